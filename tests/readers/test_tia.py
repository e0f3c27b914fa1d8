"""TIA series: values, calibration, times, and what is refused by name."""

import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from files_stamped import SER_TYPES, write_ser

from tract_dask.errors import SourceError
from tract_dask.readers import open_source

FRAMES = np.random.default_rng(0).integers(0, 60_000, (5, 12, 16)).astype("u2")


@pytest.mark.parametrize("version", [0x0210, 0x0220])
@pytest.mark.parametrize("dtype", [kind for kind in SER_TYPES if kind[0] != "c"])
def test_every_type_and_both_widths_of_offsets(dtype: str, version: int, tmp_path: Path) -> None:
    frames = FRAMES.astype(dtype)
    source = pickle.loads(pickle.dumps(open_source(write_ser(tmp_path / "a_1.ser", frames, version=version))))
    assert (source.shape, source.dtype) == (FRAMES.shape, dtype)
    np.testing.assert_array_equal(source.read(0, 5), frames)
    into = np.empty((2, 12, 16), dtype)
    source.read_into(3, into)
    np.testing.assert_array_equal(into, frames[3:])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"kind": 0x4120}, ("this is a spectrum", "image detector")),
        ({"kind": 7}, ("unknown kind", "0x0007")),
        ({"axes": [(5, 1.0, "x", "m"), (1, 1.0, "y", "m")]}, None),
        ({"axes": [(5, 1.0, "x", "m"), (3, 1.0, "y", "m")]}, ("more than three axes", "5 x 3 images")),
        ({"version": 0x0220, "axes": [(1, 1.0, "x", "m")] * 9}, ("axes of the series are damaged", "9 axes")),
    ],
)
def test_kinds_that_are_no_movie(options: dict[str, Any], words: tuple[str, ...] | None, tmp_path: Path) -> None:
    path = write_ser(tmp_path / "a_1.ser", FRAMES, **options)
    if words is None:
        assert open_source(path).shape == FRAMES.shape
        return
    with pytest.raises(SourceError) as caught:
        open_source(path)
    assert all(word in str(caught.value) for word in words), caught.value
    assert caught.value.remedy


@pytest.mark.parametrize("dtype", ["c8", "c16"])
def test_complex_images_are_refused_by_name(dtype: str, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="complex numbers"):
        open_source(write_ser(tmp_path / "a_1.ser", FRAMES.astype(dtype)))


def test_images_of_different_size_are_refused(tmp_path: Path) -> None:
    frames = [*FRAMES[:2], FRAMES[2][:10]]
    with pytest.raises(SourceError, match=r"differ in size or type.*10 x 16 pixels of type 2 in frame 2"):
        open_source(write_ser(tmp_path / "a_1.ser", frames))


def test_images_that_were_never_written_are_noted(tmp_path: Path) -> None:
    source = open_source(write_ser(tmp_path / "a_1.ser", FRAMES[:3], planned=8))
    assert source.metadata.notes == ("a_1.ser: 3 of 8 images were written; the others are left out",)
    np.testing.assert_array_equal(source.read(0, 3), FRAMES[:3])
    with pytest.raises(SourceError, match="no image of the series was written"):
        open_source(write_ser(tmp_path / "b_1.ser", [], planned=8))


@pytest.mark.parametrize(
    ("steps_m", "pixel_pm", "note"),
    [
        ((9.5e-12,), 9.5, None),
        ((5.26e-9,), 5260.0, None),
        ((1.0,), None, None),
        ((1.25e7,), None, "1.25e+07, is not a length in m"),
        ((float("nan"),), None, "not a number"),
        ((1e-11, 1e-11, 2e-11), 10.0, "the pixel size changes at frame 2"),
    ],
)
def test_pixel_sizes(steps_m: tuple[float, ...], pixel_pm: float | None, note: str | None, tmp_path: Path) -> None:
    known = open_source(write_ser(tmp_path / "a_1.ser", FRAMES, steps_m=steps_m)).metadata
    assert known.pixel_size_pm == pytest.approx(pixel_pm)
    assert any(note in text for text in known.notes) if note else not known.notes


def test_times(tmp_path: Path) -> None:
    def opened(**options: Any) -> Any:
        return open_source(write_ser(tmp_path / "a_1.ser", FRAMES, **options)).metadata

    known = opened(stamps=[100, 120, 140, 200, 220])
    assert known.frame_time_s == 20
    assert known.along_frames["time"].values.tolist() == [0, 20, 40, 100, 120]
    assert "gap of 60 s after frame 2" in known.notes[0]
    known = opened(stamps=[100, 102, 104, 106, 108])
    assert (known.frame_time_s, len(known.notes)) == (2, 1)
    assert "whole seconds" in known.notes[0]
    known = opened(stamps=[100, 100, 101, 101, 101], axes=[(5, 0.4, "Time", "s")])
    assert (known.frame_time_s, dict(known.along_frames)) == (0.4, {})
    assert "do not grow" in known.notes[0]


def test_the_emi_file_beside_it(tmp_path: Path) -> None:
    asked: list[Path] = []
    path = write_ser(tmp_path / "scan (2)_1.ser", FRAMES, stamps=[100] * 5)
    emi = tmp_path / "scan (2).emi"
    emi.write_bytes(b"\x01\x02" * 50 + b"<ObjectInfo><FrameTime>0.25</FrameTime></ObjectInfo>" + b"\0" * 9)
    for place in (emi, path, tmp_path):
        source = open_source(place, permit=asked.append)
        assert (source.files, source.metadata.frame_time_s) == ((path,), 0.25)
        np.testing.assert_array_equal(source.read(0, 5), FRAMES)
    assert {emi, path} == set(asked)
    write_ser(tmp_path / "scan (2)_2.ser", FRAMES)
    with pytest.raises(SourceError, match=r"several series.*scan \(2\)_1.ser, scan \(2\)_2.ser"):
        open_source(emi)
    (tmp_path / "alone.emi").write_bytes(b"EMI")
    with pytest.raises(SourceError, match=r"which is not there.*alone_1\.ser"):
        open_source(tmp_path / "alone.emi")


def test_damage(tmp_path: Path) -> None:
    path = write_ser(tmp_path / "a_1.ser", FRAMES, version=0x0220)
    whole = path.read_bytes()
    for size, words in (
        (10, "in its header"),
        (60, "axes of the series"),
        (100, "in its table"),
        (800, "in frame 2 of 5"),
    ):
        path.write_bytes(whole[:size])
        with pytest.raises(SourceError, match=words):
            open_source(path)
    for at, number in ((14, 2**31 - 1), (18, 2**31 - 1), (22, 2**62), (30, 2**31 - 1)):
        width = 8 if at == 22 else 4
        path.write_bytes(whole[:at] + number.to_bytes(width, "little") + whole[at + width :])
        with pytest.raises(SourceError):
            open_source(path)
    table = 72
    path.write_bytes(whole[:table] + whole[table : table + 8] * 5 + whole[table + 40 :])
    with pytest.raises(SourceError, match="the images of the series overlap"):
        open_source(path)
    path.write_bytes(struct.pack("<3H", 0x4949, 0x0197, 0x0230) + whole[6:])
    with pytest.raises(SourceError, match="not that of a TIA series"):
        open_source(path)
    path.write_bytes(bytes(len(whole)))
    with pytest.raises(SourceError, match="not that of a TIA series"):
        open_source(path)


def test_an_empty_emi_file_says_nothing(tmp_path: Path) -> None:
    frames = np.arange(2 * 6 * 8, dtype="u2").reshape(2, 6, 8)
    write_ser(tmp_path / "a_1.ser", frames, stamps=[5, 5])
    (tmp_path / "a.emi").write_bytes(b"")
    assert open_source(tmp_path / "a_1.ser").metadata.frame_time_s is None
