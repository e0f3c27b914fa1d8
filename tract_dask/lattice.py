"""Finding columns without being told where: the lattice of an image, and the peaks that sit on it."""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage
from scipy.spatial import cKDTree

from .kernels.filters import blur
from .kernels.peaks import box_means, local_maxima

Floats = NDArray[np.floating[Any]]
Places = NDArray[np.float64]
"""(n, 2) rows of (x, y), px."""
Mask = NDArray[np.bool_]

TOLERANCE = 0.2
"""How far from its lattice site a column may be, in spacings."""

_SAME_LATTICE = 0.8
"""Correlation, against the highest, from which a shift carries the lattice onto itself."""
_ORDERED = 0.4
"""Correlation from which an image has a lattice at all; half of it will do where the spacing is given."""
_OVERLAP = 0.25
"""Share of the image that must still lie on itself after a shift."""
_LARGE = 1500
"""Shorter side, in px, from twice which on the image is binned before it is correlated."""
_NOISIEST = 3.0
"""Correlation without a shift, which noise lifts above 1, up to which a lattice can be found."""
_STRONG = 0.5
_ALIKE = 0.7
_SIGNIFICANT = 4.0
_CLOSE = 0.7
"""See :func:`find_peaks`."""


@dataclass(frozen=True)
class Lattice:
    """The two shortest independent translations of a lattice, (x, y) in px; ``a`` is the shorter one."""

    a: tuple[float, float]
    b: tuple[float, float]

    @property
    def spacing(self) -> float:
        """Shortest distance between two sites, px."""
        return float(np.hypot(*self.a))

    @property
    def hole(self) -> float:
        """Farthest that a place inside the lattice can be from every site, px: the circumradius of a, b, b - a."""
        a, b = np.array(self.a), np.array(self.b)
        b = b if a @ b >= 0 else -b
        sides = np.hypot(*a) * np.hypot(*b) * np.hypot(*(b - a))
        return float(sides / (2 * abs(a[0] * b[1] - a[1] * b[0])))

    def translations(self, reach: int) -> Places:
        """Return the lattice vectors of up to ``reach`` steps along each axis, without zero."""
        steps = [step for step in product(range(-reach, reach + 1), repeat=2) if step != (0, 0)]
        return np.asarray(np.array(steps, dtype=np.float64) @ np.array([self.a, self.b]))


def find_lattice(image: Floats, valid: Mask, noise: float, spacing_px: float | None = None) -> Lattice | None:
    """Return the lattice of an image from its autocorrelation, or None where it has none.

    Shifted by a lattice vector, an image correlates with itself almost as well as unshifted; shifted from one
    sublattice to another it does so less, for strong columns then meet weak ones. So of the autocorrelation's maxima
    the lattice vectors are those that reach 0.8 of the highest; the shortest is ``a``. Among those in other directions
    ``b`` is found in the same way (by itself, for a surface may have many columns along and few rows down).
    Sublattices whose amplitudes differ by less than a factor of two count as one.

    Parameters
    ----------
    image, valid
        (y, x); blurred, and where it has been exposed.
    noise
        Standard deviation of the image's noise.
    spacing_px
        Length of ``a``, where it is known: the best within a quarter of it is taken.
    """
    step = max(1, min(image.shape) // _LARGE)
    heights, shifts = _autocorrelation(_binned(image, step), _binned(valid, step) == 1, noise)
    shifts = step * shifts
    length = np.hypot(shifts[:, 0], shifts[:, 1])
    least = _ORDERED
    if spacing_px is not None:
        shifts, heights, length = (values[length > 0.75 * spacing_px] for values in (shifts, heights, length))
        least = _ORDERED / 2
    a = _shortest(shifts, np.where(length < 1.25 * (spacing_px or np.inf), heights, 0.0), least)
    if a is None:
        return None
    sine = (shifts[:, 0] * a[1] - shifts[:, 1] * a[0]) / (length * np.hypot(*a))
    b = _shortest(shifts, np.where(np.abs(sine) > 0.3, heights, 0.0), least)
    if b is None:
        return None
    b = b - a * round(float(a @ b / (a @ a)))
    a, b = sorted((a, b), key=lambda vector: float(vector @ vector))
    return Lattice((float(a[0]), float(a[1])), (float(b[0]), float(b[1])))


def _shortest(shifts: Places, heights: Floats, least: float) -> Places | None:
    """Return the shortest shift (x, y) that is nearly as high as the highest; None where none is high enough."""
    high = np.flatnonzero(heights >= max(least, _SAME_LATTICE * heights.max(initial=0.0)))
    return shifts[min(high, key=lambda n: float(shifts[n] @ shifts[n]))] if len(high) else None


def _binned(image: Floats | Mask, step: int) -> Places:
    """Return the means of blocks of ``step`` pixels, without the rest at the right and the bottom."""
    ny, nx = (size // step * step for size in image.shape)
    return np.asarray(image[:ny, :nx].reshape(ny // step, step, nx // step, step).mean(axis=(1, 3), dtype=np.float64))


def _autocorrelation(image: Floats, valid: Mask, noise: float) -> tuple[Floats, Places]:
    """Return the heights and shifts (x, y) of the maxima of an image's autocorrelation, one of each opposite pair.

    The image is freed of its slow background and of outliers. Its autocorrelation is divided by that of its envelope
    (the local rms contrast, less the noise), so that a perfect lattice reaches about 1 however thick the crystal, and
    however much of the image is vacuum; and multiplied by the square root of the envelopes' overlap, so that a long
    shift must be better than a short one. None where the noise outweighs the columns.
    """
    ny, nx = image.shape
    wide = min(ny, nx) / 8
    flat = np.where(valid, image - smooth(image, wide), 0.0)
    flat = np.clip(flat, *np.percentile(flat[valid], [0.5, 99.5])) * valid
    power = smooth(flat**2, wide) / np.maximum(smooth(valid.astype(np.float64), wide), 1e-3)
    envelope = np.sqrt(np.maximum(power - noise**2, 0.0)) * valid
    size = [fft.next_fast_len(n + n // 2, real=True) for n in (ny, nx)]
    centre = (ny // 2, nx // 2)

    def correlate(values: Floats) -> Floats:
        """Up to shifts of half the image, the middle one zero."""
        spectrum = np.abs(fft.rfft2(values.astype(np.float32), s=size)) ** 2
        whole = np.roll(fft.irfft2(spectrum, s=size), centre, axis=(0, 1))
        return np.asarray(whole[: 2 * centre[0] + 1, : 2 * centre[1] + 1], dtype=np.float64)

    correlation, overlap = correlate(flat), correlate(envelope)
    if not 0 < correlation[centre] < _NOISIEST * overlap[centre]:
        return np.empty(0), np.empty((0, 2))
    correlation, overlap = correlation / overlap[centre], overlap / overlap[centre]
    enough = overlap >= _OVERLAP
    correlation = np.where(enough, correlation / np.sqrt(np.where(enough, overlap, 1.0)), 0.0)
    places = local_maxima(correlation, 3.0, _ORDERED / 4)
    places = places[((places > 0) & (places < [2 * centre[1], 2 * centre[0]])).all(axis=1)]
    x, y = places.astype(np.int64).T
    heights = correlation[y, x]
    shifts = np.stack([x + _vertex(correlation, y, x, 0, 1), y + _vertex(correlation, y, x, 1, 0)], axis=1)
    shifts -= centre[::-1]
    half = (y > centre[0]) | ((y == centre[0]) & (x > centre[1]))
    half &= np.hypot(shifts[:, 0], shifts[:, 1]) > 3
    return heights[half], shifts[half]


def _vertex(values: Floats, y: NDArray[np.int64], x: NDArray[np.int64], dy: int, dx: int) -> Floats:
    """Return how far from the maxima (y, x) the parabola through them and their two neighbours has its vertex."""
    before, at, after = values[y - dy, x - dx], values[y, x], values[y + dy, x + dx]
    bend = before - 2 * at + after
    return np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)


def smooth(image: Floats, sigma: float) -> Places:
    """Return ``image`` smoothed by about a Gaussian of ``sigma`` px: three passes of a box, whatever its width."""
    radius = round((np.sqrt(4 * sigma**2 + 1) - 1) / 2)
    return np.asarray(box_means(box_means(box_means(image, radius), radius), radius))


def pixel_noise(image: Floats, valid: Mask) -> float:
    """Return the standard deviation of the white noise of an image, from its second differences (Immerkær 1996)."""
    kernel = np.outer([1, -2, 1], [1, -2, 1]) / 6
    differences = np.abs(ndimage.convolve(np.asarray(image, dtype=np.float64), kernel, mode="nearest"))
    return float(np.median(differences[valid]) / 0.6745)


def damping(sigma: float) -> float:
    """Return the share of white noise's standard deviation that a Gaussian blur of ``sigma`` px leaves."""
    return min(1.0, 1 / (2 * np.sqrt(np.pi) * sigma)) if sigma > 0 else 1.0


def relief(image: Floats, spacing: float, blur_sigma_px: float) -> tuple[Floats, float]:
    """Return an image in which columns stand out, and the share of white noise that is left in it.

    Blurred to 0.08 of the spacing (a column is about twice as wide), less the surroundings over a third of it.
    """
    sigma = max(blur_sigma_px, 0.08 * spacing)
    fine = blur(np.asarray(image, dtype=np.float32), sigma)
    return fine - smooth(fine, spacing / 3), damping(sigma)


def find_peaks(
    relief: Floats, valid: Mask, lattice: Lattice | None, spacing: float, noise: float, min_amplitude: float
) -> Places:
    """Return the columns of the dominant sublattice and strong ones beside it, (n, 2) of (x, y), strongest first.

    1. Peaks: local maxima of ``relief`` within a fifth of the spacing, four times its noise high or more.
    2. Start: the peak with the highest lattice neighbours: by the median of all eight, or by its own height if that is
       less. It is on the dominant sublattice, even where a speck of dirt is the brightest thing in the image.
    3. Growth: from each accepted peak, strongest first, the strongest peak within a fifth of the spacing of each site
       that is one or two lattice steps away is accepted, if it is at least ``min_amplitude`` of the median. Sites are
       predicted from neighbours, so strain and slow distortion are followed. A peak of less than half the median must
       sit on the sites of most of the accepted ones within two steps, so that chains of noise lead nowhere. What is
       nearer than 0.7 spacings to a peak of its own sublattice is not accepted.
    4. Other sublattices are grown in the same way, and accepted if their start and their median reach 0.7 of the
       first's: the second column of a dumbbell, a shifted terrace, another grain. Weaker ones, such as oxygen between
       cerium, are left alone.
    5. Off every lattice: a peak of half the median or more that is farther from all accepted ones than any place inside
       the lattice could be is accepted: an adatom, a step edge.

    Parameters
    ----------
    relief, valid
        (y, x); columns bright. Peaks are looked for where ``valid``.
    lattice
        None: there is no growth, and strong peaks at least 0.75 spacings apart are returned.
    spacing, noise
        px, and the standard deviation of ``relief`` where there is nothing.
    """
    floor = max(_SIGNIFICANT * noise, 1e-9 * float(np.ptp(relief)))
    peaks = local_maxima(relief, max(TOLERANCE * spacing, 1.5), floor)
    x, y = peaks.astype(np.int64).T
    inside = ndimage.binary_erosion(valid)[y, x]  # a maximum on the rim is the flank of a column outside
    strongest_first = np.argsort(-relief[y, x], kind="stable")
    strongest_first = strongest_first[inside[strongest_first]]
    peaks, weights = peaks[strongest_first], relief[y, x][strongest_first]
    if not len(peaks):
        return np.empty((0, 2))
    taken = np.zeros(len(peaks), dtype=bool)
    if lattice is None:
        return np.asarray(peaks[_spread(peaks, taken, weights >= _STRONG * np.quantile(weights, 0.95), 0.75 * spacing)])
    start, support = _start(peaks, weights, lattice)
    median = support or float(weights[start])
    for _ in range(2):  # the median is that of the columns, which the first pass finds
        taken = _grow(peaks, weights, lattice, start, min_amplitude * median, _STRONG * median)
        median = float(np.median(weights[taken]))
    weakest, strong = min_amplitude * median, _STRONG * median
    while True:
        left = np.where(taken, 0.0, weights)
        start, support = _start(peaks, left, lattice)
        group = _grow(peaks, left, lattice, start, weakest, strong)
        if min(support, np.median(left[group])) < _ALIKE * median:
            break
        taken |= group
    return np.asarray(peaks[_spread(peaks, taken, weights >= strong, 1.1 * lattice.hole)])


def _start(peaks: Places, weights: Floats, lattice: Lattice) -> tuple[int, float]:
    """Return the peak of step 2 of :func:`find_peaks` (of few columns, one of the highest pair), and its measure."""
    sites = peaks[:, None] + lattice.translations(1)
    distance, neighbour = cKDTree(peaks).query(sites, distance_upper_bound=TOLERANCE * lattice.spacing)
    heights = np.where(np.isfinite(distance), np.append(weights, 0.0)[neighbour], 0.0)
    support = np.minimum(weights, np.median(heights, axis=1))
    pair = np.minimum(weights, heights.max(axis=1))
    start = int(np.lexsort((weights, pair, support))[-1])
    return start, float(support[start])


def _grow(peaks: Places, weights: Floats, lattice: Lattice, start: int, weakest: float, strong: float) -> Mask:
    """Return which of the peaks, strongest first, belong to the sublattice of one: step 3 of :func:`find_peaks`."""
    tree = cKDTree(peaks)
    taken = np.zeros(len(peaks), dtype=bool)
    blocked = weights < max(weakest, np.finfo(float).tiny)
    blocked[start] = False
    queue = [start]
    while queue:
        peak = heapq.heappop(queue)
        weak = weights[peak] < strong and peak != start
        if blocked[peak] or (weak and not _agreed(peak, peaks, tree, taken, lattice)):
            continue
        taken[peak] = True
        blocked[tree.query_ball_point(peaks[peak], _CLOSE * lattice.spacing)] = True
        sites = peaks[peak] + lattice.translations(2)
        for near in tree.query_ball_point(sites, TOLERANCE * lattice.spacing):
            free = [other for other in near if not blocked[other]]
            if free:
                heapq.heappush(queue, min(free))
    return taken


def _spread(peaks: Places, taken: Mask, strong: Mask, distance: float) -> Mask:
    """Return ``taken`` and the strong peaks farther than ``distance`` from it and from those before them."""
    tree = cKDTree(peaks)
    taken, crowded = taken.copy(), np.zeros(len(peaks), dtype=bool)
    for peak in [*np.flatnonzero(taken).tolist(), *np.flatnonzero(strong & ~taken).tolist()]:
        if taken[peak] or not crowded[peak]:
            taken[peak] = True
            crowded[tree.query_ball_point(peaks[peak], distance)] = True
    return taken


def _agreed(peak: int, peaks: Places, tree: cKDTree, taken: Mask, lattice: Lattice) -> bool:
    """Tell whether a peak sits on the lattice of most of the accepted peaks within two steps of it."""
    near = [other for other in tree.query_ball_point(peaks[peak], 2 * np.hypot(*lattice.b)) if taken[other]]
    if not near:
        return False
    basis = np.array([lattice.a, lattice.b])
    away = peaks[near] - peaks[peak]
    off = away - np.rint(away @ np.linalg.inv(basis)) @ basis
    return bool(np.mean(np.hypot(off[:, 0], off[:, 1]) <= TOLERANCE * lattice.spacing) >= 0.5)
