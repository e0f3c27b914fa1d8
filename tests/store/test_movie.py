"""The movie store: layout, lossless conversion, resuming, metadata, and what it refuses."""

import json
import os
import pickle
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
import zarr
from distributed import Client
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from tract_dask.errors import DestinationError, SourceError, StoreError
from tract_dask.progress import ShardDone, StageDone, StageStarted, Warned
from tract_dask.readers import open_source
from tract_dask.readers.source import FrameValues
from tract_dask.readers.times import timed
from tract_dask.run.verify import verify
from tract_dask.settings import ConvertSettings, MetadataSettings
from tract_dask.stages.convert.stage import convert
from tract_dask.store import datasets, files, schema
from tract_dask.store import metadata as store_metadata
from tract_dask.store.layout import Layout, peak_memory, plan_layout
from tract_dask.store.movie import open_movie
from tract_dask.store.shard_files import ShardWriter
from tract_dask.store.shards import split

SMALL = ConvertSettings(shard_mb=1, tile_px=32)
KNOWN = MetadataSettings(pixel_size_pm=8.0, frame_time_s=0.5, dose=125.0, gain=0.5)


def pixels(shape, dtype, seed=0):
    rng = np.random.default_rng(seed)
    frames = rng.poisson(50, shape).astype(dtype)
    frames[shape[0] // 2] = 0  # a frame that Zarr does not store
    if np.dtype(dtype).kind == "f":
        frames[1, 2:5, 3] = np.nan, np.inf, -0.0
        frames[shape[0] // 2] = -0.0
    return frames


def save(path, frames):
    np.save(path, frames)
    return path


def same_bits(one, other):
    return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()


@pytest.fixture
def counts():
    return pixels((21, 150, 131), "uint16")


@pytest.fixture
def source(tmp_path, counts):
    return save(tmp_path / "movie.npy", counts)


# Layout


@examples(max_examples=300, deadline=None)
@given(
    st.tuples(st.integers(1, 20_000), st.integers(1, 9000), st.integers(1, 9000)),
    st.sampled_from(["u1", "u2", "f4", "f8"]),
    st.floats(1, 4096),
    st.integers(16, 8192),
)
def test_every_layout_is_sound(shape, dtype, shard_mb, tile_px):
    layout = plan_layout(shape, dtype, ConvertSettings(shard_mb=shard_mb, tile_px=tile_px))
    shards = split(shape[0], layout.frames_per_shard)
    assert [shard.start for shard in shards] == [0, *(shard.stop for shard in shards[:-1])]
    assert shards[-1].stop == shape[0]
    grid = layout.grid()
    shard_bytes = np.prod(grid.shard, dtype=float) * np.dtype(dtype).itemsize
    assert shard_bytes <= shard_mb * 1e6 or layout.frames_per_shard == 1
    assert layout.frames_per_shard <= -(-shape[0] // 8)
    assert layout.chunk[0] <= 16
    assert max(layout.chunk[1:]) <= tile_px
    for factor in (1, *layout.bins):
        grid = layout.grid(factor)
        assert grid.shape == (shape[0], -(-shape[1] // factor), -(-shape[2] // factor))
        assert all(shard % chunk == 0 for shard, chunk in zip(grid.shard, grid.chunk, strict=True))
        assert all(grid.shape[axis] <= grid.shard[axis] < grid.shape[axis] + grid.chunk[axis] for axis in (1, 2))
    assert peak_memory(layout) >= 1.2 * shard_bytes - 1


@pytest.mark.parametrize(
    ("side", "bins"),
    [(100, ()), (127, ()), (128, (4,)), (1023, (4,)), (1024, (4, 16)), (4095, (4, 16)), (4096, (4, 16, 64))],
)
def test_binned_levels_keep_64_px_of_the_longer_side(side, bins):
    assert plan_layout((10, 50, side), "u2").bins == bins


def test_a_field_that_tiles_divide_is_not_padded():
    grid = plan_layout((8, 300, 2048), "u2").grid()
    assert grid.chunk == (1, 150, 256)
    assert grid.shard == (1, 300, 2048)


# Lossless conversion


@pytest.mark.parametrize(
    "dtype", ["u1", "i2", "u2", "i4", "f4", "f8"]
)  # f2 is widened: tests/readers/test_reader_types.py
@pytest.mark.parametrize("codec", ["lz4", "none"])
def test_the_store_equals_the_source_bit_for_bit(tmp_path, dtype, codec):
    frames = pixels((19, 141, 83), dtype)
    path = convert(
        save(tmp_path / "movie.npy", frames),
        tmp_path / "movie.zarr",
        settings=ConvertSettings(shard_mb=1, tile_px=32, codec=codec),
    )
    movie = open_movie(path)
    assert same_bits(movie.read(0, 19), frames)
    assert same_bits(movie.read(3, 12, slice(30, 77), slice(50, 200)), frames[3:12, 30:77, 50:])
    assert same_bits(np.asarray(zarr.open_array(path / "0", mode="r")[...]), frames)


def test_big_endian_is_stored_in_native_order(tmp_path):
    frames = pixels((9, 40, 50), ">u2")
    movie = open_movie(convert(save(tmp_path / "movie.npy", frames), tmp_path / "movie.zarr", settings=SMALL))
    assert same_bits(movie.read(0, 9), frames.astype("=u2"))


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 300, 17), (2, 16, 16)])
def test_tiny_movies(tmp_path, shape):
    frames = pixels(shape, "u2")
    movie = open_movie(convert(save(tmp_path / "movie.npy", frames), tmp_path / "movie.zarr"))
    assert same_bits(movie.read(0, shape[0]), frames)


def test_binned_levels_and_statistics(tmp_path, source, counts):
    movie = open_movie(convert(source, tmp_path / "movie.zarr", settings=SMALL))
    assert movie.bins == (4,)
    binned = movie.read_binned(4, 2, 9)
    assert binned.dtype == np.float32
    np.testing.assert_allclose(binned[:, :37, :32], counts[2:9, :148, :128].reshape(7, 37, 4, 32, 4).mean((2, 4)), 1e-6)
    np.testing.assert_allclose(binned[:, :37, 32], counts[2:9, :148, 128:].reshape(7, 37, 4, 3).mean((2, 3)), 1e-6)
    statistics = schema.validate(movie.statistics(), schema.STATISTICS, "movie.zarr")
    np.testing.assert_array_equal(statistics.frame_max, counts.max((1, 2)))
    np.testing.assert_array_equal(statistics.frame_min, counts.min((1, 2)))
    np.testing.assert_allclose(statistics.frame_mean, counts.mean((1, 2)), 1e-12)
    np.testing.assert_allclose(statistics.frame_std, counts.std((1, 2)), 1e-12)
    with pytest.raises(StoreError, match="no such binned level"):
        movie.read_binned(16, 0, 1)


def test_frames_with_nan_are_counted(tmp_path):
    frames = pixels((9, 140, 40), "f4")
    movie = open_movie(convert(save(tmp_path / "movie.npy", frames), tmp_path / "movie.zarr", settings=SMALL))
    assert movie.statistics().frame_bad_pixels.values.tolist() == [0, 2, 0, 0, 0, 0, 0, 0, 0]
    assert np.isfinite(movie.read_binned(4, 0, 9)).all()


def test_a_cluster_writes_what_this_process_writes(tmp_path, source, counts):
    with Client(processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None) as client:
        movie = open_movie(convert(source, tmp_path / "movie.zarr", settings=SMALL, client=client))
    assert same_bits(movie.read(0, 21), counts)
    here = open_movie(convert(source, tmp_path / "here.zarr", settings=SMALL))
    assert same_bits(movie.read_binned(4, 0, 21), here.read_binned(4, 0, 21))
    assert movie.statistics().identical(here.statistics().assign_attrs(movie.statistics().attrs))


def test_a_relative_path_and_an_open_source(tmp_path, monkeypatch, source, counts):
    monkeypatch.chdir(tmp_path)
    path = convert(open_source("movie.npy"), "sub/movie.zarr", settings=SMALL, metadata=KNOWN)
    assert path == tmp_path / "sub" / "movie.zarr"
    movie = open_movie("sub/movie.zarr")
    assert same_bits(movie.read(0, 21), counts)
    assert (movie.pixel_size_pm, movie.frame_time_s, movie.dose, movie.gain) == (8.0, 0.5, 125.0, 0.5)


# Opening, by ours and by others


def test_lazy_frames(tmp_path, source, counts):
    movie = open_movie(convert(source, tmp_path / "movie.zarr", settings=SMALL, metadata=KNOWN))
    frames = movie.frames
    assert frames.dims == ("t", "y", "x")
    assert frames.chunks == ((3,) * 7, (150,), (131,))
    assert frames.attrs == {"pixel_size_pm": 8.0, "frame_time_s": 0.5, "dose": 125.0, "gain": 0.5, "offset": 0.0}
    np.testing.assert_array_equal(frames.t, np.arange(21) * 0.5)
    np.testing.assert_array_equal(frames.x, np.arange(131) * 8.0)
    part = frames[4:9, 10:20, ::3]
    np.testing.assert_array_equal(part.compute(scheduler="synchronous"), counts[4:9, 10:20, ::3])
    np.testing.assert_array_equal(frames[5].compute(scheduler="threads"), counts[5])
    for odd in ((slice(20, 2, -5), 7, slice(-9, None)), (slice(3, 3), slice(None), -1), ([6, 2], 3, slice(90, 5, -7))):
        np.testing.assert_array_equal(frames.data[odd].compute(scheduler="synchronous"), counts[odd])


def test_tiles_hold_every_pixel_of_a_shard_once(tmp_path, source, counts):
    movie = open_movie(convert(source, tmp_path / "movie.zarr", settings=SMALL))
    found, times = np.zeros_like(counts), np.zeros(counts.shape, int)
    for shard in movie.shards:
        for start, top, left, pixels in movie.tiles(shard):
            place = tuple(slice(at, at + n) for at, n in zip((start, top, left), pixels.shape, strict=True))
            found[place] = pixels
            times[place] += 1
    assert (times == 1).all()
    np.testing.assert_array_equal(found, counts)


def test_tiles_under_boxes_are_read_wherever_they_lie(tmp_path, source, counts):
    movie = open_movie(convert(source, tmp_path / "movie.zarr", settings=SMALL))
    rng = np.random.default_rng(5)
    corners = rng.integers(-40, 160, (5, 2))
    boxes = np.concatenate([corners, corners + rng.integers(1, 50, (5, 2))], axis=1)
    for shard in movie.shards:
        pixels, place, shape = movie.read_tiles(shard.start, shard.stop, boxes)
        assert shape == (150, 131)
        height, width = pixels.shape[2:]
        touched = np.zeros(place.shape, bool)
        for y0, x0, y1, x1 in np.clip(boxes, 0, np.tile(shape, 2)):
            touched[y0 // height : -(-y1 // height), x0 // width : -(-x1 // width)] |= y1 > y0 and x1 > x0
        np.testing.assert_array_equal(place >= 0, touched)
        for row, column in np.argwhere(touched):
            part = counts[shard.start : shard.stop, row * height :, column * width :][:, :height, :width]
            tile = pixels[place[row, column]]
            np.testing.assert_array_equal(tile[: shard.frames, : part.shape[1], : part.shape[2]], part)


def test_what_the_source_warns_of_is_passed_on(tmp_path, counts):
    (tmp_path / "frames").mkdir()
    for number in (1, 2, 4):
        save(tmp_path / "frames" / f"frame_{number}.npy", counts[number])
    events = []
    path = convert(tmp_path / "frames", tmp_path / "movie.zarr", settings=SMALL, on_event=events.append)
    assert isinstance(events[0], Warned)
    assert same_bits(open_movie(path).read(0, 3), counts[[1, 2, 4]])


def test_a_movie_pickles_by_its_path(tmp_path, source, counts):
    movie = open_movie(convert(source, tmp_path / "movie.zarr", settings=SMALL))
    movie.read(0, 1)
    pickled = pickle.dumps(movie)
    assert len(pickled) < 1000
    again = pickle.loads(pickled)
    assert again == movie
    assert same_bits(again.read(0, 21), counts)


@pytest.mark.parametrize("arguments", [{}, {"consolidated": False}])
@pytest.mark.parametrize("metadata", [KNOWN, MetadataSettings()])
def test_xarray_opens_it_without_a_warning(tmp_path, source, counts, arguments, metadata):
    path = convert(source, tmp_path / "movie.zarr", settings=SMALL, metadata=metadata)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dataset = xr.open_zarr(path, **arguments).load()
    assert dataset["0"].dims == ("t", "y", "x")
    np.testing.assert_array_equal(dataset["0"], counts)
    assert set(dataset.data_vars) == {"0", *schema.STATISTICS}
    units = [dataset[axis].attrs["units"] for axis in ("t", "y", "x")]
    assert units == (["s", "pm", "pm"] if metadata is KNOWN else ["frame", "px", "px"])
    np.testing.assert_array_equal(dataset.y, np.arange(150) * (metadata.pixel_size_pm or 1))


@pytest.mark.parametrize("metadata", [KNOWN, MetadataSettings()])
def test_it_is_a_valid_ome_zarr_image(tmp_path, source, metadata):
    from ome_zarr_models.v05.image import Image

    path = convert(source, tmp_path / "movie.zarr", settings=SMALL, metadata=metadata)
    multiscale = Image.from_zarr(zarr.open_group(path, mode="r")).attributes.ome.multiscales[0]
    assert [axis.name for axis in multiscale.axes] == ["t", "y", "x"]
    units = [axis.unit for axis in multiscale.axes]
    assert units == (["second", "picometer", "picometer"] if metadata is KNOWN else [None] * 3)
    side = metadata.pixel_size_pm or 1.0
    frames, binned = (dataset.coordinateTransformations for dataset in multiscale.datasets)
    assert frames[0].scale == [metadata.frame_time_s or 1.0, side, side]
    assert binned[0].scale == [metadata.frame_time_s or 1.0, 4 * side, 4 * side]
    assert binned[1].translation == [0.0, 1.5 * side, 1.5 * side]


def test_ome_zarrs_reader_reads_every_level(tmp_path, counts):
    from ome_zarr.io import parse_url
    from ome_zarr.reader import Reader

    frames = pixels((9, 1024, 70), "u1")
    path = convert(save(tmp_path / "movie.npy", frames), tmp_path / "movie.zarr", metadata=KNOWN)
    (node,) = Reader(parse_url(str(path)))()
    assert [level.shape for level in node.data] == [(9, 1024, 70), (9, 256, 18), (9, 64, 5)]
    np.testing.assert_array_equal(node.data[0], frames)
    np.testing.assert_allclose(node.data[2][:, :, :4], frames[:, :, :64].reshape(9, 64, 16, 4, 16).mean((2, 4)), 1e-6)


@pytest.mark.parametrize("make", [lambda path: None, lambda path: path.mkdir(), lambda path: path.touch()])
def test_what_is_not_a_movie_is_not_opened(tmp_path, make):
    make(tmp_path / "movie.zarr")
    with pytest.raises(StoreError, match="no movie store here"):
        open_movie(tmp_path / "movie.zarr")


def test_a_damaged_shard_is_named(tmp_path, source):
    movie = open_movie(convert(source, tmp_path / "movie.zarr", settings=SMALL))
    shard = movie.path / "0" / "c.1.0.0"
    shard.write_bytes(shard.read_bytes()[:-100])
    with pytest.raises(StoreError, match=r"frames 3 to 5 are damaged"):
        movie.read(3, 6)
    movie.read(0, 3)


# Going on, doing again, changing metadata


class Interrupted(Exception):
    pass


def stop_after(count):
    """Return a sink that ends the work after so many shards."""
    seen = []

    def sink(event):
        seen.append(event)
        if sum(isinstance(event, ShardDone) for event in seen) == count:
            raise Interrupted

    return sink


def test_an_interrupted_conversion_goes_on(tmp_path, source, counts):
    path = tmp_path / "movie.zarr"
    with pytest.raises(Interrupted):
        convert(source, path, settings=SMALL, on_event=stop_after(3))
    with pytest.raises(StoreError, match="4 of 7 shards are missing"):
        open_movie(path)
    first = path / "0" / "c.0.0.0"
    written = first.stat().st_mtime_ns
    events = []
    convert(source, path, settings=SMALL, on_event=events.append)
    assert events[0] == StageStarted("convert", 21, 9, frame_bytes=39300)
    assert [event.shard for event in events if isinstance(event, ShardDone)] == [3, 4, 5, 6]
    assert first.stat().st_mtime_ns == written
    movie = open_movie(path)
    assert same_bits(movie.read(0, 21), counts)
    np.testing.assert_allclose(movie.statistics().frame_mean, counts.mean((1, 2)), 1e-12)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["movie.npy", "movie.zarr"]


def test_a_finished_conversion_is_reused_but_for_its_metadata(tmp_path, source):
    path = convert(source, tmp_path / "movie.zarr", settings=SMALL)
    shard = path / "0" / "c.0.0.0"
    written = shard.stat().st_mtime_ns
    events = []
    convert(source, path, settings=SMALL, metadata=KNOWN, on_event=events.append)
    assert [type(event) for event in events] == [StageStarted, StageDone]
    assert events[1].reused
    assert shard.stat().st_mtime_ns == written
    movie = open_movie(path)
    assert (movie.pixel_size_pm, movie.frame_time_s, movie.dose, movie.gain) == (8.0, 0.5, 125.0, 0.5)
    np.testing.assert_array_equal(movie.frames.y, np.arange(150) * 8.0)
    assert xr.open_zarr(path).t.attrs["units"] == "s"
    ome = zarr.open_group(path, mode="r").attrs["ome"]
    assert ome["multiscales"][0]["axes"][0]["unit"] == "second"


WRITERS = {"overwrite_array": datasets, "write_root": store_metadata}
"""The modules that write parts of a store's metadata."""


def cut_off(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize("size", [8.0, 9.0, None])
@pytest.mark.parametrize("place", ["overwrite_array", "write_root"])
def test_a_change_of_the_calibration_that_is_cut_off_is_ended_by_the_next_run(tmp_path, source, place, size):
    path = convert(source, tmp_path / "movie.zarr", settings=SMALL, metadata=MetadataSettings(pixel_size_pm=8.0))
    changed = MetadataSettings(pixel_size_pm=9.0)
    real, calls = getattr(WRITERS[place], place), []

    def killed_at_the_last(*args, **more):
        calls.append(args)
        if len(calls) == {"overwrite_array": 3, "write_root": 2}[place]:
            raise KeyboardInterrupt
        return real(*args, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(WRITERS[place], place, killed_at_the_last)
        with pytest.raises(KeyboardInterrupt):
            convert(source, path, settings=SMALL, metadata=changed)
    with pytest.raises(StoreError, match="was cut off"):
        open_movie(path)
    (fault,) = (found := verify(path)).faults
    assert (fault.file, found.remedies) == (path / "zarr.json", ["Run the same command again"])
    events = []
    convert(source, path, settings=SMALL, metadata=MetadataSettings(pixel_size_pm=size), on_event=events.append)
    assert events[-1].reused
    movie, step = open_movie(path), size or 1.0
    assert movie.pixel_size_pm == size
    np.testing.assert_array_equal(movie.frames.y, np.arange(150) * step)
    np.testing.assert_array_equal(movie.frames.x, np.arange(131) * step)
    assert verify(path).sound
    fresh = convert(source, tmp_path / "other.zarr", settings=SMALL, metadata=MetadataSettings(pixel_size_pm=size))
    assert store_metadata.attributes(path).keys() == store_metadata.attributes(fresh).keys()


@pytest.mark.parametrize("place", ["overwrite_array", "write_root"])
def test_a_conversion_that_is_cut_off_at_its_metadata_ends_as_an_undisturbed_one(tmp_path, source, counts, place):
    path, meta = tmp_path / "movie.zarr", MetadataSettings(pixel_size_pm=8.0)
    act = stop_after(7)
    with pytest.raises(Interrupted):
        convert(source, path, settings=SMALL, metadata=meta, on_event=act)  # all shards are there
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(WRITERS[place], place, cut_off)
        with pytest.raises(KeyboardInterrupt):
            convert(source, path, settings=SMALL, metadata=meta)
    events = []
    movie = open_movie(convert(source, path, settings=SMALL, metadata=meta, on_event=events.append))
    assert not [event for event in events if isinstance(event, ShardDone)]
    assert same_bits(movie.read(0, 21), counts)
    np.testing.assert_array_equal(movie.frames.y, np.arange(150) * 8.0)
    assert verify(path).sound
    assert sorted(file.name for file in tmp_path.iterdir()) == ["movie.npy", "movie.zarr"]


def test_another_movie_is_replaced_only_when_told(tmp_path, source, counts):
    path = convert(source, tmp_path / "movie.zarr", settings=SMALL)
    opened = open_movie(path)
    opened.read(0, 1)
    other = save(tmp_path / "other.npy", counts[::-1, :100])
    with pytest.raises(DestinationError, match="made from something else"):
        convert(other, path, settings=SMALL)
    assert open_movie(path) == opened
    convert(other, path, settings=SMALL, overwrite=True)
    assert same_bits(open_movie(path).read(0, 21), counts[::-1, :100])


def test_an_unfinished_conversion_of_another_movie_is_replaced(tmp_path, source, counts):
    path = tmp_path / "movie.zarr"
    with pytest.raises(Interrupted):
        convert(source, path, settings=SMALL, on_event=stop_after(2))
    other = save(tmp_path / "other.npy", counts + 1)
    convert(other, path, settings=SMALL)
    assert same_bits(open_movie(path).read(0, 21), counts + 1)


def test_a_journal_without_its_store_is_not_believed(tmp_path, source, counts):
    path = tmp_path / "movie.zarr"
    with pytest.raises(Interrupted):
        convert(source, path, settings=SMALL, on_event=stop_after(2))
    files.remove(path)
    convert(source, path, settings=SMALL)
    assert same_bits(open_movie(path).read(0, 21), counts)


CONVERT = """
import sys
from tract_dask.stages.convert.stage import convert
from tract_dask.settings import ConvertSettings
convert(sys.argv[1], sys.argv[2], settings=ConvertSettings(shard_mb=1, tile_px=32))
"""


@pytest.mark.parametrize("seconds", [0.0, 0.05, 0.2])
def test_a_killed_conversion_ends_as_an_undisturbed_one(tmp_path, seconds):
    frames = pixels((400, 160, 150), "u2")
    source, path = save(tmp_path / "movie.npy", frames), tmp_path / "movie.zarr"
    process = subprocess.Popen([sys.executable, "-c", CONVERT, source, path], start_new_session=True)
    while process.poll() is None and not store_metadata.attributes(path):
        time.sleep(0.005)
    time.sleep(seconds)
    os.killpg(process.pid, signal.SIGKILL)
    assert process.wait() in (0, -signal.SIGKILL)
    movie = open_movie(convert(source, path, settings=SMALL))
    assert same_bits(movie.read(0, 400), frames)
    clean = open_movie(convert(source, tmp_path / "clean.zarr", settings=SMALL))
    assert same_bits(movie.read_binned(4, 0, 400), clean.read_binned(4, 0, 400))
    assert all(movie.statistics()[name].equals(clean.statistics()[name]) for name in schema.STATISTICS)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["clean.zarr", "movie.npy", "movie.zarr"]


# What it refuses


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_of_other_files_is_never_replaced(tmp_path, source, overwrite):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("all of it")
    with pytest.raises(DestinationError, match="already holds other"):
        convert(source, tmp_path / "thesis", overwrite=overwrite)
    assert (tmp_path / "thesis" / "chapter.txt").read_text() == "all of it"


def test_a_file_is_replaced_only_when_told(tmp_path, source, counts):
    path = tmp_path / "notes.txt"
    path.write_text("something")
    with pytest.raises(DestinationError, match="already holds other"):
        convert(source, path)
    assert path.read_text() == "something"
    convert(source, path, overwrite=True)
    assert same_bits(open_movie(path).read(0, 21), counts)


def test_the_source_is_never_replaced(tmp_path, source):
    for destination in (source, tmp_path):
        with pytest.raises(DestinationError, match="holds the source itself"):
            convert(source, destination, overwrite=True)
    assert source.exists()


def test_another_kind_of_store_is_not_replaced(tmp_path, source):
    path = tmp_path / "results.zarr"
    zarr.create_group(path, attributes={store_metadata.ATTRIBUTE: {"key": "k", "kind": "results"}})
    with pytest.raises(DestinationError, match="made from something else"):
        convert(source, path)


def test_a_disk_that_is_too_small_is_told_before_work(tmp_path, source, monkeypatch):
    monkeypatch.setattr(files.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 1000}))
    with pytest.raises(DestinationError, match="disk is too small"):
        convert(source, tmp_path / "movie.zarr")
    assert [file.name for file in tmp_path.iterdir()] == ["movie.npy"]


def test_a_disk_that_becomes_full_keeps_what_is_done(tmp_path, source, counts, monkeypatch):
    path, add, done = tmp_path / "movie.zarr", ShardWriter.add, []

    def full(writer, frame):
        done.append(frame.shape)
        if len(done) > 15:  # in the third shard: three frames and their binned level each
            raise OSError(28, os.strerror(28))
        add(writer, frame)

    with monkeypatch.context() as patch:
        patch.setattr(ShardWriter, "add", full)
        with pytest.raises(StoreError, match=r"(?i)no space left on device.*what is done is kept"):
            convert(source, path, settings=SMALL)
    with pytest.raises(StoreError, match="5 of 7 shards are missing"):
        open_movie(path)
    convert(source, path, settings=SMALL)
    assert same_bits(open_movie(path).read(0, 21), counts)


def test_a_source_that_changes_meanwhile_is_told(tmp_path, source, counts):
    def shrink(event):
        if isinstance(event, ShardDone) and event.shard == 0:
            save(source, counts[:, :100])

    with pytest.raises(SourceError, match="has changed since"):
        convert(source, tmp_path / "movie.zarr", settings=SMALL, on_event=shrink)


def test_a_layout_is_a_value():
    layout = plan_layout((600, 4096, 4096), "u2")
    assert layout == Layout((600, 4096, 4096), np.dtype("u2"), 7, (7, 256, 256), (4, 16, 64))
    assert hash(layout) == hash(pickle.loads(pickle.dumps(layout)))


STAMPS = 1.7e9 + np.array([0.0, 0.5, 1.0, 2.5, 3.0])
"""Unix times of five frames, of which two were lost after the third."""


def stamped(path):
    source = open_source(save(path, pixels((5, 40, 40), "uint16")))
    temperature = FrameValues(np.linspace(20, 24, 5), "degC")
    known = timed(STAMPS, path.name)
    known = replace(known, along_frames=known.along_frames | {"temperature": temperature})
    return replace(source, metadata=known)


def test_time_stamps_and_headers_of_frames_are_kept(tmp_path):
    events = []
    movie = open_movie(convert(stamped(tmp_path / "a.npy"), tmp_path / "movie.zarr", on_event=events.append))
    assert movie.frame_time_s == 0.5
    np.testing.assert_array_equal(movie.times(), [0, 0.5, 1, 2.5, 3])
    np.testing.assert_array_equal(movie.frames["t"], [0, 0.5, 1, 2.5, 3])
    assert "gap of 1.5 s after frame 2" in next(event for event in events if isinstance(event, Warned)).message
    values = movie.frame_values()
    assert list(values) == ["temperature"]
    np.testing.assert_array_equal(values["temperature"], np.linspace(20, 24, 5))
    assert values["temperature"].attrs["units"] == "degC"
    assert xr.open_zarr(tmp_path / "movie.zarr")["frame_temperature"].dims == ("t",)
    assert verify(tmp_path / "movie.zarr").sound


def test_a_frame_time_of_the_user_counts_more_than_time_stamps(tmp_path):
    path, source = tmp_path / "movie.zarr", stamped(tmp_path / "a.npy")
    for said, times in ((0.25, [0, 0.25, 0.5, 0.75, 1]), (None, [0, 0.5, 1, 2.5, 3]), (0.5, [0, 0.5, 1, 2.5, 3])):
        movie = open_movie(convert(source, path, metadata=MetadataSettings(frame_time_s=said)))
        np.testing.assert_array_equal(movie.times(), times)


@pytest.mark.parametrize("stamps", [np.zeros(5), [0, 1, 1, 2, 3], [0, 1, np.nan, 2, 3], [4, 3, 2, 1, 0]])
def test_time_stamps_that_do_not_grow_are_not_used(stamps):
    known = timed(stamps, "a.seq")
    assert (known.frame_time_s, dict(known.along_frames)) == (None, {})
    assert len(known.notes) == (1 if np.any(stamps) else 0)


@pytest.mark.parametrize("name", ["shape", "dtype", "bins", "frames_per_shard", "pixel_size_pm"])
def test_a_store_that_does_not_say_what_is_needed_is_refused_by_name(name, tmp_path, source):
    path = convert(source, tmp_path / "movie.zarr")
    root = json.loads((path / "zarr.json").read_text())
    about = root["attributes"]["tract_dask"]
    del about[name], about["checksum"]
    about["checksum"] = store_metadata.digest(root)
    (path / "zarr.json").write_text(json.dumps(root))
    for attempt in (lambda: open_movie(path), lambda: convert(source, path, metadata=KNOWN)):
        with pytest.raises(StoreError, match=rf"another version.*no {name}.*--overwrite"):
            attempt()


@pytest.mark.parametrize(("said", "number"), [(2, 2), (2.5, 3), ("3", 3), ("TIFF", 1), (None, 1), (float("inf"), 1)])
def test_the_number_of_a_format_is_read_however_it_is_written(said, number):
    assert store_metadata.format_of({"format": said}) == number


def test_a_store_remembers_what_the_file_says_and_not_what_the_user_does(tmp_path, source):
    path = convert(source, tmp_path / "movie.zarr", metadata=KNOWN)
    assert open_movie(path).pixel_size_pm == 8.0
    assert store_metadata.attributes(path)["file_says"]["pixel_size_pm"] is None
