"""Arrays that follow one another as one movie, such as the data files of one detector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import SourceError
from .checks import Frames
from .source import Source


@dataclass(frozen=True, kw_only=True, eq=False)
class JoinedSource(Source):
    """Sources read one after the other.

    Attributes
    ----------
    parts
        In order, each open.
    firsts
        Each part's first frame and, last, the number of frames.
    """

    parts: tuple[Source, ...]
    firsts: NDArray[np.int64]

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""
        return all(part.one_by_one for part in self.parts)

    def _read(self, start: int, stop: int) -> Frames:
        frames = np.empty((max(0, stop - start), *self.shape[1:]), self.dtype)
        self.read_into(start, frames)
        return frames

    def read_into(self, start: int, frames: Frames) -> None:
        """Fill ``frames`` (frames, y, x), contiguous and of this movie's type, with those from ``start`` on."""
        at, stop = start, start + len(frames)
        number = int(np.searchsorted(self.firsts, start, side="right")) - 1
        while at < stop:
            first, until = int(self.firsts[number]), min(stop, int(self.firsts[number + 1]))
            self.parts[number].read_into(at - first, frames[at - start : until - start])
            at, number = until, number + 1


def check_alike(parts: list[Source], where: str) -> None:
    """Check that parts of one movie have frames of one shape and type.

    Raises
    ------
    SourceError
        Naming the first that differs.
    """
    for part in parts[1:]:
        if part.shape[1:] != parts[0].shape[1:] or part.dtype != parts[0].dtype:
            raise SourceError(
                "a part of the movie differs from the first",
                f"{where}::{part.inside}",
                f"{parts[0].shape[1]} x {parts[0].shape[2]} {parts[0].dtype}",
                f"{part.shape[1]} x {part.shape[2]} {part.dtype}",
                "Copy all files of the movie again, or open each part by its path inside",
            )
