"""A part of a frame, or of a summed image, as a grey picture at any zoom; and what values it has.

Run in the process pool. A box is its edges in px; an integer coordinate is a pixel's centre, so the whole image
is the box -0.5, -0.5, width - 0.5, height - 0.5. Zoomed out, a point of the picture is the mean over the area that it
covers, weighted at its edges; zoomed in, it is the pixel that it lies on. What was not exposed is transparent.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import zarr
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ...errors import InputError
from ...kernels.greys import TRANSPARENT, grey_levels
from ...readers import open_cached
from ...readers.checks import Permit
from ...readers.movie_files import FileList
from ...readers.source import SourceMetadata
from ...settings.run import MetadataSettings, SourceSettings
from ...store import datasets
from ...store.metadata import attributes
from ...store.movie import Movie, open_movie
from ...store.run_folder import RunFolder

Pixels = NDArray[Any]
Floats = NDArray[np.float32]

MAX_SIDE_PX = 2048
"""Longest side of a picture."""

MOST_PIXELS = 1 << 27
"""Of a frame of a movie that is not converted, which is read as a whole."""

PERCENTILES = (0.1, 0.5, 1.0, 5.0, 25.0, 50.0, 75.0, 95.0, 99.0, 99.5, 99.9)

_BINS = 128


@dataclass(frozen=True)
class View:
    """What is to be seen.

    Attributes
    ----------
    box
        Edges x0, y0, x1, y1 in px; None: the whole image.
    width
        Of the picture, in its own pixels; reduced where its height would be above :data:`MAX_SIDE_PX`.
    low, high
        Counts that are black and white; None: percentiles of what is seen.

    Raises
    ------
    InputError
        Where the box is empty or the width out of range.
    """

    box: tuple[float, float, float, float] | None = None
    width: int = 1024
    low: float | None = None
    high: float | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.width <= MAX_SIDE_PX:
            raise InputError("the width is out of range", "width", f"1 to {MAX_SIDE_PX}", f"{self.width}")
        if self.box is not None:
            x0, y0, x1, y1 = self.box
            if not (all(abs(edge) < 1e7 for edge in self.box) and x1 - x0 >= 1e-3 and y1 - y0 >= 1e-3):
                raise InputError(
                    "the box is empty or out of range",
                    "box",
                    "x0,y0,x1,y1 in px with x0 < x1 and y0 < y1",
                    f"{self.box}",
                )
        known = [value for value in (self.low, self.high) if value is not None]
        if not all(map(math.isfinite, known)) or (len(known) == 2 and not known[0] < known[1]):
            raise InputError("black is not below white", "low, high", "low < high", f"{self.low}, {self.high}")


@dataclass(frozen=True)
class Plane:
    """An image that can be read in parts, whole or binned.

    Attributes
    ----------
    shape
        Rows and columns.
    factors
        Of its binned levels, ascending, from 1.
    read
        Takes a factor, and rows and columns of that level; returns its pixels, NaN where there are none.
    gain
        Counts for one unit of the pixels.
    """

    shape: tuple[int, int]
    factors: tuple[int, ...]
    read: Callable[[int, slice, slice], Pixels]
    gain: float = 1.0


@dataclass(frozen=True)
class MovieFrame:
    """A frame of a movie on disk, in any format, also of a converted one.

    Attributes
    ----------
    named
        The file as a request names it, for errors.
    stamp
        Tells the file from what it was before.
    """

    named: str | Path
    path: str | FileList
    source: SourceSettings
    metadata: MetadataSettings
    permit: Permit | None
    number: int
    stamp: str


def source_png(frame: MovieFrame, view: View) -> bytes:
    """Return a frame of a movie as PNG."""
    return _png(source_plane(frame), view)


def source_levels(frame: MovieFrame, view: View) -> bytes:
    """Return what values a frame has, seen like that, and the size of its pixels; see :func:`levels`."""
    found = levels(source_plane(frame), view)
    opened: Movie | SourceMetadata
    if _is_converted(frame.path):
        opened = _opened_movie(str(frame.path), frame.stamp)
    else:
        opened = open_cached(frame.path, frame.source, frame.metadata, permit=frame.permit).metadata
    return as_json(found | {"pixel_size_pm": opened.pixel_size_pm, "version": frame.stamp})


def sum_png(folder: Path, view: View, stamp: str) -> bytes:
    """Return the summed image of a run as PNG."""
    return _png(sum_plane(RunFolder(folder).sum, stamp), view)


def sum_levels(folder: Path, view: View, stamp: str) -> bytes:
    """Return what values the summed image of a run has, and the size of its pixels."""
    path = RunFolder(folder).sum
    found = levels(sum_plane(path, stamp), view)
    pixel_size = zarr.open_group(path, mode="r").attrs.get("pixel_size_pm")
    return as_json(found | {"pixel_size_pm": pixel_size, "version": stamp})


def _is_converted(path: str | FileList) -> bool:
    """Tell whether a movie is a store of ours, and not a Zarr array of others."""
    return isinstance(path, str) and path.endswith(".zarr") and bool(attributes(Path(path)))


def source_plane(frame: MovieFrame) -> Plane:
    """Return the pixels of a frame.

    Raises
    ------
    InputError
        Where there is no such frame, or the movie cannot be opened.
    """
    if _is_converted(frame.path) and (frame.source.frames, frame.source.roi, frame.source.bin) == (None, None, 1):
        return movie_plane(_opened_movie(str(frame.path), frame.stamp), frame.number)
    opened = open_cached(frame.path, frame.source, frame.metadata, permit=frame.permit)
    _check_frame(frame.number, opened.shape[0])
    _check_size(str(frame.path), opened.shape[1:])

    def read(_: int, rows: slice, columns: slice) -> Pixels:
        pixels = _source_frame(frame.path, frame.source, frame.permit, frame.number, frame.stamp)
        return pixels[rows, columns]

    return Plane(opened.shape[1:], (1,), read, opened.metadata.gain)


def movie_plane(movie: Movie, frame: int) -> Plane:
    """Return a frame of a converted movie, with its binned levels.

    Raises
    ------
    InputError
        Where there is no such frame.
    """
    _check_frame(frame, movie.n_frames)

    def read(factor: int, rows: slice, columns: slice) -> Pixels:
        if factor == 1:
            whole: Pixels = movie.read(frame, frame + 1, rows, columns)[0]
            return whole
        binned: Pixels = movie.read_binned(factor, frame, frame + 1)[0, rows, columns]
        return binned

    return Plane(movie.shape[1:], (1, *movie.bins), read, movie.gain)


def sum_plane(path: Path, stamp: str) -> Plane:
    """Return the summed image in a sum.zarr.

    Raises
    ------
    StoreError
        Where there is none.
    """
    image = _summed(path, stamp)

    def read(_: int, rows: slice, columns: slice) -> Pixels:
        return image[rows, columns]

    height, width = image.shape
    return Plane((height, width), (1,), read)


@lru_cache(maxsize=2)
def _opened_movie(path: str, stamp: str) -> Movie:
    return open_movie(path)


@lru_cache(maxsize=1)
def _source_frame(
    path: str | FileList, source: SourceSettings, permit: Permit | None, frame: int, stamp: str
) -> Pixels:
    pixels: Pixels = open_cached(path, source, permit=permit).read(frame, frame + 1)[0]
    return pixels


@lru_cache(maxsize=1)
def _summed(path: Path, stamp: str) -> Floats:
    """Return the summed image, NaN where no frame covers it."""
    image = np.asarray(datasets.open_array(path / "image")[...])
    exposed = np.asarray(datasets.open_array(path / "exposure")[...]) > 0
    return np.where(exposed, image, np.nan).astype(np.float32)


def _check_size(path: str, shape: tuple[int, ...]) -> None:
    """Refuse a frame that has to be read as a whole and is too large for that."""
    if math.prod(shape) > MOST_PIXELS:
        raise InputError(
            "the frames are too large to be shown",
            path,
            f"at most {MOST_PIXELS} pixels",
            f"{shape[0]} x {shape[1]}",
            "Convert the movie: a converted one is read in parts",
        )


def _check_frame(frame: int, n_frames: int) -> None:
    if not 0 <= frame < n_frames:
        raise InputError("there is no such frame", "frame", f"0 to {n_frames - 1}", f"{frame}")


def as_json(value: object) -> bytes:
    """Return plain values as JSON; numbers that are not finite must be None already."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()


def levels(plane: Plane, view: View) -> dict[str, Any]:
    """Return what values there are to be seen.

    Returns
    -------
    dict
        ``shape`` of the whole image, rows and columns; ``range``, the smallest and largest value, in counts;
        ``percentiles`` by their number; a histogram, ``counts`` between ``edges``. All but the shape are of the image
        as it is seen: zoomed out, noise is less. None where nothing was exposed.
    """
    seen = look(plane, view)
    values = seen[np.isfinite(seen)].astype(np.float64)
    known: dict[str, Any] = {"shape": list(plane.shape), "range": None, "percentiles": None, "counts": [], "edges": []}
    if values.size:
        low, high = float(values.min()), float(values.max())
        counts, edges = np.histogram(values, _BINS, (low, high if high > low else low + 1))
        percentiles = dict(zip(map(str, PERCENTILES), np.percentile(values, PERCENTILES).tolist(), strict=True))
        known |= {"range": [low, high], "percentiles": percentiles, "counts": counts.tolist(), "edges": edges.tolist()}
    return known


def _png(plane: Plane, view: View) -> bytes:
    return encode_png(grey_levels(look(plane, view), view.low, view.high))


def look(plane: Plane, view: View) -> Floats:
    """Return what is to be seen, in counts (rows, columns); NaN where nothing was exposed, or outside of the image."""
    height, width = plane.shape
    x0, y0, x1, y1 = view.box or (-0.5, -0.5, width - 0.5, height - 0.5)
    scale = max((x1 - x0) / view.width, (y1 - y0) / MAX_SIDE_PX)
    size = [min(MAX_SIDE_PX, max(1, round(length / scale))) for length in (y1 - y0, x1 - x0)]
    factor = max((factor for factor in plane.factors if factor <= scale), default=1)
    # edges in pixels of the level, counted from the image's edge
    y0, y1, x0, x1 = ((edge + 0.5) / factor for edge in (y0, y1, x0, x1))
    rows, columns = (_cover(*span, -(-side // factor)) for span, side in (((y0, y1), height), ((x0, x1), width)))
    seen = np.full(size, np.nan, np.float32)
    if rows.stop > rows.start and columns.stop > columns.start:
        pixels = plane.read(factor, rows, columns)
        edges = [np.linspace(low, high, n + 1) for low, high, n in ((y0, y1, size[0]), (x0, x1, size[1]))]
        offsets = (edges[0] - rows.start, edges[1] - columns.start)
        seen = mean_over(pixels, *offsets) if scale > 1 else nearest(pixels, *offsets)
    return seen * np.float32(plane.gain)


def _cover(low: float, high: float, side: int) -> slice:
    """Return the pixels of a side that lie between two edges, if only in part."""
    return slice(max(0, min(side, math.floor(low))), max(0, min(side, math.ceil(high))))


def nearest(pixels: Pixels, rows: NDArray[np.float64], columns: NDArray[np.float64]) -> Floats:
    """Return the pixel under the middle of each field of a grid, given by its edges; NaN outside of the image."""
    places = [np.floor((edges[:-1] + edges[1:]) / 2).astype(np.int64) for edges in (rows, columns)]
    inside = [(place >= 0) & (place < side) for place, side in zip(places, pixels.shape, strict=True)]
    rows_in, columns_in = (np.clip(place, 0, side - 1) for place, side in zip(places, pixels.shape, strict=True))
    found = pixels[rows_in[:, None], columns_in].astype(np.float32)
    return np.where(inside[0][:, None] & inside[1], found, np.float32(np.nan))


def mean_over(pixels: Pixels, rows: NDArray[np.float64], columns: NDArray[np.float64]) -> Floats:
    """Return the mean over each field of a grid, given by its edges, of the pixels that are numbers; else NaN."""
    down, across = (_overlap(edges, side) for edges, side in zip((rows, columns), pixels.shape, strict=True))
    pixels = pixels.astype(np.float32, copy=False)

    def total(values: Floats) -> Floats:
        reduced: Floats = (across @ np.ascontiguousarray((down @ values).T)).T
        return reduced

    weight: Floats
    known = np.isfinite(pixels)
    if known.all():
        weight = np.outer(down.sum(axis=1), across.sum(axis=1)).astype(np.float32)
    else:
        pixels, weight = np.where(known, pixels, np.float32(0)), total(known.astype(np.float32))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(weight > 1e-6, total(pixels) / weight, np.nan).astype(np.float32)


def _overlap(edges: NDArray[np.float64], side: int) -> csr_array[np.float32]:
    """Return how long each interval between ``edges`` overlaps each pixel of a side, (intervals, pixels)."""
    cuts = np.union1d(np.clip(edges, 0, side), np.arange(side + 1))
    cuts = cuts[(cuts >= edges[0]) & (cuts <= edges[-1])]
    middle, length = (cuts[:-1] + cuts[1:]) / 2, np.diff(cuts)
    interval = np.clip(np.searchsorted(edges, middle, side="right") - 1, 0, len(edges) - 2)
    pixel = np.floor(middle).astype(np.int64)
    return csr_array((length.astype(np.float32), (interval, pixel)), shape=(len(edges) - 1, side))


def encode_png(level: NDArray[np.uint8]) -> bytes:
    """Return grey levels (rows, columns) as PNG, of which level 0 is transparent; fast rather than small."""
    height, width = level.shape
    lines = np.zeros((height, width + 1), np.uint8)  # each line begins with its filter: none
    lines[:, 1:] = level
    parts = {
        b"IHDR": struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0),
        b"tRNS": struct.pack(">H", TRANSPARENT),
        b"IDAT": bytes(imagecodecs.deflate_encode(lines.tobytes(), level=1, raw=False)),
        b"IEND": b"",
    }
    chunks = (
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in parts.items()
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)
