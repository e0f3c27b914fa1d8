"""Fixed patterns of a detector: what is finer in the mean of many frames than any specimen, and than the noise.

An image is looked at through fourth differences along both axes. They pass what changes from pixel to pixel, as the
sensitivity of a detector's pixels does. An atomic column with a sigma of 1.5 px keeps less than 1 % of its amplitude.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_WEIGHTS = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70.0)
_REACH = len(_WEIGHTS) - 1
_INSIDE = slice(_REACH // 2, -(_REACH // 2))
"""Pixels of an image that fourth differences are of, along an axis."""
_SHARED = (2 * np.square(np.correlate(_WEIGHTS, _WEIGHTS, "full")[_REACH:]).sum() - 1) ** 2
"""Neighbours share fourth differences: so many pixels are worth one."""
_BLOCK_PX = 16
_FEWEST_BLOCKS = 16
_OUTLIER = 8.0
_NO_PATTERN = 1e-4
_LARGEST_PX = 1024


class Measured(NamedTuple):
    """A number and its standard error."""

    value: float
    stderr: float


def fine(image: Floats) -> Floats:
    """Return the fourth differences (y - 4, x - 4) of an image (y, x); white noise keeps its standard deviation."""
    n_y, n_x = image.shape[0] - _REACH, image.shape[1] - _REACH
    rows = sum(weight * image[k : k + n_y] for k, weight in enumerate(_WEIGHTS))
    found: Floats = sum(weight * rows[:, k : k + n_x] for k, weight in enumerate(_WEIGHTS))
    return found


def pattern_power(first: Floats, second: Floats) -> Measured | None:
    """Return the variance of a fixed pattern as a share of the level squared, from means of two halves of the frames.

    What both halves show is pattern; their difference is noise, whatever its kind. None where there are too few pixels.

    Parameters
    ----------
    first, second
        (y, x) means of as many frames each, above the offset; not finite where there is none.
    """
    if min(first.shape) < _REACH + _BLOCK_PX:
        return None
    first, second = (np.where(np.isfinite(half), half, np.nan) for half in (first, second))
    mean, half = (first + second) / 2, (first - second) / 2
    both, noise = fine(mean), fine(half)
    level = mean[_INSIDE, _INSIDE]
    good = _usual(both) & np.isfinite(noise) & (level > 0)
    powers = _in_blocks(np.where(good, both**2 - noise**2, 0))
    levels = _in_blocks(np.where(good, level**2, 0))
    used = levels > 0
    if used.sum() < _FEWEST_BLOCKS:
        return None
    share = powers[used].sum() / levels[used].sum()
    left = powers[used] - share * levels[used]  # the ratio of sums, block by block
    return Measured(float(share), float(np.sqrt(np.square(left).sum()) / levels[used].sum()))


def likeness(mean: Floats, sensitivity: Floats) -> Measured | None:
    """Return how much of a pattern of sensitivities is in a mean of frames (both (y, x)): 1 where it is this one.

    -1 where the mean has its inverse, 0 where it has nothing of it. None where the sensitivity has no pattern.
    """
    return _share(fine(mean), fine(sensitivity), _smooth(mean)[_INSIDE, _INSIDE])


def added_likeness(mean: Floats, dark: Floats) -> Measured | None:
    """Return how much of the pattern of a dark image is in a mean of frames (both (y, x)), as :func:`likeness`."""
    added = fine(dark)
    return _share(fine(mean), added, np.ones_like(added))


def shift_of(mean: Floats, image: Floats) -> tuple[int, int]:
    """Return how far (y, x) an image's pattern lies from where a mean of frames (both (y, x)) shows it, or its inverse.

    Of large frames the middle is compared.
    """
    rows, columns = (slice(max(0, side - _LARGEST_PX) // 2, (side + _LARGEST_PX) // 2) for side in mean.shape)
    seen, known = (fine(one[rows, columns]) for one in (mean, image))
    spectra = (np.fft.rfft2(np.where(_usual(one), one, 0)) for one in (seen, known))
    likeness_at = np.abs(np.fft.irfft2(next(spectra) * np.conj(next(spectra)), seen.shape))
    best = np.unravel_index(np.argmax(likeness_at), likeness_at.shape)
    y, x = (int(at) if at <= side // 2 else int(at) - side for at, side in zip(best, seen.shape, strict=True))
    return y, x


def _share(seen: Floats, pattern: Floats, level: Floats) -> Measured | None:
    """Return the slope of what is seen against ``pattern * level``, where the noise grows as the level."""
    good = _usual(seen) & np.isfinite(pattern) & np.isfinite(level) & (level > 0)
    pattern, seen, level = pattern[good], seen[good], level[good]
    weight = float((level * pattern**2).sum())
    if good.sum() < _FEWEST_BLOCKS * _BLOCK_PX**2 or (pattern**2).mean() < _NO_PATTERN**2:
        return None
    slope = float((seen * pattern).sum()) / weight
    left = seen - slope * level * pattern
    return Measured(slope, float(np.sqrt(_SHARED * np.square(left * pattern).sum()) / weight))


def _usual(values: Floats) -> NDArray[np.bool_]:
    """Tell which values are finite and not far out of the others, as beside hot pixels."""
    size = np.abs(values)
    usual = np.nanmedian(size) if np.isfinite(size).any() else 0.0
    return np.isfinite(size) & (size <= _OUTLIER * 1.4826 * usual)


def _in_blocks(values: Floats) -> Floats:
    """Return the sums of squares of 16 x 16 pixels, without what is left at the ends."""
    rows, columns = (side // _BLOCK_PX for side in values.shape)
    whole = values[: rows * _BLOCK_PX, : columns * _BLOCK_PX]
    sums: Floats = whole.reshape(rows, _BLOCK_PX, columns, _BLOCK_PX).sum(axis=(1, 3))
    return sums


def _smooth(image: Floats) -> Floats:
    """Return the mean of 5 x 5 pixels around each, NaN at the edges."""
    found = np.full(image.shape, np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(image, (_REACH + 1, _REACH + 1))
    found[_INSIDE, _INSIDE] = windows.mean(axis=(2, 3))
    return found
