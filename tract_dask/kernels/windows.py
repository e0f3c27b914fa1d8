"""Gaussian blur, of whole images and of windows cut from frames, with one result bit for bit.

An image is blurred as windows of all its columns and some rows, so both go through the same sums in the same order, in
float32: the pixels of a window and of its margin are loaded, then weighed along y, then along x. Beyond the frame its
edge pixel goes on, as in ``scipy.ndimage`` with ``mode="nearest"``.

The weights are a tuple, from the centre outwards. Its length is part of its type, so that the compiler knows the number
of terms, unrolls their sum, and keeps it in vector registers.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from .vectors.simd import aligned_rows, converted, load, number, put, rows_of, store, store_at
from .vectors.tracing import INLINE, LANES, VECTOR, Index, Rows, Vector, traced

Array = npt.NDArray[Any]
Weights = tuple[np.float32, ...]

_STRIP_ROWS = 16


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


def blur_variance(sigma: float) -> float:
    """Return the variance of the weights of a Gaussian blur along an axis, px^2: below 0.7 px less than sigma^2.

    Examples
    --------
    >>> [round(blur_variance(sigma), 3) for sigma in (0.25, 0.5, 1.0, 2.0)]
    [0.001, 0.215, 1.0, 3.999]
    """
    kernel = gaussian_kernel(sigma).astype(np.float64)
    return float(kernel @ (np.arange(kernel.size) - kernel.size // 2) ** 2.0)


def disc(size: int) -> npt.NDArray[np.bool_]:
    """Return which pixels of a window count, (size, size): those no farther than half its size from the middle one."""
    offset = np.arange(size) - size // 2
    inside: npt.NDArray[np.bool_] = np.hypot(offset[:, None], offset) <= size / 2
    return inside


def spreading(size: int, kernel: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the matrix (size + kernel - 1, size) that blurs what stands in a row, and loses nothing at its ends."""
    spread = np.zeros((size + kernel.size - 1, size))
    for k, weight in enumerate(kernel):
        spread[np.arange(size) + k, np.arange(size)] = weight
    return spread


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
    height, width = image.shape
    tiles, out = _one_tile(image[None]), _room_for(image.size)
    whole = height - height % _STRIP_ROWS
    for rows, first, stop in ((_STRIP_ROWS, 0, whole), (height - whole, whole, height)):
        corner_y = np.arange(first, stop, _STRIP_ROWS)[None]
        if corner_y.size and width:
            corner_x = np.zeros_like(corner_y)
            _write_windows(tiles, 0, corner_y, corner_x, (rows, width), sigma, 1.0, out[first * width :])
    return out[: image.size].reshape(image.shape)


def cut_windows(
    frames: Array | Tiles,
    corner_y: npt.ArrayLike,
    corner_x: npt.ArrayLike,
    size: int | tuple[int, int],
    sigma: float,
    gain: float = 1.0,
    first: int = 0,
) -> npt.NDArray[np.float32]:
    """Return windows of the frames, each equal bit for bit to the same window of ``blur(gain * frame, sigma)``.

    Parameters
    ----------
    frames
        (f, ny, nx), integer or real, or tiles, which hold every pixel that the windows and the blur reach; ``gain``
        multiplies them in float32, before the blur.
    corner_y, corner_x
        (f, n) integers: the first row and column of every window.
    size
        Side of the windows in px, or rows and columns.
    sigma
        Of the blur, in px; 0 for none.
    first
        Number of the frame that the first row of corners is about.

    Returns
    -------
    (f, n, rows, columns) float32. A window that lies partly outside the frame is all zeros: test the corners for that.

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
    sides = (size, size) if isinstance(size, int) else size
    shape = (*corners_y.shape, *sides)
    out = _room_for(math.prod(shape))
    if not _write_windows(tiles, first, corners_y, corners_x, sides, sigma, gain, out):
        raise ValueError("a window reaches into a tile that is missing")
    return out[: math.prod(shape)].reshape(shape)


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


def _room_for(pixels: int) -> npt.NDArray[np.float32]:
    """Return room for pixels and for what a whole vector at the end of the last row writes beyond them."""
    return np.empty(pixels + LANES, np.float32)


def _write_windows(
    tiles: Tiles,
    first: int,
    corner_y: npt.NDArray[np.int64],
    corner_x: npt.NDArray[np.int64],
    sides: tuple[int, int],
    sigma: float,
    gain: float,
    out: npt.NDArray[np.float32],
) -> bool:
    """Write windows of these sides, blurred, one after the other; zeros where one leaves the frame.

    Return whether no tile was missing.
    """
    pixels, weights = _readable(tiles.pixels), _weights(sigma)
    margin = len(weights) - 1
    row = -(-(-(-sides[1] // LANES) * LANES + 2 * margin) // LANES)
    room = aligned_rows((2 * sides[0] + 2 * margin) * row)
    room[...] = 0
    layout = (*pixels.shape[1:], *tiles.shape)
    complete: bool = _cut(
        pixels.reshape(-1),
        layout,
        tiles.place,
        first,
        (corner_y, corner_x),
        sides,
        np.float32(gain),
        weights,
        (room, row),
        out,
    )
    return complete


@njit(cache=True, nogil=True, error_model="numpy")
def _cut(
    pixels: Array,
    layout: tuple[int, int, int, int, int],
    place: Array,
    first: int,
    corners: tuple[Array, Array],
    sides: tuple[int, int],
    gain: Any,
    weights: Weights,
    work: tuple[Array, int],
    out: Array,
) -> bool:
    """Write every window, blurred; zeros where it leaves the frame. Return whether no tile was missing.

    A row of a window is written in whole vectors; what the last one writes beyond the row, the next row replaces.

    Parameters
    ----------
    layout
        Frames, rows and columns of a tile; rows and columns of a frame.
    work
        Room for a window with its margin, and for its sums along y, and the vectors in a row of both.
    """
    corner_y, corner_x = corners
    height, width = sides
    room, row = work
    margin = len(weights) - 1
    block = rows_of(room)
    sums = block + (height + 2 * margin) * row
    complete = True
    at = 0
    for f in range(corner_y.shape[0]):
        for n in range(corner_y.shape[1]):
            y, x = corner_y[f, n], corner_x[f, n]
            if y < 0 or x < 0 or y + height > layout[3] or x + width > layout[4]:
                out[at : at + height * width] = 0
            else:
                corner = (y - margin, x - margin)
                complete &= _load(pixels, layout, place, first + f, corner, sides, margin, gain, block, row)
                for i in range(height * row):
                    store(sums, i, _weighted(block, (i + margin * row) * LANES, row * LANES, weights))
                for i in range(height):
                    for j in range(0, width, LANES):
                        value = _weighted(sums, i * row * LANES + margin + j, 1, weights)
                        store_at(out, at + i * width + j, value)
            at += height * width
    return complete


@traced(VECTOR)
def _weighted(source: Rows, middle: Index, step: Index, weights: tuple[Vector, ...]) -> Vector:
    """Return the weighted sums around LANES pixels of ``source``, counted flat; their terms are ``step`` apart."""
    total = weights[0] * source.vector(middle)
    for k in range(1, len(weights)):
        total = total + weights[k] * (source.vector(middle - step * k) + source.vector(middle + step * k))
    return total


@njit(**INLINE)
def _load(
    pixels: Array,
    layout: tuple[int, int, int, int, int],
    place: Array,
    frame: int,
    corner: tuple[int, int],
    sides: tuple[int, int],
    margin: int,
    gain: Any,
    block: Any,
    row: int,
) -> bool:
    """Fill ``block`` with a part of a frame, from the margin's ``corner`` on, times ``gain``.

    Return whether every tile was there.
    """
    frames, side_y, side_x, n_y, n_x = layout
    first_y, first_x = corner
    tall, wide, stride = sides[0] + 2 * margin, sides[1] + 2 * margin, row * LANES
    top, left = max(0, -first_y), max(0, -first_x)
    bottom, right = min(tall, n_y - first_y), min(wide, n_x - first_x)
    for i in range((first_y + top) // side_y, (first_y + bottom - 1) // side_y + 1):
        start_y, stop_y = max(top, i * side_y - first_y), min(bottom, (i + 1) * side_y - first_y)
        for j in range((first_x + left) // side_x, (first_x + right - 1) // side_x + 1):
            start_x, stop_x = max(left, j * side_x - first_x), min(right, (j + 1) * side_x - first_x)
            if place[i, j] < 0:
                return False
            source = ((place[i, j] * frames + frame) * side_y + first_y - i * side_y + start_y) * side_x
            source += first_x - j * side_x + start_x
            for y in range(start_y, stop_y):
                _copy(pixels, source, gain, block, y * stride + start_x, stop_x - start_x)
                source += side_x
    for y in range(top, bottom):
        for x in range(left):
            put(block, y * stride + x, number(block, y * stride + left))
        for x in range(right, wide):
            put(block, y * stride + x, number(block, y * stride + right - 1))
    for y in range(tall):
        if y < top or y >= bottom:
            edge = top if y < top else bottom - 1
            for j in range(row):
                store(block, y * row + j, load(block, edge * row + j))
    return True


@njit(**INLINE)
def _copy(pixels: Array, source: int, gain: Any, block: Any, target: int, count: int) -> None:
    """Copy pixels in a row, times ``gain``, in vectors, of which the last two may overlap."""
    for j in range(0, count - LANES + 1, LANES):
        store_at(block, target + j, gain * converted(pixels, source + j))
    if count >= LANES:
        store_at(block, target + count - LANES, gain * converted(pixels, source + count - LANES))
    else:
        for j in range(count):
            put(block, target + j, gain * np.float32(pixels[source + j]))
