"""Are places, intensities and their errors true at any sampling? ``python -m benchmarks.cases.scenes.sampling``.

One crystal, sampled more and more finely: a column has a sigma of 0.15 of the spacing and as many electrons at each,
and wanders by 0.01 of the spacing by itself while the field drifts. Right: a ratio to the bound near 1, an intensity
of 1, and pulls of 1. At least 2,000 fits a row.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import tract_dask as td
from tract_dask.kernels.gaussian.intensity import INTENSITY_SCALE
from tract_dask.settings import FitSettings
from tract_dask.store.schema import REJECTED

from ..common import Scene, lattice, walk, work_folder
from .bounds import bound

FITS = 2000
ELECTRONS = 12_000.0
"""Height of a column times the spacing squared, counts px^2; the background is a third of the height."""
HEADINGS = (
    *("spacing, px", "sigma, px", "window, px", "blur, px", "fit", "fits", "lost columns", "accepted"),
    *("sd / bound", "pull of x, y", "intensity", "its pull within a column", "pull of means of columns"),
)
WAYS: dict[str, dict[str, Any]] = {"lsq": {}, "lsq, free": {"shape": "free"}, "poisson": {"estimator": "poisson"}}


def scene_of(spacing: float, sigma: float, seed: int = 5) -> tuple[Scene, NDArray[np.int64]]:
    """Return a drifting crystal, and which of its columns (n,) are judged: those a spacing and more from the edge."""
    rng = np.random.default_rng(seed)
    side = int(8 * spacing)
    sites = lattice((side, side), spacing)
    inside = ((sites > spacing + 4) & (sites < side - spacing - 4)).all(axis=1)
    n_frames = int(np.ceil(FITS / inside.sum())) + 1
    own = rng.normal(0, 0.01 * spacing, (n_frames, *sites.shape))
    places = sites + own + walk(n_frames, 0.3, rng, 3.0)[:, None]
    height = ELECTRONS / spacing**2
    return Scene(places, np.full(places.shape[:2], height), sigma, height / 3, (side, side)), np.flatnonzero(inside)


def row(name: str, tracks: xr.Dataset, scene: Scene, judged: NDArray[np.int64], bound_px: float) -> str:
    """Return a line of the table: tracks against the truth."""
    found = (
        tracks["fit"].sel(parameter=["x", "y"]).to_numpy() + tracks["drift"].sel(axis=["x", "y"]).to_numpy()[:, None]
    )
    truth = scene.places[:, judged]
    still = np.median(truth - tracks["drift"].sel(axis=["x", "y"]).to_numpy()[:, None], axis=0)
    away, which = cKDTree(np.stack([tracks["x_ref"], tracks["y_ref"]], axis=1)).query(still)
    lost = int(np.count_nonzero(np.asarray(away) > 2 * scene.sigma))
    good = (tracks["status"].to_numpy()[:, which] & REJECTED) == 0
    errors = (found[:, which] - truth)[good]
    pulls = errors / tracks["stderr"].sel(parameter=["x", "y"]).to_numpy()[:, which][good]
    volume = INTENSITY_SCALE["paper"] * 2 * np.pi * scene.amplitudes[0, 0] * scene.sigma**2
    intensity = np.where(good, tracks["intensity"].to_numpy()[:, which] / volume, np.nan)
    stated = np.where(good, tracks["intensity_stderr"].to_numpy()[:, which] / volume, np.nan)
    of_columns, usual = np.nanmean(intensity, axis=0), np.sqrt(np.nanmean(stated**2))
    of_means = usual * np.sqrt(1 / good.sum(axis=0) + tracks["shape_error"].to_numpy()[which] ** 2)
    of_columns_pull = ((of_columns - of_columns.mean()) / of_means).std()
    return (
        f"| {name} | {good.size} | {lost} | {good.mean():.1%} | {errors.std() / bound_px:.3f}"
        f" | {np.sqrt((pulls**2).mean()):.2f} | {np.nanmean(intensity):.3f}"
        f" | {np.nanstd(intensity - of_columns) / usual:.2f} | {of_columns_pull:.2f} |"
    )


def by_spacing(spacing: float, share: float, folder: Path) -> list[str]:
    """Track a crystal with this spacing in px, in all ways; return a line for each."""
    scene, judged = scene_of(spacing, share * spacing)
    np.save(folder / "movie.npy", scene.counts())
    movie = td.open_movie(td.convert(folder / "movie.npy", folder / "movie.zarr", overwrite=True))
    drift = td.estimate_drift(movie)
    summed = td.sum_image(movie, drift)
    columns = td.find_columns(summed)
    lines = []
    for name, settings in WAYS.items():
        tracks = td.fit_columns(movie, columns, drift, FitSettings(**settings), summed=summed).compute()
        window = int(tracks.attrs["window_px"])
        height = float(scene.amplitudes[0, 0])
        least = bound(height, scene.sigma, height / 3, window)[0]
        label = f"{spacing:g} | {scene.sigma:.2f} | {window} | {tracks.attrs['window_blur_px']:g} | {name}"
        lines.append(row(label, tracks, scene, judged, least))
    return lines


def main() -> None:
    """Print a line for each spacing and each way of fitting."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--spacing", type=float, nargs="*", default=[12.0, 16.0, 20.0, 30.0, 40.0, 60.0, 80.0, 120.0])
    parser.add_argument("--sigma", type=float, default=0.15, help="of a column, as a share of the spacing")
    options = parser.parse_args()
    print(f"| {' | '.join(HEADINGS)} |\n|{'---|' * len(HEADINGS)}")
    for spacing in options.spacing:
        with work_folder() as folder:
            print("\n".join(by_spacing(spacing, options.sigma, folder)), flush=True)


if __name__ == "__main__":
    main()
