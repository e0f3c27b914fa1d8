"""Movies with pixels that carry no data: found when they are converted, and left out of every number."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import Scene

from tract_dask import convert, estimate_drift, find_columns, fit_columns, open_movie, sum_image
from tract_dask.progress import StageDone
from tract_dask.settings import ConvertSettings, FitSettings
from tract_dask.store.schema import REJECTED, Status

SMALL = ConvertSettings(tile_px=32, shard_mb=1)


@pytest.fixture(scope="module")
def scene():
    return Scene(n_frames=24, amplitude=30.0, background=10.0)


@pytest.fixture
def make(tmp_path, npy):
    def made(frames, settings=SMALL):
        events = []
        path = convert(npy(frames), tmp_path / "movie.zarr", settings=settings, overwrite=True, on_event=events.append)
        summary = next(event.summary for event in events if isinstance(event, StageDone))
        return open_movie(path), summary

    return made


def spoiled(scene, kind):
    """Frames with faults, and where they are (frames, y, x)."""
    rng, frames = np.random.default_rng(8), scene.counts()
    faults = np.zeros(frames.shape, bool)
    if kind == "hot":
        faults[:, *rng.integers(0, scene.shape, (40, 2)).T] = True
        frames[faults] = 60_000
    elif kind == "spikes":
        for fault in faults:
            fault[*rng.integers(0, scene.shape, (10, 2)).T] = True
        frames[faults] = rng.integers(400, 4000, faults.sum())
    elif kind == "dead line":
        faults[:, 90] = True
        frames[faults] = 0
    elif kind == "moving border":
        for fault, (dy, dx) in zip(faults, np.rint(scene.drift).astype(int), strict=True):
            fault[: 6 + dy], fault[:, 121 + dx :] = True, True
        frames[faults] = 0
    return frames, faults


FOUND = {
    "hot": "40 hot pixels left out",
    "spikes": "spikes left out",
    "dead line": "144 pixels in lines left out",
    "moving border": "24 frames with a border",
}


@pytest.mark.parametrize("kind", FOUND)
def test_what_carries_no_data_changes_nothing_else(make, scene, kind):
    frames, faults = spoiled(scene, kind)
    clean, _ = make(scene.counts())
    expected, truth = estimate_drift(clean)["drift"].to_numpy(), scene.drift_dataset()
    movie, summary = make(frames)
    assert FOUND[kind] in summary
    missing = np.isnan(movie.read(0, movie.n_frames))
    assert missing[faults].mean() > 0.98
    assert (missing & ~faults).mean() < 0.02  # beside a border
    np.testing.assert_array_equal(movie.statistics()["frame_bad_pixels"], missing.sum(axis=(1, 2)))
    assert movie.statistics()["frame_max"].max() < 150
    np.testing.assert_allclose(estimate_drift(movie)["drift"], expected, atol=0.05)
    summed = sum_image(movie, truth)
    assert summed["image"].max() < 60
    tracks = fit_columns(movie, scene.columns(), truth, FitSettings(refine_drift=False), summed=summed).compute()
    status = tracks["status"].to_numpy()
    ok, incomplete = (status & REJECTED) == 0, (status & Status.INCOMPLETE) > 0
    assert incomplete.any()
    assert ok.mean() > 0.97
    away = tracks["fit"].sel(parameter=["x", "y"]).to_numpy() - scene.place
    errors = tracks["stderr"].sel(parameter=["x", "y"]).to_numpy()
    pulls = (away / errors)[ok & incomplete]
    assert pulls.std() == pytest.approx(1, abs=0.3)


def test_the_frames_on_disk_are_those_that_were_recorded(make, scene):
    import zarr

    frames, _ = spoiled(scene, "hot")
    movie, _ = make(frames)
    np.testing.assert_array_equal(zarr.open_array(movie.path / "0", mode="r")[:], frames)
    assert zarr.open_array(movie.path / "pixels" / "mask", mode="r")[:].astype(bool).sum() == 40


def test_tiles_parts_and_whole_frames_miss_the_same_pixels(make, scene):
    frames, _ = spoiled(scene, "moving border")
    frames[:, 100, 100] = 5000
    movie, _ = make(frames)
    whole = movie.read(0, movie.n_frames)
    assert np.isnan(whole[:, 100, 100]).all()
    np.testing.assert_array_equal(movie.read(3, 9, slice(90, 120), slice(-60, None)), whole[3:9, 90:120, -60:])
    np.testing.assert_array_equal(movie.frames[5:7, 2:40].compute(), whole[5:7, 2:40])
    for shard in movie.shards:
        for first, top, left, tile in movie.tiles(shard):
            n, height, width = tile.shape
            np.testing.assert_array_equal(tile, whole[first : first + n, top : top + height, left : left + width])


def test_nothing_is_stored_where_nothing_is_found(make, scene):
    movie, summary = make(scene.counts())
    assert "left out" not in summary
    assert not (movie.path / "pixels").exists()
    assert movie.dtype == np.uint16
    assert not movie.pixels


def test_it_can_be_switched_off(make, scene):
    frames, _ = spoiled(scene, "hot")
    movie, summary = make(frames, ConvertSettings(find_defects=False))
    assert "left out" not in summary
    np.testing.assert_array_equal(movie.read(0, 24), frames)


def test_columns_without_a_reference_are_not_accepted_where_pixels_are_missing(make, scene):
    frames = scene.counts().astype(np.float32)
    frames[:, :, 116:] = np.nan
    columns = scene.columns()
    cut = scene.place[:, 0] > 100
    columns["fit_ref"][cut] = np.nan
    columns["x_ref"][cut], columns["y_ref"][cut] = scene.place[cut, 0] - 6.0, scene.place[cut, 1]
    movie, _ = make(frames)
    settings = FitSettings(refine_drift=False)
    tracks = fit_columns(movie, columns, scene.drift_dataset(), settings, summed=scene.summed()).compute()
    status = tracks["status"].to_numpy()
    assert ((status[:, cut] & Status.INCOMPLETE) > 0).mean() > 0.2
    assert not ((status & REJECTED) == 0)[:, cut][(status[:, cut] & Status.INCOMPLETE) > 0].any()
    assert ((status & REJECTED) == 0)[:, ~cut].mean() > 0.27


def test_columns_are_found_without_the_hot_pixels(make, scene):
    frames, _ = spoiled(scene, "hot")
    movie, _ = make(frames)
    found = find_columns(sum_image(movie, scene.drift_dataset()))
    places = found["fit_ref"].sel(parameter=["x", "y"]).to_numpy()
    nearest = np.hypot(*(places[:, None] - scene.place).transpose(2, 0, 1)).min(axis=1)
    assert len(places) == len(scene.place)
    assert nearest.max() < 0.5


def test_hot_pixels_cost_no_column_its_reference_where_nothing_drifts(make):
    """Forty of them, in the windows of most columns: as without them within 0.1 px and 5 % of the amplitude."""
    scene = Scene(n_frames=24, amplitude=30.0, background=10.0, max_drift=0.0)
    frames, _ = spoiled(scene, "hot")
    movie, _ = make(frames)
    found = find_columns(sum_image(movie))
    sound = find_columns(sum_image(make(scene.counts())[0]))
    assert found.sizes == sound.sizes
    np.testing.assert_array_equal(found["status_ref"], sound["status_ref"])
    difference = (found["fit_ref"] - sound["fit_ref"]).to_numpy()
    assert np.nanmax(np.abs(difference[:, 1:3])) < 0.1
    assert np.nanmax(np.abs(difference[:, 0] / sound["fit_ref"].to_numpy()[:, 0])) < 0.05


def test_lines_without_data_cost_no_column_where_nothing_drifts(make):
    """They go from edge to edge through a row and a column of columns."""
    scene = Scene(n_frames=12, amplitude=60.0, background=20.0, max_drift=0.0)
    frames = scene.counts()
    x, y = np.rint(scene.place[0]).astype(int)
    frames[:, :, x], frames[:, y + 1] = 0, 0
    found = find_columns(sum_image(make(frames)[0]))
    sound = find_columns(sum_image(make(scene.counts())[0]))
    assert found.sizes == sound.sizes
    assert (found["status_ref"] == 0).all()
    difference = (found["fit_ref"] - sound["fit_ref"]).to_numpy()
    assert np.abs(difference[:, 1:3]).max() < 0.15
    assert np.abs(difference[:, 0] / sound["fit_ref"].to_numpy()[:, 0]).max() < 0.1
