"""Fits of touching columns whose shapes are not known yet: on the summed image, many groups at a time, in NumPy.

Levenberg's and Marquardt's steps for positions and shapes; amplitudes and the background are a linear fit at every
trial. A shape is the exponent (a X^2 + 2 b X Y + c Y^2) / 2, kept within the bounds of its sigmas by its eigenvalues:
one of each member, one that all members share, or a round one that all share.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .model import canonical
from .parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, THETA, X, Y

Floats = NDArray[np.float64]

SHAPES = ("own", "shared", "round")

_BATCH = 1 << 22
"""Numbers of the derivatives that are in memory at a time."""
_MOST_DAMPING, _SMALL_DAMPING = 1e8, 1e-2
_SETTLED = 1e-4
"""Of a pixel's variance: what the squares of the residual may still fall by."""
_LONGEST = 0.5
"""No exponent changes by more than this share in a step, and no centre by more than this share of a sigma."""


class ShapeFits(NamedTuple):
    """Fits of groups: (n, members, 7) of Equation 1, all members with the group's background, and what they leave."""

    estimates: Floats
    stderr: Floats
    """(n, members, 2) of x and y, for white noise as large as the residual."""
    squares: Floats
    """(n,) sums of squares of the residuals."""
    converged: NDArray[np.bool_]


def fit_shapes(
    windows: NDArray[np.floating],
    masks: NDArray[np.bool_],
    start: Floats,
    lower: Floats,
    upper: Floats,
    *,
    shape: str = "own",
    tolerance_px: float = 1e-4,
    max_iterations: int = 60,
) -> ShapeFits:
    """Fit groups of Gaussians and a background to windows by least squares.

    Parameters
    ----------
    windows, masks
        (n, h, w), and which pixels count.
    start, lower, upper
        (n, members, 7); x and y in px from the centre of the window's first pixel. Of the bounds those of amplitude, x,
        y, and the sigmas count.
    shape
        ``own``: a shape for each member. ``shared``: one for all. ``round``: one for all, and round.

    Examples
    --------
    >>> from .model import gaussian_image
    >>> pair = np.array([[[9.0, 8.0, 12.0, 3.0, 2.0, 0.5, 1.0], [6.0, 14.5, 12.0, 3.0, 3.0, 0.0, 1.0]]])
    >>> window = gaussian_image(pair[0], (25, 23)).sum(axis=0) - 1
    >>> start = pair * [1.2, 1.05, 0.95, 0.8, 1.1, 1, 1]
    >>> fits = fit_shapes(window[None], np.ones((1, 25, 23), bool), start, pair - 5, pair + 5)
    >>> fits.estimates[0, :, [1, 3, 4]].T.round(2).tolist()
    [[8.0, 3.0, 2.0], [14.5, 3.0, 3.0]]
    """
    n, height, width = windows.shape
    members = start.shape[1]
    count = members * 6 + 1
    batch = max(1, _BATCH // (count * height * width))
    parts = [
        _fit(
            windows[k : k + batch].reshape(-1, height * width).astype(np.float64),
            masks[k : k + batch].reshape(-1, height * width),
            (height, width),
            (start[k : k + batch], lower[k : k + batch], upper[k : k + batch]),
            shape,
            (tolerance_px, max_iterations),
        )
        for k in range(0, n, batch)
    ]
    if not parts:
        return ShapeFits(start.copy(), np.empty((0, members, 2)), np.empty(0), np.empty(0, np.bool_))
    return ShapeFits(*(np.concatenate(values) for values in zip(*parts, strict=True)))


class _Point(NamedTuple):
    """Centres (n, members, 2) of x and y, exponents (n, members, 3) a, b, c; amplitudes, then background (n, k + 1)."""

    places: Floats
    exponents: Floats
    linear: Floats
    basis: Floats
    """(n, members + 1, pixels): E of the members, and 1."""
    residual: Floats
    squares: Floats


def _fit(
    pixels: Floats,
    masks: NDArray[np.bool_],
    size: tuple[int, int],
    bounds: tuple[Floats, Floats, Floats],
    shape: str,
    limits: tuple[float, int],
) -> ShapeFits:
    start, lower, upper = bounds
    tolerance, most = limits
    masks = masks & np.isfinite(pixels)
    pixels = np.where(masks, pixels, 0.0)
    grid = np.indices(size).reshape(2, -1)[::-1].astype(np.float64)
    exponents = _exponents(start)
    if shape != "own":
        exponents = np.repeat(exponents.mean(axis=1, keepdims=True), start.shape[1], axis=1)
    point = _at(start[..., [X, Y]], _bounded(exponents, lower, upper, shape), pixels, masks, grid, (lower, upper))
    damping, running = np.full(len(pixels), 1e-3), np.ones(len(pixels), np.bool_)
    for _ in range(most):
        some = np.flatnonzero(running)
        here = _Point(*(values[some] for values in point))
        slopes = _slopes(here, masks[some], grid, shape)
        matrix = slopes @ slopes.transpose(0, 2, 1)
        diagonal = np.einsum("nii->ni", matrix)
        diagonal = np.maximum(diagonal, 1e-12 * diagonal.max(axis=1, keepdims=True))
        matrix = matrix + damping[some, None, None] * diagonal[:, None] * np.eye(matrix.shape[1])
        right = (slopes @ here.residual[..., None])[..., 0]
        step, variance = _solved(matrix, right), here.squares / masks[some].sum(axis=1)
        places, changed = _moved(here, step, (lower[some], upper[some]), shape)
        trial = _at(places, changed, pixels[some], masks[some], grid, (lower[some], upper[some]))
        better = trial.squares <= here.squares * (1 + 1e-12)
        moved = np.abs(places - here.places).max(axis=(1, 2))
        bent = np.abs(changed - here.exponents).max(axis=(1, 2)) / np.abs(here.exponents[..., [0, 2]]).max(axis=(1, 2))
        for old, new in zip(point, trial, strict=True):
            old[some[better]] = new[better]
        near = (moved < tolerance) & (bent < 10 * tolerance) | ((step * right).sum(axis=1) < _SETTLED * variance)
        near |= (here.squares - trial.squares < _SETTLED * variance) & (damping[some] <= _SMALL_DAMPING)
        damping[some] = np.where(better, np.maximum(0.2 * damping[some], 1e-9), np.maximum(10 * damping[some], 1e-3))
        running[some[(better & near) | (damping[some] > _MOST_DAMPING)]] = False
        if not running.any():
            break
    return _result(point, start, masks, grid, shape, ~running)


def _exponents(columns: Floats) -> Floats:
    """Return a, b, c of columns (n, members, 7)."""
    u, v = columns[..., SIGMA_A] ** -2.0, columns[..., SIGMA_B] ** -2.0
    cos, sin = np.cos(columns[..., THETA]), np.sin(columns[..., THETA])
    return np.stack([u * cos**2 + v * sin**2, (v - u) * sin * cos, u * sin**2 + v * cos**2], axis=-1)


def _axes(exponents: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the smaller and the larger eigenvalue of exponents (..., 3), and the angle of the first one's axis."""
    a, b, c = np.moveaxis(exponents, -1, 0)
    mean, half, turn = (a + c) / 2, np.hypot((a - c) / 2, b), 0.5 * np.arctan2(2 * b, a - c)
    return mean - half, mean + half, turn + np.pi / 2


def _bounded(exponents: Floats, lower: Floats, upper: Floats, shape: str) -> Floats:
    """Return exponents whose sigmas are within their bounds; round ones, where they are to be."""
    flat, steep, angle = _axes(exponents)
    if shape == "round":
        flat = steep = (flat + steep) / 2
    least = upper[..., [SIGMA_A, SIGMA_B]].max(axis=-1) ** -2.0
    most = np.maximum(lower[..., [SIGMA_A, SIGMA_B]].min(axis=-1), 0.3) ** -2.0
    flat, steep = np.clip(flat, least, most), np.clip(steep, least, most)
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack(
        [flat * cos**2 + steep * sin**2, (flat - steep) * sin * cos, flat * sin**2 + steep * cos**2], axis=-1
    )


def _at(
    places: Floats,
    exponents: Floats,
    pixels: Floats,
    masks: NDArray[np.bool_],
    grid: Floats,
    bounds: tuple[Floats, Floats],
) -> _Point:
    """Return the point with the best amplitudes, of the sign that their bounds have, and background."""
    n, members, _ = places.shape
    dx, dy = (grid[k] - places[..., k, None] for k in range(2))
    a, b, c = (exponents[..., k, None] for k in range(3))
    basis = np.empty((n, members + 1, pixels.shape[1]))
    basis[:, :members] = np.exp(-0.5 * (a * dx**2 + 2 * b * dx * dy + c * dy**2)) * masks[:, None]
    basis[:, members] = masks
    lower, upper = (
        np.column_stack([bound[..., AMPLITUDE], np.full(n, side * np.inf)])
        for bound, side in zip(bounds, (-1, 1), strict=True)
    )
    matrix = basis @ basis.transpose(0, 2, 1) + 1e-12 * masks.sum(axis=1)[:, None, None] * np.eye(members + 1)
    right = (basis @ pixels[..., None])[..., 0]
    linear = _solved(matrix, right)
    for _ in range(members):
        kept = np.clip(linear, lower, upper)
        out = kept != linear
        if not out.any():
            break
        held = np.where(out[:, :, None] | out[:, None, :], np.eye(members + 1), matrix)
        others = right - np.einsum("nij,nj->ni", matrix, np.where(out, kept, 0.0))
        linear = _solved(held, np.where(out, kept, others))
    linear = np.clip(linear, lower, upper)
    residual = pixels - (linear[:, None] @ basis)[:, 0]
    return _Point(places, exponents, linear, basis, residual, (residual**2).sum(axis=1))


def _solved(matrix: Floats, right: Floats) -> Floats:
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", matrix), 1e-300))
    scaled = matrix / scale[:, :, None] / scale[:, None, :] + 1e-10 * np.eye(matrix.shape[1])
    return np.asarray(np.linalg.solve(scaled, (right / scale)[..., None])[..., 0] / scale)


def _slopes(point: _Point, masks: NDArray[np.bool_], grid: Floats, shape: str) -> Floats:
    """Return the derivatives (n, parameters, pixels): amplitudes, background, places, and the exponents."""
    n, members, _ = point.places.shape
    dx, dy = (grid[k] - point.places[..., k, None] for k in range(2))
    a, b, c = (point.exponents[..., k, None] for k in range(3))
    shown = point.linear[:, :members, None] * point.basis[:, :members]
    by_x, by_y = shown * (a * dx + b * dy), shown * (b * dx + c * dy)
    bends = np.stack([-0.5 * shown * dx**2, -shown * dx * dy, -0.5 * shown * dy**2], axis=2)
    if shape == "round":
        bent = (bends[:, :, 0] + bends[:, :, 2]).sum(axis=1)[:, None]
    else:
        bent = bends.sum(axis=1) if shape == "shared" else bends.reshape(n, 3 * members, -1)
    return np.concatenate([point.basis, np.stack([by_x, by_y], axis=2).reshape(n, 2 * members, -1), bent], axis=1)


def _moved(point: _Point, step: Floats, bounds: tuple[Floats, Floats], shape: str) -> tuple[Floats, Floats]:
    n, members, _ = point.places.shape
    lower, upper = bounds
    first = members + 1
    steep = np.maximum(point.exponents[..., 0], point.exponents[..., 2])
    reach = _LONGEST / np.sqrt(steep)[..., None]
    by = np.clip(step[:, first : first + 2 * members].reshape(n, members, 2), -reach, reach)
    places = np.clip(point.places + by, lower[..., [X, Y]], upper[..., [X, Y]])
    bend = step[:, first + 2 * members :]
    if shape == "round":
        bend = np.stack([bend[:, 0], np.zeros(n), bend[:, 0]], axis=1)
    bend = bend.reshape(n, members if shape == "own" else 1, 3)
    bend = np.clip(bend, -_LONGEST * steep[..., None], _LONGEST * steep[..., None])
    return places, _bounded(point.exponents + bend, lower, upper, shape)


def _result(
    point: _Point, start: Floats, masks: NDArray[np.bool_], grid: Floats, shape: str, arrived: NDArray[np.bool_]
) -> ShapeFits:
    n, members, _ = point.places.shape
    flat, steep, angle = _axes(point.exponents)
    found = start.copy()
    found[..., [X, Y]] = point.places
    found[..., AMPLITUDE], found[..., BACKGROUND] = point.linear[:, :members], point.linear[:, members:]
    found[..., SIGMA_A], found[..., SIGMA_B], found[..., THETA] = flat**-0.5, steep**-0.5, -angle
    slopes = _slopes(point, masks, grid, shape)
    matrix = slopes @ slopes.transpose(0, 2, 1)
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", matrix), 1e-300))
    inverse = np.linalg.pinv(matrix / scale[:, :, None] / scale[:, None, :], hermitian=True)
    free = np.maximum(masks.sum(axis=1) - slopes.shape[1], 1)
    variance = np.einsum("nii->ni", inverse) / scale**2 * (point.squares / free)[:, None]
    first = members + 1
    stderr = np.sqrt(np.maximum(variance[:, first : first + 2 * members], 0)).reshape(n, members, 2)
    return ShapeFits(canonical(found), stderr, point.squares, arrived)
