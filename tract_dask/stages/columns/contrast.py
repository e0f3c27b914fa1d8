"""Whether columns are bright or dark: how well the columns that either gives hold in the summed image."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ...kernels.gaussian.parameters import AMPLITUDE, SIGMA_A, SIGMA_B
from .lattice import TOLERANCE, Lattice
from .relief import Places, Reals, binned, smooth

SIGNS = {"bright": 1, "dark": -1}
"""Of a column's amplitude, by the contrast."""

CLOSE = 0.5
"""Where the other contrast has more than this share of the support, the choice is named as uncertain."""

_LARGE_STEP = 0.5
"""A place counts where the surroundings change by less than this share of the amplitude across a column's distance."""
_BINS_PER_SPACING = 8
_OUTLYING = 4.0
"""No column counts for more than so many times the median."""


def support(
    image: Reals, places: Places, fit: Places, r_squared: Reals, *, spacing: float, lattice: Lattice | None
) -> float:
    """Return how much the fits on the summed image speak for a contrast; 0 where there is none.

    Each counts with the variance that it explains, amplitude squared times width squared times R squared, and with the
    share of the neighbours on the lattice that are there as well. What lies between the columns of the other contrast
    is lower and wider, and a Gaussian is a poor picture of it. The rim of the specimen or of its support is a row of
    peaks without neighbours, higher than any column: places where the surroundings change by half of the amplitude or
    more from one column to the next are left out, and of others none counts for more than four times the median.

    Parameters
    ----------
    image
        The summed image (y, x).
    places
        (n, 2) of x and y, px, of the fits that nothing speaks against.
    fit
        (n, 7) their estimates, in units of the image.
    r_squared
        (n,) the share of its window's variance that each explains.
    spacing
        Distance of neighbouring columns, px.
    lattice
        None: neighbours do not count.
    """
    if not len(places):
        return 0.0
    explained = fit[:, AMPLITUDE] ** 2 * fit[:, SIGMA_A] * fit[:, SIGMA_B] * np.clip(r_squared, 0, 1)
    flat = _steps(image, places, spacing) < _LARGE_STEP * np.abs(fit[:, AMPLITUDE])
    counted = explained * _neighbours(places, lattice) * flat
    return float(np.minimum(counted, _OUTLYING * np.median(explained[flat])).sum()) if flat.any() else 0.0


def _neighbours(places: Places, lattice: Lattice | None) -> Reals:
    """Return the share of the eight lattice sites around each place that have a column."""
    if lattice is None or len(places) < 2:
        return np.ones(len(places))
    sites = places[:, None] + lattice.translations(1)
    away = np.asarray(cKDTree(np.unique(places, axis=0)).query(sites)[0])
    return np.asarray((away < TOLERANCE * lattice.spacing).mean(axis=1))


def _steps(image: Reals, places: Places, spacing: float) -> Reals:
    """Return by how much the surroundings of each place change across half a spacing in any direction."""
    step = max(1, int(spacing / _BINS_PER_SPACING))
    slow = smooth(binned(image, step).astype(np.float32), spacing / 2 / step)
    reach = max(1, round(spacing / 2 / step))
    x, y = np.rint((places.T + 0.5) / step - 0.5).astype(np.int64)
    rows, columns = slow.shape
    around = [
        slow[np.clip(y + dy * reach, 0, rows - 1), np.clip(x + dx * reach, 0, columns - 1)]
        for dy, dx in ((0, -1), (0, 1), (-1, 0), (1, 0))
    ]
    left, right, above, below = around
    return np.asarray(np.hypot(right - left, below - above), dtype=np.float64)


def chosen(supports: dict[str, float]) -> tuple[str, float]:
    """Return the contrast with the most support, and the share of it that the other one has.

    Examples
    --------
    >>> chosen({"bright": 2.0, "dark": 40.0})
    ('dark', 0.05)
    """
    first, second = sorted(supports, key=lambda name: -supports[name])
    return first, supports[second] / supports[first] if supports[first] else 1.0
