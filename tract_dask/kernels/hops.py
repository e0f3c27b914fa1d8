"""A place that hops between two sites, as a hidden Markov model: likelihoods by the forward and backward recursions."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]


@njit(cache=True, nogil=True)
def hop_likelihoods(
    values: Floats, weights: Floats, gaps: Counts, leave: Floats, sites: Floats, apart: float, rounds: int
) -> tuple[Floats, Floats, Floats]:
    """Return how likely a series is where it hops between two sites with each pair of probabilities.

    The sites are the likeliest ones for that pair, by expectation and maximisation (Baum et al. 1970).

    Parameters
    ----------
    values, weights
        (n, 2) places and 1 / variance of each of their coordinates; all finite, weights positive.
    gaps
        (n,) frames since the sample before; the first does not count.
    leave
        (m, 2) probabilities to leave the first and the second site from one frame to the next.
    sites
        (2, 2) to start from.
    apart
        The sites are so far apart at least.
    rounds
        Of expectation and maximisation, for each pair.

    Returns
    -------
    logs
        (m, 3) logarithms of the likelihood, and of the samples that are expected at each site.
    misfit
        (m,) chi squared that is left.
    sites
        (m, 2, 2).
    """
    n, m = len(values), len(leave)
    logs, misfit, found = np.empty((m, 3)), np.empty(m), np.empty((m, 2, 2))
    share, forward = np.empty(n), np.empty((n, 2))
    start = sites.copy()
    for k in range(m):
        place = start.copy()
        for _ in range(rounds):
            _forward_backward(values, weights, gaps, leave[k, 0], leave[k, 1], place, forward, share)
            _move(values, weights, share, apart, place)
        logs[k, 0], misfit[k] = _forward_backward(
            values, weights, gaps, leave[k, 0], leave[k, 1], place, forward, share
        )
        visits = share.sum()
        logs[k, 1], logs[k, 2] = np.log(max(n - visits, 1.0)), np.log(max(visits, 1.0))
        found[k] = place
    return logs, misfit, found


@njit(cache=True, nogil=True)
def _forward_backward(
    values: Floats,
    weights: Floats,
    gaps: Counts,
    first: float,
    second: float,
    sites: Floats,
    forward: Floats,
    share: Floats,
) -> tuple[float, float]:
    """Set ``share`` to the probability of the second site in each sample; return log likelihood and chi squared."""
    n, both = len(values), max(first + second, 1e-12)
    stationary = first / both
    total, misfit = 0.0, 0.0
    for k in range(n):
        if k == 0:
            here = stationary
        else:
            memory = (1.0 - both) ** gaps[k]
            here = stationary + (forward[k - 1, 1] - stationary) * memory
        a, b = 0.0, 0.0
        for axis in range(2):
            a -= 0.5 * weights[k, axis] * (values[k, axis] - sites[0, axis]) ** 2
            b -= 0.5 * weights[k, axis] * (values[k, axis] - sites[1, axis]) ** 2
        highest = max(a, b)
        p, q = (1.0 - here) * np.exp(a - highest), here * np.exp(b - highest)
        total += highest + np.log(p + q)
        forward[k, 0], forward[k, 1] = p / (p + q), q / (p + q)
    share[n - 1] = forward[n - 1, 1]
    for k in range(n - 2, -1, -1):
        memory = (1.0 - both) ** gaps[k + 1]
        stay_b = stationary + (1.0 - stationary) * memory
        come_b = stationary - stationary * memory
        into_b = forward[k, 0] * come_b + forward[k, 1] * stay_b
        from_b = forward[k, 1] * stay_b / max(into_b, 1e-300)
        from_a = forward[k, 1] * (1.0 - stay_b) / max(1.0 - into_b, 1e-300)
        share[k] = min(1.0, share[k + 1] * from_b + (1.0 - share[k + 1]) * from_a)
    for k in range(n):
        for axis in range(2):
            away = (1.0 - share[k]) * (values[k, axis] - sites[0, axis]) ** 2
            away += share[k] * (values[k, axis] - sites[1, axis]) ** 2
            misfit += weights[k, axis] * away
    return total, misfit


@njit(cache=True, nogil=True)
def _move(values: Floats, weights: Floats, share: Floats, apart: float, sites: Floats) -> None:
    """Move the sites to the weighted means of their samples, and apart where they are too near to each other."""
    for axis in range(2):
        first, second, first_sum, second_sum = 1e-12, 1e-12, 0.0, 0.0
        for k in range(len(values)):
            second += weights[k, axis] * share[k]
            second_sum += weights[k, axis] * share[k] * values[k, axis]
            first += weights[k, axis] * (1.0 - share[k])
            first_sum += weights[k, axis] * (1.0 - share[k]) * values[k, axis]
        sites[0, axis] = first_sum / first
        sites[1, axis] = second_sum / second
    distance = np.hypot(sites[1, 0] - sites[0, 0], sites[1, 1] - sites[0, 1])
    if distance < apart:
        part = min(max(share.mean(), 0.02), 0.98)
        for axis in range(2):
            step = (sites[1, axis] - sites[0, axis]) / max(distance, 1e-12)
            if distance < 1e-12:
                step = 1.0 if axis == 0 else 0.0
            more = step * (apart - distance)
            sites[0, axis] -= part * more
            sites[1, axis] += (1.0 - part) * more
