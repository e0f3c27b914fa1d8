"""The unit of work: runs of frames, every frame in exactly one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload


@dataclass(frozen=True, slots=True)
class Shard:
    """A run of frames, ``start`` to ``stop`` (not included); number ``index`` of the movie."""

    index: int
    start: int
    stop: int

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.stop - self.start


@dataclass(frozen=True)
class Shards(Sequence[Shard]):
    """The shards of a movie, each made when it is asked for: a million of them take no memory."""

    n_frames: int
    frames_per_shard: int

    def __len__(self) -> int:
        return -(-self.n_frames // self.frames_per_shard)

    @overload
    def __getitem__(self, index: int) -> Shard: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Shard, ...]: ...
    def __getitem__(self, index: int | slice) -> Shard | tuple[Shard, ...]:
        if isinstance(index, slice):
            return tuple(self[k] for k in range(len(self))[index])
        number = range(len(self))[index]
        start = number * self.frames_per_shard
        return Shard(number, start, min(start + self.frames_per_shard, self.n_frames))


def split(n_frames: int, frames_per_shard: int) -> Shards:
    """Return the shards of a movie: every frame in exactly one, in order.

    Examples
    --------
    >>> [shard.frames for shard in split(10, 4)]
    [4, 4, 2]
    """
    return Shards(n_frames, frames_per_shard)
