"""Bounded fits of Equation 1 to many windows: least squares, or maximum likelihood of counts."""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..windows import blur_variance, gaussian_kernel
from .covariance import Noise
from .engine import Options, Problem, fit_windows
from .moments import REACH
from .parameters import THETA

__all__ = ["LARGEST_SIGMA", "SMALLEST_SIGMA_PX", "GaussianFits", "Outcome", "fit_gaussians", "smallest_sigma"]

SMALLEST_SIGMA_PX = 0.5
"""Narrower Gaussians fall between the pixels; smaller bounds count as this, or as :func:`smallest_sigma`."""

LARGEST_SIGMA = 10.0
"""In units of the window's longer side; wider Gaussians are flat, so larger bounds count as this."""


class Outcome(IntEnum):
    """How a fit ended."""

    CONVERGED = 0
    AT_BOUND = 1
    """Converged, with a parameter that had any freedom on a bound."""
    ITERATION_LIMIT = 2
    NO_INFORMATION = 3
    """A constant window, or one that does not say where the column is."""
    NOT_FINITE = 4
    """A pixel, or the start, is NaN or infinite."""


class GaussianFits(NamedTuple):
    """What is known of each fitted window; parameters in the order of Equation 1, positions in window pixels."""

    estimates: npt.NDArray[np.float64]
    """(n, 7), canonical: sigma_a >= sigma_b > 0, theta in (-pi/2, pi/2]. Always finite: where a window cannot be
    fitted, the start moved onto the bounds."""
    stderr: npt.NDArray[np.float64]
    """(n, 7) standard errors; NaN for a parameter that is held, and where the fit has not converged."""
    volume_stderr: npt.NDArray[np.float64]
    """(n,) standard error of the volume 2 pi amplitude sigma_a sigma_b; NaN where the fit has not converged."""
    r_squared: npt.NDArray[np.float32]
    """(n,) share of the window's variance that the fit explains; 0 where there is no fit."""
    n_iterations: npt.NDArray[np.int16]
    """(n,) steps tried."""
    status: npt.NDArray[np.uint8]
    """(n,) codes of :class:`Outcome`."""
    noise: npt.NDArray[np.float64]
    """(n,) the residual's sum of squares over what the noise alone would have, if a raw pixel's variance were one for
    each count (or one, without ``counting``); NaN where the fit has not converged."""
    freedom: npt.NDArray[np.float64]
    """(n,) share of the noise's sum of squares that a fit leaves; NaN where a small window leaves nothing to tell."""

    def with_noise(self, size: npt.ArrayLike) -> GaussianFits:
        """Return fits whose errors are for noise of size 1 with those for noise of this size, (n,) or one for all."""
        factor = np.sqrt(np.broadcast_to(np.asarray(size, np.float64), self.noise.shape))
        with np.errstate(invalid="ignore"):  # no noise, times an error without end
            stderr, volume_stderr = self.stderr * factor[:, None], self.volume_stderr * factor
        stderr[:, THETA] = np.minimum(stderr[:, THETA], math.pi / 2)
        return self._replace(stderr=stderr, volume_stderr=volume_stderr)

    @property
    def converged(self) -> npt.NDArray[np.bool_]:
        """(n,) whether the last step was undamped and below the tolerance."""
        return np.less_equal(self.status, Outcome.AT_BOUND)

    @property
    def at_bound(self) -> npt.NDArray[np.bool_]:
        """(n,) whether the fit converged with a parameter that had any freedom on a bound."""
        return np.equal(self.status, Outcome.AT_BOUND)


def smallest_sigma(width: int) -> float:
    """Return the least sigma, px, of a Gaussian in windows so wide: smaller bounds count as this.

    Gaussians of 1 px and more fit into every window. The kernel's recurrences begin at the middle of a row, from which
    float32 holds a Gaussian up to 13 sigmas away: narrower ones fit where half of the row is no longer than that.

    Examples
    --------
    >>> [round(smallest_sigma(width), 2) for width in (7, 13, 21, 51)]
    [0.5, 0.5, 0.77, 1.0]
    """
    return min(1.0, max(SMALLEST_SIGMA_PX, width // 2 / REACH))


def fit_gaussians(
    windows: npt.NDArray[np.float32],
    start: npt.ArrayLike,
    lower: npt.ArrayLike,
    upper: npt.ArrayLike,
    *,
    estimator: str = "lsq",
    fixed_shape: bool = False,
    blur_sigma_px: float = 0.0,
    counting: bool = True,
    tolerance_px: float = 1e-4,
    max_iterations: int = 50,
    radius_px: float = math.inf,
    own_noise: bool = True,
) -> GaussianFits:
    """Fit Equation 1 to each window within bounds.

    Parameters
    ----------
    windows
        (n, h, w), of any finite scale.
    start, lower, upper
        (n, 7), or (7,) for all windows: amplitude, x, y, sigma_a, sigma_b, theta, background. x and y are in px from
        the centre of the window's first pixel. The sigmas share one interval, from the smaller lower to the larger
        upper bound, because which of them is the larger is an outcome; theta's bounds are ignored, for it only labels
        an orientation. A start outside the bounds is moved onto them.
    estimator
        ``lsq``: least squares. ``poisson``: maximum likelihood of counts, for windows that were not blurred.
    fixed_shape
        Whether sigma_a, sigma_b and theta stay as in ``start``; the bounds of the sigmas then do not matter.
    blur_sigma_px
        The Gaussian blur that the windows have been through, which correlates their noise; enters the standard errors.
    counting
        Whether a raw pixel's noise variance is proportional to the model, as for counted electrons, and not the same in
        every pixel; enters the standard errors of ``lsq``.
    tolerance_px
        A fit has converged when an undamped step moves the centre by less than this, and the outline of the ellipse by
        less than ten times this.
    max_iterations
        Most steps that are tried on a window.
    radius_px
        Pixels farther than this from the window's middle pixel (h // 2, w // 2) do not count.
    own_noise
        Whether the noise's size in the standard errors is that of the window's own residual, ``noise / freedom``. Off:
        it is 1, a variance of one for each count (or one, without ``counting``).

    Returns
    -------
    GaussianFits
        Standard errors are those of a linear model around the estimate. Where the ellipse is round within its error,
        theta means nothing; its standard error then grows and is cut off at pi/2. After a blur the background's is too
        large by up to a quarter in a small window, for the noise that the blur brought in from outside is left out.

    Raises
    ------
    ValueError
        If the shapes do not go together, a lower bound is not at or below its upper bound, or blurred windows are to be
        fitted by maximum likelihood.
    """
    windows = np.ascontiguousarray(windows, dtype=np.float32)
    if windows.ndim != 3 or 0 in windows.shape[1:]:
        raise ValueError(f"windows must be (n, h, w) with pixels, got {windows.shape}")
    if estimator not in ("lsq", "poisson"):
        raise ValueError(f"estimator must be lsq or poisson, got {estimator!r}")
    if estimator == "poisson" and blur_sigma_px > 0:
        raise ValueError("maximum likelihood needs the counts themselves, not blurred ones")
    n, height, width = windows.shape
    starts, lowers, uppers = (_rows(values, n) for values in (start, lower, upper))
    kernel = gaussian_kernel(blur_sigma_px).astype(np.float64)
    noise = Noise(blur_variance(blur_sigma_px), float(kernel @ kernel) ** 2, bool(counting))
    largest = LARGEST_SIGMA * max(height, width)
    problem = Problem(starts, lowers, uppers, smallest_sigma(width), largest, bool(fixed_shape))
    options = Options(estimator == "poisson", float(tolerance_px), int(max_iterations), float(radius_px))
    empty, results = fit_windows(windows, problem, options, noise)
    if empty >= 0:
        low, high = (np.broadcast_to(values, (n, 7))[empty].tolist() for values in (lowers, uppers))
        raise ValueError(f"bounds of window {empty} are empty: lower {low}, upper {high}")
    fits = GaussianFits(*results)
    return fits.with_noise(fits.noise / fits.freedom) if own_noise else fits


def _rows(values: npt.ArrayLike, n: int) -> npt.NDArray[np.float64]:
    """Return parameters for each of ``n`` windows (n, 7), or for all (1, 7)."""
    rows = np.require(values, np.float64, ("C", "W"))
    if rows.shape not in ((7,), (1, 7), (n, 7)):
        rows = np.array(np.broadcast_to(rows, (n, 7)))
    return rows.reshape(-1, 7)
