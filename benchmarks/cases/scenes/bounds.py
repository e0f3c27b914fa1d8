"""Cramer-Rao bounds of a column's place, alone and beside another: ``python -m benchmarks.cases.scenes.bounds``.

Pixels count by Poisson's law in a round window; shapes are known, heights and one background are not. What the tracks
scatter by is compared with these; no unbiased fit of one frame does better.
"""

from __future__ import annotations

import numpy as np

from ..common import Floats

STEP = 1e-5
"""Of the differences that stand for derivatives."""


def bound(
    amplitude: float, sigma: float, background: float, window: int, separation: float = 0.0
) -> tuple[float, float]:
    """Return the bounds along and across, px, of one column, or of one of two equal ones along x."""
    model, truth = _model(sigma, window, separation), _truth(amplitude, background, separation)
    slopes = []
    for k in range(truth.size):
        change = np.zeros_like(truth)
        change[k] = STEP
        slopes.append((model(truth + change) - model(truth - change)) / (2 * STEP))
    jacobian = np.array(slopes)
    covariance = np.linalg.inv((jacobian / model(truth)) @ jacobian.T)
    return float(np.sqrt(covariance[1, 1])), float(np.sqrt(covariance[2, 2]))


def _truth(amplitude: float, background: float, separation: float) -> Floats:
    """Return height, x and y of each column, and the background; the first column is at the left."""
    if not separation:
        return np.array([amplitude, 0.21, -0.13, background])
    return np.array([amplitude, -separation / 2, 0.0, amplitude, separation / 2, 0.0, background])


def _model(sigma: float, window: int, separation: float) -> _Model:
    return _Model(sigma, window, 2 if separation else 1)


class _Model:
    """The expected counts in the pixels of a round window."""

    def __init__(self, sigma: float, window: int, columns: int) -> None:
        half = window // 2
        y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
        inside = np.hypot(x, y) <= window / 2
        self.x, self.y, self.sigma, self.columns = x[inside], y[inside], sigma, columns

    def __call__(self, parameters: Floats) -> Floats:
        counts = np.full(self.x.shape, parameters[-1])
        for k in range(self.columns):
            height, x, y = parameters[3 * k : 3 * k + 3]
            counts += height * np.exp(-((self.x - x) ** 2 + (self.y - y) ** 2) / (2 * self.sigma**2))
        return counts


def main() -> None:
    """Print the bounds of pairs by their distance, and of one column by its window."""
    sigma = 5.0
    print("two columns (contrast 0.45, 6 counts), sigmas apart: along, across (px); alone in the same window")
    for apart in (0.8, 1.2, 1.6, 2.0, 2.5, 3.0, 3.5):
        along, across = bound(0.45 * 6, sigma, 6.0, 61, apart * sigma)
        print(f"{apart:>4}: {along:.3f} {across:.3f}; {bound(0.45 * 6, sigma, 6.0, 61)[0]:.3f}")
    print("one column (contrast 0.45, 3.2 counts) by its window, px: bound (px)")
    for window in (13, 17, 21, 25, 31, 41):
        print(f"{window:>4}: {bound(0.45 * 3.2, sigma, 3.2, window)[0]:.3f}")


if __name__ == "__main__":
    main()
