"""MRC stacks (MRC2014 and its older relatives, IMOD's, SerialEM's, Direct Electron's and FEI's)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mrcfile.dtypes
import numpy as np

from ...errors import SourceError
from ...settings.run import SourceSettings
from ..beside import info_text, known_beside, merged
from ..beside.direct_electron import fields_of
from ..blocks import BlockSource, fill_from
from ..checks import (
    Frames,
    Permit,
    checked_dtype,
    checked_shape,
    maybe_packed,
    open_binary,
    truncated,
    unaccounted,
    untested,
)
from ..source import SourceMetadata
from ..units import square_pixel, to_pm
from .extended import KINDS, read_extended

_HEADER_BYTES = 1024
_MODES = {0: "i1", 1: "i2", 2: "f4", 3: "c8", 4: "c8", 6: "u2", 12: "f2", 16: "V3", 101: "u1"}
"""Pixel types; those of mode 3 (pairs of whole numbers) and 4 are complex, those of mode 16 are colours."""

_BIG_ENDIAN = 0x11
_IMOD_STAMP = 1146047817
_IMOD_SIGNED, _IMOD_PACKED = 1, 16
_DEFAULT_VOXEL = 100.0
"""One angstrom, in pm: what programs write that know nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NibbleSource(BlockSource):
    """Frames of 4 bits a pixel: two in a byte, the first in its lower half; a row ends with its last byte."""

    def _fill(self, start: int, frames: Frames) -> None:
        packed = np.empty((self.shape[1], (self.shape[2] + 1) // 2), np.uint8)
        with open_binary(self.files[0], 0) as file:
            for frame, offset in zip(frames, self.offsets[start : start + len(frames)].tolist(), strict=True):
                fill_from(file, offset, packed, self.files[0])
                frame[:, ::2] = packed & 15
                frame[:, 1::2] = packed[:, : self.shape[2] // 2] >> 4


@dataclass(frozen=True)
class _Pixels:
    """How pixels are stored; ``columns`` are those of the image, which packing halves in some headers."""

    stored: np.dtype[Any]
    columns: int
    packed: bool = False
    notes: tuple[str, ...] = ()


def open_mrc(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> BlockSource:
    """Open an MRC stack: sections are frames, the voxel size is the pixel size.

    Raises
    ------
    SourceError
        Where the header is damaged, the file too short, or the pixels complex or colours.
    """
    data = np.fromfile(path, np.uint8, _HEADER_BYTES).tobytes()
    header = _header(data, path)
    pixels = _pixels(header, data, path, permit)
    row_bytes = (pixels.columns + 1) // 2 if pixels.packed else pixels.columns * pixels.stored.itemsize
    frame_bytes = int(header["ny"]) * row_bytes
    offset = _HEADER_BYTES + max(0, int(header["nsymbt"]))
    n_frames, notes = _count(header, path, offset, frame_bytes)
    half = () if pixels.packed else maybe_packed(pixels.stored, (int(header["ny"]), pixels.columns), path.name)
    shape = checked_shape((n_frames, int(header["ny"]), pixels.columns), str(path))
    return (NibbleSource if pixels.packed else BlockSource)(
        path=str(path),
        files=(path,),
        format="MRC",
        shape=shape,
        dtype=checked_dtype(pixels.stored, str(path)),
        metadata=_metadata(header, path, n_frames, (*pixels.notes, *half, *notes), permit),
        offsets=offset + frame_bytes * np.arange(n_frames, dtype=np.int64),
        stored=pixels.stored,
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


def _pixels(header: Any, data: bytes, path: Path, permit: Permit | None) -> _Pixels:
    """Return how pixels are stored, by the mode, IMOD's flags and the header's range of values.

    Raises
    ------
    SourceError
        Where they are complex or colours.
    """
    mode, columns = int(header["mode"]), int(header["nx"])
    order = header.dtype["mode"].byteorder
    if mode == 16:
        raise SourceError(
            "the pixels are RGB colours",
            str(path),
            "one intensity a pixel",
            "mode 16, three bytes a pixel",
            "Save the movie as greyscale, from the data and not from the screen",
        )
    stamp, flags = (int(number) for number in np.frombuffer(data, f"{order}i4", 2, offset=152))
    flags = flags if stamp == _IMOD_STAMP else 0
    if mode == 101 or (mode == 0 and flags & _IMOD_PACKED):
        note = untested("MRC with 4 bits a pixel", path.name)
        return _Pixels(np.dtype("u1"), columns if mode == 101 else 2 * columns, packed=True, notes=(note,))
    stored = np.dtype(_MODES[mode]).newbyteorder(order)
    checked_dtype(stored, str(path))
    if mode == 1:
        return _words(header, stored, columns, path)
    if mode:
        return _Pixels(stored, columns)
    signed, notes = _is_signed(header, flags if stamp == _IMOD_STAMP else None, path, permit)
    return _Pixels(np.dtype("i1" if signed else "u1"), columns, notes=notes)


def _words(header: Any, stored: np.dtype[Any], columns: int, path: Path) -> _Pixels:
    """Return how 16 bits of mode 1 are meant: with a sign, but some programs put numbers without one there."""
    low, high = float(header["dmin"]), float(header["dmax"])
    if 32767 < high <= 65535 and low >= 0:
        note = f"{path.name}: its header goes up to {high:g}: the numbers of mode 1 are read without a sign"
        return _Pixels(np.dtype("u2").newbyteorder(stored.byteorder), columns, notes=(note,))
    if -32768 <= low < -16384 and low <= high:
        note = (
            f"{path.name}: its numbers go down to {low:g}; counts of 16 bits may have been stored with 32768 taken off"
        )
        return _Pixels(stored, columns, notes=(note,))
    return _Pixels(stored, columns)


def _is_signed(header: Any, flags: int | None, path: Path, permit: Permit | None) -> tuple[bool, tuple[str, ...]]:
    """Tell whether bytes have a sign, and a note where the file does not say; ``flags`` are IMOD's, where it wrote it.

    By the standard they do; cameras' programs write them without.
    """
    if flags is not None:
        return bool(flags & _IMOD_SIGNED), ()
    low, high = float(header["dmin"]), float(header["dmax"])
    counted = fields_of(info_text(path, permit)).get("Autosave Counted Movie Pixel Format")
    if counted == "uint8" or (high > 127 and low <= high):
        return False, ()
    if low < high:  # from 0 to at most 127 both are the same
        return True, ()
    note = f"{path.name}: its header does not say whether bytes go from -128 to 127 (as read) or from 0 to 255"
    return True, (note,)


def _count(header: Any, path: Path, offset: int, frame_bytes: int) -> tuple[int, tuple[str, ...]]:
    """Return the number of frames: the header's, or the file's where whole frames follow those of the header.

    Raises
    ------
    SourceError
        Where the file ends before the last of the header's.
    """
    size, n_frames = path.stat().st_size, int(header["nz"])
    end = offset + n_frames * frame_bytes
    if size < end:
        n_whole = max(0, size - offset) // frame_bytes
        raise truncated(str(path), f"in frame {n_whole} of {n_frames}", end, size)
    more, rest = divmod(size - end, frame_bytes)
    if more and (not rest or not n_frames):
        note = f"{path.name}: its header counts {n_frames} frames, the file has {n_frames + more}; all are read"
        return n_frames + more, (note, *unaccounted(path.name, rest, frame_bytes))
    return n_frames, unaccounted(path.name, size - end, frame_bytes)


def _metadata(header: Any, path: Path, n_frames: int, notes: tuple[str, ...], permit: Permit | None) -> SourceMetadata:
    """Return what the extended header, the header and the files beside say, in the order in which they are believed."""
    known = _of_header(header, path)
    kind, n_bytes = bytes(header["exttyp"]), int(header["nsymbt"])
    if kind in KINDS and n_bytes > 0:
        order = header.dtype["mode"].byteorder
        known = merged(read_extended(path, kind, (_HEADER_BYTES, n_bytes), n_frames, order), known, "the main header")
    known = merged(known, known_beside(path, n_frames, permit), "the file next to it")
    return replace(known, notes=(*known.notes, *notes))


def _of_header(header: Any, path: Path) -> SourceMetadata:
    """Return the pixel size; a voxel of exactly 1 Å is a default, not a measurement."""
    axes = [int(header[name]) for name in ("mapc", "mapr", "maps")]
    notes = _axes_note(axes, path)
    along = axes[:2] if sorted(axes) == [1, 2, 3] else [1, 2]
    sizes, samples = header["cella"], np.array([header["mx"], header["my"], header["mz"]], np.int64)
    x, y = (_voxel(float(sizes["xyz"[axis - 1]]), int(samples[axis - 1])) for axis in along)
    if x == _DEFAULT_VOXEL:
        return SourceMetadata(notes=notes)
    pixel, more = square_pixel(x, y)
    if samples.min() < 1 and float(sizes["x"]) > 0:
        more += (f"{path.name}: the header has the size of the field but not its number of pixels (mx, my, mz)",)
    return SourceMetadata(pixel_size_pm=pixel, notes=notes + more)


def _voxel(cell: float, samples: int) -> float | None:
    return to_pm(float(f"{cell / samples:.7g}"), "Å") if samples > 0 else None  # the digits of a float32


def _axes_note(axes: list[int], path: Path) -> tuple[str, ...]:
    """Return a note on sections that are not along z, and on volumes of a tomogram."""
    if axes in ([1, 2, 3], [0, 0, 0]):
        return ()
    names = ", ".join("?xyz"[axis] if 0 <= axis <= 3 else "?" for axis in axes)
    return (f"{path.name}: its columns, rows and sections are the axes {names} of its specimen; sections are frames",)
