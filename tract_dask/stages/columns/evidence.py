"""Whether the pixels call for one more column: by what it explains, against their noise and what the model lacks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.model import above_background
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, X, Y
from ..groups import TOUCHING
from .group_fits import correlations, shared
from .trials import Floats, Mask, Trial, Tried

NEAREST = 1.2
"""Sigmas between columns of a group."""
_BEYOND_SCHWARZ = 6.0
"""By how much more than Schwarz's criterion asks the squares of the residual, in units of the noise, have to fall."""
_EXPLAINED = 0.5
"""Share of what the residual has beyond noise that one more column has to explain."""
_CLOSE, _FAINTEST, _FAINTEST_APART = 2.8, 0.2, 0.6
"""Sigmas up to which a column belongs to a blob, and its amplitude over that of the brightest: there, and beyond, where
fainter ones are columns of another kind between them."""
_LAGS = 4
"""Pixels over which noise may be correlated."""
_FEWEST_FOR_NOISE = 8
"""Groups that tell how large the noise is."""


class Noise(NamedTuple):
    """Variance of a pixel about fits that are good ones, and by how much more than white noise a column sees of it."""

    variance: float
    shared: float


def noise_of(trials: list[Trial], tried: list[Tried], least: float, known: Noise | None = None) -> Noise:
    """Return what most groups leave after one more column: noise, and what no sum of Gaussians describes.

    Where there are few groups it is what is ``known``, if anything is.
    """
    if known is not None and sum(len(trial.members) for trial in trials) < _FEWEST_FOR_NOISE:
        return known
    left, sharing, there = [], [], []
    for trial, one in zip(trials, tried, strict=True):
        number = trial.masks.sum(axis=(1, 2))
        left += (one.after / np.maximum(number - 4 * one.fits.shape[1], 1)).tolist()
        across, down = (np.arange(side) for side in trial.windows.shape[:0:-1])
        columns = above_background(one.fits, across, down[:, None]).sum(axis=1) * trial.masks
        residual = np.where(trial.masks, trial.windows - columns - one.fits[:, 0, BACKGROUND, None, None], 0)
        sharing.append(correlations(residual, trial.masks, _LAGS))
        power, weight = (np.maximum((values**2).sum(axis=(1, 2)), 1e-300) for values in (residual, columns))
        there += ((columns**2 * residual**2).sum(axis=(1, 2)) / weight * number / power).tolist()
    if not left:
        return Noise(least**2, 1.0)
    seen = shared(np.median(np.concatenate(sharing), axis=0)) * max(1.0, float(np.median(there)))
    return Noise(max(least**2, float(np.median(left))), seen)


def fallen(trial: Trial, tried: Tried, noise: Noise) -> Floats:
    """Return by how much the squares of the residual have fallen, in units of the noise."""
    variance = np.maximum(noise.variance, tried.after / np.maximum(_number(trial) - 4 * tried.fits.shape[1], 1))
    return np.asarray((tried.before - tried.after) / (variance * noise.shared))


def called_for(trial: Trial, tried: Tried, noise: Noise) -> Mask:
    """Return which groups need the column that they have been given: by Schwarz's criterion, and more."""
    asked = 3 * np.log(np.maximum(_number(trial), 2)) + _BEYOND_SCHWARZ
    return (fallen(trial, tried, noise) > asked) & explains(trial, tried, noise) & is_like_columns(tried.fits)


def _number(trial: Trial) -> NDArray[np.int64]:
    return np.asarray(trial.masks.sum(axis=(1, 2)))


def explains(trial: Trial, tried: Tried, noise: Noise) -> Mask:
    """Return in which groups one more column explains most of what the residual has beyond noise."""
    number = _number(trial)
    usual = number * noise.variance
    spread = noise.variance * 3 * np.sqrt(2.0 * number * noise.shared)
    return np.asarray(tried.after - usual < (1 - _EXPLAINED) * np.maximum(tried.before - usual, 0) + spread)


def is_like_columns(fits: Floats) -> Mask:
    """Return in which groups (n, members, 7) distances and amplitudes are those of columns that touch."""
    amplitude = np.abs(fits[..., AMPLITUDE])
    amplitude /= np.maximum(amplitude.max(axis=1, keepdims=True), np.finfo(float).tiny)
    away = fits[:, :, None, [X, Y]] - fits[:, None, :, [X, Y]]
    distance = np.hypot(away[..., 0], away[..., 1])
    distance[:, np.arange(fits.shape[1]), np.arange(fits.shape[1])] = np.inf
    nearest = distance.min(axis=2) / np.sqrt(fits[:, :1, SIGMA_A] * fits[:, :1, SIGMA_B])
    kept = ((nearest > NEAREST) & (nearest < TOUCHING)).all(axis=1)
    return np.asarray(kept & (amplitude > np.where(nearest < _CLOSE, _FAINTEST, _FAINTEST_APART)).all(axis=1))
