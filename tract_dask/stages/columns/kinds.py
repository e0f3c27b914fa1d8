"""The kinds of columns: which sublattice each is on, and which sublattices are equally bright."""

from __future__ import annotations

from itertools import product
from string import ascii_uppercase
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

from .lattice import TOLERANCE, Lattice
from .relief import Mask, Places, Reals

Numbers = NDArray[np.int64]

_FEWEST, _SMALL = 6, 0.1
"""Columns that a class has at least, and as a share of the largest class; smaller ones belong to the class whose
place in the cell they share, or else to the kind that is as strong as they are."""
_AS_STRONG = 0.25
"""By how much the amplitudes may then differ."""
_UNLIKE, _SURE = 0.1, 4.0
"""Classes are of different kinds where their amplitudes differ by more than 10 %, and by four of their errors."""
_LARGEST_CELL = 4
"""Lattice cells in a larger cell, where columns of one place differ from cell to cell."""
_PRICE = 3.0
"""By how much, for each class, a larger cell has to make the columns' amplitudes more alike: Schwarz's criterion asks
for 1, but amplitudes of neighbours are not independent."""
_SMOOTHEST = 0.005
"""Amplitudes are taken for no more alike than this."""


class _Class(NamedTuple):
    """Columns of one place in the cell, the median logarithm of their amplitudes, and its error."""

    members: Numbers
    level: float
    error: float


def kinds_of(places: Places, amplitude: Reals, lattice: Lattice | None) -> NDArray[np.str_]:
    """Return the kind of each column: A for the strongest sublattice, B for the next, and so on.

    Columns that are connected by lattice vectors have one place in the cell. Where their amplitudes alternate, as those
    of a lattice that looks centred and is none, the cell is larger. Places whose columns are equally strong are one
    kind (the two columns of a silicon dumbbell, the oxygen columns on two sides of a cell), and so is the whole crystal
    where all are: then kinds are empty. A column on none of these places is of the kind that is as strong, or of none.

    Parameters
    ----------
    places, amplitude
        (n, 2) of (x, y), px, and (n,), NaN where it is not known. Slow changes of the amplitude do not matter.

    Examples
    --------
    >>> i, j = np.mgrid[:6, :6].reshape(2, -1)
    >>> places = np.stack([i, j], axis=1) * 10.0
    >>> lattice = Lattice((10.0, 0.0), (0.0, 10.0))
    >>> kinds_of(places, np.where((i + j) % 2, 1.0, 0.6), lattice)[:4].tolist()
    ['B', 'A', 'B', 'A']
    >>> kinds_of(places, np.ones(36), lattice)[:2].tolist()
    ['', '']
    """
    none = np.full(len(places), "", "<U1")
    level = np.log(np.where(np.abs(amplitude) > 0, np.abs(amplitude), np.nan))
    if lattice is None or np.isfinite(level).sum() < 2 * _FEWEST:
        return none
    part, step = _indexed(places, lattice)
    sizes = np.bincount(part)
    large = np.flatnonzero(sizes >= max(_FEWEST, _SMALL * sizes.max()))
    if not len(large):
        return none
    level = level - _slow(places, level, part == sizes.argmax())
    place = np.full(len(places), -1, np.int64)
    for one in large:
        own = part == one
        place[own] = place.max() + 1 + _alternating(step[own], level[own])
    _join_small(place, places, lattice)
    classes = [_class(np.flatnonzero(place == k), level) for k in range(place.max() + 1)]
    kinds = _alike([one for one in classes if one is not None])
    if len(kinds) < 2:
        return none
    levels = np.array([np.nanmedian(level[members]) for members in kinds])
    for name, members in zip(ascii_uppercase, kinds, strict=False):
        none[members] = name
    for k in np.flatnonzero((place < 0) & np.isfinite(level)):
        nearest = int(np.abs(levels - level[k]).argmin())
        if abs(levels[nearest] - level[k]) < _AS_STRONG:
            none[k] = ascii_uppercase[nearest]
    return none


def _indexed(places: Places, lattice: Lattice) -> tuple[Numbers, Numbers]:
    """Return the part of each column that lattice vectors connect, and (n, 2) steps along a and b from its first."""
    n, tree = len(places), cKDTree(places)
    first, second, steps = [], [], []
    for i, j in ((1, 0), (0, 1), (1, 1), (1, -1)):
        vector = i * np.array(lattice.a) + j * np.array(lattice.b)
        away, other = tree.query(places + vector, distance_upper_bound=TOLERANCE * lattice.spacing)
        there = np.flatnonzero(np.isfinite(away))
        first.append(there)
        second.append(np.asarray(other)[there])
        steps.append(np.tile([i, j], (len(there), 1)))
    one, two, by = np.concatenate(first), np.concatenate(second), np.concatenate(steps)
    graph = coo_array((np.ones(len(one)), (one, two)), shape=(n, n)).tocsr()
    _, part = connected_components(graph, directed=False)
    known = {(int(a), int(b)): step for a, b, step in zip(one, two, by, strict=True)}
    index = np.zeros((n, 2), np.int64)
    _, leaders = np.unique(part, return_index=True)
    for leader in leaders:
        order, before = breadth_first_order(graph, leader, directed=False)
        for k in order[1:]:
            back = int(before[k])
            step = known.get((back, int(k)))
            index[k] = index[back] + (step if step is not None else -known[int(k), back])
    return part.astype(np.int64), index


def _slow(places: Places, level: Reals, own: Mask) -> Reals:
    """Return how the amplitude changes over the image: a parabola through the columns of one part."""
    xy = (places - places.mean(axis=0)) / np.maximum(np.ptp(places, axis=0).max(), 1.0)
    x, y = xy.T
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    fitted = own & np.isfinite(level)
    number = 6 if fitted.sum() > 60 else 3 if fitted.sum() > 15 else 1
    found = np.linalg.lstsq(terms[fitted, :number], level[fitted], rcond=None)[0]
    found[0] = 0.0
    return np.asarray(terms[:, :number] @ found)


def _alternating(step: Numbers, level: Reals) -> Numbers:
    """Return the place of each column in the smallest cell in which columns of one place are alike."""
    whole = np.isfinite(level)
    best, lowest = np.zeros(len(level), np.int64), np.inf
    for cell in _cells():
        _, place = np.unique(np.mod(step @ np.linalg.inv(cell) + 1e-6, 1.0).round(3), axis=0, return_inverse=True)
        place = place.ravel()
        counts = np.bincount(place[whole], minlength=1)
        if counts.min() < _FEWEST:
            continue
        medians = np.array([np.median(level[whole & (place == k)]) for k in range(len(counts))])
        spread = max(1.4826 * float(np.median(np.abs(level[whole] - medians[place[whole]]))), _SMOOTHEST)
        price = whole.sum() * 2 * np.log(spread) + _PRICE * len(counts) * np.log(whole.sum())
        if price < lowest and (len(counts) == 1 or np.ptp(medians) > _UNLIKE):
            best, lowest = place, price
    return best.astype(np.int64)


def _cells() -> list[NDArray[np.int64]]:
    """Return the cells of one to four lattice cells, in rows of steps along a and b."""
    cells = []
    for size in range(1, _LARGEST_CELL + 1):
        for width in (w for w in range(1, size + 1) if size % w == 0):
            cells += [np.array([[width, shear], [0, size // width]]) for shear in range(width)]
    return cells


def _join_small(place: Numbers, places: Places, lattice: Lattice) -> None:
    """Give columns without a place that of the columns two lattice steps or less away, where they agree on one."""
    small = np.flatnonzero(place < 0)
    known = np.flatnonzero(place >= 0)
    tree = cKDTree(places[known])
    steps = np.array(list(product(range(-2, 3), repeat=2))) @ np.array([lattice.a, lattice.b])
    for k in small:
        near = tree.query_ball_point(places[k] + steps, TOLERANCE * lattice.spacing)
        found = place[known[np.unique(np.concatenate([np.asarray(some, np.int64) for some in near]))]]
        if len(found) and (found == found[0]).all():
            place[k] = found[0]


def _class(members: Numbers, level: Reals) -> _Class | None:
    there = level[members][np.isfinite(level[members])]
    if not len(there):
        return None
    middle = float(np.median(there))
    spread = max(1.4826 * float(np.median(np.abs(there - middle))), _SMOOTHEST)
    return _Class(members, middle, 1.25 * spread / np.sqrt(len(there)))


def _alike(classes: list[_Class]) -> list[Numbers]:
    """Return the members of each kind, strongest first: classes are joined with the one before while they are alike."""
    kinds: list[list[_Class]] = []
    for one in sorted(classes, key=lambda found: -found.level):
        before = kinds[-1][-1] if kinds else None
        if before and before.level - one.level < max(_UNLIKE, _SURE * np.hypot(before.error, one.error)):
            kinds[-1].append(one)
        else:
            kinds.append([one])
    return [np.concatenate([one.members for one in kind]) for kind in kinds]
