"""One shard of frames to numbers: windows, bounds, fits, intensities, flags, noise and refined drift."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .kernels.filters import blur, cut_windows, gaussian_kernel
from .kernels.fitting import GaussianFits, fit_gaussians
from .movie import Movie
from .schema import AMPLITUDE, BACKGROUND, REJECTED, SIGMA_A, SIGMA_B, THETA, Status, X, Y
from .settings import FitSettings
from .shards import Shard

Floats = NDArray[np.float64]
Values = dict[str, np.ndarray[Any, Any]]

INTENSITY_SCALE = {"paper": 0.9545**2, "ellipse": 1 - np.exp(-2)}
"""Share of a Gaussian inside two sigma: the paper's (a box of +-2 sigma) and that of the ellipse of Equation 5."""

_BATCH_BYTES = 32 << 20
_CERTAIN = 13.8
"""Chi-squared of two degrees of freedom at 99.9 %."""
_AT_BOUND = 1e-9
"""Share of the interval between its bounds within which a parameter is at its bound."""


@dataclass(frozen=True)
class Job:
    """Everything that the fit of a shard needs beside the pixels.

    Attributes
    ----------
    reference
        (columns, 7) fit on the summed image; what could not be fitted there holds the median shape at the seed's place.
    drift
        (frames, 2) measured drift, (y, x), px, of all frames of the movie.
    bad
        (frames,) frames with pixels that are NaN or infinite.
    window
        Side of the windows in px.
    vacuum
        (y0, y1, x0, x1) in the summed image, or None: noise is taken from the residuals.
    refine_columns
        Fewest accepted columns that may refine a frame's drift; None leaves the drift as measured.
    """

    reference: Floats
    drift: Floats
    bad: NDArray[np.bool_]
    window: int
    vacuum: tuple[int, ...] | None
    refine_columns: int | None
    settings: FitSettings


def measure(movie: Movie, shard: Shard, job: Job) -> Values:
    """Return the values of every fitted variable of :data:`schema.RESULTS` for the frames of one shard.

    Windows are cut where the drift has carried the columns: its integer part picks the pixels, its fraction shifts the
    start of the fit. No pixel is resampled.
    """
    drift = job.drift[shard.start : shard.stop]
    place = job.reference[None, :, [Y, X]] + drift[:, None]
    corner = np.rint(place).astype(np.int64) - job.window // 2
    outside = np.any((corner < 0) | (corner + job.window > np.array(movie.shape[1:])), axis=-1)
    frames, noise = _read(movie, shard, job, corner, outside)
    fits, residual, held = _fit(frames, corner, drift[:, None] - corner, job, movie.gain)
    fits.estimates[..., [Y, X]] += corner
    for array in (fits.estimates, fits.stderr, fits.r_squared, residual):
        array[outside] = np.nan
    if noise is None:
        noise = np.array([np.median(r[np.isfinite(r)]) if np.isfinite(r).any() else np.nan for r in residual])
    weak = ~(np.abs(fits.estimates[..., AMPLITUDE]) > job.settings.threshold * noise[:, None])
    flags = {
        Status.BELOW_NOISE: weak & ~outside,
        Status.NOT_CONVERGED: ~fits.converged & ~outside,
        Status.AT_BOUND: held & ~outside,
        Status.SHAPE_AT_BOUND: fits.at_bound & ~held & ~outside,
        Status.OUTSIDE_FRAME: outside,
        Status.BAD_FRAME: np.broadcast_to(job.bad[shard.start : shard.stop, None], outside.shape),
    }
    status = np.zeros(outside.shape, np.uint8)
    for flag, found in flags.items():
        status |= np.uint8(flag) * found
    refined: Floats = drift + _common_motion(fits, status, drift, job)
    fits.estimates[..., [Y, X]] -= refined[:, None]
    intensity, intensity_error = intensities(fits.estimates, job.settings.intensity_scale)
    return {
        "fit": fits.estimates,
        "stderr": fits.stderr,
        "intensity": intensity,
        "intensity_error": intensity_error,
        "status": status,
        "r_squared": fits.r_squared,
        "n_iterations": fits.n_iterations * ~outside,
        "drift": refined,
        "noise": noise,
    }


def intensities(estimates: Floats, scale: str = "paper") -> tuple[Floats, Floats]:
    """Return column intensities and their errors, in counts.

    Parameters
    ----------
    estimates
        (..., 7) parameters of Equation 1, in counts and px.
    scale
        ``paper``: Equation 3's 0.9545^2, the share of the Gaussian in a box of +-2 sigma. ``ellipse``: 1 - exp(-2), the
        share in the ellipse of radii 2 sigma, over which Equation 5 counts the background.

    Notes
    -----
    Equation 3: I = scale * 2 pi A sigma_a sigma_b. Equation 5: sqrt(I + 8 pi B sigma_a sigma_b). Dark columns have
    A < 0 and I < 0; the counts inside the ellipse are then I + 4 pi B sigma_a sigma_b, and Equation 5 stands as
    it is written.
    """
    area = estimates[..., SIGMA_A] * estimates[..., SIGMA_B]
    intensity = INTENSITY_SCALE[scale] * 2 * np.pi * estimates[..., AMPLITUDE] * area
    variance = intensity + 8 * np.pi * estimates[..., BACKGROUND] * area
    return intensity, np.sqrt(np.maximum(variance, 0))


def _fit(
    frames: np.ndarray[Any, Any], corner: NDArray[np.int64], offset: Floats, job: Job, gain: float
) -> tuple[GaussianFits, Floats, NDArray[np.bool_]]:
    """Return the fits of all windows, (frames, columns, ...), the rms residual of each, and which are held.

    A fit is held where a bound other than that of a sigma is active. A batch of frames is cut, blurred and fitted at a
    time, so that windows take no more than some tens of megabytes.
    """
    settings, size = job.settings, job.window
    count = corner.shape[:2]
    batch = max(1, _BATCH_BYTES // (4 * size * size * count[1]))
    parts: list[tuple[Any, ...]] = []
    for start in range(0, count[0], batch):
        part = slice(start, start + batch)
        y, x = corner[part, :, 0], corner[part, :, 1]
        windows = cut_windows(frames[part], y, x, size, settings.blur_sigma_px, gain).reshape(-1, size, size)
        first, lower, upper = _bounds(job, offset[part], size)
        fits = fit_gaussians(
            windows,
            first,
            lower,
            upper,
            blur_sigma_px=settings.blur_sigma_px,
            tolerance_px=settings.tolerance_px,
            max_iterations=settings.max_iterations,
            counting=settings.counting,
        )
        with np.errstate(invalid="ignore"):  # windows of bad frames
            residual = np.sqrt((1 - fits.r_squared) * windows.var(axis=(1, 2), dtype=np.float64))
            room = np.minimum(fits.estimates - lower, upper - fits.estimates) / (upper - lower)
        held = np.any(room[:, [AMPLITUDE, X, Y, BACKGROUND]] < _AT_BOUND, axis=1)
        parts.append((*fits, residual, held))
    fields = (np.concatenate(values).reshape(*count, *values[0].shape[1:]) for values in zip(*parts, strict=True))
    *joined, residual, held = fields
    return GaussianFits(*joined), residual, held


def _bounds(job: Job, offset: Floats, size: int) -> tuple[Floats, Floats, Floats]:
    """Return start values and bounds, each (fits, 7), in the coordinates of the windows.

    ``offset`` (frames, columns, 2) leads from the summed image to the window: drift less corner, (y, x).
    """
    settings = job.settings
    start = np.broadcast_to(job.reference, (*offset.shape[:2], 7)).copy()
    start[..., [Y, X]] += offset
    lower, upper = start.copy(), start.copy()
    reach = min(settings.max_shift_px or size / 4, size / 2)
    lower[..., [Y, X]] -= reach
    upper[..., [Y, X]] += reach
    amplitude = start[..., AMPLITUDE]
    lower[..., AMPLITUDE] = np.minimum(0, settings.amplitude_factor * amplitude)
    upper[..., AMPLITUDE] = np.maximum(0, settings.amplitude_factor * amplitude)
    lower[..., [SIGMA_A, SIGMA_B]] = start[..., SIGMA_B, None] / settings.sigma_factor
    upper[..., [SIGMA_A, SIGMA_B]] = start[..., SIGMA_A, None] * settings.sigma_factor
    span = np.abs(start[..., BACKGROUND]) + settings.amplitude_factor * np.abs(amplitude)
    lower[..., BACKGROUND] -= span
    upper[..., BACKGROUND] += span
    lower[..., THETA], upper[..., THETA] = -np.inf, np.inf
    return start.reshape(-1, 7), lower.reshape(-1, 7), upper.reshape(-1, 7)


def _read(
    movie: Movie, shard: Shard, job: Job, corner: NDArray[np.int64], outside: NDArray[np.bool_]
) -> tuple[np.ndarray[Any, Any], Floats | None]:
    """Return the shard's frames, read only where its windows are, and the noise in vacuum where one is known.

    The array is as large as the frames, but memory is taken up only where tiles are read into it.
    """
    halo = gaussian_kernel(job.settings.blur_sigma_px).size // 2
    inside = corner[~outside]
    boxes = np.concatenate([inside - halo, inside + job.window + halo], axis=-1)
    vacuum = None
    if job.vacuum is not None:
        y0, y1, x0, x1 = job.vacuum
        shift = np.rint(job.drift[shard.start : shard.stop]).astype(np.int64)
        vacuum = np.clip(shift[:, [0, 1, 0, 1]] + (y0, x0, y1, x1), 0, np.tile(movie.shape[1:], 2))
        boxes = np.concatenate([boxes, vacuum + np.array([-halo, -halo, halo, halo])])
    frames = movie.read_boxes(shard.start, shard.stop, boxes)
    if vacuum is None:
        return frames, None
    noise = np.full(shard.frames, np.nan)
    for k, (y0, x0, y1, x1) in enumerate(vacuum):
        crop = (slice(max(0, y0 - halo), y1 + halo), slice(max(0, x0 - halo), x1 + halo))
        pixels = blur(frames[k][crop] * np.float32(movie.gain), job.settings.blur_sigma_px)
        with np.errstate(invalid="ignore"):  # pixels of bad frames
            noise[k] = pixels[y0 - crop[0].start :, x0 - crop[1].start :][: y1 - y0, : x1 - x0].std(dtype=np.float64)
    return frames, noise


def _common_motion(fits: GaussianFits, status: NDArray[np.uint8], drift: Floats, job: Job) -> Floats:
    """Return how far the accepted columns of each frame moved together, (frames, 2): what the drift had missed.

    Zero unless it stands out of its own error with 99.9 % certainty (chi-squared of both axes above 13.8):
    registration, which sees every pixel, is otherwise the better estimate. Zero, too, where fewer than
    ``refine_columns`` are accepted.
    """
    motion = np.zeros_like(drift)
    if job.refine_columns is None:
        return motion
    away = fits.estimates[..., [Y, X]] - drift[:, None] - job.reference[:, [Y, X]]
    expected = np.sqrt(np.abs(job.reference[:, BACKGROUND]) + np.abs(job.reference[:, AMPLITUDE]) / 2)
    expected /= np.abs(job.reference[:, AMPLITUDE]) + 1e-12
    for k in range(len(drift)):
        good = (status[k] & REJECTED) == 0
        if good.sum() >= job.refine_columns:
            common, error = _biweight(away[k, good], expected[good])
            if ((common / error) ** 2).sum() > _CERTAIN:
                motion[k] = common
    return motion


def _biweight(values: Floats, expected: Floats) -> tuple[Floats, Floats]:
    """Return the mean of ``values`` (n, 2) and its standard error, each (2,).

    Weights are 1 / expected^2, with errors (n,) known up to a factor, times Tukey's biweight at 6 median absolute
    deviations, so that columns which move by themselves do not count. The standard error is that of the weighted mean,
    from the spread of the values. Errors that the fits themselves report are no use here: at low dose they follow the
    noise, and favour the columns that it has made brighter.
    """
    centre = np.median(values, axis=0)
    errors = expected[:, None]
    weight = np.ones_like(values)
    for _ in range(10):
        pull = (values - centre) / errors
        scale = 6 * np.median(np.abs(pull), axis=0) + 1e-12
        weight = np.clip(1 - (pull / scale) ** 2, 0, None) ** 2 / errors**2
        centre = (weight * values).sum(axis=0) / weight.sum(axis=0)
    error = np.sqrt((weight**2 * (values - centre) ** 2).sum(axis=0)) / weight.sum(axis=0)
    return centre, np.maximum(error, 1e-12)
