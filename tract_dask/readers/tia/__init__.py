"""TIA series (FEI, Thermo Fisher): ``.ser`` holds the images, ``.emi`` beside it the microscope's state."""

from __future__ import annotations

import math
import mmap
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import MissingSourceError, SourceError
from ...settings.run import SourceSettings
from ..blocks import BlockSource, checked_records, read_records
from ..checks import (
    FILLING,
    Frames,
    Permit,
    checked_dtype,
    checked_file,
    checked_shape,
    lies_there,
    open_binary,
    truncated,
    unaccounted,
)
from ..source import SourceMetadata
from ..times import timed_ticks
from ..units import square_pixel, to_pm, to_seconds
from .header import Head, tia_head

_TAGGED = (0x4142, 0x4152)
_ELEMENT = np.dtype("<f8, <f8, <i4, <f8, <f8, <i4, <u2, <i4, <i4")
_ELEMENT.names = ("x0", "dx", "i", "y0", "dy", "j", "type", "nx", "ny")
_TAG = np.dtype([("kind", "<u2"), ("unknown", "<u2"), ("seconds", "<u4")])
_DTYPES = dict(enumerate(("<u1", "<u2", "<u4", "<i1", "<i2", "<i4", "<f4", "<f8", "<c8", "<c16"), 1))
_EXACT_S = 10.0
"""For longer steps whole seconds are exact enough."""


class TiaSource(BlockSource):
    """Images whose lowest row is stored first."""

    def _fill(self, start: int, frames: Frames) -> None:
        super()._fill(start, frames)
        for frame in frames:
            frame[...] = frame[::-1].copy()


def open_tia(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> BlockSource:
    """Open a series of images; an ``.emi`` file opens its only series.

    Raises
    ------
    SourceError
        Where the file is damaged, holds spectra or a scan of images, or its images differ in size or type.
    """
    if path.suffix.lower() == ".emi":
        path = _only_series(path)
        checked_file(path, permit)
    head = tia_head(path)
    offsets, tags = _tables(path, head)
    elements = read_records(path, _inside(path, offsets, _ELEMENT.itemsize), _ELEMENT)
    stored, shape = _alike(path, elements)
    dtype = checked_dtype(stored, str(path))
    n_frames, n_y, n_x = checked_shape((len(offsets), *shape), str(path))
    frame_bytes = n_y * n_x * stored.itemsize
    _check_apart(path, _inside(path, offsets, _ELEMENT.itemsize + frame_bytes), n_y * n_x)
    rest = path.stat().st_size - _end(head, offsets + _ELEMENT.itemsize + frame_bytes, tags)
    known = _metadata(path, head, elements, tags, permit)
    return TiaSource(
        path=str(path),
        files=(path,),
        format="TIA series",
        shape=(n_frames, n_y, n_x),
        dtype=dtype,
        metadata=replace(
            known, notes=known.notes + unaccounted(path.name, rest, frame_bytes, min(frame_bytes, FILLING))
        ),
        offsets=offsets + _ELEMENT.itemsize,
        stored=stored,
    )


def is_emi(path: Path) -> bool:
    """Tell whether a file is the ``.emi`` of a series, which opens by itself."""
    return path.suffix.lower() == ".emi"


def _series_of(emi: Path) -> list[Path]:
    name = re.compile(re.escape(emi.stem) + r"_\d+\.ser", re.IGNORECASE)
    return sorted(file for file in emi.parent.iterdir() if name.fullmatch(file.name))


def _only_series(emi: Path) -> Path:
    found = _series_of(emi)
    if len(found) == 1:
        return found[0]
    if not found:
        raise MissingSourceError(
            "the images of an EMI file lie in a .ser file, which is not there",
            str(emi),
            f"{emi.stem}_1.ser in the same folder",
            "no such file",
            "Copy the .ser files, too",
        )
    raise SourceError(
        "several series belong to this EMI file",
        str(emi),
        "one series",
        ", ".join(file.name for file in found[:9]),
        f"Open one of them, for example {found[0]}",
    )


def _tables(path: Path, head: Head) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where the elements that were written begin, and where their time tags do (none where there are no tags).

    Raises
    ------
    SourceError
        Where the numbers of elements are impossible, or the elements form a scan of two axes.
    """
    size, item = path.stat().st_size, head.offset_type
    long_axes = [length for length, _, _ in head.axes if length != 1]
    if len(long_axes) > 1 and head.n_valid > 1:
        raise SourceError(
            "the series is a scan of images with more than three axes",
            str(path),
            "images along one axis",
            f"{' x '.join(map(str, long_axes))} images",
            "Save the images of one line of the scan, or of one moment",
        )
    if not 0 < head.n_valid <= head.n_elements:
        raise SourceError(
            "no image of the series was written" if head.n_valid == 0 else "the numbers of images are impossible",
            str(path),
            "at least one image, and no more than were planned",
            f"{head.n_valid} of {head.n_elements}",
            "Check the recording, or make the copy again",
        )
    checked_records(head.n_valid, str(path))
    if head.table + head.n_elements * item.itemsize > size:
        raise truncated(str(path), "in its table of offsets", head.table + head.n_elements * item.itemsize, size)
    starts = np.fromfile(path, item, head.n_valid, offset=head.table)
    tags = np.fromfile(path, item, head.n_valid, offset=head.table + head.n_elements * item.itemsize)
    tagged = head.tags in _TAGGED and len(tags) == head.n_valid and int(tags.max()) + _TAG.itemsize <= size
    return _positions(path, starts), tags.astype(np.int64) if tagged else np.empty(0, np.int64)


def _end(head: Head, ends: NDArray[np.int64], tags: NDArray[np.int64]) -> int:
    """Return where a file ends by its tables; ``ends`` are those of the images, each with a tag behind it."""
    tables = head.table + 2 * head.n_elements * head.offset_type.itemsize
    return max(tables, int(ends.max()) + _TAG.itemsize, int(tags.max(initial=0)) + _TAG.itemsize)


def _positions(path: Path, starts: NDArray[Any]) -> NDArray[np.int64]:
    """Return offsets as signed numbers; those beyond the file are its end, to be refused with their frame."""
    size = path.stat().st_size
    return np.minimum(starts.astype(np.uint64), np.uint64(size)).astype(np.int64)


def _inside(path: Path, offsets: NDArray[np.int64], length: int) -> NDArray[np.int64]:
    """Return offsets, each with ``length`` bytes after it in the file.

    Raises
    ------
    SourceError
        Where the file ends before.
    """
    size = path.stat().st_size
    beyond = np.flatnonzero(offsets > size - length)
    if len(beyond):
        k = int(beyond[0])
        raise truncated(str(path), f"in frame {k} of {len(offsets)}", int(offsets[k]) + length, size)
    return offsets


def _check_apart(path: Path, offsets: NDArray[np.int64], n_pixels: int) -> None:
    """Refuse a damaged table, by which images would share bytes."""
    if np.any(np.diff(np.sort(offsets)) < _ELEMENT.itemsize + n_pixels):
        raise SourceError(
            "the images of the series overlap",
            str(path),
            f"{_ELEMENT.itemsize + n_pixels:,} bytes or more from one to the next",
            f"{int(np.diff(np.sort(offsets)).min()):,}",
            "The table of offsets is damaged: make the copy or the export again",
        )


def _alike(path: Path, elements: NDArray[Any]) -> tuple[np.dtype[Any], tuple[int, int]]:
    """Return pixel type and (rows, columns) of all images.

    Raises
    ------
    SourceError
        Where they differ, or the type is unknown.
    """
    kinds = np.stack([elements["type"].astype(np.int64), elements["ny"], elements["nx"]], axis=1)
    other = np.flatnonzero((kinds != kinds[0]).any(axis=1))
    number, n_y, n_x = kinds[0].tolist()
    if len(other):
        got_type, got_y, got_x = kinds[other[0]].tolist()
        raise SourceError(
            "the images of the series differ in size or type",
            str(path),
            f"{n_y} x {n_x} pixels of type {number}, as in frame 0",
            f"{got_y} x {got_x} pixels of type {got_type} in frame {other[0]}",
            "Export the images of one size as TIFF",
        )
    if number not in _DTYPES:
        raise SourceError(
            "the pixels are of an unknown type",
            str(path),
            f"a data type from 1 to {max(_DTYPES)}",
            str(number),
            "Make the copy or the export again",
        )
    return np.dtype(_DTYPES[number]), (n_y, n_x)


def _metadata(
    path: Path, head: Head, elements: NDArray[Any], tags: NDArray[np.int64], permit: Permit | None
) -> SourceMetadata:
    pixel, notes = _pixel_size(path, float(elements[0]["dx"]), float(elements[0]["dy"]))
    changed = np.flatnonzero(elements["dx"] != elements[0]["dx"])
    if len(changed):
        notes += (f"{path.name}: the pixel size changes at frame {changed[0]}; that of frame 0 is used for all",)
    if head.n_valid < head.n_elements:
        notes += (f"{path.name}: {head.n_valid} of {head.n_elements} images were written; the others are left out",)
    known = timed_ticks(read_records(path, tags, _TAG)["seconds"].astype(np.int64), 1, path.name)
    if known.frame_time_s is not None and known.frame_time_s < _EXACT_S:
        notes += (f"{path.name}: its time stamps are whole seconds; the times of frames are no better than that",)
    return replace(
        known,
        pixel_size_pm=pixel,
        frame_time_s=known.frame_time_s or _step_of(head) or _frame_time(path, permit),
        notes=notes + known.notes,
    )


def _pixel_size(path: Path, dx: float, dy: float) -> tuple[float | None, tuple[str, ...]]:
    """Return the pixel size in pm, from calibrations in m; those of diffraction patterns are 1/m."""
    x, y = to_pm(abs(dx), "m"), to_pm(abs(dy), "m")
    if x is None and dx not in (0.0, 1.0):
        said = f"{dx:.6g}" if math.isfinite(dx) else "not a number"
        return None, (f"{path.name}: the step along x, {said}, is not a length in m (of a diffraction pattern: 1/m)",)
    pixel, notes = square_pixel(x, y)
    return pixel, tuple(f"{path.name}: {note}" for note in notes)


def _step_of(head: Head) -> float | None:
    """Return the step of the axis of the series in seconds, where it is one of time."""
    return next((to_seconds(step, unit) for length, step, unit in head.axes if length != 1 and unit), None)


def _frame_time(path: Path, permit: Permit | None) -> float | None:
    """Return the time of a frame in seconds that the ``.emi`` beside a series has, where it has one."""
    emi = path.with_name(re.sub(r"_\d+$", "", path.stem) + ".emi")
    if not lies_there(emi, permit) or not checked_file(emi, permit).st_size:
        return None
    checked_file(emi, permit)
    with open_binary(emi) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        times = {bytes(found[1]) for found in re.finditer(rb"<FrameTime>([0-9.eE+-]{1,30})</FrameTime>", data)}
    try:
        return to_seconds(float(times.pop()), "s") if len(times) == 1 else None
    except ValueError:
        return None
