"""Columns that touch: those that were missed, which are fitted together, and their joint fits on the summed image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.model import blurred
from ...kernels.gaussian.parameters import SIGMA_A, SIGMA_B, X, Y
from ...kernels.windows import blur_variance
from ...settings.run import ColumnSettings
from ..groups import JOINED, groups_of
from .blobs import as_blobs, without_twins
from .group_fits import Summed, fit_touching
from .relief import damping
from .scene import Scene
from .singles import SIGNIFICANT, Fits, Seeds, fitted_alone
from .slopes import without_slopes
from .touching import touching_columns
from .trials import Image
from .unresolved import blind_pairs, merged
from .window_size import neighbour_distance

Floats = NDArray[np.float64]

_MOVED_PX = 1e-6


@dataclass(frozen=True)
class Grouped:
    """Columns with their groups.

    Attributes
    ----------
    seeds, spacing, fits
        Where they are, the distance of blobs, px, and their fits.
    groups, unresolved, half
        (n,) number of each column's group, 0: alone; whether one frame cannot tell it apart from another; and whether
        it was given without another one that it touches.
    """

    seeds: Seeds
    spacing: float
    fits: Fits
    groups: NDArray[np.int64]
    unresolved: NDArray[np.bool_]
    half: NDArray[np.bool_]


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
    were. Of those that one frame cannot tell apart one is left, a fit of both. Given columns (``seeds.fixed``) remain
    the only ones, and all of them.

    Parameters
    ----------
    spacing, fits
        Distance of the columns, px, and their fits, each alone.
    window_px
        As it was given; None: half the distance of blobs.
    crowded
        Columns of several sublattices are nearer to each other than lattice vectors are long.
    """
    more, own, columns = seeds, fits, without_twins(fits, spacing)
    known = np.isfinite(columns).all(axis=1)
    half = np.zeros(len(columns), np.bool_)
    several = half.copy() if seeds.unresolved is None else seeds.unresolved
    if known.any() and seeds.fixed:
        half = _halves(scene, spacing, fits, columns, seeds.places) & ~several
    elif known.any():
        lattice = next(iter(scene.lattices.values()), None)
        period = max(spacing, lattice.spacing) if lattice and not crowded else spacing
        if settings.method != "lattice":  # its sites are said, and those that are merged are named
            more, own = as_blobs(scene, settings, seeds, fits, period)
        columns, more, own = _with_missed(scene, more, spacing, period, own, without_twins(own, spacing))
    groups = groups_of(_narrow(columns))
    if not groups.any() and len(more.places) == len(seeds.places):
        none = np.zeros(len(seeds.places), np.int64)
        return Grouped(seeds, spacing, fits, none, several, half)
    fitted = partial(_fitted, scene, settings, spacing, window_px, fits.blur_sigma_px)
    found = fitted(more, own.places, columns, groups, several if seeds.fixed else np.zeros(len(columns), np.bool_))
    width = found.fits.window_px
    pairs = blind_pairs(found.fits.fit, found.groups, scene.frame_noise, width, fits.blur_sigma_px)
    if seeds.fixed:
        blind = np.isin(np.arange(len(columns)), np.array(pairs, np.int64))
        return replace(found, unresolved=blind | several, half=half)
    if not pairs:
        return found
    columns, first, several = merged(found.fits.fit, pairs)
    one = replace(more, kind=more.kind[first], number=more.number[first])
    places = np.where(several[:, None], columns[:, [X, Y]], found.fits.places[first])
    groups = np.where(several, 0, groups_of(_narrow(columns)))
    return fitted(one, places, columns, groups, several)


def _fitted(
    scene: Scene,
    settings: ColumnSettings,
    spacing: float,
    window_px: int | None,
    blur_sigma_px: float,
    seeds: Seeds,
    places: Floats,
    columns: Floats,
    groups: NDArray[np.int64],
    several: NDArray[np.bool_],
) -> Grouped:
    """Return fits of columns at places (n, 2), those of groups together; ``several``: which ones are more than one.

    ``columns`` (n, 7) is where joint fits start.
    """
    places = np.where((groups > 0)[:, None], columns[:, [X, Y]], places)
    here = replace(seeds, places=places, unresolved=several)
    spacing = _of_blobs(places, groups) or spacing
    alone = fitted_alone(scene, settings, here, spacing, window_px, blur_sigma_px=blur_sigma_px)
    joint, status = alone.fit.copy(), alone.status.copy()
    inside = np.isfinite(alone.fit[:, X]) | (groups > 0)
    joint[groups > 0] = columns[groups > 0]
    groups = np.where(inside, groups, 0)
    if groups.any():
        weakest = SIGNIFICANT * scene.noise * damping(blur_sigma_px)
        summed = Summed(scene.counts, scene.known, blur_sigma_px, scene.sign, weakest)
        fit_touching(summed, joint, status, groups, alone.window_px)
    final = np.where(groups > 0, groups_of(np.where((groups > 0)[:, None], joint, np.nan)), 0)
    kept = final > 0
    whole_fit, flags = np.where(kept[:, None], joint, alone.fit), np.where(kept, status, alone.status)
    return Grouped(
        here, spacing, replace(alone, fit=whole_fit, status=flags.astype(np.uint8)), final, several, several & False
    )


def _missed(
    scene: Scene, spacing: float, fits: Fits, columns: Floats, radius_px: float
) -> tuple[Floats, NDArray[np.int64]]:
    """Return what :func:`.touching.touching_columns` does, without the blur of the fits."""
    flat = without_slopes(scene.counts, columns, spacing)  # one side of a slope is no column
    image = Image(flat, scene.known, scene.noise, scene.sign)
    return touching_columns(image, blurred(columns, -blur_variance(fits.blur_sigma_px)), radius_px)


def _halves(scene: Scene, spacing: float, fits: Fits, columns: Floats, given: Floats) -> NDArray[np.bool_]:
    """Return which given columns (n, 7) touch one that was not given."""
    sigma = float(np.nanmedian(columns[:, SIGMA_B]))
    found, parent = _missed(scene, spacing, fits, columns, JOINED * sigma)
    half = np.zeros(len(columns), np.bool_)
    for new, own in zip(found[len(columns) :, [X, Y]], parent[len(columns) :], strict=True):
        others = np.delete(given, own, axis=0)
        half[own] |= not (np.hypot(*(others - new).T) < sigma).any()
    return half


def _with_missed(
    scene: Scene, seeds: Seeds, spacing: float, period: float, fits: Fits, columns: Floats
) -> tuple[Floats, Seeds, Fits]:
    """Return columns (n, 7), seeds and fits with the columns that were missed beside those that were found."""
    variance = blur_variance(fits.blur_sigma_px)
    found, parent = _missed(scene, spacing, fits, columns, period / 2)
    n, added = len(columns), len(found) - len(columns)
    if not added:
        return columns, seeds, fits
    changed = np.abs(found[:n, [X, Y]] - columns[:, [X, Y]]).max(axis=1) > _MOVED_PX
    whole = np.concatenate(
        [np.where(changed[:, None], blurred(found[:n], variance), columns), blurred(found[n:], variance)]
    )
    places = np.concatenate([fits.places, whole[n:, [X, Y]]])
    more = replace(seeds, places=places, kind=seeds.kind[parent], number=seeds.numbers_with(added))
    return whole, more, replace(fits, places=places)


def _narrow(columns: Floats) -> Floats:
    """Return columns as wide as they are narrow: a blob of two is long, but its columns are not."""
    narrow = columns.copy()
    narrow[:, SIGMA_A] = narrow[:, SIGMA_B]
    return narrow


def _of_blobs(places: Floats, groups: NDArray[np.int64]) -> float | None:
    """Return the median distance of blobs: groups, and columns that touch no other."""
    centres = [places[groups == number].mean(axis=0) for number in np.unique(groups[groups > 0])]
    return neighbour_distance(np.array([*places[groups == 0], *centres]))


def same_column_px(places: Floats, groups: NDArray[np.int64], usual: float) -> float:
    """Return within what distance two places are the same column: the usual, but less than members are apart."""
    nearest = usual
    for number in np.unique(groups[groups > 0]):
        members = places[groups == number]
        apart = np.hypot(*(members[:, None] - members[None]).transpose(2, 0, 1))
        nearest = min(nearest, 0.8 * float(np.min(apart, initial=np.inf, where=~np.eye(len(members), dtype=bool))))
    return nearest
