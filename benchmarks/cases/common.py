"""What the cases share: movies of Gaussian columns with known truth, tracking in this process, and a clock."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import tract_dask as td
from tract_dask.kernels.gaussian.intensity import INTENSITY_SCALE
from tract_dask.progress import Event, to_record
from tract_dask.report.findings import findings
from tract_dask.report.survey import survey
from tract_dask.settings import ColumnSettings, FitSettings, MetadataSettings, RunSettings, to_toml
from tract_dask.stages.fit.job import prepare
from tract_dask.stages.fit.stage import fit_movie
from tract_dask.store import datasets
from tract_dask.store.movie import Movie
from tract_dask.store.run_folder import RunFolder

Floats = NDArray[np.float64]

CALIBRATION = MetadataSettings(pixel_size_pm=8.0, frame_time_s=0.1)

REACH = 6.0
"""Sigmas from its centre to which a column is drawn."""


@dataclass(frozen=True)
class Scene:
    """A movie that is known: expected counts a pixel, and where each column is.

    Attributes
    ----------
    places
        x and y of every column in every frame (frame, column, 2), px.
    amplitudes
        Heights above the background (frame, column), counts; 0: the column is not there.
    sigma
        Of a column, px.
    background
        Counts, or an image of them.
    shape
        Height and width of the frames, px.
    """

    places: Floats
    amplitudes: Floats
    sigma: float
    background: float | Floats
    shape: tuple[int, int]

    @cached_property
    def expected(self) -> NDArray[np.float32]:
        """The expected counts (frame, y, x)."""
        frames = np.empty((len(self.places), *self.shape), np.float32)
        for frame, places, amplitudes in zip(frames, self.places, self.amplitudes, strict=True):
            frame[...] = self.background
            for (x, y), amplitude in zip(places, amplitudes, strict=True):
                _draw(frame, x, y, amplitude, self.sigma)
        return frames

    def counts(self, seed: int = 11, dtype: str = "uint16") -> NDArray[Any]:
        """Return a movie drawn from the expected counts by Poisson's law."""
        return np.random.default_rng(seed).poisson(np.maximum(self.expected, 0)).astype(dtype)


def _draw(image: NDArray[np.float32], x: float, y: float, amplitude: float, sigma: float) -> None:
    reach = REACH * sigma
    rows = np.arange(max(0, int(y - reach)), min(image.shape[0], int(y + reach) + 2))
    columns = np.arange(max(0, int(x - reach)), min(image.shape[1], int(x + reach) + 2))
    if amplitude and rows.size and columns.size:
        down, across = np.exp(-((rows - y) ** 2) / (2 * sigma**2)), np.exp(-((columns - x) ** 2) / (2 * sigma**2))
        image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += amplitude * down[:, None] * across


def lattice(shape: tuple[int, int], spacing: float, *, top: float = 0.0, angle_deg: float = 4.0) -> Floats:
    """Return the x and y of a hexagonal lattice below ``top``, px; above is vacuum."""
    angles = np.deg2rad([angle_deg, angle_deg + 60])
    steps = spacing * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    reach = int(2 * max(shape) / spacing)
    indices = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), axis=-1).reshape(-1, 2)
    places = indices @ steps + [shape[1] / 2 + 1.37, shape[0] / 2 + 2.21]
    x, y = places.T
    return np.asarray(places[(x > 0) & (x < shape[1]) & (y > top) & (y < shape[0])])


def walk(n_frames: int, step: float, rng: np.random.Generator, limit: float = 5.0) -> Floats:
    """Return a drift (frame, x and y) of random steps that begins at 0 and stays within ``limit``, px."""
    drift = np.cumsum(rng.normal(0, step, (n_frames, 2)), axis=0)
    drift -= drift[0]
    furthest = float(np.abs(drift).max())
    return drift * min(1.0, limit / furthest) if furthest else drift


def crystal(
    n_frames: int = 40,
    shape: tuple[int, int] = (320, 360),
    *,
    spacing: float = 40.0,
    sigma: float = 5.0,
    background: float = 3.2,
    contrast: float = 0.45,
    top: float = 80.0,
    step: float = 0.35,
    seed: int = 1,
) -> tuple[Scene, Floats]:
    """Return a crystal below a vacuum that drifts as one, and its drift; contrasts vary by 15 %."""
    rng = np.random.default_rng(seed)
    sites = lattice(shape, spacing, top=top)
    drift = walk(n_frames, step, rng)
    heights = contrast * background * (1 + 0.15 * rng.uniform(-1, 1, len(sites)))
    places = sites + drift[:, None]
    return Scene(places, np.repeat(heights[None], n_frames, axis=0), sigma, background, shape), drift


def track(counts: NDArray[Any], folder: Path, fit: dict[str, Any], columns: dict[str, Any]) -> tuple[xr.Dataset, Movie]:
    """Convert a movie into ``folder`` and track it in this process; settings of fit and columns by name.

    The folder is then that of a run, for :func:`warnings_of`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    places, events = RunFolder(folder), list[Event]()
    np.save(folder / "movie.npy", counts)
    td.convert(folder / "movie.npy", folder / "movie.zarr", metadata=CALIBRATION, overwrite=True)
    movie = td.open_movie(folder / "movie.zarr")
    settings = RunSettings(columns=ColumnSettings(**columns), fit=FitSettings(**fit))
    drift = td.estimate_drift(movie, on_event=events.append)
    summed = td.sum_image(movie, drift)
    found = td.find_columns(summed, settings.columns)
    fit_movie(movie, prepare(movie, found, drift, settings.fit, summed=summed), places.results, on_event=events.append)
    for dataset, path in ((drift, places.drift), (summed, places.sum), (found, places.columns.with_suffix(".zarr"))):
        datasets.write_dataset(without_unset(dataset), path)
    places.settings.write_text(to_toml(settings))
    places.events.write_text("".join(f"{json.dumps(to_record(event))}\n" for event in events))
    return td.open_results(places.results).load(), movie


def without_unset(dataset: xr.Dataset) -> xr.Dataset:
    """Return a Dataset without the attributes that are None, which no store takes."""
    stored = dataset.copy()
    stored.attrs = {name: value for name, value in dataset.attrs.items() if value is not None}
    return stored


def warnings_of(folder: Path) -> list[str]:
    """Return the names of the warnings of a run, such as :func:`track` leaves it."""
    events = [json.loads(line) for line in RunFolder(folder).events.read_text().splitlines()]
    return [finding.name for finding in findings(survey(folder, events)) if finding.serious]


def placed(tracks: xr.Dataset) -> Floats:
    """Return where the accepted fits are in the frames as they were taken (frame, column, x and y), px; else NaN."""
    places = (
        td.accepted(tracks)["fit"].sel(parameter=["x", "y"]).transpose("frame", "column_id", "parameter").to_numpy()
    )
    return np.asarray(places + tracks["drift"].sel(axis=["x", "y"]).to_numpy()[:, None], dtype=float)


@dataclass(frozen=True)
class Score:
    """How tracks compare with the truth.

    Attributes
    ----------
    found, wanted
        Columns of the truth, well inside the field, that were found; and all of them.
    false
        Found columns that are none.
    accepted
        Share of the fits of found columns that nothing speaks against.
    rmse, bias
        Root mean square error of a coordinate, and that of the columns' means, px.
    scatter
        Standard deviation of a coordinate about its column's mean error, px.
    bias_in_errors
        Root mean square of the columns' mean errors over the stated errors of these means; 1 is right.
    intensity
        Median over the columns of the mean intensity over the true one; 1 is right.
    intensity_in_errors
        By how many stated errors (median over the columns) of a column's mean intensity the median is off.
    pull
        Root mean square of error over stated error; 1 is right.
    unstated
        Share of the accepted fits that state no error.
    accepted_absent
        Share of accepted fits where the column is not there; NaN where all always are.
    """

    found: int
    wanted: int
    false: int
    accepted: float
    rmse: float
    bias: float
    pull: float
    unstated: float
    accepted_absent: float
    scatter: float
    bias_in_errors: float
    intensity: float
    intensity_in_errors: float

    def __str__(self) -> str:
        absent = "" if np.isnan(self.accepted_absent) else f"; accepted while absent {self.accepted_absent:.1%}"
        return (
            f"{self.found} of {self.wanted} columns, {self.false} false; accepted {self.accepted:.1%}; "
            f"rmse {self.rmse:.3f} px, bias {self.bias:.3f} px, pull {self.pull:.2f}, "
            f"no error stated for {self.unstated:.1%}{absent}"
        )


def score(
    tracks: xr.Dataset, scene: Scene, *, border: float = 25.0, tolerance: float = 6.0, unit: float = 1.0
) -> Score:
    """Compare tracks with the truth; columns within ``border`` px of the edge are not judged.

    ``unit``: detector units an electron.
    """
    places = placed(tracks)
    stated = tracks["stderr"].sel(parameter=["x", "y"]).transpose("frame", "column_id", "parameter").to_numpy()
    reference = np.stack([tracks["x_ref"].to_numpy(), tracks["y_ref"].to_numpy()], axis=1)
    still = scene.places - tracks["drift"].sel(axis=["x", "y"]).to_numpy()[:, None]
    there = scene.amplitudes != 0
    truth = np.stack([np.median(still[there[:, k] | ~there[:, k].any(), k], axis=0) for k in range(still.shape[1])])
    limits = np.array(scene.shape[::-1]) - border
    inside = ((scene.places > border) & (scene.places < limits)).all(axis=(0, 2))
    distances, nearest = cKDTree(reference).query(truth)
    away, which = np.asarray(distances), np.asarray(nearest, dtype=np.int64)
    false = np.asarray(cKDTree(truth).query(reference)[0]) > tolerance
    known = np.flatnonzero(inside & (away < tolerance))
    errors = places[:, which[known]] - scene.places[:, known]
    absent = ~there[:, known]
    accepted_absent = np.isfinite(errors[absent][:, 0])
    errors[absent] = np.nan
    stated = stated[:, which[known]]
    pulls = errors / stated
    judged = np.isfinite(errors)
    counted = judged & np.isfinite(stated)
    n, mean = counted.sum(axis=0), np.where(counted, errors, 0).sum(axis=0) / np.maximum(counted.sum(axis=0), 1)
    of_mean = np.sqrt(np.where(counted, stated**2, 0).sum(axis=0)) / np.maximum(n, 1)
    deviations = np.where(judged, errors - mean, 0)[:, (n > 1).all(axis=1)]
    pulls = pulls[judged & np.isfinite(pulls)]
    bright, bright_error = _intensities(tracks, scene, known, which[known], unit)
    return Score(
        found=len(known),
        wanted=int(inside.sum()),
        false=int(false.sum()),
        accepted=float(np.isfinite(errors[..., 0]).sum() / max(1, there[:, known].sum())),
        accepted_absent=float(accepted_absent.mean()) if accepted_absent.size else np.nan,
        rmse=float(np.sqrt(np.nanmean(errors**2))) if len(known) else np.nan,
        bias=float(np.sqrt(np.nanmean(np.nanmean(errors, axis=0) ** 2))) if len(known) else np.nan,
        pull=float(np.sqrt((pulls**2).mean())) if pulls.size else np.nan,
        unstated=float(1 - pulls.size / max(1, judged.sum())),
        scatter=float(np.sqrt((deviations**2).sum() / max(1, (n[(n > 1).all(axis=1)] - 1).sum()))),
        bias_in_errors=float(np.sqrt(np.mean((mean / of_mean)[n > 0] ** 2))) if (n > 0).any() else np.nan,
        intensity=bright,
        intensity_in_errors=bright_error,
    )


def _intensities(
    tracks: xr.Dataset, scene: Scene, known: NDArray[np.int64], which: NDArray[np.int64], unit: float
) -> tuple[float, float]:
    """Return the columns' median mean intensity over the true one, and by how many stated errors it is off."""
    true = INTENSITY_SCALE["paper"] * 2 * np.pi * scene.sigma**2 * unit * scene.amplitudes[:, known]
    fits = td.accepted(tracks)
    shares, errors = (
        np.where(true == 0, np.nan, fits[name].transpose("frame", "column_id").to_numpy()[:, which])
        / np.where(true == 0, np.nan, np.abs(true))
        for name in ("intensity", "intensity_stderr")
    )
    judged = np.isfinite(shares) & np.isfinite(errors)
    n = judged.sum(axis=0)
    if not (n > 0).any():
        return np.nan, np.nan
    shares, errors = (np.where(judged, values, 0)[:, n > 0] for values in (shares * np.sign(true), errors))
    n = n[n > 0]
    found = float(np.median(shares.sum(axis=0) / n))
    return found, abs(found - 1) / float(np.median(np.sqrt((errors**2).sum(axis=0)) / n))


@contextmanager
def work_folder() -> Iterator[Path]:
    """Give an empty folder that is removed in the end."""
    with tempfile.TemporaryDirectory(prefix="cases-") as folder:
        yield Path(folder)


class Clock:
    """Wall and processor time of a block, s."""

    def __enter__(self) -> Clock:
        self._wall, self._cpu = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.wall_s, self.cpu_s = time.perf_counter() - self._wall, time.process_time() - self._cpu
