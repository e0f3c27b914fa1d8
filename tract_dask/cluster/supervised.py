"""A child process that is started again whenever it ends, until it is told to stop."""

from __future__ import annotations

import logging
import subprocess
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from threading import Event, Lock, Thread
from time import monotonic
from typing import IO

_log = logging.getLogger(__name__)

_SHORTEST_S, _LONGEST_S = 1.0, 60.0
_STEADY_S = 60.0
"""A process that lived for so long had started well: the wait before the next one is short again."""

_WORDS = 80


class Supervised:
    """Runs a command in a process group of its own, and again with growing waits whenever it ends.

    Its standard input stays open until :meth:`stop`, and until this process has gone.

    Parameters
    ----------
    name
        Of what runs, for the log.
    command
        Program and arguments.
    order
        Written to the standard input of each process first.
    on_ended
        Called before each start and after each end.
    """

    def __init__(
        self, name: str, command: Sequence[str], order: str = "", on_ended: Callable[[], object] = lambda: None
    ) -> None:
        self.problem = ""
        self._name, self._command, self._order, self._on_ended = name, list(command), order, on_ended
        self._stopping, self._lock = Event(), Lock()
        self._process: subprocess.Popen[str] | None = None
        self._thread = Thread(target=self._run, name=f"supervised-{name}", daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int | None:
        """Number of the process that runs; None while there is none."""
        with self._lock:
            running = self._process is not None and self._process.poll() is None
            return self._process.pid if running and self._process else None

    def let_end(self) -> None:
        """Start no other process once this one has ended."""
        self._stopping.set()

    def stop(self, grace_s: float) -> None:
        """Close the standard input, wait for the end, and kill what has not ended after ``grace_s``."""
        self._stopping.set()
        with self._lock:
            process = self._process
        if process is not None:
            with suppress(OSError):
                _stream(process.stdin).close()
            try:
                process.wait(grace_s)
            except subprocess.TimeoutExpired:
                process.kill()
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
        with self._lock:
            if self._stopping.is_set():
                return
            self._process = process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                start_new_session=True,  # Ctrl-C is for the parent, which then stops this process in good order
            )
        said: deque[str] = deque(maxlen=_WORDS)
        listener = Thread(target=self._listen, args=(_stream(process.stderr), said), daemon=True)
        listener.start()
        with suppress(OSError):  # it has ended already: its last words say why
            _stream(process.stdin).write(self._order)
            _stream(process.stdin).flush()
        process.wait()
        listener.join(1.0)  # a child of it that lives on may keep the pipe open
        self.problem = " ".join(said) or f"exit code {process.returncode}"

    def _listen(self, stream: IO[str], said: deque[str]) -> None:
        """Pass on what the process says, and keep its last words."""
        with stream:
            for line in stream:
                said.extend(line.split())
                _log.info("%s: %s", self._name, line.rstrip())


def _stream(stream: IO[str] | None) -> IO[str]:
    assert stream is not None, "a pipe was asked for"
    return stream
