"""Sublattices fainter than the strongest: columns that come back in every cell of the crystal."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...kernels.gaussian.parameters import AMPLITUDE, SIGMA_A, SIGMA_B
from ...settings.run import ColumnSettings
from ..groups import INSEPARABLE
from .lattice import TOLERANCE, Lattice, grown, peaks_of, start_of
from .relief import Places, Relief
from .scene import Scene
from .singles import Fits, Seeds, fitted_alone
from .window_size import default_window, neighbour_distance

_NEARER = 0.6
"""Columns of two sublattices may be nearer to each other than those of one, by this factor: they are looked for in an
image in which columns so near stand out."""
_MOST = 12
"""Sublattices that are looked for."""
_SHARE = 0.25
"""Share of the columns known before that a sublattice has at least."""
_FILLED = 0.6
"""Share of its sites, near its own columns, that a sublattice fills at least."""
_SCATTER = 0.5
"""Of the scatter that peaks strewn evenly have about a site: what columns have less of."""
_FOUND = 0.3
"""Columns nearer to what was left out than this share of its distance are those columns, found as touching ones."""
_LOWEST = 0.4
"""Peaks lower than this share of their neighbours do not belong to their sublattice."""
_NEAREST = 0.45
"""Of the distance of the columns known before: nearer than this, faint columns are not worth what the windows of the
others would lose (oxygen in ceria, at 0.42, is 0.1 to 0.2 of cerium)."""
_WINDOW_SIGMA, _WINDOW_SHARE = 3.5, 0.8
"""Diameter of windows, in sigmas and at most as a share of the distance: 1.75 sigma around a column known positions are
12 % worse than the best, a quarter of the distance (1.25 sigma where it is five) 48 %; neighbours five sigma away pull
by less than 1 % of a sigma."""


class Sublattice(NamedTuple):
    """Columns (n, 2) of (x, y), px, and (2,) where they are in the cell, in shares of a and b from a known column."""

    places: Places
    cell: tuple[float, float]


class LeftOut(NamedTuple):
    """A sublattice that was left out.

    Attributes
    ----------
    why
        ``near`` other columns, or ``faint``.
    distance_px
        To the nearest column.
    share
        Of the amplitude of the columns that were known; None: not fitted.
    """

    sublattice: Sublattice
    why: str
    distance_px: float
    share: float | None = None

    def said(self) -> dict[str, Any]:
        """Return it as a table that is ready for JSON."""
        kept = {"why": self.why, "number": len(self.sublattice.places), "cell": list(self.sublattice.cell)}
        return kept | {"distance_px": self.distance_px, "share": self.share}


class Extended(NamedTuple):
    """Columns with those of fainter sublattices: seeds, distance of neighbours, fits, and what was left out.

    ``window_px``, the diameter of windows, is as it was given where there is no fainter sublattice.
    """

    seeds: Seeds
    spacing: float
    fits: Fits
    left_out: list[LeftOut]
    window_px: int | None


def with_fainter(
    scene: Scene, settings: ColumnSettings, seeds: Seeds, spacing: float, fits: Fits, window_px: int | None
) -> Extended:
    """Return columns with those of fainter sublattices that stand out.

    A sublattice is left out where it is nearer to columns that are known than 0.45 of their distance, or than 2.4
    sigma. Of the others those are taken whose median amplitude reaches ``min_amplitude`` of the columns known before.

    Parameters
    ----------
    spacing, fits
        Distance of the columns, px, and their fits, each alone.
    """
    nothing = Extended(seeds, spacing, fits, [], window_px)
    lattice = scene.lattice(settings.spacing_px)
    good = fits.status == 0
    if lattice is None or not good.any():
        return nothing
    found = fainter_sublattices(scene.relief(_NEARER * lattice.spacing), lattice, fits.places)
    sigma = float(np.median(np.sqrt(fits.fit[good, SIGMA_A] * fits.fit[good, SIGMA_B])))
    usual = float(np.median(np.abs(fits.fit[good, AMPLITUDE])))
    least = max(INSEPARABLE * sigma, _NEAREST * spacing)
    left_out: list[LeftOut] = []
    kept: list[Sublattice] = []
    for one in found:
        distance = _distance(one, np.concatenate([fits.places, *(other.places for other in kept)]))
        if distance < least:
            left_out.append(LeftOut(one, "near", distance))
        else:
            kept.append(one)
    while kept:
        more = with_places(seeds, np.concatenate([one.places for one in kept]))
        apart = neighbour_distance(more.places) or spacing
        window = window_px or _window(apart, sigma)
        again = fitted_alone(scene, settings, more, apart, window)
        shares = [_share(again, part, usual) for part in _parts(len(seeds.places), kept)]
        if all(share >= settings.min_amplitude for share in shares):
            return Extended(more, apart, again, left_out, window)
        faint = [(one, share) for one, share in zip(kept, shares, strict=True) if share < settings.min_amplitude]
        left_out += [LeftOut(one, "faint", _distance(one, fits.places), share) for one, share in faint]
        kept = [one for one, share in zip(kept, shares, strict=True) if share >= settings.min_amplitude]
    return nothing._replace(left_out=left_out)


def told(left_out: list[LeftOut], places: Places) -> list[dict[str, Any]]:
    """Return what was left out and is none of the columns (n, 2) after all, as tables that are ready for JSON."""
    tree = cKDTree(places)
    return [
        one.said() for one in left_out if np.median(tree.query(one.sublattice.places)[0]) > _FOUND * one.distance_px
    ]


def fainter_sublattices(relief: Relief, lattice: Lattice, known: Places) -> list[Sublattice]:
    """Return the sublattices of peaks beside columns that are known, strongest first.

    Each is grown from the peak with the highest lattice neighbours, as the first one is
    (:func:`tract_dask.stages.columns.lattice.find_peaks`). It is one where it fills most of its sites near its own
    columns, has its place in the cell to better than peaks of noise have, and comes back in a quarter of the cells.

    Parameters
    ----------
    known
        (n, 2) of (x, y), px.
    """
    peaks, weights = peaks_of(relief, lattice.spacing)
    if not len(peaks) or not len(known):
        return []
    tree = cKDTree(known)
    left = np.where(tree.query(peaks)[0] > TOLERANCE * lattice.spacing, weights, 0.0)
    found = []
    for _ in range(_MOST):
        start, support = start_of(peaks, left, lattice)
        if support <= 0:
            break
        group = grown(peaks, left, lattice, start, _LOWEST * support, _LOWEST * support)
        left[group] = 0.0
        if one := _ordered(peaks[group], peaks[start], lattice, known, tree):
            found.append(one)
    return found


def _ordered(group: Places, start: Places, lattice: Lattice, known: Places, tree: cKDTree) -> Sublattice | None:
    """Return peaks as a sublattice; None where they are none: those about another place in the cell are left out."""
    basis = np.array([lattice.a, lattice.b])
    inverse = np.linalg.inv(basis)
    first = start - known[int(np.asarray(tree.query(start)[1]))]
    away = group - known[tree.query(group)[1]] - first
    away -= np.rint(away @ inverse) @ basis
    middle = np.median(away, axis=0)
    off = np.hypot(*(away - middle).T)
    same = off <= TOLERANCE * lattice.spacing
    uniform = TOLERANCE * lattice.spacing / np.sqrt(2)
    if same.sum() < max(4, _SHARE * len(known)) or np.median(off[same]) > _SCATTER * uniform:
        return None
    offset, own = first + middle, group[same]
    sites = known + offset
    mine = cKDTree(own)
    nearest = np.asarray(mine.query(sites)[0])
    around = nearest < 1.5 * np.hypot(*basis[1])
    if (nearest[around] <= TOLERANCE * lattice.spacing).mean() < _FILLED:
        return None
    cell = np.mod(offset @ inverse, 1.0)
    return Sublattice(own, (round(float(cell[0]), 3), round(float(cell[1]), 3)))


def with_places(seeds: Seeds, more: Places) -> Seeds:
    """Return seeds with more places (n, 2) of (x, y), px."""
    kind = np.concatenate([seeds.kind, np.full(len(more), "")])
    places = np.concatenate([seeds.places, more])
    return replace(seeds, places=places, kind=kind, number=seeds.numbers_with(len(more)))


def _parts(first: int, more: list[Sublattice]) -> list[slice]:
    ends = first + np.cumsum([0, *(len(one.places) for one in more)])
    return [slice(int(start), int(end)) for start, end in pairwise(ends)]


def _share(fits: Fits, part: slice, usual: float) -> float:
    """Return the median amplitude of a part of the columns, against the usual one."""
    amplitude: NDArray[np.float64] = np.abs(fits.fit[part, AMPLITUDE])
    return float(np.nanmedian(amplitude)) / usual if np.isfinite(amplitude).any() else 0.0


def _distance(one: Sublattice, places: Places) -> float:
    """Return the median distance of its columns to the nearest of places (n, 2), px."""
    return float(np.median(cKDTree(places).query(one.places)[0]))


def _window(apart: float, sigma: float) -> int:
    """Return the diameter of windows, px, odd."""
    return max(default_window(apart), 2 * int(min(_WINDOW_SIGMA * sigma, _WINDOW_SHARE * apart) / 2) + 1)
