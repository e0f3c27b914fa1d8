"""The largest value that a camera or a file type can hold: pixels above it are cut off at it.

Values become rarer towards the largest one, the more the farther: with n pixels of the largest value and m of the next
one below, about n^2 / m would be higher still. Where that is many, and there are none, something has cut them off.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_MISSING = 30.0
"""So many pixels would be higher by chance."""
_RATIO, _RATIO_OF_BITS = 3.0, 1.0
"""So many times as many pixels have the largest value as the next one; less is enough where it is 2^n - 1."""
_EXACT = 2.0**24


def full_scale(usual_high: NDArray[np.float32], frame: NDArray[Any], used: NDArray[np.bool_]) -> float | None:
    """Return the value at which the pixels of a movie are cut off; None where they are not, or it is not seen.

    Parameters
    ----------
    usual_high
        (y, x) second highest value of each pixel in a sample of frames: a spike does not reach it.
    frame
        (y, x) a single frame.
    used
        (y, x) pixels to look at.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> frames = np.minimum(rng.poisson(250, (9, 40, 40)), 255).astype(np.float32)
    >>> full_scale(np.sort(frames, axis=0)[-2], frames[0], np.ones((40, 40), bool))
    255.0
    """
    known = usual_high[used & np.isfinite(usual_high)]
    if not known.size or (top := float(known.max())) >= _EXACT or not _cut_off(known, top):
        return None
    return top if _cut_off(frame[used & np.isfinite(frame)], top) else None


def _cut_off(values: NDArray[Any], top: float) -> bool:
    """Tell whether so many values are equal to ``top`` that some would be higher."""
    reached = int(np.count_nonzero(values == top))
    below = values[values < top]
    if not reached or not below.size:
        return False
    beside = int(np.count_nonzero(below == below.max()))
    of_bits = top >= 1 and np.log2(top + 1) % 1 == 0
    return reached > (_RATIO_OF_BITS if of_bits else _RATIO) * beside and reached**2 > _MISSING * beside
