"""The command line: one thin function a verb.

Heavy modules are imported inside the commands, so that help comes at once.
"""

from __future__ import annotations

import json
import logging
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

import click

from .errors import TractError
from .options import Command, setting_options
from .settings import RunSettings

if TYPE_CHECKING:
    from .pipeline import Plan, RunOutcome
    from .progress import Sink

F = TypeVar("F", bound=Callable[..., Any])

FAILED, BAD_FRAMES, INTERRUPTED = 1, 3, 130
"""Exit codes beside 0, and 2 for usage or bad input."""

PATH = click.Path(path_type=Path)

_DEBUG = "tract_dask.debug"


class Group(click.Group):
    """Commands whose errors end as one readable paragraph and an exit code."""

    command_class = Command

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in the order of the work."""
        return list(self.commands)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; turn what it raises into an exit code."""
        try:
            with _terminated_as_interrupted():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            click.echo("Interrupted: what is done is kept, and the same command goes on from there.", err=True)
            ctx.exit(INTERRUPTED)
        except (click.ClickException, click.Abort, click.exceptions.Exit):
            raise
        except TractError as error:
            self._explain(ctx, f"Error: {error}", error.exit_code)
        except Exception as error:  # noqa: BLE001  the last resort of the command line, which has to explain itself
            said = str(error).rstrip(".")
            text = f"Error: unexpected {type(error).__name__}: {said}. Say --debug to see where; what is done is kept."
            self._explain(ctx, text, FAILED)

    def _explain(self, ctx: click.Context, text: str, code: int) -> None:
        if ctx.meta.get(_DEBUG):
            traceback.print_exc()
        click.echo(text, err=True)
        ctx.exit(code)


def common_options(function: F) -> F:
    """Give a command ``--json`` and ``--debug``."""
    debug = click.option(
        "--debug",
        is_flag=True,
        expose_value=False,
        callback=lambda ctx, param, value: ctx.meta.update({_DEBUG: value}),
        help="Show where in the program an error came up.",
    )
    as_json = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON; progress goes to stderr.")
    return as_json(debug(function))


overwrite_option = click.option("--overwrite", is_flag=True, help="Begin anew, whatever is there.")
drift_option = click.option("--drift-from", type=PATH, help="The drift, as tract-dask drift wrote it; otherwise none.")


@click.group(name="tract", cls=Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="tract_dask", prog_name="tract-dask")
def main() -> None:
    """Track atomic columns through a TEM movie of any length.

    The whole job is "tract-dask run movie.tif out"; "tract-dask demo" shows it on a simulated movie.
    """


@main.command()
@click.argument("source")
@click.argument("output", type=PATH)
@click.option("--plan", "plan_only", is_flag=True, help="Print what would be done, and stop.")
@overwrite_option
@common_options
@setting_options("source", "metadata", "convert", "drift", "columns", "fit", "cluster")
def run(source: str, output: Path, settings: RunSettings, *, plan_only: bool, overwrite: bool, as_json: bool) -> None:
    """Turn the movie SOURCE into tracks in the folder OUTPUT.

    Run it again to go on where it was stopped; changed settings redo only what they affect.
    """
    pipeline = _pipeline(settings)
    with _progress() as on_event:
        outcome = pipeline.run(source, output, settings, on_event=on_event, overwrite=overwrite, plan_only=plan_only)
    _show_outcome(outcome, as_json=as_json)


@main.command()
@click.argument("path")
@common_options
@setting_options("source", "metadata")
def inspect(path: str, settings: RunSettings, *, as_json: bool) -> None:
    """Print what PATH holds.

    It may be a movie in any format, or a store or folder that tract-dask wrote.
    """
    from .describe import describe

    _show(describe(path, settings), as_json=as_json)


@main.command()
@click.argument("source")
@click.argument("destination", type=PATH)
@overwrite_option
@common_options
@setting_options("source", "metadata", "convert", "cluster")
def convert(source: str, destination: Path, settings: RunSettings, *, overwrite: bool, as_json: bool) -> None:
    """Convert the movie SOURCE to the store DESTINATION (.zarr)."""
    pipeline = _pipeline(settings)
    with _progress() as on_event:
        pipeline.run_convert(source, destination, settings, on_event=on_event, overwrite=overwrite)
    _show_store(destination, as_json=as_json)


@main.command()
@click.argument("movie", type=PATH)
@click.argument("output", type=PATH)
@common_options
@setting_options("drift", "cluster")
def drift(movie: Path, output: Path, settings: RunSettings, *, as_json: bool) -> None:
    """Measure the drift of the store MOVIE into OUTPUT (.zarr)."""
    pipeline = _pipeline(settings)
    with _progress() as on_event:
        pipeline.run_drift(movie, output, settings, on_event=on_event)
    _show_store(output, as_json=as_json)


@main.command()
@click.argument("movie", type=PATH)
@click.argument("output", type=PATH)
@drift_option
@overwrite_option
@common_options
@setting_options("columns", "fit.window_px", "fit.blur_sigma_px", "cluster")
def columns(
    movie: Path, output: Path, settings: RunSettings, *, drift_from: Path | None, overwrite: bool, as_json: bool
) -> None:
    """Find the columns of the store MOVIE, into OUTPUT (.csv).

    They are looked for in the movie's drift-corrected sum; a figure of them is written beside the table.
    """
    pipeline = _pipeline(settings)
    with _progress() as on_event:
        pipeline.run_columns(movie, output, settings, drift_from, on_event=on_event, overwrite=overwrite)
    _show_store(output.with_suffix(".zarr"), as_json=as_json)


@main.command()
@click.argument("movie", type=PATH)
@click.argument("columns", type=PATH)
@click.argument("results", type=PATH)
@drift_option
@common_options
@setting_options("fit", "columns.contrast", "drift.refine", "drift.refine_columns", "cluster")
def fit(
    movie: Path, columns: Path, results: Path, settings: RunSettings, *, drift_from: Path | None, as_json: bool
) -> None:
    """Fit COLUMNS (.csv) in all frames of MOVIE, into RESULTS.

    MOVIE and RESULTS are stores (.zarr); what RESULTS has from an interrupted fit is kept.
    """
    pipeline = _pipeline(settings)
    with _progress() as on_event:
        summary = pipeline.run_fit(movie, columns, results, settings, drift_from, on_event=on_event)
    _show_store(results, as_json=as_json)
    _exit_for(summary.bad_frames)


@main.command()
@click.argument("folder", type=PATH, default="tract-dask-demo")
@click.option("--frames", default=60, show_default=True, help="Frames of the simulated movie.")
@common_options
@setting_options("convert", "drift", "columns", "fit", "cluster")
def demo(folder: Path, settings: RunSettings, *, frames: int, as_json: bool) -> None:
    """Track a simulated movie, and compare with its truth.

    The movie is a drifting low-dose one of CeO2; everything goes to FOLDER.
    """
    from .demo import run_demo

    with _progress() as on_event:
        found = run_demo(folder, frames, settings, on_event=on_event)
    _show(found, as_json=as_json)


def _pipeline(settings: RunSettings) -> ModuleType:
    """Import the pipeline; the server of the local workers, if there are to be any, imports at the same time."""
    from . import forkserver

    if not (settings.cluster.scheduler or settings.cluster.scheduler_file):
        forkserver.start()
    from . import pipeline

    return pipeline


@contextmanager
def _progress() -> Iterator[Sink]:
    """Yield a sink that shows progress on standard error."""
    from .terminal import Terminal

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with Terminal() as terminal:
        yield terminal


def _show_outcome(outcome: RunOutcome, *, as_json: bool) -> None:
    """Print what a run did, or what it would do, and end with the exit code for it."""
    if as_json:
        click.echo(json.dumps(outcome.to_record()))
    elif outcome.state == "planned":
        _show(_plan_rows(outcome.plan), as_json=False)
    else:
        share = f" ({outcome.accepted / outcome.fits:.1%})" if outcome.fits else ""
        rows = {
            "columns": outcome.columns,
            "frames": outcome.frames,
            "fits": f"{outcome.fits:,}",
            "accepted": f"{outcome.accepted:,}{share}",
        }
        rows |= {"frames not fitted": outcome.bad_frames} if outcome.bad_frames else {}
        _show(rows | {"wrote": list(outcome.outputs.paths().values())}, as_json=False)
    if outcome.state == "planned":
        outcome.plan.check()
    _exit_for(outcome.bad_frames)


def _show_store(path: Path, *, as_json: bool) -> None:
    from .describe import describe

    _show(describe(path), as_json=as_json)


def _plan_rows(plan: Plan) -> dict[str, str]:
    from .terminal import size

    limit = size(plan.memory_limit) if plan.memory_limit else "no limit"
    return {
        "frames": f"{plan.frames:,}",
        "shards": f"{plan.shards:,} of {plan.frames_per_shard} frames",
        "read": f"{size(plan.bytes_read)} at most",
        "written": f"{size(plan.bytes_written)} before compression",
        "peak memory": f"{size(plan.peak_memory)} a task, of {limit}",
    }


def _show(found: dict[str, Any], *, as_json: bool) -> None:
    """Print a mapping as JSON, or as lines of names and values."""
    if as_json:
        click.echo(json.dumps(found))
        return
    width = max(map(len, found), default=0)
    for name, value in found.items():
        for k, line in enumerate(value if isinstance(value, list) else [value]):
            click.echo(f"{name if k == 0 else '':<{width}}  {'-' if line is None else line}")


def _exit_for(bad_frames: int) -> None:
    if bad_frames:
        click.get_current_context().exit(BAD_FRAMES)


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM end the command as Ctrl-C does: workers stopped, what is done kept."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


if __name__ == "__main__":
    sys.exit(main())
