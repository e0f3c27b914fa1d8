"""Vectors against numpy, and the fitter at every width that a processor may have."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from numba import njit

from tract_dask.kernels import simd
from tract_dask.kernels.simd import LANES

EXP_ERROR = 3e-7
WIDTHS_DIFFER_PX = 1e-4  # roundings differ where products and sums are not one instruction

PROCESSORS = {4: ("generic", ""), 8: ("haswell", "+avx,+avx2,+fma")}

FIT = """
import json
import numpy as np
from tract_dask.kernels.fitting import fit_gaussians
from tract_dask.kernels.gaussian import gaussian_image
from tract_dask.kernels.simd import LANES
truth = np.array([[100, 12.3, 11.2, 3.5 + 0.05 * i, 2.5, 0.1 * i, 50] for i in range(19)])
windows = np.random.default_rng(0).poisson(gaussian_image(truth, (24, 25))).astype(np.float32)
fits = fit_gaussians(windows, (80, 12, 12, 3, 3, 0, 50), 0, (1e4, 24, 23, 9, 9, 0, 1e4))
print(json.dumps([LANES, fits.estimates.tolist(), fits.stderr.tolist()]))
"""


@njit(error_model="numpy")
def arithmetic(x, y, out):
    a, b = simd.load(x, 0), simd.load(y, 0)
    simd.store(out, 0, (a + b) * 2 - a / b)
    simd.store(out, 1, simd.select((a > 0) & (b <= 1), a, 1 - b))
    simd.store(out, 2, simd.smaller(a, b) + simd.larger(a, 0.5))
    simd.store(out, 3, simd.sqrt(simd.absolute(a)) * simd.negated(b))
    simd.store(out, 4, simd.exp(a))
    return simd.count((a > 0) | (b > 0))


@njit
def turned(image, starts, out):
    simd.transpose(image, starts, 3, out, 0)


def test_vectors_compute_as_numpy_does():
    rng = np.random.default_rng(0)
    x, y = rng.normal(0, 2, (2, 1, LANES)).astype(np.float32)
    out = np.empty((5, LANES), np.float32)
    found = arithmetic(x, y, out)
    a, b = x[0], y[0]
    expected = [
        (a + b) * 2 - a / b,
        np.where((a > 0) & (b <= 1), a, 1 - b),
        np.minimum(a, b) + np.maximum(a, 0.5),
        -np.sqrt(np.abs(a)) * b,
        np.exp(a),
    ]
    np.testing.assert_allclose(out, expected, rtol=1e-5)
    assert found == np.count_nonzero((a > 0) | (b > 0))


@pytest.mark.parametrize("start", range(-90, 90, 9))
def test_exp_is_exact_to_rounding(start):
    x = np.linspace(start, start + 9, LANES, dtype=np.float32)[None]
    out = np.empty((5, LANES), np.float32)
    arithmetic(x, np.ones_like(x), out)
    expected = np.where(x[0] > -87, np.exp(np.minimum(x[0], 88).astype(np.float64)), 0)
    np.testing.assert_allclose(out[4], expected, rtol=EXP_ERROR)


def test_transpose_puts_windows_side_by_side():
    image, starts = np.arange(60 * LANES, dtype=np.float32), np.arange(LANES) * 50
    out = np.empty((LANES, LANES), np.float32)
    turned(image, starts, out)
    np.testing.assert_array_equal(out, starts[None] + 3 + np.arange(LANES)[:, None])


@pytest.mark.parametrize(
    ("features", "lanes"), [("+sse2,+avx,+avx512f", 16), ("+avx,-avx512f", 8), ("+sse2", 4), ("+neon", 4), ("", 4)]
)
def test_lanes_follow_the_processor(features, lanes):
    assert simd.lanes_of(features) == lanes


def fit_with(environment):
    ran = subprocess.run(
        [sys.executable, "-c", FIT], env=os.environ | environment, check=True, capture_output=True, text=True
    )
    return json.loads(ran.stdout)


@pytest.mark.slow
@pytest.mark.parametrize("lanes", sorted(PROCESSORS))
def test_fits_are_the_same_at_every_width(lanes):
    name, features = PROCESSORS[lanes]
    used, estimates, stderr = fit_with({"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": features})
    _, expected, expected_stderr = fit_with({})
    assert used == lanes
    np.testing.assert_allclose(np.array(estimates)[:, 1:5], np.array(expected)[:, 1:5], atol=WIDTHS_DIFFER_PX)
    np.testing.assert_allclose(stderr, expected_stderr, rtol=1e-2)
