"""An image in which columns stand out of their surroundings, whatever edges these have; and what it is made with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts load on use: workers need few of them
from numpy.typing import NDArray

from ...kernels.peaks import box_means
from ...kernels.windows import blur

Reals = NDArray[np.floating[Any]]
Places = NDArray[np.float64]
"""(n, 2) rows of (x, y), px."""
Mask = NDArray[np.bool_]

_PX_PER_SPACING = 24
"""Pixels on which the distance between columns is seen: peaks are looked for in an image binned so far."""
_BINS_PER_SPACING = 8
"""Whether there are ridges is seen on so many."""
_OF_COLUMNS, _HIGH, _SURE = 0.98, 0.15, 4.0
"""Quantile of the heights that columns have; ridges matter from this share of it on (a lattice of columns alone has up
to 0.1), and from four times the noise."""
_COARSE = 16
"""Smoothing by so many px or more is done on bins of a sixteenth of it."""
_SAMPLE = 1 << 20
"""Of more values than these, statistics are taken from a sample."""


@dataclass(frozen=True)
class Relief:
    """An image in which columns stand out, of bins of ``step`` x ``step`` px; places are in px all the same.

    Attributes
    ----------
    height
        (y, x); columns bright, their surroundings about zero.
    valid
        (y, x) where the image has been exposed.
    noise
        Standard deviation of ``height`` where there is nothing.
    """

    height: Reals
    valid: Mask
    noise: float
    step: int

    def bins(self, places: Places) -> Places:
        """Return places (x, y) in px as places in bins."""
        return np.asarray((places + 0.5) / self.step - 0.5)

    def px(self, places: Places) -> Places:
        """Return places (x, y) in bins as places in px."""
        return np.asarray((places + 0.5) * self.step - 0.5)


def relief(
    image: Reals, valid: Mask, noise: float, spacing: float, blur_sigma_px: float | None, precision_px: float = np.inf
) -> Relief:
    """Return the image in which columns ``spacing`` px apart stand out.

    Binned to 24 px a spacing, but to no more than ``precision_px``; blurred to 0.08 of the spacing (a column is about
    twice as wide), or ``blur_sigma_px`` where that is more; less the surroundings over a third of it. Where edges of
    the surroundings, as the rim of the specimen, leave ridges of 0.15 of the columns' height, these go as well.
    """
    step = max(1, int(min(spacing / _PX_PER_SPACING, precision_px)))
    sigma = max(blur_sigma_px or 0.0, 0.08 * spacing) / step
    fine = blur(binned(image, step).astype(np.float32), sigma)
    height = (fine - smooth(fine, spacing / 3 / step)).astype(np.float32)
    noise *= damping(sigma) / step
    if _has_ridges(fine, height, noise, spacing / step):
        height -= _ridges(fine, spacing / step)
    return Relief(height, binned(valid, step) == 1, noise, step)


def _ridges(image: Reals, spacing: float) -> NDArray[np.float32]:
    """Return what an image less its smoothed surroundings has of edges: a ridge beside each of them, and a ditch.

    An opening takes away what is bright and narrower than its square, as columns are, and leaves edges where they are
    (J. Serra, Image Analysis and Mathematical Morphology, 1982).
    """
    side = 2 * round(spacing / 2) + 1
    surroundings = scipy.ndimage.grey_opening(image, size=(side, side))
    return np.asarray(surroundings - smooth(surroundings, spacing / 3), dtype=np.float32)


def _has_ridges(image: Reals, height: Reals, noise: float, spacing: float) -> bool:
    """Tell whether ridges matter beside columns, from bins of an image and of its heights."""
    bins = max(1, int(spacing / _BINS_PER_SPACING))
    if min(image.shape) < 2 * bins:
        return False
    ridges = _ridges(binned(image, bins).astype(np.float32), spacing / bins)
    columns = np.quantile(sample((binned(height, bins) - ridges).ravel()), _OF_COLUMNS)
    return bool(ridges.max() > max(_HIGH * columns, _SURE * noise))


def binned(image: Reals | Mask, step: int) -> Places:
    """Return the means of blocks of ``step`` pixels, without the rest at the right and the bottom."""
    ny, nx = (size // step for size in image.shape)
    rows = image[: ny * step, : nx * step].reshape(ny, step, nx * step).mean(axis=1, dtype=np.float64)
    return np.asarray(rows.reshape(ny, nx, step).mean(axis=2))


def expanded(bins: Reals, shape: tuple[int, int], step: int, first: tuple[float, float]) -> Reals:
    """Return ``bins`` on pixels, interpolated linearly; a product with two matrices of weights.

    Parameters
    ----------
    shape
        (y, x) of the result.
    step
        Pixels from one bin to the next.
    first
        Pixel (y, x) on which bin 0 lies. Beyond the bins their edge goes on.
    """
    bins = bins.astype(np.float32)
    down, across = (
        np.maximum(0.0, 1.0 - np.abs(np.clip((np.arange(n)[:, None] - start) / step, 0, m - 1) - np.arange(m)))
        for n, m, start in zip(shape, bins.shape, first, strict=True)
    )
    return np.asarray(down.astype(np.float32) @ bins @ across.T.astype(np.float32))


def sample(values: Reals) -> Reals:
    """Return about a million of the values, evenly spaced, where there are more."""
    return values[:: max(1, len(values) // _SAMPLE)]


def smooth(image: Reals, sigma: float) -> Reals:
    """Return ``image`` smoothed by about a Gaussian of ``sigma`` px, three passes of a box; a wide one on bins."""
    step = coarseness(sigma)
    radius = round((np.sqrt(4 * (sigma / step) ** 2 + 1) - 1) / 2)
    bins = image if step == 1 else binned(image, step)
    for _ in range(3):
        bins = box_means(bins, radius)
    return bins if step == 1 else expanded(bins, image.shape, step, ((step - 1) / 2, (step - 1) / 2))


def coarseness(sigma: float) -> int:
    """Return how far an image may be binned before it is smoothed by ``sigma`` px."""
    return max(1, int(sigma / _COARSE))


def pixel_noise(image: Reals, valid: Mask) -> float:
    """Return the standard deviation of the white noise of an image, from its second differences (Immerkær 1996).

    Of a large image some rows are taken.
    """
    ny, nx = image.shape
    rows = np.arange(1, ny - 1, max(1, ny * nx // _SAMPLE))
    bend = image[rows - 1] - 2 * image[rows] + image[rows + 1]
    bend = np.abs(bend[:, :-2] - 2 * bend[:, 1:-1] + bend[:, 2:]) / 6
    return float(np.median(bend[valid[rows, 1:-1]]) / 0.6745)


def damping(sigma: float) -> float:
    """Return the share of white noise's standard deviation that a Gaussian blur of ``sigma`` px leaves."""
    return min(1.0, 1 / (2 * np.sqrt(np.pi) * sigma)) if sigma > 0 else 1.0
