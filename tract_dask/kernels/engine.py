"""The fitter's way in and out: windows and float64 parameters of Equation 1 in, estimates and standard errors out.

Three compiled functions do the work: the level of each window, the steps, and the standard errors. In between, all fits
at once are turned from Equation 1's parameters into those of the steps and back, by numpy.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from .covariance import N_ERROR_ROOM, N_ERRORS, Noise, likelihood_errors, room_in, standard_errors
from .iteration import (
    BOUNDS,
    CONVERGED,
    DAMPING,
    FACTOR,
    FIRST_DAMPING,
    N_STATE,
    NO_INFORMATION,
    OFFSET,
    OUTCOME,
    PIXELS,
    POINT,
    RUNNING,
    SHAPE_FREE,
    STEPS,
    SUMS,
    TRIAL,
    gather,
    run,
)
from .moments import INNER, MERIT, N_ROOM, N_ROW_SUMS, RESIDUAL, Array, Grid, chords, count_pixels, powers
from .simd import LANES, aligned_rows, larger, load, load_at, number, opaque, rows_of, smaller, store, vector
from .steps import (
    AMPLITUDE,
    BACKGROUND,
    COS,
    CURVATURE_U,
    CURVATURE_V,
    LOWER,
    N_PARAMETERS,
    N_SYSTEM,
    SIN,
    UPPER,
    X,
    Y,
    system_in,
)

AT_BOUND, NOT_FINITE = 1, 4
_LARGEST = np.float32(3e38)
_STRIDE_SIGMA = 1.0
_LOOSE_PX = 0.03  # near enough for the likelihood to be quadratic
_LEAST_RANGE = 1e-35  # below this float32 runs out of digits


class Results(NamedTuple):
    """What :func:`fit_windows` writes, a row a window."""

    estimates: Array
    """(n, 7) float64: the start before, the estimates after."""
    stderr: Array
    """(n, 7) float64."""
    volume_stderr: Array
    """(n,) float64."""
    r_squared: Array
    """(n,) float32."""
    n_iterations: Array
    """(n,) int16."""
    status: Array
    """(n,) uint8."""


class Options(NamedTuple):
    """What is the same for every window of a batch."""

    poisson: bool
    fixed_shape: bool
    tolerance_px: float
    max_iterations: int


class Frame(NamedTuple):
    """What the compiled functions share: the pixels of a window, and room to work in."""

    sides: tuple[int, int, int, int]
    """Height, width, number of pixels that count, and where 0 is among the powers."""
    powers: Array
    chords: Array
    room: Array
    """(rows, LANES) float32."""
    fits: Array
    starts: Array
    """(LANES,) int64."""


def _frame(height: int, width: int, radius: float) -> Frame:
    """Return what fits of windows of that size need; pixels farther than ``radius`` from the middle do not count."""
    reach = chords(height, width, radius)
    rows = N_ROW_SUMS * height + height * width + 2 * N_STATE + 2 * N_ROOM + N_SYSTEM + N_ERROR_ROOM
    return Frame(
        (height, width, count_pixels(reach, width), max(height, width)),
        powers(height, width),
        reach,
        aligned_rows(rows),
        np.empty(LANES, np.int64),
        np.empty(LANES, np.int64),
    )


@njit(**INNER)
def _level(images: Array, first: int, n_pixels: int, room: Any) -> Any:
    """Return the mean, the smallest, and the largest of the pixels from the ``first`` on."""
    total, least, largest = vector(np.float32(0)), vector(_LARGEST), vector(-_LARGEST)
    whole = n_pixels - n_pixels % LANES
    for i in range(first, first + whole, LANES):
        values = load_at(images, i)
        total += values
        least, largest = smaller(values, least), larger(values, largest)
    store(room, 0, total)
    store(room, 1, least)
    store(room, 2, largest)
    mean, low, high = np.float32(0), _LARGEST, -_LARGEST
    for lane in range(opaque(LANES)):
        mean += number(room, lane)
        low = min(low, number(room, LANES + lane))
        high = max(high, number(room, 2 * LANES + lane))
    for i in range(first + whole, first + n_pixels):
        mean, low, high = mean + images[i], min(low, images[i]), max(high, images[i])
    return mean / np.float32(n_pixels), low, high


def _compiled(sources: str) -> Any:
    """Return the compiled functions (find_levels, iterate, find_errors).

    Numba's cache on disk only knows changes of the file that holds them, and the values that they close over: so they
    close over a digest of all of the fitter's files. ``likelihood`` is None for least squares: then what only maximum
    likelihood needs is not compiled.
    """

    @njit(cache=True, nogil=True, error_model="numpy")
    def find_levels(images: Array, n_pixels: int, room: Array, levels: Array) -> str:
        """Write the mean, the smallest, and the largest pixel of each window, (n, 3) float32."""
        for n in range(len(levels)):
            levels[n, 0], levels[n, 1], levels[n, 2] = _level(images, n * n_pixels, n_pixels, rows_of(room))
        return sources

    @njit(cache=True, nogil=True, error_model="numpy")
    def iterate(images: Array, frame: Frame, table: Array, queue: Array, limits: Any, likelihood: Any) -> str:
        """Fit the windows, of which ``images`` are all pixels in a row, whose rows of the table are in the queue."""
        height, width, n_pixels, half = frame.sides
        block = rows_of(frame.room)
        sums = block + height * width
        grid = Grid(height, width, n_pixels, half, rows_of(frame.powers), rows_of(frame.chords), sums)
        state = sums + N_ROW_SUMS * height
        room = state + N_STATE
        rooms = block, state, room, system_in(room + 2 * N_ROOM), frame.fits, frame.starts
        run(images, grid, rooms, rows_of(table), queue, likelihood, limits)
        return sources

    @njit(cache=True, nogil=True, error_model="numpy")
    def find_errors(
        frame: Frame, stride: int, table: Array, queue: Array, noise: Noise, likelihood: Any, out: Array
    ) -> str:
        """Write the standard errors (n, N_ERRORS) of the fits in the queue, sampled every ``stride`` px."""
        height, width, n_pixels, half = frame.sides
        sums = rows_of(frame.room)
        grid = Grid(height, width, n_pixels, half, rows_of(frame.powers), rows_of(frame.chords), sums)
        state = sums + N_ROW_SUMS * height
        errors = state + N_STATE
        room = errors + N_ERRORS
        work = system_in(room + N_ERROR_ROOM), room_in(room)
        point, own, bounds = state + POINT, state + SUMS, state + BOUNDS
        for begin in range(0, queue.size, LANES):
            lanes = min(LANES, queue.size - begin)
            for lane in range(lanes):
                frame.fits[lane] = queue[begin + lane]
            gather(rows_of(table), frame.fits, lanes, frame.starts, state)
            free = load(state, SHAPE_FREE)
            if likelihood is None:
                scales = load(state, OFFSET) * load(state, FACTOR), free
                standard_errors(grid, stride, point, own, bounds, scales, noise, work, errors)
            else:
                likelihood_errors(point, own, bounds, (vector(np.float32(n_pixels)), free), work, errors)
            for lane in range(lanes):
                for k in range(N_ERRORS):
                    out[frame.fits[lane], k] = number(errors, k * LANES + lane)
        return sources

    return find_levels, iterate, find_errors


_SOURCES = ("simd", "moments", "steps", "iteration", "covariance", "engine")
_find_levels, _iterate, _find_errors = _compiled(
    hashlib.sha256(b"".join(Path(__file__).with_name(f"{name}.py").read_bytes() for name in _SOURCES)).hexdigest()
)


def fit_windows(
    images: Array,
    size: tuple[int, int, float],
    lower: Array,
    upper: Array,
    options: Options,
    noise: Noise,
    results: Results,
) -> None:
    """Fit the windows (n, height * width), float32, from the start in ``results.estimates``, within (n, 7).

    ``size`` is (height, width, radius of the disc of pixels that count).
    """
    height, width, radius = size
    n, pixels = len(images), images.reshape(-1)
    frame = _frame(height, width, radius)
    table = aligned_rows(n * N_STATE // LANES).reshape(n, N_STATE)
    levels = np.empty((n, 3), np.float32)
    _find_levels(pixels, height * width, frame.room, levels)
    _scale(levels, results.status, table)
    middle = width // 2, height // 2
    _enter(results.estimates, lower, upper, middle, options.fixed_shape, table)
    queue = np.flatnonzero(table[:, OUTCOME] == RUNNING)
    for likelihood in (None, True) if options.poisson else (None,):
        if likelihood:
            _to_likelihood(table, queue)
        last = bool(likelihood) == options.poisson
        tolerance = options.tolerance_px if last else max(_LOOSE_PX, options.tolerance_px)
        limits = np.float32(tolerance), np.float32((2 if likelihood else 1) * options.max_iterations)
        _iterate(pixels, frame, table, queue.copy(), limits, likelihood)
    results.status[:] = table[:, OUTCOME]
    if queue.size:
        _leave(table, queue, frame.sides[2], lower, upper, middle, options.fixed_shape, results)
        _write_errors(frame, table, queue, options.poisson, noise, results)


def _scale(levels: Array, status: Array, table: Array) -> None:
    """Write offset and factor, which bring the pixels to a mean of 0 and a range of 1, and the outcome so far."""
    with np.errstate(over="ignore", invalid="ignore"):
        mean, span = levels[:, 0], levels[:, 2] - levels[:, 1]
        finite = np.isfinite(mean)
        usable = finite & (span > _LEAST_RANGE) & np.isfinite(span)
    table[:, OFFSET] = np.where(finite, mean, 0)
    table[:, FACTOR] = 1 / np.where(usable, span, 1)
    table[:, OUTCOME] = np.where(usable, RUNNING, NO_INFORMATION)
    table[~finite | (status == NOT_FINITE), OUTCOME] = NOT_FINITE


def _linear(middle: tuple[int, int], table: Array) -> Any:
    """Return for amplitude, x, y and background: place among the parameters, the point, the bounds; zero, unit."""
    offset, factor = table[:, OFFSET].astype(np.float64), table[:, FACTOR].astype(np.float64)
    return (
        (0, AMPLITUDE, 0, 0.0, factor),
        (1, X, 1, middle[0], 1.0),
        (2, Y, 2, middle[1], 1.0),
        (6, BACKGROUND, 4, offset, factor),
    )


def _enter(start: Array, lower: Array, upper: Array, middle: tuple[int, int], fixed_shape: bool, table: Array) -> None:
    """Write the table's rows, given offset and factor there; ``middle`` is the window's middle pixel."""
    for i, at, bound, zero, unit in _linear(middle, table):
        table[:, TRIAL + at] = (start[:, i] - zero) * unit
        table[:, BOUNDS + LOWER + bound] = np.clip((lower[:, i] - zero) * unit, -_LARGEST, _LARGEST)
        table[:, BOUNDS + UPPER + bound] = np.clip((upper[:, i] - zero) * unit, -_LARGEST, _LARGEST)
    table[:, BOUNDS + LOWER + 3], table[:, BOUNDS + UPPER + 3] = 1 / upper[:, 3] ** 2, 1 / lower[:, 3] ** 2
    cos, sin = np.cos(start[:, 5]), -np.sin(start[:, 5])
    u, v = 1 / start[:, 3] ** 2, 1 / start[:, 4] ** 2
    exchange = np.abs(sin) > np.abs(cos)
    cos, sin = np.where(exchange, sin, cos), np.where(exchange, -cos, sin)
    table[:, TRIAL + COS], table[:, TRIAL + SIN] = np.abs(cos), np.where(cos < 0, -sin, sin)
    table[:, TRIAL + CURVATURE_U], table[:, TRIAL + CURVATURE_V] = np.where(exchange, v, u), np.where(exchange, u, v)
    table[:, POINT : POINT + N_PARAMETERS] = table[:, TRIAL : TRIAL + N_PARAMETERS]
    table[:, SUMS + MERIT], table[:, DAMPING], table[:, STEPS] = _LARGEST, FIRST_DAMPING, 0
    table[:, SHAPE_FREE] = not fixed_shape


def _to_likelihood(table: Array, queue: Array) -> None:
    """Let fits go on from where least squares ended, with nothing subtracted from the pixels."""
    rows = table[queue]
    level = rows[:, OFFSET] * rows[:, FACTOR]
    for at in (POINT + BACKGROUND, BOUNDS + LOWER + 4, BOUNDS + UPPER + 4):
        rows[:, at] += level
    rows[:, TRIAL : TRIAL + N_PARAMETERS] = rows[:, POINT : POINT + N_PARAMETERS]
    rows[:, OFFSET], rows[:, DAMPING], rows[:, OUTCOME] = 0, FIRST_DAMPING, RUNNING
    table[queue] = rows


def _leave(
    table: Array,
    queue: Array,
    n_pixels: int,
    lower: Array,
    upper: Array,
    middle: tuple[int, int],
    fixed_shape: bool,
    results: Results,
) -> None:
    """Write the estimates of the fits in the queue, exactly on the bounds that they are on, and how they ended."""
    fits = slice(None) if queue.size == len(table) else queue
    rows, lower, upper, estimates = table[fits], lower[fits], upper[fits], results.estimates[fits]
    for i, at, bound, zero, unit in _linear(middle, rows):
        value = rows[:, POINT + at]
        free = np.clip(value / unit + zero, lower[:, i], upper[:, i])
        free = np.where(value >= rows[:, BOUNDS + UPPER + bound], upper[:, i], free)
        estimates[:, i] = np.where(value <= rows[:, BOUNDS + LOWER + bound], lower[:, i], free)
    if not fixed_shape:
        u, v = (rows[:, POINT + at].astype(np.float64) for at in (CURVATURE_U, CURVATURE_V))
        flat, steep = np.minimum(u, v), np.maximum(u, v)
        theta = -np.arctan2(rows[:, POINT + SIN], rows[:, POINT + COS]) - np.where(u > v, np.pi / 2, 0)
        estimates[:, 5] = theta - np.pi * np.ceil(theta / np.pi - 0.5)
        least, most = lower[:, 3], upper[:, 3]
        wide = np.where(flat <= rows[:, BOUNDS + LOWER + 3], most, 1 / np.sqrt(flat))
        narrow = np.where(steep >= rows[:, BOUNDS + UPPER + 3], least, 1 / np.sqrt(steep))
        estimates[:, 3], estimates[:, 4] = np.clip(wide, least, most), np.clip(narrow, least, most)
    at_bound = np.zeros(len(rows), bool)
    for i in (0, 1, 2, 6) if fixed_shape else (0, 1, 2, 3, 4, 6):
        low, high, found = lower[:, i], upper[:, i], estimates[:, i]
        at_bound |= (low < high) & ((found == low) | (found == high))
    outcome = rows[:, OUTCOME]
    results.estimates[fits] = estimates
    results.status[fits] = np.where(at_bound & (outcome == CONVERGED), AT_BOUND, outcome)
    results.n_iterations[fits] = rows[:, STEPS]
    spread = rows[:, PIXELS + 1] - rows[:, PIXELS] ** 2 / n_pixels
    results.r_squared[fits] = np.clip(1 - rows[:, SUMS + RESIDUAL] / spread, 0, 1)


def _write_errors(frame: Frame, table: Array, queue: Array, poisson: bool, noise: Noise, results: Results) -> None:
    """Write the standard errors of all converged fits; those that may be sampled alike share a block."""
    fits = queue[table[queue, OUTCOME] == CONVERGED]
    rows, likelihood = table if fits.size == len(table) else table[fits], True if poisson else None
    errors = np.empty((len(table), N_ERRORS), np.float32)
    strides = _strides(rows, min(frame.sides[:2]))
    for stride in (1, 2, 4):
        if (strides == stride).any():
            _find_errors(frame, stride, table, fits[strides == stride], noise, likelihood, errors)
    found, (a, b) = errors[fits].astype(np.float64), results.estimates[fits, 3:5].T
    factor, swapped = rows[:, FACTOR].astype(np.float64), rows[:, POINT + CURVATURE_U] > rows[:, POINT + CURVATURE_V]
    stderr = np.empty((len(fits), 7))
    stderr[:, 0], stderr[:, 6] = found[:, 0] / factor, found[:, 6] / factor
    stderr[:, 1:3] = found[:, 1:3]
    stderr[:, 3] = 0.5 * a * np.where(swapped, found[:, 5], found[:, 3])
    stderr[:, 4] = 0.5 * b * np.where(swapped, found[:, 3], found[:, 5])
    turn, apart = found[:, 4], (a - b) * (a + b)
    with np.errstate(divide="ignore", invalid="ignore"):
        of_theta = np.where(apart > 0, np.minimum(turn * a * b / apart, math.pi / 2), math.pi / 2)
    stderr[:, 5] = np.where(np.isnan(turn), np.nan, of_theta)
    results.stderr[fits] = stderr
    results.volume_stderr[fits] = np.abs(2 * math.pi * results.estimates[fits, 0] * a * b) * found[:, 7]


def _strides(rows: Array, size: int) -> Array:
    """Return how coarsely each fit's Gaussian may be sampled, in px."""
    sigma = 1 / np.sqrt(np.maximum(rows[:, POINT + CURVATURE_U], rows[:, POINT + CURVATURE_V]))
    coarsest = max(stride for stride in (1, 2, 4) if stride == 1 or size >= 4 * stride)
    return np.minimum(np.where(sigma >= 4 * _STRIDE_SIGMA, 4, np.where(sigma >= 2 * _STRIDE_SIGMA, 2, 1)), coarsest)
