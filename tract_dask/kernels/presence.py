"""Whether a column is there: a matched filter with the column's own shape, in units of the noise.

In a window d = A s + B + noise, with s the column's shape and white noise of standard deviation σ, the generalised
least-squares estimate of A with the background B free is

    A = sum u d / sum u s,   u = s - mean(s),   standard error σ / sqrt(sum u^2)

so that A over its standard error is sum u d / (σ sqrt(sum u^2)): a fixed weight for each pixel (Kay, Fundamentals of
Statistical Signal Processing II, 1998, section 4.3). Without a column it is standard normal, whatever the background;
u is symmetric, so that a slope of the background does not matter either.

Windows that were blurred by g have noise that is correlated. There the weights are those of a shape h that is narrower
by the blur's variance twice over, once for the column and once for the filter: sum h (g * d) = sum (g * h) d, and
g * h = s. Their norm is that of g * u, which is what the filter does to white noise.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .gaussian.model import blurred, evaluate
from .gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from .vectors.simd import load, load_at, store, vector
from .vectors.tracing import LANES
from .windows import blur_variance, gaussian_kernel

Array = NDArray[Any]

_BLOCK_PIXELS = 1 << 18
"""Pixels of windows that filters are made for at a time: making them takes twenty times the memory that they keep."""


class Filters(NamedTuple):
    """Weights of matched filters, one for each column, packed as vectors.

    Attributes
    ----------
    weights
        (n, vectors, LANES) float32.
    offset
        (vectors,) the pixel of the window, counted flat, from which on a vector's weights are.
    size
        Side of the windows in px.
    """

    weights: NDArray[np.float32]
    offset: NDArray[np.int64]
    size: int


def matched_filters(parameters: NDArray[np.float64], size: int, blur_sigma_px: float) -> Filters:
    """Return each column's matched filter, for the column in the middle of its window.

    A blurred window is known from rows that are 1.5 sigmas of the blur apart: what is lost is above the frequencies
    that the blur lets through. Only those are used, which takes a third of the time after a blur of 2 px.

    Parameters
    ----------
    parameters
        (n, 7) of Equation 1, as in the windows: after their blur. Sigmas, theta and the sign of the amplitude count.
    size
        Side of the windows in px, odd; pixels farther than half of it from the middle one have weight 0.
    blur_sigma_px
        Of the blur that the windows went through, px.

    Returns
    -------
    Filters
        The sum of weights times pixels has mean 0 on any even or sloping background, and standard deviation 1 in white
        noise whose standard deviation was 1 in every pixel before the blur.
    """
    half, step = size // 2, max(1, int(1.5 * blur_sigma_px))
    rows, columns = np.arange(-(half // step) * step, half + 1, step), np.arange(size) - half
    offset, place = _places(rows + half, size)
    weights = np.empty((len(parameters), len(place), LANES), np.float32)
    many = max(1, _BLOCK_PIXELS // size**2)
    for k in range(0, len(parameters), many):
        flat = _weights(parameters[k : k + many], rows, columns, blur_sigma_px)
        weights[k : k + many] = _packed(flat, offset, place)
    return Filters(weights, place, size)


def _weights(
    parameters: NDArray[np.float64], rows: NDArray[np.int64], columns: NDArray[np.int64], blur_sigma_px: float
) -> NDArray[np.float64]:
    """Return the weights (n, rows, columns) at some rows of the windows, which are counted from the middle one."""
    disc = np.hypot(rows[:, None], columns) <= len(columns) / 2
    narrow = blurred(parameters, -2 * blur_variance(blur_sigma_px))
    narrow[:, [AMPLITUDE, X, Y, BACKGROUND]] = np.sign(narrow[:, [AMPLITUDE]]) * [1, 0, 0, 0]
    shape = evaluate(narrow, columns, rows[:, None])
    weights = np.where(disc, shape - shape[:, disc].mean(axis=1)[:, None, None], 0.0)
    across, down = (_spread(kernel_rows, blur_sigma_px) for kernel_rows in (columns, rows))
    norm = np.sqrt(((down @ weights @ across.T) ** 2).sum(axis=(1, 2)))
    weights /= np.maximum(norm, np.finfo(float).tiny)[:, None, None]
    return weights


def _places(rows: NDArray[np.int64], size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where the vectors of some rows of a window begin, and the same for vectors that do not reach beyond it."""
    offset = (rows[:, None] * size + LANES * np.arange(-(-size // LANES))).ravel()
    return offset, np.minimum(offset, size * size - LANES)


def _packed(weights: NDArray[np.float64], offset: NDArray[np.int64], place: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return weights (n, rows, size) as vectors (n, vectors, LANES) that begin at ``place``."""
    n, rows, size = weights.shape
    flat = np.zeros((n, rows, len(place) // rows * LANES), np.float32)
    flat[:, :, :size] = weights
    packed = flat.reshape(n, -1, LANES)
    for vector_, back in enumerate(offset - place):
        packed[:, vector_] = np.roll(packed[:, vector_], back, axis=1)
    return packed


def _spread(places: NDArray[np.int64], sigma: float) -> NDArray[np.float64]:
    """Return the matrix that blurs what stands at ``places``, in order, without losing anything at the ends."""
    kernel = gaussian_kernel(sigma)
    spread = np.zeros((int(np.ptp(places)) + kernel.size, places.size))
    for k, weight in enumerate(kernel):
        spread[places - places[0] + k, np.arange(places.size)] = weight
    return spread


def strengths(windows: NDArray[np.float32], filters: Filters, which: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the sum of pixels times weights of each window: a column's amplitude over its standard error, times σ.

    Parameters
    ----------
    windows
        (m, size, size).
    filters
        From :func:`matched_filters`.
    which
        (m,) the filter for each window.

    Raises
    ------
    ValueError
        If the shapes do not go together.
    """
    n, size = len(filters.weights), filters.size
    if windows.shape[1:] != (size, size) or which.shape != windows.shape[:1]:
        raise ValueError(f"windows {windows.shape} and which {which.shape} do not go with filters for {size} px")
    if which.size and not 0 <= which.min() <= which.max() < n:
        raise ValueError(f"which must be from 0 to {n - 1}")
    out = np.empty(len(windows), np.float32)
    _apply(np.ascontiguousarray(windows, dtype=np.float32), filters.weights, filters.offset, which, out)
    return out


@njit(cache=True, nogil=True)
def _apply(windows: Array, weights: Array, offset: Array, which: Array, out: Array) -> None:
    pixels, vectors = windows.shape[1] * windows.shape[2], len(offset)
    lanes = np.empty(LANES, np.float32)
    for m in range(len(windows)):
        first, own = m * pixels, which[m] * vectors
        even, odd = vector(np.float32(0)), vector(np.float32(0))
        for k in range(0, vectors - 1, 2):
            even += load(weights, own + k) * load_at(windows, first + offset[k])
            odd += load(weights, own + k + 1) * load_at(windows, first + offset[k + 1])
        if vectors % 2:
            even += load(weights, own + vectors - 1) * load_at(windows, first + offset[vectors - 1])
        store(lanes, 0, even + odd)
        out[m] = lanes.sum()


@njit(cache=True, nogil=True)
def best_states(scores: Array, cost: float) -> NDArray[np.bool_]:
    """Return where the first of two states holds: by the path with the highest sum of scores, less its switches.

    Viterbi's algorithm for two states, exact.

    Parameters
    ----------
    scores
        (n,) logarithm of the likelihood of the first state over that of the second; finite.
    cost
        Of a switch from one to the other.
    """
    n = len(scores)
    stayed = np.empty((n, 2), np.bool_)
    first, second = 0.0, 0.0
    for k in range(n):
        stayed[k, 0], stayed[k, 1] = first >= second - cost, second >= first - cost
        first, second = max(first, second - cost) + scores[k], max(second, first - cost)
    path = np.empty(n, np.bool_)
    here = first >= second
    for k in range(n - 1, -1, -1):
        path[k] = here
        if not stayed[k, 0 if here else 1]:
            here = not here
    return path
