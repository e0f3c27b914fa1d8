"""Frames without crystal or out of focus: their drift is held, they are not summed, and no fit is accepted."""

import numpy as np
import pytest
from conftest import Scene
from scipy.ndimage import gaussian_filter

import tract_dask as td
from tract_dask.stages.drift.measure import lost_frames
from tract_dask.store.schema import REJECTED, Status

N, LOST = 36, [0, 5, *range(16, 24), 35]
BUDGET_PX = 0.3
"""Of the drift of the other frames: a follower that is led astray comes back a period, 30 px, off."""


def movies():
    scene = Scene(n_frames=N, seed=2)
    here = np.ones((N, len(scene.place)), bool)
    here[LOST] = False
    away = scene.counts(here)
    blurred = scene.counts().astype(float)
    rng = np.random.default_rng(3)
    for k in LOST:
        blurred[k] = rng.poisson(gaussian_filter(scene.frame(scene.drift[k]), 12.0))
    return scene, {"away": away, "out of focus": blurred.astype(np.uint16)}


@pytest.mark.parametrize("kind", ["away", "out of focus"])
def test_lost_frames_are_held_and_said(npy, tmp_path, kind):
    scene, made = movies()
    td.convert(npy(made[kind]), tmp_path / "movie.zarr")
    movie = td.open_movie(tmp_path / "movie.zarr")
    drift = td.estimate_drift(movie)
    lost = drift["quality"].to_numpy() == 0
    assert np.flatnonzero(lost).tolist() == LOST
    error = drift["drift"].to_numpy() - scene.drift
    error -= np.median(error, axis=0)
    assert np.abs(error[~lost]).max() < BUDGET_PX
    between = drift["drift"].to_numpy()[[15, 24]]
    np.testing.assert_allclose(drift["drift"][16:24].mean(axis=0), between.mean(axis=0), atol=1e-6)
    summed = td.sum_image(movie, drift)
    assert summed.attrs["n_frames"] == N - len(LOST)
    tracks = td.fit_columns(movie, td.find_columns(summed), drift, summed=summed).load()
    status = tracks["status"].to_numpy()
    assert ((status & Status.LOST_FRAME) > 0).all(axis=1).nonzero()[0].tolist() == LOST
    assert ((status[lost] & REJECTED) > 0).all()
    assert ((status[~lost] & REJECTED) == 0).mean() > 0.98
    assert np.isnan(tracks["presence"].to_numpy()[lost]).all()


def test_low_quality_that_scatters_is_no_loss():
    rng = np.random.default_rng(0)
    assert not lost_frames(np.clip(rng.normal(0.1, 0.02, 1000), 0, 1)).any()
    assert not lost_frames(np.zeros(5)).any()


def test_without_any_structure_no_frame_is_lost(npy, tmp_path):
    td.convert(npy(np.full((4, 80, 90), 7, np.uint16)), tmp_path / "movie.zarr")
    drift = td.estimate_drift(td.open_movie(tmp_path / "movie.zarr"))
    assert not drift["drift"].to_numpy().any()
