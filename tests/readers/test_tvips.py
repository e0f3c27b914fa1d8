"""TVIPS movies: parts, what the header of each frame says, and parts that are missing."""

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from files_stamped import tvips_frame, tvips_series, write_tvips

from tract_dask.errors import SourceError
from tract_dask.readers import open_source
from tract_dask.stages.convert.stage import convert

FRAMES = np.random.default_rng(0).integers(0, 60_000, (7, 12, 16)).astype("u2")


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_both_versions(version: int, dtype: str, tmp_path: Path) -> None:
    frames = FRAMES.astype(dtype)
    source = open_source(write_tvips(tmp_path / "a.tvips", frames, version=version))
    assert (source.shape, source.dtype, source.format) == (FRAMES.shape, dtype, f"TVIPS {version}")
    np.testing.assert_array_equal(source.read(0, 7), frames)
    assert source.metadata.frame_time_s == 0.04
    assert source.metadata.pixel_size_pm == 3000
    assert any("not tested with a file from a camera" in note for note in source.metadata.notes) == (version == 1)


@pytest.mark.parametrize("per_file", [1, 3])
def test_parts_are_one_movie(per_file: int, tmp_path: Path) -> None:
    first = write_tvips(tmp_path / "in situ [1].tvips", FRAMES, per_file=per_file)
    write_tvips(tmp_path / "in situ [1]_b.tvips", FRAMES, per_file=1)
    asked: list[Path] = []
    source = pickle.loads(pickle.dumps(open_source(first, permit=asked.append)))
    parts = tuple(first.with_name(f"in situ [1]_{k:03d}.tvips") for k in range(-(-7 // per_file)))
    assert source.files == parts
    assert set(asked) == set(parts)
    for start in range(7):
        np.testing.assert_array_equal(source.read(start, 7), FRAMES[start:])
    into = np.empty((4, 12, 16), "u2")
    source.read_into(2, into)
    np.testing.assert_array_equal(into, FRAMES[2:6])
    assert source.metadata.along_frames["time"].values.tolist() == pytest.approx([0.04 * k for k in range(7)])


def test_a_folder_is_its_first_part(tmp_path: Path) -> None:
    first = write_tvips(tmp_path / "a.tvips", FRAMES, per_file=3)
    for place in (tmp_path, f"{tmp_path}/a_*.tvips"):
        source = open_source(place)
        assert len(source.files) == 3
        np.testing.assert_array_equal(source.read(0, 7), FRAMES)
    with pytest.raises(SourceError, match=r"later part of a movie.*Open .*a_000\.tvips"):
        open_source(first.with_name("a_001.tvips"))


def test_missing_parts(tmp_path: Path) -> None:
    first = write_tvips(tmp_path / "a.tvips", FRAMES, per_file=2)
    first.with_name("a_002.tvips").unlink()
    with pytest.raises(SourceError, match=r"a_002\.tvips: a part of the movie is missing.*up to a_003"):
        open_source(first)
    first.with_name("a_003.tvips").unlink()
    assert open_source(first).shape[0] == 4
    first.unlink()
    with pytest.raises(SourceError, match=r"Open .*a_000\.tvips"):
        open_source(tmp_path)


def test_parts_of_two_movies_are_noted(tmp_path: Path) -> None:
    first = write_tvips(tmp_path / "a.tvips", FRAMES, per_file=3)
    write_tvips(tmp_path / "b.tvips", FRAMES[:4], per_file=2).unlink()
    first.with_name("b_001.tvips").replace(first.with_name("a_003.tvips"))
    assert any("camera's number of frame 7 is 2 after 6" in note for note in open_source(first).metadata.notes)


def test_what_the_frames_say(tmp_path: Path) -> None:
    stored = b"".join(
        tvips_frame(FRAMES[k], k, 40 * k, values=(12.5, -3.0, 600.0 + k, 700.0, 2.0, 1.5 + k)) for k in range(4)
    )
    path = tmp_path / "a.tvips"
    path.write_bytes(tvips_series(FRAMES) + stored)
    along = open_source(path).metadata.along_frames
    assert {name: (found.units, found.values.tolist()) for name, found in along.items()} == {
        "time": ("s", [0, 0.04, 0.08, 0.12]),
        "stage_tilt": ("deg", [12.5] * 4),
        "stage_tilt_beta": ("deg", [-3.0] * 4),
        "temperature": ("degC", [600, 601, 602, 603]),
        "temperature_set": ("degC", [700] * 4),
        "bias": ("V", [1.5, 2.5, 3.5, 4.5]),
    }


def test_a_short_header_says_less(tmp_path: Path) -> None:
    source = open_source(write_tvips(tmp_path / "a.tvips", FRAMES, header=60, values=(5.0, 0, 300.0, 310.0, 0, 9.0)))
    np.testing.assert_array_equal(source.read(0, 7), FRAMES)
    assert set(source.metadata.along_frames) == {"time", "stage_tilt", "temperature", "temperature_set"}
    assert set(open_source(write_tvips(tmp_path / "b.tvips", FRAMES)).metadata.along_frames) == {"time"}


@pytest.mark.parametrize(
    ("options", "pixel_pm", "note"),
    [
        ({"pixel_nm": 2}, 2000.0, None),
        ({"pixel_nm": 15_600, "magnification": 500_000}, 31.2, None),
        ({"pixel_nm": 15_600}, None, "camera's pixel"),
        ({"pixel_nm": 31_200, "magnification": 500_000, "binning": 2}, None, "camera's pixel"),
        ({"pixel_nm": 2, "mode": 2}, None, "diffraction mode, with pixels in 1/nm"),
        ({"pixel_nm": 0}, None, None),
    ],
)
def test_pixel_sizes(options: dict[str, Any], pixel_pm: float | None, note: str | None, tmp_path: Path) -> None:
    known = open_source(write_tvips(tmp_path / "a.tvips", FRAMES, **options)).metadata
    assert known.pixel_size_pm == pytest.approx(pixel_pm)
    assert any(note in text for text in known.notes) if note else not known.notes


def test_damage(tmp_path: Path) -> None:
    path = write_tvips(tmp_path / "a.tvips", FRAMES)
    whole = path.read_bytes()
    path.write_bytes(whole[:-10])
    source = open_source(path)
    assert source.shape[0] == 6
    assert "bytes after its last whole frame are not read" in source.metadata.notes[0]
    cases = {
        "in its header": whole[:200],
        "in frame 0": whole[:300],
        "not that of a TVIPS movie": bytes(len(whole)),
        "header of the series is impossible": whole[:16] + (12).to_bytes(4, "little") + whole[20:],
        "has no frames": whole[:8] + bytes(4) + whole[12:],
    }
    for words, data in cases.items():
        path.write_bytes(data)
        with pytest.raises(SourceError, match=words):
            open_source(path)
    first = write_tvips(tmp_path / "b.tvips", FRAMES, per_file=3)
    middle = first.with_name("b_001.tvips")
    middle.write_bytes(middle.read_bytes()[:-10])
    with pytest.raises(SourceError, match=r"b_001\.tvips: the file ends in frame 2 of this part"):
        open_source(first)


def test_a_damaged_size_that_makes_billions_of_frames(tmp_path: Path) -> None:
    path = write_tvips(tmp_path / "a.tvips", FRAMES[:, :1, :1].astype("u1"), header=12)
    os.truncate(path, 2**31)  # a sparse file
    with pytest.raises(SourceError, match=r"number of frames is impossible.*165,\d{3},\d{3} of a few bytes"):
        open_source(path)


def test_a_converted_movie_opens_with_what_its_frames_said(tmp_path: Path) -> None:
    frames = np.arange(5 * 64 * 64, dtype="u2").reshape(5, 64, 64)
    place = write_tvips(tmp_path / "a.tvips", frames, values=(1, 2, 300.0, 310.0, 0, 5.0))
    again = open_source(convert(place, tmp_path / "movie.zarr"))
    known, along = open_source(place).metadata, again.metadata.along_frames
    assert set(along) == set(known.along_frames)
    for name, of in known.along_frames.items():
        assert along[name].units == of.units
        np.testing.assert_allclose(along[name].values, of.values, atol=1e-12)
