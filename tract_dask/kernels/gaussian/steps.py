"""Bounded Levenberg-Marquardt steps of LANES fits at once.

A fit's parameters are (amplitude, x, y, P, S, Q, background): P, S, Q are the coefficients of
exp(-(P u^2 + 2 S u v + Q v^2) / 2), where u and v run along the axes of the present ellipse in units of its sigmas,
so that P = Q = 1 and S = 0 before the step. There a round start is an ordinary point, although theta has no meaning,
and the bounds of the sigmas are to first order bounds of P and Q. A parameter on a bound whose gradient points
outward stays there for the step; one that a step would carry over a bound is put onto it while the others are solved
anew: the constrained optimum is found, not a clipped one.

The functions are traced, see :func:`~tract_dask.kernels.vectors.tracing.traced`: lists of vectors, one a parameter, are
registers, and rows are memory. Symmetric matrices hold their lower triangle, row by row.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..vectors.tracing import Mask, Rows, Vector, absolute, larger, select, smaller, sqrt
from .moments import (
    AMPLITUDE_ROW,
    BACKGROUND_ROW,
    COS,
    CURVATURE_U,
    CURVATURE_V,
    DATA,
    FIRST,
    KINDS,
    N_PARAMETERS,
    SIN,
    SQUARED,
    TOTAL,
    WEIGHT,
    X,
    Y,
    moment,
    to_axes,
)

LOWER, UPPER, N_BOUNDS = 0, 5, 10
"""Rows of the bounds: amplitude, x, y, curvature, background."""

BOUND_OF = (0, 1, 2, 3, 3, 3, 4)
ROW_OF = (AMPLITUDE_ROW, X, Y, CURVATURE_U, -1, CURVATURE_V, BACKGROUND_ROW)
_SINGULAR = np.float32(1e-6)
_FREE_OF = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
"""Powers of u and v in the derivatives by amplitude, centre, P, S and Q, beside E."""

HESSIAN, NEWTON, GRADIENT, LOW, HIGH, FREE, STEP, PULL = 0, 28, 56, 63, 70, 77, 84, 91
USE_NEWTON, SOLVED, N_SYSTEM = 98, 99, 100
"""Rows of the equations of a step.

J^T J of Gauss and Newton; the same with the second derivatives, which converges fast where noise is strong; the
gradient of half the residual's sum of squares; the limits of the step; 1, or 0 where a parameter stays, or goes just
to its limit; the step; the equations' right side; whether Newton's matrix is taken; whether there
is a solution.
"""


def entry(i: int, j: int) -> int:
    """Return where the element (i, j) of a symmetric matrix is stored."""
    high, low = max(i, j), min(i, j)
    return high * (high + 1) // 2 + low


def _product(i: int, j: int) -> int:
    """Return where the product of (E, E u, E v, E u^2, E u v, E v^2, 1)'s elements i and j stands in the sums."""
    if min(i, j) == 6:
        return WEIGHT
    if max(i, j) == 6:
        return FIRST + moment(*_FREE_OF[min(i, j)])
    (a, b), (c, d) = _FREE_OF[i], _FREE_OF[j]
    return SQUARED + moment(a + c, b + d)


PRODUCTS = {entry(i, j): _product(i, j) for i in range(7) for j in range(i + 1)}
"""Where the sums hold the products that make the matrices."""


def read(rows: Rows, first: int, n: int) -> list[Vector]:
    """Return ``n`` rows."""
    return [rows[first + i] for i in range(n)]


def write(rows: Rows, first: int, values: list[Vector]) -> None:
    """Write rows from the ``first`` on."""
    for i, value in enumerate(values):
        rows[first + i] = value


def assemble(point: Rows, sums: Rows) -> tuple[list[Vector], list[Vector], list[Vector]]:
    """Return J^T J, the same with second derivatives, and the gradient at a point (8,), given its sums."""
    own = read(sums, 0, WEIGHT + 1)
    amplitude, cos, sin = point[AMPLITUDE_ROW], point[COS], point[SIN]
    scale_u, scale_v = sqrt(point[CURVATURE_U]), sqrt(point[CURVATURE_V])
    to_axes(own, KINDS, (point[X], point[Y]), (cos, sin, scale_u, scale_v))
    by_shape = -0.5 * amplitude
    inverse = select(absolute(amplitude) > 1e-20, 1 / amplitude, 0)
    one = amplitude.of(1)
    scale = [one, amplitude, amplitude, by_shape, -amplitude, by_shape, one]
    gradient = [-(scale[i] * own[DATA + i if i < 6 else TOTAL]) for i in range(7)]
    hessian, newton = [], []
    for i in range(7):
        for j in range(i + 1):
            product = PRODUCTS[entry(i, j)]
            both = scale[i] * scale[j]
            value = both * own[product]
            hessian.append(value)
            newton.append(value - both * inverse * own[DATA - SQUARED + product] if 0 < i < 6 else value)
    s, su, sv = own[DATA : DATA + 3]
    # the second derivatives of log(E) itself, all by the centre: -1 by u u, u by u P, v by u S, ...
    for here, score in ((XX, -s), (YY, -s), (7, su), (11, sv), (12, su), (17, sv)):
        newton[here] = newton[here] - amplitude * score
    by_x, by_y = (scale_u * cos, -(scale_v * sin)), (scale_u * sin, scale_v * cos)
    turn_centre(hessian, by_x, by_y)
    turn_centre(newton, by_x, by_y)
    u, v = gradient[1:3]
    gradient[1:3] = by_x[0] * u + by_x[1] * v, by_y[0] * u + by_y[1] * v
    return hessian, newton, gradient


XX, XY, YY, _SS = entry(1, 1), entry(1, 2), entry(2, 2), entry(4, 4)


def turn_centre(matrix: list[Vector], by_x: Any, by_y: Any) -> None:
    """Replace rows 1, 2 of a matrix, which are for a centre moved along u, v, by those for x, y."""
    (xu, xv), (yu, yv) = by_x, by_y
    uu, uv, vv = matrix[XX], matrix[XY], matrix[YY]
    matrix[XX] = xu * (xu * uu + 2 * xv * uv) + xv * xv * vv
    matrix[XY] = xu * yu * uu + (xu * yv + xv * yu) * uv + xv * yv * vv
    matrix[YY] = yu * (yu * uu + 2 * yv * uv) + yv * yv * vv
    for other in (0, 3, 4, 5, 6):
        of_x, of_y = entry(1, other), entry(2, other)
        u, v = matrix[of_x], matrix[of_y]
        matrix[of_x], matrix[of_y] = xu * u + xv * v, yu * u + yv * v


def _outward(low: Vector, high: Vector, gradient: Vector) -> Mask:
    """Return where a parameter is on a bound, with its gradient pushing against it."""
    return ((low >= 0) & (gradient > 0)) | ((high <= 0) & (gradient < 0))


def limits(point: Rows, bounds: Rows, free_shape: Vector) -> tuple[list[Vector], list[Vector]]:
    """Return the limits of a step: the bounds, and nearer ones where the quadratic model is not to be believed.

    Where ``free_shape`` is 0, the shape stays.
    """
    u, v = point[CURVATURE_U], point[CURVATURE_V]
    low, high = [u] * 7, [u] * 7
    reach = 1 / sqrt(smaller(u, v))
    for i in (0, 1, 2, 6):
        value = point[ROW_OF[i]]
        low[i], high[i] = bounds[LOWER + BOUND_OF[i]] - value, bounds[UPPER + BOUND_OF[i]] - value
        if i in (1, 2):
            low[i], high[i] = larger(low[i], -reach), smaller(high[i], reach)
    flattest, steepest = bounds[LOWER + 3], bounds[UPPER + 3]
    for i, curvature in ((3, u), (5, v)):
        low[i] = free_shape * larger(flattest / curvature - 1, -0.75)
        high[i] = free_shape * smaller(steepest / curvature - 1, 3.0)
    on_bound = (low[3] >= 0) | (high[3] <= 0)
    high[4] = select(u.equals(v) & on_bound, 0, 0.75 * free_shape)
    low[4] = -high[4]
    return low, high


def stiffness(point: Rows, low: list[Vector], high: list[Vector], gradient: list[Vector]) -> Any:
    """Return the bounds' own curvature by S: an axis held on its bound leaves it by S^2 as the ellipse turns."""
    u, v = point[CURVATURE_U], point[CURVATURE_V]
    value = select(_outward(low[3], high[3], gradient[3]), absolute(gradient[3]) * v, 0)
    value = value + select(_outward(low[5], high[5], gradient[5]), absolute(gradient[5]) * u, 0)
    return select(u.equals(v), 0, 2 * value / larger(absolute(u - v), 1e-20))


def factorise(matrix: list[Vector], diagonal: list[Vector], free: list[Vector], damping: Vector) -> Any:
    """Return L, 1 / D and where D is positive, of L D L^T, the matrix of the free parameters.

    ``damping`` times ``diagonal``, that of J^T J, is added. L is a lower triangle without its diagonal of ones. For a
    parameter that is not free 1 / D is 0: nothing else is needed to leave it out.
    """
    lower: dict[tuple[int, int], Vector] = {}
    times_d: dict[tuple[int, int], Vector] = {}
    inverse: list[Vector] = []
    positive = damping >= 0
    for j in range(7):
        pivot, least = matrix[entry(j, j)] + damping * diagonal[j], _SINGULAR * diagonal[j]
        for k in range(j):
            pivot = pivot - lower[j, k] * times_d[j, k]
        positive = positive & ((pivot > least) | (free[j] <= 0))
        inverse.append(select(free[j] > 0, 1 / larger(pivot, least), 0))
        for i in range(j + 1, 7):
            value = matrix[entry(i, j)]
            for k in range(j):
                value = value - lower[i, k] * times_d[j, k]
            times_d[i, j] = value
            lower[i, j] = value * inverse[j]
    return lower, inverse, positive


def solve(factors: Any, values: list[Any]) -> list[Vector]:
    """Return the solution of matrix * solution = values, with the matrix's factors; 0 where a parameter is not free.

    Values may be None for 0, up to the first that is not.
    """
    lower, inverse, _ = factors
    solution = list(values)
    begin = next(i for i, value in enumerate(values) if value is not None)
    for i in range(begin + 1, 7):
        for k in range(begin, i):
            product = lower[i, k] * solution[k]
            solution[i] = -product if solution[i] is None else solution[i] - product
    result: list[Any] = [None] * 7
    for i in reversed(range(7)):
        total = None if solution[i] is None else solution[i] * inverse[i]
        for k in range(i + 1, 7):
            product = lower[k, i] * result[k]
            total = -product if total is None else total - product
        result[i] = total
    return result


def release(system: Rows, where: Mask) -> None:
    """Let every parameter free that is not pushed against its bound, in some lanes."""
    for i in range(7):
        gradient = system[GRADIENT + i]
        held = _outward(system[LOW + i], system[HIGH + i], gradient) | (system[HESSIAN + entry(i, i)] <= 0)
        system[FREE + i] = select(where, select(held, 0, system.constant(1)), system[FREE + i])
        system[PULL + i] = select(where, -gradient, system[PULL + i])
        system[STEP + i] = select(where, 0, system[STEP + i])


def solve_bounded(system: Rows, running: Mask, damping: Vector) -> Any:
    """Solve for the free parameters; return where that has to be done again.

    Parameters that cross their limits are put onto them, and the others' equations are told. Newton's matrix is taken
    where it is to be tried and positive, else that of Gauss and Newton.
    """
    hessian = read(system, HESSIAN, 28)
    use_newton = system[USE_NEWTON] > 0
    matrix = [
        select(use_newton, newton, other) for newton, other in zip(read(system, NEWTON, 28), hessian, strict=True)
    ]
    free, pull = read(system, FREE, 7), read(system, PULL, 7)
    factors = factorise(matrix, [hessian[entry(i, i)] for i in range(7)], free, damping)
    solution, positive = solve(factors, pull), factors[2]
    misled = use_newton & ~positive
    again = misled & ~positive & running
    for i in range(7):
        low, high = system[LOW + i], system[HIGH + i]
        value = smaller(larger(solution[i], low), high)
        is_free = free[i] > 0
        crossed = is_free & positive & ((solution[i] < low) | (solution[i] > high))
        again = again | (crossed & running)
        system[STEP + i] = select(is_free, value, system[STEP + i])
        system[FREE + i] = select(crossed, 0, free[i])
        for j in range(7):
            pull[j] = pull[j] - matrix[entry(i, j)] * select(crossed, value, 0)
    write(system, PULL, pull)
    system[USE_NEWTON] = select(positive, system[USE_NEWTON], 0)
    system[SOLVED] = select(positive, system.constant(1), 0)
    release(system, misled)
    return again


def diagonal_axes(p: Vector, s: Vector, q: Vector) -> tuple[Vector, Vector]:
    """Return (cos, sin) of the turn, by at most 45 degrees, that makes p u^2 + 2 s u v + q v^2 diagonal."""
    apart = p - q
    tangent = 2 * s / (absolute(apart) + sqrt(apart * apart + 4 * s * s) + 1e-30)
    tangent = select(apart < 0, -tangent, tangent)
    cos = 1 / sqrt(1 + tangent * tangent)
    return cos, tangent * cos


def turned(point: Rows, curvatures: Any, turn: Any) -> list[Vector]:
    """Return a point's axes turned by (cos, sin), as curvatures, cos and sin; keeps |sin| <= cos by exchanging axes."""
    u, v = curvatures
    by_cos, by_sin = turn
    cos = point[COS] * by_cos - point[SIN] * by_sin
    sin = point[SIN] * by_cos + point[COS] * by_sin
    sin, cos = select(cos < 0, -sin, sin), absolute(cos)
    exchange = absolute(sin) > cos
    cos, sin = select(exchange, absolute(sin), cos), select(exchange, select(sin > 0, -cos, cos), sin)
    length = 1 / sqrt(cos * cos + sin * sin)
    return [select(exchange, v, u), select(exchange, u, v), cos * length, sin * length]


def move(point: Rows, step: list[Vector], bounds: Rows, free_shape: Vector) -> list[Vector]:
    """Return the point after a step, within the bounds, and exactly on them where the step ends there."""
    trial = read(point, 0, N_PARAMETERS)
    for i in (0, 1, 2, 6):
        value, by = trial[ROW_OF[i]], step[i]
        lower, upper = bounds[LOWER + BOUND_OF[i]], bounds[UPPER + BOUND_OF[i]]
        moved = select(by <= lower - value, lower, select(by >= upper - value, upper, value + by))
        trial[ROW_OF[i]] = smaller(larger(moved, lower), upper)
    u, v = trial[CURVATURE_U], trial[CURVATURE_V]
    lower, upper = bounds[LOWER + 3], bounds[UPPER + 3]
    p, q, s = u * (1 + step[3]), v * (1 + step[5]), sqrt(u * v) * step[4]
    cos, sin = diagonal_axes(p, s, q)
    by_turn = s * sin / cos
    free = free_shape > 0
    curvatures = (_bounded(p + by_turn, lower, upper), u), (_bounded(q - by_turn, lower, upper), v)
    turn = select(free, cos, 1), select(free, sin, 0)
    trial[CURVATURE_U : SIN + 1] = turned(point, [select(free, *pair) for pair in curvatures], turn)
    return trial


def _bounded(curvature: Vector, lower: Vector, upper: Vector) -> Any:
    """Return the curvature within its bounds, exactly on one where only rounding keeps it off."""
    near = 1e-6
    return select(curvature <= lower * (1 + near), lower, select(curvature >= upper * (1 - near), upper, curvature))


def length_px(point: Rows, step: list[Vector]) -> Any:
    """Return how far a step moves the centre, or a tenth of how far it moves the ellipse's outline, if that is more."""
    sigma_u, sigma_v = 1 / sqrt(point[CURVATURE_U]), 1 / sqrt(point[CURVATURE_V])
    wider = larger(absolute(step[3]) * sigma_u, absolute(step[5]) * sigma_v) * 0.5
    turned_by = absolute(step[4]) * sigma_u * sigma_v / (sigma_u + sigma_v)
    return larger(larger(absolute(step[1]), absolute(step[2])), larger(wider, turned_by) * 0.1)
