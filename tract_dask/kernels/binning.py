"""Per-frame statistics and binned means, in one pass over the pixels.

Rows are taken in bands of :data:`FACTOR`. Every sum runs down the columns of a band, never along a row, so that the
compiler vectorises it without changing the order of additions: the results are the same on every machine. Sums over
integers of up to two bytes are exact.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from numba import njit
from numpy.typing import NDArray

Pixels: TypeAlias = NDArray[Any]
Floats: TypeAlias = NDArray[np.float64]
Counts: TypeAlias = NDArray[np.int32]
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


class FrameMeter:
    """Measures frames of one shape and pixel type, one after the other, in memory that is used again.

    Parameters
    ----------
    shape
        Rows and columns of a frame.
    dtype
        Integers or floating-point numbers of up to 8 bytes, in native byte order.
    n_levels
        Number of binned levels; level k has the shape (ceil(y / 4**k), ceil(x / 4**k)).

    Examples
    --------
    >>> measures = FrameMeter((4, 8), np.uint8, 1).measure(np.arange(32, dtype=np.uint8).reshape(4, 8))
    >>> measures.mean, measures.levels[0].tolist()
    (15.5, [[13.5, 17.5]])
    """

    def __init__(self, shape: tuple[int, int], dtype: npt.DTypeLike, n_levels: int = 0) -> None:
        self._dtype = np.dtype(np.float32) if np.dtype(dtype) == np.float16 else np.dtype(dtype)
        kind, itemsize = self._dtype.kind, self._dtype.itemsize
        self._scan = _scan_floats if kind == "f" else _scan_integers if itemsize > 2 else _scan_narrow
        factors = [FACTOR**level for level in range(1, max(1, n_levels) + 1)]
        shapes = [(-(-shape[0] // factor), -(-shape[1] // factor)) for factor in factors]
        self._sums = [np.empty(bins) for bins in shapes]
        self._counts = [np.empty(bins, np.int32) for bins in shapes]
        self._levels = tuple(np.empty(bins, np.float32) for bins in shapes[:n_levels])

    def measure(self, frame: Pixels) -> FrameMeasures:
        """Return the statistics of a frame and its means binned by 4, 16, 64 and so on, which the next call replaces.

        NaN and infinite pixels are counted and otherwise left out. Bins at the ragged right and bottom edges are means
        of the pixels that there are; a bin without a finite pixel is NaN.
        """
        frame = frame.astype(self._dtype, copy=False)
        n_good, minimum, maximum, mean, variance = self._scan(
            frame, *_extremes(self._dtype), self._sums[0], self._counts[0]
        )
        for number, level in enumerate(self._levels):
            if number:
                _coarsen(*self._bins(number - 1), *self._bins(number))
            _average(*self._bins(number), level)
        return FrameMeasures(minimum, maximum, mean, float(np.sqrt(variance)), frame.size - n_good, self._levels)

    def _bins(self, number: int) -> tuple[Floats, Counts]:
        return self._sums[number], self._counts[number]


def _extremes(dtype: np.dtype[Any]) -> tuple[Any, Any]:
    """Return the largest and the smallest value of a pixel type, from which minimum and maximum start."""
    if dtype.kind == "f":
        return dtype.type(np.inf), dtype.type(-np.inf)
    info = np.iinfo(dtype)
    return dtype.type(info.max), dtype.type(info.min)


def _scan_narrow(frame: Pixels, largest: Any, smallest: Any, sums: Floats, counts: Counts) -> Scan:
    """Fill the sums and counts of bins and return the statistics of integers of up to two bytes."""
    n = frame.size
    minimum, maximum, total, squares = _add_up(frame, largest, smallest, sums, counts)
    return n, float(minimum), float(maximum), total / n, (n * squares - total * total) / (n * n)


@njit(cache=True, nogil=True)
def _add_up(frame: Pixels, largest: Any, smallest: Any, sums: Floats, counts: Counts) -> tuple[Any, Any, int, int]:
    """Fill the sums and counts of bins; return minimum, maximum, sum and sum of squares.

    Squares are added up in float64, which is exact below 2^53: for 2^21 rows of the largest values.
    """
    n_y, n_x = frame.shape
    low, high = np.full(n_x, largest), np.full(n_x, smallest)
    squares, total = np.zeros(n_x), np.empty(n_x, np.int32)
    whole = 0
    for band in range(sums.shape[0]):
        start, stop = band * FACTOR, min(band * FACTOR + FACTOR, n_y)
        total[:] = 0
        if stop - start == FACTOR:
            _add_band(frame[start], frame[start + 1], frame[start + 2], frame[start + 3], low, high, total, squares)
        else:
            for y in range(start, stop):
                _add_row(frame[y], low, high, total, squares)
        for column in range(n_x // FACTOR):
            x = column * FACTOR
            bin_sum = int(total[x] + total[x + 1] + total[x + 2] + total[x + 3])
            sums[band, column] = bin_sum
            counts[band, column] = FACTOR * (stop - start)
            whole += bin_sum
        if n_x % FACTOR:
            bin_sum = int(total[n_x - n_x % FACTOR :].sum())
            sums[band, -1] = bin_sum
            counts[band, -1] = (n_x % FACTOR) * (stop - start)
            whole += bin_sum
    square_sum = 0
    for x in range(n_x):
        square_sum += int(squares[x])
    return low.min(), high.max(), whole, square_sum


@njit(cache=True, nogil=True)
def _add_band(
    a: Pixels, b: Pixels, c: Pixels, d: Pixels, low: Pixels, high: Pixels, total: Pixels, squares: Floats
) -> None:
    """Do what :func:`_add_row` does for the FACTOR rows of a band, at half the cost."""
    for x in range(low.size):
        low[x] = min(low[x], min(min(a[x], b[x]), min(c[x], d[x])))
        high[x] = max(high[x], max(max(a[x], b[x]), max(c[x], d[x])))
    for x in range(low.size):
        total[x] = np.int32(a[x]) + np.int32(b[x]) + np.int32(c[x]) + np.int32(d[x])
    for x in range(low.size):
        p, q, r, s = np.float64(a[x]), np.float64(b[x]), np.float64(c[x]), np.float64(d[x])
        squares[x] += p * p + q * q + r * r + s * s


@njit(cache=True, nogil=True)
def _add_row(row: Pixels, low: Pixels, high: Pixels, total: Pixels, squares: Floats) -> None:
    """Add a row of pixels to the extremes, sums and squares of their columns."""
    for x in range(row.size):
        value = np.float64(row[x])
        low[x] = min(low[x], row[x])
        high[x] = max(high[x], row[x])
        total[x] += np.int32(row[x])
        squares[x] += value * value


@njit(cache=True, nogil=True)
def _scan_integers(frame: Pixels, largest: Any, smallest: Any, sums: Floats, counts: Counts) -> Scan:
    """Fill the sums and counts of bins and return the statistics of wider integers."""
    n_y, n_x = frame.shape
    low, high = np.full(n_x, largest), np.full(n_x, smallest)
    squares, total = np.zeros(n_x), np.empty(n_x)
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
def _scan_floats(frame: Pixels, largest: Any, smallest: Any, sums: Floats, counts: Counts) -> Scan:
    """Do the same for floating-point pixels, of which some may not be finite (there x - x is not 0)."""
    n_y, n_x = frame.shape
    low, high = np.full(n_x, largest), np.full(n_x, smallest)
    squares, total = np.zeros(n_x), np.empty(n_x)
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
def _coarsen(sums: Floats, counts: Counts, coarse_sums: Floats, coarse_counts: Counts) -> None:
    """Fill the sums and counts of bins that are FACTOR times larger."""
    coarse_sums[...] = 0
    coarse_counts[...] = 0
    for y in range(sums.shape[0]):
        for column in range(coarse_sums.shape[1]):
            bin_sum, bin_n = 0.0, 0
            for x in range(column * FACTOR, min(column * FACTOR + FACTOR, sums.shape[1])):
                bin_sum += sums[y, x]
                bin_n += counts[y, x]
            coarse_sums[y // FACTOR, column] += bin_sum
            coarse_counts[y // FACTOR, column] += bin_n


@njit(cache=True, nogil=True, error_model="numpy")
def _average(sums: Floats, counts: Counts, means: NDArray[np.float32]) -> None:
    """Fill the means of bins, NaN (0 / 0) where a bin is empty."""
    for y in range(sums.shape[0]):
        for x in range(sums.shape[1]):
            means[y, x] = sums[y, x] / counts[y, x]
