"""Whether float32, in which frames are computed, holds the pixels of a movie."""

from __future__ import annotations

import numpy as np
import xarray as xr

from ..errors import InputError

_LARGEST = 1e37
_COARSE = 2.0**15
"""Mean over standard deviation of a frame: from here on rounding costs a matched filter a third of its noise."""
_TOO_COARSE = 2.0**19
"""And from here on fits a tenth of theirs."""


def check_pixels(statistics: xr.Dataset, where: str) -> str | None:
    """Return a warning where float32 rounds the frames so coarsely that it shows in results, None where it does not.

    Parameters
    ----------
    statistics
        Of the frames, as :meth:`.Movie.statistics` gives them.
    where
        What to call the movie in errors.

    Raises
    ------
    InputError
        Where pixels are larger than 1e37 or all smaller than 1e-37, or where rounding would spoil the results.
    """
    if "frame_std" not in statistics:  # sums of frames, which were looked at when they were converted
        return None
    low, high, mean, spread = (
        statistics[name].to_numpy() for name in ("frame_min", "frame_max", "frame_mean", "frame_std")
    )
    shown = np.isfinite(spread) & (spread > 0)
    if not shown.any():
        return None
    largest = float(np.maximum(np.abs(low), np.abs(high))[shown].max())
    if not 1 / _LARGEST <= largest <= _LARGEST:
        raise InputError(
            f"the pixels are too {'large' if largest > 1 else 'small'} to be computed",
            where,
            f"values of {1 / _LARGEST:g} to {_LARGEST:g}",
            f"a largest one of {largest:g}",
            "Multiply the frames by a constant before they are converted",
        )
    ratio = float(np.median(np.abs(mean[shown]) / spread[shown]))
    said = f"the frames' mean is {ratio:.2g} times what they vary by"
    if ratio > _TOO_COARSE:
        raise InputError(
            f"{said}, so that rounding would spoil the results",
            where,
            f"at most {_TOO_COARSE:.2g} times",
            f"a mean of {np.median(mean[shown]):g}, a standard deviation of {np.median(spread[shown]):g}",
            "Subtract a constant from the frames before they are converted",
        )
    return f"{said}: rounding adds to the noise; better subtract a constant first" if ratio > _COARSE else None
