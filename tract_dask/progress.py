"""What a run tells the world: small event objects, and sinks that take them.

A sink is any callable that takes one event. A run knows nothing of terminals, files or web pages; it calls its sink.
"""

from __future__ import annotations

import dataclasses
import errno
import json
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias

STAGES = ("convert", "drift", "sum", "columns", "fit")
"""The stages of a run, in their order."""

REPORT = "report"
"""What a run makes after its stages."""

_APPEND = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_NONBLOCK", 0)


@dataclass(frozen=True)
class RunStarted:
    """A run begins (or goes on)."""

    source: str
    output: str
    dashboard: str = ""


@dataclass(frozen=True)
class StageStarted:
    """A stage begins; ``done_frames`` of ``frames`` were finished by an earlier run.

    A stage that goes over the movie several times (``passes``) counts every frame as often.
    """

    stage: str
    frames: int
    done_frames: int = 0
    columns: int = 0
    frame_bytes: int = 0
    passes: int = 1


@dataclass(frozen=True)
class ShardDone:
    """One shard of a stage is computed, written and recorded."""

    stage: str
    shard: int
    frames: int
    fits: int = 0


@dataclass(frozen=True)
class StageDone:
    """A stage is finished; ``reused`` when an earlier run had done all of it."""

    stage: str
    seconds: float
    reused: bool = False
    summary: str = ""


@dataclass(frozen=True)
class Warned:
    """Something the user should know that does not stop the run."""

    message: str


@dataclass(frozen=True)
class RunDone:
    """The run ended; ``state`` is done, done_with_bad_frames, stopped, interrupted or failed."""

    state: str
    seconds: float
    message: str = ""


Event: TypeAlias = RunStarted | StageStarted | ShardDone | StageDone | Warned | RunDone
Sink: TypeAlias = Callable[[Event], None]


def silent(event: Event) -> None:
    """Take an event and do nothing with it."""


def to_record(event: Event) -> dict[str, Any]:
    """Return an event as a flat, JSON-ready mapping with its type and the UTC time.

    Examples
    --------
    >>> record = to_record(ShardDone("fit", 3, 16, 640))
    >>> record["event"], record["shard"]
    ('ShardDone', 3)
    """
    return {
        "event": type(event).__name__,
        "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
        **dataclasses.asdict(event),
    }


class JsonLines:
    """A sink that appends each event to a file as one line of JSON.

    The record is less than the results: where a line cannot be written (a full disk), the run goes on.

    Parameters
    ----------
    path
        The file; made at the first event.
    warn
        Takes a warning, once, where a line could not be written.
    """

    def __init__(self, path: Path, warn: Sink = silent) -> None:
        self.path, self._warn = path, warn
        self._is_whole, self._warned = False, False

    def __call__(self, event: Event) -> None:
        """Append one line in one call; a line before it that a killed run or a full disk has torn is ended first."""
        try:
            self._append(f"{json.dumps(to_record(event))}\n".encode())
        except OSError as error:
            self._is_whole = False
            if not self._warned:
                self._warned = True
                reason = error.strerror or str(error)
                self._warn(Warned(f"the record of this run is incomplete: {self.path} cannot be written: {reason}"))

    def _append(self, line: bytes) -> None:
        descriptor = os.open(self.path, _APPEND, 0o666)
        try:
            if not self._is_whole and not _ends_a_line(self.path):
                line = b"\n" + line
            self._is_whole = False
            if os.write(descriptor, line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._is_whole = True
        finally:
            os.close(descriptor)


def _ends_a_line(path: Path) -> bool:
    """Tell whether what is appended to a file begins a line."""
    with path.open("rb") as file:
        if os.fstat(file.fileno()).st_size == 0:
            return True
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"


def tee(sinks: Iterable[Sink]) -> Sink:
    """Return one sink that passes each event to all of ``sinks``, in order."""
    targets = tuple(sinks)

    def send(event: Event) -> None:
        for target in targets:
            target(event)

    return send
