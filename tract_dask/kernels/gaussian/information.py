"""How well a column can be located at all: Fisher's information of counts about Equation 1, and its inverse.

With the counts of pixel k Poisson distributed about its expectation m_k, the information about parameters p, q is
sum_k (dm_k/dp) (dm_k/dq) / m_k, and no unbiased estimator of all the free parameters has a covariance below its inverse
(the bound of Cramér and Rao; for positions in micrographs see S. Van Aert et al., J. Struct. Biol. 138 (2002) 21).

The shape enters as (a, b, c) of exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2) rather than as sigmas and theta: the bound of
all else is the same, and stays finite for a round column, where theta means nothing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .parameters import BACKGROUND

Floats = npt.NDArray[np.float64]


class Bounds(NamedTuple):
    """Cramér-Rao bounds of variances, each (n,); NaN where a window says nothing."""

    x: Floats
    """px^2."""
    y: Floats
    volume: Floats
    """Of 2 pi amplitude sigma_a sigma_b, counts^2."""


def column_bounds(
    parameters: npt.ArrayLike,
    side: int,
    *,
    radius_px: float = math.inf,
    fixed_shape: bool = False,
    dark_variance: float = 0.0,
) -> Bounds:
    """Return the Cramér-Rao bounds for columns in square windows of counts.

    Parameters
    ----------
    parameters
        (n, 7) of Equation 1 in counts, x and y in px from the centre of the window's first pixel.
    side
        Of the windows, px.
    radius_px
        Pixels farther than this from the window's middle pixel (side // 2, side // 2) do not count.
    fixed_shape
        Whether sigma_a, sigma_b and theta are known; amplitude, position and background are not, in any case.
    dark_variance
        That of a pixel without electrons (read noise), counts^2: its noise is taken for that of so many counts more.

    Returns
    -------
    Bounds
        NaN where a pixel's expectation is not above zero, or a parameter is not finite.

    Examples
    --------
    A narrow column on no background is known to sigma^2 / counts, and its counts as counts are:

    >>> column = [[1000.0, 10.0, 10.0, 1.5, 1.5, 0.0, 1e-6]]
    >>> counts = 2 * np.pi * 1000 * 1.5**2
    >>> bounds = column_bounds(column, 21, fixed_shape=True)
    >>> (bounds.x * counts / 1.5**2).round(3).tolist(), (bounds.volume / counts).round(3).tolist()
    ([1.0], [1.0])
    """
    columns = np.atleast_2d(np.asarray(parameters, np.float64))
    rows, across = np.indices((side, side))
    inside = np.hypot(rows - side // 2, across - side // 2) <= radius_px
    y, x = rows[inside].astype(np.float64), across[inside].astype(np.float64)
    bounds = np.full((3, len(columns)), np.nan)
    for k, column in enumerate(columns):
        expected, slopes, by_volume = model_slopes(column, x, y, fixed_shape=fixed_shape)
        expected = expected + dark_variance
        if not (expected > 0).all():  # NaN is not
            continue
        scale = np.sqrt((slopes**2 / expected).sum(axis=1))
        slopes, by_volume = slopes / scale[:, None], by_volume / scale
        information = slopes / expected @ slopes.T
        if np.linalg.cond(information) < 1 / np.finfo(np.float64).eps:
            covariance = np.linalg.inv(information)
            variances = covariance.diagonal()[:2] / scale[:2] ** 2
            bounds[:, k] = *variances, by_volume @ covariance @ by_volume
    return Bounds(*bounds)


def model_slopes(column: Floats, x: Floats, y: Floats, *, fixed_shape: bool) -> tuple[Floats, Floats, Floats]:
    """Return the pixels' expected counts (n,), their slopes (4 or 7, n), and those of the volume (4 or 7,).

    Slopes are by the free parameters: x, y, amplitude, background, and, where the shape is free, a, b, c.
    """
    amplitude, x0, y0, sigma_a, sigma_b, theta, background = column
    cos, sin, dx, dy = math.cos(theta), math.sin(theta), x - x0, y - y0
    a = (cos / sigma_a) ** 2 + (sin / sigma_b) ** 2
    b = cos * sin * (sigma_b**-2 - sigma_a**-2)
    c = (sin / sigma_a) ** 2 + (cos / sigma_b) ** 2
    unit = np.exp(-0.5 * (a * dx**2 + 2 * b * dx * dy + c * dy**2))
    gaussian, area = amplitude * unit, 2 * math.pi * sigma_a * sigma_b
    slopes = [gaussian * (a * dx + b * dy), gaussian * (b * dx + c * dy), unit, np.ones_like(unit)]
    by_volume = [0.0, 0.0, area, 0.0]
    if not fixed_shape:
        slopes += [-0.5 * gaussian * dx**2, -gaussian * dx * dy, -0.5 * gaussian * dy**2]
        share = amplitude * area * (sigma_a * sigma_b) ** 2  # area = 2 pi / sqrt(a c - b^2)
        by_volume += [-0.5 * share * c, share * b, -0.5 * share * a]
    return gaussian + background, np.array(slopes), np.array(by_volume)


def group_slopes(group: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return expected counts (n,) and slopes (3 members + 1, n) of columns (members, 7) that share a background.

    Slopes are by x, y and amplitude of each, and by the background; the shapes are known.
    """
    found = [model_slopes(column, x, y, fixed_shape=True) for column in group]
    slopes = np.concatenate([own[:3] for _, own, _ in found] + [found[0][1][3:4]])
    return np.sum([counts for counts, _, _ in found], axis=0) - (len(group) - 1) * group[0, BACKGROUND], slopes
