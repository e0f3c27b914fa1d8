"""Falcon's EER: electrons event by event, a page for each readout of the camera; frames are sums of readouts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray

from ...errors import SourceError
from ...settings.run import SourceSettings
from ..beside import known_beside, merged
from ..checks import (
    DAMAGE,
    FILLING,
    Frames,
    Permit,
    checked_claim,
    checked_dtype,
    checked_file,
    checked_shape,
    unaccounted,
    untested,
)
from ..source import Source, SourceMetadata
from ..units import number, square_pixel, to_pm, to_seconds
from . import undecoded
from .pages import EER_ABOUT, Page, Tags, walk

READOUTS = 40
"""Readouts in a frame where the path does not say otherwise: 0.16 s of a Falcon 4 at 250 readouts a second."""

_CODECS = (65000, 65001, 65002)
_BITS = (65007, 65008, 65009)
"""Tags of the third: bits of a run, and of an event's place along x and y."""

_PER_PIXEL = ("e/pixel", "e/px", "electrons/pixel")


@dataclass(frozen=True, kw_only=True, eq=False)
class EerSource(Source):
    """Sums of readouts.

    Attributes
    ----------
    directories
        The place of each readout's tags.
    readouts
        How many are in a frame.
    """

    directories: NDArray[np.int64]
    readouts: int

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""
        return True

    def _read(self, start: int, stop: int) -> Frames:
        frames = np.zeros((max(0, stop - start), *self.shape[1:]), self.dtype)
        first = page = start * self.readouts
        try:
            checked_file(self.files[0])
            with tifffile.TiffFile(self.files[0]) as tiff:
                for page in range(first, first + len(frames) * self.readouts):
                    readout = _decoded(tiff, int(self.directories[page]), page, self.shape[1:])
                    frames[(page - first) // self.readouts] += readout
        except DAMAGE as error:
            raise undecoded(page, self.path, error) from error
        return frames


_PADDING = bytes(4)


def _decoded(tiff: tifffile.TiffFile, directory: int, number: int, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return where a readout has electrons (y, x).

    Its one strip holds runs of empty pixels, each followed by an event's place within its pixel, least bit first; a run
    of all ones has no event. The decoder wants an even number of bytes, and more than the last event has, so zeros
    follow; what they alone would add is taken away.
    """
    tiff.filehandle.seek(directory)
    page = tifffile.TiffPage(tiff, index=number)
    bits = [8 if page.compression == _CODECS[0] else 7, 2, 2]
    if page.compression == _CODECS[2]:
        bits = [int(page.tags.valueof(tag, usual)) for tag, usual in zip(_BITS, bits, strict=True)]
    if len(page.dataoffsets) != 1:
        raise ValueError(f"{len(page.dataoffsets)} strips, where a readout has one")
    tiff.filehandle.seek(page.dataoffsets[0])
    data = tiff.filehandle.read(page.databytecounts[0])
    padded = data + _PADDING[len(data) % 2 :]
    readout: NDArray[np.bool_] = imagecodecs.eer_decode(padded, shape, *bits)
    places = np.flatnonzero(readout)
    runs = np.diff(places, prepend=-1) - 1
    ends = np.cumsum(sum(bits) + bits[0] * (runs // ((1 << bits[0]) - 1)))
    readout.reshape(-1)[places[ends > 8 * len(data)]] = False
    return readout


def open_eer(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> EerSource:
    """Open an EER movie; ``inner`` is the number of readouts that are summed into a frame.

    Raises
    ------
    SourceError
        Where the file is damaged or has no readouts, or ``inner`` is no such number.
    """
    pages, tags, tag_bytes = walk(path)
    raw = [page for page in pages if page.compression in _CODECS]
    if not raw:
        raise SourceError(
            "the file has no readouts of a camera",
            str(path),
            f"pages of the compressions {', '.join(map(str, _CODECS))}",
            f"{len(pages)} other pages",
            "Name a plain TIFF .tif",
        )
    readouts = _readouts(inner, len(raw), path)
    _check(raw, path)
    n_frames = len(raw) // readouts
    metadata = _metadata(tags, len(raw), readouts, path)
    notes = (f"{path.name}: {len(pages) - len(raw)} of its pages are no readouts, such as a sum, and are not read",)
    rest = path.stat().st_size - tag_bytes - sum(page.n_stored for page in pages)
    more = unaccounted(path.name, rest, 0, FILLING)
    metadata = replace(metadata, notes=(*metadata.notes, *(notes if len(pages) > len(raw) else ()), *more))
    return EerSource(
        path=str(path),
        files=(path,),
        format="EER",
        shape=checked_shape((n_frames, *raw[0].shape), str(path)),
        dtype=np.dtype(np.uint8 if readouts < 256 else np.uint16),
        metadata=merged(metadata, known_beside(path, n_frames, permit), "the file next to it"),
        inside=inner,
        directories=np.array([page.directory for page in raw], np.int64),
        readouts=readouts,
    )


def _readouts(inner: str, n_raw: int, path: Path) -> int:
    text = inner.strip("/ ")
    if not text:
        return min(READOUTS, n_raw)
    if not (text.isascii() and text.isdecimal() and len(text) < 6 and 1 <= int(text) <= min(n_raw, 65535)):
        raise SourceError(
            "this is not a number of readouts",
            f"{path}::{inner}",
            f"how many of its {n_raw} readouts are summed into a frame, 1 to {min(n_raw, 65535)}",
            inner,
            f"Open {path}::{min(READOUTS, n_raw)}",
        )
    return int(text)


def _check(raw: list[Page], path: Path) -> None:
    """Check that all readouts are alike, and no larger than memory."""
    size = path.stat().st_size
    for count, page in enumerate(raw):
        if page.shape != raw[0].shape or len(page.shape) != 2:
            raise SourceError(
                f"readout {count} (counted from 0) differs from the first",
                str(path),
                " x ".join(map(str, raw[0].shape[:2])),
                " x ".join(map(str, page.shape)),
                "The file is damaged: make the copy again",
            )
    checked_dtype(raw[0].stored, str(path))
    checked_claim(math.prod(raw[0].shape) * 2, size, str(path))


def _metadata(tags: Tags, n_raw: int, readouts: int, path: Path) -> SourceMetadata:
    """Return pixel size, frame time and dose by the XML of the first page."""
    items = _items(tags.get(EER_ABOUT))
    notes: tuple[str, ...] = (untested("EER", path.name),)
    unread = n_raw % readouts
    if unread:
        notes += (
            f"{path.name}: the last {unread} of {n_raw} readouts do not fill a frame of {readouts}; they are left out",
        )
    pixel, more = square_pixel(
        *(to_pm(*items.get(f"sensorPixelSize.{side}", _NOTHING)) for side in ("width", "height"))
    )
    said = items.get("numberOfFrames", _NOTHING)[0]
    if said > 0 and said != n_raw:
        notes += (f"{path.name} says that it has {said:g} readouts, it has {n_raw}",)
    total = to_seconds(*items.get("exposureTime", _NOTHING))
    count = said if said > 0 else n_raw
    seconds = None if total is None else float(f"{total / count * readouts:.9g}")
    return SourceMetadata(pixel, seconds, _dose(items, pixel, seconds, readouts / count), notes=notes + more)


_NOTHING = (math.nan, "")


def _dose(
    items: dict[str, tuple[float, str]], pixel_pm: float | None, seconds: float | None, share: float
) -> float | None:
    """Return the dose of a frame in e/Å^2, of the movie's or of its rate, where both are for a pixel."""
    dose, unit = items.get("totalDose", _NOTHING)
    rate, rate_unit = items.get("meanDoseRate", _NOTHING)
    one = dose * share if unit in _PER_PIXEL else math.nan
    if not one > 0 and rate_unit.removesuffix("/s") in _PER_PIXEL and seconds:
        one = rate * seconds
    if not (pixel_pm and 0 < one < math.inf):
        return None
    return float(f"{one / (pixel_pm / 100) ** 2:.9g}")


def _items(raw: object) -> dict[str, tuple[float, str]]:
    """Return the numbers of the XML with their units, by name; what is damaged says nothing."""
    text = raw.strip(b"\0 \r\n\t") if isinstance(raw, bytes) else b""
    if not text.startswith(b"<metadata") or b"<!" in text:
        return {}
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError):
        return {}
    return {item.get("name", ""): (number(item.text), item.get("unit", "").strip()) for item in root.findall("item")}
