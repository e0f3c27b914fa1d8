"""One shard of frames to numbers: windows, bounds, fits, intensities, flags, noise and refined drift."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .filtering import filter_frame
from .kernels.centroids import BEST_RADIUS, SMALLEST_RADIUS_PX, window_centroids
from .kernels.filters import Tiles, cut_windows, gaussian_kernel
from .kernels.fitting import GaussianFits, fit_gaussians
from .kernels.magnitude import unit_of
from .kernels.presence import Filters, matched_filters, strengths
from .movie import Movie
from .schema import AMPLITUDE, BACKGROUND, REJECTED, SIGMA_A, SIGMA_B, SIZES, THETA, Status, X, Y
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

    @cached_property
    def filters(self) -> Filters:
        """The matched filter of each column, by which it is told whether it is there."""
        return matched_filters(self.reference, self.window, self.settings.window_blur_px)

    @cached_property
    def unit(self) -> float:
        """Counts in the unit that frames are computed in."""
        return unit_of(self.reference[:, [AMPLITUDE, BACKGROUND]])

    @cached_property
    def in_units(self) -> Job:
        """The same with the reference's counts in that unit."""
        if self.unit == 1:
            return self
        reference = self.reference.copy()
        reference[:, [AMPLITUDE, BACKGROUND]] /= self.unit
        return replace(self, reference=reference)


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
    corner = np.rint(place).astype(np.int64) - job.window // 2
    outside = np.any((corner < 0) | (corner + job.window > np.array(movie.shape[1:])), axis=-1)
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
    refined: Floats = drift + _common_motion(fits, status, drift, job)
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
) -> tuple[GaussianFits, Floats, Floats, Floats, NDArray[np.bool_]]:
    """Return fits (frames, columns, ...), centroids (y, x), strengths of matched filters, residuals, which are held.

    Residuals (rms) are NaN where there is vacuum, and so no need of them. A fit is held where a bound other than that
    of a sigma is active. A batch of frames is cut, blurred and fitted at a time, so small that its windows stay in the
    processor's cache. Standard errors are NaN after a filter of whole frames: there is no theory of its noise.
    """
    settings, size = job.settings, job.window
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
    return min(job.settings.max_shift_px or job.window / 4, job.window / 2)


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
    boxes = [np.concatenate([corner - halo, corner + job.window + halo], axis=-1)]
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
    if squares.shape[-1] < job.window:
        return np.full((n_frames, n_places), np.nan, np.float32)
    corners = np.rint(np.linspace(0, squares.shape[-1] - job.window, side)).astype(int)
    windows = [squares[:, y : y + job.window, x : x + job.window] for y in corners for x in corners]
    which = (start + np.arange(n_frames)[:, None] + np.arange(n_places)) % len(job.reference)
    found = strengths(np.stack(windows, axis=1).reshape(-1, job.window, job.window), job.filters, which.ravel())
    return found.reshape(n_frames, n_places)


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
