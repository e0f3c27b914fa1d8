"""Errors for tests over time: they do not follow the noise of the frame that they judge.

A fit states its error from its own estimate. An amplitude that noise has made too high states an error that is too
small, by a third and more for a faint column, and a test that divides by it sees motion where there is none. Here a
column's error is the median of what its fits state around a frame, times what all columns have in common in that frame.
How far places really scatter from frame to frame then scales it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import xarray as xr
from scipy.ndimage import median_filter

from ..kernels.gaussian.intensity import Floats
from ..stages.fit.common_motion import masked_median

_BLOCK_BYTES = 128 << 20
"""Columns are read in blocks of so many bytes: places and errors of all their frames."""
_AROUND = 51
"""A column's error is the median of so many accepted frames: the noise of one moves it by a twentieth of a third."""
_ENOUGH = 200
"""What all columns have in common in a frame is the median of so many errors, of neighbouring frames if need be."""
_CUT = 2.5
"""First differences beyond so many standard deviations are jumps, and do not count in the noise."""
_CUT_VARIANCE = 1 - math.sqrt(2 / math.pi) * _CUT * math.exp(-(_CUT**2) / 2) / math.erf(_CUT / math.sqrt(2))
"""Variance of a standard normal variable that is cut there."""
_CORRELATED = 2.05
"""So many differences tell as much of the noise as one normal variable: neighbours share a frame, and they are cut.

From simulated normal noise; it is the same for 40 and for 2000 frames."""
_MEDIAN = np.pi / 2
"""Variance of a median, against that of the mean."""
_FARTHEST = 2.0
"""A column's noise is drawn towards that of all by no more than so many standard errors (Efron and Morris 1971)."""


def blocks(place: xr.DataArray, error: xr.DataArray) -> Iterator[tuple[int, Floats, Floats]]:
    """Yield blocks of columns: the first one's number, and their places and steady errors (column, frame, axis).

    Parameters
    ----------
    place, error
        (frame, column_id, axis): places, NaN where a fit is not accepted, and the errors that the fits state.
    """
    course = _common_course(error)
    step = _columns_of(place)
    for start in range(0, place.sizes["column_id"], step):
        both = xr.Dataset({"place": place, "error": error}).isel(column_id=slice(start, start + step)).compute()
        both = both.transpose("column_id", "frame", "axis")
        places = np.ascontiguousarray(both["place"])
        yield start, places, steady(np.ascontiguousarray(both["error"]), course)


def steady(errors: Floats, course: Floats) -> Floats:
    """Return the errors (column, frame, axis) that columns have in each frame, whatever its own noise.

    Parameters
    ----------
    errors
        As the fits state them, NaN where there is none.
    course
        (frame,) what the columns have in common, about 1.
    """
    known = np.isfinite(errors) & (errors > 0)
    levels = np.where(known, errors, np.nan) / course[:, None]
    by_axis, seen = np.swapaxes(levels, 1, 2), np.swapaxes(known, 1, 2)  # (column, axis, frame)
    found = np.repeat(masked_median(by_axis, seen)[..., None], errors.shape[1], axis=2)
    for column, axis in np.argwhere(seen.sum(axis=2) > _AROUND):
        frames = np.flatnonzero(seen[column, axis])
        level = median_filter(by_axis[column, axis, frames], _AROUND)
        found[column, axis] = np.interp(np.arange(errors.shape[1]), frames, level)
    return np.swapaxes(found, 1, 2) * course[:, None]


def scatter_of(places: Floats, errors: Floats) -> Floats:
    """Return what the scatter of each column (column, frame, axis) says of its errors, (column, 2).

    That is the logarithm of the variance of first differences in units of the stated one, and the variance of that
    logarithm; NaN where there are no two frames.
    """
    known = np.isfinite(places).all(axis=2) & (errors > 0).all(axis=2)
    order = np.argsort(~known, axis=1, kind="stable")[..., None]  # known frames to the front
    place, variance = (np.take_along_axis(values, order, axis=1) for values in (places, errors**2))
    with np.errstate(invalid="ignore"):
        away = np.abs(np.diff(place, axis=1) / np.sqrt(variance[:, 1:] + variance[:, :-1]))
    pairs = np.arange(1, known.shape[1]) < known.sum(axis=1)[:, None]
    counted = np.repeat(pairs, away.shape[2], axis=1)
    away = np.where(counted, away.reshape(len(away), -1), np.inf)
    middle = masked_median(away, counted)
    sd = 1.4826 * np.where(middle > 0, middle, np.nan)
    squares = np.where(counted, away, 0.0) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        for _ in range(10):
            within = away <= _CUT * sd[:, None]
            sd = np.sqrt((squares * within).sum(axis=1) / within.sum(axis=1) / _CUT_VARIANCE)
        variance_of_log = np.where(np.isfinite(sd), 2 * _CORRELATED / counted.sum(axis=1), np.nan)
    return np.column_stack([2 * np.log(sd), variance_of_log])


def drawn_together(scatters: Floats) -> tuple[Floats, Floats]:
    """Return the factor of each column's errors and its degrees of freedom, from :func:`scatter_of` of all columns.

    Each column's estimate is drawn towards the median of all columns as far as the scatter among them says that it is
    chance (empirical Bayes on the logarithm of the variance), but by no more than two of its standard errors. 1 and 1
    where no column has two frames.
    """
    own, variance = scatters.T
    known = np.isfinite(own)
    if not known.any():
        return np.ones(len(own)), np.ones(len(own))
    common, typical = float(np.median(own[known])), float(np.median(variance[known]))
    scatter = 1.4826 * float(np.median(np.abs(own[known] - common)))
    between = max(scatter**2 - typical, 0.0)
    own, variance = np.where(known, own, common), np.where(known, variance, np.inf)
    weight = between / (between + variance)
    drawn, limit = weight * own + (1 - weight) * common, _FARTHEST * np.sqrt(variance)
    of_common = _MEDIAN * (between + typical) / known.sum()
    within = np.abs(drawn - own) <= limit
    factor: Floats = np.exp(0.5 * np.where(within, drawn, own + np.clip(drawn - own, -limit, limit)))
    shared = np.where(weight > 0, between * (1 - weight), 0.0) + (1 - weight) ** 2 * of_common
    return factor, 2 / np.where(within, shared, variance)


def _columns_of(place: xr.DataArray) -> int:
    return max(1, _BLOCK_BYTES // (32 * max(place.sizes["frame"], 1)))


def _common_course(error: xr.DataArray) -> Floats:
    """Return the errors' course over the frames (frame,) that columns share, as where the dose or the focus changes.

    It comes from as many columns as fit into a block, evenly chosen; of few columns, from neighbouring frames too.
    """
    n_frames, n = error.sizes["frame"], error.sizes["column_id"]
    chosen = np.unique(np.linspace(0, n - 1, min(n, _columns_of(error), _ENOUGH)).astype(np.int64))
    errors = error.isel(column_id=chosen).transpose("frame", "column_id", "axis").to_numpy().reshape(n_frames, -1)
    known = np.isfinite(errors) & (errors > 0)
    width = max(1, math.ceil(_ENOUGH / max(np.median(known.sum(axis=1)), 1))) | 1
    if 2 * width > n_frames:
        return np.ones(n_frames)
    with np.errstate(invalid="ignore"):
        share = np.ma.masked_array(errors, ~known)
        share = share / np.ma.median(share, axis=0)
        course = np.ma.filled(np.ma.median(share, axis=1), np.nan)
    seen = np.flatnonzero(np.isfinite(course))
    if not len(seen):
        return np.ones(n_frames)
    course = np.interp(np.arange(n_frames), seen, course[seen])
    return np.asarray(median_filter(course, width), np.float64)
