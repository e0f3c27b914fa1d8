"""TIFF whose numbers, pages or calibrations are not simply what they seem: the right value, or a note."""

from __future__ import annotations

import json
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from files_classic import COUNTS, opaque, short, stk, tiff

from tract_dask.errors import SourceError
from tract_dask.readers import open_source

WORDS = COUNTS.astype("u2") * 200


def known(path: Path) -> Any:
    return open_source(path).metadata


def notes(path: Path) -> str:
    return " | ".join(known(path).notes)


def imagej(path: Path, frames: np.ndarray, lines: dict[str, str], **options: Any) -> Path:
    """Write a stack whose description is ImageJ's, line by line."""
    fields = {"images": str(len(frames)), "frames": str(len(frames)), **lines}
    text = "ImageJ=1.54f\n" + "".join(f"{key}={value}\n" for key, value in fields.items())
    options = {"photometric": "minisblack", **options}
    tifffile.imwrite(path, frames, description=text.encode("latin-1"), metadata=None, **options)
    return path


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("dtype", ["u1", "u2", "i2", "u4"])
def test_white_that_is_0_is_turned_over(dtype: str, compression: str | None, order: Any, tmp_path: Path) -> None:
    truth = COUNTS.astype(dtype)
    highest = -1 if dtype == "i2" else np.iinfo(dtype).max
    stored = (highest - truth.astype("i8")).astype(dtype)
    path = tmp_path / "a.tif"
    tifffile.imwrite(
        path, stored, photometric="miniswhite", metadata=None, compression=compression, byteorder=order, rowsperstrip=20
    )
    source = pickle.loads(pickle.dumps(open_source(path)))
    assert source.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(source.read(0, 6), truth)
    frames = np.empty((2, 20, 24), dtype)
    source.read_into(3, frames)
    np.testing.assert_array_equal(frames, truth[3:5])
    assert notes(path) == "a.tif stores white as 0 (MinIsWhite); its numbers are turned over"


def test_white_that_is_0_in_bits_and_12_bits(tmp_path: Path) -> None:
    bits = COUNTS > 100
    tifffile.imwrite(tmp_path / "b.tif", ~bits, photometric="miniswhite", metadata=None)
    np.testing.assert_array_equal(open_source(tmp_path / "b.tif").read(0, 6), bits)
    words = COUNTS[0].astype("u2") * 16
    packed = packed_bits(4095 - words, 12)
    path = tiff(tmp_path / "c.tif", [(packed, words.shape, [short(258, 12), short(262, 0)])])
    np.testing.assert_array_equal(open_source(path).read(0, 1)[0], words)


@pytest.mark.parametrize("dtype", ["u1", "f4"])
def test_white_that_is_0_only_as_shown(dtype: str, tmp_path: Path) -> None:
    """ImageJ's inverting tables are for the screen; of floating-point numbers nobody knows the white."""
    lines = {} if dtype == "f4" else {"mode": "grayscale"}
    path = tmp_path / "a.tif"
    if dtype == "f4":
        tifffile.imwrite(path, COUNTS.astype(dtype), photometric="miniswhite", metadata=None)
    else:
        imagej(path, COUNTS, lines, photometric="miniswhite")
    np.testing.assert_array_equal(open_source(path).read(0, 6), COUNTS)
    assert "is shown with white for 0" in notes(path)


@pytest.mark.parametrize(("dtype", "offset"), [("u2", -32768.0), ("u1", -128.0)])
@pytest.mark.parametrize("options", [{}, {"byteorder": ">"}, {"compression": "zlib"}])
def test_imagejs_signed_numbers(dtype: str, offset: float, options: dict[str, Any], tmp_path: Path) -> None:
    truth = (COUNTS // 2).astype("i2") - 60 if dtype == "u1" else WORDS.astype("i4") - 20000
    stored = (truth - int(offset)).astype(dtype)
    path = imagej(tmp_path / "a.tif", stored, {"cf": "0", "c0": str(offset), "c1": "1.0", "vunit": "gray"}, **options)
    source = open_source(path)
    assert source.dtype == np.dtype(dtype.replace("u", "i"))
    np.testing.assert_array_equal(source.read(0, 6), truth)
    assert source.metadata.notes == ()


@pytest.mark.parametrize(
    "lines", [{"cf": "0", "c0": "5", "c1": "0.5", "vunit": "e"}, {"cf": "21"}, {"cf": "1", "c0": "1"}]
)
def test_other_values_of_imagej_are_noted(lines: dict[str, str], tmp_path: Path) -> None:
    path = imagej(tmp_path / "a.tif", WORDS, lines)
    np.testing.assert_array_equal(open_source(path).read(0, 6), WORDS)
    assert "are not applied" in notes(path)


def test_palettes_are_noted(tmp_path: Path) -> None:
    table = np.random.default_rng(0).integers(0, 65535, (3, 256)).astype("u2")
    tifffile.imwrite(tmp_path / "a.tif", COUNTS[0], photometric="palette", colormap=table, metadata=None)
    assert "numbers of a table of colours (palette); they are read as stored" in notes(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("samples", "photometric", "words"),
    [(3, "rgb", "the pixels are RGB colours"), (4, "rgb", "RGB colours with transparency"), (4, 5, "CMYK colours")],
)
def test_colours_are_refused_by_name(samples: int, photometric: Any, words: str, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((6, 8, samples), "u1"), photometric=photometric, metadata=None)
    with pytest.raises(SourceError, match=words):
        open_source(tmp_path / "a.tif")


def test_a_mosaic_of_colour_filters_is_refused(tmp_path: Path) -> None:
    path = tiff(tmp_path / "a.tif", [(bytes(12), (3, 4), [short(258, 8), short(262, 32803)])])
    with pytest.raises(SourceError, match="mosaic of colour filters"):
        open_source(path)


def test_pages_of_both_kinds_of_white_are_refused(tmp_path: Path) -> None:
    pages = [(bytes(12), (3, 4), [short(258, 8), short(262, kind)]) for kind in (1, 0)]
    with pytest.raises(SourceError, match=r"page 1 .*white is 0"):
        open_source(tiff(tmp_path / "a.tif", pages))


def packed_bits(frame: np.ndarray, n_bits: int) -> bytes:
    """Pack rows of numbers, the highest bit first, each row in whole bytes."""
    bits = (frame.astype("u2")[..., None] >> np.arange(n_bits - 1, -1, -1)) & 1
    return np.packbits(bits.reshape(len(frame), -1).astype("u1"), axis=1).tobytes()


@pytest.mark.parametrize("n_bits", [4, 12, 10, 14])
def test_packed_pixels(n_bits: int, tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 1 << n_bits, (3, 5, 7))
    pages = [(packed_bits(frame, n_bits), frame.shape, [short(258, n_bits)]) for frame in frames]
    source = open_source(tiff(tmp_path / "a.tif", pages))
    np.testing.assert_array_equal(source.read(0, 3), frames)
    assert source.metadata.notes == ()


def test_metamorphs_stack(tmp_path: Path) -> None:
    path = stk(tmp_path / "a.stk", WORDS, [1.0, 1.5, 2.0, 2.5, 3.0, 5.5], (1, 20), "nm")
    source = open_source(path)
    np.testing.assert_array_equal(source.read(0, 6), WORDS)
    assert (source.metadata.pixel_size_pm, source.metadata.frame_time_s) == (50.0, 0.5)
    np.testing.assert_allclose(source.metadata.along_frames["time"].values, [0, 0.5, 1, 1.5, 2, 4.5])
    assert "gap of 2.5 s after frame 4" in notes(path)
    path.write_bytes(path.read_bytes().replace(struct.pack("<HHI", 33629, 5, 6), struct.pack("<HHI", 33629, 5, 60)))
    with pytest.raises(SourceError, match="in frame 6 of 60"):
        open_source(path)


@pytest.mark.parametrize(
    ("tag", "text", "size", "note"),
    [
        (
            34682,
            "[Scan]\r\nPixelWidth=3.3e-011\r\nPixelHeight=3.3e-011\r\n[Image]\r\nResolutionY=15\r\n",
            33.0,
            "last 5 of",
        ),
        (34680, "[Scan]\r\nPixelWidth=2e-9\r\nPixelHeight=2e-9\r\n", 2000.0, ""),
        (34118, "0\r\n1e-9\r\nAP_IMAGE_PIXEL_SIZE\r\nImage Pixel Size = 1.25 nm\r\nAP_X\r\n", 1250.0, ""),
        (34118, "AP_X\r\n", None, ""),
    ],
)
@pytest.mark.parametrize("kind", [2, 7, 1])
def test_tags_of_fei_and_zeiss(tag: int, text: str, size: float, note: str, kind: int, tmp_path: Path) -> None:
    page = (COUNTS[0].tobytes(), (20, 24), [short(258, 8), opaque(tag, text.encode(), kind)])
    path = tiff(tmp_path / "a.tif", [page])
    assert known(path).pixel_size_pm == size
    assert note in notes(path)
    assert bool(notes(path)) == bool(note)


def test_frames_behind_the_only_page(tmp_path: Path) -> None:
    about = json.dumps({"axes": "TYX", "truncated": True, "shape": [6, 20, 24]})
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, WORDS[0], description=about, metadata=None)
    with path.open("ab") as file:
        file.write(WORDS[1:].tobytes())
    np.testing.assert_array_equal(open_source(path).read(0, 6), WORDS)
    assert notes(path) == ""


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_bytes_that_no_page_accounts_for(compression: str | None, tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, WORDS[:2], metadata=None, photometric="minisblack", compression=compression)
    assert notes(path) == ""
    with path.open("ab") as file:
        file.write(WORDS[1:].tobytes())
    assert open_source(path).shape[0] == 2
    assert "a.tif holds 4,8" in notes(path)
    path.write_bytes(path.read_bytes()[: -4 * WORDS[0].nbytes])
    assert "a.tif holds 9" in notes(path)


@pytest.mark.parametrize("metadata", [{"axes": "TYX"}, {"axes": "TYX", "Labels": ["x" * 900] * 6, "Info": "y" * 5000}])
def test_what_imagej_writes_beside_the_pages_is_accounted_for(metadata: dict[str, Any], tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", WORDS, imagej=True, metadata=metadata)
    assert notes(tmp_path / "a.tif") == ""


def test_pages_that_a_description_does_not_count(tmp_path: Path) -> None:
    path = imagej(tmp_path / "a.tif", WORDS, {"images": "4", "frames": "4"})
    assert open_source(path).shape[0] == 6
    assert "has 6 pages, its description counts 4; all are read" in notes(path)
    path = ome(tmp_path / "b.tif", WORDS, 'SizeT="4"')
    assert open_source(path).shape[0] == 4
    assert "has 6 pages, its description names 4; the others are not read" in notes(path)


@pytest.mark.parametrize("counted", [6, 4, 9])
def test_pages_that_a_shape_does_not_count(counted: int, tmp_path: Path) -> None:
    about = json.dumps({"axes": "TYX", "shape": [counted, 20, 24]})
    tifffile.imwrite(tmp_path / "a.tif", WORDS, description=about, metadata=None, photometric="minisblack")
    assert open_source(tmp_path / "a.tif").shape[0] == 6
    assert ("has 6 pages, its description counts" in notes(tmp_path / "a.tif")) == (counted != 6)


def ome(path: Path, frames: np.ndarray, pixels: str, inside: str = "") -> Path:
    sizes = "".join(f'{name}="{value}" ' for name, value in (("SizeC", 1), ("SizeZ", 1)))
    times = "" if "SizeT" in pixels else f'SizeT="{len(frames)}"'
    text = (
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image ID="Image:0">'
        f'<Pixels DimensionOrder="XYZCT" Type="uint16" SizeX="24" SizeY="20" {sizes}{times} {pixels}>{inside}</Pixels>'
        "</Image></OME>"
    )
    tifffile.imwrite(path, frames, description=text.encode(), metadata=None, photometric="minisblack")
    return path


def test_ome_has_times_of_planes(tmp_path: Path) -> None:
    stamps = [0, 40, 80, 200, 240, 280]
    planes = "".join(f'<Plane TheT="{k}" DeltaT="{t}" DeltaTUnit="ms"/>' for k, t in enumerate(stamps))
    found = known(ome(tmp_path / "a.tif", WORDS, 'PhysicalSizeX="0.5" PhysicalSizeXUnit="Å"', planes))
    assert (found.pixel_size_pm, found.frame_time_s) == (50.0, 0.04)
    np.testing.assert_allclose(found.along_frames["time"].values, np.array(stamps) / 1000)
    assert "gap of 0.12 s after frame 2" in " ".join(found.notes)
    path = ome(tmp_path / "b.tif", WORDS, 'TimeIncrement="1" TimeIncrementUnit="s"', planes)
    assert known(path).frame_time_s == 0.04
    assert "its planes are 0.04 s apart, not 1 s as it says" in notes(path)


@pytest.mark.parametrize(
    "planes", ['<Plane TheT="0" DeltaT="1"/>', '<Plane TheT="x"/>', '<Plane TheT="99" DeltaT="1"/>']
)
def test_ome_planes_that_say_too_little(planes: str, tmp_path: Path) -> None:
    found = known(ome(tmp_path / "a.tif", WORDS, 'TimeIncrement="20" TimeIncrementUnit="ms"', planes))
    assert (found.frame_time_s, found.along_frames, found.notes) == (0.02, {}, ())


@pytest.mark.parametrize(
    ("lines", "size", "seconds", "note"),
    [
        ({"unit": "\\u00C5", "finterval": "25", "tunit": "milliseconds"}, 20.0, 0.025, ""),
        ({"unit": "\\u00B5m", "finterval": "0,5", "tunit": "min"}, 200000.0, 30.0, ""),
        ({"unit": "nm", "yunit": "nm", "finterval": "25", "tunit": "\\u00B5sec"}, 200.0, 2.5e-5, ""),
        ({"unit": "1/nm"}, None, None, "the pixel size is in '1/nm', which is not a length"),
        ({"unit": "nm", "finterval": "25", "tunit": "frames"}, 200.0, None, "in 'frames', which is not a time"),
        ({"unit": "nm", "yunit": "\\u00C5"}, 200.0, None, "the pixels are not square (x 200 pm, y 20 pm)"),
        ({"unit": "pixel"}, None, None, ""),
    ],
)
def test_imagejs_units(lines: dict[str, str], size: float, seconds: float, note: str, tmp_path: Path) -> None:
    path = imagej(tmp_path / "a.tif", WORDS, lines, resolution=(5, 5))
    assert (known(path).pixel_size_pm, known(path).frame_time_s) == (size, seconds)
    assert note in notes(path)
    assert bool(notes(path)) == bool(note)


def test_an_orientation_is_noted(tmp_path: Path) -> None:
    page = (COUNTS[0].tobytes(), (20, 24), [short(258, 8), short(274, 4)])
    path = tiff(tmp_path / "a.tif", [page])
    np.testing.assert_array_equal(open_source(path).read(0, 1)[0], COUNTS[0])
    assert "turned or mirrored (orientation 4); it is read as it is stored" in notes(path)


def test_serialems_file_beside_a_tiff(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", WORDS, metadata=None, photometric="minisblack")
    (tmp_path / "a.tif.mdoc").write_text("[FrameSet = 0]\nPixelSpacing = 0.5\nExposureTime = 3\nNumSubFrames = 6\n")
    assert (known(tmp_path / "a.tif").pixel_size_pm, known(tmp_path / "a.tif").frame_time_s) == (50.0, 0.5)


@pytest.mark.parametrize("compression", ["jpeg", "jpeg2000"])
def test_images_inside_pages_that_are_cut_off_are_refused(compression: str, tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    frames = np.random.default_rng(3).poisson(9, (3, 40, 36)).astype("u1")
    tifffile.imwrite(path, frames, compression=compression, photometric="minisblack")
    with tifffile.TiffFile(path) as tiff:
        places = [(page.dataoffsets[0], page.databytecounts[0]) for page in tiff.pages]
    whole = open_source(path).read(0, 3)
    content = bytearray(path.read_bytes())
    offset, n_bytes = places[1]
    content[offset + n_bytes // 2 : offset + n_bytes] = bytes(n_bytes - n_bytes // 2)
    path.write_bytes(content)
    with pytest.raises(SourceError, match=r"an image inside page 1 .* is cut off"):
        open_source(path).read(0, 3)
    np.testing.assert_array_equal(open_source(path).read(2, 3), whole[2:])
