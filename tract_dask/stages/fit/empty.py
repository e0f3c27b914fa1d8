"""What passes where there is no column: fits of noise alone, made before the movie's own are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.correlated import noise_spectrum
from ...kernels.gaussian.intensity import Floats
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from ...kernels.windows import Tiles, gaussian_kernel
from ...settings.run import FitSettings
from ...store.columns import column_dataset
from ...store.schema import is_accepted
from .job import Job
from .measure import damping, fit_places, noise_left, status_of
from .places import Places

EMPTY_PASS = 0.05
"""Share of places without a column whose fits are accepted with the default threshold."""

_DRAWS = 1500
"""So many fits of noise tell the share that passes to 0.6 % of all."""
_MOST_PIXELS = 6_000_000
"""Where windows are large, there are fewer."""
_LEAST = 0.25
"""Where hardly any fit of noise ends within its bounds, a threshold still counts this much."""


def calibrated(job: Job) -> Job:
    """Return the job with the scale of its threshold, and the noise in residuals, from fits of windows of noise alone.

    A fit looks for its place, and where shapes are free for its width: of the maxima of the noise within its bounds it
    takes a high one. How high depends on the window, the columns' width, the blur, the bounds and the estimator. So the
    median column is fitted, with all settings of the job, to noise at its background; the scale is such that the
    default threshold lets :data:`EMPTY_PASS` of these fits through. After a filter of whole frames it stays 1.
    """
    if job.settings.filters_frames:
        return job
    sample, frame, noise = _noise_alone(job.in_units)
    places = Places.of(frame.shape, 0, 1, sample)
    fits = fit_places(places, Tiles(frame[None, None], np.zeros((1, 1), np.int64), frame.shape), 1.0, sample)
    passes = is_accepted(status_of(fits, places, np.zeros((1, 1))))
    amplitude = np.where(passes, np.abs(fits.estimates[..., AMPLITUDE]), 0.0)
    noise *= noise_left(job.settings.noise_blur_px, job.correlation)
    limit = float(np.quantile(amplitude, 1 - EMPTY_PASS)) / noise
    left_over = float(np.nanmedian(damping(job) * fits.residual)) / noise
    return replace(job, scale=max(limit / FitSettings().threshold, _LEAST), left_over=left_over)


def _noise_alone(job: Job) -> tuple[Job, NDArray[np.float32], float]:
    """Return a job of one frame without columns, that frame, and the standard deviation of its pixels.

    Its places lie on a grid, off the pixels' centres by chance.
    """
    rng = np.random.default_rng(0)
    halo = gaussian_kernel(job.settings.noise_blur_px).size
    side = max(8, int(min(np.sqrt(_DRAWS), np.sqrt(_MOST_PIXELS) / job.window_px)))
    steps = halo + job.window_px * (np.arange(side) + 0.5)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    places = grid + rng.uniform(-0.5, 0.5, grid.shape)
    shape: Floats = np.tile(np.median(job.reference, axis=0), (len(places), 1))
    shape[:, [X, Y]] = places
    level = shape[0, BACKGROUND] * job.unit
    size = (job.window_px * side + 2 * halo,) * 2
    noise = np.sqrt(level) / job.unit if level > 0 else abs(shape[0, AMPLITUDE]) / 4
    if level > 0 and job.settings.estimator == "poisson":
        frame = (rng.poisson(level, size) / job.unit).astype(np.float32)
    else:
        frame = np.float32(shape[0, BACKGROUND]) + np.float32(noise) * rng.standard_normal(size, np.float32)
    sample = replace(
        job,
        columns=column_dataset(places, fit=shape),
        drift=np.zeros((1, 2)),
        bad=np.zeros(1, np.bool_),
        lost=(),
        vacuum=None,
        reference_blur_px=job.settings.window_blur_px,
        refined_by=None,
        unit=1.0,
    )
    if job.correlation is not None:
        frame, share = _spread(frame, shape[0, BACKGROUND], np.array(job.correlation))
        noise *= share
    return sample, frame, float(noise)


def _spread(frame: NDArray[np.float32], level: float, correlation: Floats) -> tuple[NDArray[np.float32], float]:
    """Return a frame of white noise about ``level`` as a detector of this autocorrelation shows it.

    Electrons are spread over neighbours, which leaves their number; the second value is by what that makes the standard
    deviation of a pixel smaller.
    """
    power = np.maximum(noise_spectrum(correlation, frame.shape), 0)
    share = 1 / np.sqrt(power[0, 0])
    spread = np.fft.irfft2(np.fft.rfft2(frame - level) * np.sqrt(power) * share, frame.shape)
    return (level + spread).astype(np.float32), float(share)
