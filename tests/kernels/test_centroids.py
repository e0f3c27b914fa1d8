"""Centroids against closed forms: Gaussians and discs at known places, and the theory of their noise."""

import numpy as np
import pytest

from tract_dask.kernels.centroids import BEST_RADIUS, CentroidOutcome, window_centroids
from tract_dask.kernels.gaussian.model import gaussian_image

SIDE = 25
MIDDLE = np.array([12.0, 12.0])
SIGMA = 4.0
RADIUS = BEST_RADIUS * SIGMA


def windows_at(places, amplitude=20.0, background=100.0, sigma=SIGMA, side=SIDE):
    """Round Gaussians at ``places`` (n, 2) of (x, y), noise-free."""
    parameters = [[amplitude, x, y, sigma, sigma, 0.0, background] for x, y in places]
    return np.array([gaussian_image(np.array(p), (side, side)) for p in parameters], dtype=np.float32)


def places_near_the_middle(n, within=3.0, seed=0):
    return MIDDLE + np.random.default_rng(seed).uniform(-within, within, (n, 2))


@pytest.mark.parametrize(("amplitude", "background"), [(20.0, 0.0), (20.0, 1e4), (-20.0, 100.0)])
def test_a_moved_gaussian_is_found_where_it_is(amplitude, background):
    """To 0.01 px, from 3 px away, on any background: also though the Gaussian reaches beyond its mask."""
    places = places_near_the_middle(200)
    found = window_centroids(windows_at(places, amplitude, background), MIDDLE, RADIUS, 6.0, dark=amplitude < 0)
    assert (found.status == CentroidOutcome.CONVERGED).all()
    assert np.abs(found.places - places).max() <= 0.01


@pytest.mark.parametrize("sides", [(9, 31), (31, 9), (17, 18)])
def test_the_centroid_of_a_disc_is_its_middle(sides):
    """A disc of radius 3 px, drawn by its exact share of each pixel: its centre of mass is its middle."""
    y, x = np.mgrid[: sides[0] * 20, : sides[1] * 20] / 20 - 0.475
    middle = (sides[1] / 2 - 0.73, sides[0] / 2 - 0.42)
    fine = np.hypot(x - middle[0], y - middle[1]) <= 3
    disc = fine.reshape(sides[0], 20, sides[1], 20).mean(axis=(1, 3), dtype=np.float64)
    found = window_centroids(7 + disc[None].astype(np.float32), np.rint([middle]), 3.9)
    np.testing.assert_allclose(found.places, [middle], atol=0.01)


def test_the_background_does_not_matter():
    """Steps vanish where the mask is centred on its brightness, whatever is added to all of it."""
    noise = np.random.default_rng(1).normal(0, 4, (300, SIDE, SIDE))
    windows = windows_at(places_near_the_middle(300), background=0.0) + noise.astype(np.float32)
    low, high = (window_centroids(windows + np.float32(b), MIDDLE, RADIUS, 6.0, tolerance_px=1e-4) for b in (0, 500))
    np.testing.assert_array_equal(low.status, high.status)
    assert np.nanmax(np.abs(low.places - high.places)) <= 2e-3


def spread(radius, noise=1.0, n=4000):
    """Standard deviation per axis of centroids in white noise, px."""
    places = places_near_the_middle(n, within=0.5, seed=2)
    windows = windows_at(places) + np.random.default_rng(3).normal(0, noise, (n, SIDE, SIDE)).astype(np.float32)
    return float((window_centroids(windows, MIDDLE, radius, 6.0).places - places).std())


@pytest.mark.parametrize("radius", [1.3, BEST_RADIUS, 2.4])
def test_noise_is_that_of_theory(radius):
    """The noise of a mask's first moment is sqrt(pi / 4) radius^2; it is divided by the volume above the rim.

    A rim over which the share falls evenly from 1 to 0 has a third of the variance, not the half that a sharp edge
    has: a share of 2 / (3 radius) less in all.
    """
    u, radius_px = radius**2 / 2, radius * SIGMA
    volume = 2 * np.pi * SIGMA**2 * 20.0 * (1 - (1 + u) * np.exp(-u))
    expected = np.sqrt(np.pi / 4 * (1 - 2 / (3 * radius_px))) * radius_px**2 / volume
    assert spread(radius_px) == pytest.approx(expected, rel=0.03)


def test_the_best_radius_is_the_best():
    """Its standard deviation is 1.18 times the Cramer-Rao bound in white noise, sqrt(2 / pi) * noise / amplitude.

    That is of a sharp mask; the soft rim makes it 1.13.
    """
    best = spread(RADIUS)
    assert best / (np.sqrt(2 / np.pi) / 20.0) == pytest.approx(1.184 * np.sqrt(1 - 2 / (3 * RADIUS)), rel=0.03)
    assert best <= min(spread(0.75 * RADIUS), spread(1.3 * RADIUS))


def test_a_mask_shrinks_at_the_edge_and_stays_unbiased():
    places = np.array([[12.0, 4.5], [3.8, 12.0], [20.0, 19.6]])
    found = window_centroids(windows_at(places), places + np.array([1.0, -1.0]), RADIUS)
    assert (found.status == CentroidOutcome.CONVERGED).all()
    assert np.abs(found.places - places).max() <= 0.02


def test_what_goes_wrong_is_told():
    windows = windows_at([MIDDLE] * 5 + [(19.0, 12.0)])
    windows[0] = 3.0
    windows[1, 12, 14] = np.nan
    windows[2, 0, 0] = np.inf
    start = np.array([[12.0, 12.0]] * 6)
    start[3] = np.nan
    found = window_centroids(windows, start, RADIUS, 4.0, dark=[False] * 4 + [True, False])
    outcomes = ["NO_SIGNAL", "NOT_FINITE", "CONVERGED", "NOT_FINITE", "NO_SIGNAL", "AT_REACH"]
    assert [CentroidOutcome(code).name for code in found.status] == outcomes
    np.testing.assert_array_equal(np.isfinite(found.places).all(axis=1), [False, False, True, False, False, True])
    np.testing.assert_allclose(found.places[5], [16.0, 12.0], atol=0.01)


def test_all_at_once_is_one_by_one():
    rng = np.random.default_rng(4)
    windows = windows_at(places_near_the_middle(40)) + rng.normal(0, 8, (40, SIDE, SIDE)).astype(np.float32)
    radii = rng.uniform(5, 9, 40)
    together = window_centroids(windows, MIDDLE, radii, 6.0)
    for n in range(40):
        alone = window_centroids(windows[n : n + 1], MIDDLE, radii[n], 6.0)
        np.testing.assert_array_equal(alone.places[0], together.places[n])


def test_wrong_shapes_and_radii_are_refused():
    with pytest.raises(ValueError, match="windows must be"):
        window_centroids(np.zeros((9, 9), np.float32), MIDDLE, 3.0)
    with pytest.raises(ValueError, match="radius must be at least"):
        window_centroids(np.zeros((1, 9, 9), np.float32), MIDDLE, 1.0)
    assert window_centroids(np.zeros((0, 9, 9), np.float32), MIDDLE, 3.0).places.shape == (0, 2)
