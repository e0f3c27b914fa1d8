"""How likely each number of atoms is, given an intensity and its error; arrays in, arrays out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from ..kernels.gaussian.intensity import Floats

EMPTY_MEAN, EMPTY_SD = 1.65, 0.62
"""Intensity, in units of its standard error, that a fit finds where there is no column: it looks for the highest place.
Mean and standard deviation over vacuum at 125 to 2500 e/A^2."""
CONFIDENCE = (0.68, 0.95)


@dataclass(frozen=True)
class Levels:
    """What columns of 0, 1, 2 … atoms show, (numbers,): intensity, standard deviation common to all frames, prior."""

    numbers: NDArray[np.int64]
    intensity: Floats
    spread: Floats
    log_prior: Floats


def probabilities(
    intensity: Floats,
    sigma: Floats,
    limit: Floats,
    weak: NDArray[np.bool_],
    n_frames: Floats,
    shape_error: Floats,
    *,
    levels: Levels,
    chosen: bool,
) -> NDArray[np.float32]:
    """Return the probability of each number of atoms, (..., numbers); NaN where nothing is known.

    ``weak`` fits were not accepted, so all that is known is that their intensity is below ``limit``. ``chosen``: the
    intensity is the mean over ``n_frames``, of which only those above ``limit`` were taken.
    """
    shape = np.broadcast_shapes(*(np.shape(a) for a in (intensity, sigma, limit, weak, n_frames, shape_error)))
    logs = np.empty((*shape, len(levels.numbers)), np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        for k, (n, mu) in enumerate(zip(levels.numbers, levels.intensity, strict=True)):
            common = levels.spread[k] ** 2 + (shape_error * mu) ** 2
            mean, sd = (np.sqrt(mu**2 + 2 * sigma**2), sigma) if n else (EMPTY_MEAN * sigma, EMPTY_SD * sigma)
            fainter = log_ndtr((limit - mean) / np.sqrt(sd**2 + common))
            if chosen:
                mean, sd = _cut_off(mean, sd, limit)
            variance = sd**2 / n_frames + common
            seen = -0.5 * ((intensity - mean) ** 2 / variance + np.log(variance))
            logs[..., k] = np.where(weak, fainter, seen) + levels.log_prior[k]
        logs -= logs.max(axis=-1, keepdims=True)
        np.exp(logs, out=logs)
        logs /= logs.sum(axis=-1, keepdims=True)
    return logs


def _cut_off(mean: Floats, sd: Floats, limit: Floats) -> tuple[Floats, Floats]:
    """Return mean and standard deviation of a normal distribution of which only what is above ``limit`` is taken."""
    at = (limit - mean) / sd
    hazard = np.exp(-0.5 * at**2 - log_ndtr(-at)) / np.sqrt(2 * np.pi)
    return mean + sd * hazard, sd * np.sqrt(np.maximum(1 + at * hazard - hazard**2, 1e-6))


def credible_sets(
    probability: NDArray[np.float32], *, numbers: NDArray[np.int64], brightest: int
) -> tuple[NDArray[Any], ...]:
    """Return the most probable number, the ends of the smallest sets that hold 68 % and 95 %, and ambiguity."""
    known = np.isfinite(probability[..., 0])
    ordered = -np.sort(-probability, axis=-1)
    held = np.cumsum(ordered, axis=-1)
    parts = [np.where(known, numbers[np.argmax(probability, axis=-1)], np.nan).astype(np.float32)]
    for level in CONFIDENCE:
        last = np.minimum((held < level).sum(axis=-1), len(numbers) - 1)[..., None]
        member = probability >= np.take_along_axis(ordered, last, axis=-1)
        low, high = np.argmax(member, axis=-1), len(numbers) - 1 - np.argmax(member[..., ::-1], axis=-1)
        parts += [np.where(known, numbers[end], np.nan).astype(np.float32) for end in (low, high)]
    gap = member.sum(axis=-1) < high - low + 1
    return (*parts, known & (gap | ((low <= brightest) & (high > brightest))))
