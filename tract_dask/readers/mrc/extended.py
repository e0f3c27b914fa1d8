"""The extended header that FEI's (Thermo Fisher's) programs write: what each section was taken with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mrcfile.dtypes
import numpy as np
from numpy.typing import NDArray

from ..source import FrameValues, SourceMetadata
from ..times import timed
from ..units import square_pixel, to_pm

KINDS = (b"FEI1", b"FEI2")

_BITS = {"Timestamp": 0, "Dose": 6, "Alpha tilt": 7, "Beta tilt": 8, "Pixel size X": 14, "Pixel size Y": 15}
"""Which bit of the first mask says that a number is there."""

_LONGEST = 1 << 14


def read_extended(path: Path, kind: bytes, place: tuple[int, int], n_frames: int, order: str) -> SourceMetadata:
    """Return pixel size, dose, times and tilts from an extended header.

    Parameters
    ----------
    path
        The file.
    kind
        One of :data:`KINDS`.
    place
        First byte and number of bytes.
    n_frames
        Sections; only the first is looked at where the header has not a record for each.
    order
        Byte order, ``<`` or ``>``.
    """
    start, n_bytes = place
    fields = mrcfile.dtypes.get_ext_header_dtype(kind, order)
    size = int(np.fromfile(path, f"{order}i4", 1, offset=start)[0]) if n_bytes >= 4 else 0
    stride = size if fields.itemsize <= size <= _LONGEST else fields.itemsize
    count = min(n_frames, n_bytes // stride)
    if not count:
        return SourceMetadata()
    raw = np.fromfile(path, np.uint8, count * stride, offset=start)
    records = np.ndarray((len(raw) // stride,), fields, raw.data, strides=(stride,))
    values = {name: _values(records, name, bit) for name, bit in _BITS.items()}
    return _metadata(values, path.name, whole=len(records) == n_frames)


def _values(records: NDArray[np.void], name: str, bit: int) -> NDArray[np.float64]:
    """Return a number of each record; NaN where its mask says that it is not there."""
    there = (records["Bitmask 1"] >> bit) & 1 > 0
    return np.where(there, records[name], np.nan).astype(np.float64)


def _metadata(values: dict[str, NDArray[np.float64]], where: str, *, whole: bool) -> SourceMetadata:
    pixel, notes = square_pixel(*(to_pm(float(values[f"Pixel size {axis}"][0]), "m") for axis in "XY"))
    dose = float(values["Dose"][0]) * 1e-20  # electrons per m^2
    known = SourceMetadata(pixel, dose=float(f"{dose:.9g}") if 0 < dose < 1e9 else None, notes=notes)
    if not whole:
        return known
    days = values["Timestamp"]
    started = float(days[0]) * 86400.0 if days[0] > 0 else None
    seconds = np.round((days - days[0]) * 86400.0, 6)
    stamps = timed(seconds, where) if np.isfinite(seconds).all() and seconds.any() else SourceMetadata()
    along = dict(stamps.along_frames)
    for name, tilt in (("stage_tilt", values["Alpha tilt"]), ("stage_tilt_beta", values["Beta tilt"])):
        if np.isfinite(tilt).any():
            along[name] = FrameValues(tilt, "deg")
    return replace(
        known, frame_time_s=stamps.frame_time_s, notes=notes + stamps.notes, along_frames=along, start_s=started
    )
