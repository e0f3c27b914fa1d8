"""The header of a TIA series: its version, how many images it holds, and the axes along which they are counted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SourceError
from ..checks import open_binary, truncated

_HEADER = np.dtype("<u2, <u2, <u2, <u4, <u4, <i4, <i4")
_HEADER.names = ("order", "series", "version", "kind", "tags", "n", "valid")
_BYTE_ORDER, _SERIES = 0x4949, 0x0197
_OFFSETS = {0x0210: "<u4", 0x0220: "<u8"}
"""Type of an offset by the version of the series."""

_LINE, _IMAGE = 0x4120, 0x4122
_MOST_AXES = 8
_HEAD_BYTES = 1 << 16
"""The header with the names of its axes is never longer."""


@dataclass(frozen=True)
class Head:
    """The header of a series: its version, its numbers of elements, and the axes along which they are counted."""

    version: int
    tags: int
    n_elements: int
    n_valid: int
    table: int
    axes: tuple[tuple[int, float, str], ...]  # length, step, unit

    @property
    def offset_type(self) -> np.dtype[Any]:
        """Type of the offsets in its table."""
        return np.dtype(_OFFSETS[self.version])


def tia_head(path: Path) -> Head:
    """Return the header of a series.

    Raises
    ------
    SourceError
        Where it is damaged, or not that of a series of images.
    """
    with open_binary(path) as file:
        data = file.read(_HEAD_BYTES)
    if len(data) < _HEADER.itemsize + 12:
        raise truncated(str(path), "in its header", _HEADER.itemsize + 12, len(data))
    header = np.frombuffer(data, _HEADER, 1)[0]
    version = int(header["version"])
    if (int(header["order"]), int(header["series"])) != (_BYTE_ORDER, _SERIES) or version not in _OFFSETS:
        raise SourceError(
            "the header is not that of a TIA series",
            str(path),
            "49 49 97 01, then 10 02 or 20 02",
            data[:6].hex(" "),
            "Check the copy, or export the series as TIFF",
        )
    _check_kind(path, int(header["kind"]))
    table, n_axes = _numbers(data, _HEADER.itemsize, _OFFSETS[version])
    first = _HEADER.itemsize + np.dtype(_OFFSETS[version]).itemsize + 4
    axes = tuple(_axes(path, data, first, n_axes))
    return Head(version, int(header["tags"]), int(header["n"]), int(header["valid"]), table, axes)


def _numbers(data: bytes, at: int, offset_type: str) -> tuple[int, int]:
    """Return the place of the table of offsets, and the number of axes."""
    table, n_axes = np.frombuffer(data, np.dtype([("table", offset_type), ("axes", "<i4")]), 1, at)[0].tolist()
    return table, n_axes


def _check_kind(path: Path, kind: int) -> None:
    if kind == _IMAGE:
        return
    raise SourceError(
        "this is a spectrum or a line profile" if kind == _LINE else "the elements are of an unknown kind",
        str(path),
        "images (kind 0x4122)",
        f"kind {kind:#06x}" + " (one axis)" * (kind == _LINE),
        "Open the series of the image detector; TIA writes one .ser file for each detector",
    )


def _axes(path: Path, data: bytes, at: int, n_axes: int) -> Iterator[tuple[int, float, str]]:
    """Yield length, step and unit of each axis of the series."""
    damaged = SourceError(
        "the axes of the series are damaged",
        str(path),
        f"up to {_MOST_AXES} axes with names",
        f"{n_axes} axes",
        "Make the copy or the export again",
    )
    if not 0 <= n_axes <= _MOST_AXES:
        raise damaged
    for _ in range(n_axes):
        size, _start, step, _element = _unpacked(data, at, "<i4, <f8, <f8, <i4", damaged)
        at, _name = _text(data, at + 24, damaged)
        at, unit = _text(data, at, damaged)
        yield size, step, unit


def _unpacked(data: bytes, at: int, kinds: str, damaged: SourceError) -> tuple[Any, ...]:
    dtype = np.dtype(kinds)
    if at + dtype.itemsize > len(data):
        raise damaged
    return tuple(np.frombuffer(data, dtype, 1, at)[0].tolist())


def _text(data: bytes, at: int, damaged: SourceError) -> tuple[int, str]:
    """Return where a text with its length before it ends, and the text."""
    (length,) = np.frombuffer(data[at : at + 4].ljust(4, b"\xff"), "<i4").tolist()
    if not 0 <= length <= len(data) - at - 4:
        raise damaged
    return at + 4 + length, data[at + 4 : at + 4 + length].decode("latin-1").strip("\0 ")
