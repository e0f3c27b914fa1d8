"""What the tags of a DigitalMicrograph image say of its pixel size, its times and its intensities."""

from __future__ import annotations

import math
import re

from ..source import SourceMetadata
from ..units import square_pixel, to_pm, to_seconds
from .image import Axis, Image, frame_axis
from .tags import below, flat, number, text


def calibration(image: Image) -> SourceMetadata:
    """Return pixel size and frame time of an image of two or three axes, and what the user should know of them."""
    frames = frame_axis(image) if len(image.axes) == 3 else None
    x, y = (axis for k, axis in enumerate(image.axes) if k != frames)
    pixel, notes = square_pixel(_pixel_pm(x), _pixel_pm(y))
    notes = tuple(f"{image.name}: {note}" for note in notes) + _of_units(image, x, y)
    seconds = None
    if frames is not None:
        along = image.axes[frames]
        seconds = to_seconds(along.scale, along.unit)
        if seconds is None and (along.unit or along.scale not in (0.0, 1.0)):
            unit = along.unit or "(no unit)"
            notes += (f"{image.name}: its frames are {along.scale:.6g} {unit} apart, which is not a frame time",)
    if seconds is None:
        seconds, more = _of_tags(image)
        notes += more
    return SourceMetadata(pixel, seconds, notes=notes + _of_brightness(image))


def _pixel_pm(axis: Axis) -> float | None:
    return to_pm(abs(axis.scale), axis.unit) if axis.is_length else None


def _of_units(image: Image, x: Axis, y: Axis) -> tuple[str, ...]:
    """Return notes where x and y are calibrated in other units than lengths, differ in kind, or make no sense."""
    units = {axis.unit for axis in (x, y) if axis.unit and not axis.is_length}
    if units:
        unit = " and ".join(sorted(units))
        return (f"{image.name}: its pixels are calibrated in {unit}, which is not a length; the pixel size is unknown",)
    absurd = [axis for axis in (x, y) if axis.is_length and _pixel_pm(axis) is None]
    if absurd:
        said = f"{absurd[0].scale:.6g} {absurd[0].unit}"
        return (f"{image.name}: a pixel of {said} is impossible; the pixel size is unknown",)
    if x.is_length != y.is_length:
        return (f"{image.name}: only one of x and y is calibrated; check the pixel size",)
    return ()


_EXPOSURES = (
    ("Acquisition", "Parameters", "High Level", "Exposure (s)"),
    ("Acquisition", "Parameters", "Detector", "exposure (s)"),
    ("DataBar", "Exposure Time (s)"),
)
_TIME = re.compile(r"frame (?:time|duration|interval|period)(?: \((\w+)\))?")
_RATE = re.compile(r"frame ?rate(?: \(.*\))?|frames per second|fps")


def _of_tags(image: Image) -> tuple[float | None, tuple[str, ...]]:
    """Return the frame time from tags of an in-situ camera, or its exposure; and a note that says which."""
    tags = below(image.tags, "ImageTags")
    for path, found in flat(below(tags, "In-situ"), "In-situ/"):
        name = path.rsplit("/", 1)[-1].lower()
        if isinstance(found, int | float) and math.isfinite(found) and found > 0:
            match = _TIME.fullmatch(name)
            rate = to_seconds(1 / found, "s") if _RATE.fullmatch(name) else None
            seconds = to_seconds(found, match[1] or "s") if match else rate
            if seconds is not None:
                return seconds, (f"{image.name}: the frame time is that of the tag {path}",)
    for names in _EXPOSURES:
        seconds = to_seconds(number(tags, *names) or math.nan, "s")
        if seconds is not None:
            said = f"an exposure of {seconds:.6g} s and no frame time"
            return seconds, (f"{image.name}: its tags have {said}; the exposure is used unless time stamps say more",)
    return None, ()


def _of_brightness(image: Image) -> tuple[str, ...]:
    """Return a note where DigitalMicrograph shows other numbers than those that are stored."""
    place = below(image.tags, "ImageData", "Calibrations", "Brightness")
    scale, origin, unit = number(place, "Scale"), number(place, "Origin"), text(place, "Units")
    if scale in (None, 0, 1) and origin in (None, 0):
        return ()
    shown = f"{scale or 1:.6g} times (stored number - {origin or 0:.6g}) {unit}".strip()
    return (f"{image.name}: DigitalMicrograph shows {shown}; the numbers are read as stored, see the setting gain",)


_EPOCH_S = 11_644_473_600
"""From 1601, where Windows begins to count, to 1970."""


def started(image: Image) -> float | None:
    """Return when an image was acquired, in seconds since 1970; None where its tags do not say."""
    stamp = number(image.tags, "ImageTags", "DataBar", "Acquisition Time (OS)")
    if stamp is None or not 1e17 < stamp < 2e17:  # 1917 to 2234
        return None
    return round(float(stamp) / 1e7 - _EPOCH_S, 5)  # as a float64 it is exact to 2 microseconds


def stage_tilt(image: Image) -> float | None:
    """Return the stage's tilt in degrees; None where the tags do not say."""
    return number(image.tags, "ImageTags", "Microscope Info", "Stage Position", "Stage Alpha")
