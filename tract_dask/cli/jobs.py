"""The commands for a service somewhere else: submit, jobs, watch, cancel."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import click

from ..errors import ExitCode, InputError
from ..progress import Event, RunDone, RunStarted, ShardDone, StageDone, StageStarted, Warned
from ..service.jobs.states import State
from ..settings.run import RunSettings
from .options import Command, setting_options
from .show import PATH, common_options, show

if TYPE_CHECKING:
    from ..service.client import ServiceClient, ServiceEvent, ServiceJob

F = TypeVar("F", bound=Callable[..., Any])

TOKEN_VARIABLE = "TRACT_DASK_TOKEN"

_CODES = dict.fromkeys((State.FAILED, State.CANCELLED), ExitCode.FAILED)
_CODES[State.DONE_WITH_FAILED_FRAMES] = ExitCode.BAD_FRAMES
"""Exit codes of the jobs that one watches to their end, as those of a run."""

_FILE_WIDTH = 250
_COLOURS = {State.RUNNING: "cyan", State.DONE: "green", State.FAILED: "red", State.CANCELLED: "dim"}
_COLOURS |= dict.fromkeys((State.WAITING, State.DONE_WITH_FAILED_FRAMES), "yellow")


def service_options(function: F) -> F:
    """Give a command the options that name a service; it receives its client as ``service``."""

    @functools.wraps(function)
    def command(*args: Any, server: str, token_file: Path | None, ca: Path | None, **rest: Any) -> Any:
        from ..service.client import ServiceClient

        token = _read_token(token_file) if token_file else os.environ.get(TOKEN_VARIABLE)
        with ServiceClient(server, token, ca) as service:
            return function(*args, service=service, **rest)

    decorated: Any = command
    for option in (
        click.option("--ca", type=PATH, envvar="TRACT_DASK_CA", help="Certificate of the service's authority, ca.pem."),
        click.option("--token-file", type=PATH, help=f"File with the token; otherwise {TOKEN_VARIABLE} is used."),
        click.option(
            "--server",
            default="http://127.0.0.1:8000",
            envvar="TRACT_DASK_SERVER",
            metavar="URL",
            help="Address of the service; also TRACT_DASK_SERVER. [http://127.0.0.1:8000].",
        ),
    ):
        decorated = option(decorated)
    return cast("F", decorated)


@click.command(cls=Command)
@click.argument("source")
@click.option("--output", default="", metavar="FOLDER", help="Folder under the data root; otherwise a new one.")
@click.option("--label", default="", metavar="TEXT", help="Text by which to find the job.")
@click.option("--curate", is_flag=True, help="Stop after the summed image, for columns to be edited by hand.")
@click.option("--watch", "watching", is_flag=True, help="Show its progress until it ends.")
@service_options
@common_options
@setting_options("source", "metadata", "convert", "drift", "columns", "fit")
def submit(
    source: str, settings: RunSettings, service: ServiceClient, *, watching: bool, as_json: bool, **options: Any
) -> None:
    """Queue a job for the movie SOURCE at a service.

    SOURCE, and the files that options name, are paths under the service's data root.
    """
    job = service.submit(source, settings, **options)
    if watching:
        click.echo(f"job {job.id}", err=True)
        _watch(service, job.id, as_json=as_json)
    else:
        _show_job(job, service, as_json=as_json)


@click.command()
@click.option(
    "--state", "states", multiple=True, type=click.Choice([*map(str, State)]), help="Only in this state; repeatable."
)
@click.option("--owner", default="", metavar="NAME", help="Only jobs of this owner.")
@click.option("--text", default="", metavar="TEXT", help="Only jobs with this text in label, source, owner or id.")
@click.option("--limit", default=20, show_default=True, type=click.IntRange(1), help="Most jobs, the newest first.")
@service_options
@common_options
def jobs(service: ServiceClient, *, as_json: bool, **filters: Any) -> None:
    """List the jobs of a service."""
    found = service.jobs(**filters)
    if as_json:
        click.echo(json.dumps([asdict(job) for job in found]))
    else:
        _print_table(found)


@click.command()
@click.argument("job")
@service_options
@common_options
def watch(job: str, service: ServiceClient, *, as_json: bool) -> None:
    """Show the progress of JOB until it ends, or waits for columns.

    JOB is its id, or the id's first digits.
    """
    _watch(service, service.find(job).id, as_json=as_json)


@click.command()
@click.argument("job")
@service_options
@common_options
def cancel(job: str, service: ServiceClient, *, as_json: bool) -> None:
    """Cancel JOB; what is done is kept, and can be continued."""
    _show_job(service.cancel(service.find(job).id), service, as_json=as_json)


class Translation:
    """What the service says of a job, as the events of a run: so it is shown as a run is."""

    def __init__(self) -> None:
        self._state = ""
        self._stages: dict[str, dict[str, Any]] = {}
        self._fits = 0

    def __call__(self, event: ServiceEvent) -> Iterator[Event]:
        """Yield the events of a run that one of the service stands for."""
        if event.kind == "progress":
            yield from self._progressed(event.data)
        elif event.kind == "log" and event.data.get("level") in ("warning", "error"):
            yield Warned(str(event.data["message"]))
        elif event.job is not None:
            yield from self._changed(event.job)

    def _changed(self, job: ServiceJob) -> Iterator[Event]:
        if not self._state:
            yield RunStarted(job.source, job.output)
        yield from self._progressed(job.progress)
        if job.is_at_rest:
            yield RunDone(str(job.state), _seconds(job), _farewell(job))
        elif self._state not in ("", job.state) and job.reason:
            yield Warned(f"{job.state}: {job.reason}")
        self._state = str(job.state)

    def _progressed(self, progress: dict[str, Any]) -> Iterator[Event]:
        for stage, now in progress.get("stages", {}).items():
            before = self._stages.get(stage, {"state": "pending", "done_frames": 0})
            if now["state"] == "pending" or now == before:
                continue
            done_before = 0 if now["state"] == "done" else now["done_frames"]
            if before["state"] == "pending":
                yield StageStarted(stage, now["frames"], done_before)
                before, self._fits = {"state": "running", "done_frames": done_before}, 0
            if (frames := now["done_frames"] - before["done_frames"]) > 0:
                fits = progress["fits"] if stage == progress["stage"] else self._fits
                yield ShardDone(stage, 0, frames, max(fits - self._fits, 0))
                self._fits = fits
            if now["state"] in ("done", "reused") and before["state"] == "running":
                yield StageDone(stage, now["seconds"] or 0.0, now["state"] == "reused", now["summary"])
            self._stages[stage] = now


def _watch(service: ServiceClient, job_id: str, *, as_json: bool) -> None:
    """Show a job until it is at rest, and end with the exit code for what became of it."""
    from .terminal import Terminal

    job, translated = None, Translation()
    try:
        with Terminal() as terminal:
            for event in service.watch(job_id):
                job = event.job or job
                for shown in translated(event):
                    terminal(shown)
    except KeyboardInterrupt:
        click.echo(f"The job goes on. Watch it again with: tract-dask watch {job_id}", err=True)
        click.get_current_context().exit(ExitCode.INTERRUPTED)
    if job is None or not job.is_at_rest:
        raise InputError("the job was deleted", job_id)
    _show_job(job, service, as_json=as_json)
    click.get_current_context().exit(_CODES.get(job.state, 0))


def _show_job(job: ServiceJob, service: ServiceClient, *, as_json: bool) -> None:
    """Print a job, and where its page is."""
    rows: dict[str, Any] = {"job": job.id, "state": job.state + (f" ({job.reason})" if job.reason else "")}
    rows |= {"label": job.label} if job.label else {}
    for name in ("columns", "frames", "fits", "accepted"):
        if job.outcome.get(name) is not None:
            rows[name] = f"{job.outcome[name]:,}"
    page = f"{service.url}/jobs/{job.id}"
    rows |= {"output": job.output, "page": f"{page}/columns" if job.state == State.WAITING else page}
    show(asdict(job) if as_json else rows, as_json=as_json)


def _print_table(found: list[ServiceJob]) -> None:
    """Print jobs as a table."""
    from rich.console import Console
    from rich.progress_bar import ProgressBar
    from rich.table import Table
    from rich.text import Text

    from ..progress import clock, short

    console, table = Console(highlight=False), Table(box=None, pad_edge=False, header_style="bold")
    if not console.is_terminal:
        console.width = _FILE_WIDTH
    widths = {"job": 10, "state": 8, "done": 10, "": 4}  # on a narrow terminal, the others are cut
    for name in ("job", "state", "stage", "done", "", "frames/s", "left", "owner", "label", "movie"):
        right = name in ("", "frames/s", "left")
        table.add_column(name, justify="right" if right else "left", no_wrap=True, min_width=widths.get(name))
    for job in found:
        running, progress = job.state == State.RUNNING, job.progress
        share = float(progress.get("fraction") or 0.0)
        rate, left = progress.get("frames_per_s"), progress.get("seconds_left")
        table.add_row(
            job.id,
            Text(job.state.replace("_", " "), style=_COLOURS.get(job.state, "")),
            job.stage if running else "",
            ProgressBar(total=1.0, completed=share, width=10, complete_style="cyan", finished_style="green"),
            f"{share:.0%}",
            short(rate) if running and rate else "",
            clock(left) if running and left is not None else "",
            job.owner,
            job.label,
            job.source,
        )
    console.print(table if found else "No jobs found.")


def _farewell(job: ServiceJob) -> str:
    """Return what is said at the end, beside what every end of a run says."""
    said = {
        State.WAITING: "it waits for its columns to be edited",
        State.DONE_WITH_FAILED_FRAMES: "done, with frames that could not be fitted",
        State.FAILED: f"failed: {job.reason}",
        State.CANCELLED: job.reason or "cancelled",
    }
    return said.get(job.state, "")


def _seconds(job: ServiceJob) -> float:
    """Return how long a job took, or has taken, in s."""
    if job.started is None:
        return 0.0
    end = datetime.now(UTC) if job.ended is None else datetime.fromisoformat(job.ended)
    return max((end - datetime.fromisoformat(job.started)).total_seconds(), 0.0)


def _read_token(file: Path) -> str:
    try:
        return file.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            "the token cannot be read", str(file), "a file with a token, and nothing else", str(error), "Check its path"
        ) from error
