"""Commands that run stages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..progress import STAGES, RunState
from ..settings.run import RunSettings
from .options import Command, setting_options
from .show import PATH, common_options, exit_for, overwrite_option, progress, show

if TYPE_CHECKING:
    from ..run.pipeline import RunOutcome
    from ..run.plan import Plan

drift_option = click.option("--drift-from", type=PATH, help="Drift written by tract-dask drift; unset: no drift.")


@click.command(cls=Command)
@click.argument("source")
@click.argument("output", type=PATH)
@click.option("--plan", "plan_only", is_flag=True, help="Print what the run would do, and stop.")
@click.option("--report/--no-report", default=True, help="Write report.html at the end [on].")
@click.option("--until", type=click.Choice(STAGES[:-1]), help="Stop after this stage, such as to edit columns.csv.")
@overwrite_option
@common_options
@setting_options("source", "metadata", "convert", "drift", "columns", "fit", "cluster")
def run(source: str, output: Path, settings: RunSettings, *, as_json: bool, **options: Any) -> None:
    """Turn the movie SOURCE into tracks in the folder OUTPUT.

    Run it again to continue an interrupted run; changed settings redo only what they affect.
    """
    get_ready(settings)
    from ..run.pipeline import run as run_stages

    with progress() as on_event:
        outcome = run_stages(source, output, settings, on_event=on_event, **options)
    _show_outcome(outcome, as_json=as_json)


@click.command(cls=Command)
@click.argument("path")
@common_options
@setting_options("source", "metadata")
def inspect(path: str, settings: RunSettings, *, as_json: bool) -> None:
    """Print what PATH holds.

    It may be a movie in any format, or a store or folder that tract-dask wrote.
    """
    from ..run.inspect import describe

    show(describe(path, settings), as_json=as_json)


@click.command(cls=Command)
@click.argument("source")
@click.argument("destination", type=PATH)
@overwrite_option
@common_options
@setting_options("source", "metadata", "convert", "cluster")
def convert(source: str, destination: Path, settings: RunSettings, *, overwrite: bool, as_json: bool) -> None:
    """Convert the movie SOURCE to the store DESTINATION (.zarr)."""
    get_ready(settings)
    from ..run.one_stage import run_convert

    with progress() as on_event:
        run_convert(source, destination, settings, on_event=on_event, overwrite=overwrite)
    _show_store(destination, as_json=as_json)


@click.command(cls=Command)
@click.argument("movie", type=PATH)
@click.argument("output", type=PATH)
@common_options
@setting_options("drift", "cluster")
def drift(movie: Path, output: Path, settings: RunSettings, *, as_json: bool) -> None:
    """Measure the drift of the store MOVIE into OUTPUT (.zarr)."""
    get_ready(settings)
    from ..run.one_stage import run_drift

    with progress() as on_event:
        run_drift(movie, output, settings, on_event=on_event)
    _show_store(output, as_json=as_json)


@click.command(cls=Command)
@click.argument("movie", type=PATH)
@click.argument("output", type=PATH)
@click.option("--edit", is_flag=True, help="Then edit the columns in the browser; saved changes go to OUTPUT.")
@drift_option
@overwrite_option
@common_options
@setting_options("columns", "fit.window_px", "fit.blur_sigma_px", "cluster")
def columns(
    movie: Path,
    output: Path,
    settings: RunSettings,
    *,
    drift_from: Path | None,
    edit: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Find the columns of the store MOVIE, into OUTPUT (.csv).

    They are found in the movie's drift-corrected sum; a figure of them is written next to the table.
    """
    get_ready(settings)
    from ..run.one_stage import run_columns

    with progress() as on_event:
        run_columns(movie, output, settings, drift_from, on_event=on_event, overwrite=overwrite)
        if edit and _edit(output, settings):
            run_columns(movie, output, settings, drift_from, on_event=on_event)
    _show_store(output.with_suffix(".zarr"), as_json=as_json)


@click.command(cls=Command)
@click.argument("movie", type=PATH)
@click.argument("columns", type=PATH)
@click.argument("results", type=PATH)
@drift_option
@common_options
@setting_options("fit", "columns.contrast", "cluster")
def fit(
    movie: Path, columns: Path, results: Path, settings: RunSettings, *, drift_from: Path | None, as_json: bool
) -> None:
    """Fit COLUMNS (.csv) in all frames of MOVIE, into RESULTS.

    MOVIE and RESULTS are stores (.zarr); fits of an interrupted run in RESULTS are kept.
    """
    get_ready(settings)
    from ..run.one_stage import run_fit

    with progress() as on_event:
        summary = run_fit(movie, columns, results, settings, drift_from, on_event=on_event)
    _show_store(results, as_json=as_json)
    exit_for(summary.bad_frames)


@click.command(cls=Command)
@click.argument("folder", type=PATH, default="tract-dask-demo")
@click.option("--frames", default=60, show_default=True, help="Frames of the simulated movie.")
@common_options
@setting_options("convert", "drift", "columns", "fit", "cluster")
def demo(folder: Path, settings: RunSettings, *, frames: int, as_json: bool) -> None:
    """Track a simulated movie, and compare with its truth.

    The movie shows drifting CeO2 at low dose; everything is written to FOLDER.
    """
    from ..run.demo import run_demo

    with progress() as on_event:
        found = run_demo(folder, frames, settings, on_event=on_event)
    show(found, as_json=as_json)


def _edit(table: Path, settings: RunSettings) -> bool:
    """Let the user edit a table of columns in the browser; tell whether it was saved."""
    from ..service.notebook import edit_table

    return edit_table(
        table,
        settings,
        lambda url: click.echo(f"Editing {table.name} at {url}\nCtrl-C ends it; what was saved is kept.", err=True),
    )


def get_ready(settings: RunSettings) -> None:
    """Import what runs; the server of the local workers, if there are to be any, imports at the same time."""
    from ..cluster import forkserver  # which Windows has not

    if not (settings.cluster.scheduler or settings.cluster.scheduler_file):
        forkserver.start()
    with forkserver.uncollected():
        from ..run import one_stage, pipeline  # noqa: F401


def _show_outcome(outcome: RunOutcome, *, as_json: bool) -> None:
    """Print what a run did, or what it would do, and end with the exit code for it."""
    if as_json:
        click.echo(json.dumps(outcome.to_record()))
    elif outcome.state == RunState.PLANNED:
        show(_plan_rows(outcome.plan), as_json=False)
    else:
        share = f" ({outcome.accepted / outcome.fits:.1%})" if outcome.fits else ""
        rows = {
            "columns": outcome.columns,
            "frames": outcome.frames,
            "fits": f"{outcome.fits:,}",
            "accepted": f"{outcome.accepted:,}{share}",
        }
        rows |= {"frames not fitted": outcome.bad_frames} if outcome.bad_frames else {}
        written = [path for path in outcome.outputs.paths().values() if Path(path).exists()]
        show(rows | {"wrote": written}, as_json=False)
    if outcome.state == RunState.PLANNED:
        outcome.plan.check()
    exit_for(outcome.bad_frames)


def _show_store(path: Path, *, as_json: bool) -> None:
    from ..run.inspect import describe

    show(describe(path), as_json=as_json)


def _plan_rows(plan: Plan) -> dict[str, str]:
    from ..progress import size

    limit = size(plan.memory_limit) if plan.memory_limit else "no limit"
    return {
        "frames": f"{plan.frames:,}",
        "shards": f"{plan.shards:,} of {plan.frames_per_shard} frames",
        "read": f"{size(plan.bytes_read)} at most",
        "written": f"{size(plan.bytes_written)} before compression",
        "peak memory": f"{size(plan.peak_memory)} a task, of {limit}",
    }
