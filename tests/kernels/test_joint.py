"""Joint fits of touching columns, against SciPy on the same pixels, and against the truth of simulated pairs."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from tract_dask.kernels.gaussian.fit import Outcome
from tract_dask.kernels.gaussian.joint import MOST_MEMBERS, fit_joint
from tract_dask.kernels.gaussian.model import blurred, evaluate, gaussian_image
from tract_dask.kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from tract_dask.kernels.windows import blur, blur_variance

POSITION_PX = 1e-3  # against SciPy on the same pixels
RELATIVE = 1e-3  # amplitudes
RATIO = 1.05  # standard deviation over the joint Cramér-Rao bound
PULL = 0.05  # by which the pulls' standard deviation may differ from 1: 3 of its own errors for 2000 pairs

SIDE = 25


def pair(distance, sigma=3.0, amplitudes=(90.0, 60.0), background=50.0):
    """Return two members (2, 7) about the middle of a window."""
    members = np.zeros((2, 7))
    members[:, AMPLITUDE], members[:, 3:5], members[:, BACKGROUND] = amplitudes, (1.05 * sigma, sigma), background
    members[:, X], members[:, Y] = 12.3 + np.array([-0.5, 0.5]) * distance * sigma, 11.8
    members[:, 5] = 0.3, -0.4
    return members


def image(members, shape=(SIDE, SIDE)):
    return gaussian_image(members, shape).sum(axis=-3) - (len(members) - 1) * members[0, BACKGROUND]


def disc(side=SIDE, radius=12.5):
    return np.hypot(*(np.indices((side, side)) - side // 2)) <= radius


def fitted(windows, members, mask=None, reach=4.0, **options):
    """Return joint fits that start off the truth, and are bounded about their start."""
    n = len(windows)
    start = np.repeat(members[None], n, axis=0)
    start[..., AMPLITUDE] *= 0.8
    start[..., X] += 0.4
    start[..., Y] -= 0.3
    lower, upper = start.copy(), start.copy()
    lower[..., [X, Y]] -= reach
    upper[..., [X, Y]] += reach
    lower[..., AMPLITUDE], upper[..., AMPLITUDE] = 0, 1e4
    lower[..., BACKGROUND], upper[..., BACKGROUND] = -1e4, 1e4
    mask = disc() if mask is None else mask
    return fit_joint(windows.astype(np.float32), mask[None], np.zeros(n, np.int64), start, lower, upper, **options)


def by_scipy(window, members, mask):
    y, x = np.nonzero(mask & np.isfinite(window))

    def residual(values):
        model = members.copy()
        model[:, [AMPLITUDE, X, Y]] = values[:-1].reshape(-1, 3)
        model[:, BACKGROUND] = 0
        return evaluate(model, x, y).sum(axis=0) + values[-1] - window[y, x]

    first = np.append(members[:, [AMPLITUDE, X, Y]].ravel(), members[0, BACKGROUND])
    return least_squares(residual, first, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12).x


@pytest.mark.parametrize("distance", [1.6, 2.0, 3.0, 4.0])
@pytest.mark.parametrize("missing", [False, True])
def test_pairs_are_those_of_scipy(distance, missing):
    truth = pair(distance)
    windows = np.random.default_rng(1).poisson(30 * image(truth), (20, SIDE, SIDE)) / 30
    if missing:
        windows[:, 9, 5:11] = np.nan
        windows[:, 15, 14] = np.inf
    fits = fitted(windows, truth)
    assert (fits.status == Outcome.CONVERGED).all()
    for window, found in zip(windows, fits.estimates, strict=True):
        expected = by_scipy(window.astype(np.float32), truth, disc())
        members = expected[:-1].reshape(-1, 3)
        np.testing.assert_allclose(found[:, [X, Y]], members[:, 1:], atol=POSITION_PX)
        np.testing.assert_allclose(found[:, AMPLITUDE], members[:, 0], rtol=RELATIVE)
        np.testing.assert_allclose(found[:, BACKGROUND], expected[-1], rtol=RELATIVE)


@pytest.mark.parametrize("members", [1, 3, MOST_MEMBERS])
def test_chains_are_those_of_scipy(members):
    truth = np.zeros((members, 7))
    truth[:, AMPLITUDE], truth[:, 3:5], truth[:, BACKGROUND] = np.linspace(60, 100, members), (2.6, 2.4), 40
    truth[:, X], truth[:, Y] = 6 + 5.0 * np.arange(members), 8 + np.arange(members) % 2
    shape = (17, 52)
    windows = np.random.default_rng(2).poisson(10 * image(truth, shape), (3, *shape)) / 10
    fits = fitted(windows, truth, np.ones(shape, bool))
    assert fits.converged.all()
    for window, found in zip(windows, fits.estimates, strict=True):
        expected = by_scipy(window.astype(np.float32), truth, np.ones(shape, bool))[:-1].reshape(-1, 3)
        np.testing.assert_allclose(found[:, [X, Y]], expected[:, 1:], atol=POSITION_PX)
        np.testing.assert_allclose(found[:, AMPLITUDE], expected[:, 0], rtol=RELATIVE)


def joint_bound(members, mask):
    """Return the Cramér-Rao bounds (members, 3) of amplitude, x, y of counts with known shapes, in a round window."""
    y, x = np.nonzero(mask)
    values = np.append(members[:, [AMPLITUDE, X, Y]].ravel(), members[0, BACKGROUND])

    def model(values):
        model = members.copy()
        model[:, [AMPLITUDE, X, Y]], model[:, BACKGROUND] = values[:-1].reshape(-1, 3), 0
        return evaluate(model, x, y).sum(axis=0) + values[-1]

    slopes = np.array([(model(values + h) - model(values - h)) / 2e-4 for h in 1e-4 * np.eye(len(values))])
    covariance = np.linalg.inv(slopes / model(values) @ slopes.T)
    return np.sqrt(covariance.diagonal()[:-1]).reshape(-1, 3)


@pytest.mark.parametrize("distance", [1.6, 2.5, 4.0])
@pytest.mark.parametrize("sigma_blur", [0.0, 1.0])
def test_pairs_reach_the_bound_and_know_their_errors(distance, sigma_blur):
    """Counts are high enough that the fit is linear over its errors."""
    n, narrow = 2000, pair(distance, amplitudes=(400.0, 300.0), background=300.0)
    room = 8
    raw = image(narrow + np.array([0, room, room, 0, 0, 0, 0]), (SIDE + 2 * room, SIDE + 2 * room))
    counts = np.random.default_rng(3).poisson(raw, (n, *raw.shape)).astype(np.float32)
    inner = slice(room, room + SIDE)
    windows = np.stack([blur(frame, sigma_blur)[inner, inner] for frame in counts])
    truth = blurred(narrow, blur_variance(sigma_blur))
    fits = fitted(windows, truth, blur_sigma_px=sigma_blur)
    assert fits.converged.all()
    own = np.sqrt(fits.noise / fits.freedom).mean()
    errors = fits.estimates[..., [AMPLITUDE, X, Y]] - truth[:, [AMPLITUDE, X, Y]]
    spread, stated = errors.std(axis=0), fits.stderr[..., [AMPLITUDE, X, Y]]
    bound = joint_bound(narrow, disc())[:, 1:]
    assert (spread[:, 1:] / bound).mean() < RATIO
    pulls = (errors / stated).std(axis=0)
    np.testing.assert_allclose(pulls[:, 1:], 1, atol=PULL)
    np.testing.assert_allclose(pulls[:, 0], 1, atol=2 * PULL)
    assert np.abs(errors[..., 1:].mean(axis=0)).max() < 4 * (spread[:, 1:] / np.sqrt(n)).max()
    assert own == pytest.approx(1, abs=0.03)


def test_a_member_stays_within_its_bounds():
    truth = pair(2.0)
    windows = image(truth)[None]
    fits = fitted(windows, truth, reach=0.2)
    assert fits.status[0] == Outcome.AT_BOUND
    assert fits.held[0].all()
    away = fits.estimates[0][:, [X, Y]] - truth[:, [X, Y]] - np.array([0.4, -0.3])
    assert np.abs(away).max() == pytest.approx(0.2, abs=1e-9)


def test_a_group_does_not_depend_on_the_others():
    truth = pair(2.2)
    windows = np.random.default_rng(4).poisson(image(truth), (37, SIDE, SIDE))
    together, alone = fitted(windows, truth), fitted(windows[5:6], truth)
    np.testing.assert_array_equal(together.estimates[5], alone.estimates[0])
    np.testing.assert_array_equal(together.stderr[5], alone.stderr[0])


def test_what_cannot_be_fitted_says_so():
    truth = pair(2.5)
    windows = np.stack([np.full((SIDE, SIDE), 7.0), np.full((SIDE, SIDE), np.nan), image(truth)])
    fits = fitted(windows, truth)
    assert fits.status.tolist() == [Outcome.NO_INFORMATION, Outcome.NO_INFORMATION, Outcome.CONVERGED]
    assert np.isfinite(fits.estimates).all()
    assert np.isnan(fits.stderr[:2]).all()


def test_dark_pairs_of_any_scale():
    truth = pair(2.5)
    plain = fitted(image(truth)[None], truth)
    turned = truth.copy()
    turned[:, AMPLITUDE] *= -1e6
    turned[:, BACKGROUND] = 1e9
    start = turned[None] + np.array([1e7, 0.4, -0.3, 0, 0, 0, 0])
    reach = np.array([1e9, 4, 4, 0, 0, 0, 1e10])
    dark = fit_joint(
        image(turned)[None].astype(np.float32), disc()[None], np.zeros(1, np.int64), start, start - reach, start + reach
    )
    np.testing.assert_allclose(dark.estimates[0][:, [X, Y]], plain.estimates[0][:, [X, Y]], atol=POSITION_PX)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"start": np.zeros((1, 9, 7))}, "1 to 8 members"),
        ({"start": np.zeros((2, 2, 7))}, "must be"),
        ({"which": np.array([1])}, "do not go with"),
        ({"lower": np.ones((1, 2, 7)), "upper": np.zeros((1, 2, 7))}, "lower bound"),
    ],
)
def test_what_does_not_go_together_is_refused(change, words):
    arguments = {
        "windows": np.zeros((1, 9, 9), np.float32),
        "masks": np.ones((1, 9, 9), bool),
        "which": np.zeros(1, np.int64),
        "start": np.ones((1, 2, 7)),
        "lower": np.zeros((1, 2, 7)),
        "upper": np.ones((1, 2, 7)),
    }
    with pytest.raises(ValueError, match=words):
        fit_joint(**arguments | change)
