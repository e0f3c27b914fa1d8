"""Groups of columns in windows of the summed image, and their fits with one more column."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...kernels.gaussian.joint import MOST_MEMBERS
from ...kernels.gaussian.joint_shapes import fit_shapes
from ...kernels.gaussian.model import above_background, group_image
from ...kernels.gaussian.parameters import AMPLITUDE, SIGMA_A, SIGMA_B, THETA, X, Y
from ..groups import INSEPARABLE, groups_of
from .group_fits import rendered

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_NARROWER, _WIDER = 2.0, 1.3
"""By how much the sigmas of touching columns may be smaller, and larger, than the smaller ones of blobs usually are."""


class Image(NamedTuple):
    """The summed image.

    Attributes
    ----------
    counts
        (y, x).
    valid
        (y, x) where it is known.
    noise
        Standard deviation of a pixel's noise.
    sign
        1 where columns are bright, -1 where they are dark.
    """

    counts: Floats
    valid: Mask
    noise: float
    sign: int


class Trial(NamedTuple):
    """Windows of groups with the same number of members, without the columns around them.

    Attributes
    ----------
    members
        (n, members) numbers of the columns.
    corner
        (n, 2) x and y of the first pixel.
    """

    members: NDArray[np.int64]
    corner: NDArray[np.int64]
    windows: Floats
    masks: Mask


def near(columns: Floats, radius: int) -> NDArray[np.int64]:
    """Return the number of each column's group, where those are joined that are in each other's window; 0: alone."""
    round_ones = columns.copy()
    round_ones[:, [SIGMA_A, SIGMA_B]] = radius / INSEPARABLE
    return groups_of(round_ones)


def trials_of(image: Image, columns: Floats, chosen: Mask, radius: int) -> list[Trial]:
    """Return the windows of all groups with a chosen column, by the number of their members."""
    numbers = near(columns, radius)
    alone = numbers == 0
    numbers[alone] = numbers.max(initial=0) + 1 + np.arange(np.count_nonzero(alone))
    total = rendered(columns, image.counts.shape)
    by_size: dict[tuple[int, int], list[tuple[NDArray[np.int64], NDArray[np.int64]]]] = {}
    for number in np.unique(numbers[chosen]):
        members = np.flatnonzero(numbers == number)
        places = columns[members][:, [X, Y]]
        if len(members) >= MOST_MEMBERS or not np.isfinite(places).all():
            continue
        reach = int(np.ceil(np.ptp(places, axis=0).max() / 2)) + radius
        middle = np.rint((places.min(axis=0) + places.max(axis=0)) / 2).astype(np.int64)
        side = 2 * (-(-reach // 2) * 2) + 1
        by_size.setdefault((len(members), side), []).append((members, middle - side // 2))
    trials = []
    for (_, side), groups in by_size.items():
        members, corner = (np.stack(values) for values in zip(*groups, strict=True))
        windows, masks = [], []
        along = np.arange(side)
        for own, (x, y) in zip(columns[members], corner, strict=True):
            shapes = own.copy()
            shapes[:, [X, Y]] -= (x, y)
            rows, across = (
                np.clip(y + along, 0, image.counts.shape[0] - 1),
                np.clip(x + along, 0, image.counts.shape[1] - 1),
            )
            there = image.valid[np.ix_(rows, across)] & np.outer(rows == y + along, across == x + along)
            disc = np.any([np.hypot(along - c[X], along[:, None] - c[Y]) <= radius for c in shapes], axis=0)
            around = total[np.ix_(rows, across)] - above_background(shapes, along, along[:, None]).sum(axis=0)
            windows.append(image.counts[np.ix_(rows, across)] - around)
            masks.append(there & disc)
        trials.append(Trial(members, corner, np.stack(windows), np.stack(masks)))
    return trials


def _limits(start: Floats, radius: int, sign: int, side: int) -> tuple[Floats, Floats]:
    """Return bounds: the amplitude's sign, places, and sigmas up to the window's radius."""
    lower, upper = start.copy(), start.copy()
    lower[..., AMPLITUDE], upper[..., AMPLITUDE] = (0, np.inf) if sign > 0 else (-np.inf, 0)
    lower[..., [X, Y]] = np.maximum(start[..., [X, Y]] - radius, 0)
    upper[..., [X, Y]] = np.minimum(start[..., [X, Y]] + radius, side - 1)
    lower[..., [SIGMA_A, SIGMA_B]], upper[..., [SIGMA_A, SIGMA_B]] = 0.5, max(radius, 2)
    return lower, upper


def fitted(
    trial: Trial, start: Floats, radius: int, sign: int, sigmas: tuple[float, float] | None = None
) -> tuple[Floats, Floats]:
    """Return fits of one common shape (n, members, 7), and the sums of squares that they leave.

    ``sigmas`` are the least and the largest that columns have; None: those that a window shows.
    """
    lower, upper = _limits(start, radius, sign, trial.windows.shape[-1])
    if sigmas is not None:
        lower[..., [SIGMA_A, SIGMA_B]], upper[..., [SIGMA_A, SIGMA_B]] = sigmas
    bounded = (trial.windows, trial.masks, start, lower, upper)
    fits = fit_shapes(*bounded, shape="shared", tolerance_px=1e-2, max_iterations=25)
    return fits.estimates, fits.squares


class Tried(NamedTuple):
    """What one more column makes of groups: fits (n, members + 1, 7), and sums of squares without it and with it."""

    fits: Floats
    before: Floats
    after: Floats


def with_one_more(trial: Trial, columns: Floats, radius: int, sign: int) -> Tried:
    """Return the fits of groups with one more column, from the better of two starts.

    Without it their shape is free. With it they are about as narrow as blobs are: wider ones, which only noise has,
    would be taken for background.
    """
    usual = float(np.nanmedian(columns[:, SIGMA_B]))
    sigmas = usual / _NARROWER, usual * _WIDER
    start = columns[trial.members].copy()
    start[..., [X, Y]] -= trial.corner[:, None]
    before, squares = fitted(trial, start, radius, sign)
    best, left = fitted(trial, _at_the_peak(trial, before, sign), radius, sign, sigmas)
    split, of_split = fitted(trial, _split(before), radius, sign, sigmas)
    better = of_split < left
    return Tried(np.where(better[:, None, None], split, best), squares, np.where(better, of_split, left))


def _at_the_peak(trial: Trial, before: Floats, sign: int) -> Floats:
    """Return the groups with one more column, at the highest place of what their fit leaves."""
    side = trial.windows.shape[-1]
    along = np.arange(side)
    new = before[:, :1].copy()
    for k, (window, mask, group) in enumerate(zip(trial.windows, trial.masks, before, strict=True)):
        model = group_image(group, along, along[:, None])
        sigma = max(0.7 * float(np.sqrt(group[0, SIGMA_A] * group[0, SIGMA_B])), 0.7)
        left = ndimage.gaussian_filter(np.where(mask, sign * (window - model), 0.0), sigma)
        y, x = np.unravel_index(int(np.argmax(np.where(mask, left, -np.inf))), mask.shape)
        new[k, 0, [X, Y]] = x, y
        new[k, 0, AMPLITUDE] = 0.5 * group[:, AMPLITUDE].mean()
    return np.concatenate([before, new], axis=1)


def _split(before: Floats) -> Floats:
    """Return the groups with their brightest column in two, along the axis in which it is widest."""
    rows = np.arange(len(before))
    which = np.abs(before[..., AMPLITUDE]).argmax(axis=1)
    one = before[rows, which]
    narrow = one[:, SIGMA_B].copy()
    apart = np.maximum(np.sqrt(np.maximum(one[:, SIGMA_A] ** 2 - narrow**2, 0)), 0.7 * narrow)
    by = apart[:, None] * np.column_stack([np.cos(one[:, THETA]), -np.sin(one[:, THETA])])
    more = np.concatenate([before, one[:, None]], axis=1)
    more[rows, which, X : Y + 1] += by
    more[:, -1, X : Y + 1] -= by
    more[..., SIGMA_A] = more[..., SIGMA_B] = narrow[:, None]
    more[rows, which, AMPLITUDE] *= 0.7
    more[:, -1, AMPLITUDE] *= 0.7
    return more


def matched(group: Floats, members: Floats) -> list[int]:
    """Return the order in which the columns of a group are the members, nearest first, and the one that is new."""
    left = list(range(len(group)))
    order = []
    for member in members:
        nearest = min(left, key=lambda k: float(np.hypot(*(group[k] - member)[[X, Y]])))
        order.append(nearest)
        left.remove(nearest)
    return order + left
