"""The model: Equation 1 as written, and one label for each Gaussian."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tract_dask.kernels.gaussian.model import canonical, evaluate, gaussian_image

PARAMETERS = st.tuples(
    st.floats(-10, 10),
    st.floats(0, 20),
    st.floats(0, 20),
    st.floats(1, 8),
    st.floats(1, 8),
    st.floats(-10, 10),
    st.floats(-10, 10),
)


def test_equation_1_as_written():
    amplitude, x0, y0, sigma_a, sigma_b, theta, background = parameters = 3.0, 4.0, 5.0, 2.5, 1.5, 0.4, 7.0
    x, y = 5.5, 3.0
    along = ((x - x0) * np.cos(theta) - (y - y0) * np.sin(theta)) / sigma_a
    across = ((x - x0) * np.sin(theta) + (y - y0) * np.cos(theta)) / sigma_b
    expected = amplitude * np.exp(-(along**2) / 2) * np.exp(-(across**2) / 2) + background
    assert evaluate(parameters, x, y) == pytest.approx(expected, rel=1e-14)


def test_major_axis_lies_along_cos_and_minus_sin_of_theta():
    theta = 0.4
    parameters = (1.0, 0.0, 0.0, 4.0, 2.0, theta, 0.0)
    on_axis = evaluate(parameters, 4 * np.cos(theta), -4 * np.sin(theta))
    assert on_axis == pytest.approx(np.exp(-0.5), rel=1e-14)


def test_image_is_indexed_y_then_x_and_batched():
    parameters = np.array([[1.0, 3, 1, 1, 1, 0, 0], [1.0, 0, 4, 1, 1, 0, 0]])
    images = gaussian_image(parameters, (5, 7))
    assert images.shape == (2, 5, 7)
    assert np.unravel_index(images[0].argmax(), (5, 7)) == (1, 3)
    assert np.unravel_index(images[1].argmax(), (5, 7)) == (4, 0)


@given(PARAMETERS)
def test_canonical_is_the_same_gaussian_and_its_own_label(parameters):
    labelled = canonical(parameters)
    assert labelled[3] >= labelled[4] > 0
    assert -np.pi / 2 < labelled[5] <= np.pi / 2
    np.testing.assert_allclose(gaussian_image(labelled, (9, 9)), gaussian_image(parameters, (9, 9)), atol=1e-9)
    np.testing.assert_array_equal(canonical(labelled), labelled)


def test_an_angle_that_rounds_to_the_open_end_is_the_closed_one():
    theta = np.nextafter(np.pi / 2, 2)
    assert -np.pi / 2 < canonical([1.0, 0.0, 0.0, 3.0, 2.0, theta, 0.0])[5] <= np.pi / 2
