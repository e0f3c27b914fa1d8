"""Many columns with known truth in one made movie: still, hopping or absent ones, at a contrast, dose and sampling."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from tract_dask import convert, fit_columns, open_movie, sum_image
from tract_dask.settings import FitSettings, MetadataSettings
from tract_dask.store.camera import Camera
from tract_dask.store.columns import column_dataset

Floats = NDArray[np.float64]

_PIXEL_PM = 8.0
_SPACING = 8.0
"""Distance of neighbours in sigmas."""
_REACH = 5
"""A column is drawn so many sigmas far."""


@dataclass(frozen=True)
class Made:
    """What a made movie shows.

    Attributes
    ----------
    amplitude, background
        Counts of the columns above the crystal's background, and that background.
    sigma_px
        Width of the columns.
    vacuum
        Level of the vacuum beside the crystal, as a share of the background.
    side
        The crystal has so many columns along x and along y.
    psf_px
        Sigma of the spread of an electron over the camera's pixels; their counts are then real numbers.
    """

    amplitude: float
    background: float
    sigma_px: float = 4.0
    vacuum: float = 1.0
    side: int = 14
    psf_px: float = 0.0

    @property
    def n_columns(self) -> int:
        """Columns of the crystal."""
        return self.side**2

    @property
    def _sizes(self) -> tuple[int, int, int]:
        """Spacing, margin beside the crystal and width of the vacuum above it, px."""
        spacing = round(_SPACING * self.sigma_px)
        return spacing, 2 * spacing, max(80, 4 * spacing)

    def sites(self, rng: np.random.Generator) -> Floats:
        """Return the places of the columns, (column, 2), x and y in px."""
        spacing, margin, vacuum = self._sizes
        steps = spacing * np.arange(self.side) + margin
        grid = np.stack(np.meshgrid(steps, steps + vacuum), axis=-1).reshape(-1, 2)
        return np.asarray(grid + rng.uniform(-0.5, 0.5, grid.shape))

    def frame(self, places: Floats, there: NDArray[np.bool_]) -> Floats:
        """Return expected counts of one frame."""
        spacing, margin, vacuum = self._sizes
        width = spacing * (self.side - 1) + 2 * margin
        image = np.full((width + vacuum, width), self.background, np.float64)
        image[:vacuum] *= self.vacuum
        reach = round(_REACH * self.sigma_px)
        for x, y in places[there]:
            left, top = int(x) - reach, int(y) - reach
            box = np.arange(2 * reach + 1)
            across, down = (np.exp(-0.5 * ((box + s - c) / self.sigma_px) ** 2) for s, c in ((left, x), (top, y)))
            image[top : top + box.size, left : left + box.size] += self.amplitude * down[:, None] * across
        return image

    def tracks(
        self,
        work: Path,
        moved_px: Floats,
        there: NDArray[np.bool_] | None = None,
        seed: int = 0,
        camera: Camera | None = None,
        **settings: Any,
    ) -> xr.Dataset:
        """Return the fitted tracks of a movie in which columns move by ``moved_px`` (frame, column, 2: x, y).

        Fits start from the true places and shapes of columns that do not move; ``there`` (frame, column). ``camera``:
        what is known of it.
        """
        rng = np.random.default_rng(seed)
        sites = self.sites(rng)
        if there is None:
            there = np.ones(moved_px.shape[:2], np.bool_)
        movie_path = work / "movie.npy"
        shown = zip(moved_px, there, strict=True)
        counts = np.stack([rng.poisson(self.frame(sites + moved, seen)).astype(np.uint16) for moved, seen in shown])
        if self.psf_px:
            counts = np.stack([gaussian_filter(frame.astype(np.float32), self.psf_px, mode="wrap") for frame in counts])
        np.save(movie_path, counts)
        calibration = MetadataSettings(pixel_size_pm=_PIXEL_PM, frame_time_s=1.0)
        movie = open_movie(convert(movie_path, work / f"movie_{seed}.zarr", metadata=calibration))
        _, _, vacuum = self._sizes
        shape = [self.amplitude, 0, 0, self.sigma_px, self.sigma_px, 0, self.background]
        reference = np.tile(np.array(shape, np.float64), (self.n_columns, 1))
        reference[:, 1:3] = sites
        columns = column_dataset(sites, [""] * self.n_columns, np.arange(1, self.n_columns + 1), reference)
        columns = columns.assign_attrs(blur_sigma_px=0.0)
        box = (8, vacuum - round(3 * self.sigma_px), 8, counts.shape[2] - 8)
        given: dict[str, Any] = {"vacuum_box": box, "refine_drift": False} | settings
        summed = None if camera is None else sum_image(movie).assign_attrs(camera.to_attribute())
        return fit_columns(movie, columns, None, FitSettings(**given), summed=summed).load()
