"""Borders of frames that were moved before: rows and columns of one value, or of none, around what a frame shows.

Rows of one value are a border where the pixels beside them are others: with a share q of that value there, m pixels
have it by chance with probability q^m. Aligned frames are interpolated, so that the last row and column beside a border
are a mixture of both, and are counted to it.

Vacuum of one value is not a border: that of a simulation without noise, or without any count. There the other values
begin little by little, or lie together, as in the tails of columns; beside a border they begin at once, with noise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

_UNLIKELY = 30.0
"""A border is one where it has a probability of exp(-30) by chance."""
_LARGEST_SHARE = 0.97
_BESIDE, _NEXT = 8, slice(1, 3)
"""Rows or columns that tell what lies beside a border, and those of them that tell how often its value is there."""
_GRADUAL = 0.25
"""Other values are this many times as frequent next to a border as a few rows on, or more."""
_ALONE, _FEWEST = 0.2, 8.0
"""Of the pixels that stand alone in noise this share does so beside a border, where so many are expected."""


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
    shown = frame[y0:y1, x0:x1]
    top, bottom, left, right = (part[:_BESIDE] for part in (shown, shown[::-1], shown.T, shown.T[::-1]))
    height, width = frame.shape
    y0 = y0 + 1 if y0 and _is_border(frame[0, 0], top, y0 * width) else 0
    y1 = y1 - 1 if y1 < height and _is_border(frame[-1, 0], bottom, (height - y1) * width) else height
    x0 = x0 + 1 if x0 and _is_border(frame[y0, 0], left, x0 * height) else 0
    x1 = x1 - 1 if x1 < width and _is_border(frame[y0, -1], right, (width - x1) * height) else width
    return None if (y0, y1, x0, x1) == (0, height, 0, width) or y0 >= y1 or x0 >= x1 else (y0, y1, x0, x1)


def _is_border(value: Any, beside: NDArray[Any], pixels: int) -> bool:
    """Tell whether so many pixels of one value are no chance, by the rows beside them, the nearest first."""
    if value != value:  # NaN needs no border to be known
        return False
    same = beside == value
    near = same[_NEXT] if len(same) > _NEXT.start else same
    share = (np.count_nonzero(near) + 1) / (near.size + 1)
    if not (share < _LARGEST_SHARE and -np.log(share) * pixels > _UNLIKELY):
        return False
    return not (_is_gradual(same) or _is_smooth(same))


def _is_gradual(same: NDArray[np.bool_]) -> bool:
    """Tell whether there are few other values in the rows next to a border, by where those have its value."""
    near, far = 1 - same[_NEXT].mean(), 1 - same[_NEXT.stop + 2 :].mean() if len(same) == _BESIDE else 0.0
    return bool(near < _GRADUAL * far)


def _is_smooth(same: NDArray[np.bool_]) -> bool:
    """Tell whether pixels of a border's value lie together in the rows beside it: in noise, many stand alone."""
    if len(same) < 3:
        return False
    inner = same[1:-1, 1:-1]
    alike = (inner == same[:-2, 1:-1]) | (inner == same[2:, 1:-1])
    alike |= (inner == same[1:-1, :-2]) | (inner == same[1:-1, 2:])
    share = float(inner.mean()) if inner.size else 0.0
    expected = inner.size * (share * (1 - share) ** 4 + (1 - share) * share**4)
    return bool(expected > _FEWEST and np.count_nonzero(~alike) < _ALONE * expected)


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
