"""Shard files: what Zarr reads of ours, what we read of Zarr's, and what is damaged."""

import numpy as np
import pytest
import zarr

from tract_dask.store.shard_files import BLOSC, CHUNK_KEYS, Grid, ShardReader, ShardWriter, chunk_path, codecs

GRID = Grid(shape=(13, 30, 44), chunk=(3, 16, 15), shard=(6, 32, 45))
CODECS = ["lz4", "zstd", "none"]


def frames_of(dtype="u2"):
    return np.random.default_rng(0).poisson(40, GRID.shape).astype(dtype)


def zarr_array(path, dtype, codec):
    return zarr.create_array(
        str(path),
        shape=GRID.shape,
        chunks=GRID.chunk,
        shards=GRID.shard,
        dtype=dtype,
        compressors=codecs(codec),
        chunk_key_encoding=CHUNK_KEYS,
        fill_value=0,
    )


def write(path, frames, codec):
    for number, start in enumerate(range(0, len(frames), GRID.shard[0])):
        with ShardWriter(chunk_path(path, number, 0, 0), path, GRID, frames.dtype, codec) as writer:
            for frame in frames[start : start + GRID.shard[0]]:
                writer.add(frame)


def reader(path, number, dtype, codec):
    return ShardReader(chunk_path(path, number, 0, 0), GRID, np.dtype(dtype), encoded=codec in BLOSC)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("dtype", ["u1", "u2", "f4", "f8"])
def test_zarr_reads_what_is_written(tmp_path, dtype, codec):
    frames = frames_of(dtype)
    array = zarr_array(tmp_path / "0", dtype, codec)
    write(tmp_path / "0", frames, codec)
    np.testing.assert_array_equal(array[...], frames)
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.parametrize("codec", CODECS)
def test_what_zarr_writes_is_read(tmp_path, codec):
    frames = frames_of()
    zarr_array(tmp_path / "0", "u2", codec)[...] = frames
    for number, start in enumerate((0, 6, 12)):
        stop = min(6, 13 - start)
        out = np.ones((stop, 9, 30), np.uint16)
        with reader(tmp_path / "0", number, "u2", codec) as shard:
            shard.read((slice(0, stop), slice(12, 21), slice(14, 44)), out)
        np.testing.assert_array_equal(out, frames[start : start + stop, 12:21, 14:44])


def test_a_tile_that_is_not_stored_is_an_error(tmp_path):
    frames = frames_of()
    frames[6:9, :16] = 0  # tiles that Zarr does not store
    zarr_array(tmp_path / "0", "u2", "lz4")[...] = frames
    out = np.empty((3, 30, 44), np.uint16)
    with (
        reader(tmp_path / "0", 1, "u2", "lz4") as shard,
        pytest.raises(ValueError, match=r"tile \(0, 0, 0\) is missing"),
    ):
        shard.read((slice(0, 3), slice(0, 30), slice(0, 44)), out)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("seed", range(12))
def test_every_flipped_bit_of_a_tile_is_seen_by_us_and_by_zarr(tmp_path, codec, seed):
    frames = frames_of()
    zarr_array(tmp_path / "0", "u2", codec)
    write(tmp_path / "0", frames, codec)
    path = chunk_path(tmp_path / "0", 0, 0, 0)
    rng, data = np.random.default_rng(seed), bytearray(path.read_bytes())
    data[rng.integers(len(data))] ^= 1 << rng.integers(8)
    path.write_bytes(data)
    out = np.empty((6, 30, 44), np.uint16)
    with pytest.raises(ValueError, match=r"is damaged"), reader(tmp_path / "0", 0, "u2", codec) as shard:
        shard.read((slice(0, 6), slice(0, 30), slice(0, 44)), out)
    with pytest.raises(ValueError, match=r"(?i)checksum"):
        zarr.open_array(str(tmp_path / "0"), mode="r")[:6]


def test_an_error_leaves_no_file(tmp_path):
    def fail():
        with ShardWriter(chunk_path(tmp_path, 0, 0, 0), tmp_path, GRID, np.dtype("u2"), "lz4") as writer:
            writer.add(frames_of()[0])
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert not [file for file in tmp_path.rglob("*") if file.is_file()]


@pytest.mark.parametrize("codec", CODECS)
def test_damage_is_told(tmp_path, codec):
    write(tmp_path, frames_of(), codec)
    path = chunk_path(tmp_path, 0, 0, 0)
    data = path.read_bytes()
    path.write_bytes(data[:-30] + b"x" + data[-29:])
    with pytest.raises(ValueError, match="index at the end"), reader(tmp_path, 0, "u2", codec):
        pass
    path.write_bytes(data[:50])
    with pytest.raises(ValueError, match="index at the end"), reader(tmp_path, 0, "u2", codec):
        pass
    path.write_bytes(bytes(200) + data[200:])
    out = np.empty(GRID.chunk, np.uint16)
    with reader(tmp_path, 0, "u2", codec) as shard, pytest.raises(ValueError, match=r"tile .* is damaged"):
        shard.read_tile(0, 0, 0, out)


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(FileNotFoundError), reader(tmp_path, 0, "u2", "lz4"):
        pass
