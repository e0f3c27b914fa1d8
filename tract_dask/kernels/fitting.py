"""Bounded least squares of Equation 1 on many windows."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .filters import gaussian_kernel
from .gaussian import canonical
from .least_squares import GaussianFits, Options, fit_windows

__all__ = ["LARGEST_SIGMA", "SMALLEST_SIGMA_PX", "GaussianFits", "fit_gaussians"]

SMALLEST_SIGMA_PX = 0.1
"""Narrower Gaussians fall between the pixels; smaller bounds count as this."""

LARGEST_SIGMA = 10.0
"""In units of the window's longer side; wider Gaussians are flat, so larger bounds count as this."""


def fit_gaussians(
    windows: npt.NDArray[np.float32],
    start: npt.ArrayLike,
    lower: npt.ArrayLike,
    upper: npt.ArrayLike,
    *,
    blur_sigma_px: float = 0.0,
    counting: bool = True,
    tolerance_px: float = 1e-4,
    max_iterations: int = 50,
) -> GaussianFits:
    """Fit Equation 1 to each window by least squares within bounds.

    Parameters
    ----------
    windows
        (n, h, w), of any finite scale. A window with a pixel that is NaN or infinite gets NaN, not an exception.
    start, lower, upper
        (n, 7), or (7,) for all windows: amplitude, x, y, sigma_a, sigma_b, theta, background. x and y are in px from
        the centre of the window's first pixel. The sigmas share one interval, from the smaller lower to the larger
        upper bound, because which of them is the larger is an outcome; theta's bounds are ignored, for it only labels
        an orientation. A start outside the bounds is moved onto them.
    blur_sigma_px
        The Gaussian blur that the windows have been through, which correlates their noise; enters the standard errors.
    counting
        Whether a raw pixel's noise variance is proportional to the model, as for counted electrons, and not the same in
        every pixel; enters the standard errors. The noise's size is always taken from the residuals.
    tolerance_px
        A fit has converged when an undamped step moves the centre by less than this, and the outline of the ellipse by
        less than ten times this.
    max_iterations
        Most steps that are tried on a window.

    Returns
    -------
    GaussianFits
        Standard errors are those of a linear model around the estimate. Where the ellipse is round within its error,
        theta means nothing; its standard error then grows and is cut off at pi/2. After a blur the background's is too
        large by up to a quarter in a small window, for the noise that the blur brought in from outside is left out.

    Raises
    ------
    ValueError
        If the shapes do not go together, or a lower bound is not at or below its upper bound.
    """
    windows = np.ascontiguousarray(windows, dtype=np.float32)
    if windows.ndim != 3 or 0 in windows.shape[1:]:
        raise ValueError(f"windows must be (n, h, w) with pixels, got {windows.shape}")
    n, height, width = windows.shape
    starts, lowers, uppers = (
        np.array(np.broadcast_to(np.asarray(values, np.float64), (n, 7)), order="C") for values in (start, lower, upper)
    )
    lowers[:, 3:5] = np.maximum(lowers[:, 3:5].min(axis=1, keepdims=True), SMALLEST_SIGMA_PX)
    uppers[:, 3:5] = np.minimum(uppers[:, 3:5].max(axis=1, keepdims=True), LARGEST_SIGMA * max(height, width))
    lowers[:, 5], uppers[:, 5] = -np.inf, np.inf
    if not (lowers <= uppers).all():
        row = int(np.flatnonzero(~(lowers <= uppers).all(axis=1))[0])
        raise ValueError(
            f"bounds of window {row} are empty: lower {lowers[row].tolist()}, upper {uppers[row].tolist()}"
        )
    starts[:, 3:6] = canonical(starts)[:, 3:6]
    kernel = gaussian_kernel(blur_sigma_px).astype(np.float64)
    distances = np.arange(kernel.size) - kernel.size // 2
    variance, power = float(kernel @ distances**2), float(kernel @ kernel) ** 2
    options = Options(variance, power, bool(counting), float(tolerance_px), int(max_iterations))
    fits = GaussianFits(
        estimates=np.clip(starts, lowers, uppers),
        stderr=np.full((n, 7), np.nan),
        r_squared=np.zeros(n, np.float32),
        n_iterations=np.zeros(n, np.int16),
        converged=np.zeros(n, np.bool_),
        at_bound=np.zeros(n, np.bool_),
    )
    fit_windows(windows.reshape(n, height * width), width, lowers, uppers, options, fits)
    return fits
