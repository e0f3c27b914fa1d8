"""The loop of the fitter: many windows, LANES at a time, each until it has converged.

A fit's whole state is one row of a table. A block takes LANES rows and their windows, lane by lane, and steps on
until most of its fits are finished; the others go back to the table and into a later block. So lanes are seldom idle,
and a fit goes the same way, bit for bit, whatever its neighbours are.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from .moments import (
    DATA,
    FIRST,
    INNER,
    MERIT,
    N_ROOM,
    N_SUMS,
    RESIDUAL,
    SQUARED,
    TOTAL,
    WEIGHT,
    Array,
    Grid,
    Shape,
    window_sums,
)
from .simd import (
    LANES,
    count,
    larger,
    load,
    negated,
    number,
    opaque,
    put,
    select,
    smaller,
    store,
    transpose,
    vector,
)
from .steps import (
    AMPLITUDE,
    BACKGROUND,
    COS,
    CURVATURE_U,
    CURVATURE_V,
    LOWER,
    N_BOUNDS,
    N_PARAMETERS,
    SIN,
    UPPER,
    XX,
    YY,
    System,
    X,
    Y,
    assemble,
    diagonal_axes,
    is_small,
    move,
    set_limits,
    solve_bounded,
    turn_axes,
)

POINT, TRIAL = 0, N_PARAMETERS
SUMS = 2 * N_PARAMETERS
DAMPING, STEPS, OUTCOME = SUMS + N_SUMS, SUMS + N_SUMS + 1, SUMS + N_SUMS + 2
BOUNDS = SUMS + N_SUMS + 3
SHAPE_FREE, OFFSET, FACTOR = BOUNDS + N_BOUNDS, BOUNDS + N_BOUNDS + 1, BOUNDS + N_BOUNDS + 2
PIXELS = FACTOR + 1
N_STATE = 80
"""Columns of the table of fits. Pixels are (pixel - offset) * factor."""

RUNNING, CONVERGED, ITERATION_LIMIT, NO_INFORMATION = -1, 0, 2, 3

_GAUSS_NEWTON_STEPS = np.float32(2)  # from further away the second derivatives mislead
FIRST_DAMPING = np.float32(1e-2)
_UNDAMPED = np.float32(1e-2)  # below this a step is a Gauss-Newton step for all that matters
_LARGEST_DAMPING = np.float32(1e8)
_ROUNDING = np.float32(1e-5)  # relative noise of a sum of squares in float32
_FLOOR = np.float32(1e-6)  # the same, relative to the pixels' own sum of squares
_FEW = LANES // 4


@njit(**INNER)
def _load_block(images: Array, grid: Grid, starts: Array, state: Any, block: Any) -> None:
    """Write the windows at ``starts`` of the flat images, lane by lane, and the sums of pixels and their squares."""
    n = grid.height * grid.width
    offset, factor = load(state, OFFSET), load(state, FACTOR)
    column = 0
    while column < n:
        at = min(column, n - LANES)
        if at >= 0:
            transpose(images, starts, at, block, at)
        else:  # a tiny window
            at = 0
            for lane in range(LANES):
                for k in range(n):
                    put(block, k * LANES + lane, images[starts[lane] + k])
        for k in range(at, min(at + LANES, n)):
            store(block, k, (load(block, k) - offset) * factor)
        column += LANES
    first = second = vector(np.float32(0))
    for y in range(grid.height):  # row by row, for the sake of float32's rounding
        row_first = row_second = vector(np.float32(0))
        middle, chord = grid.width // 2, int(number(grid.chords, y))
        row = y * grid.width
        for k in range(row + max(middle - chord, 0), row + min(middle + chord + 1, grid.width)):
            pixel = load(block, k)
            row_first += pixel
            row_second += pixel * pixel
        first += row_first
        second += row_second
    store(state, PIXELS, first)
    store(state, PIXELS + 1, second)


@njit(**INNER)
def _amplitude(best: Any, before: Any, bounds: Any) -> Any:
    """Return the best amplitude within its bounds, but not less than half of what it was: it must not vanish."""
    half = 0.5 * before
    kept = select(before < 0, smaller(best, half), larger(best, half))
    return smaller(larger(kept, load(bounds, LOWER + 0)), load(bounds, UPPER + 0))


@njit(**INNER)
def _project(state: Any, sums: Any, n_pixels: Any) -> None:
    """Set the trial's amplitude and background to the best ones for its shape; turn the sums into the residual's."""
    first, second = load(state, PIXELS), load(state, PIXELS + 1)
    trial, bounds = state + TRIAL, state + BOUNDS
    amplitude, base = load(trial, AMPLITUDE), load(trial, BACKGROUND)
    ee, e = load(sums, SQUARED), load(sums, FIRST)
    ed = load(sums, DATA) + base * e
    determinant = ee * n_pixels - e * e
    best = (ed * n_pixels - e * first) / determinant
    usable = determinant > 1e-4 * ee * n_pixels
    amplitude = _amplitude(select(usable, best, amplitude), amplitude, bounds)
    free = (first - amplitude * e) / n_pixels
    background = smaller(larger(free, load(bounds, LOWER + 4)), load(bounds, UPPER + 4))
    on_bound = usable & ((background > free) | (background < free))
    amplitude = select(on_bound, _amplitude((ed - background * e) / ee, amplitude, bounds), amplitude)
    store(trial, AMPLITUDE, amplitude)
    store(trial, BACKGROUND, background)
    merit = second + amplitude * (amplitude * ee - 2 * ed + 2 * background * e)
    merit += background * (background * n_pixels - 2 * first)
    store(sums, MERIT, merit)
    store(sums, RESIDUAL, merit)
    store(sums, WEIGHT, n_pixels)
    store(sums, TOTAL, first - amplitude * e - background * n_pixels)
    for k in range(opaque(15)):
        score = load(sums, DATA + k) - amplitude * load(sums, SQUARED + k)
        if k < 6:
            score -= (background - base) * load(sums, FIRST + k)
        store(sums, DATA + k, score)


@njit(**INNER)
def _shape(point: Any) -> Shape:
    """Return the centre and exponent of a point (8,)."""
    u, v, cos, sin = load(point, CURVATURE_U), load(point, CURVATURE_V), load(point, COS), load(point, SIN)
    a, c = u * cos * cos + v * sin * sin, u * sin * sin + v * cos * cos
    return Shape(load(point, X), load(point, Y), a, (u - v) * cos * sin, c)


@njit(**INNER)
def _exponent(point: Any) -> Any:
    """Return the coefficients of 1, X, Y, X^2, X Y, Y^2 in -2 log(E)."""
    x, y, a, b, c = _shape(point)
    by_x, by_y = a * x + b * y, b * x + c * y
    return x * by_x + y * by_y, -2 * by_x, -2 * by_y, a, 2 * b, c


@njit(**INNER)
def _slope(sums: Any, amplitude: Any, change: Any) -> Any:
    """Return how log(likelihood) changes with the amplitude, the background and the exponent, to first order."""
    by_amplitude, by_background, one, x, y, xx, xy, yy = change
    bend = one * load(sums, DATA) + x * load(sums, DATA + 1) + y * load(sums, DATA + 2)
    bend += xx * load(sums, DATA + 3) + xy * load(sums, DATA + 4) + yy * load(sums, DATA + 5)
    return by_amplitude * load(sums, DATA) + by_background * load(sums, TOTAL) - 0.5 * amplitude * bend


@njit(**INNER)
def _gain(state: Any, sums: Any) -> Any:
    """Return how log(likelihood) changes from the point to the trial: the mean slope of both ends.

    No logarithm of a pixel is needed, and a step has the opposite gain of the way back: no fit goes to and fro.
    """
    point, trial = state + POINT, state + TRIAL
    amplitude, before = load(trial, AMPLITUDE), load(point, AMPLITUDE)
    one, x, y, xx, xy, yy = _exponent(trial)
    one_0, x_0, y_0, xx_0, xy_0, yy_0 = _exponent(point)
    by_background = load(trial, BACKGROUND) - load(point, BACKGROUND)
    change = amplitude - before, by_background, one - one_0, x - x_0, y - y_0, xx - xx_0, xy - xy_0, yy - yy_0
    return 0.5 * (_slope(state + SUMS, before, change) + _slope(sums, amplitude, change))


@njit(**INNER)
def _accept(state: Any, sums: Any, running: Any, likelihood: Any, floor: Any) -> None:
    """Take over the trial where it is no worse than the point."""
    if likelihood is None:
        accepted = running & (load(sums, MERIT) <= load(state, SUMS + MERIT) * (1 + _ROUNDING) + floor)
    else:
        accepted = running & (_gain(state, sums) >= negated(floor))
    for row in range(opaque(N_PARAMETERS)):
        store(state, POINT + row, select(accepted, load(state, TRIAL + row), load(state, POINT + row)))
    for row in range(opaque(N_SUMS)):
        store(state, SUMS + row, select(accepted, load(sums, row), load(state, SUMS + row)))
    damping = load(state, DAMPING)
    store(state, DAMPING, select(accepted, 0.1 * damping, larger(10 * damping, _UNDAMPED)))


@njit(**INNER)
def _turn_circles(state: Any, system: System, free: Any) -> None:
    """Turn the axes of circles on a bound to those of the gradient, where P and Q can part from it alone."""
    gradient, point = system.gradient, state + POINT
    u, v = load(point, CURVATURE_U), load(point, CURVATURE_V)
    stuck = (u == v) & (load(system.high, 4) <= 0) & (free > 0)
    if count(stuck) == 0:
        return
    cos, sin = diagonal_axes(load(gradient, 3), 0.5 * load(gradient, 4), load(gradient, 5))
    turn_axes(point, (u, v), (select(stuck, cos, 1), select(stuck, sin, 0)))
    assemble(point, state + SUMS, system)
    set_limits(point, state + BOUNDS, free, system)


@njit(**INNER)
def _step(state: Any, system: System, running: Any, likelihood: Any, limits: Any) -> Any:
    """Write the next trial of each fit; return which are still running."""
    tolerance, most = limits
    point = state + POINT
    damping, steps = load(state, DAMPING), load(state, STEPS)
    free = load(state, SHAPE_FREE)
    assemble(point, state + SUMS, system)
    set_limits(point, state + BOUNDS, free, system)
    _turn_circles(state, system, free)
    solved = solve_bounded(system, steps >= _GAUSS_NEWTON_STEPS, damping)
    move(point, system, state + BOUNDS, free, state + TRIAL)
    small = is_small(point, system, tolerance) & (damping <= _UNDAMPED) & solved
    known = (load(system.hessian, XX) > 0) & (load(system.hessian, YY) > 0)
    outcome = select(small, select(known, CONVERGED, NO_INFORMATION), RUNNING)
    stopped = (damping > _LARGEST_DAMPING) | (steps >= most)
    outcome = select((outcome == RUNNING) & stopped, select(solved, ITERATION_LIMIT, NO_INFORMATION), outcome)
    store(state, OUTCOME, select(running, outcome, load(state, OUTCOME)))
    store(state, STEPS, select(running, steps + 1, steps))
    arrived = running & (outcome == CONVERGED)
    for row in range(opaque(N_PARAMETERS)):
        store(state, POINT + row, select(arrived, load(state, TRIAL + row), load(state, POINT + row)))
    return running & (outcome == RUNNING)


@njit(**INNER)
def _run_block(grid: Grid, block: Any, state: Any, room: Any, system: System, options: Any) -> None:
    """Step on with a block of fits until few of them are running, or none where there are ``few`` = 0."""
    likelihood, tolerance, most, few = options
    sums, part = room, room + N_ROOM
    n_pixels = vector(np.float32(grid.n_pixels))
    floor = _FLOOR * load(state, PIXELS + 1)
    running = load(state, OUTCOME) == RUNNING
    while True:
        model = load(state, TRIAL + AMPLITUDE), load(state, TRIAL + BACKGROUND)
        window_sums(block, grid, _shape(state + TRIAL), model, likelihood, part, sums)
        if likelihood is None:
            _project(state, sums, n_pixels)
        _accept(state, sums, running, likelihood, floor)
        running = _step(state, system, running, likelihood, (tolerance, most))
        if count(running) <= few:
            return


@njit(**INNER)
def gather(table: Any, fits: Array, lanes: int, starts: Array, state: Any) -> None:
    """Copy rows ``fits`` (LANES,) of the table into the lanes of a state; idle lanes repeat the last one."""
    for lane in range(LANES):
        starts[lane] = fits[min(lane, lanes - 1)] * N_STATE
    for column in range(0, opaque(N_STATE), LANES):
        transpose(table, starts, column, state, column)


@njit(**INNER)
def _scatter(state: Any, fits: Array, lanes: int, starts: Array, room: Any, table: Any) -> None:
    """Copy the lanes of a state back to rows ``fits`` (LANES,) of the table."""
    for lane in range(LANES):
        starts[lane] = lane * LANES
    for column in range(0, opaque(N_STATE), LANES):
        transpose(state, starts, column * LANES, room, 0)
        for lane in range(lanes):
            store(table, (fits[lane] * N_STATE + column) // LANES, load(room, lane))


@njit(**INNER)
def run(images: Array, grid: Grid, rooms: Any, table: Any, queue: Array, likelihood: Any, limits: Any) -> None:
    """Fit the windows whose rows of the table (n, N_STATE) are in the queue, to the end.

    ``images`` are all windows' pixels in a row. ``rooms`` are rows for the block, a state, sums and a system, and two
    (LANES,) int64. ``limits`` are the tolerance and the number of steps.
    """
    block, state, room, system, fits, starts = rooms
    n_pixels = grid.height * grid.width
    left = queue.size
    while left > 0:
        again = 0
        for begin in range(0, left, LANES):
            lanes = min(LANES, left - begin)
            for lane in range(lanes):
                fits[lane] = queue[begin + lane]
            gather(table, fits, lanes, starts, state)
            for lane in range(LANES):
                starts[lane] = fits[min(lane, lanes - 1)] * n_pixels
            _load_block(images, grid, starts, state, block)
            few = _FEW if left > LANES else 0
            _run_block(grid, block, state, room, system, (likelihood, limits[0], limits[1], few))
            _scatter(state, fits, lanes, starts, room, table)
            for lane in range(lanes):
                if number(state, OUTCOME * LANES + lane) == RUNNING:
                    queue[again] = fits[lane]
                    again += 1
        left = again
