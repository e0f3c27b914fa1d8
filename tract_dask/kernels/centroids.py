"""Centroids of windows after Crocker and Grier: a round mask that moves until it is centred on its own brightness.

The centroid of a mask at c is c + s with

    s = sum w (p - c) (I - b) / sum w (I - b)

over the pixels p, where I is their brightness, w their share inside the mask (1, falling to 0 across a rim of one
pixel), and b the mean brightness of that rim: the local background, without which a centroid is drawn to the middle of
its mask. The mask moves by s, fractions of a pixel included, until s vanishes (J. C. Crocker and D. G. Grier, J.
Colloid Interface Sci. 179 (1996) 298).

Two things follow from where the background is taken. Where s vanishes it does so for every b, since the mask is
symmetric: the result does not depend on the background. And for a round column the slope of the numerator against c is
the denominator, by the divergence theorem: every step is one of Newton's method, and a column that moves by some
distance is found to move by that distance, also where it reaches beyond the mask.

Crocker and Grier's program, Blair and Dufresne's and trackpy's ``refine_com`` look at a band-passed image, whose
negative pixels are set to zero. Here nothing is clipped, and the blur that the windows have been through is the only
filter: a window is too small for another, and the rim does what the band-pass was for.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from .vectors.simd import larger, load_at, select, smaller, total, vector
from .vectors.tracing import INLINE, LANES

Array = npt.NDArray[Any]

BEST_RADIUS = 1.894
"""Of the mask, in units of the column's sigma.

In white noise the standard deviation of the centroid of a round Gaussian is proportional to u / (1 - (1 + u) exp(-u))
with u = radius^2 / (2 sigma^2), and smallest where exp(u) = 1 + u + u^2, at u = 1.793. It is then 1.18 times the
Cramer-Rao bound; the soft rim makes that 1.13 at a radius of 8 px.
"""

SMALLEST_RADIUS_PX = 1.5
"""A smaller mask has no pixels to tell where its brightness lies."""


class CentroidOutcome(IntEnum):
    """How the search for a centroid ended."""

    CONVERGED = 0
    AT_REACH = 1
    """The mask came to the end of its reach; the centroid is there."""
    ITERATION_LIMIT = 2
    NO_SIGNAL = 3
    """The mask is no brighter than its rim, so its brightness has no centre."""
    NOT_FINITE = 4
    """A pixel of the mask, or the start, is NaN or infinite."""


CONVERGED, AT_REACH, ITERATION_LIMIT, NO_SIGNAL, NOT_FINITE = map(int, CentroidOutcome)


class Centroids(NamedTuple):
    """What is known of each window."""

    places: npt.NDArray[np.float64]
    """(n, 2) of (x, y) in px from the centre of the window's first pixel; NaN for NO_SIGNAL and NOT_FINITE."""
    status: npt.NDArray[np.uint8]
    """(n,) codes of :class:`CentroidOutcome`."""


def window_centroids(
    windows: npt.NDArray[np.float32],
    start: npt.ArrayLike,
    radius: npt.ArrayLike,
    reach: float = math.inf,
    *,
    dark: npt.ArrayLike = False,
    tolerance_px: float = 2e-2,
    max_iterations: int = 20,
) -> Centroids:
    """Return the centroid of the column in each window.

    Parameters
    ----------
    windows
        (n, h, w), blurred or not, of any scale and background.
    start
        (n, 2) of (x, y) in px from the centre of the window's first pixel: where the mask begins.
    radius
        (n,), or one for all: radius of the mask in px; best at :data:`BEST_RADIUS` sigmas. The mask shrinks where it
        would leave the window, and stays round.
    reach
        The mask stays within this of its start along x and along y, px.
    dark
        (n,), or one for all: whether the column is darker than its surroundings.
    tolerance_px
        The mask stays where it is once it has moved by less than this; the next step would be some four times smaller.
    max_iterations
        Most moves of a mask.

    Raises
    ------
    ValueError
        If the shapes do not go together, or a radius is too small.
    """
    windows = np.ascontiguousarray(windows, dtype=np.float32)
    if windows.ndim != 3 or 0 in windows.shape[1:]:
        raise ValueError(f"windows must be (n, h, w) with pixels, got {windows.shape}")
    n = len(windows)
    starts = np.array(np.broadcast_to(np.asarray(start, np.float64), (n, 2)), order="C")
    radii = np.array(np.broadcast_to(np.asarray(radius, np.float64), (n,)), order="C")
    darks = np.array(np.broadcast_to(np.asarray(dark, np.bool_), (n,)), order="C")
    if n and not radii.min() >= SMALLEST_RADIUS_PX:
        raise ValueError(f"a mask's radius must be at least {SMALLEST_RADIUS_PX} px, got {radii.min()}")
    status = np.empty(n, np.uint8)
    _find(windows, starts, radii, darks, (float(reach), float(tolerance_px), int(max_iterations)), status)
    return Centroids(starts, status)


@njit(cache=True, nogil=True, error_model="numpy")
def _find(
    windows: Array, places: Array, radii: Array, dark: Array, limits: tuple[float, float, int], status: Array
) -> None:
    """Move every place (x, y) to the centroid of its window; ``limits`` are reach, tolerance and most moves."""
    n, height, width = windows.shape
    pixels = height * width
    flat = windows.reshape(-1)
    end = np.zeros(pixels + LANES, np.float32)  # of all windows: what lies beyond the last one is not to be read
    ramp = np.arange(LANES).astype(np.float32)
    for k in range(n):
        start = places[k, 0], places[k, 1]
        places[k, 0], places[k, 1] = np.nan, np.nan
        status[k] = NOT_FINITE
        if math.isfinite(start[0]) and math.isfinite(start[1]):
            source, first = flat, k * pixels
            if k == n - 1:
                for i in range(pixels):  # an assignment to a slice would more than double the time to compile
                    end[i] = flat[first + i]
                source, first = end, 0
            level = source[first + (height // 2) * width + width // 2]
            window = source, first, (height, width), level if math.isfinite(level) else np.float32(0)
            places[k, 0], places[k, 1], status[k] = _rest(window, ramp, start, radii[k], dark[k], limits)


@njit(**INLINE)
def _rest(
    window: Any, ramp: Array, start: tuple[float, float], largest: float, dark: bool, limits: tuple[float, float, int]
) -> tuple[float, float, int]:
    """Return where the moving mask comes to rest, (x, y), and how; NaN where there is no signal.

    ``window`` is what :func:`_moments` takes.
    """
    height, width = window[2]
    reach, tolerance, most = limits
    high_x, high_y = width - 0.5 - SMALLEST_RADIUS_PX, height - 0.5 - SMALLEST_RADIUS_PX
    left, right = max(start[0] - reach, width - 1 - high_x), min(start[0] + reach, high_x)
    top, bottom = max(start[1] - reach, height - 1 - high_y), min(start[1] + reach, high_y)
    x, y, outcome = np.nan, np.nan, NO_SIGNAL
    if left <= right and top <= bottom:
        x, y, outcome = min(max(start[0], left), right), min(max(start[1], top), bottom), ITERATION_LIMIT
    moves = 0
    while outcome == ITERATION_LIMIT and moves < most:
        moves += 1
        radius = min(largest, x + 0.5, width - 0.5 - x, y + 0.5, height - 0.5 - y)
        moment_x, moment_y, brightness = _moments(window, ramp, x, y, radius)
        if (brightness < 0) if dark else (brightness > 0):
            step_x, step_y = moment_x / brightness, moment_y / brightness
            part = min(1.0, 0.5 * radius / (math.hypot(step_x, step_y) + 1e-12))
            next_x, next_y = min(max(x + part * step_x, left), right), min(max(y + part * step_y, top), bottom)
            moved = max(abs(next_x - x), abs(next_y - y))
            x, y = next_x, next_y
            if moved < tolerance:
                outcome = CONVERGED if max(abs(step_x), abs(step_y)) < 2 * tolerance else AT_REACH
        else:
            x, y, outcome = np.nan, np.nan, NO_SIGNAL if math.isfinite(brightness) else NOT_FINITE
    return x, y, outcome


@njit(**INLINE)
def _moments(window: Any, ramp: Array, x: float, y: float, radius: float) -> tuple[np.float32, np.float32, np.float32]:
    """Return the first moments (along x, along y) and the sum of the mask's brightness above that of its rim.

    ``window`` is the flat pixels of windows, where this one begins, its height and width, and the level that is
    subtracted so that float32 keeps its digits. A pixel counts as one of the rim by share (1 - share).
    """
    source, begin, (height, width), level = window
    top, bottom = max(0, math.ceil(y - radius - 1)), min(height - 1, math.floor(y + radius + 1))
    left, right = max(0, math.ceil(x - radius - 1)), min(width - 1, math.floor(x + radius + 1))
    steep = np.float32(0.5 / radius)  # a pixel's share falls by 1 where its distance grows by 1
    edge = np.float32(0.5 + 0.5 * radius)
    none = vector(np.float32(0))
    area, area_x, area_y, inner = none, none, none, none
    bright, bright_x, bright_y, inner_bright = none, none, none, none
    for j in range(left, right + 1, LANES):
        dx = load_at(ramp, 0) + np.float32(j - x)
        inside = edge - steep * dx * dx
        column, bright_column = none, none
        at = begin + top * width + j
        for i in range(top, bottom + 1):
            dy = np.float32(i - y)
            share = smaller(larger(inside - steep * dy * dy, np.float32(0)), np.float32(1))
            lit = select(share > np.float32(0), share * (load_at(source, at) - level), np.float32(0))
            column += share
            bright_column += lit
            area_y += share * dy
            bright_y += lit * dy
            inner += share * share
            inner_bright += share * lit
            at += width
        area += column
        bright += bright_column
        area_x += column * dx
        bright_x += bright_column * dx
    background = total(bright - inner_bright) / max(total(area - inner), np.float32(1e-3))
    moments = bright_x - background * area_x, bright_y - background * area_y, bright - background * area
    return total(moments[0]), total(moments[1]), total(moments[2])
