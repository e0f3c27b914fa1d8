"""Small files of MRC, TIFF and EER as cameras' programs write them, by writers of our own."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import mrcfile.dtypes
import numpy as np

COUNTS = np.random.default_rng(1).integers(1, 250, (6, 20, 24)).astype("u1")
"""A movie of small whole numbers."""


def mrc(path: Path, frames: np.ndarray, mode: int, *, extended: bytes = b"", order: str = "<", **fields: Any) -> Path:
    """Write an MRC stack; ``fields`` replace those of the header, ``label_bytes`` its bytes from 152 on."""
    header = np.zeros((), mrcfile.dtypes.HEADER_DTYPE.newbyteorder(order))
    header["nz"], header["ny"], header["nx"] = frames.shape
    header["mz"], header["my"], header["mx"] = frames.shape
    header["mode"], header["nsymbt"] = mode, len(extended)
    header["mapc"], header["mapr"], header["maps"] = 1, 2, 3
    header["map"], header["machst"] = b"MAP ", [68, 68, 0, 0] if order == "<" else [17, 17, 0, 0]
    stamp = fields.pop("imod", None)
    for name, value in fields.items():
        header[name] = value
    data = bytearray(header.tobytes())
    if stamp is not None:
        data[152:160] = struct.pack(f"{order}2i", 1146047817, stamp)
    path.write_bytes(bytes(data) + extended + frames.tobytes())
    return path


def nibbles(frames: np.ndarray) -> np.ndarray:
    """Return frames of 4 bits a pixel as packed bytes, the first pixel of two in the lower half."""
    odd = frames.shape[2] % 2
    even = np.pad(frames, ((0, 0), (0, 0), (0, odd))).astype("u1")
    return even[:, :, ::2] | even[:, :, 1::2] << 4


def mrc_4bit(path: Path, frames: np.ndarray) -> Path:
    """Write SerialEM's mode 101."""
    return mrc(path, nibbles(frames), 101, nx=frames.shape[2], mx=frames.shape[2], cella=frames.shape[2])


def fei_records(n_frames: int, kind: str = "FEI2", **values: Any) -> bytes:
    """Return FEI's extended header: a record a frame, with the numbers that are given and the bits that say so."""
    fields = mrcfile.dtypes.get_ext_header_dtype(kind.encode())
    bits = {"Timestamp": 0, "Dose": 6, "Alpha tilt": 7, "Beta tilt": 8, "Pixel size X": 14, "Pixel size Y": 15}
    records = np.zeros(n_frames, fields)
    records["Metadata size"] = fields.itemsize
    for name, value in values.items():
        field = name.replace("_", " ")
        records[field] = value
        records["Bitmask 1"] |= 1 << bits[field]
    return records.tobytes()


Tag = tuple[int, int, int, bytes]
"""Number, type, count, and value as bytes."""


def short(tag: int, *values: int) -> Tag:
    return tag, 3, len(values), struct.pack(f"<{len(values)}H", *values)


def long(tag: int, *values: int) -> Tag:
    return tag, 4, len(values), struct.pack(f"<{len(values)}I", *values)


def opaque(tag: int, data: bytes, kind: int = 7) -> Tag:
    return tag, kind, len(data), data


def tiff(path: Path, pages: list[tuple[bytes, tuple[int, int], list[Tag]]]) -> Path:
    """Write a BigTIFF: of each page the data of its one strip, rows and columns, and more tags; little-endian."""
    out = bytearray(b"II" + struct.pack("<HHHQ", 43, 8, 0, 0))
    link = 8
    for data, (n_y, n_x), more in pages:
        place = len(out)
        out += data
        tags = {tag[0]: tag for tag in [long(256, n_x), long(257, n_y), short(259, 1), short(262, 1), short(277, 1)]}
        tags |= {273: (273, 16, 1, struct.pack("<Q", place)), 278: long(278, n_y), 279: long(279, len(data))}
        tags |= {tag[0]: tag for tag in more}
        entries = bytearray()
        for number, kind, count, value in sorted(tags.values()):
            if len(value) > 8:
                entries += struct.pack("<HHQQ", number, kind, count, len(out))
                out += value
            else:
                entries += struct.pack("<HHQ", number, kind, count) + value.ljust(8, b"\0")
        out[link : link + 8] = struct.pack("<Q", len(out))
        out += struct.pack("<Q", len(tags)) + entries
        link = len(out)
        out += bytes(8)
    path.write_bytes(bytes(out))
    return path


def eer_bits(readout: np.ndarray, skip_bits: int = 7) -> bytes:
    """Return one readout (y, x) of 0 and 1 as runs of empty pixels, each followed by an event's place in its pixel."""
    most = (1 << skip_bits) - 1
    bits, width = 0, 0
    last = -1
    for at in [*np.flatnonzero(readout).tolist(), readout.size]:
        run = at - last - 1
        while run >= most:
            bits |= most << width
            width += skip_bits
            run -= most
        bits |= run << width
        width += skip_bits
        if at < readout.size:
            bits |= 0b0110 << width
            width += 4
        last = at
    return bits.to_bytes(-(-width // 8), "little")


EER_XML = (
    '<metadata><item name="commercialName">Falcon 4</item><item name="exposureTime" unit="s">{seconds}</item>'
    '<item name="numberOfFrames">{frames}</item><item name="totalDose" unit="e/pixel">{dose}</item>'
    '<item name="sensorPixelSize.width" unit="m">{pixel}</item>'
    '<item name="sensorPixelSize.height" unit="m">{pixel}</item></metadata>'
)


def eer(path: Path, readouts: np.ndarray, *, final: bool = False, xml: str = "") -> Path:
    """Write readouts (readouts, y, x) of 0 and 1 as EER; ``final`` puts an ordinary sum before them."""
    text = xml or EER_XML.format(seconds=0.004 * len(readouts), frames=len(readouts), dose=2.0, pixel=1e-10)
    about = opaque(65001, text.encode())
    size = readouts.shape[1:]
    pages = [(eer_bits(readout), size, [short(258, 1), short(259, 65001)]) for readout in readouts]
    if final:
        pages.insert(0, (readouts.sum(0).astype("<u2").tobytes(), size, [short(258, 16)]))
    pages[0][2].append(about)
    return tiff(path, pages)


def stk(path: Path, frames: np.ndarray, seconds: list[float], pixel: tuple[int, int], unit: str) -> Path:
    """Write a MetaMorph stack: one directory, planes one behind the other, times of day, a pixel as a fraction."""
    n_frames, n_y, n_x = frames.shape
    data = frames.astype("<u2").tobytes()
    start = 8
    texts = struct.pack("<2I", *pixel) + struct.pack("<I", len(unit)) + unit.encode("latin-1")
    at = start + len(data)
    about = struct.pack("<8I", 3, 1, 4, at, 5, at, 6, at + 8)
    planes = b"".join(struct.pack("<6I", 1, 1, 2460000, round(1000 * s), 0, 0) for s in seconds)
    about_at = at + len(texts)
    planes_at = about_at + len(about)
    entries = [(256, 4, 1, n_x), (257, 4, 1, n_y), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 1), (273, 4, 1, start)]
    entries += [(277, 3, 1, 1), (278, 4, 1, n_y), (279, 4, 1, 2 * n_y * n_x)]
    entries += [(33628, 4, 4, about_at), (33629, 5, n_frames, planes_at)]
    directory = struct.pack("<H", len(entries)) + b"".join(struct.pack("<HHII", *entry) for entry in entries) + bytes(4)
    body = data + texts + about + planes
    path.write_bytes(b"II*\0" + struct.pack("<I", start + len(body)) + body + directory)
    return path
