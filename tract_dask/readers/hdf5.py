"""HDF5 data sets, named as ``file.h5::/path/in/file``; HyperSpy's .hspy among them."""

from __future__ import annotations

import math
import re
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..errors import SourceError
from ..settings.run import SourceSettings
from .blocks import fill_from
from .hdf5_links import DAMAGE, Access, Found, Segment, files_behind, follow, movies_below, opened
from .source import (
    Frames,
    Permit,
    Source,
    SourceMetadata,
    checked_claim,
    checked_dtype,
    checked_file,
    checked_shape,
    reading,
    truncated,
    widened,
)
from .units import square_pixel, to_pm, to_seconds

_CHUNK_BYTES, _CHUNK_RATIO = 32 << 20, 100
"""A chunk may claim so many bytes, and so many times the bytes of its file."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Hdf5Source(Source):
    """A data set.

    Attributes
    ----------
    holder, inner
        The file that holds it, behind all links, and its path there.
    sources
        The HDF5 files of a virtual data set, each with the frames that come from it.
    """

    holder: Path
    inner: str
    sources: tuple[tuple[Path, range], ...]

    def _read(self, start: int, stop: int) -> Frames:
        try:
            return widened(self._pixels(start, stop), self.dtype)
        except OSError:
            for file in self.files:  # libhdf5 does not say which of them it was
                checked_file(file)
            raise

    def _pixels(self, start: int, stop: int) -> Frames:
        with ExitStack() as stack:
            for source, frames in self.sources:  # what libhdf5 cannot open here it reads as zeros
                if start < frames.stop and frames.start < stop:
                    stack.enter_context(h5py.File(source, "r"))
            file = stack.enter_context(h5py.File(self.holder, "r"))
            dataset = file[self.inner]
            pixels: Frames = dataset[start:stop] if dataset.ndim == 3 else dataset[()][None][start:stop]
        return pixels


@dataclass(frozen=True, kw_only=True, eq=False)
class RawPixelSource(Source):
    """A data set whose pixels lie, as ``stored``, in parts of other files that follow one another."""

    segments: tuple[Segment, ...]
    stored: np.dtype[Any]

    def _read(self, start: int, stop: int) -> Frames:
        frames = np.empty((max(0, stop - start), *self.shape[1:]), self.stored)
        pixels = frames.reshape(-1).view(np.uint8)
        first = start * self.shape[1] * self.shape[2] * self.stored.itemsize
        done = 0
        for segment in self.segments:
            skipped = max(0, first - done)
            count = min(done + segment.n_bytes, first + len(pixels)) - done - skipped
            if count > 0:
                at = done + skipped - first
                with reading(str(segment.path)), segment.path.open("rb", buffering=0) as file:
                    fill_from(file, segment.offset + skipped, pixels[at : at + count], segment.path)
            done += segment.n_bytes
        return widened(frames, self.dtype)


def open_hdf5(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
    """Open a data set of an HDF5 file; where only one has three axes, ``inner`` may be empty.

    Raises
    ------
    SourceError
        Where the file is damaged, the path leads nowhere or to several data sets, the data are not a movie, or a file
        is missing that a link leads to.
    """
    with reading(str(path), "the file cannot be read as HDF5"), ExitStack() as stack:
        access = Access(permit)
        file = stack.enter_context(opened(path, access))
        shown, notes = _chosen(file, inner, path, Access(permit))
        dataset = follow(file, shown, access, stack)
        where = f"{path}::{shown}"
        dtype = checked_dtype(dataset.dtype, where)
        _check_filters(dataset, where)
        behind = files_behind(dataset, access)
        files = tuple(access.files)
        shape = checked_shape(dataset.shape or (), where)
        notes += _check_storage(dataset, shape, where, files, behind.raw)
        metadata = _calibration(file, dataset, where)
        common: dict[str, Any] = {
            "path": str(path),
            "files": files,
            "format": "HDF5",
            "shape": shape,
            "dtype": dtype,
            "metadata": replace(metadata, notes=metadata.notes + notes),
            "inside": dataset.name,
        }
        if dataset.id.get_create_plist().get_external_count():
            return RawPixelSource(**common, segments=tuple(behind.raw), stored=_stored(dataset, where))
        holder, sources = Path(dataset.file.filename), tuple(behind.hdf5.items())[1:]
        return Hdf5Source(**common, holder=holder, inner=dataset.name, sources=sources)


def _stored(dataset: Any, where: str) -> np.dtype[Any]:
    """Return the type in which raw pixels are read without HDF5, which has to be one that NumPy knows."""
    stored: np.dtype[Any] = dataset.dtype
    if h5py.h5t.py_create(stored) != dataset.id.get_type():
        raise SourceError(
            "the raw pixels are of a type that only HDF5 knows",
            where,
            "whole bytes a pixel",
            str(dataset.id.get_type()),
            "Write the movie again, as an ordinary data set",
        )
    return stored


def _chosen(file: Any, inner: str, path: Path, access: Access) -> tuple[str, tuple[str, ...]]:
    """Return the path of the data set that ``inner`` names, or of the only movie below it; and notes."""
    with ExitStack() as stack:
        target = follow(file, inner, access, stack)
        if isinstance(target, h5py.Dataset):
            return inner, ()
        search = movies_below(target, inner, access) if target is not None else movies_below(file, "", access)
    numbers = [] if target is None else [item for item in search.found if item.dtype.kind in "iufcb"]
    movies = [item for item in numbers if len(item.shape) == 3] or [item for item in numbers if len(item.shape) == 2]
    if len(movies) == 1:
        lost = f" (and {len(search.lost) - 1} more)" if len(search.lost) > 1 else ""
        return movies[0].shown, (f"{path.name}: {search.lost[0]}{lost}",) if search.lost else ()
    raise _ambiguous(path, inner, target, movies, movies or search.found, search.lost)


def _ambiguous(
    path: Path, inner: str, target: Any, movies: list[Found], found: list[Found], lost: list[str]
) -> SourceError:
    listing = ", ".join(f"{item.shown} {item.shape} {item.dtype}" for item in found[:20])
    holds = f"a file that holds {listing}" if listing else "a file without data sets"
    return SourceError(
        "there is nothing under this path"
        if target is None
        else f"there are {len(movies) or 'no'} data sets that could be the movie",
        f"{path}::{inner}" if inner else str(path),
        "the path of one data set with axes (frames, y, x)",
        f"{holds}, where {'; '.join(lost[:9])}" if lost else holds,
        f"Name it, for example {path.name}::{movies[0].shown}" if movies else "Name one of those, or check the file",
    )


def _check_storage(
    dataset: Any, shape: tuple[int, int, int], where: str, files: tuple[Path, ...], raw: list[Segment]
) -> tuple[str, ...]:
    """Check that the pixels are in the file; return a note where some were never written."""
    size = sum(file.stat().st_size for file in files)
    checked_claim(shape[1] * shape[2] * dataset.dtype.itemsize, size, where)
    properties = dataset.id.get_create_plist()
    layout, n_bytes = properties.get_layout(), math.prod(shape) * dataset.dtype.itemsize
    if properties.get_external_count():
        held = sum(part.n_bytes for part in raw)
        if held < n_bytes:
            raise truncated(where, "before the last frame of its raw pixels", n_bytes, held)
    elif layout == h5py.h5d.CONTIGUOUS:
        offset = dataset.id.get_offset()
        if offset is None:
            raise _never_written(where)
        if offset + n_bytes > size:
            raise truncated(where, "before the last frame", offset + n_bytes, size)
    if layout != h5py.h5d.CHUNKED:
        return ()
    _check_chunks(dataset, size, where)
    expected = int(
        np.prod([-(-n // chunk) for n, chunk in zip(dataset.shape, dataset.chunks, strict=True)], dtype=object)
    )
    written = dataset.id.get_num_chunks()
    if not written:
        raise _never_written(where)
    return () if written >= expected else (_PARTLY.format(where, expected - written, expected),)


_PARTLY = "{}: {:,} of {:,} chunks were never written; their pixels are read as the fill value"


def _check_chunks(dataset: Any, size: int, where: str) -> None:
    n_bytes = math.prod(dataset.chunks) * dataset.dtype.itemsize
    if n_bytes > _CHUNK_BYTES + _CHUNK_RATIO * size:
        raise SourceError(
            "one chunk would be far larger than the file can hold",
            where,
            f"at most {_CHUNK_BYTES + _CHUNK_RATIO * size:,} bytes from files of {size:,}",
            f"{n_bytes:,} bytes, chunks {dataset.chunks}",
            "The file is damaged, or repack it with h5repack -l CHUNK=1x512x512",
        )


def _never_written(where: str) -> SourceError:
    return SourceError(
        "no pixel of the data set was ever written",
        where,
        "stored frames",
        "room for them only",
        "Wait until the movie is written, or name another data set",
    )


def _check_filters(dataset: Any, where: str) -> None:
    properties = dataset.id.get_create_plist()
    for number in range(properties.get_nfilters()):
        code, _, _, name = properties.get_filter(number)
        if not h5py.h5z.filter_avail(code):
            raise SourceError(
                "the data are compressed by a filter that is not installed",
                where,
                "filters that this HDF5 library has, such as gzip or lzf",
                f"filter {code} ({name.decode(errors='replace')})",
                "Install its plugin where HDF5_PLUGIN_PATH points, or repack the file with h5repack -f GZIP=1",
            )


def _calibration(file: Any, dataset: Any, where: str) -> SourceMetadata:
    """Return the calibration; none, and a note, where it is damaged: the pixels may be whole."""
    try:
        return _metadata(file, dataset)
    except DAMAGE as error:
        return SourceMetadata(notes=(f"{where}: the calibration cannot be read ({' '.join(str(error).split())})",))


def _metadata(file: Any, dataset: Any) -> SourceMetadata:
    """Return the calibration of HyperSpy's axes, or of attributes such as pixel_size_nm and frame_time_ms."""
    axes = [_axis(dataset.parent, number) for number in range(dataset.ndim)]
    pixel, notes = square_pixel(to_pm(*axes[-1]), to_pm(*axes[-2]))
    seconds = to_seconds(*axes[0]) if dataset.ndim == 3 else None
    for item in (file, dataset.file, dataset.parent, dataset):
        for name in item.attrs:
            if match := re.fullmatch(r"(pixel_size|frame_time)_([^_]+)", name):
                convert, number = (to_pm if match[1] == "pixel_size" else to_seconds), _number(_single(item, name))
                if match[1] == "pixel_size":
                    pixel = convert(number, match[2]) or pixel
                else:
                    seconds = convert(number, match[2]) or seconds
    return SourceMetadata(pixel, seconds, notes=notes)


def _axis(group: Any, number: int) -> tuple[float, str]:
    """Return scale and unit of a HyperSpy axis; the unit is empty where there is no such axis."""
    name = f"axis-{number}"
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):  # no link is followed for a unit
        return math.nan, ""
    axis = group[name]
    unit = _single(axis, "units")
    return _number(_single(axis, "scale")), unit.decode(errors="replace") if isinstance(unit, bytes) else str(unit)


def _single(item: Any, name: str) -> Any:
    """Return an attribute that holds one value; empty where it is not there, or holds many."""
    if name not in item.attrs or item.attrs.get_id(name).shape not in ((), (1,)):
        return ""
    return item.attrs[name]


def _number(value: Any) -> float:
    try:
        return float(np.asarray(value).item())
    except (TypeError, ValueError):
        return float("nan")
