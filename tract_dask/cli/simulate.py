"""Commands that simulate."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import click

from ..settings.run import RunSettings
from ..simulate.settings import PRESETS, Microscope, SpecimenSettings
from .options import class_options, setting_options
from .show import PATH, Subgroup, common_options, show

pixel_option = click.option("--pixel-size-pm", default=4.0, show_default=True, metavar="PM", help="Size of a pixel.")

specimen_options = class_options(SpecimenSettings, "specimen", "Specimen")

microscope_options = class_options(Microscope, "microscope", "Microscope", presets=PRESETS)


@click.group(cls=Subgroup)
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
@click.option("--seed", default=0, show_default=True, help="Seed of the random numbers.")
@common_options
@specimen_options
@microscope_options
def simulate_movie(
    output: Path, specimen: SpecimenSettings, microscope: Microscope, *, model: str, as_json: bool, **options: Any
) -> None:
    """Write a drifting, counted movie to OUTPUT (.tif), and its truth next to it (.zarr)."""
    from ..simulate.files import write_simulated_movie

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

    Its columns (.csv) and its settings (.toml) go next to it.
    """
    from ..simulate.files import write_simulated_image

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
    """Write the intensities of columns of 1, 2, 3 ... atoms to OUTPUT (.csv).

    The images (.tif, all columns equally thick) and the settings (.toml) go next to it. Give the pixel size and the fit
    of the experiment: they change intensities.
    """
    from ..simulate.files import write_simulated_table

    specimen = dataclasses.replace(specimen, n_periods=max_atoms)
    options["contrast"] = settings.columns.contrast
    table, written = write_simulated_table(output, specimen, microscope, settings.fit, **options)
    found = {str(n): round(float(value), 4) for n, value in table["intensity"].to_series().items()}
    show(found | {"wrote": [str(path) for path in written]}, as_json=as_json)
