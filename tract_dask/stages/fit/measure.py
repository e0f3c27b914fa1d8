"""One shard of frames to numbers: windows, bounds, fits, intensities, flags, noise and refined drift."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...kernels.blur import Tiles, cut_windows, gaussian_kernel
from ...kernels.centroids import BEST_RADIUS, SMALLEST_RADIUS_PX, window_centroids
from ...kernels.gaussian.fit import GaussianFits, fit_gaussians
from ...kernels.gaussian.intensity import INTENSITY_SCALE, Floats, intensities
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, THETA, X, Y
from ...kernels.presence import strengths
from ...settings.run import FitSettings
from ...store.movie import Movie
from ...store.schema import SIZES, Status
from ...store.shards import Shard
from .common_motion import common_motion, masked_median
from .filters import filter_frame
from .job import Job

Values = dict[str, np.ndarray[Any, Any]]

_BATCH_BYTES = 4 << 20

_NOISE_SIDE_PX = 256
"""Blurred with sigma 2 px, a square of this side has noise for 1300 independent values: its size is known to 2 %."""

_AT_BOUND = 1e-9
"""Share of the interval between its bounds within which a parameter is at its bound."""


def measure(movie: Movie, shard: Shard, job: Job) -> Values:
    """Return the values of every fitted variable of :data:`schema.RESULTS` for the frames of one shard.

    Windows are cut where the drift has carried the columns: its integer part picks the pixels, its fraction shifts the
    start of the fit. No pixel is resampled. One layer of tiles is in memory at a time; with a filter of whole frames
    beside it one filtered frame.
    """
    parts: list[Values] = []
    for start in range(shard.start, shard.stop, movie.layer_frames):
        stop = min(start + movie.layer_frames, shard.stop)
        if job.settings.filters_frames:
            frames = movie.read(start, stop)
            parts += [_measure_frames(movie, k, k + 1, job, frame) for k, frame in enumerate(frames, start)]
        else:
            parts.append(_measure_frames(movie, start, stop, job))
    return {name: np.concatenate([values[name] for values in parts]) for name in parts[0]}


def measure_frame(movie: Movie, frame: int, job: Job) -> Values:
    """Return the same as :func:`measure` for a single frame, whose arrays have length 1 along it."""
    return _measure_frames(movie, frame, frame + 1, job, movie.read(frame, frame + 1)[0])


def _measure_frames(movie: Movie, start: int, stop: int, job: Job, frame: np.ndarray[Any, Any] | None = None) -> Values:
    """Return the values for frames ``start`` to ``stop`` (not included) of one shard.

    They begin with the first of a layer of tiles, or are a single one, ``frame``, which has been read.
    """
    job, unit = job.in_units, job.unit
    drift, gain = job.drift[start:stop], movie.gain / unit
    place = job.reference[None, :, [Y, X]] + drift[:, None]
    corner = np.rint(place).astype(np.int64) - job.window_px // 2
    outside = np.any((corner < 0) | (corner + job.window_px > np.array(movie.shape[1:])), axis=-1)
    vacuum = _vacuum(job, drift, movie.shape[1:])
    bad = np.broadcast_to(job.bad[start:stop, None], outside.shape)
    if frame is None:
        tiles = _read(movie, start, stop, job, corner[~outside], vacuum)
    else:
        whole = job.settings.filters_frames
        pixels, gain = (filter_frame(frame, job.settings, gain), 1.0) if whole else (frame, gain)
        tiles = Tiles(pixels[None, None], np.zeros((1, 1), np.int64), movie.shape[1:])
    fits, centroid, presence, residual, held = _fit(tiles, corner, drift[:, None] - corner, job, gain)
    fits.estimates[..., [Y, X]] += corner
    centroid += corner
    centroid[outside | bad] = np.nan
    for array in (fits.estimates, fits.stderr, fits.volume_stderr, fits.r_squared, presence, residual):
        array[outside] = np.nan
    noise, precision, empty = _vacuum_noise(tiles, vacuum, residual, start, job, gain)
    status = _status(fits, held, outside, bad, job.settings.threshold * noise)
    refined: Floats = drift + common_motion(fits, status, drift, job)
    fits.estimates[..., [Y, X]] -= refined[:, None]
    for counts in (fits.estimates, fits.stderr):
        counts[..., [AMPLITUDE, BACKGROUND]] *= unit
    intensity, intensity_error = intensities(fits.estimates, job.settings.intensity_scale)
    return {
        "fit": fits.estimates,
        "stderr": fits.stderr,
        "centroid": centroid - refined[:, None],
        "intensity": intensity,
        "intensity_error": intensity_error,
        "intensity_stderr": INTENSITY_SCALE[job.settings.intensity_scale] * unit * fits.volume_stderr,
        "status": status,
        "presence": presence * precision,
        "presence_vacuum": empty * precision,
        "r_squared": fits.r_squared,
        "n_iterations": fits.n_iterations * ~outside,
        "drift": refined,
        "noise": unit * noise,
    }


def _vacuum_noise(
    tiles: Tiles, vacuum: NDArray[np.int64] | None, residual: Floats, start: int, job: Job, gain: float
) -> tuple[Floats, Floats, NDArray[np.float32]]:
    """Return the noise (frames), what turns matched filters into strengths (frames, 1), and those of empty places.

    Strengths in vacuum (frames, places) are not scaled yet, and NaN where there is no vacuum: the noise is then that of
    the fits' residuals.
    """
    blur = job.settings.noise_blur_px
    empty = np.full((len(residual), SIZES["place"]), np.nan, np.float32)
    if vacuum is None:
        noise = _damping(job.settings) * masked_median(residual, np.isfinite(residual))
    else:
        squares = _squares(tiles, vacuum, blur, gain)
        with np.errstate(invalid="ignore"):  # pixels of bad frames
            noise = np.asarray(squares.reshape(len(squares), -1).std(axis=1), dtype=np.float64)
        if job.settings.window_blur_px != blur:
            squares = _squares(tiles, vacuum, job.settings.window_blur_px, gain)
        empty = _empty_strengths(squares, start, job)
    with np.errstate(divide="ignore", invalid="ignore"):  # vacuum without noise
        return noise, _white_noise_left(blur) / noise[:, None], empty


def _status(
    fits: GaussianFits, held: NDArray[np.bool_], outside: NDArray[np.bool_], bad: NDArray[np.bool_], weakest: Floats
) -> NDArray[np.uint8]:
    """Return what speaks against each fit, (frames, columns); ``weakest`` (frames) is the smallest good amplitude."""
    weak = ~(np.abs(fits.estimates[..., AMPLITUDE]) > weakest[:, None])
    flags = {
        Status.BELOW_NOISE: weak & ~outside,
        Status.NOT_CONVERGED: ~fits.converged & ~outside,
        Status.AT_BOUND: held & ~outside,
        Status.SHAPE_AT_BOUND: fits.at_bound & ~held & ~outside,
        Status.OUTSIDE_FRAME: outside,
        Status.BAD_FRAME: bad,
    }
    status = np.zeros(outside.shape, np.uint8)
    for flag, found in flags.items():
        status |= np.uint8(flag) * found
    return status


def _fit(
    tiles: Tiles, corner: NDArray[np.int64], offset: Floats, job: Job, gain: float
) -> tuple[GaussianFits, Floats, Floats, Floats, NDArray[np.bool_]]:
    """Return fits (frames, columns, ...), centroids (y, x), strengths of matched filters, residuals, which are held.

    Residuals (rms) are NaN where there is vacuum, and so no need of them. A fit is held where a bound other than that
    of a sigma is active. A batch of frames is cut, blurred and fitted at a time, so small that its windows stay in the
    processor's cache. Standard errors are NaN after a filter of whole frames: there is no theory of its noise.
    """
    settings, size = job.settings, job.window_px
    count = corner.shape[:2]
    first, lower, upper = _bounds(job, offset, size)
    batch = max(1, _BATCH_BYTES // (4 * size * size * count[1]))
    parts: list[tuple[Any, ...]] = []
    for start in range(0, count[0], batch):
        part = slice(start, start + batch)
        y, x = corner[part, :, 0], corner[part, :, 1]
        windows = cut_windows(tiles, y, x, size, settings.window_blur_px, gain, start).reshape(-1, size, size)
        fits = fit_gaussians(
            windows,
            *(values[part].reshape(-1, 7) for values in (first, lower, upper)),
            estimator=settings.estimator,
            fixed_shape=settings.shape == "fixed",
            blur_sigma_px=settings.window_blur_px,
            tolerance_px=settings.tolerance_px,
            max_iterations=settings.max_iterations,
            radius_px=size / 2,
            counting=settings.counting,
        )
        if settings.filters_frames:
            fits.stderr[:], fits.volume_stderr[:] = np.nan, np.nan
        centroid = _centroids(windows, first[part], job)
        strength = strengths(windows, job.filters, np.arange(len(windows)) % count[1]).astype(np.float64)
        residual = np.full(len(windows), np.nan)
        if job.vacuum is None:
            with np.errstate(invalid="ignore"):  # windows of bad frames
                residual = np.sqrt((1 - fits.r_squared) * windows[:, _disc(size)].var(axis=1, dtype=np.float64))
        parts.append((*fits, centroid, strength, residual))
    fields = (np.concatenate(values).reshape(*count, *values[0].shape[1:]) for values in zip(*parts, strict=True))
    *joined, centroid, strength, residual = fields
    fitted = GaussianFits(*joined)
    held = np.zeros(count, np.bool_)
    for k in (AMPLITUDE, X, Y, BACKGROUND):
        low, high, value = lower[..., k], upper[..., k], fitted.estimates[..., k]
        held |= np.minimum(value - low, high - value) < _AT_BOUND * (high - low)
    return fitted, centroid, strength, residual, held


def _centroids(windows: NDArray[np.float32], start: Floats, job: Job) -> Floats:
    """Return the centroids of windows (n, h, w), (n, 2) rows of (y, x), in a mask that begins where the fit does.

    Its radius is that with the least noise for a Gaussian with the column's width.
    """
    sigma = np.sqrt(job.reference[:, SIGMA_A] * job.reference[:, SIGMA_B])
    best = np.full(len(sigma), job.settings.mask_radius_px) if job.settings.mask_radius_px else BEST_RADIUS * sigma
    radius = np.broadcast_to(np.maximum(best, SMALLEST_RADIUS_PX), start.shape[:2]).ravel()
    dark = np.broadcast_to(job.reference[:, AMPLITUDE] < 0, start.shape[:2]).ravel()
    places = start[..., [X, Y]].reshape(-1, 2)
    return window_centroids(windows, places, radius, _reach(job), dark=dark).places[:, ::-1]


def _disc(size: int) -> NDArray[np.bool_]:
    """Return which pixels of a window count, (size, size): those no farther than half its size from the middle one."""
    offset = np.arange(size) - size // 2
    return np.hypot(offset[:, None], offset) <= size / 2


def _damping(settings: FitSettings) -> float:
    """Return by how much the blur for the noise would still reduce the noise of the windows, which is white if raw."""
    still = settings.window_blur_px < settings.noise_blur_px
    return _white_noise_left(settings.noise_blur_px) if still else 1.0


def _white_noise_left(sigma: float) -> float:
    """Return the share of white noise's standard deviation that the blur of pixels by ``sigma`` px leaves."""
    return float((gaussian_kernel(sigma) ** 2).sum())


def _bounds(job: Job, offset: Floats, size: int) -> tuple[Floats, Floats, Floats]:
    """Return start values and bounds, each (frames, columns, 7), in the coordinates of the windows.

    ``offset`` (frames, columns, 2) leads from the summed image to the window: drift less corner, (y, x).
    """
    settings, reference = job.settings, job.reference
    amplitude = settings.amplitude_factor * reference[:, AMPLITUDE]
    span = np.abs(reference[:, BACKGROUND]) + np.abs(amplitude)
    narrow, wide = reference[:, SIGMA_B] / settings.sigma_factor, reference[:, SIGMA_A] * settings.sigma_factor
    bounds = {
        AMPLITUDE: (np.minimum(0, amplitude), np.maximum(0, amplitude)),
        SIGMA_A: (narrow, wide),
        SIGMA_B: (narrow, wide),
        THETA: (-np.inf, np.inf),
        BACKGROUND: (reference[:, BACKGROUND] - span, reference[:, BACKGROUND] + span),
    }
    start, lower, upper = (np.empty((*offset.shape[:2], 7)) for _ in range(3))
    start[...] = reference
    for k, (low, high) in bounds.items():
        lower[..., k], upper[..., k] = low, high
    reach = _reach(job)
    for k, shift in ((Y, offset[..., 0]), (X, offset[..., 1])):
        start[..., k] += shift
        lower[..., k], upper[..., k] = start[..., k] - reach, start[..., k] + reach
    return start, lower, upper


def _reach(job: Job) -> float:
    """Return how far a column may be from its place in the summed image, along x and along y, px."""
    return min(job.settings.max_shift_px or job.window_px / 4, job.window_px / 2)


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


def _read(
    movie: Movie, start: int, stop: int, job: Job, corner: NDArray[np.int64], vacuum: NDArray[np.int64] | None
) -> Tiles:
    """Return the tiles of some frames that the windows (first row and column of each), or the vacuum, touch."""
    halo = gaussian_kernel(job.settings.noise_blur_px).size // 2
    boxes = [np.concatenate([corner - halo, corner + job.window_px + halo], axis=-1)]
    if vacuum is not None:
        first, side = vacuum[:, :2], vacuum[:, 2:]
        boxes.append(np.concatenate([first - halo, first + side + halo], axis=-1))
    return movie.read_tiles(start, stop, np.concatenate(boxes))


def _squares(tiles: Tiles, vacuum: NDArray[np.int64], blur_sigma_px: float, gain: float) -> NDArray[np.float32]:
    """Return the squares of vacuum of some frames, (frames, side, side), after that blur."""
    return cut_windows(tiles, vacuum[:, :1], vacuum[:, 1:2], int(vacuum[0, 2]), blur_sigma_px, gain)[:, 0]


def _empty_strengths(squares: NDArray[np.float32], start: int, job: Job) -> NDArray[np.float32]:
    """Return the strengths of matched filters in vacuum, (frames, places); NaN where no window fits into the squares.

    The places lie on a grid over the square. Each has the filter of one column in one frame, and of the next one in the
    next, whichever shard the frame is in.
    """
    n_frames, n_places, side = len(squares), SIZES["place"], math.isqrt(SIZES["place"])
    if squares.shape[-1] < job.window_px:
        return np.full((n_frames, n_places), np.nan, np.float32)
    corners = np.rint(np.linspace(0, squares.shape[-1] - job.window_px, side)).astype(int)
    windows = [squares[:, y : y + job.window_px, x : x + job.window_px] for y in corners for x in corners]
    which = (start + np.arange(n_frames)[:, None] + np.arange(n_places)) % len(job.reference)
    found = strengths(np.stack(windows, axis=1).reshape(-1, job.window_px, job.window_px), job.filters, which.ravel())
    return found.reshape(n_frames, n_places)
