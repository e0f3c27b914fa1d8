"""The loop of the fitter: many windows, LANES at a time, each until it has converged.

A fit's whole state is one row of a table. A block takes LANES rows and their windows, lane by lane, and steps on
until most of its fits are finished; the others go back to the table and into a later block. So lanes are seldom idle,
and a fit goes the same way, bit for bit, whatever its neighbours are.

Each step is: sums over the pixels at the trial (:mod:`.moments`); the best amplitude and background there; the trial
is taken over, or not; the equations of the next step and their solution within bounds (:mod:`.steps`); the next trial.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types

from ..vectors.simd import copy_row, number, put, transpose
from ..vectors.tracing import (
    INLINE,
    LANES,
    Rows,
    Vector,
    absolute,
    count,
    fewer,
    larger,
    loop,
    more,
    select,
    smaller,
    spread,
    traced,
)
from .moments import (
    AMPLITUDE_ROW,
    BACKGROUND_ROW,
    CURVATURE_U,
    CURVATURE_V,
    DATA,
    FIRST,
    MERIT,
    N_PARAMETERS,
    N_SUMS,
    RESIDUAL,
    SIN,
    SQUARED,
    TOTAL,
    WEIGHT,
    Array,
    Grid,
    shape_of,
    window_sums,
)
from .steps import (
    FREE,
    GRADIENT,
    HESSIAN,
    HIGH,
    LOW,
    LOWER,
    N_BOUNDS,
    NEWTON,
    SOLVED,
    STEP,
    UPPER,
    USE_NEWTON,
    XX,
    YY,
    assemble,
    diagonal_axes,
    entry,
    length_px,
    limits,
    move,
    read,
    release,
    solve_bounded,
    stiffness,
    turned,
    write,
)

POINT, TRIAL = 0, N_PARAMETERS
SUMS = 2 * N_PARAMETERS
DAMPING, STEPS, OUTCOME, LENGTH, HELD = (SUMS + N_SUMS + k for k in range(5))
BOUNDS = SUMS + N_SUMS + 5
SHAPE_FREE, OFFSET, FACTOR, PIXELS = (BOUNDS + N_BOUNDS + k for k in range(4))
N_STATE = 80
"""Columns of the table of fits. Pixels are (pixel - offset) * factor; the factor is 0 before the window was looked at.
PIXELS are the sums of the pixels and of their squares, LENGTH is that of the last step, HELD says which
parameters were not free in it, a bit each."""

RUNNING, CONVERGED, ITERATION_LIMIT, NO_INFORMATION, NOT_FINITE = -1, 0, 2, 3, 4

GAUSS_NEWTON_STEPS = 2.0  # from further away the second derivatives mislead
FIRST_DAMPING = 1e-2
UNDAMPED = 1e-2  # below this a step is a Gauss-Newton step for all that matters
LARGEST_DAMPING = 1e8
LEFT = 0.1  # of the tolerance, what may be left to go after a step whose length is not below it
SETTLED = 1e-4  # of a raw pixel's variance: what the residual's sum of squares may still fall by
STALLED = 1e-2  # the same after a step that float32 saw as no fall
ROUNDING = 1e-5  # relative noise of a sum of squares in float32
FLOOR = 1e-6  # the same, relative to the pixels' own sum of squares
_LARGEST = 3e38
_LEAST_RANGE = 1e-35  # below this float32 runs out of digits
_FEW = LANES // 4


@traced()
def _normalise(block: Rows, grid: Grid, state: Rows) -> None:
    """Bring the pixels of a block to a mean of 0 and a range of 1; write their sums, and the start in those units.

    Where offset and factor are known already these are taken, and the start is left alone.
    """
    zero, none = grid.height.constant(0), block.constant(0)
    n_pixels = grid.height * grid.width

    def level(y: Any, values: list[Vector]) -> list[Vector]:
        def pixel(k: Any, values: list[Vector]) -> list[Vector]:
            value = block[k]
            return [values[0] + value, smaller(value, values[1]), larger(value, values[2])]

        total, *extremes = loop(y * grid.width, (y + 1) * grid.width, [none, *values[1:]], pixel)
        return [values[0] + total, *extremes]  # row by row, for the sake of float32's rounding

    total, low, high = loop(zero, grid.height, [none, block.constant(_LARGEST), block.constant(-_LARGEST)], level)
    mean, span = total / spread(n_pixels), high - low
    fresh = state[FACTOR].equals(0)
    finite = absolute(mean) <= _LARGEST
    usable = finite & (span > _LEAST_RANGE) & (span <= _LARGEST)
    outcome = select(finite, select(usable, none + RUNNING, NO_INFORMATION), NOT_FINITE)
    outcome = select(state[OUTCOME].equals(NOT_FINITE), NOT_FINITE, outcome)
    state[OUTCOME] = select(fresh, outcome, state[OUTCOME])
    offset = state[OFFSET] = select(fresh, select(finite, mean, 0), state[OFFSET])
    factor = state[FACTOR] = select(fresh, 1 / select(usable, span, 1), state[FACTOR])
    for place, origin in (
        (TRIAL + AMPLITUDE_ROW, none),
        (BOUNDS + LOWER, none),
        (BOUNDS + UPPER, none),
        (TRIAL + BACKGROUND_ROW, offset),
        (BOUNDS + LOWER + 4, offset),
        (BOUNDS + UPPER + 4, offset),
    ):
        value = smaller(larger((state[place] - origin) * factor, -_LARGEST), _LARGEST)
        state[place] = select(fresh, value, state[place])
    for k in range(N_PARAMETERS):
        state[POINT + k] = select(fresh, state[TRIAL + k], state[POINT + k])

    def row(y: Any, values: list[Vector]) -> list[Vector]:
        def scale(k: Any, _: list[Vector]) -> list[Vector]:
            block[k] = (block[k] - offset) * factor
            return []

        def add(k: Any, values: list[Vector]) -> list[Vector]:
            return [values[0] + block[k], values[1] + block[k] * block[k]]

        first, chord = y * grid.width, grid.chords.integer(y)
        loop(first, first + grid.width, [], scale)
        begin, end = more(grid.half_width - chord, 0), fewer(grid.half_width + chord + 1, grid.width)
        sums = loop(first + begin, first + end, [none, none], add)
        return [value + of_row for value, of_row in zip(values, sums, strict=True)]

    state[PIXELS], state[PIXELS + 1] = loop(zero, grid.height, [none, none], row)


@njit(**INLINE)
def _load_block(images: Array, grid: Grid, starts: Array, state: Any, block: Any) -> None:
    """Write the windows at ``starts`` of the flat images, lane by lane."""
    n = grid.height * grid.width
    if n < LANES:  # a tiny window
        for lane in range(LANES):
            for k in range(n):
                put(block, k * LANES + lane, images[starts[lane] + k])
    else:
        for column in range(0, n, LANES):
            at = min(column, n - LANES)
            transpose(images, starts, at, block, at)
    _normalise(block, grid, state)


def _within(value: Vector, low: Vector, high: Vector) -> Vector:
    """Return the value, or the bound that it is beyond."""
    return smaller(larger(value, low), high)


def _project(state: Rows, sums: list[Vector], n_pixels: Vector) -> None:
    """Set the trial's amplitude and background to the best ones for its shape; turn the sums into the residual's."""
    first, second = state[PIXELS], state[PIXELS + 1]
    trial, bounds = state + TRIAL, state + BOUNDS
    before, base = trial[AMPLITUDE_ROW], trial[BACKGROUND_ROW]

    def bounded(best: Vector) -> Vector:
        """Return the amplitude within its bounds, but not less than half of what it was: it must not vanish."""
        kept = select(before < 0, smaller(best, 0.5 * before), larger(best, 0.5 * before))
        return _within(kept, bounds[LOWER], bounds[UPPER])

    ee, e = sums[SQUARED], sums[FIRST]
    ed = sums[DATA] + base * e
    determinant = ee * n_pixels - e * e
    best = (ed * n_pixels - e * first) / determinant
    usable = determinant > 1e-4 * ee * n_pixels
    amplitude = bounded(select(usable, best, before))
    free = (first - amplitude * e) / n_pixels
    background = _within(free, bounds[LOWER + 4], bounds[UPPER + 4])
    on_bound = usable & ((background > free) | (background < free))
    amplitude = select(on_bound, bounded((ed - background * e) / ee), amplitude)
    trial[AMPLITUDE_ROW], trial[BACKGROUND_ROW] = amplitude, background
    merit = second + amplitude * (amplitude * ee - 2 * ed + 2 * background * e)
    merit = merit + background * (background * n_pixels - 2 * first)
    sums[MERIT:] = [merit, merit]
    sums[WEIGHT], sums[TOTAL] = n_pixels, first - amplitude * e - background * n_pixels
    for k in range(15):
        score = sums[DATA + k] - amplitude * sums[SQUARED + k]
        sums[DATA + k] = score - (background - base) * sums[FIRST + k] if k < 6 else score


def _exponent(point: Rows) -> list[Vector]:
    """Return the coefficients of 1, X, Y, X^2, X Y, Y^2 in -2 log(E)."""
    x, y, a, b, c = shape_of(point)
    by_x, by_y = a * x + b * y, b * x + c * y
    return [x * by_x + y * by_y, -2 * by_x, -2 * by_y, a, 2 * b, c]


def _gain(state: Rows, sums: list[Vector]) -> Vector:
    """Return how log(likelihood) changes from the point to the trial: the mean slope of both ends.

    No logarithm of a pixel is needed, and a step has the opposite gain of the way back: no fit goes to and fro.
    """
    point, trial = state + POINT, state + TRIAL
    bends = [new - old for new, old in zip(_exponent(trial), _exponent(point), strict=True)]
    by_amplitude = trial[AMPLITUDE_ROW] - point[AMPLITUDE_ROW]
    by_background = trial[BACKGROUND_ROW] - point[BACKGROUND_ROW]

    def slope(amplitude: Vector, own: list[Vector]) -> Vector:
        bend = bends[0] * own[DATA]
        for k in range(1, 6):
            bend = bend + bends[k] * own[DATA + k]
        return by_amplitude * own[DATA] + by_background * own[TOTAL] - 0.5 * amplitude * bend

    return 0.5 * (slope(point[AMPLITUDE_ROW], read(state, SUMS, N_SUMS)) + slope(trial[AMPLITUDE_ROW], sums))


@traced()
def _accept(state: Rows, rows: Rows, n_pixels: Vector, likelihood: Any) -> None:
    """Take over the trial, with its sums, where it is no worse than the point."""
    sums, floor = read(rows, 0, N_SUMS), FLOOR * state[PIXELS + 1]
    if likelihood is None:
        _project(state, sums, n_pixels)
        better = sums[MERIT] <= state[SUMS + MERIT] * (1 + ROUNDING) + floor
    else:
        better = _gain(state, sums) >= -floor
    accepted = state[OUTCOME].equals(RUNNING) & better
    for row in range(N_PARAMETERS):
        state[POINT + row] = select(accepted, state[TRIAL + row], state[POINT + row])
    for row in range(N_SUMS):
        state[SUMS + row] = select(accepted, sums[row], state[SUMS + row])
    state[LENGTH] = select(accepted, state[LENGTH], 0)
    damping = state[DAMPING]
    state[DAMPING] = select(accepted, 0.1 * damping, larger(10 * damping, UNDAMPED))


@traced(types.int64)
def _set_up(state: Rows, system: Rows, again: Any) -> Any:
    """Write the equations of a step; return in how many lanes they have to be written again.

    The axes of circles on a bound are turned to those of the gradient, where P and Q can part from it alone.
    """
    point, free = state + POINT, state[SHAPE_FREE]
    hessian, newton, gradient = assemble(point, state + SUMS)
    low, high = limits(point, state + BOUNDS, free)
    by_turn, shape = stiffness(point, low, high, gradient), entry(4, 4)
    hessian[shape], newton[shape] = hessian[shape] + by_turn, newton[shape] + by_turn
    for first, values in ((HESSIAN, hessian), (NEWTON, newton), (GRADIENT, gradient), (LOW, low), (HIGH, high)):
        write(system, first, values)
    system[USE_NEWTON] = select(state[STEPS] >= GAUSS_NEWTON_STEPS, free.of(1), 0)
    release(system, free >= 0)
    u, v = point[CURVATURE_U], point[CURVATURE_V]
    stuck = state[OUTCOME].equals(RUNNING) & u.equals(v) & (high[4] <= 0) & (free > 0) & (spread(again) <= 0)
    cos, sin = diagonal_axes(gradient[3], 0.5 * gradient[4], gradient[5])
    axes = turned(point, (u, v), (select(stuck, cos, 1), select(stuck, sin, 0)))
    for k, row in enumerate(range(CURVATURE_U, SIN + 1)):
        point[row] = select(stuck, axes[k], point[row])
    return count(stuck)


@traced(types.int64)
def _solve(state: Rows, system: Rows) -> Any:
    """Solve the equations of a step; return in how many lanes that has to be done again, with other parameters free."""
    return count(solve_bounded(system, state[OUTCOME].equals(RUNNING), state[DAMPING]))


def _held(system: Rows) -> Vector:
    """Return a bit for each parameter that is not free, or has been put onto its limit."""
    bits = system.constant(0)
    for i in range(7):
        bits = bits + (1 - system[FREE + i]) * float(1 << i)
    return bits


def _slope(system: Rows, step: list[Vector]) -> Vector:
    """Return the step times the gradient: what the last step, a full one, adds to the residual's sum of squares."""
    total = step[0] * system[GRADIENT]
    for i in range(1, 7):
        total = total + step[i] * system[GRADIENT + i]
    return total


@traced(types.int64)
def _conclude(state: Rows, system: Rows, limits: Any, likelihood: Any) -> Any:
    """Write the next trial of each fit; return how many are still running.

    A fit has converged when what is left to go after a step is below the tolerance. Steps that shrink by a factor r
    each leave r / (1 - r) times the last one; here they shrink faster and faster. That is so while the same bounds are
    active. It has converged, too, when the fall of the residual that the step promises (the Newton decrement, which is
    the squared distance from the minimum in units of the noise) is far below the noise: at high signal float32 cannot
    tell the last falls from its own rounding, and rejects what is right.
    """
    tolerance, most, share = limits
    point, damping, steps = state + POINT, state[DAMPING], state[STEPS]
    running, solved = state[OUTCOME].equals(RUNNING), system[SOLVED] > 0
    step = read(system, STEP, 7)
    trial = move(point, step, state + BOUNDS, state[SHAPE_FREE])
    length, before, held = length_px(point, step), state[LENGTH], _held(system)
    shrinking = (
        (length < 0.5 * before) & (length * length < LEFT * tolerance * (before - length)) & held.equals(state[HELD])
    )
    slope, noise = _slope(system, step), state[SUMS + MERIT] * share
    settled = -slope < select(before > 0, noise * SETTLED, noise * STALLED)  # a length of 0: the last was rejected
    near = (length < tolerance) | shrinking | settled
    small = near & (damping <= UNDAMPED) & solved
    known = (system[HESSIAN + XX] > 0) & (system[HESSIAN + YY] > 0)
    stopped = (damping > LARGEST_DAMPING) | (steps >= most)
    none = damping.of(0)
    outcome = select(stopped, select(solved, none + ITERATION_LIMIT, NO_INFORMATION), RUNNING)
    outcome = select(small, select(known, none + CONVERGED, NO_INFORMATION), outcome)
    state[OUTCOME] = select(running, outcome, state[OUTCOME])
    state[STEPS] = select(running, steps + 1, steps)
    state[LENGTH] = select(running, length, before)
    state[HELD] = select(running, held, state[HELD])
    arrived = running & outcome.equals(CONVERGED)
    for row in (SUMS + MERIT, SUMS + RESIDUAL) if likelihood is None else ():
        state[row] = select(arrived, larger(state[row] + slope, 0), state[row])
    for row in range(N_PARAMETERS):
        state[TRIAL + row] = trial[row]
        state[POINT + row] = select(arrived, trial[row], state[POINT + row])
    return count(running & outcome.equals(RUNNING))


@traced(types.int64)
def _count_running(state: Rows) -> Any:
    return count(state[OUTCOME].equals(RUNNING))


@njit(**INLINE)
def gather(table: Any, fits: Array, lanes: int, starts: Array, state: Any) -> None:
    """Copy rows ``fits`` (LANES,) of the table into the lanes of a state; idle lanes repeat the last one."""
    for lane in range(LANES):
        starts[lane] = fits[min(lane, lanes - 1)] * N_STATE
    for column in range(0, N_STATE, LANES):
        transpose(table, starts, column, state, column)


@njit(**INLINE)
def _scatter(state: Any, fits: Array, lanes: int, starts: Array, room: Any, table: Any) -> None:
    """Copy the lanes of a state back to rows ``fits`` (LANES,) of the table."""
    for lane in range(LANES):
        starts[lane] = lane * LANES
    for column in range(0, N_STATE, LANES):
        transpose(state, starts, column * LANES, room, 0)
        for lane in range(lanes):
            copy_row(room, lane, table, (fits[lane] * N_STATE + column) // LANES)


@njit(**INLINE)
def run(images: Array, grid: Grid, rooms: Any, table: Any, queue: Array, likelihood: Any, limits: Any) -> None:
    """Fit the windows whose rows of the table (n, N_STATE) are in the queue, to the end.

    ``images`` are all windows' pixels in a row. ``rooms`` are rows for the block, a state, sums, and equations, and two
    (LANES,) int64. ``limits`` are the tolerance, the number of steps, and the share of the residual's sum of
    squares that is a raw pixel's variance.
    """
    block, state, sums, part, system, fits, starts = rooms
    left = queue.size
    while left > 0:
        again = 0
        for begin in range(0, left, LANES):
            lanes = min(LANES, left - begin)
            for lane in range(lanes):
                fits[lane] = queue[begin + lane]
            gather(table, fits, lanes, starts, state)
            for lane in range(LANES):
                starts[lane] = fits[min(lane, lanes - 1)] * grid.height * grid.width
            _load_block(images, grid, starts, state, block)
            few = _FEW if left > LANES else 0
            n_running = _count_running(state)
            while n_running > few:
                window_sums(block, grid, state + TRIAL, likelihood, part, sums)
                _accept(state, sums, np.float32(grid.n_pixels), likelihood)
                for attempt in range(2):
                    if _set_up(state, system, attempt) == 0:
                        break
                while _solve(state, system) > 0:
                    pass
                n_running = _conclude(state, system, limits, likelihood)
            _scatter(state, fits, lanes, starts, part, table)
            for lane in range(lanes):
                if number(state, OUTCOME * LANES + lane) == RUNNING:
                    queue[again] = fits[lane]
                    again += 1
        left = again
