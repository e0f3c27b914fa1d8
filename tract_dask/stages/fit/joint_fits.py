"""The joint fits of touching columns, in place of what their own windows give."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.joint import JointFits, fit_joint
from ...kernels.gaussian.model import evaluate
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from ...kernels.windows import Tiles, cut_windows
from .frame_fits import FrameFits
from .groups import Groups, discs, joint_settings
from .job import Job
from .places import group_corners, natural_corners

Floats = NDArray[np.float64]

_LEAST_SEEN = 0.5
"""Share of a member's disc that has to be there."""


class Frames(NamedTuple):
    """The pixels of some frames, and where the columns' own windows lie in them."""

    tiles: Tiles
    first: int
    """Number of the first frame among the tiles."""
    gain: float
    drift: Floats
    """(frames, 2) y and x, px."""
    displaced: Floats
    """(frames, columns or 1, 2) what linear motion adds to it."""
    corner: NDArray[np.int64]
    """(frames, columns, 2) first row and column of each column's own window."""


def fit_groups(fits: FrameFits, frames: Frames, bounds: Sequence[Floats], job: Job) -> None:
    """Replace the fits (frames * columns, ...) of touching columns by joint ones.

    Columns that touch a group, and are not of it, are held: at their start, and once more where they have been fitted.

    Parameters
    ----------
    fits
        What the columns' own windows give, in the coordinates of these.
    bounds
        Start, lower and upper bounds, (frames * columns, 7), in the same coordinates.
    """
    for groups in job.groups:
        _fit_class(fits, frames, bounds, groups, bounds[0], job)
    for groups in job.groups:
        if (groups.outer >= 0).any():
            _fit_class(fits, frames, bounds, groups, fits.estimates, job)


def _fit_class(
    fits: FrameFits, frames: Frames, bounds: Sequence[Floats], groups: Groups, known: Floats, job: Job
) -> None:
    """Replace the fits of the members of some groups; ``known`` (frames * columns, 7) are the columns around them."""
    corner = group_corners(groups, frames.drift, frames.displaced, frames.tiles.shape)
    settings, n_columns = joint_settings(job.settings), frames.corner.shape[1]
    y, x = corner[..., 0], corner[..., 1]
    windows = cut_windows(frames.tiles, y, x, groups.size, settings.window_blur_px, frames.gain, frames.first)
    windows = windows.reshape(-1, *groups.size) - job.floor
    number = (np.arange(len(corner))[:, None, None] * n_columns + groups.members).reshape(len(windows), -1)
    moved = _offset(frames, corner, groups.members)
    own = [values[number] for values in bounds]
    for values in own:
        values[..., [X, Y]] += moved
    if (groups.outer >= 0).any():
        windows -= _around(known, frames, corner, groups)
    masks, which, shifted = _masks(groups, corner, frames, job.window_px)
    found = fit_joint(
        windows,
        masks,
        which,
        *own,
        blur_sigma_px=settings.window_blur_px,
        counting=settings.counting,
        tolerance_px=settings.tolerance_px,
        max_iterations=settings.max_iterations,
    )
    _write(fits, found, number, moved, np.tile(groups.errors, (len(corner), 1)), known=not settings.filters_frames)
    fits.strength[number] = _strengths(windows, groups, shifted)
    if job.vacuum is None:
        fits.residual[number] = _residual(windows, masks, which, found)[:, None]
    fits.incomplete[number] = False
    if frames.tiles.pixels.dtype.kind == "f":
        _note_missing(fits, windows, masks[which], number, groups.disc, job.window_px)


def _offset(frames: Frames, corner: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return (x, y) from the windows of groups to those of columns (n, m), (frames * n, m, 2)."""
    apart = frames.corner[:, columns] - corner[:, :, None]
    return apart.reshape(-1, columns.shape[1], 2)[..., ::-1].astype(np.float64)


def _masks(
    groups: Groups, corner: NDArray[np.int64], frames: Frames, window_px: int
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.bool_]]:
    """Return masks, which of them is for each window, and which windows were moved to stay inside the frame."""
    by: NDArray[Any] = (natural_corners(groups, frames.drift, frames.displaced) - corner).reshape(-1, 2)
    shifted = np.asarray(by.any(axis=1))
    which = np.tile(np.arange(len(groups.members)), len(corner))
    if not shifted.any():
        return groups.masks, which, shifted
    kinds, of_kind = np.unique(np.column_stack([which[shifted], by[shifted]]), axis=0, return_inverse=True)
    more = discs(groups.disc[kinds[:, 0]] + kinds[:, None, 1:], groups.size, window_px)
    which[shifted] = len(groups.masks) + of_kind.ravel()
    return np.concatenate([groups.masks, more]), which, shifted


def _around(known: Floats, frames: Frames, corner: NDArray[np.int64], groups: Groups) -> NDArray[np.float32]:
    """Return what columns outside the groups, and touching them, add to their windows."""
    outer = np.maximum(groups.outer, 0)
    number = np.arange(len(corner))[:, None, None] * frames.corner.shape[1] + outer
    columns = known[number.reshape(-1, outer.shape[1])]
    columns[..., [X, Y]] += _offset(frames, corner, outer)
    columns[..., BACKGROUND] = 0
    columns[np.tile(groups.outer < 0, (len(corner), 1)), AMPLITUDE] = 0
    columns = np.where(np.isfinite(columns).all(axis=-1, keepdims=True), columns, [0, 0, 0, 1, 1, 0, 0])
    down, across = (np.arange(side) for side in groups.size)
    total = np.zeros((len(columns), *groups.size), np.float32)
    for k in range(outer.shape[1]):
        total += evaluate(columns[:, k], across, down[:, None]).astype(np.float32)
    return total


def _write(
    fits: FrameFits, found: JointFits, number: NDArray[np.int64], moved: Floats, errors: Floats, *, known: bool
) -> None:
    """Write joint fits over single ones; ``errors`` (windows, 7) are true over the kernel's, NaN unless ``known``."""
    estimates = found.estimates.copy()
    estimates[..., [X, Y]] -= moved
    factor = errors if known else np.full_like(errors, np.nan)
    fits.estimates[number] = estimates
    fits.stderr[number] = found.stderr * factor[:, None]
    fits.volume_stderr[number] = found.volume_stderr * factor[:, None, AMPLITUDE]
    fits.held[number] = fits.at_bound[number] = found.held
    for name, values in (
        ("r_squared", found.r_squared),
        ("n_iterations", found.n_iterations),
        ("converged", found.converged),
        ("ratio", found.noise),
    ):
        vars(fits)[name][number] = values[:, None]


def _strengths(windows: NDArray[np.float32], groups: Groups, shifted: NDArray[np.bool_]) -> Floats:
    """Return the strengths of the members' matched filters; NaN where pixels are missing or the window was moved."""
    n, members = groups.members.shape
    pixels = windows.reshape(-1, n, windows[0].size)
    found = np.matmul(groups.filters, pixels.transpose(1, 2, 0)).transpose(2, 0, 1).reshape(-1, members)
    return np.where(shifted[:, None], np.nan, found)


def _residual(
    windows: NDArray[np.float32], masks: NDArray[np.bool_], which: NDArray[np.int64], found: JointFits
) -> Floats:
    """Return the rms of the residuals, over the pixels that are there."""
    counts = masks[which] & np.isfinite(windows)
    number = np.maximum(counts.sum(axis=(1, 2)), 1)
    pixels = np.where(counts, windows, 0).astype(np.float64)
    mean = pixels.sum(axis=(1, 2)) / number
    variance = (np.where(counts, windows - mean[:, None, None], 0.0) ** 2).sum(axis=(1, 2)) / number
    return np.asarray(np.sqrt((1 - found.r_squared) * variance))


def _note_missing(
    fits: FrameFits,
    windows: NDArray[np.float32],
    masks: NDArray[np.bool_],
    number: NDArray[np.int64],
    disc: NDArray[np.int64],
    window_px: int,
) -> None:
    """Flag members in whose window pixels are missing; those of which too little is there are not known."""
    there = np.isfinite(windows)
    missing = (masks & ~there).any(axis=(1, 2))
    if not missing.any():
        return
    fits.incomplete[number[missing]] = True
    centre = np.tile(disc, (len(windows) // len(disc), 1, 1))[missing]
    for k in range(number.shape[1]):
        own = discs(centre[:, k : k + 1], windows.shape[1:], window_px)
        lost = number[missing, k][(own & there[missing]).sum(axis=(1, 2)) < _LEAST_SEEN * own.sum(axis=(1, 2))]
        for flags in (fits.converged, fits.held, fits.at_bound):
            flags[lost] = False
        for values in (fits.estimates, fits.stderr, fits.volume_stderr, fits.centroid, fits.strength):
            values[lost] = np.nan
