"""Traced functions of vectors against numpy."""

import numpy as np
import pytest
from numba import njit, types

from tract_dask.kernels.vectors import simd, tracing
from tract_dask.kernels.vectors.tracing import LANES, traced

EXP_ERROR = 3e-7
ROUNDING = 1e-6


@traced(types.int64)
def _write_arithmetic(x, y, out):
    a, b = x[0], y[0]
    out[0] = (a + b) * 2 - a / b
    out[1] = tracing.select((a > 0) & ~(b <= 1) | a.equals(b), 1 - b, -a)
    out[2] = tracing.smaller(a, b) + tracing.larger(a, 0.5)
    out[3] = tracing.sqrt(tracing.absolute(a))
    out[4] = 1 / b
    return tracing.count(a > b)


@njit(error_model="numpy")
def arithmetic(x, y, out):
    return _write_arithmetic(x, y, out)


def test_vectors_compute_as_numpy_does():
    a, b = np.random.default_rng(0).normal(0, 2, (2, LANES)).astype(np.float32)
    b[0] = a[0]
    out = np.empty((5, LANES), np.float32)
    n_larger = arithmetic(a[None], b[None], out)
    expected = [
        (a + b) * 2 - a / b,
        np.where((a > 0) & (b > 1) | (a == b), 1 - b, -a),
        np.minimum(a, b) + np.maximum(a, 0.5),
        np.sqrt(np.abs(a)),
        1 / b,
    ]
    np.testing.assert_allclose(out, expected, rtol=ROUNDING, atol=ROUNDING)
    assert n_larger == np.count_nonzero(a > b)


@traced()
def _write_exp(x, out):
    out[0] = tracing.exp(x[0])


@njit
def exponential(x, out):
    _write_exp(x, out)


@pytest.mark.parametrize("start", range(-90, 90, 9))
def test_exp_is_exact_to_rounding(start):
    x = np.linspace(start, start + 9, LANES, dtype=np.float32)
    out = np.empty((1, LANES), np.float32)
    exponential(x[None], out)
    expected = np.where(x > -87, np.exp(np.minimum(x, 88).astype(np.float64)), 0)
    np.testing.assert_allclose(out[0], expected, rtol=EXP_ERROR)


def test_exp_of_no_number_is_zero():
    out = np.empty((1, LANES), np.float32)
    exponential(np.full((1, LANES), np.nan, np.float32), out)
    assert (out == 0).all()


@traced()
def _write_powers(bounds, base, out):
    first, end = bounds

    def step(k, values):
        power, total = values
        out[k] = power
        return [power * base, total + power * tracing.spread(k)]

    _, total = tracing.loop(tracing.more(first, 0), tracing.fewer(end, 6), [base, base * 0], step)
    out[6] = total


@njit
def powers(first, end, base, out):
    _write_powers((first, end), base, out)


@pytest.mark.parametrize(("first", "end"), [(0, 6), (-3, 9), (2, 5), (4, 4)])
def test_loop_carries_its_values_from_turn_to_turn(first, end):
    out = np.zeros((7, LANES), np.float32)
    powers(first, end, 1.5, out)
    turns = range(max(first, 0), min(end, 6))
    expected = np.zeros(7)
    for n, k in enumerate(turns, 1):
        expected[k] = 1.5**n
        expected[6] += k * 1.5**n
    np.testing.assert_allclose(out, np.repeat(expected[:, None], LANES, axis=1), rtol=ROUNDING)


@njit
def turned(image, starts, out):
    simd.transpose(image, starts, 3, out, 0)


def test_transpose_puts_windows_side_by_side():
    image, starts = np.arange(60 * LANES, dtype=np.float32), np.arange(LANES) * 50
    out = np.empty((LANES, LANES), np.float32)
    turned(image, starts, out)
    np.testing.assert_array_equal(out, starts[None] + 3 + np.arange(LANES)[:, None])


@traced(types.float32)
def _sum_from(array, first):
    return tracing.total(array.vector(first))


@njit
def sum_from(array, first):
    return _sum_from(array, first)


@pytest.mark.parametrize("dtype", ["u1", "i2", "u4", "f4", "f8"])
def test_elements_of_any_type_are_read_as_float32(dtype):
    values = np.arange(3 * LANES).astype(dtype)
    assert sum_from(values, 5) == values[5 : 5 + LANES].sum()


@pytest.mark.parametrize(
    ("features", "lanes"), [("+sse2,+avx,+avx512f", 16), ("+avx,-avx512f", 8), ("+sse2", 4), ("+neon", 4), ("", 4)]
)
def test_lanes_follow_the_processor(features, lanes):
    assert tracing.lanes_of(features) == lanes
