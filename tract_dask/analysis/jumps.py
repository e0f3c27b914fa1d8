"""When the columns jump: the original's threshold, a change-point test, the rate of jumps, the barrier it implies."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import dask
import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.special import gammainccinv, gammaincinv

from ..errors import SettingsError
from ..kernels.changepoints import gains, plateaus
from ..kernels.gaussian.intensity import Floats
from ..store import schema
from .motion import frame_times, named, positions, standard_errors
from .rates import hop_rates
from .weights import blocks, drawn_together, scatter_of

_PARTS = 64
"""A block is worked through in so many parts, side by side."""
_BOLTZMANN_EV = 8.617333262e-5


def threshold_jumps(tracks: xr.Dataset, threshold_pm: float) -> xr.Dataset:
    """Return the jumps by the original's rule.

    A column jumps into a frame where both its distance from the frame before and that from its mean place are above
    the threshold. Where either frame has no accepted fit there is no jump.

    Parameters
    ----------
    tracks
        Results; only accepted fits count.
    threshold_pm
        In pm. A column that keeps still exceeds it by chance with probability exp(-t² / 4σ²) a frame, at most, where
        σ is its error per axis; :func:`change_points` takes account of the errors by itself.

    Returns
    -------
    Dataset
        Over jump, in the order of the frames: ``column_id``, ``frame`` (the first at the new place), ``step``
        (jump, axis) and its length ``size``, in pm.

    Raises
    ------
    SettingsError
        Where the threshold is not above 0.
    """
    if not threshold_pm > 0:
        raise SettingsError("the threshold is out of range", "threshold_pm", "above 0 pm", f"{threshold_pm:g}")
    place = positions(tracks)
    step = place - place.shift(frame=1)
    away = place - place.mean("frame").compute()  # first, so that the places need not be kept until it is known
    above = ((step**2).sum("axis") > threshold_pm**2) & ((away**2).sum("axis") > threshold_pm**2)
    frame, column = np.nonzero(above.transpose("frame", "column_id").to_numpy())
    steps = step.isel(frame=xr.DataArray(frame, dims="jump"), column_id=xr.DataArray(column, dims="jump"))
    table = _table(
        tracks["column_id"].to_numpy()[column],
        tracks["frame"].to_numpy()[frame],
        steps.transpose("jump", "axis").to_numpy(),
    )
    return table.assign_attrs(threshold_pm=threshold_pm)


def change_points(tracks: xr.Dataset, confidence: float = 0.95, shortest: int = 2) -> xr.Dataset:
    """Return the jumps that a change-point test finds at a stated confidence.

    Each column's places are cut into plateaus of constant mean, by the segmentation that has the least weighted squared
    residuals plus a penalty for each jump; it is found exactly. Missing frames are left out. The penalty is such that
    a column that keeps still shows any jump at all with probability 1 - ``confidence``, whatever the number of frames.

    Parameters
    ----------
    tracks
        Results; only accepted fits count.
    confidence
        Between 0 and 1.
    shortest
        Frames of the shortest plateau. 2: a single wild fit is no jump.

    Returns
    -------
    Dataset
        Over jump, in the order of the frames: ``column_id``, ``frame`` (the first at the new place), ``step``
        (jump, axis) between the means of the plateaus before and after with its ``stderr``, its length ``size``, in
        pm, and ``p_value``, the probability that a column that keeps still shows any jump as clear as this one.

    Raises
    ------
    SettingsError
        Where the confidence or the shortest plateau is out of range.

    Notes
    -----
    Errors are what the fits of the column state around a frame, as a median that does not follow the noise of one
    frame (:mod:`tract_dask.analysis.weights`), times the factor of :func:`noise_factor`. Noise is taken as independent
    from frame to frame. A column that wanders is cut into steps.
    """
    if not 0 < confidence < 1:
        raise SettingsError("the confidence is out of range", "confidence", "between 0 and 1", f"{confidence:g}")
    if shortest < 1:
        raise SettingsError("a plateau needs a frame", "shortest", "1 or more", f"{shortest}")
    factors = noise_factor(tracks)
    found: list[tuple[NDArray[Any], ...]] = []
    for start, places, errors in blocks(positions(tracks), standard_errors(tracks)):
        own = factors.isel(column_id=slice(start, start + len(places)))
        scaled, degrees = errors * own["factor"].to_numpy()[:, None, None], own["degrees"].to_numpy()
        jobs = [
            dask.delayed(_jumps_of)(part, places, scaled, degrees, confidence, shortest)
            for part in np.array_split(np.arange(len(places)), min(_PARTS, len(places)))
        ]
        for column, *jumps in dask.compute(*jobs, scheduler="threads"):
            found.append((start + column, *jumps))
    column, frame, step, stderr, p_value = (np.concatenate(parts) for parts in zip(*found, strict=True))
    order = np.lexsort((column, frame))
    table = _table(
        tracks["column_id"].to_numpy()[column[order]],
        tracks["frame"].to_numpy()[frame[order]],
        step[order],
    )
    table["stderr"] = named(table["step"].copy(data=stderr[order]), "pm", "Standard error of the step")
    table["p_value"] = named(table["size"].copy(data=p_value[order]), "1", "Probability of such a jump without motion")
    return table.assign_attrs(confidence=confidence, shortest=shortest)


def noise_factor(tracks: xr.Dataset) -> xr.Dataset:
    """Return by what factor the places scatter more from frame to frame than the fits' errors say.

    From the differences between successive accepted frames in units of their error, cut at 2.5 standard deviations,
    which leaves out jumps. Each column's estimate is drawn towards the median of all columns as far as the scatter
    among them says that it is chance (empirical Bayes on the logarithm of the variance), but by no more than two of its
    standard errors.

    Parameters
    ----------
    tracks
        Results; only accepted fits count.

    Returns
    -------
    Dataset
        Over column_id: ``factor`` (1: the errors are right), and ``degrees``, the degrees of freedom with which it is
        known. 1 and 1 where no column has two frames.
    """
    parts = [scatter_of(*block[1:]) for block in blocks(positions(tracks), standard_errors(tracks))]
    factor, degrees = drawn_together(np.concatenate(parts))
    columns = {"column_id": tracks["column_id"]}
    return xr.Dataset(
        {
            "factor": named(xr.DataArray(factor, columns, ("column_id",)), "1", "Scatter over stated error"),
            "degrees": named(xr.DataArray(degrees, columns, ("column_id",)), "1", "Degrees of freedom of the factor"),
        }
    )


def jump_rate(jumps: xr.Dataset, tracks: xr.Dataset, confidence: float = 0.95) -> xr.Dataset:
    """Return how often each column jumps, with an interval.

    Jumps of :func:`change_points` are those that a test is sure of; a column that hops fast, or by little, makes more.
    Its rate comes from a hidden Markov model of two sites (:mod:`tract_dask.analysis.rates`). Jumps of another table,
    and those of a column that is on more than two sites, are counted, with the exact interval for a Poisson process
    (Garwood 1936).

    Parameters
    ----------
    jumps
        From :func:`threshold_jumps` or :func:`change_points`.
    tracks
        The results in which they were found. A column is watched from each accepted frame to the next: for the time
        between them where they follow each other, also where the camera lost frames between them; for one frame time
        where fits between them were not accepted.
    confidence
        Of the interval.

    Returns
    -------
    Dataset
        Over column_id: ``n`` jumps of the table, the ``rate`` and its interval from ``low`` to ``high``, in 1/s; NaN
        for a column that was not seen in two frames. ``counted``, whether the rate is a count. ``smallest``, in pm: a
        column may hop by less, unseen (two standard errors of a place; NaN where jumps were counted). Jumps between one
        frame and the next count once.

    Notes
    -----
    The interval of the model is that of equal tails under Jeffreys' prior. On made columns that hop by two or more
    errors with probabilities of 0.02 to 0.4 a frame, 95 % intervals hold the truth in 95 to 99 % of 40 frames. Where a
    movie cannot tell, they are wide: 0.005 to 0.2 a frame for a column that shows no hop in 40 frames.

    Raises
    ------
    SettingsError
        Where the time of a frame is not known, or the confidence is out of range.
    """
    if not 0 < confidence < 1:
        raise SettingsError("the confidence is out of range", "confidence", "between 0 and 1", f"{confidence:g}")
    n = (tracks["column_id"] == jumps["column_id"].rename(None)).sum("jump").to_numpy()
    seen = positions(tracks).notnull().all("axis").transpose("frame", "column_id").to_numpy()
    watched = _watched(seen, frame_times(tracks), float(tracks.attrs["frame_time_s"]))
    time = np.where(watched > 0, watched, np.nan)
    tail = (1 - confidence) / 2
    low, high = np.where(n > 0, gammaincinv(np.maximum(n, 1), tail), 0.0), gammainccinv(n + 1, tail)
    rates = np.stack([n / time, low / time, high / time], axis=1)
    smallest, counted = np.full(len(n), np.nan), np.ones(len(n), np.bool_)
    if "shortest" in jumps.attrs:
        of_model, smallest = hop_rates(tracks, confidence)
        counted = np.isnan(of_model[:, 0])
        of_model[:, 0] = np.where((n == 0) & (of_model[:, 1] == 0), 0.0, of_model[:, 0])
        rates, smallest = np.where(counted[:, None], rates, of_model), np.where(counted, np.nan, smallest)
    found = {
        "rate": (rates[:, 0], "1/s", "Jumps for each second"),
        "low": (rates[:, 1], "1/s", f"Lower end of the {confidence:.0%} interval of the rate"),
        "high": (rates[:, 2], "1/s", f"Upper end of the {confidence:.0%} interval of the rate"),
        "n": (n, "1", "Jumps"),
        "counted": (counted, "1", "Whether the rate is that of the jumps in the table"),
        "smallest": (smallest, "pm", "Smallest hop that counts"),
    }
    columns = {"column_id": tracks["column_id"]}
    return xr.Dataset(
        {
            name: named(xr.DataArray(values, columns, ("column_id",)), unit, text)
            for name, (values, unit, text) in found.items()
        },
        attrs={"confidence": confidence},
    )


def _watched(seen: NDArray[np.bool_], times: Floats, frame_time: float) -> Floats:
    """Return for how long (columns,) each column is watched, s; ``seen`` (frames, columns), ``times`` (frames,)."""
    both = seen[1:] & seen[:-1]
    after_gaps = np.maximum(seen.sum(axis=0) - 1, 0) - both.sum(axis=0)
    watched: Floats = np.diff(times) @ both + frame_time * after_gaps
    return watched


def activation_energy(rate: xr.Dataset, temperature_k: float, attempt_frequency_hz: float = 1e13) -> xr.Dataset:
    """Return the barrier that a rate of thermally activated jumps implies: E = kT ln(attempt frequency / rate).

    Parameters
    ----------
    rate
        From :func:`jump_rate`.
    temperature_k
        Of the specimen, K.
    attempt_frequency_hz
        1e13, the original's, is about the frequency of a lattice vibration.

    Returns
    -------
    Dataset
        Over column_id: ``energy`` with its interval from ``low`` to ``high``, in eV. Where no jump was seen, the energy
        and ``high`` are infinite, and ``low`` is what the watching rules out.

    Raises
    ------
    SettingsError
        Where the temperature or the frequency is not above 0.

    Notes
    -----
    The original takes kT = 0.025 eV, and the number of jumps in the movie for their rate. Jumps that the beam drives
    are not thermally activated: the energy then means nothing.
    """
    for name, value in (("temperature_k", temperature_k), ("attempt_frequency_hz", attempt_frequency_hz)):
        if not value > 0:
            raise SettingsError("the value is out of range", name, "above 0", f"{value:g}")
    found = {}
    for name, source, text in (
        ("energy", "rate", "Activation energy"),
        ("low", "high", "Lower end of its interval"),
        ("high", "low", "Upper end of its interval"),
    ):
        with np.errstate(divide="ignore"):
            energy = _BOLTZMANN_EV * temperature_k * xr.ufuncs.log(attempt_frequency_hz / rate[source])
        found[name] = named(energy, "eV", text)
    return xr.Dataset(found, attrs={"temperature_k": temperature_k, "attempt_frequency_hz": attempt_frequency_hz})


def chance(gain: Floats | float, n: int) -> Floats:
    """Return the probability that n frames of a column that keeps still gain as much, in chi squared, by any jump.

    A jump pays for itself alone (first term; Csörgő and Horváth 1997 give its form) or with its neighbour, as the two
    ends of a short excursion (second term). Coefficients from simulations of n = 6 to 2500 frames with plateaus of two
    frames or more, with which it agrees within about 20 % for probabilities from 0.01 to 0.3; beyond, it extrapolates.
    """
    gain = np.maximum(np.asarray(gain, dtype=np.float64), 2.0)
    alone = 0.57 * gain * max(np.log(n) - 1.5, 0.1) * np.exp(-gain / 2)
    pairs = 0.17 * n * gain**2 * np.exp(-gain)
    return np.asarray(-np.expm1(-alone - pairs))


@lru_cache(maxsize=4096)
def _penalty(confidence: float, n: int) -> float:
    """Return the gain that a jump needs: the inverse of :func:`chance`."""
    most = 4 * np.log(n) - 4 * np.log1p(-confidence) + 50

    def excess(gain: float) -> float:
        return float(np.log(chance(gain, n)) - np.log1p(-confidence))

    from scipy.optimize import brentq  # takes its time, and a report of a run does not need it

    return 2.0 if excess(4.0) <= 0 else float(brentq(excess, 4.0, most))


def _jumps_of(
    part: NDArray[np.int64], places: Floats, errors: Floats, degrees: Floats, confidence: float, shortest: int
) -> tuple[NDArray[Any], ...]:
    """Return the columns of the jumps of part of a block, and what :func:`_jumps` says of them."""
    found = [_jumps(places[k], errors[k], degrees[k], confidence, shortest) for k in part]
    column = np.repeat(part, [len(jumps[0]) for jumps in found])
    return column, *(np.concatenate(values) for values in zip(*found, strict=True))


def _jumps(
    place: Floats, error: Floats, degrees: float, confidence: float, shortest: int
) -> tuple[NDArray[np.int64], Floats, Floats, Floats]:
    """Return the frames, steps, their errors and the p-values of the jumps of one column.

    The factor of the errors is itself known with some degrees of freedom only, so a gain counts as chi squared of
    degrees ln(1 + gain / degrees), which has the tail of Fisher's F.
    """
    frames = np.flatnonzero(np.isfinite(place).all(axis=1) & (error > 0).all(axis=1))
    n = len(frames)
    if n < 2 * shortest:
        return np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2)), np.empty(0)
    values, weights = place[frames] - place[frames].mean(axis=0), error[frames] ** -2.0
    penalty = degrees * np.expm1(_penalty(confidence, n) / degrees)
    jumps = plateaus(values, weights, penalty, shortest)
    step, variance, gain = gains(values, weights, jumps)
    return frames[jumps], step, np.sqrt(variance), chance(degrees * np.log1p(gain / degrees), n)


def _table(column: NDArray[np.int64], frame: NDArray[np.int64], step: Floats) -> xr.Dataset:
    """Return a table of jumps."""
    values = xr.DataArray(step, {"axis": schema.texts(schema.AXES)}, ("jump", "axis"))
    return xr.Dataset(
        {
            "column_id": named(xr.DataArray(column, dims="jump"), "1", "Column that jumps"),
            "frame": named(xr.DataArray(frame, dims="jump"), "1", "First frame at the new place"),
            "step": named(values, "pm", "Step of the column"),
            "size": named((values**2).sum("axis") ** 0.5, "pm", "Length of the step"),
        }
    )
