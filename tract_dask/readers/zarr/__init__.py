"""Zarr arrays as movies: OME-Zarr, HyperSpy's .zspy, plain arrays, and our own movie stores."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SourceError
from ...settings.run import SourceSettings
from ..axes import Order, ordered, spelled_out
from ..calibration import as_number, calibrated, may_calibrate, with_declared
from ..checks import Frames, Permit, checked_claim, checked_dtype, checked_file, reading, truncated, widened
from ..hdf5.candidates import ambiguous, movies_of, others_of
from ..meant import STATED, as_meant
from ..source import FrameValues, Part, Source, SourceMetadata
from .blosc import check_blosc
from .nodes import Node, arrays_below, axes_of, node_at, open_node
from .place import Place, open_place, plain_path
from .shards import missing_in_shards


@dataclass(frozen=True, kw_only=True, eq=False)
class ZarrSource(Source):
    """An array.

    Attributes
    ----------
    place, node
        The store, and the array in it.
    order
        Which stored axis is which.
    n_metadata
        So many of ``files`` are metadata; the others are chunks, ordered along the frames.
    firsts
        (chunks,) first frame of each chunk's file, ascending; empty where the chunks are no files of their own.
    """

    place: Place
    node: Node
    order: Order
    n_metadata: int
    firsts: NDArray[np.int64]

    def files_of(self, start: int, stop: int) -> slice:
        """Return which of ``files`` hold frames ``start`` to ``stop`` (not included)."""
        if not len(self.firsts):
            return slice(None)
        depth = 1 if self.order.frame is None else self.node.chunk[self.order.frame]
        low = int(np.searchsorted(self.firsts, start - start % depth, side="left"))
        high = int(np.searchsorted(self.firsts, stop, side="left"))
        return slice(self.n_metadata + low, self.n_metadata + high)

    def _read(self, start: int, stop: int) -> Frames:
        for file in self.files[self.files_of(start, stop)]:
            checked_file(file)  # Zarr reads a chunk that is gone as the fill value
        self._check_blosc(start, stop)
        array = open_node(self.place, self.node)
        if array.shape != self.node.shape:
            return np.empty((0, *self.shape[1:]), self.dtype)  # it has changed
        taken = np.asarray(array[self.order.selection(array.ndim, start, stop)])
        movie = self.order.movie(taken)
        return widened(movie[start:stop] if self.order.frame is None else movie, self.dtype)

    def _check_blosc(self, start: int, stop: int) -> None:
        """Check the chunks of frames that Blosc is to decode; those of a ZIP file have checksums."""
        if "blosc" not in self.node.codecs or not len(self.firsts):
            return
        index = self.node.index
        inner = self.node.chunk if index is None else index.chunk
        n_inner = math.prod(self.node.chunk) // math.prod(inner)
        chunk_bytes = math.prod(inner) * self.node.dtype.itemsize
        check_blosc(self.files[self.files_of(start, stop)], chunk_bytes, index, n_inner)


def open_zarr(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
    """Open an array of a Zarr store; where only one could be the movie, ``inner`` may be empty, or name a group.

    Raises
    ------
    SourceError
        Where metadata are damaged, the path leads nowhere or to several arrays, or the data are not a movie.
    """
    with reading(str(path), "the store cannot be read as Zarr", "Make the copy or the export again"):
        place = open_place(path, permit)
        node, notes = _chosen(place, inner, path)
        assert node.shape is not None
        where = f"{path}::/{node.name}" if node.name else str(path)
        axes, convention = axes_of(place, node)
        array = open_node(place, node)
        dtype = checked_dtype(np.dtype(array.dtype), where)
        axes = spelled_out(axes)
        order = ordered(axes, node.shape, where)
        shape = order.shape(node.shape)
        names, firsts, size = _chunk_files(place, node, order, where)
        checked_claim(shape[1] * shape[2] * dtype.itemsize, size, where)
        checked_claim(math.prod(array.chunks) * dtype.itemsize, size, where, "one chunk")
        metadata = _ours(place, node, calibrated(axes, order, where), path)
        chunks = place.files([f"{node.name}/{name}".strip("/") for name in names])
        missing = _missing(node, len(names), array.fill_value, where)
        if not missing and node.index is not None and chunks:
            missing = _missing_inside(node, dict(zip(names, chunks, strict=True)), array.fill_value, where)
        stored = ZarrSource(
            path=str(path),
            files=(*place.used, *chunks),
            format=convention,
            shape=shape,
            dtype=dtype,
            metadata=replace(metadata, notes=(*metadata.notes, *notes, *missing, *_doubts(node, order))),
            inside=f"/{node.name}" if node.name else "",
            place=replace(place, permit=None),
            node=node,
            order=order,
            n_metadata=len(place.used),
            firsts=firsts if chunks else firsts[:0],
        )
        return as_meant(stored, {name: node.attributes[name] for name in STATED if name in node.attributes}, path.name)


def _chosen(place: Place, inner: str, path: Path) -> tuple[Node, tuple[str, ...]]:
    """Return the array that ``inner`` names, or the only movie below it; and notes."""
    name = plain_path(inner)
    node = node_at(place, name)
    if node is not None and node.shape is not None:
        return node, ()
    found, lost = arrays_below(place, node) if node is not None else ([], [])
    movies = movies_of(found)
    if len(movies) != 1:
        found = found or arrays_below(place, node_at(place, "") or Node("", {}))[0]
        raise ambiguous(path, inner, movies, found, lost, there=node is not None)
    chosen = node_at(place, movies[0].shown.strip("/"))
    assert chosen is not None
    notes = (f"{path.name}: {lost[0]}",) if lost else ()
    return chosen, notes + others_of(movies[0], found, path.name)


def _chunk_files(place: Place, node: Node, order: Order, where: str) -> tuple[list[str], NDArray[np.int64], int]:
    """Return the names of an array's chunk files along the frames, the first frame of each, and their bytes.

    Raises
    ------
    SourceError
        Where one is empty.
    """
    assert node.shape is not None
    pattern = re.compile(node.keys)
    counts = [-(-length // step) for length, step in zip(node.shape, node.chunk, strict=True)]
    found: list[tuple[int, str]] = []
    size = 0
    for name, n_bytes in place.sizes(node.name, len(node.shape) + 1):
        match = pattern.fullmatch(name)
        index = [int(number) for number in match.groups() if len(number) < 20] if match else []
        if len(index) != len(counts) or any(k >= count for k, count in zip(index, counts, strict=True)):
            continue
        if not n_bytes:
            raise truncated(f"{where}/{name}", "before it begins", 1, 0)
        size += n_bytes
        found.append((0 if order.frame is None else index[order.frame] * node.chunk[order.frame], name))
    found.sort()
    return [name for _, name in found], np.array([first for first, _ in found], np.int64), size


def _missing(node: Node, written: int, fill: Any, where: str) -> tuple[str, ...]:
    """Return a note where chunks are not there; it is an error where none is."""
    assert node.shape is not None
    expected = math.prod(-(-length // step) for length, step in zip(node.shape, node.chunk, strict=True))
    if not written:
        raise SourceError(
            "no chunk of the array is there",
            where,
            f"{expected:,} chunks",
            "metadata only",
            "Wait until it is written, or copy the whole folder again",
        )
    if written >= expected:
        return ()
    return (f"{where}: {expected - written:,} of {expected:,} chunks are not there; they are read as {fill}",)


def _missing_inside(node: Node, files: dict[str, Path], fill: Any, where: str) -> tuple[str, ...]:
    """Return a note where chunks are missing inside shards."""
    assert node.shape is not None
    assert node.index is not None
    pattern = re.compile(node.keys)
    matched = ((pattern.fullmatch(name), file) for name, file in files.items())
    placed = ((tuple(map(int, match.groups())), file) for match, file in matched if match)
    missing, expected = missing_in_shards(node.index, node.shape, node.chunk, placed)
    if not missing:
        return ()
    return (f"{where}: {missing:,} of {expected:,} chunks are missing in its shards; they are read as {fill}",)


def _doubts(node: Node, order: Order) -> tuple[str, ...]:
    """Return what was guessed about the axes, or passed over; chunks of one frame each leave no doubt."""
    return () if node.chunk and node.chunk[0] == 1 and len(node.chunk) == 3 else order.notes


def _ours(place: Place, node: Node, said: SourceMetadata, path: Path) -> SourceMetadata:
    """Return the calibration with what attributes say, and what our own movie stores say of themselves.

    Raises
    ------
    SourceError
        Where a movie store is unfinished.
    """
    above = node_at(place, node.name.rpartition("/")[0]) if node.name else None
    holders = [{} if one is None else one.attributes for one in (above, node)]
    attributes = [{name: value for name, value in one.items() if may_calibrate(name)} for one in holders]
    said = with_declared(said, attributes, path.name)
    store = (above.attributes if above else {}).get("tract_dask")
    if not isinstance(store, dict) or store.get("kind") != "movie":
        return said
    if not store.get("complete"):
        raise SourceError(
            "the movie store is unfinished", str(path), "a finished one", "", "Run the command that writes it again"
        )
    known = {name: as_number(store.get(name)) for name in ("pixel_size_pm", "frame_time_s", "dose", "gain", "offset")}
    gain = _or_none(known["gain"]) or 1.0
    offset = _or_none(known["offset"]) or 0.0
    level = f" and an offset of {offset:g}, which are used" if offset else ", which is used"
    note = f"{path.name}: the movie was converted with a gain of {gain:g}{level}"
    return replace(
        said,
        pixel_size_pm=_or_none(known["pixel_size_pm"]),
        frame_time_s=_or_none(known["frame_time_s"]),
        dose=_or_none(known["dose"]),
        along_frames={**said.along_frames, **_along(place, above, store)},
        gain=gain,
        offset=offset,
        part=_part(store.get("part")),
        notes=said.notes + ((note,) if (gain, offset) != (1.0, 0.0) else ()),
    )


def _part(said: Any) -> Part | None:
    """Return which part of its own source a movie store is; None where it is all of it, or that is damaged."""
    names = {field.name for field in fields(Part)}
    if not isinstance(said, dict) or set(said) != names or not all(type(value) is int for value in said.values()):
        return None
    return Part(**said)


def _along(place: Place, group: Node | None, store: dict[str, Any]) -> dict[str, FrameValues]:
    """Return what a movie store of ours keeps of its frames' headers beside their times."""
    assert group is not None
    listed = store.get("frame_values")
    names = [str(name) for name in listed] if isinstance(listed, list) else []
    found = {}
    for name in names:
        path = f"{group.name}/frame_{name}".strip("/")
        node = node_at(place, path) if name != "time" and re.fullmatch(r"\w+", name) else None
        if node is not None and node.shape == tuple(store.get("shape", ()))[:1]:
            unit = node.attributes.get("units")
            values = np.asarray(open_node(place, node)[...], np.float64)
            found[name] = FrameValues(values, unit if isinstance(unit, str) else "")
    return found


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) and value > 0 else None
