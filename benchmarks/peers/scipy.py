"""scipy: least_squares by trust regions within bounds, with the analytic derivatives of Equation 1."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from benchmarks.peers.protocol import Floats, Found, Task, equation_1, serve, slopes_1

_INSIDE = 1e-9
"""Start values have to lie inside the bounds, by this."""


def prepare(task: Task) -> Callable[[], Found]:
    x, y = task.grid
    pixels = task.windows.reshape(len(task.windows), -1).astype(np.float64)
    start = np.clip(task.start, task.lower + _INSIDE, task.upper - _INSIDE)

    def slopes(parameters: Floats) -> Floats:
        return slopes_1(parameters, x, y)

    def work() -> Found:
        centres, fine = np.empty((len(pixels), 2)), np.empty(len(pixels), np.bool_)
        for number, counts in enumerate(pixels):

            def residuals(parameters: Floats, counts: Floats = counts) -> Floats:
                return equation_1(parameters, x, y) - counts

            fit = least_squares(
                residuals,
                start[number],
                jac=slopes,
                bounds=(task.lower[number], task.upper[number]),
                method="trf",
                x_scale="jac",
            )
            centres[number], fine[number] = fit.x[1:3], fit.success
        return Found(centres, fine)

    return work


def pairs(task: Task) -> Callable[[], Found]:
    """Two columns of known shapes and their background: seven free parameters, as many as of one column."""
    x, y = task.grid
    pixels = task.windows.reshape(len(task.windows), -1).astype(np.float64)
    lower, upper = (_free(bound) for bound in (task.lower, task.upper))
    start = np.clip(_free(task.start), lower + _INSIDE, upper - _INSIDE)

    def columns(number: int, free: Floats) -> Floats:
        both: Floats = task.start[number].copy()
        both[:, :3], both[:, 6] = free[:6].reshape(2, 3), (free[6], 0.0)
        return both

    def work() -> Found:
        centres, fine = np.empty((len(pixels), 2, 2)), np.empty(len(pixels), np.bool_)
        for number, counts in enumerate(pixels):

            def residuals(free: Floats, number: int = number, counts: Floats = counts) -> Floats:
                first, second = (equation_1(column, x, y) for column in columns(number, free))
                return first + second - counts

            def slopes(free: Floats, number: int = number) -> Floats:
                parts = [slopes_1(column, x, y)[:, :3] for column in columns(number, free)]
                return np.column_stack([*parts, np.ones(len(x))])

            bounds = lower[number], upper[number]
            fit = least_squares(residuals, start[number], jac=slopes, bounds=bounds, method="trf", x_scale="jac")
            centres[number], fine[number] = fit.x[:6].reshape(2, 3)[:, 1:], fit.success
        return Found(centres, fine)

    return work


def _free(both: Floats) -> Floats:
    """Return amplitude, x, y of both members of pairs (n, 2, 7), and the background."""
    return np.column_stack([both[:, 0, :3], both[:, 1, :3], both[:, 0, 6]])


if __name__ == "__main__":
    serve({"trf": prepare, "pairs": pairs})
