"""Errors of fits where pixels share their noise: what they are, in units of those that white noise would give.

With the slopes J of the model, H = J^T J and noise of covariance C, the estimates have the covariance
H^-1 (J^T C J) H^-1, and the residual's sum of squares the expectation tr C - tr(H^-1 J^T C J), from which the size of
C can be taken. Both are evaluated twice: for white noise, and for noise with the autocorrelation that was measured,
both after the blur; for maximum likelihood with every pixel in units of its own standard deviation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..windows import gaussian_kernel
from .information import model_slopes
from .parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, X, Y

Floats = NDArray[np.float64]

_ALIKE = 0.05
"""Columns whose shape and contrast differ by less than this share have the same factors."""


class SharedNoise(NamedTuple):
    """What noise that pixels share does, over what white noise of the same size does.

    Attributes
    ----------
    errors
        (n, 8) standard errors: Equation 1's seven, and the volume.
    left
        (n,) what a fit leaves of the noise's sum of squares.
    """

    errors: Floats
    left: Floats


def shared_noise(
    parameters: Floats,
    size: int,
    correlation: Floats,
    *,
    blur_sigma_px: float = 0.0,
    fixed_shape: bool = True,
    counting: bool = True,
    likelihood: bool = False,
) -> SharedNoise:
    """Return by what errors for white noise of a known size, and what fits leave of it, are to be multiplied.

    Parameters
    ----------
    parameters
        (n, 7) of Equation 1 in the windows, after their blur, the background as large as its noise's variance.
    size
        Diameter of the windows, px.
    correlation
        (2 r + 1, 2 r + 1) autocorrelation of the raw pixels' noise; 1 in the middle.
    """
    first, which = alike(parameters)
    kernel = gaussian_kernel(blur_sigma_px).astype(np.float64)
    found = [
        _factors(parameters[k], size, correlation, kernel, (fixed_shape, counting or likelihood, likelihood))
        for k in first
    ]
    factors = np.array(found).reshape(-1, 9)[which]
    return SharedNoise(factors[:, :8], factors[:, 8])


def alike(parameters: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return one column (n, 7) of each shape and contrast, and for each column which of them is like it, (n,)."""
    shape = np.abs(parameters[:, [SIGMA_A, SIGMA_B, AMPLITUDE, BACKGROUND]])
    shape[:, 2] /= np.maximum(shape[:, 3], 1e-9 * np.maximum(shape[:, 2], 1e-300))
    classes = np.rint(np.log(np.maximum(shape[:, :3], 1e-6)) / _ALIKE)
    _, first, which = np.unique(classes, axis=0, return_index=True, return_inverse=True)
    return first, which.ravel()


def noise_spectrum(correlation: Floats, shape: tuple[int, ...]) -> Floats:
    """Return the power of noise with an autocorrelation (2 r + 1, 2 r + 1), at the frequencies of ``rfft2``."""
    lags, lag = np.zeros(shape), np.arange(len(correlation)) - len(correlation) // 2
    lags[np.ix_(lag % shape[0], lag % shape[1])] = correlation
    return np.asarray(np.fft.rfft2(lags).real)


def _factors(column: Floats, size: int, correlation: Floats, kernel: Floats, how: tuple[bool, bool, bool]) -> Floats:
    fixed_shape, counting, likelihood = how
    margin = kernel.size // 2
    side = size + 2 * margin
    at = column.copy()
    at[[X, Y]] = side // 2
    rows, across = np.indices((side, side), dtype=np.float64)
    expected, slopes, volume = model_slopes(at, across.ravel(), rows.ravel(), fixed_shape=fixed_shape)
    variance = np.maximum(expected, 0.02 * np.abs(expected).max()) if counting else np.ones(expected.size)
    disc = (np.hypot(rows - side // 2, across - side // 2) <= size / 2).ravel()
    slopes = np.where(disc, slopes, 0.0)
    scale = np.sqrt((slopes**2).sum(axis=1))
    slopes, volume = slopes / scale[:, None], np.asarray(volume) / scale
    if likelihood:
        slopes = slopes / np.sqrt(variance)
    hessian = np.linalg.pinv(slopes @ slopes.T)
    padded = (2 * side, 2 * side)
    images = slopes.reshape(-1, side, side)
    if not likelihood:
        blur = np.fft.rfft2(np.outer(kernel, kernel), padded)
        spread = np.fft.irfft2(np.fft.rfft2(images, padded) * blur, padded)
        images = spread[:, margin : margin + side, margin : margin + side] * np.sqrt(variance).reshape(side, side)
    own = np.fft.rfft2(images, padded)
    traces = _traces(variance[disc], correlation, kernel, likelihood=likelihood)
    errors, remains = [], []
    white = np.ones((padded[0], padded[1] // 2 + 1))
    for spectrum, trace in zip((white, noise_spectrum(correlation, padded)), traces, strict=True):
        shared = np.fft.irfft2(own * spectrum, padded)[:, :side, :side].reshape(len(images), -1)
        meat = images.reshape(len(images), -1) @ shared.T
        covariance = hessian @ meat @ hessian
        remains.append(trace - float(np.trace(hessian @ meat)))
        errors.append(np.append(covariance.diagonal(), volume @ covariance @ volume))
    with np.errstate(invalid="ignore", divide="ignore"):
        x, y, amplitude, background, *shapes, of_volume = np.sqrt(errors[1] / errors[0])
    widths = max(shapes, default=math.nan)
    left = max(remains[1] / remains[0], 0.0) if remains[0] > 0 else 1.0
    return np.array([amplitude, x, y, *(widths if shapes else 1.0,) * 3, background, of_volume, left])


def _traces(variance: Floats, correlation: Floats, kernel: Floats, *, likelihood: bool) -> tuple[float, float]:
    """Return the sum of the variances of the pixels that are fitted, for white noise and for what is shared."""
    if likelihood:
        return float(variance.size), float(variance.size)
    reach = len(correlation) // 2
    blurred = np.correlate(kernel, kernel, "full")
    blurred = np.pad(blurred, max(0, reach - (kernel.size - 1)))
    middle = len(blurred) // 2
    kept = blurred[middle - reach : middle + reach + 1]
    total = float(variance.sum())
    return total * float(blurred[middle]) ** 2, total * float((correlation * np.outer(kept, kept)).sum())
