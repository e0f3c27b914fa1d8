"""What a job's process does with its order: it drives the pipeline, and says what happens, a line of JSON each."""

from __future__ import annotations

import json
import threading
import traceback
from concurrent.futures import CancelledError
from contextlib import closing
from functools import partial
from pathlib import Path
from time import monotonic
from typing import IO, Any

import dask
from distributed import default_client
from distributed.comm import CommClosedError

from ...cluster.dispatch import JOB
from ...cluster.retries import persist
from ...cluster.tls import using
from ...errors import ChangedSourceError, ClusterError, ExitCode, TractError
from ...progress import Event, Noticed, ShardDone, StageDone, StageStarted, Warned, clock, silent
from ...readers.checks import Permit
from ...readers.movie_files import FileList
from ...run import pipeline
from ...run.checks import open_input
from ...settings.run import RunSettings
from ...settings.toml import from_dict
from ...stages.convert.origin import origin_of
from ...store import metadata, run_folder
from ...store.files import remove, write_aside
from ..data_root import DataRoot
from ..outputs import Mark, claim, claimed
from .timeline import Timeline

PROGRESS_S = 0.35
"""Shortest time between two records of progress."""

TICK_S = 1.0
"""Longest time between them, so that rates fall where nothing is done."""

PATIENCE_S = 60.0
"""For so long the folder's lock is waited for: a try that was killed may be about to end."""

OUTCOME = ("state", "frames", "columns", "fits", "accepted", "bad_frames", "seconds", "reused")
"""What a job keeps of a run's outcome."""


class Reporter:
    """A sink that says what happens, in lines of JSON.

    Parameters
    ----------
    stream
        Where to.
    before
        The stages of the job's progress as an earlier try left them.
    """

    def __init__(self, stream: IO[str], before: dict[str, Any]) -> None:
        self._stream, self._timeline = stream, Timeline(before)
        self._lock = threading.Lock()
        self._stage, self._told = "", 0.0
        threading.Thread(target=self._tick, daemon=True).start()

    def __call__(self, event: Event) -> None:
        """Take an event of the run."""
        with self._lock:
            self._timeline(event)
            if self._timeline.stage != self._stage:
                self._stage = self._timeline.stage
                self._write(kind="stage", stage=self._stage)
            match event:
                case StageStarted():
                    frames = f" {event.frames // event.passes} frames" if event.frames else ""
                    self._write(kind="log", level="info", message=f"{event.stage}: started{frames}")
                case StageDone():
                    took = "was done before" if event.reused else f"done in {clock(event.seconds)}"
                    message = f"{event.stage}: {', '.join(filter(None, (took, event.summary)))}"
                    self._write(kind="log", level="info", message=message)
                case Warned():
                    self._write(kind="log", level="warning", message=event.message)
                case Noticed():
                    message = f"{event.title}. {event.text} {event.remedy}".strip()
                    self._write(kind="log", level="warning", message=message)
            if not isinstance(event, ShardDone) or monotonic() - self._told >= PROGRESS_S:
                self._tell_progress()

    def end(self, **record: Any) -> None:
        """Say how the work ended."""
        with self._lock:
            self._tell_progress()
            self._write(**record)

    def _tick(self) -> None:
        while True:
            threading.Event().wait(TICK_S / 2)
            with self._lock:
                if self._stage and monotonic() - self._told >= TICK_S:
                    self._tell_progress()

    def _tell_progress(self) -> None:
        self._told = monotonic()
        self._write(kind="progress", shards=self._timeline.shards, data=self._timeline.to_record())

    def _write(self, **record: Any) -> None:
        self._stream.write(json.dumps(metadata.json_ready(record)) + "\n")
        self._stream.flush()


def run_order(order: dict[str, Any], on_event: Reporter) -> pipeline.RunOutcome:
    """Do what the order says: a run, or its part up to the stage ``until``; with its ``columns``, if it has some.

    Raises
    ------
    TractError
        As :func:`tract_dask.service.outputs.claim` and :func:`tract_dask.run.pipeline.run`.
    """
    dask.config.set({JOB: order["job"]})
    settings = from_dict(RunSettings, {**order["settings"], "cluster": order["cluster"]})
    root, mark = DataRoot(Path(order["root"]), tuple(map(Path, order["closed"]))), Mark(**order["mark"])
    persist(partial(claim, root, mark, PATIENCE_S), on_event, order["output"])
    with claimed(root, mark):
        return _run_in(run_folder.RunFolder(Path(order["output"])), order, root, settings, on_event)


def _run_in(
    outputs: run_folder.RunFolder, order: dict[str, Any], root: DataRoot, settings: RunSettings, on_event: Reporter
) -> pipeline.RunOutcome:
    """Do what the order says, in the folder that its job has."""
    columns, source = order["columns"], _source(order)
    persist(partial(check_content, source, settings, outputs, order["content"], root.permit), on_event, str(source))
    run = partial(pipeline.run, source, outputs.root, settings, patience_s=PATIENCE_S, permit=root.permit)
    if columns is not None:  # an edited table is one that differs from that of a finished stage
        sink = silent if outputs.columns.exists() else on_event
        run(on_event=sink, until="columns")
        persist(partial(place_columns, outputs, columns), on_event, order["output"])
    return run(on_event=on_event, until=order["until"])


def _source(order: dict[str, Any]) -> str | FileList:
    """Return the movie of an order: a path, or a list of files."""
    files = order["files"]
    return str(order["source"]) if files is None else FileList(order["source"], tuple(map(Path, files)))


def check_content(
    source: str | FileList, settings: RunSettings, outputs: run_folder.RunFolder, content: str, permit: Permit
) -> None:
    """Check that a movie still holds what it held when its job was submitted: it was looked at then, and planned.

    Raises
    ------
    ChangedSourceError
        Where it does not.
    """
    if not content:  # of a job of an earlier version
        return
    with closing(open_input(source, settings, outputs.movie, permit)) as opened:
        if origin_of(opened).content != content:
            raise ChangedSourceError(
                "the movie has changed since the job was submitted",
                str(source),
                "what it held then",
                "something else: it was replaced, or written again",
                "Look at it, and submit a new job if it is the right one",
            )


def place_columns(outputs: run_folder.RunFolder, table: str) -> None:
    """Put a table of columns into a run's folder as if edited by hand; empty: let columns be found automatically."""
    with run_folder.sole_run(outputs, PATIENCE_S):
        if table:
            write_aside(outputs.columns, table.encode())
        elif metadata.attributes(outputs.columns.with_suffix(".zarr")).get("edited"):
            remove(outputs.columns)


def is_lost(error: BaseException) -> bool:
    """Tell whether an error means that the cluster or the way to it is gone, so that another try may go well."""
    if isinstance(error, ClusterError | CommClosedError | CancelledError | ConnectionError | TimeoutError):
        return True
    if isinstance(error, TractError):
        return False
    try:
        return bool(default_client().status != "running")
    except ValueError:  # there is no client
        return False


def carry_out(order: dict[str, Any], stream: IO[str]) -> int:
    """Do what an order says, and say to ``stream`` how it went and ended; return the exit code of the process."""
    reporter = Reporter(stream, order["stages"])
    try:
        with using(order["credentials"]):
            outcome = run_order(order, reporter).to_record()
    except KeyboardInterrupt:
        reporter.end(kind="interrupted")
        return ExitCode.INTERRUPTED
    except TractError as error:
        reporter.end(kind="error", lost=is_lost(error), text=str(error))
        return ExitCode.FAILED
    except BaseException as error:  # noqa: BLE001  whatever it is, the job has to say so
        traceback.print_exc()
        text = f"unexpected {type(error).__name__}: {str(error).rstrip('.')}"
        reporter.end(kind="error", lost=is_lost(error), text=text)
        return ExitCode.FAILED
    reporter.end(kind="outcome", **{name: outcome[name] for name in OUTCOME})
    return ExitCode.DONE
