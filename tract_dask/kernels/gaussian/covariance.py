"""Standard errors of finished fits, LANES at a time, from the covariance H^-1 (J^T C J) H^-1 of a linear model.

H = J^T J, and C is the covariance of the pixels' noise: that of raw pixels, after the blur. So J^T C J is a product of
blurred Jacobians with the raw pixels' variances as weights. All its sums are of smooth functions, which are sampled as
coarsely as their width allows. The errors are those for noise of a known size: a raw pixel's variance is one for each
count, or one. What the noise's size is follows from the residual: its expected sum of squares is the trace of C less
that of H^-1 (J^T C J), and the trace of C is the raw variance times the sum of the squares of the blur's weights.

For maximum likelihood H is Fisher's information, the covariance is H^-1, and the noise's size is Pearson's chi-squared
per degree of freedom.

The functions are traced, see :func:`~tract_dask.kernels.vectors.tracing.traced`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..vectors.tracing import Index, Mask, Rows, Vector, absolute, exp, fewer, larger, loop, select, spread, sqrt
from .moments import (
    AMPLITUDE_ROW,
    BACKGROUND_ROW,
    COS,
    CURVATURE_U,
    CURVATURE_V,
    DATA,
    KINDS,
    MERIT,
    N_ROW_SUMS,
    SIN,
    SQUARED,
    TOTAL,
    WEIGHT,
    Grid,
    X,
    Y,
    add_pair,
    down,
    ellipse,
    powers_of,
    to_axes,
)
from .steps import BOUND_OF, LOWER, PRODUCTS, ROW_OF, UPPER, assemble, entry, factorise, read, solve, turn_centre

RATIO, FREEDOM, LEVEL, N_ERRORS = 8, 9, 10, 11
"""Standard errors of a fit: amplitude, x, y, P, S, Q, background, and that of log(volume). Behind them the residual's
sum of squares over what the noise alone has (the trace of C), the share of that which the fit leaves, and the variance
of a pixel whose weight in C is 1."""

_MODEL = (KINDS[0], KINDS[2])


class Noise(NamedTuple):
    """What is known of the noise beforehand."""

    blur_variance: float
    """px^2."""
    blur_power: float
    """Sum of the squares of the blur's weights."""
    counting: bool
    """Whether a raw pixel's variance is proportional to the model."""


def _variance(point: Rows, offset: Vector, counting: Index) -> tuple[Vector, Vector, Vector]:
    """Return (base, contrast, level): a raw pixel's variance is level * (base + contrast * E), one for each count.

    Where counts do not tell it, it is 1. ``offset`` is what was subtracted from the pixels.
    """
    floor = larger(point[BACKGROUND_ROW] + offset, 0)
    amplitude = larger(point[AMPLITUDE_ROW], -floor)
    total = absolute(amplitude) + floor
    usable = (total > 0) & (spread(counting) > 0)
    return select(usable, floor / total, 1), select(usable, amplitude / total, 0), select(usable, total, 1)


def _noise_sums(grid: Grid, stride: Index, shapes: Any, variance: Any, into: Rows) -> Any:
    """Write the moments of variance * (blurred E)^2 and variance * (blurred E); return the sum of the variance.

    ``shapes`` are those of E and of the blurred E, whose centre is the same. Every ``stride``-th pixel stands for all.
    """
    raw, wide = shapes
    base, contrast = variance
    left, above = grid.half_width // stride, grid.half_height // stride
    right, below = (grid.width - 1 - grid.half_width) // stride, (grid.height - 1 - grid.half_height) // stride
    none, height = raw.x.of(0), above + below + 1

    def row(j: Index, totals: list[Vector]) -> list[Vector]:
        y = (j - above) * stride
        dy = spread(y) - raw.y
        chord = (grid.chords.integer(grid.half_height + y) + stride) // stride - 1  # -1 stays -1

        def pixel(i: Index, values: list[Vector]) -> list[Vector]:
            x = powers_of(grid, i * stride)
            dx = x[1] - raw.x
            e, blurred = (exp(-0.5 * (s.a * dx * dx + s.c * dy * dy) - s.b * dx * dy) for s in (raw, wide))
            weighted = (base + contrast * e) * blurred
            return [values[0] + e, *add_pair(values[1:], ((weighted * blurred, None), None, (weighted, None)), x)]

        first, end = fewer(left, chord) * -1, fewer(right, chord) + 1
        total, *sums = loop(first, end, [none] * (1 + 13), pixel)
        line = grid.rows + j * N_ROW_SUMS
        for k, value in enumerate(sums):
            line[k] = value
        return [totals[0] + total]

    (total,) = loop(height.constant(0), height, [none], row)
    down(grid, height, above * stride * -1, stride, _MODEL, into)
    area = spread(stride * stride)
    for k in range(TOTAL):
        if k < DATA:
            into[k] = into[k] * area
    return base * spread(grid.n_pixels) + contrast * total * area


def _meat(point: Rows, narrow: Any, own: list[Vector]) -> list[Vector]:
    """Return J^T C J (28,), given the moments of the blurred E along the ellipse's axes.

    The model is Equation 1 convolved with the blur, and the derivatives are by the parameters before it: weights
    ``main`` of their own monomial times E, and ``extra`` of E. ``narrow`` are sigma / (sigma after the blur), along u
    and v.
    """
    u, v = narrow
    amplitude = point[AMPLITUDE_ROW] * u * v
    uu, vv, half = u * u, v * v, -0.5 * amplitude
    main = [u * v, amplitude * uu, amplitude * vv, half * uu * uu, -amplitude * uu * vv, half * vv * vv, u.of(1)]
    extra = {3: half * (1 - uu), 5: half * (1 - vv)}
    meat = []
    for i in range(7):
        for j in range(i + 1):
            value = main[i] * main[j] * own[PRODUCTS[entry(i, j)]]
            if j in extra:
                value = value + main[i] * extra[j] * own[PRODUCTS[entry(i, 0)]]
            if i in extra:
                value = value + extra[i] * main[j] * own[PRODUCTS[entry(j, 0)]]
            if i in extra and j in extra:
                value = value + extra[i] * extra[j] * own[SQUARED]
            meat.append(value)
    cos, sin = point[COS], point[SIN]
    scale_u, scale_v = sqrt(point[CURVATURE_U]), sqrt(point[CURVATURE_V])
    turn_centre(meat, (scale_u * cos, -(scale_v * sin)), (scale_u * sin, scale_v * cos))
    return meat


def _free(point: Rows, bounds: Rows, free_shape: Vector, hessian: list[Vector]) -> list[Vector]:
    """Return which parameters have standard errors: those not on a bound, 1 or 0."""
    free: list[Any] = [None] * 7
    for i in (0, 1, 2, 3, 5, 6):
        value, lower, upper = point[ROW_OF[i]], bounds[LOWER + BOUND_OF[i]], bounds[UPPER + BOUND_OF[i]]
        free[i] = select((value > lower) & (value < upper), value.of(1), 0)
    for i in (3, 5):
        free[i] = free[i] * free_shape
    circle = point[CURVATURE_U].equals(point[CURVATURE_V])
    free[4] = select(circle & (free[3] <= 0), 0, free_shape)
    return [select(hessian[entry(i, i)] > 0, free[i], 0) for i in range(7)]


def _quadratic(matrix: list[Vector], values: list[Vector]) -> Vector:
    """Return values^T matrix values."""
    total = values[0].of(0)
    for i in range(7):
        row = 0.5 * matrix[entry(i, i)] * values[i]
        for j in range(i):
            row = row + matrix[entry(i, j)] * values[j]
        total = total + 2 * values[i] * row
    return total


def _inverse(hessian: list[Vector], free: list[Vector]) -> tuple[list[list[Vector]], Mask]:
    """Return the inverse of the free parameters' hessian, 0 for the others, and where it is known."""
    factors = factorise(hessian, [hessian[entry(i, i)] for i in range(7)], free, free[0].of(0))
    one = free[0].of(1)
    return [solve(factors, [None] * i + [one] + [None] * (6 - i)) for i in range(7)], factors[2]


def standard_errors(
    grid: Grid, stride: Index, point: Rows, sums: Rows, bounds: Rows, scales: Any, noise: Any, part: Rows, errors: Rows
) -> None:
    """Write the errors (N_ERRORS,) of LANES fits, for noise of level 1; NaN where a parameter is held.

    ``scales`` are the offset of the pixels, and 0 or 1 for whether the shape is free. ``noise`` is that of least
    squares, or None for maximum likelihood.
    """
    offset, free_shape = scales
    hessian, _, _ = assemble(point, sums)
    free = _free(point, bounds, free_shape, hessian)
    if noise is None:
        meat, trace, level = hessian, spread(grid.n_pixels), point[X].of(1)
    else:
        u, v = point[CURVATURE_U], point[CURVATURE_V]
        wide_u, wide_v = u / (1 + u * noise.blur_variance), v / (1 + v * noise.blur_variance)
        shapes = ellipse(point, u, v), ellipse(point, wide_u, wide_v)
        *variance, level = _variance(point, offset, noise.counting)
        total = _noise_sums(grid, stride, shapes, variance, part)
        own = read(part, 0, DATA)
        to_axes(own, _MODEL, (point[X], point[Y]), (point[COS], point[SIN], sqrt(u), sqrt(v)))
        own += [total] * (WEIGHT + 1 - DATA)
        meat, trace = _meat(point, (sqrt(wide_u / u), sqrt(wide_v / v)), own), total * noise.blur_power
    inverse, known = _inverse(hessian, free)
    freedom = trace
    for i in range(7):
        for j in range(7):
            freedom = freedom - inverse[i][j] * meat[entry(i, j)]
    for i in range(7):
        errors[i] = select(known & (free[i] > 0), sqrt(_quadratic(meat, inverse[i])), np.nan)
    amplitude = point[AMPLITUDE_ROW]
    volume = [inverse[0][j] / amplitude - 0.5 * (inverse[3][j] + inverse[5][j]) for j in range(7)]
    errors[7] = select(known, sqrt(_quadratic(meat, volume)), np.nan)
    errors[RATIO] = larger(sums[MERIT], 0) / trace
    errors[FREEDOM] = select(known & (freedom > 0), freedom / trace, np.nan)
    errors[LEVEL] = level
