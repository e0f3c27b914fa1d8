"""Vectors in compiled functions, and the fitter at every width that a processor may have."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from numba import njit

from tract_dask.kernels.vectors import simd
from tract_dask.kernels.vectors.tracing import LANES

WIDTHS_DIFFER_PX = 1e-4  # roundings differ where products and sums are not one instruction

PROCESSORS = {4: ("generic", ""), 8: ("haswell", "+avx,+avx2,+fma")}

FIT = """
import json
import numpy as np
from tract_dask.kernels.gaussian.fit import fit_gaussians
from tract_dask.kernels.gaussian.model import gaussian_image
from tract_dask.kernels.vectors.tracing import LANES
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
    a += 1
    simd.store_at(out, 3 * LANES, simd.select((a > 0) | (b > 0), simd.vector(3.0), simd.load_at(x, 0)))
    return simd.total(a)


def test_vectors_compute_as_numpy_does():
    rng = np.random.default_rng(0)
    x, y = rng.normal(0, 2, (2, 1, LANES)).astype(np.float32)
    out = np.empty((4, LANES), np.float32)
    found = arithmetic(x, y, out)
    a, b = x[0], y[0]
    expected = [
        (a + b) * 2 - a / b,
        np.where((a > 0) & (b <= 1), a, 1 - b),
        np.minimum(a, b) + np.maximum(a, 0.5),
        np.where((a + 1 > 0) | (b > 0), 3, a),
    ]
    np.testing.assert_allclose(out, expected, rtol=1e-5)
    assert found == pytest.approx((a + 1).sum(), rel=1e-5)


def fit_with(environment):
    ran = subprocess.run(
        [sys.executable, "-c", FIT], env=os.environ | environment, check=True, capture_output=True, text=True
    )
    return json.loads(ran.stdout)


@pytest.fixture(scope="module")
def fitted_here():
    return fit_with({})


@pytest.mark.slow
@pytest.mark.parametrize("lanes", sorted(PROCESSORS.keys() - {LANES}))
def test_fits_are_the_same_at_every_width(lanes, fitted_here):
    name, features = PROCESSORS[lanes]
    used, estimates, stderr = fit_with({"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": features})
    _, expected, expected_stderr = fitted_here
    assert used == lanes
    np.testing.assert_allclose(np.array(estimates)[:, 1:5], np.array(expected)[:, 1:5], atol=WIDTHS_DIFFER_PX)
    np.testing.assert_allclose(stderr, expected_stderr, rtol=1e-2)
