"""Errors of fits to noise that pixels share, against dense matrices and against noise that is drawn."""

from __future__ import annotations

import numpy as np
import pytest

from tract_dask.kernels.gaussian.correlated import shared_noise
from tract_dask.kernels.gaussian.information import model_slopes

SIZE = 15
COLUMN = np.array([[9.0, 7.0, 7.0, 3.0, 2.5, 0.3, 20.0]])


def spread(sigma, reach=6):
    """Return the autocorrelation of white noise after a Gaussian of ``sigma`` px."""
    lag = np.arange(-reach, reach + 1)
    return np.exp(-(lag[:, None] ** 2 + lag**2) / (4 * sigma**2))


def test_white_noise_leaves_errors_as_they_were():
    for blur in (0.0, 2.0):
        found = shared_noise(COLUMN, SIZE, np.ones((1, 1)), blur_sigma_px=blur)
        np.testing.assert_allclose(np.append(found.errors, found.left), 1, rtol=1e-9)


@pytest.mark.parametrize("likelihood", [False, True])
def test_factors_are_those_of_dense_matrices(likelihood):
    rows, across = np.indices((SIZE, SIZE), dtype=float)
    inside = np.hypot(rows - 7, across - 7) <= SIZE / 2
    y, x = rows[inside], across[inside]
    expected, slopes, volume = model_slopes(COLUMN[0], x, y, fixed_shape=True)
    apart = (y[:, None] - y) ** 2 + (x[:, None] - x) ** 2
    root = np.sqrt(expected)
    slopes = slopes / root if likelihood else slopes
    errors, remains = [], []
    for shared in (np.eye(len(x)), np.exp(-apart / (4 * 1.2**2))):
        noise = shared if likelihood else shared * root[:, None] * root
        hessian = np.linalg.inv(slopes @ slopes.T)
        covariance = hessian @ slopes @ noise @ slopes.T @ hessian
        remains.append(np.trace(noise) - np.trace(hessian @ slopes @ noise @ slopes.T))
        errors.append(np.sqrt(np.append(covariance.diagonal(), volume @ covariance @ volume)))
    at_x, at_y, amplitude, background, of_volume = errors[1] / errors[0]
    found = shared_noise(COLUMN, SIZE, spread(1.2, 10), likelihood=likelihood)
    assert found.left[0] == pytest.approx(remains[1] / remains[0], rel=0.01)
    np.testing.assert_allclose(
        found.errors[0, [0, 1, 2, 6, 7]], [amplitude, at_x, at_y, background, of_volume], rtol=0.01
    )


def test_columns_that_are_alike_share_factors_and_keep_their_order():
    columns = np.repeat(COLUMN, 5, axis=0)
    columns[[1, 3], 3:5] *= 1.4
    found = shared_noise(columns, SIZE, spread(1.0), blur_sigma_px=1.5).errors
    np.testing.assert_array_equal(found[[0, 2]], found[[4, 4]])
    np.testing.assert_array_equal(found[1], found[3])
    assert not np.allclose(found[0], found[1])
