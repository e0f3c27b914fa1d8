"""Pixel size and times: of axes, and of attributes that programs give to arrays."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .axes import Axis, Order, plain_unit
from .source import SourceMetadata
from .times import timed
from .units import number, square_pixel, to_pm, to_seconds


def calibrated(axes: Sequence[Axis], order: Order, where: str) -> SourceMetadata:
    """Return pixel size and times as the axes have them; a note for units that are no length, such as 1/nm."""
    sides = [replace(axes[k], unit=plain_unit(axes[k].unit)) for k in (order.x, order.y)]
    x_pm, y_pm = (to_pm(abs(side.scale), side.unit) for side in sides)
    pixel, notes = square_pixel(x_pm if x_pm is not None else y_pm, y_pm)
    if pixel is None and not sides[0].unit and math.isfinite(sides[0].scale) and sides[0].scale not in (0.0, 1.0):
        notes = (f"{where}: its pixels have the size {sides[0].scale:g} without a unit; the pixel size is not known",)
    elif pixel is None and (unit := sides[0].unit) and not to_pm(1.0, unit) and unit.lower() not in _NO_UNITS:
        notes = (f"{where}: its pixels are measured in {unit}, which is not a length; the pixel size is not known",)
    notes += _contradicting(sides, where) if pixel is not None else ()
    times = SourceMetadata() if order.frame is None else _times(axes[order.frame], where)
    return replace(times, pixel_size_pm=pixel, notes=(*notes, *times.notes))


_UNEVEN = 0.01


def _contradicting(sides: Sequence[Axis], where: str) -> tuple[str, ...]:
    """Return notes on the axes x and y where one is no length but the other is, or their places are not even."""
    notes = []
    for side in sides:
        unit = side.unit.lower()
        if not to_pm(1.0, side.unit) and unit not in _NO_UNITS:
            notes.append(f"{where}: its axis {side} is not a length; the pixel size is that of the other axis")
        steps = np.diff(side.values) if side.values is not None else np.zeros(0)
        if len(steps) and np.ptp(steps) > _UNEVEN * abs(np.median(steps)):
            notes.append(f"{where}: its places along {side} are not even; the usual (median) step is used")
    return tuple(notes)


_NO_UNITS = ("", "px", "pixel", "pixels", "<undefined>", "undefined", "none", "n/a", "index", "arb", "a.u.")


def _times(axis: Axis, where: str) -> SourceMetadata:
    unit = plain_unit(axis.unit)
    second = to_seconds(1.0, unit)
    if second and axis.values is not None and len(axis.values) > 1:
        return timed(axis.values * second, Path(where.partition("::")[0]).name)
    seconds = to_seconds(axis.scale, unit)
    return SourceMetadata(frame_time_s=seconds, notes=_no_time(axis, unit, where) if seconds is None else ())


def _no_time(axis: Axis, unit: str, where: str) -> tuple[str, ...]:
    """Return a note where the axis of the frames is calibrated, but not in a unit of time."""
    step = axis.scale if math.isfinite(axis.scale) else 1.0
    if unit.lower() in (*_NO_UNITS, "frame", "frames") and step in (0.0, 1.0):
        return ()
    named = f"along {axis.name}" if axis.name else "of its frames"
    what = f"{axis.scale:.6g} {unit}" if unit else f"{axis.scale:.6g} without a unit"
    return (f"{where}: the step {named} is {what}, which is not a frame time; the frame time is not known",)


DECLARED = ("pixel_size_", "frame_time_")
"""Beginnings of attributes that programs give to arrays, with the unit behind."""


_LENGTH = re.compile(r"(pixel|voxel)_?(size|spacing|width|scale)|(scale|spacing|sampling|dx|dy)$", re.IGNORECASE)
_TIME = re.compile(r"frame_?(rate|time|interval|period)|fps|exposure|(time_?step|delta_?t|dt)$", re.IGNORECASE)
"""Names of attributes that may be meant for a calibration."""


def may_calibrate(name: str) -> bool:
    """Tell whether an attribute of this name says something of pixel size or frame time, understood or not."""
    return _LENGTH.match(name) is not None or _TIME.match(name) is not None


def declared(attributes: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """Return pixel size (pm) and frame time (s) by attributes such as ``pixel_size_nm`` and ``frame_time_ms``.

    Examples
    --------
    >>> declared({"pixel_size_nm": 0.5, "frame_time_ms": "25", "pixel_size": 3})
    (500.0, 0.025)
    """
    pixel = seconds = None
    for name, value in attributes.items():
        unit = name.rpartition("_")[2]
        if name == f"pixel_size_{unit}":
            pixel = to_pm(as_number(value), unit) or pixel
        elif name == f"frame_time_{unit}":
            seconds = to_seconds(as_number(value), unit) or seconds
    return pixel, seconds


def with_declared(said: SourceMetadata, holders: Iterable[Mapping[str, Any]], where: str) -> SourceMetadata:
    """Return what the axes say, filled up by attributes; a note where these contradict it or cannot be understood.

    Parameters
    ----------
    said
        By the axes, which count more.
    holders
        The attributes of what holds the movie, of which the last count most.
    where
        The array, for notes.
    """
    pixel = seconds = None
    notes, odd = [], list[str]()
    for attributes in holders:
        found = declared(attributes)
        pixel, seconds = found[0] or pixel, found[1] or seconds
        odd += [name for name, value in attributes.items() if declared({name: value}) == (None, None)]
    for name in odd:
        known = (said.pixel_size_pm or pixel) if _LENGTH.match(name) else (said.frame_time_s or seconds)
        if name.startswith(DECLARED) or not known:
            notes.append(f"{where}: its attribute {name} cannot be understood; it is not used")
    for what, unit, known, given in (
        ("pixel size", "pm", said.pixel_size_pm, pixel),
        ("frame time", "s", said.frame_time_s, seconds),
    ):
        if known and given and not math.isclose(known, given, rel_tol=0.001):
            notes.append(f"{where}: the {what} is {known:.6g} {unit} by its axes, {given:.6g} {unit} by its attributes")
    return replace(
        said,
        pixel_size_pm=said.pixel_size_pm or pixel,
        frame_time_s=said.frame_time_s or seconds,
        notes=(*said.notes, *notes),
    )


def as_number(value: Any) -> float:
    """Return a number, also of a text that has a comma for its point; NaN where it is none."""
    if isinstance(value, str | bytes):
        return number(value.decode("latin-1") if isinstance(value, bytes) else value)
    try:
        return float(np.asarray(value).item())
    except (TypeError, ValueError, OverflowError):
        return math.nan
