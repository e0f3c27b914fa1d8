"""Is one Gaussian enough? How probable a window's residual is, where one Gaussian and noise is all that there is.

The residual's sum of squares is a weighted sum of chi-squared variables. Its mean, variance and third cumulant are
traces of powers of P C: C is the covariance of the window's pixels, P takes away what a fit follows. They are made by
convolutions, exactly but for the third, which is the mean over random signs. A chi-squared distribution with the same
three (Imhof, 1961, after Pearson) gives the tail. Counts scatter more than a normal distribution: their cumulants are
added.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from ...kernels.gaussian.information import model_slopes
from ...kernels.gaussian.parameters import X, Y
from ...kernels.windows import disc, gaussian_kernel
from ...settings.run import FitSettings

Floats = NDArray[np.float64]

_LEAST = 0.02
"""Of the largest variance of a pixel that any has."""
_DRAWS = 48
"""Random signs tell the third cumulant to some percent."""
_OF_THIRD = 5.5, 0.5
"""How the third cumulant of squared counts of a mean m grows: 8 m^3 (1 + 5.5 g + 0.5 g^2) with g = 1 / 2m."""
_OF_MEDIAN = np.pi / 2
"""Variance of a median over that of a mean, of the same values."""


class Freedom(NamedTuple):
    """Degrees of freedom of a window's residual: numbers, or arrays of the columns'.

    Attributes
    ----------
    degrees
        Of the chi-squared distribution with the same variance: twice the squared mean over the variance.
    skew_degrees
        Of that with the same skewness.
    grain
        By how much the squares of counts scatter more than those of a normal distribution: the share of the variance
        of a sum of squares, times the electrons in a pixel.
    """

    degrees: Any
    skew_degrees: Any
    grain: Any

    @property
    def median(self) -> Any:
        """Median of the residual's sum of squares, in units of its mean (Wilson and Hilferty, 1931)."""
        k = max(self.skew_degrees, 0.5)
        return 1 + k * ((1 - 2 / (9 * k)) ** 3 - 1) / math.sqrt(max(self.degrees, 0.5) * k)


def freedom(column: Floats, size: int, settings: FitSettings, shared: Floats | None = None) -> Freedom:
    """Return the degrees of freedom of what fits leave in a round window.

    Parameters
    ----------
    column
        (7,) of Equation 1 after the blur, its background as large as its noise's variance.
    size
        Diameter of the window, px.
    shared
        (2 r + 1, 2 r + 1) autocorrelation of the raw pixels' noise; None: they share none.
    """
    rows, across = np.indices((size, size), dtype=np.float64)
    at = column.copy()
    at[[X, Y]] = size // 2
    expected, slopes, _ = model_slopes(at, across.ravel(), rows.ravel(), fixed_shape=settings.shape == "fixed")
    return freedom_left(slopes, expected, disc(size), settings, shared)


def freedom_left(
    slopes: Floats, expected: Floats, mask: NDArray[np.bool_], settings: FitSettings, shared: Floats | None = None
) -> Freedom:
    """Return the degrees of freedom that a model leaves, given its slopes (n, pixels) and expected counts (pixels,).

    Parameters
    ----------
    mask
        (rows, columns) pixels that count.
    """
    likelihood, disc = settings.estimator == "poisson", mask.ravel()
    variance = np.maximum(expected, _LEAST * np.abs(expected).max()) if settings.counting or likelihood else disc * 1.0
    slopes = disc * slopes / (np.sqrt(variance) if likelihood else 1.0)
    basis = np.linalg.qr((slopes / np.sqrt((slopes**2).sum(axis=1))[:, None]).T)[0].T.reshape(-1, *mask.shape)
    weight = (disc if likelihood else disc * np.sqrt(variance / variance.mean())).reshape(mask.shape).astype(np.float64)
    kernel = gaussian_kernel(settings.window_blur_px).astype(np.float64)
    lags = np.convolve(kernel, kernel)
    common = np.outer(lags, lags)
    common = common if shared is None else _convolved(common, shared, whole=True)
    common /= common[len(common) // 2, len(common) // 2]
    one, two, three = _cumulants(basis, weight, common)
    return Freedom(one**2 / two, two**3 / three**2, 1 / (2 * float((common**2).sum())))


def _convolved(images: Floats, kernel: Floats, *, whole: bool = False) -> Floats:
    """Return images (..., y, x) convolved with a kernel (odd, odd): as large as they are, or the whole result."""
    sides = [a + b - 1 for a, b in zip(images.shape[-2:], kernel.shape, strict=True)]
    room = [-(-side // 8) * 8 for side in sides]  # a fast length
    product = np.fft.irfft2(np.fft.rfft2(images, room) * np.fft.rfft2(kernel, room), room)
    rows, across = (
        slice(0 if whole else k // 2, side if whole else k // 2 + n)
        for k, n, side in zip(kernel.shape, images.shape[-2:], sides, strict=True)
    )
    return np.asarray(product[..., rows, across], np.float64)


def _cumulants(basis: Floats, weight: Floats, common: Floats) -> tuple[float, float, float]:
    """Return the traces of P C and its square and third power; C is weight * common * weight."""

    def covariance(images: Floats) -> Floats:
        return weight * _convolved(weight * images, common)

    def left(images: Floats) -> Floats:
        flat, own = images.reshape(len(images), -1), basis.reshape(len(basis), -1)
        return (flat - (flat @ own.T) @ own).reshape(images.shape)

    power = weight**2
    followed = covariance(basis)
    inner = followed.reshape(len(basis), -1) @ basis.reshape(len(basis), -1).T
    one = float(power.sum() - np.trace(inner))
    every = float((power * _convolved(power, common**2)).sum())
    two = every - 2 * float((followed**2).sum()) + float((inner**2).sum())
    signs = left(np.random.default_rng(0).choice([-1.0, 1.0], (_DRAWS, *weight.shape)))
    once = left(covariance(signs))
    twice = left(covariance(once))
    own, third = float((once**2).sum()), float((once * twice).sum())
    return one, two, third * two / own  # by what chance has in the second, which is known


def p_values(ratio: Floats, size: Floats, left: Floats, level: Floats, free: Freedom, number: Floats) -> Floats:
    """Return how probable so large a residual is where one Gaussian is all that there is, (frames, columns).

    Parameters
    ----------
    ratio
        (frames, columns) the residuals' sums of squares over what noise of size 1 has.
    size
        (frames,) of the noise: the median over the windows of a frame.
    left
        (columns,) share of the noise that a fit leaves.
    level
        (columns,) mean counts of a pixel, in units of what noise of size 1 has for an electron; infinite where the
        noise is not that of counts.
    free
        Of a window.
    number
        (frames,) of windows whose median ``size`` is.

    Returns
    -------
    NDArray
        Uniform from 0 to 1 where the model is right. NaN where the noise is not known.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        grain = free.grain * size[:, None] / level
        own = 1 + grain + _OF_MEDIAN / number[:, None]
        excess = (ratio / (size[:, None] * np.where(left > 0, left, np.nan)) - 1) * np.sqrt(free.degrees / (2 * own))
        tail = free.skew_degrees * (1 + grain) ** 3 / (1 + _OF_THIRD[0] * grain + _OF_THIRD[1] * grain**2) ** 2
        return np.asarray(gammaincc(tail / 2, np.maximum(tail + excess * np.sqrt(2 * tail), 0) / 2))
