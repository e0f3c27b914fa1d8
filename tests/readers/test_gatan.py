"""Gatan's in-situ movies: a director with raw files, and folders by hour, minute and second."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from files_dm import in_situ, write_director, write_dm, write_seconds
from files_stamped import write_tvips

from tract_dask.errors import SettingsError, SourceError
from tract_dask.readers import files_named_now, is_movie_folder, open_source
from tract_dask.settings import SourceSettings

FRAMES = np.random.default_rng(0).integers(0, 120, (12, 6, 7)).astype("u2")
FRAME = FRAMES[0].nbytes
ENDS = (FRAME * 3 + 5, FRAME * 3 + 50, FRAME * 9)
"""Frames cross the ends of files; one spans three of them."""


def refused(path: Path | str, *words: str) -> None:
    with pytest.raises(SourceError) as caught:
        open_source(path)
    text = str(caught.value)
    assert all(word in text for word in words), text


@pytest.mark.parametrize("suffix", [".dm4", ".dm5"])
@pytest.mark.parametrize("dtype", ["u1", "u2", "i2", "f4"])
@pytest.mark.parametrize("ends", [(), ENDS])
def test_director_raw_file_and_folder_are_the_movie(
    suffix: str, dtype: str, ends: tuple[int, ...], tmp_path: Path
) -> None:
    frames = FRAMES.astype(dtype)
    ends = tuple(end * frames.itemsize // 2 for end in ends)
    path = write_director(tmp_path / f"movie 1.v2{suffix}", frames, ends)
    (tmp_path / "movie 1.v2.gtg").write_bytes(b"x")
    (tmp_path / "movie 1.v2.prz").write_bytes(b"x")
    (tmp_path / "log.txt").write_text("begun")
    assert is_movie_folder(tmp_path)
    for place in (path, path.with_suffix(".raw"), tmp_path, f"{tmp_path}/*{suffix}"):
        asked: list[Path] = []
        source = open_source(place, permit=asked.append)
        assert (source.shape, source.dtype) == ((12, 6, 7), frames.dtype)
        np.testing.assert_array_equal(source.read(0, 12), frames)
        for start, stop in ((0, 1), (3, 4), (2, 5), (8, 12), (11, 12)):
            np.testing.assert_array_equal(source.read(start, stop), frames[start:stop])
        assert source.metadata.pixel_size_pm == 10
        assert sum("not tested with a file from a camera" in note for note in source.metadata.notes) == (
            1 + (suffix == ".dm5")
        )
        parts = [path.with_suffix(f".raw_{k}" if k else ".raw") for k in range(len(ends) + 1)]
        assert set(source.files) == {path, *parts}
        assert set(asked) == set(source.files)
        np.testing.assert_array_equal(pickle.loads(pickle.dumps(source)).read(3, 5), frames[3:5])


def test_the_files_that_hold_some_frames(tmp_path: Path) -> None:
    source = open_source(write_director(tmp_path / "a.dm4", FRAMES, ENDS))
    names = [[file.name for file in source.files[source.files_of(k, k + 1)]] for k in (0, 3, 4, 8, 9)]
    assert names == [["a.raw"], ["a.raw", "a.raw_1", "a.raw_2"], ["a.raw_2"], ["a.raw_2"], ["a.raw_3"]]


def test_a_raw_file_is_read_as_it_is_declared(tmp_path: Path) -> None:
    path = write_director(tmp_path / "a.dm4", FRAMES, ENDS).with_suffix(".raw")
    declared = SourceSettings(raw_shape=(1, 6, 7), raw_dtype="int16")
    assert open_source(path, declared).shape == (1, 6, 7)
    with pytest.raises(SettingsError, match="no raw_shape"):
        open_source(path, SourceSettings(raw_dtype="int16"))
    path.with_suffix(".dm4").unlink()
    with pytest.raises(SettingsError, match="no raw_shape and raw_dtype"):
        open_source(path)


def test_missing_parts_and_frames(tmp_path: Path) -> None:
    path = write_director(tmp_path / "a.dm4", FRAMES, ENDS)
    last, middle, first = (path.with_suffix(end) for end in (".raw_3", ".raw_1", ".raw"))
    kept = last.read_bytes()
    last.unlink()
    refused(path, "fewer frames than were recorded", "for 12 frames", "9 whole frames", "--raw-shape 0,6,7")
    last.write_bytes(kept[:-1])
    refused(path, "11 whole frames")
    last.write_bytes(kept + kept[:FRAME] + b"x")
    source = open_source(path)
    assert source.shape[0] == 13
    assert "recorded with 12 frames; its files hold 13 and 1 bytes" in source.metadata.notes[1]
    middle.unlink()
    refused(path, "a file of the movie's frames is missing", "a.raw_1", "a.raw_2 without it")
    first.unlink()
    for file in (path.with_suffix(".raw_2"), last):
        file.unlink()
    source = open_source(path)
    assert source.shape == (1, 6, 7)
    assert "12 frames were recorded, but a.raw is not next to it" in source.metadata.notes[0]


def test_a_part_that_is_lost_before_it_is_read(tmp_path: Path) -> None:
    source = open_source(write_director(tmp_path / "a.dm4", FRAMES, ENDS))
    (tmp_path / "a.raw_3").unlink()
    np.testing.assert_array_equal(source.read(0, 9), FRAMES[:9])
    with pytest.raises(SourceError, match="No such file"):
        source.read(8, 10)
    (tmp_path / "a.raw_2").write_bytes(b"x")
    with pytest.raises(SourceError, match=r"a\.raw_2: the file ends before the frames"):
        source.read(0, 9)


def test_a_director_without_a_count(tmp_path: Path) -> None:
    path = write_director(tmp_path / "a.dm4", FRAMES, ENDS, n_frames=0)
    source = open_source(path)
    np.testing.assert_array_equal(source.read(0, 12), FRAMES)
    assert any("do not say how many frames" in note for note in source.metadata.notes)
    (tmp_path / "a.raw_3").write_bytes(b"x")
    source = open_source(path)
    assert source.shape == (1, 6, 7)
    assert "does not hold its frames" in source.metadata.notes[0]


def test_an_image_of_its_own_next_to_a_raw_file(tmp_path: Path) -> None:
    write_dm(tmp_path / "a.dm4", FRAMES, (), in_situ(12))
    assert open_source(tmp_path / "a.dm4").metadata.notes == ()
    (tmp_path / "a.raw").write_bytes(FRAMES.tobytes())
    source = open_source(tmp_path / "a.dm4")
    assert source.shape == (12, 6, 7)
    assert "it holds frames itself; a.raw next to it is not read" in source.metadata.notes[0]
    with pytest.raises(SettingsError, match="no raw_shape"):
        open_source(tmp_path / "a.raw")
    assert open_source(f"{write_director(tmp_path / 'b.dm4', FRAMES)}::1").shape == (1, 6, 7)


def test_a_folder_with_other_images_is_not_guessed_at(tmp_path: Path) -> None:
    write_director(tmp_path / "a.dm4", FRAMES)
    write_dm(tmp_path / "survey.dm4", FRAMES[0])
    refused(tmp_path, "several movies or images", "a.dm4, survey.dm4", "Name one of them")
    (tmp_path / "survey.dm4").unlink()
    write_director(tmp_path / "b.dm5", FRAMES)
    refused(tmp_path, "a.dm4, b.dm5")


@pytest.mark.parametrize("tags", [None, {"DataBar": {"Exposure Time (s)": 0.25}}])
def test_folders_by_hour_minute_and_second(tags: Any, tmp_path: Path) -> None:
    write_seconds(tmp_path / "run", FRAMES, [4, 4, 4], tags)
    asked: list[Path] = []
    source = open_source(tmp_path / "run", permit=asked.append)
    assert is_movie_folder(tmp_path / "run")
    np.testing.assert_array_equal(source.read(0, 12), FRAMES)
    assert (source.metadata.frame_time_s, source.metadata.pixel_size_pm) == (0.25, 10)
    assert "time" not in source.metadata.along_frames
    assert "not tested with a file from a camera" in source.metadata.notes[0]
    assert set(source.files) <= set(asked)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(source)).read(3, 9), FRAMES[3:9])
    assert files_named_now(source) is None
    assert open_source(tmp_path / "run/Hour_01/Minute_00").shape == (4, 6, 7)
    assert open_source(tmp_path / "run/Hour_00/Minute_59/Second_58").shape == (4, 6, 7)


def test_seconds_that_are_missing_show_in_the_times(tmp_path: Path) -> None:
    folder = write_seconds(tmp_path / "run", FRAMES, [3, 3, 0, 3, 3])
    known = open_source(folder).metadata
    assert known.frame_time_s == pytest.approx(1 / 3)
    np.testing.assert_allclose(known.along_frames["time"].values, [k / 3 + (k > 5) for k in range(12)], atol=1e-8)
    assert any("a gap of 1.33333 s after frame 5" in note for note in known.notes)


def test_a_tree_that_holds_nothing_or_what_the_permit_refuses(tmp_path: Path) -> None:
    (tmp_path / "a/Hour_00/Minute_00").mkdir(parents=True)
    refused(tmp_path / "a", "no frames")
    write_seconds(tmp_path / "outside", FRAMES, [12])
    (tmp_path / "b").mkdir()
    (tmp_path / "b/Hour_00").symlink_to(tmp_path / "outside/Hour_00")

    def permit(path: Path) -> None:
        if "outside" in str(path):
            raise SourceError("may not be opened", "elsewhere", remedy="-")

    with pytest.raises(SourceError, match="may not be opened"):
        open_source(tmp_path / "b", permit=permit)


@pytest.mark.parametrize(
    "names", [("movie.DM4", "movie.RAW", "movie.RAW_1"), ("movie.DM4", "movie.raw", "movie.Raw_1")]
)
def test_names_in_capitals(names: tuple[str, ...], tmp_path: Path) -> None:
    write_director(tmp_path / "movie.dm4", FRAMES, (FRAME * 3 + 5,))
    for name, was in zip(names, ("movie.dm4", "movie.raw", "movie.raw_1"), strict=True):
        (tmp_path / was).rename(tmp_path / name)
    for place in (tmp_path / names[0], tmp_path / names[1], tmp_path):
        np.testing.assert_array_equal(open_source(place).read(0, 12), FRAMES)


@pytest.mark.parametrize("writer", ["director", "tvips"])
def test_an_empty_file_at_the_end_holds_no_frames(writer: str, tmp_path: Path) -> None:
    if writer == "director":
        path = write_director(tmp_path / "movie.dm4", FRAMES, ENDS)
        (tmp_path / f"movie.raw_{len(ENDS) + 1}").touch()
    else:
        path = write_tvips(tmp_path / "movie.tvips", FRAMES, per_file=5)
        (tmp_path / "movie_003.tvips").touch()
    source = open_source(path)
    np.testing.assert_array_equal(source.read(0, len(FRAMES)), FRAMES)
    assert all(file.stat().st_size for file in source.files)
