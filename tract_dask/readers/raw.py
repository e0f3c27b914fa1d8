"""Raw binary files, whose shape and pixel type the user declares."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SettingsError, SourceError
from ..settings.run import SourceSettings
from .blocks import BlockSource, open_block
from .checks import Permit
from .source import SourceMetadata


def open_raw(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> BlockSource:
    """Open a raw binary file.

    Raises
    ------
    SettingsError
        Where shape or pixel type are not declared, or make no sense.
    SourceError
        Where the file's size does not fit them.
    """
    shape, dtype = _declared(path, settings)
    n_frames, rest = divmod(path.stat().st_size - settings.raw_offset, shape[1] * shape[2] * max(1, dtype.itemsize))
    if not shape[0] and (n_frames < 1 or rest):
        raise SourceError(
            "the file does not hold a whole number of frames",
            str(path),
            f"frames of {shape[1]} x {shape[2]} {dtype} after {settings.raw_offset} bytes",
            f"{max(0, n_frames)} frames and {rest if n_frames >= 0 else 0:,} bytes over",
            "Check raw_shape, raw_dtype and raw_offset, and whether the copy is complete",
        )
    notes: tuple[str, ...] = ()
    if shape[0] and (n_frames, rest) > (shape[0], 0):
        notes = (f"{path.name} goes on after its {shape[0]} declared frames; what follows is not read",)
    return open_block(
        path,
        name="raw",
        shape=(shape[0] or n_frames, *shape[1:]),
        stored=dtype,
        offset=settings.raw_offset,
        metadata=SourceMetadata(notes=notes),
    )


def _declared(path: Path, settings: SourceSettings) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return the shape (frames or 0, y, x) and the pixel type that the settings declare, checked."""
    shape, stored = settings.raw_shape, settings.raw_dtype
    if shape is None or stored is None:
        missing = " and ".join(name for name, value in (("raw_shape", shape), ("raw_dtype", stored)) if value is None)
        raise SettingsError(
            "a raw file says nothing about itself",
            str(path),
            "raw_shape (frames, y, x) and raw_dtype",
            f"no {missing}",
            "Declare them, for example --raw-shape 0,4096,4096 --raw-dtype uint16",
        )
    if len(shape) != 3 or shape[0] < 0 or min(shape[1:]) < 1:
        raise SettingsError(
            "the shape is not that of a movie",
            "setting raw_shape (SourceSettings)",
            "frames, y, x with y and x at least 1 (frames 0: as many as the file holds)",
            repr(shape),
        )
    try:
        dtype = np.dtype(stored)
    except TypeError as error:
        raise SettingsError(
            "there is no such pixel type",
            "setting raw_dtype (SourceSettings)",
            "a NumPy name such as uint16 or >f4",
            repr(stored),
        ) from error
    return shape, dtype
