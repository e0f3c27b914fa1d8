"""StreamPix sequences: versions, time stamps, references beside them, and what is refused by name."""

import os
import pickle
from pathlib import Path
from typing import Any

import mrcfile
import numpy as np
import pytest
from files_stamped import write_seq

from tract_dask.errors import SourceError
from tract_dask.progress import Warned
from tract_dask.readers import open_source
from tract_dask.readers.times import has_stamps, timed
from tract_dask.run.inspect import describe
from tract_dask.settings.run import MetadataSettings, RunSettings, SourceSettings
from tract_dask.stages.convert.stage import convert
from tract_dask.store.movie import open_movie

FRAMES = np.random.default_rng(0).integers(0, 250, (6, 12, 16)).astype("u2")


@pytest.mark.parametrize("version", [3, 4, 5, 6])
@pytest.mark.parametrize(("dtype", "bits"), [("u1", 8), ("u2", 10), ("u2", 12), ("u2", 16)])
def test_versions_and_depths(version: int, dtype: str, bits: int, tmp_path: Path) -> None:
    frames = FRAMES.astype(dtype)
    source = open_source(write_seq(tmp_path / "a.seq", frames, version=version, bits=bits))
    source = pickle.loads(pickle.dumps(source))
    assert (source.shape, source.dtype, source.metadata.notes) == (FRAMES.shape, dtype, ())
    np.testing.assert_array_equal(source.read(0, 6), frames)
    into = np.empty((3, 12, 16), dtype)
    source.read_into(2, into)
    np.testing.assert_array_equal(into, frames[2:5])
    assert source.metadata.frame_time_s == 0.04


def test_times_to_the_microsecond_and_a_gap(tmp_path: Path) -> None:
    start = 1_700_000_000_000_000
    steps = np.array([0, 33_001, 66_002, 99_003, 333_003, 366_004])
    known = open_source(write_seq(tmp_path / "a.seq", FRAMES, stamps_us=(start + steps).tolist())).metadata
    assert (known.frame_time_s, known.start_s) == (0.033001, 1_700_000_000)
    assert known.along_frames["time"].values.tolist() == (steps / 1e6).tolist()
    assert "gap of 0.234 s after frame 3" in known.notes[0]


def test_without_times_the_set_rate_is_taken(tmp_path: Path) -> None:
    for options in ({"stamps_us": [0] * 6}, {"padding": -8}):
        known = open_source(write_seq(tmp_path / "a.seq", FRAMES, **options)).metadata
        assert (known.frame_time_s, dict(known.along_frames)) == (0.04, {})
        assert "that of the set rate, 25 frames a second" in known.notes[0]


@pytest.mark.parametrize(("said", "there"), [(4, 6), (100, 6)])
def test_frames_are_counted_by_size(said: int, there: int, tmp_path: Path) -> None:
    source = open_source(write_seq(tmp_path / "a.seq", FRAMES, said=said))
    assert source.shape[0] == there
    assert source.metadata.notes == (f"a.seq: the file holds {there} frames, its header says {said}; {there} are read",)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"compression": 1}, "the frames are compressed"),
        ({"image_format": 200}, "the pixels are colours"),
        ({"bits": 24}, "colours or numbers of another width"),
        ({"bits": 8}, "packed or padded"),
        ({"version": 2}, "not that of a StreamPix sequence"),
        ({"padding": -9}, "frames overlap"),
    ],
)
def test_what_is_refused(options: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=words) as caught:
        open_source(write_seq(tmp_path / "a.seq", FRAMES, **options))
    assert caught.value.remedy


def test_references_beside_it(tmp_path: Path) -> None:
    path = write_seq(tmp_path / "movie.1.seq", FRAMES)
    assert not open_source(path).metadata.references
    for name in ("movie.1.seq.dark.mrc", "movie.1.gain.mrc", "movie.gain.mrc"):
        with mrcfile.new(tmp_path / name) as file:
            file.set_data(np.ones((12, 16), "f4"))
    for name in ("movie.1.metadata", "movie.1.seq.Config.Metadata.xml"):
        (tmp_path / name).write_text("<x/>")
    expected = {
        "dark": tmp_path / "movie.1.seq.dark.mrc",
        "gain": tmp_path / "movie.1.gain.mrc",
        "defects": tmp_path / "movie.1.seq.Config.Metadata.xml",
        "metadata": tmp_path / "movie.1.metadata",
    }
    assert open_source(path).metadata.references == expected
    (tmp_path / "movie.gain.mrc").unlink()
    folder = open_source(tmp_path)
    assert folder.files == (path,)
    np.testing.assert_array_equal(folder.read(0, 6), FRAMES)


def test_damage(tmp_path: Path) -> None:
    path = write_seq(tmp_path / "a.seq", FRAMES, version=3)
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])  # without the filling of the last frame
    assert open_source(path).shape[0] == 6
    path.write_bytes(whole[:-120])
    source = open_source(path)
    assert source.shape[0] == 5
    assert len(source.metadata.notes) == 2
    cases = {
        "in its header": whole[:1000],
        "in its first frame": whole[:1100],
        "not that of a StreamPix": bytes(len(whole)),
        "has no frames": whole[:548] + bytes(4) + whole[552:],
    }
    for words, data in cases.items():
        path.write_bytes(data)
        with pytest.raises(SourceError, match=words):
            open_source(path)


def test_a_damaged_stride_that_makes_billions_of_frames(tmp_path: Path) -> None:
    path = write_seq(tmp_path / "a.seq", FRAMES[:, :1, :1].astype("u1"), padding=0)
    os.truncate(path, 2**31)  # a sparse file
    with pytest.raises(SourceError, match="number of frames is impossible"):
        open_source(path)


STAMPS_US = [0, 33_002, 65_798, 98_800, 1_135_389, 1_168_943]
"""Times of six frames that come unevenly; some were lost after the fourth."""


@pytest.mark.parametrize(
    ("frames", "times", "step"),
    [
        (None, [0, 0.033002, 0.065798, 0.0988, 1.135389, 1.168943], 0.033002),
        ("0:4", [0, 0.033002, 0.065798, 0.0988], 0.033002),
        ("1:3", [0, 0.032796], 0.032796),
        ("::3", [0, 0.0988], 0.0988),
        ("1::3", [0, 1.102387], 1.102387),
        ("::2", [0, 0.065798, 1.135389], 0.5676945),
    ],
)
def test_a_part_has_the_times_of_its_stamps(
    frames: str | None, times: list[float], step: float, tmp_path: Path
) -> None:
    place, declared = write_seq(tmp_path / "a.seq", FRAMES, stamps_us=STAMPS_US), SourceSettings(frames=frames)
    known = open_source(place, declared).metadata
    np.testing.assert_allclose(known.along_frames["time"].values, times, atol=1e-9)
    assert known.frame_time_s == pytest.approx(step)
    movie = open_movie(convert(place, tmp_path / "movie.zarr", source_settings=declared))
    np.testing.assert_allclose(movie.times(), times, atol=1e-9)


def test_a_frame_time_of_the_user_in_place_of_stamps_is_said(tmp_path: Path) -> None:
    place = write_seq(tmp_path / "a.seq", FRAMES, stamps_us=STAMPS_US)
    said, every_second = MetadataSettings(frame_time_s=0.03), SourceSettings(frames="::2")
    known = open_source(place, every_second, said).metadata
    assert known.frame_time_s == 0.06
    assert not any("the times of frames show it" in note for note in known.notes)
    (note,) = [note for note in known.notes if "as you say" in note]
    assert "0.06 s apart, as you say" in note
    assert "0.5676945 s apart, are not used" in note
    assert "time of frames, s" not in describe(place, RunSettings(source=every_second, metadata=said))
    assert describe(place)["time of frames, s"] == "0 to 1.16894"
    events: list[Any] = []
    movie = open_movie(
        convert(place, tmp_path / "m.zarr", source_settings=every_second, metadata=said, on_event=events.append)
    )
    np.testing.assert_allclose(movie.times(), [0, 0.06, 0.12])
    part = describe(tmp_path / "m.zarr")["part of the source"]
    assert part == "from frame 0 on, every 2 frames; from row 0 and column 0 on"
    assert [event.message for event in events if isinstance(event, Warned)] == list(known.notes)


def test_stamps_of_a_fast_camera_are_used_though_they_are_whole_nanoseconds() -> None:
    stamps = 1.23456789e-5 * np.array([0, 1, 2, 3, 1000])
    known = timed(stamps, "a")
    assert known.frame_time_s == pytest.approx(1.23456789e-5, rel=1e-8)
    assert has_stamps(known)
