"""Damaged heaps of texts in HDF5 files, in which libhdf5 (to 2.0) searches forever."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from ...errors import SourceError
from ..checks import open_binary

_SIGN, _HEAD, _OBJECT = b"GCOL", 16, 16
_WHOLE, _END = 16 << 20, 4 << 20
"""A file of so many bytes is looked at as a whole; of a larger one, so many at its beginning and its end."""


def check_heaps(path: Path, size: int) -> None:
    """Check that each heap of texts comes to an end: free space of no bytes is what libhdf5 never gets past.

    Raises
    ------
    SourceError
        Where one does not.
    """
    with open_binary(path, 0) as file:
        for start in (0,) if size <= _WHOLE else (0, size - _END):
            data = os.pread(file.fileno(), _WHOLE if size <= _WHOLE else _END, start)
            if any(_is_endless(data, at) for at in _signs(data)):
                raise SourceError(
                    "the texts in the file are damaged",
                    str(path),
                    "a heap of texts that ends",
                    "free space of no bytes",
                    "Make the copy or the export again",
                )


def _signs(data: bytes) -> Iterator[int]:
    at = data.find(_SIGN)
    while at >= 0:
        yield at
        at = data.find(_SIGN, at + 1)


def _is_endless(data: bytes, at: int) -> bool:
    """Tell whether the heap at a place holds free space of no bytes, before its end."""
    end = at + int.from_bytes(data[at + 8 : at + 16], "little")
    if data[at + 4 : at + 8] != b"\1\0\0\0":
        return False
    at += _HEAD
    while at + _OBJECT <= min(end, len(data)):
        number, length = int.from_bytes(data[at : at + 2], "little"), int.from_bytes(data[at + 8 : at + 16], "little")
        if not number and not length:
            return True
        at += _OBJECT + (length + 7) // 8 * 8 if number else length
    return False
