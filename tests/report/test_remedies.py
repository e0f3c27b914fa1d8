"""Every warning is on the page docs/trust.md, and what it advises makes it go."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from conftest import Scene
from test_report import Run

from tract_dask import convert, find_columns, fit_columns, open_movie
from tract_dask.report import findings as room
from tract_dask.report.findings import findings
from tract_dask.report.survey import survey
from tract_dask.settings import ColumnSettings, FitSettings, RunSettings
from tract_dask.store.schema import Status

ROOT = Path(__file__).parents[2]


def test_every_warning_is_documented():
    source = Path(room.__file__).read_text(encoding="utf-8")
    names = re.findall(r'Finding\(\s*"([a-z_]+)"', source)
    rows = re.findall(r"^\| `([a-z_]+)` \|", (ROOT / "docs/trust.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(names) > 20
    assert set(rows) == set(names)


def test_calibrations_that_are_given_are_not_missed(tmp_path):
    lacking = Run(tmp_path, pixel_size_pm=None, frame_time_s=None)
    assert lacking.names() == {"pixel_size", "frame_time"}
    known = tmp_path / "known"
    known.mkdir()
    assert Run(known).names() == set()


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ({"contrast": "bright"}, {"contrast": "dark"}),
        ({"contrast": "bright"}, {}),
    ],
)
def test_the_right_contrast_or_none_makes_doubts_go(tmp_path, wrong, right):
    scene = Scene(amplitude=-12.0)
    image = np.random.default_rng(0).poisson(scene.frame(np.zeros(2)) * 40) / 40
    exposure = np.full(image.shape, 40, np.uint32)
    summed = xr.Dataset({"image": (("y", "x"), image), "exposure": (("y", "x"), exposure)})
    made = Run(tmp_path)
    known = survey(made.write(), [])
    for settings, doubtful in ((wrong, True), (right, False)):
        found = find_columns(summed, ColumnSettings(**settings))
        about = {name: value for name, value in found.attrs.items() if value is not None}
        run = replace(known, found=about, tracks=found.assign_attrs(known.tracks.attrs))
        names = {finding.name for finding in room._found(run)}
        assert ("doubtful_columns" in names) == doubtful, settings


def test_a_smaller_window_misses_fewer_pixels(tmp_path, npy):
    scene = Scene(n_frames=8)
    frames = scene.counts().astype("f4")
    frames[:, :, 106] = np.nan
    movie = open_movie(convert(npy(frames), tmp_path / "movie.zarr"))
    missing = []
    for window in (19, 11):
        settings = FitSettings(window_px=window)
        tracks = fit_columns(movie, scene.columns(), scene.drift_dataset(), settings, summed=scene.summed()).compute()
        missing.append(int((tracks["status"].to_numpy() & Status.INCOMPLETE > 0).sum()))
    assert missing[0] > 2 * missing[1]


def test_a_spacing_left_unset_is_plausible(tmp_path):
    made = Run(tmp_path)
    made.columns["status_ref"][::3] = Status.AT_BOUND
    made.settings = RunSettings(columns=ColumnSettings(spacing_px=12.0))
    known = survey(made.write(), [])
    assert "spacing" in {finding.name for finding in findings(known)}
    assert "spacing" not in {finding.name for finding in findings(replace(known, settings=RunSettings()))}
