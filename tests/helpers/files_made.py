"""Small movies in formats of which no camera's file is at hand, written from public descriptions of the layout.

No line here was written with a reader of this project in view: file and reader come from two minds, and agree only
where both follow the format. Frames are (frame, y, x); a writer returns the path that a user would open.
"""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

Frames = NDArray[Any]

# ---- Gatan DM4 ----

DM_SCALARS = {"i2": 2, "i4": 3, "u2": 4, "u4": 5, "f4": 6, "f8": 7, "b1": 8, "i1": 9, "u1": 10, "i8": 11, "u8": 12}
DM_IMAGES = {"i2": 1, "f4": 2, "u1": 6, "i4": 7, "i1": 9, "u2": 10, "u4": 11, "f8": 12}
DM_RGB, DM_STRUCT, DM_ARRAY, DM_GROUP, DM_DATA = 23, 15, 20, 20, 21


def _code(value: np.generic | Frames) -> int:
    return DM_SCALARS[value.dtype.str[1:]]


def _little(value: Any) -> bytes:
    """The bytes of numbers, little-endian and in C order."""
    values = np.asarray(value)
    return values.astype(values.dtype.newbyteorder("<")).tobytes()


def _dm_data(value: Any) -> bytes:
    """One leaf of the tag tree: `%%%%`, number of info words, info words (big-endian), the value (little-endian)."""
    if isinstance(value, str):
        return _dm_data(np.frombuffer(value.encode("utf-16-le"), "<u2"))
    if isinstance(value, tuple):
        info = [DM_STRUCT, 0, len(value), *(word for field in value for word in (0, _code(field)))]
        payload = b"".join(map(_little, value))
    elif isinstance(value, np.ndarray):
        info, payload = [DM_ARRAY, _code(value), value.size], _little(value)
    else:
        info, payload = [_code(value)], _little(value)
    return b"%%%%" + struct.pack(f">q{len(info)}q", len(info), *info) + payload


def _dm_group(tags: dict[str, Any] | list[Any]) -> bytes:
    """A group: sorted, open, number of entries, entries. A list is a group whose entries have no names."""
    named = isinstance(tags, dict)
    entries = list(tags.items()) if isinstance(tags, dict) else [("", value) for value in tags]
    return struct.pack(">BBq", named, 0, len(entries)) + b"".join(_dm_entry(*entry) for entry in entries)


def _dm_entry(name: str, value: Any) -> bytes:
    is_group = isinstance(value, dict | list)
    body = _dm_group(value) if is_group else _dm_data(value)
    label = name.encode("latin-1")
    head = struct.pack(f">BH{len(label)}s", DM_GROUP if is_group else DM_DATA, len(label), label)
    return head + struct.pack(">q", len(body)) + body


def _dm4(tags: dict[str, Any]) -> bytes:
    """A whole DM4 file: version 4, bytes of the tag tree, little-endian data, the tree, eight zeros."""
    root = _dm_group(tags)
    return struct.pack(">iqi", 4, len(root), 1) + root + bytes(8)


def _dm_image(data: Frames, scales: Sequence[tuple[float, str]], tags: dict[str, Any], name: str) -> dict[str, Any]:
    """One entry of ImageList; `scales` are (scale, unit) along x, y, ... as the file orders its axes."""
    dimensions = [
        {"Label": "", "Origin": np.float32(0), "Scale": np.float32(scale), "Units": unit} for scale, unit in scales
    ]
    return {
        "ImageData": {
            "Calibrations": {
                "Brightness": {"Label": "", "Origin": np.float32(0), "Scale": np.float32(1), "Units": "Counts"},
                "Dimension": dimensions,
                "DisplayCalibratedUnits": np.bool_(True),
            },
            "Data": data.ravel(),
            "DataType": np.uint32(DM_IMAGES[data.dtype.str[1:]]),
            "Dimensions": [np.uint32(length) for length in reversed(data.shape)],
            "PixelDepth": np.uint32(data.itemsize),
        },
        "ImageTags": tags,
        "Name": name,
        "UniqueID": [np.uint32(number) for number in (0x51, 0x62, 0x73, 0x84)],
    }


def _dm_thumbnail() -> dict[str, Any]:
    """The small RGB picture that DigitalMicrograph puts first into ImageList: data type 23, four bytes a pixel."""
    picture = _dm_image(np.full((96, 96), 0x00808080, np.int32), [(1, ""), (1, "")], {}, "")
    picture["ImageData"]["DataType"] = np.uint32(DM_RGB)
    return picture


def _dm_document(image: dict[str, Any], thumbnail: bool) -> dict[str, Any]:
    """The root of a DM file that shows one image, as DigitalMicrograph orders it."""
    images = [_dm_thumbnail(), image] if thumbnail else [image]
    source = {"ClassName": "ImageSource:Simple", "Id": [np.uint32(0)], "ImageRef": np.uint32(len(images) - 1)}
    tags = {
        "ApplicationBounds": tuple(np.int64(number) for number in (0, 0, 1018, 1910)),
        "DocumentObjectList": [{"AnnotationType": np.int32(20), "ImageSource": np.uint64(0)}],
        "DocumentTags": {},
        "HasWindowPosition": np.bool_(True),
        "Image Behavior": {"UnscaledTransform": {"Offset": (np.float32(0), np.float32(0))}},
        "ImageList": images,
        "ImageSourceList": [source],
        "InImageMode": np.bool_(True),
        "MinVersionList": [{"RequiredVersion": np.uint32(50659328)}],
    }
    return tags | ({"Thumbnails": [{"ImageIndex": np.uint32(0)}]} if thumbnail else {})


def _acquisition(exposure_s: float) -> dict[str, Any]:
    return {"DataBar": {"Exposure Number": np.int32(1), "Exposure Time (s)": np.float64(exposure_s)}}


def write_dm4(
    path: Path, data: Frames, pixel_nm: float, exposure_s: float = 0.05, thumbnail: bool = True, in_situ: int = 0
) -> Path:
    """A DM4 file with one image (y, x) or a stack (frame, y, x), after a thumbnail; with `in_situ` frames, a director.

    Layout: "Digital Micrograph file format", C. Boothroyd (personal.ntu.edu.sg/cbb/info/dmformat), and the sizes that
    small files of DigitalMicrograph carry.
    """
    tags = _acquisition(exposure_s)
    if in_situ:
        tags["In-situ"] = {"Recorded": {"# Frames": np.uint32(in_situ)}}
    scales = [(pixel_nm, "nm")] * 2 + [(exposure_s, "s")] * (data.ndim - 2)
    path.write_bytes(_dm4(_dm_document(_dm_image(data, scales, tags, path.stem), thumbnail)))
    return path


def write_raw_parts(folder: Path, name: str, frames: Frames, part_pixels: int) -> None:
    """NAME.raw, NAME.raw_1, ...: the pixels of all frames in a row, a new file after each `part_pixels` pixels."""
    pixels = frames.ravel()
    for number, start in enumerate(range(0, pixels.size, part_pixels)):
        part = folder / (f"{name}.raw_{number}" if number else f"{name}.raw")
        part.write_bytes(_little(pixels[start : start + part_pixels]))


def write_gatan_dm4(
    folder: Path, frames: Frames, pixel_nm: float, part_pixels: int, exposure_s: float = 0.05, thumbnail: bool = True
) -> Path:
    """Gatan's in-situ movie: the director NAME.dm4 shows the last frame; the frames are in NAME.raw, NAME.raw_1, ...

    Layout: Gatan's template "DM5 Reader for InSitu 4DSTEM" (L. J. Spillane, 2024) for the raw files, which frames run
    across; tag `In-situ:Recorded:# Frames` in the director.
    """
    write_raw_parts(folder, "insitu", frames, part_pixels)
    return write_dm4(folder / "insitu.dm4", frames[-1], pixel_nm, exposure_s, thumbnail, in_situ=len(frames))


# ---- Gatan DM5 ----


def _dm5_image(parent: h5py.Group, data: Frames, data_type: int, scales: Sequence[tuple[float, str]]) -> h5py.Group:
    """One image of a DM5: groups are tag groups, attributes tags, lists count `[0]`, `[1]`, ...; text is Latin-1."""
    image = parent.create_group("ImageData")
    image.create_dataset("Data", data=data)
    image.attrs["DataType"], image.attrs["PixelDepth"] = np.uint32(data_type), np.uint32(data.itemsize)
    sizes = image.create_group("Dimensions")
    calibrations = image.create_group("Calibrations")
    for number, (scale, unit) in enumerate(scales):
        sizes.attrs[f"[{number}]"] = np.uint32(data.shape[-1 - number])
        axis = calibrations.create_group(f"Dimension/[{number}]")
        axis.attrs["Label"], axis.attrs["Units"] = np.bytes_(""), np.bytes_(unit.encode("latin-1"))
        axis.attrs["Origin"], axis.attrs["Scale"] = np.float32(0), np.float32(scale)
    return parent.create_group("ImageTags")


def write_dm5(
    path: Path, data: Frames, pixel_nm: float, exposure_s: float = 0.05, thumbnail: bool = True, in_situ: int = 0
) -> Path:
    """A DM5 file (HDF5) with one image (y, x) or a stack (frame, y, x), after a thumbnail; or a director.

    Layout: Gatan's template "DM5 Reader for InSitu 4DSTEM" (L. J. Spillane, 2024): DocumentObjectList/[0]@ImageSource,
    ImageSourceList/[n]@ImageRef, ImageList/[n]/ImageData/Data and ImageData/Calibrations/Dimension/[n] with Scale,
    Origin and Units, x first; In-situ/Recorded@"# Frames" below ImageTags.
    """
    scales = [(pixel_nm, "nm")] * 2 + [(exposure_s, "s")] * (data.ndim - 2)
    with h5py.File(path, "w") as file:
        shown = file.create_group("DocumentObjectList/[0]")
        shown.attrs["ImageDisplayType"], shown.attrs["ImageSource"] = np.int32(1), np.uint64(0)
        source = file.create_group("ImageSourceList/[0]")
        source.attrs["ClassName"], source.attrs["ImageRef"] = np.bytes_("ImageSource:Simple"), np.uint32(thumbnail)
        if thumbnail:
            grey = np.full((96, 96), 0x00808080, np.int32)
            _dm5_image(file.create_group("ImageList/[0]"), grey, DM_RGB, [(1, ""), (1, "")])
        image = file.create_group(f"ImageList/[{int(thumbnail)}]")
        image.attrs["Name"] = np.bytes_(path.stem)
        tags = _dm5_image(image, data, DM_IMAGES[data.dtype.str[1:]], scales)
        tags.create_group("DataBar").attrs["Exposure Time (s)"] = exposure_s
        if in_situ:
            tags.create_group("In-situ/Recorded").attrs["# Frames"] = np.uint32(in_situ)
    return path


def write_gatan_dm5(folder: Path, frames: Frames, pixel_nm: float, part_pixels: int, exposure_s: float = 0.05) -> Path:
    """As `write_gatan_dm4`, with a director in DM5."""
    write_raw_parts(folder, "insitu", frames, part_pixels)
    return write_dm5(folder / "insitu.dm5", frames[-1], pixel_nm, exposure_s, in_situ=len(frames))


def write_gatan_tree(
    folder: Path, frames: Frames, pixel_nm: float, per_second: int, first_second: int = 0, name: str = "capture"
) -> Path:
    """K2 and OneView: one DM4 a frame, in Hour_00/Minute_00/Second_00; the frames count from 0 within each second.

    Layout: the names that Gatan's In-Situ data carry in public data sets,
    NAME_Hour_00_Minute_00_Second_00_Frame_0000.dm4.
    """
    root = folder / name
    for number, frame in enumerate(frames):
        second, in_second = divmod(number, per_second)
        minutes, seconds = divmod(first_second + second, 60)
        hours, minutes = divmod(minutes, 60)
        place = root / f"Hour_{hours:02}" / f"Minute_{minutes:02}" / f"Second_{seconds:02}"
        place.mkdir(parents=True, exist_ok=True)
        stem = f"{name}_Hour_{hours:02}_Minute_{minutes:02}_Second_{seconds:02}_Frame_{in_second:04}"
        write_dm4(place / f"{stem}.dm4", frame, pixel_nm, exposure_s=1 / per_second)
    return root


# ---- TVIPS, StreamPix ----


def write_tvips(
    folder: Path, frames: Frames, stamps_s: Sequence[float], per_file: int, pixel_nm: int = 0, said_bytes: int = 12
) -> Path:
    """TVIPS version 1: a series header of 256 bytes in NAME_000.tvips only, then 12 bytes before each image.

    Layout: EMMENU's TVIPS format as LiberTEM 0.16 (MIT) describes it: the series header is 13 int32 (size, version, x,
    y, bits, offsets, binnings, pixel size in nm, high tension, magnification, bytes of an image header, which counts
    in version 2 only); an image header is counter, unix time, milliseconds.
    """
    y, x = frames.shape[1:]
    bits = frames.itemsize * 8
    series = struct.pack("<13i", 256, 1, x, y, bits, 0, 0, 1, 1, pixel_nm, 200, 80_000, said_bytes).ljust(256, b"\0")
    for part, start in enumerate(range(0, len(frames), per_file)):
        images = [b"" if part else series]
        for number in range(start, min(start + per_file, len(frames))):
            seconds, milliseconds = divmod(round(stamps_s[number] * 1000), 1000)
            images += [struct.pack("<3I", number, seconds, milliseconds), _little(frames[number])]
        (folder / f"series_{part:03}.tvips").write_bytes(b"".join(images))
    return folder / "series_000.tvips"


def write_seq(folder: Path, frames: Frames, stamps_s: Sequence[float], version: int, rate_hz: float = 10) -> Path:
    """StreamPix .seq of header version 3, 4 or 5, uncompressed grey: each frame, with its stamp, in a slot of sectors.

    Layout: NorPix's sequence description as pims 0.7 (BSD-3) has it: magic 0xFEED, name, version, header size, 512
    bytes of description, the image's numbers from byte 548; the first frame at 1024, from version 5 (StreamPix 6) at
    8192; stamps are seconds and milliseconds, from version 5 microseconds too.
    """
    first = 8192 if version >= 5 else 1024
    bits, image_bytes = frames.itemsize * 8, frames[0].nbytes
    sector = 8192 if version >= 5 else 512
    slot = -(-(image_bytes + 8) // sector) * sector
    head = struct.pack("<I24sii512s", 0xFEED, "Norpix seq\n".encode("utf-16-le"), version, 1024, b"")
    y, x = frames.shape[1:]
    head += struct.pack("<9Id", x, y, bits, bits, image_bytes, 100, len(frames), 0, slot, rate_hz)
    seconds = int(stamps_s[0])
    head += struct.pack("<iIIIiiiIiHH", 0, 0, 0, 0, 0, 0, 0, 0, seconds, 0, 0)
    body = []
    for frame, stamp in zip(frames, stamps_s, strict=True):
        seconds, micro = divmod(round(stamp * 1_000_000), 1_000_000)
        milli, micro = divmod(micro, 1000)
        time = struct.pack("<IHH", seconds, milli, micro if version >= 5 else 0)
        body.append((_little(frame) + time).ljust(slot, b"\0"))
    path = folder / f"version{version}.seq"
    path.write_bytes(head.ljust(first, b"\0") + b"".join(body))
    return path


# ---- TIFF: packed bits, EER ----

Tags = list[tuple[int, int, Any]]
TIFF_SHORT, TIFF_LONG, TIFF_UNDEFINED, TIFF_LONG8 = 3, 4, 7, 16


def _tiff(pages: Sequence[tuple[Tags, bytes]], big: bool) -> bytes:
    """A little-endian TIFF 6.0 or BigTIFF; each page is its tags and the bytes of its one strip."""
    word, counts, fits = ("<Q", "<Q", 8) if big else ("<I", "<H", 4)
    out = bytearray(struct.pack("<2sHHHQ", b"II", 43, 8, 0, 16) if big else struct.pack("<2sHI", b"II", 42, 8))
    formats = {TIFF_SHORT: "<H", TIFF_LONG: "<I", TIFF_LONG8: "<Q"}
    pointer = len(out) - fits
    for tags, strip in pages:
        strip_at = len(out)
        out += strip + bytes(-len(strip) % 8)
        place = [(273, TIFF_LONG8 if big else TIFF_LONG, strip_at), (279, TIFF_LONG8 if big else TIFF_LONG, len(strip))]
        entries = []
        for code, kind, value in sorted([*tags, *place]):
            data = value if isinstance(value, bytes) else struct.pack(formats[kind], value)
            count = len(value) if isinstance(value, bytes) else 1
            if len(data) > fits:
                data_at = len(out)
                out += data + bytes(-len(data) % 8)
                data = struct.pack(word, data_at)
            entries.append(struct.pack("<HH", code, kind) + struct.pack(word, count) + data.ljust(fits, b"\0"))
        struct.pack_into(word, out, pointer, len(out))
        out += struct.pack(counts, len(entries)) + b"".join(entries)
        pointer = len(out)
        out += bytes(fits) + bytes(-(len(out) + fits) % 8)
    return bytes(out)


def _page(x: int, y: int, bits: int, compression: int) -> Tags:
    shorts = [(258, bits), (259, compression), (262, 1), (277, 1)]
    longs = [(256, x), (257, y), (278, y)]
    return [(c, TIFF_SHORT, v) for c, v in shorts] + [(c, TIFF_LONG, v) for c, v in longs]


def write_packed_tiff(folder: Path, frames: Frames, bits: int) -> Path:
    """TIFF with 4 or 12 bits a pixel, uncompressed: the highest bit first, each row filled up to a whole byte.

    Layout: TIFF 6.0 (Adobe, 1992), BitsPerSample and FillOrder 1.
    """
    y, x = frames.shape[1:]
    pages = []
    for frame in frames:
        digits = (frame[..., None].astype(np.uint16) >> np.arange(bits - 1, -1, -1, dtype=np.uint16)) & 1
        pages.append((_page(x, y, bits, 1), np.packbits(digits.reshape(y, -1).astype(np.uint8), axis=1).tobytes()))
    path = folder / f"packed{bits}.tif"
    path.write_bytes(_tiff(pages, big=False))
    return path


def _eer_frame(events: Frames, skip_bits: int, sub_bits: int, seed: int) -> bytes:
    """The code of one frame: pixels skipped before each electron, then where in its pixel it fell; lowest bit first.

    A skip of all ones is "that many pixels, no electron" and has no position behind it. The last skip leads to the end;
    zeros fill the last word of 64 bits.
    """
    most = (1 << skip_bits) - 1
    places = [*np.flatnonzero(events), events.size]
    positions = np.random.default_rng(seed).integers(0, 1 << sub_bits, len(places))
    bits: list[str] = []
    for skip, position in zip(np.diff(places, prepend=-1) - 1, positions, strict=True):
        whole, rest = divmod(int(skip), most)
        bits += ["1" * skip_bits] * whole + [f"{rest:0{skip_bits}b}"[::-1], f"{position:0{sub_bits}b}"[::-1]]
    stream = np.array(list("".join(bits)), np.uint8)
    code = np.packbits(stream, bitorder="little").tobytes()
    return code + bytes(-len(code) % 8)


def write_eer(
    folder: Path, frames: Frames, exposure_s: float, compression: int = 65001, final_image: bool = False
) -> Path:
    """Falcon 4 EER: a BigTIFF with one page a frame, or their sum before them; `frames` hold 0 or 1 electron a pixel.

    Layout: Thermo Fisher's "EER File Format" document, as imagecodecs (BSD-3) decodes its section 4: compression 65000
    skips with 8 bits, 65001 with 7, both with 4 bits for the place within the pixel; 65002 says its bits in tags 65007
    (skip), 65008 (x), 65009 (y). Tag 65001 of the first page is XML of the acquisition.
    """
    y, x = frames.shape[1:]
    skip_bits, across, down = {65000: (8, 2, 2), 65001: (7, 2, 2), 65002: (6, 1, 2)}[compression]
    items = {"exposureTime": (f"{exposure_s:.6f}", ' unit="s"'), "numberOfFrames": (len(frames), "")}
    items |= {"sensorImageWidth": (x, ' unit="pixel"'), "sensorImageHeight": (y, ' unit="pixel"')}
    xml = "".join(f'<item name="{name}"{unit}>{value}</item>' for name, (value, unit) in items.items())
    pages: list[tuple[Tags, bytes]] = []
    if final_image:
        pages = [(_page(x, y, 16, 1), _little(frames.sum(0, dtype=np.uint16)))]
    for number, frame in enumerate(frames):
        tags = _page(x, y, 1, compression)
        if compression == 65002:
            tags += [(65007, TIFF_SHORT, skip_bits), (65008, TIFF_SHORT, across), (65009, TIFF_SHORT, down)]
        pages.append((tags, _eer_frame(frame, skip_bits, across + down, number)))
    pages[0][0].append((65001, TIFF_UNDEFINED, f"<metadata>{xml}</metadata>".encode()))
    path = folder / f"events{compression}.eer"
    path.write_bytes(_tiff(pages, big=True))
    return path


# ---- MRC ----


def write_mrc_4bit(folder: Path, frames: Frames, pixel_angstrom: float) -> Path:
    """MRC mode 101: two pixels a byte, the left one in the low four bits, each row filled up to a whole byte.

    Layout: MRC2014, update 20141 (ccpem.ac.uk), and IMOD's description of mode 101.
    """
    nz, ny, nx = frames.shape
    head = struct.pack("<10i", nx, ny, nz, 101, 0, 0, 0, nx, ny, nz)
    head += struct.pack("<6f", *(length * pixel_angstrom for length in (nx, ny, nz)), 90, 90, 90)
    head += struct.pack("<3i3f2i", 1, 2, 3, frames.min(), frames.max(), frames.mean(), 0, 0)
    head = head.ljust(208, b"\0") + b"MAP \x44\x44\0\0" + struct.pack("<fi", frames.std(), 0)
    even = np.pad(frames.astype(np.uint8), ((0, 0), (0, 0), (0, nx % 2)))
    path = folder / "packed.mrc"
    path.write_bytes(head.ljust(1024, b"\0") + (even[..., ::2] | even[..., 1::2] << 4).astype(np.uint8).tobytes())
    return path


# ---- Merlin ----

CHIP = 256


def _words(pixels: Frames, bits: int) -> bytes:
    """Raw Merlin pixels: words of 64 bits, the first pixel in the lowest bits, the word's highest byte first."""
    if bits == 1:
        packed = np.packbits(pixels.astype(np.uint8), axis=-1, bitorder="little").tobytes()
    else:
        packed = _little(pixels.astype(np.uint8 if bits == 6 else np.uint16))
    return np.frombuffer(packed, "<u8").astype(">u8").tobytes()


def _readout(frame: Frames) -> Frames:
    """The rows as the chips deliver them; a quad gives at once lower right and lower left (both turned), upper two."""
    if frame.shape == (CHIP, CHIP):
        return frame
    upper, turned = frame[:CHIP], frame[: CHIP - 1 : -1, ::-1]
    return np.concatenate([turned, upper[:, CHIP:], upper[:, :CHIP]], axis=1)


def _merlin_header(number: int, quad: bool, bits: int, stamp_s: float, exposure_s: float) -> bytes:
    size, chips = (768, 4) if quad else (384, 1)
    across = CHIP * chips * (2 if bits == 24 else 1)
    at = datetime.fromtimestamp(round(stamp_s, 6), UTC)
    layout, mask = ("2x2", "0F") if quad else ("1x1", "01")
    fields = [f"MQ1,{number:06},{size:05},{chips:02},{across:04},{CHIP:04},R64,{layout:>6},{mask}"]
    fields += [f"{at:%Y-%m-%d %H:%M:%S.%f},{exposure_s:.6f},0,0,0,"]
    fields += [f"MQ1A,{at:%Y-%m-%dT%H:%M:%S.%f}000Z,{round(exposure_s * 1e9)}ns,{bits},"]
    return ",".join(fields).encode().ljust(size, b"\0")


def write_mib(folder: Path, frames: Frames, bits: int, stamps_s: Sequence[float], exposure_s: float = 0.01) -> Path:
    """Merlin raw (R64) of 1, 6, 12 or 24 bit, one chip (256, 256) or a quad (512, 512; not 24 bit), with its .hdr.

    Layout: LiberTEM 0.16 (MIT), and the headers of a camera's quad file. 24 bit are two 12-bit readouts, the high one
    first, said in the header as one image of twice the width.
    """
    quad = frames.shape[1:] != (CHIP, CHIP)
    blocks = []
    for number, (frame, stamp) in enumerate(zip(frames, stamps_s, strict=True), 1):
        rows = _readout(frame)
        planes = [(rows >> 12) & 0xFFF, rows & 0xFFF] if bits == 24 else [rows]
        blocks += [_merlin_header(number, quad, bits, stamp, exposure_s), *(_words(plane, bits) for plane in planes)]
    path = folder / f"raw{bits}.mib"
    path.write_bytes(b"".join(blocks))
    lines = ["HDR,\t", "Time and Date Stamp (day, mnth, yr, hr, min, s):\t18/09/2019 11:15:06"]
    lines += [f"Assembly Size (NX1, 2X2):\t   {'2x2' if quad else '1x1'}", f"Counter Depth (number):\t{bits}"]
    lines += [f"Acquisition Time (ms):\t{exposure_s * 1e3:.6f}", f"Frames in Acquisition (Number):\t{len(frames)}"]
    lines += ["Frames per Trigger (Number):\t1", "End\t"]
    path.with_suffix(".hdr").write_text("\r\n".join(lines) + "\r\n", encoding="latin-1", newline="")
    return path


# ---- HDF5: Velox, DECTRIS ----


def _velox_metadata(frame: int, pixel_m: float, stamp_s: float, exposure_s: float, shape: tuple[int, ...]) -> bytes:
    """What Velox says of one frame: JSON whose numbers are texts; Scan.FrameTime is the scan's, not the camera's."""
    said = {
        "Core": {"MetadataDefinitionVersion": "7.9", "MetadataSchemaVersion": "v1/2013/07"},
        "Acquisition": {"AcquisitionStartDatetime": {"DateTime": str(int(stamp_s))}, "SourceType": "XFEG"},
        "Stage": {"AlphaTilt": "0.1", "BetaTilt": "0", "Position": {"x": "0", "y": "0", "z": "0"}},
        "Scan": {"ScanSize": {"width": "0", "height": "0"}, "FrameTime": "0.66151550000000003"},
        "Detectors": {
            "Detector-0": {"DetectorName": "BF", "DetectorType": "ScanningDetector"},
            "Detector-1": {
                "DetectorName": "BM-Ceta",
                "DetectorType": "ImagingDetector",
                "ExposureTime": repr(exposure_s),
            },
        },
        "BinaryResult": {
            "AcquisitionUnit": "CameraImage",
            "ImageSize": {"width": str(shape[1]), "height": str(shape[0])},
            "DetectorIndex": "1",
            "Detector": "BM-Ceta",
            "PixelSize": {"width": repr(pixel_m), "height": repr(pixel_m)},
            "PixelUnitX": "m",
            "PixelUnitY": "m",
            "Encoding": "Signed",
        },
        "CustomProperties": {
            "Detectors[BM-Ceta].FrameID": {"type": "long", "value": str(frame)},
            "Detectors[BM-Ceta].TimeStamp": {"type": "int64", "value": str(round(stamp_s * 1e6))},
        },
    }
    return json.dumps(said, separators=(",", ":")).encode()


def write_velox(folder: Path, frames: Frames, pixel_m: float, stamps_s: Sequence[float], exposure_s: float) -> Path:
    """Velox EMD of a camera: Data/Image/<id>/Data is (y, x, frame), Metadata one column of JSON a frame.

    Layout: a small Velox file of a Ceta camera (openNCEM's test data), opened with h5py.
    """
    path = folder / "velox.emd"
    shape = frames.shape[1:]
    with h5py.File(path, "w") as file:
        file["Version"] = np.array([b'{\n    "version": "8",\n    "format": "Velox"\n}\n'], dtype=object).astype("S")
        image = file.create_group("Data/Image/0b36b39acdb84cd2971d755b7ba267bf")
        image.create_dataset("Data", data=np.moveaxis(frames, 0, -1), chunks=(*shape, 1), maxshape=(*shape, None))
        said = np.zeros((60000, len(frames)), np.uint8)
        for number, stamp in enumerate(stamps_s):
            text = _velox_metadata(number, pixel_m, stamp, exposure_s, shape)
            said[: len(text), number] = np.frombuffer(text, np.uint8)
        image.create_dataset("Metadata", data=said, chunks=(60000, 1), maxshape=(60000, None), compression="gzip")
        image["FrameLookupTable"] = np.arange(len(frames), dtype=np.uint32)
        file.create_group("Data/Text")
    return path


BITSHUFFLE = """
import sys
from pathlib import Path
import h5py, hdf5plugin, numpy as np
folder, per_file = Path(sys.argv[1]), int(sys.argv[2])
frames = np.load(folder / "frames.npy")
for part, start in enumerate(range(0, len(frames), per_file), 1):
    piece = frames[start : start + per_file]
    with h5py.File(folder / f"run_data_{part:06}.h5", "w") as file:
        chunks = dict(chunks=(1, *frames.shape[1:]), **hdf5plugin.Bitshuffle(cname="lz4"))
        stored = file.create_dataset("entry/data/data", data=piece, **chunks)
        stored.attrs["image_nr_low"], stored.attrs["image_nr_high"] = start + 1, start + len(piece)
"""


def write_dectris(folder: Path, frames: Frames, frame_time_s: float, per_file: int, dead: int = 0) -> Path:
    """DECTRIS NeXus: NAME_master.h5 with external links data_000001, ... to files whose chunks are bitshuffle and LZ4.

    Layout: DECTRIS's description of filewriter files (NXmx), and a small master file of an ARINA; filter 32008 written
    by hdf5plugin (MIT), a chunk a frame, in a process of its own: a reader must do without the plugin. The pixel mask
    marks `dead` pixels of the first row. The detector's pixel size is not that of the image: no pixel size is known.
    """
    path = folder / "run_master.h5"
    numbers = {"count_time": frame_time_s, "frame_time": frame_time_s, "x_pixel_size": 1e-4, "y_pixel_size": 1e-4}
    units = {"count_time": "s", "frame_time": "s", "x_pixel_size": "m", "y_pixel_size": "m"}
    with h5py.File(path, "w") as master:
        entry = master.create_group("entry")
        entry.attrs["NX_class"], entry.attrs["default"] = np.bytes_("NXentry"), np.bytes_("data")
        data = entry.create_group("data")
        data.attrs["NX_class"], data.attrs["signal"] = np.bytes_("NXdata"), np.bytes_("data_000001")
        detector = entry.create_group("instrument/detector")
        detector.attrs["NX_class"] = np.bytes_("NXdetector")
        for name, value in numbers.items():
            detector[name] = value
            detector[name].attrs["units"] = np.bytes_(units[name])
        detector["bit_depth_image"] = np.uint32(frames.itemsize * 8)
        specific = detector.create_group("detectorSpecific")
        specific["nimages"], specific["ntrigger"] = np.uint64(len(frames)), np.uint64(1)
        mask = np.zeros(frames.shape[1:], np.uint32)
        mask[0, :dead] = 2
        specific["pixel_mask"] = mask
        for part in range(1, -(-len(frames) // per_file) + 1):
            data[f"data_{part:06}"] = h5py.ExternalLink(f"run_data_{part:06}.h5", "/entry/data/data")
    np.save(folder / "frames.npy", frames)
    subprocess.run([sys.executable, "-c", BITSHUFFLE, str(folder), str(per_file)], check=True)
    (folder / "frames.npy").unlink()
    return path
