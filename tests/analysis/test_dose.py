"""Sums of frames made on reading: against the frames themselves, and against truth."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import xarray as xr

from tract_dask import convert, estimate_drift, fit_columns, fit_doses, open_movie, rebin_frames, sum_image
from tract_dask.analysis.dose import SummedFrames
from tract_dask.errors import SettingsError
from tract_dask.kernels.gaussian import parameters
from tract_dask.settings import ConvertSettings, FitSettings, MetadataSettings
from tract_dask.stages.fit.job import prepare
from tract_dask.stages.fit.stage import fit_movie
from tract_dask.store import schema
from tract_dask.store.results import open_results

LAYOUT = ConvertSettings(tile_px=32, find_defects=False)
KNOWN = MetadataSettings(pixel_size_pm=8.0, frame_time_s=0.5, dose=125.0)


@pytest.fixture
def make_movie(tmp_path, npy):
    def make(frames):
        place = tmp_path / f"movie{len(list(tmp_path.iterdir()))}.zarr"
        return open_movie(convert(npy(frames), place, settings=LAYOUT, metadata=KNOWN))

    return make


def random_drift(n_frames: int, reach: float = 6.0) -> xr.Dataset:
    shift = np.random.default_rng(1).uniform(-reach, reach, (n_frames, 2))
    quality = np.linspace(0.5, 1, n_frames)
    return xr.Dataset({"drift": (("frame", "axis"), shift), "quality": ("frame", quality)})


def expected(frames: np.ndarray, n: int, drift: xr.Dataset | None) -> np.ndarray:
    """Sums by the book: frame(y + dy, x + dx), with the edge pixel going on, added up in int64 or float64."""
    count = len(frames) // n
    shift = np.zeros((count, n, 2)) if drift is None else drift["drift"].to_numpy()[: count * n].reshape(count, n, 2)
    whole = np.rint(shift - shift.mean(axis=1, keepdims=True)).astype(int)
    y, x = np.arange(frames.shape[1]), np.arange(frames.shape[2])
    sums = []
    for group in range(count):
        moved = [
            frames[group * n + k][np.ix_(np.clip(y + dy, 0, y[-1]), np.clip(x + dx, 0, x[-1]))].astype(
                float if frames.dtype.kind == "f" else int
            )
            for k, (dy, dx) in enumerate(whole[group])
        ]
        sums.append(sum(moved))
    return np.array(sums)


@pytest.mark.parametrize("n", [1, 3, 7, 21])
@pytest.mark.parametrize("moves", [False, True])
def test_sums_are_those_of_the_frames(make_movie, n, moves):
    frames = np.random.default_rng(0).poisson(200, (21, 75, 61)).astype(np.uint8)
    drift = (
        random_drift(21, 40.0 if n == 3 else 6.0) if moves else None
    )  # 40 px: farther than a tile, than half a field
    sums, truth = rebin_frames(make_movie(frames), n, drift), expected(frames, n, drift)
    assert sums.shape == truth.shape
    np.testing.assert_array_equal(sums.read(0, sums.n_frames), truth)
    np.testing.assert_array_equal(sums.read(0, 1, slice(40, 70), slice(25, 61)), truth[:1, 40:70, 25:61])
    np.testing.assert_array_equal(sums.frames.compute(scheduler="sync"), truth)
    patched = np.zeros(sums.shape, int)
    for shard in sums.shards:
        for start, top, left, tile in sums.tiles(shard):
            patched[start : start + len(tile), top : top + tile.shape[1], left : left + tile.shape[2]] += tile
    np.testing.assert_array_equal(patched, truth)


def test_tiles_that_are_not_asked_for_are_not_read(make_movie):
    frames = np.random.default_rng(0).poisson(9, (8, 160, 160)).astype(np.uint16)
    sums = rebin_frames(make_movie(frames), 2, random_drift(8, 2.0))
    tiles = sums.read_tiles(0, 2, np.array([[70, 70, 90, 90]]))
    assert (tiles.place >= 0).sum() == 1
    np.testing.assert_array_equal(
        tiles.pixels[0][:, 6:26, 6:26], expected(frames, 2, random_drift(8, 2.0))[:2, 70:90, 70:90]
    )


@pytest.mark.parametrize(
    ("dtype", "largest"),
    [("float16", 60_000), ("float32", 2**22), ("int16", -(2**15)), ("uint16", 2**16 - 1), ("uint32", 2**32 - 1)],
)
def test_every_kind_of_pixel_is_summed_exactly(make_movie, dtype, largest):
    frames = np.random.default_rng(0).integers(0, 2000, (6, 40, 36)).astype(dtype)
    frames[:3, 0, 0] = largest  # three of which leave the dtype
    sums = rebin_frames(make_movie(frames), 3)
    np.testing.assert_array_equal(sums.read(0, 2), expected(frames.astype(float), 3, None))


def test_metadata_follow(make_movie):
    frames = np.random.default_rng(0).poisson(5, (23, 40, 36)).astype(np.uint16)
    sums = rebin_frames(make_movie(frames), 4)
    assert (sums.n_frames, sums.n_dropped, sums.dose, sums.frame_time_s, sums.pixel_size_pm) == (5, 3, 500.0, 2.0, 8.0)
    assert sums.drift is None
    np.testing.assert_allclose(sums.frames["t"], 2.0 * np.arange(5))
    statistics = sums.statistics()
    np.testing.assert_allclose(statistics["frame_mean"], expected(frames, 4, None).mean(axis=(1, 2)))
    assert (statistics["frame_min"] <= expected(frames, 4, None).min(axis=(1, 2))).all()
    assert (statistics["frame_max"] >= expected(frames, 4, None).max(axis=(1, 2))).all()


def test_a_sum_with_a_bad_frame_is_bad(make_movie):
    frames = np.random.default_rng(0).poisson(5, (12, 40, 36)).astype(np.float32)
    frames[5, 3, 4] = np.nan
    sums = rebin_frames(make_movie(frames), 3)
    np.testing.assert_array_equal(sums.statistics()["frame_bad_pixels"], [0, 1, 0, 0])
    assert np.isnan(sums.read(1, 2)[0, 3, 4])


def test_what_rounding_leaves_is_the_drift_of_the_sums(make_movie):
    frames = np.zeros((20, 40, 36), np.uint8)
    drift = random_drift(20)
    sums = rebin_frames(make_movie(frames), 5, drift)
    left = drift["drift"].to_numpy().reshape(4, 5, 2) - sums.shift.reshape(4, 5, 2)
    np.testing.assert_allclose(sums.drift["drift"], left.mean(axis=1))
    assert (left.std(axis=1) < 0.5).all()
    np.testing.assert_array_equal(sums.drift["quality"], drift["quality"].to_numpy().reshape(4, 5).min(axis=1))
    schema.validate(sums.drift, schema.DRIFT, "drift")


def test_sums_of_sums_and_pickles(make_movie):
    frames = np.random.default_rng(0).poisson(5, (24, 75, 61)).astype(np.uint8)
    twice = rebin_frames(rebin_frames(make_movie(frames), 2), 3)
    again = pickle.loads(pickle.dumps(twice))
    assert isinstance(again, SummedFrames)
    assert (again.key, again.dose) == (twice.key, 6 * 125.0)
    np.testing.assert_array_equal(again.read(0, 4), expected(frames, 6, None))


def test_numbers_of_frames_that_cannot_be(make_movie):
    movie = make_movie(np.zeros((6, 40, 36), np.uint8))
    for n in (0, 7):
        with pytest.raises(SettingsError, match="1 to 6 frames"):
            rebin_frames(movie, n)
    with pytest.raises(SettingsError, match="another movie"):
        rebin_frames(movie, 2, random_drift(5))


# Fits


def test_fits_of_sums_are_those_of_a_brighter_movie(scene, make_movie):
    """Fitting sums equals, value by value, fitting a movie made of them."""
    frames, drift = scene.counts(), scene.drift_dataset()
    (summed_up,) = fit_doses(make_movie(frames), scene.columns(), drift, groups=[3], summed=scene.summed())
    columns = scene.columns()
    columns["fit_ref"][:, [parameters.AMPLITUDE, parameters.BACKGROUND]] *= 3
    sums = rebin_frames(make_movie(frames), 3, drift)
    brighter = make_movie(expected(frames, 3, drift).astype(np.uint32))
    direct = fit_columns(brighter, columns, sums.drift, summed=scene.summed().assign(image=3 * scene.summed()["image"]))
    for name in ("fit", "stderr", "intensity", "status", "noise", "drift"):
        np.testing.assert_array_equal(summed_up[name], direct[name], err_msg=name)
    assert summed_up.attrs["dose"] == 375.0
    np.testing.assert_allclose(summed_up["time"], 1.5 * np.arange(4))


def test_drifting_frames_are_aligned_before_they_are_summed(scene, make_movie):
    """Positions in sums of six drifting frames are as good as counting allows, and where they are without drift."""
    scene.max_drift = 12.0
    scene.n_frames = 24
    scene.__post_init__()
    scene.drift[:] = np.linspace(-6, 6, 24)[:, None] * [0.7, 1.0]
    frames = np.array([scene.frame(shift) for shift in scene.drift], dtype=np.float32)
    (tracks,) = fit_doses(
        make_movie(frames), scene.columns(), scene.drift_dataset(), groups=[6], settings=FitSettings(refine_drift=False)
    )
    away = tracks["fit"].sel(parameter=["x", "y"]).to_numpy() - scene.place
    assert np.abs(away).max() <= 1e-2  # neighbours' tails, as in the frames themselves


def test_precision_grows_with_the_square_root_of_the_dose(scene, make_movie):
    scene.n_frames = 48
    scene.__post_init__()
    movie = make_movie(scene.counts())
    doses = fit_doses(
        movie, scene.columns(), scene.drift_dataset(), groups=(1, 4), settings=FitSettings(refine_drift=False)
    )
    few, many = (tracks["fit"].sel(parameter=["x", "y"]).to_numpy() - scene.place for tracks in doses)
    assert few.std() / many.std() == pytest.approx(2.0, rel=0.12)  # 384 values in the second: known to 4 %
    slopes = [float(tracks["fit"].sel(parameter="amplitude").mean()) for tracks in doses]
    assert slopes[1] / slopes[0] == pytest.approx(4.0, rel=0.02)


def test_stages_take_sums_for_a_movie(scene, make_movie, tmp_path):
    scene.n_frames = 16
    scene.__post_init__()
    movie = make_movie(scene.counts())
    pairs = rebin_frames(movie, 2)
    summed = sum_image(pairs)
    np.testing.assert_allclose(summed["image"], 2 * sum_image(movie)["image"])
    drift = estimate_drift(pairs)
    truth = scene.drift.reshape(8, 2, 2).mean(axis=1)
    away = drift["drift"].to_numpy() - truth
    assert np.abs(away - np.median(away, axis=0)).max() <= 0.25
    job = prepare(pairs, scene.columns(), drift, FitSettings())
    fit_movie(pairs, job, tmp_path / "results.zarr")
    lazily = fit_columns(pairs, scene.columns(), drift)
    np.testing.assert_array_equal(open_results(tmp_path / "results.zarr")["fit"], lazily["fit"])
    assert lazily.attrs.items() <= open_results(tmp_path / "results.zarr").attrs.items()
