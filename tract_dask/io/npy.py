"""NumPy .npy files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError

import numpy as np

from ..errors import SourceError
from ..settings import SourceSettings
from ..stores import load_array, sole_parser
from .blocks import open_block
from .source import Frames, Source, SourceMetadata, checked_dtype, checked_shape


@dataclass(frozen=True, kw_only=True, eq=False)
class FortranSource(Source):
    """A .npy file with the frame axis fastest (Fortran order), read through a memory map."""

    def read(self, start: int, stop: int) -> Frames:
        """Return frames ``start`` to ``stop`` (not included) as a new array (frames, y, x)."""
        frames = load_array(self.files[0], mmap_mode="r").reshape(self.shape)[start:stop]
        return np.array(frames, dtype=self.dtype, order="C")


def open_npy(path: Path, inner: str, settings: SourceSettings) -> Source:
    """Open a .npy file.

    Raises
    ------
    SourceError
        Where the header is damaged, the file too short, or the array not a movie of numbers.
    """
    try:
        with path.open("rb") as file, sole_parser():
            version = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, fortran, stored = header(file)
            offset = file.tell()
    except (ValueError, TokenError) as error:
        raise SourceError(
            "the header is not that of a .npy file", str(path), got=str(error), remedy="Save it again with numpy.save"
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
    )
