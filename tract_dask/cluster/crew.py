"""The workers of a cluster: which are there, which are left out."""

from __future__ import annotations

from collections.abc import Iterable
from threading import Event, Thread
from time import monotonic
from typing import Any

import dask
from distributed import Client

PATIENCE = "tract_dask.patience-s"
"""Item of Dask's configuration: for how long, in s, work waits while the cluster has no worker."""

HANG = "tract_dask.hang-s"
"""Item of Dask's configuration: a batch that takes so long, in s, and :data:`SLOW` times the longest, seems to hang."""

PATIENCE_S, HANG_S = 60.0, 60.0

LEFT_OUT_S = 300.0

RESTART_S = 60

MOST_SWOLLEN, MOST_LOST = 4, 10
"""So often a shard may lose its worker to its memory limit, and in other ways that say nothing of its data."""


def patience_s() -> float:
    """Return for how long work waits while the cluster has no worker, in s: as Dask is configured, or a minute."""
    return float(dask.config.get(PATIENCE, PATIENCE_S))


class Crew:
    """Which workers there are, with their threads, looked at each second until ``ended`` is set.

    Cancels what is running once the cluster has had no worker for too long: nobody would ever finish it.
    """

    def __init__(self, client: Client, running: Iterable[Any]) -> None:
        self._client, self._running, self._patience_s = client, running, patience_s()
        self.workers: dict[str, int] = dict(client.nthreads())
        self.ended = Event()
        Thread(target=self._watch, daemon=True).start()

    @property
    def window(self) -> int:
        """How many batches may be in flight."""
        return 4 * max(1, sum(self.workers.values())) + 4

    def _watch(self) -> None:
        alone_since = monotonic()
        while not self.ended.wait(1.0):
            if self._client.status != "running":
                return
            self.workers = dict(self._client.nthreads())
            if self.workers:
                alone_since = monotonic()
            elif monotonic() - alone_since > self._patience_s:
                self._client.cancel(list(self._running), force=True)  # each second: the loop may have submitted another
