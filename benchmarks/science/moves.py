"""Crystals that turn, columns that hop, scanned rows that are displaced: against truth and the bounds of errors."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from tract_dask import convert, fit_columns, open_movie
from tract_dask.analysis.jumps import change_points
from tract_dask.kernels import linear_motion
from tract_dask.settings import FitSettings
from tract_dask.store.columns import column_dataset
from tract_dask.store.schema import is_accepted

from .tables import Table

Floats = NDArray[np.float64]

PIXEL_PM = 10.0
PEAK, BACKGROUND = 80.0, 20.0
SPACING, SIGMA, HOPPING_SPACING = 7.0, 3.0, 10.5
"""Distance of columns in their sigmas; sigma where it is not said, px; distance of columns that hop."""
MARGIN = 4.0
"""Sigmas from the columns to the edges, at least."""
TURN = np.array([[0.97, 0.24], [-0.24, 0.97]])
JITTER_PM, FRAMES, SIDE = 13.0, 8, 256
"""Standard deviation of rows' offsets; frames of a scanned movie, and their side, px."""
SPACING_PM, ERROR_PM, DRAWS = 320.0, 4.8, 4000
"""Of the crystal of 10 x 10 columns that turns."""
HOPS_PM, HOPPING_FRAMES = (60.0, 100.0, 140.0), 40


class Movie(NamedTuple):
    """(frames, y, x) counts, (columns, 7) of Equation 1 as a sum of many frames shows them."""

    counts: NDArray[np.uint16]
    columns: Floats


def run(data: Path, work: Path) -> list[Table]:
    """Measure all tables; the simulated data of the other sections are not used."""
    return [turning(), hopping(work), scanned(work)]


def turning() -> Table:
    """Return how well rotation and magnification of a frame are known."""
    places = SPACING_PM * (np.stack(np.meshgrid(*2 * [np.arange(10.0)]), axis=-1).reshape(-1, 2) - 4.5)
    bound, rng, rows = ERROR_PM / np.sqrt((places**2).sum()), np.random.default_rng(11), []
    for degrees, growth in ((0.0, 0.0), (0.5, 0.005), (3.0, 0.03)):
        true = np.array([np.deg2rad(degrees), growth, 0.0, 0.0])
        away = linear_motion.moved(places, true) - places
        found, stated = linear_motion.estimate(
            away + rng.normal(0, ERROR_PM, (DRAWS, *places.shape)), places, np.ones((DRAWS, len(places)))
        )
        sd, bias = found[:, :2].std(axis=0), found[:, :2].mean(axis=0) - true[:2]
        cells = [f"{np.rad2deg(sd[0]):.4f}", f"{sd[0] / bound:.2f}", f"{bias[0] / sd[0]:+.2f}"]
        cells += [f"{sd[1]:.2e}", f"{sd[1] / bound:.2f}", f"{bias[1] / sd[1]:+.2f}"]
        pull = ((found[:, :2] - true[:2]) / stated[:, :2]).std()
        rows.append([f"{degrees:g}°, {growth:.1%}", *cells, f"{pull:.2f}"])
    head = ["rotation, sd, °", "/ bound", "bias / sd", "magnification, sd", "/ bound", "bias / sd", "pull"]
    about = f"10 x 10 columns, {SPACING_PM:g} pm apart, errors of {ERROR_PM:g} pm an axis, {DRAWS:,} frames"
    return Table(f"A crystal that turns and grows: {about}.", ["rotation, magnification", *head], rows)


def hopping(work: Path) -> Table:
    """Return how well columns are followed that hop between two places, and whether the hops are jumps."""
    rows = []
    for hop in HOPS_PM:
        rng, columns = np.random.default_rng(round(hop)), crystal(SIGMA, HOPPING_SPACING)
        hops = rng.random((HOPPING_FRAMES, len(columns))) < 0.08
        hops[0], hops[:, ::3] = False, False
        away = (np.cumsum(hops, axis=0) % 2 == 1)[..., None] * hop / PIXEL_PM
        angle = rng.uniform(0, 2 * np.pi, len(columns))
        shift = away * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        movie = drawn(columns, np.zeros((HOPPING_FRAMES, SIDE)), shift, rng)
        tracks = fitted(movie, work / f"hops-{hop:g}")
        good = np.asarray(is_accepted(tracks["status"].to_numpy()))
        error = PIXEL_PM * (tracks["fit"].sel(parameter=["x", "y"]).to_numpy() - columns[:, 1:3] - shift)
        right = good & (np.hypot(error[..., 0], error[..., 1]) < 30)
        out, still = away[..., 0] > 0, ~hops.any(axis=0)
        jumps = change_points(tracks, 0.99)
        named = {*zip(jumps["frame"].values.tolist(), (jumps["column_id"].values - 1).tolist(), strict=True)}
        long = [
            (f, c) for f, c in np.argwhere(hops).tolist() if not hops[f - 1 : f, c].any() and f < HOPPING_FRAMES - 1
        ]
        long = [(f, c) for f, c in long if not hops[f + 1, c]]
        cells = [
            f"{int(right[out].sum()):,} of {int(out.sum()):,}",
            f"{error[right & out].std() / error[:, still].std():.2f}",
        ]
        false = [one for one in named if not hops[max(0, one[0] - 1) : one[0] + 2, one[1]].any()]
        cells += [f"{sum(one in named for one in long):,} of {len(long):,}", f"{len(false)}"]
        rows.append([f"{hop:g}", *cells])
    head = ["frames away: followed", "their sd / sd of columns at rest", "hops that `jumps` finds", "false jumps"]
    about = f"sigma {SIGMA:g} px, {PIXEL_PM:g} pm a pixel, {HOPPING_FRAMES} frames; two frames or more at a place"
    return Table(f"Columns that hop to a free place and back: {about}.", ["hop, pm", *head], rows)


def scanned(work: Path) -> Table:
    """Return how well offsets of rows are known from half of the columns, and what is left of them in positions."""
    rows = []
    for sigma in (1.5, 3.0, 5.0):
        rng, columns = np.random.default_rng(round(10 * sigma)), crystal(sigma)
        offset = rng.normal(0, JITTER_PM / PIXEL_PM, (FRAMES, SIDE))
        movie = drawn(columns, offset, np.zeros((FRAMES, len(columns), 2)), rng)
        half = fitted(movie._replace(columns=movie.columns[::2]), work / f"half-{sigma:g}", scan_rows="sum")
        bound = np.array([1 / np.sqrt(told(columns, own)) for own in offset])
        known = bound < 0.5 * JITTER_PM / PIXEL_PM
        error = half["row_offset"].to_numpy() - offset
        error -= np.average(error, axis=1, weights=known / bound**2)[:, None]
        pull = (error / half["row_offset_stderr"].to_numpy())[known].std()
        usual, freed = (fitted(movie, work / f"{name}-{sigma:g}", scan_rows=name) for name in ("off", "sum"))
        away = [_away(tracks, columns) for tracks in (usual, freed)]
        stated = PIXEL_PM * freed["stderr"].sel(parameter="x").to_numpy()
        cells = [f"{PIXEL_PM * np.sqrt((error[known] ** 2).mean()):.2f}"]
        cells += [f"{np.sqrt((error[known] ** 2).mean() / (bound[known] ** 2).mean()):.2f}", f"{pull:.2f}"]
        cells += [f"{np.nanstd(away[0]):.2f}", f"{np.nanstd(away[1]):.2f}", f"{np.nanstd(away[1] / stated):.2f}"]
        rows.append([f"{sigma:g}", *cells])
    head = ["offsets of rows: error, pm", "/ bound", "pull", "x of columns: sd, pm", "with `scan_rows`, pm", "pull"]
    about = f"independent offsets of {JITTER_PM:g} pm, {FRAMES} frames; offsets are from half of the columns"
    return Table(f"Scanned frames whose rows are displaced: {about}.", ["sigma, px", *head], rows)


def crystal(sigma: float, spacing: float = SPACING) -> Floats:
    """Return columns on a turned lattice, so that they meet all rows: (n, 7) of Equation 1."""
    step = spacing * sigma * np.arange(-40.0, 40.0)
    place = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2) @ TURN + SIDE / 2
    place = place[((place > MARGIN * sigma) & (place < SIDE - MARGIN * sigma)).all(axis=1)]
    columns = np.tile([PEAK, 0.0, 0.0, sigma, sigma, 0.0, BACKGROUND], (len(place), 1))
    columns[:, 1:3] = place
    return columns


def drawn(columns: Floats, offset: Floats, shift: Floats, rng: np.random.Generator) -> Movie:
    """Return frames of columns that are away by ``shift`` (frames, columns, 2), whose rows have offsets."""
    counts = np.empty((len(offset), SIDE, SIDE), np.uint16)
    for frame, (own, away) in enumerate(zip(offset, shift, strict=True)):
        moved = columns.copy()
        moved[:, 1:3] += away
        counts[frame] = rng.poisson(BACKGROUND + seen(moved, own)[0])
    wide = np.hypot(columns[:, 3], offset.std())
    summed = columns.copy()
    summed[:, 0], summed[:, 3] = PEAK * columns[:, 3] / wide, wide
    return Movie(counts, summed)


def seen(columns: Floats, offset: Floats) -> tuple[Floats, Floats]:
    """Return what columns add to a frame whose rows are displaced, and its slope along x."""
    image, slope, along = np.zeros((SIDE, SIDE)), np.zeros((SIDE, SIDE)), np.arange(SIDE)
    for _, x, y, sigma, *_ in columns:
        rows = slice(max(0, int(y - 6 * sigma)), int(y + 6 * sigma) + 1)
        dx = along - x - offset[rows, None]
        height = PEAK * np.exp(-(dx**2 + (along[rows, None] - y) ** 2) / (2 * sigma**2))
        image[rows] += height
        slope[rows] += height * dx / sigma**2
    return image, slope


def told(columns: Floats, offset: Floats) -> Floats:
    """Return the information of half of the columns on each row's offset, 1/px^2."""
    slope, image = seen(columns[::2], offset)[1], seen(columns, offset)[0]
    return np.asarray((slope**2 / (BACKGROUND + image)).sum(axis=1)) + 1e-12


def fitted(movie: Movie, folder: Path, scan_rows: str = "off") -> xr.Dataset:
    """Return the tracks of given columns, in memory."""
    folder.mkdir()
    np.save(folder / "movie.npy", movie.counts)
    opened = open_movie(convert(folder / "movie.npy", folder / "movie.zarr"))
    places, number = movie.columns[:, 1:3], np.arange(1, len(movie.columns) + 1)
    columns = column_dataset(places, [""] * len(places), number, movie.columns).assign_attrs(blur_sigma_px=0.0)
    tracks = fit_columns(opened, columns, settings=FitSettings(refine_drift=False, scan_rows=scan_rows))
    return tracks.compute().assign_attrs(pixel_size_pm=PIXEL_PM)


def _away(tracks: xr.Dataset, columns: Floats) -> Floats:
    """Return how far columns are from their places along x, less what a frame shares, pm."""
    away = PIXEL_PM * (tracks["fit"].sel(parameter="x").to_numpy() - columns[:, 1])
    away = np.where(np.asarray(is_accepted(tracks["status"].to_numpy())), away, np.nan)
    return np.asarray(away - np.nanmean(away, axis=1, keepdims=True))
