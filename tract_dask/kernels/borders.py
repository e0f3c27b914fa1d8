"""Borders of frames that were moved before: rows and columns of one value, or of none, around what a frame shows.

Rows of one value are a border where the pixels beside them are others: with a share q of that value there, m pixels
have it by chance with probability q^m. Aligned frames are interpolated, so that the last row and column beside a border
are a mixture of both, and are counted to it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

_UNLIKELY = 30.0
"""A border is one where it has a probability of exp(-30) by chance."""
_LARGEST_SHARE = 0.97
_BESIDE = 4
"""Rows or columns beside a border that tell how often its value is there."""


def shown_part(frame: NDArray[Any]) -> tuple[int, int, int, int] | None:
    """Return first row, stop row, first column and stop column of what a frame (y, x) shows.

    None where it has no border, or shows nothing at all.

    Examples
    --------
    >>> frame = np.pad(np.random.default_rng(0).poisson(9, (40, 40)), ((3, 0), (0, 5)))
    >>> shown_part(frame)
    (4, 43, 0, 39)
    """
    edges = _edges(frame)
    if edges == (0, frame.shape[0], 0, frame.shape[1]) or edges[0] >= edges[1]:
        return None
    y0, y1, x0, x1 = edges
    top, bottom = frame[y0 : y0 + _BESIDE, x0:x1], frame[y1 - _BESIDE : y1, x0:x1]
    left, right = frame[y0:y1, x0 : x0 + _BESIDE], frame[y0:y1, x1 - _BESIDE : x1]
    height, width = frame.shape
    y0 = y0 + 1 if y0 and _is_border(frame[0, 0], top, y0 * width) else 0
    y1 = y1 - 1 if y1 < height and _is_border(frame[-1, 0], bottom, (height - y1) * width) else height
    x0 = x0 + 1 if x0 and _is_border(frame[y0, 0], left, x0 * height) else 0
    x1 = x1 - 1 if x1 < width and _is_border(frame[y0, -1], right, (width - x1) * height) else width
    return None if (y0, y1, x0, x1) == (0, height, 0, width) or y0 >= y1 or x0 >= x1 else (y0, y1, x0, x1)


def _is_border(value: Any, beside: NDArray[Any], pixels: int) -> bool:
    """Tell whether so many pixels of one value are no chance, by the pixels beside them."""
    if value != value:  # NaN needs no border to be known
        return False
    share = (np.count_nonzero(beside == value) + 1) / (beside.size + 1)
    return bool(share < _LARGEST_SHARE and -np.log(share) * pixels > _UNLIKELY)


@njit(cache=True, nogil=True)
def _edges(frame: NDArray[Any]) -> tuple[int, int, int, int]:
    """Return the rows and columns inside those of one value, from each side."""
    y0, y1, x0, x1 = 0, frame.shape[0], 0, frame.shape[1]
    while y0 < y1 and _is_even(frame, y0, y0 + 1, x0, x1, frame[0, 0]):
        y0 += 1
    while y1 > y0 and _is_even(frame, y1 - 1, y1, x0, x1, frame[frame.shape[0] - 1, 0]):
        y1 -= 1
    if y0 == y1:
        return y0, y1, x0, x1
    while x0 < x1 and _is_even(frame, y0, y1, x0, x0 + 1, frame[y0, 0]):
        x0 += 1
    while x1 > x0 and _is_even(frame, y0, y1, x1 - 1, x1, frame[y0, frame.shape[1] - 1]):
        x1 -= 1
    return y0, y1, x0, x1


@njit(cache=True, nogil=True)
def _is_even(frame: NDArray[Any], y0: int, y1: int, x0: int, x1: int, value: Any) -> bool:
    for y in range(y0, y1):
        for x in range(x0, x1):
            if frame[y, x] != value and (frame[y, x] == frame[y, x] or value == value):
                return False
    return True
