"""The compiled half of the fitter: sums over a window, bounded steps, standard errors.

With u, v the distances from the centre along the ellipse's axes, in units of its sigmas, and E = exp(-(u^2 + v^2) / 2),
every derivative of the model is a combination of seven functions, here called the monomials: E, E u, E v, E u^2, E u v,
E v^2 and 1. So all that a step needs are the moments of E^2, of E and of E * residual. The loops over pixels are short
and in float32, each with few enough sums to stay in registers, and the compiler vectorises them.

Levenberg-Marquardt steps are taken in the coefficients of exp(-(P u^2 + 2 S u v + Q v^2) / 2), with P = Q = 1 and
S = 0 before the step. There a round start is an ordinary point, although theta has no meaning, and the bounds of the
sigmas are to first order bounds of P and Q. After the first steps the hessian holds the second derivatives too, where
that leaves it positive. A parameter on a bound whose gradient points outward stays there for the step; one that a step
would carry over a bound is put onto it while the others are solved anew: the constrained optimum is found, not a
clipped one.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[Any]

# Only the entry point is called from Python and cached; what it calls is compiled into it, and so lives in this file.
_INNER: Any = {"error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_ANY_ORDER = {"reassoc", "contract", "nsz", "arcp"}  # for sums; NaN and infinity stay what they are
_SQUARES = np.array(
    [
        [0, 1, 2, 3, 4, 5],
        [1, 3, 4, 6, 7, 8],
        [2, 4, 5, 7, 8, 9],
        [3, 6, 7, 10, 11, 12],
        [4, 7, 8, 11, 12, 13],
        [5, 8, 9, 12, 13, 14],
    ]
)
"""Where the product of two monomials stands in the moments up to order 4."""

_FIRST = np.array([0, 1, 1, 3, 4, 5, 6])
_SECOND = np.array([0, 2, 2, 0, 0, 0, 0])
"""The two monomials that make up the model's derivative by each parameter of a step."""

_EXPONENT = np.float32(-0.5 * math.log2(math.e))
_ZERO, _HALF, _SMALLEST = np.float32(0), np.float32(0.5), np.float32(-50)
_BIAS, _MANTISSA_BITS = np.int32(127), np.int32(23)
_C0, _C1, _C2, _C3, _C4, _C5 = (
    np.polynomial.Chebyshev.interpolate(np.exp2, 5, domain=[-0.5, 0.5])
    .convert(kind=np.polynomial.Polynomial)
    .coef.astype(np.float32)
)
_GAUSS_NEWTON_STEPS = 2  # from further away the second derivatives mislead
_FIRST_DAMPING = 1e-3
_UNDAMPED = 1e-2  # below this a step is a Gauss-Newton step for all that matters
_LARGEST_DAMPING = 1e8
_ROUNDING = 1e-6  # relative noise of a residual's sum of squares in float32
_SINGULAR = 1e-12
_SAME = 1e-12  # pixels that differ by less, relatively, than float32 can tell


class System(NamedTuple):
    """The normal equations of a step in (amplitude, x, y, P, S, Q, background), its limits, and the step itself."""

    gram: Array
    """(7, 7) scalar products of the monomials."""
    bend: Array
    """(6, 6) sums of E * residual times the monomials' products over E^2."""
    score: Array
    """(7,) scalar products of the monomials with the residual."""
    hessian: Array
    """(7, 7) of Gauss and Newton, J^T J."""
    newton: Array
    """(7, 7) with the second derivatives as well: where noise is strong, only this one converges fast."""
    gradient: Array
    """(7,) of half the residual's sum of squares."""
    low: Array
    high: Array
    """(7,) limits of the step."""
    held: Array
    """(7,) whether the parameter stays, or goes just to its limit."""
    step: Array
    """(7,)."""


class Window(NamedTuple):
    """The pixels of one window, and room for what is computed on them: all (n,) float32."""

    pixels: Array
    x: Array
    y: Array
    u: Array
    v: Array
    gaussian: Array
    squared: Array
    weighted: Array


@njit(inline="always", **_INNER)
def gaussian(square: Any) -> Any:
    """Return exp(-square / 2) in float32 within 3e-7, and 0 where that is below 1e-15; loops over it vectorise.

    Such small values mean nothing next to the peak's 1, and their squares would be subnormal, which is slow.
    """
    power = _EXPONENT * square
    bounded = max(power, _SMALLEST)
    whole = np.floor(bounded + _HALF)
    part = bounded - whole
    mantissa = _C0 + part * (_C1 + part * (_C2 + part * (_C3 + part * (_C4 + part * _C5))))
    result = mantissa * np.int32((np.int32(whole) + _BIAS) << _MANTISSA_BITS).view(np.float32)
    return result if power > _SMALLEST else _ZERO


@njit(fastmath=_ANY_ORDER, **_INNER)
def _place(x: Array, y: Array, axes: Any, u: Array, v: Array, e: Array, squared: Array) -> None:
    """Write u, v, E and E^2 of every pixel; ``axes`` is (ux, uy, u0, vx, vy, v0) with u = ux x + uy y + u0."""
    ux, uy, u0, vx, vy, v0 = axes
    for i in range(x.size):
        along = ux * x[i] + uy * y[i] + u0
        across = vx * x[i] + vy * y[i] + v0
        u[i] = along
        v[i] = across
        peak = gaussian(along * along + across * across)
        e[i] = peak
        squared[i] = peak * peak


@njit(fastmath=_ANY_ORDER, **_INNER)
def _residual(pixels: Array, e: Array, amplitude: Any, background: Any, weighted: Array) -> Any:
    """Write E * residual; return the sums of the residual and of its square."""
    first = second = _ZERO
    for i in range(pixels.size):
        r = pixels[i] - amplitude * e[i] - background
        weighted[i] = e[i] * r
        first += r
        second += r * r
    return first, second


@njit(fastmath=_ANY_ORDER, **_INNER)
def _noise(u: Array, v: Array, wide: Any, noise: Any, e: Array, squared: Array, weighted: Array) -> Any:
    """Write the blurred E and its square, weighted with the noise's variance, and return the sum of the variance."""
    wide_u, wide_v = wide
    base, contrast = noise
    total = _ZERO
    for i in range(u.size):
        variance = base + contrast * e[i]
        blurred = gaussian(wide_u * u[i] * u[i] + wide_v * v[i] * v[i])
        weighted[i] = variance * blurred
        squared[i] = variance * blurred * blurred
        total += variance
    return total


@njit(fastmath=_ANY_ORDER, **_INNER)
def _moments_2(u: Array, v: Array, weight: Array) -> Any:
    """Return the sums of weight * (1, u, v, u^2, u v, v^2)."""
    w00 = w10 = w01 = w20 = w11 = w02 = _ZERO
    for i in range(u.size):
        w, wu, wv = weight[i], weight[i] * u[i], weight[i] * v[i]
        w00 += w
        w10 += wu
        w01 += wv
        w20 += wu * u[i]
        w11 += wu * v[i]
        w02 += wv * v[i]
    return w00, w10, w01, w20, w11, w02


@njit(fastmath=_ANY_ORDER, **_INNER)
def _moments_4(u: Array, v: Array, weight: Array) -> Any:
    """Return the sums of weight * u^i v^j, by order i + j from 0 to 4 and within it by j."""
    q00 = q10 = q01 = q20 = q11 = q02 = q30 = q21 = q12 = q03 = q40 = q31 = q22 = q13 = q04 = _ZERO
    for i in range(u.size):
        q = weight[i]
        uu, uv, vv = u[i] * u[i], u[i] * v[i], v[i] * v[i]
        quu, qvv = q * uu, q * vv
        q00 += q
        q10 += q * u[i]
        q01 += q * v[i]
        q20 += quu
        q11 += q * uv
        q02 += qvv
        q30 += quu * u[i]
        q21 += quu * v[i]
        q12 += qvv * u[i]
        q03 += qvv * v[i]
        q40 += quu * uu
        q31 += quu * uv
        q22 += quu * vv
        q13 += qvv * uv
        q04 += qvv * vv
    return q00, q10, q01, q20, q11, q02, q30, q21, q12, q03, q40, q31, q22, q13, q04


@njit(**_INNER)
def _axes(params: Array) -> Any:
    """Return (ux, uy, u0, vx, vy, v0) in float32: u = ux x + uy y + u0, and v likewise."""
    cos, sin = math.cos(params[5]), math.sin(params[5])
    ux, uy, vx, vy = cos / params[3], -sin / params[3], sin / params[4], cos / params[4]
    u0, v0 = -(ux * params[1] + uy * params[2]), -(vx * params[1] + vy * params[2])
    return np.float32(ux), np.float32(uy), np.float32(u0), np.float32(vx), np.float32(vy), np.float32(v0)


@njit(**_INNER)
def _gram(moments: Any, gram: Array) -> None:
    """Write the weighted scalar products (6, 6) of the monomials that hold E, given the weights' moments."""
    for i in range(6):
        for j in range(6):
            gram[i, j] = moments[_SQUARES[i, j]]


@njit(**_INNER)
def fit_sums(window: Window, params: Array, system: System) -> float:
    """Gather the gram, score and bend of a step from ``params`` (7,); return the residual's sum of squares."""
    w = window
    _place(w.x, w.y, _axes(params), w.u, w.v, w.gaussian, w.squared)
    first, second = _residual(w.pixels, w.gaussian, np.float32(params[0]), np.float32(params[6]), w.weighted)
    _gram(_moments_4(w.u, w.v, w.squared), system.gram)
    firsts = _moments_2(w.u, w.v, w.gaussian)
    residuals = _moments_4(w.u, w.v, w.weighted)
    _gram(residuals, system.bend)
    gram, score = system.gram, system.score
    for i in range(6):
        gram[i, 6] = gram[6, i] = firsts[i]
        score[i] = residuals[i]
    gram[6, 6], score[6] = w.x.size, first
    return float(second)


@njit(**_INNER)
def noise_sums(window: Window, params: Array, blur_variance: float, noise: Any, gram: Array) -> float:
    """Write the (7, 7) products of the blurred monomials, each pixel weighted with its noise's variance.

    Blurred means that E is as wide as after a blur of that variance, while u and v are those of ``params``. The
    variance in a pixel is base + contrast * (the E of ``params``), with ``noise`` = (base, contrast). Returns its sum.
    """
    w = window
    _place(w.x, w.y, _axes(params), w.u, w.v, w.gaussian, w.squared)
    wide_u = np.float32(params[3] ** 2 / (params[3] ** 2 + blur_variance))
    wide_v = np.float32(params[4] ** 2 / (params[4] ** 2 + blur_variance))
    variance = (np.float32(noise[0]), np.float32(noise[1]))
    total = float(_noise(w.u, w.v, (wide_u, wide_v), variance, w.gaussian, w.squared, w.weighted))
    _gram(_moments_4(w.u, w.v, w.squared), gram)
    firsts = _moments_2(w.u, w.v, w.weighted)
    for i in range(6):
        gram[i, 6] = gram[6, i] = firsts[i]
    gram[6, 6] = total
    return total


class GaussianFits(NamedTuple):
    """What is known of each fitted window; parameters in the order of Equation 1, positions in window pixels."""

    estimates: npt.NDArray[np.float64]
    """(n, 7), canonical: sigma_a >= sigma_b > 0, theta in (-pi/2, pi/2]; NaN where a pixel is not finite."""
    stderr: npt.NDArray[np.float64]
    """(n, 7) standard errors; NaN for a parameter held by a bound, and where the fit has not converged."""
    r_squared: npt.NDArray[np.float32]
    """(n,) share of the window's variance that the fit explains; 0 for a constant window."""
    n_iterations: npt.NDArray[np.int16]
    """(n,) steps tried."""
    converged: npt.NDArray[np.bool_]
    """(n,) whether the last step was undamped and below the tolerance."""
    at_bound: npt.NDArray[np.bool_]
    """(n,) whether a parameter that had any freedom ended on a bound."""


class Options(NamedTuple):
    """What is the same for every window of a batch."""

    blur_variance: float
    blur_power: float
    counting: bool
    tolerance: float
    max_iterations: int


@njit(**_INNER)
def _new_system() -> System:
    """Return room for a system."""
    squares, rows, held = np.zeros((4, 7, 7)), np.empty((5, 7)), np.zeros(7, np.bool_)
    gram, bend, hessian, newton = squares[0], squares[1], squares[2], squares[3]
    return System(gram, bend, rows[0], hessian, newton, rows[1], rows[2], rows[3], held, rows[4])


@njit(**_INNER)
def _copy(source: Array, target: Array) -> None:
    for i in range(target.size):
        target[i] = source[i]


@njit(**_INNER)
def _derivatives(params: Array, blur_variance: float) -> Array:
    """Return d(model) / d(amplitude, x, y, P, S, Q, background) as weights (2, 7) of the monomials _FIRST and _SECOND.

    With a blur, the model is Equation 1 convolved with a circular Gaussian of that variance: the derivatives are still
    by the parameters before the blur, and the monomials those of ``noise_sums``.
    """
    weights = np.zeros((2, 7))
    cos, sin = math.cos(params[5]), math.sin(params[5])
    wide_a, wide_b = math.sqrt(params[3] ** 2 + blur_variance), math.sqrt(params[4] ** 2 + blur_variance)
    narrow_a, narrow_b = params[3] / wide_a, params[4] / wide_b
    amplitude = params[0] * narrow_a * narrow_b
    weights[0, 0] = narrow_a * narrow_b
    weights[0, 1], weights[1, 1] = amplitude * narrow_a * cos / wide_a, amplitude * narrow_b * sin / wide_b
    weights[0, 2], weights[1, 2] = -amplitude * narrow_a * sin / wide_a, amplitude * narrow_b * cos / wide_b
    weights[0, 3], weights[1, 3] = -0.5 * amplitude * narrow_a**4, -0.5 * amplitude * (1 - narrow_a**2)
    weights[0, 4] = -amplitude * (narrow_a * narrow_b) ** 2
    weights[0, 5], weights[1, 5] = -0.5 * amplitude * narrow_b**4, -0.5 * amplitude * (1 - narrow_b**2)
    weights[0, 6] = 1.0
    return weights


@njit(**_INNER)
def _products(weights: Array, gram: Array, result: Array) -> None:
    """Write the (7, 7) scalar products of the derivatives, given those of the monomials."""
    half = np.empty((7, 7))
    for i in range(7):
        for k in range(7):
            half[i, k] = weights[0, i] * gram[_FIRST[i], k] + weights[1, i] * gram[_SECOND[i], k]
    for i in range(7):
        for j in range(i + 1):
            result[i, j] = weights[0, j] * half[i, _FIRST[j]] + weights[1, j] * half[i, _SECOND[j]]
            result[j, i] = result[i, j]


@njit(**_INNER)
def _factorise(matrix: Array) -> bool:
    """Replace the lower triangle by the Cholesky factor, its diagonal inverted; False where the matrix is singular."""
    for j in range(7):
        for i in range(j, 7):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = total * matrix[j, j]
            elif total > _SINGULAR:
                matrix[j, j] = 1 / math.sqrt(total)
            else:
                return False
    return True


@njit(**_INNER)
def _solve(factor: Array, vector: Array) -> None:
    """Replace ``vector`` by the solution of matrix * solution = vector, with the factor of the matrix."""
    for i in range(7):
        total = vector[i]
        for k in range(i):
            total -= factor[i, k] * vector[k]
        vector[i] = total * factor[i, i]
    for i in range(6, -1, -1):
        total = vector[i]
        for k in range(i + 1, 7):
            total -= factor[k, i] * vector[k]
        vector[i] = total * factor[i, i]


@njit(**_INNER)
def _scaled(hessian: Array, held: Array, damping: float, matrix: Array, scale: Array) -> None:
    """Write the hessian scaled to a diagonal of 1 + damping, without what is held, and that scale."""
    for i in range(7):
        scale[i] = 1.0 if held[i] else 1 / math.sqrt(hessian[i, i])
        for j in range(i):
            matrix[i, j] = 0.0 if held[i] or held[j] else hessian[i, j] * scale[i] * scale[j]
        matrix[i, i] = 1.0 + damping


@njit(**_INNER)
def _is_outward(low: float, high: float, gradient: float) -> bool:
    """Whether a parameter with these limits is on a bound, with its gradient pushing against it."""
    return bool((low >= 0 and gradient > 0) or (high <= 0 and gradient < 0))


@njit(**_INNER)
def _solve_bounded(system: System, hessian: Array, damping: float) -> bool:
    """Write the damped step within its limits, and which parameters it holds; False where it has no solution."""
    low, high, gradient, held, step = system.low, system.high, system.gradient, system.held, system.step
    diagonal = system.hessian
    matrix, scale, pull, scaled = np.empty((7, 7)), np.empty(7), np.empty(7), np.empty(7)
    for i in range(7):
        held[i] = _is_outward(low[i], high[i], gradient[i]) or not diagonal[i, i] > 0
        pull[i], step[i] = -gradient[i], 0.0
    crossed = True
    while crossed:
        _scaled(hessian, held, damping, matrix, scale)
        if not _factorise(matrix):
            return False
        for i in range(7):
            scaled[i] = 0.0 if held[i] else pull[i] * scale[i]
        _solve(matrix, scaled)
        crossed = False
        for i in range(7):
            if not held[i]:
                step[i] = scaled[i] * scale[i]
                if not low[i] <= step[i] <= high[i]:
                    step[i] = min(max(step[i], low[i]), high[i])
                    held[i] = crossed = True
                    for j in range(7):
                        pull[j] -= hessian[j, i] * step[i]
    return True


@njit(**_INNER)
def _limit(params: Array, lower: Array, upper: Array, low: Array, high: Array) -> None:
    """Write the limits of a step: the bounds, and nearer ones where the quadratic model is not to be believed."""
    for i in range(7):
        low[i], high[i] = lower[i] - params[i], upper[i] - params[i]
    for i in (1, 2):
        low[i], high[i] = max(low[i], -params[3]), min(high[i], params[3])
    for i, k in ((3, 3), (5, 4)):
        low[i] = max((params[k] / upper[3]) ** 2 - 1, -0.75)
        high[i] = min((params[k] / lower[3]) ** 2 - 1, 3.0)
    low[4], high[4] = -0.75, 0.75
    if params[3] == params[4] and (low[3] >= 0 or high[3] <= 0):
        low[4] = high[4] = 0.0  # a circle on its bound, which any S would carry over it


@njit(**_INNER)
def _stiffness(params: Array, low: Array, high: Array, gradient: Array) -> float:
    """Return the bounds' own curvature by S: an axis held on its bound leaves it by S^2 as the ellipse turns."""
    ratio = (params[4] / params[3]) ** 2
    stiffness = 0.0
    if ratio < 1 and _is_outward(low[3], high[3], gradient[3]):
        stiffness += 2 * abs(gradient[3]) / (1 - ratio)
    if ratio < 1 and _is_outward(low[5], high[5], gradient[5]):
        stiffness += 2 * abs(gradient[5]) * ratio / (1 - ratio)
    return stiffness


@njit(**_INNER)
def _curve(amplitude: float, weights: Array, bend: Array, score: Array, hessian: Array, newton: Array) -> None:
    """Write the hessian with second derivatives: with f = log(E), those of the model are A E (f_i f_j + f_ij)."""
    inverse = 1 / amplitude if amplitude != 0 else 0.0
    _products(weights, bend, newton)
    for i in range(7):
        for j in range(7):
            newton[i, j] = hessian[i, j] - newton[i, j] * inverse
    newton[0, 0], newton[6, 6] = hessian[0, 0], hessian[6, 6]
    xu, xv, yu, yv = weights[0, 1], weights[1, 1], weights[0, 2], weights[1, 2]
    newton[1, 1] += (xu * xu + xv * xv) * score[0] * inverse
    newton[2, 1] += (xu * yu + xv * yv) * score[0] * inverse
    newton[2, 2] += (yu * yu + yv * yv) * score[0] * inverse
    newton[3, 1] -= xu * score[1]
    newton[3, 2] -= yu * score[1]
    newton[4, 1] -= xu * score[2] + xv * score[1]
    newton[4, 2] -= yu * score[2] + yv * score[1]
    newton[5, 1] -= xv * score[2]
    newton[5, 2] -= yv * score[2]
    for i in range(1, 6):
        for j in (1, 2):
            newton[j, i] = newton[i, j]


@njit(**_INNER)
def _turn(p: float, s: float, q: float) -> float:
    """Return the angle to the axes in which p u^2 + 2 s u v + q v^2 is diagonal, the smaller value first."""
    return 0.5 * math.atan2(2 * s, q - p)


@njit(**_INNER)
def _prepare(params: Array, lower: Array, upper: Array, system: System) -> None:
    """Turn the sums at ``params`` into the system of the next step."""
    weights, score, gradient = _derivatives(params, 0.0), system.score, system.gradient
    low, high, hessian, newton = system.low, system.high, system.hessian, system.newton
    _products(weights, system.gram, hessian)
    _curve(params[0], weights, system.bend, score, hessian, newton)
    for i in range(7):
        gradient[i] = -weights[0, i] * score[_FIRST[i]] - weights[1, i] * score[_SECOND[i]]
    _limit(params, lower, upper, low, high)
    stiffness = _stiffness(params, low, high, gradient)
    hessian[4, 4] += stiffness
    newton[4, 4] += stiffness


@njit(**_INNER)
def _bounded_sigma(curvature: float, lower: float, upper: float) -> float:
    """Return the sigma of exp(-curvature d^2 / 2), exactly on a bound where only rounding keeps it off."""
    if curvature * upper**2 <= 1 + 1e-9:
        return upper
    if curvature * lower**2 >= 1 - 1e-9:
        return lower
    return 1 / math.sqrt(curvature)


@njit(**_INNER)
def _move(params: Array, system: System, lower: Array, upper: Array, trial: Array) -> None:
    """Write ``params`` after the step, within the bounds."""
    step = system.step
    for i in (0, 1, 2, 6):
        trial[i] = min(max(params[i] + step[i], lower[i]), upper[i])
        if step[i] == lower[i] - params[i]:
            trial[i] = lower[i]
        elif step[i] == upper[i] - params[i]:
            trial[i] = upper[i]
    p, q = (1 + step[3]) / params[3] ** 2, (1 + step[5]) / params[4] ** 2
    s = step[4] / (params[3] * params[4])
    middle, radius = (p + q) / 2, math.hypot((q - p) / 2, s)
    trial[3] = _bounded_sigma(middle - radius, lower[3], upper[3])
    trial[4] = _bounded_sigma(middle + radius, lower[3], upper[3])
    trial[5] = params[5] + _turn(p, s, q)


@njit(**_INNER)
def _is_small(params: Array, trial: Array, tolerance: float) -> bool:
    """Whether the centre moved less than ``tolerance`` and the ellipse's outline less than ten times that."""
    centre = max(abs(trial[1] - params[1]), abs(trial[2] - params[2]))
    turned = abs(trial[5] - params[5]) * (params[3] - params[4])
    outline = max(abs(trial[3] - params[3]), abs(trial[4] - params[4]), turned)
    return bool(centre < tolerance and outline < 10 * tolerance)


@njit(**_INNER)
def _minimise(
    window: Window, params: Array, lower: Array, upper: Array, options: Options, system: System
) -> tuple[float, int, bool]:
    """Improve ``params`` until a step is small; return (residual's sum of squares, steps tried, converged)."""
    trial = np.empty(7)
    floor = window.pixels.size * (0.1 * _ROUNDING) ** 2
    damping, accepted = _FIRST_DAMPING, True
    rss = fit_sums(window, params, system)
    for iteration in range(1, options.max_iterations + 1):
        if accepted:
            _prepare(params, lower, upper, system)
            if system.high[4] == 0:  # along the gradient's own axes, P and Q can leave the bound one without the other
                params[5] += _turn(system.gradient[3], system.gradient[4] / 2, system.gradient[5])
                fit_sums(window, params, system)
                _prepare(params, lower, upper, system)
        accepted = False
        newton = iteration > _GAUSS_NEWTON_STEPS and _solve_bounded(system, system.newton, damping)
        if newton or _solve_bounded(system, system.hessian, damping):
            _move(params, system, lower, upper, trial)
            if damping <= _UNDAMPED and _is_small(params, trial, options.tolerance):
                _copy(trial, params)
                return rss, iteration, bool(system.hessian[1, 1] > 0 and system.hessian[2, 2] > 0)
            trial_rss = fit_sums(window, trial, system)
            accepted = trial_rss <= rss * (1 + _ROUNDING) + floor
        if accepted:
            _copy(trial, params)
            rss = trial_rss
            damping *= 0.1
        else:
            damping = max(10 * damping, 0.01)
            if damping > _LARGEST_DAMPING:
                return rss, iteration, False
    return rss, options.max_iterations, False


@njit(**_INNER)
def _noise_model(amplitude: float, background: float, counting: bool) -> Any:
    """Return (base, contrast): up to a factor, a pixel's noise variance is base + contrast * E."""
    floor = max(background, 0.0)
    total = abs(amplitude) + floor
    if not counting or floor + amplitude < 0 or not total > 0:
        return 1.0, 0.0
    return floor / total, amplitude / total


@njit(**_INNER)
def _standard_errors(
    params: Array, system: System, rss: float, variance: float, options: Options, stderr: Array
) -> None:
    """Write the standard errors (7,) of a finished fit, from the covariance H^-1 (J^T C J) H^-1.

    C is the noise's covariance, that of raw pixels after the blur; so J^T C J is a product of blurred Jacobians, with
    the raw pixels' variances as weights, whose sum is ``variance`` (``noise_sums``). The size of C follows from the
    residual: its expected sum of squares is the trace of C less that of H^-1 (J^T C J), and the trace of C is the raw
    variance times the sum of the squares of the blur's weights.
    """
    held = system.held
    meat, matrix, inverse, scale = np.empty((7, 7)), np.empty((7, 7)), np.zeros((7, 7)), np.empty(7)
    _products(_derivatives(params, options.blur_variance), system.gram, meat)
    _scaled(system.hessian, held, 0.0, matrix, scale)
    if not _factorise(matrix):
        return
    freedom = variance * options.blur_power
    for i in range(7):
        if not held[i]:
            inverse[i, i] = scale[i]
            _solve(matrix, inverse[i])
            for j in range(7):
                inverse[i, j] *= scale[j]
                freedom -= inverse[i, j] * meat[i, j]
    if not freedom > 0:
        return
    for i in range(7):
        if not held[i]:
            square = 0.0
            for j in range(7):
                for k in range(7):
                    square += inverse[i, j] * meat[j, k] * inverse[i, k]
            stderr[i] = math.sqrt(square * rss / freedom)
    elongation = params[3] / params[4] - params[4] / params[3]
    turn = stderr[4] / elongation if elongation > 0 else np.inf
    stderr[3], stderr[4], stderr[5] = 0.5 * params[3] * stderr[3], 0.5 * params[4] * stderr[5], min(turn, math.pi / 2)


@njit(fastmath=_ANY_ORDER, **_INNER)
def _mean(image: Array) -> float:
    """Return the mean, in float64; not finite where a pixel is not."""
    total = 0.0
    for i in range(image.size):
        total += image[i]
    return total / image.size


@njit(fastmath=True, **_INNER)
def _load(image: Array, mean: float, pixels: Array) -> float:
    """Write finite pixels less their mean; return the largest magnitude."""
    largest = _ZERO
    for i in range(image.size):
        pixels[i] = image[i] - mean
        largest = max(largest, abs(pixels[i]))
    return float(largest)


@njit(fastmath=_ANY_ORDER, **_INNER)
def _normalise(pixels: Array, largest: float) -> float:
    """Divide the pixels by the largest magnitude; return the sum of their squares."""
    square, factor = _ZERO, 1 / largest
    for i in range(pixels.size):
        pixel = np.float32(pixels[i] * factor)
        pixels[i] = pixel
        square += pixel * pixel
    return float(square)


@njit(**_INNER)
def _is_at_bound(params: Array, lower: Array, upper: Array) -> bool:
    """Whether a parameter is on a bound of an interval that is more than a point."""
    for i in (0, 1, 2, 6):
        if lower[i] < upper[i] and (params[i] <= lower[i] or params[i] >= upper[i]):
            return True
    return bool(lower[3] < upper[3] and (params[3] >= upper[3] or params[4] <= lower[3]))


@njit(**_INNER)
def _fit_window(
    window: Window,
    offset: float,
    scale: float,
    lower: Array,
    upper: Array,
    options: Options,
    fits: GaussianFits,
    i: int,
) -> float:
    """Fit the loaded window, the ``i``-th, from its start in ``fits``; return the residual's sum of squares."""
    params, low, high = fits.estimates[i], lower.copy(), upper.copy()
    for values in (params, low, high):
        values[0] /= scale
        values[6] = (values[6] - offset) / scale
    system = _new_system()
    rss, fits.n_iterations[i], fits.converged[i] = _minimise(window, params, low, high, options, system)
    fits.at_bound[i] = _is_at_bound(params, low, high)
    if fits.converged[i]:
        noise = _noise_model(params[0] * scale, params[6] * scale + offset, options.counting)
        variance = noise_sums(window, params, options.blur_variance, noise, system.gram)
        _standard_errors(params, system, rss, variance, options, fits.stderr[i])
        fits.stderr[i, 0] *= scale
        fits.stderr[i, 6] *= scale
    params[0] = min(max(params[0] * scale, lower[0]), upper[0])
    params[6] = min(max(params[6] * scale + offset, lower[6]), upper[6])
    params[5] -= math.pi * math.ceil(params[5] / math.pi - 0.5)
    return float(rss)


@njit(cache=True, nogil=True, error_model="numpy")
def fit_windows(images: Array, width: int, lower: Array, upper: Array, options: Options, fits: GaussianFits) -> None:
    """Fit every window from the start in ``fits.estimates``, one after the other and each alone.

    ``images`` are the windows (n, height * width), float32; ``lower`` and ``upper`` are (n, 7).
    """
    n, size = images.shape
    room = np.empty((8, size), np.float32)
    window = Window(room[0], room[1], room[2], room[3], room[4], room[5], room[6], room[7])
    for k in range(size):
        window.x[k], window.y[k] = k % width, k // width
    for i in range(n):
        mean = _mean(images[i])
        known = math.isfinite(mean)
        for k in range(7):
            known = known and math.isfinite(fits.estimates[i, k])
        if not known:
            fits.r_squared[i] = np.nan
            for k in range(7):
                fits.estimates[i, k] = np.nan
            continue
        largest = _load(images[i], mean, window.pixels)
        if largest > _SAME * abs(mean):
            square = _normalise(window.pixels, largest)
            rss = _fit_window(window, mean, largest, lower[i], upper[i], options, fits, i)
            fits.r_squared[i] = 1 - rss / square
