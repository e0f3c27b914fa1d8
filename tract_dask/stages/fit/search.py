"""Columns that have left their places: searched for in the free part of their cells, and fitted where they are.

A fit reaches an eighth of the spacing, so that it does not slide onto a neighbour. A column that hops farther ends on
that bound, or is not seen at all. Its matched filter then looks over all places that are nearer to it than to any other
column; where it finds the column, the usual fit is made.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.parameters import AMPLITUDE, SIGMA_A, SIGMA_B, X, Y
from ...kernels.strength_maps import strength_maps
from ...kernels.windows import Tiles, cut_windows, gaussian_kernel
from ...store.schema import is_accepted
from ..groups import INSEPARABLE
from .frame_fits import FrameFits
from .incomplete import cut_raw
from .job import Job
from .places import Places
from .window_fits import bounds_of, fit_windows

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Numbers = NDArray[np.int64]

_TOLD = 6.0
"""A column is searched for where it would be as many standard errors strong: noise alone reaches 5 once in 10,000
cells."""
_CLEAR, _AS_STRONG = 5.0, 0.6
"""It is found where something is so many standard errors strong, and as strong as this share of the column."""
_FADED = 0.5
"""A fit with a smaller share of the column's amplitude has not found it."""
_FEWEST = 4
"""In a movie of fewer columns, all may have left."""
_BATCH_PIXELS = 1 << 22


class Left(NamedTuple):
    """Columns that are not where they belong.

    Attributes
    ----------
    frame, column
        (n,) their numbers.
    clear
        (n,) how strong one has to be to be found, in units of the filters' strengths.
    home
        (n, 2) y and x of where they belong in the frame, px.
    """

    frame: Numbers
    column: Numbers
    clear: Floats
    home: Floats

    def part(self, which: Any) -> Left:
        """Return some of them."""
        return Left(*(values[which] for values in self))


def search(
    fits: FrameFits,
    status: NDArray[np.uint16],
    places: Places,
    read: Callable[[NDArray[np.int64]], Tiles],
    gain: float,
    scales: tuple[Floats, Floats],
    shift: Floats,
    job: Job,
) -> Bools:
    """Replace the fits of columns that have left their places by fits where they are; return which, (frames, columns).

    Parameters
    ----------
    fits
        Of the frames, in their coordinates.
    read
        Returns tiles of the frames that hold boxes.
    scales
        What makes strengths of matched filters, (frames, columns), and the size of the noise in errors, (frames,).
    shift
        (frames, 2) y and x by which all columns have moved together, px.
    """
    hopped = np.zeros(status.shape, np.bool_)
    left = _left(fits, status, places, scales[0], shift, job)
    if not left.frame.size:
        return hopped
    reach = int(job.cells.along[-1]) + job.window_px // 2
    margin = reach + gaussian_kernel(job.settings.window_blur_px).size // 2
    middle = np.rint(left.home).astype(np.int64)
    tiles = read(np.concatenate([middle - margin, middle + margin + 1], axis=1))
    step = max(1, _BATCH_PIXELS // (2 * margin + 1) ** 2)
    batches = [left.part(slice(k, k + step)) for k in range(0, len(middle), step)]
    found = [_found(some, tiles, gain, places.start, job) for some in batches]
    if not any(len(seen) for seen, _ in found):
        return hopped
    which = np.concatenate(
        [offset + seen for offset, (seen, _) in zip(range(0, len(middle), step), found, strict=True)]
    )
    refits, left = FrameFits.joined([more for _, more in found], (len(which), 1)), left.part(which)
    refits = refits.with_noise(scales[1][left.frame])
    kept, good = _beyond(refits, left, places, job), np.asarray(is_accepted(status))
    kept &= _not_the_frame(left, kept, good)
    kept = _apart(refits, left, fits, good, kept, job)
    for name, values in vars(refits).items():
        vars(fits)[name][left.frame[kept], left.column[kept]] = values[kept, 0]
    hopped[left.frame[kept], left.column[kept]] = True
    return hopped


def _left(
    fits: FrameFits, status: NDArray[np.uint16], places: Places, precision: Floats, shift: Floats, job: Job
) -> Left:
    """Return the columns that are not where they belong, and are bright enough to be found elsewhere."""
    faded = ~(np.abs(fits.estimates[..., AMPLITUDE]) > _FADED * np.abs(job.reference[:, AMPLITUDE]))
    gone = (~is_accepted(status) | faded) & np.isfinite(precision) & ~fits.incomplete
    gone &= ~(places.outside | places.bad[:, None] | places.lost[:, None]) & job.known & (job.group_numbers == 0)
    if job.settings.filters_frames or job.settings.search_px == 0:
        gone[:] = False
    frame, column = np.nonzero(gone)
    columns, number = np.unique(column, return_inverse=True)
    expected = job.cells.expected(columns.tolist())[number]
    bright = expected * precision[frame, column] > _TOLD
    frame, column, expected = frame[bright], column[bright], expected[bright]
    clear = np.maximum(_CLEAR / precision[frame, column], _AS_STRONG * expected)
    displaced = places.displaced[frame, column if places.displaced.shape[1] > 1 else 0]
    home = job.reference[column][:, [Y, X]] + places.drift[frame] + shift[frame] + displaced
    return Left(frame, column, clear, home)


def _found(left: Left, tiles: Tiles, gain: float, first: int, job: Job) -> tuple[Numbers, FrameFits]:
    """Return which of some columns are seen in the free parts of their cells, and fits there, in the frame."""
    cells, blur = job.cells, job.settings.window_blur_px
    reach, halo = int(cells.along[-1]) + job.window_px // 2, gaussian_kernel(blur).size // 2
    corner = np.rint(left.home).astype(np.int64) - reach
    raw = cut_raw(tiles, left.frame, corner - halo, 2 * (reach + halo) + 1, gain)
    inside = np.full((len(raw), 1), halo)
    images = cut_windows(raw, inside, inside, 2 * reach + 1, blur)[:, 0]
    columns, number = np.unique(left.column, return_inverse=True)
    maps = strength_maps(images, cells.weights(columns), number, cells.step)
    free = cells.free(columns.tolist())[number] & _whole(corner, len(cells.along), tiles.shape, job)
    at, strength = _peaks(maps, free)
    seen = np.flatnonzero(strength > left.clear)
    start = cells.step * at[seen].astype(np.float64) + job.window_px // 2
    fits = _fits_at(images[seen], start, left.column[seen], job)
    start = np.where(fits.converged[:, None], fits.estimates[:, [Y, X]], start)
    fits = _fits_at(images[seen], start, left.column[seen], job)  # in the middle of their windows, as all others
    return seen, fits.moved(corner[seen])


def _whole(corner: Numbers, places: int, shape: tuple[int, int], job: Job) -> Bools:
    """Return at which places of their grids whole windows lie in the frame, (n, places, places)."""
    first = corner[:, :, None] + job.cells.step * np.arange(places)
    inside = (first >= 0) & (first + job.window_px <= np.array(shape)[:, None])
    return np.asarray(inside[:, 0, :, None] & inside[:, 1, None, :])


def _peaks(maps: NDArray[np.float32], free: Bools) -> tuple[Numbers, Floats]:
    """Return the places (n, 2) and the heights (n,) of the highest peaks of maps at free places; 0 where none is.

    The slope of something that stands elsewhere is no peak.
    """
    known = np.where(np.isfinite(maps), maps, 0)
    flat = np.where(free, known, 0).reshape(len(maps), -1)
    best = flat.argmax(axis=1)
    at = np.stack(np.divmod(best, maps.shape[2]), axis=1)
    height = flat[np.arange(len(maps)), best]
    around = np.pad(known, ((0, 0), (1, 1), (1, 1)))
    for y in range(3):
        for x in range(3):
            height = np.where(around[np.arange(len(maps)), at[:, 0] + y, at[:, 1] + x] > height, 0, height)
    return at, height.astype(np.float64)


def _fits_at(images: NDArray[np.float32], start: Floats, column: Numbers, job: Job) -> FrameFits:
    """Return fits of columns in windows about places (n, 2) of images (n, side, side), in their coordinates."""
    size = job.window_px
    corner = np.clip(np.rint(start).astype(np.int64) - size // 2, 0, images.shape[1] - size)
    along = np.arange(size)
    y, x = corner[:, :1, None] + along[:, None], corner[:, 1:, None] + along
    windows = images[np.arange(len(images))[:, None, None], y, x] - job.floor
    offset = start - corner - job.reference[column][:, [Y, X]]
    return fit_windows(windows, bounds_of(offset, column, job), column, job).moved(corner)


def _beyond(refits: FrameFits, left: Left, places: Places, job: Job) -> Bools:
    """Tell which fits (n, 1) are good, and beyond the bounds of the usual ones."""
    displaced = places.displaced[left.frame, left.column if places.displaced.shape[1] > 1 else 0]
    usual = job.reference[left.column][:, [Y, X]] + places.drift[left.frame] + displaced
    away = np.abs(refits.estimates[:, 0, [Y, X]] - usual).max(axis=1)
    return np.asarray(refits.converged[:, 0] & ~refits.held[:, 0] & (away > job.reach_px))


def _apart(refits: FrameFits, left: Left, fits: FrameFits, good: Bools, kept: Bools, job: Job) -> Bools:
    """Tell which of the fits that are ``kept`` (n, 1) stand clear of all other columns of their frames.

    Of two columns that are found on one atom, the one that is nearer to its own place has it.
    """
    reference, place = job.reference, refits.estimates[:, 0, [Y, X]]
    limit = INSEPARABLE * np.sqrt(reference[left.column, SIGMA_A] * reference[left.column, SIGMA_B])
    away = np.linalg.norm(place - left.home, axis=1)
    at_home = good.copy()
    at_home[left.frame, left.column] = False
    clear = np.zeros_like(kept)
    for frame in np.unique(left.frame[kept]).tolist():
        taken = [fits.estimates[frame, at_home[frame]][:, [Y, X]]]
        here = np.flatnonzero(kept & (left.frame == frame))
        for k in here[np.argsort(away[here], kind="stable")].tolist():
            clear[k] = not any((np.linalg.norm(place[k] - some, axis=1) < limit[k]).any() for some in taken)
            taken += [place[k : k + 1]] * bool(clear[k])
    return clear


def _not_the_frame(left: Left, kept: Bools, good: Bools) -> Bools:
    """Tell for each fit whether others of its frame are where they belong: else the frame is displaced, not they."""
    number = np.bincount(left.frame[kept], minlength=len(good))
    return np.asarray((number <= good.sum(axis=1)) | (good.shape[1] < _FEWEST))[left.frame]
