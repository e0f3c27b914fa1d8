"""Bounded steps of LANES joint fits at once, for any number of parameters.

As in :mod:`.steps`, a parameter on a bound whose gradient points outward stays there for the step, and one that a step
would carry over a bound is put onto it while the others are solved again. Here the number of parameters is known when
the code runs, not when it is compiled: matrices are memory.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit, types

from ..vectors import tracing
from ..vectors.simd import larger, load, select, smaller, store
from ..vectors.tracing import INLINE, Mask, Vector, traced

PLAIN: Any = {"error_model": "numpy", "nogil": True}
"""How functions are compiled that are called in many places: by themselves, so that they are compiled once."""

_SINGULAR = np.float32(1e-6)


class Equations(NamedTuple):
    """Rows of the equations of a step: lower triangles of matrices, and vectors of the parameters.

    J^T J; the same with second derivatives; L and L D of L D L^T; the gradient of half the residual's sum of squares;
    the limits of the step; 1, or 0 where a parameter stays, or goes just to its limit; the step; the right side; 1 / D;
    room for a solution. ``flags``: whether the second derivatives are used; whether there is a solution; and 0.
    """

    hessian: Any
    newton: Any
    lower: Any
    times: Any
    gradient: Any
    low: Any
    high: Any
    free: Any
    step: Any
    pull: Any
    inverse: Any
    solution: Any
    flags: Any


def n_equation_rows(n: int) -> int:
    """Return how many rows the equations of ``n`` parameters take."""
    return 4 * (n * (n + 1) // 2) + 8 * n + 3


@njit(**PLAIN)
def equations(rows: Any, n: int) -> Equations:
    """Return the equations of ``n`` parameters in some rows."""
    triangle = n * (n + 1) // 2
    first = rows + 4 * triangle
    return Equations(
        rows,
        rows + triangle,
        rows + 2 * triangle,
        rows + 3 * triangle,
        first,
        first + n,
        first + 2 * n,
        first + 3 * n,
        first + 4 * n,
        first + 5 * n,
        first + 6 * n,
        first + 7 * n,
        first + 8 * n,
    )


@traced(types.int64)
def count(mask: Mask) -> Any:
    """Return in how many lanes a mask holds."""
    return tracing.count(mask)


@traced(lambda mask: mask)
def without(mask: Mask) -> Mask:
    """Return where a mask does not hold."""
    return ~mask


@traced(lambda x: x)
def root(x: Vector) -> Vector:
    """Return the square root."""
    return tracing.sqrt(x)


@traced(lambda x: x)
def size(x: Vector) -> Vector:
    """Return the number without its sign."""
    return tracing.absolute(x)


@njit(**PLAIN)
def entry(i: int, j: int) -> int:
    """Return where the element (i, j) of a symmetric matrix is stored."""
    high, low = max(i, j), min(i, j)
    return high * (high + 1) // 2 + low


@njit(**INLINE)
def release(e: Equations, n: int, where: Any) -> None:
    """Let every parameter free that is not pushed against its bound, in some lanes."""
    for i in range(n):
        gradient, low, high = load(e.gradient, i), load(e.low, i), load(e.high, i)
        held = ((low >= 0) & (gradient > 0)) | ((high <= 0) & (gradient < 0)) | (load(e.hessian, entry(i, i)) <= 0)
        store(e.free, i, select(where, select(held, 0.0, 1.0), load(e.free, i)))
        store(e.pull, i, select(where, 0.0 - gradient, load(e.pull, i)))
        store(e.step, i, select(where, 0.0, load(e.step, i)))


@njit(**INLINE)
def factorise(e: Equations, n: int, damping: Any) -> Any:
    """Write L, L D and 1 / D of the free parameters' matrix; return where D is positive.

    ``damping`` times the diagonal of J^T J is added. For a parameter that is not free 1 / D is 0.
    """
    newton = load(e.flags, 0) > 0
    positive = damping >= 0
    for j in range(n):
        diagonal = load(e.hessian, entry(j, j))
        pivot = select(newton, load(e.newton, entry(j, j)), diagonal) + damping * diagonal
        for k in range(j):
            pivot = pivot - load(e.lower, entry(j, k)) * load(e.times, entry(j, k))
        least, free = _SINGULAR * diagonal, load(e.free, j)
        positive = positive & ((pivot > least) | (free <= 0))
        inverse = select(free > 0, 1.0 / larger(pivot, least), 0.0)
        store(e.inverse, j, inverse)
        for i in range(j + 1, n):
            value = select(newton, load(e.newton, entry(i, j)), load(e.hessian, entry(i, j)))
            for k in range(j):
                value = value - load(e.lower, entry(i, k)) * load(e.times, entry(j, k))
            store(e.times, entry(i, j), value)
            store(e.lower, entry(i, j), value * inverse)
    return positive


@njit(**INLINE)
def substitute(e: Equations, n: int) -> None:
    """Replace the right side in ``solution`` by the solution; 0 where a parameter is not free."""
    for i in range(n):
        value = load(e.solution, i)
        for k in range(i):
            value = value - load(e.lower, entry(i, k)) * load(e.solution, k)
        store(e.solution, i, value)
    for back in range(n):
        i = n - 1 - back
        value = load(e.solution, i) * load(e.inverse, i)
        for k in range(i + 1, n):
            value = value - load(e.lower, entry(k, i)) * load(e.solution, k)
        store(e.solution, i, select(load(e.free, i) > 0, value, 0.0))


@njit(**INLINE)
def _solve_once(e: Equations, n: int, running: Any, damping: Any) -> Any:
    """Solve for the free parameters; return in how many lanes that has to be done again."""
    positive = factorise(e, n, damping)
    for i in range(n):
        store(e.solution, i, load(e.pull, i))
    substitute(e, n)
    newton = load(e.flags, 0) > 0
    misled = newton & without(positive)
    again = misled & running
    for i in range(n):
        low, high, value = load(e.low, i), load(e.high, i), load(e.solution, i)
        bounded = smaller(larger(value, low), high)
        is_free = load(e.free, i) > 0
        crossed = is_free & positive & ((value < low) | (value > high))
        again = again | (crossed & running)
        store(e.step, i, select(is_free, bounded, load(e.step, i)))
        store(e.free, i, select(crossed, 0.0, load(e.free, i)))
        moved = select(crossed, bounded, 0.0)
        for j in range(n):
            value = select(newton, load(e.newton, entry(i, j)), load(e.hessian, entry(i, j)))
            store(e.pull, j, load(e.pull, j) - value * moved)
    store(e.flags, 0, select(positive, load(e.flags, 0), 0.0))
    store(e.flags, 1, select(positive, 1.0, 0.0))
    release(e, n, misled)
    return count(again)


@njit(**PLAIN)
def solve_bounded(e: Equations, n: int, outcome: Any, damping: Any) -> None:
    """Write the step to the minimum of the quadratic model within the limits.

    ``outcome`` and ``damping`` are rows; an outcome below 0 is that of a fit that goes on.
    """
    left = 1
    while left > 0:
        left = _solve_once(e, n, load(outcome, 0) < 0, load(damping, 0))
