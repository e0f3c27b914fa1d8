"""What scheduling costs: many shards with nothing to do, each with its entry in the journal."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Any

import psutil

from tract_dask.cluster.connect import connect
from tract_dask.cluster.tasks import run_shards
from tract_dask.settings import ClusterSettings
from tract_dask.store.journal import Journal, Payload
from tract_dask.store.shards import Shard, split

from .sizes import Size

_SETTLED = 5
"""Memory is taken once a fifth of the shards is done: by then all that is made once has been made."""


def nothing(shard: Shard) -> Payload:
    """Do the work of a shard that has none."""
    return {}


def run(size: Size, work: Path) -> dict[str, Any]:
    """Return the time for a shard, and how much the driver, which is the scheduler too, grew meanwhile."""
    process, shards = psutil.Process(), split(size.shards, 1)
    memory: list[float] = []

    def watch(shard: Shard, payload: Payload) -> None:
        if shard.index % max(1, size.shards // 100) == 0:
            memory.append(process.memory_info().rss / 1e6)

    with connect(ClusterSettings(workers=psutil.cpu_count())) as client:
        client.wait_for_workers(1)
        journal = Journal(work / "journal", "empty")
        began = perf_counter()
        run_shards(nothing, shards, journal=journal, name="empty", client=client, on_done=watch)
        seconds = perf_counter() - began
    return {
        "shards": size.shards,
        "ms_per_shard": 1e3 * seconds / size.shards,
        "driver_mb": {"settled": memory[len(memory) // _SETTLED], "end": memory[-1]},
    }
