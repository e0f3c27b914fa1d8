"""How far a stage is, how fast, and how long it will take: what a terminal and a web page show alike."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from time import monotonic
from typing import Self

from .progress import ShardDone, StageDone, StageStarted

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
