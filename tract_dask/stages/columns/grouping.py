"""Columns that touch: those that were missed, which are fitted together, and their joint fits on the summed image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.model import blurred
from ...kernels.gaussian.parameters import SIGMA_A, SIGMA_B, X, Y
from ...kernels.windows import blur_variance
from ...settings.run import ColumnSettings
from ..groups import groups_of
from .group_fits import Summed, fit_touching
from .relief import damping
from .scene import Scene
from .singles import SIGNIFICANT, Fits, Seeds, fitted_alone
from .slopes import without_slopes
from .touching import Image, touching_columns
from .twins import twins_of
from .window_size import neighbour_distance

Floats = NDArray[np.float64]

_MOVED_PX = 1e-6
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
    scene: Scene,
    settings: ColumnSettings,
    seeds: Seeds,
    spacing: float,
    fits: Fits,
    window_px: int | None,
    *,
    crowded: bool = False,
) -> Grouped:
    """Return the columns with their groups, and with those that were missed.

    Touching ones are fitted together, in windows that suit their groups. Where no columns touch, their fits are as they
    were. Given columns (``seeds.fixed``) remain the only ones.

    Parameters
    ----------
    spacing, fits
        Distance of the columns, px, and their fits, each alone.
    window_px
        As it was given; None: half the distance of blobs.
    crowded
        Columns of several sublattices are nearer to each other than lattice vectors are long.
    """
    columns = _without_twins(fits, spacing)
    if not seeds.fixed and np.isfinite(columns).all(axis=1).any():
        columns, more, more_fits = _with_missed(scene, seeds, spacing, fits, columns, crowded)
    else:
        more, more_fits = seeds, fits
    groups = groups_of(_narrow(columns))
    if not groups.any():
        return Grouped(seeds, spacing, fits, np.zeros(len(seeds.places), np.int64))
    seeds, fits = more, more_fits
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


def _with_missed(
    scene: Scene, seeds: Seeds, spacing: float, fits: Fits, columns: Floats, crowded: bool
) -> tuple[Floats, Seeds, Fits]:
    """Return columns (n, 7), seeds and fits with the columns that were missed beside those that were found."""
    variance = blur_variance(fits.blur_sigma_px)
    lattice = next(iter(scene.lattices.values()), None)
    cell = max(spacing, lattice.spacing) if lattice and not crowded else spacing
    flat = without_slopes(scene.counts, columns, spacing)  # one side of a slope is no column
    image = Image(flat, scene.known, scene.noise, scene.sign)
    found, parent = touching_columns(image, blurred(columns, -variance), cell / 2)
    n, added = len(columns), len(found) - len(columns)
    if not added:
        return columns, seeds, fits
    changed = np.abs(found[:n, [X, Y]] - columns[:, [X, Y]]).max(axis=1) > _MOVED_PX
    whole = np.concatenate(
        [np.where(changed[:, None], blurred(found[:n], variance), columns), blurred(found[n:], variance)]
    )
    number = np.concatenate([seeds.number, seeds.number.max(initial=0) + 1 + np.arange(added)])
    places = np.concatenate([fits.places, whole[n:, [X, Y]]])
    more = replace(seeds, places=places, kind=seeds.kind[parent], number=number)
    return whole, more, replace(fits, places=places)


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
