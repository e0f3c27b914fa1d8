"""Files written from public layouts, by writers that know no reader, give back what was written into them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import files_made as made
import numpy as np
import pytest

from tract_dask.errors import SourceError
from tract_dask.readers import open_source

N_FRAMES, N_Y, N_X = 7, 24, 37
PIXEL_NM = 0.0125
STAMPS = 1_700_000_000 + np.array([0, 0.125, 0.25, 0.375, 0.625, 0.75, 0.875])  # a frame was lost after the fourth


def movie(dtype: str = "u2", shape: tuple[int, ...] = (N_FRAMES, N_Y, N_X), top: int | None = None) -> np.ndarray:
    """Frames that use the whole range of their type, each pixel different from its neighbours."""
    rng = np.random.default_rng(len(dtype) + shape[-1])
    if np.dtype(dtype).kind == "f":
        return rng.normal(scale=100, size=shape).astype(dtype)
    limits = np.iinfo(dtype)
    return rng.integers(limits.min, limits.max if top is None else top, shape, dtype, endpoint=True)


def assert_gives(path: Path, frames: np.ndarray, pixel_pm: float | None = None) -> Any:
    """Check shape, type, pixels of all frames and of some, and pixel size; return what the source says of itself."""
    source = open_source(path)
    assert source.shape == frames.shape
    assert source.dtype == frames.dtype
    for start, stop in ((0, len(frames)), (0, 1), (2, 4), (len(frames) - 1, len(frames))):
        np.testing.assert_array_equal(source.read(start, stop), frames[start:stop])
    assert source.metadata.pixel_size_pm == (None if pixel_pm is None else pytest.approx(pixel_pm, rel=1e-12))
    metadata = source.metadata
    source.close()
    return metadata


def assert_times(metadata: Any, stamps: np.ndarray, tolerance: float = 1e-6) -> None:
    """Check the frames' times from the first on, and the median frame time."""
    times = np.asarray(metadata.along_frames["time"].values)
    np.testing.assert_allclose(times - times[0], stamps - stamps[0], atol=tolerance)
    assert metadata.frame_time_s == pytest.approx(float(np.median(np.diff(stamps))), abs=tolerance)


def said(path: Path) -> str:
    """What the source says of a damaged movie: its error, or its notes."""
    try:
        return " ".join(open_source(path).metadata.notes)
    except SourceError as error:
        return str(error)


def part_in_a_frame() -> int:
    """Pixels of a raw file that end within a frame: two and a bit."""
    return 2 * N_Y * N_X + 5 * N_X + 3


DIRECTORS = {"dm4": made.write_gatan_dm4, "dm5": made.write_gatan_dm5}


@pytest.mark.parametrize("dtype", ["u1", "u2", "i2", "f4"])
@pytest.mark.parametrize("director", DIRECTORS)
def test_gatan_frames_run_across_raw_files(director: str, dtype: str, tmp_path: Path) -> None:
    frames = movie(dtype)
    path = DIRECTORS[director](tmp_path, frames, PIXEL_NM, part_in_a_frame())
    assert len(list(tmp_path.glob("insitu.raw*"))) == 4
    assert_gives(path, frames, PIXEL_NM * 1000)


@pytest.mark.parametrize("director", DIRECTORS)
def test_gatan_frame_in_more_than_two_raw_files(director: str, tmp_path: Path) -> None:
    frames = movie()
    path = DIRECTORS[director](tmp_path, frames, PIXEL_NM, N_Y * N_X // 3)
    assert (tmp_path / "insitu.raw_10").exists()  # files count as numbers: 10 comes after 9
    assert_gives(path, frames, PIXEL_NM * 1000)


@pytest.mark.parametrize("director", DIRECTORS)
def test_gatan_movie_in_one_raw_file(director: str, tmp_path: Path) -> None:
    frames = movie()
    path = DIRECTORS[director](tmp_path, frames, PIXEL_NM, frames.size)
    assert_gives(path, frames, PIXEL_NM * 1000)


def test_gatan_director_without_a_thumbnail(tmp_path: Path) -> None:
    frames = movie()
    path = made.write_gatan_dm4(tmp_path, frames, PIXEL_NM, part_in_a_frame(), thumbnail=False)
    assert_gives(path, frames, PIXEL_NM * 1000)


@pytest.mark.parametrize("director", DIRECTORS)
def test_gatan_raw_file_that_is_missing_is_said(director: str, tmp_path: Path) -> None:
    path = DIRECTORS[director](tmp_path, movie(), PIXEL_NM, part_in_a_frame())
    (tmp_path / "insitu.raw_1").unlink()
    assert "raw_1" in said(path)


@pytest.mark.parametrize("first_second", [0, 58])
def test_gatan_tree_of_seconds(first_second: int, tmp_path: Path) -> None:
    frames = movie(shape=(9, N_Y, N_X))
    root = made.write_gatan_tree(tmp_path, frames, PIXEL_NM, per_second=3, first_second=first_second)
    assert len(list(root.rglob("Second_*"))) == 3
    assert_gives(root, frames, PIXEL_NM * 1000)


def test_gatan_tree_orders_frames_beyond_ten(tmp_path: Path) -> None:
    frames = movie(shape=(24, 8, 9))
    root = made.write_gatan_tree(tmp_path, frames, PIXEL_NM, per_second=12)
    assert_gives(root, frames, PIXEL_NM * 1000)


@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"])
@pytest.mark.parametrize("suffix", ["dm4", "dm5"])
@pytest.mark.parametrize("n_frames", [1, N_FRAMES])
def test_dm_images_and_stacks(suffix: str, dtype: str, n_frames: int, tmp_path: Path) -> None:
    frames = movie(dtype, (n_frames, N_Y, N_X))
    write = made.write_dm4 if suffix == "dm4" else made.write_dm5
    path = write(tmp_path / f"alone.{suffix}", frames if n_frames > 1 else frames[0], PIXEL_NM)
    metadata = assert_gives(path, frames, PIXEL_NM * 1000)
    if n_frames > 1:
        assert metadata.frame_time_s == pytest.approx(0.05, rel=1e-6)


@pytest.mark.parametrize("said_bytes", [0, 12])  # version 1 need not say how long an image header is
@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_tvips_version_1_in_several_files(dtype: str, said_bytes: int, tmp_path: Path) -> None:
    frames = movie(dtype)
    path = made.write_tvips(tmp_path, frames, STAMPS.tolist(), per_file=3, said_bytes=said_bytes)
    assert len(list(tmp_path.glob("*.tvips"))) == 3
    assert_times(assert_gives(path, frames), STAMPS, tolerance=1e-3)


@pytest.mark.parametrize("dtype", ["u1", "u2"])
@pytest.mark.parametrize("version", [3, 4, 5])
def test_streampix_versions(version: int, dtype: str, tmp_path: Path) -> None:
    frames = movie(dtype)
    path = made.write_seq(tmp_path, frames, STAMPS.tolist(), version)
    assert_times(assert_gives(path, frames), STAMPS, tolerance=1e-6 if version == 5 else 1e-3)


@pytest.mark.parametrize(("bits", "dtype"), [(4, "u1"), (12, "u2")])
@pytest.mark.parametrize("width", [36, 37])
def test_packed_tiff(bits: int, dtype: str, width: int, tmp_path: Path) -> None:
    frames = movie(dtype, (N_FRAMES, N_Y, width), top=2**bits - 1)
    assert_gives(made.write_packed_tiff(tmp_path, frames, bits), frames)


@pytest.mark.parametrize("width", [36, 37])
def test_mrc_of_four_bits(width: int, tmp_path: Path) -> None:
    frames = movie("u1", (N_FRAMES, N_Y, width), top=15)
    assert_gives(made.write_mrc_4bit(tmp_path, frames, 0.125), frames, pixel_pm=12.5)


@pytest.mark.parametrize("final_image", [False, True])
@pytest.mark.parametrize("compression", [65000, 65001, 65002])
def test_eer_raw_frames(compression: int, final_image: bool, tmp_path: Path) -> None:
    electrons = (np.random.default_rng(5).random((N_FRAMES, 64, 64)) < 0.004).astype(np.uint8)
    electrons[1] = 0  # a frame without electrons
    electrons[2, 0, 0] = electrons[2, -1, -1] = 1  # and electrons in the corners
    path = made.write_eer(tmp_path, electrons, 0.028, compression, final_image)
    source = open_source(f"{path}::1")  # each readout is a frame
    assert source.shape == electrons.shape
    assert source.dtype.kind == "u"
    np.testing.assert_array_equal(source.read(0, N_FRAMES), electrons)
    assert source.metadata.frame_time_s == pytest.approx(0.004)


@pytest.mark.parametrize(("bits", "dtype"), [(1, "u1"), (6, "u1"), (12, "u2"), (24, "u4")])
def test_merlin_raw_of_one_chip(bits: int, dtype: str, tmp_path: Path) -> None:
    frames = movie(dtype, (4, 256, 256), top=2**bits - 1)
    assert_times(assert_gives(made.write_mib(tmp_path, frames, bits, STAMPS[:4].tolist()), frames), STAMPS[:4])


@pytest.mark.parametrize(("bits", "dtype"), [(1, "u1"), (6, "u1"), (12, "u2")])
def test_merlin_raw_of_a_quad(bits: int, dtype: str, tmp_path: Path) -> None:
    frames = movie(dtype, (4, 512, 512), top=2**bits - 1)
    assert_times(assert_gives(made.write_mib(tmp_path, frames, bits, STAMPS[:4].tolist()), frames), STAMPS[:4])


@pytest.mark.parametrize("dtype", ["i2", "u2"])
def test_velox_camera_movie(dtype: str, tmp_path: Path) -> None:
    frames = movie(dtype)
    path = made.write_velox(tmp_path, frames, PIXEL_NM * 1e-9, STAMPS.tolist(), exposure_s=0.1)
    assert_times(assert_gives(path, frames, PIXEL_NM * 1000), STAMPS)


@pytest.mark.parametrize("dtype", ["u1", "u2", "u4"])
def test_dectris_master(dtype: str, tmp_path: Path) -> None:
    frames = movie(dtype, (N_FRAMES, 33, 37))
    metadata = assert_gives(made.write_dectris(tmp_path, frames, frame_time_s=0.002, per_file=3), frames)
    assert metadata.frame_time_s == pytest.approx(0.002)


WHOLE: dict[str, Callable[[Path], Path]] = {
    "tvips": lambda folder: made.write_tvips(folder, movie(), STAMPS.tolist(), per_file=3),
    "dectris": lambda folder: made.write_dectris(folder, movie(), 0.002, per_file=3),
    "dm4": lambda folder: made.write_gatan_dm4(folder, movie(), PIXEL_NM, part_in_a_frame()),
    "dm5": lambda folder: made.write_gatan_dm5(folder, movie(), PIXEL_NM, part_in_a_frame()),
}


@pytest.mark.parametrize("kind", WHOLE)
def test_movies_of_several_files_move_together(kind: str, tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    path = WHOLE[kind](tmp_path / "here")
    moved = shutil.move(tmp_path / "here", tmp_path / "a [b] folder")
    assert_gives(Path(moved) / path.name, movie(), PIXEL_NM * 1000 if kind.startswith("dm") else None)
