"""The fitter's way in and out: windows and float64 parameters of Equation 1 in, estimates and standard errors out.

Four compiled functions do the work: parameters and bounds of all fits go into the rows of a table; the steps; the
standard errors; and estimates and errors come out of the table.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from ..vectors.simd import aligned_rows, number, rows_of
from ..vectors.tracing import INLINE, LANES, Rows, traced
from .covariance import FREEDOM, LEVEL, N_ERRORS, RATIO, Noise, standard_errors
from .iteration import (
    BOUNDS,
    CONVERGED,
    DAMPING,
    FACTOR,
    FIRST_DAMPING,
    N_STATE,
    NOT_FINITE,
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
from .moments import (
    AMPLITUDE_ROW,
    BACKGROUND_ROW,
    COS,
    CURVATURE_U,
    CURVATURE_V,
    MERIT,
    N_PARAMETERS,
    N_ROW_SUMS,
    N_SUMS,
    RESIDUAL,
    SIN,
    Array,
    Grid,
    X,
    Y,
    chords,
    count_pixels,
    powers,
)
from .steps import LOWER, N_SYSTEM, UPPER

AT_BOUND = 1
_LARGEST = 3e38
_STRIDE_SIGMA = 1.0
_STRIDES_ACROSS = 10  # a window, whose edge is as coarse as the stride
_LOOSE_PX = 0.03  # near enough for the likelihood to be quadratic


class Results(NamedTuple):
    """What :func:`fit_windows` writes, a row a window."""

    estimates: Array
    """(n, 7) float64."""
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
    noise: Array
    """(n,) float64."""
    freedom: Array
    """(n,) float64."""


class Problem(NamedTuple):
    """Start, lower and upper bounds: (n, 7) float64, or (1, 7) for all windows."""

    start: Array
    lower: Array
    upper: Array
    least_sigma: float
    largest_sigma: float
    """What the bounds of the sigmas are cut to, px."""
    fixed_shape: bool


class Options(NamedTuple):
    """What is the same for every window of a batch."""

    poisson: bool
    tolerance_px: float
    max_iterations: int
    radius_px: float
    """Pixels farther than this from the window's middle do not count."""


class Frame(NamedTuple):
    """What the compiled functions share: the pixels of a window, and room to work in."""

    sides: tuple[int, int, int]
    """Height, width, and number of pixels that count."""
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
    rows = height * width + N_ROW_SUMS * height + N_STATE + 2 * N_SUMS + N_SYSTEM + LANES
    return Frame(
        (height, width, count_pixels(reach, width)),
        powers(height, width),
        reach,
        aligned_rows(rows),
        np.empty(LANES, np.int64),
        np.empty(LANES, np.int64),
    )


@njit(**INLINE)
def _grid(frame: Frame, sums: Any) -> Grid:
    """Return the pixels of a window, with room for the sums of its rows."""
    height, width, n_pixels = frame.sides
    half = max(height, width)
    places = rows_of(frame.powers), rows_of(frame.chords), sums
    return Grid(height, width, height // 2, width // 2, n_pixels, half, places[0], places[1], places[2])


_LINEAR = ((0, AMPLITUDE_ROW, 0), (1, X, 1), (2, Y, 2), (6, BACKGROUND_ROW, 4))
"""Where amplitude, x, y and background are among the parameters, in a point, and among the bounds."""


@njit(**INLINE)
def _sigma_bounds(problem: Problem, lower: Array, upper: Array) -> Any:
    """Return the one interval of both sigmas."""
    least = max(min(lower[3], lower[4]), problem.least_sigma)
    most = min(max(upper[3], upper[4]), problem.largest_sigma)
    if problem.fixed_shape:
        least, most = problem.least_sigma, problem.largest_sigma
    return least, most


@njit(**INLINE)
def _to_likelihood(row: Array) -> None:
    """Let a fit go on, with nothing subtracted from the pixels."""
    level = row[OFFSET] * row[FACTOR]
    row[POINT + BACKGROUND_ROW] += level
    row[BOUNDS + LOWER + 4] += level
    row[BOUNDS + UPPER + 4] += level
    for i in range(N_PARAMETERS):
        row[TRIAL + i] = row[POINT + i]
    row[OFFSET], row[DAMPING], row[OUTCOME] = 0, FIRST_DAMPING, RUNNING


@njit(**INLINE)
def _stride(row: Array, size: int) -> int:
    """Return how coarsely a fit's Gaussian may be sampled, in px."""
    sigma = 1 / math.sqrt(max(row[POINT + CURVATURE_U], row[POINT + CURVATURE_V]))
    stride = 4 if sigma >= 4 * _STRIDE_SIGMA else 2 if sigma >= 2 * _STRIDE_SIGMA else 1
    while stride > 1 and size < _STRIDES_ACROSS * stride:
        stride //= 2
    return stride


@traced()
def _find_block(grid: Grid, stride: Any, state: Rows, noise: Any, part: Rows, errors: Rows) -> None:
    """Write the standard errors of the fits of a block."""
    scales = state[OFFSET] * state[FACTOR], state[SHAPE_FREE]
    standard_errors(grid, stride, state + POINT, state + SUMS, state + BOUNDS, scales, noise, part, errors)


@njit(**INLINE)
def _write_errors(errors: Array, swapped: bool, factor: float, found: Array, stderr: Array, of_volume: Array) -> None:
    """Write the standard errors by the parameters of Equation 1, given those by the steps' own."""
    a, b = found[3], found[4]
    stderr[0], stderr[6] = errors[0] / factor, errors[6] / factor
    stderr[1], stderr[2] = errors[1], errors[2]
    stderr[3] = 0.5 * a * (errors[5] if swapped else errors[3])
    stderr[4] = 0.5 * b * (errors[3] if swapped else errors[5])
    apart, turn = (a - b) * (a + b), float(errors[4])
    if turn == turn:  # not held
        stderr[5] = turn * a * b / apart if apart > 0 else np.inf
    of_volume[0] = abs(2 * math.pi * found[0] * a * b) * errors[7]


@njit(**INLINE)
def _enter_fits(problem: Problem, middle: Any, table: Array, estimates: Array) -> int:
    """Write the table's rows and the start within the bounds; return which row's bounds are empty, or -1."""
    one = (
        0 if len(problem.start) == 1 else 1,
        0 if len(problem.lower) == 1 else 1,
        0 if len(problem.upper) == 1 else 1,
    )
    free = np.float32(0 if problem.fixed_shape else 1)
    for n in range(len(table)):
        start, row, found = problem.start[n * one[0]], table[n], estimates[n]
        lower, upper = problem.lower[n * one[1]], problem.upper[n * one[2]]
        row[OUTCOME] = RUNNING
        for i in range(7):
            found[i] = start[i]
            if not abs(start[i]) < np.inf:
                found[i], row[OUTCOME] = 0, NOT_FINITE
        a, b, theta = abs(found[3]), abs(found[4]), found[5]
        if a < b:
            a, b, theta = b, a, theta + 0.5 * math.pi
        least, most = _sigma_bounds(problem, lower, upper)
        if not least <= most:
            return n
        found[3], found[4] = min(max(a, least), most), min(max(b, least), most)
        found[5] = 0.5 * math.pi - (0.5 * math.pi - theta) % math.pi
        for at in range(4):
            i, point, bound = _LINEAR[at]
            if not lower[i] <= upper[i]:
                return n
            found[i] = min(max(found[i], lower[i]), upper[i])
            zero = middle[at]
            row[TRIAL + point] = found[i] - zero
            row[BOUNDS + LOWER + bound], row[BOUNDS + UPPER + bound] = lower[i] - zero, upper[i] - zero
        row[BOUNDS + LOWER + 3], row[BOUNDS + UPPER + 3] = 1 / most**2, 1 / least**2
        u, v, cos, sin = 1 / found[3] ** 2, 1 / found[4] ** 2, math.cos(found[5]), -math.sin(found[5])
        if abs(sin) > abs(cos):
            u, v, cos, sin = v, u, sin, -cos
        row[TRIAL + CURVATURE_U], row[TRIAL + CURVATURE_V] = u, v
        row[TRIAL + COS], row[TRIAL + SIN] = abs(cos), -sin if cos < 0 else sin
        row[SUMS + MERIT], row[DAMPING], row[SHAPE_FREE] = _LARGEST, FIRST_DAMPING, free
    return -1


@njit(**INLINE)
def _fit(images: Array, frame: Frame, table: Array, limits: Any, likelihood: Any) -> None:
    """Fit the windows, of which ``images`` are all pixels in a row.

    ``likelihood`` is None for least squares: then what only maximum likelihood needs is not compiled. Maximum
    likelihood goes on from where least squares ended.
    """
    block = rows_of(frame.room)
    height, width, _ = frame.sides
    sums = block + height * width
    state = sums + N_ROW_SUMS * height
    moments = state + N_STATE
    part = moments + N_SUMS
    rooms = block, state, moments, part, part + N_SUMS, frame.fits, frame.starts
    queue, left = np.empty(len(table), np.int64), 0
    for n in range(len(table)):
        row = table[n]
        if likelihood is not None and row[STEPS] > 0:
            _to_likelihood(row)
        if row[OUTCOME] == RUNNING:
            queue[left] = n
            left += 1
    run(images, _grid(frame, sums), rooms, rows_of(table), queue[:left], likelihood, limits)


@njit(**INLINE)
def _find_all_errors(frame: Frame, table: Array, noise: Any, out: Array) -> None:
    """Write the standard errors (n, N_ERRORS) of the converged fits; those that may be sampled alike share a block.

    ``noise`` is None for maximum likelihood.
    """
    height, width, _ = frame.sides
    sums = rows_of(frame.room)
    state = sums + N_ROW_SUMS * height
    part, errors = state + N_STATE, state + (N_STATE + N_SUMS)
    grid = _grid(frame, sums)
    queue = np.empty(len(table), np.int64)
    for stride in (1, 2, 4):
        left = 0
        for n in range(len(table)):
            if table[n, OUTCOME] == CONVERGED and _stride(table[n], min(height, width)) == stride:
                queue[left] = n
                left += 1
        for begin in range(0, left, LANES):
            lanes = min(LANES, left - begin)
            for lane in range(lanes):
                frame.fits[lane] = queue[begin + lane]
            gather(rows_of(table), frame.fits, lanes, frame.starts, state)
            _find_block(grid, stride, state, noise, part, errors)
            for lane in range(lanes):
                for k in range(N_ERRORS):
                    out[frame.fits[lane], k] = number(errors, k * LANES + lane)


@njit(**INLINE)
def _leave_fits(problem: Problem, kind: Any, middle: Any, table: Array, errors: Array, results: Results) -> None:
    """Write what is known of all fits: estimates exactly on the bounds that they are on, how they ended, errors.

    ``kind`` are the number of pixels that count, and whether a pixel's variance goes with its counts.
    """
    n_pixels, counting = kind
    one = 0 if len(problem.lower) == 1 else 1, 0 if len(problem.upper) == 1 else 1
    for n in range(len(table)):
        row, found, outcome = table[n], results.estimates[n], int(table[n, OUTCOME])
        results.status[n], results.n_iterations[n], results.r_squared[n] = outcome, int(row[STEPS]), 0
        for i in range(7):
            results.stderr[n, i] = np.nan
        results.volume_stderr[n], results.noise[n], results.freedom[n] = np.nan, np.nan, np.nan
        if row[STEPS] == 0:
            continue
        lower, upper = problem.lower[n * one[0]], problem.upper[n * one[1]]
        offset, factor = float(row[OFFSET]), float(row[FACTOR])
        at_bound = False
        for at in range(4):
            i, point, bound = _LINEAR[at]
            value = float(row[POINT + point])
            scaled = (value / factor + offset if i == 6 else value / factor) if i in (0, 6) else value + middle[at]
            found[i] = min(max(scaled, lower[i]), upper[i])
            if row[POINT + point] >= row[BOUNDS + UPPER + bound]:
                found[i] = upper[i]
            if row[POINT + point] <= row[BOUNDS + LOWER + bound]:
                found[i] = lower[i]
            at_bound |= lower[i] < upper[i] and (found[i] == lower[i] or found[i] == upper[i])
        u, v = float(row[POINT + CURVATURE_U]), float(row[POINT + CURVATURE_V])
        if not problem.fixed_shape:
            theta = -math.atan2(row[POINT + SIN], row[POINT + COS]) - (0.5 * math.pi if u > v else 0.0)
            found[5] = theta - math.pi * math.ceil(theta / math.pi - 0.5)
            least, most = _sigma_bounds(problem, lower, upper)
            wide, narrow = 1 / math.sqrt(min(u, v)), 1 / math.sqrt(max(u, v))
            found[3] = most if min(u, v) <= row[BOUNDS + LOWER + 3] else min(max(wide, least), most)
            found[4] = least if max(u, v) >= row[BOUNDS + UPPER + 3] else min(max(narrow, least), most)
            for i in (3, 4):
                at_bound |= least < most and (found[i] == least or found[i] == most)
        first, second = float(row[PIXELS]), float(row[PIXELS + 1])
        explained = 1 - row[SUMS + RESIDUAL] / (second - first * first / n_pixels)
        results.r_squared[n] = min(max(explained, 0.0), 1.0)
        if outcome == CONVERGED:
            results.status[n] = AT_BOUND if at_bound else CONVERGED
            level = errors[n, LEVEL] * factor if counting else factor * factor
            _write_errors(errors[n], u > v, factor, found, results.stderr[n], results.volume_stderr[n : n + 1])
            results.stderr[n] *= math.sqrt(level)
            results.volume_stderr[n] *= math.sqrt(level)
            results.noise[n], results.freedom[n] = errors[n, RATIO] / level, errors[n, FREEDOM]


def _compiled(sources: str) -> Any:
    """Return the compiled functions (enter, iterate, find_errors, leave).

    Numba's cache on disk only knows changes of the file that holds them, and the values that they close over: so they
    close over, and return, a digest of all of the fitter's files.
    """

    @njit(cache=True, nogil=True, error_model="numpy")
    def enter(problem: Problem, middle: Any, table: Array, estimates: Array) -> Any:
        return _enter_fits(problem, middle, table, estimates), sources

    @njit(cache=True, nogil=True, error_model="numpy")
    def iterate(images: Array, frame: Frame, table: Array, limits: Any, likelihood: Any) -> str:
        _fit(images, frame, table, limits, likelihood)
        return sources

    @njit(cache=True, nogil=True, error_model="numpy")
    def find_errors(frame: Frame, table: Array, noise: Any, out: Array) -> str:
        _find_all_errors(frame, table, noise, out)
        return sources

    @njit(cache=True, nogil=True, error_model="numpy")
    def leave(problem: Problem, kind: Any, middle: Any, table: Array, errors: Array, results: Results) -> str:
        _leave_fits(problem, kind, middle, table, errors, results)
        return sources

    return enter, iterate, find_errors, leave


_SOURCES = ("../vectors/simd", "../vectors/tracing", "moments", "steps", "iteration", "covariance", "engine")
_enter, _iterate, _find_errors, _leave = _compiled(
    hashlib.sha256(b"".join((Path(__file__).parent / f"{name}.py").read_bytes() for name in _SOURCES)).hexdigest()
)


def fit_windows(images: Array, problem: Problem, options: Options, noise: Noise) -> tuple[int, Results]:
    """Fit the windows (n, height, width), float32, within bounds; return which window's bounds are empty, or -1."""
    n, height, width = images.shape
    results = Results(
        np.empty((n, 7)),
        np.empty((n, 7)),
        np.empty(n),
        np.empty(n, np.float32),
        np.empty(n, np.int16),
        np.empty(n, np.uint8),
        np.empty(n),
        np.empty(n),
    )
    pixels, frame = images.reshape(-1), _frame(height, width, options.radius_px)
    table = aligned_rows(n * N_STATE // LANES).reshape(n, N_STATE)
    table[:] = 0
    middle = 0.0, float(width // 2), float(height // 2), 0.0
    empty, _ = _enter(problem, middle, table, results.estimates)
    if empty >= 0:
        return empty, results
    for likelihood in (None, True) if options.poisson else (None,):
        last = bool(likelihood) == options.poisson
        tolerance = options.tolerance_px if last else max(_LOOSE_PX, options.tolerance_px)
        share = 1 / (frame.sides[2] * noise.blur_power)
        limits = np.float32(tolerance), np.float32((2 if likelihood else 1) * options.max_iterations), np.float32(share)
        _iterate(pixels, frame, table, limits, likelihood)
    errors = np.empty((n, N_ERRORS), np.float32)
    _find_errors(frame, table, None if options.poisson else noise, errors)
    _leave(problem, (frame.sides[2], options.poisson or noise.counting), middle, table, errors, results)
    return -1, results
