"""What a run tells the world: small event objects, and sinks that take them.

A sink is any callable that takes one event. A run knows nothing of terminals, files or web pages; it calls its sink.
"""

from __future__ import annotations

import dataclasses
import errno
import json
import os
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from time import monotonic
from typing import Any, Self, TypeAlias

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
class Noticed:
    """A warning about the tracks of a finished run, see :mod:`tract_dask.report.findings`."""

    name: str
    title: str
    text: str
    remedy: str = ""


class RunState(StrEnum):
    """How a run ended."""

    PLANNED = "planned"
    STOPPED = "stopped"
    """After the stage that was asked for."""
    DONE = "done"
    DONE_WITH_BAD_FRAMES = "done_with_bad_frames"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


@dataclass(frozen=True)
class RunDone:
    """The run ended; ``state`` is a :class:`RunState`, or that of a job."""

    state: str
    seconds: float
    message: str = ""


Event: TypeAlias = RunStarted | StageStarted | ShardDone | StageDone | Warned | Noticed | RunDone

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
    is_held
        Tells whether the file's folder is still the one that it was; nothing is written where it is not.
    """

    def __init__(self, path: Path, warn: Sink = silent, is_held: Callable[[Path], bool] = lambda path: True) -> None:
        self.path, self._warn, self._is_held = path, warn, is_held
        self._is_whole, self._warned = False, False

    def __call__(self, event: Event) -> None:
        """Append one line in one call; a line before it that a killed run or a full disk has torn is ended first."""
        try:
            if not self._is_held(self.path):
                return
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


WINDOW_S = 10.0
"""Recent rates are of so many seconds."""


@dataclass
class StageMeter:
    """What is known of a running stage from its events.

    Attributes
    ----------
    frames, done, done_before
        As the stage counts them: every frame as often as it goes over the movie (``passes``).
    began
        Monotonic time in s.
    seconds
        How long it took; None while it runs.
    """

    stage: str
    frames: int = 0
    done_before: int = 0
    frame_bytes: int = 0
    columns: int = 0
    passes: int = 1
    done: int = 0
    fits: int = 0
    began: float = field(default_factory=monotonic)
    seconds: float | None = None
    reused: bool = False
    summary: str = ""
    _recent: deque[tuple[float, int, int]] = field(default_factory=deque)

    @classmethod
    def start(cls, event: StageStarted) -> Self:
        """Return the meter of a stage that starts."""
        return cls(
            event.stage,
            event.frames,
            event.done_frames,
            event.frame_bytes,
            event.columns,
            event.passes,
            event.done_frames,
        )

    def add(self, event: ShardDone) -> None:
        """Count a shard."""
        self.done += event.frames
        self.fits += event.fits
        now = monotonic()
        self._recent.append((now, event.frames, event.fits))
        while now - self._recent[0][0] > WINDOW_S:
            self._recent.popleft()

    def finish(self, event: StageDone) -> None:
        """Note the end."""
        self.seconds, self.reused, self.summary = event.seconds, event.reused, event.summary

    @property
    def elapsed(self) -> float:
        """Seconds since the stage began, or that it took."""
        return self.seconds if self.seconds is not None else monotonic() - self.began

    @property
    def movie_frames(self) -> int:
        """Frames of the movie."""
        return self.frames // self.passes

    @property
    def done_frames(self) -> int:
        """Frames of the movie that would be done, had they gone through all passes one by one."""
        return self.done // self.passes

    @property
    def rates(self) -> tuple[float, float]:
        """Frames and fits a second since the stage began."""
        elapsed = self.elapsed
        frames = (self.done - self.done_before) / self.passes
        return (frames / elapsed, self.fits / elapsed) if elapsed else (0.0, 0.0)

    @property
    def recent_rates(self) -> tuple[float, float]:
        """Frames and fits a second in the last :data:`WINDOW_S`; since the stage began where that is shorter."""
        since = min(monotonic() - self.began, WINDOW_S)
        if self.seconds is not None or since <= 0:
            return self.rates
        recent = [shard for shard in self._recent if monotonic() - shard[0] <= WINDOW_S]
        return sum(shard[1] for shard in recent) / self.passes / since, sum(shard[2] for shard in recent) / since

    @property
    def seconds_left(self) -> float | None:
        """Seconds that the rest will take at the rate so far; None before the first shard."""
        frames = self.done - self.done_before
        return (self.frames - self.done) * self.elapsed / frames if frames else None


def short(number: float) -> str:
    """Return a number in three figures.

    Examples
    --------
    >>> [short(number) for number in (0.1234, 12.34, 4810.0, 1.5e6)]
    ['0.123', '12.3', '4.81k', '1.5M']
    """
    for scale, suffix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= scale:
            return f"{number / scale:.3g}{suffix}"
    return f"{number:.3g}"


def size(count: float) -> str:
    """Return a number of bytes in three figures.

    Examples
    --------
    >>> [size(count) for count in (512, 2.1e9)]
    ['512 B', '2.1 GB']
    """
    text = short(count)
    return f"{text[:-1]} {text[-1]}B" if text[-1].isalpha() else f"{text} B"


def clock(seconds: float) -> str:
    """Return a time as a person writes it.

    Examples
    --------
    >>> [clock(seconds) for seconds in (0.42, 48, 75, 7325)]
    ['0.4 s', '48 s', '1:15', '2:02:05']
    """
    if seconds < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
