"""The loop on a cluster: it keeps workers busy with batches of shards, and tries again what they could not do.

A batch that met an error which may pass goes to another worker, after a wait. One whose worker died goes out again; the
shards of one whose worker crashed are tried alone, so that what crashes workers is found. A batch that takes far longer
than all others is copied to another worker: the first result counts.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Collection, Generator, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue
from threading import Thread
from time import monotonic, sleep, time
from typing import Any, TypeAlias

import dask
from distributed import Client, Worker
from distributed.scheduler import KilledWorker

from ..errors import ClusterError, StoreError, TractError
from ..store.journal import Payload
from ..store.shards import Shard
from .batch import Batch, Numbers, Packed, Report, Todo, Work, next_size
from .crew import HANG, HANG_S, LEFT_OUT_S, MOST_LOST, MOST_SWOLLEN, RESTART_S, Crew
from .deaths import Death, death, is_to_blame
from .retries import Rows, Trouble, is_hopeless, places_to_avoid, wait_s

SLOW = 20
"""So many times as long as the longest batch so far is too long; while there is none, five times :data:`HANG`."""

JOB = "tract_dask.job"
"""Item of Dask's configuration: the job that work is part of, to be named with its tasks."""

_SETTLE_S = 15.0
"""For so long an interrupted run waits for the tasks that are being executed."""

_TICK_S, _LOOK_S = 0.25, 1.0

_FETCH_S = 5.0
"""A worker that does not hand over a small result in this time is given up, as one that hangs."""

_WORD_S = 1.0
"""For so long the nanny of a dead worker may take to say how it died."""

Finished: TypeAlias = Generator[tuple[int, Payload], None, None]

Tell: TypeAlias = Callable[[str], None]


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


class Dispatch:
    """Keeps a bounded window of batches in flight, so that neither driver nor scheduler grows with the movie.

    The window grows with the cluster, whose workers may come one after the other.

    Parameters
    ----------
    name
        Of the stage.
    file
        What the shards are read from, to be named in errors.
    tell
        Called with what the user should know.
    """

    def __init__(
        self, client: Client, work: Work, todo: Numbers, shards: Sequence[Shard], name: str, file: str, tell: Tell
    ) -> None:
        self._client, self._packed, self._shards, self._tell = client, Packed(work, file), shards, tell
        self._name, self._file, self._group = name, file, task_group(name)
        self._todo, self._size, self._sent, self._finished = Todo(todo), 1, 0, 0
        self._flying: dict[Any, Batch] = {}
        self._later: list[tuple[float, Callable[[], None]]] = []
        self._suspects: list[Batch] = []
        self._arrived: SimpleQueue[Any] = SimpleQueue()
        self._rows, self._left_out, self._told = Rows(), dict[str, float](), set[object]()
        self._longest_s, self._looked = 0.0, monotonic()
        self._hang_s = float(dask.config.get(HANG, HANG_S))
        self._crew = Crew(client, self._flying)

    def results(self) -> Finished:
        """Yield index and payload of every shard, as they are done."""
        try:
            while self._todo.left or self._flying or self._later or self._suspects:
                self._submit()
                with suppress(Empty):
                    yield from self._take(self._arrived.get(timeout=_TICK_S))
                self._look()
        finally:
            self._end()

    def _submit(self) -> None:
        """Send what is due, what is to be tried alone, and then as much new work as there is room for."""
        now = monotonic()
        due = [act for at, act in self._later if at <= now]
        self._later = [item for item in self._later if item[0] > now]
        for act in due:
            act()
        self._test_suspects()
        while self._todo.left and self._in_hand() < self._crew.window:
            self._send(Batch(self._todo.take(self._size)))

    def _in_hand(self) -> int:
        return len(self._flying) + len(self._later) + len(self._suspects)

    def _test_suspects(self) -> None:
        """Give each worker that has none a shard that is to be tried alone."""
        if not self._suspects:
            return
        bounds = (bound for batch in self._flying.values() if batch.is_suspect for bound in batch.copies.values())
        testing: set[str] = set().union(*bounds)
        for worker in self._healthy() - testing:
            before = (k for k, batch in enumerate(self._suspects) if worker not in {d.worker for d in batch.deaths})
            if self._suspects:
                self._send(self._suspects.pop(next(before, 0)), only={worker})

    def _healthy(self) -> set[str]:
        """Return the workers that are not left out now; all of them, where that leaves none."""
        now = monotonic()
        workers = set(self._crew.workers)
        return {worker for worker in workers if self._left_out.get(worker, 0.0) < now} or workers

    def _send(self, batch: Batch, only: Collection[str] = ()) -> None:
        """Submit a batch, or a further copy of it, to some workers or to any that serve."""
        workers = set(self._crew.workers)
        healthy = self._healthy()
        chosen = set(only) or healthy - places_to_avoid(batch.troubles, healthy) or healthy
        bound = frozenset() if chosen == workers and not only else frozenset(chosen)
        self._sent += 1
        key = (self._group, int(batch.shards[0]), self._sent)
        where = {"workers": sorted(bound)} if bound else {}
        future = self._client.submit(self._packed, batch.shards, key=key, pure=False, **where)
        batch.copies[future], batch.sent = bound, monotonic()
        self._flying[future] = batch
        future.add_done_callback(self._arrived.put)

    def _take(self, future: Any) -> Finished:
        """Take a future that has ended, well or not."""
        batch = self._flying.get(future)
        if batch is None:  # another copy was faster
            return
        try:
            report: Report = future.result(timeout=_FETCH_S)  # waits anew where the worker that held it has gone
        except KilledWorker as error:
            self._drop(batch, future)
            self._died(batch, str(error.last_worker.address))
            return
        except CancelledError as error:
            raise ClusterError(
                f"stage {self._name} was left without a worker or a scheduler",
                "the cluster",
                remedy="See the workers' logs, restart the cluster, and run again: what is done is kept",
            ) from error
        except TimeoutError:
            if future.status == "error":
                raise
            self._drop(batch, future)
            self._send_if_alone(batch)
            return
        if report.trouble is not None:
            self._drop(batch, future)
            self._failed(batch, report.trouble)
            return
        for copy in list(batch.copies):
            self._drop(batch, copy)
        yield from self._succeeded(batch, report)

    def _drop(self, batch: Batch, future: Any) -> None:
        """Forget a copy of a batch; the cluster does not begin it any more."""
        del batch.copies[future], self._flying[future]
        future.release()

    def _send_if_alone(self, batch: Batch) -> None:
        if not batch.copies:
            self._send(batch)

    def _succeeded(self, batch: Batch, report: Report) -> Finished:
        payloads, seconds = report.payloads, report.seconds
        self._rows.succeeded(report.place.worker)
        self._finished += 1
        self._longest_s = max(self._longest_s, seconds)
        self._todo.give_back(batch.shards[len(payloads) :])
        rate, share = len(payloads) / max(seconds, 1e-6), self._todo.left // (2 * self._crew.window)
        self._size = next_size(self._size, rate, share)
        self._submit()
        yield from zip(batch.shards.tolist(), payloads, strict=False)

    def _frames(self, batch: Batch) -> str:
        first, last = self._shards[batch.shards[0]].start, self._shards[batch.shards[-1]].stop - 1
        return f"frames {first} to {last}"

    def _tell_once(self, what: object, text: str) -> None:
        if what not in self._told:
            self._told.add(what)
            self._tell(text)

    # What fails -----------------------------------------------------------------------------------------------------

    def _failed(self, batch: Batch, met: Trouble) -> None:
        """Try the shards of a batch again, each by itself, later and elsewhere; or give up."""
        worker = met.place.worker
        self._tell_once((worker, met.number), f"worker {worker}: {met}; {self._frames(batch)} are tried again")
        if self._rows.failed(worker):
            self._leave_out(worker, f"worker {worker} fails again and again ({met}): it is left out for some minutes")
        if batch.copies:
            return
        for part in batch.split():
            part.troubles.append(met)
            if is_hopeless(part.troubles, self._crew.workers):
                raise met.error
            wait = wait_s(len(part.troubles)) if met.passes else 0.0
            self._later.append((monotonic() + wait, partial(self._send, part)))

    def _leave_out(self, worker: str, text: str) -> None:
        if self._left_out.get(worker, 0.0) < monotonic():
            self._left_out[worker] = monotonic() + LEFT_OUT_S
            self._tell(text)

    # Workers that die -----------------------------------------------------------------------------------------------

    def _died(self, batch: Batch, worker: str) -> None:
        """Judge later, once the worker's nanny has had the time to say how it died."""
        self._later.append((monotonic() + _WORD_S, partial(self._judge, batch, worker)))

    def _judge(self, batch: Batch, worker: str) -> None:
        """Send a batch whose worker died once more; its shards alone, where they may be the reason; or give up."""
        how = death(self._client, worker)
        self._tell_once(how, f"worker {worker} died ({how}); what it was doing is done again")
        if batch.copies:
            return
        if how.is_of_node or not (how.is_crash or how.out_of_memory or batch.is_suspect or batch.lost):
            batch.lost.append(how)
            self._check_lost(batch.lost, MOST_LOST, batch)
            (self._suspects.append if batch.is_suspect else self._send)(batch)
        elif not batch.is_suspect:
            self._suspects += batch.split(is_suspect=True)
        else:
            batch.deaths.append(how)
            self._check_lost([met for met in batch.deaths if met.out_of_memory], MOST_SWOLLEN, batch)
            if is_to_blame(batch.deaths, others_finished=self._finished > 0):
                raise self._crash(batch, how)
            self._suspects.append(batch)

    def _check_lost(self, lost: list[Death], most: int, batch: Batch) -> None:
        """Give up a batch that loses one worker after the other, though not by its data."""
        if len(lost) >= most:
            raise ClusterError(
                f"workers died again and again under {self._frames(batch)} in stage {self._name}",
                lost[-1].worker,
                got=str(lost[-1]),
                remedy="Give them more memory (--memory-limit) or make shards smaller (--shard-mb), and run again",
            )

    def _crash(self, batch: Batch, how: Death) -> TractError:
        return StoreError(
            f"{self._frames(batch)} crash every worker that works on them in stage {self._name}",
            self._file,
            got=f"{how}, {len(batch.deaths)} times",
            remedy="A library fails on this file, which may be damaged: make it again, or leave those frames out",
        )

    # Workers that hang ----------------------------------------------------------------------------------------------

    def _look(self) -> None:
        """Once a second: send again what waits for workers that have gone, and look for what hangs."""
        now = monotonic()
        if now - self._looked < _LOOK_S:
            return
        self._looked = now
        workers = set(self._crew.workers)
        for future, batch in list(self._flying.items()):
            bound = batch.copies[future]
            if workers and bound and not bound & workers and future.status == "pending":
                self._drop(batch, future)
                self._send_if_alone(batch)
        if any(now - batch.sent > self._limit_s for batch in self._flying.values()):
            self._look_for_hangs()

    @property
    def _limit_s(self) -> float:
        return max(self._hang_s, SLOW * self._longest_s) if self._finished else 5 * self._hang_s

    def _look_for_hangs(self) -> None:
        """Copy the batches of workers that hang to others; let nannies restart those that do not even breathe."""
        limit = self._limit_s
        by_key = {future.key: batch for future, batch in self._flying.items()}
        for worker, (keys, silent_s, busy_s) in self._client.run_on_scheduler(_whereabouts, self._group).items():
            if max(silent_s, busy_s) <= limit:
                continue
            held = [by_key[key] for key in keys if key in by_key]
            stuck = [batch for batch in held if monotonic() - batch.sent > limit]
            if not stuck:
                continue
            others = set(self._crew.workers) - {worker}
            what = f"has been silent for {silent_s:.0f} s" if silent_s > limit else f"has been busy for {busy_s:.0f} s"
            then = "they are given to others" if others else "there is no other worker: the work waits"
            self._leave_out(worker, f"worker {worker} {what}: {self._frames(stuck[0])}, {self._file}; {then}")
            for batch in dict.fromkeys(held) if others else ():
                self._send(batch)
            if silent_s > limit:
                _restart(self._client, worker)

    def _end(self) -> None:
        self._crew.ended.set()
        if self._flying and self._client.status == "running":
            self._client.cancel(list(self._flying), force=True)
            _settle(self._client, self._group, sorted(self._healthy()))


def _whereabouts(group: str, dask_scheduler: Any) -> dict[str, tuple[list[Any], float, float]]:
    """Return, for each worker with tasks of a group: their keys, for how many s it is silent, and busy with one."""
    found, now = {}, time()
    for worker in dask_scheduler.workers.values():
        ours = [task for task in worker.processing if task.key[0] == group]
        if ours:
            busy_s = max(worker.executing.get(task, 0.0) for task in ours)
            found[worker.address] = [task.key for task in ours], now - worker.last_seen, busy_s
    return found


def _restart(client: Client, worker: str) -> None:
    """Let the nanny of a worker kill it and start another, in a thread: a dead disk may hold the process."""

    def restart() -> None:
        with suppress(Exception):  # the scheduler removes it by itself, after some minutes
            client.restart_workers([worker], timeout=RESTART_S, raise_for_error=False)

    Thread(target=restart, daemon=True).start()


def _settle(client: Client, group: str, workers: list[str]) -> None:
    """Wait until no worker of a cluster that goes on is still at a task of ``group``, of which none is queued any more.

    A running task cannot be stopped; what it writes must not come after what the next run does in the same place. A
    cluster of our own (:attr:`distributed.Client.cluster`) is about to end with its tasks. Workers that hang are not
    waited for.
    """
    if client.cluster is not None:
        return

    def wait() -> None:
        deadline = monotonic() + _SETTLE_S
        with suppress(OSError):  # the cluster has gone
            while monotonic() < deadline and any(
                client.run(_is_at, group, workers=workers, on_error="ignore").values()
            ):
                sleep(0.05)

    waiting = Thread(target=wait, daemon=True)
    waiting.start()
    waiting.join(_SETTLE_S)


def _is_at(group: str, dask_worker: Worker) -> bool:
    """Tell whether a worker executes a task of ``group``."""
    return any(task.key[0] == group for task in dask_worker.state.executing)
