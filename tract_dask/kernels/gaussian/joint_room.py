"""What the fitter of groups has in memory: the numbers of a group, and room for LANES groups at a time.

The numbers of a group are one row of a table: those of each member (see :mod:`.joint_sums`), and behind them what the
members have in common.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from ..vectors.simd import larger, load, select, smaller, store, transpose, vector
from ..vectors.tracing import INLINE, LANES
from .iteration import NO_INFORMATION
from .joint_steps import PLAIN, Equations, entry, equations, n_equation_rows, size, without
from .joint_sums import (
    HEIGHT,
    LOWER,
    N_ALONE,
    N_DATA,
    N_MEMBER,
    N_PAIR,
    TRIAL,
    UPPER,
    Window,
    background_block,
    own_block,
    pair_block,
)
from .moments import Array

BACKGROUND_ROW, LOW_BACKGROUND, HIGH_BACKGROUND, TRIAL_BACKGROUND = 0, 1, 2, 3
DAMPING, STEPS, OUTCOME, LENGTH, OFFSET, FACTOR, PIXELS, FIRST, SECOND, MERIT, N_COMMON = (
    4,
    5,
    6,
    7,
    8,
    9,
    10,
    11,
    12,
    13,
    16,
)
"""Rows of a group behind those of its members. Pixels are (pixel - offset) * factor; how many count, and the sums of
them and of their squares; the residual's sum of squares."""

_LARGEST = 3e38
_LEAST_RANGE = 1e-35  # below this float32 runs out of digits


class Room(NamedTuple):
    """Rows to work in, for groups of some size."""

    members: int
    state: Any
    """(n_state,) members, and behind them what is common."""
    common: Any
    window: Window
    images: Any
    """(members + 1, pixels): E of the members, and the residual, or the noise."""
    trial: Any
    """(n_sums,) of the trial."""
    sums: Any
    """The same of the point."""
    small: Equations
    """Of amplitudes and background."""
    whole: Equations
    wide: Any
    """Members after the blur."""


@njit(**PLAIN)
def n_sums(members: int) -> int:
    """Return how many sums a step needs: of each member, of each pair, of the residual; and two totals."""
    return members * (N_ALONE + N_DATA) + members * (members + 1) // 2 * N_PAIR + 2


def n_state(members: int) -> int:
    """Return how many numbers a group has."""
    return members * N_MEMBER + N_COMMON


def n_rows(members: int, pixels: int) -> int:
    """Return how many rows :class:`Room` takes."""
    own = 2 * n_state(members) + 2 * (members * (N_ALONE + N_DATA) + members * (members + 1) // 2 * N_PAIR + 2)
    return own + (members + 3) * pixels + n_equation_rows(members + 1) + n_equation_rows(3 * members + 1)


@njit(**PLAIN)
def room_in(rows: Any, members: int, height: int, width: int) -> Room:
    """Return the room for groups with so many members in such windows, in some rows."""
    pixels, states, sums = height * width, members * N_MEMBER + N_COMMON, n_sums(members)
    block = rows + 2 * states
    images = block + 2 * pixels
    first = images + (members + 1) * pixels
    small, n = first + 2 * sums, members + 1
    whole = small + (2 * n * (n + 1) + 8 * n + 3)
    return Room(
        members,
        rows,
        rows + members * N_MEMBER,
        Window(height, width, block, block + pixels),
        images,
        first,
        first + sums,
        equations(small, n),
        equations(whole, 3 * members + 1),
        rows + states,
    )


@njit(**PLAIN)
def member_of(room: Room, k: int) -> Any:
    """Return where a member's numbers stand."""
    return room.state + k * N_MEMBER


@njit(**PLAIN)
def image_of(room: Room, k: int) -> Any:
    """Return where a member's image stands; behind those of the members the residual, or the noise."""
    return room.images + k * (room.window.height * room.window.width)


@njit(**PLAIN)
def sums_of(sums: Any, members: int, i: int, j: int) -> Any:
    """Return where the sums of a pair stand."""
    return sums + (members * (N_ALONE + N_DATA) + entry(i, j) * N_PAIR)


@njit(**PLAIN)
def totals_of(sums: Any, members: int) -> Any:
    """Return where the residual's sum, and that of its squares, stand."""
    return sums + (n_sums(members) - 2)


@njit(**PLAIN)
def load_block(images: Array, masks: Array, which: Array, groups: Array, lanes: int, room: Room, starts: Array) -> None:
    """Write windows and weights, lane by lane, and the pixels' sums; what is no number counts for nothing."""
    window, common = room.window, room.common
    n = window.height * window.width
    for source in range(2):
        for lane in range(LANES):
            group = groups[min(lane, lanes - 1)]
            starts[lane] = (group if source == 0 else which[group]) * n
        for column in range(0, n, LANES):
            at = min(column, n - LANES)
            if source == 0:
                transpose(images, starts, at, window.pixels, at)
            else:
                transpose(masks, starts, at, window.weights, at)
    zero = vector(np.float32(0))
    number, total, low, high = zero, zero, zero + _LARGEST, zero - _LARGEST
    for k in range(n):
        pixel, weight = load(window.pixels, k), load(window.weights, k)
        counts = (size(pixel) <= _LARGEST) & (weight > 0)
        pixel, weight = select(counts, pixel, 0.0), select(counts, 1.0, 0.0)
        store(window.pixels, k, pixel)
        store(window.weights, k, weight)
        number, total = number + weight, total + pixel
        low, high = select(counts, smaller(pixel, low), low), select(counts, larger(pixel, high), high)
    span = high - low
    usable = (number > 0) & (span > _LEAST_RANGE) & (span <= _LARGEST)
    blank = (load(common, OUTCOME) < 0) & without(usable)
    store(common, OUTCOME, select(blank, float(NO_INFORMATION), load(common, OUTCOME)))
    offset, factor = total / larger(number, 1.0), 1.0 / select(usable, span, 1.0)
    first, second = zero, zero
    for k in range(n):
        value = (load(window.pixels, k) - offset) * factor * load(window.weights, k)
        store(window.pixels, k, value)
        first, second = first + value, second + value * value
    _scale(room, offset, factor)
    store(common, OFFSET, offset)
    store(common, FACTOR, factor)
    store(common, PIXELS, number)
    store(common, FIRST, first)
    store(common, SECOND, second)


@njit(**INLINE)
def _scale(room: Room, offset: Any, factor: Any) -> None:
    """Bring amplitudes, background and their bounds to the units of the block."""
    for k in range(room.members):
        member = member_of(room, k)
        for step in range(4):
            row = (HEIGHT, LOWER, UPPER, TRIAL)[step]
            store(member, row, smaller(larger(load(member, row) * factor, -_LARGEST), _LARGEST))
    for row in range(BACKGROUND_ROW, TRIAL_BACKGROUND + 1):
        scaled = (load(room.common, row) - offset) * factor
        store(room.common, row, smaller(larger(scaled, -_LARGEST), _LARGEST))


@njit(**PLAIN)
def assemble_all(room: Room, members_at: Any, sums: Any, matrix: Any, number: Any) -> None:
    """Write the products of all derivatives, given the sums of members (n, N_MEMBER) at their points."""
    members = room.members
    for j in range(members):
        other = members_at + j * N_MEMBER
        for i in range(j):
            pair_block(members_at + i * N_MEMBER, other, sums_of(sums, members, i, j), i, j, matrix)
        own_block(other, sums_of(sums, members, j, j), j, matrix)
        background_block(other, sums + j * N_ALONE, j, 3 * members, matrix)
    store(matrix, entry(3 * members, 3 * members), number)
