"""Pixels of any size: the same picture in other units gives the same columns at the same places."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import xarray as xr
from conftest import Scene

from tract_dask import convert, estimate_drift, find_columns, fit_columns, open_movie, sum_image
from tract_dask.errors import InputError
from tract_dask.kernels.magnitude import unit_of
from tract_dask.progress import Warned
from tract_dask.readers import open_source
from tract_dask.settings import ColumnSettings, ConvertSettings, FitSettings, MetadataSettings, RunSettings
from tract_dask.stages.columns.detect import detect_columns
from tract_dask.stages.convert.stage import convert_stage
from tract_dask.stages.pixel_range import check_pixels

SAME_PX = 1e-3
LUCK = 0.02
"""Share of the fits that may end otherwise: some take a step more or less where float32 rounds otherwise."""
SCENE = {"n_frames": 6, "shape": (208, 192)}


class Made(NamedTuple):
    """What the stages make of a movie."""

    drift: xr.Dataset
    summed: xr.Dataset
    columns: xr.Dataset
    tracks: xr.Dataset


@pytest.fixture(scope="module")
def make(tmp_path_factory):
    """Make tracks of frames, stage by stage."""

    def make(frames, columns=None, gain=1.0, **fit):
        folder = tmp_path_factory.mktemp("scale")
        np.save(folder / "movie.npy", frames)
        settings, metadata = ConvertSettings(tile_px=32), MetadataSettings(gain=gain)
        movie = open_movie(convert(folder / "movie.npy", folder / "movie.zarr", settings=settings, metadata=metadata))
        drift = estimate_drift(movie)
        summed = sum_image(movie, drift)
        found = find_columns(summed, columns)
        tracks = fit_columns(movie, found, drift, FitSettings(**fit), summed=summed).compute()
        return Made(drift, summed, found, tracks)

    return make


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    return Scene(**SCENE).counts()


@pytest.fixture(scope="module")
def plain(make, frames) -> Made:
    return make(frames.astype(np.float32))


def assert_same(made: Made, plain: Made, factor: float = 1.0) -> None:
    """Check that all is the same but for the units of what is counted."""
    np.testing.assert_allclose(made.drift["drift"], plain.drift["drift"], atol=SAME_PX)
    assert made.columns.sizes == plain.columns.sizes
    np.testing.assert_array_equal(made.columns["status_ref"], plain.columns["status_ref"])
    same = (made.tracks["status"] == plain.tracks["status"]).to_numpy()
    assert same.mean() > 1 - LUCK
    for name in ("x", "y", "sigma_a", "sigma_b"):
        found, right = (which.tracks["fit"].sel(parameter=name).to_numpy() for which in (made, plain))
        np.testing.assert_allclose(found[same], right[same], atol=SAME_PX)
    np.testing.assert_allclose(made.tracks["centroid"], plain.tracks["centroid"], atol=2 * SAME_PX)
    counted = [made.tracks["fit"].sel(parameter=name) / factor for name in ("amplitude", "background")]
    right = [plain.tracks["fit"].sel(parameter=name) for name in ("amplitude", "background")]
    for name in ("noise", "intensity", "intensity_stderr"):
        counted.append(made.tracks[name] / factor)
        right.append(plain.tracks[name])
    for one, other in zip(counted, right, strict=True):
        shown = same if one.ndim == 2 else ...
        np.testing.assert_allclose(one.to_numpy()[shown], other.to_numpy()[shown], rtol=2e-3, atol=1e-2)
    for name in ("presence", "presence_vacuum", "r_squared", "shape_error"):
        np.testing.assert_allclose(made.tracks[name], plain.tracks[name], rtol=1e-3, atol=1e-2)


def test_no_column_is_split_by_its_own_noise(plain):
    """Counts vary most where columns are bright: that is no second column."""
    assert plain.columns.sizes["column_id"] == len(Scene(**SCENE).place)


@pytest.mark.parametrize("factor", [1e-30, 1e-16, 1e-7, 1e5, 1e6, 1e8, 1e15, 1e30])
def test_frames_times_a_factor_give_the_same_tracks(make, frames, plain, factor):
    assert_same(make((frames * factor).astype(np.float32)), plain, factor)


@pytest.mark.parametrize(("dtype", "factor"), [("uint32", 10_000_000), ("int32", 9_000_001)])
def test_large_pixels_of_other_types_give_the_same_tracks(make, frames, plain, dtype, factor):
    assert_same(make(frames.astype(dtype) * np.dtype(dtype).type(factor)), plain, factor)


def test_a_gain_that_undoes_the_factor_gives_the_same_counts(make, frames, plain):
    assert_same(make((frames * 1e9).astype(np.float32), gain=1e-9), plain)


def test_a_power_of_two_changes_no_bit(make, frames):
    small, large = (make((frames * 2.0**power).astype(np.float32)) for power in (-60, 60))
    for name in ("fit", "stderr", "noise", "intensity"):
        kind = np.array([2.0**120 if k in (0, 6) else 1.0 for k in range(7)])
        factor = kind if name in ("fit", "stderr") else 2.0**120
        np.testing.assert_array_equal(small.tracks[name] * factor, large.tracks[name])


@pytest.mark.parametrize("fit", [{"estimator": "poisson"}, {"filter": "wiener"}, {"filter": "none", "shape": "free"}])
@pytest.mark.parametrize("factor", [1e-16, 1e8])
def test_every_fit_is_the_same(make, frames, fit, factor):
    plain, scaled = (make((frames * times).astype(np.float32), **fit) for times in (1.0, factor))
    assert_same(scaled, plain, factor)


@pytest.mark.parametrize("factor", [1.0, 1e-12, 1e9])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("offset", [-1000.0, 1e4])
def test_negative_pixels_and_dark_columns_give_the_same_places(make, frames, plain, factor, sign, offset):
    settings = ColumnSettings(contrast="bright" if sign > 0 else "dark")
    made = make((factor * (sign * frames.astype(np.float64) + offset)).astype(np.float32), settings)
    np.testing.assert_allclose(made.columns["x_ref"], plain.columns["x_ref"], atol=5 * SAME_PX)
    same = (made.tracks["status"] == plain.tracks["status"]).to_numpy()
    assert same.mean() > 1 - LUCK
    found, right = (which.tracks["fit"].sel(parameter=["x", "y"]).to_numpy()[same] for which in (made, plain))
    np.testing.assert_allclose(found, right, atol=5 * SAME_PX)


@pytest.mark.parametrize("method", ["maxima", "blobs", "template"])
@pytest.mark.parametrize("factor", [1e-30, 1e-12, 1e30])
def test_detections_are_the_same(frames, method, factor):
    image = frames.mean(axis=0)
    plain, scaled = (detect_columns(image * times, method) for times in (1.0, factor))
    for name in ("x", "y", "strength"):
        np.testing.assert_allclose(scaled[name], plain[name], rtol=1e-4)


def statistics(mean: float, spread: float) -> xr.Dataset:
    found = {"frame_mean": mean, "frame_std": spread, "frame_min": mean - 3 * spread, "frame_max": mean + 3 * spread}
    return xr.Dataset({name: ("t", [value, np.nan, value]) for name, value in found.items()})


def test_a_background_that_rounding_makes_visible_is_said_or_refused():
    assert check_pixels(statistics(1e6, 100.0), "m") is None
    assert check_pixels(statistics(5.0, 0.0), "m") is None
    assert "1e+05 times" in check_pixels(statistics(1e6, 10.0), "m")
    with pytest.raises(InputError, match=r"rounding would spoil.*Subtract a constant"):
        check_pixels(statistics(-1e9, 100.0), "m")


def test_a_large_background_gives_the_same_places(make, frames, plain):
    made = make(frames.astype(np.uint32) + 300_000)
    np.testing.assert_array_equal(made.tracks["status"], plain.tracks["status"])
    found, right = (which.tracks["fit"].sel(parameter=["x", "y"]) for which in (made, plain))
    np.testing.assert_allclose(found, right, atol=5 * SAME_PX)


@pytest.mark.parametrize("factor", [1e100, 1e-60])
def test_pixels_beyond_float32_are_refused(npy, frames, tmp_path, factor):
    with pytest.raises(InputError, match="to be computed"):
        convert_stage(open_source(npy(frames * factor)), tmp_path / "movie.zarr", RunSettings(), lambda: None)


def test_a_run_says_that_the_background_is_large(npy, frames, tmp_path):
    events, source = [], open_source(npy(frames.astype(np.uint32) + 1_000_000))
    convert_stage(source, tmp_path / "movie.zarr", RunSettings(), lambda: None, events.append)
    assert any("rounding" in event.message for event in events if isinstance(event, Warned))


def test_a_unit_is_a_power_of_two_near_the_values():
    rng = np.random.default_rng(0)
    for power in range(-300, 300, 7):
        values = rng.uniform(0.5, 2.0, (40, 50)) * 2.0**power
        unit = unit_of(values)
        assert 0.4 < values.mean() / unit < 2.0 or (unit == 1.0 and -17 < power < 17)
        assert np.frexp(unit)[0] == 0.5
    assert unit_of(np.zeros(3)) == unit_of(np.array([])) == unit_of([np.nan]) == 1.0
    assert np.isfinite(unit_of([1.7e308] * 3))
