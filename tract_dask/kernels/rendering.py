"""Noise-free images from the model, and Poisson counts drawn from them: numba loops over one frame."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

_REACH = 6.0
"""A column is drawn out to this many sigma, where it has fallen to 1.5e-8 of its height."""

_FEWEST_LEVELS, _MOST_LEVELS = 64, 2048
"""Means for which a table of Poisson probabilities is kept: 80 times the root of the highest, within these bounds."""


@njit(cache=True, nogil=True)
def draw_level(
    image: np.ndarray[Any, Any], lower: np.ndarray[Any, Any], upper: np.ndarray[Any, Any], left: np.ndarray[Any, Any]
) -> None:
    """Fill ``image`` with ``lower[y] + (upper[y] - lower[y]) * left[x]``: two profiles in y, blended along x."""
    for i in range(image.shape[0]):
        base, change = lower[i], upper[i] - lower[i]
        for j in range(image.shape[1]):
            image[i, j] = base + change * left[j]


@njit(cache=True, nogil=True)
def add_columns(
    image: np.ndarray[Any, Any],
    x: np.ndarray[Any, Any],
    y: np.ndarray[Any, Any],
    amplitude: np.ndarray[Any, Any],
    sigma: np.ndarray[Any, Any],
) -> None:
    """Add round Gaussians at (``x``, ``y``), in px, to ``image``; each is a product of two profiles on its patch."""
    rows, columns = image.shape
    longest = int(2 * _REACH * sigma.max()) + 2
    across = np.empty(longest, dtype=np.float32)
    for k in range(x.size):
        if amplitude[k] == 0.0:
            continue
        reach, scale = _REACH * sigma[k], -0.5 / (sigma[k] * sigma[k])
        x0, x1 = max(0, math.ceil(x[k] - reach)), min(columns - 1, math.floor(x[k] + reach))
        y0, y1 = max(0, math.ceil(y[k] - reach)), min(rows - 1, math.floor(y[k] + reach))
        for j in range(x0, x1 + 1):
            across[j - x0] = math.exp(scale * (j - x[k]) ** 2)
        for i in range(y0, y1 + 1):
            height = np.float32(amplitude[k] * math.exp(scale * (i - y[k]) ** 2))
            for j in range(x0, x1 + 1):
                image[i, j] += height * across[j - x0]


class PoissonTable(NamedTuple):
    """Alias tables of Poisson distributions at evenly spaced means from ``low``, ``step`` apart."""

    low: float
    step: float
    first: np.ndarray[Any, np.dtype[np.int64]]
    accept: np.ndarray[Any, np.dtype[np.uint32]]
    alias: np.ndarray[Any, np.dtype[np.uint16]]


def poisson_table(low: float, high: float) -> PoissonTable:
    """Return the tables for means from ``low`` to ``high``, each cut 8 standard deviations from its mean."""
    levels = min(max(int(80 * math.sqrt(high)), _FEWEST_LEVELS), _MOST_LEVELS)
    means = np.linspace(low, high, levels)
    width = int(16 * math.sqrt(high)) + 24
    first = np.maximum(0, means - width / 2).astype(np.int64)
    accept, alias = _alias_tables(means, first, width)
    return PoissonTable(low, max(float(means[1] - means[0]), 1e-12), first, accept, alias)


@njit(cache=True, nogil=True)
def _alias_tables(
    means: np.ndarray[Any, Any], first: np.ndarray[Any, Any], width: int
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Build Walker's alias tables by Vose's method: cell ``c`` yields itself or its alias, all cells equally likely."""
    accept = np.empty((means.size, width), dtype=np.uint32)
    alias = np.empty((means.size, width), dtype=np.uint16)
    share = np.empty(width)
    small, large = np.empty(width, dtype=np.int64), np.empty(width, dtype=np.int64)
    for level in range(means.size):
        mean = max(means[level], 1e-12)
        for c in range(width):
            n = first[level] + c
            share[c] = math.exp(n * math.log(mean) - mean - math.lgamma(n + 1.0))
        share *= width / share.sum()
        n_small = n_large = 0
        for c in range(width):
            accept[level, c], alias[level, c] = np.uint32(0xFFFFFFFF), c
            if share[c] < 1.0:
                small[n_small] = c
                n_small += 1
            else:
                large[n_large] = c
                n_large += 1
        while n_small and n_large:
            n_small -= 1
            poor, rich = small[n_small], large[n_large - 1]
            accept[level, poor], alias[level, poor] = np.uint32(share[poor] * 4294967295.0), rich
            share[rich] -= 1.0 - share[poor]
            if share[rich] < 1.0:
                n_large -= 1
                small[n_small] = rich
                n_small += 1
    return accept, alias


@njit(cache=True, nogil=True)
def draw_counts(
    mean: np.ndarray[Any, Any],
    key: int,
    low: float,
    step: float,
    first: np.ndarray[Any, Any],
    accept: np.ndarray[Any, Any],
    alias: np.ndarray[Any, Any],
) -> np.ndarray[Any, Any]:
    """Return Poisson counts (uint16) with the given means, from the tables of :func:`poisson_table`.

    A mean between two tables takes one of them at random, in proportion, so that the expected count is exact; the
    variance grows by a quarter of ``step`` squared at most (0.1 % of it; 2 % above a thousand counts). One random
    number a pixel (splitmix64 of its index and of ``key``), so a frame depends on its key alone.
    """
    counts = np.empty(mean.shape, dtype=np.uint16)
    last, width, scale = first.size - 1, np.uint64(accept.shape[1]), 1.0 / step
    low_bits, half = np.uint64(0xFFFFFFFF), np.uint64(32)
    state = np.uint64(key)
    for i in range(mean.shape[0]):
        for j in range(mean.shape[1]):
            state += np.uint64(0x9E3779B97F4A7C15)
            z = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            z ^= z >> np.uint64(31)
            position = (mean[i, j] - low) * scale + (z & low_bits) * 2.0**-32
            level = min(max(int(position), 0), last)
            product = (z >> half) * width
            cell = np.int64(product >> half)
            if np.uint32(product & low_bits) > accept[level, cell]:
                cell = np.int64(alias[level, cell])
            counts[i, j] = first[level] + cell
    return counts
