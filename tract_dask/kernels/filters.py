"""Gaussian blur, of whole frames and of windows cut from them, with one result bit for bit.

Both go through the same two row sums in the same order, in float32. Beyond the frame its edge pixel goes on, as in
``scipy.ndimage`` with ``mode="nearest"``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[Any]


def gaussian_kernel(sigma: float, truncate: float = 4.0) -> npt.NDArray[np.float32]:
    """Return the weights of a Gaussian blur, normalised, cut off at ``truncate`` sigmas.

    Returns
    -------
    (2 r + 1,) float32 with r = int(truncate * sigma + 0.5); the single weight 1 for sigma 0.

    Raises
    ------
    ValueError
        If ``sigma`` is negative or not finite.

    Examples
    --------
    >>> gaussian_kernel(0.5).astype(float).round(4).tolist()
    [0.0003, 0.1065, 0.7866, 0.1065, 0.0003]
    """
    if not (math.isfinite(sigma) and sigma >= 0):
        raise ValueError(f"sigma must be at least 0, got {sigma}")
    radius = int(truncate * sigma + 0.5)
    distances = np.arange(-radius, radius + 1)
    weights = np.exp(-0.5 * (distances / sigma) ** 2) if sigma > 0 else np.ones(1)
    normalised: npt.NDArray[np.float32] = (weights / weights.sum()).astype(np.float32)
    return normalised


@njit(cache=True, nogil=True)
def _load_row(row: Array, first: int, gain: Any, extended: Array) -> None:
    """Copy gain * row, from column ``first`` on, into ``extended``; beyond its ends the row's end pixels go on."""
    last = row.size - 1
    if first >= 0 and first + extended.size <= row.size:
        for i in range(extended.size):
            extended[i] = gain * np.float32(row[first + i])
    else:
        for i in range(extended.size):
            extended[i] = gain * np.float32(row[min(max(first + i, 0), last)])


@njit(cache=True, nogil=True)
def _blur_block(
    image: Array, y: int, x: int, gain: Any, kernel: Array, across: Array, extended: Array, out: Array
) -> None:
    """Write the blurred block of ``image`` whose first pixel is (y, x) into ``out``: along x, then along y.

    Sums run from the kernel's centre outwards. ``across`` (rows + 2 r, columns) and ``extended`` (columns + 2 r) are
    scratch. Offsets go through max(0, ...) so that the compiler sees that no index is negative, and vectorises.
    """
    radius = max(0, kernel.size // 2)
    height, width = out.shape
    centre = kernel[radius]
    for i in range(across.shape[0]):
        _load_row(image[min(max(y - radius + i, 0), image.shape[0] - 1)], x - radius, gain, extended)
        for j in range(width):
            across[i, j] = centre * extended[j + radius]
        for k in range(1, radius + 1):
            weight, left, right = kernel[radius + k], max(0, radius - k), radius + k
            for j in range(width):
                across[i, j] += weight * (extended[j + left] + extended[j + right])
    for i in range(height):
        for j in range(width):
            out[i, j] = centre * across[i + radius, j]
        for k in range(1, radius + 1):
            weight, above, below = kernel[radius + k], i + max(0, radius - k), i + radius + k
            for j in range(width):
                out[i, j] += weight * (across[above, j] + across[below, j])


@njit(cache=True, nogil=True)
def _cut(frames: Array, corner_y: Array, corner_x: Array, gain: Any, kernel: Array, out: Array) -> None:
    """Write every window, blurred; zeros where it leaves the frame."""
    size, halo = out.shape[2], 2 * (kernel.size // 2)
    across = np.empty((size + halo, size), np.float32)
    extended = np.empty(size + halo, np.float32)
    for f in range(out.shape[0]):
        for n in range(out.shape[1]):
            y, x = corner_y[f, n], corner_x[f, n]
            if y < 0 or x < 0 or y + size > frames.shape[1] or x + size > frames.shape[2]:
                out[f, n] = 0
            else:
                _blur_block(frames[f], y, x, gain, kernel, across, extended, out[f, n])


@njit(cache=True, nogil=True)
def _blur_frame(image: Array, kernel: Array, out: Array) -> None:
    """Write the whole blurred frame."""
    halo = 2 * (kernel.size // 2)
    across = np.empty((out.shape[0] + halo, out.shape[1]), np.float32)
    extended = np.empty(out.shape[1] + halo, np.float32)
    _blur_block(image, 0, 0, np.float32(1), kernel, across, extended, out)


def _readable(frames: Array) -> Array:
    """Return the pixels in a layout and dtype that compiled code reads: float16 and odd byte orders are converted."""
    if frames.dtype.kind not in "iuf":
        raise ValueError(f"pixels must be real numbers, got {frames.dtype}")
    dtype = np.dtype(np.float32) if frames.dtype.itemsize == 2 and frames.dtype.kind == "f" else frames.dtype
    return np.ascontiguousarray(frames, dtype=dtype.newbyteorder("="))


def blur(image: Array, sigma: float) -> npt.NDArray[np.float32]:
    """Return the image blurred with a circular Gaussian, as ``scipy.ndimage.gaussian_filter(mode="nearest")`` does.

    Parameters
    ----------
    image
        (ny, nx), integer or real.
    sigma
        In px; 0 gives a copy.

    Returns
    -------
    (ny, nx) float32. A NaN spreads over the kernel's reach.

    Raises
    ------
    ValueError
        If the image is not two-dimensional, its pixels are not real numbers, or ``sigma`` is negative.
    """
    if image.ndim != 2:
        raise ValueError(f"image must be (ny, nx), got {image.shape}")
    out = np.empty(image.shape, np.float32)
    if image.size:
        _blur_frame(_readable(image), gaussian_kernel(sigma), out)
    return out


def cut_windows(
    frames: Array,
    corner_y: npt.ArrayLike,
    corner_x: npt.ArrayLike,
    size: int,
    sigma: float,
    gain: float = 1.0,
) -> npt.NDArray[np.float32]:
    """Return square windows of the frames, each equal bit for bit to the same window of ``blur(gain * frame, sigma)``.

    Parameters
    ----------
    frames
        (f, ny, nx), integer or real; ``gain`` multiplies them in float32, before the blur.
    corner_y, corner_x
        (f, n) integers: the first row and column of every window.
    size
        Side of the windows in px.
    sigma
        Of the blur, in px; 0 for none.

    Returns
    -------
    (f, n, size, size) float32. A window that lies partly outside the frame is all zeros: test the corners to know it.

    Raises
    ------
    ValueError
        If the shapes do not go together, or the pixels are not real numbers.
    """
    corners_y, corners_x = (np.ascontiguousarray(corner, dtype=np.int64) for corner in (corner_y, corner_x))
    if frames.ndim != 3 or corners_y.ndim != 2 or corners_y.shape != corners_x.shape or len(corners_y) != len(frames):
        shapes = (frames.shape, corners_y.shape, corners_x.shape)
        raise ValueError(f"frames must be (f, ny, nx) and corners (f, n), got {shapes[0]}, {shapes[1]}, {shapes[2]}")
    out = np.empty((*corners_y.shape, size, size), np.float32)
    _cut(_readable(frames), corners_y, corners_x, np.float32(gain), gaussian_kernel(sigma), out)
    return out
