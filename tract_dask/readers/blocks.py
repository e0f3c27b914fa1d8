"""Frames that lie uncompressed in a file: straight from disk into the array that is returned."""

from __future__ import annotations

from bisect import bisect_right
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SourceError
from .checks import Frames, checked_dtype, checked_shape, open_binary, truncated, widened
from .source import NOTHING_KNOWN, FilledSource, SourceMetadata


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockSource(FilledSource):
    """Frames at known places in one file, or in several that are one long row of bytes.

    Attributes
    ----------
    offsets
        Position of each frame's first byte.
    stored
        Pixel type as stored, with its byte order.
    firsts
        Position of the first byte of each file; a frame may cross from one into the next.
    flipped
        Bits that are the other way round than meant: all of them where white is 0, the highest where an offset makes
        signed numbers positive.
    """

    offsets: NDArray[np.int64]
    stored: np.dtype[Any]
    firsts: tuple[int, ...] = (0,)
    flipped: int = 0

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""
        return True

    def files_of(self, start: int, stop: int) -> slice:
        """Return which of ``files`` hold frames ``start`` to ``stop`` (not included)."""
        if len(self.firsts) == 1 or stop <= start:
            return slice(None)
        n_bytes = self.shape[1] * self.shape[2] * self.stored.itemsize
        places = self.offsets[start:stop]
        last = bisect_right(self.firsts, int(places.max()) + n_bytes - 1)
        return slice(bisect_right(self.firsts, int(places.min())) - 1, last)

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
        with ExitStack() as stack:
            opened: dict[int, Any] = {}
            for first, last in pairwise((0, *breaks.tolist(), len(offsets))):
                at, rest = int(offsets[first]), frames[first:last].reshape(-1).view(np.uint8)
                while len(rest):
                    number = bisect_right(self.firsts, at) - 1
                    if number not in opened:
                        opened[number] = stack.enter_context(open_binary(self.files[number], 0))
                    until = self.firsts[number + 1] if number + 1 < len(self.firsts) else at + len(rest)
                    part = rest[: until - at]
                    fill_from(opened[number], at - self.firsts[number], part, self.files[number])
                    at, rest = at + len(part), rest[len(part) :]


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
    parts: tuple[Path, ...] = (),
) -> BlockSource:
    """Return the frames that lie one after the other in a file from byte ``offset`` on, and go on in ``parts``.

    Raises
    ------
    SourceError
        Where the pixel type or the shape is unfit, or the file is too short.
    """
    dtype = checked_dtype(stored, str(path))
    n_frames, n_y, n_x = checked_shape(shape, str(path))
    frame_bytes = n_y * n_x * stored.itemsize
    sizes = [file.stat().st_size for file in (path, *parts)]
    size = sum(sizes)
    if size < offset + n_frames * frame_bytes:
        n_whole = max(0, size - offset) // frame_bytes
        raise truncated(str(path), f"in frame {n_whole} of {n_frames}", offset + n_frames * frame_bytes, size)
    return BlockSource(
        path=str(path),
        files=(path, *parts),
        format=name,
        shape=(n_frames, n_y, n_x),
        dtype=dtype,
        metadata=metadata,
        offsets=offset + frame_bytes * np.arange(n_frames, dtype=np.int64),
        stored=stored,
        firsts=tuple(accumulate(sizes[:-1], initial=0)),
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


def read_records(path: Path, offsets: NDArray[np.int64], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return small records of one type, such as the headers of frames, that lie at ``offsets`` in a file."""
    found = np.empty(len(offsets), dtype)
    with open_binary(path, 0) as file:
        for k, offset in enumerate(offsets.tolist()):
            fill_from(file, offset, found[k : k + 1], path)
    return found


MOST_RECORDS = 1 << 24
"""More frames that each have a header of their own are a damaged header: to read theirs would take minutes."""


def checked_records(count: int, where: str) -> None:
    """Check how many frames with a header or time stamp each a file would have, before room is made for them.

    Raises
    ------
    SourceError
        Where there are too many to be true.
    """
    if count > MOST_RECORDS:
        raise SourceError(
            "the number of frames is impossible",
            where,
            f"at most {MOST_RECORDS:,}",
            f"{count:,} of a few bytes each",
            "The header is damaged: make the copy or the export again",
        )
