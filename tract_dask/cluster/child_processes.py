"""Child processes, each in a group of its own: it ends when its standard input does, and with all that it started.

So none outlives this process, however this one ends. A child calls :func:`listen` for that; ``ssh`` and what it starts
far away need no such call.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from queue import Empty, Queue
from threading import Event, Lock, Thread
from time import monotonic
from typing import IO, cast

_log = logging.getLogger(__name__)

_SHORTEST_S, _LONGEST_S = 1.0, 60.0
_STEADY_S = 60.0
"""A process that lived for so long had started well: the wait before the next one is short again."""

_WORDS = 80


class Child:
    """A process in a group of its own; lines go to its standard input, which stays open until it is to end.

    Parameters
    ----------
    command
        Program and arguments.
    on_error
        Called with each line of its standard error, in another thread.
    talks
        Whether its standard output is wanted, by :meth:`lines`.
    """

    def __init__(self, command: Sequence[str], on_error: Callable[[str], object], *, talks: bool = False) -> None:
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE if talks else subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            start_new_session=True,  # to be killed with all that it started; Ctrl-C is for its parent to answer
        )
        self._stdin = cast("IO[str]", self._process.stdin)
        self._errors = Thread(target=_read, args=(self._process.stderr, on_error), daemon=True)
        self._errors.start()

    def is_alive(self) -> bool:
        """Tell whether it runs."""
        return self._process.poll() is None

    def tell(self, line: str) -> None:
        """Write a line to its standard input; nothing happens where it has ended already."""
        with suppress(OSError, ValueError):
            self._stdin.write(f"{line}\n")
            self._stdin.flush()

    def lines(self, tick_s: float) -> Iterator[str]:
        """Yield what it says until it says no more, and "" whenever it says nothing for ``tick_s``."""
        lines = Queue[str | None]()
        Thread(target=_read, args=(self._process.stdout, lines.put, lines.put), daemon=True).start()
        while True:
            try:
                line = lines.get(timeout=tick_s)
            except Empty:  # what it started may live on and hold the pipe open
                line = "" if self.is_alive() else None
            if line is None:
                return
            yield line

    def close(self) -> None:
        """Close its standard input, at which it ends."""
        with suppress(OSError):  # what it has not read is still to be written
            self._stdin.close()

    def end(self, grace_s: float | None = 0.0) -> int:
        """Kill it and all that it started, itself after ``grace_s`` (None: wait for its end); return its exit code."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(grace_s)
        with suppress(OSError):  # nothing of it is there any more
            os.killpg(self._process.pid, signal.SIGKILL)
        self.close()
        self._errors.join(1.0)
        return self._process.wait()


def _read(stream: IO[str], take: Callable[[str], object], end: Callable[[None], object] = bool) -> None:
    with stream:
        for line in stream:
            take(line.rstrip())
    end(None)


class Supervised:
    """Runs a command as a :class:`Child`, and again with growing waits whenever it ends.

    Parameters
    ----------
    name
        Of what runs, for the log.
    command
        Program and arguments.
    order
        A line for the standard input of each process.
    on_ended
        Called before each start and after each end.

    Attributes
    ----------
    problem
        Why the last process ended: its last words, or else its exit code.
    """

    def __init__(
        self, name: str, command: Sequence[str], order: str = "", on_ended: Callable[[], object] = lambda: None
    ) -> None:
        self.problem = ""
        self._name, self._command, self._order, self._on_ended = name, command, order, on_ended
        self._stopping, self._lock = Event(), Lock()
        self._child: Child | None = None
        self._thread = Thread(target=self._run, name=f"supervised-{name}", daemon=True)
        self._thread.start()

    def is_alive(self) -> bool:
        """Tell whether the process runs."""
        child = self._child
        return child is not None and child.is_alive()

    def let_end(self) -> None:
        """Start no other process once this one has ended."""
        self._stopping.set()

    def stop(self, grace_s: float) -> None:
        """Close the standard input, wait for the end, and kill what has not ended after ``grace_s``."""
        self._stopping.set()
        with self._lock:
            child = self._child
        if child is not None:
            child.close()
            child.end(grace_s)
        self._thread.join()

    def _run(self) -> None:
        wait_s = _SHORTEST_S
        while not self._stopping.is_set():
            began = monotonic()
            self._on_ended()
            self._run_once()
            self._on_ended()
            if self._stopping.is_set():
                return
            if monotonic() - began > _STEADY_S:
                wait_s = _SHORTEST_S
            _log.warning("%s has ended (%s); it starts again in %g s", self._name, self.problem, wait_s)
            self._stopping.wait(wait_s)
            wait_s = min(2 * wait_s, _LONGEST_S)

    def _run_once(self) -> None:
        said: deque[str] = deque(maxlen=_WORDS)

        def hear(line: str) -> None:
            said.extend(line.split())
            _log.info("%s: %s", self._name, line)

        with self._lock:
            if self._stopping.is_set():
                return
            self._child = child = Child(self._command, hear)
        child.tell(self._order)
        code = child.end(None)
        self._child = None
        self.problem = " ".join(said) or how_ended(code)


def how_ended(code: int) -> str:
    """Say how a process ended, from its exit code.

    Examples
    --------
    >>> how_ended(-11), how_ended(1)
    ('SIGSEGV', 'exit code 1')
    """
    if code >= 0:
        return f"exit code {code}"
    hint = ", as the system sends it where memory runs out" if -code == signal.SIGKILL else ""
    return signal.Signals(-code).name + hint


def listen(take: Callable[[str], object], end: Callable[[], object]) -> None:
    """Pass each line of standard input to ``take``, in a thread; call ``end`` after the last: the parent is gone."""

    def read() -> None:
        for line in sys.stdin:
            take(line)
        end()

    Thread(target=read, daemon=True).start()
