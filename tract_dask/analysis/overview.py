"""What pages show of the tracks: numbers of every column and frame, and values averaged over frames.

The report gathers them from all frames, the service from each shard that is finished; so both show the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ..kernels.gaussian.parameters import AMPLITUDE, X, Y
from ..store.schema import NOT_SEEN, Status, is_accepted

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

QUANTITIES = ("x", "y", "intensity")
SERIES = (*QUANTITIES, *(f"{name}_stderr" for name in QUANTITIES))
FRAME = ("fits", "accepted", "bad", "amplitude", "drift_y", "drift_x")
_FLAGS = ("below_noise", "not_converged", "at_bound", "shape_at_bound", "incomplete", "hopped", "same_atom")
COUNTS = ("fits", "accepted", "outside", *_FLAGS, "unlike")
UNLIKELY = 1e-3
"""A fit is unlike one Gaussian where its p-value is below this."""

MEANS = ("x", "y", "intensity", "r_squared", "variance", "intensity_variance")
_READ = ("fit", "stderr", "intensity", "intensity_stderr", "r_squared", "status", "drift", "p_value")


@dataclass(frozen=True)
class Calibration:
    """What the numbers of results mean; None: not known."""

    pixel_size_pm: float | None
    frame_time_s: float | None
    dose: float | None

    @classmethod
    def of(cls, about: Mapping[str, Any]) -> Self:
        """Return what the attributes of results say."""
        return cls(about.get("pixel_size_pm"), about.get("frame_time_s"), about.get("dose"))

    @property
    def scale(self) -> float:
        """Lengths in :attr:`unit` for one px."""
        return self.pixel_size_pm or 1.0

    @property
    def unit(self) -> str:
        """Of lengths."""
        return "pm" if self.pixel_size_pm else "px"

    @property
    def time_unit(self) -> str:
        """Of times: frames where the time of one is not known."""
        return "s" if self.frame_time_s else "frames"


@dataclass(frozen=True)
class ColumnSums:
    """Sums over some frames, for each column; those of other frames can be added (Chan, Golub and LeVeque 1983).

    Attributes
    ----------
    counts
        (:data:`COUNTS`, column): fits that were made, accepted ones, frames in which the window leaves the image, and
        made fits with each flag, and accepted ones that are unlike one Gaussian.
    moments
        (3, :data:`MEANS`, column): how many accepted fits have a value, its mean, and the sum of squares about the
        mean. x and y in px; ``variance`` is the stated one of the place, per axis; ``intensity_variance`` alike.
    """

    counts: NDArray[np.int64]
    moments: Floats

    @classmethod
    def nothing(cls, n_columns: int) -> Self:
        """Return the sums over no frames."""
        return cls(np.zeros((len(COUNTS), n_columns), np.int64), np.zeros((3, len(MEANS), n_columns)))

    def __add__(self, other: Self) -> Self:
        (n, mean, squares), (m, other_mean, other_squares) = self.moments, other.moments
        share, step = m / np.maximum(n + m, 1), other_mean - mean
        moments = np.stack([n + m, mean + share * step, squares + other_squares + share * n * step**2])
        return type(self)(self.counts + other.counts, moments)

    def numbers(self, scale: float) -> dict[str, NDArray[Any]]:
        """Return what the sums say of each column.

        Parameters
        ----------
        scale
            Size of a pixel, in the unit of the lengths.

        Returns
        -------
        dict
            By name (column): :data:`COUNTS`; ``share`` of the made fits that were accepted; over accepted fits the mean
            ``r_squared`` and ``intensity``, the standard deviations ``sd_x`` and ``sd_y``, ``spread``, their root mean
            square, ``expected``, that of the stated errors, and ``excess``, the one over the other; ``faint``, the mean
            square of the intensity's stated error over the mean intensity squared. NaN: not known.
        """
        counts = dict(zip(COUNTS, self.counts, strict=True))
        known, mean, squares = self.moments
        means = dict(zip(MEANS, np.where(known > 0, mean, np.nan), strict=True))
        sd = scale * np.sqrt(squares[:2] / np.where(known[:2] > 1, known[:2] - 1, np.nan))
        spread, expected = np.sqrt((sd**2).mean(axis=0)), scale * np.sqrt(means["variance"])
        return counts | {
            "share": counts["accepted"] / np.where(counts["fits"] > 0, counts["fits"], np.nan),
            "r_squared": means["r_squared"],
            "intensity": means["intensity"],
            "sd_x": sd[0],
            "sd_y": sd[1],
            "spread": spread,
            "expected": expected,
            "excess": spread / np.where(expected > 0, expected, np.nan),
            "faint": means["intensity_variance"] / np.where(means["intensity"] != 0, means["intensity"] ** 2, np.nan),
        }


class Part:
    """The fits of some frames.

    Parameters
    ----------
    opened
        Returns a variable of the results by its name, to be sliced along its frames.
    start, stop
        Frames.

    Attributes
    ----------
    series
        x, y (px), intensity (counts), and their standard errors (:data:`SERIES`, frame, column); NaN where a fit is not
        accepted.
    """

    def __init__(self, opened: Callable[[str], Any], start: int, stop: int) -> None:
        found = {name: np.asarray(opened(name)[start:stop]) for name in _READ}
        fit, stderr, self._status = found["fit"], found["stderr"], found["status"]
        self._fitted, self._accepted = (self._status & np.uint16(NOT_SEEN)) == 0, is_accepted(self._status)
        self._r_squared, self._amplitude, self._drift = found["r_squared"], fit[..., AMPLITUDE], found["drift"]
        self._unlike = self._accepted & (found["p_value"] < UNLIKELY)
        own, errors = (fit, "intensity"), (stderr, "intensity_stderr")
        self.series: Floats = np.stack(
            [one for of, name in (own, errors) for one in (of[..., X], of[..., Y], found[name])]
        )
        self.series[:, ~self._accepted] = np.nan

    def columns(self) -> ColumnSums:
        """Return the sums over these frames."""
        flagged = [self._fitted & self._has(Status[name.upper()]) for name in _FLAGS]
        counts = [self._fitted, self._accepted, self._has(Status.OUTSIDE_FRAME), *flagged, self._unlike]
        variance = (self.series[3] ** 2 + self.series[4] ** 2) / 2
        r_squared = np.where(self._accepted, self._r_squared, np.nan)
        values = np.stack([*self.series[:3], r_squared, variance, self.series[5] ** 2])
        known = np.isfinite(values)
        n = known.sum(axis=1)
        mean = np.where(known, values, 0).sum(axis=1) / np.maximum(n, 1)
        squares = np.where(known, (values - mean[:, None]) ** 2, 0).sum(axis=1)
        return ColumnSums(np.stack([flags.sum(axis=0) for flags in counts]), np.stack([n, mean, squares]))

    def frames(self) -> Floats:
        """Return the numbers of each frame (:data:`FRAME`, frame): ``amplitude`` is the mean of accepted fits."""
        count = self._accepted.sum(axis=1)
        amplitude = np.where(self._accepted, self._amplitude, 0).sum(axis=1) / np.where(count > 0, count, np.nan)
        bad = self._has(Status.BAD_FRAME).any(axis=1)
        return np.stack([self._fitted.sum(axis=1), count, bad, amplitude, *self._drift.T])

    def _has(self, flag: Status) -> Flags:
        return np.asarray((self._status & int(flag)) > 0)


def frame_curves(frames: Mapping[str, Floats], step: int) -> dict[str, Floats]:
    """Return means over groups of ``step`` frames of values by name, and ``share``, of made fits that were accepted."""
    means = {name: binned_mean(values, step) for name, values in frames.items()}
    return means | {"share": means["accepted"] / np.where(means["fits"] > 0, means["fits"], np.nan)}


def binned_mean(values: Floats, step: int) -> Floats:
    """Return the means of groups of ``step`` values along the first axis; NaN where a group has none."""
    groups = _groups(values, step)
    known = np.isfinite(groups)
    return np.asarray(np.where(known, groups, 0).sum(axis=1) / _number(known))


def binned(values: Floats, errors: Floats, step: int) -> dict[str, Floats]:
    """Return means of groups of ``step`` values along the first axis, with their errors and the groups' extremes.

    The ``error`` of a ``mean`` is that which the errors of its values make, sqrt(sum of squares) / number; where these
    are not known, it comes from the spread of the values. ``low`` and ``high`` keep what is averaged away.

    Parameters
    ----------
    values, errors
        (frame, ...); what is not finite does not count.
    """
    groups, stated = _groups(values, step), _groups(errors, step)
    known = np.isfinite(groups)
    count, mean = _number(known), binned_mean(values, step)
    error = np.sqrt((np.where(known, stated, 0) ** 2).sum(axis=1)) / count
    squares = np.where(known, (groups - mean[:, None]) ** 2, 0).sum(axis=1)
    seen = np.sqrt(squares / np.where(count > 1, count - 1, np.nan) / count)
    low, high = np.where(known, groups, np.inf).min(axis=1), np.where(known, groups, -np.inf).max(axis=1)
    return {
        "mean": mean,
        "error": np.where(np.isfinite(error), error, seen),
        "low": np.where(count > 0, low, np.nan),
        "high": np.where(count > 0, high, np.nan),
    }


def _number(known: Flags) -> Floats:
    """Return how many values of each group are known; NaN for none."""
    count = known.sum(axis=1)
    return np.where(count > 0, count, np.nan)


def _groups(values: NDArray[Any], step: int) -> Floats:
    """Return groups of ``step`` consecutive values, (groups, step, ...); the last is filled up with NaN."""
    missing = np.full((-len(values) % step, *values.shape[1:]), np.nan)
    return np.concatenate([values, missing]).reshape(-1, step, *values.shape[1:])
