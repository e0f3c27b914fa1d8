"""One shard of frames to numbers: windows, bounds, fits, intensities, flags, noise and refined drift."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...kernels import linear_motion
from ...kernels.filling import fill_near
from ...kernels.gaussian.intensity import INTENSITY_SCALE, Floats, intensities
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from ...kernels.presence import strengths
from ...kernels.windows import Tiles, cut_windows, gaussian_kernel
from ...settings.run import FitSettings
from ...store.movie import Movie
from ...store.schema import SIZES, Status, is_accepted
from ...store.shards import Shard
from .common_motion import CommonMotion, common_motion, masked_median
from .filters import above_offset, filter_frame
from .frame_fits import FrameFits
from .goodness import p_values
from .incomplete import cut_raw, fit_incomplete
from .job import Job
from .joint_fits import Frames, fit_groups
from .levels import Vacuum, noise_at_columns, noise_without_vacuum
from .noise_size import frame_noise
from .places import Places
from .same_atom import on_one_atom
from .scan_rows import free_hopped, undone
from .search import search
from .window_fits import bounds_of, fit_windows

Values = dict[str, np.ndarray[Any, Any]]

_BATCH_BYTES = 4 << 20

_LEAST_VACUUM = 0.5
"""So much of the square has to be there."""

_ROUNDS = 4
"""So often windows are cut again where the crystal turns."""

_CERTAIN = 33.4
"""Chi-squared of the four numbers of a linear motion at 0.999999."""


def measure(movie: Movie, shard: Shard, job: Job, *, whole: bool = False) -> Values:
    """Return the values of every fitted variable of :data:`schema.RESULTS` for the frames of one shard.

    Windows are cut where the drift has carried the columns: its integer part picks the pixels, its fraction shifts the
    start of the fit. No pixel is resampled. One layer of tiles is in memory at a time; with a filter of whole frames
    beside it one filtered frame. ``whole`` reads whole frames, which need not begin with a layer of tiles.
    """
    job = job.in_units
    whole = whole or job.settings.filters_frames or job.settings.scan_rows != "off"
    parts = [_measure_frames(*pixels, job) for pixels in _read(movie, shard, job, whole)]
    return {name: np.concatenate([values[name] for values in parts]) for name in parts[0]}


class _Pixels(NamedTuple):
    """The tiles of some frames that hold given boxes."""

    tiles: Callable[[NDArray[np.int64]], Tiles]
    """Of boxes, as :meth:`.movie.Movie.read_tiles` takes them."""
    stop: int
    """The frame after the last one."""
    gain: float
    """What they still lack."""


def _read(movie: Movie, shard: Shard, job: Job, whole: bool) -> Iterator[tuple[Places, _Pixels]]:
    """Yield what lies where, and its pixels: of a layer of tiles, or a whole frame."""
    gain, frame_shape = movie.gain / job.unit, movie.shape[1:]
    for start in range(shard.start, shard.stop, movie.layer_frames):
        stop = min(start + movie.layer_frames, shard.stop)
        if not whole:
            read = partial(movie.read_tiles, start, stop)
            yield Places.of(frame_shape, start, stop, job), _Pixels(read, stop, gain)
            continue
        for number, pixels in enumerate(movie.read(start, stop), start):
            filters = job.settings.filters_frames
            pixels = above_offset(pixels, movie.offset) if filters else pixels
            frame, lacking = (_filtered(pixels, job.settings, gain), 1.0) if filters else (pixels, gain)
            tiles = Tiles(frame[None, None], np.zeros((1, 1), np.int64), frame_shape)
            yield Places.of(frame_shape, number, number + 1, job), _Pixels(partial(_same, tiles), number + 1, lacking)


def _same(tiles: Tiles, _: NDArray[np.int64]) -> Tiles:
    return tiles


def _filtered(frame: NDArray[Any], settings: FitSettings, gain: float) -> NDArray[np.float32]:
    """Return a frame (y, x) after the filter of whole frames; what is missing in it is missing afterwards."""
    if frame.dtype.kind != "f" or (there := np.isfinite(frame)).all() or not there.any():
        return filter_frame(frame, settings, gain)
    return np.where(there, filter_frame(fill_near(frame), settings, gain), np.float32(np.nan))


def _measure_frames(places: Places, pixels: _Pixels, job: Job, rounds: int = _ROUNDS) -> Values:
    """Return the values of some frames, whose positions go from the windows to the frame, and to the summed image.

    Where the crystal has turned or grown so far that windows no longer hold their columns in the middle, they are cut
    again where it has carried them.
    """
    tiles, gain = pixels.tiles(places.boxes(job)), pixels.gain
    in_frame = fit_places(places, tiles, gain, job).without(places.outside, places.bad).moved(places.corner)
    good, window = in_frame.good(places.outside | places.bad[:, None]) & job.counted, job.window_noise
    size, number = frame_noise(in_frame.ratio, good, window.left, window.free)
    in_frame = in_frame.with_noise(size)
    noise, precision, empty = _noise(places, tiles, gain, in_frame, job)
    weakest = job.settings.threshold * job.scale * noise
    status = status_of(in_frame, places, weakest)
    in_frame, rows = undone(in_frame, status, places, tiles, gain, job)
    common = common_motion(in_frame.estimates, status, places.drift, job)
    if rounds and (displaced := _carried(common, places, job)) is not None:
        again = Places.of(tiles.shape, places.start, pixels.stop, job, displaced)
        return _measure_frames(again, pixels, job, rounds - 1)
    drift: Floats = places.drift + common.shift
    hopped = search(in_frame, status, places, pixels.tiles, gain, (precision, size), common.shift, job)
    free_hopped(in_frame, hopped, rows, job)
    status = status_of(in_frame, places, weakest) | np.where(hopped, Status.HOPPED, 0).astype(np.uint16)
    home = job.reference[:, [Y, X]] + drift[:, None] + places.displaced
    taken = on_one_atom(in_frame.estimates, home, is_accepted(status), job.near)
    status |= np.where(taken, Status.SAME_ATOM | Status.BELOW_NOISE, 0).astype(np.uint16)
    fits = in_frame.moved(-drift[:, None]).scaled(job.unit)
    fits.estimates[..., BACKGROUND] -= job.dark_variance
    chance = p_values(in_frame.ratio, size, window.left, window.level, job.freedom, number)
    intensity, intensity_error = intensities(fits.estimates, job.settings.intensity_scale, job.dark_variance)
    return {
        "fit": fits.estimates,
        "stderr": fits.stderr,
        "centroid": fits.centroid,
        "intensity": intensity,
        "intensity_error": intensity_error,
        "intensity_stderr": INTENSITY_SCALE[job.settings.intensity_scale] * fits.volume_stderr,
        "status": status,
        "presence": np.where(places.lost[:, None], np.nan, fits.strength * precision),
        "presence_vacuum": empty,
        "r_squared": fits.r_squared,
        "p_value": np.where(in_frame.incomplete | job.settings.filters_frames, np.nan, chance).astype(np.float32),
        "n_iterations": fits.n_iterations,
        "drift": drift,
        "motion": np.zeros((len(drift), SIZES["motion_kind"])),
        "motion_measured": common.linear,
        "motion_stderr": common.stderr,
        "noise": job.unit * noise,
        **rows,
    }


def _carried(common: CommonMotion, places: Places, job: Job) -> Floats | None:
    """Return how far (y, x) linear motion carries the columns, (frames, columns, 2); None where windows are good.

    It counts where it stands out of its errors, and is more than a quarter of how far a column may be from its place.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        certain = ((common.linear / common.stderr) ** 2).sum(axis=1) > _CERTAIN
    motion = np.where(certain[:, None], common.linear, 0)
    displaced = (linear_motion.moved(job.from_centre, motion) - job.from_centre)[..., ::-1]
    more = np.hypot(*np.moveaxis(displaced - places.displaced, -1, 0)).max(axis=1, initial=0)
    return displaced if (more > job.reach_px / 4).any() else None


def _noise(
    places: Places, tiles: Tiles, gain: float, fits: FrameFits, job: Job
) -> tuple[Floats, Floats, NDArray[np.float32]]:
    """Return the noise at the columns, what makes strengths of matched filters, (frames, columns), and those in vacuum.

    Where there is no vacuum, the noise is that of the fits' residuals. Where the level of the vacuum does not tell the
    columns' noise, it is that of the vacuum, and strengths are NaN. Those in vacuum are (frames, places).
    """
    blur, residual, white = job.settings.noise_blur_px, fits.residual, noise_left(job.settings.noise_blur_px)
    if places.vacuum is None:
        common = damping(job) / job.left_over * masked_median(residual, np.isfinite(residual))
        known = noise = noise_without_vacuum(common, job.reference, job.settings)
        empty = np.full((len(residual), SIZES["place"]), np.nan)
    else:
        squares, there = _squares(tiles, places.vacuum, blur, gain)
        with np.errstate(invalid="ignore"):  # pixels of bad frames
            flat = squares.reshape(len(squares), -1)
            vacuum = Vacuum(
                flat.std(axis=1, dtype=np.float64) / np.sqrt(there), flat.mean(axis=1, dtype=np.float64) - job.floor
            )
        known = noise_at_columns(vacuum, fits.estimates, job.reference, job.settings)
        noise = np.where(np.isfinite(known), known, vacuum.noise[:, None])
        if job.settings.window_blur_px != blur:
            squares, _ = _squares(tiles, places.vacuum, job.settings.window_blur_px, gain)
        with np.errstate(divide="ignore", invalid="ignore"):
            empty = _empty_strengths(squares, places.start, job) * (white / vacuum.noise[:, None])
    with np.errstate(divide="ignore", invalid="ignore"):  # frames without noise
        return noise, np.where(known > 0, white / known, np.nan), empty.astype(np.float32)


def status_of(fits: FrameFits, places: Places, weakest: Floats) -> NDArray[np.uint16]:
    """Return what speaks against each fit, (frames, columns); ``weakest``, alike, is the smallest good amplitude."""
    inside, amplitude = ~places.outside, np.abs(fits.estimates[..., AMPLITUDE])
    flags = {
        Status.BELOW_NOISE: ~(amplitude > weakest) & inside & ~(fits.incomplete & np.isnan(amplitude)),
        Status.NOT_CONVERGED: ~fits.converged & inside,
        Status.AT_BOUND: fits.held & inside,
        Status.SHAPE_AT_BOUND: fits.at_bound & ~fits.held & inside,
        Status.INCOMPLETE: fits.incomplete & inside & ~places.bad[:, None],
        Status.OUTSIDE_FRAME: places.outside,
        Status.BAD_FRAME: places.bad[:, None],
        Status.LOST_FRAME: places.lost[:, None],
    }
    status = np.zeros(inside.shape, np.uint16)
    for flag, found in flags.items():
        status |= np.uint16(flag) * found
    return status


def fit_places(places: Places, tiles: Tiles, gain: float, job: Job) -> FrameFits:
    """Return what the windows give, in their coordinates.

    A batch of frames is cut, blurred and fitted at a time, so small that its windows stay in the processor's cache.
    """
    n_frames, n_columns = places.outside.shape
    batch = max(1, _BATCH_BYTES // (4 * job.window_px**2 * n_columns))
    offset = places.drift[:, None] + places.displaced - places.corner
    bounds, parts = bounds_of(offset, np.arange(n_columns), job), []
    for start in range(0, n_frames, batch):
        part = slice(start, start + batch)
        y, x = places.corner[part, :, 0], places.corner[part, :, 1]
        windows = cut_windows(tiles, y, x, job.window_px, job.settings.window_blur_px, gain, start)
        if job.floor:
            windows -= job.floor
        limits = [values[part].reshape(-1, 7) for values in bounds]
        fits = fit_windows(windows.reshape(-1, *windows.shape[2:]), limits, np.arange(y.size) % n_columns, job)
        sound = ~(places.outside[part] | places.bad[part, None])
        real = tiles.pixels.dtype.kind == "f"
        if real and (missing := ~np.isfinite(windows.sum(axis=(2, 3)).ravel()) & sound.ravel()).any():
            _fit_again(fits, np.flatnonzero(missing), (tiles, start, places.corner[part], gain), limits, job)
        fit_groups(
            fits,
            Frames(tiles, start, gain, places.drift[part], places.displaced[part], places.corner[part]),
            limits,
            job,
        )
        fits.estimates[:, [X, Y]] -= np.tile(job.drawn, (len(y), 1))
        parts.append(fits)
    return FrameFits.joined(parts, places.outside.shape)


def _fit_again(
    fits: FrameFits,
    which: NDArray[np.int64],
    pixels: tuple[Tiles, int, NDArray[np.int64], float],
    bounds: Sequence[Floats],
    job: Job,
) -> None:
    """Fit the windows of these numbers, in which pixels are missing, to those that are there; replace their fits.

    Parameters
    ----------
    pixels
        Tiles, number of the first frame, the corners (frames, columns, 2) of the windows from there on, and the gain.
    """
    tiles, first, corners, gain = pixels
    halo = gaussian_kernel(job.settings.window_blur_px).size // 2
    frame, column = np.divmod(which, corners.shape[1])
    raw = cut_raw(tiles, first + frame, corners[frame, column] - halo, job.window_px + 2 * halo, gain) - job.floor

    def fit(windows: NDArray[np.float32], numbers: NDArray[np.int64]) -> FrameFits:
        return fit_windows(windows, [values[which[numbers]] for values in bounds], column[numbers], job)

    found, missing, lost = fit_incomplete(raw, job.settings, fit, job.full_scale_in_unit)
    lost |= missing & ~job.known[column]  # neither the place nor the shape of such a column was ever seen whole
    for name, values in vars(found).items():
        vars(fits)[name][which] = values
    fits.incomplete[which] = missing
    for flags in (fits.converged, fits.held, fits.at_bound):
        flags[which[lost]] = False
    for values in (fits.estimates, fits.centroid, fits.strength):
        values[which[lost]] = np.nan


def damping(job: Job) -> float:
    """Return by how much the blur for the noise would still reduce the noise of the windows."""
    settings = job.settings
    still = settings.window_blur_px < settings.noise_blur_px
    return noise_left(settings.noise_blur_px, job.correlation) if still else 1.0


def noise_left(sigma: float, correlation: Sequence[Sequence[float]] | None = None) -> float:
    """Return the share of the noise's standard deviation that the blur of pixels by ``sigma`` px leaves.

    ``correlation`` is the autocorrelation of the pixels' noise, None where they share none.
    """
    kernel = gaussian_kernel(sigma).astype(np.float64)
    if correlation is None:
        return float(kernel @ kernel)
    lags = np.convolve(kernel, kernel)
    spread = [np.convolve(row, lags) for row in np.asarray(correlation)]
    along_y = np.convolve(np.array(spread)[:, len(spread[0]) // 2], lags)
    return math.sqrt(max(0.0, float(along_y[len(along_y) // 2])))


def _squares(
    tiles: Tiles, vacuum: NDArray[np.int64], blur_sigma_px: float, gain: float
) -> tuple[NDArray[np.float32], Floats]:
    """Return the squares of vacuum of some frames, (frames, side, side), after that blur, and what is there of each.

    Pixels that are missing are filled with the mean of what is near, unless most of the square is missing.
    """
    side = int(vacuum[0, 2])
    squares = cut_windows(tiles, vacuum[:, :1], vacuum[:, 1:2], side, blur_sigma_px, gain)[:, 0]
    halo, share = gaussian_kernel(blur_sigma_px).size // 2, np.ones(len(squares))
    for k in np.flatnonzero(~np.isfinite(squares.sum(axis=(1, 2)))):
        raw = cut_raw(tiles, np.array([k]), vacuum[k : k + 1, :2] - halo, side + 2 * halo, gain)[0]
        there = np.isfinite(raw).mean()
        if there > _LEAST_VACUUM:
            corner = np.array([[halo]])
            share[k], squares[k] = there, cut_windows(fill_near(raw)[None], corner, corner, side, blur_sigma_px)[0, 0]
    return squares, share


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
