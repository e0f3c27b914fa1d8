"""What a file holds beside its movie is not dropped without a word: bytes, axes, pages and arrays."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from files_classic import eer
from files_dm import write_dm
from files_hdf5 import emd, nexus
from test_reader_places import DECLARED, EVENTS, FRAMES, write

from tract_dask.readers import open_source


def notes_of(path: Path) -> list[str]:
    return [note for note in open_source(path, DECLARED).metadata.notes if "not tested" not in note]


ANY_BYTE = (".mrc", ".npy", ".tvips", ".seq", ".mib", ".dm3", ".dm4", ".h5", ".hspy")
FILLED = (".tif", ".stk", ".eer", ".ser")
"""Formats in which parts lie anywhere, with filling between them."""


@pytest.mark.parametrize(("suffix", "n_bytes"), [*((one, 7) for one in ANY_BYTE), *((one, 9000) for one in FILLED)])
def test_bytes_at_the_end(suffix: str, n_bytes: int, tmp_path: Path) -> None:
    path = write(tmp_path / f"movie{suffix}")
    assert notes_of(path) == []
    with path.open("ab") as file:
        file.write(bytes(n_bytes))
    assert [note for note in notes_of(path) if f"{n_bytes:,}"[:2] in note and "not read" in note], notes_of(path)


@pytest.mark.parametrize("libver", ["earliest", "v108", "latest"])
@pytest.mark.parametrize("before", [0, 512, 4096])
def test_bytes_around_hdf5(libver: str, before: int, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w", libver=libver, userblock_size=before) as file:
        file["movie"] = FRAMES
    said = [f"a.h5: the {before:,} bytes before its HDF5 data (user block) are not read"] if before else []
    assert notes_of(tmp_path / "a.h5") == said
    with (tmp_path / "a.h5").open("ab") as file:
        file.write(bytes(600))
    assert notes_of(tmp_path / "a.h5") == [
        *said,
        "a.h5 holds 600 bytes that its header does not account for; they are not read",
    ]


def test_arrays_beside_the_movie(tmp_path: Path) -> None:
    """Those of its size, and those that could be a movie; a table or a line is neither."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["movie"], file["dark"], file["one"] = FRAMES, FRAMES[0], FRAMES[:1]
        file["table"], file["line"] = np.zeros((9, 2)), np.zeros(9)
    said = "a.h5: /movie is read; the file also holds /dark (20, 24), /one (1, 20, 24)"
    assert notes_of(tmp_path / "a.h5") == [said]
    assert open_source(f"{tmp_path}/a.h5::/movie").metadata.notes == ()
    nexus(tmp_path / "n.h5", FRAMES, ["time", "y", "x"])
    with h5py.File(tmp_path / "n.h5", "a") as file:
        file["other"] = FRAMES
    assert "/other (4, 20, 24)" in notes_of(tmp_path / "n.h5")[0]
    group = zarr.open_group(tmp_path / "g.zarr", mode="w")
    group.create_array("movie", data=FRAMES)
    group.create_array("dark", data=FRAMES[0])
    assert notes_of(tmp_path / "g.zarr") == ["g.zarr: /movie is read; the file also holds /dark (20, 24)"]


@pytest.mark.parametrize("shape", [(1, 4, 20, 24), (4, 1, 20, 24), (1, 4, 1, 20, 24)])
def test_axes_of_length_1(shape: tuple[int, ...], tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["movie"] = FRAMES.reshape(shape)
    array = zarr.open_array(tmp_path / "a.zarr", mode="w", shape=shape, dtype="u2", chunks=(1, *shape[1:]))
    array[...] = FRAMES.reshape(shape)
    for name in ("a.h5", "a.zarr"):
        source = open_source(tmp_path / name)
        np.testing.assert_array_equal(source.read(0, 4), FRAMES)
        assert "of the axes, those of length 1 are passed over: without a name" in source.metadata.notes[0]
    channel = [("channel", "", np.arange(1.0)), ("time", "s", np.arange(4.0))]
    emd(tmp_path / "n.emd", FRAMES[None], [*channel, ("y", "nm", np.arange(20.0)), ("x", "nm", np.arange(24.0))])
    assert "length 1 are passed over: channel" in notes_of(tmp_path / "n.emd")[0]
    said = notes_of(write_dm(tmp_path / "x.dm4", FRAMES[:, None]))
    assert said == ["x.dm4: an axis of length 1 is passed over"]


def test_a_scan_is_not_made_a_movie(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["scan"] = np.zeros((3, 4, 20, 24), "u2")
    with pytest.raises(Exception, match="no data sets that could be the movie"):
        open_source(tmp_path / "a.h5")


def test_pages_beside_the_movie(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "k.tif") as file:
        for frame in FRAMES:
            file.write(frame, photometric="minisblack", metadata=None)
        file.write(FRAMES[0, ::2, ::2], photometric="minisblack", subfiletype=1, metadata=None)
    assert notes_of(tmp_path / "k.tif") == ["k.tif: 1 of its pages are small copies (thumbnails) and are not read"]
    with tifffile.TiffWriter(tmp_path / "s.tif") as file:
        for frame in FRAMES:
            file.write(frame, photometric="minisblack", metadata=None, subifds=1)
            file.write(frame[::2, ::2], photometric="minisblack", metadata=None, subfiletype=1)
    assert "SubIFDs" in notes_of(tmp_path / "s.tif")[0]
    eer(tmp_path / "f.eer", EVENTS, final=True)
    assert notes_of(tmp_path / "f.eer") == ["f.eer: 1 of its pages are no readouts, such as a sum, and are not read"]
