"""Whether a column is there: in a frame, at a false-alarm rate that vacuum states; and when it appears or vanishes.

The results hold, for every column and frame, the strength of a matched filter at the column's place (``presence``, see
:mod:`tract_dask.kernels.presence`), and the same at places in vacuum (``presence_vacuum``). In white noise the latter
are standard normal; what they are in these frames, with their detector and their fringes, is what decides.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import stats

from ..errors import SettingsError
from ..kernels.gaussian.intensity import Floats
from ..kernels.presence import best_states
from ..store import schema
from .motion import named

_FEWEST = 50
"""Strengths in vacuum without which theory has to do."""
_TAIL = 50
"""Beyond so many of the highest strengths the normal tail goes on; of few strengths, beyond a tenth of them."""
_BLOCK_BYTES = 256 << 20
_ROUNDS = 20
_WEAKEST = 0.5
"""Mean strength below which a column cannot be told from vacuum at all."""


@dataclass(frozen=True)
class Vacuum:
    """How strong the matched filter is where there is no column.

    Attributes
    ----------
    strengths
        (n,) measured in vacuum, ascending; none: the standard normal distribution of theory.
    mean, sd
        Of the strengths.
    """

    strengths: Floats
    mean: float = 0.0
    sd: float = 1.0

    def p_values(self, strength: NDArray[Any]) -> Floats:
        """Return the probability of such a strength or a higher one in vacuum; NaN where there is none.

        Empirical up to the highest 50 strengths (a tenth of them, if they are fewer than 500). Beyond, it falls on from
        there as a normal distribution of their mean and standard deviation does.
        """
        n = len(self.strengths)
        values = np.asarray(strength, dtype=np.float64)
        normal = stats.norm(self.mean, self.sd)
        if not n:
            return np.asarray(normal.sf(values))
        tail = min(_TAIL, n // 10)
        edge, share = self.strengths[-tail], tail / n
        body = np.interp(values, self.strengths, 1 - np.arange(n) / n)
        beyond = share * normal.sf(np.maximum(values, edge)) / normal.sf(edge)
        return np.where(np.isnan(values), np.nan, np.where(values < edge, body, beyond))


def vacuum_strengths(tracks: xr.Dataset) -> Vacuum:
    """Return what the frames' vacuum says; theory where they show less than 50 windows of it.

    Raises
    ------
    SettingsError
        Where the tracks have no ``presence``.
    """
    _check(tracks)
    return _pooled(tracks["presence_vacuum"].to_numpy())


def _pooled(strengths: NDArray[Any]) -> Vacuum:
    values = np.sort(strengths[np.isfinite(strengths)].astype(np.float64))
    if len(values) < _FEWEST:
        return Vacuum(np.empty(0))
    return Vacuum(values, float(values.mean()), float(values.std(ddof=1)))


def p_values(tracks: xr.Dataset) -> xr.DataArray:
    """Return the probability that vacuum shows as strong a column, (frame, column_id), as lazy as the tracks.

    Parameters
    ----------
    tracks
        Results; whether the fits are accepted does not matter.

    Returns
    -------
    DataArray
        Small where a column is there. NaN where its window leaves the frame, and in bad frames. The attribute
        ``calibration`` says how many strengths in vacuum it rests on, or ``theory``: the normal distribution, with the
        noise of the fits' residuals where no vacuum was found.

    Raises
    ------
    SettingsError
        Where the tracks have no ``presence``.
    """
    vacuum = vacuum_strengths(tracks)
    found = xr.apply_ufunc(vacuum.p_values, tracks["presence"], dask="parallelized", output_dtypes=[np.float64])
    found = named(found, "1", "Probability of such a strength in vacuum")
    return found.assign_attrs(calibration=len(vacuum.strengths) or "theory")


def looked(tracks: xr.Dataset) -> xr.DataArray:
    """Return in which frames each column can be judged, (frame, column_id), as lazy as the tracks.

    A column is there (:func:`present`, :func:`states`), or not there, or nothing is known: its window leaves the frame,
    the frame is bad, or the level of the vacuum does not tell the noise at the column. Not there is therefore
    ``looked(tracks) & ~present(tracks)``.

    Raises
    ------
    SettingsError
        Where the tracks have no ``presence``.
    """
    _check(tracks)
    return named(xr.ufuncs.isfinite(tracks["presence"]), "1", "Whether the frame says if the column is there")


def present(tracks: xr.Dataset, false_alarm_rate: float = 0.01) -> xr.DataArray:
    """Return in which frames each column is there, (frame, column_id), as lazy as the tracks.

    False where it is not there, and where nothing is known: :func:`looked` tells these apart.

    Parameters
    ----------
    tracks
        Results; whether the fits are accepted does not matter.
    false_alarm_rate
        Share of empty places that would be taken for a column.

    Raises
    ------
    SettingsError
        Where the rate is out of range, or the tracks have no ``presence``.
    """
    if not 0 < false_alarm_rate < 1:
        raise SettingsError("the rate is out of range", "false_alarm_rate", "between 0 and 1", f"{false_alarm_rate:g}")
    found = p_values(tracks)
    return named(found <= false_alarm_rate, "1", f"Column present, at a false-alarm rate of {false_alarm_rate:g}")


def false_alarms(tracks: xr.Dataset, rates: Sequence[float] = (0.1, 0.03, 0.01, 0.003, 0.001)) -> xr.Dataset:
    """Return how often :func:`present` finds a column in vacuum that it has not been calibrated on.

    Each half of the frames, the odd and the even ones, is judged by the other half.

    Returns
    -------
    Dataset
        Over rate: ``measured``, the share of strengths in vacuum that pass, with its 95 % interval ``low``, ``high``
        (Clopper and Pearson 1934; places that overlap are not quite independent), and their number ``n``.

    Raises
    ------
    SettingsError
        Where there is too little vacuum for that.
    """
    _check(tracks)
    strengths = tracks["presence_vacuum"].to_numpy()
    halves = strengths[::2], strengths[1::2]
    vacuums = [_pooled(half) for half in halves]
    if not all(len(vacuum.strengths) for vacuum in vacuums):
        raise SettingsError(
            "there is too little vacuum to measure the rate of false alarms",
            "presence_vacuum",
            f"{_FEWEST} strengths in the odd and in the even frames",
            ", ".join(str(int(np.isfinite(half).sum())) for half in halves),
            "Give a vacuum box that holds the fit's window, or more frames",
        )
    judged = np.concatenate(
        [vacuum.p_values(half[np.isfinite(half)]) for vacuum, half in zip(vacuums, halves[::-1], strict=True)]
    )
    levels, n = np.asarray(rates, np.float64), len(judged)
    passed = (judged <= levels[:, None]).sum(axis=1)
    low = np.where(passed > 0, stats.beta.ppf(0.025, passed, n - passed + 1), 0.0)
    high = np.where(passed < n, stats.beta.ppf(0.975, passed + 1, n - passed), 1.0)
    text = "Share of empty places that pass"
    found = {"measured": (passed / n, text), "low": (low, f"{text}, from"), "high": (high, f"{text}, to")}
    rate = {"rate": levels}
    table = xr.Dataset({name: named(xr.DataArray(v, rate, ("rate",)), "1", t) for name, (v, t) in found.items()})
    return table.assign(n=named(xr.DataArray(n), "1", "Strengths in vacuum"))


def appearances(tracks: xr.Dataset, confidence: float = 0.95) -> xr.Dataset:
    """Return when columns appear and vanish, by a two-state test at a stated confidence.

    A column's strength is taken as normal about 0, where it is not there, or about its own mean, where it is; of all
    ways to switch between both the best is found exactly (Viterbi's algorithm), each switch at a cost. Missing frames
    are left out.

    Parameters
    ----------
    tracks
        Results; whether the fits are accepted does not matter.
    confidence
        Between 0 and 1. A column that is always there, or never, shows any event at all with probability 1 -
        ``confidence`` at most, whatever the number of frames.

    Returns
    -------
    Dataset
        Over event, in the order of the frames: ``column_id``, ``frame`` (the first in the new state), ``kind``
        (``appears`` or ``vanishes``), and ``p_value``: a bound on the probability of an event as clear as this one in a
        column that does not change.

    Raises
    ------
    SettingsError
        Where the confidence is out of range, or the tracks have no ``presence``.

    Notes
    -----
    The sum of the logarithms of the likelihood ratio over the frames from a to b exceeds h anywhere with a probability
    of at most n exp(-h), and exp(-h) where a or b is an end of the movie (Ville's inequality, for each a). At a cost c
    for each switch a run costs 2 c, and c at an end, so that n exp(-2 c) + 2 exp(-c) = 1 - ``confidence`` gives c.

    The standard deviation of the strengths is that of their differences from frame to frame, but 1 at least, and the
    same in both states. A column that loses some of its atoms, or wanders away by less than its width, stays present.
    """
    if not 0 < confidence < 1:
        raise SettingsError("the confidence is out of range", "confidence", "between 0 and 1", f"{confidence:g}")
    frames, columns = tracks["frame"].to_numpy(), tracks["column_id"].to_numpy()
    found = [
        (frames[known[switch]], columns[column], bool(states[switch]), p_value)
        for column, known, states, scores in _state_paths(tracks, confidence)
        for switch, p_value in _events(states, scores)
    ]
    found.sort(key=lambda event: event[:2])
    frame, column_id, appears, p = (np.array(part) for part in zip(*found, strict=True)) if found else np.empty((4, 0))
    values: dict[str, tuple[NDArray[Any], str]] = {
        "column_id": (column_id.astype(np.int64), "Column"),
        "frame": (frame.astype(np.int64), "First frame in the new state"),
        "kind": (schema.texts(np.where(appears.astype(bool), "appears", "vanishes")), "What the column does"),
        "p_value": (p.astype(np.float64), "Bound on the probability of such an event in a column that does not change"),
    }
    table = xr.Dataset({k: named(xr.DataArray(v, dims=("event",)), "1", text) for k, (v, text) in values.items()})
    return table.assign_attrs(confidence=confidence)


def states(tracks: xr.Dataset, confidence: float = 0.95) -> xr.DataArray:
    """Return in which frames each column is there by the test of :func:`appearances`, (frame, column_id).

    It judges a frame with the help of those around it, and so sees weaker columns than :func:`present`, but no absence
    of a few frames. False where nothing is known: :func:`looked` tells where. A column that is never there is there in
    any frame with probability 1 - ``confidence`` at most.
    """
    path = xr.zeros_like(tracks["presence"], dtype=np.bool_).compute()
    for column, known, there, _ in _state_paths(tracks, confidence):
        path[{"frame": known, "column_id": column}] = there
    return named(path, "1", f"Column present, by a two-state test at a confidence of {confidence:g}")


def _state_paths(
    tracks: xr.Dataset, confidence: float
) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.bool_], Floats]]:
    """Yield each column's number, its frames, whether it is there in them, and the scores that say so."""
    vacuum = vacuum_strengths(tracks)
    presence = tracks["presence"].transpose("column_id", "frame")
    block = max(1, _BLOCK_BYTES // (4 * max(presence.sizes["frame"], 1)))
    for start in range(0, presence.sizes["column_id"], block):
        rows = presence.isel(column_id=slice(start, start + block)).to_numpy()
        for column, row in enumerate(rows, start):
            known = np.flatnonzero(np.isfinite(row))
            if len(known) > 1:
                yield column, known, *_two_states((row[known] - vacuum.mean) / vacuum.sd, 1 - confidence)


def _two_states(strength: Floats, alpha: float) -> tuple[NDArray[np.bool_], Floats]:
    """Return in which frames a column is there, and the scores: log-likelihood ratios of present over absent.

    The mean strength of the column is found with its states, in turn, from the mean over all frames and from a high
    quantile; of both the more likely result is taken.
    """
    strength = np.asarray(strength, np.float64)
    n = len(strength)
    cost = -np.log((np.sqrt(1 + n * alpha) - 1) / n)
    variance = max(1.0, (np.median(np.abs(np.diff(strength))) / 0.6745) ** 2 / 2)
    best: tuple[float, NDArray[np.bool_], Floats] = (0.0, np.zeros(n, np.bool_), np.zeros(n))
    for mean in (strength.mean(), np.quantile(strength, 0.9)):
        there = np.zeros(n, np.bool_)
        for _ in range(_ROUNDS):
            scores = max(mean, _WEAKEST) * (strength - max(mean, _WEAKEST) / 2) / variance
            before, there = there, best_states(scores, cost)
            if not there.any() or (there == before).all():
                break
            mean = strength[there].mean()
        merit = float(scores[there].sum() - cost * np.count_nonzero(np.diff(there)))
        if merit > best[0]:
            best = merit, there, scores
    _, there, scores = best
    if there.all() and stats.norm.sf(strength.sum() / np.sqrt(n * variance)) > alpha / 2:
        return np.zeros(n, np.bool_), np.zeros(n)  # no switch has a cost here, so the mean itself must speak for it
    return there, scores


def _events(there: NDArray[np.bool_], scores: Floats) -> list[tuple[int, float]]:
    """Return each switch with the bound on its probability by chance: that of the less certain run beside it."""
    switches = np.flatnonzero(np.diff(there)) + 1
    ends = np.concatenate([[0], switches, [len(there)]])
    gain = np.array([abs(scores[a:b].sum()) for a, b in pairwise(ends)])
    chances = np.where((ends[:-1] == 0) | (ends[1:] == len(there)), 1, len(there)) * np.exp(-gain)
    return [(int(switch), min(1.0, float(max(chances[k : k + 2])))) for k, switch in enumerate(switches)]


def _check(tracks: xr.Dataset) -> None:
    missing = [name for name in ("presence", "presence_vacuum") if name not in tracks]
    if missing:
        raise SettingsError(
            "the tracks do not say how present the columns are",
            "tracks",
            "presence and presence_vacuum, as every fit leaves them",
            f"without {', '.join(missing)}",
            "Fit the columns again",
        )
