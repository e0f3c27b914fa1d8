"""Frames that lie uncompressed in a file: straight from disk into the array that is returned."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .source import (
    NOTHING_KNOWN,
    Frames,
    Source,
    SourceMetadata,
    checked_dtype,
    checked_shape,
    reading,
    truncated,
    widened,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockSource(Source):
    """Frames at known places in one file.

    Attributes
    ----------
    offsets
        Position of each frame's first byte.
    stored
        Pixel type as stored, with its byte order.
    flipped
        Bits that are the other way round than meant: all of them where white is 0, the highest where an offset makes
        signed numbers positive.
    """

    offsets: NDArray[np.int64]
    stored: np.dtype[Any]
    flipped: int = 0

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""
        return True

    def _read(self, start: int, stop: int) -> Frames:
        frames = np.empty((max(0, stop - start), *self.shape[1:]), self.dtype)
        self._fill(start, frames)
        return frames

    def read_into(self, start: int, frames: Frames) -> None:
        """Fill ``frames`` (frames, y, x), contiguous and of this movie's type, with those from ``start`` on."""
        with reading(self.path, f"the file cannot be read at frames {start} to {start + len(frames) - 1}"):
            self._fill(start, frames)
        self._check_exact(start, frames)

    def _fill(self, start: int, frames: Frames) -> None:
        if self.stored.newbyteorder("=") == self.dtype or self.flipped:
            self._fill_as_stored(start, frames)
            if self.stored.newbyteorder("=") != self.stored:
                frames.byteswap(inplace=True)
            flip(frames, self.flipped)
            return
        as_stored = np.empty((1, *self.shape[1:]), self.stored)
        for k in range(len(frames)):
            self._fill_as_stored(start + k, as_stored)
            frames[k : k + 1] = widened(as_stored, self.dtype)

    def _fill_as_stored(self, start: int, frames: Frames) -> None:
        if not len(frames):
            return
        offsets = self.offsets[start : start + len(frames)]
        breaks = np.flatnonzero(np.diff(offsets) != frames[0].nbytes) + 1
        with self.files[0].open("rb", buffering=0) as file:
            for first, last in pairwise((0, *breaks.tolist(), len(offsets))):
                fill_from(file, int(offsets[first]), frames[first:last], self.files[0])


def flip(frames: Frames, bits: int) -> None:
    """Turn these bits of each pixel, in place; whole numbers only."""
    if bits:
        pixels = frames.view(f"u{frames.itemsize}")
        pixels ^= pixels.dtype.type(bits)


def open_block(
    path: Path,
    *,
    name: str,
    shape: tuple[int, ...],
    stored: np.dtype[Any],
    offset: int,
    metadata: SourceMetadata = NOTHING_KNOWN,
) -> BlockSource:
    """Return the frames that lie one after the other in a file from byte ``offset`` on.

    Raises
    ------
    SourceError
        Where the pixel type or the shape is unfit, or the file is too short.
    """
    dtype = checked_dtype(stored, str(path))
    n_frames, n_y, n_x = checked_shape(shape, str(path))
    frame_bytes = n_y * n_x * stored.itemsize
    size = path.stat().st_size
    if size < offset + n_frames * frame_bytes:
        n_whole = max(0, size - offset) // frame_bytes
        raise truncated(str(path), f"in frame {n_whole} of {n_frames}", offset + n_frames * frame_bytes, size)
    return BlockSource(
        path=str(path),
        files=(path,),
        format=name,
        shape=(n_frames, n_y, n_x),
        dtype=dtype,
        metadata=metadata,
        offsets=offset + frame_bytes * np.arange(n_frames, dtype=np.int64),
        stored=stored,
    )


def fill_from(file: Any, offset: int, frames: Frames, path: Path) -> None:
    """Fill ``frames`` from ``offset`` on; one call of the system reads at most 2 GB."""
    target = frames.reshape(-1).view(np.uint8)
    file.seek(offset)
    done = 0
    while done < len(target):
        count = file.readinto(target[done:])
        if not count:
            raise truncated(
                str(path), "before the frames that it held when it was opened", offset + len(target), offset + done
            )
        done += count
