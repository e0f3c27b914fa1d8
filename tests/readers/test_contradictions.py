"""Files that contradict themselves: axes of NeXus, sources of virtual data sets, references beside sequences."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from files_classic import mrc
from files_stamped import write_seq
from test_reader_places import FRAMES

from tract_dask.errors import SourceError
from tract_dask.readers import open_source

TIME = (np.arange(4) * 0.5, "s")
Y, X = (np.arange(20) * 0.1, "nm"), (np.arange(24) * 0.1, "nm")


def write_nexus(path: Path, axes: list[str], places: dict[str, Any], indices: dict[str, int]) -> Path:
    with h5py.File(path, "w") as file:
        group = file.create_group("entry/data")
        group.attrs.update(NX_class="NXdata", signal="data", axes=axes)
        group.attrs.update({f"{name}_indices": place for name, place in indices.items()})
        group["data"] = FRAMES
        for name, (values, unit) in places.items():
            group[name] = values
            group[name].attrs["units"] = unit
    return path


WHOLE = ["time", "y", "x"]
UNEVEN = (np.cumsum(np.r_[0, np.linspace(0.1, 0.5, 23)]), "nm")
NONE = "contradict each other"
CASES: dict[str, tuple[list[str], dict[str, Any], dict[str, int], float | None, float | None, str]] = {
    "as they should be": (WHOLE, {"time": TIME, "y": Y, "x": X}, {}, 100.0, 0.5, ""),
    "exchanged": (["x", "y", "time"], {"time": TIME, "x": X}, {"x": 2, "y": 1, "time": 0}, 100.0, 0.5, ""),
    "two of one": (WHOLE, {"time": TIME}, {"time": 0, "y": 2, "x": 2}, None, None, NONE),
    "of none": (WHOLE, {"time": TIME}, {"x": 7}, None, None, NONE),
    "one twice": (["x", "y", "x"], {"x": X}, {}, None, None, NONE),
    "too many": (["t", *WHOLE], {}, {}, None, None, NONE),
    "the last two": (
        ["y", "x"],
        {"y": Y, "x": X},
        {},
        100.0,
        None,
        "names 2 of its 3 axes (y, x), taken for its last",
    ),
    "the first": (["time"], {"time": TIME}, {}, None, 0.5, "names 1 of its 3 axes (time), taken for its first"),
    "too few, unknown": (["y", "x"], {}, {}, None, None, NONE),
    "another length": (WHOLE, {"time": TIME, "x": (X[0][:7], "nm")}, {}, 100.0, 0.5, "lists 7 places for 24 elements"),
    "no length": (WHOLE, {"time": TIME, "y": Y, "x": (X[0], "s")}, {}, 100.0, 0.5, "x (s) is not a length"),
    "no time": (WHOLE, {"time": (TIME[0], "nm")}, {}, None, None, "0.5 nm, which is not a frame time"),
    "uneven": (WHOLE, {"time": TIME, "x": UNEVEN}, {}, 300.0, 0.5, "places along x (nm) are not even"),
}


@pytest.mark.parametrize("name", CASES)
def test_axes_of_nexus(name: str, tmp_path: Path) -> None:
    axes, places, indices, pixel, seconds, words = CASES[name]
    source = open_source(write_nexus(tmp_path / "a.nxs", axes, places, indices))
    np.testing.assert_array_equal(source.read(0, 4), FRAMES)
    known = source.metadata
    assert known.pixel_size_pm == (None if pixel is None else pytest.approx(pixel, rel=0.03))
    assert known.frame_time_s == seconds
    assert bool(known.notes) == bool(words), known.notes
    assert any(words in note for note in known.notes) or not words, known.notes


Sources = list[tuple[Any, np.ndarray, tuple[int, ...]]]


def write_virtual(folder: Path, sources: Sources, dtype: str = "u2") -> Path:
    """Write a movie of sources: each the place in the movie, its pixels, and the shape that the movie says of it."""
    layout = h5py.VirtualLayout(FRAMES.shape, dtype)
    for k, (place, pixels, said) in enumerate(sources):
        with h5py.File(folder / f"part_{k}.h5", "w") as file:
            file["data"] = pixels
        layout[place] = h5py.VirtualSource(f"part_{k}.h5", "data", said, dtype=pixels.dtype)
    with h5py.File(folder / "movie.h5", "w", libver="latest") as file:
        file.create_virtual_dataset("movie", layout)
    return folder / "movie.h5"


HALF = (2, 20, 24)
FIRST, SECOND = (np.s_[0:2], FRAMES[:2], HALF), (np.s_[2:4], FRAMES[2:], HALF)


def test_virtual_sources_with_an_axis_less(tmp_path: Path) -> None:
    images: Sources = [(np.s_[k], FRAMES[k], (20, 24)) for k in range(4)]
    source = open_source(write_virtual(tmp_path, images))
    np.testing.assert_array_equal(source.read(0, 4), FRAMES)
    assert source.metadata.notes == ()


@pytest.mark.parametrize(
    ("second", "got"),
    [
        ((np.s_[2:4], FRAMES[2:, :, :12], HALF), "2 x 20 x 12"),
        ((np.s_[2:4], FRAMES[2:3], HALF), "1 x 20 x 24"),
        ((np.s_[2:4], FRAMES[2:].transpose(0, 2, 1), HALF), "2 x 24 x 20"),
        ((np.s_[2:4], FRAMES[2], HALF), "20 x 24"),
    ],
)
def test_virtual_sources_that_are_too_small(second: Any, got: str, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=f"too short.*of at least 2 x 20 x 24; got {got}"):
        open_source(write_virtual(tmp_path, [FIRST, second]))


@pytest.mark.parametrize(
    ("sources", "words"),
    [
        ([FIRST, (np.s_[1:3], FRAMES[2:], HALF)], "480 of 1,920 pixels of the virtual data set come from no file"),
        ([FIRST], "960 of 1,920 pixels"),
        ([FIRST, (np.s_[2:4], FRAMES[2:] + 0.5, HALF)], "part_1.h5::/data are converted from float64 to uint16"),
        ([FIRST, (np.s_[2:4], FRAMES[2:].astype("i4"), HALF)], "converted from int32 to uint16"),
    ],
)
def test_virtual_data_that_are_not_all_of_their_sources(sources: Sources, words: str, tmp_path: Path) -> None:
    notes = open_source(write_virtual(tmp_path, sources)).metadata.notes
    assert len(notes) == 1
    assert words in notes[0]


def _image(pixels: np.ndarray) -> Callable[[Path], object]:
    return lambda path: mrc(path, np.ascontiguousarray(pixels, "f4"), 2)


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (_image(FRAMES[:1]), "it is not applied"),
        (_image(FRAMES[:1, :10]), "it has 10 x 24 pixels, and the frames 20 x 24"),
        (_image(FRAMES[:1].transpose(0, 2, 1)), "it has 24 x 20 pixels, and the frames 20 x 24"),
        (lambda path: path.write_text("a text"), "cannot be read (the header is not that of an MRC stack)"),
        (lambda path: path.touch(), "cannot be read (the file is empty)"),
    ],
)
def test_references_beside_sequences(write: Callable[[Path], object], words: str, tmp_path: Path) -> None:
    write_seq(tmp_path / "m.seq", FRAMES)
    write(tmp_path / "m.dark.mrc")
    known = open_source(tmp_path / "m.seq").metadata
    assert [note for note in known.notes if "m.dark.mrc" in note and words in note], known.notes
    assert ("dark" in known.references) == (words == "it is not applied")


@pytest.mark.parametrize(
    ("attributes", "odd"),
    [
        ({"pixel_size": 0.1, "pixel_unit": "nm"}, ["pixel_size"]),
        ({"frame_rate": 25.0, "pixel_size_nm": 0.1}, ["frame_rate"]),
        ({"exposure_s": 0.1, "frame_time_s": 0.2, "pixelsize": 1}, ["pixelsize"]),
        ({"title": "a", "voltage": 300}, []),
    ],
)
def test_attributes_that_may_be_a_calibration_are_named(
    attributes: dict[str, Any], odd: list[str], tmp_path: Path
) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["movie"] = FRAMES
        file["movie"].attrs.update(attributes)
    said = [f"a.h5: its attribute {name} cannot be understood; it is not used" for name in odd]
    assert open_source(tmp_path / "a.h5").metadata.notes == tuple(said)
