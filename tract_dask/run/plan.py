"""How much memory and time a run needs, before it begins."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from distributed import Client

from ..cluster.connect import LazyClient
from ..cluster.memory import local_memory_limit, memory_budget
from ..errors import ClusterError
from ..settings.run import RunSettings
from ..store.layout import peak_memory, plan_layout
from ..store.shards import split

WORKER_BYTES = 300_000_000
"""What a worker process takes before it has read a pixel."""

BATCH_BYTES = 128_000_000
"""What a task that reads the movie works on at a time, beside the frames themselves and the sums of the field."""

_FILTER_BYTES = 40
"""A pixel of a frame that is filtered as a whole: its transform, powers and rings, or the dual of its gradient."""


@dataclass(frozen=True)
class Plan:
    """What a run is going to do, known before it does anything.

    Attributes
    ----------
    frames, shards, frames_per_shard
        The units of work.
    bytes_read, bytes_written
        From and to disk, before compression: the source once, the movie twice; the movie with its binned levels.
    peak_memory
        Bytes that a task needs with its worker, at most.
    memory_limit
        Bytes that it may use; None where the workers have no limit.
    """

    frames: int
    shards: int
    frames_per_shard: int
    bytes_read: int
    bytes_written: int
    peak_memory: int
    memory_limit: int | None = None

    def check(self) -> None:
        """Refuse work that does not fit.

        Raises
        ------
        ClusterError
            With both numbers.
        """
        if self.memory_limit is not None and self.peak_memory > self.memory_limit:
            raise ClusterError(
                "the work does not fit into a worker's memory",
                "plan",
                f"at most {self.memory_limit / 1e9:.2f} GB a task",
                f"{self.peak_memory / 1e9:.2f} GB for shards of {self.frames_per_shard} frames",
                "Make shards smaller (--shard-mb), give workers more memory (--memory-limit), or start fewer",
            )


def plan_run(
    shape: tuple[int, int, int], dtype: np.dtype[Any], settings: RunSettings, memory_limit: int | None = None
) -> Plan:
    """Return the plan for a movie of ``shape`` (frames, y, x) and ``dtype``; a pure function."""
    layout = plan_layout(shape, dtype, settings.convert)
    raw = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    shard = raw // shape[0] * layout.frames_per_shard
    filtered = _FILTER_BYTES * shape[1] * shape[2] if settings.fit.filters_frames else 0
    binned = sum(4 * shape[0] * (shape[1] // bin_) * (shape[2] // bin_) for bin_ in layout.bins)
    return Plan(
        frames=shape[0],
        shards=len(split(shape[0], layout.frames_per_shard)),
        frames_per_shard=layout.frames_per_shard,
        bytes_read=3 * raw + binned,
        bytes_written=raw + binned,
        peak_memory=WORKER_BYTES
        + max(peak_memory(layout), BATCH_BYTES + max(2 * shard, 24 * shape[1] * shape[2]) + filtered),
        memory_limit=memory_limit,
    )


def expected_limit(settings: RunSettings, client: Client | None) -> int | None:
    """Return the bytes that a task may use, without starting workers."""
    cluster = settings.cluster
    if client is None and cluster.resolved_kind != "address":
        return local_memory_limit(cluster) // cluster.threads
    with closing(LazyClient(cluster, client)) as workers:
        return memory_budget(workers())
