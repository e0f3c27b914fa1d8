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
from tract_dask.analysis.jumps import noise_factor
from tract_dask.report import findings as room
from tract_dask.report.findings import findings
from tract_dask.report.survey import gathered, survey
from tract_dask.settings import ColumnSettings, ConvertSettings, FitSettings, RunSettings
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


@pytest.fixture(scope="module")
def drifting(tmp_path_factory):
    """A crystal that drifts by 22 px along y within eight frames: its scene, its movie, and a run's numbers."""
    folder, scene = tmp_path_factory.mktemp("drifting"), Scene(n_frames=8)
    scene.drift[:, 0] = np.linspace(-11, 11, scene.n_frames)
    np.save(folder / "movie.npy", scene.counts())
    movie = open_movie(convert(folder / "movie.npy", folder / "movie.zarr"))
    return scene, movie, survey(Run(folder).write(), [])


def told(drifting, columns=None, drift=None, **settings):
    """Return the names of what is known of fits with these settings."""
    scene, movie, known = drifting
    columns = scene.columns(settings.get("blur_sigma_px", 2.0)) if columns is None else columns
    drift = scene.drift_dataset() if drift is None else drift
    fit = FitSettings(**settings)
    return told_of(known, fit_columns(movie, columns, drift, fit, summed=scene.summed()), fit)


def told_of(known, tracks, fit=None):
    """Return what is known of these tracks, by name; ``known`` has the rest of the run."""
    tracks = tracks.compute()
    tracks.attrs["pixel_size_pm"] = 4.0
    numbers, frames, series = gathered(tracks, None)
    nothing = ("column_id", np.full(tracks.sizes["column_id"], np.nan))
    run = replace(
        known,
        tracks=tracks,
        columns=numbers.assign(dict.fromkeys(("residual", "p_value"), nothing)),
        frames=frames,
        series=series,
        settings=RunSettings(fit=fit or FitSettings()),
        factor=float(np.median(noise_factor(tracks)["factor"])),
    )
    return {finding.name: finding for finding in findings(run)}


def test_a_smaller_window_reaches_closer_to_the_edge(drifting):
    wide, narrow = (told(drifting, window_px=window) for window in (51, 19))
    assert "window-px" in wide["at_the_edge"].remedy
    assert "at_the_edge" not in narrow


def test_a_long_drift_is_short_in_a_part_of_the_frames(drifting, tmp_path):
    assert "--frames" in told(drifting)["long_drift"].remedy
    scene, _, known = drifting
    part = Scene(n_frames=3)
    part.drift = scene.drift[2:5] - scene.drift[3]
    np.save(tmp_path / "part.npy", part.counts())
    movie = open_movie(convert(tmp_path / "part.npy", tmp_path / "part.zarr"))
    assert "long_drift" not in told((part, movie, known))


def test_fits_that_were_stopped_settle_with_more_iterations(drifting):
    few = told(drifting, max_iterations=1)
    assert "fit.max_iterations=50" in few["not_converged"].remedy
    assert "not_converged" not in told(drifting)


def test_a_smaller_blur_or_a_larger_window_gives_errors(drifting):
    columns = drifting[0].columns(6.0).isel(column_id=slice(0, 2))
    assert "--blur-sigma-px" in told(drifting, columns, blur_sigma_px=6.0, window_px=13)["no_errors"].remedy
    columns = drifting[0].columns(1.0).isel(column_id=slice(0, 2))
    assert "no_errors" not in told(drifting, columns, blur_sigma_px=1.0, window_px=21)


def test_without_filters_of_whole_frames_errors_are_known(drifting):
    assert "--filter gaussian" in told(drifting, filter="wiener")["no_errors"].remedy
    assert "no_errors" not in told(drifting)


def test_a_mask_that_is_wrong_is_not_made_where_it_is_not_wanted(tmp_path, npy):
    frames = Scene(n_frames=16).counts()
    frames[:, :, 100:104] = 0
    left = []
    for wanted in (True, False):
        path = convert(npy(frames), tmp_path / f"{wanted}.zarr", settings=ConvertSettings(find_defects=wanted))
        left.append(open_movie(path).pixels)
    assert sum(left[0].counts(frames.shape[1:]).values()) >= 4 * frames.shape[1]
    assert not left[1]


def test_columns_need_pixels_that_are_small_enough(tmp_path):
    made = Run(tmp_path)
    known = survey(made.write(), [])
    for sigma, narrow in ((0.7, True), (0.85, False)):
        run = replace(known, found=known.found | {"sigma_px": sigma})
        assert ("undersampled" in {finding.name for finding in findings(run)}) == narrow
