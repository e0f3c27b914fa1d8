"""Sums over the pixels of LANES windows at once: all that a step of a fit needs to know of them.

With E = exp(-(a X^2 + 2 b X Y + c Y^2) / 2) at the distances X, Y from a column's centre, the model is A E +
background, and its derivatives are combinations of E, E X, E Y, E X^2, E X Y, E Y^2 and 1. Their scalar products with
each other and with the pixels are moments of E^2, E and E * pixel: sums of weight * X^i Y^j.

Along a row no exponential is needed: E(X + 1) = E(X) R(X) and R(X + 1) = R(X) exp(-a), both from an anchor outwards.
The two pixels at equal distances from the anchor are taken together, as sum and difference, for the even and odd
powers of X. First every row is summed over X, then the rows over Y. Moments about the window's middle are then moved
to the column's own centre and turned to the axes of its ellipse, by polynomial identities that cost little.

A window's pixels lie in a block (pixels, LANES), lane by lane another window. Blocks, sums and room are
addresses of rows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from .simd import exp, larger, load, negated, number, opaque, store, vector

Array = npt.NDArray[Any]

INNER: Any = {"error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""How functions are compiled that only compiled functions call."""

SQUARED, FIRST, DATA, TOTAL, WEIGHT, MERIT, RESIDUAL, N_SUMS = 0, 15, 21, 36, 37, 38, 39, 40
"""Rows of the sums: moments of E^2 up to order 4, of E up to order 2, of E * residual up to order 4 (each by order i
+ j, within it by j), the sums of the residual and of the weight, chi-squared, and the residual's sum of squares."""

REACH = 13
"""px from an anchor to the last pixel that it serves: there E = exp(-87), float32's smallest, for sigma = 1 px."""

_FLOOR = np.float32(1e-18)  # as E, means nothing; its square is still normal, and subnormal numbers are slow
N_ROW_SUMS = 13
_LEAST_MODEL = np.float32(1e-4)  # of the window's range of counts: the variance where the model is below


def moment(i: int, j: int) -> int:
    """Return where the moment of X^i Y^j stands among its own: by order, and within it by j."""
    n = i + j
    return n * (n + 1) // 2 + j


def _lines(kind: str) -> tuple[Array, Array]:
    """Return the rows of moments to change together, (lines, 5) to read and to write, to replace X by X + t.

    Or, for the other kinds, Y by Y + t, X by X + t Y, Y by Y + t X. Each line holds moments by rising power of what is
    replaced. Shorter lines are filled up, and what is written there goes to a spare row.
    """
    reads, writes = [], []
    for base, order in ((SQUARED, 4), (FIRST, 2), (DATA, 4)):
        lines = {
            "x": [[(i, j) for i in range(order + 1 - j)] for j in range(order)],
            "y": [[(i, j) for j in range(order + 1 - i)] for i in range(order)],
            "x by y": [[(i, n - i) for i in range(n + 1)] for n in range(1, order + 1)],
            "y by x": [[(n - j, j) for j in range(n + 1)] for n in range(1, order + 1)],
        }[kind]
        for line in lines:
            rows = [base + moment(*powers) for powers in line]
            reads.append(rows + rows[:1] * (5 - len(rows)))
            writes.append(rows + [_SPARE] * (5 - len(rows)))
    return np.array(reads), np.array(writes)


_SPARE = N_SUMS
_KINDS = [_lines(kind) for kind in ("x", "y", "x by y", "y by x")]
_READ, _WRITE = (np.concatenate([kind[k] for kind in _KINDS]) for k in (0, 1))
_BY_X, _BY_Y, _X_BY_Y, _Y_BY_X = 0, 10, 20, 30
_TURN = np.array([_BY_X, _BY_Y, _X_BY_Y, _Y_BY_X, _X_BY_Y])
_LINES, _LINES_OF_MODEL = 10, 6
"""How many lines a kind has: all, and those of the moments of E^2 and E alone."""

_POWERS = np.array([(n - j, j) for order in (4, 2, 4) for n in range(order + 1) for j in range(n + 1)])
"""(36, 2) powers of X and Y of the moments."""

N_ROOM = N_SUMS + 11
"""Rows that sums need to be turned in: themselves, a spare one, and room for powers."""


def _targets() -> Array:
    """Return (13, 5) where each row sum times Y^0 .. Y^4 goes; powers that nobody needs go to a spare row."""
    result = np.full((N_ROW_SUMS, 5), _SPARE)
    for k in range(N_ROW_SUMS):
        base, i, order = (SQUARED, k, 4) if k < 5 else (DATA, k - 5, 4) if k < 10 else (FIRST, k - 10, 2)
        for j in range(order + 1 - i):
            result[k, j] = base + moment(i, j)
    return result


_TARGETS = _targets()
_FIVE, _THREE = np.array([0, 1, 5, 6]), np.array([2, 3, 4, 7, 8, 9, 10, 11, 12])
"""The sums of rows with moments in more than Y^2, and the others."""


class Grid(NamedTuple):
    """The pixels of a window, and room for sums over its rows."""

    height: int
    width: int
    n_pixels: int
    """How many pixels count."""
    half: int
    """Where 0 is among the powers."""
    powers: Any
    """(2 half + 1, 5) k^0 .. k^4 of the integers from -half, as rows of numbers."""
    chords: Any
    """(height,) how far the pixels that count reach from the middle of their row, px; -1 where none counts."""
    rows: Any
    """(13 * height,): sum k of row y is in row k * height + y."""


class Shape(NamedTuple):
    """Centre, in px from the window's middle pixel, and exponent of E, in vectors."""

    x: Any
    y: Any
    a: Any
    b: Any
    c: Any


def chords(height: int, width: int, radius: float) -> Array:
    """Return how far the pixels within ``radius`` of a window's middle reach in each row; -1 where there is none."""
    rest = radius**2 - np.arange(-(height // 2), height - height // 2) ** 2.0
    reach = np.minimum(np.sqrt(np.maximum(rest, 0)), max(height, width))
    return np.where(rest >= 0, np.floor(reach), -1).astype(np.float32)


def count_pixels(reach: Array, width: int) -> int:
    """Return how many pixels count, given the chords."""
    sides = np.minimum(reach, width // 2) + np.minimum(reach, width - 1 - width // 2) + 1
    return int(sides[reach >= 0].sum())


def powers(height: int, width: int) -> Array:
    """Return (n, 5) k^0 .. k^4 of the integers from -max(height, width) on, float32."""
    half = max(height, width)
    return (np.arange(-half, half + 1.0)[:, None] ** np.arange(5)).astype(np.float32)


@njit(**INNER)
def _add(sums: Any, squared: Any, first: Any, data: Any, x: Any) -> Any:
    """Add two pixels at equal distances from the anchor to the 13 sums of a row, each given as (right, left)."""
    s0, s1, s2, s3, s4, u0, u1, u2, u3, u4, g0, g1, g2 = sums
    x1, x2, x3, x4 = x
    even, odd = squared[0] + squared[1], squared[0] - squared[1]
    s0 += even
    s1 += odd * x1
    s2 += even * x2
    s3 += odd * x3
    s4 += even * x4
    even, odd = data[0] + data[1], data[0] - data[1]
    u0 += even
    u1 += odd * x1
    u2 += even * x2
    u3 += odd * x3
    u4 += even * x4
    even, odd = first[0] + first[1], first[0] - first[1]
    g0 += even
    g1 += odd * x1
    g2 += even * x2
    return s0, s1, s2, s3, s4, u0, u1, u2, u3, u4, g0, g1, g2


@njit(**INNER)
def _plain_pair(sums: Any, e: Any, pixels: Any, base: Any, x: Any) -> Any:
    """Add two pixels to the sums of a row, all pixels weighing the same."""
    right, left = larger(e[0], _FLOOR), larger(e[1], _FLOOR)
    data = right * (pixels[0] - base), left * (pixels[1] - base)
    return _add(sums, (right * right, left * left), (right, left), data, x)


@njit(**INNER)
def _powers(grid: Grid, k: int) -> Any:
    """Return k .. k^4."""
    at = 5 * (grid.half + k)
    return (
        number(grid.powers, at + 1),
        number(grid.powers, at + 2),
        number(grid.powers, at + 3),
        number(grid.powers, at + 4),
    )


@njit(**INNER)
def _store_row(grid: Grid, y: int, sums: Any) -> None:
    """Keep the sums of a row."""
    h, rows = grid.height, grid.rows
    s0, s1, s2, s3, s4, u0, u1, u2, u3, u4, g0, g1, g2 = sums
    store(rows, y, s0)
    store(rows, y + h, s1)
    store(rows, y + 2 * h, s2)
    store(rows, y + 3 * h, s3)
    store(rows, y + 4 * h, s4)
    store(rows, y + 5 * h, u0)
    store(rows, y + 6 * h, u1)
    store(rows, y + 7 * h, u2)
    store(rows, y + 8 * h, u3)
    store(rows, y + 9 * h, u4)
    store(rows, y + 10 * h, g0)
    store(rows, y + 11 * h, g1)
    store(rows, y + 12 * h, g2)


@njit(**INNER)
def _plain_row(block: Any, at: int, reach: Any, start: Any, base: Any, grid: Grid, y: int) -> None:
    """Sum E^2 X^0..4, E * (pixel - base) * X^0..4 and E X^0..2 along a row, from its anchor at pixel ``at``.

    ``reach`` is how far the row goes before and after the anchor; negative where it only begins, or has ended, there.
    """
    before, after = reach
    both = min(before, after)
    e, right, left, k = start
    none = vector(np.float32(0))
    sums = none, none, none, none, none, none, none, none, none, none, none, none, none
    e_left = e
    if both >= 0:
        data = e * (load(block, at) - base)
        sums = e * e, none, none, none, none, data, none, none, none, none, e, none, none
    for j in range(1, both + 1):
        e, e_left, right, left = e * right, e_left * left, right * k, left * k
        sums = _plain_pair(sums, (e, e_left), (load(block, at + j), load(block, at - j)), base, _powers(grid, j))
    side, e, ratio = (1, e, right) if after > before else (-1, e_left, left)
    for j in range(max(both, 0) + 1, max(before, after) + 1):
        e, ratio = e * ratio, ratio * k
        if j >= -both:
            pixel = load(block, at + side * j)
            sums = _plain_pair(sums, (e, none), (pixel, none), base, _powers(grid, side * j))
    _store_row(grid, y, sums)


@njit(**INNER)
def _weighted_pair(sums: Any, totals: Any, e: Any, pixels: Any, model: Any, x: Any) -> Any:
    """Add two pixels to the sums of a row, with the weight 1 / model and the residual pixel / model - 1."""
    right, left = larger(e[0], _FLOOR), larger(e[1], _FLOOR)
    amplitude, base = model
    of_right = larger(base + amplitude * right, _LEAST_MODEL)
    of_left = larger(base + amplitude * left, _LEAST_MODEL)
    totals, weight, residual = _weigh(totals, pixels[0], of_right)
    totals, weight_left, residual_left = _weigh(totals, pixels[1], of_left)
    first = right * weight, left * weight_left
    squared, data = (right * first[0], left * first[1]), (right * residual, left * residual_left)
    return _add(sums, squared, first, data, x), totals


@njit(**INNER)
def _weigh(totals: Any, pixel: Any, model: Any) -> Any:
    """Return the totals of residual, weight, chi-squared and squares with one more pixel; its weight and residual."""
    total, weights, chi, squares = totals
    weight = 1 / model
    residual = pixel * weight - 1
    apart = pixel - model
    return (total + residual, weights + weight, chi + apart * residual, squares + apart * apart), weight, residual


@njit(**INNER)
def _weighted_row(block: Any, at: int, reach: Any, start: Any, model: Any, totals: Any, grid: Grid, y: int) -> Any:
    """Sum weight E^2 X^0..4, residual E X^0..4 and weight E X^0..2 along a row; return the totals with the row's."""
    before, after = reach
    both = min(before, after)
    e, right, left, k = start
    amplitude, base = model
    none = vector(np.float32(0))
    sums = none, none, none, none, none, none, none, none, none, none, none, none, none
    e_left = e
    if both >= 0:
        totals, weight, residual = _weigh(totals, load(block, at), larger(base + amplitude * e, _LEAST_MODEL))
        sums = weight * e * e, none, none, none, none, residual * e, none, none, none, none, weight * e, none, none
    for j in range(1, both + 1):
        e, e_left, right, left = e * right, e_left * left, right * k, left * k
        pixels = load(block, at + j), load(block, at - j)
        sums, totals = _weighted_pair(sums, totals, (e, e_left), pixels, model, _powers(grid, j))
    side, e, ratio = (1, e, right) if after > before else (-1, e_left, left)
    for j in range(max(both, 0) + 1, max(before, after) + 1):
        e, ratio = e * ratio, ratio * k
        if j >= -both:
            pixel = load(block, at + side * j)
            totals, weight, residual = _weigh(totals, pixel, larger(base + amplitude * e, _LEAST_MODEL))
            first = weight * e
            sums = _add(sums, (e * first, none), (first, none), (residual * e, none), _powers(grid, side * j))
    _store_row(grid, y, sums)
    return totals


@njit(**INNER)
def _five(grid: Grid, k: int, part: Any, into: Any) -> None:
    """Write the moments of sum ``k`` of the rows with Y^0 .. Y^4."""
    h, y, stride = part
    powers, at = grid.powers, 5 * y
    m0 = m1 = m2 = m3 = m4 = vector(np.float32(0))
    for j in range(h):
        s = load(grid.rows, k * h + j)
        m0 += s
        m1 += s * number(powers, at + 1)
        m2 += s * number(powers, at + 2)
        m3 += s * number(powers, at + 3)
        m4 += s * number(powers, at + 4)
        at += 5 * stride
    store(into, _TARGETS[k, 0], m0)
    store(into, _TARGETS[k, 1], m1)
    store(into, _TARGETS[k, 2], m2)
    store(into, _TARGETS[k, 3], m3)
    store(into, _TARGETS[k, 4], m4)


@njit(**INNER)
def _three(grid: Grid, k: int, part: Any, into: Any) -> None:
    """Write the moments of sum ``k`` of the rows with Y^0 .. Y^2."""
    h, y, stride = part
    powers, at = grid.powers, 5 * y
    m0 = m1 = m2 = vector(np.float32(0))
    for j in range(h):
        s = load(grid.rows, k * h + j)
        m0 += s
        m1 += s * number(powers, at + 1)
        m2 += s * number(powers, at + 2)
        at += 5 * stride
    store(into, _TARGETS[k, 0], m0)
    store(into, _TARGETS[k, 1], m1)
    store(into, _TARGETS[k, 2], m2)


@njit(**INNER)
def down(grid: Grid, h: int, top: int, stride: int, into: Any) -> None:
    """Write the moments of ``h`` rows, given their sums; Y goes from row ``top`` of the powers by ``stride``."""
    part = h, top, stride
    for n in range(opaque(_FIVE.size)):
        _five(grid, _FIVE[n], part, into)
    for n in range(opaque(_THREE.size)):
        _three(grid, _THREE[n], part, into)


@njit(**INNER)
def _replace(sums: Any, kind: int, lines: int, by: Any) -> None:
    """Replace X by X + ``by``, or what else the kind of lines says, in the first ``lines`` of them.

    Pascal's triangle: where m_0, m_1, ... are moments by rising power, adding t m_(i-1) to m_i from the last i down to
    the first, then to the second, and so on gives the moments of the sum's powers.
    """
    for n in range(kind, kind + lines):
        m0, m1, m2 = load(sums, _READ[n, 0]), load(sums, _READ[n, 1]), load(sums, _READ[n, 2])
        m3, m4 = load(sums, _READ[n, 3]), load(sums, _READ[n, 4])
        m4 += by * m3
        m3 += by * m2
        m2 += by * m1
        m1 += by * m0
        m4 += by * m3
        m3 += by * m2
        m2 += by * m1
        m4 += by * m3
        m3 += by * m2
        m4 += by * m3
        store(sums, _WRITE[n, 1], m1)
        store(sums, _WRITE[n, 2], m2)
        store(sums, _WRITE[n, 3], m3)
        store(sums, _WRITE[n, 4], m4)


@njit(**INNER)
def to_axes(sums: Any, most: int, centre: Any, axes: Any) -> None:
    """Turn moments of X, Y into those of u, v, along the ellipse's axes and in units of its sigmas.

    u = (cos (X - x) + sin (Y - y)) / sigma_u and v = (cos (Y - y) - sin (X - x)) / sigma_v, with ``centre`` = (x, y)
    and ``axes`` = (cos, sin, 1 / sigma_u, 1 / sigma_v). The turn is three shears, exact to rounding for |sin| <= cos.
    ``sums`` has ``N_ROOM`` rows, of which the first ``most`` are turned: TOTAL for all moments, DATA for the model's.
    """
    x, y = centre
    cos, sin, scale_u, scale_v = axes
    tangent = sin / (1 + cos)
    by_u, by_v = sums + (N_SUMS + 1), sums + (N_SUMS + 6)
    store(by_u, 0, negated(x))
    store(by_u, 1, negated(y))
    store(by_u, 2, tangent)
    store(by_u, 3, negated(sin))
    store(by_u, 4, tangent)
    for step in range(opaque(5)):
        _replace(sums, _TURN[step], _LINES if most == TOTAL else _LINES_OF_MODEL, load(by_u, step))
    u = v = vector(np.float32(1))
    for i in range(opaque(5)):
        store(by_u, i, u)
        store(by_v, i, v)
        u, v = u * scale_u, v * scale_v
    for row in range(most):
        store(sums, row, load(sums, row) * (load(by_u, _POWERS[row, 0]) * load(by_v, _POWERS[row, 1])))


@njit(**INNER)
def _start(shape: Shape, from_anchor: Any, dy: Any, k: Any) -> Any:
    """Return E at an anchor, the ratios by which it changes to the right and to the left, and their own ratio."""
    dx = from_anchor
    bend = shape.b * dy
    e = exp(-0.5 * (shape.a * dx * dx + shape.c * dy * dy) - bend * dx)
    slope = shape.a * dx + bend
    right = exp(-0.5 * shape.a - slope)
    left = exp(slope - 0.5 * shape.a)
    return e, right, left, k


@njit(**INNER)
def window_sums(block: Any, grid: Grid, shape: Shape, model: Any, likelihood: Any, room: Any, sums: Any) -> None:
    """Write the moments of E^2, E and E * residual about the window's middle pixel.

    Only pixels that count are summed over.

    ``model`` is (amplitude, background). For least squares the residual is pixel - background, and the totals are
    left out, for nothing in them depends on the shape. For maximum likelihood every pixel has the weight 1 / model,
    the residual is pixel / model - 1, and chi-squared is Pearson's. ``room`` is for the moments of one of the
    segments into which wide windows are divided.
    """
    height, width = grid.height, grid.width
    pieces = (width + 2 * REACH) // (2 * REACH + 1)
    k = exp(negated(shape.a))
    top = grid.half - height // 2
    none = vector(np.float32(0))
    totals = none, none, none, none
    for piece in range(pieces):
        begin, end = piece * width // pieces, (piece + 1) * width // pieces
        anchor = begin + (end - begin) // 2
        origin = np.float32(anchor - width // 2)
        for y in range(height):
            chord = int(number(grid.chords, y))
            first, last = max(begin, width // 2 - chord), min(end - 1, width // 2 + chord)
            reach = anchor - first, last - anchor
            start = _start(shape, origin - shape.x, np.float32(y - height // 2) - shape.y, k)
            if likelihood is None:
                _plain_row(block, y * width + anchor, reach, start, model[1], grid, y)
            else:
                totals = _weighted_row(block, y * width + anchor, reach, start, model, totals, grid, y)
        if pieces == 1:
            down(grid, height, top, opaque(1), sums)
        else:
            down(grid, height, top, opaque(1), room)
            _replace(room, opaque(_BY_X), opaque(_LINES), vector(origin))
            for row in range(opaque(TOTAL)):
                store(sums, row, load(room, row) + (load(sums, row) if piece > 0 else none))
    store(sums, TOTAL, totals[0])
    store(sums, WEIGHT, totals[1])
    store(sums, MERIT, totals[2])
    store(sums, RESIDUAL, totals[3])
