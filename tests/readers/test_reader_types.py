"""Every pixel type that opens runs to the end, with the numbers that float64 gives."""

from __future__ import annotations

from pathlib import Path

import h5py
import mrcfile
import numpy as np
import pytest
import tifffile
from conftest import Scene
from distributed import Client

from tract_dask.errors import SourceError
from tract_dask.readers import open_source
from tract_dask.run import pipeline
from tract_dask.settings import RunSettings, SourceSettings
from tract_dask.stages.convert.stage import convert
from tract_dask.store.movie import open_movie
from tract_dask.store.results import open_results

SMALL = np.random.default_rng(0).integers(0, 120, (5, 24, 32))
WHOLE = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", ">u2", ">i2", ">u4", ">i4", ">u8", ">i8", "?")
BROKEN = ("f2", "f4", "f8", ">f2", ">f4", ">f8")
READ_AS = {"b1": "u1", "f2": "f4"}


def frames(dtype: str) -> np.ndarray:
    if dtype == "?":
        return SMALL > 60
    return (SMALL / 8 if "f" in dtype else SMALL - 60 * ("i" in dtype)).astype(dtype)


def write(path: Path, pixels: np.ndarray) -> SourceSettings:
    suffix = path.suffix
    if suffix == ".npy":
        np.save(path, np.asfortranarray(pixels) if "fortran" in path.stem else pixels)
    elif suffix == ".h5":
        with h5py.File(path, "w") as file:
            file.create_dataset("a", data=pixels, chunks=(1, 24, 32), compression="gzip")
    elif suffix == ".tif":
        codec = {"compression": "zlib"} if "zlib" in path.stem else {}
        order = ">" if pixels.dtype.str[0] == ">" else "<"
        tifffile.imwrite(path, pixels, photometric="minisblack", byteorder=order, **codec)
    elif suffix == ".mrc":
        with mrcfile.new(path, data=pixels):
            pass
    else:
        path.write_bytes(pixels.tobytes())
        return SourceSettings(raw_shape=(0, *pixels.shape[1:]), raw_dtype=pixels.dtype.str)
    return SourceSettings()


CASES = [(name, dtype) for name in ("c.npy", "fortran.npy", "a.h5", "a.raw") for dtype in WHOLE + BROKEN]
CASES += [
    (name, dtype) for name in ("a.tif", "zlib.tif") for dtype in WHOLE + BROKEN if dtype != "?" or name == "a.tif"
]
CASES += [("a.mrc", dtype) for dtype in ("i1", "i2", "u2", "f2", "f4", ">i2", ">f4")]


@pytest.mark.parametrize(("name", "dtype"), CASES)
def test_every_type_is_read_as_the_numbers_that_it_holds(name: str, dtype: str, tmp_path: Path) -> None:
    pixels = frames(dtype)
    source = open_source(tmp_path / name, write(tmp_path / name, pixels))
    assert source.dtype == np.dtype(READ_AS.get(pixels.dtype.str[1:], pixels.dtype)).newbyteorder("=")
    for start, stop in ((0, 5), (2, 3), (3, 5)):
        read = source.read(start, stop)
        assert read.dtype == source.dtype
        np.testing.assert_array_equal(read.astype("f8"), pixels[start:stop].astype("f8"))
        into = np.empty_like(read)
        source.read_into(start, into)
        np.testing.assert_array_equal(into, read)


@pytest.mark.parametrize("dtype", WHOLE + BROKEN)
def test_every_type_is_converted(dtype: str, tmp_path: Path) -> None:
    pixels = frames(dtype)
    np.save(tmp_path / "a.npy", pixels)
    movie = open_movie(convert(tmp_path / "a.npy", tmp_path / "movie.zarr"))
    np.testing.assert_array_equal(movie.read(0, 5).astype("f8"), pixels.astype("f8"))
    np.testing.assert_allclose(movie.statistics()["frame_mean"], pixels.astype("f8").mean((1, 2)), rtol=1e-6, atol=1e-6)


def test_whole_runs_find_the_same_columns_in_every_type(client: Client, tmp_path: Path) -> None:
    counts = Scene(n_frames=4, shape=(128, 110), spacing=28).counts()
    found = {}
    for dtype in ("f8", "f2", ">i8"):
        folder = tmp_path / dtype.strip(">")
        folder.mkdir()
        write(folder / "a.h5", counts.astype(dtype))
        pipeline.run(folder / "a.h5", folder / "out", RunSettings(), client=client, report=False)
        found[dtype] = open_results(folder / "out/results.zarr").load()
    for results in found.values():
        assert results.sizes["column_id"] >= 4
        np.testing.assert_allclose(results["fit"], found["f8"]["fit"], rtol=1e-5, atol=1e-5)
        np.testing.assert_array_equal(results["status"], found["f8"]["status"])


def test_halves_are_widened_exactly(tmp_path: Path) -> None:
    every = np.arange(1 << 16, dtype="u2").view("f2").reshape(4, 128, 128)
    np.save(tmp_path / "a.npy", every)
    np.testing.assert_array_equal(open_source(tmp_path / "a.npy").read(0, 4), every.astype("f4"))


def test_true_is_what_is_not_zero(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", SMALL > 60)
    data = bytearray((tmp_path / "a.npy").read_bytes())
    data[-SMALL.size :] = bytes(2 * (SMALL > 60).astype("u1").ravel())
    (tmp_path / "a.npy").write_bytes(data)
    np.testing.assert_array_equal(open_source(tmp_path / "a.npy").read(0, 5), SMALL > 60)


@pytest.mark.parametrize(
    ("dtype", "word"),
    [(np.longdouble, "extended"), ("c8", "complex64"), ("c16", "complex128"), ("U3", "<U3"), ("M8[s]", "datetime64")],
)
def test_other_types_are_refused_by_name(dtype: str, word: str, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((2, 8, 8), dtype))
    with pytest.raises(SourceError, match=f"cannot be used as intensities.*got .*{word}"):
        open_source(tmp_path / "a.npy")


@pytest.mark.parametrize(
    ("dtype", "value"), [("i8", 2**53 + 1), ("i8", -(2**53) - 1), ("u8", 2**64 - 1), (">i8", -(2**63))]
)
@pytest.mark.parametrize("name", ["a.npy", "fortran.npy", "a.h5", "zlib.tif"])
def test_whole_numbers_that_floats_would_round_are_refused(dtype: str, value: int, name: str, tmp_path: Path) -> None:
    pixels = np.zeros((3, 24, 32), dtype)
    pixels[1, 0, 0] = 2**53
    write(tmp_path / name, pixels)
    np.testing.assert_array_equal(open_source(tmp_path / name).read(0, 3), pixels)
    pixels[2, 5, 5] = value
    (tmp_path / name).unlink()
    write(tmp_path / name, pixels)
    source = open_source(tmp_path / name)
    np.testing.assert_array_equal(source.read(0, 2), pixels[:2])
    for attempt in (lambda: source.read(2, 3), lambda: source.read_into(1, np.empty((2, 24, 32), source.dtype))):
        with pytest.raises(SourceError, match=r"float64 cannot tell apart.*9,007,199,254,740,992"):
            attempt()
