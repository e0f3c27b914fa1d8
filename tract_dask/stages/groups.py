"""Groups of columns that touch, which are fitted together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..kernels.gaussian.joint import MOST_MEMBERS
from ..kernels.gaussian.parameters import SIGMA_A, SIGMA_B, X, Y

TOUCHING = 4.0
"""Columns nearer than so many of their sigmas, after the blur, touch: a neighbour that is left out pulls."""
JOINED = 3.2
"""Nearer than this they are fitted together, unless each has a neighbour that is much nearer. Farther neighbours are
held where they were fitted last."""
INSEPARABLE = 2.4
"""Nearer than this they are fitted together in any case."""
UNRESOLVED = 0.25
"""Error of a position in one frame, over the distance, from which columns cannot be told apart."""
_MUCH_NEARER = 1.25
"""Ratio of the distances."""


def groups_of(columns: NDArray[np.float64], most: int = MOST_MEMBERS) -> NDArray[np.int64]:
    """Return the number of each column's group, from 1 on; 0 for a column that touches no other.

    Columns of one group are connected by pairs nearer than :data:`JOINED` that are not much farther apart than each
    of them is from its nearest neighbour: the dumbbells of a crystal are not joined to each other. A group of more than
    ``most`` is cut where its members are farthest apart: nearest pairs are joined first, as long as the group stays
    small enough. A column that touches others, and is joined to none of them, is a group by itself.

    Parameters
    ----------
    columns
        (n, 7) of Equation 1, after the blur of the windows that are fitted; NaN where a column is not known.

    Examples
    --------
    >>> places = np.array([[0.0, 0.0], [9.0, 0.0], [40.0, 0.0]])
    >>> columns = np.ones((3, 7)) * 3
    >>> columns[:, [1, 2]] = places
    >>> groups_of(columns).tolist()
    [1, 1, 0]
    """
    numbers = np.zeros(len(columns), np.int64)
    first, second, apart = touching(columns)
    nearest = np.full(len(columns), np.inf)
    for side in (first, second):
        np.minimum.at(nearest, side, apart)
    allowed = (apart < JOINED) & (apart < _MUCH_NEARER * np.minimum(nearest[first], nearest[second]))
    allowed |= apart < INSEPARABLE
    leader = np.arange(len(columns))
    size = np.ones(len(columns), np.int64)

    def find(k: int) -> int:
        while leader[k] != k:
            leader[k] = k = int(leader[leader[k]])
        return k

    for pair in np.argsort(apart, kind="stable"):
        one, other = sorted((find(int(first[pair])), find(int(second[pair]))))
        if allowed[pair] and one != other and size[one] + size[other] <= most:
            leader[other] = one
            size[one] += size[other]
    for k in np.unique(np.concatenate([first, second])).astype(int).tolist():
        numbers[k] = find(k) + 1
    _, compact = np.unique(numbers[numbers > 0], return_inverse=True)
    numbers[numbers > 0] = compact + 1
    return numbers


def touching(columns: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the pairs of columns (n, 7) that touch, and how far they are apart, in their sigmas."""
    known = np.flatnonzero(np.isfinite(columns[:, [X, Y, SIGMA_A, SIGMA_B]]).all(axis=1))
    if len(known) < 2:
        none = np.empty(0, np.int64)
        return none, none, np.empty(0)
    from scipy.spatial import cKDTree  # takes its time, and workers do not need it

    places, widest = columns[known][:, [X, Y]], columns[known, SIGMA_A]
    pairs = cKDTree(places).query_pairs(TOUCHING * float(np.quantile(widest, 0.99)), output_type="ndarray")
    one, other = pairs.astype(np.int64).T
    away = places[one] - places[other]
    distance = np.hypot(*away.T)
    apart = distance / (0.5 * (_reach(columns[known[one]], away) + _reach(columns[known[other]], away)))
    near = apart < TOUCHING
    return known[one[near]], known[other[near]], np.asarray(apart[near])


def _reach(columns: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return sigma of columns (n, 7) in a direction (n, 2) of (x, y), px."""
    theta = columns[:, 5]
    length = np.maximum(np.hypot(*along.T), 1e-12)
    x, y = along.T / length
    major, minor = x * np.cos(theta) - y * np.sin(theta), x * np.sin(theta) + y * np.cos(theta)
    return np.asarray(np.hypot(columns[:, SIGMA_A] * major, columns[:, SIGMA_B] * minor))
