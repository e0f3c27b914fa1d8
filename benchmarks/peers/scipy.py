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


if __name__ == "__main__":
    serve({"trf": prepare})
