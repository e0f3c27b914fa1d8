"""Second columns of blobs at the vector that the crystal's other blobs have.

In a crystal of pairs the vector and the shape are known far better than any one blob tells. So a blob is a pair where
two columns of the usual shape, about that vector apart, describe it as well as one column of any likely shape
does, and where one column of the usual shape does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.parameters import SIGMA_A, SIGMA_B, THETA, X, Y
from .evidence import NEAREST, Noise, explains, fallen, is_like_columns, noise_of
from .trials import Floats, Image, Mask, Trial, Tried, fitted, matched, near, trials_of, with_one_more

_TELLING = 9.0
"""By how much the squares of the residual have to fall, in units of the noise, where a blob tells of the vector."""
_FEWEST, _MOST = 5, 0.5
"""Blobs that tell of the vector, and the share of them that have it."""
_SHARE = 0.2
"""Share of all blobs that have it for sure, from which others may have it."""
_SAMPLE = 24
"""Blobs that are tried first: where hardly any of these tells of a vector, the others are not tried."""
_ALIKE, _ABOUT = 0.2, 0.45
"""By how much vectors differ, over their length, where they are alike; and where a blob may have the usual one."""
_AS_WIDE = 1.1
"""By how much the sigmas of such columns differ from the usual ones."""
_ANY = 1.5
"""By how much the sigmas of one column in place of a pair differ from the usual ones: no atom is wider by more."""
_PRESENT, _AGAINST = 25.0, 4.0
"""What the second column has to explain, in units of the noise; and by how much one column of another shape may be
better: as much as is likely of a blob among others that are pairs."""


class _Usual(NamedTuple):
    """The vector (x, y) from one column of a pair to the other, and the shape (7,) of a column."""

    vector: Floats
    shape: Floats


def agreed(
    image: Image, columns: Floats, parent: NDArray[np.int64], radius: int, known: Sequence[tuple[Trial, Tried]] = ()
) -> tuple[Floats, NDArray[np.int64]]:
    """Return columns and parents, with second columns where most of the blobs have one at the same vector.

    ``known``: what one more column makes of some of the columns, as they are.
    """
    numbers = near(columns, radius)
    size = np.where(numbers > 0, np.bincount(numbers)[numbers], 1)
    single = np.isfinite(columns).all(axis=1) & (size == 1)
    pairs = [columns[numbers == number] for number in np.unique(numbers[size == 2])]
    alone = [(trial, one) for trial, one in known if trial.members.shape[1] == 1]
    for trial, _ in alone:
        single[trial.members] = False
    rest = np.flatnonzero(single)
    some = np.isin(np.arange(len(columns)), rest[:: max(1, len(rest) // _SAMPLE)])
    for chosen in (some, single & ~some):
        alone += [
            (trial, with_one_more(trial, columns, radius, image.sign))
            for trial in trials_of(image, columns, chosen, radius)
        ]
        trials, tried = [trial for trial, _ in alone], [one for _, one in alone]
        noise = noise_of(trials, tried, image.noise)
        if chosen is some and _hopeless(pairs, trials, tried, noise, int(np.count_nonzero(single & ~some))):
            return columns, parent
    usual = _usual(pairs, trials, tried, noise)
    if usual is None:
        return columns, parent
    found, added, parents = columns.copy(), [], []
    for trial in trials:
        fits, kept = _as_the_others(trial, columns, usual, noise, (radius, image.sign))
        fits[..., [X, Y]] += trial.corner[:, None]
        for pair, (member,) in zip(fits[kept], trial.members[kept], strict=True):
            order = matched(pair, columns[[member]])
            found[member] = pair[order[0]]
            added.append(pair[order[1]])
            parents.append(int(parent[member]))
    if not added:
        return columns, parent
    return np.concatenate([found, added]), np.concatenate([parent, parents])


def _hopeless(pairs: list[Floats], trials: list[Trial], tried: list[Tried], noise: Noise, left: int) -> bool:
    """Return whether so few blobs tell of a vector that the ``left`` ones will not make them enough."""
    number = sum(len(trial.members) for trial in trials)
    told = len(_telling(trials, tried, noise))
    most = len(pairs) + told + (told + 2 * np.sqrt(told + 1)) / max(number, 1) * left
    return bool(most < max(_FEWEST, _SHARE * (len(pairs) + number + left)))


def _telling(trials: list[Trial], tried: list[Tried], noise: Noise) -> list[Floats]:
    """Return the pairs that a second column makes of the blobs that tell of a vector."""
    return [
        pair
        for trial, own in zip(trials, tried, strict=True)
        for pair in own.fits[(fallen(trial, own, noise) > _TELLING) & is_like_columns(own.fits)]
    ]


def _usual(pairs: list[Floats], trials: list[Trial], tried: list[Tried], noise: Noise) -> _Usual | None:
    """Return what pairs, and blobs in which a second column was tried, have in common; None where it is nothing."""
    blobs = len(pairs) + sum(len(trial.members) for trial in trials)
    both = np.array([*pairs, *_telling(trials, tried, noise)]).reshape(-1, 2, 7)
    vector, alike = _most_alike(both[:, 1, [X, Y]] - both[:, 0, [X, Y]])
    if np.count_nonzero(alike) < max(_FEWEST, _MOST * len(both), _SHARE * blobs):
        return None
    shape = np.median(both[alike].reshape(-1, 7), axis=0)
    if np.hypot(*vector) < NEAREST * np.sqrt(shape[SIGMA_A] * shape[SIGMA_B]):
        return None
    return _Usual(vector, shape)


def _most_alike(vectors: Floats) -> tuple[Floats, Mask]:
    """Return the vector (x, y) that most of the vectors (n, 2), of either sign, are like, and which ones are."""
    alike = np.zeros(len(vectors), np.bool_)
    if not len(vectors):
        return np.zeros(2), alike
    length = np.hypot(*vectors.T)
    for vector, own in zip(vectors, length, strict=True):
        away = np.minimum(np.hypot(*(vectors - vector).T), np.hypot(*(vectors + vector).T))
        like = away < _ALIKE * own
        if like.sum() > alike.sum():
            alike, usual = like, vector
    turned = np.where(((vectors @ usual) < 0)[:, None], -vectors, vectors)
    return np.median(turned[alike], axis=0), alike


def _as_the_others(
    trial: Trial, columns: Floats, usual: _Usual, noise: Noise, how: tuple[int, int]
) -> tuple[Floats, Mask]:
    """Return pairs (n, 2, 7) at about the usual vector, beside a column or around it, and which are there."""
    start = columns[trial.members].copy()
    start[..., [X, Y]] -= trial.corner[:, None]
    one = start.copy()
    one[..., [SIGMA_A, SIGMA_B, THETA]] = usual.shape[[SIGMA_A, SIGMA_B, THETA]]
    sigmas, wide = ((usual.shape[SIGMA_B] / by, usual.shape[SIGMA_A] * by) for by in (_AS_WIDE, _ANY))
    _, free = fitted(trial, start, *how, sigmas=wide)
    _, alone = fitted(trial, one, *how, sigmas=sigmas)
    best, left = np.repeat(one, 2, axis=1), np.full(len(one), np.inf)
    for by in (-usual.vector, -0.5 * usual.vector, 0 * usual.vector):
        pair = np.repeat(one, 2, axis=1)
        pair[:, 0, [X, Y]] += by
        pair[:, 1, [X, Y]] += by + usual.vector
        fits, squares = fitted(trial, pair, *how, sigmas=sigmas)
        away = fits[:, 1, [X, Y]] - fits[:, 0, [X, Y]] - usual.vector
        better = (np.hypot(*away.T) < _ABOUT * np.hypot(*usual.vector)) & (squares < left)
        best, left = np.where(better[:, None, None], fits, best), np.where(better, squares, left)
    there = np.isfinite(left) & is_like_columns(best)
    left = np.where(there, left, alone)
    there &= fallen(trial, Tried(best, alone, left), noise) > _PRESENT
    there &= fallen(trial, Tried(best, free, left), noise) > -_AGAINST
    return best, there & explains(trial, Tried(best, np.maximum(free, left), left), noise)
