"""Columns that touch: which of them are fitted together, and their joint fits on the summed image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.parameters import SIGMA_A, SIGMA_B, X, Y
from ...settings.run import ColumnSettings
from ..groups import groups_of
from .group_fits import Summed, fit_touching
from .relief import damping
from .scene import Scene
from .singles import SIGNIFICANT, Fits, Seeds, fitted_alone
from .twins import twins_of
from .window_size import neighbour_distance

Floats = NDArray[np.float64]

_SAME = 1.2
"""Columns nearer than so many sigmas are the same one, found twice."""


@dataclass(frozen=True)
class Grouped:
    """Columns with their groups: seeds, the distance of blobs, fits, and (n,) the group of each column; 0: alone."""

    seeds: Seeds
    spacing: float
    fits: Fits
    groups: NDArray[np.int64]


def grouped(
    scene: Scene, settings: ColumnSettings, seeds: Seeds, spacing: float, fits: Fits, window_px: int | None
) -> Grouped:
    """Return the columns with their groups; touching ones are fitted together, in windows that suit their groups.

    Where no columns touch, their fits are as they were.

    Parameters
    ----------
    spacing, fits
        Distance of the columns, px, and their fits, each alone.
    window_px
        As it was given; None: half the distance of blobs.
    """
    columns = _without_twins(fits, spacing)
    groups = groups_of(_narrow(columns))
    if not groups.any():
        return Grouped(seeds, spacing, fits, groups)
    places = fits.places.copy()
    places[groups > 0] = columns[groups > 0][:, [X, Y]]
    here = replace(seeds, places=places)
    spacing = _of_blobs(places, groups) or spacing
    alone = fitted_alone(scene, settings, here, spacing, window_px, blur_sigma_px=fits.blur_sigma_px)
    joint, status = alone.fit.copy(), alone.status.copy()
    inside = np.isfinite(alone.fit[:, X]) | (groups > 0)
    joint[groups > 0] = columns[groups > 0]
    groups = np.where(inside, groups, 0)
    weakest = SIGNIFICANT * scene.noise * damping(fits.blur_sigma_px)
    summed = Summed(scene.counts, scene.known, fits.blur_sigma_px, scene.sign, weakest)
    fit_touching(summed, joint, status, groups, alone.window_px)
    final = np.where(groups > 0, groups_of(np.where((groups > 0)[:, None], joint, np.nan)), 0)
    kept = final > 0
    whole_fit, flags = np.where(kept[:, None], joint, alone.fit), np.where(kept, status, alone.status)
    return Grouped(here, spacing, replace(alone, fit=whole_fit, status=flags.astype(np.uint8)), final)


def _narrow(columns: Floats) -> Floats:
    """Return columns as wide as they are narrow: a blob of two is long, but its columns are not."""
    narrow = columns.copy()
    narrow[:, SIGMA_A] = narrow[:, SIGMA_B]
    return narrow


def _without_twins(fits: Fits, spacing: float) -> Floats:
    """Return the fits without those of columns that were found twice."""
    columns = fits.fit.copy()
    known = np.flatnonzero(np.isfinite(columns).all(axis=1))
    if len(known):
        sigma = float(np.median(columns[known, SIGMA_B]))
        twins = twins_of(columns[known][:, [X, Y]], min(_SAME * sigma, spacing / 3))
        columns[known[list(twins)]] = np.nan
    return columns


def _of_blobs(places: Floats, groups: NDArray[np.int64]) -> float | None:
    """Return the median distance of blobs: groups, and columns that touch no other."""
    centres = [places[groups == number].mean(axis=0) for number in np.unique(groups[groups > 0])]
    return neighbour_distance(np.concatenate([places[groups == 0], centres]))


def same_column_px(places: Floats, groups: NDArray[np.int64], usual: float) -> float:
    """Return within what distance two places are the same column: the usual, but less than members are apart."""
    nearest = usual
    for number in np.unique(groups[groups > 0]):
        members = places[groups == number]
        apart = np.hypot(*(members[:, None] - members[None]).transpose(2, 0, 1))
        nearest = min(nearest, 0.8 * float(np.min(apart, initial=np.inf, where=~np.eye(len(members), dtype=bool))))
    return nearest
