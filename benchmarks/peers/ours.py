"""This project: bounded fits of all seven parameters, with standard errors; of pairs, with known shapes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from benchmarks.peers.protocol import Found, Task, serve
from tract_dask.kernels.gaussian.fit import fit_gaussians
from tract_dask.kernels.gaussian.joint import fit_joint

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


def pairs(task: Task) -> Callable[[], Found]:
    masks = np.ones((1, *task.windows.shape[1:]), np.bool_)

    def work() -> Found:
        which = np.zeros(len(task.windows), np.int64)
        fits = fit_joint(task.windows, masks, which, task.start, task.lower, task.upper, tolerance_px=TOLERANCE_PX)
        return Found(fits.estimates[..., 1:3], fits.converged)

    return work


if __name__ == "__main__":
    serve({"lsq": method("lsq"), "poisson": method("poisson"), "pairs": pairs})
