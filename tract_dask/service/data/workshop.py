"""Where heavy requests are done: a few spawned processes, so that the service's own stays small and answers at once.

A worker does one task after the other and gives its result back by value. It is replaced once it has done many, or has
become large, so that memory stays flat; where it dies, its task is done once more by its successor.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import pickle
import signal
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from importlib import import_module
from itertools import count
from multiprocessing.connection import Connection
from pathlib import Path
from queue import LifoQueue
from threading import Lock
from time import monotonic
from traceback import format_exc
from typing import Any, TypeVar

from ...errors import ClusterError, TractError
from ...forkserver import THREAD_VARIABLES

T = TypeVar("T")

_START_S = 60.0
_BYTES = 1 << 30
"""A worker that holds more after a task is replaced."""

_SHELF_BYTES = 64 << 20


class WorkshopError(ClusterError):
    """The workshop is full, or a task took too long, or its worker died twice."""


class _LostWorkerError(Exception):
    """The worker died under its task."""


class Workshop:
    """A few processes that do what would hold up the other requests.

    Parameters
    ----------
    workers
        Processes; started when the first task comes, or by :meth:`start`.
    places
        Tasks that may wait; what comes on top is refused.
    tasks
        A worker that has done so many is replaced.
    imported
        Modules that a worker imports when it starts.
    """

    def __init__(
        self,
        workers: int = 2,
        *,
        places: int = 64,
        tasks: int = 500,
        imported: tuple[str, ...] = ("tract_dask.service.data.pictures", "tract_dask.service.data.tracks"),
    ) -> None:
        self._short = _Bench(workers, places, tasks, imported)
        self._long = _Bench(1, 8, 1, imported)
        self._shelf, self._coming = Shelf(_SHELF_BYTES), dict[str, asyncio.Task[bytes]]()

    def start(self) -> None:
        """Start the processes now, so that the first request need not wait for them."""
        self._short.start()

    async def run(self, function: Callable[..., T], *args: Any, timeout_s: float = 60.0) -> T:
        """Return ``function(*args)``, called in one of the processes.

        Parameters
        ----------
        function
            A function of a module, so that it is found by its name. It may be called twice.
        args
            Small, and pickled.
        timeout_s
            Then its process is ended.

        Raises
        ------
        TractError
            As the function raised it.
        WorkshopError
            Where too many tasks wait, the time is up, or the process died twice.
        """
        return await self._short.run(function, args, timeout_s)

    async def run_long(self, function: Callable[..., T], *args: Any, timeout_s: float = 3600.0) -> T:
        """Do the same in a process of its own, one such task at a time: for what takes longer than a glance."""
        return await self._long.run(function, args, timeout_s)

    async def run_kept(self, key: str, function: Callable[..., bytes], *args: Any) -> bytes:
        """Return ``function(*args)``, done once for the same ``key`` as long as there is room to keep its result."""
        found = self._shelf.get(key)
        if found is not None:
            return found
        task = self._coming.get(key)
        if task is None:
            task = self._coming[key] = asyncio.create_task(self.run(function, *args))
            task.add_done_callback(partial(self._arrived, key))
        return await asyncio.shield(task)

    def _arrived(self, key: str, task: asyncio.Task[bytes]) -> None:
        del self._coming[key]
        if not task.cancelled() and task.exception() is None:
            self._shelf.put(key, task.result())

    def close(self) -> None:
        """End the processes, and what they are at."""
        self._short.close()
        self._long.close()


class Shelf:
    """Results by their keys; those that were asked for last, as many as fit.

    Parameters
    ----------
    size
        Bytes that it holds at most.
    """

    def __init__(self, size: int) -> None:
        self._size, self._held, self._items = size, 0, OrderedDict[str, bytes]()

    def get(self, key: str) -> bytes | None:
        """Return what is kept under ``key``."""
        if key in self._items:
            self._items.move_to_end(key)
        return self._items.get(key)

    def put(self, key: str, value: bytes) -> None:
        """Keep ``value``, unless it takes more than an eighth of the room."""
        if key in self._items or len(value) > self._size // 8:
            return
        self._items[key] = value
        self._held += len(value)
        while self._held > self._size:
            _, oldest = self._items.popitem(last=False)
            self._held -= len(oldest)


class _Bench:
    """Places of a number of workers, and the tasks that wait for them."""

    def __init__(self, workers: int, places: int, tasks: int, imported: tuple[str, ...]) -> None:
        self._limit, self._closed = workers + places, False
        self._lock, self._here = Lock(), 0
        self._threads = ThreadPoolExecutor(workers, "workshop")
        self._seats: LifoQueue[_Seat] = LifoQueue()
        self._all = [_Seat(tasks, imported) for _ in range(workers)]
        for seat in reversed(self._all):
            self._seats.put(seat)

    def start(self) -> None:
        for seat in self._all:
            seat.start()

    async def run(self, function: Callable[..., T], args: tuple[Any, ...], timeout_s: float) -> T:
        with self._lock:
            if self._here >= self._limit:
                raise WorkshopError(
                    "the service has too much to do",
                    "workshop",
                    f"at most {self._limit} tasks at a time",
                    f"{self._here + 1}",
                    "Try again in a few seconds",
                )
            self._here += 1
        future = self._threads.submit(self._do, function, args, timeout_s)
        future.add_done_callback(self._left)
        return await asyncio.wrap_future(future)

    def _left(self, _: object) -> None:
        with self._lock:
            self._here -= 1

    def _do(self, function: Callable[..., T], args: tuple[Any, ...], timeout_s: float) -> T:
        seat = self._seats.get()
        try:
            try:
                return seat.do(function, args, timeout_s)
            except _LostWorkerError:
                if self._closed:
                    raise
                return seat.do(function, args, timeout_s)
        except _LostWorkerError:
            raise WorkshopError(
                "the process that did this died",
                getattr(function, "__name__", "task"),
                remedy="Try again; if it dies again, the machine may lack memory",
            ) from None
        finally:
            self._seats.put(seat)

    def close(self) -> None:
        self._closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        for wait in (False, True):  # a task that was about to begin has started another
            self._threads.shutdown(wait=wait)
            for seat in self._all:
                seat.end()


class _Seat:
    """The place of one worker: it has one when it needs one, and in time another."""

    def __init__(self, tasks: int, imported: tuple[str, ...]) -> None:
        self._tasks, self._imported = tasks, imported
        self._worker: _Worker | None = None
        self._successor: _Worker | None = None

    def start(self) -> None:
        if self._worker is None:
            self._worker = _Worker(self._tasks, self._imported)

    def do(self, function: Callable[..., T], args: tuple[Any, ...], timeout_s: float) -> T:
        if self._successor is not None and (self._worker is None or self._successor.ready):
            self._change()
        self.start()
        worker = self._worker
        assert worker is not None
        try:
            value: T
            value, tired = worker.do(function, args, timeout_s)
        except (_LostWorkerError, WorkshopError):
            self._change()
            raise
        if tired and self._tasks == 1:
            self._change()
        elif tired and self._successor is None:
            self._successor = _Worker(self._tasks, self._imported)  # it starts while the other goes on
        return value

    def _change(self) -> None:
        worker, self._worker, self._successor = self._worker, self._successor, None
        if worker is not None:
            worker.end()

    def end(self) -> None:
        self._change()
        self._change()


class _Worker:
    """A process that does one task after the other."""

    def __init__(self, tasks: int, imported: tuple[str, ...]) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, there = context.Pipe()
        arguments = (there, tasks, imported)
        self._process = context.Process(target=_work, args=arguments, name="tract_dask workshop", daemon=True)
        self._process.start()
        there.close()
        self._greeted = False

    @property
    def ready(self) -> bool:
        """Whether it has imported what it needs."""
        return self._greeted or self._pipe.poll()

    def do(self, function: Callable[..., Any], args: tuple[Any, ...], timeout_s: float) -> tuple[Any, bool]:
        """Return what the function returns, and whether the worker should be replaced."""
        try:
            if not self._greeted:
                self._answer(_START_S, "it does not start")
                self._greeted = True
            self._pipe.send((function, args))
            error, value, tired = self._answer(timeout_s, getattr(function, "__name__", "task"))
        except (EOFError, OSError) as lost:
            raise _LostWorkerError from lost
        if error is not None:
            raise error
        return pickle.loads(value), tired

    def _answer(self, timeout_s: float, where: str) -> Any:
        began = monotonic()
        if not self._pipe.poll(timeout_s):
            raise WorkshopError(
                "this takes too long",
                where,
                f"at most {timeout_s:g} s",
                f"{monotonic() - began:.0f} s",
                "Ask for less, or try again when the machine has less to do",
            )
        return self._pipe.recv()

    def end(self) -> None:
        self._process.kill()
        self._process.join()
        with suppress(OSError):
            self._pipe.close()


def _work(pipe: Connection, tasks: int, imported: tuple[str, ...]) -> None:
    """Do what comes through the pipe until its other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the service's to answer
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    for module in imported:
        import_module(module)
    with suppress(EOFError, OSError):
        pipe.send(None)
        for done in count(1):
            answer = _answered(pipe.recv_bytes())
            pipe.send_bytes(pickle.dumps((*answer, done >= tasks or _memory() > _BYTES)))


def _answered(task: bytes) -> tuple[Exception | None, bytes]:
    """Do a task; return its error, or its value as it goes through the pipe."""
    try:
        function, args = pickle.loads(task)
        return None, pickle.dumps(function(*args))
    except TractError as error:
        return error, b""
    except Exception:  # noqa: BLE001 (the worker goes on)
        return RuntimeError(f"in the workshop:\n{format_exc()}"), b""


def _memory() -> int:
    """Return the bytes of memory that this process holds; 0 where the system does not say."""
    with suppress(OSError):
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    return 0
