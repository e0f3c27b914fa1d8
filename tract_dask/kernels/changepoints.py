"""Where a series of places in the plane changes its mean: the best of all ways to cut it into plateaus."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

_NEVER = -1e300
_LANES = 32


@njit(cache=True, nogil=True)
def plateaus(values: Floats, weights: Floats, penalty: float, shortest: int) -> Indices:
    """Return the first samples of the plateaus after the first, in order: where the series jumps.

    Of all segmentations into plateaus of constant mean, the one whose sum of weighted squared residuals, plus
    ``penalty`` for each jump, is least (optimal partitioning: Jackson et al. 2005), by dynamic programming over the
    last jump; exact, in n²/2 steps.

    Parameters
    ----------
    values, weights
        (n, 2) places and 1 / variance of each of their coordinates; all finite, weights positive.
    penalty
        What a jump must gain in chi squared.
    shortest
        Samples of the shortest plateau, 1 or more.
    """
    n = len(values)
    weight, total = _running(weights, weights), _running(values, weights)
    gain = np.full(n + 1, _NEVER)
    gain[0] = 0.0
    last = np.zeros(n + 1, dtype=np.int64)
    score, lanes = np.empty(n + 1), np.empty(_LANES)
    for stop in range(shortest, n + 1):
        _scores(gain, weight, total, stop, stop - shortest + 1, score)
        last[stop] = _first_of_highest(score, stop - shortest + 1, lanes)
        gain[stop] = score[last[stop]] - penalty  # so every segmentation pays once too often, all alike
    jumps = np.empty(n // shortest + 1, dtype=np.int64)
    found, place = 0, last[n]
    while place > 0:
        jumps[found] = place
        found += 1
        place = last[place]
    return jumps[:found][::-1].copy()


@njit(cache=True, nogil=True)
def gains(values: Floats, weights: Floats, jumps: Indices) -> tuple[Floats, Floats, Floats]:
    """Return what each jump is worth: its step (jump, 2), the step's variance, and the chi squared that it gains.

    The step is the difference of the weighted means of the plateaus on both sides of it; the gain is what taking the
    jump out, and joining its plateaus, would add to the weighted squared residuals.
    """
    weight, total = _running(weights, weights), _running(values, weights)
    step, variance, gain = np.empty((len(jumps), 2)), np.empty((len(jumps), 2)), np.zeros(len(jumps))
    for k in range(len(jumps)):
        start = jumps[k - 1] if k > 0 else 0
        middle, stop = jumps[k], jumps[k + 1] if k + 1 < len(jumps) else len(values)
        for axis in range(2):
            before, after = weight[axis, middle] - weight[axis, start], weight[axis, stop] - weight[axis, middle]
            left, right = total[axis, middle] - total[axis, start], total[axis, stop] - total[axis, middle]
            step[k, axis] = right / after - left / before
            variance[k, axis] = 1.0 / before + 1.0 / after
            gain[k] += step[k, axis] ** 2 / variance[k, axis]
    return step, variance, gain


@njit(cache=True, nogil=True)
def critical_penalty(values: Floats, weights: Floats, shortest: int, least: float) -> float:
    """Return the smallest penalty at which :func:`plateaus` finds no jump, or ``least`` where that is larger.

    It is the highest gain per jump of any segmentation. The penalty is raised to that of the best segmentation until
    the best one has no jumps (Dinkelbach's iteration), which takes two or three rounds.
    """
    penalty = least
    weight, total = _running(weights, weights), _running(values, weights)
    n = len(values)
    whole = total[0, n] ** 2 / weight[0, n] + total[1, n] ** 2 / weight[1, n]
    while True:
        jumps = plateaus(values, weights, penalty, shortest)
        if len(jumps) == 0:
            return penalty
        gain = -whole
        start = 0
        for k in range(len(jumps) + 1):
            stop = jumps[k] if k < len(jumps) else n
            for axis in range(2):
                gain += (total[axis, stop] - total[axis, start]) ** 2 / (weight[axis, stop] - weight[axis, start])
            start = stop
        penalty = max(gain / len(jumps), np.nextafter(penalty, np.inf) * (1 + 1e-12))


@njit(cache=True, nogil=True)
def _running(values: Floats, weights: Floats) -> Floats:
    """Return running sums (2, n + 1) of values times weights, or of the weights alone where both are the same."""
    sums = np.zeros((2, len(values) + 1))
    same = values is weights
    for axis in range(2):
        for k in range(len(values)):
            sums[axis, k + 1] = sums[axis, k] + (weights[k, axis] if same else values[k, axis] * weights[k, axis])
    return sums


@njit(cache=True, nogil=True, error_model="numpy")
def _scores(gain: Floats, weight: Floats, total: Floats, stop: int, n: int, score: Floats) -> None:
    """Set ``score[start]`` to the best gain up to ``start`` plus that of a plateau from there to ``stop``.

    The two quotients share a denominator, since dividing is what takes the time.
    """
    weight_y, weight_x, total_y, total_x = weight[0], weight[1], total[0], total[1]
    end_wy, end_wx, end_y, end_x = weight_y[stop], weight_x[stop], total_y[stop], total_x[stop]
    for start in range(n):
        y, x = end_y - total_y[start], end_x - total_x[start]
        wy, wx = end_wy - weight_y[start], end_wx - weight_x[start]
        score[start] = gain[start] + (y * y * wx + x * x * wy) / (wy * wx)


@njit(cache=True, nogil=True)
def _first_of_highest(score: Floats, n: int, lanes: Floats) -> int:
    """Return the first index at which ``score`` is highest; ``lanes`` lets many maxima be taken side by side."""
    lanes[:] = score[0]
    whole = n - n % _LANES
    for start in range(0, whole, _LANES):
        for lane in range(_LANES):
            lanes[lane] = max(lanes[lane], score[start + lane])
    highest = lanes.max()
    for start in range(whole, n):
        highest = max(highest, score[start])
    start = 0
    while score[start] != highest:
        start += 1
    return start
