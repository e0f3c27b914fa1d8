"""Master files of DECTRIS, and bitshuffle without its plugin."""

from __future__ import annotations

import pickle
import threading
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest
from files_hdf5 import FRAMES, dectris

from tract_dask.errors import InputError, SourceError
from tract_dask.readers import open_source

BITSHUFFLE = dict(hdf5plugin.Bitshuffle(cname="lz4"))


def test_data_files_are_one_movie(tmp_path: Path) -> None:
    asked: list[Path] = []
    master = dectris(tmp_path, **BITSHUFFLE)
    for name in (master, f"{master}::/entry/data", tmp_path):
        source = open_source(name, permit=asked.append)
        for found in (source, pickle.loads(pickle.dumps(open_source(name)))):
            np.testing.assert_array_equal(found.read(0, 5), FRAMES)
            np.testing.assert_array_equal(found.read(1, 4), FRAMES[1:4])
        assert len(source.files) == 4
    assert {file.resolve() for file in source.files} <= set(asked)
    found = open_source(master).metadata
    assert (found.frame_time_s, found.pixel_size_pm) == (0.002, None)
    assert found.references["defects"] == Path(f"{master}::/entry/instrument/detector/pixel_mask")
    untested, masked, option = found.notes
    assert "was not tested with a file from a camera" in untested
    assert "masks 3 pixels" in masked
    assert "--defects" in option
    assert open_source(str(found.references["defects"])).read(0, 1).sum() == 3
    part = open_source(f"{master}::/entry/data/data_000002")
    np.testing.assert_array_equal(part.read(0, 2), FRAMES[2:4])


def test_missing_parts_and_frames(tmp_path: Path) -> None:
    master = dectris(tmp_path)
    with h5py.File(master, "a") as file:
        del file["entry/data/data_000002"]
    notes = open_source(master).metadata.notes
    assert "part data_000002 is missing" in notes[0]
    assert "was to take 5 frames, and 3 are there" in notes[2]
    (tmp_path / "run_data_000003.h5").unlink()
    with pytest.raises(SourceError, match=r"run_data_000003.h5.*no such file"):
        open_source(master)


def test_parts_that_differ(tmp_path: Path) -> None:
    master = dectris(tmp_path)
    with h5py.File(tmp_path / "run_data_000002.h5", "w") as file:
        file["entry/data/data"] = FRAMES[:, :9]
    with pytest.raises(SourceError, match="a part of the movie differs"):
        open_source(master)


SHAPES = [
    ((5, 33, 47), (1, 33, 47)),
    ((5, 33, 47), (2, 16, 20)),
    ((3, 1, 5), (1, 1, 5)),
    ((33, 47), (10, 47)),
    ((2, 120, 100), (1, 120, 100)),
]


@pytest.mark.parametrize("dtype", ["u1", "<u2", ">u2", "i4", "f4", "f8"])
@pytest.mark.parametrize(("shape", "chunks"), SHAPES)
def test_bitshuffle_as_hdf5plugin_writes_it(
    dtype: str, shape: tuple[int, ...], chunks: tuple[int, ...], tmp_path: Path
) -> None:
    frames = np.random.default_rng(1).poisson(300, shape).astype(dtype)
    for options in ({"cname": "lz4"}, {"cname": "zstd"}, {"nelems": 64}):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file.create_dataset("data", data=frames, chunks=chunks, **hdf5plugin.Bitshuffle(**options))
        source = open_source(tmp_path / "a.h5")
        assert type(source).__name__ == "BitshuffledSource"
        found = source.read(0, source.shape[0])
        np.testing.assert_array_equal(found, frames if frames.ndim == 3 else frames[None])
        assert found.dtype == np.dtype(dtype).newbyteorder("=")
        last = np.empty((1, *source.shape[1:]), found.dtype)
        source.read_into(source.shape[0] - 1, last)
        np.testing.assert_array_equal(last, found[-1:])


def test_bitshuffle_needs_neither_plugin_nor_hdf5_to_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("data", (8, 40, 36), "u2", chunks=(1, 40, 36), fillvalue=7, **BITSHUFFLE)
        data[:5] = FRAMES
        data.id.write_direct_chunk((5, 0, 0), FRAMES[0].tobytes(), filter_mask=1)
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: code != 32008)
    source = open_source(tmp_path / "a.h5")
    monkeypatch.setattr(h5py, "File", None)
    np.testing.assert_array_equal(source.read(0, 6), [*FRAMES, FRAMES[0]])
    assert (source.read(6, 8) == 7).all()
    assert "2 of 8 chunks were never written" in source.metadata.notes[0]
    results: list[bool] = []
    threads = [
        threading.Thread(target=lambda: results.append(bool((source.read(0, 5) == FRAMES).all()))) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [True] * 4


def test_damaged_chunks_are_errors(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("data", data=FRAMES, chunks=(1, 40, 36), **BITSHUFFLE)
        places = [data.id.get_chunk_info(k).byte_offset for k in range(5)]
    source = open_source(path)
    whole = path.read_bytes()
    for at, damage in (
        (0, b"\xff" * 8),
        (8, b"\xff" * 4),
        (12, b"\x7f\xff\xff\xff"),
        (12, bytes(4)),
    ):
        changed = bytearray(whole)
        changed[places[2] + at : places[2] + at + len(damage)] = damage
        path.write_bytes(changed)
        with pytest.raises(SourceError, match=r"a\.h5"):
            source.read(2, 3)
        np.testing.assert_array_equal(source.read(3, 5), FRAMES[3:])
    path.write_bytes(whole[: places[4]])
    with pytest.raises(InputError, match=r"a\.h5"):
        source.read(0, 5)
