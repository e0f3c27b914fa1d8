"""What the tags of DigitalMicrograph say about an image: pixel type, axes, calibration and times."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SourceError
from .dm_tags import Array, Tags, below, entries, flat, number, text, value
from .source import SourceMetadata
from .units import square_pixel, to_pm, to_seconds

_TYPES = {1: "i2", 2: "f4", 6: "u1", 7: "i4", 9: "i1", 10: "u2", 11: "u4", 12: "f8", 14: "?", 39: "i8", 40: "u8"}
_KINDS = dict.fromkeys((3, 5, 13, 27, 28), "complex numbers") | dict.fromkeys((8, 23), "RGB colours")
"""DigitalMicrograph's numbers of pixel types."""

_MOST_AXES = 16


@dataclass(frozen=True)
class Axis:
    """An axis: pixels along it, the size of one, the coordinate of the first, and their unit."""

    size: int
    scale: float = 1.0
    origin: float = 0.0
    unit: str = ""

    @property
    def is_time(self) -> bool:
        """Whether its unit is one of time."""
        return to_seconds(1.0, self.unit) is not None

    @property
    def is_length(self) -> bool:
        """Whether its unit is one of length."""
        return not self.is_time and any(to_pm(size, self.unit) is not None for size in (1.0, 1e-6))

    @property
    def is_energy(self) -> bool:
        """Whether its unit is one of energy: pixels along it are channels of a spectrum."""
        return self.unit.strip().lower() in ("ev", "kev", "mev")


@dataclass(frozen=True)
class Image:
    """One of the images of a file.

    Attributes
    ----------
    place
        File and number of the image, for errors.
    tags
        Its entry in ``ImageList``.
    axes
        The fastest first: x, y and then frames, as a rule.
    """

    place: str
    number: int
    tags: Tags
    axes: tuple[Axis, ...]

    @property
    def name(self) -> str:
        """The name of the file and the number of the image, for notes."""
        return Path(self.place).name

    @property
    def n_pixels(self) -> int:
        """How many pixels its axes span."""
        return math.prod(axis.size for axis in self.axes)

    @property
    def kind(self) -> str:
        """What its pixels are where they are not intensities, in words; empty where they are."""
        data_type = number(self.tags, "ImageData", "DataType")
        if data_type in _KINDS:
            return f"the pixels are {_KINDS[int(data_type)]}"
        form = text(self.tags, "ImageTags", "Meta Data", "Format").lower()
        if form.startswith("spectrum") or any(axis.is_energy for axis in self.axes):
            return "this is a spectrum, or an image of spectra"
        return "this is a line profile or a spectrum" if len(self.axes) < 2 else ""


def images(tags: Tags, place: str) -> list[Image]:
    """Return the images of a file, without its thumbnails.

    Raises
    ------
    SourceError
        Where there is none.
    """
    found = [
        Image(f"{place}::{k}", k, entry, _axes(entry))
        for k, entry in entries(tags, "ImageList")
        if value(entry, "ImageData", "Data") is not None
    ]
    if not found:
        raise SourceError(
            "the file holds no image", place, "an image in ImageList", "none", "Check how it was exported"
        )
    thumbnails = {number(entry, "ImageIndex") for _, entry in entries(tags, "Thumbnails")}
    shown = _shown(tags)
    if thumbnails or not shown:
        return [image for image in found if image.number not in thumbnails] or found
    return [image for image in found if image.number in shown] or found


def _shown(tags: Tags) -> set[float | None]:
    """Return the numbers of the images that the document shows, which its thumbnails are not."""
    sources = dict(entries(tags, "ImageSourceList"))
    named = (number(entry, "ImageSource") for _, entry in entries(tags, "DocumentObjectList"))
    return {number(sources.get(int(source)), "ImageRef") for source in named if source is not None} - {None}


def chosen(tags: Tags, place: str, inner: str) -> tuple[Image, tuple[str, ...]]:
    """Return the image that ``inner`` numbers, or the largest of intensities; and a note where there are others.

    Raises
    ------
    SourceError
        Where there is no such image, or none of intensities.
    """
    found = images(tags, place)
    if inner:
        every = {str(k): Image(f"{place}::{k}", k, entry, _axes(entry)) for k, entry in entries(tags, "ImageList")}
        image = every.get(inner.strip("/"))
        if image is None or value(image.tags, "ImageData", "Data") is None:
            numbers = ", ".join(str(item.number) for item in found[:20])
            raise SourceError(
                "the file has no image of this number", f"{place}::{inner}", numbers, inner, "Name one of those"
            )
        return image, ()
    fit = [image for image in found if not image.kind] or found
    image = max(fit, key=lambda item: item.n_pixels)
    if len(found) == 1:
        return image, ()
    others = ", ".join(f"::{item.number} ({_size(item)})" for item in found if item is not image)
    return image, (
        f"{Path(place).name}: image {image.number} ({_size(image)}) is read; the file also holds {others[:300]}",
    )


def _size(image: Image) -> str:
    return " x ".join(str(axis.size) for axis in reversed(image.axes))


def _axes(tags: Tags) -> tuple[Axis, ...]:
    sizes = [size for _, size in entries(tags, "ImageData", "Dimensions")][:_MOST_AXES]
    calibrations = dict(entries(tags, "ImageData", "Calibrations", "Dimension"))
    axes = [_axis(int(size) if isinstance(size, int) else 0, calibrations.get(k)) for k, size in enumerate(sizes)]
    while len(axes) > 2 and axes[-1].size == 1:
        axes.pop()
    return tuple(axes)


def _axis(size: int, calibration: object) -> Axis:
    scale, origin = number(calibration, "Scale"), number(calibration, "Origin")
    unit = text(calibration, "Units").strip()
    return Axis(size, 1.0 if scale is None else float(scale), 0.0 if origin is None else float(origin), unit)


def stored_type(image: Image, order: str) -> np.dtype[Any]:
    """Return the type of an image's pixels in the file; ``order`` is that of its bytes.

    Raises
    ------
    SourceError
        Where the pixels are no intensities (complex, RGB, spectra), of an unknown type, or the image has more than
        three axes.
    """
    if image.kind:
        raise SourceError(
            image.kind,
            image.place,
            "one intensity a pixel, and axes x, y and frames",
            f"data type {value(image.tags, 'ImageData', 'DataType')}, axes {_size(image)}",
            "Save its modulus, one colour or one energy from DigitalMicrograph as an image or a stack",
        )
    if len(image.axes) > 3:
        raise SourceError(
            f"the image has {len(image.axes)} axes, as scans of diffraction patterns have",
            image.place,
            "axes x, y and frames",
            _size(image),
            "Save one slice of it from DigitalMicrograph as a stack",
        )
    data_type = number(image.tags, "ImageData", "DataType")
    if data_type not in _TYPES:
        raise SourceError(
            "the type of the pixels is unknown",
            image.place,
            ", ".join(f"{code} ({name})" for code, name in _TYPES.items()),
            f"data type {data_type}",
            "Save the image from DigitalMicrograph as Real (4 byte)",
        )
    stored = np.dtype(_TYPES[int(data_type)]).newbyteorder(order)  # type: ignore[arg-type]
    _check_bytes(image, stored)
    return stored


def _check_bytes(image: Image, stored: np.dtype[Any]) -> None:
    """Check that the array of pixels is as long as the axes and the type say."""
    data, depth = value(image.tags, "ImageData", "Data"), number(image.tags, "ImageData", "PixelDepth")
    expected = image.n_pixels * stored.itemsize
    if isinstance(data, Array) and data.n_bytes != expected:
        got = f"{data.n_bytes:,} bytes"
    elif depth is not None and depth != stored.itemsize:
        expected, got = stored.itemsize, f"{depth} bytes a pixel"
    else:
        return
    raise SourceError(
        "the pixels contradict the axes and the type of the image",
        image.place,
        f"{expected:,} bytes for {_size(image)} {stored}",
        got,
        "The file is damaged: make the copy or the export again",
    )


def frame_axis(image: Image) -> int:
    """Return which axis of three counts the frames: that of time, or the slowest."""
    times = [k for k, axis in enumerate(image.axes) if axis.is_time]
    return times[-1] if times else len(image.axes) - 1


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
        if along.unit and seconds is None:
            notes += (f"{image.name}: its frames are {along.scale:.6g} {along.unit} apart, which is no frame time",)
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
        return (f"{image.name}: its pixels are calibrated in {unit}, which is no length; the pixel size is unknown",)
    absurd = [axis for axis in (x, y) if axis.is_length and _pixel_pm(axis) is None]
    if absurd:
        said = f"{absurd[0].scale:.6g} {absurd[0].unit}"
        return (f"{image.name}: a pixel of {said} makes no sense; the pixel size is unknown",)
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
    return float(stamp) / 1e7 - _EPOCH_S


def stage_tilt(image: Image) -> float | None:
    """Return the stage's tilt in degrees; None where the tags do not say."""
    return number(image.tags, "ImageTags", "Microscope Info", "Stage Position", "Stage Alpha")
