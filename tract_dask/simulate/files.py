"""Simulated movies, images and tables on disk: a TIFF or CSV, and beside it what it shows and how it was made."""

from __future__ import annotations

import csv
import importlib.metadata
import io
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import tomli_w
import xarray as xr

from ..analysis import lookup
from ..errors import DestinationError, SettingsError
from ..settings.run import FitSettings
from ..settings.toml import to_dict
from ..store.columns import positions, read_columns_csv
from ..store.datasets import write_dataset
from ..store.files import disk_errors, write_aside
from .movie import simulate_movie
from .multislice import multislice_image, thickness_series
from .pictured import simulate_multislice_movie
from .settings import Microscope, SpecimenSettings
from .structures import specimen_of
from .table import tabulate

_TABLE_ATTRIBUTES = ("pixel_size_pm", "window_pm", "window_blur_pm", "estimator", "intensity_scale")


def write_simulated_movie(
    path: Path,
    model: str,
    specimen: SpecimenSettings,
    microscope: Microscope,
    *,
    frames: int,
    pixel_size_pm: float,
    contrast: float | None = None,
    **options: Any,
) -> list[Path]:
    """Write a movie of ``model`` (gaussian or multislice) and its truth as a store beside it.

    ``options`` are those that :func:`simulate_movie` and :func:`simulate_multislice_movie` share; without ``contrast``,
    theirs is taken. Gaussian columns show the CeO2 step alone. Raises as those functions.
    """
    _check_suffix(path, ".tif", ".tiff")
    if not pixel_size_pm > 0:
        raise SettingsError("the size of a pixel is out of range", "pixel_size_pm", "above 0 pm", f"{pixel_size_pm:g}")
    if options.get("seed", 0) < 0:
        raise SettingsError("the seed is out of range", "seed", "0 or more", f"{options['seed']}")
    options |= {"n_frames": frames, "pixel_size_pm": pixel_size_pm}
    if contrast is not None:
        options["contrast"] = contrast
    if specimen.structure == "ceo2":
        options["shape"] = round(specimen.height_pm / pixel_size_pm), round(specimen.width_pm / pixel_size_pm)
    if model == "multislice":
        atoms = None if specimen.structure == "ceo2" else specimen_of(specimen)
        truth = simulate_multislice_movie(path, atoms, microscope, **options)
    elif specimen.structure == "ceo2":
        truth = simulate_movie(path, **options)
    else:
        raise SettingsError(
            "Gaussian columns show CeO2 alone",
            "setting structure",
            "ceo2",
            specimen.structure,
            "Use --model multislice",
        )
    beside = path.with_suffix(".zarr")
    write_dataset(truth, beside)
    return [path, beside]


def write_simulated_image(
    path: Path, specimen: SpecimenSettings, microscope: Microscope, pixel_size_pm: float
) -> list[Path]:
    """Simulate an image and write it; see :func:`multislice_image` and :func:`write_image`, which raise."""
    _check_suffix(path, ".tif", ".tiff")
    return write_image(multislice_image(specimen_of(specimen), microscope, pixel_size_pm=pixel_size_pm), path, specimen)


def write_simulated_table(
    path: Path,
    specimen: SpecimenSettings,
    microscope: Microscope,
    settings: FitSettings,
    *,
    pixel_size_pm: float,
    kind: str = "",
    contrast: str = "bright",
) -> tuple[xr.Dataset, list[Path]]:
    """Simulate and measure a look-up table and write it; see :func:`thickness_series`, :func:`tabulate`.

    Returns
    -------
    tuple
        The table, and the paths of what was written.
    """
    _check_suffix(path, ".csv")
    series = thickness_series(specimen_of(specimen, even=True), microscope, pixel_size_pm=pixel_size_pm)
    table = tabulate(series, settings, kind=kind, contrast=contrast)
    return table, write_series(table, series, path, specimen)


def write_image(simulated: xr.Dataset, path: Path, specimen: SpecimenSettings) -> list[Path]:
    """Write an image with its truth and settings.

    Parameters
    ----------
    simulated
        From :func:`tract_dask.simulate.multislice_image`.
    path
        The TIFF: float32, vacuum = 1, with ImageJ's calibration. Beside it go ``.csv``, the columns with ``column_id,
        x, y, kind, atoms``, which a run takes as its columns, and ``.toml``.
    specimen
        What the image shows, for the ``.toml``.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    DestinationError, StoreError
        Where the files cannot be written.
    """
    _check_suffix(path, ".tif", ".tiff")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["column_id", "x", "y", "kind", "atoms"])
    for column, (x, y), kind, number in zip(
        simulated["column_id"].to_numpy(),
        positions(simulated),
        simulated["kind"].to_numpy(),
        simulated["atoms"].to_numpy(),
        strict=True,
    ):
        writer.writerow([int(column), f"{x:.4f}", f"{y:.4f}", kind, int(number)])
    settings = {"pixel_size_pm": float(simulated.attrs["pixel_size_pm"])}
    return _write_all(
        {
            path: _tiff(simulated),
            path.with_suffix(".csv"): text.getvalue().encode(),
            path.with_suffix(".toml"): _record(simulated, specimen, settings),
        }
    )


def write_series(table: xr.Dataset, series: xr.Dataset, path: Path, specimen: SpecimenSettings) -> list[Path]:
    """Write a look-up table as CSV, the images it was measured in (``.tif``) and its settings (``.toml``).

    Raises as :func:`write_image`.
    """
    _check_suffix(path, ".csv")
    known = {name: table.attrs[name] for name in _TABLE_ATTRIBUTES}
    written = _write_all(
        {path.with_suffix(".tif"): _tiff(series), path.with_suffix(".toml"): _record(series, specimen, known)}
    )
    lookup.write_table(table, path)
    return [path, *written]


def read_image(path: Path) -> xr.Dataset:
    """Return what :func:`write_image` wrote of a single image: ``image`` (y, x), and its columns with ``atoms``."""
    record = tomllib.loads(path.with_suffix(".toml").read_text(encoding="utf-8"))
    columns = read_columns_csv(path.with_suffix(".csv"))[["x_ref", "y_ref", "kind"]]
    atoms = np.loadtxt(path.with_suffix(".csv"), delimiter=",", skiprows=1, usecols=4, dtype=np.int64, ndmin=1)
    attributes = {"units": "1", "long_name": "Intensity, vacuum = 1", "pixel_size_pm": record["pixel_size_pm"]}
    return columns.assign(
        atoms=("column_id", atoms, {"units": "1", "long_name": "Atoms of the column"}),
        image=(("y", "x"), tifffile.imread(path), attributes),
    ).assign_attrs(pixel_size_pm=record["pixel_size_pm"], microscope=tomli_w.dumps(record["microscope"]))


def read_table(path: Path) -> xr.Dataset:
    """Return the look-up table that :func:`write_table` wrote, with the settings of its fit as attributes."""
    record = tomllib.loads(path.with_suffix(".toml").read_text(encoding="utf-8"))
    known = {name: record[name] for name in _TABLE_ATTRIBUTES}
    return lookup.read_table(path).assign_attrs(known, microscope=tomli_w.dumps(record["microscope"]))


def _tiff(simulated: xr.Dataset) -> bytes:
    """Return the image, or those of a series, as an ImageJ TIFF."""
    per_nm = 1000.0 / simulated.attrs["pixel_size_pm"]
    axes = "ZYX" if "n_periods" in simulated.dims else "YX"
    file = io.BytesIO()
    pages = simulated["image"].to_numpy()
    tifffile.imwrite(file, pages, imagej=True, resolution=(per_nm, per_nm), metadata={"unit": "nm", "axes": axes})
    return file.getvalue()


def _record(simulated: xr.Dataset, specimen: SpecimenSettings, settings: dict[str, Any]) -> bytes:
    """Return TOML that says how something was made."""
    versions = {name: importlib.metadata.version(name) for name in ("tract_dask", "abtem", "ase")}
    microscope = tomllib.loads(simulated.attrs["microscope"])
    record = settings | {"versions": versions, "specimen": to_dict(specimen), "microscope": microscope}
    return tomli_w.dumps(record).encode()


def _write_all(contents: dict[Path, bytes]) -> list[Path]:
    for path, content in contents.items():
        with disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        write_aside(path, content)
    return list(contents)


def _check_suffix(path: Path, *suffixes: str) -> None:
    if path.suffix not in suffixes:
        raise DestinationError(
            "the file name has the wrong suffix", str(path), f"a name that ends in {suffixes[0]}", path.name
        )
