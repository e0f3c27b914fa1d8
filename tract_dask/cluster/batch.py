"""Batches of shards on their way to workers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from distributed.protocol.pickle import dumps, loads
from numpy.typing import NDArray

from ..store.journal import Payload
from .deaths import Death
from .retries import Place, Trouble, trouble

BATCH_S = 0.5
"""For so long a task goes on taking shards of its batch; a longer shard is a batch of its own."""

Numbers: TypeAlias = NDArray[np.int64]
"""Indices of shards."""

Work: TypeAlias = Callable[[Numbers], tuple[list[Payload], float]]


class Report(NamedTuple):
    """What a worker says of a batch: the payloads of the shards that are done, the seconds, or its trouble."""

    place: Place
    payloads: list[Payload]
    seconds: float
    trouble: Trouble | None = None


class Packed:
    """Work that is unpacked where it is done.

    What a task refers to, such as an open movie, is opened by unpacking it. The scheduler unpacks every task, and may
    see none of the files.
    """

    def __init__(self, work: Work, file: str) -> None:
        self._work, self._file = dumps(work), file

    def __call__(self, batch: Numbers) -> Report:
        """Unpack the work and do it; report an error that may pass, and raise any other."""
        place = Place.here()
        try:
            work: Work = loads(self._work)
            return Report(place, *work(batch))
        except Exception as error:
            met = trouble(error, place, self._file)
            if met is None:
                raise
            return Report(place, [], 0.0, met)


class Todo:
    """The shards that are still to do, in order; what a batch left undone comes first again."""

    def __init__(self, todo: Numbers) -> None:
        self._runs, self.left = [todo], len(todo)

    def take(self, count: int) -> Numbers:
        """Return the next shards, ``count`` of them or fewer."""
        run = self._runs.pop()
        if len(run) > count:
            self._runs.append(run[count:])
        self.left -= len(run[:count])
        return run[:count]

    def give_back(self, run: Numbers) -> None:
        """Put shards in front of all others."""
        if len(run):
            self._runs.append(run)
            self.left += len(run)


@dataclass(eq=False)
class Batch:
    """Shards that go out together, and what has become of them so far.

    Attributes
    ----------
    copies
        Futures in flight, each with the workers that it may go to (empty: any).
    lost
        Deaths of workers that were none of its doing.
    deaths
        Deaths of workers that may have been: of a batch of one shard, tried alone.
    """

    shards: Numbers
    troubles: list[Trouble] = field(default_factory=list)
    deaths: list[Death] = field(default_factory=list)
    lost: list[Death] = field(default_factory=list)
    is_suspect: bool = False
    copies: dict[Any, frozenset[str]] = field(default_factory=dict)
    sent: float = 0.0

    def split(self, *, is_suspect: bool = False) -> list[Batch]:
        """Return a batch for each shard, with the same past."""
        is_suspect |= self.is_suspect
        parts = [self.shards[k : k + 1] for k in range(len(self.shards))]
        return [Batch(part, self.troubles.copy(), self.deaths.copy(), self.lost.copy(), is_suspect) for part in parts]


def next_size(size: int, rate: float, share: int) -> int:
    """Return how many shards the next batch holds: as many as its time allows, at most twice as many as before.

    Examples
    --------
    >>> next_size(8, rate=1000.0, share=100), next_size(8, rate=4.0, share=100), next_size(8, rate=1000.0, share=0)
    (16, 2, 1)
    """
    return max(1, min(int(rate * BATCH_S), 2 * size, share))
