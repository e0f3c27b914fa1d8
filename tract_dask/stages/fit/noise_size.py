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

from ...kernels.gaussian.correlated import shared_noise
from ...kernels.gaussian.fit import fit_gaussians
from ...kernels.gaussian.information import model_slopes
from ...kernels.gaussian.model import blurred, evaluate
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, X, Y
from ...kernels.windows import blur_variance, disc, gaussian_kernel, spreading
from ...settings.run import FitSettings
from .goodness import Freedom, freedom

Floats = NDArray[np.float64]

FEWEST_DEGREES = 10.0
"""The size of the noise is not taken from fewer degrees of freedom."""

_WIDTHS = 16


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
    free
        Degrees of freedom of a window's residual.
    level
        (columns,) mean counts of a pixel over the pixels that share an electron; infinite where the noise is not that
        of counts.
    """

    errors: Floats
    volume: Floats
    left: Floats
    free: Freedom
    level: Floats


def window_noise(reference: Floats, size: int, settings: FitSettings, correlation: Floats | None = None) -> WindowNoise:
    """Return what windows do with noise, for columns of this shape after the blur.

    Parameters
    ----------
    reference
        (columns, 7) of Equation 1; where they are does not matter.
    size
        Diameter of the round windows, px.
    correlation
        (2 r + 1, 2 r + 1) autocorrelation of the raw pixels' noise; None: they share none.
    """
    noise = _of_white(reference, size, settings, freedom(_middle(reference), size, settings, correlation))
    if correlation is None:
        return noise
    shared = shared_noise(
        reference,
        size,
        correlation,
        blur_sigma_px=settings.window_blur_px,
        fixed_shape=settings.shape == "fixed",
        counting=settings.counting,
        likelihood=settings.estimator == "poisson",
    )
    return WindowNoise(
        noise.errors * shared.errors[:, :7],
        noise.volume * shared.errors[:, 7],
        noise.left * shared.left,
        noise.free,
        noise.level / correlation.sum(),
    )


def _middle(reference: Floats) -> Floats:
    """Return the column of the median width."""
    width = reference[:, SIGMA_A] * reference[:, SIGMA_B]
    return np.asarray(reference[np.argsort(width, kind="stable")[len(width) // 2]])


def _of_white(reference: Floats, size: int, settings: FitSettings, free: Freedom) -> WindowNoise:
    """Return what windows do with noise of which pixels share none."""
    width = np.sqrt(reference[:, SIGMA_A] * reference[:, SIGMA_B])
    order = np.argsort(width, kind="stable")
    chosen = order[np.unique(np.linspace(0, len(order) - 1, _WIDTHS).round().astype(int))]
    some = reference[chosen].copy()
    some[:, [X, Y]] = size // 2
    nearest = np.abs(np.log(width[:, None] / width[chosen])).argmin(axis=1)
    counts = np.array([evaluate(column, *_places(size)).mean() for column in some])[nearest]
    counted = (settings.counting or settings.estimator == "poisson") & (counts > 0)
    level = np.where(counted, counts, np.inf)
    if settings.estimator == "poisson":
        parameters = 4 if settings.shape == "fixed" else 7
        share = 1 - parameters / np.count_nonzero(disc(size))
        ones = np.ones((len(reference), 7))
        return WindowNoise(ones, ones[:, 0], share * ones[:, 0], free, level)
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
    return WindowNoise(errors[nearest], volume[nearest], left[nearest], free, level)


def frame_noise(ratio: Floats, good: NDArray[np.bool_], left: Floats, free: Freedom) -> tuple[Floats, Floats]:
    """Return the size of each frame's noise, (frames,), and how many windows tell it; NaN where they do not.

    Parameters
    ----------
    ratio
        (frames, columns) the residuals' sums of squares over what the noise alone has.
    good
        (frames, columns) fits that count.
    left
        (columns,) share of the noise that a fit leaves.
    free
        Degrees of freedom in a window.

    Notes
    -----
    The median of n values of chi-squared over its k degrees of freedom is larger by 1 / (k n), in the mean, than that
    of all.
    """
    good = good & np.isfinite(ratio) & (left > 0)
    sizes = np.where(good, ratio / np.where(left > 0, left, 1.0), np.nan)
    size, number = np.full(len(ratio), np.nan), good.sum(axis=1).astype(np.float64)
    enough = (number * free.degrees >= FEWEST_DEGREES) & (number > 0)
    if enough.any():
        size[enough] = np.nanmedian(sizes[enough], axis=1) / (free.median + 1 / (free.degrees * number[enough]))
    return size, number


def _places(size: int) -> tuple[Floats, Floats]:
    """Return x and y of the pixels that count, (n,)."""
    y, x = np.nonzero(disc(size))
    return x.astype(np.float64), y.astype(np.float64)


def _exact(column: Floats, size: int, settings: FitSettings) -> tuple[Floats, float, float]:
    """Return standard errors (7,) and that of the volume for noise of size 1, and the share of it that a fit leaves."""
    fixed, inside = settings.shape == "fixed", disc(size)
    _, slopes, by_volume = model_slopes(column, *_places(size), fixed_shape=fixed)
    scale = np.sqrt((slopes**2).sum(axis=1))
    kernel = gaussian_kernel(settings.window_blur_px).astype(np.float64)
    spread, power = spreading(size, kernel), spreading(size, kernel**2)
    images = np.zeros((len(slopes), size, size))
    images[:, inside] = slopes / scale[:, None]
    inverse = np.linalg.inv(images[:, inside] @ images[:, inside].T)
    reach = kernel.size // 2
    along = np.arange(-reach, size + reach)
    raw = evaluate(blurred(column, -blur_variance(settings.window_blur_px)), along, along[:, None])
    variance = np.maximum(raw, 0) if settings.counting and (raw > 0).any() else np.ones_like(raw)
    wide = spread @ images @ spread.T
    meat = np.einsum("iyx,jyx,yx->ij", wide, wide, variance)
    whole = float((power @ inside.astype(float) @ power.T * variance).sum())
    covariance = inverse @ meat @ inverse / np.outer(scale, scale)
    left = 1 - float(np.trace(inverse @ meat)) / whole
    errors = np.full(7, np.nan)
    errors[[X, Y, AMPLITUDE, BACKGROUND]] = np.sqrt(covariance.diagonal()[:4])
    return errors, float(np.sqrt(by_volume @ covariance @ by_volume)), left
