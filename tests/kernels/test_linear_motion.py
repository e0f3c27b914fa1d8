"""Linear motion against closed forms, and its estimates against known truth."""

import numpy as np
import pytest
from scipy.linalg import expm

from tract_dask.kernels import linear_motion

PLACES = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0)), axis=-1).reshape(-1, 2) * 40 - 180
MOTION = np.array([0.03, -0.01, 0.004, 0.002])


def generator(motion):
    rotation, growth, shear, diagonal = motion
    return np.array([[growth + shear, diagonal - rotation], [diagonal + rotation, growth - shear]])


def test_matrices_are_exponentials():
    chance = np.random.default_rng(0)
    for motion in [np.zeros(4), MOTION, *chance.normal(0, 0.3, (20, 4))]:
        np.testing.assert_allclose(linear_motion.matrices(motion), expm(generator(motion)), atol=1e-12)
        np.testing.assert_allclose(linear_motion.motions(linear_motion.matrices(motion)), motion, atol=1e-9)


def test_the_way_back_leads_to_where_it_began():
    there = linear_motion.moved(PLACES, MOTION)
    np.testing.assert_allclose(linear_motion.moved(there, -MOTION), PLACES, atol=1e-10)


def test_a_fit_finds_what_was_done_and_leaves_columns_out_that_move_by_themselves():
    seen = linear_motion.moved(PLACES, MOTION)[None] + [3.0, -2.0]
    seen[0, :5] += 15.0
    shift, motion = linear_motion.fit(seen, PLACES, np.ones(100), np.ones((1, 100), bool), (0, 1, 2, 3))
    np.testing.assert_allclose(shift[0], [3.0, -2.0], atol=1e-6)
    np.testing.assert_allclose(motion[0], MOTION, atol=1e-8)


def test_spread_of_rotation_and_magnification_is_the_least_possible():
    """At most 1.1 times sigma / sqrt(sum r^2), and no bias beyond a fifth of it (400 frames)."""
    chance, sigma = np.random.default_rng(1), 0.5
    truth = np.zeros((400, 4))
    truth[:, :2] = chance.normal(0, 0.01, (400, 2))
    seen = linear_motion.moved(PLACES, truth) + chance.normal(0, sigma, (400, 100, 2))
    _, motion = linear_motion.fit(seen, PLACES, np.ones(100), np.ones((400, 100), bool), (0, 1))
    bound = sigma / np.sqrt((PLACES**2).sum())
    off = motion[:, :2] - truth[:, :2]
    assert (off.std(axis=0) < 1.1 * bound).all()
    assert (np.abs(off.mean(axis=0)) < 0.2 * bound).all()


def test_first_estimates_state_their_errors():
    chance = np.random.default_rng(2)
    away = chance.normal(0, 0.5, (500, 100, 2))
    away[:, 90:] = np.nan
    weight = np.broadcast_to(np.arange(100) < 90, (500, 100)).astype(float)
    motion, stderr = linear_motion.estimate(away + linear_motion.moved(PLACES, MOTION) - PLACES, PLACES, weight)
    pull = (motion - MOTION) / stderr
    np.testing.assert_allclose(pull.std(axis=0), 1.0, atol=0.1)
    assert (np.abs(pull.mean(axis=0)) < 0.15).all()


@pytest.mark.parametrize(
    "places",
    [
        np.column_stack([np.arange(20.0), np.zeros(20)]),
        np.column_stack([np.arange(20.0), 0.05 * (-1) ** np.arange(20)]),
    ],
)
def test_columns_on_a_line_tell_of_no_motion(places):
    motion, _ = linear_motion.estimate(np.zeros((2, 20, 2)), places, np.ones((2, 20)))
    assert np.isnan(motion).all()


def test_motion_takes_ten_columns_and_a_shift_alone_one():
    few = np.arange(100) * 7 % 100 < np.array([9, 10])[:, None]
    motion, _ = linear_motion.estimate(np.zeros((2, 100, 2)), PLACES, few.astype(float))
    assert np.isnan(motion).all(axis=1).tolist() == [True, False]
    shift, _ = linear_motion.fit(PLACES[None] + [3.0, -2.0], PLACES, np.ones(100), np.arange(100)[None] == 5, ())
    np.testing.assert_allclose(shift[0], [3.0, -2.0], atol=1e-9)
