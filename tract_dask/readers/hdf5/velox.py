"""What Velox writes about the images of an EMD file: JSON texts, one a frame, each a column of bytes."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ..calibration import as_number
from ..source import FrameValues, SourceMetadata
from ..times import timed_ticks
from ..units import square_pixel, to_pm, to_seconds
from .axes import VELOX, text, within

_MOST_BYTES, _MOST_COLUMNS = 1 << 20, 1000
"""A text may have so many bytes, and so many are read."""


def is_velox(dataset: Any) -> bool:
    """Tell whether a data set holds images of a Velox file."""
    return VELOX.fullmatch(dataset.name or "") is not None


def velox_metadata(dataset: Any, where: str) -> SourceMetadata:
    """Return pixel size, frame time, and what the frames say of the stage; nothing where there are no such texts.

    A text that is no JSON says nothing; there is a note.
    """
    said = list(_texts(dataset))
    first = next(filter(None, said), None)
    if first is None:
        state = "damaged" if said else "missing"
        return SourceMetadata(notes=(f"{where}: Velox's metadata are {state}",))
    sides = (("width", "PixelUnitX"), ("height", "PixelUnitY"))
    units = [text(_at(first, "BinaryResult", unit)) for _, unit in sides]
    sizes = [as_number(_at(first, "BinaryResult", "PixelSize", side)) for side, _ in sides]
    pixel, notes = square_pixel(*(to_pm(size, unit) for size, unit in zip(sizes, units, strict=True)))
    if pixel is None and units[0] not in ("", "m"):
        notes = (f"{where}: its pixels are measured in {units[0]}, which is not a length; the pixel size is not known",)
    if damaged := [k for k, one in enumerate(said) if not one]:
        notes += (f"{where}: Velox's metadata of {len(damaged)} frames (first {damaged[0]}) are damaged",)
    every = len(said) == dataset.shape[2]
    times = timed_ticks(_stamps(said, first), 1_000_000, where)
    seconds, how = (times.frame_time_s, times.notes) if times.frame_time_s else _frame_time(first, where)
    if times.frame_time_s and not every:
        how += (
            f"{where}: the time stamps of the first {len(said)} frames give the frame time; the others were not read",
        )
    along = _along(said)
    if along and not every:
        how += (f"{where}: {', '.join(along)} of the first {len(said)} frames were read only; they are not kept",)
    along = along | dict(times.along_frames) if every else {}
    return SourceMetadata(pixel, seconds, notes=(*notes, *how), along_frames=along, start_s=times.start_s)


def detector_of(dataset: Any) -> str:
    """Return the name of the detector of a Velox image; empty where it is not known."""
    first = next(_texts(dataset), {})
    return text(_at(first, "BinaryResult", "Detector"))


def _texts(dataset: Any) -> Iterator[dict[str, Any]]:
    """Yield the texts of the frames; of very many frames those of the first."""
    columns = within(dataset.parent, "Metadata", h5py.Dataset)
    if columns is None or columns.ndim != 2 or columns.dtype != np.uint8 or columns.shape[0] > _MOST_BYTES:
        return
    chunk = math.prod(columns.chunks) if columns.chunks else 0
    if chunk > _MOST_BYTES * _MOST_COLUMNS:
        return
    for k in range(min(columns.shape[1], _MOST_COLUMNS)):
        try:
            found = json.loads(columns[:, k].tobytes().partition(b"\0")[0])
        except (ValueError, RecursionError):
            found = {}
        yield found if isinstance(found, dict) else {}


def _at(found: Any, *names: str) -> Any:
    """Return what is at a path of names; empty where nothing is."""
    for name in names:
        found = found.get(name, "") if isinstance(found, dict) else ""
    return "" if isinstance(found, dict) else found


def _stamps(said: list[dict[str, Any]], first: dict[str, Any]) -> NDArray[np.int64]:
    """Return the moments of a camera's frames in µs since 1970; none where one does not say it."""
    key = f"Detectors[{_at(first, 'BinaryResult', 'Detector')}].TimeStamp"
    stamps = np.array([as_number(_at(one, "CustomProperties", key, "value")) for one in said])
    return np.zeros(0, np.int64) if not np.isfinite(stamps).all() else stamps.astype(np.int64)


def _frame_time(said: dict[str, Any], where: str) -> tuple[float | None, tuple[str, ...]]:
    """Return the time of a scan, or a camera's exposure with a note: the scan's time is not that of a camera."""
    name, detectors = _at(said, "BinaryResult", "Detector"), said.get("Detectors")
    listed = [one for one in detectors.values() if isinstance(one, dict)] if isinstance(detectors, dict) else []
    own: dict[str, Any] = next((one for one in listed if name and one.get("DetectorName") == name), {})
    frame, exposure = as_number(_at(said, "Scan", "FrameTime")), as_number(_at(own, "ExposureTime"))
    if own.get("DetectorType") != "ImagingDetector":
        return to_seconds(frame, "s"), ()
    seconds = to_seconds(exposure, "s")
    return seconds, (f"{where}: the frame time is the camera's exposure time",) if seconds else ()


def _along(said: list[dict[str, Any]]) -> dict[str, FrameValues]:
    """Return the tilt of the stage and the temperature of the holder along the frames, where they are known."""
    tilts = {"stage_tilt": "AlphaTilt", "stage_tilt_beta": "BetaTilt"}
    found = {
        name: FrameValues(np.degrees([as_number(_at(one, "Stage", key)) for one in said]), "deg")
        for name, key in tilts.items()
    }
    found["temperature"] = FrameValues(np.array([_temperature(one) for one in said]), "degC")
    return {name: values for name, values in found.items() if not np.isnan(values.values).all()}


def _temperature(said: dict[str, Any]) -> float:
    """Return the holder's temperature; NaN where no property of the user's or of the stage names one in degC."""
    custom = said.get("CustomProperties")
    named = custom.items() if isinstance(custom, dict) else ()
    found = (as_number(_at(value, "value")) for name, value in named if name.lower().endswith("temperature"))
    return next((value for value in found if not math.isnan(value)), math.nan)
