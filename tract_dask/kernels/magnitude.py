"""The unit in which pixels are computed, so that float32 neither overflows nor runs out of digits.

Squares and fourth powers of pixels must be ordinary numbers too. So pixels of another order of magnitude are divided by
a power of two, which is exact, and what is found is multiplied by it: it is then the same as for ordinary pixels.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

_ORDINARY = 2.0**16
_ENOUGH = 1 << 16


def unit_of(values: ArrayLike) -> float:
    """Return a power of two by which to divide these values; 1 where their mean size is ordinary, or 0.

    Ordinary is from 2^-16 to 2^16. What is NaN or infinite is left out; of many values some are looked at.

    Examples
    --------
    >>> unit_of([3.0, 500.0]), unit_of([1e-9, 3e-9]), unit_of([np.nan, -4e9]) == 2**31
    (1.0, 1.862645149230957e-09, True)
    """
    flat = np.ravel(values)
    sizes = np.abs(flat[:: flat.size // _ENOUGH | 1].astype(np.float64))
    sizes = sizes[np.isfinite(sizes)]
    with np.errstate(over="ignore"):
        size = float(sizes.mean()) if sizes.size else 0.0
    if not math.isfinite(size):  # the sum overflows
        size = float(np.median(sizes))
    if size == 0 or 1 / _ORDINARY <= size <= _ORDINARY:
        return 1.0
    return math.ldexp(1.0, math.frexp(size)[1] - 1)
