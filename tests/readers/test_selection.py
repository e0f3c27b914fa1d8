"""A part of a movie: frames, a field and bins, against the same part of the array."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import tifffile
from files_stamped import write_seq
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from tract_dask.errors import SettingsError, SourceError
from tract_dask.readers import open_source
from tract_dask.readers.selection import span
from tract_dask.settings import MetadataSettings, SourceSettings
from tract_dask.stages.convert.stage import convert
from tract_dask.store.movie import open_movie

FRAMES = np.random.default_rng(3).integers(0, 250, (12, 21, 26)).astype("u1")


def binned(frames: np.ndarray, side: int) -> np.ndarray:
    n_y, n_x = (length // side * side for length in frames.shape[1:])
    parts = [frames[:, y:n_y:side, x:n_x:side].astype(np.int64) for y in range(side) for x in range(side)]
    return np.sum(parts, axis=0)


@pytest.fixture(params=["movie.npy", "movie.tif", "folder"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / request.param
    if path.suffix == ".npy":
        np.save(path, FRAMES)
    elif path.suffix == ".tif":
        tifffile.imwrite(path, FRAMES, compression="zlib", photometric="minisblack")
    else:
        path.mkdir()
        for number in range(4):
            np.save(path / f"f_{number}.npy", FRAMES[3 * number : 3 * number + 3])
    return path


@pytest.mark.parametrize(
    ("declared", "expected", "dtype"),
    [
        (SourceSettings(frames="2:11:3"), FRAMES[2:11:3], "u1"),
        (SourceSettings(frames="-5:"), FRAMES[-5:], "u1"),
        (SourceSettings(roi="3:17,5:26"), FRAMES[:, 3:17, 5:26], "u1"),
        (SourceSettings(roi=" :8 , -9: "), FRAMES[:, :8, -9:], "u1"),
        (SourceSettings(bin=2), binned(FRAMES, 2), "u2"),
        (SourceSettings(frames="1:10:2", roi="1:20,2:25", bin=3), binned(FRAMES[1:10:2, 1:20, 2:25], 3), "u2"),
    ],
)
def test_a_part_is_that_of_the_array(place: Path, declared: SourceSettings, expected: np.ndarray, dtype: str) -> None:
    source = pickle.loads(pickle.dumps(open_source(place, declared)))
    assert (source.shape, source.dtype) == (expected.shape, np.dtype(dtype))
    np.testing.assert_array_equal(source.read(0, len(expected)), expected)
    np.testing.assert_array_equal(source.read(1, 3), expected[1:3])
    filled = np.empty((2, *expected.shape[1:]), dtype)
    source.read_into(1, filled)
    np.testing.assert_array_equal(filled, expected[1:3])
    assert "a part of the movie is read" in source.metadata.notes[-1]


def test_sizes_and_times_are_those_of_the_part(tmp_path: Path) -> None:
    np.save(tmp_path / "movie.npy", FRAMES)
    known = MetadataSettings(pixel_size_pm=8.0, frame_time_s=0.025, dose=100.0, gain=0.5)
    part = open_source(tmp_path / "movie.npy", SourceSettings(frames="0:12:4", bin=2), known).metadata
    assert (part.pixel_size_pm, part.frame_time_s, part.dose, part.gain) == (16.0, 0.1, 100.0, 0.5)


@pytest.mark.parametrize(
    ("part", "times", "step"),
    [
        ("1::2", [0, 0.16, 0.24], 0.12),
        ("1:4", [0, 0.04, 0.16], 0.08),
        ("::3", [0, 0.2], 0.2),
        ("3:", [0, 0.04, 0.08], 0.04),
        ("5:", [0], 0.04),
    ],
)
def test_a_part_keeps_the_times_of_frames_around_a_gap(
    part: str, times: list[float], step: float, tmp_path: Path
) -> None:
    stamps = [1_700_000_000_000_000 + 40_000 * k for k in (0, 1, 2, 5, 6, 7)]
    frames = np.arange(6 * 64 * 64, dtype="u2").reshape(6, 64, 64)
    place = write_seq(tmp_path / "lost.seq", frames, stamps_us=stamps)
    movie = open_movie(convert(place, tmp_path / "movie.zarr", source_settings=SourceSettings(frames=part)))
    assert movie.times().tolist() == times
    assert movie.frame_time_s == step


@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"])
def test_sums_of_bins_are_exact(dtype: str, tmp_path: Path) -> None:
    most = np.iinfo(dtype).max if np.dtype(dtype).kind in "iu" else 2.0**20
    np.save(tmp_path / "movie.npy", np.full((1, 32, 32), most, dtype))
    source = open_source(tmp_path / "movie.npy", SourceSettings(bin=32))
    assert source.dtype.kind == np.dtype(dtype).kind
    assert int(source.read(0, 1)[0, 0, 0]) == int(most) * 1024


@pytest.mark.parametrize(("value", "fits"), [(2**40, True), (2**52, False)])
def test_sums_of_the_largest_whole_numbers_are_exact_or_refused(value: int, fits: bool, tmp_path: Path) -> None:
    np.save(tmp_path / "movie.npy", np.full((1, 8, 8), value, "u8"))
    source = open_source(tmp_path / "movie.npy", SourceSettings(bin=8))
    if fits:
        assert source.read(0, 1).item() == 64 * value
    else:
        with pytest.raises(SourceError, match="sums of the bins"):
            source.read(0, 1)


def test_files_of_a_part_are_those_that_hold_it(tmp_path: Path) -> None:
    for number in range(4):
        np.save(tmp_path / f"f_{number}.npy", FRAMES[3 * number : 3 * number + 3])
    source = open_source(tmp_path, SourceSettings(frames="2:10:2"))
    assert source.files_of(0, 1) == slice(0, 1)
    assert source.files_of(1, 4) == slice(1, 3)


@pytest.mark.parametrize(
    ("declared", "name"),
    [
        (SourceSettings(frames="5"), "frames"),
        (SourceSettings(frames="5:5"), "frames"),
        (SourceSettings(frames="0:13"), "frames"),
        (SourceSettings(frames="0:4:0"), "frames"),
        (SourceSettings(frames="a:b"), "frames"),
        (SourceSettings(roi="0:10"), "roi"),
        (SourceSettings(roi="0:10,0:27"), "roi"),
        (SourceSettings(roi="0:10,0:5,0:5"), "roi"),
        (SourceSettings(bin=22), "bin"),
        (SourceSettings(roi="0:3,0:26", bin=4), "bin"),
    ],
)
def test_parts_that_do_not_exist_are_named(declared: SourceSettings, name: str, tmp_path: Path) -> None:
    np.save(tmp_path / "movie.npy", FRAMES)
    with pytest.raises(SettingsError, match=rf"setting {name} \(SourceSettings\)"):
        open_source(tmp_path / "movie.npy", declared)


@examples(deadline=None)
@given(st.integers(1, 30), st.integers(-30, 30), st.integers(-30, 30), st.integers(1, 9))
def test_spans_are_those_of_python(length: int, start: int, stop: int, step: int) -> None:
    expected = list(range(length))[start:stop:step]
    within = all(-length <= end <= length for end in (start, stop))
    try:
        assert list(span(f"{start}:{stop}:{step}", length, "frames")) == expected
        assert within
    except SettingsError:
        assert not (expected and within)
