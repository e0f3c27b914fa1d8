"""Settings: what they take, and their TOML."""

from __future__ import annotations

import pytest

from tract_dask.errors import SettingsError
from tract_dask.settings import ColumnSettings, FitSettings, RunSettings, toml
from tract_dask.store import datasets


def test_settings_survive_toml():
    made = RunSettings(
        fit=FitSettings(window_px=31, vacuum_box=(0, 10, 5, 50)),
        columns=ColumnSettings(method="lattice", lattices=({"origin": [1.0, 2.0], "a_count": 3},)),
    )
    assert toml.from_toml(RunSettings, toml.to_toml(made)) == made


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FitSettings(blur_sigma_px=-1), "blur_sigma_px.*at least 0 and at most 20 px; got -1"),
        (lambda: FitSettings(window_px=4.5), "window_px.*int; got 4.5"),
        (lambda: FitSettings(intensity_scale="box"), "one of paper, ellipse; got 'box'"),
        (lambda: FitSettings(threshold=float("nan")), "threshold.*out of range"),
        (lambda: toml.from_toml(RunSettings, "[fit]\nwindow = 3"), "no setting 'window'"),
        (lambda: toml.from_toml(RunSettings, "fit = 3"), "a table \\[fit\\]"),
        (lambda: toml.from_toml(RunSettings, "[fit\n"), "not valid TOML"),
        (lambda: toml.load(datasets.Path("nowhere.toml")), "nowhere.toml: the settings file cannot be read"),
    ],
)
def test_bad_settings_name_themselves(make, message):
    with pytest.raises(SettingsError, match=message):
        make()
