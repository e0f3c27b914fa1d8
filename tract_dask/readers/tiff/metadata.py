"""What a TIFF's tags and descriptions say about a movie: ImageJ, OME, tifffile's JSON, DigitalMicrograph."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ...errors import SourceError
from ..source import NOTHING_KNOWN, SourceMetadata
from ..times import timed
from ..units import number, odd_length, odd_time, square_pixel, to_pm, to_seconds
from .pages import (
    DESCRIPTION,
    DM_SCALES,
    DM_UNITS,
    RESOLUTION_UNIT,
    STK_PLANES,
    X_RESOLUTION,
    Y_RESOLUTION,
    Page,
    Tags,
)
from .vendors import of_sem, of_stk

_RESOLUTION_UNITS = {3: "cm"}


@dataclass(frozen=True)
class Description:
    """What the file says of itself.

    Attributes
    ----------
    format
        The dialect's name.
    frames
        Number of frames that it claims; None where it says nothing.
    one_run
        The claim may exceed the pages, because the frames follow each other from the first page's data on.
    order
        Page of each frame, where it is not simply the frame's number.
    metadata
        Pixel size, frame time, notes.
    signed
        Numbers with a sign were stored with an offset that makes them positive.
    as_shown
        Whether white is 0 says only how the movie is shown.
    """

    format: str = "TIFF"
    frames: int | None = None
    one_run: bool = False
    order: tuple[int, ...] | None = None
    metadata: SourceMetadata = NOTHING_KNOWN
    signed: bool = False
    as_shown: bool = False


def parse_description(tags: Tags, path: Path, pages: list[Page]) -> Description:
    """Return what the first page's tags say about the movie of these pages.

    Raises
    ------
    SourceError
        Where the file holds more than one time or depth axis, channels, or parts of a movie in other files.
    """
    text = _text(tags, DESCRIPTION).rstrip()
    if text.startswith("ImageJ="):
        return _imagej(text, tags, path, pages)
    if text.endswith("OME>"):
        return _ome(text, path, len(pages))
    if text.startswith("{") and '"shape"' in text:
        return _shaped(text, tags, path, len(pages))
    if tags.get(STK_PLANES):
        n_planes, metadata = of_stk(tags, path)
        return Description("MetaMorph STK", n_planes, True, metadata=metadata)
    unit = _RESOLUTION_UNITS.get(_first(tags, RESOLUTION_UNIT), "")
    special = _dm(tags, path) or of_sem(tags, pages[0].shape[0], path.name)
    return Description(metadata=special or _resolution(tags, unit))


def _imagej(text: str, tags: Tags, path: Path, pages: list[Page]) -> Description:
    fields = dict(line.strip().partition("=")[::2] for line in text.splitlines())
    images, channels, slices, times = (_integer(fields, key) for key in ("images", "channels", "slices", "frames"))
    notes = _one_axis(path, channels=channels, slices=slices, frames=times)
    n_frames = max(images, channels, slices, times)
    interval, unit = number(fields.get("finterval")), fields.get("tunit", "s")
    notes += odd_time(unit, path.name) if interval > 0 else ()
    notes += _more_pages(n_frames, len(pages), path) if len(pages) > 1 else ()
    lengths = [fields.get("unit", ""), fields.get("yunit", fields.get("unit", ""))]
    spatial = _resolution(tags, *lengths)
    signed, more = _imagej_values(fields, pages[0], path)
    notes = (*spatial.notes, *odd_length(lengths[0], path.name), *notes, *more)
    metadata = SourceMetadata(spatial.pixel_size_pm, to_seconds(interval, unit), notes=notes)
    return Description("ImageJ TIFF", n_frames, True, metadata=metadata, signed=signed, as_shown=True)


def _imagej_values(fields: dict[str, str], page: Page, path: Path) -> tuple[bool, tuple[str, ...]]:
    """Tell whether stored numbers are signed ones with an offset, and return a note where they mean something else.

    ImageJ writes a function (``cf``, 0 is a straight line) and its coefficients, by which a stored number has a value.
    """
    if fields.get("cf", "20") == "20":  # 20 is none
        return False, ()
    offset, slope = number(fields.get("c0")), number(fields.get("c1"))
    straight = fields["cf"] == "0"
    if straight and (offset, slope) == (0, 1):
        return False, ()
    if straight and slope == 1 and page.stored.kind == "u" and offset == -(2.0 ** (8 * page.stored.itemsize - 1)):
        return True, ()
    rule = f"{offset:g} + {slope:g} x" if straight else f"function {fields['cf']} of"
    unit = fields.get("vunit", "").strip()
    return False, (f"{path.name}: ImageJ's values ({rule} the stored number, in {unit or 'no unit'}) are not applied",)


def _more_pages(n_frames: int, n_pages: int, path: Path) -> tuple[str, ...]:
    if n_pages <= n_frames:
        return ()
    return (f"{path.name} has {n_pages} pages, its description counts {n_frames}; all are read",)


def _shaped(text: str, tags: Tags, path: Path, n_pages: int) -> Description:
    try:
        fields = json.loads(text)
        shape = [int(n) for n in fields["shape"][:-2] if n > 1]
    except (ValueError, TypeError, LookupError, OverflowError, RecursionError):
        return Description(metadata=_resolution(tags, ""))
    if len(shape) > 1:
        _one_axis(path, **{f"axis {k}": n for k, n in enumerate(shape)})
    unit = _RESOLUTION_UNITS.get(_first(tags, RESOLUTION_UNIT), "")
    n_frames = math.prod(shape)
    if fields.get("truncated"):
        return Description("TIFF", n_frames, True, metadata=_resolution(tags, unit))
    known = _resolution(tags, unit)
    notes = (f"{path.name} has {n_pages} pages, its description counts {n_frames}; the pages are read",)
    return Description(metadata=known if n_frames == n_pages else replace(known, notes=known.notes + notes))


def _ome(text: str, path: Path, n_pages: int) -> Description:
    if "<!" in text.replace("<!--", ""):
        raise _damaged_ome("a declaration of types or entities, which OME does not know", path)
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise _damaged_ome(str(error), path) from error
    images = root.findall("{*}Image")
    pixels = root.find("{*}Image/{*}Pixels")
    if pixels is None:
        return Description("OME-TIFF")
    channels, slices, times = (_integer(pixels.attrib, key) for key in ("SizeC", "SizeZ", "SizeT"))
    notes = _one_axis(path, channels=channels, slices=slices, frames=times)
    spread = len({part.text for part in pixels.findall("{*}TiffData/{*}UUID")}) > 1
    if spread:
        notes += (f"{path.name} is one part of a movie in several files; its folder or a pattern opens all of them",)
    n_frames = max(channels, slices, times)
    x, y = (
        to_pm(number(pixels.get(f"PhysicalSize{axis}")), pixels.get(f"PhysicalSize{axis}Unit", "µm")) for axis in "XY"
    )
    pixel, not_square = square_pixel(x, y)
    notes += not_square + odd_length(pixels.get("PhysicalSizeXUnit", ""), path.name)
    if len(images) > 1:
        notes += (f"{path.name} holds {len(images)} images; the first is read",)
    seconds = to_seconds(number(pixels.get("TimeIncrement")), pixels.get("TimeIncrementUnit", "s"))
    notes += odd_time(pixels.get("TimeIncrementUnit", ""), path.name)
    metadata = SourceMetadata(pixel, seconds, notes=notes)
    if spread:
        return Description("OME-TIFF", metadata=metadata)
    metadata = _with_planes(metadata, pixels, n_frames, path)
    if n_frames < n_pages:
        note = f"{path.name} has {n_pages} pages, its description names {n_frames}; the others are not read"
        metadata = replace(metadata, notes=(*metadata.notes, note))
    order = _ome_order(pixels, n_frames, path) if n_frames <= n_pages else None
    return Description("OME-TIFF", n_frames, order=order, metadata=metadata)


def _with_planes(known: SourceMetadata, pixels: Any, n_frames: int, path: Path) -> SourceMetadata:
    """Return what is known with the times that planes have; these count more than the increment between them."""
    stamps = np.full(min(n_frames, len(pixels)), np.nan)
    for plane in pixels.findall("{*}Plane"):
        frame = sum(_integer(plane.attrib, f"The{axis}", 0) for axis in "TZC")
        seconds = to_seconds(1.0, plane.get("DeltaTUnit", "s"))
        if frame < len(stamps) and seconds:
            stamps[frame] = number(plane.get("DeltaT")) * seconds
    if len(stamps) < max(2, n_frames) or not np.isfinite(stamps).all() or not np.ptp(stamps):
        return known
    times = timed(stamps, path.name)
    notes = known.notes + times.notes
    usual, said = times.frame_time_s, known.frame_time_s
    if usual and said and not math.isclose(usual, said, rel_tol=0.01):
        notes += (f"{path.name}: its planes are {usual:.6g} s apart, not {said:.6g} s as it says; the planes count",)
    return replace(known, frame_time_s=usual or said, notes=notes, along_frames=times.along_frames)


def _damaged_ome(got: str, path: Path) -> SourceError:
    return SourceError("the OME description is damaged", str(path), got=got, remedy="Export the movie again")


def _ome_order(pixels: Any, n_frames: int, path: Path) -> tuple[int, ...]:
    """Return the page of each frame, as the TiffData elements say."""
    pages = list(range(n_frames))
    named = 0
    for block in pixels.findall("{*}TiffData"):
        page, frame = _integer(block.attrib, "IFD", 0), sum(_integer(block.attrib, f"First{a}", 0) for a in "TZC")
        count = _integer(block.attrib, "PlaneCount", 1 if "IFD" in block.attrib else n_frames)
        steps = max(0, min(count, n_frames - frame))
        named += steps
        if named > 16 * n_frames:
            raise _damaged_ome(f"{n_frames} frames whose pages are named again and again", path)
        pages[frame : frame + steps] = range(page, page + steps)
    return tuple(pages)


def _dm(tags: Tags, path: Path) -> SourceMetadata | None:
    """Return the calibration that DigitalMicrograph leaves in its own tags."""
    if not all(tags.get(tag) for tag in DM_UNITS[:1] + DM_SCALES[:1]):
        return None
    scales = [number(_first(tags, tag)) for tag in DM_SCALES]
    units = [_text(tags, tag) for tag in DM_UNITS]
    pixel, notes = square_pixel(to_pm(scales[0], units[0]), to_pm(scales[1], units[1]))
    return SourceMetadata(pixel, to_seconds(scales[2], units[2]), notes=notes + odd_length(units[0], path.name))


def _resolution(tags: Tags, *units: str) -> SourceMetadata:
    """Return the pixel size from the resolution tags, which count pixels a unit; ``units`` are those of x and of y."""
    sizes = []
    for tag, unit in zip((X_RESOLUTION, Y_RESOLUTION), (units[0], units[-1]), strict=True):
        pixels, per = (*(tags.get(tag) or ()), 0, 0)[:2]
        sizes.append(to_pm(per / pixels, unit) if pixels else None)
    pixel, notes = square_pixel(*sizes)
    return SourceMetadata(pixel, notes=notes)


def _one_axis(path: Path, **lengths: int) -> tuple[str, ...]:
    """Raise unless at most one of the axes is longer than 1; return a note where that one is the channel.

    Programs that know no time axis, tifffile among them, call the frames of a plain stack channels.
    """
    if sum(n > 1 for n in lengths.values()) > 1:
        raise SourceError(
            "the data are not a movie",
            str(path),
            "one axis of frames, and y and x",
            ", ".join(
                f"{n} {name}" if not name.startswith("axis") else f"{name} of {n}" for name, n in lengths.items()
            ),
            "Save one channel, or one slice over time, as a separate file",
        )
    n_channels = lengths.get("channels", 1)
    return (f"the {n_channels} channels of {path.name} are taken for frames",) if n_channels > 1 else ()


def _text(tags: Tags, tag: int) -> str:
    raw = tags.get(tag)
    if not isinstance(raw, bytes):
        return ""
    try:
        return raw.decode("utf-8").strip("\0")
    except UnicodeDecodeError:
        return raw.decode("latin-1").strip("\0")


def _integer(fields: dict[str, str], key: str, default: int = 1) -> int:
    value = fields.get(key, "")
    return int(value) if value.isdecimal() else default


def _first(tags: Tags, tag: int) -> Any:
    return (tags.get(tag) or (0,))[0]
