"""HDF5 data sets, named as ``file.h5::/path/in/file``: also those of EMD, HyperSpy, NeXus and DECTRIS."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ...errors import SourceError
from ...settings.run import SourceSettings
from ..axes import Axis, Order, ordered, spelled_out
from ..blocks import fill_from
from ..calibration import calibrated, may_calibrate, with_declared
from ..checks import DAMAGE, MOST_FRAMES, Frames, Permit, checked_dtype, checked_file, open_binary, reading, widened
from ..joined import JoinedSource, check_alike
from ..meant import STATED, as_meant
from ..source import Source, SourceMetadata
from .axes import axes_of, single, text
from .bitshuffle import FILTER, BitshuffledSource, chunks_of, codec_of
from .candidates import ambiguous, movies_of, others_of
from .dectris import master_metadata, parts_of
from .links import Access, Behind, Segment, files_behind, follow, movies_below, opened
from .storage import check_storage, outside
from .velox import is_velox, velox_metadata


@dataclass(frozen=True, kw_only=True, eq=False)
class Hdf5Source(Source):
    """A data set.

    Attributes
    ----------
    holder, inner
        The file that holds it, behind all links, and its path there.
    sources
        The HDF5 files of a virtual data set, each with the frames that come from it.
    order
        Which stored axis is which.
    depth
        Frames that are stored together.
    """

    holder: Path
    inner: str
    sources: tuple[tuple[Path, range], ...]
    order: Order
    depth: int

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
                    checked_file(source)
                    stack.enter_context(h5py.File(source, "r"))
            checked_file(self.holder)
            file = stack.enter_context(h5py.File(self.holder, "r"))
            return self._taken(file[self.inner], start, stop)

    def _taken(self, dataset: Any, start: int, stop: int) -> Frames:
        """Read frames as they lie; where they lie along a later axis, those that are stored together at a time."""
        if not self.order.frame:
            taken: Frames = self.order.movie(dataset[self.order.selection(dataset.ndim, start, stop)])
            return taken[start:stop] if self.order.frame is None else taken
        frames = np.empty((max(0, stop - start), *self.shape[1:]), dataset.dtype)
        first = start
        while first < stop:
            last = min(stop, first - first % self.depth + self.depth)
            taken = dataset[self.order.selection(dataset.ndim, first, last)]
            frames[first - start : last - start] = self.order.movie(taken)
            first = last
        return frames


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
                with reading(str(segment.path)), open_binary(segment.path, 0) as file:
                    fill_from(file, segment.offset + skipped, pixels[at : at + count], segment.path)
            done += segment.n_bytes
        return widened(frames, self.dtype)


def open_hdf5(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
    """Open a data set of an HDF5 file; where only one could be the movie, ``inner`` may be empty, or name a group.

    Raises
    ------
    SourceError
        Where the file is damaged, the path leads nowhere or to several data sets, the data are not a movie, or a file
        is missing that a link leads to.
    """
    with reading(str(path), "the file cannot be read as HDF5"), ExitStack() as stack:
        access = Access(permit)
        file = stack.enter_context(opened(path, access))
        group = follow(file, inner or "/entry/data", Access(permit), stack)
        if parts := parts_of(file, group):
            return _joined(file, path, inner, parts, permit)
        shown, notes = _chosen(file, inner, path, Access(permit))
        return _one(file, path, shown, notes + outside(file, path), access)


def _joined(file: Any, path: Path, inner: str, names: list[str], permit: Permit | None) -> Source:
    """Open the parts of a master file as one movie."""
    inside = f"/{inner.strip('/') or 'entry/data'}"
    parts = [_one(file, path, f"{inside}/{name}", (), Access(permit, {path: None})) for name in names]
    check_alike(parts, str(path))
    firsts = np.cumsum([0, *(part.shape[0] for part in parts)])
    said = master_metadata(file, names, int(firsts[-1]), path)
    first = parts[0].metadata
    notes = tuple(dict.fromkeys((*said.notes, *(note for part in parts for note in part.metadata.notes))))
    return JoinedSource(
        path=str(path),
        files=tuple(dict.fromkeys(used for part in parts for used in part.files)),
        format="DECTRIS",
        shape=(int(firsts[-1]), *parts[0].shape[1:]),
        dtype=parts[0].dtype,
        metadata=replace(
            said, pixel_size_pm=first.pixel_size_pm, frame_time_s=said.frame_time_s or first.frame_time_s, notes=notes
        ),
        inside=inside,
        parts=tuple(parts),
        firsts=firsts,
    )


def _one(file: Any, path: Path, shown: str, notes: tuple[str, ...], access: Access) -> Source:
    """Open one data set; ``file`` is that which the user named, and ``shown`` the path in it."""
    with ExitStack() as stack:
        dataset = follow(file, shown, access, stack)
        where = f"{path}::{shown}"
        return as_meant(_as_stored(file, dataset, path, where, notes, access), _stated(dataset), where)


def _as_stored(file: Any, dataset: Any, path: Path, where: str, notes: tuple[str, ...], access: Access) -> Source:
    """Open a data set, with its numbers as they are stored."""
    dtype = _pixels_of(dataset, where)
    codec = codec_of(dataset)
    _check_filters(dataset, where, spared=codec is not None)
    behind = files_behind(dataset, access)
    files = tuple(access.files)
    axes, unread = axes_of(dataset, where, file)
    axes = spelled_out(axes)
    order = ordered(axes, dataset.shape or (), where)
    shape = order.shape(dataset.shape)
    raw_bytes = sum(part.n_bytes for part in behind.raw)
    notes += (*unread, *check_storage(dataset, where, files, raw_bytes), *behind.notes, *_doubts(dataset, order))
    metadata = _calibration(file, dataset, axes, order, where)
    common: dict[str, Any] = {
        "path": str(path),
        "files": files,
        "format": "Velox EMD" if is_velox(dataset) else "HDF5",
        "shape": shape,
        "dtype": dtype,
        "metadata": replace(metadata, notes=metadata.notes + notes),
        "inside": dataset.name,
    }
    if dataset.id.get_create_plist().get_external_count():
        _check_plain_order(order, where)
        return RawPixelSource(**common, segments=tuple(behind.raw), stored=_stored(dataset, where))
    common |= {"holder": Path(dataset.file.filename), "order": order}
    if codec is not None:
        found = chunks_of(dataset, where)
        fill = dataset.fillvalue
        return BitshuffledSource(**common, stored=dataset.dtype, chunks=found, codec=codec, fill=fill)
    depth = dataset.chunks[order.frame] if order.frame and dataset.chunks else 1
    return Hdf5Source(**common, inner=dataset.name, sources=_sources(behind, order), depth=depth)


def _doubts(dataset: Any, order: Order) -> tuple[str, ...]:
    """Return what was guessed about the axes; chunks of one frame each leave no doubt."""
    return () if dataset.chunks and dataset.chunks[0] == 1 and dataset.ndim == 3 else order.notes


def _sources(behind: Behind, order: Order) -> tuple[tuple[Path, range], ...]:
    """Return the files of a virtual data set, each with its frames; all, where the frames are not the first axis."""
    items = tuple(behind.hdf5.items())[1:]
    return items if order.frame == 0 else tuple((file, range(MOST_FRAMES)) for file, _ in items)


def _check_plain_order(order: Order, where: str) -> None:
    """Refuse raw pixels in other files whose axes are in another order: they are read as they lie."""
    if order.chosen not in ((0, 1), (0, 1, 2)):
        raise SourceError(
            "the raw pixels lie in other files, and their axes are not in the order (frames, y, x)",
            where,
            "the axes (frames, y, x)",
            f"frame, y and x as axes {order.chosen}",
            "Write the movie again, as an ordinary data set",
        )


def _pixels_of(dataset: Any, where: str) -> np.dtype[Any]:
    """Return the type in which pixels are read; colours and complex numbers are refused by name."""
    names: tuple[str, ...] = tuple(dataset.dtype.names or ())
    if {"r", "g", "b"} <= {name.lower() for name in names}:
        what, remedy = "RGB colours", "Save one colour, or the grey values, as an array of numbers"
    elif len(names) == 2 and names[0].lower().startswith("re") and names[1].lower().startswith("im"):
        what, remedy = "complex numbers", "Convert the movie, for example to its modulus, and save it as float32"
    else:
        return checked_dtype(dataset.dtype, where)
    raise SourceError(f"the pixels are {what}", where, "one number a pixel", str(dataset.dtype), remedy)


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
        signal = f"{inner}/{text(single(target, 'signal'))}" if inner and target is not None else ""
        if signal.rstrip("/") != inner and isinstance(follow(file, signal, access, stack), h5py.Dataset):
            return signal, ()
        search = movies_below(target, inner, access) if target is not None else movies_below(file, "", access)
    movies = [] if target is None else movies_of(search.found)
    if len(movies) == 1:
        lost = f" (and {len(search.lost) - 1} more)" if len(search.lost) > 1 else ""
        notes = (f"{path.name}: {search.lost[0]}{lost}",) if search.lost else ()
        return movies[0].shown, notes + others_of(movies[0], search.found, path.name)
    raise ambiguous(path, inner, movies, search.found, search.lost, there=target is not None)


def _check_filters(dataset: Any, where: str, *, spared: bool) -> None:
    """Refuse filters that HDF5 does not have, but ``spared`` for the one that is decoded here."""
    properties = dataset.id.get_create_plist()
    for place in range(properties.get_nfilters()):
        code, _, _, name = properties.get_filter(place)
        if not (spared and code == FILTER) and not h5py.h5z.filter_avail(code):
            raise SourceError(
                "the data are compressed by a filter that is not installed",
                where,
                "filters that this HDF5 library has, such as gzip or lzf",
                f"filter {code} ({name.decode(errors='replace')})",
                "Install its plugin where HDF5_PLUGIN_PATH points, or repack the file with h5repack -f GZIP=1",
            )


def _calibration(file: Any, dataset: Any, axes: list[Axis], order: Order, where: str) -> SourceMetadata:
    """Return the calibration; none, and a note, where it is damaged: the pixels may be whole."""
    try:
        return _metadata(file, dataset, axes, order, where)
    except DAMAGE as error:
        return SourceMetadata(notes=(f"{where}: the calibration cannot be read ({' '.join(str(error).split())})",))


def _metadata(file: Any, dataset: Any, axes: list[Axis], order: Order, where: str) -> SourceMetadata:
    """Return the calibration of the axes or of Velox, or of attributes such as pixel_size_nm and frame_time_ms."""
    said = velox_metadata(dataset, where) if is_velox(dataset) else calibrated(axes, order, where)
    holders = dict.fromkeys((file["/"], dataset.file["/"], dataset.parent, dataset))
    attributes = [{name: single(item, name) for name in item.attrs if may_calibrate(name)} for item in holders]
    return with_declared(said, attributes, Path(where.partition("::")[0]).name)


def _stated(dataset: Any) -> dict[str, Any]:
    """Return what the attributes of a data set say of its numbers; nothing where they are damaged."""
    with suppress(*DAMAGE):
        there = [name for name in STATED if name in dataset.attrs]
        return {name: dataset.attrs[name] for name in there if dataset.attrs.get_id(name).shape in ((), (1,), (2,))}
    return {}
