"""HDF5 data sets that the bitshuffle filter compressed, decoded without HDF5: no plugin is needed, nor its lock."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import imagecodecs
import numpy as np
from numpy.typing import NDArray

from ..axes import Order
from ..blocks import fill_from
from ..checks import Frames, checked_file, open_binary, truncated, widened
from ..source import FilledSource

FILTER = 32008
_NONE, _LZ4, _ZSTD = 0, 2, 3
_DEFAULT_BLOCK = 8192
"""Bytes that bitshuffle treats at once where nobody says how many."""


@dataclass(frozen=True)
class Chunks:
    """Where the chunks of a data set are in its file.

    Attributes
    ----------
    shape, chunk
        Of the array and of a chunk, along the stored axes.
    numbers
        (written,) numbers of the chunks that are in the file, in C order and ascending.
    offsets, sizes
        (written,) of each, in bytes.
    plain
        (written,) whether it was not compressed.
    """

    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    numbers: NDArray[np.int64]
    offsets: NDArray[np.int64]
    sizes: NDArray[np.int64]
    plain: NDArray[np.bool_]

    @property
    def counts(self) -> tuple[int, ...]:
        """Chunks along each axis."""
        return tuple(-(-length // step) for length, step in zip(self.shape, self.chunk, strict=True))

    def touched(self, part: tuple[slice | int, ...]) -> Iterator[tuple[int, tuple[int, ...]]]:
        """Yield the chunks that a part of the array touches: place in ``offsets``, -1 unless written; and origin."""
        spans = [_span(index, length) for index, length in zip(part, self.shape, strict=True)]
        ranges = [
            range(span.start // step, -(-span.stop // step)) for span, step in zip(spans, self.chunk, strict=True)
        ]
        for inner in np.ndindex(*map(len, ranges)):
            index = [one[k] for one, k in zip(ranges, inner, strict=True)]
            flat = 0
            for k, count in zip(index, self.counts, strict=True):
                flat = flat * count + k
            place = int(np.searchsorted(self.numbers, flat))
            there = place < len(self.numbers) and int(self.numbers[place]) == flat
            yield place if there else -1, tuple(k * step for k, step in zip(index, self.chunk, strict=True))


@dataclass(frozen=True, kw_only=True, eq=False)
class BitshuffledSource(FilledSource):
    """A data set that is read by the places of its chunks.

    Attributes
    ----------
    holder
        The file that holds them.
    order
        Which stored axis is which.
    stored
        Pixel type as stored.
    chunks
        Where they are.
    codec
        What bitshuffle compressed its blocks with.
    fill
        Value of the chunks that were never written.
    """

    holder: Path
    order: Order
    stored: np.dtype[Any]
    chunks: Chunks
    codec: int
    fill: Any

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""
        return self.order.frame is None or self.chunks.chunk[self.order.frame] == 1

    def _fill(self, start: int, frames: Frames) -> None:
        checked_file(self.holder)
        with open_binary(self.holder, 0) as file:
            if self._is_a_chunk_a_frame():
                for k in range(len(frames)):
                    self._fill_frame(file, start + k, frames[k])
            elif len(frames):
                self._gather(file, start, frames)

    def _is_a_chunk_a_frame(self) -> bool:
        """Tell whether each frame is one chunk, as it is to be returned."""
        return (
            self.order.chosen == (0, 1, 2)
            and self.chunks.chunk == (1, *self.shape[1:])
            and len(self.chunks.shape) == 3
            and self.stored == self.dtype
        )

    def _fill_frame(self, file: Any, number: int, frame: NDArray[Any]) -> None:
        place = int(np.searchsorted(self.chunks.numbers, number))
        if place == len(self.chunks.numbers) or self.chunks.numbers[place] != number:
            frame[...] = self.fill
            return
        self._decode(file, place, frame.reshape(-1).view(np.uint8))

    def _gather(self, file: Any, start: int, frames: Frames) -> None:
        """Put the parts of all chunks that frames touch where they belong."""
        chunks = self.chunks
        part = self.order.selection(len(chunks.shape), start, start + len(frames))
        spans = [_span(index, length) for index, length in zip(part, chunks.shape, strict=True)]
        taken = np.empty([span.stop - span.start for span in spans], self.stored)
        pixels = np.empty(chunks.chunk, self.stored)
        for place, origin in chunks.touched(part):
            if place < 0:
                pixels[...] = self.fill
            else:
                self._decode(file, place, pixels.reshape(-1).view(np.uint8))
            edges = [
                (max(span.start, at), min(span.stop, at + step))
                for span, at, step in zip(spans, origin, chunks.chunk, strict=True)
            ]
            target = tuple(slice(a - span.start, b - span.start) for (a, b), span in zip(edges, spans, strict=True))
            taken[target] = pixels[tuple(slice(a - at, b - at) for (a, b), at in zip(edges, origin, strict=True))]
        whole = tuple(slice(None) if isinstance(index, slice) else 0 for index in part)
        frames[...] = widened(self.order.movie(taken[whole]), self.dtype)

    def _decode(self, file: Any, place: int, target: NDArray[np.uint8]) -> None:
        data = np.empty(int(self.chunks.sizes[place]), np.uint8)
        fill_from(file, int(self.chunks.offsets[place]), data, self.holder)
        if self.chunks.plain[place]:
            target[...] = data
        else:
            decode(data, self.stored.itemsize, self.codec, target)


def _span(index: slice | int, length: int) -> slice:
    if isinstance(index, int):
        return slice(index, index + 1)
    start, stop, _ = index.indices(length)
    return slice(start, stop)


def codec_of(dataset: Any) -> int | None:
    """Return the codec of a data set that only the bitshuffle filter compressed; None of all others."""
    properties = dataset.id.get_create_plist()
    if properties.get_layout() != h5py.h5d.CHUNKED or properties.get_nfilters() != 1:
        return None
    code, _, values, _ = properties.get_filter(0)
    plain = h5py.h5t.py_create(dataset.dtype) == dataset.id.get_type()
    if code != FILTER or not plain or dataset.file.userblock_size:
        return None
    codec = values[4] if len(values) > 4 else _NONE
    return codec if codec in (_LZ4, _ZSTD) else None


def chunks_of(dataset: Any, where: str) -> Chunks:
    """Return where the chunks of a data set are.

    Raises
    ------
    SourceError
        Where one ends behind the file.
    """
    found: list[tuple[int, int, int, bool]] = []
    counts = [-(-length // step) for length, step in zip(dataset.shape, dataset.chunks, strict=True)]

    def keep(chunk: Any) -> None:
        flat = 0
        for at, step, count in zip(chunk.chunk_offset, dataset.chunks, counts, strict=True):
            flat = flat * count + at // step
        found.append((flat, chunk.byte_offset, chunk.size, bool(chunk.filter_mask & 1)))

    dataset.id.chunk_iter(keep)
    numbers, offsets, sizes, plain = (np.array([item[k] for item in sorted(found)], np.int64) for k in range(4))
    n_bytes, size = math.prod(dataset.chunks) * dataset.dtype.itemsize, Path(dataset.file.filename).stat().st_size
    if len(found) and (ends := offsets + sizes).max() > size:
        raise truncated(where, "before its last chunk", int(ends.max()), size)
    if len(found) and int(sizes.max()) > 2 * n_bytes + 4096:
        raise ValueError(f"a chunk of {n_bytes:,} bytes is stored in {int(sizes.max()):,}")
    return Chunks(dataset.shape, dataset.chunks, numbers, offsets, sizes, plain.astype(bool))


def decode(data: Any, itemsize: int, codec: int, target: NDArray[np.uint8]) -> None:
    """Decode a chunk as the bitshuffle filter writes it.

    Parameters
    ----------
    data
        (bytes,) uint8. Eight bytes: the number of bytes; four: those of a block (both big-endian). Then the
        blocks, each after its length; then the pixels that fill no eighth of a block, as they are.
    target
        (bytes,) as many as the chunk has.

    Raises
    ------
    ValueError
        Where the chunk is damaged.
    """
    view: Any = memoryview(data)
    total, block = int.from_bytes(view[:8], "big"), int.from_bytes(view[8:12], "big") or _DEFAULT_BLOCK
    whole = len(target) - len(target) % (8 * itemsize)
    if total != len(target) or block % (8 * itemsize):
        raise ValueError(f"a chunk of {len(target):,} bytes says that it has {total:,}, in blocks of {block:,}")
    shuffled: Any = np.empty(whole, np.uint8)
    unpack: Any = imagecodecs.lz4_decode if codec == _LZ4 else imagecodecs.zstd_decode
    at = 12
    for done in range(0, whole, block):
        expected, length = min(block, whole - done), int.from_bytes(view[at : at + 4], "big")
        at += 4
        out = shuffled[done : done + expected]
        if not 0 < length <= len(view) - at or len(unpack(view[at : at + length], out=out)) != expected:
            raise ValueError("a block of a chunk is damaged")
        at += length
    if len(view) - at < len(target) - whole:
        raise ValueError("a chunk ends too early")
    if whole:
        blocks: Any = memoryview(shuffled)  # of an array imagecodecs would take the item's size for that of the pixels
        imagecodecs.bitshuffle_decode(blocks, itemsize=itemsize, blocksize=block // itemsize, out=target[:whole])
    target[whole:] = data[at : at + len(target) - whole]
