"""Columns whose tops are cut off at the largest value of the camera."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import Scene

from tract_dask import convert, estimate_drift, find_columns, fit_columns, open_movie, rebin_frames, sum_image
from tract_dask.settings import ConvertSettings, FitSettings, SourceSettings
from tract_dask.store.schema import REJECTED, Status


@pytest.fixture(scope="module")
def scene():
    return Scene(n_frames=16, amplitude=60.0, background=20.0)


@pytest.fixture(scope="module")
def movie(scene, tmp_path_factory):
    """Cut off at two thirds of the columns' amplitude."""
    folder = tmp_path_factory.mktemp("saturated")
    np.save(folder / "movie.npy", np.minimum(scene.counts(), 60))
    settings = ConvertSettings(tile_px=32, shard_mb=1)
    return open_movie(convert(folder / "movie.npy", folder / "movie.zarr", settings=settings))


def test_saturated_pixels_are_counted_and_read_as_infinite(scene, movie):
    at = np.minimum(scene.counts(), 60) == 60
    assert movie.full_scale == 60
    np.testing.assert_array_equal(np.isposinf(movie.read(0, 16)), at)
    np.testing.assert_array_equal(movie.pixels.saturated, at.sum(axis=(1, 2)))
    assert movie.statistics()["frame_max"].max() == 60


def test_drift_is_measured_on_what_was_recorded(scene, movie):
    np.testing.assert_allclose(estimate_drift(movie)["drift"], scene.drift, atol=0.15)


def test_amplitudes_and_places_are_as_if_nothing_was_cut_off(scene, movie):
    """Taken as they are, these pixels make amplitudes 20 % too small."""
    summed = sum_image(movie, scene.drift_dataset())
    found = find_columns(summed)
    assert found.sizes["column_id"] == len(scene.place)
    true = scene.columns(found.attrs["blur_sigma_px"])["fit_ref"].to_numpy()[0]
    np.testing.assert_allclose(np.median(found["fit_ref"].to_numpy()[:, 0]), true[0], rtol=0.05)
    settings = FitSettings(refine_drift=False)
    tracks = fit_columns(movie, scene.columns(), scene.drift_dataset(), settings, summed=summed).compute()
    status = tracks["status"].to_numpy()
    good = (status & REJECTED) == 0
    assert good.mean() > 0.97
    assert ((status & Status.INCOMPLETE) > 0).mean() > 0.9
    amplitude = tracks["fit"].sel(parameter="amplitude").to_numpy()[good]
    stated = tracks["stderr"].sel(parameter="amplitude").to_numpy()[good]
    assert amplitude.mean() == pytest.approx(true[0], rel=0.015)
    assert ((amplitude - true[0]) / stated).std() < 1.1
    away = (tracks["fit"].sel(parameter=["x", "y"]).to_numpy() - scene.place)[good]
    pulls = away / tracks["stderr"].sel(parameter=["x", "y"]).to_numpy()[good]
    assert np.abs(away.mean(axis=0)).max() < 4 * away.std() / np.sqrt(len(away))
    assert 0.6 < pulls.std() < 1.15


@pytest.mark.parametrize("cut", [70, 10_000])
def test_pixels_that_were_cut_off_before_they_were_summed_in_bins_are_counted(scene, cut, tmp_path):
    np.save(tmp_path / "movie.npy", np.minimum(scene.counts(), cut))
    movie = open_movie(convert(tmp_path / "movie.npy", tmp_path / "movie.zarr", source_settings=SourceSettings(bin=2)))
    found = movie.pixels.counts(movie.shape[1:])
    assert (found.get("cut off", 0) > 20) == (cut == 70)
    assert movie.full_scale is None


def test_a_sum_with_a_saturated_frame_has_no_limit(movie):
    pairs = rebin_frames(movie, 2)
    assert pairs.full_scale is None
    assert np.isposinf(pairs.read(0, 8)).any()
