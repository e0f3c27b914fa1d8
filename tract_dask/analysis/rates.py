"""How often columns hop: the rate and its interval from a hidden Markov model of two sites."""

from __future__ import annotations

from typing import NamedTuple

import dask
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..kernels.gaussian.intensity import Floats
from ..kernels.hops import hop_likelihoods
from .motion import frame_times, positions, standard_errors
from .weights import blocks, drawn_together, scatter_of

SMALLEST_HOP = 2.0
"""Hops of so many standard errors of a place, or more, count."""

_GRID = 13
"""Probabilities to leave a site that are tried, for each of both."""
_LEAST, _MOST = 0.1, 0.7
"""They go from so many hops in all frames up to that probability in each."""
_DEEP = 9.0
"""Pairs that are less likely than the best by this logarithm do not count."""
_ROUNDS, _SAMPLES = 4, 8_000
"""Rounds of expectation and maximisation; fewer where a column has more samples than this over the rounds."""
_MISFIT = 5.0
"""A column is not on two sites where chi squared is so many of its standard deviations too large."""
_HALF = 0.5
"""An interval that begins below so many hops in all frames begins at 0."""
_FEWEST = 5
"""Accepted frames from which on there is a rate."""
_PARTS = 64
"""Columns are worked through in so many parts, side by side."""


class HopRate(NamedTuple):
    """Hops between successive frames, for each frame: most likely value, and the interval. NaN: not two sites."""

    rate: float
    low: float
    high: float


def hop_rates(tracks: xr.Dataset, confidence: float) -> tuple[Floats, Floats]:
    """Return rates with their intervals (column, 3) in 1/s, and the smallest hop that counts (column,) in pm.

    Errors are steady ones (:mod:`tract_dask.analysis.weights`), times the scatter that the columns have in common: a
    column that hops at every other frame would hide in its own. NaN where a column is not on two sites, or was accepted
    in fewer than five frames.
    """
    times, frame_time = frame_times(tracks), float(tracks.attrs["frame_time_s"])
    data = list(blocks(positions(tracks), standard_errors(tracks)))
    scatters = np.concatenate([scatter_of(places, errors) for _, places, errors in data])
    factor = float(np.median(drawn_together(scatters)[0]))
    found, smallest = np.full((len(scatters), 3), np.nan), np.full(len(scatters), np.nan)
    for start, places, errors in data:
        scaled = factor * errors
        with np.errstate(invalid="ignore"):
            typical = np.sqrt(np.ma.masked_invalid(scaled**2).mean(axis=(1, 2)).filled(np.nan))
        smallest[start : start + len(places)] = SMALLEST_HOP * typical
        jobs = [
            dask.delayed(_rates_of)(part, places, scaled, times / frame_time, confidence)
            for part in np.array_split(np.arange(len(places)), min(_PARTS, len(places)))
        ]
        parts = dask.compute(*jobs, scheduler="threads")
        found[start : start + len(places)] = np.concatenate(parts) / frame_time
    return found, smallest


def _rates_of(part: NDArray[np.int64], places: Floats, errors: Floats, steps: Floats, confidence: float) -> Floats:
    """Return the rates for each frame of part of a block's columns, (column, 3); ``steps`` are times in frames."""
    found = np.full((len(part), 3), np.nan)
    for row, column in enumerate(part):
        known = np.flatnonzero(np.isfinite(places[column]).all(axis=1) & (errors[column] > 0).all(axis=1))
        if len(known) >= _FEWEST:
            gaps = np.maximum(np.rint(np.diff(steps[known], prepend=0)), 1).astype(np.int64)
            found[row] = hop_rate(places[column, known], errors[column, known], gaps, confidence)
    return found


def hop_rate(values: Floats, errors: Floats, gaps: NDArray[np.int64], confidence: float) -> HopRate:
    """Return how often a series of places hops between two sites.

    Parameters
    ----------
    values, errors
        (n, 2) places and their standard errors, all finite.
    gaps
        (n,) frames from the sample before; the first does not count.
    confidence
        Of the interval.

    Notes
    -----
    With probabilities a and b to leave the one and the other site from frame to frame, hops come at a rate of
    2 a b / (a + b). The likelihood of each pair (a, b) is that of a hidden Markov model (Rabiner 1989) with the sites
    integrated out about their best places. The prior is Jeffreys' for rates, (a b)^(-1/2); the interval leaves out the
    same probability on both sides, and the value is the median.
    """
    typical = float(np.sqrt(np.mean(errors**2)))
    values, weights = (values - values.mean(axis=0)) / typical, (typical / errors) ** 2
    n = len(values)
    rounds = max(1, min(_ROUNDS, _SAMPLES // n))
    sites = _start(values, weights, gaps)
    edges = np.log([[_LEAST / n, _MOST]] * 2)
    for last in (False, True):
        steps = [np.linspace(low, high, _GRID) for low, high in edges]
        pairs = np.exp(np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2))
        logs, misfit, found = hop_likelihoods(values, weights, gaps, pairs, sites, SMALLEST_HOP, rounds)
        score = logs[:, 0] - logs[:, 1] - logs[:, 2] + 0.5 * np.log(pairs).sum(axis=1)
        best = int(np.argmax(score))
        sites = found[best]
        near = np.log(pairs[score > score[best] - _DEEP])
        if last:
            break
        width = (edges[:, 1] - edges[:, 0]) / (_GRID - 1)
        edges = np.stack([near.min(axis=0) - width, near.max(axis=0) + width], axis=1).clip(edges[:, :1], edges[:, 1:])
    if misfit[best] > 2 * n + _MISFIT * np.sqrt(4 * n):
        return HopRate(np.nan, np.nan, np.nan)
    rates = 2 * pairs.prod(axis=1) / pairs.sum(axis=1)
    order = np.argsort(rates)
    weight = np.exp(score - score[best])[order]
    share = (np.cumsum(weight) - 0.5 * weight) / weight.sum()
    tail = (1 - confidence) / 2
    low, middle, high = np.exp(np.interp([tail, 0.5, 1 - tail], share, np.log(rates[order])))
    watched = float(gaps[1:].sum())
    return HopRate(float(middle), float(low) if low * watched > _HALF else 0.0, float(high))


def _start(values: Floats, weights: Floats, gaps: NDArray[np.int64]) -> Floats:
    """Return likely sites: the best of three splits along the direction in which the places scatter most."""
    _, _, (axis, _) = np.linalg.svd(values, full_matrices=False)
    along = values @ axis
    best, sites = -np.inf, np.zeros((2, 2))
    for share in (0.15, 0.5, 0.85):
        upper = along > np.quantile(along, share)
        if not 0 < upper.sum() < len(values):
            continue
        start = np.stack([values[~upper].mean(axis=0), values[upper].mean(axis=0)])
        logs, _, found = hop_likelihoods(values, weights, gaps, np.full((1, 2), 0.2), start, SMALLEST_HOP, 10)
        if logs[0, 0] > best:
            best, sites = float(logs[0, 0]), found[0]
    return sites
