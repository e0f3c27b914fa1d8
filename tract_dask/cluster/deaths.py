"""How workers died: their nannies note it on the scheduler, and whoever lost work there asks.

A nanny notes the deaths of its worker where it has loaded this module (``--preload-nanny
tract_dask.cluster.deaths``), as those of clusters that are started here do, or once a client has registered
:class:`NoteDeaths`.
"""

from __future__ import annotations

import asyncio
import signal
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from distributed import Client, Status
from distributed.diagnostics.plugin import NannyPlugin

from .child_processes import how_ended

MODULE = __name__
"""What nannies load."""

_TOPIC, _MEMORY_TOPIC = "tract_dask-deaths", "worker-restart-memory"
_ANSWER_S = 2.0

CRASHES = frozenset({signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGILL})
"""Signals of which a process dies by a fault of its own code, and not because somebody ends it."""

MOST_CRASHES, MOST_UNKNOWN = 2, 3
"""So many workers have to die on a shard that each has alone, by a crash or for unknown reasons, to blame its data."""


@dataclass(frozen=True)
class Death:
    """How a worker died: its exit code, negative for a signal; None where nobody knows."""

    worker: str
    code: int | None = None
    out_of_memory: bool = False

    @property
    def is_crash(self) -> bool:
        """Whether it died of what it was doing: a fault in a compiled library."""
        return self.code is not None and -self.code in CRASHES and not self.out_of_memory

    @property
    def is_of_node(self) -> bool:
        """Whether its machine, or somebody, has ended it, whatever it was doing."""
        return self.code is not None and not self.is_crash and not self.out_of_memory

    def __str__(self) -> str:
        if self.out_of_memory:
            return "it took more memory than its limit, and was ended"
        return "the cause is unknown" if self.code is None else how_ended(self.code)


class NoteDeaths(NannyPlugin):
    """Lets the nannies of a running cluster note how their workers die."""

    name = _TOPIC

    def setup(self, nanny: Any) -> None:
        """Begin to note."""
        dask_setup(nanny)


def dask_setup(nanny: Any) -> None:
    """Let a nanny note how its worker dies (the name is what Dask calls in a module that is loaded first)."""
    if hasattr(nanny, "_tract_dask_notes"):
        return
    nanny._tract_dask_notes = True
    go_on = nanny._on_worker_exit

    async def note(code: int) -> None:
        if nanny.status == Status.running:
            record = {"worker": nanny.worker_address, "code": code}
            with suppress(Exception):  # to restart the worker is more important
                await asyncio.wait_for(nanny.scheduler.log_event(topic=_TOPIC, msg=record), _ANSWER_S)
        await go_on(code)

    nanny._on_worker_exit = note


def death(client: Client, worker: str) -> Death:
    """Return how a worker died, as far as its nanny has said; let nannies note it from now on."""
    with suppress(OSError):
        known = {event["worker"]: event["code"] for _, event in client.get_events(_TOPIC)}
        swollen = {event["worker"] for _, event in client.get_events(_MEMORY_TOPIC)}
        if not known:
            client.register_plugin(NoteDeaths())
        return Death(worker, known.get(worker, -signal.SIGKILL if worker in swollen else None), worker in swollen)
    return Death(worker)


def is_to_blame(deaths: list[Death], *, others_finished: bool) -> bool:
    """Tell whether the workers that died on a shard, which each had alone, show that its data are the reason.

    Examples
    --------
    >>> crash = Death("tcp://a:1", -11)
    >>> is_to_blame([crash], others_finished=True), is_to_blame([crash, crash], others_finished=True)
    (False, True)
    >>> is_to_blame([Death("tcp://a:1"), Death("tcp://b:1"), Death("tcp://a:1")], others_finished=True)
    False
    """
    if sum(met.is_crash for met in deaths) >= MOST_CRASHES:
        return True
    unknown = {met.worker for met in deaths if met.code is None}
    return others_finished and len(unknown) >= MOST_UNKNOWN
