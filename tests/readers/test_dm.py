"""DigitalMicrograph: DM3, DM4 and DM5 files."""

from __future__ import annotations

import pickle
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from files_dm import document, image, numbered, thumbnail, write_dm, write_dm5, write_tags

from tract_dask.errors import SourceError
from tract_dask.readers import open_source
from tract_dask.readers.dm.tags import read_tags

FRAMES = np.random.default_rng(0).integers(0, 120, (5, 6, 7)).astype("u2")
LENGTHS = [(0.05, "nm"), (0.05, "nm"), (0.25, "s")]


def refused(path: Path | str, *words: str) -> None:
    with pytest.raises(SourceError) as caught:
        open_source(path)
    text = str(caught.value)
    assert all(word in text for word in words), text
    assert caught.value.remedy


@pytest.mark.parametrize("suffix", [".dm3", ".dm4", ".dm5"])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8", "?"])
def test_every_type_of_pixels_in_both_orders_of_bytes(suffix: str, order: str, dtype: str, tmp_path: Path) -> None:
    frames = (FRAMES > 60) if dtype == "?" else FRAMES.astype(dtype)
    path = write_dm(tmp_path / f"a{suffix}", frames, LENGTHS, order=order)
    source = open_source(path)
    assert (source.format, source.shape) == (suffix[1:].upper(), (5, 6, 7))
    assert source.dtype == np.dtype("u1" if dtype == "?" else dtype)
    np.testing.assert_array_equal(source.read(0, 5), frames)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(source)).read(2, 4), frames[2:4])
    target = np.empty((3, 6, 7), source.dtype)
    source.read_into(1, target)
    np.testing.assert_array_equal(target, frames[1:4])
    assert (source.metadata.pixel_size_pm, source.metadata.frame_time_s) == (50, 0.25)


def test_one_image_is_a_movie_of_one_frame_and_axes_of_one_pixel_count_for_none(tmp_path: Path) -> None:
    assert open_source(write_dm(tmp_path / "a.dm4", FRAMES[0])).shape == (1, 6, 7)
    for frames in (FRAMES[None, None], FRAMES[:, None]):
        source = open_source(write_dm(tmp_path / "b.dm4", frames))
        np.testing.assert_array_equal(source.read(0, 9), FRAMES)


@pytest.mark.parametrize(("suffix", "axis"), [(".dm3", 1), (".dm4", 2)])
def test_the_axis_of_time_counts_the_frames_wherever_it_is(suffix: str, axis: int, tmp_path: Path) -> None:
    stored = np.moveaxis(FRAMES, 0, axis)
    axes = [(0.05, "nm"), (0.05, "nm")]
    axes.insert(2 - axis, (40.0, "ms"))
    source = open_source(write_dm(tmp_path / f"a{suffix}", stored, axes, order=">"))
    assert source.shape == (5, 6, 7)
    np.testing.assert_array_equal(source.read(0, 5), FRAMES)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(source)).read(3, 4), FRAMES[3:4])
    assert (source.metadata.pixel_size_pm, source.metadata.frame_time_s) == (50, 0.04)
    assert "not its slowest axis" in source.metadata.notes[-1]
    path = Path(source.path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(SourceError, match="before the frames"):
        source.read(0, 1)


def test_a_dm5_stack_whose_frames_are_not_the_slowest_axis_is_refused(tmp_path: Path) -> None:
    refused(write_dm5(tmp_path / "a.dm5", FRAMES, [(1.0, "s"), (1.0, "nm"), (1.0, "nm")]), "not its slowest axis")


@pytest.mark.parametrize(
    ("frames", "axes", "words"),
    [
        (FRAMES.astype("c8"), (), "the pixels are complex numbers"),
        (FRAMES.astype("c16"), (), "the pixels are complex numbers"),
        (np.zeros((3, 4), [(name, "u1") for name in "RGBA"]), (), "the pixels are RGB colours"),
        (FRAMES, [(1.0, "nm"), (1.0, "nm"), (0.1, "eV")], "spectrum"),
        (FRAMES[0], [(0.1, "eV")], "spectrum"),
        (FRAMES[0, 0], (), "line profile or a spectrum"),
        (np.zeros((2, 3, 4, 5), "u2"), (), "the image has 4 axes"),
    ],
)
@pytest.mark.parametrize("suffix", [".dm3", ".dm4", ".dm5"])
def test_what_is_no_movie_is_refused_by_name(suffix: str, frames: Any, axes: Any, words: str, tmp_path: Path) -> None:
    refused(write_dm(tmp_path / f"a{suffix}", frames, axes), words)


def test_an_image_of_spectra_is_refused_by_its_tags(tmp_path: Path) -> None:
    refused(write_dm(tmp_path / "a.dm4", FRAMES, (), {"Meta Data": {"Format": "Spectrum image"}}), "spectrum")


def test_the_largest_image_of_several_or_the_one_that_is_named(tmp_path: Path) -> None:
    images = [image(FRAMES[0]), image(FRAMES), image(FRAMES[:, :, :].astype("c16")), image(FRAMES[1])]
    path = write_tags(tmp_path / "a.dm4", document(*images))
    source = open_source(path)
    np.testing.assert_array_equal(source.read(0, 5), FRAMES)
    assert source.inside == "2"
    assert "image 2 (5 x 6 x 7) is read; the file also holds ::1 (6 x 7), ::3" in source.metadata.notes[0]
    np.testing.assert_array_equal(open_source(f"{path}::4").read(0, 1), FRAMES[1:2])
    refused(f"{path}::3", "complex")
    refused(f"{path}::0", "RGB")
    refused(f"{path}::9", "no image of this number", "Expected 1, 2, 3, 4")
    refused(f"{path}::x", "no image of this number")


def test_a_thumbnail_that_no_tag_names_is_not_the_movie(tmp_path: Path) -> None:
    tags = document(image(FRAMES[:, :2, :2]))
    del tags["Thumbnails"]
    tags["ImageList"] = numbered([image(np.zeros((50, 50), "u2")), image(FRAMES[:, :2, :2])])
    source = open_source(write_tags(tmp_path / "a.dm4", tags))
    np.testing.assert_array_equal(source.read(0, 5), FRAMES[:, :2, :2])
    refused(write_tags(tmp_path / "b.dm4", {"ImageList": numbered([thumbnail()])}), "RGB")
    refused(write_tags(tmp_path / "c.dm4", {"ImageList": {}}), "the file holds no image")


@pytest.mark.parametrize(
    ("axes", "pixel", "seconds", "words"),
    [
        ([(0.2, "Å"), (0.2, "Å"), (20.0, "µs")], 20, 2e-5, ""),
        ([(0.001, "µm"), (0.002, "µm"), (1.0, "")], 1000, None, "not square"),
        ([(-0.1, "nm"), (0.1, "nm"), (2.0, "nm")], 100, None, "its frames are 2 nm apart, which is not a frame time"),
        ([(0.1, "nm"), (0.1, "nm"), (0.5, "")], 100, None, "its frames are 0.5 (no unit) apart"),
        ([(0.01, "1/nm"), (0.01, "1/nm"), (1.0, "sec")], None, 1, "calibrated in 1/nm, which is not a length"),
        ([(0.1, "nm"), (1.0, "")], 100, None, "only one of x and y is calibrated"),
        ([(0.0, "nm"), (0.0, "nm")], None, None, "a pixel of 0 nm is impossible"),
        ([(1.0, "mrad"), (1.0, "mrad"), (0.0, "s")], None, None, "mrad"),
        ([(1e-9, "ms"), (1.0, "nm")], 1000, None, "calibrated in ms"),
    ],
)
def test_calibrations_and_what_is_odd_about_them(
    axes: Any, pixel: float | None, seconds: float | None, words: str, tmp_path: Path
) -> None:
    frames = FRAMES if len(axes) == 3 else FRAMES[0]
    if words == "calibrated in ms":
        pixel = None
    for suffix in (".dm3", ".dm4"):
        known = open_source(write_dm(tmp_path / f"a{suffix}", frames, axes)).metadata
        assert (known.pixel_size_pm, known.frame_time_s) == (pixel, seconds)
        assert any(words in note for note in known.notes) if words else not known.notes


def test_numbers_that_digitalmicrograph_shows_otherwise(tmp_path: Path) -> None:
    known = open_source(write_dm(tmp_path / "a.dm4", FRAMES, brightness=(1.0, 0.5, "e-"))).metadata
    assert "shows 0.5 times (stored number - 1) e-; the numbers are read as stored" in known.notes[0]


@pytest.mark.parametrize(
    ("tags", "seconds", "words"),
    [
        ({"DataBar": {"Exposure Time (s)": 0.2}}, 0.2, "an exposure of 0.2 s"),
        ({"Acquisition": {"Parameters": {"High Level": {"Exposure (s)": 0.3}}}}, 0.3, "an exposure of 0.3 s"),
        ({"In-situ": {"Recorded": {"Frame rate (fps)": 25.0}}}, 0.04, "the tag In-situ/Recorded/Frame rate (fps)"),
        ({"In-situ": {"Frame time (ms)": 5.0}}, 0.005, "the tag In-situ/Frame time (ms)"),
        ({"DataBar": {"Exposure Time (s)": float("nan")}}, None, ""),
    ],
)
def test_the_frame_time_of_tags(tags: Any, seconds: float | None, words: str, tmp_path: Path) -> None:
    known = open_source(write_dm(tmp_path / "a.dm4", FRAMES, (), tags)).metadata
    assert known.frame_time_s == seconds
    assert [words in note for note in known.notes] == [True] * bool(words)


def stamped(seconds: float) -> dict[str, Any]:
    tilt = {"Microscope Info": {"Stage Position": {"Stage Alpha": seconds / 10}}}
    return {"DataBar": {"Acquisition Time (OS)": 1.31e17 + 1e7 * seconds, "Exposure Time (s)": 0.1}} | tilt


@pytest.mark.parametrize("silent", [0, 4])
def test_a_file_without_a_time_stamp_among_others_is_named(silent: int, tmp_path: Path) -> None:
    for k in range(5):
        write_dm(tmp_path / f"f_{k}.dm4", FRAMES[k], LENGTHS, None if k == silent else stamped(0.5 * k))
    known = open_source(tmp_path).metadata
    assert list(known.along_frames) == ["stage_tilt"]
    tilts = [np.nan if k == silent else 0.05 * k for k in range(5)]
    np.testing.assert_allclose(known.along_frames["stage_tilt"].values, tilts)
    assert any(f"f_{silent}.dm4 does not say when it was taken, other files do" in note for note in known.notes)


def test_a_folder_of_single_frames_has_the_times_of_its_files(tmp_path: Path) -> None:
    moments = [0.0, 0.5, 1.0, 2.5, 3.0]
    for k, moment in enumerate(moments):
        write_dm(tmp_path / f"f_{k}.dm4", FRAMES[k], LENGTHS, stamped(moment))
    source = open_source(tmp_path)
    np.testing.assert_array_equal(source.read(0, 5), FRAMES)
    assert (source.metadata.frame_time_s, source.metadata.pixel_size_pm) == (0.5, 50)
    np.testing.assert_allclose(source.metadata.along_frames["time"].values, moments)
    np.testing.assert_allclose(source.metadata.along_frames["stage_tilt"].values, np.array(moments) / 10)
    assert any("a gap of 1.5 s after frame 2" in note for note in source.metadata.notes)
    for k in range(5):
        write_dm(tmp_path / f"f_{k}.dm4", FRAMES[k], LENGTHS, stamped(0.04 * k))
    assert open_source(tmp_path).metadata.frame_time_s == 0.04


@pytest.mark.parametrize("moments", [[3.0] * 5, [0.0, 1.0, 0.5, 2.0, 3.0]])
def test_stamps_that_say_nothing_leave_the_exposure(moments: list[float], tmp_path: Path) -> None:
    for k, moment in enumerate(moments):
        write_dm(tmp_path / f"f_{k}.dm4", FRAMES[k], LENGTHS, stamped(moment))
    known = open_source(tmp_path).metadata
    assert known.frame_time_s == 0.1
    assert "time" not in known.along_frames
    assert any("do not grow" in note for note in known.notes) is (len(set(moments)) > 1)


@pytest.mark.parametrize("suffix", [".dm3", ".dm4"])
def test_a_file_that_ends_early_or_goes_on(suffix: str, tmp_path: Path) -> None:
    path = write_dm(tmp_path / f"a{suffix}", FRAMES)
    whole = path.read_bytes()
    for kept in range(1, len(whole) - 8, 61):
        path.write_bytes(whole[:kept])
        refused(path, path.name)
    path.write_bytes(whole[: whole.index(FRAMES.tobytes()) + 100])
    refused(path, "in its pixels")
    path.write_bytes(whole + bytes(1000))
    assert "1,000 bytes after its last tag are not read" in open_source(path).metadata.notes[0]


def test_dm5_says_that_it_was_not_tested_and_is_read_by_name(tmp_path: Path) -> None:
    path = write_dm5(tmp_path / "a.dm5", FRAMES, LENGTHS)
    asked: list[Path] = []
    source = open_source(path, permit=asked.append)
    assert source.metadata.notes == (
        "a.dm5: this reader of DM5 was not tested with a file from a camera; compare a frame with the vendor's program",
    )
    assert set(asked) == {path}
    (tmp_path / "b.dm4").write_bytes(path.read_bytes())
    np.testing.assert_array_equal(open_source(tmp_path / "b.dm4").read(0, 5), FRAMES)
    with h5py.File(path, "a") as file:
        file["loop"] = file["ImageList"]
        file["ImageList/[1]/loop"] = file["/"]
        file["ImageList/[7]"] = h5py.ExternalLink("/etc/passwd", "/")
    assert open_source(path).shape == (5, 6, 7)


def test_damage_ends_soon(tmp_path: Path) -> None:
    """Groups in one another, too many tags, numbers that cannot be: each an error within a moment."""
    path = tmp_path / "a.dm4"
    nested: dict[str, Any] = {}
    for _ in range(99):
        nested = {"a": nested}
    refused(write_tags(path, nested, 3), "nested too deeply")
    refused(write_tags(path, nested, 4), "the file holds no image")
    write_dm(path, FRAMES)
    whole = path.read_bytes()
    began = time.process_time()
    for at, value, words in ((18, b"\x7f" * 8, "more tags than"), (0, bytes(4), "not a DigitalMicrograph file")):
        path.write_bytes(whole[:at] + value + whole[at + len(value) :])
        refused(path, words)
    for number in (0, 0x7FFFFFFF, 0xFFFFFFFF):
        tags = document(image(FRAMES))
        tags["ImageList"]["[1]"]["ImageData"]["Dimensions"]["[2]"] = number
        refused(write_tags(path, tags), "contradict the axes")
    tags["ImageList"]["[1]"]["ImageData"] |= {"DataType": 77}
    refused(write_tags(path, tags), "the type of the pixels is unknown")
    path.write_bytes(bytes(1 << 20))
    refused(path, "not a DigitalMicrograph file")
    assert time.process_time() - began < 2


def test_a_damaged_tag_of_a_dm4_file_is_passed_over_and_named(tmp_path: Path) -> None:
    path = write_dm(tmp_path / "a.dm4", FRAMES, LENGTHS, {"Other": {"damaged": 1.0}})
    whole = path.read_bytes()
    at = whole.index(b"damaged") + len(b"damaged") + 8
    path.write_bytes(whole[:at] + b"!" + whole[at + 1 :])
    source = open_source(path)
    np.testing.assert_array_equal(source.read(0, 5), FRAMES)
    assert source.metadata.notes == ("a.dm4: these tags are damaged and were passed over: damaged",)
    (tmp_path / "a.dm3").write_bytes(write_dm(tmp_path / "a.dm3", FRAMES).read_bytes().replace(b"%%%%", b"%!%%", 1))
    refused(tmp_path / "a.dm3", "does not begin as values do")


def test_tags_are_read_whole(tmp_path: Path) -> None:
    tags = {"a": {"b": 3, "c": "text µ"}, "d": numbered([1.5, {"e": (1.0, 2.0)}])}
    for version in (3, 4):
        for order in "<>":
            found = read_tags(write_tags(tmp_path / "a.dm4", tags, version, order))
            assert (found.version, found.order) == (version, order)
            assert found.tags["a"]["b"] == 3
            assert found.tags["d"] == {"[0]": 1.5, "[1]": {"e": (1.0, 2.0)}}
