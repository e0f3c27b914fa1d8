"""What surrounds a run: client, events, and work in the background, such as the picture of the columns."""

from __future__ import annotations

import dataclasses
import os
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from itertools import chain, repeat
from pathlib import Path
from time import perf_counter
from types import TracebackType

import xarray as xr
from distributed import Client

from ..cluster.connect import LazyClient
from ..cluster.memory import memory_budget
from ..cluster.retries import Done, persist
from ..cluster.tls import open_to_others
from ..errors import StoreError
from ..progress import Event, RunDone, RunStarted, RunState, Sink, StageDone, Warned
from ..settings.cluster import ClusterSettings
from ..store import disk
from ..store.held import check_held
from .plan import Plan


class Session:
    """What every job has around it: a client at its first use, and events that tell its beginning and its end.

    A thread does what nothing waits for, while the workers work.
    """

    def __init__(
        self,
        source: str,
        output: Path,
        cluster: ClusterSettings,
        client: Client | None,
        send: Sink,
        plan: Plan | None = None,
    ) -> None:
        self._started, self._plan, self._began = RunStarted(source, str(output)), plan, perf_counter()
        self._is_given = client is not None
        self.workers, self._sink = LazyClient(cluster, client, self._on_connect), send
        self._refusal: OSError | None = None
        self.state, self.message = RunState.DONE, ""
        self._thread, self._asides = ThreadPoolExecutor(1, "aside"), list[tuple[Callable[[], object], Future[object]]]()

    def send(self, event: Event) -> None:
        """Send an event to the sink; what that raises ends the job."""
        try:
            self._sink(event)
        except OSError as error:
            self._refusal = error
            raise

    def attempt(self, work: Callable[[], Done]) -> Done:
        """Do some work, again where this process meets an error that may pass, see :func:`.tries.persist`."""
        return persist(work, self.send, self._started.output, lambda error: error is self._refusal)

    def aside(self, work: Callable[[], object]) -> None:
        """Let the thread do some work."""
        self._asides.append((work, self._thread.submit(work)))

    def finish_aside(self) -> None:
        """Wait for the thread; do here what met an error there that may pass, raise other errors."""
        for work, future in self._asides:
            tries = chain([future.result], repeat(work))
            self.attempt(partial(_do_next, tries))
        self._asides.clear()

    def __enter__(self) -> Session:
        self.send(self._started)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._thread.shutdown(cancel_futures=True)
        self.workers.close()
        if kind is not None:
            self.state = RunState.INTERRUPTED if kind is KeyboardInterrupt else RunState.FAILED
            self.message = ""
        self.send(RunDone(self.state, perf_counter() - self._began, self.message))
        if isinstance(error, OSError) and error.errno and not isinstance(error, ConnectionError | TimeoutError):
            raise StoreError(
                "a file could not be read or written",
                error.filename or f"{self._started.output}, made from {self._started.source}",
                got=os.strerror(error.errno),
                remedy="Check the disk, then run the same command again: what is done is kept",
            ) from error

    def _on_connect(self, client: Client) -> None:
        if self._plan:
            dataclasses.replace(self._plan, memory_limit=memory_budget(client)).check()
        self.send(dataclasses.replace(self._started, dashboard=client.dashboard_link or ""))
        if not self._is_given and (warning := open_to_others(client.scheduler.address)):
            self.send(Warned(warning))
        self.aside(_get_ready)


def _do_next(works: Iterator[Callable[[], object]]) -> object:
    return next(works)()


class Record:
    """A sink that keeps how long every stage took, and which were done before."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.reused: tuple[str, ...] = ()

    def __call__(self, event: Event) -> None:
        """Take an event."""
        if isinstance(event, StageDone):
            if event.reused:
                self.reused += (event.stage,)
            else:
                self.seconds[event.stage] = event.seconds


def _get_ready() -> None:
    """Import what the later stages need here, and make the compiler ready to load kernels."""
    from .. import report  # noqa: F401
    from ..kernels.registration import load_kernels
    from ..plots.columns import plot_columns  # noqa: F401
    from ..stages.columns import find  # noqa: F401

    load_kernels()


def draw_columns(summed: xr.Dataset, columns: xr.Dataset, figure: Path) -> None:
    """Draw the columns beside the place of their figure, then put them there, so that a figure is always whole."""
    from ..plots.columns import plot_columns  # matplotlib takes its time, and not every run draws

    partial_figure = disk.aside(figure, uuid.uuid4().hex, figure.suffix)
    check_held(figure)
    plot_columns(summed, columns, partial_figure)
    check_held(figure)
    partial_figure.replace(figure)
