"""The simulated data, tracked: movies of a CeO2 surface along [110], and which of their columns is which.

The folder holds TIFFs of 4 pm a pixel and 40 frames:

- ``static_soft_counts_DDDDeA2_u8.tif``, pure counting noise on columns that keep still, at DDDD e/A^2 a frame and half
  the contrast of the simulation; ``static_noisefree.tif``, the same scene without noise and at full contrast; and
  ``static_truth.npz`` (``ce``: id, x, y, number of atoms, layer below the surface);
- ``movie_counts_DDDDeA2_u8.tif`` and ``movie_soft_counts_DDDDeA2_u8.tif``, which drift, and in which columns move,
  vanish and appear; ``movie_truth.npz`` (``ids``; ``xy`` and ``n_ce`` (frame, column); ``disp_pm``);
- ``lut_noisefree_n1to12.tif`` and ``lut_soft_noisefree_n1to12.tif``, where all columns of page k have k + 1 atoms, and
  ``lut_truth.npz`` (``ce``: (page, column, (id, x, y, ...))).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import xarray as xr
from numpy.typing import NDArray

import tract_dask as td
from tract_dask.analysis.lookup import look_up_table
from tract_dask.settings import FitSettings, MetadataSettings
from tract_dask.store.columns import column_dataset, positions
from tract_dask.store.movie import Movie

Floats = NDArray[np.float64]

PIXEL_PM, FRAME_TIME_S, N_FRAMES = 4.0, 0.1, 40
CONTRASTS = ("full", "soft")
_MARGIN_PX = 30
"""Columns nearer to the edge of the field are not compared."""
_SAME_PX = 6.0
"""A found column within this distance of a true one is that column."""
_BELOW = 2
"""Layers from this one on are below the surface."""


@dataclass(frozen=True)
class Scene:
    """A movie, tracked as far as its columns; ``drift`` is None where the field keeps still."""

    movie: Movie
    drift: xr.Dataset | None

    @cached_property
    def summed(self) -> xr.Dataset:
        """The drift-corrected sum."""
        return td.sum_image(self.movie, self.drift)

    @cached_property
    def columns(self) -> xr.Dataset:
        """The columns, found by themselves."""
        return td.find_columns(self.summed)

    def fit(self, **settings: Any) -> xr.Dataset:
        """Return the tracks, in memory."""
        tracks: xr.Dataset = td.fit_columns(
            self.movie, self.columns, self.drift, FitSettings(**settings), summed=self.summed
        ).compute()
        return tracks


def open_scene(data: Path, work: Path, name: str, *, drifts: bool) -> Scene:
    """Return the scene of a file whose name says its dose, NAME_DDDDeA2_u8.tif, converted into ``work``."""
    return _converted(data / f"{name}eA2_u8.tif", work / f"{name}.zarr", float(name[-4:]), drifts=drifts)


def still_scene(data: Path, work: Path, contrast: str, dose: int) -> Scene:
    """Return the scene whose columns keep still; at full contrast its counts are drawn here."""
    if contrast == "soft":
        return open_scene(data, work, f"static_soft_counts_{dose:04d}", drifts=False)
    image = tifffile.imread(data / "static_noisefree.tif")
    expected = np.broadcast_to(image * dose * (PIXEL_PM / 100) ** 2, (N_FRAMES, *image.shape))
    counts = work / f"static_counts_{dose:04d}.npy"
    np.save(counts, np.random.default_rng(dose).poisson(expected).astype(np.uint16))
    return _converted(counts, counts.with_suffix(".zarr"), float(dose), drifts=False)


def still_columns(data: Path, scene: Scene) -> xr.Dataset:
    """Return the truth of the scene's columns that can be compared, ``atoms`` and ``below`` over column_id.

    ``below`` says whether the column is below the surface, as those of Supplementary Table 2 of the paper.
    """
    truth = np.load(data / "static_truth.npz")["ce"]
    found, which = _matched(positions(scene.columns), truth[:, 1:3], scene.movie.shape[1:])
    return xr.Dataset(
        {"atoms": ("column_id", truth[which, 3].astype(int)), "below": ("column_id", truth[which, 4] >= _BELOW)},
        {"column_id": scene.columns["column_id"].to_numpy()[found]},
    )


def moving_columns(data: Path, tracks: xr.Dataset) -> dict[int, int]:
    """Return which column of the truth each found column is, by its median place in the frames: {truth's ID: ours}."""
    truth = np.load(data / "movie_truth.npz")
    raw = (
        tracks["fit"].sel(parameter=["x", "y"]) + tracks["drift"].sel(axis=["x", "y"]).to_numpy()[:, None]
    ).to_numpy()
    away = np.hypot(*np.moveaxis(np.nanmedian(raw[:, :, None] - truth["xy"][:, None], axis=0), -1, 0))
    nearest = np.nanargmin(away, axis=0)
    return {
        int(name): int(tracks["column_id"][k])
        for j, (name, k) in enumerate(zip(truth["ids"], nearest, strict=True))
        if away[k, j] < _SAME_PX
    }


def table_of(data: Path, contrast: str, **settings: Any) -> xr.Dataset:
    """Return the look-up table of one contrast, measured with the settings of the fit."""
    images = tifffile.imread(data / f"lut_{'soft_' if contrast == 'soft' else ''}noisefree_n1to12.tif")
    sites = np.load(data / "lut_truth.npz")["ce"][0]
    seeds = column_dataset(sites[:, 1:3], "Ce", sites[:, 0].astype(int))
    return look_up_table(images, seeds, FitSettings(**settings), pixel_size_pm=PIXEL_PM)


def _converted(source: Path, store: Path, dose: float, *, drifts: bool) -> Scene:
    about = MetadataSettings(pixel_size_pm=PIXEL_PM, frame_time_s=FRAME_TIME_S, dose=dose)
    td.convert(source, store, metadata=about, overwrite=True)
    movie = td.open_movie(store)
    return Scene(movie, td.estimate_drift(movie) if drifts else None)


def _matched(found: Floats, true: Floats, shape: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the numbers of the found columns well inside the field, and of the true ones that they are."""
    away = np.hypot(*np.moveaxis(found[:, None] - true, -1, 0))
    nearest = away.argmin(axis=1)
    inside = ((found >= _MARGIN_PX) & (found < np.array(shape[::-1]) - _MARGIN_PX)).all(axis=1)
    known = np.flatnonzero(inside & (away.min(axis=1) < _SAME_PX))
    return known, nearest[known]
