"""What the tags of DigitalMicrograph say about an image: which it is, its pixel type and axes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SourceError
from ..units import to_pm, to_seconds
from .tags import Array, Tags, entries, number, text, value

TYPES: dict[float | None, str] = {1: "i2", 2: "f4", 6: "u1", 7: "i4", 9: "i1", 10: "u2", 11: "u4", 12: "f8", 14: "b1"}
TYPES |= {39: "i8", 40: "u8"}
COLOURS, COMPLEX = (8, 23), (3, 5, 13, 27, 28)
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
        if data_type in COLOURS:
            return "the pixels are RGB colours"
        if data_type in COMPLEX:
            return "the pixels are complex numbers"
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
            "the file holds no image",
            place,
            "an image in ImageList",
            "none",
            "Check how it was exported, and that the copy is whole",
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
    return (*axes[:2], *(axis for axis in axes[2:] if axis.size != 1))


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
    name = TYPES.get(data_type)
    if name is None:
        raise SourceError(
            "the type of the pixels is unknown",
            image.place,
            ", ".join(f"{code} ({known})" for code, known in TYPES.items()),
            f"data type {data_type}",
            "Save the image from DigitalMicrograph as Real (4 byte)",
        )
    stored = np.dtype(name).newbyteorder(order)  # type: ignore[arg-type]
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
