"""Where in an image a column is: the strength of its matched filter at places on a grid."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .presence import Filters
from .vectors.tracing import LANES

Array = NDArray[Any]


def dense_filters(filters: Filters, columns: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the weights of some columns' matched filters as images, (n, size, size).

    Parameters
    ----------
    filters
        From :func:`.presence.matched_filters`.
    columns
        (n,) numbers of the columns.
    """
    flat = np.zeros((len(columns), filters.size**2), np.float32)
    for k, first in enumerate(filters.offset.tolist()):
        flat[:, first : first + LANES] += filters.weights[columns, k]
    return flat.reshape(len(columns), filters.size, filters.size)


def strength_maps(
    images: NDArray[np.float32], weights: NDArray[np.float32], which: NDArray[np.int64], step: int
) -> NDArray[np.float32]:
    """Return the strengths of matched filters over images, in steps of some pixels.

    Parameters
    ----------
    images
        (n, side, side).
    weights
        (m, size, size) filters, from :func:`dense_filters`.
    which
        (n,) the filter for each image.
    step
        From one place to the next, px.

    Returns
    -------
    ndarray
        (n, places, places): a filter whose corner is at pixel (step * i, step * j). NaN where it meets a pixel that is
        NaN.

    Raises
    ------
    ValueError
        If the shapes do not go together.

    Examples
    --------
    >>> image = np.zeros((1, 5, 5), np.float32)
    >>> image[0, 3, 1] = 2
    >>> filters = np.zeros((1, 3, 3), np.float32)
    >>> filters[0, 1, 1] = 1
    >>> strength_maps(image, filters, np.zeros(1, np.int64), 2)[0].tolist()
    [[0.0, 0.0], [2.0, 0.0]]
    >>> strength_maps(image, filters, np.zeros(1, np.int64), 1)[0, 2].tolist()
    [2.0, 0.0, 0.0]
    """
    size = weights.shape[-1]
    if images.shape[1] != images.shape[2] or images.shape[1] < size or which.shape != images.shape[:1]:
        raise ValueError(f"images {images.shape} and which {which.shape} do not go with filters for {size} px")
    if which.size and not 0 <= which.min() <= which.max() < len(weights):
        raise ValueError(f"which must be from 0 to {len(weights) - 1}")
    places = (images.shape[1] - size) // step + 1
    out = np.empty((len(images), places, places), np.float32)
    _correlate(np.ascontiguousarray(images, np.float32), np.ascontiguousarray(weights, np.float32), which, step, out)
    return out


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _correlate(images: Array, weights: Array, which: Array, step: int, out: Array) -> None:
    size = weights.shape[1]
    for n in range(len(images)):
        image, filter_ = images[n], weights[which[n]]
        for i in range(out.shape[1]):
            for j in range(out.shape[2]):
                total = np.float32(0)
                for y in range(size):
                    for x in range(size):
                        total += filter_[y, x] * image[i * step + y, j * step + x]
                out[n, i, j] = total
