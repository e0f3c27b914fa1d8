"""Merlin files: processed and raw frames of one chip and of four, times, and the text beside them."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from files_stamped import side_by_side, write_hdr, write_mib

from tract_dask.errors import SourceError
from tract_dask.readers import open_source

DEEP = np.random.default_rng(0).integers(0, 2**24, (3, 16, 256)).astype("u4")


@pytest.mark.parametrize("layout", ["1x1", "2x2", "2x2G", "Nx1"])
@pytest.mark.parametrize("dtype", ["u1", "u2", "u4"])
def test_processed(dtype: str, layout: str, tmp_path: Path) -> None:
    frames = DEEP.astype(dtype)
    source = open_source(write_mib(tmp_path / "a.mib", frames, layout=layout))
    source = pickle.loads(pickle.dumps(source))
    assert (source.shape, source.dtype, source.metadata.notes) == (DEEP.shape, dtype, ())
    np.testing.assert_array_equal(source.read(0, 3), frames)
    into = np.empty((2, 16, 256), dtype)
    source.read_into(1, into)
    np.testing.assert_array_equal(into, frames[1:])


@pytest.mark.parametrize("layout", ["1x1", "2x2", "2x2G"])
@pytest.mark.parametrize(("depth", "dtype"), [(1, "u1"), (6, "u1"), (12, "u2"), (24, "u4")])
def test_raw(depth: int, dtype: str, layout: str, tmp_path: Path) -> None:
    frames = (DEEP & (2**depth - 1)).astype(dtype)
    source = open_source(write_mib(tmp_path / "a.mib", frames, raw=depth, layout=layout))
    source = pickle.loads(pickle.dumps(source))
    assert (source.shape, source.dtype) == (DEEP.shape, dtype)
    np.testing.assert_array_equal(source.read(0, 3), frames)
    into = np.empty((2, 16, 256), dtype)
    source.read_into(1, into)
    np.testing.assert_array_equal(into, frames[1:])
    assert "not tested with a file from a camera" in source.metadata.notes[0]
    assert any("gap between the chips" in note for note in source.metadata.notes) == layout.endswith("G")


@pytest.mark.parametrize("layout", ["1x1", "2x2"])
def test_raw_24_bit_whose_header_counts_both_halves(layout: str, tmp_path: Path) -> None:
    path = write_mib(tmp_path / "a.mib", DEEP, raw=24, layout=layout, doubled=True)
    for frames in (DEEP, DEEP[:1]):
        write_mib(path, frames, raw=24, layout=layout, doubled=True)
        np.testing.assert_array_equal(open_source(path).read(0, len(frames)), frames)


def test_words_by_hand(tmp_path: Path) -> None:
    """Four pixels of 12 bits in a word: the last one comes first."""
    path = write_mib(tmp_path / "a.mib", DEEP[:1, :1, :4] & 0xFFF, raw=12)
    path.write_bytes(path.read_bytes()[:384] + bytes([0, 4, 0, 3, 0, 2, 15, 255]))
    assert open_source(path).read(0, 1).tolist() == [[[4095, 2, 3, 4]]]


def test_chips_by_hand() -> None:
    assert side_by_side(np.arange(8).reshape(2, 4)).tolist() == [[7, 6, 5, 4, 2, 3, 0, 1]]


@pytest.mark.parametrize("exact", [True, False])
def test_times(exact: bool, tmp_path: Path) -> None:
    path = write_mib(tmp_path / "a.mib", DEEP, exact=exact, stamps_us=[0, 1234, 2469])
    known = open_source(path).metadata
    assert known.along_frames["time"].values.tolist() == [0, 0.001234, 0.002469]
    assert (known.frame_time_s, known.notes) == (0.0012345, ())
    known = open_source(write_mib(path, DEEP[:1], exact=exact)).metadata
    assert known.frame_time_s == 0.002
    assert "exposure of its first frame, 0.002 s" in known.notes[0]
    text = path.read_bytes().replace(b"2026-03-04", b"04.03.2026")
    path.write_bytes(text)
    assert "cannot be read: '04.03.2026" in open_source(path).metadata.notes[0]


def test_the_hdr_file_beside_it(tmp_path: Path) -> None:
    asked: list[Path] = []
    path = write_mib(tmp_path / "scan [2].mib", DEEP.astype("u2"))
    header = write_hdr(tmp_path / "scan [2].hdr", 3)
    for place in (header, path, tmp_path, f"{tmp_path}/scan*"):
        source = open_source(place, permit=asked.append)
        assert (source.files, source.metadata.notes) == ((path,), ())
        np.testing.assert_array_equal(source.read(0, 3), DEEP.astype("u2"))
    assert {header, path} == set(asked)
    write_hdr(header, 300)
    assert "it holds 3 frames, its .hdr file says 300" in open_source(path).metadata.notes[0]
    write_mib(path, DEEP[:1])
    write_hdr(header, 1, more="Frame Time (ms):\t2.5\n")
    assert open_source(header).metadata.frame_time_s == 0.0025


def test_a_hdr_file_without_its_frames(tmp_path: Path) -> None:
    header = write_hdr(tmp_path / "scan.hdr", 3)
    with pytest.raises(SourceError, match=r"which is not there.*scan\.mib"):
        open_source(header)
    write_mib(tmp_path / "scan1.mib", DEEP)
    np.testing.assert_array_equal(open_source(header).read(0, 3), DEEP)
    write_mib(tmp_path / "scan2.mib", DEEP)
    with pytest.raises(SourceError, match=r"several \.mib files.*scan1\.mib, scan2\.mib"):
        open_source(header)


def test_the_depth_of_raw_frames_may_stand_in_the_hdr_file(tmp_path: Path) -> None:
    frames = DEEP & 0xFFF
    path = write_mib(tmp_path / "a.mib", frames, raw=12, exact=False)
    with pytest.raises(SourceError, match=r"raw frames are impossible.*got 0 bits"):
        open_source(path)
    write_hdr(tmp_path / "a.hdr", 3, depth=12)
    np.testing.assert_array_equal(open_source(path).read(0, 3), frames)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b"MQ1,000001", b"MQ2,000001", "not that of a Merlin file"),
        (b"U16", b"U12", "not that of a Merlin file"),
        (b",00384,", b",99999,", "not that of a Merlin file"),
        (b",0256,0016,", b",0000,0016,", "has no frames"),
        (b",0256,0016,", b",9999,9999,", "in its first frame"),
        (b"MQ1,000002,00384,01", b"MQ1,000002,00384,04", "header of frame 1 differs from the first"),
        (b"MQ1,000003", b"XXX,000003", "header of frame 2 differs from the first"),
    ],
)
def test_damage(old: bytes, new: bytes, words: str, tmp_path: Path) -> None:
    path = write_mib(tmp_path / "a.mib", DEEP.astype("u2"))
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(SourceError, match=words):
        open_source(path)


def test_a_file_that_was_cut_short(tmp_path: Path) -> None:
    path = write_mib(tmp_path / "a.mib", DEEP)
    path.write_bytes(path.read_bytes()[:-5])
    source: Any = open_source(path)
    assert source.shape[0] == 2
    assert "bytes after its last whole frame are not read" in source.metadata.notes[0]


def test_an_empty_hdr_file_says_nothing(tmp_path: Path) -> None:
    frames = np.arange(2 * 6 * 8, dtype="u2").reshape(2, 6, 8)
    path = write_mib(tmp_path / "a.mib", frames)
    (tmp_path / "a.hdr").write_bytes(b"")
    np.testing.assert_array_equal(open_source(path).read(0, 2), frames)
