"""Where heavy requests are done: a few spawned processes, so that the service's own stays small and answers at once.

A worker does one task after the other and gives its result back by value. It is replaced once it has done many, or has
become large, so that memory stays flat; where it dies, its task is done once more by its successor, which has done
nothing else: what crashes there as well is the file's fault. Files are first opened here, never in the service's own
process. A worker has a limit on its private memory; files that it maps do not count.
"""

from __future__ import annotations

import asyncio
import gc
import multiprocessing
import os
import pickle
import signal
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from itertools import count
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Semaphore, Thread
from traceback import format_exc
from typing import Any, TypeVar

from ..cluster.forkserver import THREAD_VARIABLES, uncollected
from ..errors import ClusterError, TractError
from .crashes import Blamed, CrashError, ExhaustedError, crash_of, crashed, exhausted, of_system, unending

T = TypeVar("T")

_START_S = 60.0
_BYTES = 1 << 30
"""A worker that holds more after a task is replaced."""

_LEAST_BYTES = 512 << 20
"""A worker may always hold so much more than it does when it has started: the compilers of kernels need it."""

_COLLECTED = (100_000, 20, 20)
"""When garbage is looked for; as usual, half of the time of a long table would go into that."""

_CACHE_BYTES = 64 << 20
_END_S = 5.0


class ProcessPoolError(ClusterError):
    """The pool is full, or a task took too long, or its worker died twice."""


class _LostWorkerError(Exception):
    """The worker died under its task; with its exit code."""


@dataclass(frozen=True)
class _WorkerOptions:
    """How workers are: so many tasks each, these modules, so many bytes of private memory (None: no limit)."""

    tasks: int
    imported: tuple[str, ...]
    memory: int | None = None


@dataclass(frozen=True)
class _Task:
    """Something to be done: a call, for how long, and the file or folder that is to blame where it crashes."""

    function: Callable[..., Any]
    args: tuple[Any, ...]
    timeout_s: float
    about: str = ""

    @property
    def name(self) -> str:
        return self.about or getattr(self.function, "__name__", "task")

    def late(self) -> TractError:
        """Return the error for a worker that did not answer in time."""
        if self.about:
            return unending(self.about, self.timeout_s)
        remedy = "Ask for less, or try again when the machine has less to do"
        return ProcessPoolError("this takes too long", self.name, f"at most {self.timeout_s:g} s", "more", remedy)

    def killed(self) -> ProcessPoolError:
        """Return the error for workers that were killed."""
        remedy = "Try again; if it dies again, the machine may lack memory"
        return ProcessPoolError("the process that did this died", self.name, remedy=remedy)


class ProcessPool:
    """A few processes that do what would hold up the other requests.

    Parameters
    ----------
    workers
        Processes; started when the first task comes, or by :meth:`start`.
    places
        Tasks that may wait; what comes on top is refused.
    tasks
        A worker that has done so many is replaced.
    memory
        Bytes of private memory that a task may take; None: as many as there are.
    imported
        Modules that a worker imports when it starts.
    """

    def __init__(
        self,
        workers: int = 2,
        *,
        places: int = 64,
        tasks: int = 500,
        memory: int | None = None,
        imported: tuple[str, ...] = ("tract_dask.service.views.pictures", "tract_dask.service.views.tracks"),
    ) -> None:
        self._short = _WorkerGroup(workers, places, _WorkerOptions(tasks, imported, memory))
        self._long = _WorkerGroup(1, 8, _WorkerOptions(1, imported, memory))
        self._blamed = Blamed()
        self._cache, self._pending = ResultCache(_CACHE_BYTES), dict[str, asyncio.Task[bytes]]()

    def start(self) -> None:
        """Start the processes now, so that the first request need not wait for them."""
        self._short.start()

    async def run(self, function: Callable[..., T], *args: Any, timeout_s: float = 60.0, about: str | Path = "") -> T:
        """Return ``function(*args)``, called in one of the processes.

        Parameters
        ----------
        function
            A function of a module, so that it is found by its name. It may be called twice.
        args
            Small, and pickled.
        timeout_s
            Then its process is ended.
        about
            The file or folder that it reads, to be named where the process crashes or does not come to an end.

        Raises
        ------
        TractError
            As the function raised it.
        CrashError
            Where the process crashed twice, the second time a new one, or did not come to an end with ``about``; also,
            for some minutes, where it did so before with the same file.
        ExhaustedError
            Where it needs too much memory.
        ProcessPoolError
            Where too many tasks wait, the time is up, or the process was killed twice.
        """
        value: T = await self._at(self._short, _Task(function, args, timeout_s, str(about)))
        return value

    async def run_long(
        self, function: Callable[..., T], *args: Any, timeout_s: float = 3600.0, about: str | Path = ""
    ) -> T:
        """Do the same in a process of its own, one such task at a time: for what takes longer than a glance."""
        value: T = await self._at(self._long, _Task(function, args, timeout_s, str(about)))
        return value

    async def _at(self, group: _WorkerGroup, task: _Task) -> Any:
        if task.about:
            await asyncio.to_thread(self._blamed.check, task.about)
        try:
            return await group.run(task)
        except CrashError as error:
            await asyncio.to_thread(self._blamed.add, task.about, error)
            raise

    async def run_cached(self, key: str, function: Callable[..., bytes], *args: Any, about: str | Path = "") -> bytes:
        """Return ``function(*args)``, done once for the same ``key`` as long as there is room to keep its result."""
        found = self._cache.get(key)
        if found is not None:
            return found
        task = self._pending.get(key)
        if task is None:
            task = self._pending[key] = asyncio.create_task(self.run(function, *args, about=about))
            task.add_done_callback(partial(self._arrived, key))
        return await asyncio.shield(task)

    def _arrived(self, key: str, task: asyncio.Task[bytes]) -> None:
        del self._pending[key]
        if not task.cancelled() and task.exception() is None:
            self._cache.put(key, task.result())

    def close(self) -> None:
        """End the processes, and what they are at."""
        self._short.close()
        self._long.close()


class ResultCache:
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


class _WorkerGroup:
    """Places of a number of workers, and the tasks that wait for them."""

    def __init__(self, workers: int, places: int, options: _WorkerOptions) -> None:
        self._limit, self._closed = workers + places, False
        self._room = Semaphore(self._limit)
        self._threads = ThreadPoolExecutor(workers, "process pool")
        self._all = [_Slot(options) for _ in range(workers)]
        self._free = self._all[::-1]  # as many as threads; the one that was used last is warm

    def start(self) -> None:
        for slot in self._all:
            slot.start()

    async def run(self, task: _Task) -> Any:
        if not self._room.acquire(blocking=False):
            raise ProcessPoolError(
                "the service has too much to do",
                "process pool",
                f"at most {self._limit} tasks at a time",
                f"{self._limit + 1}",
                "Try again in a few seconds",
            )
        future = self._threads.submit(self._do, task)
        future.add_done_callback(lambda _: self._room.release())
        return await asyncio.wrap_future(future)

    def _do(self, task: _Task) -> Any:
        slot = self._free.pop()
        try:
            return self._tried(slot, task)
        except _LostWorkerError as lost:
            sign = crash_of(lost.args[0])
            raise (crashed(task.about, sign) if sign and task.about else task.killed()) from None
        finally:
            self._free.append(slot)

    def _tried(self, slot: _Slot, task: _Task) -> Any:
        try:
            return slot.do(task)
        except _LostWorkerError:  # perhaps by what it did before
            if self._closed:
                raise
            return slot.do(task)

    def close(self) -> None:
        self._closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        for wait in (False, True):  # a task that was about to begin has started another
            self._threads.shutdown(wait=wait)
            for slot in self._all:
                slot.end()


class _Slot:
    """The place of one worker: it has one when it needs one, and in time another."""

    def __init__(self, options: _WorkerOptions) -> None:
        self._options = options
        self._worker: _Worker | None = None
        self._successor: _Worker | None = None

    def start(self) -> _Worker:
        self._worker = self._worker or _Worker(self._options)
        return self._worker

    def do(self, task: _Task) -> Any:
        if self._successor is not None and (self._worker is None or self._successor.ready):
            self._change()
        try:
            value, tired = self.start().do(task)
        except (_LostWorkerError, CrashError, ExhaustedError, ProcessPoolError):
            self._change()
            raise
        if tired and self._options.tasks == 1:
            self._change()
        elif tired and self._successor is None:
            self._successor = _Worker(self._options)  # it starts while the other goes on
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

    def __init__(self, options: _WorkerOptions) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, there = context.Pipe()
        self._process = context.Process(target=_work, args=(there, options), name="tract_dask pool", daemon=True)
        self._process.start()
        there.close()
        self._is_ready = False

    @property
    def ready(self) -> bool:
        """Whether it has imported what it needs."""
        return self._is_ready or self._pipe.poll()

    def do(self, task: _Task) -> tuple[Any, bool]:
        """Return what the function returns, and whether the worker should be replaced."""
        try:
            if not self._is_ready:
                self._answer(_START_S, _unstarted())
                self._is_ready = True
            self._pipe.send((task.function, task.args))
            error, value, tired = self._answer(task.timeout_s, task.late())
        except (EOFError, OSError) as lost:
            self._process.join(_END_S)
            raise _LostWorkerError(self._process.exitcode) from lost
        if isinstance(error, int):
            raise exhausted(task.name, error)
        if error is not None:
            raise error
        return pickle.loads(value), tired

    def _answer(self, timeout_s: float, late: TractError) -> Any:
        if not self._pipe.poll(timeout_s):
            raise late
        return self._pipe.recv()

    def end(self) -> None:
        self._process.kill()
        self._process.join(_END_S)  # one that waits for a dead disk cannot be killed before that answers
        with suppress(OSError):
            self._pipe.close()


def _unstarted() -> ProcessPoolError:
    what, remedy = "the process that was to do this does not start", "Try again when the machine has less to do"
    return ProcessPoolError(what, "process pool", f"at most {_START_S:g} s", remedy=remedy)


def _work(pipe: Connection, options: _WorkerOptions) -> None:
    """Do what comes through the pipe until its other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the service's to answer
    Thread(target=_end_with_parent, daemon=True).start()
    os.environ |= dict.fromkeys(THREAD_VARIABLES, "1")
    os.environ["ARROW_DEFAULT_MEMORY_POOL"] = "system"  # its own reserves 1 GiB
    with uncollected():
        for module in options.imported:
            import_module(module)
    gc.set_threshold(*_COLLECTED)
    limit = 0 if options.memory is None else _limit_memory(max(options.memory, _LEAST_BYTES))
    with suppress(EOFError, OSError):
        pipe.send(None)
        for done in count(1):
            answer = _answered(pipe.recv_bytes(), limit)
            pipe.send_bytes(pickle.dumps((*answer, done >= options.tasks or own_memory("VmRSS") > _BYTES)))


def _end_with_parent() -> None:
    """End this process once the service has gone, whatever it is at."""
    if parent := multiprocessing.parent_process():
        parent.join()
        os._exit(1)


def _limit_memory(more: int) -> int:
    """Let this process take only ``more`` bytes beyond what it has; return that number.

    What counts is private memory that can be written (RLIMIT_DATA). Address space does not: movies are mapped, and
    libraries reserve more than they use.
    """
    import resource  # not there on Windows

    if held := own_memory("VmData"):
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_DATA, (held + more, held + more))
    return more


def own_memory(kind: str) -> int:
    """Return the bytes of memory of this process, of a kind such as VmData; 0 where the system does not say."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith(f"{kind}:"):
                return int(line.split()[1]) * 1024
    return 0


def _answered(task: bytes, limit: int) -> tuple[Exception | int | None, bytes]:
    """Do a task; return its error, or its value as it goes through the pipe; ``limit`` where its memory was over it."""
    try:
        function, args = pickle.loads(task)
        return None, pickle.dumps(function(*args))
    except Exception as error:  # noqa: BLE001 (the worker goes on)
        if _is_starved(error):
            return limit, b""
        if isinstance(error, TractError | OSError) and (found := of_system(error) or error):
            return found, b""
        return RuntimeError(f"in the process pool:\n{format_exc()}"), b""


def _is_starved(error: BaseException | None) -> bool:
    """Tell whether memory ran out, whatever the error was made into since."""
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__ or error.__context__
    return False
