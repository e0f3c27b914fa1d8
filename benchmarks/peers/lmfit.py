"""lmfit: a Model of Equation 1, with bounds as lmfit does them (by transforming the parameters), leastsq."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import lmfit
import numpy as np

from benchmarks.peers.protocol import Floats, Found, Task, equation_1, serve


def column(  # lmfit reads the names of the parameters
    x: Floats,
    y: Floats,
    amplitude: float,
    x0: float,
    y0: float,
    sigma_a: float,
    sigma_b: float,
    theta: float,
    background: float,
) -> Floats:
    return equation_1(np.array([amplitude, x0, y0, sigma_a, sigma_b, theta, background]), x, y)


def prepare(task: Task) -> Callable[[], Found]:
    x, y = task.grid
    pixels = task.windows.reshape(len(task.windows), -1).astype(np.float64)
    model = lmfit.Model(column, independent_vars=["x", "y"])

    def parameters(number: int) -> Any:
        bounded = lmfit.Parameters()
        for name, value, low, high in zip(
            model.param_names, task.start[number], task.lower[number], task.upper[number], strict=True
        ):
            bounded.add(name, value, min=low, max=high)
        return bounded

    def work() -> Found:
        centres, fine = np.empty((len(pixels), 2)), np.empty(len(pixels), np.bool_)
        for number, counts in enumerate(pixels):
            fit = model.fit(counts, parameters(number), x=x, y=y, calc_covar=False)
            centres[number], fine[number] = (fit.params["x0"].value, fit.params["y0"].value), fit.success
        return Found(centres, fine)

    return work


if __name__ == "__main__":
    serve({"leastsq": prepare})
