"""One shard of frames to numbers: windows, bounds, fits, intensities, flags, noise and refined drift."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .kernels.filters import Tiles, cut_windows, gaussian_kernel
from .kernels.fitting import GaussianFits, fit_gaussians
from .movie import Movie
from .schema import AMPLITUDE, BACKGROUND, REJECTED, SIGMA_A, SIGMA_B, THETA, Status, X, Y
from .settings import FitSettings
from .shards import Shard

Floats = NDArray[np.float64]
Values = dict[str, np.ndarray[Any, Any]]

INTENSITY_SCALE = {"paper": 0.9545**2, "ellipse": 1 - np.exp(-2)}
"""Share of a Gaussian inside two sigma: the paper's (a box of +-2 sigma) and that of the ellipse of Equation 5."""

_BATCH_BYTES = 4 << 20
_NOISE_SIDE_PX = 256
"""Blurred with sigma 2 px, a square of this side has noise for 1300 independent values: its size is known to 2 %."""
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
    vacuum = _vacuum(job, drift, movie.shape[1:])
    tiles = _read(movie, shard, job, corner[~outside], vacuum)
    fits, residual, held = _fit(tiles, corner, drift[:, None] - corner, job, movie.gain)
    fits.estimates[..., [Y, X]] += corner
    for array in (fits.estimates, fits.stderr, fits.volume_stderr, fits.r_squared, residual):
        array[outside] = np.nan
    if vacuum is None:
        noise = _damping(job.settings) * masked_median(residual, np.isfinite(residual))
    else:
        noise = _noise(tiles, vacuum, job, movie.gain)
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
        "intensity_stderr": INTENSITY_SCALE[job.settings.intensity_scale] * fits.volume_stderr,
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
    tiles: Tiles, corner: NDArray[np.int64], offset: Floats, job: Job, gain: float
) -> tuple[GaussianFits, Floats, NDArray[np.bool_]]:
    """Return the fits of all windows, (frames, columns, ...), the rms residual of each, and which are held.

    Residuals are NaN where there is vacuum, and so no need of them. A fit is held where a bound other than that of a
    sigma is active. A batch of frames is cut, blurred and fitted at a time, so small that its windows stay in the
    processor's cache.
    """
    settings, size = job.settings, job.window
    count = corner.shape[:2]
    batch = max(1, _BATCH_BYTES // (4 * size * size * count[1]))
    parts: list[tuple[Any, ...]] = []
    for start in range(0, count[0], batch):
        part = slice(start, start + batch)
        y, x = corner[part, :, 0], corner[part, :, 1]
        windows = cut_windows(tiles, y, x, size, settings.window_blur_px, gain, start).reshape(-1, size, size)
        first, lower, upper = _bounds(job, offset[part], size)
        fits = fit_gaussians(
            windows,
            first,
            lower,
            upper,
            estimator=settings.estimator,
            fixed_shape=settings.shape == "fixed",
            blur_sigma_px=settings.window_blur_px,
            tolerance_px=settings.tolerance_px,
            max_iterations=settings.max_iterations,
            radius_px=size / 2,
            counting=settings.counting,
        )
        residual = np.full(len(windows), np.nan)
        with np.errstate(invalid="ignore"):  # windows of bad frames
            if job.vacuum is None:
                residual = np.sqrt((1 - fits.r_squared) * windows[:, _disc(size)].var(axis=1, dtype=np.float64))
            room = np.minimum(fits.estimates - lower, upper - fits.estimates) / (upper - lower)
        held = np.any(room[:, [AMPLITUDE, X, Y, BACKGROUND]] < _AT_BOUND, axis=1)
        parts.append((*fits, residual, held))
    fields = (np.concatenate(values).reshape(*count, *values[0].shape[1:]) for values in zip(*parts, strict=True))
    *joined, residual, held = fields
    return GaussianFits(*joined), residual, held


def _disc(size: int) -> NDArray[np.bool_]:
    """Return which pixels of a window count, (size, size): those no farther than half its size from the middle one."""
    offset = np.arange(size) - size // 2
    return np.hypot(offset[:, None], offset) <= size / 2


def _damping(settings: FitSettings) -> float:
    """Return by how much the blur for the noise would still reduce the noise of the windows, which is white if raw."""
    still = settings.window_blur_px < settings.blur_sigma_px
    return float((gaussian_kernel(settings.blur_sigma_px) ** 2).sum()) if still else 1.0


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


def _vacuum(job: Job, drift: Floats, shape: tuple[int, ...]) -> NDArray[np.int64] | None:
    """Return where the noise is measured: in each frame the first row and column, and the side, of a square; (f, 3).

    It is the middle of the vacuum box, no larger than what the noise takes, moved with the drift and kept inside the
    frame. None where there is no vacuum.
    """
    if job.vacuum is None:
        return None
    y0, y1, x0, x1 = job.vacuum
    side = min(y1 - y0, x1 - x0, _NOISE_SIDE_PX)
    corner = np.array([y0 + y1 - side, x0 + x1 - side]) // 2 + np.rint(drift).astype(np.int64)
    corner = np.clip(corner, 0, np.array(shape) - side)
    return np.column_stack([corner, np.full(len(corner), side)])


def _read(movie: Movie, shard: Shard, job: Job, corner: NDArray[np.int64], vacuum: NDArray[np.int64] | None) -> Tiles:
    """Return the tiles of the shard that the windows (first row and column of each), or the vacuum, touch."""
    halo = gaussian_kernel(job.settings.blur_sigma_px).size // 2
    boxes = [np.concatenate([corner - halo, corner + job.window + halo], axis=-1)]
    if vacuum is not None:
        first, side = vacuum[:, :2], vacuum[:, 2:]
        boxes.append(np.concatenate([first - halo, first + side + halo], axis=-1))
    return movie.read_tiles(shard.start, shard.stop, np.concatenate(boxes))


def _noise(tiles: Tiles, vacuum: NDArray[np.int64], job: Job, gain: float) -> Floats:
    """Return the standard deviation of each frame's blurred vacuum."""
    squares = cut_windows(tiles, vacuum[:, :1], vacuum[:, 1:2], int(vacuum[0, 2]), job.settings.blur_sigma_px, gain)
    with np.errstate(invalid="ignore"):  # pixels of bad frames
        return np.asarray(squares.std(axis=(1, 2, 3), dtype=np.float64))


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
    good = (status & REJECTED) == 0
    enough = good.sum(axis=1) >= job.refine_columns
    if enough.any():
        common, error = _biweight(away[enough], expected, good[enough])
        certain = ((common / error) ** 2).sum(axis=1) > _CERTAIN
        motion[enough] = np.where(certain[:, None], common, 0)
    return motion


def _biweight(values: Floats, expected: Floats, good: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Return the mean of each frame's good ``values`` (frames, n, 2) and its standard error, each (frames, 2).

    Weights are 1 / expected^2, with errors (n,) known up to a factor, times Tukey's biweight at 6 median absolute
    deviations, so that columns which move by themselves do not count. The standard error is that of the weighted mean,
    from the spread of the values. Errors that the fits themselves report are no use here: at low dose they follow the
    noise, and favour the columns that it has made brighter.
    """
    # per frame and axis: (frames, 2, n)
    values = np.where(good[:, None], np.swapaxes(values, 1, 2), 0)
    counted = np.broadcast_to(good[:, None], values.shape)
    precision = counted / expected**2
    centre = masked_median(values, counted)
    weight = precision
    for _ in range(10):
        pull = np.abs(values - centre[..., None]) / expected
        scale = 6 * masked_median(pull, counted)[..., None] + 1e-12
        weight = np.clip(1 - (pull / scale) ** 2, 0, None) ** 2 * precision
        centre = (weight * values).sum(axis=-1) / weight.sum(axis=-1)
    error = np.sqrt((weight**2 * (values - centre[..., None]) ** 2).sum(axis=-1)) / weight.sum(axis=-1)
    return centre, np.maximum(error, 1e-12)


def masked_median(values: Floats, good: NDArray[np.bool_]) -> Floats:
    """Return the median of the good values along the last axis; NaN where there are none.

    Examples
    --------
    >>> masked_median(np.array([[3.0, 1.0, 9.0], [5.0, 5.0, 5.0]]), np.array([[True, True, False], [False] * 3]))
    array([ 2., nan])
    """
    ordered = np.sort(np.where(good, values, np.inf), axis=-1)
    count = good.sum(axis=-1)[..., None]
    low, high = (np.take_along_axis(ordered, np.maximum(k, 0), axis=-1) for k in ((count - 1) // 2, count // 2))
    with np.errstate(invalid="ignore"):
        return np.where(count > 0, (low + high) / 2, np.nan)[..., 0]
