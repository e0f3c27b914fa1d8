"""Gaussian blur, of whole images and of windows cut from frames, with one result bit for bit.

Both go through the same sums in the same order, in float32, block by block: the pixels of a block and of its margin are
loaded, then weighed along x, then along y. Beyond the frame its edge pixel goes on, as in ``scipy.ndimage`` with
``mode="nearest"``.

The weights are a tuple, from the centre outwards. Its length is part of its type, so that the compiler knows the number
of terms, unrolls their sum, and keeps it in vector registers.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from .simd import LANES, load_at, store

Array = npt.NDArray[Any]
Weights = tuple[np.float32, ...]

_BLOCK = (64, 256)


class Tiles(NamedTuple):
    """Frames in tiles of one size, of which some may be missing.

    Attributes
    ----------
    pixels
        (tiles, frames, tile rows, tile columns), integer or real. Tiles may reach over the frame's edges.
    place
        (rows, columns) which of the tiles lies there; -1 where it is missing.
    shape
        Rows and columns of a frame.
    """

    pixels: Array
    place: npt.NDArray[np.int64]
    shape: tuple[int, int]


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
        pixels = _readable(image)[None, None]
        _blur_image(pixels, np.zeros((1, 1), np.int64), _weights(sigma), _BLOCK, out)
    return out


def cut_windows(
    frames: Array | Tiles,
    corner_y: npt.ArrayLike,
    corner_x: npt.ArrayLike,
    size: int,
    sigma: float,
    gain: float = 1.0,
    first: int = 0,
) -> npt.NDArray[np.float32]:
    """Return square windows of the frames, each equal bit for bit to the same window of ``blur(gain * frame, sigma)``.

    Parameters
    ----------
    frames
        (f, ny, nx), integer or real, or tiles, which hold every pixel that the windows and the blur reach; ``gain``
        multiplies them in float32, before the blur.
    corner_y, corner_x
        (f, n) integers: the first row and column of every window.
    size
        Side of the windows in px.
    sigma
        Of the blur, in px; 0 for none.
    first
        Number of the frame that the first row of corners is about.

    Returns
    -------
    (f, n, size, size) float32. A window that lies partly outside the frame is all zeros: test the corners to know it.

    Raises
    ------
    ValueError
        If the shapes do not go together, the pixels are not real numbers, or a tile is missing.
    """
    corners_y, corners_x = (np.ascontiguousarray(corner, dtype=np.int64) for corner in (corner_y, corner_x))
    tiles = frames if isinstance(frames, Tiles) else _one_tile(frames)
    if corners_y.ndim != 2 or corners_y.shape != corners_x.shape or first + len(corners_y) > tiles.pixels.shape[1]:
        most = tiles.pixels.shape[1] - first
        raise ValueError(f"corners must be (f, n), f up to {most}, got {corners_y.shape} and {corners_x.shape}")
    out = np.empty((*corners_y.shape, size, size), np.float32)
    pixels = _readable(tiles.pixels)
    weights = _weights(sigma)
    if not _cut(pixels, tiles.place, tiles.shape, first, corners_y, corners_x, np.float32(gain), weights, out):
        raise ValueError("a window reaches into a tile that is missing")
    return out


def _one_tile(frames: Array) -> Tiles:
    """Return frames (f, ny, nx) as a single tile each."""
    if frames.ndim != 3:
        raise ValueError(f"frames must be (f, ny, nx), got {frames.shape}")
    return Tiles(frames[None], np.zeros((1, 1), np.int64), (frames.shape[1], frames.shape[2]))


def _readable(pixels: Array) -> Array:
    """Return the pixels in a layout and dtype that compiled code reads: float16 and odd byte orders are converted."""
    if pixels.dtype.kind not in "iuf":
        raise ValueError(f"pixels must be real numbers, got {pixels.dtype}")
    dtype = np.dtype(np.float32) if pixels.dtype.itemsize == 2 and pixels.dtype.kind == "f" else pixels.dtype
    return np.ascontiguousarray(pixels, dtype=dtype.newbyteorder("="))


def _weights(sigma: float) -> Weights:
    """Return the weights of a Gaussian blur from the centre outwards."""
    kernel = gaussian_kernel(sigma)
    return tuple(kernel[kernel.size // 2 :])


@njit(cache=True, nogil=True)
def _cut(
    pixels: Array,
    place: Array,
    shape: tuple[int, int],
    first: int,
    corner_y: Array,
    corner_x: Array,
    gain: Any,
    weights: Weights,
    out: Array,
) -> bool:
    """Write every window, blurred; zeros where it leaves the frame. Return whether no tile was missing."""
    size = out.shape[2]
    block, across, last = _scratch(size, size, len(weights) - 1)
    complete = True
    for f in range(out.shape[0]):
        for n in range(out.shape[1]):
            y, x = corner_y[f, n], corner_x[f, n]
            if y < 0 or x < 0 or y + size > shape[0] or x + size > shape[1]:
                out[f, n] = 0
            else:
                complete &= _load(pixels, place, shape, first + f, y, x, size, size, len(weights) - 1, gain, block)
                _blur_block(block, weights, across, last, out[f, n])
    return complete


@njit(cache=True, nogil=True)
def _blur_image(pixels: Array, place: Array, weights: Weights, sides: tuple[int, int], out: Array) -> None:
    """Write the whole blurred image, of which ``pixels`` is the only tile, in blocks of at most these sides."""
    block, across, last = _scratch(sides[0], sides[1], len(weights) - 1)
    for y in range(0, out.shape[0], sides[0]):
        for x in range(0, out.shape[1], sides[1]):
            part = out[y : y + sides[0], x : x + sides[1]]
            height, width = part.shape
            _load(pixels, place, out.shape, 0, y, x, height, width, len(weights) - 1, np.float32(1), block)
            _blur_block(block, weights, across, last, part)


@njit(cache=True, nogil=True)
def _scratch(height: int, width: int, margin: int) -> tuple[Array, Array, Array]:
    """Return zeros for a block with its margin, its sums along x, and a row of its sums along y, in whole vectors."""
    wide = -(-width // LANES) * LANES
    return (
        np.zeros((height + 2 * margin, wide + 2 * margin), np.float32),
        np.zeros((height + 2 * margin, wide), np.float32),
        np.zeros(wide, np.float32),
    )


@njit(cache=True, nogil=True)
def _load(
    pixels: Array,
    place: Array,
    shape: tuple[int, int],
    frame: int,
    y: int,
    x: int,
    height: int,
    width: int,
    margin: int,
    gain: Any,
    block: Array,
) -> bool:
    """Fill the first rows and columns of ``block`` with a part of a frame and its margin, times ``gain``.

    (y, x) is the first pixel inside the margin. Return whether every tile was there.
    """
    tall, wide = height + 2 * margin, width + 2 * margin
    first_y, first_x = y - margin, x - margin
    top, left = max(0, -first_y), max(0, -first_x)
    bottom, right = min(tall, shape[0] - first_y), min(wide, shape[1] - first_x)
    side_y, side_x = pixels.shape[2:]
    for row in range((first_y + top) // side_y, (first_y + bottom - 1) // side_y + 1):
        start_y, stop_y = max(top, row * side_y - first_y), min(bottom, (row + 1) * side_y - first_y)
        for column in range((first_x + left) // side_x, (first_x + right - 1) // side_x + 1):
            start_x, stop_x = max(left, column * side_x - first_x), min(right, (column + 1) * side_x - first_x)
            if place[row, column] < 0:
                return False
            tile = pixels[place[row, column], frame]
            offset_y, offset_x = first_y - row * side_y, first_x - column * side_x
            for i in range(start_y, stop_y):
                source = tile[offset_y + i, offset_x + start_x : offset_x + stop_x]
                target = block[i, start_x:stop_x]
                for j in range(target.size):
                    target[j] = gain * np.float32(source[j])
    for i in range(top, bottom):
        for j in range(left):
            block[i, j] = block[i, left]
        for j in range(right, wide):
            block[i, j] = block[i, right - 1]
    for i in range(tall):
        edge = top if i < top else bottom - 1
        if i < top or i >= bottom:
            for j in range(wide):
                block[i, j] = block[edge, j]
    return True


@njit(cache=True, nogil=True)
def _blur_block(block: Array, weights: Weights, across: Array, last: Array, out: Array) -> None:
    """Write the blurred block: along x into ``across``, then along y. Columns beyond those of ``out`` are padding."""
    margin = len(weights) - 1
    height, width = out.shape
    for i in range(height + 2 * margin):
        _weigh(block, i * block.shape[1] + margin, 1, weights, across[i])
    for i in range(height):
        _weigh(across, (i + margin) * across.shape[1], across.shape[1], weights, last)
        for j in range(width):
            out[i, j] = last[j]


@njit(cache=True, nogil=True)
def _weigh(source: Array, centre: int, step: int, weights: Weights, out: Array) -> None:
    """Write the weighted sums around ``out.size`` pixels of ``source``, counted flat, from ``centre`` on.

    Their terms are ``step`` apart.
    """
    for row in range(out.size // LANES):
        middle = centre + row * LANES
        total = weights[0] * load_at(source, middle)
        for k in range(1, len(weights)):
            total = total + weights[k] * (load_at(source, middle - k * step) + load_at(source, middle + k * step))
        store(out, row, total)
