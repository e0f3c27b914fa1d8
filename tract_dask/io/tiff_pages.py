"""The pages of a TIFF: where they are and what they hold, from one walk along their chain of directories.

The walk reads a few hundred bytes a page, so that every page of a long movie can be checked when it is opened.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypeAlias

import numpy as np

from ..errors import SourceError
from .source import truncated

Tags: TypeAlias = dict[int, Any]
"""Tag number to value: bytes for text and opaque data, else a tuple of numbers."""

_TYPES = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 6: "b", 7: "s", 8: "h", 9: "i", 10: "ii", 11: "f", 12: "d"}
_TYPES |= {13: "I", 16: "Q", 17: "q", 18: "Q"}

SUBFILE, WIDTH, LENGTH, BITS, COMPRESSION, FILL_ORDER = 254, 256, 257, 258, 259, 266
STRIP_OFFSETS, SAMPLES, STRIP_ROWS, STRIP_BYTES, PREDICTOR = 273, 277, 278, 279, 317
TILE_WIDTH, TILE_OFFSETS, TILE_BYTES, SAMPLE_FORMAT, DEPTH = 322, 324, 325, 339, 32997
_NEEDED = frozenset(
    (SUBFILE, WIDTH, LENGTH, BITS, COMPRESSION, FILL_ORDER, STRIP_OFFSETS, SAMPLES, STRIP_ROWS, STRIP_BYTES)
) | frozenset((PREDICTOR, TILE_WIDTH, TILE_OFFSETS, TILE_BYTES, SAMPLE_FORMAT, DEPTH))


@dataclass(frozen=True, slots=True)
class Page:
    """One page.

    Attributes
    ----------
    directory
        Position of its directory in the file.
    shape
        Rows and columns, and depth or colours where a pixel has several values.
    stored
        Pixel type with the file's byte order; ``bool`` for single bits.
    offset, end
        Where its data begin, and end at the latest.
    plain
        The data are one run of bytes, row after row, uncompressed.
    reduced
        A small copy of another page.
    """

    directory: int
    shape: tuple[int, ...]
    stored: np.dtype[Any]
    offset: int
    end: int
    plain: bool
    reduced: bool


@dataclass(frozen=True)
class Dialect:
    """How a TIFF spells its numbers: byte order, and the sizes of classic TIFF or of BigTIFF."""

    order: Literal["<", ">"]
    count: str
    entry: str
    pointer: str

    def parse(self, code: str, data: bytes) -> tuple[Any, ...]:
        """Return the numbers in ``data``."""
        return struct.unpack(self.order + code, data)


@dataclass(frozen=True)
class _Tiff:
    """A TIFF that is open, with what it takes to read its directories."""

    file: BinaryIO
    path: Path
    size: int
    dialect: Dialect

    def read(self, start: int, n_bytes: int) -> bytes:
        """Return bytes; none where the file ends before them."""
        if start + n_bytes > self.size:
            return b""
        self.file.seek(start)
        return self.file.read(n_bytes)


def walk(path: Path) -> tuple[list[Page], Tags]:
    """Return all pages of a TIFF in order, and every tag of the first.

    Raises
    ------
    SourceError
        Where the file is no TIFF, ends early, or its chain of pages is damaged.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        dialect, following = _start(file, path)
        tiff = _Tiff(file, path, size, dialect)
        pages: list[Page] = []
        first_tags: Tags = {}
        seen = set()
        while following:
            if following in seen:
                raise SourceError(
                    f"page {len(pages)} leads back to an earlier page", str(path), remedy="Export the movie again"
                )
            seen.add(following)
            entries, after = _directory(tiff, following, len(pages))
            tags = {tag: _value(tiff, *entry) for tag, entry in entries.items() if tag in _NEEDED or not pages}
            page = _page(tags, following, dialect, path, len(pages))
            if page.end > size:
                raise truncated(str(path), f"inside the data of page {len(pages)} (counted from 0)", page.end, size)
            first_tags = first_tags or tags
            pages.append(page)
            following = after
    return pages, first_tags


def _start(file: BinaryIO, path: Path) -> tuple[Dialect, int]:
    """Return the dialect of a TIFF and the place of its first directory."""
    head = file.read(16)
    order: Literal["<", ">"] = ">" if head[:2] == b"MM" else "<"
    version = struct.unpack(order + "H", head[2:4])[0] if head[:2] in (b"II", b"MM") and len(head) >= 8 else 0
    if version == 42:
        return Dialect(order, "H", "HHI4s", "I"), struct.unpack(order + "I", head[4:8])[0]
    if version == 43 and len(head) == 16:
        return Dialect(order, "Q", "HHQ8s", "Q"), struct.unpack(order + "Q", head[8:16])[0]
    raise SourceError(
        "the file is not a TIFF",
        str(path),
        "II or MM and the number 42 or 43 at its start",
        repr(head[:4]) if head else "an empty file",
        "Check the copy and the file's name",
    )


def _directory(tiff: _Tiff, start: int, number: int) -> tuple[dict[int, tuple[int, int, bytes]], int]:
    """Return the entries (tag: type, count, value or its place) of a directory, and where the next one is."""
    dialect = tiff.dialect
    entry = struct.Struct(dialect.order + dialect.entry)
    count_bytes, pointer_bytes = struct.calcsize(dialect.order + dialect.count), struct.calcsize(dialect.pointer)
    head = tiff.read(start, count_bytes)
    n_bytes = entry.size * dialect.parse(dialect.count, head)[0] if head else 0
    tail = tiff.read(start + count_bytes, n_bytes + pointer_bytes) if head else b""
    if not tail:
        expected = start + count_bytes + n_bytes + pointer_bytes
        raise truncated(str(tiff.path), f"before the directory of page {number} (counted from 0)", expected, tiff.size)
    entries = {tag: (kind, count, raw) for tag, kind, count, raw in entry.iter_unpack(tail[:n_bytes])}
    return entries, dialect.parse(dialect.pointer, tail[n_bytes:])[0]


def _value(tiff: _Tiff, kind: int, count: int, raw: bytes) -> Any:
    """Return the value of a tag; empty where its type is unknown or it lies outside the file."""
    code = _TYPES.get(kind)
    if code is None:
        return ()
    n_bytes = struct.calcsize(tiff.dialect.order + code) * count
    inside = n_bytes <= len(raw)
    data = raw[:n_bytes] if inside else tiff.read(tiff.dialect.parse(tiff.dialect.pointer, raw)[0], n_bytes)
    if code == "s":
        return data
    return tiff.dialect.parse(code * count if len(code) > 1 else f"{count}{code}", data) if data else ()


def _page(tags: Tags, directory: int, dialect: Dialect, path: Path, number: int) -> Page:
    """Return a page from its tags."""

    def first(tag: int, default: int = 0) -> int:
        return int((tags.get(tag) or (default,))[0])

    offsets = tags.get(TILE_OFFSETS) or tags.get(STRIP_OFFSETS) or ()
    counts = tags.get(TILE_BYTES) or tags.get(STRIP_BYTES) or ()
    n_y, n_x, n_bits = first(LENGTH), first(WIDTH), first(BITS, 1)
    if not (offsets and min(offsets) >= 0 and n_y > 0 and n_x > 0 and 1 <= n_bits <= 64):
        raise SourceError(
            f"page {number} (counted from 0) does not say where its pixels are",
            str(path),
            "width, length, bits a sample and strip or tile offsets",
            f"width {n_x}, length {n_y}, {n_bits} bits, {len(offsets)} strips or tiles",
            "Export the movie again",
        )
    stored = _pixel_type(first(SAMPLE_FORMAT, 1), n_bits).newbyteorder(dialect.order)
    several = tuple(value for value in (first(SAMPLES, 1), first(DEPTH, 1)) if value > 1)
    row_bytes = n_x * stored.itemsize
    plain = (
        first(COMPRESSION, 1) == first(PREDICTOR, 1) == first(FILL_ORDER, 1) == 1
        and TILE_WIDTH not in tags
        and not several
        and n_bits == 8 * stored.itemsize
        and _adjacent(offsets, min(first(STRIP_ROWS, n_y) or n_y, n_y) * row_bytes)
    )
    end = offsets[0] + n_y * row_bytes if plain else max(map(sum, zip(offsets, counts, strict=False)), default=0)
    return Page(directory, (n_y, n_x, *several), stored, offsets[0], end, plain, bool(first(SUBFILE) & 1))


def _pixel_type(sample_format: int, n_bits: int) -> np.dtype[Any]:
    """Return the smallest NumPy type that holds a sample."""
    if n_bits == 1:
        return np.dtype(bool)
    n_bytes = next(n for n in (1, 2, 4, 8) if n_bits <= 8 * n)
    kind = {2: "i", 3: "f", 5: "c", 6: "c"}.get(sample_format, "u")
    return np.dtype(f"{kind}{max(n_bytes, {'f': 2, 'c': 8}.get(kind, 1))}")


def _adjacent(offsets: tuple[int, ...], strip_bytes: int) -> bool:
    return all(offset == offsets[0] + k * strip_bytes for k, offset in enumerate(offsets))
