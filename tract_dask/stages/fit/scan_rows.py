"""Scanned frames whose rows are displaced: positions are freed from that, and no pixel is resampled."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.model import blurred
from ...kernels.gaussian.parameters import SIGMA_A, SIGMA_B, X, Y
from ...kernels.scan_rows import displaced_rows
from ...kernels.windows import Tiles, blur_variance, cut_windows
from ...store.schema import is_accepted
from ..columns.window_size import neighbour_distance
from .frame_fits import FrameFits
from .job import Job
from .places import Places
from .row_homes import on_sites

Floats = NDArray[np.float64]
Values = dict[str, NDArray[Any]]


_FEWEST_ROWS = 8
_TELLING = 2.5
"""Pixels so many sigmas from a column tell of its rows, but for those that are as near to another one."""


def undone(
    fits: FrameFits, status: NDArray[np.uint16], places: Places, tiles: Tiles, gain: float, job: Job
) -> tuple[FrameFits, Values]:
    """Return fits whose x are freed from displaced rows, and what was found of these; without the setting, nothing.

    Parameters
    ----------
    fits
        In the coordinates of the frames.
    tiles
        Whole frames.

    Returns
    -------
    Fits with other x, its error and centroid; ``row_offset`` and ``row_offset_stderr`` (frames, rows) and ``row_shift``
    (frames, columns), what was taken off.
    """
    if job.settings.scan_rows == "off":
        return fits, {}
    (n_frames, n_columns), (height, width) = status.shape, places.shape
    offset, stderr = np.full((2, n_frames, height), np.nan)
    estimates, errors, centroid = fits.estimates.copy(), fits.stderr.copy(), fits.centroid.copy()
    shift, zero = np.zeros((n_frames, n_columns)), np.zeros((1, 1), np.int64)
    blur, size = blur_variance(job.settings.window_blur_px), _size(job)
    for k in np.flatnonzero(~(places.bad | places.lost)).tolist():
        image = cut_windows(tiles, zero, zero, (height, width), 0.0, gain, k)[0, 0].astype(np.float64) - job.floor
        seen = np.where(is_accepted(status[k])[:, None], fits.estimates[k], np.nan)
        sites = job.row_sites
        home = _home(seen, places, k, job) if sites is None else on_sites(seen[:, X], sites)
        raw, counting = blurred(seen, -blur), job.settings.counting
        found = displaced_rows(image, raw, home, size, counting=counting)
        absorbed = np.zeros(height) if sites is None else absorbed_variance(found.offset)
        offset[k], stderr[k] = found.offset, np.sqrt(found.variance + absorbed)
        known = np.isfinite(found.x)
        shift[k, known] = (seen[:, X] - found.x)[known]
        there = np.clip(np.rint(seen[known, Y]), 0, height - 1).astype(np.int64)
        errors[k, known, X] = np.sqrt(found.x_variance[known] + absorbed[there])
    estimates[..., X] -= shift
    centroid[..., 1] -= shift
    found_all: Values = {"row_offset": offset, "row_offset_stderr": stderr, "row_shift": shift}
    return replace(fits, estimates=estimates, stderr=errors, centroid=centroid), found_all


def absorbed_variance(offset: Floats) -> Floats:
    """Return the variance (rows,) of what a lattice that is fitted to a frame takes of the offsets (rows,) of its rows.

    The mean of all offsets moves the lattice, and their slope along y shears it: of offsets that are independent over
    so many rows as their correlation tells, each is known as well as a line through them.
    """
    known = np.isfinite(offset)
    if known.sum() < _FEWEST_ROWS:
        return np.zeros(len(offset))
    values, y = offset[known] - offset[known].mean(), np.arange(len(offset), dtype=np.float64)
    power = max(float(values @ values), np.finfo(float).tiny)
    along = np.array([values[lag:] @ values[:-lag] / power for lag in range(1, len(values) // 2)])
    shared = 1 + 2 * along[: int(np.argmax(np.append(along, 0.0) <= 0))].sum()
    y -= y[known].mean()
    return np.asarray(np.mean(values**2) * shared / known.sum() * (1 + y**2 / np.mean(y[known] ** 2)))


def free_hopped(fits: FrameFits, hopped: NDArray[np.bool_], rows: Values, job: Job) -> None:
    """Free x of columns that were found away from their places from the offsets of the rows there, in place."""
    for frame, column in zip(*np.nonzero(hopped), strict=True) if rows else ():
        offset, stderr = rows["row_offset"][frame], rows["row_offset_stderr"][frame]
        away = np.arange(len(offset)) - fits.estimates[frame, column, Y]
        share = np.exp(-(away**2) / (job.reference[column, SIGMA_A] * job.reference[column, SIGMA_B]))
        share /= share.sum()
        shift = float(share @ offset)
        rows["row_shift"][frame, column] = shift
        fits.estimates[frame, column, X] -= shift
        fits.centroid[frame, column, 1] -= shift
        fits.stderr[frame, column, X] = np.hypot(
            fits.stderr[frame, column, X], np.sqrt((share * stderr) @ (share * stderr))
        )


def _size(job: Job) -> int:
    """Return the diameter of what tells of rows: windows of fits are narrow for columns that are cut into rows."""
    sigma = float(np.median(job.reference[:, SIGMA_A]))
    distance = neighbour_distance(job.reference[:, [X, Y]]) if len(job.reference) > 1 else 0.0
    return max(job.window_px, 2 * int(min(_TELLING * sigma, (distance or 0.0) / 2)) + 1)


def _home(seen: Floats, places: Places, frame: int, job: Job) -> Floats:
    """Return x where columns of a frame belong, (n,): as in the summed image, moved as most of them are."""
    displaced = places.displaced[frame, :, 1] if places.displaced.shape[1] > 1 else places.displaced[frame, 0, 1]
    home = job.reference[:, X] + places.drift[frame, 1] + displaced
    away = (seen[:, X] - home)[np.isfinite(seen[:, X])]
    return np.where(job.known, home + (np.median(away) if away.size else 0.0), np.nan)
