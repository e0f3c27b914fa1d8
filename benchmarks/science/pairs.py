"""Touching columns: simulated pairs, found and fitted together with defaults, against truth and the joint bound."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tract_dask import convert, find_columns, fit_columns, open_movie, sum_image
from tract_dask.kernels.gaussian.information import model_slopes
from tract_dask.kernels.gaussian.intensity import INTENSITY_SCALE
from tract_dask.kernels.gaussian.model import evaluate
from tract_dask.settings import FitSettings
from tract_dask.store.columns import positions

from .tables import Table, with_error

Floats = NDArray[np.float64]

PIXEL_PM, SIGMA, CELL, SIDE, FRAMES = 4.0, 3.0, 40.0, 8, 200
"""Size of a pixel; sigma of the columns and distance of the pairs, px; pairs in a row; frames of a movie."""
PEAK, BACKGROUND, JITTER = 60.0, 20.0, 0.1
"""Counts, and by how much every column wanders, px."""
DISTANCES = (1.6, 2.0, 2.4, 3.0, 4.0)
ALONE: dict[str, dict[str, Any]] = {"`estimator=poisson`": {"estimator": "poisson"}, "`shape=free`": {"shape": "free"}}


class Pairs(NamedTuple):
    """A movie of pairs: (frames, y, x) counts, and (frames, columns, 2) true places as (x, y), pairs side by side."""

    counts: NDArray[np.uint16]
    truth: Floats


def run(data: Path, work: Path) -> list[Table]:
    """Measure all tables; the simulated data of the other sections are not used."""
    rows, alone = [], []
    for distance in DISTANCES:
        made = draw(distance)
        np.save(work / "pairs.npy", made.counts)
        movie = open_movie(convert(work / "pairs.npy", work / f"pairs-{distance}.zarr"))
        columns = find_columns(sum_image(movie))
        rows.append([f"{distance:g}", *_cells(fit_columns(movie, columns, settings=_settings()), made, distance)])
        if distance == 2.4:
            for name, settings in ALONE.items():
                tracks = fit_columns(movie, columns, settings=_settings(**settings))
                alone.append([name, *_cells(tracks, made, distance)])
    head = ["pairs found", "bias of the distance, pm", "sd, pm", "sd / bound", "pull", "intensity, % off", "its pull"]
    about = f"{SIDE**2} pairs, {FRAMES} frames, peaks of {PEAK:g} on {BACKGROUND:g} counts, {PIXEL_PM:g} pm a pixel"
    return [
        Table(f"Pairs of columns of sigma {SIGMA:g} px: {about}.", ["distance, sigma", *head], rows),
        Table("The same at 2.4 sigma with other settings of the fit.", ["setting", *head], alone),
    ]


def draw(distance: float, seed: int = 0) -> Pairs:
    """Return a movie of pairs, each turned by another angle."""
    rng = np.random.default_rng([seed, round(10 * distance)])
    centre = np.stack(np.meshgrid(*2 * [CELL * (1 + np.arange(SIDE))]), axis=-1).reshape(-1, 2)
    turn = rng.uniform(0, np.pi, len(centre))
    half = 0.5 * distance * SIGMA * np.column_stack([np.cos(turn), np.sin(turn)])
    still = np.stack([centre - half, centre + half], axis=1).reshape(-1, 2)
    truth = still + rng.normal(0, JITTER, (FRAMES, *still.shape))
    along = np.arange(int(CELL * (SIDE + 1)))
    counts = np.empty((FRAMES, len(along), len(along)), np.uint16)
    for frame, places in enumerate(truth):
        x, y = (np.exp(-((along - places[:, axis, None]) ** 2) / (2 * SIGMA**2)) for axis in range(2))
        counts[frame] = rng.poisson(BACKGROUND + PEAK * y.T @ x)
    return Pairs(counts, truth)


def bound_px(distance: float, window_px: int) -> float:
    """Return the Cramér-Rao bound of x and y, rms over both axes, of pairs in their discs; shapes are known."""
    pair = np.array([[PEAK, side * distance * SIGMA / 2, 0.0, SIGMA, SIGMA, 0.0, BACKGROUND] for side in (-1, 1)])
    y, x = np.mgrid[-window_px : window_px + 1, -2 * window_px : 2 * window_px + 1].reshape(2, -1).astype(float)
    inside = np.any([np.hypot(x - column[1], y) <= window_px / 2 for column in pair], axis=0)
    x, y = x[inside], y[inside]
    parts = [model_slopes(column, x, y, fixed_shape=True)[1] for column in pair]
    slopes = np.concatenate([parts[0][:3], parts[1][:3], parts[0][3:4]])
    expected = evaluate(pair, x, y).sum(axis=0) - BACKGROUND
    variance = np.linalg.inv((slopes / expected) @ slopes.T).diagonal()
    return float(np.sqrt(variance[[0, 1, 3, 4]].mean()))


def _settings(**changed: Any) -> FitSettings:
    return FitSettings(refine_drift=False, **changed)


def _cells(lazy: xr.Dataset, made: Pairs, distance: float) -> list[str]:
    tracks = lazy.compute()
    still = made.truth.mean(axis=0)
    away, nearest = (np.asarray(values).reshape(-1, 2) for values in cKDTree(positions(tracks)).query(still))
    there = (away < SIGMA / 2).all(axis=1) & (nearest[:, 0] != nearest[:, 1])
    chosen = nearest[there].ravel()
    if not len(chosen):
        return [f"{there.mean():.1%}", *[""] * 6]
    truth = made.truth[:, np.repeat(there, 2)]
    accepted = (tracks["status"].to_numpy() == 0)[:, chosen]
    error = tracks["fit"].sel(parameter=["x", "y"]).to_numpy()[:, chosen] - truth
    error = np.where(accepted[..., None], error, np.nan)
    stated = tracks["stderr"].sel(parameter=["x", "y"]).to_numpy()[:, chosen]
    along = still[1::2][there] - still[::2][there]
    along /= np.hypot(*along.T)[:, None]
    longer = PIXEL_PM * np.einsum("fnk,nk->fn", error[:, 1::2] - error[:, ::2], along)
    volume = INTENSITY_SCALE[tracks.attrs["intensity_scale"]] * 2 * np.pi * PEAK * SIGMA**2
    intensity = np.where(accepted, tracks["intensity"].to_numpy()[:, chosen] - volume, np.nan)
    each = np.nanmean(longer, axis=0)
    return [
        f"{there.mean():.1%}",
        with_error(float(np.nanmean(longer)), float(np.nanstd(each) / np.sqrt(len(each)))),
        f"{PIXEL_PM * np.nanstd(error):.2f}",
        f"{np.nanstd(error) / bound_px(distance, int(tracks.attrs['window_px'])):.3f}",
        f"{np.nanstd(error / stated):.3f}",
        f"{100 * np.nanmean(intensity) / volume:+.2f}",
        f"{np.nanstd(intensity / tracks['intensity_stderr'].to_numpy()[:, chosen]):.3f}",
    ]
