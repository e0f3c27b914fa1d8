"""Pixels that carry no data: hot, dead and stuck ones, spikes of single frames, dead lines, and borders.

A pixel is judged by its neighbours in a square of 5 x 5. With h and l the fifth highest and the fifth lowest of them,
it stands out where it exceeds

    h + 6 (h - l) + k noise

h and l do not see a cluster of up to four more pixels that are faulty, nor a line. An atomic column is wider: at the
centre of a Gaussian of sigma 0.8 px, at any place between pixels, the excess over h is at most 4.2 times h - l, however
high the dose. What noise alone adds to h - l counts not in single frames. The noise is that of the movie: a line
through the variance from one frame to the next against the level.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .saturation import cut_off_one_by_one, full_scale

Floats = NDArray[np.float32]
Mask = NDArray[np.uint8]

BLOCK = 4
"""Side of the squares that a pixel's own history is kept for, px."""

HOT, DEAD, LINE, USER = 1, 2, 3, 4
"""Why a pixel is masked: what a mask holds; 0 where it is not."""

_STRUCTURE = 6.0
_STATIC_NOISE, _FRAME_NOISE = 6.0, 8.0
_RELIEF = 2.5
"""In single frames noise alone has h - l of 1.7 standard deviations; these are taken off."""
_LIKELY = 25.0
"""A pixel is stuck where that it keeps its value by chance has a probability of exp(-25)."""
_LINE_SHARE = 0.95
_EDGE_NOISE = 10.0
_BINS = 16
_ENOUGH = 1 << 20
"""Of so many pixels it is looked whether they are cut off one by one."""


class Moments:
    """What sample frames tell of every pixel: its mean without the two highest values, variance, and changes.

    Frames are added in pairs that follow one another, so that drift adds little to the variance.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.total, self.first, self.second, self.squares, self.last = np.zeros((5, *shape), np.float32)
        self.changes = np.zeros(shape, np.uint8)
        self.first[:], self.second[:] = -np.inf, -np.inf
        self.frames = self.pairs = 0

    def add(self, frame: NDArray[Any], *, follows: bool) -> None:
        """Add a frame (y, x); ``follows`` where it is the next of the one before."""
        _add(frame, follows, self.total, self.first, self.second, self.squares, self.changes, self.last)
        self.frames, self.pairs = self.frames + 1, self.pairs + follows

    @property
    def mean(self) -> Floats:
        """(y, x)."""
        mean: Floats = (self.total - self.first - self.second) / np.float32(self.frames - 2)
        return mean

    @property
    def variance(self) -> Floats:
        """(y, x) from one frame to the next."""
        return self.squares / np.float32(2 * self.pairs)


@njit(cache=True, nogil=True)
def _add(
    frame: NDArray[Any],
    follows: bool,
    total: Floats,
    first: Floats,
    second: Floats,
    squares: Floats,
    changes: Mask,
    last: Floats,
) -> None:
    for y in range(frame.shape[0]):
        for x in range(frame.shape[1]):
            value = np.float32(frame[y, x])
            high = max(first[y, x], value)
            second[y, x] = max(second[y, x], min(first[y, x], value))
            first[y, x] = high
            total[y, x] += value
            step = value - last[y, x]
            squares[y, x] += step * step if follows else np.float32(0)
            changes[y, x] += np.uint8(1) if follows and step != 0 else np.uint8(0)
            last[y, x] = value


class Noise(NamedTuple):
    """The variance of a pixel of one frame at a level: ``even + slope * level``, in detector units squared."""

    even: float
    slope: float


class History(NamedTuple):
    """What is known of a movie before its frames are looked at one by one.

    Attributes
    ----------
    mask
        (y, x) why pixels are masked; 0 for the others.
    usual
        (blocks, blocks) no pixel at or below this is looked at more closely: levels in the sample, and noise.
    noise
        Of one frame.
    full_scale
        Value at which pixels are cut off; None where they are not.
    relief
        How many standard deviations are taken off h - l in single frames.
    cut_off
        How many pixels are cut off, each at a value of its own, as in frames that a gain reference has corrected.
    """

    mask: Mask
    usual: Floats
    noise: Noise
    full_scale: float | None = None
    relief: float = _RELIEF
    cut_off: int = 0


def look_back(moments: Moments) -> History | None:
    """Return the static defects of a movie, and by what single frames are judged; None where nothing varies."""
    mean, variance = moments.mean, moments.variance
    noise = _noise(mean, variance)
    if noise is None:
        return None
    mask = np.zeros(mean.shape, np.uint8)
    _find_lines(mask, mean, moments, noise)
    odd = ~np.isfinite(mean)
    known = np.where(odd | (mask > 0), np.float32(np.nan), mean)
    high, low = (_standing_out(known, np.float32(sign), noise, moments.frames) for sign in (1, -1))
    mask[(mask == 0) & (high > 0)] = HOT
    top = full_scale(moments.second, moments.last, (mask == 0) & ~odd)
    stuck = _stuck(moments.changes, moments.pairs, (mask > 0) | (moments.second == (np.nan if top is None else top)))
    mask[(mask == 0) & ((low > 0) | (stuck > 0)) & ~odd] = DEAD
    usual = _usual(np.where(mask > 0, np.float32(np.nan), mean), noise)
    return History(mask, usual, noise, top, cut_off=_cut_off(moments, (mask == 0) & ~odd, noise) if top is None else 0)


def _cut_off(moments: Moments, used: NDArray[np.bool_], noise: Noise) -> int:
    """Return how many pixels are cut off at values of their own."""
    chosen = np.flatnonzero(used)[:: max(1, used.size // _ENOUGH)]
    first, second, level, variance = (
        values.ravel()[chosen] for values in (moments.first, moments.second, moments.mean, moments.variance)
    )
    expected = np.maximum(noise.even + noise.slope * np.maximum(level, 0), np.finfo(np.float32).tiny)
    share = int(used.sum()) / max(1, len(chosen))
    return round(share * cut_off_one_by_one(first, second, level, (variance / expected).astype(np.float32)))


def look_at_few(frames: Sequence[NDArray[Any]]) -> History | None:
    """Return the same for a movie of a few frames (y, x), by neighbours alone; None where nothing varies.

    As there are no levels of a sample that narrow columns stay below, h - l is taken as it is.

    Pixels that stand out in all frames are hot ones, if there are two or more.
    """
    moments = Moments(frames[0].shape)
    for number, frame in enumerate(frames):
        moments.add(frame, follows=number > 0)
    mean = moments.total / np.float32(moments.frames)
    across: Floats = np.diff(mean, axis=1, append=mean[:, -1:]) ** np.float32(2) / np.float32(2)
    if (noise := _noise(mean, moments.variance if moments.pairs else across)) is None:
        return None
    history = History(np.zeros(mean.shape, np.uint8), _usual(mean, noise), noise, relief=0.0)
    found = np.zeros(mean.shape, np.int64)
    for frame in frames:
        found[tuple(find_spikes(frame, history).T)] += 1
    history.mask[(found == len(frames)) & (found > 1)] = HOT
    top = full_scale(moments.first, moments.last, (found == 0) & np.isfinite(mean))
    return history._replace(usual=_usual(np.where(found > 0, np.float32(np.nan), mean), noise), full_scale=top)


def _usual(level: Floats, noise: Noise) -> Floats:
    """Return the level of blocks beyond which a pixel of a frame is looked at, from the mean of frames (y, x)."""
    blocks = _blocks(level)
    high = _largest_around(np.where(np.isfinite(blocks), blocks, -np.inf))
    usual = high + _FRAME_NOISE * (np.sqrt(np.maximum(noise.even + noise.slope * np.maximum(high, 0), 0)) + noise.slope)
    return np.where(np.isfinite(usual), usual, 0).astype(np.float32)


def _standing_out(known: Floats, sign: np.float32, noise: Noise, frames: int) -> Mask:
    """Tell which pixels of a mean of frames are higher than their neighbours, or lower with ``sign`` -1."""
    least = -_largest_around(-np.nan_to_num(_blocks(sign * known), nan=np.inf))
    found: Mask = _static(sign * known, least, sign, noise.even, noise.slope, frames)
    return found


def _noise(mean: Floats, variance: Floats) -> Noise | None:
    """Return the noise as a line through medians of blocks, in groups of like level; None where there is none."""
    level, spread = _blocks(mean).ravel(), _blocks(variance).ravel()
    good = np.isfinite(level) & np.isfinite(spread)
    if good.sum() < 4 * _BINS:
        return None
    level, spread = level[good], spread[good]
    parts = np.array_split(np.argsort(level, kind="stable"), _BINS)
    x, y = (np.array([np.median(values[part]) for part in parts], np.float64) for values in (level, spread))
    if not (np.median(y) > 0):
        return None
    slope = float(np.polyfit(x, y, 1)[0]) if np.ptp(x) > 0.1 * np.abs(x).max() else 0.0
    if slope <= 0:
        slope = float(np.median(y / x)) if x.min() > 0 else 0.0
    even = max(0.0, float(np.median(y - slope * np.maximum(x, 0))))
    short = np.median(y) / (even + slope * max(float(np.median(x)), 0.0) or float(np.median(y)))
    return Noise(even * max(1.0, short), slope * max(1.0, short))


def _blocks(image: Floats) -> Floats:
    """Return the means of what is finite in squares of BLOCK x BLOCK; NaN where nothing is."""
    rows, columns = (-(-side // BLOCK) * BLOCK for side in image.shape)
    whole = np.full((rows, columns), np.nan, np.float32)
    whole[: image.shape[0], : image.shape[1]] = image
    squares = whole.reshape(rows // BLOCK, BLOCK, columns // BLOCK, BLOCK)
    known = np.isfinite(squares)
    count = known.sum(axis=(1, 3))
    total = np.where(known, squares, 0).sum(axis=(1, 3), dtype=np.float64)
    with np.errstate(invalid="ignore"):
        return np.where(count > 0, total / count, np.nan).astype(np.float32)


def _largest_around(level: Floats) -> Floats:
    """Return the largest of a block and those around it."""
    padded = np.pad(level, 1, mode="edge")
    across = np.maximum(np.maximum(padded[:, :-2], padded[:, 1:-1]), padded[:, 2:])
    return np.maximum(np.maximum(across[:-2], across[1:-1]), across[2:])


def _find_lines(mask: Mask, mean: Floats, moments: Moments, noise: Noise) -> None:
    """Mask rows and columns that keep their values, beside others at another level that do not."""
    n = moments.pairs
    usual = min(float(np.median(moments.changes)) / max(n, 1), 0.99)
    if n < 2 or usual <= 0:
        return
    for axis in (1, 0):
        still = (moments.changes == 0).mean(axis=axis) > _LINE_SHARE
        if not still.any() or -np.log1p(-usual) * n * mean.shape[axis] < 2 * _LIKELY:
            continue
        with np.errstate(invalid="ignore"):
            level = np.where(np.isfinite(mean), mean, 0).mean(axis=axis, dtype=np.float64)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], still, [0]])))
        for first, stop in zip(edges[::2], edges[1::2], strict=True):
            beside = [k for k in (first - 1, stop) if 0 <= k < still.size]
            error = [_error(level[k], noise, moments.frames * mean.shape[axis]) for k in beside]
            sharp = [abs(level[k] - level[first]) > _EDGE_NOISE * e for k, e in zip(beside, error, strict=True)]
            if any(sharp):
                mask[(slice(first, stop), slice(None)) if axis else (slice(None), slice(first, stop))] = LINE


def _error(level: float, noise: Noise, n: int) -> float:
    return float(np.sqrt((noise.even + noise.slope * max(level, 0.0)) / n))


@njit(cache=True, nogil=True)
def _bounds_around(values: NDArray[Any], y: int, x: int, room: NDArray[np.float64]) -> tuple[int, float, float]:
    """Return how many finite neighbours a pixel has, and the fifth highest and the fifth lowest of 24."""
    n = 0
    for i in range(max(0, y - 2), min(values.shape[0], y + 3)):
        for j in range(max(0, x - 2), min(values.shape[1], x + 3)):
            value = np.float64(values[i, j])
            if (i == y and j == x) or value - value != 0:
                continue
            k = n
            while k > 0 and room[k - 1] > value:
                room[k] = room[k - 1]
                k -= 1
            room[k] = value
            n += 1
    if n < 6:
        return 0, 0.0, 0.0
    rank = (5 * n + 12) // 24
    return n, room[n - rank], room[rank - 1]


@njit(cache=True, nogil=True)
def _reached(values: NDArray[Any], y: int, x: int, limit: float) -> int:
    """Return how many pixels of 3 x 3 reach a limit; with more than five a pixel is not alone."""
    n = 0
    for i in range(max(0, y - 1), min(values.shape[0], y + 2)):
        for j in range(max(0, x - 1), min(values.shape[1], x + 2)):
            n += 1 if values[i, j] >= limit else 0
        if n > 5:
            break
    return n


@njit(cache=True, nogil=True)
def _static(values: Floats, least: Floats, sign: float, even: float, slope: float, frames: int) -> Mask:
    """Tell which pixels of a mean of frames, times ``sign``, stand out; ``least``: the lowest levels around blocks."""
    found, room = np.zeros(values.shape, np.uint8), np.empty(25)
    for y in range(values.shape[0]):
        for x in range(values.shape[1]):
            value = np.float64(values[y, x])
            lowest = least[y // BLOCK, x // BLOCK]
            noise = np.sqrt((even + slope * max(0.0, min(sign * lowest, 1e30))) / frames)
            if not value > lowest + _STATIC_NOISE * noise:
                continue
            if _reached(values, y, x, value) > 5:  # the pixel itself is one
                continue
            n, high, low = _bounds_around(values, y, x, room)
            noise = np.sqrt((even + slope * max(0.0, sign * high)) / frames)
            limit = high + _STRUCTURE * (high - low) + _STATIC_NOISE * noise + _FRAME_NOISE * slope / frames
            if n and value > limit:
                found[y, x] = 1
    return found


@njit(cache=True, nogil=True)
def _stuck(changes: Mask, pairs: int, masked: NDArray[np.bool_]) -> Mask:
    """Tell which pixels never change their value, though their neighbours do."""
    found, room = np.zeros(changes.shape, np.uint8), np.empty(25)
    for y in range(changes.shape[0]):
        for x in range(changes.shape[1]):
            if changes[y, x] == 0 and not masked[y, x]:
                n, _, low = _bounds_around(changes, y, x, room)
                share = min(low / max(pairs, 1), 0.99)
                if n and -np.log(1 - share) * pairs > _LIKELY:
                    found[y, x] = 1
    return found


def find_spikes(frame: NDArray[Any], history: History) -> NDArray[np.int64]:
    """Return the pixels of a frame that stand out of their neighbours and of what was there before: (n, 2) y, x.

    A frame in which more than 3 of 1000 pixels do is another picture, and has no spikes.
    """
    room = np.empty((max(16, frame.size // 333), 2), np.int64)
    n = _spikes(frame, history.mask, history.usual, (*history.noise, history.relief), room)
    return room[:n] if n < len(room) else room[:0]


@njit(cache=True, nogil=True)
def _spikes(
    frame: NDArray[Any], mask: Mask, usual: Floats, limits: tuple[float, float, float], out: NDArray[np.int64]
) -> int:
    n, width, room = 0, frame.shape[1], np.empty(25)
    even, slope, relief = limits
    limit = np.empty(usual.shape[1] * BLOCK, np.float32)
    for y in range(frame.shape[0]):
        if y % BLOCK == 0:
            for k in range(usual.shape[1]):
                limit[BLOCK * k : BLOCK * k + BLOCK] = usual[y // BLOCK, k]
        row, above = frame[y], np.int32(0)
        for x in range(width):
            above += np.int32(np.float32(row[x]) > limit[x])
        if above == 0:
            continue
        for x in range(width):
            if row[x] <= limit[x] or mask[y, x]:
                continue
            value = np.float64(row[x])
            if value - value != 0 or _reached(frame, y, x, 0.5 * (value + limit[x])) > 5:
                continue
            count, high, low = _bounds_around(frame, y, x, room)
            noise = np.sqrt(even + slope * max(0.0, high))
            if count and value > (
                high + _STRUCTURE * max(0.0, high - low - relief * noise) + _FRAME_NOISE * (noise + slope)
            ):
                if n == out.shape[0]:
                    return n
                out[n, 0], out[n, 1] = y, x
                n += 1
    return n
