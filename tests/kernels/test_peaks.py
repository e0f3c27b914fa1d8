"""Maxima, climbing and centroids against scipy and against known truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter, uniform_filter

from tract_dask.kernels.peaks import box_means, centroids, climb, local_maxima


def disc(radius: float) -> np.ndarray:
    reach = int(radius)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return x**2 + y**2 <= radius**2


def spot(shape: tuple[int, int], x: float, y: float, sigma: float = 3.0) -> np.ndarray:
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    return np.exp(-((cols - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), radius=st.floats(1, 6), ny=st.integers(1, 40), nx=st.integers(1, 40))
def test_maxima_are_those_of_a_maximum_filter(seed: int, radius: float, ny: int, nx: int) -> None:
    image = np.random.default_rng(seed).permutation(ny * nx).reshape(ny, nx).astype(np.float64)  # no two alike
    expected = (maximum_filter(image, footprint=disc(radius), mode="nearest") == image) & (image >= ny * nx / 3)
    y, x = np.nonzero(expected)
    np.testing.assert_array_equal(local_maxima(image, radius, ny * nx / 3), np.stack([x, y], axis=1))


def test_a_plateau_has_one_maximum() -> None:
    image = np.zeros((9, 9), np.float32)
    image[3:5, 2:5] = 1
    np.testing.assert_array_equal(local_maxima(image, 4.0, 0.5), [[2, 3]])


def test_nothing_above_the_threshold_is_no_maximum() -> None:
    assert local_maxima(np.zeros((5, 7)), 2.0, 1.0).shape == (0, 2)


def test_climbing_reaches_the_brightest_pixel_in_reach_and_no_farther() -> None:
    image = spot((40, 50), 21, 17)
    np.testing.assert_array_equal(climb(image, np.array([[18.2, 15.1]]), 5.0), [[21, 17]])
    ((x, y),) = climb(image, np.array([[10.0, 17.0]]), 5.0)
    assert (x, y) == (15, 17)


def test_climbing_from_outside_and_with_no_radius_stays() -> None:
    image = spot((40, 50), 21, 17)
    np.testing.assert_array_equal(climb(image, np.array([[-9.0, 4.0], [20.4, 17.2]]), 0.0), [[-9, 4], [20.4, 17.2]])


@settings(max_examples=30, deadline=None)
@given(x=st.floats(15, 25), y=st.floats(15, 25), dx=st.integers(-5, 5), dy=st.integers(-5, 5))
def test_centroids_are_near_the_truth_and_move_with_the_image(x: float, y: float, dx: int, dy: int) -> None:
    start = np.rint([[x, y]])
    centre = centroids(7 + spot((48, 48), x, y), start, 6.0)
    assert np.abs(centre - [[x, y]]).max() < 0.2
    moved = centroids(7 + spot((48, 48), x + dx, y + dy), start + np.array([[dx, dy]]), 6.0)
    np.testing.assert_allclose(moved, centre + np.array([[dx, dy]]), atol=1e-9)


@pytest.mark.parametrize("place", [(4.0, 4.0), (0.0, 0.0), (-30.0, 2.0)])
def test_the_centroid_of_a_flat_disc_is_its_place(place: tuple[float, float]) -> None:
    np.testing.assert_array_equal(centroids(np.full((9, 9), 3.0), np.array([place]), 2.5), [place])


@settings(max_examples=20, deadline=None)
@given(radius=st.integers(0, 30), ny=st.integers(1, 30), nx=st.integers(1, 30))
def test_box_means_are_those_of_scipy(radius: int, ny: int, nx: int) -> None:
    image = np.random.default_rng(ny).normal(50, 9, (ny, nx))
    np.testing.assert_allclose(
        box_means(image, radius), uniform_filter(image, 2 * radius + 1, mode="nearest"), rtol=1e-10
    )
