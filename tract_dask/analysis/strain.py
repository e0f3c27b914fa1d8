"""Strain: how the vectors from a column to its neighbours differ from those of the mean lattice."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..errors import InputError, SettingsError
from ..store.schema import texts
from .motion import positions, standard_errors

Floats = NDArray[np.float64]

COMPONENTS = ("xx", "yy", "xy", "rotation")

_NEAR = 0.25
"""How far from where the lattice has it a neighbour may be, as a share of the shortest lattice vector."""
_NEIGHBOURS, _FEWEST = 12, 5
"""Of so many nearest columns lattice vectors are chosen; a strain needs so many of eight neighbours."""
_SHARED = 0.8
"""A vector is one of the lattice where columns have both neighbours along it as often as along the best, this share."""
_PARALLEL = 0.3
"""Sine of the angle between lattice vectors, at least."""
_WORST = 10.0
"""By how much less one direction may be known than the other."""


class Places(NamedTuple):
    """Places of columns (..., columns, 2) along x and y, and their standard errors, pm; NaN where not known."""

    at: Floats
    error: Floats


def mean_places(tracks: xr.Dataset, frames: str = "mean") -> Places:
    """Return the places of the columns: means over the frames, or one for ``each`` frame.

    The error of a mean is that of the fits, or the scatter of the frames where that is more.

    Raises
    ------
    SettingsError
        Where ``frames`` is neither, or the size of a pixel is not known.
    """
    if frames not in ("mean", "each"):
        raise SettingsError("frames cannot be used", "frames", "mean or each", repr(frames))
    order = "frame", "column_id", "axis"
    at, error = (
        values.sel(axis=["x", "y"]).transpose(*order).to_numpy()
        for values in (positions(tracks), standard_errors(tracks))
    )
    if frames == "each":
        return Places(at, error)
    known = np.isfinite(at)
    number = known.sum(axis=0)
    share = 1 / np.where(number, number, np.nan)
    mean = np.where(known, at, 0).sum(axis=0) * share
    scatter = np.where(known, np.square(at - mean), 0).sum(axis=0) / np.where(number > 1, number - 1, np.inf)
    stated = np.where(known, np.square(error), 0).sum(axis=0) * share
    return Places(mean, np.sqrt(np.maximum(scatter, stated) * share))


def of_kind(tracks: xr.Dataset, kind: str | None) -> NDArray[np.int64]:
    """Return the numbers (not the IDs) of the columns of a kind; None: of all.

    Raises
    ------
    SettingsError
        Where no column is of it.
    """
    kinds = texts(tracks["kind"].to_numpy())
    some = np.flatnonzero(kinds == kind) if kind is not None else np.arange(len(kinds))
    if not len(some):
        known = ", ".join(sorted(filter(None, set(kinds)))) or "columns without a kind"
        raise SettingsError("no column is of this kind", "kind", known, str(kind))
    return some


def described(found: xr.Dataset, tracks: xr.Dataset, some: NDArray[np.int64]) -> xr.Dataset:
    """Return what was found of some columns with their places and kinds; of frames, with their numbers."""
    for name in ("x_ref", "y_ref", "kind"):
        found[name] = tracks[name].isel(column_id=some).drop_vars(["parameter", "unit"], errors="ignore")
    return found.assign_coords(frame=tracks["frame"]) if "frame" in found.dims else found


def strain(
    tracks: xr.Dataset,
    kind: str | None = None,
    *,
    frames: str = "mean",
    reference: Sequence[int] | None = None,
) -> xr.Dataset:
    """Return the strain at each column, from the vectors to its neighbours on the same sublattice.

    The vectors to those of the eight neighbours (along a, b, a + b, a - b) that are there are d = F v, with v those of
    the mean lattice; F is found by least squares, and strain is the symmetric part of F - 1, for small angles.

    Parameters
    ----------
    tracks
        Results; only accepted fits count.
    kind
        Sublattice (``tracks.kind``); None: all columns. Neighbours are always one lattice vector away.
    frames
        ``mean``: of the mean places; ``each``: for each frame.
    reference
        IDs of columns whose mean lattice has no strain; None: all.

    Returns
    -------
    Dataset
        (column_id) or (frame, column_id): ``xx``, ``yy``, ``xy`` (shares) and ``rotation`` (rad, from x to y, which is
        clockwise as images are shown), each with ``_stderr``; ``neighbours``, their number. NaN at columns with fewer
        than five, or where these lie on one line. Attributes ``a_pm`` and ``b_pm``: the mean lattice, (x, y).

    Raises
    ------
    InputError
        Where the columns have no lattice.
    SettingsError
        Where there is no such kind or column, or the size of a pixel is not known.
    """
    some = of_kind(tracks, kind)
    found = mean_places(tracks, frames)
    at, error = found.at[..., some, :], found.error[..., some, :]
    with np.errstate(invalid="ignore"):
        usual = at if at.ndim == 2 else np.ma.median(np.ma.masked_invalid(at), axis=0).filled(np.nan)
    ids = tracks["column_id"].to_numpy()[some]
    chosen = np.ones(len(some), np.bool_) if reference is None else np.isin(ids, list(reference))
    if reference is not None and not set(reference) <= set(ids.tolist()):
        raise SettingsError("there is no such column", "reference", "IDs of columns of this kind", str(reference))
    basis = lattice_of(usual, chosen)
    steps = np.array([step for step in product((-1, 0, 1), repeat=2) if step != (0, 0)])
    neighbour = _neighbours(usual, steps @ basis, _NEAR * float(np.hypot(*basis.T).min()))
    values, errors, number = _gradients(at, error, neighbour, steps @ basis)
    dims = ("frame", "column_id") if frames == "each" else ("column_id",)
    units = {"xx": "1", "yy": "1", "xy": "1", "rotation": "rad"}
    variables: dict[str, Any] = {
        name: (dims, values[..., k], {"units": units[name], "long_name": f"Strain {name}"})
        for k, name in enumerate(COMPONENTS)
    }
    variables |= {f"{name}_stderr": (dims, errors[..., k]) for k, name in enumerate(COMPONENTS)}
    result = xr.Dataset(variables, {"column_id": ids}).assign(neighbours=(dims, number))
    return described(result, tracks, some).assign_attrs(a_pm=basis[0].tolist(), b_pm=basis[1].tolist())


def lattice_of(at: Floats, chosen: NDArray[np.bool_] | None = None) -> Floats:
    """Return the two shortest vectors, (2, 2) rows of (x, y), along which columns have neighbours on both sides.

    Parameters
    ----------
    at
        (n, 2) places; NaN where they are not known.
    chosen
        (n,) columns whose mean vectors they are.

    Raises
    ------
    InputError
        Where there are none.
    """
    known = at[np.isfinite(at).all(axis=1)]
    if len(known) < 2 * _FEWEST:
        raise _no_lattice(len(known))
    tree = cKDTree(known)
    around = min(_NEIGHBOURS + 1, len(known))
    vectors = (known[np.asarray(tree.query(known, k=around)[1])[:, 1:]] - known[:, None]).reshape(-1, 2)
    vectors *= np.where((vectors[:, 1] < 0) | ((vectors[:, 1] == 0) & (vectors[:, 0] < 0)), -1, 1)[:, None]
    means: list[tuple[float, Floats]] = []
    left = vectors
    while len(left):
        shortest = left[np.hypot(*left.T).argmin()]
        radius = _NEAR * float(np.hypot(*shortest))
        for _ in range(3):
            own = np.hypot(*(left - shortest).T) < radius
            shortest = np.median(left[own], axis=0) if own.any() else shortest
        both = [np.asarray(tree.query(known + sign * shortest)[0]) < radius for sign in (1, -1)]
        means.append((float(np.mean(both[0] & both[1])), shortest))
        near = np.hypot(*(left - shortest).T) < radius
        left = left[~near] if near.any() else left[1:]
    best = max(share for share, _ in means)
    good = sorted((v for share, v in means if share > 0 and share >= _SHARED * best), key=lambda v: float(np.hypot(*v)))
    first = good[0] if good else None
    others = [v for v in good if abs(_cross(good[0], v)) > _PARALLEL * np.hypot(*v) * np.hypot(*good[0])]
    if first is None or not others:
        raise _no_lattice(len(known))
    basis = np.array([first, others[0]])
    radius = _NEAR * float(np.hypot(*first))
    return _averaged(at, np.ones(len(at), np.bool_) if chosen is None else chosen, basis, radius)


def _no_lattice(number: int) -> InputError:
    return InputError(
        "the columns have no lattice",
        "strain",
        "columns with neighbours on both sides",
        f"{number} columns",
        "Give a kind",
    )


def _cross(one: Floats, other: Floats) -> float:
    return float(one[0] * other[1] - one[1] * other[0])


def _averaged(at: Floats, chosen: NDArray[np.bool_], basis: Floats, radius: float) -> Floats:
    """Return the lattice vectors as the means over the chosen columns."""
    neighbour = _neighbours(at, np.concatenate([basis, -basis]), radius)
    means = []
    for k in range(2):
        pairs = [(chosen & (neighbour[:, side] >= 0), neighbour[:, side], sign) for side, sign in ((k, 1), (k + 2, -1))]
        found = [sign * (at[other[own]] - at[own]) for own, other, sign in pairs]
        every = np.concatenate(found)
        means.append(every.mean(axis=0) if len(every) else basis[k])
    return np.array(means)


def _neighbours(at: Floats, vectors: Floats, radius: float) -> NDArray[np.int64]:
    """Return which column is a vector away from each, (n, vectors); -1 where none is."""
    known = np.flatnonzero(np.isfinite(at).all(axis=1))
    found = np.full((len(at), len(vectors)), -1, np.int64)
    away, other = cKDTree(at[known]).query(at[known][:, None] + vectors, distance_upper_bound=radius)
    found[known] = np.where(np.isfinite(away), np.append(known, -1)[np.asarray(other)], -1)
    return found


def _gradients(
    at: Floats, error: Floats, neighbour: NDArray[np.int64], vectors: Floats
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return strains and their errors (..., n, 4), and how many neighbours tell them (..., n)."""
    there = neighbour >= 0
    away = at[..., neighbour, :] - at[..., :, None, :]
    seen = there & np.isfinite(away).all(axis=-1)
    weight = seen.astype(np.float64)
    # a plane through the neighbours and the column: its own error is one of many, and does not count fully
    design = np.concatenate([np.ones((len(vectors), 1)), vectors], axis=1)
    normal = np.einsum("...k,ki,kj->...ij", weight, design, design)
    normal[..., 0, 0] += 1.0
    spread = np.linalg.eigvalsh(np.einsum("...k,ki,kj->...ij", weight, vectors, vectors))
    enough = (seen.sum(axis=-1) >= _FEWEST) & (spread[..., 1] < _WORST * spread[..., 0])
    inverse = np.linalg.pinv(normal, hermitian=True)
    gain = np.einsum("...ij,kj,...k->...ik", inverse, design, weight)[..., 1:, :]
    own = inverse[..., 1:, 0]
    moved = np.where(seen[..., None], away - vectors, 0.0)
    gradient = np.einsum("...ik,...kc->...ci", gain, moved)
    variance = np.einsum("...ik,...kc->...ci", gain**2, np.where(seen[..., None], error[..., neighbour, :] ** 2, 0.0))
    variance += np.einsum("...i,...c->...ci", own**2, np.nan_to_num(error) ** 2)
    (xx, xy), (yx, yy) = (np.moveaxis(gradient[..., c, :], -1, 0) for c in range(2))
    (vxx, vxy), (vyx, vyy) = (np.moveaxis(variance[..., c, :], -1, 0) for c in range(2))
    half = 0.5 * np.sqrt(vxy + vyx)
    values = np.stack([xx, yy, 0.5 * (xy + yx), 0.5 * (yx - xy)], axis=-1)
    errors = np.stack([np.sqrt(vxx), np.sqrt(vyy), half, half], axis=-1)
    number = seen.sum(axis=-1).astype(np.int64)
    return np.where(enough[..., None], values, np.nan), np.where(enough[..., None], errors, np.nan), number
