"""StreamPix sequences (NorPix; Direct Electron and other cameras): frames at a fixed stride, each with a time stamp."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SourceError
from ..settings.run import SourceSettings
from .blocks import BlockSource, checked_records, read_records
from .checks import Permit, checked_file, checked_shape, is_named, open_binary, reading, truncated
from .mrc import open_mrc
from .source import SourceMetadata
from .times import timed_ticks

_HEADER_BYTES = 1024
_NUMBERS = ("width", "height", "bits", "bits_real", "image_bytes", "format", "n", "origin", "stride")
_HEADER = np.dtype(
    {
        "names": ["magic", "version", *_NUMBERS, "rate", "compression"],
        "formats": ["<u4", "<i4", *["<u4"] * len(_NUMBERS), "<f8", "<u4"],
        "offsets": [0, 28, *range(548, 548 + 4 * len(_NUMBERS), 4), 584, 620],
        "itemsize": _HEADER_BYTES,
    }
)
_MAGIC = 0xFEED
_VERSIONS = (3, 4, 5, 6)
_LONG_HEADER = 5
"""From this version on the first frame begins at byte 8192, not 1024."""

_GREY = (0, 100)
"""Formats of the image that are one grey value a pixel; 0 says nothing."""

_STAMPS = (
    np.dtype([("s", "<u4"), ("ms", "<u2"), ("us", "<u2")]),
    np.dtype([("s", "<u4"), ("ms", "<u2")]),
)
_BESIDE = {
    "dark": (".dark.mrc", ".dark"),
    "gain": (".gain.mrc", ".gain"),
    "defects": (".Config.Metadata.xml", ".defects.mrc", ".defects"),
    "metadata": (".metadata", ".xml"),
}


def open_seq(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> BlockSource:
    """Open an uncompressed sequence of grey frames; as many as the file holds.

    Raises
    ------
    SourceError
        Where the file is damaged or compressed, or its pixels are colours or packed.
    """
    header = _header(path)
    n_frames, notes = _count(path, header)
    checked_records(n_frames, str(path))
    offsets = header.first + header.stride * np.arange(n_frames, dtype=np.int64)
    known = _times(path, header, offsets)
    if known.frame_time_s is None and math.isfinite(header.rate) and 1e-6 < header.rate < 1e9:
        notes += (f"{path.name}: the frame time is that of the set rate, {header.rate:.6g} frames a second",)
        known = replace(known, frame_time_s=float(f"{1 / header.rate:.9g}"))
    references, odd = _references(path, (header.n_y, header.n_x), permit)
    return BlockSource(
        path=str(path),
        files=(path,),
        format=f"StreamPix {header.version}",
        shape=(n_frames, header.n_y, header.n_x),
        dtype=header.stored.newbyteorder("="),
        metadata=replace(known, notes=(*notes, *known.notes, *odd), references=references),
        offsets=offsets,
        stored=header.stored,
    )


def belongs_to_seq(path: Path) -> bool:
    """Tell whether an MRC file is the dark or gain reference of a sequence beside it."""
    lower = path.name.lower()
    ending = next((end for end in (".dark.mrc", ".gain.mrc", ".defects.mrc") if lower.endswith(end)), "")
    stem = path.name[: -len(ending)] if ending else ""
    names = (name for name in (stem, f"{stem}.seq") if stem and name.endswith(".seq"))
    return any(os.path.lexists(path.with_name(name)) for name in names)


@dataclass(frozen=True)
class _Header:
    """What the header of the file says, checked."""

    version: int
    n_y: int
    n_x: int
    stored: np.dtype[Any]
    first: int
    stride: int
    n_said: int
    rate: float

    @property
    def frame_bytes(self) -> int:
        """Bytes of the pixels of a frame."""
        return self.n_y * self.n_x * self.stored.itemsize


def _header(path: Path) -> _Header:
    with open_binary(path) as file:
        data = file.read(_HEADER_BYTES)
    if len(data) < _HEADER_BYTES:
        raise truncated(str(path), "in its header", _HEADER_BYTES, len(data))
    record = np.frombuffer(data, _HEADER, 1)[0]
    said = dict(zip(_HEADER.names or (), record.tolist(), strict=True))
    if said["magic"] != _MAGIC or said["version"] not in _VERSIONS:
        raise SourceError(
            "the header is not that of a StreamPix sequence",
            str(path),
            f"the number {_MAGIC:#x} and a version from {_VERSIONS[0]} to {_VERSIONS[-1]}",
            f"{said['magic']:#x} and version {said['version']}",
            "Check the copy, or export the sequence as TIFF",
        )
    _, n_y, n_x = checked_shape((said["height"], said["width"]), str(path))
    stored = _stored(path, said, n_y * n_x)
    if said["stride"] < n_y * n_x * stored.itemsize:
        raise SourceError(
            "the header's frames overlap",
            str(path),
            f"at least {n_y * n_x * stored.itemsize:,} bytes from one frame to the next",
            f"{said['stride']:,}",
            "The header is damaged: make the copy or the export again",
        )
    first = 8192 if said["version"] >= _LONG_HEADER else _HEADER_BYTES
    return _Header(said["version"], n_y, n_x, stored, first, said["stride"], said["n"], said["rate"])


def _stored(path: Path, said: dict[str, int], n_pixels: int) -> np.dtype[Any]:
    """Return the pixel type.

    Raises
    ------
    SourceError
        Where the frames are compressed, colours, or packed.
    """
    item = 1 if said["bits"] <= 8 else 2
    refused = (
        (said["compression"] != 0, "the frames are compressed", f"compression {said['compression']}"),
        (said["format"] not in _GREY, "the pixels are colours", f"image format {said['format']}"),
        (not 8 <= said["bits"] <= 16, "the pixels are colours or numbers of another width", f"{said['bits']} bits"),
        (
            said["image_bytes"] not in (0, n_pixels * item),
            "the pixels are packed or padded",
            f"{said['image_bytes']:,} bytes for {n_pixels:,} pixels of {said['bits']} bits",
        ),
    )
    for wrong, what, got in refused:
        if wrong:
            raise SourceError(
                what,
                str(path),
                "uncompressed grey pixels of 8 to 16 bits, one byte or two each",
                got,
                "Export the sequence from StreamPix as uncompressed grey TIFF",
            )
    return np.dtype(f"<u{item}")


def _count(path: Path, header: _Header) -> tuple[int, tuple[str, ...]]:
    """Return how many whole frames the file holds, and a note where its header says otherwise.

    Raises
    ------
    SourceError
        Where there is not one.
    """
    size = path.stat().st_size
    count, rest = divmod(max(0, size - header.first), header.stride)
    if rest >= header.frame_bytes:
        count, rest = count + 1, 0  # without the filling after the last frame
    if not count:
        raise truncated(str(path), "in its first frame", header.first + header.frame_bytes, size)
    notes = []
    if count != header.n_said:
        notes.append(f"{path.name}: the file holds {count} frames, its header says {header.n_said}; {count} are read")
    if rest:
        notes.append(f"{path.name}: {rest} bytes after the last whole frame are not read; the end may be missing")
    return count, tuple(notes)


def _times(path: Path, header: _Header, offsets: NDArray[np.int64]) -> SourceMetadata:
    """Return the times of the frames, by the stamps behind their pixels; older versions have no microseconds."""
    room = min(header.stride, path.stat().st_size - int(offsets[-1])) - header.frame_bytes
    layout = next((stamp for stamp in _STAMPS if stamp.itemsize <= room), None)
    if layout is None:
        return SourceMetadata()
    stamps = read_records(path, offsets + header.frame_bytes, layout)
    micro = stamps["us"].astype(np.int64) if "us" in (layout.names or ()) else np.zeros(len(stamps), np.int64)
    if header.version < _LONG_HEADER and micro.max() >= 1000:
        micro[:] = 0  # whatever lay in memory
    since = (stamps["s"].astype(np.int64) * 1000 + stamps["ms"]) * 1000 + micro
    return timed_ticks(since, 1_000_000, path.name)


def _references(path: Path, shape: tuple[int, int], permit: Permit | None) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Return the files of the detector beside a sequence: ``NAME.dark.mrc``, ``NAME.seq.dark.mrc`` and the like.

    One that cannot be a reference of frames with this ``shape`` is left out; there is a note.
    """
    found, notes = {}, []
    for what, endings in _BESIDE.items():
        names = (path.with_name(f"{stem}{ending}") for ending in endings for stem in (path.stem, path.name))
        there = next((file for file in names if is_named(file)), None)
        if there is None:
            continue
        is_free = permit is None or not there.is_symlink()  # a link is named, not followed
        if there.suffix.lower() == ".mrc" and is_free and (wrong := _unfit(there, shape, permit)):
            notes.append(f"{there.name} next to the movie is by its name the detector's {what} reference, but {wrong}")
        else:
            found[what] = there
    return found, tuple(notes)


def _unfit(file: Path, shape: tuple[int, int], permit: Permit | None) -> str:
    """Return why an MRC file cannot be a reference of frames with a shape (y, x); empty where it can."""
    try:
        checked_file(file, permit)
        with reading(str(file)):
            found = open_mrc(file, "", SourceSettings(), permit).shape
    except SourceError as error:
        return f"it cannot be read ({error.what})"
    if found[1:] == shape:
        return ""
    return f"it has {found[1]} x {found[2]} pixels, and the frames {shape[0]} x {shape[1]}"
