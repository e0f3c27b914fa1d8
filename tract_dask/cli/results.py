"""Commands on finished runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from ..errors import ExitCode
from ..settings.run import RunSettings
from .options import Command, numbers, setting_options
from .run import get_ready
from .show import PATH, common_options, progress, show


@click.command(cls=Command)
@click.argument("path", type=PATH, metavar="OUTPUT")
@click.option("--repair", is_flag=True, help="Then make what is damaged in a movie again, from its source.")
@common_options
def verify(path: Path, *, repair: bool, as_json: bool) -> None:
    """Read all that the run in the folder OUTPUT wrote, and name what is damaged or missing.

    OUTPUT may also be a single store (.zarr). The exit code is 0 where all is sound, and 1 where it is not.
    """
    from ..run import verify as verifying

    with progress() as on_event:
        found = verifying.verify(path, on_event)
        if repair and verifying.repair(found, on_event):
            found = verifying.verify(path, on_event)
    if as_json:
        click.echo(json.dumps(found.to_record()))
    else:
        click.echo(found.text())
    if not found.sound:
        click.get_current_context().exit(ExitCode.FAILED)


@click.command("compare-filters", cls=Command)
@click.argument("source")
@click.argument("output", type=PATH)
@click.option("--frame-numbers", type=numbers, default="0", metavar="N,N,...", help="Frames that are compared [0].")
@click.option("--column-ids", type=numbers, metavar="N,N,...", help="IDs of the columns; unset: all of them.")
@common_options
@setting_options("source", "metadata", "convert", "drift", "columns", "fit", "cluster")
def compare_filters(
    source: str,
    output: Path,
    settings: RunSettings,
    *,
    frame_numbers: tuple[int, ...],
    column_ids: tuple[int, ...] | None,
    as_json: bool,
) -> None:
    """Show what each filter does to positions and intensities, as a table and a figure in the folder OUTPUT.

    SOURCE is the folder of a run; or a movie, which is then run into OUTPUT first.
    """
    from ..analysis import filters
    from ..run.compare_filters import compare_in_run

    run_folder = Path(source)
    if not (run_folder / "movie.zarr").is_dir():
        run_folder = output
        get_ready(settings)
        from ..run.pipeline import run

        filters.check_frames(frame_numbers, run(source, output, settings, plan_only=True).frames)
        with progress() as on_event:
            run(source, output, settings, on_event=on_event)
    compared, warnings = compare_in_run(run_folder, output, frame_numbers, column_ids, settings.fit)
    if as_json:
        click.echo(json.dumps({"rows": list(filters.table_rows(compared)), "warnings": warnings}))
    else:
        click.echo(filters.table_text(compared))
    for warning in warnings:
        click.echo(f"Warning: {warning}.", err=True)


@click.command(cls=Command)
@click.argument("folder", type=PATH, metavar="OUTPUT")
@click.option("--file", type=PATH, help="Where to write the report; otherwise report.html in the folder.")
@common_options
def report(folder: Path, file: Path | None, *, as_json: bool) -> None:
    """Write what the run in the folder OUTPUT measured, and how well, as one HTML file.

    Every run writes one at its end; this writes it again. The file needs neither other files nor a network.
    """
    from ..report.page import write_report

    written = write_report(folder, file)
    show({"wrote": str(written), "bytes": written.stat().st_size}, as_json=as_json)


@click.command(cls=Command)
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
    from ..export import tables
    from ..export.atoms import read_atoms, to_xyz

    atoms, spacing_pm = model.pop("atoms"), model.pop("spacing_pm")
    if file.suffix.lower() != ".xyz" and (atoms is not None or spacing_pm is not None):
        raise click.UsageError("--atoms and --spacing-pm are for a model of atoms (.xyz).")
    if file.suffix.lower() == ".xyz":
        if atoms is None or spacing_pm is None:
            raise click.UsageError("A model of atoms needs --atoms and --spacing-pm.")
        tracks = tables.open_tracks(results)
        counts = read_atoms(atoms)
        to_xyz(tracks, counts, file, spacing_pm=spacing_pm, overwrite=overwrite, **model)
    else:
        tables.export(results, file, accepted_only=accepted_only, overwrite=overwrite)
    show({"wrote": str(file), "bytes": file.stat().st_size}, as_json=as_json)


@click.command(cls=Command)
@click.argument("out", type=PATH)
@click.option("--folder", type=PATH, help='Where to put the figures. ["figures" in OUT].')
@click.option("--only", metavar="NAME,NAME,...", help="Names of figures; unset: those that need no further fits.")
@click.option("--table", type=PATH, help="A look-up table (.csv), for numbers of atoms.")
@click.option(
    "--format", "suffix", default="png", type=click.Choice(["png", "pdf", "svg"]), help="Format of the files. [png]."
)
@common_options
def figures(
    out: Path, *, folder: Path | None, only: str | None, table: Path | None, suffix: str, as_json: bool
) -> None:
    """Draw the figures that the results of a run in the folder OUT allow.

    They are sum, drift, fit, displacement, spread, tracks, jumps, fwhm, intensity, repeated_error, strain,
    polarisation, distances and presence; with --table, look_up and occupancy; and precision, intensity_dose and
    filters, which fit frames again, if --only names them.
    """
    from ..plots.of_run import draw_figures

    names = None if only is None else [name.strip() for name in only.split(",")]
    drawn = draw_figures(out, folder, names, table=table, suffix=f".{suffix}")
    found: dict[str, Any] = {"wrote": [str(path) for path in drawn.files.values()]}
    show(found | ({"skipped": drawn.skipped} if as_json else {}), as_json=as_json)
    for name, reason in drawn.skipped.items():
        click.echo(f"Not drawn: {name}. {reason}", err=True)
