"""One step of the least-squares fit of one window in plain NumPy, and the compiled fitter held equal to it.

Read :func:`one_step` before tract_dask/kernels/gaussian: it computes the same numbers in float64, pixel by pixel.
docs/kernels.md names the compiled function for each function here, and lists what is left out.
"""

import numpy as np
import pytest

from tract_dask.kernels.gaussian.fit import Outcome, fit_gaussians
from tract_dask.kernels.gaussian.model import canonical, evaluate, gaussian_image
from tract_dask.kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, THETA, X, Y

POSITION_PX = 5e-6  # compiled against reference after one step; a damping ten times as large moves x by 2e-2
SIGMA_PX = 5e-5
THETA_RAD = 5e-5
RELATIVE = 1e-5  # amplitude and background, of the column's amplitude

DAMPING = 1e-3  # a fit begins at 1e-2, and each accepted point divides it by 10; the start is the first

SHAPE, WIDE = (25, 23), (33, 61)
TRUTH = np.array([100.0, 0.8, 0.6, 3.8, 2.7, 0.5, 60.0])  # x and y here, and in the next three, from the middle pixel
START = np.array([80.0, 0.0, 0.0, 3.3, 3.0, 0.2, 70.0])
LOWER = np.array([0.0, -6.0, -6.0, 1.0, 1.0, -2.0, 0.0])
UPPER = np.array([1e4, 6.0, 6.0, 12.0, 12.0, 2.0, 1e4])


def pixels_of(window, radius):
    """Return the pixels that count, as x, y and value: those within ``radius`` px of the middle one."""
    y, x = np.mgrid[: window.shape[0], : window.shape[1]]
    counts = np.hypot(x - window.shape[1] // 2, y - window.shape[0] // 2) <= radius
    return x[counts].astype(float), y[counts].astype(float), window[counts].astype(float)


def axes_of(parameters):
    """Return F (2, 2): (u, v) = F (X, Y) lie along the ellipse's axes, in units of its sigmas."""
    _, _, _, sigma_a, sigma_b, theta, _ = parameters
    cos, sin = np.cos(theta), np.sin(theta)
    return np.array([[cos / sigma_a, -sin / sigma_a], [sin / sigma_b, cos / sigma_b]])


def project(parameters, pixels, lower, upper):
    """Return the parameters with the best amplitude and background for their centre and shape."""
    x, y, values = pixels
    result = parameters.copy()
    result[[AMPLITUDE, BACKGROUND]] = 1, 0
    e = evaluate(result, x, y)
    before = parameters[AMPLITUDE]

    def bounded(amplitude):  # it may not vanish in one step: at least half of what it was stays
        kept = min(amplitude, before / 2) if before < 0 else max(amplitude, before / 2)
        return np.clip(kept, lower[AMPLITUDE], upper[AMPLITUDE])

    amplitude = bounded(np.linalg.lstsq(np.stack([e, np.ones_like(e)], axis=1), values, rcond=None)[0][0])
    free = np.mean(values - amplitude * e)
    background = np.clip(free, lower[BACKGROUND], upper[BACKGROUND])
    if background != free:
        amplitude = bounded(e @ (values - background) / (e @ e))
    result[[AMPLITUDE, BACKGROUND]] = amplitude, background
    return result


def jacobian(parameters, x, y):
    """Return the derivatives (n, 7) of the model by amplitude, x, y, P, S, Q and background.

    The model is A exp(-(P u^2 + 2 S u v + Q v^2) / 2) + background, at P = Q = 1 and S = 0.
    """
    amplitude, axes = parameters[AMPLITUDE], axes_of(parameters)
    u, v = axes @ [x - parameters[X], y - parameters[Y]]
    e = np.exp(-0.5 * (u * u + v * v))
    g = amplitude * e
    by_x, by_y = (g * (u * axes[0, i] + v * axes[1, i]) for i in (0, 1))
    return np.stack([e, by_x, by_y, -0.5 * g * u * u, -g * u * v, -0.5 * g * v * v, np.ones_like(e)], axis=1)


def limits(parameters, lower, upper, fixed_shape):
    """Return how far a step may go, down and up (7,): to the bounds, and not so far that the model is another."""
    low, high = lower - parameters, upper - parameters
    reach, curvatures = parameters[[SIGMA_A, SIGMA_B]].max(), parameters[[SIGMA_A, SIGMA_B]] ** -2.0
    low[[X, Y]], high[[X, Y]] = np.maximum(low[[X, Y]], -reach), np.minimum(high[[X, Y]], reach)
    low[[3, 5]] = np.maximum(upper[SIGMA_A] ** -2.0 / curvatures - 1, -0.75)
    high[[3, 5]] = np.minimum(lower[SIGMA_A] ** -2.0 / curvatures - 1, 3.0)
    low[4], high[4] = -0.75, 0.75
    if fixed_shape:
        low[3:6] = high[3:6] = 0
    return low, high


def solve_bounded(matrix, pull, low, high):
    """Return the step: what would cross a limit is put onto it, and the others are solved anew."""
    step = np.zeros(7)
    free = ~((low >= 0) & (pull < 0) | (high <= 0) & (pull > 0))
    while True:
        rest = pull - matrix @ np.where(free, 0, step)
        step[free] = np.linalg.solve(matrix[np.ix_(free, free)], rest[free])
        crossed = free & ((step < low) | (step > high))
        if not crossed.any():
            return step
        step = np.clip(step, low, high)
        free &= ~crossed


def move(parameters, step, lower, upper):
    """Return the parameters after a step."""
    result = parameters.copy()
    for i in (AMPLITUDE, X, Y, BACKGROUND):
        result[i] = np.clip(parameters[i] + step[i], lower[i], upper[i])
    _, _, _, p, s, q, _ = step
    axes = axes_of(parameters)
    curvatures, directions = np.linalg.eigh(axes.T @ [[1 + p, s], [s, 1 + q]] @ axes)
    result[[SIGMA_A, SIGMA_B]] = np.clip(curvatures**-0.5, lower[SIGMA_A], upper[SIGMA_A])
    result[THETA] = np.arctan2(-directions[1, 0], directions[0, 0])
    return result


def one_step(window, start, lower, upper, radius=np.inf, fixed_shape=False):
    """Return the parameters of one window after one damped Gauss-Newton step from the start, canonical."""
    pixels = pixels_of(window, radius)
    x, y, values = pixels
    point = project(start, pixels, lower, upper)
    by = jacobian(point, x, y)
    residual = values - evaluate(point, x, y)
    hessian = by.T @ by
    matrix = hessian + DAMPING * np.diag(np.diag(hessian))
    step = solve_bounded(matrix, by.T @ residual, *limits(point, lower, upper, fixed_shape))
    trial = project(move(point, step, lower, upper), pixels, lower, upper)
    better = np.sum((values - evaluate(trial, x, y)) ** 2) <= np.sum(residual**2)
    return canonical(trial if better else point)


def placed(parameters, shape=SHAPE):
    """Return parameters whose x and y count from the first pixel."""
    return parameters + np.array([0, shape[1] // 2, shape[0] // 2, 0, 0, 0, 0])


def noisy_windows(shape=SHAPE, n=20):
    """Windows (n, h, w) with columns about the truth."""
    rng = np.random.default_rng(5)
    truths = placed(TRUTH, shape) + rng.normal(0, [5, 0.5, 0.5, 0.2, 0.2, 0.2, 3], (n, 7))
    return rng.poisson(gaussian_image(truths, shape)).astype(np.float32)


def assert_equal(found, expected):
    turned = (found[:, THETA] - expected[:, THETA] + np.pi / 2) % np.pi - np.pi / 2
    assert np.abs(found[:, [X, Y]] - expected[:, [X, Y]]).max() <= POSITION_PX
    assert np.abs(found[:, [SIGMA_A, SIGMA_B]] - expected[:, [SIGMA_A, SIGMA_B]]).max() <= SIGMA_PX
    assert np.abs(turned).max() <= THETA_RAD
    counts = found[:, [AMPLITUDE, BACKGROUND]] - expected[:, [AMPLITUDE, BACKGROUND]]
    assert np.abs(counts).max() <= RELATIVE * TRUTH[AMPLITUDE]


@pytest.mark.parametrize(
    ("shape", "bounds", "options"),
    [
        (SHAPE, {}, {}),
        (WIDE, {}, {}),
        (SHAPE, {}, {"radius": 9.3}),
        (SHAPE, {}, {"fixed_shape": True}),
        (SHAPE, {AMPLITUDE: (0, 85)}, {}),
        (SHAPE, {X: (-6, 0.2), Y: (-0.1, 0.1)}, {}),
        (SHAPE, {BACKGROUND: (0, 50)}, {}),
    ],
    ids=["free", "wide", "disc", "fixed shape", "amplitude bound", "position bounds", "background bound"],
)
def test_the_compiled_step_is_the_reference_step(shape, bounds, options):
    lower, upper = LOWER.copy(), UPPER.copy()
    for i, pair in bounds.items():
        lower[i], upper[i] = pair
    windows = noisy_windows(shape)
    start, lower, upper = (placed(values, shape) for values in (np.clip(START, lower, upper), lower, upper))
    radius, fixed_shape = options.get("radius", np.inf), options.get("fixed_shape", False)
    fits = fit_gaussians(windows, start, lower, upper, max_iterations=1, radius_px=radius, fixed_shape=fixed_shape)
    assert (fits.status == Outcome.ITERATION_LIMIT).all()
    assert (fits.n_iterations == 2).all(), "the start, and what one step made of it"
    assert_equal(fits.estimates, np.stack([one_step(w, start, lower, upper, **options) for w in windows]))
    assert np.abs(fits.estimates[:, [X, Y]] - start[[X, Y]]).max() > 0.05, "it has moved"


def test_before_the_first_step_amplitude_and_background_are_the_best_ones():
    windows = noisy_windows()
    start, lower, upper = map(placed, (START, LOWER, UPPER))
    fits = fit_gaussians(windows, start, lower, upper, max_iterations=0)
    expected = np.stack([project(start, pixels_of(window, np.inf), lower, upper) for window in windows])
    assert (fits.n_iterations == 1).all()
    assert_equal(fits.estimates, canonical(expected))
