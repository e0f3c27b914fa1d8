"""The figures of a run: all that its results allow, each in a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from .. import plots
from ..analysis import jumps
from ..analysis.dose import fit_doses
from ..analysis.filters import compare_filters, filtered_region
from ..analysis.intensity import intensity_against_dose, normalised, repeated_error, vacuum_level
from ..analysis.lookup import read_table
from ..analysis.occupancy import count_atoms
from ..analysis.polarisation import neighbour_distances, polarisation
from ..analysis.precision import precision_table
from ..analysis.presence import appearances
from ..analysis.strain import strain
from ..errors import InputError, SettingsError, StoreError
from ..settings.run import FitSettings
from ..settings.toml import from_toml
from ..store import datasets, metadata
from ..store.movie import Movie, open_movie
from ..store.results import open_results
from ..store.run_folder import RunFolder
from ..store.schema import is_accepted, texts

_GROUPS = (1, 2, 4)
"""Frames in a sum, for figures against dose."""
_COMPARED = 4
"""Columns in figures of a few neighbours, as in the paper."""


class Drawn(NamedTuple):
    """What :func:`draw_figures` did: the file of each figure, and why others could not be drawn."""

    files: dict[str, Path]
    skipped: dict[str, str]


@dataclass(frozen=True)
class Run:
    """The finished stores of a run, each opened when it is first asked for.

    Attributes
    ----------
    folder
        Of the run (:class:`tract_dask.store.run_folder.RunFolder`).
    table
        A look-up table as CSV, for numbers of atoms.
    """

    folder: Path
    table: Path | None = None

    @property
    def places(self) -> RunFolder:
        """Where its stores are."""
        return RunFolder(self.folder)

    @cached_property
    def tracks(self) -> xr.Dataset:
        """The results."""
        return open_results(self.places.results)

    @cached_property
    def summed(self) -> xr.Dataset:
        """The summed image."""
        summed = datasets.open_dataset(self.places.sum)
        return summed.assign_attrs(pixel_size_pm=self.tracks.attrs["pixel_size_pm"])

    @cached_property
    def columns(self) -> xr.Dataset:
        """The columns as they were found."""
        return datasets.open_dataset(self.places.columns_store)

    @cached_property
    def movie(self) -> Movie:
        """The movie."""
        return open_movie(self.places.movie)

    @cached_property
    def settings(self) -> FitSettings:
        """Those of the fit."""
        path = self.places.results
        return from_toml(FitSettings, metadata.attributes(path)["settings"], str(path))

    @cached_property
    def vacuum(self) -> xr.Dataset:
        """The level of the vacuum in the summed image."""
        box = metadata.attributes(self.places.results).get("vacuum")
        return vacuum_level(self.summed, box and tuple(box), columns=self.columns)

    @cached_property
    def intensities(self) -> xr.Dataset:
        """Intensities in units of 1 A^2 of vacuum, with the time of the frames."""
        return normalised(self.tracks, self.vacuum).assign(time=self.tracks["time"])

    @cached_property
    def look_up(self) -> xr.Dataset:
        """The look-up table."""
        if self.table is None:
            raise SettingsError("there is no look-up table", "figures", "a CSV file", "none", "Give one with --table")
        return read_table(self.table)

    @cached_property
    def doses(self) -> list[xr.Dataset]:
        """The columns fitted in sums of 1, 2, 4 frames, in memory."""
        drift = datasets.open_dataset(self.places.drift)
        fits = fit_doses(self.movie, self.columns, drift, _GROUPS, self.settings, summed=self.summed)
        return [one.compute() for one in fits]

    @cached_property
    def against_dose(self) -> xr.Dataset:
        """Intensities against dose, of the brightest column."""
        vacua = [self.vacuum.map(lambda level, n=n: n * level, keep_attrs=True) for n in _GROUPS]
        return intensity_against_dose(self.doses, [self.brightest], vacuum=vacua)

    @cached_property
    def brightest(self) -> int:
        """ID of the column that stands out most."""
        amplitude = np.abs(self.tracks["fit_ref"].sel(parameter="amplitude").to_numpy())
        return int(self.tracks["column_id"][int(np.nan_to_num(amplitude).argmax())])

    @cached_property
    def neighbours(self) -> list[int]:
        """IDs of the column that spreads most among those seen in most frames, and of those nearest to it."""
        fits = self.tracks["fit"].sel(parameter=["x", "y"])
        good = is_accepted(self.tracks["status"])
        spread = fits.where(good).std("frame").max("parameter").where(good.mean("frame") > 0.5).to_numpy()
        places = np.stack([self.tracks["x_ref"], self.tracks["y_ref"]], axis=1)
        centre = places[int(np.nanargmax(spread))] if np.isfinite(spread).any() else places.mean(axis=0)
        near = np.argsort(np.hypot(*(places - centre).T), kind="stable")[:_COMPARED]
        return sorted(self.tracks["column_id"].to_numpy()[near].tolist())

    @cached_property
    def frames(self) -> tuple[int, int]:
        """The two neighbouring frames between which those columns move most."""
        some = self.tracks.sel(column_id=self.neighbours)
        place = some["fit"].sel(parameter=["x", "y"]).where(is_accepted(some["status"])).to_numpy()
        moved = np.hypot(*np.moveaxis(np.diff(place, axis=0), -1, 0))
        seen = np.isfinite(moved).sum(axis=1, keepdims=True)
        ranked = np.where(seen == seen.max(initial=0), np.nan_to_num(moved, nan=-1), -1)
        first = int(ranked.max(axis=1).argmax()) if len(ranked) else 0
        return first, min(first + 1, self.tracks.sizes["frame"] - 1)


def _filters(run: Run, path: Path) -> Figure:
    frame = run.frames[1]
    drift = datasets.open_dataset(run.places.drift)
    compared = compare_filters(
        run.movie, run.columns, drift, frames=(frame,), column_ids=run.neighbours, settings=run.settings
    )
    return plots.plot_filters(filtered_region(run.movie, compared, frame, run.settings), compared, path)


def _jumps(run: Run, path: Path) -> Figure:
    return plots.plot_jumps(jumps.change_points(run.tracks, confidence=0.99), run.tracks, run.summed, path)


def _occupancy(run: Run, path: Path) -> Figure:
    counts = count_atoms(run.tracks, run.look_up, run.vacuum, frames="mean")
    return plots.plot_occupancy(counts, run.tracks, run.summed, None, path)


def _strain(run: Run, path: Path) -> Figure:
    kind = "A" if "A" in run.tracks["kind"].to_numpy() else None
    return plots.plot_strain(strain(run.tracks, kind), run.summed, path)


def _polarisation(run: Run, path: Path) -> Figure:
    known = set(texts(run.tracks["kind"].to_numpy()))
    if not {"A", "B"} <= known:
        what, got = "columns of kinds A and B", ", ".join(sorted(filter(None, known))) or "columns of one kind"
        raise InputError("there is no off-centring to draw", "figure polarisation", what, got)
    return plots.plot_polarisation(polarisation(run.tracks), run.summed, path)


FIGURES: dict[str, Callable[[Run, Path], Figure]] = {
    "sum": lambda run, path: plots.plot_sum(run.summed, path, columns=run.columns),
    "drift": lambda run, path: plots.plot_drift(run.tracks, path),
    "fit": lambda run, path: plots.plot_fit(run.tracks, run.movie, run.brightest, run.frames[0], path),
    "displacement": lambda run, path: plots.plot_displacement(run.tracks, run.movie, *run.frames, run.neighbours, path),
    "spread": lambda run, path: plots.plot_spread(run.tracks, run.summed, path),
    "tracks": lambda run, path: plots.plot_tracks(run.tracks, run.summed, None, path),
    "jumps": _jumps,
    "fwhm": lambda run, path: plots.plot_fwhm(run.tracks, run.summed, path),
    "intensity": lambda run, path: plots.plot_intensity(run.intensities, None, path),
    "repeated_error": lambda run, path: plots.plot_repeated_error(
        repeated_error(run.intensities), run.tracks, run.summed, path
    ),
    "strain": _strain,
    "polarisation": _polarisation,
    "distances": lambda run, path: plots.plot_neighbour_distances(neighbour_distances(run.tracks), run.summed, path),
    "presence": lambda run, path: plots.plot_presence(run.tracks, path, events=appearances(run.tracks)),
    "look_up": lambda run, path: plots.plot_look_up(run.look_up, path),
    "occupancy": _occupancy,
    "precision": lambda run, path: plots.plot_precision(precision_table(run.doses), path),
    "intensity_dose": lambda run, path: plots.plot_intensity_against_dose(
        run.against_dose, None, path, table=None if run.table is None else run.look_up
    ),
    "filters": _filters,
}
"""How each figure is drawn from a run."""

SLOW = ("precision", "intensity_dose", "filters")
"""Figures for which frames are fitted again: only drawn where they are named."""
OF_TABLE = ("look_up", "occupancy")
"""Figures for which a look-up table is needed."""


def draw_figures(
    run: Path,
    folder: Path | None = None,
    only: Sequence[str] | None = None,
    *,
    table: Path | None = None,
    suffix: str = ".png",
) -> Drawn:
    """Draw the figures of a finished run into a folder.

    Parameters
    ----------
    run
        The folder of the run.
    folder
        Where to put them; None: ``figures`` in that of the run.
    only
        Names of figures (:data:`FIGURES`); None: all that need no further fits, those of the table if there is one.
    table
        A look-up table (CSV), for numbers of atoms.
    suffix
        ``.png``, ``.pdf`` or ``.svg``.

    Raises
    ------
    SettingsError
        Where there is no such figure.
    StoreError
        Where there is no finished run.
    """
    unknown = [name for name in only or () if name not in FIGURES]
    if unknown:
        raise SettingsError("there is no such figure", "figures", ", ".join(FIGURES), ", ".join(unknown))
    stages = [run / f"{name}.zarr" for name in ("results", "sum", "columns", "drift", "movie")]
    if missing := [path.name for path in stages if not path.is_dir()]:
        raise StoreError(
            "this is not a finished run", str(run), "the folder of tract-dask run", f"no {missing[0]}", "Run it"
        )
    left_out = SLOW + (OF_TABLE if table is None else ())
    chosen = [name for name in FIGURES if name not in left_out] if only is None else list(only)
    folder = folder or run / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    opened, drawn = Run(run, table), Drawn({}, {})
    for name in chosen:
        path = folder / f"{name}{suffix}"
        try:
            FIGURES[name](opened, path)
        except InputError as error:
            drawn.skipped[name] = str(error)
        else:
            drawn.files[name] = path
    return drawn
