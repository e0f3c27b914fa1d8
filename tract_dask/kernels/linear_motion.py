"""Linear motion: rotation, magnification and shear of all columns of a frame about a centre, beside their shift.

A frame shows a column that lies at ``u`` from the centre at ``exp(G) u``. Small motions add up in ``G``, and ``-G`` is
the way back. Four numbers make ``G``, in this order (:data:`NAMES`): the rotation from x towards y in radians, the
magnification (relative), and two shears: x longer and y shorter, and the same along the diagonals.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

NAMES = ("rotation", "magnification", "shear", "diagonal_shear")
"""What the four numbers of a motion are called."""

UNITS = ("rad", "1", "1", "1")

_GENERATORS = np.array([[[0, -1], [1, 0]], [[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]]], np.float64)
"""(4, 2, 2) by which (x, y) is multiplied."""

_FEWEST = 10
"""With fewer columns the spread of what is left does not tell their errors."""

_THIN = 1e-4
"""Determinant of columns' covariance over its squared trace: with less they lie on a line, as thin as 1 to 100."""

_ROUNDS = 20
_BIWEIGHT = 6.0
"""Median deviations at which a column no longer counts."""


def matrices(motion: Floats) -> Floats:
    """Return the matrices (..., 2, 2) of motions (..., 4), which take (x, y) from the centre to where it is seen.

    Examples
    --------
    >>> matrices(np.array([np.pi / 2, 0, 0, 0])).round(6) + 0.0
    array([[ 0., -1.],
           [ 1.,  0.]])
    """
    rotation, growth, shear, diagonal = np.moveaxis(np.asarray(motion, np.float64), -1, 0)
    square = (shear**2 + diagonal**2 - rotation**2).astype(np.complex128)
    root = np.sqrt(square)
    small = np.abs(root) < 1e-8
    cosh = np.cosh(root).real
    sinhc = np.where(small, 1.0, (np.sinh(root) / np.where(small, 1.0, root)).real)
    traceless = np.tensordot(np.stack([rotation, shear, diagonal], axis=-1), _GENERATORS[[0, 2, 3]], axes=1)
    return np.asarray(
        np.exp(growth)[..., None, None] * (cosh[..., None, None] * np.eye(2) + sinhc[..., None, None] * traceless)
    )


def moved(places: Floats, motion: Floats) -> Floats:
    """Return where places (n, 2) or (..., n, 2), as (x, y) from the centre, are seen after motions (..., 4)."""
    return np.asarray(places @ np.swapaxes(matrices(motion), -1, -2))


def motions(matrix: Floats) -> Floats:
    """Return the motions (..., 4) of matrices (..., 2, 2) near 1: what :func:`matrices` takes back to them.

    Examples
    --------
    >>> motions(matrices(np.array([0.1, 0.02, -0.03, 0.04]))).round(6)
    array([ 0.1 ,  0.02, -0.03,  0.04])
    """
    growth = np.log(np.maximum(np.linalg.det(matrix), 1e-12)) / 2
    unit = matrix * np.exp(-growth)[..., None, None]
    cosine = np.trace(unit, axis1=-2, axis2=-1) / 2
    angle = np.sqrt(cosine.astype(np.complex128) ** 2 - 1)  # sinh of the root of the square
    small = np.abs(angle) < 1e-8
    ratio = np.where(small, 1.0, (np.arcsinh(angle) / np.where(small, 1.0, angle)).real)
    (xx, xy), (yx, yy) = (np.moveaxis(row, -1, 0) for row in np.moveaxis(unit, -2, 0))
    parts = np.stack([yx - xy, np.zeros_like(growth), xx - yy, xy + yx], axis=-1) * ratio[..., None] / 2
    parts[..., 1] = growth
    return np.asarray(parts)


def estimate(away: Floats, places: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return the motions of frames and their standard errors, each (frames, 4), at once for all.

    Parameters
    ----------
    away
        (frames, n, 2) displacements (x, y) of columns.
    places
        (n, 2) where they lie, from the centre.
    weight
        (frames, n) precision of their displacements, up to a factor; zero for a column that does not count.

    Notes
    -----
    Weighted least squares of a shift and a matrix, one axis at a time, for both have the same normal equations. Errors
    are from the spread of what is left. NaN for frames with fewer than ten columns, and where all lie on a line.
    """
    ones = np.ones(len(places))
    design = np.column_stack([ones, places])  # (n, 3)
    squares = design[:, [0, 0, 0, 1, 1, 2]] * design[:, [0, 1, 2, 1, 2, 2]]
    normal = _sums(weight, squares)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    count = (weight > 0).sum(axis=1)
    scale = np.sqrt(np.maximum(np.einsum("fii->fi", normal), 1e-300))
    scaled = normal / scale[:, :, None] / scale[:, None, :]
    total = np.maximum(normal[:, 0, 0], 1e-300)[:, None]
    middle = normal[:, 0, 1:] / total
    spread_out = normal[:, 1:, 1:] / total[..., None] - middle[:, :, None] * middle[:, None, :]
    usable = (count >= _FEWEST) & (np.linalg.det(spread_out) > _THIN * np.einsum("fii->f", spread_out) ** 2)
    inverse = np.full_like(normal, np.nan)
    inverse[usable] = np.linalg.inv(scaled[usable]) / scale[usable, :, None] / scale[usable, None, :]
    rows, variances = [], []
    for axis in (0, 1):
        values = np.where(weight > 0, away[..., axis], 0.0)
        right = _sums(weight * values, design)
        row = np.einsum("fij,fj->fi", inverse, right)
        left = (weight * values * values).sum(axis=1) - np.einsum("fi,fi->f", row, right)
        rows.append(row[:, 1:])
        spread = np.maximum(left, 0) / np.maximum(count - 3, 1)
        variances.append(spread[:, None] * np.einsum("fii->fi", inverse)[:, 1:])
    motion = np.full((len(away), 4), np.nan)
    motion[usable] = motions(np.stack(rows, axis=1)[usable] + np.eye(2))
    across = variances[0][:, 1] + variances[1][:, 0]
    along = variances[0][:, 0] + variances[1][:, 1]
    return motion, np.sqrt(np.stack([across, along, along, across], axis=-1)) / 2


def _sums(values: Floats, factors: Floats) -> Floats:
    """Return the product of matrices (frames, n) and (n, k): for a frame, bit for bit, the same among any others."""
    return np.stack([(values * factor).sum(axis=1) for factor in factors.T], axis=1)


def fewest(chosen: Sequence[int]) -> int:
    """Return how many columns :func:`fit` takes for a shift and these numbers of a motion."""
    return 3 + len(chosen) // 2 if chosen else 1


def fit(
    seen: Floats, places: Floats, expected: Floats, good: NDArray[np.bool_], chosen: Sequence[int]
) -> tuple[Floats, Floats]:
    """Return the shifts (frames, 2) and the motions (frames, 4) that bring places to where they are seen.

    Parameters
    ----------
    seen
        (frames, n, 2) as (x, y) from the centre.
    places
        (n, 2) where columns lie, alike.
    expected
        (n,) errors of what is seen, up to a factor.
    good
        (frames, n) what counts.
    chosen
        Which of the four numbers are fitted, beside the shift; the others stay zero.

    Notes
    -----
    Gauss-Newton steps of least squares, weighted by 1 / expected^2 times Tukey's biweight of the distance, so that
    columns that move by themselves do not count. A shift alone takes one column; frames with too few keep zeros.
    """
    frames, columns = len(seen), len(places)
    shift, motion = np.zeros((frames, 2)), np.zeros((frames, 4))
    unknowns = 2 + len(chosen)
    enough = good.sum(axis=1) >= fewest(chosen)
    seen = np.where(good[..., None], seen, 0.0)
    slopes = np.zeros((frames, columns, 2, unknowns))
    slopes[:, :, 0, 0] = slopes[:, :, 1, 1] = 1
    for _ in range(_ROUNDS):
        turned = moved(places, motion)
        left = seen - turned - shift[:, None]
        distance = np.where(good, np.hypot(*np.moveaxis(left, -1, 0)) / expected, np.nan)
        limit = _BIWEIGHT * np.nanmedian(np.where(enough[:, None], distance, 1.0), axis=1)[:, None] + 1e-12
        weight = np.where(good, np.clip(1 - (distance / limit) ** 2, 0, None) ** 2, 0) / expected**2
        for k, number in enumerate(chosen, 2):
            slopes[..., k] = turned @ _GENERATORS[number].T
        flat, doubled = slopes.reshape(frames, -1, unknowns), np.repeat(weight, 2, axis=1)
        weighted = flat * doubled[..., None]
        normal = np.swapaxes(weighted, 1, 2) @ flat
        right = np.einsum("fmk,fm->fk", weighted, left.reshape(frames, -1))
        step = np.zeros((frames, unknowns))
        step[enough] = _solve(normal[enough], right[enough])
        shift += step[:, :2]
        motion[:, list(chosen)] += step[:, 2:]
        if not (np.abs(step) > 1e-9).any():
            break
    return shift, motion


def _solve(normal: Floats, right: Floats) -> Floats:
    """Return the solutions (n, k) of sets of equations, with the smallest steps where they are not unique."""
    scale = np.sqrt(np.maximum(np.einsum("fii->fi", normal), 1e-300))
    scaled = normal / scale[:, :, None] / scale[:, None, :]
    return np.asarray(np.einsum("fij,fj->fi", np.linalg.pinv(scaled, hermitian=True), right / scale) / scale)
