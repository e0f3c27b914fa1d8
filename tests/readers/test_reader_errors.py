"""Every bad input ends, when it is opened, with a paragraph that names file, place, expected, got and remedy."""

from __future__ import annotations

import logging
import os
import struct
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import mrcfile
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from test_readers import N_FRAMES, N_X, N_Y, UNDECLARED, movie

from tract_dask.errors import SettingsError, SourceError, TractError
from tract_dask.readers import READERS, Reader, open_source
from tract_dask.settings import SourceSettings


def fails(path: Path | str, *words: str, declared: SourceSettings = UNDECLARED) -> None:
    """Check that opening ends with one paragraph that names the file, a remedy, and all of ``words``."""
    with pytest.raises(SourceError) as caught:
        open_source(path, declared)
    text = str(caught.value)
    assert Path(str(path).partition("::")[0]).name in text
    assert caught.value.remedy
    assert "\n" not in text
    for word in words:
        assert word in text, text


def cut(path: Path, n_bytes: int) -> None:
    with path.open("r+b") as file:
        file.truncate(n_bytes)


def test_missing_file(tmp_path: Path) -> None:
    fails(tmp_path / "absent.tif", "there is no such file", "every worker")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("movie.cine", ("Phantom's files are not read", ".tif", "got .cine", "multipage TIFF")),
        ("movie.tpx3", ("Timepix3 event files are not read",)),
        ("movie.xyz", ("format is unknown", ".mrc", "got .xyz", "Bio-Formats", "--raw-shape")),
        ("movie", ("without a suffix",)),
    ],
)
def test_other_formats(name: str, words: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"data")
    fails(tmp_path / name, *words)


def test_no_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save(tmp_path / "movie.npy", movie())

    def refuse(*args: object, **options: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    fails(tmp_path / "movie.npy", "cannot be read", "Permission denied")


@pytest.mark.parametrize("data", [b"II", b"\x89PNG\r\n\x1a\n and more", b"II\x00\x00\x00\x00\x00\x00"])
def test_not_a_tiff(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "movie.tif").write_bytes(data)
    fails(tmp_path / "movie.tif", "not a TIFF")


def test_tiff_without_pages(tmp_path: Path) -> None:
    (tmp_path / "movie.tif").write_bytes(b"II\x2a\x00\x00\x00\x00\x00")
    fails(tmp_path / "movie.tif", "no frames")


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_tiff_cut_inside_a_page(compression: str | None, tmp_path: Path) -> None:
    path = tmp_path / "movie.tif"
    with tifffile.TiffWriter(path) as writer:
        for frame in movie():
            writer.write(frame, compression=compression, metadata=None, contiguous=False)
    cut(path, path.stat().st_size - 10)
    fails(path, "inside the data of page 4", f"got {path.stat().st_size:,} bytes", "cut short")


def test_tiff_cut_before_a_directory(tmp_path: Path) -> None:
    path = tmp_path / "movie.tif"
    with tifffile.TiffWriter(path) as writer:
        for frame in movie():
            writer.write(frame, metadata=None, contiguous=False)
    with tifffile.TiffFile(path) as tiff:
        directory = tiff.pages[3].offset
    for n_bytes in (directory + 30, directory + 1, directory):
        cut(path, n_bytes)
        fails(path, "before the directory of page 3")
    tifffile.imwrite(path, movie(), imagej=True, metadata={"axes": "TYX"})
    cut(path, path.stat().st_size // 2)
    fails(path, "before the directory of page 1")


def test_tiff_with_fewer_pages_than_promised(tmp_path: Path) -> None:
    text = "ImageJ=1.53t\nimages=9\nframes=9\n"
    tifffile.imwrite(tmp_path / "movie.tif", movie(), description=text, metadata=None)
    fails(tmp_path / "movie.tif", "before its last page", "9 pages", "got 5")


def test_imagej_file_with_one_page_cut_short(tmp_path: Path) -> None:
    text = "ImageJ=1.53t\nimages=9\nframes=9\n"
    tifffile.imwrite(tmp_path / "movie.tif", movie()[0], description=text, metadata=None)
    fails(tmp_path / "movie.tif", "in frame 1 of 9", "bytes")


def test_tiff_whose_pages_go_in_a_circle(tmp_path: Path) -> None:
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, movie()[0], metadata=None)
    data = bytearray(path.read_bytes())
    start = int.from_bytes(data[4:8], "little")
    pointer = start + 2 + 12 * int.from_bytes(data[start : start + 2], "little")
    data[pointer : pointer + 4] = data[4:8]
    path.write_bytes(data)
    fails(path, "page 1 leads back")


@pytest.mark.parametrize(
    ("page", "got"), [(movie()[0, :20], f"20 x {N_X} uint16"), (movie("f4")[0], f"{N_Y} x {N_X} float32")]
)
def test_page_that_differs(page: np.ndarray, got: str, tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "movie.tif") as writer:
        for frame in (*movie()[:3], page):
            writer.write(frame, metadata=None, contiguous=False)
    fails(tmp_path / "movie.tif", "page 3 (counted from 0) differs", f"Expected {N_Y} x {N_X} uint16", f"got {got}")


def test_rgb(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "movie.tif", np.zeros((3, 8, 8, 3), "u1"), photometric="rgb")
    fails(tmp_path / "movie.tif", "colour", "3 values a pixel", "greyscale")


def test_complex_numbers_and_records(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "complex.tif", np.zeros((3, 8, 8), "c8"), photometric="minisblack")
    np.save(tmp_path / "complex.npy", np.zeros((3, 8, 8), "c16"))
    np.save(tmp_path / "long.npy", np.zeros((3, 8, 8), np.longdouble))
    np.save(tmp_path / "records.npy", np.zeros((3, 8, 8), "u1, u1"))
    np.save(tmp_path / "objects.npy", np.array([[None]]))
    with mrcfile.new(tmp_path / "complex.mrc", data=np.zeros((3, 8, 8), "c8")):
        pass
    with h5py.File(tmp_path / "complex.h5", "w") as file:
        file["a"] = np.zeros((3, 8, 8), "c8")
    names = ("complex.tif", "complex.npy", "long.npy", "records.npy", "objects.npy", "complex.mrc", "complex.h5")
    for name in names:
        fails(tmp_path / name, "cannot be used as intensities", "float32")


def test_several_axes(tmp_path: Path) -> None:
    frames = np.zeros((2, 3, 8, 8), "u2")
    tifffile.imwrite(tmp_path / "imagej.tif", frames, imagej=True, metadata={"axes": "TZYX"})
    tifffile.imwrite(tmp_path / "ome.tif", frames, ome=True, metadata={"axes": "TCYX"})
    tifffile.imwrite(tmp_path / "plain.tif", frames, photometric="minisblack")
    np.save(tmp_path / "movie.npy", frames)
    for name, words in (("imagej.tif", "3 slices, 2 frames"), ("ome.tif", "3 channels"), ("plain.tif", "axis 1 of 3")):
        fails(tmp_path / name, "not a movie", words)
    fails(tmp_path / "movie.npy", "not a movie", "4 axes")


def test_damaged_page_is_found_when_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, movie(), compression="zlib", metadata=None)
    with tifffile.TiffFile(path) as tiff:
        place = tiff.pages[2].dataoffsets[0]
    with path.open("r+b") as file:
        file.seek(place)
        file.write(b"\xff" * 40)
    source = open_source(path)
    np.testing.assert_array_equal(source.read(0, 2), movie()[:2])
    with pytest.raises(SourceError, match=r"movie\.tif: page 2 \(counted from 0\) cannot be decoded"):
        source.read(0, N_FRAMES)


def test_file_that_shrinks_or_goes_after_opening(tmp_path: Path) -> None:
    np.save(tmp_path / "movie.npy", movie())
    source = open_source(tmp_path / "movie.npy")
    cut(tmp_path / "movie.npy", 1000)
    with pytest.raises(SourceError, match="when it was opened"):
        source.read(0, N_FRAMES)
    (tmp_path / "movie.npy").unlink()
    with pytest.raises(SourceError, match=r"movie\.npy: the file cannot be read.*No such file"):
        source.read(0, N_FRAMES)


def test_cut_mrc_npy_and_hdf5(tmp_path: Path) -> None:
    with mrcfile.new(tmp_path / "movie.mrc", data=movie()):
        pass
    np.save(tmp_path / "movie.npy", movie())
    np.save(tmp_path / "fortran.npy", np.asfortranarray(movie()))
    with h5py.File(tmp_path / "movie.h5", "w") as file:
        file["a"] = movie()
    for name in ("movie.mrc", "movie.npy", "fortran.npy"):
        cut(tmp_path / name, (tmp_path / name).stat().st_size - 1)
        fails(tmp_path / name, "in frame 4 of 5", "cut short")
        cut(tmp_path / name, 40)
        fails(tmp_path / name, "the header is not that of")
    cut(tmp_path / "movie.h5", 4000)
    fails(tmp_path / "movie.h5", "cannot be opened as HDF5")


def test_mrc_of_an_unknown_mode(tmp_path: Path) -> None:
    (tmp_path / "movie.mrc").write_bytes(np.array([4, 4, 4, 99] + 252 * [0], "<i4").tobytes())
    fails(tmp_path / "movie.mrc", "not that of an MRC stack", "mode [4, 4, 4, 99]")


def test_no_frames(tmp_path: Path) -> None:
    np.save(tmp_path / "movie.npy", movie()[:0])
    fails(tmp_path / "movie.npy", "no frames")
    (tmp_path / "empty").mkdir()
    fails(tmp_path / "empty", "no frames")
    fails(tmp_path / "empty" / "*.tif", "no frames", "pattern")


def test_hdf5_paths(tmp_path: Path) -> None:
    path = tmp_path / "movie.h5"
    with h5py.File(path, "w") as file:
        file["one/data"], file["two/data"] = movie(), movie("f4")
        file["line"] = np.arange(3)
    fails(path, "2 data sets", "/one/data (5, 24, 37) uint16", "/two/data", "movie.h5::/one/data")
    fails(f"{path}::/three", "nothing under this path", "/one/data", "/two/data")
    fails(f"{path}::/line", "1 axes")
    with h5py.File(tmp_path / "empty.h5", "w"):
        pass
    fails(tmp_path / "empty.h5", "a file without data sets")
    fails(f"{tmp_path / 'movie.tif'}::/a", "no such file")
    np.save(tmp_path / "movie.npy", movie())
    fails(f"{tmp_path / 'movie.npy'}::/a", "NumPy files have no paths inside")


def test_hdf5_with_a_filter_that_is_not_here(tmp_path: Path) -> None:
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((1, 8, 8))
    properties.set_filter(32099, h5py.h5z.FLAG_OPTIONAL, (0,))
    with h5py.File(tmp_path / "movie.h5", "w") as file:
        space = h5py.h5s.create_simple((2, 8, 8))
        h5py.h5d.create(file.id, b"a", h5py.h5t.NATIVE_UINT16, space, properties)
    fails(tmp_path / "movie.h5", "filter that is not installed", "32099", "h5repack")


def test_raw_that_is_not_declared(tmp_path: Path) -> None:
    (tmp_path / "movie.raw").write_bytes(movie().tobytes())
    for declared, word in (
        (SourceSettings(), "raw_shape and raw_dtype"),
        (SourceSettings(raw_dtype="u2"), "no raw_shape"),
        (SourceSettings((0, N_X), "u2"), "(0, 37)"),
        (SourceSettings((0, N_Y, N_X), "pixels"), "'pixels'"),
    ):
        with pytest.raises(SettingsError) as caught:
            open_source(tmp_path / "movie.raw", declared)
        assert word in str(caught.value)


def test_raw_of_another_size(tmp_path: Path) -> None:
    (tmp_path / "movie.raw").write_bytes(movie().tobytes()[:-2])
    path = tmp_path / "movie.raw"
    fails(path, "in frame 4 of 5", declared=SourceSettings((N_FRAMES, N_Y, N_X), "u2"))
    fails(path, "whole number of frames", "4 frames and 1,774 bytes", declared=SourceSettings((0, N_Y, N_X), "u2"))
    fails(path, "whole number of frames", declared=SourceSettings((0, N_Y, N_X), "u2", raw_offset=10**6))
    fails(path, "complex", declared=SourceSettings((1, 2, 2), "c8"))


def test_sequences_with_a_stranger(tmp_path: Path) -> None:
    for number in range(3):
        np.save(tmp_path / f"frame_{number}.npy", movie()[0])
    np.save(tmp_path / "frame_3.npy", movie()[0, :10])
    with pytest.raises(SourceError, match=rf"frame_3\.npy: .*Expected {N_Y} x {N_X} uint16.*got 10 x {N_X} uint16"):
        open_source(tmp_path)
    (tmp_path / "frame_3.npy").write_bytes(b"\x93NUMPY")
    with pytest.raises(SourceError, match=r"frame_3\.npy: the header"):
        open_source(tmp_path / "frame_*.npy")
    tifffile.imwrite(tmp_path / "sum.tif", movie()[0])
    fails(tmp_path, "several formats", "4 .npy, 1 .tif", "pattern")


def test_tifffile_says_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "movie.tif"
    tag = (65000, "H", 1, 3, True)
    tifffile.imwrite(path, movie(), compression="lzw", tile=(16, 16), metadata=None, extratags=[tag])
    with path.open("r+b") as file:
        data = file.read()
        file.seek(data.index(np.array([65000, 3], "<u2").tobytes()) + 2)
        file.write(b"\x63\x00")  # a type that there is not, of which tifffile warns
    with caplog.at_level(logging.DEBUG):
        np.testing.assert_array_equal(open_source(path).read(0, N_FRAMES), movie())
    assert not [record for record in caplog.records if record.name == "tifffile"]
    assert capfd.readouterr() == ("", "")


@settings(max_examples=300, deadline=None)
@given(
    flavour=st.sampled_from(["plain.tif", "zlib.tif", "ome.tif", "movie.npy", "movie.mrc"]),
    places=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=4),
    kept=st.floats(0, 1),
)
def test_damaged_bytes_give_frames_or_a_paragraph(
    damaged: dict[str, Path], flavour: str, places: list[tuple[float, int]], kept: float
) -> None:
    """Whatever bytes of a header are wrong, no other error than ours comes out."""
    original = damaged[flavour]
    data = bytearray(original.read_bytes())
    for place, value in places:
        data[int(place * min(len(data), 1100))] = value
    path = original.with_name(f"damaged_{flavour}")
    path.write_bytes(data[: max(4, int(len(data) * min(1.0, kept + 0.5)))])
    with suppress(SourceError):
        source = open_source(path)
        if np.prod(source.shape) < 1e6:
            assert source.read(0, source.shape[0]).shape == source.shape


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder, frames = tmp_path_factory.mktemp("damaged"), movie()[:, :12, :10]
    tifffile.imwrite(folder / "plain.tif", frames, imagej=True, metadata={"axes": "TYX", "unit": "nm"})
    tifffile.imwrite(folder / "zlib.tif", frames, compression="zlib", bigtiff=True, rowsperstrip=3)
    tifffile.imwrite(folder / "ome.tif", frames, ome=True, metadata={"axes": "TYX", "PhysicalSizeX": 0.1})
    np.save(folder / "movie.npy", frames)
    with mrcfile.new(folder / "movie.mrc", data=frames):
        pass
    return {path.name: path for path in folder.iterdir()}


def npy_of(header: bytes, version: int = 2) -> bytes:
    return b"\x93NUMPY" + bytes((version, 0)) + len(header).to_bytes(4 if version > 1 else 2, "little") + header


@pytest.mark.parametrize(
    "data",
    [
        b"\x93NUMPY\x02\x00\xff\xff\xff\xff{'descr'",
        npy_of(b"-" * 9000 + b"1"),
        npy_of(b"(" * 9000),
        npy_of(b"{'descr': '<u2', 'fortran_order': False, 'shape': (9" + b"9" * 4500 + b", 4, 4), }"),
        npy_of(b"{'descr': '<u2', 'fortran_order': True, 'shape': (9" + b"9" * 400 + b", 4, 4), }", 1),
        npy_of(b"{'descr': '<u9', 'fortran_order': True, 'shape': (1, 4, 4), }", 3),
        npy_of(b"{'descr': '|V99999999999', 'fortran_order': False, 'shape': (1, 4, 4), }"),
    ],
)
def test_npy_headers_that_claim_too_much(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "movie.npy").write_bytes(data)
    fails(tmp_path / "movie.npy")


OME_HEAD = '<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image><Pixels SizeT="{}">'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"ImageJ=1.53t\nimages={10**9}\nframes={10**9}\n", "ends in frame"),
        (f"ImageJ=1.53t\nimages={10**15}\nframes={10**15}\n", "number of frames is impossible"),
        ("ImageJ=1.53t\nimages=" + "9" * 5000, "cannot be read"),
        ('{"shape": ' + "[" * 50_000, ""),
        (f'{{"shape": [{10**9}, 24, 37], "truncated": true}}', "ends in frame"),
        (OME_HEAD.format(10**9) + "</Pixels></Image></OME>", "ends before its last page"),
        (OME_HEAD.format(1) + '<TiffData PlaneCount="5"/>' * 100 + "</Pixels></Image></OME>", "again and again"),
        ("<!DOCTYPE x [" + '<!ENTITY a "aaaaaaaa">' + "]>" + OME_HEAD.format(5) + "&a;</OME>", "declaration of types"),
        ("<a>" * 100_000 + "</OME>", "OME description is damaged"),
    ],
)
def test_tiff_descriptions_that_claim_too_much(text: str, words: str, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "movie.tif", movie()[0], description=text.encode(), metadata=None)
    if words:
        fails(tmp_path / "movie.tif", words)
    else:
        assert open_source(tmp_path / "movie.tif").shape == (1, N_Y, N_X)


def patched(path: Path, tag: int, value: int) -> None:
    """Change a tag of the first page of a little-endian classic TIFF."""
    data = bytearray(path.read_bytes())
    at = data.index(tag.to_bytes(2, "little"), int.from_bytes(data[4:8], "little"))
    data[at + 2 : at + 12] = b"\x04\x00\x01\x00\x00\x00" + value.to_bytes(4, "little")
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("tags", "options", "words"),
    [
        ({256: 10**5, 257: 10**5, 278: 10**5}, {"compression": "zlib"}, "far larger than the file can hold"),
        ({322: 1 << 20, 323: 1 << 20}, {"compression": "zlib", "tile": (16, 16)}, "far larger than the page"),
        ({256: 2**31, 257: 2**31}, {}, "ends inside the data of page 0"),
        ({278: 1}, {"compression": "zlib"}, "does not say where its pixels are"),
        ({259: 22610}, {"compression": "zlib"}, "compression of page 0"),
    ],
)
def test_tiff_pages_that_claim_too_much(
    tags: dict[int, int], options: dict[str, Any], words: str, tmp_path: Path
) -> None:
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, movie()[0], metadata=None, **options)
    for tag, value in tags.items():
        patched(path, tag, value)
    fails(path, words)


@pytest.mark.parametrize("codec", ["jpeg", "jpeg2000", "png", "lerc", "jpegxl", "webp"])
def test_an_image_in_a_page_that_claims_too_much(codec: str, tmp_path: Path) -> None:
    """The page is small; the image in its place, which the codec would believe, is not."""
    import imagecodecs

    path, large = tmp_path / "movie.tif", np.zeros((4200, 4200), "u1")
    encode = getattr(imagecodecs, f"{ {'jpeg2000': 'jpeg2k'}.get(codec, codec) }_encode")
    easy = {"effort": 1} if codec == "jpegxl" else {}
    bomb = bytes(encode(np.dstack([large] * 3) if codec == "webp" else large, **easy))
    tifffile.imwrite(path, movie("u1")[0], metadata=None, compression="lerc", photometric="minisblack")
    data = bytearray(path.read_bytes())
    path.write_bytes(data + bomb)
    numbers = {"jpeg": 7, "jpeg2000": 34712, "png": 34933, "lerc": 34887, "jpegxl": 50002, "webp": 50001}
    for tag, value in {259: numbers[codec], 273: len(data), 279: len(bomb)}.items():
        patched(path, tag, value)
    source = open_source(path)
    with pytest.raises(SourceError, match=r"an image inside page 0 .* is far larger than the page"):
        source.read(0, 1)


def test_tiff_directories_that_overlap(tmp_path: Path) -> None:
    """A thousand directories in each other's entries: to read them all would take for ever."""
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, movie()[0], metadata=None)
    data = bytearray(path.read_bytes())
    first = int.from_bytes(data[4:8], "little")
    count = int.from_bytes(data[first : first + 2], "little")
    tags = bytes(data[first + 2 : first + 2 + 12 * count])
    n_pages, n_entries = 2000, 3000
    start = len(data) + len(data) % 2
    body = bytearray(bytes(start - len(data)))
    for k in range(n_pages):
        after = start + 4 * (k + 1) if k < n_pages - 1 else 0
        body += n_entries.to_bytes(2, "little") + after.to_bytes(2, "little")
    data[4:8] = start.to_bytes(4, "little")
    path.write_bytes(data + body + tags * 4000)
    fails(path)


@pytest.mark.parametrize("size", [1, 4])
def test_hdf5_chunks_that_are_shorter_than_their_checksum(size: int, tmp_path: Path) -> None:
    """libhdf5 reads before the beginning of such a chunk, and ends the process."""
    with h5py.File(tmp_path / "movie.h5", "w") as file:
        dataset = file.create_dataset("data", data=movie(), chunks=(1, N_Y, N_X), fletcher32=True)
        dataset.id.write_direct_chunk((2, 0, 0), b"x" * size)
    fails(tmp_path / "movie.h5", "too short for its checksum", "(2, 0, 0)")


def test_hdf5_that_claims_too_much(tmp_path: Path) -> None:
    path = tmp_path / "movie.h5"
    with h5py.File(path, "w") as file:
        wide = file.create_dataset("wide", (2, 1 << 20, 1 << 20), "u2", chunks=(1, 64, 64), compression="gzip")
        wide[0, :64, :64] = 1
        chunk = file.create_dataset("chunk", (64, 2048, 1024), "u1", chunks=(64, 1024, 1024), compression="gzip")
        chunk[0, 0, 0] = 1
        long = file.create_dataset("long", (1 << 40, 8, 8), "u1", chunks=(1, 8, 8), compression="gzip")
        long[0] = 1
        file["text"] = "not a movie"
        file["nothing"] = h5py.Empty("u2")
    fails(f"{path}::wide", "one frame would be far larger than the file can hold")
    fails(f"{path}::chunk", "one chunk would be far larger than the file can hold")
    fails(f"{path}::long", "the number of frames is impossible")
    fails(f"{path}::text", "cannot be used as intensities")
    fails(f"{path}::nothing", "not a movie")


def test_hdf5_with_more_objects_than_are_looked_at(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "movie.h5", "w", libver="latest") as file:
        file["data"] = movie()
        for k in range(10_001):
            file[f"many/{k}"] = h5py.SoftLink("/data")
    fails(tmp_path / "movie.h5", "more than 10,000", "movie.h5::/entry/data")
    assert open_source(f"{tmp_path / 'movie.h5'}::many/7").shape == movie().shape


def test_mrc_headers_that_claim_too_much(tmp_path: Path) -> None:
    header = np.zeros(256, "<i4")
    for shape, extended in (((2**31 - 1, 2**31 - 1, 2**31 - 1), 0), ((4, 4, 4), 2**31 - 1), ((4, 4, 2**30), 0)):
        header[:4], header[23] = (*shape, 6), extended
        (tmp_path / "movie.mrc").write_bytes(header.tobytes() + bytes(128))
        fails(tmp_path / "movie.mrc", "the file ends")
    source_settings = SourceSettings((2**40, 2**20, 2**20), "u2")
    (tmp_path / "movie.raw").write_bytes(bytes(100))
    fails(tmp_path / "movie.raw", "number of frames is impossible", declared=source_settings)


@pytest.mark.parametrize(
    "error",
    [RecursionError("deep"), KeyError("name"), OverflowError("big"), ZeroDivisionError(), struct.error("short")],
)
def test_whatever_a_library_raises_is_an_error_of_ours(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tifffile.imwrite(tmp_path / "movie.tif", movie(), compression="zlib")
    source = open_source(tmp_path / "movie.tif")

    def broken(*arguments: object, **options: object) -> None:
        raise error

    monkeypatch.setattr(tifffile, "TiffPage", broken)
    with pytest.raises(SourceError, match=r"movie\.tif") as caught:
        source.read(0, 1)
    assert caught.value.__cause__ is error
    monkeypatch.setitem(READERS, ".tif", Reader("TIFF", (".tif",), broken))
    fails(tmp_path / "movie.tif")


def test_too_little_memory_is_not_the_files_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save(tmp_path / "movie.npy", movie())
    source = open_source(tmp_path / "movie.npy")

    def full(*arguments: object) -> None:
        raise MemoryError

    monkeypatch.setattr("tract_dask.readers.blocks.fill_from", full)
    with pytest.raises(TractError, match=r"memory ran out.*fewer workers") as caught:
        source.read(0, 1)
    assert not isinstance(caught.value, SourceError)
