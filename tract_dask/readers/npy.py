"""NumPy .npy files."""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SourceError
from ..settings.run import SourceSettings
from .blocks import open_block
from .checks import Frames, Permit, checked_dtype, checked_shape, open_binary, truncated, unaccounted, widened
from .source import Source, SourceMetadata

_HEADER_BYTES = 10_000
"""NumPy, too, parses no longer header."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FortranSource(Source):
    """A .npy file with the frame axis fastest (Fortran order), read through a memory map.

    Attributes
    ----------
    axes, stored
        Shape (two axes where it is one image) and type of the array in the file.
    offset, n_bytes
        Where its pixels begin, and the size of the file that holds them all.
    """

    axes: tuple[int, ...]
    stored: np.dtype[Any]
    offset: int
    n_bytes: int

    def _read(self, start: int, stop: int) -> Frames:
        size = self.files[0].stat().st_size
        if size < self.n_bytes:  # to touch a map beyond its file would end the process
            raise truncated(self.path, "before the frames that it held when it was opened", self.n_bytes, size)
        with open_binary(self.files[0]) as file:
            stack = np.memmap(file, self.stored, "r", self.offset, self.axes, "F").reshape(self.shape)
        return widened(np.array(stack[start:stop], order="C"), self.dtype)


def open_npy(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
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
    n_bytes = math.prod(shape) * stored.itemsize
    frame_bytes = math.prod(shape[-2:]) * stored.itemsize
    notes = unaccounted(path.name, path.stat().st_size - offset - n_bytes, frame_bytes)
    known = SourceMetadata(notes=notes)
    source = open_block(path, name="NumPy", shape=shape, stored=stored, offset=offset, metadata=known)
    if not fortran:
        return source
    return FortranSource(
        path=str(path),
        files=(path,),
        format="NumPy",
        shape=checked_shape(shape, str(path)),
        dtype=checked_dtype(stored, str(path)),
        metadata=known,
        axes=tuple(shape),
        stored=stored,
        offset=offset,
        n_bytes=offset + n_bytes,
    )


def _header(path: Path) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Return shape, whether the order is Fortran's, pixel type, and where the pixels begin."""
    with open_binary(path) as file:
        first = np.lib.format.read_magic(file) == (1, 0)
        length = struct.unpack("<H" if first else "<I", file.read(2 if first else 4))[0]
        if length > _HEADER_BYTES:
            raise ValueError(f"a header of {length:,} bytes")
        text = file.read(length)
        return *_fields(text.decode("latin-1")), file.tell()


_FIELD = re.compile(
    r"""\s*(['"])(?:(descr)\1\s*:\s*(?:(['"])([<>|=]?[A-Za-z]\d*(?:\[\w+\])?)\3|\[[^\]]*\])"""
    r"""|(fortran_order)\1\s*:\s*(True|False)|(shape)\1\s*:\s*\(([-\d\s,]*)\))\s*,?"""
)
"""One of the three fields, as a Python literal."""


def _fields(text: str) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return shape, order and type from a header: by hand, for Python's own parser takes long, and a lock."""
    body = text.strip()
    fields, at = {}, 1
    while found := _FIELD.match(body, at):
        fields[found[2] or found[5] or found[7]] = found
        at = found.end()
    if set(fields) != {"descr", "fortran_order", "shape"} or body[:1] != "{" or body[at:].strip() != "}":
        raise ValueError(text[:200])
    shape = tuple(int(part) for part in fields["shape"][8].split(",") if part.strip())
    stored = np.dtype(fields["descr"][4] or "V1")  # a list of fields is no type of pixels in any case
    return shape, fields["fortran_order"][6] == "True", stored
