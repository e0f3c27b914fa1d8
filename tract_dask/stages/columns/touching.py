"""Blobs of the summed image that are two columns or more: found by whether one more Gaussian is called for.

Every column is first fitted alone in a wide window. Where that is a good picture of it, and round, that is all.
Elsewhere the columns of the window are fitted together, once as they are and once with one more of the same shape: it
is kept where the residual falls by far more than noise and what the model lacks would make it fall. In a crystal the
blobs are alike: where most of them are pairs, fainter ones are tried with the vector of the others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.fit import fit_gaussians
from ...kernels.gaussian.joint import MOST_MEMBERS
from ...kernels.gaussian.parameters import AMPLITUDE, SIGMA_A, SIGMA_B, X, Y
from .agreed import agreed
from .evidence import Noise, called_for, noise_of
from .relief import binned
from .trials import Floats, Image, Mask, Trial, Tried, matched, near, trials_of, with_one_more

_BINS_PER_SIGMA = 2.0
"""Columns are looked for on bins of the image, so many to a sigma."""
_ELONGATED = 1.15
"""Ratio of the sigmas from which a column may be two: a pair 1.6 sigma apart has 1.28."""
_UNLIKE = 0.05
"""Share of the amplitude, rms, that a column's fit leaves beyond noise, from which it may be two."""
_LEFT = 0.25
"""Quantile of what fits leave, which is noise: most columns are well described."""
_COMMON = 0.3
"""Share of the groups of two and more that call for one more column, from which on they get it."""
_ROUNDS = 2


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
    again, noise, known = _suspects(image, columns, radius), None, list[tuple[Trial, Tried]]()
    for _ in range(MOST_MEMBERS - 1):
        if not again.any():
            break
        found, parent, again, noise, known = _grown(image, found, parent, again, radius, noise)
    for _ in range(_ROUNDS):  # the second without what the first has found around a column
        before = len(found)
        found, parent = agreed(image, found, parent, radius, known)
        if len(found) == before:
            break
        known = []
    return found, parent


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
    left = (1 - fits.r_squared) * windows[:, disc].var(axis=1)
    left -= max(image.noise**2, float(np.quantile(left, _LEFT)))
    amplitude = np.abs(columns[inside, AMPLITUDE])
    unlike = np.sqrt(np.maximum(left, 0)) > _UNLIKE * amplitude
    elongated = fits.estimates[:, SIGMA_A] > _ELONGATED * fits.estimates[:, SIGMA_B]
    suspects = np.zeros(len(columns), np.bool_)
    suspects[inside] = unlike | elongated | ~fits.converged
    return suspects


def _grown(
    image: Image, columns: Floats, parent: NDArray[np.int64], chosen: Mask, radius: int, known: Noise | None
) -> tuple[Floats, NDArray[np.int64], Mask, Noise, list[tuple[Trial, Tried]]]:
    """Return columns, parents, which have changed after one more is tried in each group, the noise, and what was tried.

    Where columns have changed, nothing of that holds any longer.
    """
    found, again = columns.copy(), np.zeros(len(columns), np.bool_)
    added, parents = [], []
    trials = trials_of(image, columns, chosen, radius)
    tried = [with_one_more(trial, columns, radius, image.sign) for trial in trials]
    noise = noise_of(trials, tried, image.noise, known)
    kept = [called_for(trial, one, noise) for trial, one in zip(trials, tried, strict=True)]
    common = _common(trials, kept, near(columns, radius))
    for trial, one, more in zip(trials, tried, kept, strict=True):
        if trial.members.shape[1] not in common:
            continue
        fits = one.fits.copy()
        fits[..., [X, Y]] += trial.corner[:, None]
        for group, members in zip(fits[more], trial.members[more], strict=True):
            order = matched(group, columns[members])
            found[members], again[members] = group[order[:-1]], True
            added.append(group[order[-1]])
            nearest = int(np.hypot(*(group[order[:-1]] - group[order[-1]])[:, [X, Y]].T).argmin())
            parents.append(int(parent[members[nearest]]))
    if not added:
        return columns, parent, again, noise, list(zip(trials, tried, strict=True))
    found = np.concatenate([found, added])
    parent = np.concatenate([parent, parents])
    return found, parent, np.concatenate([again, np.ones(len(added), np.bool_)]), noise, []


def _common(trials: list[Trial], kept: list[Mask], numbers: NDArray[np.int64]) -> set[int]:
    """Return the sizes of groups that get one more column: 1, and those of which many call for it."""
    sizes = np.bincount(numbers[numbers > 0])
    more: dict[int, int] = {}
    for trial, chosen in zip(trials, kept, strict=True):
        more[trial.members.shape[1]] = more.get(trial.members.shape[1], 0) + int(chosen.sum())
    return {size for size, count in more.items() if size == 1 or count >= _COMMON * (sizes >= size).sum()}
