"""Local maxima, the brightest pixel near a seed, centroids (after Crocker, Grier and Weeks), and wide box means."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Places = NDArray[np.float64]


@njit(cache=True, nogil=True)
def local_maxima(image: Floats, radius: float, threshold: float) -> Places:
    """Return the pixels that nothing within ``radius`` outshines, as (n, 2) rows of (x, y), in raster order.

    Parameters
    ----------
    image
        (y, x), finite.
    radius
        In px; of several equally bright pixels within it, the first in raster order is the maximum.
    threshold
        Pixels below are no maxima.
    """
    ny, nx = image.shape
    reach = int(radius)
    found = [(0.0, 0.0) for _ in range(0)]
    for y in range(ny):
        for x in range(nx):
            value = image[y, x]
            if value >= threshold and _outshines(image, y, x, value, reach, radius):
                found.append((float(x), float(y)))
    places = np.empty((len(found), 2))
    for i, (px, py) in enumerate(found):
        places[i, 0] = px
        places[i, 1] = py
    return places


@njit(cache=True, nogil=True)
def _outshines(image: Floats, y: int, x: int, value: float, reach: int, radius: float) -> bool:
    ny, nx = image.shape
    for distance in range(1, reach + 1):  # rings outwards: most pixels lose against a direct neighbour
        for v in range(max(0, y - distance), min(ny, y + distance + 1)):
            step = 1 if abs(v - y) == distance else 2 * distance
            for u in range(x - distance, x + distance + 1, step):
                if u < 0 or u >= nx or (u - x) ** 2 + (v - y) ** 2 > radius * radius:
                    continue
                other = image[v, u]
                if other > value or (other == value and (v < y or (v == y and u < x))):
                    return False
    return True


@njit(cache=True, nogil=True)
def climb(image: Floats, places: Places, radius: float) -> Places:
    """Return, for each place (n, 2) of (x, y), the brightest pixel within ``radius`` px of it.

    A place with no pixel of the image in reach stays where it is; of equally bright pixels the nearest wins.
    """
    ny, nx = image.shape
    climbed = places.copy()
    for i in range(len(places)):
        x, y = places[i, 0], places[i, 1]
        best, nearest = -np.inf, np.inf
        for v in range(max(0, int(np.ceil(y - radius))), min(ny - 1, int(np.floor(y + radius))) + 1):
            for u in range(max(0, int(np.ceil(x - radius))), min(nx - 1, int(np.floor(x + radius))) + 1):
                distance = (u - x) ** 2 + (v - y) ** 2
                value = image[v, u]
                if distance <= radius * radius and (value > best or (value == best and distance < nearest)):
                    best, nearest = value, distance
                    climbed[i, 0], climbed[i, 1] = u, v
    return climbed


@njit(cache=True, nogil=True)
def centroids(image: Floats, places: Places, radius: float) -> Places:
    """Return the centre of brightness within ``radius`` px of each place (n, 2) of (x, y).

    The weight of a pixel is its brightness above the darkest pixel of the disc; a flat disc leaves its place.
    """
    ny, nx = image.shape
    centres = places.copy()
    for i in range(len(places)):
        x, y = places[i, 0], places[i, 1]
        darkest, total, sum_x, sum_y, pixels, all_x, all_y = np.inf, 0.0, 0.0, 0.0, 0, 0.0, 0.0
        for v in range(max(0, int(np.ceil(y - radius))), min(ny - 1, int(np.floor(y + radius))) + 1):
            for u in range(max(0, int(np.ceil(x - radius))), min(nx - 1, int(np.floor(x + radius))) + 1):
                if (u - x) ** 2 + (v - y) ** 2 <= radius * radius:
                    value = float(image[v, u])
                    darkest = min(darkest, value)
                    total += value
                    sum_x += value * (u - x)
                    sum_y += value * (v - y)
                    pixels += 1
                    all_x += u - x
                    all_y += v - y
        weight = total - darkest * pixels
        if pixels and weight > 0:
            centres[i, 0] = x + (sum_x - darkest * all_x) / weight
            centres[i, 1] = y + (sum_y - darkest * all_y) / weight
    return centres


def box_means(image: Floats, radius: int) -> Places:
    """Return the mean of the (2 radius + 1)^2 pixels around each pixel, by running sums: any radius costs the same.

    Beyond the image its edge pixels go on, as in ``scipy.ndimage.uniform_filter`` with ``mode="nearest"``, which takes
    several times as long.
    """
    side = 2 * radius + 1
    means = np.asarray(image, dtype=np.float64)
    for _ in range(2):
        sums = np.pad(means, ((radius + 1, radius), (0, 0)), mode="edge").cumsum(axis=0)
        means = (sums[side:] - sums[:-side]).T / side
    return np.ascontiguousarray(means)
