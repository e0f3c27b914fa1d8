"""Bounded Levenberg-Marquardt steps of LANES fits at once.

A fit's parameters are (amplitude, x, y, P, S, Q, background): P, S, Q are the coefficients of
exp(-(P u^2 + 2 S u v + Q v^2) / 2), where u and v run along the axes of the present ellipse in units of its sigmas,
so that P = Q = 1 and S = 0 before the step. There a round start is an ordinary point, although theta has no meaning,
and the bounds of the sigmas are to first order bounds of P and Q. A parameter on a bound whose gradient points
outward stays there for the step; one that a step would carry over a bound is put onto it while the others are solved
anew: the constrained optimum is found, not a clipped one.

Arrays are (rows, LANES) float32, one row a parameter. Symmetric matrices hold their lower triangle, row by row.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from .moments import DATA, FIRST, INNER, N_ROOM, SQUARED, TOTAL, WEIGHT, Array, moment, to_axes
from .simd import (
    absolute,
    count,
    larger,
    load,
    negated,
    opaque,
    select,
    smaller,
    sqrt,
    store,
    vector,
)

AMPLITUDE, X, Y, CURVATURE_U, CURVATURE_V, COS, SIN, BACKGROUND, N_PARAMETERS = 0, 1, 2, 3, 4, 5, 6, 7, 8
"""Rows of a point: the curvatures 1 / sigma^2 along the axes u = (cos, sin) and v = (-sin, cos), with |sin| <= cos."""

LOWER, UPPER, N_BOUNDS = 0, 5, 10
"""Rows of the bounds: amplitude, x, y, curvature, background."""

BOUND_OF = np.array([0, 1, 2, 3, 3, 3, 4])
ROW_OF = np.array([AMPLITUDE, X, Y, CURVATURE_U, -1, CURVATURE_V, BACKGROUND])
_SINGULAR = np.float32(1e-6)
_N_MATRIX = 28


def _products() -> Array:
    """Return where each product of (E, E u, E v, E u^2, E u v, E v^2, 1) stands in the sums, as a lower triangle."""
    powers = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
    rows = [SQUARED + moment(i + k, j + n) for a, (i, j) in enumerate(powers) for k, n in powers[: a + 1]]
    return np.array(rows + [FIRST + moment(i, j) for i, j in powers] + [WEIGHT])


PRODUCTS = _products()

XX, XY, YY, _SS = 2, 4, 5, 14
"""Elements of a symmetric matrix."""

_WITH_X, _WITH_Y = np.array([1, 7, 11, 16, 22]), np.array([3, 8, 12, 17, 23])
"""The same of x, or y, with the other parameters."""


class System(NamedTuple):
    """The normal equations of a step in (amplitude, x, y, P, S, Q, background), its limits, and the step itself."""

    sums: Any
    """Moments along the ellipse's axes."""
    hessian: Any
    """(28,) J^T J, of Gauss and Newton."""
    newton: Any
    """(28,) with the second derivatives as well: where noise is strong, only this one converges fast."""
    gradient: Any
    """(7,) of half the residual's sum of squares."""
    low: Any
    high: Any
    """(7,) limits of the step."""
    free: Any
    """(7,) 1, or 0 where the parameter stays, or goes just to its limit."""
    step: Any
    """(7,)."""
    factor: Any
    """(28,) room."""
    scale: Any
    pull: Any
    """(7,) room."""


N_SYSTEM = N_ROOM + 84 + 49
"""Rows of a system."""


@njit(**INNER)
def system_in(room: Any) -> System:
    """Return a system in ``N_SYSTEM`` rows."""
    matrices, rows = room + N_ROOM, room + (N_ROOM + 84)
    return System(
        room,
        matrices,
        matrices + 28,
        rows,
        rows + 7,
        rows + 14,
        rows + 21,
        rows + 28,
        matrices + 56,
        rows + 35,
        rows + 42,
    )


@njit(**INNER)
def entry(i: int, j: int) -> int:
    """Return where the element (i, j) of a symmetric matrix is stored."""
    high, low = max(i, j), min(i, j)
    return (high * (high + 1) >> 1) + low


@njit(**INNER)
def assemble(point: Any, sums: Any, system: System) -> None:
    """Turn the moments (30,) at a point (8,) into the hessian and the gradient."""
    own, hessian, newton, gradient = system.sums, system.hessian, system.newton, system.gradient
    for row in range(opaque(WEIGHT + 1)):
        store(own, row, load(sums, row))
    amplitude, cos, sin = load(point, AMPLITUDE), load(point, COS), load(point, SIN)
    scale_u, scale_v = sqrt(load(point, CURVATURE_U)), sqrt(load(point, CURVATURE_V))
    centre, axes = (load(point, X), load(point, Y)), (cos, sin, scale_u, scale_v)
    to_axes(own, opaque(TOTAL), centre, axes)
    by_shape = -0.5 * amplitude
    inverse = select(absolute(amplitude) > 1e-20, 1 / amplitude, 0)
    store(system.scale, 0, 1)
    store(system.scale, 1, amplitude)
    store(system.scale, 2, amplitude)
    store(system.scale, 3, by_shape)
    store(system.scale, 4, negated(amplitude))
    store(system.scale, 5, by_shape)
    store(system.scale, 6, 1)
    for i in range(opaque(7)):
        factor = load(system.scale, i)
        store(gradient, i, negated(factor * load(own, DATA + i if i < 6 else TOTAL)))
        for j in range(i + 1):
            here = entry(i, j)
            scale = factor * load(system.scale, j)
            value = scale * load(own, PRODUCTS[here])
            store(hessian, here, value)
            if 0 < i < 6:
                value -= scale * inverse * load(own, DATA - SQUARED + PRODUCTS[here])
            store(newton, here, value)
    _bend_centre(newton, amplitude, (load(own, DATA), load(own, DATA + 1), load(own, DATA + 2)))
    by_x, by_y = (scale_u * cos, negated(scale_v * sin)), (scale_u * sin, scale_v * cos)
    turn_centre(hessian, by_x, by_y)
    turn_centre(newton, by_x, by_y)
    u, v = load(gradient, 1), load(gradient, 2)
    store(gradient, 1, by_x[0] * u + by_x[1] * v)
    store(gradient, 2, by_y[0] * u + by_y[1] * v)


@njit(**INNER)
def _bend_centre(newton: Any, amplitude: Any, scores: Any) -> None:
    """Add the second derivatives of log(E) itself, all by the centre: -1 by u u, u by u P, v by u S, ..."""
    s, su, sv = scores
    for here, score in ((XX, negated(s)), (YY, negated(s)), (7, su), (11, sv), (12, su), (17, sv)):
        store(newton, here, load(newton, here) - amplitude * score)


@njit(**INNER)
def turn_centre(hessian: Any, by_x: Any, by_y: Any) -> None:
    """Replace rows 1, 2 of a matrix, which are for a centre moved along u, v, by those for x, y."""
    xu, xv = by_x
    yu, yv = by_y
    uu, uv, vv = load(hessian, XX), load(hessian, XY), load(hessian, YY)
    store(hessian, XX, xu * (xu * uu + 2 * xv * uv) + xv * xv * vv)
    store(hessian, XY, xu * yu * uu + (xu * yv + xv * yu) * uv + xv * yv * vv)
    store(hessian, YY, yu * (yu * uu + 2 * yv * uv) + yv * yv * vv)
    for n in range(opaque(_WITH_X.size)):
        u, v = load(hessian, _WITH_X[n]), load(hessian, _WITH_Y[n])
        store(hessian, _WITH_X[n], xu * u + xv * v)
        store(hessian, _WITH_Y[n], yu * u + yv * v)


@njit(**INNER)
def set_limits(point: Any, bounds: Any, free_shape: Any, system: System) -> None:
    """Write the limits of a step: the bounds, and nearer ones where the quadratic model is not to be believed.

    Adds to the hessian the bounds' own curvature by S: an axis that is held on its bound leaves it by S^2 as the
    ellipse turns. Where ``free_shape`` is 0, the shape stays.
    """
    low, high, gradient = system.low, system.high, system.gradient
    for i in (0, 1, 2, 6):
        value = load(point, ROW_OF[i])
        store(low, i, load(bounds, LOWER + BOUND_OF[i]) - value)
        store(high, i, load(bounds, UPPER + BOUND_OF[i]) - value)
    u, v = load(point, CURVATURE_U), load(point, CURVATURE_V)
    reach = 1 / sqrt(smaller(u, v))
    for i in (1, 2):
        store(low, i, larger(load(low, i), negated(reach)))
        store(high, i, smaller(load(high, i), reach))
    flattest, steepest = load(bounds, LOWER + 3), load(bounds, UPPER + 3)
    for i, curvature in ((3, u), (5, v)):
        store(low, i, free_shape * larger(flattest / curvature - 1, -0.75))
        store(high, i, free_shape * smaller(steepest / curvature - 1, 3.0))
    stuck = (u == v) & ((load(low, 3) >= 0) | (load(high, 3) <= 0))
    limit = select(stuck, 0, 0.75 * free_shape)
    store(low, 4, negated(limit))
    store(high, 4, limit)
    apart = larger(absolute(u - v), 1e-20)
    stiffness = select(_outward(system, opaque(3)), absolute(load(gradient, 3)) * v, 0)
    stiffness += select(_outward(system, opaque(5)), absolute(load(gradient, 5)) * u, 0)
    stiffness = select(u == v, 0, 2 * stiffness / apart)
    for matrix in (system.hessian, system.newton):
        store(matrix, _SS, load(matrix, _SS) + stiffness)


@njit(**INNER)
def _outward(system: System, i: int) -> Any:
    """Return where a parameter is on a bound, with its gradient pushing against it."""
    gradient = load(system.gradient, i)
    return ((load(system.low, i) >= 0) & (gradient > 0)) | ((load(system.high, i) <= 0) & (gradient < 0))


@njit(**INNER)
def factorise(system: System, use_newton: Any, damping: Any) -> Any:
    """Write the Cholesky factor of the free parameters' matrix, scaled by the diagonal of J^T J, and damped.

    The factor's own diagonal is inverted. Returns where the matrix is positive.
    """
    free, factor, scale = system.free, system.factor, system.scale
    for i in range(opaque(7)):
        is_free = load(free, i) > 0
        store(scale, i, select(is_free, 1 / sqrt(select(is_free, load(system.hessian, entry(i, i)), 1)), 0))
    positive = damping >= 0
    for j in range(opaque(7)):
        for i in range(j, 7):
            total = _element(system, use_newton, entry(i, j)) * load(scale, i) * load(scale, j)
            if i == j:
                total = select(load(free, i) > 0, total, 1) + damping
            for k in range(j):
                total -= load(factor, entry(i, k)) * load(factor, entry(j, k))
            if i > j:
                store(factor, entry(i, j), total * load(factor, entry(j, j)))
            else:
                positive = positive & (total > _SINGULAR)
                store(factor, entry(j, j), 1 / sqrt(larger(total, _SINGULAR)))
    return positive


@njit(**INNER)
def _element(system: System, use_newton: Any, here: int) -> Any:
    return select(use_newton, load(system.newton, here), load(system.hessian, here))


@njit(**INNER)
def solve(factor: Any, values: Any) -> None:
    """Replace ``values`` (7,) by the solution of matrix * solution = values, with the matrix's factor."""
    for i in range(opaque(7)):
        total = load(values, i)
        for k in range(i):
            total -= load(factor, entry(i, k)) * load(values, k)
        store(values, i, total * load(factor, entry(i, i)))
    for back in range(opaque(7)):
        i = 6 - back
        total = load(values, i)
        for k in range(i + 1, 7):
            total -= load(factor, entry(k, i)) * load(values, k)
        store(values, i, total * load(factor, entry(i, i)))


@njit(**INNER)
def solve_bounded(system: System, try_newton: Any, damping: Any) -> Any:
    """Write the damped step within its limits, and which parameters it leaves free; return where it has a solution.

    Newton's matrix is taken where it is to be tried and positive, else that of Gauss and Newton.
    """
    use_newton = try_newton
    _release(system)
    while True:
        positive = factorise(system, use_newton, damping)
        misled = use_newton & (select(positive, 1, vector(np.float32(0))) == 0)
        if count(misled) > 0:
            use_newton = use_newton & positive
            _release(system)
        elif count(_solve_free(system, use_newton) & positive) == 0:
            return positive


@njit(**INNER)
def _release(system: System) -> None:
    """Let every parameter free that is not pushed against its bound."""
    for i in range(opaque(7)):
        held = _outward(system, i) | (load(system.hessian, entry(i, i)) <= 0)
        store(system.free, i, select(held, 0, vector(np.float32(1))))
        store(system.pull, i, negated(load(system.gradient, i)))
        store(system.step, i, 0)


@njit(**INNER)
def _solve_free(system: System, use_newton: Any) -> Any:
    """Solve for the free parameters; put those that cross their limits onto them; return where there were any."""
    free, step, pull, room = system.free, system.step, system.pull, system.sums
    for i in range(opaque(7)):
        store(room, i, load(pull, i) * load(system.scale, i))
    solve(system.factor, room)
    crossing = load(free, 0) < 0
    for i in range(opaque(7)):
        is_free = load(free, i) > 0
        value = load(room, i) * load(system.scale, i)
        bounded = smaller(larger(value, load(system.low, i)), load(system.high, i))
        crossed = is_free & ((value < load(system.low, i)) | (value > load(system.high, i)))
        crossing = crossing | crossed
        store(free, i, select(crossed, 0, load(free, i)))
        store(step, i, select(is_free, bounded, load(step, i)))
        if count(crossed) > 0:
            _fix(system, use_newton, i, select(crossed, bounded, 0))
    return crossing


@njit(**INNER)
def _fix(system: System, use_newton: Any, i: int, value: Any) -> None:
    """Take what a parameter moves by into account for the others."""
    for j in range(opaque(7)):
        pull = load(system.pull, j) - _element(system, use_newton, entry(i, j)) * value
        store(system.pull, j, pull)


@njit(**INNER)
def diagonal_axes(p: Any, s: Any, q: Any) -> Any:
    """Return (cos, sin) of the turn, by at most 45 degrees, that makes p u^2 + 2 s u v + q v^2 diagonal."""
    apart = p - q
    tangent = 2 * s / (absolute(apart) + sqrt(apart * apart + 4 * s * s) + 1e-30)
    tangent = select(apart < 0, negated(tangent), tangent)
    cos = 1 / sqrt(1 + tangent * tangent)
    return cos, tangent * cos


@njit(**INNER)
def turn_axes(point: Any, curvatures: Any, turn: Any) -> None:
    """Turn a point's axes by (cos, sin) and set its curvatures; keeps |sin| <= cos by exchanging axes."""
    u, v = curvatures
    by_cos, by_sin = turn
    cos = load(point, COS) * by_cos - load(point, SIN) * by_sin
    sin = load(point, SIN) * by_cos + load(point, COS) * by_sin
    sin, cos = select(cos < 0, negated(sin), sin), absolute(cos)
    exchange = absolute(sin) > cos
    turned = select(sin > 0, negated(cos), cos)
    cos, sin = select(exchange, absolute(sin), cos), select(exchange, turned, sin)
    length = 1 / sqrt(cos * cos + sin * sin)
    store(point, COS, cos * length)
    store(point, SIN, sin * length)
    store(point, CURVATURE_U, select(exchange, v, u))
    store(point, CURVATURE_V, select(exchange, u, v))


@njit(**INNER)
def move(point: Any, system: System, bounds: Any, free_shape: Any, trial: Any) -> None:
    """Write the point after the step, within the bounds, and exactly on them where the step ends there."""
    step = system.step
    for i in (0, 1, 2, 6):
        row, by = ROW_OF[i], load(step, i)
        value = load(point, row)
        lower, upper = load(bounds, LOWER + BOUND_OF[i]), load(bounds, UPPER + BOUND_OF[i])
        moved = select(by <= lower - value, lower, select(by >= upper - value, upper, value + by))
        store(trial, row, smaller(larger(moved, lower), upper))
    u, v = load(point, CURVATURE_U), load(point, CURVATURE_V)
    store(trial, COS, load(point, COS))
    store(trial, SIN, load(point, SIN))
    lower, upper = load(bounds, LOWER + 3), load(bounds, UPPER + 3)
    p, q, s = u * (1 + load(step, 3)), v * (1 + load(step, 5)), sqrt(u * v) * load(step, 4)
    cos, sin = diagonal_axes(p, s, q)
    by_turn = s * sin / cos
    new_u, new_v = _bounded(p + by_turn, lower, upper), _bounded(q - by_turn, lower, upper)
    fixed = free_shape <= 0
    turn_axes(trial, (select(fixed, u, new_u), select(fixed, v, new_v)), (select(fixed, 1, cos), select(fixed, 0, sin)))


@njit(**INNER)
def _bounded(curvature: Any, lower: Any, upper: Any) -> Any:
    """Return the curvature within its bounds, exactly on one where only rounding keeps it off."""
    near = np.float32(1e-6)
    return select(curvature <= lower * (1 + near), lower, select(curvature >= upper * (1 - near), upper, curvature))


@njit(**INNER)
def is_small(point: Any, system: System, tolerance: Any) -> Any:
    """Return where the centre moves less than ``tolerance`` and the ellipse's outline less than ten times that."""
    step = system.step
    sigma_u, sigma_v = 1 / sqrt(load(point, CURVATURE_U)), 1 / sqrt(load(point, CURVATURE_V))
    centre = larger(absolute(load(step, 1)), absolute(load(step, 2)))
    wider = larger(absolute(load(step, 3)) * sigma_u, absolute(load(step, 5)) * sigma_v) * 0.5
    turned = absolute(load(step, 4)) * sigma_u * sigma_v / (sigma_u + sigma_v)
    return (centre < tolerance) & (larger(wider, turned) < 10 * tolerance)
