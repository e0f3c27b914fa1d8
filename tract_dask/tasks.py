"""The loop that keeps workers busy with shards, and takes their results as they come."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import closing, contextmanager, suppress
from functools import partial
from threading import Event, Thread
from time import monotonic, perf_counter, sleep
from typing import Any, TypeAlias

import dask
import numpy as np
from distributed import Client, Worker, as_completed
from distributed.protocol.pickle import dumps, loads
from distributed.scheduler import KilledWorker
from numpy.typing import NDArray

from .errors import ClusterError, StoreError
from .journal import Journal, Payload
from .shards import Shard

PATIENCE = "tract_dask.patience-s"
"""Item of Dask's configuration: for how long, in s, work waits while the cluster has no worker."""

JOB = "tract_dask.job"
"""Item of Dask's configuration: the job that work is part of, to be named with its tasks."""

_PATIENCE_S = 60.0
_SETTLE_S = 15.0
"""For so long an interrupted run waits for the tasks that are being executed."""

_BATCH_S = 0.5
"""For so long a task goes on taking shards of its batch; a longer shard is a batch of its own."""

_ROUNDS = 3
"""So often shards are made that are not on disk afterwards."""

_LOOK_AGAIN_S = (0.2, 1.0, 5.0, 30.0, 60.0)
"""After such waits they are looked for again: network disks may show a file for so long as missing."""

Numbers: TypeAlias = NDArray[np.int64]
"""Indices of shards."""


def patience_s() -> float:
    """Return for how long work waits while the cluster has no worker, in s: as Dask is configured, or a minute."""
    return float(dask.config.get(PATIENCE, _PATIENCE_S))


def _nothing(shard: Shard, payload: Payload) -> None:
    pass


def run_shards(
    task: Callable[[Shard], Payload],
    shards: Sequence[Shard],
    *,
    journal: Journal,
    name: str,
    client: Client | None = None,
    on_done: Callable[[Shard, Payload], None] = _nothing,
) -> dict[int, Payload]:
    """Run ``task`` on every shard that the journal does not know, and return the payloads of all by index.

    Arguments and errors are those of :func:`stream_shards`, which keeps nothing.
    """
    payloads: dict[int, Payload] = {}

    def keep(shard: Shard, payload: Payload) -> None:
        payloads[shard.index] = payload

    stream_shards(task, shards, keep, journal=journal, name=name, client=client, on_done=on_done)
    return payloads


def stream_shards(
    task: Callable[[Shard], Payload],
    shards: Sequence[Shard],
    take: Callable[[Shard, Payload], None],
    *,
    journal: Journal,
    name: str,
    client: Client | None = None,
    on_done: Callable[[Shard, Payload], None] = _nothing,
) -> None:
    """Run ``task`` on every shard that the journal does not know, and hand every payload to ``take``.

    On a cluster, shards that take little time go out several at once: a task takes them one by one, and notes each in
    the journal, for about half a second. In the end every shard is looked at on disk, and made again where it is not
    as the journal says.

    Parameters
    ----------
    task
        Takes a shard, writes its result, returns its payload. Pass paths to it, not data.
    shards
        From :func:`split`: each is sent to the workers by its place among them, which is its ``index``.
    take
        Called once for each shard: first for those in the journal, then for the others as they are done.
    name
        Stage name, shown on the dashboard.
    client
        The cluster to run on; None runs in this process.
    on_done
        Called with each shard that this call finished, as it comes.

    Raises
    ------
    TractError
        The first error of a task; finished shards stay in the journal.
    StoreError
        Where a shard is not on disk though it was written, or another run has taken the place of this one.
    ClusterError
        Where workers die under a task again and again.
    """
    taken = np.zeros(len(shards), dtype=np.bool_)

    def take_once(index: int, payload: Payload) -> None:
        if not taken[index]:
            taken[index] = True
            take(shards[index], payload)

    work = partial(_work, task, shards, journal)
    todo = _missing(journal, shards, take_once)
    for _ in range(_ROUNDS):
        if not len(todo):
            return
        with closing(
            _run_here(work, todo) if client is None else _run_on(client, work, todo, shards, name)
        ) as finished:
            for index, payload in finished:
                take_once(index, payload)
                on_done(shards[index], payload)
        todo = _lost(journal, shards, take_once, patient=client is not None)
    if len(todo):
        raise StoreError(
            f"{len(todo)} shards of stage {name} were written, and are not on disk as they were written",
            str(journal.folder.parent),
            "the files that the journal names",
            f"none, or others, for frames {shards[todo[0]].start} to {shards[todo[0]].stop - 1}",
            "Check this disk and its connection, and run again",
        )


def _missing(journal: Journal, shards: Sequence[Shard], take: Callable[[int, Payload], None]) -> Numbers:
    """Hand on the payloads of the shards that are done, and on disk; return the others."""
    missing = np.ones(len(shards), dtype=np.bool_)
    for index, payload, _ in journal.sound(shards):
        missing[index] = False
        take(index, payload)
    return np.flatnonzero(missing)


def _lost(journal: Journal, shards: Sequence[Shard], take: Callable[[int, Payload], None], *, patient: bool) -> Numbers:
    """Return which shards are not on disk, though all were reported done.

    What another machine wrote can take a while to be seen on a network disk: a cluster's shards are looked for again.
    """
    lost = _missing(journal, shards, take)
    for seconds in _LOOK_AGAIN_S if patient else ():
        if not len(lost):
            break
        sleep(seconds)
        lost = _missing(journal, shards, take)
    return lost


Work: TypeAlias = Callable[[Numbers], tuple[list[Payload], float]]
Finished: TypeAlias = Generator[tuple[int, Payload], None, None]


def _work(
    task: Callable[[Shard], Payload], shards: Sequence[Shard], journal: Journal, batch: Numbers
) -> tuple[list[Payload], float]:
    """Do the shards of a batch until its time is up; return the payloads of those that are done, and the seconds."""
    began = perf_counter()
    payloads = []
    with journal.batch() as done:
        for index in batch.tolist():
            payloads.append(task(shards[index]))
            done(shards[index], payloads[-1])
            if perf_counter() - began > _BATCH_S:
                break
    return payloads, perf_counter() - began


class _Packed:
    """Work that is unpacked where it is done.

    What a task refers to, such as an open movie, is opened by unpacking it. The scheduler unpacks every task, and may
    see none of the files.
    """

    def __init__(self, work: Work) -> None:
        self._work = dumps(work)

    def __call__(self, batch: Numbers) -> tuple[list[Payload], float]:
        """Unpack the work and do it."""
        work: Work = loads(self._work)
        return work(batch)


def _run_here(work: Work, todo: Numbers) -> Finished:
    for k in range(len(todo)):
        (payload,), _ = work(todo[k : k + 1])
        yield int(todo[k]), payload


class _Queue:
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


def _run_on(client: Client, work: Work, todo: Numbers, shards: Sequence[Shard], name: str) -> Finished:
    """Keep a bounded window of batches in flight, so that neither driver nor scheduler grows with the movie.

    The window grows with the cluster, whose workers may come one after the other.
    """
    group = task_group(name)
    packed, queue, size = _Packed(work), _Queue(todo), 1
    running: dict[Any, Numbers] = {}
    completed = as_completed()
    crew = _Crew(client, running)

    def submit() -> None:
        while queue.left and len(running) < crew.window:
            batch = queue.take(size)
            future = client.submit(packed, batch, key=(group, int(batch[0])), pure=False)
            running[future] = batch
            completed.add(future)

    submit()
    try:
        for future in completed:
            batch = running[future]
            with _cluster_errors(name, shards[batch[0]].start, shards[batch[-1]].stop):
                payloads, seconds = future.result()  # waits anew where the worker that held it has gone
            del running[future]
            queue.give_back(batch[len(payloads) :])
            size = _next_size(size, len(payloads) / max(seconds, 1e-6), queue.left // (2 * crew.window))
            submit()
            yield from zip(batch.tolist(), payloads, strict=False)
    finally:
        crew.ended.set()
        if running and client.status == "running":
            client.cancel(list(running), force=True)
            _settle(client, group)


def task_group(name: str) -> str:
    """Return a new name for a group of tasks, of which Dask shows the first part as that of their kind.

    Examples
    --------
    >>> with dask.config.set({JOB: "3f9a0c12de"}):
    ...     task_group("fit")[:19]
    'fit-job_3f9a0c12de-'
    """
    job = dask.config.get(JOB, "")
    return "-".join((name, *([f"job_{job}"] if job else []), uuid.uuid4().hex))


def _settle(client: Client, group: str) -> None:
    """Wait until no worker of a cluster that goes on is still at a task of ``group``, of which none is queued any more.

    A running task cannot be stopped; what it writes must not come after what the next run does in the same place. A
    cluster of our own (:attr:`distributed.Client.cluster`) is about to end with its tasks.
    """
    deadline = monotonic() + _SETTLE_S
    with suppress(OSError):  # the cluster has gone
        while client.cluster is None and any(client.run(_is_at, group, on_error="ignore").values()):
            if monotonic() > deadline:
                return
            sleep(0.05)


def _is_at(group: str, dask_worker: Worker) -> bool:
    """Tell whether a worker executes a task of ``group``."""
    return any(task.key[0] == group for task in dask_worker.state.executing)


def _next_size(size: int, rate: float, share: int) -> int:
    """Return how many shards the next batch holds: as many as its time allows, at most twice as many as before.

    Examples
    --------
    >>> _next_size(8, rate=1000.0, share=100), _next_size(8, rate=4.0, share=100), _next_size(8, rate=1000.0, share=0)
    (16, 2, 1)
    """
    return max(1, min(int(rate * _BATCH_S), 2 * size, share))


class _Crew:
    """How many worker threads there are, looked at each second until ``ended`` is set.

    Cancels what is running once the cluster has had no worker for too long: nobody would ever finish it.
    """

    def __init__(self, client: Client, running: Iterable[Any]) -> None:
        self._client, self._running, self._patience_s = client, running, patience_s()
        self._threads: int = sum(client.nthreads().values())
        self.ended = Event()
        Thread(target=self._watch, daemon=True).start()

    @property
    def window(self) -> int:
        """How many batches may be in flight."""
        return 4 * max(1, self._threads) + 4

    def _watch(self) -> None:
        alone_since = monotonic()
        while not self.ended.wait(1.0):
            if self._client.status != "running":
                return
            self._threads = sum(self._client.nthreads().values())
            if self._threads:
                alone_since = monotonic()
            elif monotonic() - alone_since > self._patience_s:
                self._client.cancel(list(self._running), force=True)  # each second: the loop may have submitted another


@contextmanager
def _cluster_errors(name: str, start: int, stop: int) -> Iterator[None]:
    """Turn what the cluster says of a lost task into a ClusterError."""
    try:
        yield
    except KilledWorker as error:
        raise ClusterError(
            f"workers died again and again under frames {start} to {stop - 1} in stage {name}",
            str(error.last_worker.address),
            remedy="Give them more memory (--memory-limit) or make shards smaller (--shard-mb), and run again",
        ) from error
    except CancelledError as error:
        raise ClusterError(
            f"stage {name} was left without a worker or a scheduler",
            "the cluster",
            remedy="See the workers' logs, start the cluster anew, and run again: what is done is kept",
        ) from error
