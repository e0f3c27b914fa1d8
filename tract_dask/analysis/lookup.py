"""The look-up table: what intensity a column of 1, 2, 3 … atoms has, from simulated images (section 2.6, Figure 5d)."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from ..errors import SettingsError
from ..kernels.gaussian.fit import fit_gaussians
from ..kernels.gaussian.information import column_bounds
from ..kernels.gaussian.intensity import Floats, intensities
from ..kernels.gaussian.model import blurred
from ..kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, X, Y
from ..kernels.windows import blur_variance, cut_windows
from ..settings.run import ColumnSettings, FitSettings
from ..stages.columns.contrast import SIGNS
from ..stages.columns.find import find_columns
from ..stages.columns.window_size import neighbour_distance, resolve_blur, resolve_window
from ..store.columns import column_dataset, positions
from ..store.files import read_small, write_aside
from ..store.schema import REJECTED, is_accepted
from ..store.tables import decoded, parse_number, parse_table
from .intensity import UNIT

_PM_PER_ANGSTROM = 100.0
_MOST_BYTES = 64 << 20
"""Bytes of a look-up table."""

_REACH = 1 / 8
"""Share of the window by which a fit may be away from where its column is known to be."""

TABLE = {
    "intensity": (UNIT, "Mean intensity over the sites"),
    "low": (UNIT, "Smallest intensity of a site"),
    "high": (UNIT, "Largest intensity of a site"),
    "variance_poisson": ("e/A^2", "Equation 5, squared, times the dose"),
    "variance_fit": ("e/A^2", "Smallest variance that a fit can have (Cramér-Rao), times the dose"),
}
"""Variables of a table on ``atoms``: unit, what they are. ``variance_*`` are missing where nobody knows them."""


def look_up_table(
    images: ArrayLike | xr.DataArray,
    columns: xr.Dataset | Sequence[xr.Dataset],
    settings: FitSettings | None = None,
    *,
    pixel_size_pm: float | None = None,
    vacuum: float = 1.0,
    contrast: str = "bright",
) -> xr.Dataset:
    """Measure the columns of simulated images with our own fit.

    Parameters
    ----------
    images
        (image, y, x), noise-free. The pixels should be as large as the experiment's, for blur and window are in px.
    columns
        Where the columns are: ``x_ref`` and ``y_ref`` on ``column_id``, as :func:`tract_dask.lattice_columns` makes
        them, in all images or in each. Columns have as many atoms as their variable ``atoms`` says; where there is
        none, those of image k have k + 1.
    settings
        Those of the experiment's fit, whose ``blur_sigma_px``, ``window_px``, ``estimator``, ``shape`` and
        ``intensity_scale`` change intensities.
    pixel_size_pm
        Where ``images`` has no such attribute.
    vacuum
        Intensity of a pixel of vacuum in the images.
    contrast
        ``bright`` or ``dark`` columns; ``auto``: those of which more can be fitted.

    Returns
    -------
    xr.Dataset
        On ``atoms``: ``intensity`` (mean over the sites), ``low`` and ``high`` (their range, the paper's error bars),
        ``variance_poisson`` (Equation 5) and ``variance_fit`` (:func:`intensity_bound`), both to be divided by the
        dose; on (atoms, site): ``site_intensity``. 1 is the integrated intensity of 1 A^2 of vacuum. A site is left
        out (NaN) where its fit is not accepted or left the column, as it does where contrast reverses.

    Raises
    ------
    SettingsError
        Where images, columns or pixel size are missing or do not go together, or no column could be measured.
    """
    settings = settings or FitSettings()
    if settings.filters_frames:
        raise SettingsError(
            "a table cannot be made with this filter",
            "setting filter (FitSettings)",
            "gaussian or none",
            settings.filter,
        )
    size = _pixel_size(images, pixel_size_pm)
    pages = np.asarray(images, dtype=np.float64) / vacuum
    scenes = [columns] * len(pages) if isinstance(columns, xr.Dataset) else list(columns)
    if pages.ndim != 3 or len(scenes) != len(pages):
        raise SettingsError(
            "images and columns do not go together",
            "look_up_table",
            "images (image, y, x), and one Dataset of columns for all or for each",
            f"images {pages.shape}, {len(scenes)} Datasets",
        )
    spacing = None if settings.window_px else neighbour_distance(positions(scenes[0]))
    window_px = resolve_window(settings.window_px, pages.shape[1:], spacing)
    pairs = list(zip(pages, scenes, strict=True))
    if settings.blur_sigma_px is None:
        blur = resolve_blur(None, _found(pages[-1], scenes[-1], window_px, settings, contrast))
        settings = dataclasses.replace(settings, blur_sigma_px=blur)
    tries = [contrast] if contrast != "auto" else list(SIGNS)
    measured = [
        np.concatenate([_measured(page, scene, window_px, settings, own) for page, scene in pairs]) for own in tries
    ]
    fits = max(measured, key=lambda found: int(np.isfinite(found).all(axis=1).sum()))
    atoms = np.concatenate([_atoms(scene, k + 1) for k, scene in enumerate(scenes)])
    site = np.concatenate([scene["column_id"].to_numpy() for scene in scenes]).astype(str)
    table = _values(fits, atoms, site, size, window_px, settings)
    table.attrs = {
        "pixel_size_pm": size,
        "window_pm": window_px * size,
        "window_blur_pm": settings.window_blur_px * size,
        "estimator": settings.estimator,
        "intensity_scale": settings.intensity_scale,
    }
    return table


def read_table(path: str | Path) -> xr.Dataset:
    """Read a look-up table from a CSV file with columns ``atoms, intensity`` and optionally more.

    Rows without a ``site`` hold the mean, ``low`` and ``high`` (where they are missing: the mean) and the variances
    over dose; rows with one, the intensity at that site. Where there are no means, they are made from the sites.

    Returns
    -------
    xr.Dataset
        As :func:`look_up_table` returns it; settings of the fit are not known.

    Raises
    ------
    SettingsError
        Naming the line that cannot be used.
    """
    rows = _read_rows(Path(path))
    means = {int(row["atoms"]): row for row in rows if not row["site"]}
    sites = [row for row in rows if row["site"]]
    atoms = np.array([row["atoms"] for row in sites], np.int64)
    names = np.array([row["site"] for row in sites], dtype=str)
    table = _by_site(np.array([row["intensity"] for row in sites]), atoms, names, str(path))
    if not means:
        return table
    numbers = sorted(means)
    column = {name: np.array([means[n][name] for n in numbers]) for name in TABLE}
    for name in ("low", "high"):
        column[name] = np.where(np.isnan(column[name]), column["intensity"], column[name])
    known = {name: values for name, values in column.items() if np.isfinite(values).any()}
    return _dataset(np.array(numbers), known).merge(table[["site_intensity"]], join="left")


def write_table(table: xr.Dataset, path: str | Path) -> None:
    """Write a look-up table as CSV: a row for each number of atoms, then a row for each of its sites."""
    names = [name for name in TABLE if name in table]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["atoms", *names, "site"])
    for row in table[names].to_dataframe().itertuples():
        writer.writerow([row.Index, *(f"{getattr(row, name):.9g}" for name in names), ""])
    blank = [""] * (len(names) - 1)
    for atoms, row_of_sites in zip(table["atoms"].to_numpy(), table["site_intensity"].to_numpy(), strict=True):
        for site, value in zip(table["site"].to_numpy(), row_of_sites, strict=True):
            if np.isfinite(value):
                writer.writerow([atoms, f"{value:.9g}", *blank, site])
    write_aside(Path(path), text.getvalue().encode())


def intensity_bound(parameters: Floats, window_px: int, *, fixed_shape: bool) -> Floats:
    """Return the smallest standard error of columns' intensities (Cramér-Rao), as a share of them, (columns,).

    Parameters
    ----------
    parameters
        (columns, 7) of Equation 1 in electrons, without blur.
    window_px, fixed_shape
        As the columns are fitted.
    """
    centred = parameters.copy()
    places = parameters[:, [X, Y]]
    centred[:, [X, Y]] -= np.rint(places) - window_px // 2
    volume = 2 * np.pi * np.abs(parameters[:, [AMPLITUDE, SIGMA_A, SIGMA_B]].prod(axis=1))
    bounds = column_bounds(centred, window_px, radius_px=window_px / 2, fixed_shape=fixed_shape)
    return np.asarray(np.sqrt(bounds.volume) / volume)


def _read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a table with numbers, NaN where a cell is empty."""
    try:
        text = decoded(read_small(path, _MOST_BYTES))
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError("the look-up table cannot be read", str(path), "a CSV file", str(error)) from error
    table = parse_table(text, str(path))
    if {"atoms", "intensity"} - set(table.header) or not table.rows:
        raise SettingsError(
            "this is not a look-up table",
            str(path),
            "columns atoms, intensity, optionally low, high, site, and one row or more",
            f"columns {', '.join(table.header)} and {len(table.rows)} rows",
        )
    rows = []
    for at, values in table.rows:
        line = dict(zip(table.header, values, strict=True))
        row: dict[str, Any] = {"site": line.get("site", "")}
        try:
            row |= {name: parse_number(line.get(name) or "nan") for name in ("atoms", *TABLE)}
            usable = row["atoms"] == int(row["atoms"]) >= 1 and np.isfinite(row["intensity"])
        except ValueError:
            usable = False
        if not usable:
            raise SettingsError(
                f"line {at} cannot be used",
                str(path),
                "a whole number of atoms from 1 on, and numbers",
                ", ".join(values),
            )
        rows.append(row)
    return rows


def _pixel_size(images: Any, given: float | None) -> float:
    size = given or getattr(images, "attrs", {}).get("pixel_size_pm")
    if not size:
        raise SettingsError(
            "the size of a pixel is not known", "look_up_table", "pixel_size_pm", "none", "Give pixel_size_pm"
        )
    return float(size)


def _atoms(scene: xr.Dataset, number: int) -> NDArray[np.int64]:
    if "atoms" in scene:
        return scene["atoms"].to_numpy().astype(np.int64)
    return np.full(scene.sizes["column_id"], number)


def _measured(image: Floats, columns: xr.Dataset, window_px: int, settings: FitSettings, contrast: str) -> Floats:
    """Return the fits of the columns of an image, (columns, 7); NaN where a fit is not accepted or left its column."""
    reach = max(1.0, _REACH * window_px)
    found = _found(image, columns, window_px, settings, contrast)[["fit_ref", "status_ref"]].reindex(
        column_id=columns["column_id"], fill_value={"status_ref": np.uint16(REJECTED)}
    )
    fit = found["fit_ref"].to_numpy().copy()
    away = np.hypot(*(fit[:, [X, Y]] - positions(columns)).T)
    kept = is_accepted(found["status_ref"].to_numpy()) & (away < reach)
    fit[~kept] = np.nan
    if settings.estimator == "poisson":
        fit[kept] = _likeliest(image, fit[kept], window_px, settings)
    return fit


def _found(image: Floats, columns: xr.Dataset, window_px: int, settings: FitSettings, contrast: str) -> xr.Dataset:
    """Return the columns of an image, found from where they are."""
    summed = xr.Dataset({"image": (("y", "x"), image), "exposure": (("y", "x"), np.ones(image.shape, np.uint32))})
    reach = max(1.0, _REACH * window_px)
    is_blurred = settings.estimator == "poisson" or settings.filter == "gaussian"
    return find_columns(
        summed,
        ColumnSettings(contrast=contrast, search_radius_px=reach, centroid_radius_px=reach),
        seeds=column_dataset(positions(columns), column_id=columns["column_id"]),
        blur_sigma_px=settings.blur_sigma_px if is_blurred else 0.0,
        window_px=window_px,
    )


def _likeliest(image: Floats, reference: Floats, window_px: int, settings: FitSettings) -> Floats:
    """Return fits by maximum likelihood to the raw pixels, (n, 7), started from fits to the blurred ones."""
    start = blurred(reference, -blur_variance(settings.noise_blur_px))
    corner = np.rint(start[:, [Y, X]]).astype(np.int64) - window_px // 2
    start[:, [Y, X]] -= corner
    room = np.array([5 * np.abs(start[:, AMPLITUDE]), *np.full((2, len(start)), _REACH * window_px)])
    lower, upper = start.copy(), start.copy()
    lower[:, [AMPLITUDE, X, Y]] -= room.T
    upper[:, [AMPLITUDE, X, Y]] += room.T
    lower[:, [SIGMA_A, SIGMA_B]], upper[:, [SIGMA_A, SIGMA_B]] = 0.5, window_px
    lower[:, BACKGROUND], upper[:, BACKGROUND] = 0, image.max()
    fits = fit_gaussians(
        cut_windows(image[None].astype(np.float32), corner[None, :, 0], corner[None, :, 1], window_px, 0.0)[0],
        start,
        lower,
        upper,
        estimator="poisson",
        fixed_shape=settings.shape == "fixed",
        max_iterations=200,
        radius_px=window_px / 2,
    )
    estimates = np.where(fits.converged[:, None], fits.estimates, np.nan)
    estimates[:, [Y, X]] += corner
    return estimates


def _values(
    fits: Floats, atoms: NDArray[np.int64], site: NDArray[np.str_], size: float, window_px: int, settings: FitSettings
) -> xr.Dataset:
    """Return the table of fits to images whose vacuum is 1."""
    area = (size / _PM_PER_ANGSTROM) ** 2
    intensity, error = intensities(fits, settings.intensity_scale)
    table = _by_site(area * intensity, atoms, site, "look_up_table")
    electrons = fits.copy()
    electrons[:, [AMPLITUDE, BACKGROUND]] *= area  # at 1 e/A^2
    sharp = blurred(electrons, -blur_variance(settings.window_blur_px))
    bound = intensity_bound(sharp, window_px, fixed_shape=settings.shape == "fixed")
    for name, variance in (("variance_poisson", area * error**2), ("variance_fit", (bound * area * intensity) ** 2)):
        values = [np.nanmean(variance[atoms == n]) for n in table["atoms"].to_numpy()]
        table[name] = ("atoms", values, dict(zip(("units", "long_name"), TABLE[name], strict=True)))
    return table


def _by_site(intensity: Floats, atoms: NDArray[np.int64], site: NDArray[np.str_], where: str) -> xr.Dataset:
    """Return the table of intensities at sites: mean and range of each number of atoms that has any."""
    known = np.isfinite(intensity)
    if not known.any() and len(intensity):
        raise SettingsError(
            "no column of the images could be measured",
            where,
            "columns at the given places",
            f"{len(intensity)} places without one",
            "Check that x and y are in px and not exchanged, and the contrast",
        )
    pairs = list(zip(atoms[known].tolist(), site[known].tolist(), strict=True))
    if len(set(pairs)) < len(pairs):
        first = next(pair for pair in pairs if pairs.count(pair) > 1)
        raise SettingsError(
            "a site occurs twice",
            where,
            "one intensity for each number of atoms and site",
            f"{first[0]} atoms at site {first[1]}",
            "Give the columns of different images different IDs",
        )
    numbers, sites = np.unique(atoms[known]), list(dict.fromkeys(site[known].tolist()))
    grid = np.full((len(numbers), len(sites)), np.nan)
    grid[np.searchsorted(numbers, atoms[known]), [sites.index(name) for _, name in pairs]] = intensity[known]
    mean = np.nanmean(grid, axis=1) if grid.size else np.empty(0)
    low, high = (np.nanmin(grid, axis=1), np.nanmax(grid, axis=1)) if grid.size else (mean, mean)
    table = _dataset(numbers, {"intensity": mean, "low": low, "high": high})
    attributes = {"units": UNIT, "long_name": "Intensity at each site"}
    table["site_intensity"] = (("atoms", "site"), grid, attributes)
    return table.assign_coords(site=sites)


def _dataset(numbers: NDArray[np.int64], values: dict[str, Floats]) -> xr.Dataset:
    attributes = {name: {"units": unit, "long_name": text} for name, (unit, text) in TABLE.items()}
    variables = {name: ("atoms", array, attributes[name]) for name, array in values.items()}
    return xr.Dataset(variables, {"atoms": numbers.astype(np.int64)})
