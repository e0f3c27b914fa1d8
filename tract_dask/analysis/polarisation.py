"""Polarisation: how far columns of one kind are from the centre of their neighbours of another; and distances."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..errors import InputError
from .strain import Floats, described, mean_places, of_kind

_SHELL = 1.3
"""Neighbours are as near as the nearest, up to this factor."""
_MOST = 8
"""Neighbours of a column that are counted."""
_CENTRED = 0.35
"""A column is between its neighbours where their centre is this share of their distance away, at most."""


def polarisation(
    tracks: xr.Dataset, kind: str = "B", around: str = "A", *, frames: str = "mean", neighbours: int | None = None
) -> xr.Dataset:
    """Return how far each column of a kind is from the centre of its nearest neighbours of another kind.

    In a perovskite along [001], A and B are its cations: the vector is the off-centring of B.

    Parameters
    ----------
    tracks
        Results; only accepted fits count.
    kind, around
        The kinds of the column and of its neighbours (``tracks.kind``).
    frames
        ``mean``: of the mean places; ``each``: for each frame.
    neighbours
        How many are around a column; None: as many as most columns have within 1.3 times the nearest's distance.

    Returns
    -------
    Dataset
        (column_id, axis) or (frame, column_id, axis): ``displacement`` and ``displacement_stderr``, pm, x to the right
        and y down. NaN at columns that do not have all their neighbours, as at the edge of the image. Attribute
        ``neighbours``.

    Raises
    ------
    InputError
        Where no column lies between neighbours.
    SettingsError
        Where there is no such kind, or the size of a pixel is not known.
    """
    own, other = of_kind(tracks, kind), of_kind(tracks, around)
    found = mean_places(tracks, frames)
    usual = found.at if frames == "mean" else mean_places(tracks).at
    nearest, number = _between(usual[own], usual[other], neighbours)
    if not number:
        raise InputError(
            "no column lies between neighbours of the other kind",
            "polarisation",
            f"columns {kind} with columns {around} around them",
            f"{len(own)} columns {kind}, {len(other)} columns {around}",
        )
    whole: NDArray[np.bool_] = np.all(nearest >= 0, axis=1)
    at, error = found.at[..., other, :][..., nearest, :], found.error[..., other, :][..., nearest, :]
    moved = np.where(whole[:, None], found.at[..., own, :] - at.mean(axis=-2), np.nan)
    stderr = np.hypot(found.error[..., own, :], np.sqrt(np.square(error).sum(axis=-2)) / number)
    dims = ("frame", "column_id", "axis") if frames == "each" else ("column_id", "axis")
    result = xr.Dataset(
        {
            "displacement": (dims, moved, {"units": "pm", "long_name": f"{kind} from the centre of {around}"}),
            "displacement_stderr": (dims, np.where(np.isfinite(moved), stderr, np.nan), {"units": "pm"}),
        },
        {"column_id": tracks["column_id"].to_numpy()[own], "axis": ["x", "y"]},
        {"neighbours": number, "kind": kind, "around": around},
    )
    return described(result, tracks, own)


def neighbour_distances(tracks: xr.Dataset, first: str | None = None, second: str | None = None) -> xr.Dataset:
    """Return the distances of neighbouring columns of two kinds, each pair once, from their mean places.

    Parameters
    ----------
    tracks
        Results; only accepted fits count.
    first, second
        The kinds of the two columns; None: any. A column's neighbours are those no farther than 1.3 times its nearest.

    Returns
    -------
    Dataset
        (pair): ``distance`` and ``distance_stderr``, pm; ``angle``, rad from x to y, 0 to pi; ``first`` and ``second``,
        the IDs; ``x`` and ``y``, px, the middle in the summed image.

    Raises
    ------
    SettingsError
        Where there is no such kind, or the size of a pixel is not known.
    """
    own, other = of_kind(tracks, first), of_kind(tracks, second)
    found = mean_places(tracks)
    own, other = (some[np.isfinite(found.at[some]).all(axis=1)] for some in (own, other))
    near: set[tuple[int, int]] = set()
    if len(own) and len(other):
        k = min(_MOST + 1, len(other))
        away, which = (np.asarray(v).reshape(len(own), k) for v in cKDTree(found.at[other]).query(found.at[own], k=k))
        away = np.where(other[which] == own[:, None], np.inf, away)
        close = away <= _SHELL * away.min(axis=1, keepdims=True)
        rows, ranks = np.nonzero(close & np.isfinite(away))
        near = {tuple(sorted((int(own[r]), int(other[which[r, c]])))) for r, c in zip(rows, ranks, strict=True)}  # type: ignore[misc]
    one, two = np.array(sorted(near), np.int64).reshape(-1, 2).T
    along = found.at[two] - found.at[one]
    distance = np.hypot(*along.T)
    direction = along / np.where(distance > 0, distance, np.nan)[:, None]
    stderr = np.sqrt(((found.error[one] ** 2 + found.error[two] ** 2) * direction**2).sum(axis=1))
    places = np.stack([tracks["x_ref"].to_numpy(), tracks["y_ref"].to_numpy()])
    ids = tracks["column_id"].to_numpy()
    middle = places[:, one] / 2 + places[:, two] / 2
    return xr.Dataset(
        {
            "distance": ("pair", distance, {"units": "pm", "long_name": "Distance of neighbours"}),
            "distance_stderr": ("pair", stderr, {"units": "pm"}),
            "angle": ("pair", np.mod(np.arctan2(along[:, 1], along[:, 0]), np.pi), {"units": "rad"}),
            "first": ("pair", ids[one]),
            "second": ("pair", ids[two]),
            "x": ("pair", middle[0], {"units": "px"}),
            "y": ("pair", middle[1], {"units": "px"}),
        }
    )


def _between(own: Floats, other: Floats, number: int | None) -> tuple[NDArray[np.int64], int]:
    """Return the neighbours of each place (n, number), -1 where it does not lie between so many; and their number."""
    there, known = np.isfinite(own).all(axis=1), np.flatnonzero(np.isfinite(other).all(axis=1))
    k = min((number or _MOST) + 1, len(known))
    if k < 2 or not there.any():
        return np.full((len(own), 1), -1, np.int64), 0
    away, which = (np.asarray(values) for values in cKDTree(other[known]).query(own[there], k=k))
    close = (away <= _SHELL * away[:, :1]).sum(axis=1)
    if number is None:
        number = int(np.bincount(close[close > 1], minlength=1).argmax())
    if not 1 < number <= k:
        return np.full((len(own), 1), -1, np.int64), 0
    nearest = known[which[:, :number]]
    off = np.hypot(*(other[nearest].mean(axis=1) - own[there]).T)
    whole = (close == number) & (off <= _CENTRED * away[:, 0])
    found = np.full((len(own), number), -1, np.int64)
    found[np.flatnonzero(there)[whole]] = nearest[whole]
    return found, number if whole.any() else 0
