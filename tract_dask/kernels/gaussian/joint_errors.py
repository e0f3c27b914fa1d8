"""Standard errors of groups, as in :mod:`.covariance`: H^-1 (J^T C J) H^-1, of all members and the background."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ..vectors.simd import larger, load, select, store, vector
from ..vectors.tracing import INLINE
from .joint_room import (
    BACKGROUND_ROW,
    FACTOR,
    HIGH_BACKGROUND,
    LOW_BACKGROUND,
    MERIT,
    OFFSET,
    PIXELS,
    Room,
    assemble_all,
    image_of,
    member_of,
    sums_of,
    totals_of,
)
from .joint_steps import PLAIN, entry, factorise, root, size, substitute
from .joint_sums import (
    HEIGHT,
    LOWER,
    N_ALONE,
    N_MEMBER,
    TRIAL,
    UPPER,
    A,
    B,
    C,
    X,
    add_image,
    member_image,
    multiply,
    noise_image,
    pair_sums,
    total_and_squares,
)

RATIO, FREEDOM, LEVEL, N_GROUP_ERRORS = 0, 1, 2, 4
"""Behind the standard errors of amplitude, x and y of each member, and of the background: as in :mod:`.covariance`."""


@njit(**INLINE)
def _write_wide(room: Room, blur_variance: Any) -> None:
    """Write the members after the blur: wider, and so much lower, with the factor of their height in ``TRIAL``."""
    for k in range(room.members):
        member, wide = member_of(room, k), room.wide + k * N_MEMBER
        a, b, c = load(member, A), load(member, B), load(member, C)
        narrow = a * c - b * b
        xx, xy, yy = c / narrow + blur_variance, b / narrow, a / narrow + blur_variance
        area = xx * yy - xy * xy
        factor = root(1.0 / (area * narrow))
        for row in range(3):
            store(wide, row, load(member, row))
        store(wide, A, yy / area)
        store(wide, B, xy / area)
        store(wide, C, xx / area)
        store(wide, TRIAL, factor)


@njit(**INLINE)
def _write_meat(room: Room, noise: Any) -> Any:
    """Write J^T C J into the second derivatives' place; return the trace of C, and the noise's level.

    The blurred derivatives are taken times the standard deviation of the raw pixels' noise.
    """
    blur_variance, blur_power, counting = noise
    members, window, common, e = room.members, room.window, room.common, room.whole
    n, spread = 3 * room.members + 1, image_of(room, room.members)
    floor = larger(load(common, BACKGROUND_ROW) + load(common, OFFSET) * load(common, FACTOR), 0.0)
    level = floor
    begin = 0.0 - floor
    for k in range(window.height * window.width):
        store(spread, k, floor)
    for k in range(members):
        member = member_of(room, k)
        member_image(window, member + X, member + A, image_of(room, k), room.trial + k * N_ALONE)
        add_image(window, load(member, HEIGHT), image_of(room, k), spread)
        level = larger(level, size(load(member, HEIGHT)) + floor)
    level = level if counting else begin - 1.0
    noise_image(window, level, spread)
    total_and_squares(window, spread, totals_of(room.trial, members))
    trace = load(totals_of(room.trial, members), 1)
    _write_wide(room, blur_variance)
    for k in range(members):
        wide, alone = room.wide + k * N_MEMBER, room.trial + k * N_ALONE
        member_image(window, wide + X, wide + A, image_of(room, k), alone)
        multiply(window, image_of(room, k), spread)
        for i in range(k + 1):
            one = room.wide + i * N_MEMBER
            pair_sums(window, one + X, image_of(room, i), image_of(room, k), sums_of(room.trial, members, i, k))
    data = room.trial + members * N_ALONE
    for k in range(members):
        wide, alone = room.wide + k * N_MEMBER, room.trial + k * N_ALONE
        pair_sums(window, wide + X, image_of(room, k), spread, data)
        for row in range(3):
            store(alone, row, load(data, row))
    assemble_all(room, room.wide, room.trial, e.newton, trace)
    for i in range(n):
        for j in range(i + 1):
            value = load(e.newton, entry(i, j))
            value = value * load(room.wide + (i // 3) * N_MEMBER, TRIAL) if i < n - 1 else value
            value = value * load(room.wide + (j // 3) * N_MEMBER, TRIAL) if j < n - 1 else value
            store(e.newton, entry(i, j), value)
    return trace * blur_power, select(level > 0, level, 1.0)


@njit(**INLINE)
def _free(room: Room) -> None:
    """Write which parameters have standard errors: those that are not on a bound."""
    e, members, common = room.whole, room.members, room.common
    for k in range(members):
        member = member_of(room, k)
        for row in range(3):
            value, low, high = load(member, row), load(member, LOWER + row), load(member, UPPER + row)
            inside = (value > low) & (value < high) & (load(e.hessian, entry(3 * k + row, 3 * k + row)) > 0)
            store(e.free, 3 * k + row, select(inside, 1.0, 0.0))
    value = load(common, BACKGROUND_ROW)
    inside = (value > load(common, LOW_BACKGROUND)) & (value < load(common, HIGH_BACKGROUND))
    store(e.free, 3 * members, select(inside, 1.0, 0.0))


@njit(**PLAIN)
def find_errors(room: Room, noise: Any, errors: Any) -> None:
    """Write the standard errors of all parameters for noise of level 1, and (RATIO, FREEDOM, LEVEL) behind them."""
    e, common = room.whole, room.common
    n, zero = 3 * room.members + 1, vector(np.float32(0))
    assemble_all(room, room.state, room.sums, e.hessian, load(common, PIXELS))
    trace, level = _write_meat(room, noise)
    _free(room)
    store(e.flags, 0, zero)
    known = factorise(e, n, zero)
    left = trace
    for i in range(n):
        for k in range(n):
            store(e.solution, k, zero)
        store(e.solution, i, zero + 1.0)
        substitute(e, n)
        variance = zero
        for j in range(n):
            of_row = zero
            for k in range(n):
                of_row = of_row + load(e.newton, entry(j, k)) * load(e.solution, k)
            variance = variance + of_row * load(e.solution, j)
            if j == i:
                left = left - of_row
        store(errors, i, select(known & (load(e.free, i) > 0), root(variance), np.nan))
    store(errors, n + RATIO, larger(load(common, MERIT), 0.0) / trace)
    store(errors, n + FREEDOM, select(known & (left > 0), left / trace, np.nan))
    store(errors, n + LEVEL, level)
