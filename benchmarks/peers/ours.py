"""This project: bounded fits of all seven parameters, with standard errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from benchmarks.peers.protocol import Found, Task, serve
from tract_dask.kernels.gaussian.fit import fit_gaussians

TOLERANCE_PX = 1e-4


def method(estimator: Literal["lsq", "poisson"]) -> Callable[[Task], Callable[[], Found]]:
    def prepare(task: Task) -> Callable[[], Found]:
        def work() -> Found:
            fits = fit_gaussians(
                task.windows, task.start, task.lower, task.upper, estimator=estimator, tolerance_px=TOLERANCE_PX
            )
            return Found(fits.estimates[:, 1:3], fits.converged)

        return work

    return prepare


if __name__ == "__main__":
    serve({"lsq": method("lsq"), "poisson": method("poisson")})
