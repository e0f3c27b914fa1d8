"""The largest value that a camera or a file type can hold: pixels above it are cut off at it.

Values become rarer towards the largest one, the more the farther: with n pixels of the largest value and m of the next
one below, about n^2 / m would be higher still. Where that is many, and there are none, something has cut them off.
Not so where values fade into the largest one, as dark columns without noise do into the vacuum around them.

Where frames were corrected by a gain reference afterwards, each pixel is cut off at a value of its own. It has that
value again and again, and varies by less than pixels of its level do.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

_MISSING = 30.0
"""So many pixels would be higher by chance."""
_RATIO, _RATIO_OF_BITS = 3.0, 1.0
"""So many times as many pixels have the largest value as the next one; less is enough where it is 2^n - 1.

Less is enough, too, among the highest values of pixels, of which noise makes a narrow peak: a single frame decides.
"""
_EXACT = 2.0**24
_FADES, _LITTLE, _ALONE = 0.5, 1e-3, 0.02
"""It fades where this share of the pixels beside it have the next value, or this little of the range less, and hardly
any pixel stands alone, as many do in noise."""


_LEVELS = (0.0, 0.5, 0.7, 0.9, 0.97, 0.99, 0.997, 1.0)
"""Groups of pixels by their level, as shares of all."""
_FEWEST_CUT, _TIED, _SURE, _QUIET = 32, 0.5, 5.0, 0.7
"""A group of so many pixels is cut off where more than this share has its highest value twice, by so many standard
errors more than in the darker group with the fewest, and where it has less than this share of the usual variance."""
_NEAR = 2.0
"""Its highest values are less than so many times its mean: one electron in a frame, or none, is no cut."""


def cut_off_one_by_one(highest: Floats, second: Floats, level: Floats, quietness: Floats) -> int:
    """Return how many pixels of a movie are cut off, each at its own value; 0 where that is not seen.

    Parameters
    ----------
    highest, second
        (pixels,) the two highest values of each pixel in a sample of frames.
    level, quietness
        (pixels,) its mean, and its variance over that of the noise at this level.
    """
    order = np.argsort(level, kind="stable")
    tied = (highest == second)[order]
    edges = np.rint(np.array(_LEVELS) * len(order)).astype(int)
    least, found = 1.0, 0
    for first, stop in pairwise(edges):
        group, number, which = tied[first:stop], stop - first, order[first:stop]
        if number < _FEWEST_CUT:
            continue
        share = float(group.mean())
        sure = _SURE * np.sqrt(share * (1 - share) / number + 0.25 / number)
        near = np.median(highest[which]) < _NEAR * np.median(level[which])
        if near and share > max(_TIED, least + sure) and quietness[which].mean() < _QUIET:
            found += int(group.sum())
        else:
            least = min(least, share)
    return found


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
    if not known.size or (top := float(known.max())) >= _EXACT or not _cut_off(known, top, _RATIO_OF_BITS):
        return None
    good = used & np.isfinite(frame)
    ratio = _RATIO_OF_BITS if top >= 1 and np.log2(top + 1) % 1 == 0 else _RATIO
    return top if _cut_off(frame[good], top, ratio) and not _fades(frame, good, top) else None


def _cut_off(values: NDArray[Any], top: float, ratio: float) -> bool:
    """Tell whether so many values are equal to ``top``, against those next to it, that some would be higher."""
    reached = int(np.count_nonzero(values == top))
    below = values[values < top]
    if not reached or not below.size:
        return False
    beside = int(np.count_nonzero(below == below.max()))
    return reached > ratio * beside and reached**2 > _MISSING * beside


def _fades(frame: NDArray[Any], good: NDArray[np.bool_], top: float) -> bool:
    """Tell whether the pixels (y, x) beside those equal to ``top`` are hardly lower, and none is alone as in noise."""
    reached = good & (frame == top)
    padded = np.pad(reached, 1).astype(np.int8)
    around = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
    beside = good & ~reached & (around > 0)
    if not beside.any():
        return False
    alone = np.count_nonzero(reached & (around == 0)) + np.count_nonzero(beside & (around == 4))
    below = frame[good & ~reached]
    near = min(float(below.max()), top - _LITTLE * (top - float(below.min())))
    return bool((frame[beside] >= near).mean() > _FADES and alone < _ALONE * beside.sum())
