"""Fixed patterns against known truth."""

import numpy as np
import pytest

from tract_dask.kernels.patterns import fine, likeness, pattern_power

SHAPE = (200, 180)


def scene(sigma=2.0, spacing=12.0):
    """Gaussians on a grid of another period than the pixels."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    near = [np.abs((axis + 0.3 * spacing) % spacing - spacing / 2) for axis in (y + 0.013 * x, x)]
    return 20 + 60 * np.exp(-(near[0] ** 2 + near[1] ** 2) / (2 * sigma**2))


def halves(rng, image, pattern, frames=50):
    return [rng.poisson(image * pattern, (frames, *SHAPE)).mean(axis=0) for _ in range(2)]


def test_white_noise_keeps_its_size():
    assert fine(np.random.default_rng(0).normal(size=(400, 400))).std() == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize(("size", "sigma"), [(0.0, 1.5), (0.0, 2.0), (0.0, 4.0), (0.03, 2.0), (0.1, 2.0)])
def test_the_size_of_a_pattern(size, sigma):
    """Budget: 10 %, or 1 % of the level where there is none, down to columns of sigma 1.5 px."""
    rng = np.random.default_rng(1)
    found = pattern_power(*halves(rng, scene(sigma), rng.normal(1, size, SHAPE)))
    assert abs(found.value - size**2) < max(5 * found.stderr, 0.2 * size**2)
    if size:
        assert found.value > 5 * found.stderr
        assert np.sqrt(found.value) == pytest.approx(size, rel=0.1)
    else:
        assert found.value < 0.01**2


def test_its_error_is_that_of_many_movies():
    rng, image = np.random.default_rng(2), scene()
    found = [pattern_power(*halves(rng, image, 1.0, frames=3)) for _ in range(30)]
    pulls = np.array([one.value / one.stderr for one in found])
    assert abs(pulls.mean()) < 0.6
    assert pulls.std() == pytest.approx(1, abs=0.3)


@pytest.mark.parametrize(("power", "expected"), [(1, 1.0), (-1, -1.0), (0, 0.0)])
def test_which_pattern_it_is(power, expected):
    rng = np.random.default_rng(3)
    sensitivity = np.clip(rng.normal(1, 0.05, SHAPE), 0.7, 1.3)
    mean = np.mean(halves(rng, scene(), sensitivity**power), axis=0)
    mean[50, 60] = 1e4
    mean[10, 10] = np.nan
    found = likeness(mean, sensitivity)
    assert found.value == pytest.approx(expected, abs=max(0.06, 5 * found.stderr))
    assert found.stderr < 0.1


def test_nothing_is_said_of_too_little():
    assert pattern_power(np.ones((20, 20)), np.ones((20, 20))) is None
    assert likeness(np.ones(SHAPE), np.ones(SHAPE)) is None
