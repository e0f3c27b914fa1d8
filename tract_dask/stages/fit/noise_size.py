"""How large the noise is, from all windows of a frame, and what a window's own edge does to the errors that it causes.

A small window has next to no residual that would tell how large its noise is: a disc of 13 px, blurred by 2 px, holds
three independent values for four parameters. The columns of a frame share their noise: so many electrons make so much
variance. So its size is the median over the windows of the frame, each by its own degrees of freedom.

The kernel's errors leave out that the blur brings noise into a window from outside and that what is blurred beyond the
edge is lost. In windows of a few sigmas of the blur that is much, and here it is put right: by the ratio of errors
summed over pixels, with all edges, to the kernel's, for columns as wide as each one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from ...kernels.gaussian.fit import fit_gaussians
from ...kernels.gaussian.information import model_slopes
from ...kernels.gaussian.model import blurred, evaluate
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, X, Y
from ...kernels.windows import gaussian_kernel
from ...settings.run import FitSettings

Floats = NDArray[np.float64]

FEWEST_DEGREES = 10.0
"""The size of the noise is not taken from fewer degrees of freedom."""

_WIDTHS = 16
_LARGEST_PX = 31
"""Degrees of freedom are counted in a window no larger than this: a larger one is shrunk, with all that is in it."""


class WindowNoise(NamedTuple):
    """What a column's window does with noise.

    Attributes
    ----------
    errors
        (columns, 7) true over the kernel's standard errors.
    volume
        (columns,) the same for volumes.
    left
        (columns,) share of the noise's sum of squares that a fit leaves.
    degrees
        Effective degrees of freedom of a window: twice the squared mean of its residual's sum of squares over its
        variance.
    level
        (columns,) mean counts of a pixel; infinite where the noise is not that of counts.
    grain
        By how much the squares of counts scatter more than those of a normal distribution: the share of the variance
        of a sum of squares, times the electrons in a pixel.
    """

    errors: Floats
    volume: Floats
    left: Floats
    degrees: float
    level: Floats
    grain: float


def window_noise(reference: Floats, size: int, settings: FitSettings) -> WindowNoise:
    """Return what windows do with noise, for columns of this shape after the blur.

    Parameters
    ----------
    reference
        (columns, 7) of Equation 1; where they are does not matter.
    size
        Diameter of the round windows, px.
    """
    width = np.sqrt(reference[:, SIGMA_A] * reference[:, SIGMA_B])
    order = np.argsort(width, kind="stable")
    chosen = order[np.unique(np.linspace(0, len(order) - 1, _WIDTHS).round().astype(int))]
    some = reference[chosen].copy()
    some[:, [X, Y]] = size // 2
    nearest = np.abs(np.log(width[:, None] / width[chosen])).argmin(axis=1)
    degrees = _degrees(some[len(some) // 2], size, settings)
    counts = np.array([evaluate(column, *_places(size)).mean() for column in some])[nearest]
    counted = (settings.counting or settings.estimator == "poisson") & (counts > 0)
    level = np.where(counted, counts, np.inf)
    kernel = gaussian_kernel(settings.window_blur_px).astype(np.float64)
    grain = (kernel @ kernel) ** 4 / (2 * (np.convolve(kernel, kernel) ** 2).sum() ** 2)
    if settings.estimator == "poisson":
        free = 4 if settings.shape == "fixed" else 7
        share = 1 - free / np.count_nonzero(_disc(size))
        ones = np.ones((len(reference), 7))
        return WindowNoise(ones, ones[:, 0], share * ones[:, 0], degrees, level, grain)
    exact = [_exact(column, size, settings) for column in some]
    bounds = np.full(7, np.inf)
    images = evaluate(some, np.arange(size), np.arange(size)[:, None]).astype(np.float32)
    stated = fit_gaussians(
        images,
        some,
        -bounds,
        bounds,
        fixed_shape=settings.shape == "fixed",
        blur_sigma_px=settings.window_blur_px,
        counting=settings.counting,
        radius_px=size / 2,
        own_noise=False,
    )
    with np.errstate(invalid="ignore"):
        errors = np.stack([errors for errors, _, _ in exact]) / stated.stderr
        volume = np.array([volume for _, volume, _ in exact]) / stated.volume_stderr
    errors, volume = np.where(errors > 0, errors, 1.0), np.where(volume > 0, volume, 1.0)
    left = np.array([left for _, _, left in exact])
    return WindowNoise(errors[nearest], volume[nearest], left[nearest], degrees, level, grain)


def frame_noise(ratio: Floats, good: NDArray[np.bool_], left: Floats, degrees: float) -> Floats:
    """Return the size of each frame's noise, (frames,); NaN where its windows do not tell.

    Parameters
    ----------
    ratio
        (frames, columns) the residuals' sums of squares over what the noise alone has.
    good
        (frames, columns) fits that count.
    left
        (columns,) share of the noise that a fit leaves.
    degrees
        Of freedom in a window.

    Notes
    -----
    The median of chi-squared over its k degrees of freedom is (1 - 2 / 9k)^3 (Wilson and Hilferty, 1931).
    """
    good = good & np.isfinite(ratio) & (left > 0)
    sizes = np.where(good, ratio / np.where(left > 0, left, 1.0), np.nan)
    size = np.full(len(ratio), np.nan)
    enough = (good.sum(axis=1) * degrees >= FEWEST_DEGREES) & good.any(axis=1)
    if enough.any():
        size[enough] = np.nanmedian(sizes[enough], axis=1) / (1 - 2 / (9 * max(degrees, 0.5))) ** 3
    return size


def p_values(ratio: Floats, size: Floats, noise: WindowNoise) -> NDArray[np.float32]:
    """Return how probable so large a residual is where one Gaussian is all that there is, (frames, columns).

    Parameters
    ----------
    ratio
        (frames, columns) the residuals' sums of squares over what the noise alone has.
    size
        (frames,) of the noise, from :func:`frame_noise`.

    Returns
    -------
    NDArray
        The upper tail of chi-squared; uniform from 0 to 1 where the model is right. NaN where the noise is not known.

    Notes
    -----
    A count of mean m has the excess kurtosis 1 / m, which leaves so much fewer degrees of freedom.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        electrons = noise.level / size[:, None]
        degrees = noise.degrees / (1 + noise.grain / electrons)
        squares = degrees * ratio / (size[:, None] * np.where(noise.left > 0, noise.left, np.nan))
    return np.asarray(gammaincc(degrees / 2, squares / 2), np.float32)


def _places(size: int) -> tuple[Floats, Floats]:
    """Return x and y of the pixels that count, (n,)."""
    y, x = np.nonzero(_disc(size))
    return x.astype(np.float64), y.astype(np.float64)


def _disc(size: int) -> NDArray[np.bool_]:
    offset = np.arange(size) - size // 2
    return np.hypot(offset[:, None], offset) <= size / 2


def _spread(size: int, kernel: Floats) -> Floats:
    """Return the matrix (size + kernel - 1, size) that blurs what stands in a row, and loses nothing at its ends."""
    spread = np.zeros((size + kernel.size - 1, size))
    for k, weight in enumerate(kernel):
        spread[np.arange(size) + k, np.arange(size)] = weight
    return spread


def _exact(column: Floats, size: int, settings: FitSettings) -> tuple[Floats, float, float]:
    """Return standard errors (7,) and that of the volume for noise of size 1, and the share of it that a fit leaves."""
    fixed, disc = settings.shape == "fixed", _disc(size)
    _, slopes, by_volume = model_slopes(column, *_places(size), fixed_shape=fixed)
    scale = np.sqrt((slopes**2).sum(axis=1))
    kernel = gaussian_kernel(settings.window_blur_px).astype(np.float64)
    spread, power = _spread(size, kernel), _spread(size, kernel**2)
    images = np.zeros((len(slopes), size, size))
    images[:, disc] = slopes / scale[:, None]
    inverse = np.linalg.inv(images[:, disc] @ images[:, disc].T)
    reach = kernel.size // 2
    along = np.arange(-reach, size + reach)
    raw = evaluate(blurred(column, -(settings.window_blur_px**2)), along, along[:, None])
    variance = np.maximum(raw, 0) if settings.counting and (raw > 0).any() else np.ones_like(raw)
    wide = spread @ images @ spread.T
    meat = np.einsum("iyx,jyx,yx->ij", wide, wide, variance)
    whole = float((power @ disc.astype(float) @ power.T * variance).sum())
    covariance = inverse @ meat @ inverse / np.outer(scale, scale)
    left = 1 - float(np.trace(inverse @ meat)) / whole
    errors = np.full(7, np.nan)
    errors[[X, Y, AMPLITUDE, BACKGROUND]] = np.sqrt(covariance.diagonal()[:4])
    return errors, float(np.sqrt(by_volume @ covariance @ by_volume)), left


def _degrees(column: Floats, size: int, settings: FitSettings) -> float:
    """Return the effective degrees of freedom of a window: (trace P C)^2 / trace (P C)^2, P beside the fit's slopes."""
    shrink = max(1.0, size / _LARGEST_PX)
    side = 2 * round((size / shrink - 1) / 2) + 1
    small = column.copy()
    small[[SIGMA_A, SIGMA_B]] /= shrink
    small[[X, Y]] = side // 2
    _, slopes, _ = model_slopes(small, *_places(side), fixed_shape=settings.shape == "fixed")
    basis = np.linalg.qr((slopes / np.sqrt((slopes**2).sum(axis=1))[:, None]).T)[0]
    kernel = gaussian_kernel(settings.window_blur_px / shrink).astype(np.float64)
    twice = np.pad(np.convolve(kernel, kernel), (side, side))
    middle = twice.size // 2
    y, x = np.nonzero(_disc(side))
    noise = twice[middle + y[:, None] - y] * twice[middle + x[:, None] - x]
    left = noise - basis @ (basis.T @ noise)
    left -= (left @ basis) @ basis.T
    return float(np.trace(left) ** 2 / (left**2).sum())
