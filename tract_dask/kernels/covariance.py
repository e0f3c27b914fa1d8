"""Standard errors of finished fits, LANES at a time, from the covariance H^-1 (J^T C J) H^-1 of a linear model.

H = J^T J, and C is the covariance of the pixels' noise: that of raw pixels, after the blur. So J^T C J is a product of
blurred Jacobians with the raw pixels' variances as weights. All its sums are of smooth functions, which are sampled as
coarsely as their width allows. The size of C follows from the residual: its expected sum of squares is the trace of C
less that of H^-1 (J^T C J), and the trace of C is the raw variance times the sum of the squares of the blur's weights.

For maximum likelihood H is Fisher's information, and the covariance H^-1 times Pearson's chi-squared per degree of
freedom.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from .moments import DATA, INNER, MERIT, N_ROOM, SQUARED, TOTAL, WEIGHT, Grid, Shape, down, to_axes
from .simd import absolute, exp, larger, load, negated, number, opaque, select, sqrt, store, vector
from .steps import (
    AMPLITUDE,
    BACKGROUND,
    BOUND_OF,
    COS,
    CURVATURE_U,
    CURVATURE_V,
    LOWER,
    PRODUCTS,
    ROW_OF,
    SIN,
    UPPER,
    System,
    X,
    Y,
    assemble,
    entry,
    factorise,
    solve,
    turn_centre,
)

N_ERRORS = 8
"""Standard errors of a fit: amplitude, x, y, P, S, Q, background, and that of log(volume)."""


class Noise(NamedTuple):
    """What is known of the noise beforehand."""

    blur_variance: float
    """px^2."""
    blur_power: float
    """Sum of the squares of the blur's weights."""
    counting: bool
    """Whether a raw pixel's variance is proportional to the model."""


class Room(NamedTuple):
    """Space for :func:`standard_errors`."""

    sums: Any
    meat: Any
    """(28,) J^T C J."""
    inverse: Any
    """(49,) H^-1."""
    main: Any
    extra: Any
    """(7,) the derivatives, as weights of their own monomial and of E."""
    values: Any
    """(7,)."""


N_ERROR_ROOM = N_ROOM + 28 + 49 + 21
"""Rows of the space for :func:`standard_errors`."""


@njit(**INNER)
def room_in(room: Any) -> Room:
    """Return space for :func:`standard_errors` in ``N_ERROR_ROOM`` rows."""
    matrices = room + N_ROOM
    return Room(room, matrices, matrices + 28, matrices + 77, matrices + 84, matrices + 91)


@njit(**INNER)
def _variance(point: Any, offset: Any, counting: bool) -> Any:
    """Return (base, contrast): up to a factor, a raw pixel's variance is base + contrast * E.

    ``offset`` is what was subtracted from the pixels.
    """
    amplitude = load(point, AMPLITUDE)
    floor = larger(load(point, BACKGROUND) + offset, 0)
    total = absolute(amplitude) + floor
    usable = (floor + amplitude >= 0) & (total > 0)
    if not counting:
        usable = usable & (total < 0)
    return select(usable, floor / total, 1), select(usable, amplitude / total, 0)


@njit(**INNER)
def _noise_sums(grid: Grid, stride: int, shapes: Any, variance: Any, room: Room) -> Any:
    """Write the moments of variance * (blurred E)^2 and variance * (blurred E); return the sum of the variance.

    ``shapes`` are those of E and of the blurred E, whose centre is the same. Every ``stride``-th pixel stands for all.
    """
    raw, wide = shapes
    base, contrast = variance
    left, above = (grid.width // 2) // stride, (grid.height // 2) // stride
    right, below = (grid.width - 1 - grid.width // 2) // stride, (grid.height - 1 - grid.height // 2) // stride
    h, rows, powers = above + below + 1, grid.rows, grid.powers
    total = vector(np.float32(0))
    for j in range(h):
        dy = np.float32((j - above) * stride) - raw.y
        s0 = s1 = s2 = s3 = s4 = g0 = g1 = g2 = vector(np.float32(0))
        chord = int(number(grid.chords, grid.height // 2 + (j - above) * stride)) // stride
        for i in range(-min(left, chord), min(right, chord) + 1):
            at = 5 * (grid.half + i * stride)
            dx = number(powers, at + 1) - raw.x
            e = exp(-0.5 * (raw.a * dx * dx + raw.c * dy * dy) - raw.b * dx * dy)
            blurred = exp(-0.5 * (wide.a * dx * dx + wide.c * dy * dy) - wide.b * dx * dy)
            weight = base + contrast * e
            g = weight * blurred
            q = g * blurred
            total += e
            x1, x2 = number(powers, at + 1), number(powers, at + 2)
            x3, x4 = number(powers, at + 3), number(powers, at + 4)
            s0 += q
            s1 += q * x1
            s2 += q * x2
            s3 += q * x3
            s4 += q * x4
            g0 += g
            g1 += g * x1
            g2 += g * x2
        store(rows, j, s0)
        store(rows, j + h, s1)
        store(rows, j + 2 * h, s2)
        store(rows, j + 3 * h, s3)
        store(rows, j + 4 * h, s4)
        store(rows, j + 10 * h, g0)
        store(rows, j + 11 * h, g1)
        store(rows, j + 12 * h, g2)
    down(grid, h, grid.half - above * stride, stride, room.sums)
    area = np.float32(stride * stride)
    for row in range(opaque(TOTAL)):
        store(room.sums, row, load(room.sums, row) * area)
    return base * np.float32(grid.n_pixels) + contrast * total * area


@njit(**INNER)
def _meat(point: Any, narrow: Any, total: Any, room: Room) -> None:
    """Write J^T C J (28,), given the moments of the blurred E along the ellipse's axes.

    The model is Equation 1 convolved with the blur, and the derivatives are by the parameters before it. ``narrow`` are
    sigma / (sigma after the blur), along u and v.
    """
    u, v = narrow
    amplitude, main, extra = load(point, AMPLITUDE) * u * v, room.main, room.extra
    half_u, half_v = -0.5 * amplitude, -0.5 * amplitude
    for i in range(opaque(7)):
        store(extra, i, 0)
    store(main, 0, u * v)
    store(main, 1, amplitude * u * u)
    store(main, 2, amplitude * v * v)
    store(main, 3, half_u * u * u * u * u)
    store(extra, 3, half_u * (1 - u * u))
    store(main, 4, negated(amplitude) * u * u * v * v)
    store(main, 5, half_v * v * v * v * v)
    store(extra, 5, half_v * (1 - v * v))
    store(main, 6, 1)
    store(room.sums, WEIGHT, total)
    for i in range(opaque(7)):
        for j in range(i + 1):
            here = entry(i, j)
            one, other = load(room.sums, PRODUCTS[i * (i + 1) >> 1]), load(room.sums, PRODUCTS[j * (j + 1) >> 1])
            value = load(main, i) * (load(main, j) * load(room.sums, PRODUCTS[here]) + load(extra, j) * one)
            value += load(extra, i) * (load(main, j) * other + load(extra, j) * load(room.sums, SQUARED))
            store(room.meat, here, value)
    cos, sin = load(point, COS), load(point, SIN)
    scale_u, scale_v = sqrt(load(point, CURVATURE_U)), sqrt(load(point, CURVATURE_V))
    turn_centre(room.meat, (scale_u * cos, negated(scale_v * sin)), (scale_u * sin, scale_v * cos))


@njit(**INNER)
def set_free(point: Any, bounds: Any, free_shape: Any, system: System) -> None:
    """Write which parameters have standard errors: those not on a bound."""
    for i in range(opaque(7)):
        if i != 4:
            value = load(point, ROW_OF[i])
            lower, upper = load(bounds, LOWER + BOUND_OF[i]), load(bounds, UPPER + BOUND_OF[i])
            free = select((value > lower) & (value < upper), vector(np.float32(1)), 0)
            store(system.free, i, free * free_shape if i in (3, 5) else free)
    circle = load(point, CURVATURE_U) == load(point, CURVATURE_V)
    held = circle & (load(system.free, 3) <= 0)
    store(system.free, 4, select(held, 0, free_shape))
    for i in range(opaque(7)):
        known = load(system.hessian, entry(i, i)) > 0
        store(system.free, i, select(known, load(system.free, i), 0))


@njit(**INNER)
def _quadratic(matrix: Any, values: Any) -> Any:
    """Return values^T matrix values."""
    total = vector(np.float32(0))
    for i in range(opaque(7)):
        row = 0.5 * load(matrix, entry(i, i)) * load(values, i)
        for j in range(i):
            row += load(matrix, entry(i, j)) * load(values, j)
        total += 2 * load(values, i) * row
    return total


@njit(**INNER)
def standard_errors(
    grid: Grid,
    stride: int,
    point: Any,
    sums: Any,
    bounds: Any,
    scales: Any,
    noise: Noise,
    work: Any,
    errors: Any,
) -> None:
    """Write the standard errors (8,) of LANES fits by least squares; NaN where a parameter is held.

    ``scales`` are the offset of the pixels, and 0 or 1 for whether the shape is free.
    """
    system, room = work
    offset, free_shape = scales
    assemble(point, sums, system)
    set_free(point, bounds, free_shape, system)
    u, v, cos, sin = load(point, CURVATURE_U), load(point, CURVATURE_V), load(point, COS), load(point, SIN)
    blur = np.float32(noise.blur_variance)
    wide_u, wide_v = u / (1 + u * blur), v / (1 + v * blur)
    narrow = sqrt(wide_u / u), sqrt(wide_v / v)
    shapes = _exponent(point, u, v), _exponent(point, wide_u, wide_v)
    total = _noise_sums(grid, stride, shapes, _variance(point, offset, noise.counting), room)
    axes = (cos, sin, sqrt(u), sqrt(v))
    to_axes(room.sums, opaque(DATA), (load(point, X), load(point, Y)), axes)
    _meat(point, narrow, total, room)
    freedom = _invert(system, room, total * np.float32(noise.blur_power))
    _errors(point, system, room, _size(load(sums, MERIT), freedom), errors)


@njit(**INNER)
def likelihood_errors(point: Any, sums: Any, bounds: Any, scales: Any, work: Any, errors: Any) -> None:
    """Write the standard errors (8,) of LANES fits by maximum likelihood; NaN where a parameter is held.

    ``scales`` are the number of pixels, and 0 or 1 for whether the shape is free.
    """
    system, room = work
    n_pixels, free_shape = scales
    assemble(point, sums, system)
    set_free(point, bounds, free_shape, system)
    for row in range(opaque(28)):
        store(room.meat, row, load(system.hessian, row))
    freedom = _invert(system, room, n_pixels)
    _errors(point, system, room, _size(load(sums, MERIT), freedom), errors)


@njit(**INNER)
def _size(chi: Any, freedom: Any) -> Any:
    """Return the noise's variance in units of what it was taken as, NaN where nothing is left to say."""
    return select(freedom > 0, larger(chi, 0) / freedom, np.float32(np.nan))


@njit(**INNER)
def _exponent(point: Any, u: Any, v: Any) -> Shape:
    """Return the shape of a Gaussian at a point's centre and axes with these curvatures."""
    cos, sin = load(point, COS), load(point, SIN)
    a, c = u * cos * cos + v * sin * sin, u * sin * sin + v * cos * cos
    return Shape(load(point, X), load(point, Y), a, (u - v) * cos * sin, c)


@njit(**INNER)
def _invert(system: System, room: Room, trace: Any) -> Any:
    """Write the inverse of the free parameters' hessian; return the degrees of freedom, ``trace`` less H^-1 meat's."""
    never = trace < trace
    positive = factorise(system, never, vector(np.float32(0)))
    freedom = trace
    values = room.values
    for i in range(opaque(7)):
        for j in range(opaque(7)):
            store(values, j, load(system.scale, i) if i == j else vector(np.float32(0)))
        solve(system.factor, values)
        for j in range(opaque(7)):
            value = load(values, j) * load(system.scale, j)
            store(room.inverse, 7 * i + j, value)
            freedom -= value * load(room.meat, entry(i, j))
    return select(positive, freedom, 0)


@njit(**INNER)
def _errors(point: Any, system: System, room: Room, size: Any, errors: Any) -> None:
    """Write the standard errors, given the noise's size."""
    inverse, values = room.inverse, room.values
    for i in range(opaque(7)):
        for j in range(opaque(7)):
            store(values, j, load(inverse, 7 * i + j))
        error = sqrt(_quadratic(room.meat, values) * size)
        store(errors, i, select(load(system.free, i) > 0, error, np.float32(np.nan)))
    for j in range(opaque(7)):
        store(
            values, j, load(inverse, j) / load(point, AMPLITUDE) - 0.5 * (load(inverse, 21 + j) + load(inverse, 35 + j))
        )
    store(errors, 7, sqrt(_quadratic(room.meat, values) * size))
