"""How far a background that rises draws columns up the slope, and by how much their places are put back.

Equation 1 has one background for a window. Where the true one rises by g counts a pixel, as on a wedge, least squares
puts a column of height A and width sigma, in a disc of radius R, farther up by

    g sigma^2 / A  *  4 (1 - (1 + u) exp(-u)) / (1 - (1 + 2 u) exp(-2 u)),    u = R^2 / (2 sigma^2)

(the slope's projection onto the derivative by the place; the other parameters are even and do not change). The slope is
that of a plane through the backgrounds of a column and of those around it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, X, Y
from .relief import expanded

Floats = NDArray[np.float64]

_AROUND = 19
"""Columns that a plane goes through: two shells of a hexagonal lattice."""
_FEWEST = 9
_SURE = 5.0
"""A slope counts where it is so many times its error, which is that of the backgrounds' scatter about the plane."""


def background_slopes(places: Floats, background: Floats) -> Floats:
    """Return how the background rises at each column, (columns, 2) along x and y, counts / px; 0 where not sure.

    Parameters
    ----------
    places, background
        (columns, 2) x and y in px, and (columns,); columns of which one is not finite do not count.
    """
    slopes = np.zeros(places.shape)
    known = np.flatnonzero(np.isfinite(places).all(axis=1) & np.isfinite(background))
    if len(known) < _FEWEST:
        return slopes
    plane, doubt = _planes(places[known], background[known], places[known])
    found = plane[:, 1:]
    chance = np.einsum("ni,nij,nj->n", found, np.linalg.pinv(doubt, hermitian=True), found)
    slopes[known] = np.where((chance > _SURE**2)[:, None], found, 0)
    return slopes


def _planes(places: Floats, level: Floats, at: Floats) -> tuple[Floats, Floats]:
    """Return planes through the levels of the nearest columns: level and slopes (n, 3) at places ``at`` (n, 2).

    The second is the covariance of the slopes (n, 2, 2).
    """
    from scipy.spatial import cKDTree  # takes its time, and workers hardly need it

    _, nearest = cKDTree(places).query(at, k=min(_AROUND, len(places)))
    around = np.asarray(nearest, np.int64)
    offsets = places[around] - at[:, None]
    unit = float(np.sqrt(np.square(offsets).mean())) or 1.0
    offsets /= unit
    design = np.concatenate([np.ones((*offsets.shape[:2], 1)), offsets], axis=2)
    inverse = np.linalg.pinv(np.einsum("nki,nkj->nij", design, design), rcond=1e-6, hermitian=True)
    plane = np.einsum("nij,nkj,nk->ni", inverse, design, level[around])
    left = level[around] - np.einsum("nki,ni->nk", design, plane)
    scatter = np.square(left).sum(axis=1) / (design.shape[1] - 3)
    return plane / [1, unit, unit], inverse[:, 1:, 1:] * scatter[:, None, None] / unit**2


def without_slopes(image: Floats, fit: Floats, spacing: float) -> Floats:
    """Return an image (y, x) less the level of a background that rises; the image itself where that is not sure.

    The level is that of planes through the backgrounds of the nearest columns, every half ``spacing`` (px), and linear
    between. ``fit`` (columns, 7) as in :func:`drawn_by_slopes`.
    """
    if not background_slopes(fit[:, [X, Y]], fit[:, BACKGROUND]).any():
        return image
    known = fit[np.isfinite(fit[:, [X, Y, BACKGROUND]]).all(axis=1)]
    step = max(1, int(spacing / 2))
    rows, columns = (np.arange(0, side + step, step, dtype=np.float64) for side in image.shape)
    nodes = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    level = _planes(known[:, [X, Y]], known[:, BACKGROUND], nodes)[0][:, 0].reshape(len(rows), len(columns))
    return np.asarray(image - expanded(level, image.shape, step, (0.0, 0.0)))


def drawn_by_slopes(fit: Floats, window_px: int) -> Floats:
    """Return how far sloping backgrounds draw columns, (columns, 2) along x and y, px.

    Parameters
    ----------
    fit
        (columns, 7) fits of Equation 1 to windows, each column alone; NaN where there is none.
    window_px
        Diameter of the windows.
    """
    slopes = background_slopes(fit[:, [X, Y]], fit[:, BACKGROUND])
    variance = np.where(slopes.any(axis=1), fit[:, SIGMA_A] * fit[:, SIGMA_B], 1.0)
    u = window_px**2 / (8 * variance)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = 4 * (1 - (1 + u) * np.exp(-u)) / (1 - (1 + 2 * u) * np.exp(-2 * u))
        shift = slopes * (variance * share / fit[:, AMPLITUDE])[:, None]
    return np.where(np.isfinite(shift), shift, 0)
