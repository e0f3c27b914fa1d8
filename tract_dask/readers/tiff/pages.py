"""The pages of a TIFF: where they are and what they hold, from one walk along their chain of directories.

The walk reads a few hundred bytes a page, so that every page of a long movie can be checked when it is opened.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...errors import SourceError
from ..checks import open_binary, truncated

Tags: TypeAlias = dict[int, Any]
"""Tag number to value: bytes for text and opaque data, else a tuple of numbers."""

_TYPES = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 6: "b", 7: "s", 8: "h", 9: "i", 10: "ii", 11: "f", 12: "d"}
_TYPES |= {13: "I", 16: "Q", 17: "q", 18: "Q"}

SUBFILE, WIDTH, LENGTH, BITS, COMPRESSION, PHOTOMETRIC, FILL_ORDER = 254, 256, 257, 258, 259, 262, 266
STRIP_OFFSETS, SAMPLES, STRIP_ROWS, STRIP_BYTES, PREDICTOR = 273, 277, 278, 279, 317
TILE_WIDTH, TILE_LENGTH, TILE_OFFSETS, TILE_BYTES, SAMPLE_FORMAT, DEPTH = 322, 323, 324, 325, 339, 32997
DESCRIPTION, X_RESOLUTION, Y_RESOLUTION, RESOLUTION_UNIT = 270, 282, 283, 296
DM_UNITS, DM_SCALES = (65003, 65004, 65005), (65009, 65010, 65011)
ORIENTATION, SUB_PAGES, STK_ABOUT, STK_PLANES = 274, 330, 33628, 33629
SEM_TEXTS = (34680, 34682, 34118)
"""FEI's two, and Zeiss's."""

EER_ABOUT = 65001

_PLACES = frozenset((STRIP_OFFSETS, STRIP_BYTES, TILE_OFFSETS, TILE_BYTES))
_NEEDED = _PLACES | frozenset(
    (
        SUBFILE,
        WIDTH,
        LENGTH,
        BITS,
        COMPRESSION,
        PHOTOMETRIC,
        FILL_ORDER,
        SAMPLES,
        STRIP_ROWS,
        PREDICTOR,
        TILE_WIDTH,
        TILE_LENGTH,
    )
)
_NEEDED |= frozenset((SAMPLE_FORMAT, DEPTH))
_AS_BYTES = frozenset((*SEM_TEXTS, EER_ABOUT))
"""Opaque data, whose type some programs call whole numbers."""

_AS_PLACES = frozenset((STK_ABOUT, STK_PLANES))
"""Tags that hold more than they say: their value here is (count, place)."""

_OF_THE_FIRST = frozenset((DESCRIPTION, X_RESOLUTION, Y_RESOLUTION, RESOLUTION_UNIT, *DM_UNITS, *DM_SCALES))
_OF_THE_FIRST |= _AS_BYTES | _AS_PLACES | frozenset((ORIENTATION, SUB_PAGES))

_UNKNOWN = 1 << 62
"""Bytes of a page that does not say how many it has."""

_FEW = 64
"""So many numbers are read of a tag that does not say where pixels are."""


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
    segment_bytes
        What the largest of its strips or tiles takes once it is decoded.
    plain
        The data are one run of bytes, row after row, uncompressed.
    reduced
        A small copy of another page.
    compression
        The number of its codec.
    n_stored
        Bytes of its data in the file.
    n_bits
        Bits of a sample.
    photometric
        What its numbers mean: 0 white is 0, 1 black is 0, 3 the numbers of a table of colours, others are colours.
    """

    directory: int
    shape: tuple[int, ...]
    stored: np.dtype[Any]
    offset: int
    end: int
    segment_bytes: int
    plain: bool
    reduced: bool
    compression: int
    n_stored: int
    n_bits: int
    photometric: int


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


def walk(path: Path) -> tuple[list[Page], Tags, int]:
    """Return all pages of a TIFF in order, the tags of the first that say something of the movie, and all tags' bytes.

    Raises
    ------
    SourceError
        Where the file is no TIFF, ends early, or its chain of pages is damaged.
    """
    size = path.stat().st_size
    with open_binary(path) as file:
        dialect, following = _start(file, path)
        tiff = _Tiff(file, path, size, dialect)
        pages: list[Page] = []
        first_tags: Tags = {}
        seen = set()
        read = 8 if dialect.pointer == "I" else 16
        while following:
            if following in seen:
                raise _damaged_chain(f"page {len(pages)} leads back to an earlier page", path)
            seen.add(following)
            entries, after, n_bytes = _directory(tiff, following, len(pages))
            wanted = _NEEDED if pages else _NEEDED | _OF_THE_FIRST
            tags = {tag: _value(tiff, tag, *entry) for tag, entry in entries.items() if tag in wanted}
            read += n_bytes
            if read > size + _SLACK:
                raise _damaged_chain(f"the directories up to page {len(pages)} overlap", path)
            page = _page(tags, following, dialect, path, len(pages))
            if page.end > size:
                raise truncated(str(path), f"inside the data of page {len(pages)} (counted from 0)", page.end, size)
            first_tags = first_tags or tags
            pages.append(page)
            following = after
    return pages, first_tags, read


_SLACK = 1 << 16


def _damaged_chain(what: str, path: Path) -> SourceError:
    return SourceError(what, str(path), remedy="Export the movie again")


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


def _directory(tiff: _Tiff, start: int, number: int) -> tuple[dict[int, tuple[int, int, bytes]], int, int]:
    """Return the entries (tag: type, count, value or its place) of a directory, where the next one is, and its bytes.

    Its bytes include those that its tags take elsewhere in the file.
    """
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
    sizes = [_n_bytes(kind, count) for kind, count, _ in entries.values()]
    elsewhere = sum(n for n in sizes if struct.calcsize(dialect.pointer) < n <= tiff.size)
    return entries, dialect.parse(dialect.pointer, tail[n_bytes:])[0], count_bytes + len(tail) + elsewhere


def _n_bytes(kind: int, count: int) -> int:
    return struct.calcsize("<" + _TYPES.get(kind, "")) * count


def _value(tiff: _Tiff, tag: int, kind: int, count: int, raw: bytes) -> Any:
    """Return the value of a tag; empty where its type is unfit or it lies outside the file."""
    code = "s" if tag in _AS_BYTES and kind in (1, 2, 6, 7) else _TYPES.get(kind, "")
    if tag in _AS_PLACES:
        return count, tiff.dialect.parse(tiff.dialect.pointer, raw)[0]
    if not code or (tag in _NEEDED and code not in "BHIQbhiq"):
        return ()
    n_bytes = _n_bytes(kind, count)
    start = None if n_bytes <= len(raw) else tiff.dialect.parse(tiff.dialect.pointer, raw)[0]
    if start is not None and start + n_bytes > tiff.size:
        return ()
    if code != "s" and tag not in _PLACES:
        count, n_bytes = min(count, _FEW), _n_bytes(kind, min(count, _FEW))
    data = raw[:n_bytes] if start is None else tiff.read(start, n_bytes)
    if code == "s":
        return data
    if tag in _PLACES:
        return np.frombuffer(data, tiff.dialect.order + {"I": "u4", "Q": "u8", "H": "u2"}.get(code, code))
    return tiff.dialect.parse(code * count if len(code) > 1 else f"{count}{code}", data) if data else ()


def _page(tags: Tags, directory: int, dialect: Dialect, path: Path, number: int) -> Page:
    """Return a page from its tags."""

    def first(tag: int, default: int = 0) -> int:
        return int((tags.get(tag) or (default,))[0])

    tiled = TILE_WIDTH in tags
    offsets, counts = (
        next((tags[tag] for tag in pair if len(tags.get(tag, ()))), np.zeros(0, np.uint8))
        for pair in ((TILE_OFFSETS, STRIP_OFFSETS), (TILE_BYTES, STRIP_BYTES))
    )
    n_y, n_x, n_bits = first(LENGTH), first(WIDTH), first(BITS, 1)
    raw = first(COMPRESSION, 1) == first(PREDICTOR, 1) == first(FILL_ORDER, 1) == 1 and not tiled
    rows = n_y if raw and len(offsets) == 1 else min(first(STRIP_ROWS, n_y) or n_y, n_y)
    part = (first(TILE_LENGTH), first(TILE_WIDTH)) if tiled else (rows, n_x)
    sound = n_y > 0 and n_x > 0 and 1 <= n_bits <= 64 and min(part) > 0
    needed = -(-n_y // part[0]) * -(-n_x // part[1]) if sound else 1
    if not sound or len(offsets) < needed or offsets.min() < 0:
        raise SourceError(
            f"page {number} (counted from 0) does not say where its pixels are",
            str(path),
            f"width, length, bits a sample and strip or tile offsets{f', {needed} of them' if sound else ''}",
            f"width {n_x}, length {n_y}, {n_bits} bits, {len(offsets)} strips or tiles",
            "Export the movie again",
        )
    stored = _pixel_type(first(SAMPLE_FORMAT, 1), n_bits).newbyteorder(dialect.order)
    several = tuple(value for value in (first(SAMPLES, 1), first(DEPTH, 1)) if value > 1)
    row_bytes = n_x * stored.itemsize
    plain = raw and not several and n_bits == 8 * stored.itemsize and _adjacent(offsets, part[0] * row_bytes)
    end = int(offsets[0]) + n_y * row_bytes if plain else _end(offsets[:needed], counts[:needed])
    n_bytes = part[0] * part[1] * stored.itemsize
    n_stored = n_y * row_bytes if plain else int(counts[:needed].astype(np.float64).sum()) if len(counts) else _UNKNOWN
    return Page(
        directory,
        (n_y, n_x, *several),
        stored,
        int(offsets[0]),
        end,
        n_bytes,
        plain,
        bool(first(SUBFILE) & 1),
        first(COMPRESSION, 1),
        n_stored,
        n_bits,
        first(PHOTOMETRIC, 1),
    )


def _end(offsets: NDArray[Any], counts: NDArray[Any]) -> int:
    """Return where the last strip or tile ends; Python's numbers know no overflow."""
    far = max(int(offsets.max()), int(counts.max(initial=0)))
    if far >= 2**62:
        return far
    ends = offsets.astype(np.int64)
    ends[: len(counts)] += counts.astype(np.int64)
    return int(ends.max())


def _pixel_type(sample_format: int, n_bits: int) -> np.dtype[Any]:
    """Return the smallest NumPy type that holds a sample."""
    if n_bits == 1:
        return np.dtype(bool)
    n_bytes = next(n for n in (1, 2, 4, 8) if n_bits <= 8 * n)
    kind = {2: "i", 3: "f", 5: "c", 6: "c"}.get(sample_format, "u")
    return np.dtype(f"{kind}{max(n_bytes, {'f': 2, 'c': 8}.get(kind, 1))}")


def _adjacent(offsets: NDArray[Any], strip_bytes: int) -> bool:
    return len(offsets) == 1 or bool((np.diff(offsets.astype(np.float64)) == strip_bytes).all())
