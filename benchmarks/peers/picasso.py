"""Picasso (picassosr): its rotated Gaussian, a port of Gpufit to numba; no bounds, no standard errors.

Its parameters are peak, x, y, sigma_x, sigma_y, background, angle. ``guess`` starts as everybody does, ``seeds`` from
its own moments, whose cost is counted. The sign of the angle does not matter, since everybody starts at zero.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from picasso.fitting import gaussfit, seeds

from benchmarks.peers.protocol import Found, Task, serve

TOLERANCE = 1e-5
MAX_ITERATIONS = 100


def method(*, likelihood: bool, own_seeds: bool) -> Callable[[Task], Callable[[], Found]]:
    def prepare(task: Task) -> Callable[[], Found]:
        start = task.start[:, [0, 1, 2, 3, 4, 6, 5]].astype(np.float32)

        def work() -> Found:
            side = task.windows.shape[1]
            first = seeds.initial_parameters_gauss(task.windows, side, rotated=True) if own_seeds else start
            fits, _, states, _ = gaussfit.fit_spots(
                gaussfit.ROTATED,
                task.windows,
                first,
                mle=likelihood,
                tolerance=TOLERANCE,
                max_iterations=MAX_ITERATIONS,
            )
            return Found(fits[:, 1:3].astype(np.float64), states == gaussfit.FIT_STATE_CONVERGED)

        return work

    return prepare


if __name__ == "__main__":
    serve(
        {
            "lsq guess": method(likelihood=False, own_seeds=False),
            "lsq seeds": method(likelihood=False, own_seeds=True),
            "poisson guess": method(likelihood=True, own_seeds=False),
            "poisson seeds": method(likelihood=True, own_seeds=True),
        }
    )
