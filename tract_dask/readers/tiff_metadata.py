"""What a TIFF's tags and descriptions say about a movie: ImageJ, OME, tifffile's JSON, DigitalMicrograph."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from ..errors import SourceError
from .source import NOTHING_KNOWN, SourceMetadata
from .tiff_pages import DESCRIPTION, DM_SCALES, DM_UNITS, RESOLUTION_UNIT, X_RESOLUTION, Y_RESOLUTION, Tags
from .units import square_pixel, to_pm, to_seconds

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
    """

    format: str = "TIFF"
    frames: int | None = None
    one_run: bool = False
    order: tuple[int, ...] | None = None
    metadata: SourceMetadata = NOTHING_KNOWN


def parse_description(tags: Tags, path: Path, n_pages: int) -> Description:
    """Return what the first page's tags say about the movie, whose file has ``n_pages``.

    Raises
    ------
    SourceError
        Where the file holds more than one time or depth axis, channels, or parts of a movie in other files.
    """
    text = _text(tags, DESCRIPTION).rstrip()
    if text.startswith("ImageJ="):
        return _imagej(text, tags, path)
    if text.endswith("OME>"):
        return _ome(text, path, n_pages)
    if text.startswith('{"shape"'):
        return _shaped(text, tags, path)
    return Description(
        metadata=_dm(tags) or _resolution(tags, _RESOLUTION_UNITS.get(_first(tags, RESOLUTION_UNIT), ""))
    )


def _imagej(text: str, tags: Tags, path: Path) -> Description:
    fields = dict(line.strip().partition("=")[::2] for line in text.splitlines())
    images, channels, slices, times = (_integer(fields, key) for key in ("images", "channels", "slices", "frames"))
    notes = _one_axis(path, channels=channels, slices=slices, frames=times)
    seconds = to_seconds(_number(fields.get("finterval", "")), fields.get("tunit", "s"))
    spatial = _resolution(tags, fields.get("unit", ""))
    metadata = SourceMetadata(spatial.pixel_size_pm, seconds, notes=spatial.notes + notes)
    return Description("ImageJ TIFF", max(images, channels, slices, times), True, metadata=metadata)


def _shaped(text: str, tags: Tags, path: Path) -> Description:
    try:
        fields = json.loads(text)
        shape = [int(n) for n in fields["shape"][:-2] if n > 1]
    except (ValueError, TypeError, LookupError, OverflowError, RecursionError):
        return Description(metadata=_resolution(tags, ""))
    if len(shape) > 1:
        _one_axis(path, **{f"axis {k}": n for k, n in enumerate(shape)})
    unit = _RESOLUTION_UNITS.get(_first(tags, RESOLUTION_UNIT), "")
    n_frames = math.prod(shape) if fields.get("truncated") else None
    return Description("TIFF", n_frames, bool(fields.get("truncated")), metadata=_resolution(tags, unit))


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
        to_pm(_number(pixels.get(f"PhysicalSize{axis}", "")), pixels.get(f"PhysicalSize{axis}Unit", "µm"))
        for axis in "XY"
    )
    pixel, not_square = square_pixel(x, y)
    notes += not_square
    if len(images) > 1:
        notes += (f"{path.name} holds {len(images)} images; the first is read",)
    seconds = to_seconds(_number(pixels.get("TimeIncrement", "")), pixels.get("TimeIncrementUnit", "s"))
    metadata = SourceMetadata(pixel, seconds, notes=notes)
    if spread:
        return Description("OME-TIFF", metadata=metadata)
    order = _ome_order(pixels, n_frames, path) if n_frames <= n_pages else None
    return Description("OME-TIFF", n_frames, order=order, metadata=metadata)


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


def _dm(tags: Tags) -> SourceMetadata | None:
    """Return the calibration that DigitalMicrograph leaves in its own tags."""
    if not all(tags.get(tag) for tag in DM_UNITS[:1] + DM_SCALES[:1]):
        return None
    scales = [_number(str(_first(tags, tag))) for tag in DM_SCALES]
    units = [_text(tags, tag) for tag in DM_UNITS]
    pixel, notes = square_pixel(to_pm(scales[0], units[0]), to_pm(scales[1], units[1]))
    return SourceMetadata(pixel, to_seconds(scales[2], units[2]), notes=notes)


def _resolution(tags: Tags, unit: str) -> SourceMetadata:
    """Return the pixel size from the resolution tags, which count pixels a unit."""
    sizes = []
    for tag in (X_RESOLUTION, Y_RESOLUTION):
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


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _integer(fields: dict[str, str], key: str, default: int = 1) -> int:
    value = fields.get(key, "")
    return int(value) if value.isdecimal() else default


def _first(tags: Tags, tag: int) -> Any:
    return (tags.get(tag) or (0,))[0]
