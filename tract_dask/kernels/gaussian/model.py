"""The model of a column: a rotated elliptical Gaussian on a constant background, Equation 1 of the paper.

Parameters are arrays whose last axis is (amplitude, x, y, sigma_a, sigma_b, theta, background). Coordinates are pixels:
an integer is a pixel's centre, x runs to the right, y down. The major axis lies along (cos theta, -sin theta).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .parameters import BACKGROUND

Floats = npt.NDArray[np.float64]


def canonical(parameters: npt.ArrayLike) -> Floats:
    """Return the same Gaussians labelled in the one way that is stored.

    Parameters
    ----------
    parameters
        (..., 7); the signs of the sigmas are ignored.

    Returns
    -------
    (..., 7) float64 with sigma_a >= sigma_b and theta in (-pi/2, pi/2].

    Examples
    --------
    >>> canonical([1.0, 0.0, 0.0, 2.0, 3.0, 0.0, 0.0]).round(4).tolist()
    [1.0, 0.0, 0.0, 3.0, 2.0, 1.5708, 0.0]
    """
    result = np.array(parameters, dtype=np.float64)
    first, second, theta = np.abs(result[..., 3]), np.abs(result[..., 4]), result[..., 5]
    turned = np.where(first >= second, theta, theta + np.pi / 2)
    result[..., 3], result[..., 4] = np.maximum(first, second), np.minimum(first, second)
    folded = np.pi / 2 - np.mod(np.pi / 2 - turned, np.pi)
    result[..., 5] = np.where(folded > -np.pi / 2, folded, np.pi / 2)  # the remainder may be rounded up to pi
    return result


def blurred(parameters: npt.ArrayLike, variance: float) -> Floats:
    """Return what a circular Gaussian blur makes of Gaussians (..., 7): wider and lower, of the same volume.

    Parameters
    ----------
    variance
        The blur's, px^2. A negative one undoes a blur; it leaves at least a tenth of each sigma.

    Examples
    --------
    >>> blurred([8.0, 0.0, 0.0, 4.0, 3.0, 0.0, 1.0], 2.0**2).round(2).tolist()
    [5.95, 0.0, 0.0, 4.47, 3.61, 0.0, 1.0]
    """
    result = np.array(parameters, dtype=np.float64)
    sigmas = result[..., 3:5].copy()
    result[..., 3:5] = np.sqrt(np.maximum(sigmas**2 + variance, (0.1 * sigmas) ** 2))
    result[..., 0] *= (sigmas / result[..., 3:5]).prod(axis=-1)
    return result


def evaluate(parameters: npt.ArrayLike, x: npt.ArrayLike, y: npt.ArrayLike) -> Floats:
    """Return Equation 1 at the points (x, y).

    Parameters
    ----------
    parameters
        (..., 7).
    x, y
        Coordinates in px, of any one shape or broadcastable to it.

    Returns
    -------
    float64 of shape (..., *points): every Gaussian at every point.
    """
    columns, rows = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    fields: Any = np.moveaxis(np.asarray(parameters, np.float64), -1, 0)
    fields = fields.reshape(fields.shape + (1,) * columns.ndim)
    amplitude, x0, y0, sigma_a, sigma_b, theta, background = fields
    along = (columns - x0) * np.cos(theta) - (rows - y0) * np.sin(theta)
    across = (columns - x0) * np.sin(theta) + (rows - y0) * np.cos(theta)
    result: Floats = amplitude * np.exp(-0.5 * ((along / sigma_a) ** 2 + (across / sigma_b) ** 2)) + background
    return result


def above_background(parameters: npt.ArrayLike, x: npt.ArrayLike, y: npt.ArrayLike) -> Floats:
    """Return what Gaussians add to their backgrounds at the points (x, y); otherwise as :func:`evaluate`."""
    columns = np.array(parameters, np.float64)
    columns[..., BACKGROUND] = 0
    return evaluate(columns, x, y)


def gaussian_image(parameters: npt.ArrayLike, shape: tuple[int, int]) -> Floats:
    """Return images (..., ny, nx) of Equation 1 for parameters (..., 7), sampled at the pixels' centres."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return evaluate(parameters, columns, rows)


def group_image(members: Floats, x: npt.ArrayLike, y: npt.ArrayLike) -> Floats:
    """Return the image of columns (..., members, 7) that share the background of the first, (..., y, x)."""
    return np.asarray(above_background(members, x, y).sum(axis=-3) + members[..., 0, BACKGROUND, None, None])
