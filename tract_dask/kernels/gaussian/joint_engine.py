"""The fitter of groups: many windows with the same number of columns each, LANES at a time.

A step is as in :mod:`.iteration`: the sums at the trial; the best amplitudes and background there; the trial is taken
over, or not; the equations of the next step and their solution within bounds; the next trial. What is different: the
number of columns is known when the code runs, so sums and matrices are memory; and shapes are fixed.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from ..vectors.simd import aligned_rows, larger, load, rows_of, select, smaller, store, transpose, vector
from ..vectors.tracing import INLINE, LANES
from .iteration import (
    CONVERGED,
    FLOOR,
    GAUSS_NEWTON_STEPS,
    ITERATION_LIMIT,
    LARGEST_DAMPING,
    LEFT,
    NO_INFORMATION,
    ROUNDING,
    RUNNING,
    SETTLED,
    STALLED,
    UNDAMPED,
)
from .joint_errors import N_GROUP_ERRORS, find_errors
from .joint_room import (
    BACKGROUND_ROW,
    DAMPING,
    FIRST,
    HIGH_BACKGROUND,
    LENGTH,
    LOW_BACKGROUND,
    MERIT,
    OUTCOME,
    PIXELS,
    SECOND,
    STEPS,
    TRIAL_BACKGROUND,
    Room,
    assemble_all,
    image_of,
    load_block,
    member_of,
    n_rows,
    n_sums,
    room_in,
    sums_of,
    totals_of,
)
from .joint_steps import PLAIN, count, entry, release, size, solve_bounded
from .joint_sums import (
    LOWER,
    N_ALONE,
    N_DATA,
    N_MEMBER,
    REACH,
    TRIAL,
    UPPER,
    A,
    add_image,
    begin_residual,
    gradient_block,
    member_image,
    pair_sums,
    residual_sums,
    total_and_squares,
)
from .moments import Array


@njit(**PLAIN)
def _evaluate(room: Room) -> None:
    """Write images and sums at the trial, its best amplitudes and background, and the sums of the residual."""
    members, sums, window, common = room.members, room.trial, room.window, room.common
    for k in range(members):
        member = member_of(room, k)
        member_image(window, member + (TRIAL + 1), member + A, image_of(room, k), sums + k * N_ALONE)
        for i in range(k + 1):
            one = member_of(room, i)
            pair_sums(window, one + (TRIAL + 1), image_of(room, i), image_of(room, k), sums_of(sums, members, i, k))
    _project(room)
    residual = image_of(room, members)
    begin_residual(window, load(common, TRIAL_BACKGROUND), residual)
    for k in range(members):
        add_image(window, 0.0 - load(member_of(room, k), TRIAL), image_of(room, k), residual)
    total_and_squares(window, residual, totals_of(sums, members))
    for k in range(members):
        data = sums + (members * N_ALONE + k * N_DATA)
        residual_sums(window, member_of(room, k) + (TRIAL + 1), image_of(room, k), residual, data)


@njit(**INLINE)
def _project(room: Room) -> None:
    """Set the trial's amplitudes and background to the best ones within their bounds; no amplitude is halved."""
    members, sums, common, e = room.members, room.trial, room.common, room.small
    zero = vector(np.float32(0))
    n, base = members + 1, load(common, TRIAL_BACKGROUND)
    for j in range(members):
        member, alone = member_of(room, j), sums + j * N_ALONE
        value = load(member, TRIAL)
        low, high = load(member, LOWER) - value, load(member, UPPER) - value
        half = 0.5 * value
        store(e.low, j, select(value > 0, larger(low, 0.0 - half), low))
        store(e.high, j, select(value < 0, smaller(high, 0.0 - half), high))
        slope = base * load(alone, 0) - load(alone, 3)
        for i in range(members):
            product = load(sums_of(sums, members, i, j), 0)
            slope = slope + load(member_of(room, i), TRIAL) * product
            if i <= j:
                store(e.hessian, entry(i, j), product)
        store(e.gradient, j, slope)
        store(e.hessian, entry(members, j), load(alone, 0))
    number = load(common, PIXELS)
    slope = number * base - load(common, FIRST)
    for i in range(members):
        slope = slope + load(member_of(room, i), TRIAL) * load(sums + i * N_ALONE, 0)
    store(e.hessian, entry(members, members), number)
    store(e.gradient, members, slope)
    store(e.low, members, load(common, LOW_BACKGROUND) - base)
    store(e.high, members, load(common, HIGH_BACKGROUND) - base)
    store(e.flags, 0, zero)
    release(e, n, zero <= 0)
    store(e.flags, 2, zero)
    solve_bounded(e, n, common + OUTCOME, e.flags + 2)
    for j in range(members):
        member = member_of(room, j)
        value = load(member, TRIAL) + load(e.step, j)
        store(member, TRIAL, smaller(larger(value, load(member, LOWER)), load(member, UPPER)))
    value = base + load(e.step, members)
    store(common, TRIAL_BACKGROUND, smaller(larger(value, load(common, LOW_BACKGROUND)), load(common, HIGH_BACKGROUND)))


@njit(**PLAIN)
def _accept(room: Room) -> None:
    """Take over the trial, with its sums, where it is no worse than the point; change the damping."""
    members, common = room.members, room.common
    merit, before = load(totals_of(room.trial, members), 1), load(common, MERIT)
    better = merit <= before * (1 + ROUNDING) + FLOOR * load(common, SECOND)
    accepted = (load(common, OUTCOME) < 0) & better
    for k in range(members):
        member = member_of(room, k)
        for row in range(3):
            store(member, row, select(accepted, load(member, TRIAL + row), load(member, row)))
    store(common, BACKGROUND_ROW, select(accepted, load(common, TRIAL_BACKGROUND), load(common, BACKGROUND_ROW)))
    store(common, MERIT, select(accepted, merit, before))
    for row in range(n_sums(members)):
        store(room.sums, row, select(accepted, load(room.trial, row), load(room.sums, row)))
    damping = load(common, DAMPING)
    store(common, LENGTH, select(accepted, load(common, LENGTH), 0.0))
    store(common, DAMPING, select(accepted, 0.1 * damping, larger(10.0 * damping, UNDAMPED)))


@njit(**PLAIN)
def _set_up(room: Room) -> None:
    """Write the equations of a step and its limits: the bounds, and how far the quadratic model is to be believed."""
    members, common, e = room.members, room.common, room.whole
    n = 3 * members + 1
    assemble_all(room, room.state, room.sums, e.hessian, load(common, PIXELS))
    for k in range(n * (n + 1) // 2):
        store(e.newton, k, load(e.hessian, k))
    for k in range(members):
        member = member_of(room, k)
        gradient_block(member, room.sums + (members * N_ALONE + k * N_DATA), k, e.gradient, e.newton)
        reach = load(member, REACH)
        for row in range(3):
            low = load(member, LOWER + row) - load(member, row)
            high = load(member, UPPER + row) - load(member, row)
            store(e.low, 3 * k + row, low if row == 0 else larger(low, 0.0 - reach))
            store(e.high, 3 * k + row, high if row == 0 else smaller(high, reach))
    store(e.gradient, n - 1, 0.0 - load(totals_of(room.sums, members), 0))
    store(e.low, n - 1, load(common, LOW_BACKGROUND) - load(common, BACKGROUND_ROW))
    store(e.high, n - 1, load(common, HIGH_BACKGROUND) - load(common, BACKGROUND_ROW))
    store(e.flags, 0, select(load(common, STEPS) >= GAUSS_NEWTON_STEPS, 1.0, 0.0))
    release(e, n, load(common, PIXELS) >= 0)


@njit(**PLAIN)
def _conclude(room: Room, limits: Any) -> Any:
    """Write the next trial of each group; return how many are still running.

    As in :mod:`.iteration`: a group has converged when what is left to go is below the tolerance, or the residual's
    fall that the step promises is far below the noise.
    """
    tolerance, most, power = limits
    members, common, e = room.members, room.common, room.whole
    n, zero = 3 * room.members + 1, vector(np.float32(0))
    running, damping, steps = load(common, OUTCOME) < 0, load(common, DAMPING), load(common, STEPS)
    solved, length, before = load(e.flags, 1) > 0, zero, load(common, LENGTH)
    slope, free, known = zero, zero, damping >= 0
    for i in range(n):
        slope = slope + load(e.step, i) * load(e.gradient, i)
        free = free + load(e.free, i)
        if i % 3 != 0 and i < n - 1:
            length = larger(size(load(e.step, i)), length)
            known = known & (load(e.hessian, entry(i, i)) > 0)
    noise = load(common, MERIT) / (larger(load(common, PIXELS), 1.0) * power)
    shrinking = (length < 0.5 * before) & (length * length < LEFT * tolerance * (before - length)) & (free >= n)
    settled = (0.0 - slope) < select(before > 0, noise * SETTLED, noise * STALLED)
    near = (length < tolerance) | shrinking | settled
    small = near & (damping <= UNDAMPED) & solved
    stopped = (damping > LARGEST_DAMPING) | (steps >= most)
    outcome = select(stopped, select(solved, float(ITERATION_LIMIT), float(NO_INFORMATION)), float(RUNNING))
    outcome = select(small, select(known, float(CONVERGED), float(NO_INFORMATION)), outcome)
    arrived = running & small & known
    store(common, OUTCOME, select(running, outcome, load(common, OUTCOME)))
    store(common, STEPS, select(running, steps + 1.0, steps))
    store(common, LENGTH, select(running, length, before))
    store(common, MERIT, select(arrived, larger(load(common, MERIT) + slope, 0.0), load(common, MERIT)))
    for k in range(members):
        member = member_of(room, k)
        for row in range(3):
            value, low, high = load(member, row), load(member, LOWER + row), load(member, UPPER + row)
            moved = _moved(value, load(e.step, 3 * k + row), low, high)
            store(member, TRIAL + row, moved)
            store(member, row, select(arrived, moved, value))
    value = load(common, BACKGROUND_ROW)
    moved = _moved(value, load(e.step, n - 1), load(common, LOW_BACKGROUND), load(common, HIGH_BACKGROUND))
    store(common, TRIAL_BACKGROUND, moved)
    store(common, BACKGROUND_ROW, select(arrived, moved, value))
    return count(running & (outcome < 0))


@njit(**INLINE)
def _moved(value: Any, by: Any, low: Any, high: Any) -> Any:
    """Return a value after a step, exactly on a bound where the step ends there."""
    moved = select(by <= low - value, low, select(by >= high - value, high, value + by))
    return smaller(larger(moved, low), high)


@njit(**PLAIN)
def _copy_in(table: Any, columns: int, groups: Array, lanes: int, starts: Array, state: Any) -> None:
    """Copy rows of a table into the lanes of a state; idle lanes repeat the last one."""
    for lane in range(LANES):
        starts[lane] = groups[min(lane, lanes - 1)] * columns
    for column in range(0, columns, LANES):
        transpose(table, starts, column, state, column)


@njit(**PLAIN)
def _copy_out(state: Array, rows: int, groups: Array, lanes: int, table: Array) -> None:
    """Copy the lanes of a state back to rows of a table."""
    for lane in range(lanes):
        for k in range(rows):
            table[groups[lane], k] = state[k, lane]


def _compiled(sources: str) -> Any:
    """Return the compiled loop over all groups, which knows a digest of the files that it is made of."""

    @njit(cache=True, nogil=True, error_model="numpy")
    def fit(data: Any, space: Array, table: Array, errors: Array, options: Any) -> str:
        images, masks, which, (height, width) = data
        limits, noise = options
        columns = table.shape[1]
        members = columns // N_MEMBER - 1
        room = room_in(rows_of(space), members, height, width)
        groups, starts = np.empty(LANES, np.int64), np.empty(LANES, np.int64)
        n_errors = 3 * members + 1 + N_GROUP_ERRORS
        written = np.empty((n_errors, LANES), np.float32)
        for begin in range(0, len(table), LANES):
            lanes = min(LANES, len(table) - begin)
            for lane in range(lanes):
                groups[lane] = begin + lane
            _copy_in(rows_of(table), columns, groups, lanes, starts, room.state)
            load_block(images, masks, which, groups, lanes, room, starts)
            running = count(load(room.common, OUTCOME) < 0)
            while running > 0:
                _evaluate(room)
                _accept(room)
                _set_up(room)
                solve_bounded(room.whole, 3 * members + 1, room.common + OUTCOME, room.common + DAMPING)
                running = _conclude(room, limits)
            _copy_out(space, columns, groups, lanes, table)
            find_errors(room, noise, rows_of(written))
            _copy_out(written, n_errors, groups, lanes, errors)
        return sources

    return fit


_OWN = ("joint_sums", "joint_steps", "joint_room", "joint_errors", "joint_engine")
_SOURCES = ("../vectors/simd", "../vectors/tracing", *_OWN)
_fit = _compiled(
    hashlib.sha256(b"".join((Path(__file__).parent / f"{name}.py").read_bytes() for name in _SOURCES)).hexdigest()
)


def fit_groups(
    images: Array, masks: Array, which: Array, table: Array, limits: tuple[float, float, float], noise: Any
) -> Array:
    """Fit groups whose rows (n, n_state) are in the table, to the end; return their errors.

    Parameters
    ----------
    images
        (n, height, width) float32 windows.
    masks, which
        (m, height, width) float32, 1 where a pixel counts, and (n,) which of them is for each window.
    limits
        Tolerance in px, most steps, and the sum of the squares of the blur's weights.
    noise
        Variance of the blur, the sum of the squares of its weights, and whether noise is that of counts.

    Returns
    -------
    Array
        (n, 3 members + 1 + N_GROUP_ERRORS).
    """
    height, width = images.shape[1:]
    members = table.shape[1] // N_MEMBER - 1
    errors = np.empty((len(table), 3 * members + 1 + N_GROUP_ERRORS), np.float32)
    space = aligned_rows(n_rows(members, height * width))
    data = images.reshape(-1), masks.reshape(-1), which, (height, width)
    _fit(data, space, table, errors, (tuple(map(np.float32, limits)), noise))
    return errors
