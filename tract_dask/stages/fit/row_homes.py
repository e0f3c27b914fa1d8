"""Sites of a lattice as places where columns of a frame belong along x."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SettingsError
from ...settings.run import FitSettings
from ..sites import fit_sites

Floats = NDArray[np.float64]

_FEWEST_FRAMES = 3
"""The sum of fewer frames is displaced as they are."""
_ALIKE = 0.1
"""Columns that lie so near in the cell, in shares of its vectors, are of one sublattice."""
_MOST_KINDS = 12
_FEWEST = 4
_ROUNDS = 10
_BIWEIGHT = 6.0


def check_frames(settings: FitSettings, usable: int) -> None:
    """Check that there are enough frames for their sum to say where columns belong.

    Raises
    ------
    SettingsError
        Where they are too few.
    """
    if settings.scan_rows == "sum" and usable < _FEWEST_FRAMES:
        raise SettingsError(
            "rows of the sum of so few frames are displaced, too",
            "setting scan_rows (FitSettings)",
            f"{_FEWEST_FRAMES} frames or more",
            f"{usable}",
            "Choose lattice",
        )


def on_sites(x: Floats, sites: Floats) -> Floats:
    """Return x of the sites of a lattice that is fitted to the columns of a frame, (n,); NaN for columns without one.

    By least squares with Tukey's biweight, so that columns far from their sites do not count.

    Parameters
    ----------
    x
        (n,) where they are seen; NaN: not known.
    sites
        From :func:`sites_of`.
    """
    sited = np.isfinite(sites).all(axis=1)
    good = sited & np.isfinite(x)
    home = np.full(len(x), np.nan)
    if good.sum() <= sites.shape[1]:
        return home
    weight: Floats = np.ones(good.sum())
    solution: NDArray[Any] = np.zeros(sites.shape[1])
    for _ in range(_ROUNDS):
        solution = np.linalg.lstsq(sites[good] * weight[:, None], x[good] * weight, rcond=None)[0]
        left = np.abs(x[good] - sites[good] @ solution)
        weight = np.maximum(0, 1 - (left / (_BIWEIGHT * np.median(left) + 1e-12)) ** 2)
    home[sited] = sites[sited] @ solution
    return home


def sites_of(places: Floats, kinds: NDArray[np.object_]) -> Floats:
    """Return of what the sites of columns are made, (n, sublattices + 2): which sublattice, and numbers along a and b.

    NaN for columns on no site. Columns on no site of their kind make a new one with those that lie alike in the cell.

    Parameters
    ----------
    places
        (n, 2); NaN: not known.
    kinds
        (n,) their sublattices, as far as they are known.

    Raises
    ------
    SettingsError
        Where the columns make no lattice.
    """
    kinds, known, everyone = kinds.copy(), np.isfinite(places).all(axis=1), np.ones(len(places), np.bool_)
    try:
        sites = fit_sites(places, kinds.astype(str), everyone)
        for number in range(_MOST_KINDS):
            rest = np.flatnonzero(known & ~sites.fitted)
            cell = (places[rest] - sites.site[rest]) @ np.linalg.inv(sites.vectors)
            apart = cell[:, None] - cell
            near = np.hypot(*np.moveaxis(apart - np.rint(apart), -1, 0)) < _ALIKE
            if near.sum(axis=1).max(initial=0) < _FEWEST:
                break
            kinds[rest[near[near.sum(axis=1).argmax()]]] = f"{number} of the cell"
            sites = fit_sites(places, kinds.astype(str), everyone)
    except SettingsError as error:
        here, remedy = "setting scan_rows (FitSettings)", "Choose sum, or off"
        raise SettingsError("the columns make no lattice", here, error.expected, error.got, remedy) from error
    names, own = np.unique(kinds.astype(str), return_inverse=True)
    design = np.column_stack([own[:, None] == np.arange(len(names)), sites.index]).astype(np.float64)
    design[~sites.fitted] = np.nan
    return np.asarray(design[:, design[sites.fitted].any(axis=0)])
