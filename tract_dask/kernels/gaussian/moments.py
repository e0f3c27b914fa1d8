"""Sums over the pixels of LANES windows at once: all that a step of a fit needs to know of them.

With E = exp(-(a X^2 + 2 b X Y + c Y^2) / 2) at the distances X, Y from a column's centre, the model is A E +
background, and its derivatives are combinations of E, E X, E Y, E X^2, E X Y, E Y^2 and 1. Their scalar products with
each other and with the pixels are moments of E^2, E and E * pixel: sums of weight * X^i Y^j.

Along a row no exponential is needed: E(X + 1) = E(X) R(X) and R(X + 1) = R(X) exp(-a), both from an anchor outwards.
The two pixels at equal distances from the anchor are taken together, as sum and difference, for the even and odd
powers of X. First every row is summed over X, then the rows over Y. Moments about the window's middle are then moved
to the column's own centre and turned to the axes of its ellipse, by polynomial identities that cost little.

A window's pixels lie in a block (pixels, LANES), lane by lane another window. Blocks, sums and room are
addresses of rows. Functions without a decorator are traced, see :func:`~tract_dask.kernels.vectors.tracing.traced`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from ..vectors.tracing import INLINE, Index, Rows, Vector, exp, fewer, larger, loop, more, select, spread, traced

Array = npt.NDArray[Any]

SQUARED, FIRST, DATA, TOTAL, WEIGHT, MERIT, RESIDUAL, N_SUMS = 0, 15, 21, 36, 37, 38, 39, 40
"""Rows of the sums: moments of E^2 up to order 4, of E up to order 2, of E * residual up to order 4 (each by order i
+ j, within it by j), the sums of the residual and of the weight, chi-squared, and the residual's sum of squares."""

REACH = 13
"""px from an anchor to the last pixel that it serves: there E = exp(-87), float32's smallest, for sigma = 1 px."""

_FLOOR = 1e-18  # as E, means nothing; its square is still normal, and subnormal numbers are slow
_LEAST_MODEL = 1e-4  # of the window's range of counts: the variance where the model is below

ROW_OF_SQUARED, ROW_OF_DATA, ROW_OF_FIRST, _ROW_OF_TOTALS, N_ROW_SUMS = 0, 5, 10, 13, 17
"""Sums of a row of pixels: E^2 X^0..4, E * residual X^0..4, E X^0..2, and the four totals."""

KINDS = ((SQUARED, ROW_OF_SQUARED, 4), (DATA, ROW_OF_DATA, 4), (FIRST, ROW_OF_FIRST, 2))
"""The kinds of moments: first row of the sums, first sum of a row of pixels, highest order."""


def moment(i: int, j: int) -> int:
    """Return where the moment of X^i Y^j stands among its own: by order, and within it by j."""
    n = i + j
    return n * (n + 1) // 2 + j


def orders(most: int) -> list[tuple[int, int]]:
    """Return the powers (i, j) of the moments up to an order, as they stand."""
    return [(n - j, j) for n in range(most + 1) for j in range(n + 1)]


class Grid(NamedTuple):
    """The pixels of a window, and room for sums over its rows; sizes are integers."""

    height: Any
    width: Any
    half_height: Any
    half_width: Any
    """Row and column of the middle pixel."""
    n_pixels: Any
    """How many pixels count."""
    half: Any
    """Where 0 is among the powers."""
    powers: Any
    """(2 half + 1, 5) k^0 .. k^4 of the integers from -half, as rows of numbers."""
    chords: Any
    """(height,) how far the pixels that count reach from the middle of their row, px; -1 where none counts."""
    rows: Any
    """(N_ROW_SUMS * height,)"""


class Shape(NamedTuple):
    """Centre, in px from the window's middle pixel, and exponent of E."""

    x: Any
    y: Any
    a: Any
    b: Any
    c: Any


AMPLITUDE_ROW, X, Y, CURVATURE_U, CURVATURE_V, COS, SIN, BACKGROUND_ROW, N_PARAMETERS = 0, 1, 2, 3, 4, 5, 6, 7, 8
"""Rows of a point: the curvatures 1 / sigma^2 along the axes u = (cos, sin) and v = (-sin, cos), with |sin| <= cos."""


def ellipse(point: Any, u: Vector, v: Vector) -> Shape:
    """Return the shape of a Gaussian at a point's centre and axes with the curvatures u and v."""
    cos, sin = point[COS], point[SIN]
    a, c = u * cos * cos + v * sin * sin, u * sin * sin + v * cos * cos
    return Shape(point[X], point[Y], a, (u - v) * cos * sin, c)


def shape_of(point: Any) -> Shape:
    """Return the shape of the Gaussian of a point (8,)."""
    return ellipse(point, point[CURVATURE_U], point[CURVATURE_V])


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


def powers_of(grid: Grid, k: Index) -> list[Vector]:
    """Return k^0 .. k^4."""
    return [grid.powers.single((grid.half + k) * 5 + n) for n in range(5)]


def add_pair(sums: list[Vector], pairs: Any, x: list[Vector]) -> list[Vector]:
    """Add pixels at distances x and -x to the 13 sums of a row.

    ``pairs`` are (right, left) of E^2, E * residual and E, with their weights; left is None where there is no pixel,
    and a pair is None where the sums are not wanted.
    """
    added = list(sums)
    for pair, (_, first, order) in zip(pairs, KINDS, strict=True):
        if pair is None:
            continue
        right, left = pair
        even, odd = (right, right) if left is None else (right + left, right - left)
        for i in range(order + 1):
            added[first + i] += odd * x[i] if i % 2 else even * x[i] if i else even
    return added


def _plain(e: Vector, pixel: Vector, model: Any) -> tuple[list[Vector], list[Vector]]:
    """Return E^2, E * residual and E of a pixel, all pixels weighing the same; there are no totals."""
    e = larger(e, _FLOOR)
    return [e * e, e * (pixel - model[1]), e], []


def _weighted(e: Vector, pixel: Vector, model: Any) -> tuple[list[Vector], list[Vector]]:
    """Return E^2 weight, E * residual and E weight, weight = 1 / model and residual = pixel / model - 1.

    And of the pixel alone: residual, weight, chi-squared, and the square of its distance from the model.
    """
    amplitude, base = model
    e = larger(e, _FLOOR)
    expected = larger(base + amplitude * e, _LEAST_MODEL)
    weight, apart = 1 / expected, pixel - expected
    residual = pixel * weight - 1
    first = e * weight
    return [e * first, e * residual, first], [residual, weight, apart * residual, apart * apart]


def _sum_row(block: Rows, reach: Any, start: Any, model: Any, likelihood: Any, grid: Grid) -> list[Vector]:
    """Return the sums of a row of pixels, of which ``block`` is the anchor; X is the distance from the anchor.

    ``reach`` is how far the row goes before and after the anchor; negative where it only begins, or has ended, there.
    ``start`` is what :func:`_start` returns.
    """
    before, after = reach
    e, right, left, k = start
    term = _plain if likelihood is None else _weighted
    both = fewer(before, after)

    def add(sums: list[Vector], ends: Any, j: Index) -> list[Vector]:
        terms = [term(e, pixel, model) for e, pixel in ends]
        products = [(*values, None)[:2] for values in zip(*(of_pixel for of_pixel, _ in terms), strict=True)]
        totals = list(sums[_ROW_OF_TOTALS:])
        for _, of_pixel in terms:
            totals = [total + value for total, value in zip(totals, of_pixel, strict=True)]
        return add_pair(sums[:_ROW_OF_TOTALS], products, powers_of(grid, j)) + totals

    def pair(j: Index, values: list[Vector]) -> list[Vector]:
        (e, e_left, right, left), sums = values[:4], values[4:]
        e, e_left = e * right, e_left * left
        return [e, e_left, right * k, left * k, *add(sums, ((e, block[j]), (e_left, block[j * -1])), j)]

    def skip(j: Index, values: list[Vector]) -> list[Vector]:
        return [values[0] * values[1], values[1] * k]

    products, totals = term(e, block[0], model)
    sums = [e.of(0)] * (_ROW_OF_TOTALS + len(totals))
    for place, value in enumerate(products + totals):
        row = KINDS[place][1] if place < len(KINDS) else _ROW_OF_TOTALS + place - len(KINDS)
        sums[row] = select(spread(both) >= 0, value, 0)
    e, e_left, right, left, *sums = loop(both.constant(1), both + 1, [e, e, right, left, *sums], pair)
    for side, end, e, ratio in ((1, after, e, right), (-1, before, e_left, left)):  # noqa: B020

        def single(j: Index, values: list[Vector], side: int = side) -> list[Vector]:
            e = values[0] * values[1]
            return [e, values[1] * k, *add(values[2:], ((e, block[j * side]),), j * side)]

        begin = more(both + 1, both * -1)
        e, ratio = loop(more(both, 0) + 1, fewer(begin, end + 1), [e, ratio], skip)
        sums = loop(begin, end + 1, [e, ratio, *sums], single)[2:]
    return sums


def _start(shape: Shape, dx: Vector, dy: Vector) -> tuple[Vector, ...]:
    """Return E at an anchor, the ratios by which it changes to the right and to the left, and their own ratio."""
    bend = shape.b * dy
    e = exp(-0.5 * (shape.a * dx * dx + shape.c * dy * dy) - bend * dx)
    slope = shape.a * dx + bend
    return e, exp(-0.5 * shape.a - slope), exp(slope - 0.5 * shape.a), exp(-shape.a)


@traced()
def _sum_segment(block: Rows, grid: Grid, segment: Any, point: Rows, likelihood: Any, into: Rows) -> None:
    """Write the moments of a window's columns from ``begin`` to before ``end`` about their anchor."""
    begin, end, anchor = segment
    middle, shape = grid.half_width, shape_of(point)
    model = point[AMPLITUDE_ROW], point[BACKGROUND_ROW]
    dx = spread(anchor - middle) - shape.x

    def row(y: Index, _: list[Vector]) -> list[Vector]:
        chord = grid.chords.integer(y)
        reach = anchor - more(begin, middle - chord), fewer(end - 1, middle + chord) - anchor
        start = _start(shape, dx, spread(y - grid.half_height) - shape.y)
        sums = _sum_row(block + (y * grid.width + anchor), reach, start, model, likelihood, grid)
        line = grid.rows + y * N_ROW_SUMS
        for k, value in enumerate(sums):
            line[k] = value
        return []

    loop(begin.constant(0), grid.height, [], row)
    down(grid, grid.height, grid.half_height * -1, begin.constant(1), KINDS, into)
    _add_totals(grid, likelihood, into)


def down(grid: Grid, h: Index, top: Index, stride: Index, kinds: Any, into: Rows) -> None:
    """Write the moments of ``h`` rows, given their sums; Y goes from ``top`` by ``stride``."""
    for base, first, order in kinds:

        def moments(j: Index, values: list[Vector], first: int = first, order: int = order) -> list[Vector]:
            line, y = grid.rows + j * N_ROW_SUMS, powers_of(grid, top + j * stride)
            sums = [line[first + i] for i in range(order + 1)]
            return [v + (sums[i] * y[n] if n else sums[i]) for v, (i, n) in zip(values, orders(order), strict=True)]

        found = loop(h.constant(0), h, [into.constant(0)] * len(orders(order)), moments)
        for k, value in enumerate(found):
            into[base + k] = value


def _add_totals(grid: Grid, likelihood: Any, into: Rows) -> None:
    """Write the totals of all rows; nothing but 0 for least squares."""

    def total(j: Index, values: list[Vector]) -> list[Vector]:
        line = grid.rows + j * N_ROW_SUMS
        return [v + line[_ROW_OF_TOTALS + i] for i, v in enumerate(values)]

    found = [into.constant(0)] * (N_ROW_SUMS - _ROW_OF_TOTALS)
    if likelihood is not None:
        found = loop(grid.height.constant(0), grid.height, found, total)
    for k, value in enumerate(found):
        into[TOTAL + k] = value


def _replace(moments: list[Vector], base: int, lines: Any, by: Vector) -> None:
    """Replace X by X + ``by``, or what else the lines say: each is moments by rising power of what is replaced.

    Pascal's triangle: where m_0, m_1, ... are moments by rising power, adding t m_(i-1) to m_i from the last i down to
    the first, then to the second, and so on gives the moments of the sum's powers.
    """
    for line in lines:
        places = [base + moment(*powers) for powers in line]
        for first in range(1, len(places)):
            for i in range(len(places) - 1, first - 1, -1):
                moments[places[i]] = moments[places[i]] + by * moments[places[i - 1]]


def _lines_of(kind: str, order: int) -> list[list[tuple[int, int]]]:
    """Return the powers of the moments that change together where X is replaced by X + t, Y by Y + t, X by X + t Y."""
    return {
        "x": [[(i, j) for i in range(order + 1 - j)] for j in range(order)],
        "y": [[(i, j) for j in range(order + 1 - i)] for i in range(order)],
        "x by y": [[(i, n - i) for i in range(n + 1)] for n in range(1, order + 1)],
        "y by x": [[(n - j, j) for j in range(n + 1)] for n in range(1, order + 1)],
    }[kind]


def to_axes(moments: list[Vector], kinds: Any, centre: Any, axes: Any) -> None:
    """Turn moments of X, Y into those of u, v, along the ellipse's axes and in units of its sigmas.

    u = (cos (X - x) + sin (Y - y)) / sigma_u and v = (cos (Y - y) - sin (X - x)) / sigma_v, with ``centre`` = (x, y)
    and ``axes`` = (cos, sin, 1 / sigma_u, 1 / sigma_v). The turn is three shears, exact to rounding for |sin| <= cos.
    ``kinds`` are those of the ``KINDS`` that are turned.
    """
    x, y = centre
    cos, sin, scale_u, scale_v = axes
    tangent = sin / (1 + cos)
    by_u, by_v = [x.of(1)], [x.of(1)]
    for _ in range(4):
        by_u.append(by_u[-1] * scale_u)
        by_v.append(by_v[-1] * scale_v)
    for base, _, order in kinds:
        for kind, by in (("x", -x), ("y", -y), ("x by y", tangent), ("y by x", -sin), ("x by y", tangent)):
            _replace(moments, base, _lines_of(kind, order), by)
        for i, j in orders(order):
            place = base + moment(i, j)
            moments[place] = moments[place] * (by_u[i] * by_v[j])


@traced()
def _add_segment(sums: Rows, part: Rows, origin: Index, is_first: Index) -> None:
    """Add the moments of a segment, about its anchor at X = ``origin``, to those about the window's middle."""
    moments = [part[k] for k in range(N_SUMS)]
    for base, _, order in KINDS:
        _replace(moments, base, _lines_of("x", order), spread(origin))
    for k, value in enumerate(moments):
        sums[k] = value + select(spread(is_first) > 0, 0, sums[k])


@njit(**INLINE)
def window_sums(block: Any, grid: Grid, point: Any, likelihood: Any, room: Any, sums: Any) -> None:
    """Write the moments of E^2, E and E * residual about the window's middle pixel, for a point.

    Only pixels that count are summed over. For least squares the residual is pixel - background, and the totals are
    left out, for nothing in them depends on the shape. For maximum likelihood every pixel has the weight 1 / model,
    the residual is pixel / model - 1, and chi-squared is Pearson's. ``room`` is for the moments of one of the
    segments into which wide windows are divided.
    """
    width = grid.width
    pieces = (width + 2 * REACH) // (2 * REACH + 1)
    for piece in range(pieces):
        begin, end = piece * width // pieces, (piece + 1) * width // pieces
        anchor = begin + (end - begin) // 2
        _sum_segment(block, grid, (begin, end, anchor), point, likelihood, sums if pieces == 1 else room)
        if pieces > 1:
            _add_segment(sums, room, anchor - width // 2, piece == 0)
