"""The lattice that a set of places belongs to: its vectors, the number of each place's site, a least-squares fit."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts load on use: workers need few of them
from numpy.typing import NDArray

from ..errors import SettingsError
from ..kernels.gaussian.intensity import Floats

Mask = NDArray[np.bool_]

_NEIGHBOURS = 12
_ALIKE = 0.15
"""Differences of places that agree to so much of the spacing are the same vector."""
_ON_SITE = 0.3
"""A column within so much of the spacing of a site that its neighbours predict is on that site."""
_FREQUENT = 0.6
"""Share of the most frequent difference's count from which on a difference may be a vector of the lattice."""
_OUTLIER = 4.0
_FEWEST = 4


@dataclass(frozen=True)
class Sites:
    """A fitted lattice.

    Attributes
    ----------
    vectors, stderr
        (2, 2): its vectors a and b, and their standard errors.
    index
        (n, 2) number of each place's site along a and b.
    site
        (n, 2) the sites; NaN where there is no place.
    fitted
        (n) the places that counted in the fit.
    """

    vectors: Floats
    stderr: Floats
    index: NDArray[np.int64]
    site: Floats
    fitted: Mask


def fit_sites(places: Floats, kinds: NDArray[Any], chosen: Mask) -> Sites:
    """Fit site = origin of its kind + i a + j b to places, by least squares without outliers.

    Parameters
    ----------
    places
        (n, 2); NaN where there is none.
    kinds
        (n) sublattice of each place.
    chosen
        (n) places that the fit may use. The others are counted to their nearest sites.

    Raises
    ------
    SettingsError
        Where too few places are left, or they lie on a line.
    """
    known = np.isfinite(places).all(axis=1)
    use = chosen & known
    names, number = np.unique(kinds, return_inverse=True)
    largest = int(np.bincount(number[use], minlength=len(names)).argmax())
    basis = find_basis(places[use & (number == largest)])
    index = np.zeros((len(places), 2), dtype=np.int64)
    reached = np.zeros(len(places), dtype=bool)
    for kind in range(len(names)):
        some = np.flatnonzero(use & (number == kind))
        index[some], reached[some] = number_sites(places[some], basis)
    fitted = use & reached
    solution, covariance = np.zeros((len(names) + 2, 2)), np.zeros((len(names) + 2,) * 2)
    for _ in range(20):
        solution, covariance = _solve(places, number, index, fitted, len(names))
        origins, basis = solution[:-2], solution[-2:]
        free = known & ~(use & reached)
        steps = (places[free] - origins[number[free]]) @ np.linalg.inv(basis)
        index[free] = np.rint(np.nan_to_num(steps)).astype(np.int64)
        away = np.hypot(*(places - origins[number] - index @ basis).T)
        inside = use & reached & (away <= _OUTLIER * max(float(np.median(away[fitted])) / 1.1774, 1e-9))
        if (inside == fitted).all():
            break
        fitted = inside
    site = origins[number] + index @ basis  # NaN for a kind without fitted places
    site[~known] = np.nan
    residual = (places - site)[fitted]
    variance = (residual**2).sum(axis=0) / max(len(residual) - len(solution), 1)
    stderr = np.sqrt(np.diag(covariance)[-2:, None] * variance)
    return Sites(basis, stderr, index, site, fitted)


def find_basis(places: Floats) -> Floats:
    """Return the two shortest vectors (2, 2) by which many of the places differ from others.

    Each place is compared with its twelve nearest neighbours; differences that are frequent are the lattice's.

    Raises
    ------
    SettingsError
        Where there are fewer than four places, or none off a line.
    """
    if len(places) < _FEWEST:
        raise _no_lattice(f"{len(places)} columns")
    tree: Any = scipy.spatial.cKDTree(places)
    distance, neighbour = tree.query(places, min(_NEIGHBOURS, len(places) - 1) + 1)
    differences = (places[neighbour[:, 1:]] - places[:, None]).reshape(-1, 2)
    spacing = float(np.median(distance[:, 1]))
    tree = scipy.spatial.cKDTree(differences)
    near = tree.query_ball_point(differences, _ALIKE * spacing)
    count = np.array([len(others) for others in near])
    a = _shortest(differences, near, count)
    off = np.abs(differences[:, 0] * a[1] - differences[:, 1] * a[0]) > 0.3 * np.hypot(*a) * np.hypot(*differences.T)
    if not off.any():
        raise _no_lattice("columns on a line")
    b = _shortest(differences, near, np.where(off, count, 0))
    return np.array([a, b - a * np.rint(a @ b / (a @ a))])


def _shortest(differences: Floats, near: Any, count: NDArray[np.int64]) -> Floats:
    """Return the shortest of the frequent differences, averaged over those alike; one sign of it: down, or right."""
    frequent = np.flatnonzero(count >= _FREQUENT * count.max())
    length = np.hypot(*differences[frequent].T)
    vector = np.asarray(differences[near[frequent[length.argmin()]]].mean(axis=0))
    return -vector if tuple(np.round(vector / length.min(), 1) + 0.0) < (0.0, 0.0) else vector


def number_sites(places: Floats, basis: Floats) -> tuple[NDArray[np.int64], Mask]:
    """Return the numbers of the places along both vectors, and which of them were reached from their neighbours.

    It begins at the place in the middle. Neighbours are predicted from each other, so a slow distortion of the lattice
    does not confuse the numbers.
    """
    index, reached = np.zeros((len(places), 2), dtype=np.int64), np.zeros(len(places), dtype=bool)
    if not len(places):
        return index, reached
    tree: Any = scipy.spatial.cKDTree(places)
    steps = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)])
    limit = _ON_SITE * float(np.hypot(*basis.T).min())
    start = int(np.hypot(*(places - np.median(places, axis=0)).T).argmin())
    reached[start] = True
    queue = deque([start])
    while queue:
        here = queue.popleft()
        distance, found = tree.query(places[here] + steps @ basis, distance_upper_bound=limit)
        for step, other in zip(steps[np.isfinite(distance)], found[np.isfinite(distance)], strict=True):
            if not reached[other]:
                reached[other] = True
                index[other] = index[here] + step
                queue.append(int(other))
    return index, reached


def _solve(
    places: Floats, number: NDArray[np.int64], index: NDArray[np.int64], fitted: Mask, kinds: int
) -> tuple[Floats, Floats]:
    """Return the origins of all kinds, then a and b, (kinds + 2, 2), and the inverse of the normal matrix.

    The origin of a kind without fitted places is NaN.
    """
    present = np.bincount(number[fitted], minlength=kinds) > 0
    design = np.hstack([(number[fitted, None] == np.flatnonzero(present)).astype(float), index[fitted]])
    if fitted.sum() < _FEWEST or np.linalg.matrix_rank(design) < design.shape[1]:
        raise _no_lattice(f"{int(fitted.sum())} columns on sites, which do not span a plane")
    solution, covariance = np.full((kinds + 2, 2), np.nan), np.full((kinds + 2,) * 2, np.nan)
    rows = np.append(np.flatnonzero(present), [kinds, kinds + 1])
    solution[rows] = np.linalg.lstsq(design, places[fitted], rcond=None)[0]
    covariance[np.ix_(rows, rows)] = np.linalg.inv(design.T @ design)
    return solution, covariance


def _no_lattice(got: str) -> SettingsError:
    return SettingsError(
        "no lattice can be fitted to the columns",
        "lattice_displacement",
        f"{_FEWEST} columns or more that repeat along two directions",
        got,
        "Choose other columns to fit it to",
    )
