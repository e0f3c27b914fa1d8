"""Blobs of the summed image that are two columns or more: found by whether one more Gaussian is called for.

Every column is first fitted alone in a wide window. Where that is a good picture of it, and round, that is all.
Elsewhere the columns of the window are fitted together, once as they are and once with one more of the same shape: it
is kept where the residual falls by far more than noise and what the model lacks would make it fall. In a crystal the
blobs are alike: where most of them are pairs, fainter ones are tried with the vector of the others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...kernels.gaussian.fit import fit_gaussians
from ...kernels.gaussian.joint import MOST_MEMBERS
from ...kernels.gaussian.joint_shapes import fit_shapes
from ...kernels.gaussian.model import evaluate
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, THETA, X, Y
from ..groups import INSEPARABLE, TOUCHING, groups_of
from .group_fits import rendered
from .relief import binned

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_BINS_PER_SIGMA = 2.0
"""Columns are looked for on bins of the image, so many to a sigma."""
_ELONGATED = 1.15
"""Ratio of the sigmas from which a column may be two: a pair 1.6 sigma apart has 1.28."""
_UNLIKE = 0.05
"""Share of the amplitude, rms, that a column's fit leaves beyond noise, from which it may be two."""
_BEYOND_SCHWARZ = 6.0
"""By how much more than Schwarz's criterion asks the squares of the residual, in units of the noise, have to fall."""
_AGREED = 5.0
"""The same in all, where the crystal's other blobs say where the second column is."""
_EXPLAINED = 0.5
"""Share of what the residual has beyond noise that one more column has to explain."""
_NEAREST = 1.2
"""Sigmas between columns of a group."""
_CLOSE, _FAINTEST, _FAINTEST_APART = 2.8, 0.2, 0.6
"""Sigmas up to which a column belongs to a blob, and its amplitude over that of the brightest: there, and beyond, where
fainter ones are columns of another kind between them."""
_COMMON = 0.3
"""Share of the groups of two and more that call for one more column, from which on they get it."""
_FEWEST, _ROUNDS = 5, 2
_MOST = 0.5
"""Share of the blobs that are pairs, from which on all may be."""
_ALIKE = 0.15
"""By how much vectors of pairs differ, over their length, where they are alike."""


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


class _Trial(NamedTuple):
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


def touching_columns(image: Image, columns: Floats, radius_px: float) -> tuple[Floats, NDArray[np.int64]]:
    """Return the columns (m, 7) with those that were missing, and which given column each is, or was split from.

    Parameters
    ----------
    columns
        (n, 7) fits of Equation 1 to the image, each alone; NaN where there is none.
    radius_px
        Of the windows in which columns are looked for: half the distance of blobs.
    """
    step = max(1, int(np.nanmedian(columns[:, SIGMA_B]) / _BINS_PER_SIGMA))
    if step > 1:
        whole = binned(image.valid, step) == 1
        coarse = Image(binned(image.counts, step), whole, image.noise / step, image.sign)
        found, parent = touching_columns(coarse, _scaled(columns, 1 / step), radius_px / step)
        return _scaled(found, step), parent
    found, parent = columns.copy(), np.arange(len(columns))
    radius = int(max(radius_px, 3))
    again = _suspects(image, columns, radius)
    for _ in range(MOST_MEMBERS - 1):
        if not again.any():
            break
        found, parent, again = _grown(image, found, parent, again, radius)
    for _ in range(_ROUNDS):  # the second without what the first has found around a column
        found, parent = _agreed(image, found, parent, radius)
    return found, parent


def _near(columns: Floats, radius: int) -> NDArray[np.int64]:
    """Return the number of each column's group, where those are joined that are in each other's window; 0: alone."""
    round_ones = columns.copy()
    round_ones[:, [SIGMA_A, SIGMA_B]] = radius / INSEPARABLE
    return groups_of(round_ones)


def _scaled(columns: Floats, by: float) -> Floats:
    """Return columns in pixels that are smaller by a factor."""
    scaled = columns.copy()
    scaled[:, [X, Y]] = (scaled[:, [X, Y]] + 0.5) * by - 0.5
    scaled[:, [SIGMA_A, SIGMA_B]] *= by
    return scaled


def _suspects(image: Image, columns: Floats, radius: int) -> Mask:
    """Return which columns are elongated, or not well described, in windows of that radius."""
    corner = np.rint(np.nan_to_num(columns[:, [X, Y]], nan=-1e6)).astype(np.int64) - radius
    side = 2 * radius + 1
    inside: Mask = np.all((corner >= 0) & (corner + side <= np.array(image.counts.shape)[::-1]), axis=1)
    inside &= np.isfinite(columns).all(axis=1)
    windows = np.stack(
        [image.counts[y : y + side, x : x + side] for x, y in corner[inside]] or [np.zeros((side, side))]
    )
    if not inside.any():
        return inside
    start = columns[inside].copy()
    start[:, [X, Y]] -= corner[inside]
    lower, upper = np.full(start.shape, -np.inf), np.full(start.shape, np.inf)
    lower[:, [X, Y]], upper[:, [X, Y]] = start[:, [X, Y]] - radius, start[:, [X, Y]] + radius
    lower[:, [SIGMA_A, SIGMA_B]], upper[:, [SIGMA_A, SIGMA_B]] = 0.5, side
    fits = fit_gaussians(windows.astype(np.float32), start, lower, upper, max_iterations=100, radius_px=radius)
    disc = np.hypot(*(np.indices((side, side)) - radius)) <= radius
    left = (1 - fits.r_squared) * windows[:, disc].var(axis=1) - image.noise**2
    amplitude = np.abs(columns[inside, AMPLITUDE])
    unlike = np.sqrt(np.maximum(left, 0)) > _UNLIKE * amplitude
    elongated = fits.estimates[:, SIGMA_A] > _ELONGATED * fits.estimates[:, SIGMA_B]
    suspects = np.zeros(len(columns), np.bool_)
    suspects[inside] = unlike | elongated | ~fits.converged
    return suspects


def _trials(image: Image, columns: Floats, chosen: Mask, radius: int) -> list[_Trial]:
    """Return the windows of all groups with a chosen column, by the number of their members."""
    numbers = _near(columns, radius)
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
            shapes[:, BACKGROUND] = 0
            rows, across = (
                np.clip(y + along, 0, image.counts.shape[0] - 1),
                np.clip(x + along, 0, image.counts.shape[1] - 1),
            )
            there = image.valid[np.ix_(rows, across)] & np.outer(rows == y + along, across == x + along)
            disc = np.any([np.hypot(along - c[X], along[:, None] - c[Y]) <= radius for c in shapes], axis=0)
            around = total[np.ix_(rows, across)] - evaluate(shapes, along, along[:, None]).sum(axis=0)
            windows.append(image.counts[np.ix_(rows, across)] - around)
            masks.append(there & disc)
        trials.append(_Trial(members, corner, np.stack(windows), np.stack(masks)))
    return trials


def _limits(start: Floats, radius: int, sign: int, side: int) -> tuple[Floats, Floats]:
    """Return bounds: the amplitude's sign, places, and sigmas up to the window's radius."""
    lower, upper = start.copy(), start.copy()
    lower[..., AMPLITUDE], upper[..., AMPLITUDE] = (0, np.inf) if sign > 0 else (-np.inf, 0)
    lower[..., [X, Y]] = np.maximum(start[..., [X, Y]] - radius, 0)
    upper[..., [X, Y]] = np.minimum(start[..., [X, Y]] + radius, side - 1)
    lower[..., [SIGMA_A, SIGMA_B]], upper[..., [SIGMA_A, SIGMA_B]] = 0.5, max(radius, 2)
    return lower, upper


def _fitted(trial: _Trial, start: Floats, radius: int, sign: int) -> tuple[Floats, Floats]:
    """Return fits of one common shape (n, members, 7), and the sums of squares that they leave."""
    bounds = _limits(start, radius, sign, trial.windows.shape[-1])
    fits = fit_shapes(trial.windows, trial.masks, start, *bounds, shape="shared", tolerance_px=1e-2, max_iterations=25)
    return fits.estimates, fits.squares


class _Tried(NamedTuple):
    """What one more column makes of groups: fits (n, members + 1, 7), and sums of squares without it and with it."""

    fits: Floats
    before: Floats
    after: Floats


def _grown(
    image: Image, columns: Floats, parent: NDArray[np.int64], chosen: Mask, radius: int
) -> tuple[Floats, NDArray[np.int64], Mask]:
    """Return columns, parents, and which of them have changed, after one more is tried in each group."""
    found, again = columns.copy(), np.zeros(len(columns), np.bool_)
    added, parents = [], []
    trials = _trials(image, columns, chosen, radius)
    tried = [_with_one_more(trial, columns, radius, image.sign) for trial in trials]
    noise = _noise(trials, tried, image.noise)
    for trial, one in zip(trials, tried, strict=True):
        kept = _called_for(trial, one, noise)
        if trial.members.shape[1] > 1 and np.mean(kept) < _COMMON:
            continue
        one.fits[..., [X, Y]] += trial.corner[:, None]
        for group, members in zip(one.fits[kept], trial.members[kept], strict=True):
            order = _matched(group, columns[members])
            found[members], again[members] = group[order[:-1]], True
            added.append(group[order[-1]])
            nearest = int(np.hypot(*(group[order[:-1]] - group[order[-1]])[:, [X, Y]].T).argmin())
            parents.append(int(parent[members[nearest]]))
    if not added:
        return columns, parent, again
    found = np.concatenate([found, added])
    parent = np.concatenate([parent, parents])
    return found, parent, np.concatenate([again, np.ones(len(added), np.bool_)])


def _with_one_more(trial: _Trial, columns: Floats, radius: int, sign: int) -> _Tried:
    """Return the fits of groups with one more column, from the better of two starts."""
    start = columns[trial.members].copy()
    start[..., [X, Y]] -= trial.corner[:, None]
    before, squares = _fitted(trial, start, radius, sign)
    best, left = _fitted(trial, _at_the_peak(trial, before, sign), radius, sign)
    split, of_split = _fitted(trial, _split(before), radius, sign)
    better = of_split < left
    return _Tried(np.where(better[:, None, None], split, best), squares, np.where(better, of_split, left))


class _Noise(NamedTuple):
    """Variance of a pixel about fits that are good ones, and by how much more than white noise a column sees of it."""

    variance: float
    shared: float


def _noise(trials: list[_Trial], tried: list[_Tried], least: float) -> _Noise:
    """Return what most groups leave after one more column: noise, and what no sum of Gaussians describes."""
    left, shared, there = [], [], []
    for trial, one in zip(trials, tried, strict=True):
        number = trial.masks.sum(axis=(1, 2))
        left += (one.after / np.maximum(number - 4 * one.fits.shape[1], 1)).tolist()
        across, down = (np.arange(side) for side in trial.windows.shape[:0:-1])
        for window, mask, group in zip(trial.windows, trial.masks, one.fits, strict=True):
            shapes = group.copy()
            shapes[:, BACKGROUND] = 0
            columns = evaluate(shapes, across, down[:, None]).sum(axis=0) * mask
            residual = np.where(mask, window - columns - group[0, BACKGROUND], 0)
            power = float((residual**2).sum())
            seen = float((columns**2 * residual**2).sum() / max(float((columns**2).sum()), 1e-300))
            steps = float((residual[1:] * residual[:-1]).sum()), float((residual[:, 1:] * residual[:, :-1]).sum())
            along = np.clip(np.array(steps) / max(power, 1e-300), 0, 0.7)
            shared.append(float(np.prod((1 + along) / (1 - along))))
            there.append(seen * mask.sum() / max(power, 1e-300))
    if not left:
        return _Noise(least**2, 1.0)
    return _Noise(max(least**2, float(np.median(left))), float(np.median(shared)) * max(1.0, float(np.median(there))))


def _matched(group: Floats, members: Floats) -> list[int]:
    """Return the order in which the columns of a group are the members, nearest first, and the one that is new."""
    left = list(range(len(group)))
    order = []
    for member in members:
        nearest = min(left, key=lambda k: float(np.hypot(*(group[k] - member)[[X, Y]])))
        order.append(nearest)
        left.remove(nearest)
    return order + left


def _at_the_peak(trial: _Trial, before: Floats, sign: int) -> Floats:
    """Return the groups with one more column, at the highest place of what their fit leaves."""
    side = trial.windows.shape[-1]
    along = np.arange(side)
    new = before[:, :1].copy()
    for k, (window, mask, group) in enumerate(zip(trial.windows, trial.masks, before, strict=True)):
        shapes = group.copy()
        shapes[:, BACKGROUND] = 0
        model = evaluate(shapes, along, along[:, None]).sum(axis=0) + group[0, BACKGROUND]
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


def _called_for(trial: _Trial, tried: _Tried, noise: _Noise, least: float | None = None) -> Mask:
    """Return which groups need the column that they have been given.

    ``least`` is by how much the squares have to fall in units of the noise; None: by Schwarz's criterion, and more.
    """
    number, fits = trial.masks.sum(axis=(1, 2)), tried.fits
    variance = np.maximum(noise.variance, tried.after / np.maximum(number - 4 * fits.shape[1], 1))
    fallen = (tried.before - tried.after) / (variance * noise.shared)
    kept = fallen > (3 * np.log(np.maximum(number, 2)) + _BEYOND_SCHWARZ if least is None else least)
    usual = number * noise.variance
    spread = noise.variance * 3 * np.sqrt(2.0 * number * noise.shared)
    kept &= tried.after - usual < (1 - _EXPLAINED) * np.maximum(tried.before - usual, 0) + spread
    amplitude = np.abs(fits[..., AMPLITUDE]) / np.abs(fits[..., AMPLITUDE]).max(axis=1, keepdims=True)
    away = fits[:, :, None, [X, Y]] - fits[:, None, :, [X, Y]]
    distance = np.hypot(away[..., 0], away[..., 1])
    distance[:, np.arange(fits.shape[1]), np.arange(fits.shape[1])] = np.inf
    nearest = distance.min(axis=2) / np.sqrt(fits[:, :1, SIGMA_A] * fits[:, :1, SIGMA_B])
    kept &= ((nearest > _NEAREST) & (nearest < TOUCHING)).all(axis=1)
    kept &= (amplitude > np.where(nearest < _CLOSE, _FAINTEST, _FAINTEST_APART)).all(axis=1)
    return np.asarray(kept)


def _agreed(image: Image, columns: Floats, parent: NDArray[np.int64], radius: int) -> tuple[Floats, NDArray[np.int64]]:
    """Return columns and parents, with second columns where most of the blobs have one at the same vector."""
    numbers = _near(columns, radius)
    size = np.where(numbers > 0, np.bincount(numbers)[numbers], 1)
    single = np.isfinite(columns).all(axis=1) & (size == 1)
    pairs = [np.flatnonzero(numbers == number) for number in np.unique(numbers[size == 2])]
    trials = [trial for trial in _trials(image, columns, single, radius) if trial.members.shape[1] == 1]
    tried = [_with_one_more(trial, columns, radius, image.sign) for trial in trials]
    noise = _noise(trials, tried, image.noise)
    among = [columns[other] - columns[one] for one, other in pairs]
    shapes, fallen = [columns[one] for one, _ in pairs], [np.inf] * len(pairs)
    for trial, own in zip(trials, tried, strict=True):
        number = trial.masks.sum(axis=(1, 2))
        variance = np.maximum(noise.variance, own.after / np.maximum(number - 8, 1)) * noise.shared
        among += list(own.fits[:, 1] - own.fits[:, 0])
        shapes += list(own.fits[:, 0])
        fallen += ((own.before - own.after) / variance).tolist()
    usual, alike = _usual(np.array(among).reshape(-1, 7)[:, [X, Y]])
    if np.count_nonzero(alike) < max(_FEWEST, _MOST * len(alike)) or np.median(np.array(fallen)[alike]) < _AGREED:
        return columns, parent
    shape = np.median(np.array(shapes)[alike], axis=0)
    if np.hypot(*usual) < _NEAREST * np.sqrt(shape[SIGMA_A] * shape[SIGMA_B]):
        return columns, parent
    found, added, parents = columns.copy(), [], []
    tried = [_as_the_others(trial, columns, shape, usual, (radius, image.sign)) for trial in trials]
    noise = _noise(trials, tried, image.noise)
    for trial, one in zip(trials, tried, strict=True):
        kept = _called_for(trial, one, noise, _AGREED)
        one.fits[..., [X, Y]] += trial.corner[:, None]
        for pair, (member,) in zip(one.fits[kept], trial.members[kept], strict=True):
            order = _matched(pair, columns[[member]])
            found[member] = pair[order[0]]
            added.append(pair[order[1]])
            parents.append(int(parent[member]))
    if not added:
        return columns, parent
    return np.concatenate([found, added]), np.concatenate([parent, parents])


def _usual(vectors: Floats) -> tuple[Floats, Mask]:
    """Return the vector (x, y) that most of the vectors (n, 2), of either sign, are like, and which ones are."""
    alike = np.zeros(len(vectors), np.bool_)
    if not len(vectors):
        return np.zeros(2), alike
    length = np.hypot(*vectors.T)
    for vector, own in zip(vectors, length, strict=True):
        away = np.minimum(np.hypot(*(vectors - vector).T), np.hypot(*(vectors + vector).T))
        near = away < _ALIKE * own
        if near.sum() > alike.sum():
            alike, usual = near, vector
    turned = np.where(((vectors @ usual) < 0)[:, None], -vectors, vectors)
    return np.median(turned[alike], axis=0), alike


def _as_the_others(trial: _Trial, columns: Floats, shape: Floats, vector: Floats, how: tuple[int, int]) -> _Tried:
    """Return fits of columns with a second one at about that vector, on either side of it or around it."""
    start = columns[trial.members].copy()
    start[..., [X, Y]] -= trial.corner[:, None]
    _, squares = _fitted(trial, start, *how)
    best, left = np.repeat(start, 2, axis=1), squares.copy()
    for by in (-vector, -0.5 * vector, 0 * vector):
        pair = np.repeat(start, 2, axis=1)
        pair[:, 0, [X, Y]] += by
        pair[:, 1, [X, Y]] += by + vector
        pair[..., [SIGMA_A, SIGMA_B, THETA]] = shape[[SIGMA_A, SIGMA_B, THETA]]
        fits, own = _fitted(trial, pair, *how)
        like = np.hypot(*(fits[:, 1, [X, Y]] - fits[:, 0, [X, Y]] - vector).T) < 3 * _ALIKE * np.hypot(*vector)
        better = like & (own < left)
        best, left = np.where(better[:, None, None], fits, best), np.where(better, own, left)
    return _Tried(best, squares, left)
