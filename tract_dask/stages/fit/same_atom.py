"""Fits of two columns that lie on one atom: the column that is nearer to its own place has it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.parameters import SIGMA_A, SIGMA_B, X, Y

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_NEAREST, _OF_SEEDS, _SAME = 1.0, 0.4, 0.15
"""Two fits are of one atom where they are nearer than so many sigmas, and than this share of their places' distance; in
any case where they are nearer than 0.15 sigmas."""


class Pairs(NamedTuple):
    """Pairs of columns whose usual fits can come together.

    Attributes
    ----------
    first, second
        (pairs,) numbers of the columns.
    limit
        (pairs,) px: nearer to each other they are on one atom.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    limit: Floats

    @classmethod
    def of(cls, reference: Floats, reach: float) -> Pairs:
        """Return the pairs of columns (n, 7) whose fits stay within ``reach`` px of their places, along each axis."""
        places, sigma = reference[:, [Y, X]], np.sqrt(reference[:, SIGMA_A] * reference[:, SIGMA_B])
        if len(places) < 2:
            return cls(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))
        from scipy.spatial import cKDTree  # takes its time, and the start of a worker does not need it

        meet = 2 * np.sqrt(2) * reach + _NEAREST * float(sigma.max())
        first, second = cKDTree(places).query_pairs(meet, output_type="ndarray").astype(np.int64).T
        return cls(first, second, limits(places[first], places[second], sigma[first], sigma[second]))


def limits(first: Floats, second: Floats, one: Floats, other: Floats) -> Floats:
    """Return how near fits of columns with these places (n, 2) and sigmas (n,) may come, px."""
    apart = np.hypot(*(first - second).T)
    sigma = np.sqrt(one * other)
    return np.asarray(np.clip(_OF_SEEDS * apart, _SAME * sigma, _NEAREST * sigma))


def on_one_atom(estimates: Floats, home: Floats, good: Bools, pairs: Pairs) -> Bools:
    """Return the fits that lie on the atom of another column, which is nearer to its own place, (frames, columns).

    Parameters
    ----------
    estimates
        (frames, columns, 7) of Equation 1.
    home
        (frames, columns, 2) y and x of where they belong, in the same coordinates.
    good
        (frames, columns) accepted fits.
    """
    losers = np.zeros(good.shape, np.bool_)
    if not pairs.first.size:
        return losers
    place = estimates[..., [Y, X]]
    apart = np.hypot(*np.moveaxis(place[:, pairs.first] - place[:, pairs.second], -1, 0))
    frame, pair = np.nonzero(good[:, pairs.first] & good[:, pairs.second] & (apart < pairs.limit))
    first, second = pairs.first[pair], pairs.second[pair]
    away = [np.hypot(*(place[frame, which] - home[frame, which]).T) for which in (first, second)]
    losers[frame, np.where(away[0] > away[1], first, second)] = True
    return losers
