"""What a fit loses with pixels that its window misses: by how much its errors grow.

The covariance of an estimate is H^-1 B H^-1, with H the sum over the pixels of their slopes' products, each times the
pixel's weight, and B the same with the pixel's noise: the variance m_k for counts, and 1 for even noise. Least squares
has weights 1, maximum likelihood of counts has weights 1 / m_k. The sums are taken over all pixels of the round window,
and over those that are there; what the errors grow by is the ratio of both.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .information import model_slopes
from .parameters import AMPLITUDE, BACKGROUND, PARAMETERS, X, Y

Floats = NDArray[np.float64]

_FREE = (X, Y, AMPLITUDE, BACKGROUND)
"""What the first four slopes are by."""

_DARKEST = 0.05
"""Expected counts are at least this share of the largest: a fit may end with a background below zero."""


def widening(
    parameters: Floats, there: NDArray[np.bool_], *, fixed_shape: bool, counting: bool, likelihood: bool
) -> tuple[Floats, Floats]:
    """Return by how much standard errors grow with the pixels that are missing.

    Parameters
    ----------
    parameters
        (n, 7) of Equation 1, x and y in px from the centre of the window's first pixel.
    there
        (n, side, side) pixels that are known.
    fixed_shape
        Whether sigma_a, sigma_b and theta are known.
    counting
        Whether a pixel's noise grows with the model.
    likelihood
        Whether pixels have the weights of counts, and not all the same.

    Returns
    -------
    factors, volume
        (n, 7) and (n,), at least 1; infinite where what is left does not determine the column.
    """
    side = there.shape[-1]
    rows, across = np.indices((side, side))
    disc = np.hypot(rows - side // 2, across - side // 2) <= side / 2
    y, x = rows[disc].astype(np.float64), across[disc].astype(np.float64)
    factors, volume = np.full((len(there), len(PARAMETERS)), np.inf), np.full(len(there), np.inf)
    for k, (column, known) in enumerate(zip(parameters, there[:, disc], strict=True)):
        expected, slopes, by_volume = model_slopes(column, x, y, fixed_shape=fixed_shape)
        expected = np.maximum(np.abs(expected), _DARKEST * np.abs(expected).max(initial=1e-30))
        weights, noise = 1 / expected if likelihood else np.ones(x.size), expected if counting else np.ones(x.size)
        scale = np.sqrt((slopes**2).sum(axis=1))
        scale[scale == 0] = 1.0
        slopes, by_volume = slopes / scale[:, None], by_volume / scale
        whole, left = (_covariance(slopes, weights * part, noise) for part in (np.ones(x.size), known))
        if whole is None or left is None:
            continue
        ratio = np.sqrt(np.maximum(left.diagonal() / whole.diagonal(), 1.0))
        factors[k] = ratio[4:].max(initial=1.0)
        factors[k, list(_FREE)] = ratio[:4]
        of_volume = (by_volume @ left @ by_volume) / (by_volume @ whole @ by_volume)
        volume[k] = np.sqrt(max(of_volume, 1.0))
    return factors, volume


def _covariance(slopes: Floats, weights: Floats, noise: Floats) -> Floats | None:
    """Return the covariance of estimates with these weights of the pixels; None where they do not determine them."""
    information = (slopes * weights) @ slopes.T
    if not np.isfinite(information).all() or np.linalg.cond(information) > 1e10:
        return None
    inverse = np.linalg.inv(information)
    covariance: Floats = inverse @ ((slopes * weights**2 * noise) @ slopes.T) @ inverse
    return covariance
