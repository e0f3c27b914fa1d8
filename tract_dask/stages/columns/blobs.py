"""Blobs of touching columns: places that a method has found in one blob are one again, before it is told what it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.parameters import SIGMA_B, X, Y
from ...settings.run import ColumnSettings
from ..groups import JOINED
from .scene import Scene
from .singles import Fits, Seeds, fitted_alone
from .twins import twins_of

Floats = NDArray[np.float64]

_SAME = 1.2
"""Columns nearer than so many sigmas are the same one, found twice."""
_STAYS = 3.0
"""A fit of a blob as one column ends within this share of the blobs' period, or it has left the blob."""


def without_twins(fits: Fits, spacing: float) -> Floats:
    """Return the fits (n, 7) without those of columns that were found twice."""
    columns = fits.fit.copy()
    known = np.flatnonzero(np.isfinite(columns).all(axis=1))
    if len(known):
        sigma = float(np.median(columns[known, SIGMA_B]))
        twins = twins_of(columns[known][:, [X, Y]], min(_SAME * sigma, spacing / 3))
        columns[known[list(twins)]] = np.nan
    return columns


def as_blobs(scene: Scene, settings: ColumnSettings, seeds: Seeds, fits: Fits, period: float) -> tuple[Seeds, Fits]:
    """Return seeds and fits with one for those that touch, and are nearer than half the period of the blobs.

    Noise makes more than one maximum of a blob, and two columns may have one; the pixels tell which it is. What cannot
    be fitted as one, such as at the rim of the image, stays as it was.
    """
    known = np.asarray(np.isfinite(fits.fit).all(axis=1))
    if not known.any():
        return seeds, fits
    number = _clusters(fits.fit, known, min(JOINED * float(np.median(fits.fit[known, SIGMA_B])), period / 2))
    _, first, count = np.unique(number, return_index=True, return_counts=True)
    first = first[count > 1]
    if not len(first):
        return seeds, fits
    blobs = np.array([fits.fit[number == number[k]][:, [X, Y]].mean(axis=0) for k in first])
    some = replace(seeds, places=blobs, kind=seeds.kind[first], number=seeds.number[first])
    one = fitted_alone(scene, settings, some, period, None, blur_sigma_px=fits.blur_sigma_px)
    whole = np.hypot(*(one.fit[:, [X, Y]] - blobs).T) < period / _STAYS
    kept = np.asarray(np.isin(number, number[first[whole]], invert=True))
    kept[first] = True
    at = first[whole]
    places, fit, status, explained = fits.places.copy(), fits.fit.copy(), fits.status.copy(), fits.explained.copy()
    places[at], fit[at] = blobs[whole], one.fit[whole]
    status[at], explained[at] = one.status[whole], one.explained[whole]
    left = replace(seeds, places=places[kept], kind=seeds.kind[kept], number=seeds.number[kept])
    return left, replace(fits, places=places[kept], fit=fit[kept], status=status[kept], explained=explained[kept])


def _clusters(columns: Floats, known: NDArray[np.bool_], distance: float) -> NDArray[np.int64]:
    """Return the number of the cluster of each column: of those that are connected by so short distances."""
    from scipy.sparse import coo_matrix  # takes its time, and workers do not need it
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    numbers = np.flatnonzero(known)
    near = cKDTree(columns[numbers][:, [X, Y]]).query_pairs(distance, output_type="ndarray")
    one, other = numbers[near.astype(np.int64)].reshape(-1, 2).T
    links = coo_matrix((np.ones(len(one)), (one, other)), shape=(len(columns), len(columns)))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)
