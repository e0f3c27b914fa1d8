"""MRC stacks (MRC2014 and its older relatives, IMOD's unsigned bytes)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mrcfile.dtypes
import numpy as np

from ..errors import SourceError
from ..settings.run import SourceSettings
from .blocks import BlockSource, open_block
from .source import Permit, SourceMetadata
from .units import square_pixel, to_pm

_HEADER_BYTES = 1024
_MODES = {0: "i1", 1: "i2", 2: "f4", 3: "i2, i2", 4: "c8", 6: "u2", 12: "f2"}
_BIG_ENDIAN = 0x11
_IMOD_STAMP = 1146047817
_DEFAULT_VOXEL = 100.0
"""One angstrom, in pm: what programs write that know nothing."""


def open_mrc(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> BlockSource:
    """Open an MRC stack: sections are frames, the voxel size is the pixel size.

    Raises
    ------
    SourceError
        Where the header is damaged, the file too short, or the pixels complex or packed.
    """
    data = np.fromfile(path, np.uint8, _HEADER_BYTES).tobytes()
    header = _header(data, path)
    mode = int(header["mode"])
    order = header.dtype["mode"].byteorder
    kind = "u1" if mode == 0 and _imod_unsigned(data, order) else _MODES[mode]
    return open_block(
        path,
        name="MRC",
        shape=(int(header["nz"]), int(header["ny"]), int(header["nx"])),
        stored=np.dtype(kind).newbyteorder(order),
        offset=_HEADER_BYTES + max(0, int(header["nsymbt"])),
        metadata=_metadata(header),
    )


def _header(data: bytes, path: Path) -> Any:
    """Return the header in the byte order in which it makes sense; the machine stamp is often wrong."""
    if len(data) == _HEADER_BYTES:
        stamped = ">" if data[212] == _BIG_ENDIAN else "<"
        for order in (stamped, "<" if stamped == ">" else ">"):
            header = np.frombuffer(data, mrcfile.dtypes.HEADER_DTYPE.newbyteorder(order))[0]
            if int(header["mode"]) in _MODES and min(header["nx"], header["ny"]) > 0 and header["nz"] >= 0:
                return header
    raise SourceError(
        "the header is not that of an MRC stack",
        str(path),
        f"{_HEADER_BYTES} bytes with a positive size and one of the modes {', '.join(map(str, _MODES))}",
        f"{len(data)} bytes"
        if len(data) < _HEADER_BYTES
        else f"size and mode {np.frombuffer(data, '<i4', 4).tolist()}",
        "Check the copy, or save it again as mode 1, 2 or 6",
    )


def _imod_unsigned(data: bytes, order: str) -> bool:
    """Tell whether IMOD wrote mode 0 as unsigned bytes: its stamp is there and bit 0 of its flags is not set."""
    stamp, flags = np.frombuffer(data, f"{order}i4", 2, offset=152)
    return bool(stamp == _IMOD_STAMP and not flags & 1)


def _metadata(header: Any) -> SourceMetadata:
    """Return the pixel size; a voxel of exactly 1 Å is a default, not a measurement."""
    x, y = (
        to_pm(
            float(f"{float(header['cella'][axis]) / max(1, int(header[f'm{axis}'])):.7g}"), "Å"
        )  # the digits of a float32
        for axis in ("x", "y")
    )
    if x == _DEFAULT_VOXEL:
        return SourceMetadata()
    pixel, notes = square_pixel(x, y)
    return SourceMetadata(pixel_size_pm=pixel, notes=notes)
