"""Places that are the same column, found in a time that does not grow with how many of them fall together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_LEAST_PX = 1e-4
"""What is nearer is the same place."""


def twins_of(places: NDArray[np.float64], distance: float) -> dict[int, int]:
    """Return which places to drop, each with the one that stands for it: the first within ``distance`` that is kept.

    Kept ones are farther apart than ``distance``, so a cell of that size holds a few of them, however many places do.
    """
    if not len(places):
        return {}
    distance = max(distance, _LEAST_PX)
    cells = np.floor((places - places.min(axis=0)) / distance).astype(np.int64)
    size = int(cells[:, 1].max()) + 3
    numbers = (cells[:, 0] + 1) * size + cells[:, 1] + 1
    known, cell, count = np.unique(numbers, return_inverse=True, return_counts=True)
    around = [dx * size + dy for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
    crowded = count[cell] > 1
    for step in around:
        if step:
            at = np.searchsorted(known, numbers + step)
            crowded |= known[np.minimum(at, len(known) - 1)] == numbers + step
    twins: dict[int, int] = {}
    kept: dict[int, list[tuple[int, float, float]]] = {}
    for place in np.flatnonzero(crowded).tolist():
        x, y = places[place].tolist()
        number = int(numbers[place])
        near = [
            first
            for step in around
            for first, u, v in kept.get(number + step, ())
            if (u - x) ** 2 + (v - y) ** 2 <= distance**2
        ]
        if near:
            twins[place] = min(near)
        else:
            kept.setdefault(number, []).append((place, x, y))
    return twins
