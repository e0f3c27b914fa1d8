"""The numbers of a report: those of every column and of every frame, and series that are short enough for a page."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ..analysis import overview
from ..analysis.jumps import noise_factor
from ..analysis.overview import Floats
from ..errors import SettingsError
from ..settings.run import RunSettings
from ..settings.toml import load
from ..store import datasets, metadata, results, schema
from ..store.files import read_small
from ..store.pixels import GROUP
from ..store.run_folder import RunFolder
from ..store.strangers import strangers
from .residuals import Residuals, residuals

VALUES = 1_600_000
"""Numbers that the series of all columns together may have: 4 MB of the page."""
_IN_MEMORY = 256 << 20
"""Tracks of no more bytes are read once; larger ones are gone through part by part, more than once."""
_PART_BYTES = 16 << 20
"""So many bytes of fits are looked at together, or those of a bin of frames."""
_EVENTS_BYTES = 256 << 20
_FRAMES = 2000
"""Points that a curve over the frames may have."""


@dataclass(frozen=True)
class Survey:
    """What a report tells of a run.

    Attributes
    ----------
    about
        What results.zarr says of itself; ``movie``: what movie.zarr says; ``strangers``: names of the stores that
        were made from another movie.
    settings
        Those of the run; None where they cannot be read.
    known
        Units: lengths are in pm, or in px where the size of a pixel is not known.
    columns
        Over column_id: x_ref, y_ref, kind, the numbers of :meth:`.overview.ColumnSums.numbers`, and ``residual`` and
        ``p_value`` of the fit on the summed image, see :class:`.residuals.Residuals`.
    frames
        Over frame: time, drift, drift_measured (frame, axis), the numbers of :meth:`.overview.Part.frames`, ``share``
        of accepted fits, and ``quality`` of the drift where it was measured.
    series
        Place and intensity of every column in time, averaged over frames until they fit on a page, see
        :func:`.overview.binned`: over (bin, quantity, column_id), where quantity is x and y, measured from the place in
        the summed image, and intensity (counts); ``time`` (bin). Attribute ``frames``: how many a bin has.
    factor
        Median over columns of :func:`tract_dask.analysis.jumps.noise_factor`; NaN where no error is known.
    summed
        The summed image.
    found
        Attributes of the columns as they were found, see :func:`tract_dask.find_columns`; empty where they are gone.
    events
        The run's, as far as they are kept.
    """

    folder: Path
    tracks: xr.Dataset
    about: dict[str, Any]
    settings: RunSettings | None
    known: overview.Calibration
    columns: xr.Dataset
    frames: xr.Dataset
    series: xr.Dataset
    factor: float
    summed: xr.Dataset
    found: dict[str, Any]
    events: list[dict[str, Any]]

    @property
    def fits(self) -> int:
        """Fits that were made."""
        return int(self.columns["fits"].sum())

    @property
    def left_out(self) -> dict[str, Any]:
        """How many pixels of the movie carry no data, see :meth:`tract_dask.store.pixels.Pixels.counts`."""
        counts: dict[str, Any] = self.about["movie"].get(GROUP, {})
        return counts

    @property
    def scatter(self) -> Floats:
        """Relative standard deviation of a column's intensity in single frames, (columns,), by successive values."""
        values = self.series["mean"].sel(quantity="intensity").to_numpy()
        steps = np.diff(values, axis=0)
        known = np.isfinite(steps)
        squares = np.where(known, steps, 0.0) ** 2
        number = np.where(known.any(axis=0), known.sum(axis=0), np.nan)
        variance = self.series.attrs["frames"] * squares.sum(axis=0) / (2 * number)
        return np.asarray(np.sqrt(variance) / np.abs(self.columns["intensity"].to_numpy()))

    @property
    def accepted(self) -> int:
        """Fits that were accepted."""
        return int(self.columns["accepted"].sum())


def survey(folder: Path, events: list[dict[str, Any]]) -> Survey:
    """Return what a report tells of the run in ``folder``; memory does not grow with the movie.

    Raises
    ------
    StoreError
        Where the tracks or the summed image are missing or unfinished.
    """
    places = RunFolder(folder)
    tracks = results.open_results(places.results)
    if small := tracks.nbytes <= _IN_MEMORY:
        tracks = tracks.load(scheduler="threads")
    summed = datasets.open_dataset(places.sum)
    about = metadata.attributes(places.results)
    known = overview.Calibration.of(about)
    measured = tracks.assign_attrs(pixel_size_pm=known.scale)
    columns, frames, series = gathered(measured, None if small else results.variables(places.results))
    others, settings = strangers(folder), _settings(places.settings)
    if places.drift.exists() and places.drift not in others:
        frames["quality"] = ("frame", datasets.open_dataset(places.drift)["quality"].to_numpy())
    left = residuals(tracks, summed, float(metadata.attributes(places.movie).get("gain", 1.0)), settings)
    columns = columns.assign(
        {name: ("column_id", values) for name, values in zip(Residuals._fields, left, strict=True)}
    )
    return Survey(
        folder=folder,
        tracks=measured,
        about=about | {"movie": metadata.attributes(places.movie), "strangers": [path.name for path in others]},
        settings=settings,
        known=known,
        columns=columns,
        frames=frames,
        series=series,
        factor=float(np.median(noise_factor(measured)["factor"])) if np.isfinite(columns["expected"]).any() else np.nan,
        summed=summed,
        found=_found(places.columns.with_suffix(".zarr")),
        events=events,
    )


def events_of(path: Path) -> list[dict[str, Any]]:
    """Return the events of a run; a line that is not whole is left out, and all are where they cannot be read."""
    found = []
    with suppress(OSError):
        for line in read_small(path, _EVENTS_BYTES).splitlines():
            with suppress(ValueError, RecursionError):
                found.append(json.loads(line))
    return [event for event in found if isinstance(event, dict) and "event" in event]


def gathered(tracks: xr.Dataset, opened: Callable[[str], Any] | None, values: int = VALUES) -> tuple[xr.Dataset, ...]:
    """Return ``columns``, ``frames`` and ``series`` of :class:`Survey`.

    Parameters
    ----------
    tracks
        Their lengths are in units of ``pixel_size_pm``.
    opened
        Returns a variable of them, which is read part by part; None: they are in memory.
    values
        Numbers that all series together may have.
    """
    n_frames, n_columns, scale = tracks.sizes["frame"], tracks.sizes["column_id"], tracks.attrs["pixel_size_pm"]
    step = _frames_a_bin(n_frames, n_columns, values)
    origin = np.stack([tracks["x_ref"], tracks["y_ref"], np.zeros(n_columns)])
    units = np.array([scale, scale, 1.0])[:, None]
    sums, by_frame, binned = overview.ColumnSums.nothing(n_columns), [], []
    per_part = max(1, _PART_BYTES // (8 * 7 * max(1, n_columns) * step)) * step
    for start in range(0, n_frames, per_part):
        part = overview.Part(opened or (lambda name: tracks[name].to_numpy()), start, min(start + per_part, n_frames))
        sums += part.columns()
        by_frame.append(part.frames())
        places, errors = np.split(part.series.transpose(1, 0, 2), 2, axis=1)
        binned.append(overview.binned((places - origin) * units, errors * units, step))
    numbers = {name: ("column_id", number) for name, number in sums.numbers(scale).items()}
    columns = tracks[["x_ref", "y_ref", "kind"]].assign(numbers)
    return columns, _frames(tracks, np.concatenate(by_frame, axis=1)), _series(tracks, binned, step)


def _frames(tracks: xr.Dataset, numbers: Floats) -> xr.Dataset:
    of = dict(zip(overview.FRAME, numbers, strict=True))
    of |= {"bad": of["bad"] > 0, "share": of["accepted"] / np.where(of["fits"] > 0, of["fits"], np.nan)}
    known = tracks[["time", "drift", "drift_measured", "motion"]].compute(scheduler="threads")
    return known.assign({name: ("frame", number) for name, number in of.items()})


def _series(tracks: xr.Dataset, binned: list[dict[str, Floats]], step: int) -> xr.Dataset:
    dims = "bin", "quantity", "column_id"
    found = {name: (dims, np.concatenate([part[name] for part in binned])) for name in binned[0]}
    coordinates = {"quantity": schema.texts(overview.QUANTITIES), "column_id": tracks["column_id"]}
    time = overview.binned_mean(tracks["time"].to_numpy(), step)
    return xr.Dataset(found, coordinates, {"frames": step}).assign(time=("bin", time))


def frame_curves(frames: xr.Dataset) -> dict[str, Floats]:
    """Return the numbers over frame, averaged until a curve has no more points than a screen can show."""
    known = {str(name): values.to_numpy() for name, values in frames.items() if values.dims == ("frame",)}
    return overview.frame_curves(known, -(-frames.sizes["frame"] // _FRAMES))


def _frames_a_bin(n_frames: int, n_columns: int, values: int) -> int:
    """Return how many frames are averaged, so that the series have about so many ``values``.

    A series of single frames has a value and an error; one of means also the extremes.

    Examples
    --------
    >>> _frames_a_bin(40, 34, 1_600_000), _frames_a_bin(20_000, 400, 1_600_000)
    (1, 61)
    """
    if 2 * len(overview.QUANTITIES) * n_frames * n_columns <= values:
        return 1
    bins = max(2, values // (4 * len(overview.QUANTITIES) * n_columns))
    return max(2, -(-n_frames // bins))


def median(values: Any) -> float:
    """Return the median of the finite values; NaN where there are none."""
    return float(np.nanmedian(values)) if np.isfinite(values).any() else float("nan")


def percentiles(values: Any) -> tuple[float, float]:
    """Return between which values nine tenths of the finite ones lie: their 5th and 95th percentile."""
    low, high = np.nanpercentile(values, [5, 95])
    return float(low), float(high)


def _found(path: Path) -> dict[str, Any]:
    return {str(name): value for name, value in datasets.open_dataset(path).attrs.items()} if path.exists() else {}


def _settings(path: Path) -> RunSettings | None:
    """Return the settings of the run; None where they are missing or of another version."""
    try:
        return load(path)
    except SettingsError:
        return None
