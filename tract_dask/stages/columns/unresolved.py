"""Touching columns that one frame cannot tell apart: found by what the noise of a frame allows, and made one column."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.information import group_slopes
from ...kernels.gaussian.model import blurred
from ...kernels.gaussian.parameters import AMPLITUDE, SIGMA_A, SIGMA_B, THETA, X, Y
from ...kernels.windows import blur_variance
from ..groups import UNRESOLVED

Floats = NDArray[np.float64]

_UNKNOWN = 1e200
"""Variance of a place, px^2, of what has no amplitude."""


def blind_pairs(
    fit: Floats, groups: NDArray[np.int64], noise: float, window_px: int, blur_sigma_px: float
) -> list[tuple[int, int]]:
    """Return the pairs of a group's members whose distance is less than four errors of a position in one frame.

    The errors are the least that white noise allows (Cramér and Rao) where all members are fitted together, along the
    line from one to the other.

    Parameters
    ----------
    fit
        (n, 7) of Equation 1 after the blur.
    groups
        (n,) number of each column's group; 0: alone.
    noise
        Standard deviation of a pixel of a frame.
    window_px
        Diameter of a member's window.
    blur_sigma_px
        Blur of the windows.
    """
    narrow = blurred(fit, -blur_variance(blur_sigma_px))
    pairs = []
    for number in np.unique(groups[groups > 0]):
        members = np.flatnonzero((groups == number) & np.isfinite(narrow).all(axis=1))
        if len(members) > 1:
            covariance = noise**2 * _covariance(narrow[members], window_px)
            pairs += [(int(members[one]), int(members[other])) for one, other in _blind(narrow[members], covariance)]
    return pairs


def _covariance(group: Floats, window_px: int) -> Floats:
    """Return (members, 2, 2) of x and y for noise of size 1: shapes are known, and the background is shared."""
    reach = window_px / 2
    low, high = group[:, [X, Y]].min(axis=0) - reach, group[:, [X, Y]].max(axis=0) + reach
    along = (np.arange(np.floor(first), last + 1) for first, last in zip(low, high, strict=True))
    x, y = (values.ravel() for values in np.meshgrid(*along))
    near = np.any([np.hypot(x - c[X], y - c[Y]) <= reach for c in group], axis=0)
    _, every = group_slopes(group, x[near], y[near])
    scale = np.maximum(np.sqrt((every**2).sum(axis=1)), np.finfo(float).tiny)
    inverse = np.linalg.pinv((every / scale[:, None]) @ (every / scale[:, None]).T, hermitian=True)
    with np.errstate(all="ignore"):
        inverse /= np.outer(scale, scale)
    found = np.stack([inverse[3 * k : 3 * k + 2, 3 * k : 3 * k + 2] for k in range(len(group))])
    found[group[:, AMPLITUDE] == 0] = _UNKNOWN * np.eye(2)
    return found


def _blind(group: Floats, covariance: Floats) -> list[tuple[int, int]]:
    found = []
    for one in range(len(group)):
        for other in range(one + 1, len(group)):
            away = group[other, [X, Y]] - group[one, [X, Y]]
            distance = max(float(np.hypot(*away)), 1e-9)
            along = away / distance
            error = np.sqrt(max(along @ covariance[k] @ along for k in (one, other)))
            if error > UNRESOLVED * distance:
                found.append((one, other))
    return found


def merged(fit: Floats, pairs: list[tuple[int, int]]) -> tuple[Floats, NDArray[np.int64], NDArray[np.bool_]]:
    """Return columns (m, 7) with one in place of those that pairs connect, the first of each, and which ones are such.

    The one has the centroid and the second moments of what it stands in for.
    """
    leader = np.arange(len(fit))
    for one, other in pairs:
        leader[leader == leader[other]] = leader[one]
    first = np.array([int(np.flatnonzero(leader == number)[0]) for number in dict.fromkeys(leader.tolist())])
    columns, several = fit[first].copy(), np.zeros(len(first), np.bool_)
    for k, member in enumerate(first):
        own = fit[leader == leader[member]]
        if len(own) > 1:
            several[k] = True
            columns[k] = _one_for(own)
    return columns, first, several


def _one_for(own: Floats) -> Floats:
    """Return one column with the volume, the centroid and the second moments of several."""
    volume = own[:, AMPLITUDE] * own[:, SIGMA_A] * own[:, SIGMA_B]
    share = volume / volume.sum() if volume.any() else np.full(len(own), 1 / len(own))
    centre = share @ own[:, [X, Y]]
    turn = np.stack([np.cos(own[:, THETA]), -np.sin(own[:, THETA])], axis=-1)
    across = np.stack([-turn[:, 1], turn[:, 0]], axis=-1)
    away = own[:, [X, Y]] - centre
    moments = sum(
        part * (a**2 * np.outer(u, u) + b**2 * np.outer(v, v) + np.outer(d, d))
        for part, a, b, u, v, d in zip(share, own[:, SIGMA_A], own[:, SIGMA_B], turn, across, away, strict=True)
    )
    values, axes = np.linalg.eigh(np.asarray(moments))
    column = own[0].copy()
    column[[X, Y]] = centre
    column[SIGMA_A], column[SIGMA_B] = np.sqrt(values[::-1])
    column[THETA] = -np.arctan2(axes[1, 1], axes[0, 1])
    column[AMPLITUDE] = volume.sum() / (column[SIGMA_A] * column[SIGMA_B])
    return np.asarray(column)
