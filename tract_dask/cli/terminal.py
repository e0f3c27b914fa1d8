"""A run's progress on the terminal: a line a stage, redrawn in place; plain lines where the output is no terminal."""

from __future__ import annotations

import sys
from time import monotonic
from types import TracebackType
from typing import IO, cast

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from ..progress import (
    Event,
    Noticed,
    RunDone,
    RunStarted,
    RunState,
    ShardDone,
    StageDone,
    StageMeter,
    StageStarted,
    Warned,
    clock,
    short,
    size,
)
from .streams import Lasting

_PLAIN_INTERVAL_S = 10.0

_ENDS: dict[str, str] = {
    RunState.DONE: "done",
    RunState.DONE_WITH_BAD_FRAMES: "done, with frames that could not be fitted",
    RunState.STOPPED: "stopped as asked: the same command without --until goes on from there",
}


class Line(StageMeter):
    """What the terminal says of one stage."""

    @property
    def count(self) -> str:
        """How many frames are done, of how many."""
        return f"{self.done_frames}/{self.movie_frames} frames" if self.frames else ""

    @property
    def speed(self) -> str:
        """Frames, and fits or megabytes, a second; empty before the first shard."""
        frames, fits = self.rates
        if not frames:
            return ""
        parts = [f"{short(frames)} frames/s"]
        if fits:
            parts.append(f"{short(fits)} fits/s")
        elif self.frame_bytes:
            parts.append(f"{size(frames * self.frame_bytes)}/s")
        return "  ".join(parts)

    @property
    def remaining(self) -> str:
        """The time left, or the time taken."""
        if self.seconds is not None:
            return "as before" if self.reused else clock(self.seconds)
        left = self.seconds_left
        return "" if left is None else f"{clock(left)} left"


class Terminal:
    """A sink that shows a run on the terminal; use it as a context manager.

    Parameters
    ----------
    console
        Where to write; standard error by default.
    """

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(file=cast("IO[str]", Lasting(sys.stderr)), highlight=False)
        self.lines: dict[str, Line] = {}
        self._printed, self._headed = monotonic(), False
        self._noticed: list[Noticed] = []
        live = self.console.is_terminal and not self.console.is_dumb_terminal
        self._live = Live(get_renderable=self.table, console=self.console, refresh_per_second=4) if live else None

    def __enter__(self) -> Terminal:
        if self._live:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live:
            self._live.stop()

    def __call__(self, event: Event) -> None:
        """Take an event and show it."""
        match event:
            case RunStarted():
                if not self._headed:
                    self._say(f"{event.source} → {event.output}", "bold")
                self._headed = True
                if event.dashboard:
                    self._say(f"dashboard {event.dashboard}", "dim")
            case StageStarted():
                self.lines[event.stage] = line = Line.start(event)
                self._plain(self._started(line))
            case ShardDone():
                line = self.lines.setdefault(event.stage, Line(event.stage))
                line.add(event)
                if monotonic() - self._printed > _PLAIN_INTERVAL_S:
                    parts = (line.count, line.speed, line.remaining)
                    self._plain(f"{line.stage}: " + ", ".join(filter(None, parts)))
            case StageDone():
                line = self.lines.setdefault(event.stage, Line(event.stage))
                line.finish(event)
                took = "done before" if event.reused else f"done in {clock(event.seconds)}"
                self._plain(f"{line.stage}: " + ", ".join(filter(None, (took, line.speed, line.summary))))
            case Warned():
                self._say(f"warning: {event.message}", "yellow")
            case Noticed():
                self._noticed.append(event)
            case RunDone():
                self._end(event)

    def table(self) -> Table:
        """Return the lines as they stand now."""
        grid = Table.grid(padding=(0, 2), expand=True)
        for column in range(5):
            grid.add_column(justify="right" if column > 2 else "left", no_wrap=True)
        grid.add_column(no_wrap=True, ratio=1)  # of a narrow terminal, only the notes are cut
        width = 24 if self.console.width >= 110 else 10
        for line in self.lines.values():
            finished = line.seconds is not None
            dim = "dim" if line.reused else ""
            total = max(line.frames, 1)
            share = total if finished else line.done
            bar = ProgressBar(total=total, completed=share, width=width, complete_style="cyan", finished_style="green")
            note = "  ".join(filter(None, (line.speed, line.summary)))
            grid.add_row(
                Text("✓" if finished else "·", style="green" if finished else "cyan"),
                Text(line.stage, style=dim or "bold"),
                "" if line.reused else bar,
                Text(line.count, style=dim),
                Text(line.remaining, style=dim),
                Text(note, style=dim),
            )
        return grid

    def _started(self, line: Line) -> str:
        parts = [
            f"{line.movie_frames} frames" if line.frames else "",
            f"{line.columns} columns" if line.columns else "",
            f"{line.done_before // line.passes} frames done before" if line.done_before else "",
        ]
        return f"{line.stage}: " + (", ".join(filter(None, parts)) or "started")

    def _end(self, event: RunDone) -> None:
        if self._live:
            self._live.refresh()
            self._live.stop()
        for finding in self._noticed:
            self._say(f"! {finding.title}. {finding.text}", "yellow")
            if finding.remedy:
                self._say(f"  → {finding.remedy}", "yellow")
        self._noticed.clear()
        message = event.message or _ENDS.get(event.state, event.state)
        styles: dict[str, str] = {RunState.DONE: "green", RunState.FAILED: "red"}
        self._say(f"{message} ({clock(event.seconds)})", styles.get(event.state, "yellow"))

    def _plain(self, text: str) -> None:
        if self._live is None:
            self._say(text)
            self._printed = monotonic()

    def _say(self, text: str, style: str = "") -> None:
        self.console.print(Text(text, style=style), soft_wrap=True)
