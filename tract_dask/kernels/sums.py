"""Sums of frames that are moved by whole pixels: ``total(y, x) += frame(y + dy, x + dx)``.

What leaves the field of the sum is dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

Pixels: TypeAlias = NDArray[Any]
Whole: TypeAlias = NDArray[np.int64]


def overlap(n_template: int, n_frame: int, shift: int) -> tuple[slice, slice]:
    """Return the parts of template and frame, along an axis, that lie on one another where the frame is shifted.

    Examples
    --------
    >>> overlap(100, 100, 3)
    (slice(0, 97, None), slice(3, 100, None))
    """
    start = min(max(0, -shift), n_template)
    stop = max(start, min(n_template, n_frame - shift))
    return slice(start, stop), slice(start + shift, stop + shift)


def add_shifted(total: Pixels, image: Pixels, shift: Sequence[int] | Whole) -> None:
    """Add an image, of any shape, to a sum. Axes before the last two are alike in both."""
    sides = zip(total.shape[-2:], image.shape[-2:], map(int, shift), strict=True)
    target, source = zip(*(overlap(*side) for side in sides), strict=True)
    np.add(total[..., *target], image[..., *source], out=total[..., *target], casting="same_kind")


@njit(cache=True, nogil=True)
def add_frames(total: Pixels, frames: Pixels, shifts: Whole) -> None:
    """Add frames (frames, y, x) to a sum, each at its shift (frames, 2).

    All frames are added to a row before the next row is begun: it stays in the cache, and is converted to the type of
    the sum on the way.
    """
    n_frames, height, width = frames.shape
    if n_frames == 0:
        return
    for y in range(max(0, -shifts[:, 0].max()), min(total.shape[0], height - shifts[:, 0].min())):
        for k in range(n_frames):
            row, dx = y + shifts[k, 0], shifts[k, 1]
            left, right = max(0, -dx), min(total.shape[1], width - dx)
            if row < 0 or row >= height or left >= right:
                continue
            target, source = total[y, left:right], frames[k, row, left + dx : right + dx]
            for x in range(target.size):
                target[x] += source[x]


@njit(cache=True, nogil=True)
def add_tiles(
    total: Pixels, pixels: Pixels, place: Whole, shape: tuple[int, int], targets: Whole, shifts: Whole
) -> None:
    """Add frames in tiles to sums of frames in the same tiles, each at its shift; what lies beyond is the edge pixel.

    Parameters
    ----------
    total
        (tiles, sums, tile rows, tile columns).
    pixels
        (tiles, frames, tile rows, tile columns); only the first frames, as many as there are targets, are added.
    place
        (rows, columns) which of the tiles lies there; -1 where it is missing, and adds nothing.
    shape
        Rows and columns of a frame.
    targets, shifts
        (frames,) the sum that a frame belongs to, and (frames, 2) its shift, (y, x) in px.
    """
    height, width = total.shape[2:]
    across, inside = np.empty(width, np.int64), np.empty(width, np.int64)
    for row, column in np.ndindex(place.shape):
        if place[row, column] < 0:
            continue
        for k in range(targets.size):
            sums = total[place[row, column], targets[k]]
            for j in range(width):
                x = min(max(column * width + j + shifts[k, 1], 0), shape[1] - 1)
                across[j], inside[j] = x // width, x % width
            for i in range(height):
                y = min(max(row * height + i + shifts[k, 0], 0), shape[0] - 1)
                for j in range(width):
                    tile = place[y // height, across[j]]
                    if tile >= 0:
                        sums[i, j] += pixels[tile, k, y % height, inside[j]]


def coverage(shape: tuple[int, ...], shifts: Whole) -> Whole:
    """Return how many frames of a shape, moved by shifts (frames, 2), cover each pixel of a sum of the same shape."""
    edges = np.zeros((shape[0] + 1, shape[1] + 1), np.int64)
    for dy, dx in shifts:
        (rows, _), (columns, _) = overlap(shape[0], shape[0], int(dy)), overlap(shape[1], shape[1], int(dx))
        for y, sign_y in ((rows.start, 1), (rows.stop, -1)):
            for x, sign_x in ((columns.start, 1), (columns.stop, -1)):
                edges[y, x] += sign_y * sign_x
    return np.asarray(edges.cumsum(axis=0).cumsum(axis=1)[:-1, :-1])
