"""The fits of columns alone in their windows: start values, bounds, and what a window gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...kernels.centroids import BEST_RADIUS, SMALLEST_RADIUS_PX, window_centroids
from ...kernels.gaussian.fit import fit_gaussians
from ...kernels.gaussian.intensity import Floats
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, THETA, X, Y
from ...kernels.presence import strengths
from ...kernels.windows import disc
from .frame_fits import FrameFits
from .job import Job

_AT_BOUND = 1e-9
"""Share of the interval between its bounds within which a parameter is at its bound."""


def fit_windows(
    windows: NDArray[np.float32], bounds: Sequence[Floats], which: NDArray[np.int64], job: Job
) -> FrameFits:
    """Return what windows (n, h, w) of columns ``which`` give, with start and bounds (n, 7) in their coordinates."""
    settings, (start, lower, upper) = job.settings, bounds
    fits = fit_gaussians(
        windows,
        *bounds,
        estimator=settings.estimator,
        fixed_shape=settings.shape == "fixed",
        blur_sigma_px=settings.window_blur_px,
        tolerance_px=settings.tolerance_px,
        max_iterations=settings.max_iterations,
        radius_px=job.window_px / 2,
        counting=settings.counting,
        own_noise=False,
    )
    fits.stderr[:] *= np.nan if settings.filters_frames else job.window_noise.errors[which]
    fits.volume_stderr[:] *= np.nan if settings.filters_frames else job.window_noise.volume[which]
    if settings.shape == "free":  # a sigma on its bound moves amplitude and background by more than they scatter
        fits.stderr[fits.at_bound, AMPLITUDE] = fits.stderr[fits.at_bound, BACKGROUND] = np.nan
        fits.volume_stderr[fits.at_bound] = np.nan
    held, residual = np.zeros(len(windows), np.bool_), np.full(len(windows), np.nan)
    for k in (AMPLITUDE, X, Y, BACKGROUND):
        low, high, value = lower[:, k], upper[:, k], fits.estimates[:, k]
        held |= np.minimum(value - low, high - value) < _AT_BOUND * (high - low)
    if job.vacuum is None:
        with np.errstate(invalid="ignore"):  # windows of bad frames
            variance = windows[:, disc(job.window_px)].var(axis=1, dtype=np.float64)
            residual = np.sqrt((1 - fits.r_squared) * variance)
    return FrameFits(
        fits.estimates,
        fits.stderr,
        fits.volume_stderr,
        fits.r_squared,
        fits.n_iterations,
        fits.converged,
        fits.at_bound,
        held,
        _centroids(windows, start, which, job),
        strengths(windows, job.filters, which).astype(np.float64),
        residual,
        fits.noise,
        np.zeros(len(windows), np.bool_),
    )


def _centroids(windows: NDArray[np.float32], start: Floats, which: NDArray[np.int64], job: Job) -> Floats:
    """Return the centroids of windows (n, h, w), (n, 2) rows of (y, x), in a mask that begins where the fit does.

    Its radius is that with the least noise for a Gaussian with the column's width.
    """
    sigma = np.sqrt(job.reference[:, SIGMA_A] * job.reference[:, SIGMA_B])
    best = np.full(len(sigma), job.settings.mask_radius_px) if job.settings.mask_radius_px else BEST_RADIUS * sigma
    radius, dark = np.maximum(best, SMALLEST_RADIUS_PX)[which], (job.reference[:, AMPLITUDE] < 0)[which]
    return window_centroids(windows, start[:, [X, Y]], radius, job.reach_px, dark=dark).places[:, ::-1]


def bounds_of(offset: Floats, columns: NDArray[np.int64], job: Job) -> tuple[Floats, Floats, Floats]:
    """Return start values and bounds, each (..., 7), in the coordinates of windows.

    Parameters
    ----------
    offset
        (..., 2) y and x from the summed image to the window, px.
    columns
        Numbers of the columns, which go with ``offset``.
    """
    settings, reference = job.settings, job.reference[columns]
    amplitude = settings.amplitude_factor * reference[..., AMPLITUDE]
    span = np.abs(reference[..., BACKGROUND]) + np.abs(amplitude)
    narrow, wide = reference[..., SIGMA_B] / settings.sigma_factor, reference[..., SIGMA_A] * settings.sigma_factor
    bounds = {
        AMPLITUDE: (np.minimum(0, amplitude), np.maximum(0, amplitude)),
        SIGMA_A: (narrow, wide),
        SIGMA_B: (narrow, wide),
        THETA: (-np.inf, np.inf),
        BACKGROUND: (reference[..., BACKGROUND] - span, reference[..., BACKGROUND] + span),
    }
    start, lower, upper = (np.empty((*offset.shape[:-1], 7)) for _ in range(3))
    start[...] = reference
    for k, (low, high) in bounds.items():
        lower[..., k], upper[..., k] = low, high
    reach = job.reach_px
    for k, shift in ((Y, offset[..., 0]), (X, offset[..., 1])):
        start[..., k] += shift
        lower[..., k], upper[..., k] = start[..., k] - reach, start[..., k] + reach
    return start, lower, upper
