"""The command line: one thin function a verb.

Heavy modules are imported inside the commands, so that help comes at once.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from . import interrupts
from .console import DEBUG, PATH, Subgroup, common_options, show
from .errors import TractError
from .hosting import certs, serve, token
from .lazy import uncollected
from .options import Command, class_options, numbers, setting_options
from .progress import STAGES
from .remote import cancel, jobs, submit, watch
from .settings import RunSettings
from .simulate.settings import PRESETS, Microscope, SpecimenSettings
from .system import check_system

if TYPE_CHECKING:
    from .pipeline import Plan, RunOutcome
    from .progress import Sink

F = TypeVar("F", bound=Callable[..., Any])

FAILED, BAD_FRAMES = 1, 3
"""Exit codes beside 0, 2 for usage or bad input, and that of an interrupt."""


class Group(click.Group):
    """Commands whose errors end as one readable paragraph and an exit code."""

    command_class = Command

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in the order of the work."""
        return list(self.commands)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; turn what it raises into an exit code."""
        try:
            check_system()
            with _terminated_as_interrupted():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            click.echo(interrupts.SENTENCE, err=True)
            ctx.exit(interrupts.CODE)
        except (click.ClickException, click.Abort, click.exceptions.Exit):
            raise
        except TractError as error:
            self._explain(ctx, f"Error: {error}", error.exit_code)
        except Exception as error:  # noqa: BLE001  the last resort of the command line, which has to explain itself
            said = str(error).rstrip(".")
            text = f"Error: unexpected {type(error).__name__}: {said}. Say --debug to see where; what is done is kept."
            self._explain(ctx, text, FAILED)

    def _explain(self, ctx: click.Context, text: str, code: int) -> None:
        if ctx.meta.get(DEBUG):
            traceback.print_exc()
        click.echo(text, err=True)
        ctx.exit(code)


overwrite_option = click.option("--overwrite", is_flag=True, help="Begin anew, whatever is there.")
drift_option = click.option("--drift-from", type=PATH, help="The drift, as tract-dask drift wrote it; otherwise none.")

pixel_option = click.option("--pixel-size-pm", default=4.0, show_default=True, metavar="PM", help="Size of a pixel.")
specimen_options = class_options(SpecimenSettings, "specimen", "Specimen")
microscope_options = class_options(Microscope, "microscope", "Microscope", presets=PRESETS)


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
@click.option("--report/--no-report", default=True, help="Write report.html at the end [on].")
@click.option("--until", type=click.Choice(STAGES[:-1]), help="Stop after this stage, such as to edit columns.csv.")
@overwrite_option
@common_options
@setting_options("source", "metadata", "convert", "drift", "columns", "fit", "cluster")
def run(source: str, output: Path, settings: RunSettings, *, as_json: bool, **options: Any) -> None:
    """Turn the movie SOURCE into tracks in the folder OUTPUT.

    Run it again to go on where it was stopped; changed settings redo only what they affect.
    """
    pipeline = _pipeline(settings)
    with _progress() as on_event:
        outcome = pipeline.run(source, output, settings, on_event=on_event, **options)
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

    show(describe(path, settings), as_json=as_json)


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
@click.option("--edit", is_flag=True, help="Then edit them in the browser; what is saved there is written to OUTPUT.")
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

    They are looked for in the movie's drift-corrected sum; a figure of them is written beside the table.
    """
    pipeline = _pipeline(settings)
    with _progress() as on_event:
        pipeline.run_columns(movie, output, settings, drift_from, on_event=on_event, overwrite=overwrite)
        if edit and _edit(output, settings):
            pipeline.run_columns(movie, output, settings, drift_from, on_event=on_event)
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
@click.argument("path", type=PATH, metavar="OUTPUT")
@click.option("--repair", is_flag=True, help="Then make what is damaged in a movie anew, from its source.")
@common_options
def verify(path: Path, *, repair: bool, as_json: bool) -> None:
    """Read all that the run in the folder OUTPUT wrote, and name what is damaged or missing.

    OUTPUT may also be a single store (.zarr). The exit code is 0 where all is sound, and 1 where it is not.
    """
    from . import verify as verifying

    with _progress() as on_event:
        found = verifying.verify(path, on_event)
        if repair and verifying.repair(found, on_event):
            found = verifying.verify(path, on_event)
    if as_json:
        click.echo(json.dumps(found.to_record()))
    else:
        click.echo(found.text())
    if not found.sound:
        click.get_current_context().exit(FAILED)


@main.command("compare-filters")
@click.argument("source")
@click.argument("output", type=PATH)
@click.option("--frames", type=numbers, default="0", metavar="N,N,...", help="Numbers of the frames [0].")
@click.option("--column-ids", type=numbers, metavar="N,N,...", help="IDs of the columns; unset: all of them.")
@common_options
@setting_options("source", "metadata", "convert", "drift", "columns", "fit", "cluster")
def compare_filters(
    source: str,
    output: Path,
    settings: RunSettings,
    *,
    frames: tuple[int, ...],
    column_ids: tuple[int, ...] | None,
    as_json: bool,
) -> None:
    """Show what each filter does to positions and intensities, as a table and a figure in the folder OUTPUT.

    SOURCE is the folder of a run; or a movie, which is then run into OUTPUT first.
    """
    from . import comparison

    run_folder = Path(source)
    if not (run_folder / "movie.zarr").is_dir():
        run_folder, pipeline = output, _pipeline(settings)
        comparison.check_frames(frames, pipeline.run(source, output, settings, plan_only=True).frames)
        with _progress() as on_event:
            pipeline.run(source, output, settings, on_event=on_event)
    compared, warnings = comparison.compare_in_run(run_folder, output, frames, column_ids, settings.fit)
    if as_json:
        click.echo(json.dumps({"rows": list(comparison.table_rows(compared)), "warnings": warnings}))
    else:
        click.echo(comparison.table_text(compared))
    for warning in warnings:
        click.echo(f"Warning: {warning}.", err=True)


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
    show(found, as_json=as_json)


@main.command()
@click.argument("folder", type=PATH, metavar="OUTPUT")
@click.option("--file", type=PATH, help="Where to write the report; otherwise report.html in the folder.")
@common_options
def report(folder: Path, file: Path | None, *, as_json: bool) -> None:
    """Write what the run in the folder OUTPUT measured, and how well, as one HTML file.

    Every run ends with one; this makes it anew. The file needs neither other files nor a network.
    """
    from .report import write_report

    written = write_report(folder, file)
    show({"wrote": str(written), "bytes": written.stat().st_size}, as_json=as_json)


@main.command()
@click.argument("results", type=PATH)
@click.argument("file", type=PATH)
@click.option("--overwrite", is_flag=True, help="Replace the file if it is there.")
@click.option("--accepted-only", is_flag=True, help="Leave out the fits that are not accepted.")
@click.option("--atoms", type=PATH, help="For .xyz: a CSV file with column_id, atoms and perhaps frame.")
@click.option("--spacing-pm", type=float, metavar="PM", help="For .xyz: distance of atoms along the beam.")
@click.option("--element", default="Ce", show_default=True, metavar="SYMBOL", help="For .xyz: the element.")
@click.option("--align", default="centre", type=click.Choice(["centre", "face"]), help="For .xyz: [centre].")
@common_options
def export(results: Path, file: Path, *, overwrite: bool, accepted_only: bool, as_json: bool, **model: Any) -> None:
    """Write RESULTS to FILE: .csv, .parquet, .nc, .mat, or .xyz for a model of atoms.

    RESULTS is a results.zarr, or the folder of a run.
    """
    from . import export as exporting

    atoms, spacing_pm = model.pop("atoms"), model.pop("spacing_pm")
    if file.suffix.lower() != ".xyz" and (atoms is not None or spacing_pm is not None):
        raise click.UsageError("--atoms and --spacing-pm are for a model of atoms (.xyz).")
    if file.suffix.lower() == ".xyz":
        if atoms is None or spacing_pm is None:
            raise click.UsageError("A model of atoms needs --atoms and --spacing-pm.")
        tracks = exporting.open_tracks(results)
        counts = exporting.read_atoms(atoms)
        exporting.to_xyz(tracks, counts, file, spacing_pm=spacing_pm, overwrite=overwrite, **model)
    else:
        exporting.export(results, file, accepted_only=accepted_only, overwrite=overwrite)
    show({"wrote": str(file), "bytes": file.stat().st_size}, as_json=as_json)


@main.command()
@click.argument("out", type=PATH)
@click.option("--folder", type=PATH, help='Where to put the figures. ["figures" in OUT].')
@click.option("--only", metavar="NAME,NAME,...", help="Names of figures; unset: those that need no further fits.")
@click.option("--table", type=PATH, help="A look-up table (.csv), for numbers of atoms.")
@click.option(
    "--format", "suffix", default="png", type=click.Choice(["png", "pdf", "svg"]), help="Of the files. [png]."
)
@common_options
def figures(
    out: Path, *, folder: Path | None, only: str | None, table: Path | None, suffix: str, as_json: bool
) -> None:
    """Draw the figures that the results of a run in the folder OUT allow.

    They are sum, drift, fit, displacement, spread, tracks, jumps, fwhm, intensity, repeated_error and presence; with
    --table, look_up and occupancy; and precision, intensity_dose and filters, which fit frames again, if --only names
    them.
    """
    from .figures import draw_figures

    names = None if only is None else [name.strip() for name in only.split(",")]
    drawn = draw_figures(out, folder, names, table=table, suffix=f".{suffix}")
    found: dict[str, Any] = {"wrote": [str(path) for path in drawn.files.values()]}
    show(found | ({"skipped": drawn.skipped} if as_json else {}), as_json=as_json)
    for name, reason in drawn.skipped.items():
        click.echo(f"Not drawn: {name}. {reason}", err=True)


@main.group(cls=Subgroup)
def simulate() -> None:
    """Simulate movies, images and look-up tables with known truth.

    All but the movie of Gaussian columns is multislice, which needs abTEM: pip install "tract_dask[simulate]".
    """


@simulate.command(name="movie")
@click.argument("output", type=PATH)
@click.option(
    "--model",
    type=click.Choice(("gaussian", "multislice")),
    default="gaussian",
    help="Columns as Gaussians, quick and of any length, or images by multislice. [gaussian].",
)
@click.option("--frames", default=60, show_default=True, help="Frames of the movie.")
@pixel_option
@click.option("--frame-time-s", default=0.1, show_default=True, metavar="S", help="Time from frame to frame.")
@click.option("--dose", default=500.0, show_default=True, metavar="E/A^2", help="Electron dose of a frame.")
@click.option("--contrast", type=float, help="Factor on the contrast. [gaussian: 0.5; multislice: 1].")
@click.option("--drift-px", default=0.3, show_default=True, metavar="PX", help="Step of the random drift, per axis.")
@click.option("--jump-pm", default=15.0, show_default=True, metavar="PM", help="How far one column jumps (ceo2).")
@click.option("--seed", default=0, show_default=True, help="The number that fixes all randomness.")
@common_options
@specimen_options
@microscope_options
def simulate_movie(
    output: Path, specimen: SpecimenSettings, microscope: Microscope, *, model: str, as_json: bool, **options: Any
) -> None:
    """Write a drifting, counted movie to OUTPUT (.tif), and its truth beside it (.zarr)."""
    from .simulate.files import write_simulated_movie

    written = write_simulated_movie(output, model, specimen, microscope, **options)
    show({"wrote": [str(path) for path in written]}, as_json=as_json)


@simulate.command(name="image")
@click.argument("output", type=PATH)
@pixel_option
@common_options
@specimen_options
@microscope_options
def simulate_image(
    output: Path, specimen: SpecimenSettings, microscope: Microscope, *, pixel_size_pm: float, as_json: bool
) -> None:
    """Write a noise-free image to OUTPUT (.tif), vacuum = 1.

    Its columns (.csv) and its settings (.toml) go beside it.
    """
    from .simulate.files import write_simulated_image

    written = write_simulated_image(output, specimen, microscope, pixel_size_pm)
    show({"wrote": [str(path) for path in written]}, as_json=as_json)


@simulate.command(name="table")
@click.argument("output", type=PATH)
@click.option("--max-atoms", default=12, show_default=True, help="Thickness of the last image, in periods of the beam.")
@click.option("--kind", default="", metavar="ELEMENT", help="Columns to measure; otherwise the heaviest.")
@pixel_option
@common_options
@class_options(SpecimenSettings, "specimen", "Specimen", without=("n_periods",))
@microscope_options
@setting_options("columns.contrast", "fit.window_px", "fit.blur_sigma_px", "fit.estimator", "fit.intensity_scale")
def simulate_table(
    output: Path,
    specimen: SpecimenSettings,
    microscope: Microscope,
    settings: RunSettings,
    *,
    max_atoms: int,
    as_json: bool,
    **options: Any,
) -> None:
    """Write what intensity a column of 1, 2, 3 ... atoms has to OUTPUT (.csv).

    The images (.tif, all columns equally thick) and the settings (.toml) go beside it. Give the pixel size and the fit
    of the experiment: they change intensities.
    """
    from .simulate.files import write_simulated_table

    specimen = dataclasses.replace(specimen, n_periods=max_atoms)
    options["contrast"] = settings.columns.contrast
    table, written = write_simulated_table(output, specimen, microscope, settings.fit, **options)
    found = {str(n): round(float(value), 4) for n, value in table["intensity"].to_series().items()}
    show(found | {"wrote": [str(path) for path in written]}, as_json=as_json)


for service_command in (serve, token, certs, submit, jobs, watch, cancel):
    main.add_command(service_command)


def _edit(table: Path, settings: RunSettings) -> bool:
    """Let the user edit a table of columns in the browser; tell whether it was saved."""
    from .editor import edit_table

    return edit_table(
        table,
        settings,
        lambda url: click.echo(f"Editing {table.name} at {url}\nCtrl-C ends it; what was saved is kept.", err=True),
    )


def _pipeline(settings: RunSettings) -> ModuleType:
    """Import the pipeline; the server of the local workers, if there are to be any, imports at the same time."""
    from . import forkserver

    if not (settings.cluster.scheduler or settings.cluster.scheduler_file):
        forkserver.start()
    with uncollected():
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
    if outcome.state == "planned":
        outcome.plan.check()
    _exit_for(outcome.bad_frames)


def _show_store(path: Path, *, as_json: bool) -> None:
    from .describe import describe

    show(describe(path), as_json=as_json)


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


def command() -> NoReturn:
    """Run the command line as a process, and end it at once.

    To take apart all that was imported takes Python a second or more, and nothing depends on it: what was written is on
    disk, the workers are gone, and their server ends with this process.
    """
    interrupts.install()
    code: object = 0
    try:
        main()
    except SystemExit as ended:
        code = ended.code
    except KeyboardInterrupt:  # just before a command has begun, or after its end
        interrupts.end_at_once()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # whoever read it may be gone
            stream.flush()
    os._exit(code if isinstance(code, int) else int(code is not None))


if __name__ == "__main__":
    command()
