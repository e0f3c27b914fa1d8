"""Pixels that hold no number, filled with the mean of what is near: where a filter needs a whole image.

The mean is weighted by a Gaussian. Far from all known pixels it is that of the whole image. What is filled carries no
information: fits are made to the pixels that are there (:mod:`tract_dask.stages.fit.incomplete`).
The sum of the frames, and frames that drift is measured on, are filled so, too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .windows import blur

_REACH_PX = 3.0
"""Sigma of the mean of what is near."""

_LEAST = np.float32(1e-3)
"""A mean over less than this share of its weights goes over into that of the image."""


def fill_near(image: NDArray[Any]) -> NDArray[np.float32]:
    """Return an image (y, x) whose pixels that are NaN or infinite are the mean of what is near them.

    Where none is known, the image is zeros.

    Examples
    --------
    >>> fill_near(np.array([[2.0, np.nan, 2.0]])).tolist()
    [[2.0, 2.0, 2.0]]
    """
    there = np.isfinite(image)
    filled: NDArray[np.float32] = np.where(there, image, 0).astype(np.float32)
    if there.all() or not there.any():
        return filled
    level = np.float32(filled[there].mean(dtype=np.float64))
    share = blur(there.astype(np.float32), _REACH_PX)
    near = blur(np.where(there, filled - level, 0).astype(np.float32), _REACH_PX)
    np.copyto(filled, level + near / np.maximum(share, _LEAST), where=~there)
    return filled
