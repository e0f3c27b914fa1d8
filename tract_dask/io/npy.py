"""NumPy .npy files."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SourceError
from ..settings import SourceSettings
from ..stores import load_array, sole_parser
from .blocks import open_block
from .source import Frames, Source, SourceMetadata, checked_dtype, checked_shape, truncated, widened

_HEADER_BYTES = 10_000
"""NumPy, too, parses no longer header."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FortranSource(Source):
    """A .npy file with the frame axis fastest (Fortran order), read through a memory map; ``n_bytes`` long."""

    n_bytes: int

    def _read(self, start: int, stop: int) -> Frames:
        size = self.files[0].stat().st_size
        if size < self.n_bytes:  # to touch a map beyond its file would end the process
            raise truncated(self.path, "before the frames that it held when it was opened", self.n_bytes, size)
        frames = load_array(self.files[0], mmap_mode="r").reshape(self.shape)[start:stop]
        return widened(np.array(frames, order="C"), self.dtype)


def open_npy(path: Path, inner: str, settings: SourceSettings) -> Source:
    """Open a .npy file.

    Raises
    ------
    SourceError
        Where the header is damaged, the file too short, or the array not a movie of numbers.
    """
    try:
        shape, fortran, stored, offset = _header(path)
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError, struct.error) as error:
        raise SourceError(
            "the header is not that of a .npy file",
            str(path),
            got=str(error) or type(error).__name__,
            remedy="Save it again with numpy.save",
        ) from error
    source = open_block(path, name="NumPy", shape=shape, stored=stored, offset=offset)
    if not fortran:
        return source
    return FortranSource(
        path=str(path),
        files=(path,),
        format="NumPy",
        shape=checked_shape(shape, str(path)),
        dtype=checked_dtype(stored, str(path)),
        metadata=SourceMetadata(),
        n_bytes=offset + int(np.prod(shape, dtype=object)) * stored.itemsize,
    )


def _header(path: Path) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Return shape, whether the order is Fortran's, pixel type, and where the pixels begin."""
    with path.open("rb") as file:
        first = np.lib.format.read_magic(file) == (1, 0)
        start = file.tell()
        length = struct.unpack("<H" if first else "<I", file.read(2 if first else 4))[0]
        if length > _HEADER_BYTES:
            raise ValueError(f"a header of {length:,} bytes")
        file.seek(start)
        with sole_parser():
            read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
            shape, fortran, stored = read(file)
        return shape, fortran, stored, file.tell()
