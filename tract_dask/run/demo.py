"""The demonstration: a movie with known truth, the whole run on it, and how far the tracks are from the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ..progress import Event, RunStarted, Sink, silent, tee
from ..settings.run import RunSettings
from ..simulate.movie import simulate_movie
from ..store import datasets
from ..store.results import accepted, open_results
from . import pipeline

BORDER_PX = 30.0
"""Columns at least this far inside frame 0 have to be found."""


def run_demo(
    folder: str | Path, n_frames: int = 60, settings: RunSettings | None = None, *, on_event: Sink = silent
) -> dict[str, Any]:
    """Simulate a movie of ceria in ``folder``, run everything on it, and return a table that is ready for JSON.

    Parameters
    ----------
    folder
        Gets ``movie.tif``, ``truth.zarr`` and ``out`` (what a run writes); an earlier demonstration is replaced.
    n_frames
        Length of the movie.
    settings
        Of the run; None: the defaults.
    on_event
        Takes the run's progress.

    Returns
    -------
    dict
        Names with their units, and numbers: columns, frames, fits, accepted fits, errors against the truth (see
        :func:`compare`), throughput, the dashboard's link, and the paths of the outputs.
    """
    folder = Path(folder)
    movie = folder / "movie.tif"
    truth = simulate_movie(movie, n_frames=n_frames)
    datasets.write_dataset(truth, folder / "truth.zarr")

    dashboard = ""

    def note_dashboard(event: Event) -> None:
        nonlocal dashboard
        if isinstance(event, RunStarted):
            dashboard = event.dashboard or dashboard

    outcome = pipeline.run(movie, folder / "out", settings, on_event=tee((note_dashboard, on_event)), overwrite=True)
    seconds = sum(outcome.seconds.values())
    return {
        "columns found": outcome.columns,
        "frames": outcome.frames,
        "fits": outcome.fits,
        "accepted": outcome.accepted,
        **compare(open_results(outcome.outputs.results).load(), truth),
        "fits/s": round(outcome.fits / outcome.seconds["fit"]),
        "MB/s, all stages": round(movie.stat().st_size / seconds / 1e6, 1),
        "dashboard": dashboard,
        "source": str(movie),
        "truth": str(folder / "truth.zarr"),
        **outcome.outputs.paths(),
    }


def compare(results: xr.Dataset, truth: xr.Dataset) -> dict[str, Any]:
    """Return how far ``results`` are from the truth that :func:`tract_dask.simulate_movie` returned.

    Every found column is paired with the nearest true one. The position error is the standard deviation per axis of the
    position in the frame (drift included) minus the truth, over the accepted fits of the static cerium columns that lie
    at least :data:`BORDER_PX` inside frame 0; the drift error is that of drift minus true drift over the frames.
    """
    pixel_pm = truth.attrs["pixel_size_pm"]
    true_drift = truth["drift"].to_numpy()
    drift = results["drift"].to_numpy()
    offset = np.median(true_drift - drift, axis=0)  # the truth counts from frame 0, the results from a frame of theirs
    true_place = np.stack([truth["x"][0], truth["y"][0]], axis=-1) + offset[::-1]
    place = np.stack([results["x_ref"], results["y_ref"]], axis=-1)
    pair = np.linalg.norm(place[:, None] - true_place[None], axis=-1).argmin(axis=1)

    last = np.array(truth.attrs["shape"][::-1]) - 1
    inner = ((true_place >= BORDER_PX) & (true_place <= last - BORDER_PX)).all(axis=1)
    cerium, role = truth["kind"].to_numpy() == "Ce", truth["role"].to_numpy()

    fit = accepted(results)["fit"]
    static = (cerium & inner & (role == "static"))[pair]
    error_pm = {}
    for k, axis in ((1, "x"), (0, "y")):
        raw = fit.sel(parameter=axis).to_numpy() + drift[:, k, None]
        error_pm[axis] = float(np.nanstd((raw - truth[axis].to_numpy()[:, pair])[:, static])) * pixel_pm
    drift_error = np.std(drift - true_drift, axis=0) * pixel_pm

    gone = truth["atoms"].to_numpy()[:, pair] == 0
    trusted = np.isfinite(fit.sel(parameter="x").to_numpy())
    wanted = np.flatnonzero(cerium & inner)
    return {
        "cerium columns found": f"{np.isin(wanted, pair).sum()} of {wanted.size}",
        "oxygen taken for cerium": int((~cerium[pair]).sum()),
        "position error x, pm": round(error_pm["x"], 2),
        "position error y, pm": round(error_pm["y"], 2),
        "drift error x, pm": round(float(drift_error[1]), 2),
        "drift error y, pm": round(float(drift_error[0]), 2),
        "absences noticed": f"{(gone & ~trusted).sum()} of {gone.sum()} frames",
    }
