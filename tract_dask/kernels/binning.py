"""Per-frame statistics and binned means, in one pass over the pixels.

Rows are taken in bands of :data:`FACTOR`. Every sum runs down the columns of a band, never along a row, so that the
compiler vectorises it without changing the order of additions: the results are the same on every machine.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

Pixels: TypeAlias = NDArray[Any]
Floats: TypeAlias = NDArray[np.float64]
Counts: TypeAlias = NDArray[np.int64]
Scan: TypeAlias = tuple[int, float, float, float, float]
"""Number of finite pixels, their minimum, maximum, mean and variance."""

FACTOR = 4
"""Each level is this many times coarser than the one before: level k is binned by 4 to the power of k."""


class FrameMeasures(NamedTuple):
    """What one frame holds: statistics of its finite pixels (NaN where it has none) and its binned means."""

    minimum: float
    maximum: float
    mean: float
    std: float
    n_bad: int
    levels: tuple[NDArray[np.float32], ...]


def measure_frame(frame: Pixels, n_levels: int = 0) -> FrameMeasures:
    """Return the statistics of a frame and its means binned by 4, 16, 64 and so on.

    NaN and infinite pixels are counted and otherwise left out. Bins at the ragged right and bottom edges are means of
    the pixels that there are; a bin without a finite pixel is NaN.

    Parameters
    ----------
    frame
        Pixels (y, x): integers or floating-point numbers of up to 8 bytes, in native byte order.
    n_levels
        Number of binned levels; level k has the shape (ceil(y / 4**k), ceil(x / 4**k)).

    Examples
    --------
    >>> measures = measure_frame(np.arange(32, dtype=np.uint8).reshape(4, 8), 1)
    >>> measures.mean, measures.levels[0].tolist()
    (15.5, [[13.5, 17.5]])
    """
    if frame.dtype == np.float16:
        frame = frame.astype(np.float32)
    n_y, n_x = frame.shape
    sums = np.empty((-(-n_y // FACTOR), -(-n_x // FACTOR)))
    counts = np.empty(sums.shape, np.int64)
    scan = _scan_floats if frame.dtype.kind == "f" else _scan_integers
    narrow = frame.dtype.kind in "iu" and frame.dtype.itemsize <= 2
    total = np.zeros(n_x, np.int32 if narrow else np.float64)
    n_good, minimum, maximum, mean, variance = scan(frame, total, *_extremes(frame.dtype), sums, counts)
    levels = []
    for level in range(n_levels):
        if level:
            sums, counts = _coarsen(sums, counts)
        levels.append(_means(sums, counts))
    return FrameMeasures(minimum, maximum, mean, float(np.sqrt(variance)), frame.size - n_good, tuple(levels))


def _extremes(dtype: np.dtype[Any]) -> tuple[Any, Any]:
    """Return the largest and the smallest value of a pixel type, from which minimum and maximum start."""
    if dtype.kind == "f":
        return dtype.type(np.inf), dtype.type(-np.inf)
    info = np.iinfo(dtype)
    return dtype.type(info.max), dtype.type(info.min)


@njit(cache=True, nogil=True)
def _scan_integers(frame: Pixels, total: Pixels, largest: Any, smallest: Any, sums: Floats, counts: Counts) -> Scan:
    """Fill the sums and counts of bins and return the statistics of integer pixels."""
    n_y, n_x = frame.shape
    low, high = np.full(n_x, largest), np.full(n_x, smallest)
    squares = np.zeros(n_x)
    n, mean, between = 0, 0.0, 0.0
    for band in range(sums.shape[0]):
        start, stop = band * FACTOR, min(band * FACTOR + FACTOR, n_y)
        total[:] = 0
        for y in range(start, stop):
            for x in range(n_x):
                value = frame[y, x]
                total[x] += value
                low[x] = min(low[x], value)
                high[x] = max(high[x], value)
        band_sum = 0.0
        for column in range(sums.shape[1]):
            left, right = column * FACTOR, min(column * FACTOR + FACTOR, n_x)
            bin_sum = 0.0
            for x in range(left, right):
                bin_sum += total[x]
            sums[band, column] = bin_sum
            counts[band, column] = (right - left) * (stop - start)
            band_sum += bin_sum
        band_n = (stop - start) * n_x
        band_mean = band_sum / band_n
        for y in range(start, stop):
            for x in range(n_x):
                difference = frame[y, x] - band_mean
                squares[x] += difference * difference
        n, mean, between = _merge(n, mean, between, band_n, band_mean)
    return n, float(low.min()), float(high.max()), mean, (squares.sum() + between) / n


@njit(cache=True, nogil=True)
def _scan_floats(frame: Pixels, total: Pixels, largest: Any, smallest: Any, sums: Floats, counts: Counts) -> Scan:
    """Do the same for floating-point pixels, of which some may not be finite (there x - x is not 0)."""
    n_y, n_x = frame.shape
    low, high = np.full(n_x, largest), np.full(n_x, smallest)
    squares = np.zeros(n_x)
    seen = np.zeros(n_x, np.int32)
    n, mean, between = 0, 0.0, 0.0
    for band in range(sums.shape[0]):
        start, stop = band * FACTOR, min(band * FACTOR + FACTOR, n_y)
        total[:] = 0.0
        seen[:] = 0
        for y in range(start, stop):
            for x in range(n_x):
                value = frame[y, x]
                good = value - value == 0
                total[x] += value if good else 0.0
                seen[x] += 1 if good else 0
                low[x] = value if good and value < low[x] else low[x]
                high[x] = value if good and value > high[x] else high[x]
        band_sum, band_n = 0.0, 0
        for column in range(sums.shape[1]):
            bin_sum, bin_n = 0.0, 0
            for x in range(column * FACTOR, min(column * FACTOR + FACTOR, n_x)):
                bin_sum += total[x]
                bin_n += seen[x]
            sums[band, column] = bin_sum
            counts[band, column] = bin_n
            band_sum += bin_sum
            band_n += bin_n
        if band_n == 0:
            continue
        band_mean = band_sum / band_n
        for y in range(start, stop):
            for x in range(n_x):
                value = frame[y, x]
                difference = value - band_mean if value - value == 0 else 0.0
                squares[x] += difference * difference
        n, mean, between = _merge(n, mean, between, band_n, band_mean)
    if n == 0:
        return 0, np.nan, np.nan, np.nan, np.nan
    return n, float(low.min()), float(high.max()), mean, (squares.sum() + between) / n


@njit(cache=True, nogil=True)
def _merge(n: int, mean: float, between: float, band_n: int, band_mean: float) -> tuple[int, float, float]:
    """Add a band to the running mean and to the squares between bands (Chan, Golub and LeVeque, 1983)."""
    both = n + band_n
    step = band_mean - mean
    return both, mean + step * (band_n / both), between + step * step * (n * (band_n / both))


@njit(cache=True, nogil=True)
def _coarsen(sums: Floats, counts: Counts) -> tuple[Floats, Counts]:
    """Return the sums and counts of bins that are FACTOR times larger."""
    n_y, n_x = sums.shape
    shape = ((n_y + FACTOR - 1) // FACTOR, (n_x + FACTOR - 1) // FACTOR)
    coarse_sums, coarse_counts = np.zeros(shape), np.zeros(shape, np.int64)
    for y in range(n_y):
        for x in range(n_x):
            coarse_sums[y // FACTOR, x // FACTOR] += sums[y, x]
            coarse_counts[y // FACTOR, x // FACTOR] += counts[y, x]
    return coarse_sums, coarse_counts


@njit(cache=True, nogil=True)
def _means(sums: Floats, counts: Counts) -> NDArray[np.float32]:
    """Return the means of bins as float32, NaN where a bin is empty."""
    means = np.empty(sums.shape, np.float32)
    for y in range(sums.shape[0]):
        for x in range(sums.shape[1]):
            means[y, x] = sums[y, x] / counts[y, x] if counts[y, x] else np.nan
    return means
