"""The motion that all columns of a frame share: a shift, and how the crystal turns, grows and shears."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...kernels import linear_motion
from ...kernels.gaussian.intensity import Floats
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from ...store.schema import Status, is_accepted
from .job import Job

CERTAIN = 13.8
"""Chi-squared of two degrees of freedom at 99.9 %."""


class CommonMotion(NamedTuple):
    """What the accepted columns of each frame do together.

    Attributes
    ----------
    shift
        (frames, 2) how far they moved, (y, x): what the drift had missed. Zero unless it stands out of its own error
        with 99.9 % certainty (chi-squared of both axes above 13.8): registration, which sees every pixel, is otherwise
        the better estimate. Zero, too, where fewer than ``job.refined_by`` are accepted.
    linear
        (frames, 4) rotation, magnification and shears (:mod:`~tract_dask.kernels.linear_motion`); NaN where too few
        are accepted.
    stderr
        (frames, 4) of them.
    """

    shift: Floats
    linear: Floats
    stderr: Floats


def common_motion(estimates: Floats, status: NDArray[np.uint16], drift: Floats, job: Job) -> CommonMotion:
    """Return what the accepted columns of each frame do together."""
    motion = np.zeros_like(drift)
    found = CommonMotion(motion, np.full((len(drift), 4), np.nan), np.full((len(drift), 4), np.nan))
    if job.refined_by is None:
        return found
    away = estimates[..., [Y, X]] - drift[:, None] - job.reference[:, [Y, X]]
    expected = errors_of(job.reference)
    good = still(status)
    enough = good.sum(axis=1) >= job.refined_by
    if enough.any():
        common, error, weight = _biweight(away[enough], expected, good[enough])
        certain = ((common / error) ** 2).sum(axis=1) > CERTAIN
        motion[enough] = np.where(certain[:, None], common, 0)
        found.linear[enough], found.stderr[enough] = linear_motion.estimate(
            away[enough][..., ::-1], job.from_centre, weight.min(axis=1)
        )
    return found


def still(status: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Tell which fits are of columns that are where they belong: one that hopped tells nothing of the crystal."""
    return np.asarray(is_accepted(status) & ((status & np.uint16(Status.HOPPED)) == 0))


def errors_of(columns: Floats) -> Floats:
    """Return the errors of positions of columns (n, 7), up to a factor that all share."""
    height = np.abs(columns[:, AMPLITUDE])
    return np.asarray(np.sqrt(np.abs(columns[:, BACKGROUND]) + height / 2) / (height + 1e-12))


def _biweight(values: Floats, expected: Floats, good: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats]:
    """Return the mean of each frame's good ``values`` (frames, n, 2), its standard error, and weights (frames, 2, n).

    Mean and error are (frames, 2). Weights are 1 / expected^2, with errors (n,) known up to a factor, times Tukey's
    biweight at 6 median absolute deviations, so that columns which move by themselves do not count. The standard error
    is that of the weighted mean, from the spread of the values. Errors that the fits themselves report are no use here:
    at low dose they follow the noise, and favour the columns that it has made brighter.
    """
    # per frame and axis: (frames, 2, n)
    values = np.where(good[:, None], np.swapaxes(values, 1, 2), 0)
    counted = np.broadcast_to(good[:, None], values.shape)
    precision = counted / expected**2
    centre = masked_median(values, counted)
    weight = precision
    for _ in range(10):
        pull = np.abs(values - centre[..., None]) / expected
        scale = 6 * masked_median(pull, counted)[..., None] + 1e-12
        weight = np.clip(1 - (pull / scale) ** 2, 0, None) ** 2 * precision
        centre = (weight * values).sum(axis=-1) / weight.sum(axis=-1)
    error = np.sqrt((weight**2 * (values - centre[..., None]) ** 2).sum(axis=-1)) / weight.sum(axis=-1)
    return centre, np.maximum(error, 1e-12), weight


def masked_median(values: Floats, good: NDArray[np.bool_]) -> Floats:
    """Return the median of the good values along the last axis; NaN where there are none.

    Examples
    --------
    >>> masked_median(np.array([[3.0, 1.0, 9.0], [5.0, 5.0, 5.0]]), np.array([[True, True, False], [False] * 3]))
    array([ 2., nan])
    """
    ordered = np.sort(np.where(good, values, np.inf), axis=-1)
    count = good.sum(axis=-1)[..., None]
    low, high = (np.take_along_axis(ordered, np.maximum(k, 0), axis=-1) for k in ((count - 1) // 2, count // 2))
    with np.errstate(invalid="ignore"):
        return np.where(count > 0, (low + high) / 2, np.nan)[..., 0]
