"""What compressed strips and tiles say of their own size and end, looked at before a codec believes it."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import Any

from ...errors import SourceError

CODECS = {1: "none", 5: "LZW", 8: "deflate", 32946: "deflate", 50013: "deflate", 32773: "PackBits"}
CODECS |= {50000: "zstd", 34926: "zstd", 34925: "LZMA", 34887: "LERC", 2: "CCITT", 3: "CCITT", 4: "CCITT"}
CODECS |= {6: "JPEG", 7: "JPEG", 33007: "JPEG", 34892: "JPEG", 34933: "PNG", 50001: "WebP", 34927: "WebP"}
CODECS |= {33003: "JPEG 2000", 33004: "JPEG 2000", 33005: "JPEG 2000", 34712: "JPEG 2000"}
CODECS |= {50002: "JPEG XL", 52546: "JPEG XL", 65000: "EER", 65001: "EER", 65002: "EER"}
"""The compressions that are read, by their numbers; what others take cannot be told before they are decoded."""

PART_BYTES = 16 << 20
"""A strip or a tile may take so many bytes, and twice those of its page."""

_WITH_END, _END, _OLD_JPEG = ("JPEG", "JPEG 2000"), b"\xff\xd9", 6
"""The marker at the end of an image, which is nowhere else in its pixels; old JPEG strips are parts of an image."""

_MOST_SCANS, _MOST_TILES = 100, 4096


def check_codestreams(file: Any, page: Any, path: str) -> None:
    """Check the size that each image inside a page claims, and that it ends; ``file`` and ``page`` are tifffile's.

    Raises
    ------
    SourceError
        Where one is far larger than the page, or cut off: the codecs give grey in place of what is missing.
    """
    codec = CODECS.get(int(page.compression), "")
    measure = _MEASURES.get(codec)
    if measure is None:
        return
    itemsize = page.dtype.itemsize if page.dtype is not None else 1
    most = PART_BYTES + 2 * page.imagelength * page.imagewidth * itemsize
    for offset, n_bytes in zip(page.dataoffsets, page.databytecounts, strict=False):
        file.seek(offset)
        data = file.read(n_bytes)
        claimed = measure(data) * itemsize
        if claimed > most:
            raise SourceError(
                f"an image inside page {page.index} (counted from 0) is far larger than the page",
                path,
                f"at most {most:,} bytes",
                f"{claimed:,} bytes",
                "The file is damaged: export the movie again",
            )
        if codec in _WITH_END and data and int(page.compression) != _OLD_JPEG and data.rfind(_END) < 0:
            raise SourceError(
                f"an image inside page {page.index} (counted from 0) is cut off",
                path,
                f"the {codec} marker of its end",
                "none",
                "Make the copy or the export again",
            )


def _jpeg(data: bytes) -> int:
    """Return the samples of the largest frame; of one with very many scans, more than are allowed."""
    if data.count(b"\xff\xda") > _MOST_SCANS:
        return 1 << 62
    frames = re.findall(rb"\xff[\xc0-\xc3\xc5-\xc7\xc9-\xcb\xcd-\xcf]..(?s:.)(....)(.)", data, re.DOTALL)
    sizes = [(*struct.unpack(">HH", size), count[0]) for size, count in frames]
    return max((rows * columns * n for rows, columns, n in sizes if 0 < n <= 4), default=0)


def _jpeg2000(data: bytes) -> int:
    at = data.find(b"\xff\x4f\xff\x51")
    if at < 0 or len(data) < at + 42:
        return 0
    x, y, x0, y0, tile_x, tile_y, _, _ = struct.unpack_from(">8I", data, at + 8)
    tiles = -(-x // max(1, tile_x)) * -(-y // max(1, tile_y))
    n_components = struct.unpack_from(">H", data, at + 40)[0]
    return 1 << 62 if tiles > _MOST_TILES else int(max(0, x - x0) * max(0, y - y0) * n_components)


def _png(data: bytes) -> int:
    columns, rows = struct.unpack_from(">II", data, 16) if len(data) >= 24 else (0, 0)
    return int(columns * rows)


def _lerc(data: bytes) -> int:
    if not data.startswith(b"Lerc2 ") or len(data) < 26:
        return 0
    version = struct.unpack_from("<i", data, 6)[0]
    rows, columns, bands = struct.unpack_from("<iii", data, 14 if version >= 3 else 10)
    return int(max(0, rows) * max(0, columns) * max(1, bands if version >= 4 else 1))


def _webp(data: bytes) -> int:
    kind = data[12:16]
    if kind == b"VP8X" and len(data) >= 30:
        return (1 + int.from_bytes(data[24:27], "little")) * (1 + int.from_bytes(data[27:30], "little"))
    if kind == b"VP8L" and len(data) >= 25:
        bits = int.from_bytes(data[21:25], "little")
        return (1 + (bits & 0x3FFF)) * (1 + (bits >> 14 & 0x3FFF))
    columns, rows = struct.unpack_from("<HH", data, 26) if len(data) >= 30 else (0, 0)
    return int((columns & 0x3FFF) * (rows & 0x3FFF))


def _jpegxl(data: bytes) -> int:
    """Return the pixels by the header of the codestream: a length, a ratio or a second length, bit by bit."""
    at = data.find(b"\xff\x0a")
    bits = int.from_bytes(data[at + 2 : at + 14], "little")

    def take(count: int) -> int:
        nonlocal bits
        value, bits = bits & ((1 << count) - 1), bits >> count
        return value

    small = take(1)

    def length() -> int:
        return 8 * (1 + take(5)) if small else 1 + take((9, 13, 18, 30)[take(2)])

    rows = length()
    ratio = take(3)
    return rows * (2 * rows if ratio else length())


_MEASURES: dict[str, Callable[[bytes], int]] = {
    "JPEG": _jpeg,
    "JPEG 2000": _jpeg2000,
    "PNG": _png,
    "LERC": _lerc,
    "WebP": _webp,
    "JPEG XL": _jpegxl,
}
