"""Runs the jobs: takes them from the queue, so many at a time, and sees each through its tries."""

from __future__ import annotations

import logging
import sqlite3
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from threading import Event, Thread

from ...store.locks import sole_use
from ..config import ServiceConfig
from ..deletion import finish_deletions
from ..jobs.records import Job, utc_now
from ..jobs.states import State
from ..jobs.store import JobStore
from .cluster_process import ClusterProcess
from .job_process import JobProcess

_log = logging.getLogger(__name__)

_LOOK_S = 1.0


class Runner:
    """Runs the jobs of a store on the cluster that they share.

    Parameters
    ----------
    config
        Says where the data are, how many jobs run at a time, and on which cluster.
    store
        Of the jobs; of all runners, only this one may run them.

    Attributes
    ----------
    cluster
        Keeps the cluster.
    """

    def __init__(self, config: ServiceConfig, store: JobStore) -> None:
        self.cluster = ClusterProcess(config.cluster, config.state)
        self._config, self._store, self._root = config, store, config.root
        self._processes: dict[str, JobProcess] = {}
        self._awake, self._stopping = Event(), Event()
        self._thread: Thread | None = None
        self._held = ExitStack()

    def start(self) -> None:
        """Take up the jobs where a service before has left them, and go on.

        Raises
        ------
        DestinationError
            Where another service works on the same data root.
        """
        lock = self._config.state / "service.lock"
        self._held.enter_context(sole_use(lock, "another service works on this data root", patience_s=5.0))
        self._stopping.clear()
        self._recover("the service had been killed")
        Thread(target=finish_deletions, args=(self._root, self._store), name="tidying", daemon=True).start()
        self.cluster.start()
        self._thread = Thread(target=self._loop, name="runner", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the running jobs' processes; the jobs go back to the queue."""
        self._stopping.set()
        self._awake.set()
        if self._thread is not None:
            self._thread.join()
        for process in self._processes.values():
            process.join()
        self.cluster.stop()
        self._held.close()

    def is_alive(self) -> bool:
        """Tell whether jobs are started."""
        return self._thread is not None and self._thread.is_alive()

    def wake(self) -> None:
        """Look at the queue now: something has changed."""
        self._awake.set()

    def _loop(self) -> None:
        while not self._stopping.is_set():
            try:
                self._fill()
            except (
                sqlite3.Error,
                OSError,
                RuntimeError,
            ):  # a full disk, say: the next look may go well
                _log.exception("the queue cannot be looked at now")
            self._awake.wait(_LOOK_S)
            self._awake.clear()

    def _fill(self) -> None:
        """Start as many jobs as there is room for."""
        self._processes = {name: process for name, process in self._processes.items() if process.is_alive()}
        self._recover("its thread had ended")
        while len(self._processes) < self._config.concurrency and not self._stopping.is_set():
            job = next_job(self._store.queued(), self._store.running(), self._store.served(), utc_now())
            if job is None:
                return
            self._start(job)

    def _start(self, job: Job) -> None:
        job = self._store.change(job.id, State.RUNNING, "its turn")
        process = JobProcess(job, self._store, self._root, self.cluster, self._stopping, self.wake)
        self._processes[job.id] = process
        process.start()

    def _recover(self, reason: str) -> None:
        """Put jobs back into the queue that are noted as running, but that nobody runs."""
        for job in self._store.running():
            if job.id in self._processes:
                continue
            cancelled = self._store.cancel_reason(job.id)
            if cancelled is None:
                self._store.change(job.id, State.QUEUED, reason)
            else:
                self._store.change(job.id, State.CANCELLED, cancelled)


def next_job(queued: Sequence[Job], running: Sequence[Job], served: Mapping[str, str], now: str) -> Job | None:
    """Return the job to start next; None where none may start yet. A pure function.

    The owner with the fewest running jobs comes first; among equals the one who has waited longest, since a job of
    theirs was last started or, if later, since they submitted the oldest of those that wait; of an owner's jobs the
    oldest. So each owner who waits is passed over at most once by every other, however many come and submit.

    Parameters
    ----------
    queued, running
        The jobs in these states.
    served
        When a job of each owner was last started (:meth:`tract_dask.service.jobs.store.JobStore.served`).
    now
        Jobs that are not to be tried before a later time are left out.
    """
    ready = [job for job in queued if (job.not_before or "") <= now]
    busy = Counter(job.owner for job in running)
    oldest: dict[str, Job] = {}
    for job in sorted(ready, key=lambda job: job.number):
        oldest.setdefault(job.owner, job)

    def turn(job: Job) -> tuple[int, str, int]:
        return busy[job.owner], max(served.get(job.owner, ""), job.created), job.number

    return min(oldest.values(), key=turn, default=None)
