"""Windows in which pixels are missing: fitted to those that are there, with errors that say what is lost."""

from __future__ import annotations

import numpy as np
import pytest

from tract_dask import convert, fit_columns, open_movie
from tract_dask.kernels.filling import fill_near
from tract_dask.kernels.windows import Tiles, cut_windows
from tract_dask.settings import ConvertSettings, FitSettings
from tract_dask.stages.fit.incomplete import cut_raw
from tract_dask.store.schema import REJECTED, Status

WAYS = {
    "lsq": FitSettings(refine_drift=False),
    "poisson": FitSettings(estimator="poisson", refine_drift=False),
    "free": FitSettings(shape="free", refine_drift=False),
}


@pytest.fixture
def fitted(tmp_path, npy, scene):
    def fit(frames, settings):
        path = convert(npy(frames), tmp_path / "movie.zarr", settings=ConvertSettings(tile_px=32), overwrite=True)
        movie = open_movie(path)
        return fit_columns(movie, scene.columns(), scene.drift_dataset(), settings, summed=scene.summed()).compute()

    return fit


def missing_pixels(scene, kind, rng):
    """Pixels that are missing in every frame: single ones, a line through a row of columns, a border beside one."""
    mask = np.zeros(scene.shape, bool)
    if kind == "single":
        mask.ravel()[rng.choice(mask.size, mask.size // 100, replace=False)] = True
    elif kind == "line":
        mask[round(scene.place[0, 1]) + 1] = True
        mask[:, round(scene.place[0, 0]) - 2] = True
    else:
        mask[round(scene.place[:, 1].max()) + 4 :] = True
    return mask


@pytest.mark.parametrize(
    ("way", "kind"),
    [("lsq", "single"), ("lsq", "border"), ("poisson", "line"), ("poisson", "border"), ("free", "border")],
)
def test_errors_are_true_where_pixels_are_missing(fitted, scene, kind, way):
    scene.n_frames = 60
    scene.__post_init__()
    frames = scene.counts().astype(np.float32)
    mask = missing_pixels(scene, kind, np.random.default_rng(3))
    whole = fitted(frames, WAYS[way])
    tracks = fitted(np.where(mask, np.nan, frames), WAYS[way])
    incomplete = (tracks.status.to_numpy() & Status.INCOMPLETE) > 0
    accepted = (tracks.status.to_numpy() & REJECTED) == 0
    here = incomplete & accepted
    assert here.sum() >= 100
    assert accepted[~incomplete].mean() > 0.98
    assert here.sum() > 0.5 * incomplete.sum()

    def pulls(fits, which):
        away = fits.fit.sel(parameter=["x", "y"]).to_numpy() - scene.place
        return (away / fits.stderr.sel(parameter=["x", "y"]).to_numpy())[which]

    found, before = pulls(tracks, here), pulls(whole, here)
    assert found.std() == pytest.approx(before.std(), rel=0.1)
    assert np.abs(found.mean(axis=0)).max() < np.abs(before.mean(axis=0)).max() + 4 / np.sqrt(len(found))
    moved = (tracks.fit - whole.fit).sel(parameter=["x", "y"]).to_numpy()[~incomplete]
    np.testing.assert_allclose(moved, 0, atol=0.01)  # by what the blur brings from beyond the round window


def test_a_window_with_little_left_is_not_fitted(fitted, scene):
    frames = scene.counts().astype(np.float32)
    x, y = np.rint(scene.place[2]).astype(int)
    frames[:, y - 12 : y + 13, x - 6 : x + 20] = np.nan
    tracks = fitted(frames, WAYS["lsq"])
    lost = tracks.isel(column_id=2)
    assert (lost.status == (Status.INCOMPLETE | Status.NOT_CONVERGED)).all()
    assert lost.fit.isnull().all()
    assert lost.presence.isnull().all()
    assert (tracks.status.isel(column_id=slice(4, None)) & ~Status.INCOMPLETE == 0).mean() > 0.98


def test_constant_frames_are_bad_frames_and_so_are_frames_that_are_mostly_missing(fitted, scene):
    frames = scene.counts().astype(np.float32)
    frames[3], frames[5, :100], frames[7, :10] = 7.0, np.nan, np.nan
    tracks = fitted(frames, WAYS["lsq"])
    bad = (tracks.status.to_numpy() & Status.BAD_FRAME) > 0
    np.testing.assert_array_equal(bad.all(axis=1), np.isin(np.arange(scene.n_frames), [3, 5]))


@pytest.mark.parametrize("name", ["wiener", "tv-l1"])
def test_a_filter_of_whole_frames_does_not_spread_what_is_missing(fitted, scene, name):
    frames = scene.counts().astype(np.float32)
    frames[:, 3, 4] = np.nan
    tracks = fitted(frames, FitSettings(filter=name, refine_drift=False))
    away = tracks.fit.sel(parameter=["x", "y"]).to_numpy() - scene.place
    assert np.isfinite(away).all()
    assert np.median(np.abs(away)) < 0.3


def test_raw_windows_are_those_that_are_cut_without_a_blur():
    rng = np.random.default_rng(0)
    frames = rng.random((2, 64, 96)).astype(np.float32)
    tiles = Tiles(
        frames.reshape(2, 2, 32, 3, 32).transpose(1, 3, 0, 2, 4).reshape(6, 2, 32, 32).copy(),
        np.arange(6).reshape(2, 3),
        (64, 96),
    )
    corners = np.array([[5, 20], [30, 50]])
    raw = cut_raw(tiles, np.array([1, 1]), corners, 13, 2.0)
    expected = cut_windows(frames[1:], corners[None, :, 0], corners[None, :, 1], 13, 0.0, 2.0)[0]
    np.testing.assert_array_equal(raw, expected)
    beyond = cut_raw(tiles, np.array([0]), np.array([[-3, 90]]), 9, 1.0)[0]
    np.testing.assert_array_equal(beyond, np.pad(frames[0], 9, mode="edge")[6:15, 99:108])


def test_what_is_missing_is_filled_by_what_is_near():
    image = np.arange(400.0).reshape(20, 20)
    holed = image.copy()
    holed[7, 9], holed[10, 3] = np.nan, np.inf
    filled = fill_near(holed)
    np.testing.assert_allclose(filled, image, atol=2.0)
    assert not fill_near(np.full((3, 3), np.nan)).any()
