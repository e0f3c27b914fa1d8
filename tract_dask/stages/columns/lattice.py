"""Finding columns without being told where: the lattice of an image, and the peaks that sit on it."""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy  # its parts load on use: workers need few of them
from numpy.typing import NDArray

from ...kernels.peaks import local_maxima
from ...kernels.windows import blur
from .relief import Mask, Places, Reals, Relief, binned, coarseness, damping, expanded, sample, smooth

TOLERANCE = 0.2
"""How far from its lattice site a column may be, in spacings."""

_WIDEST_BLUR_PX, _BLUR_OF_SPACING, _FINEST_BLUR_PX = 2.0, 0.1, 0.5
"""Blurs before an image is correlated with itself, where none is set."""
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
_MARGIN = 3
"""The shortest shift, px, that may be a lattice vector."""
_LEVEL_BINS = 8
"""Bins in the reach of the background's median."""
_HOLE_PX = 5
"""Holes less wide than this are those of single pixels, small clusters, and short lines of them."""
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


def find_lattice(
    image: Reals, valid: Mask, noise: float, blur_sigma_px: float | None, spacing_px: float | None = None
) -> Lattice | None:
    """Return the lattice of an image from its autocorrelation, or None where it has none.

    Shifted by a lattice vector, an image correlates with itself almost as well as unshifted; shifted from one
    sublattice to another it does so less, for strong columns then meet weak ones. So of the autocorrelation's maxima
    the lattice vectors are those that reach 0.8 of the highest; the shortest is ``a``. Among those in other directions
    ``b`` is found in the same way (by itself, for a surface may have many columns along and few rows down).
    Sublattices whose amplitudes differ by less than a factor of two count as one.

    Parameters
    ----------
    image, valid
        (y, x), and where it has been exposed.
    noise
        Standard deviation of the noise of a pixel.
    blur_sigma_px
        Blur before the correlation. None: 2 px; where the lattice is then so fine that this is much of a column, or
        none is seen, a tenth of its spacing, or half a pixel.
    spacing_px
        Length of ``a``, where it is known: the best within a quarter of it is taken.
    """
    if blur_sigma_px is None:
        found = find_lattice(image, valid, noise, _WIDEST_BLUR_PX, spacing_px)
        finer = _BLUR_OF_SPACING * found.spacing if found else _FINEST_BLUR_PX
        again = find_lattice(image, valid, noise, finer, spacing_px) if finer < _WIDEST_BLUR_PX else None
        return again or found
    step = max(1, min(image.shape) // _LARGE)
    blurred = blur(binned(image, step).astype(np.float32), blur_sigma_px / step)
    noise *= damping(blur_sigma_px / step) / step
    heights, shifts = _autocorrelation(blurred, binned(valid, step) == 1, noise)
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


def _shortest(shifts: Places, heights: Reals, least: float) -> Places | None:
    """Return the shortest shift (x, y) that is nearly as high as the highest; None where none is high enough."""
    high = np.flatnonzero(heights >= max(least, _SAME_LATTICE * heights.max(initial=0.0)))
    return shifts[min(high, key=lambda n: float(shifts[n] @ shifts[n]))] if len(high) else None


def _autocorrelation(image: Reals, valid: Mask, noise: float) -> tuple[Reals, Places]:
    """Return the heights and shifts (x, y) of the maxima of an image's autocorrelation, one of each opposite pair.

    The image is freed of its slow background and of outliers. The background is a median: a mean would leave a ridge
    along the rim of the specimen, which outweighs low columns. Its autocorrelation is divided by that of its envelope
    (the local rms contrast, less the noise), so that a perfect lattice reaches about 1 however thick the crystal, and
    however much of the image is vacuum; and multiplied by the square root of the envelopes' overlap, so that a long
    shift must be better than a short one. None where the noise outweighs the columns.
    """
    wide = min(image.shape) / 8
    flat = np.where(valid, image - _level(image, wide), np.float32(0))
    flat = np.clip(flat, *np.percentile(sample(flat[valid]), [0.5, 99.5]).astype(np.float32)) * valid
    correlation = _correlate(flat)
    step = coarseness(wide)
    share = binned(valid, step)
    power = smooth(binned(flat**2, step), wide / step) / np.maximum(smooth(share, wide / step), 1e-3)
    coarse = step**2 * _correlate(np.sqrt(np.maximum(power - noise**2, 0.0)) * share)
    centre, middle = (_MARGIN, correlation.shape[1] // 2), (_MARGIN, coarse.shape[1] // 2)
    overlap = expanded(coarse, correlation.shape, step, (centre[0] - step * middle[0], centre[1] - step * middle[1]))
    level = overlap[centre]
    if not 0 < correlation[centre] < _NOISIEST * level:
        return np.empty(0), np.empty((0, 2))
    correlation *= np.where(overlap >= _OVERLAP * level, 1 / np.sqrt(np.maximum(overlap, _OVERLAP * level) * level), 0)
    places = local_maxima(correlation.astype(np.float32), float(_MARGIN), _ORDERED / 4)
    inside = (places > 0) & (places < np.array(correlation.shape[::-1]) - 1)
    x, y = places[inside.all(axis=1)].astype(np.int64).T
    heights = correlation[y, x]
    shifts = np.stack([x + _vertex(correlation, y, x, 0, 1), y + _vertex(correlation, y, x, 1, 0)], axis=1)
    shifts -= centre[::-1]
    half = (y > centre[0]) | ((y == centre[0]) & (x > centre[1]))
    half &= np.hypot(shifts[:, 0], shifts[:, 1]) > _MARGIN
    return heights[half], shifts[half]


def _correlate(image: Reals) -> Reals:
    """Return the autocorrelation of an image for shifts of up to half of it.

    Only one of each opposite pair of shifts is there: down by -3 px (``_MARGIN``) and more, along x the middle is zero.
    """
    down, across = (n // 2 for n in image.shape)
    size = [scipy.fft.next_fast_len(n + n // 2 + 1, real=True) for n in image.shape]
    spectrum = np.abs(scipy.fft.rfft2(image.astype(np.float32), s=size)) ** 2
    whole = scipy.fft.irfft2(spectrum, s=size)
    rows, columns = np.arange(-_MARGIN, down + 1), np.arange(-across, across + 1)
    return np.ascontiguousarray(whole[rows][:, columns])


def _vertex(values: Reals, y: NDArray[np.int64], x: NDArray[np.int64], dy: int, dx: int) -> Reals:
    """Return how far from the maxima (y, x) the parabola through them and their two neighbours has its vertex."""
    before, at, after = values[y - dy, x - dx], values[y, x], values[y + dy, x + dx]
    bend = before - 2 * at + after
    return np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)


def _level(image: Reals, reach: float) -> Reals:
    """Return the median of an image's surroundings, those within ``reach`` px along each axis, from bins."""
    step = max(1, int(reach / _LEVEL_BINS))
    bins = scipy.ndimage.median_filter(binned(image, step), 2 * round(reach / step) + 1, mode="nearest")
    return expanded(bins, image.shape, step, ((step - 1) / 2, (step - 1) / 2))


def without_holes(there: Mask) -> Mask:
    """Return which pixels (y, x) are there, and those of the small holes and narrow lines between them.

    Examples
    --------
    >>> there = np.ones((9, 9), bool)
    >>> there[4, 4] = there[:, 0] = False
    >>> whole = without_holes(there)
    >>> bool(whole[4, 4]), bool(whole[4, 0])
    (True, False)
    """
    side = 2 * _HOLE_PX
    closed = scipy.ndimage.binary_closing(np.pad(there, side, mode="edge"), np.ones((_HOLE_PX, _HOLE_PX), np.bool_))
    whole: Mask = there | closed[side:-side, side:-side]
    return whole


def peaks_of(relief: Relief, spacing: float) -> tuple[Places, Reals]:
    """Return the local maxima (n, 2) of (x, y), px, that stand out of the noise, and their heights, strongest first."""
    height = relief.height
    floor = max(_SIGNIFICANT * relief.noise, 1e-9 * float(np.ptp(height)))
    peaks = local_maxima(height, max(TOLERANCE * spacing / relief.step, 1.5), floor)
    x, y = peaks.astype(np.int64).T
    inside = scipy.ndimage.binary_erosion(relief.valid)[y, x]  # a maximum on the rim is the flank of a column outside
    strongest_first = np.argsort(-height[y, x], kind="stable")
    strongest_first = strongest_first[inside[strongest_first]]
    return relief.px(peaks[strongest_first]), height[y, x][strongest_first]


def find_peaks(relief: Relief, lattice: Lattice | None, spacing: float, min_amplitude: float) -> Places:
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
       first's: the second column of a dumbbell, a shifted terrace, another grain. Fainter ones are looked for later
       (:mod:`tract_dask.stages.columns.sublattices`).
    5. Off every lattice: a peak of half the median or more that is farther from all accepted ones than any place inside
       the lattice could be is accepted: an adatom, a step edge.

    Parameters
    ----------
    relief
        Peaks are looked for where it is valid.
    lattice
        None: there is no growth, and strong peaks at least 0.75 spacings apart are returned.
    spacing
        In px, as the lattice.
    """
    peaks, weights = peaks_of(relief, spacing)
    if not len(peaks):
        return np.empty((0, 2))
    taken = np.zeros(len(peaks), dtype=bool)
    if lattice is None:
        return np.asarray(peaks[_spread(peaks, taken, weights >= _STRONG * np.quantile(weights, 0.95), 0.75 * spacing)])
    start, support = start_of(peaks, weights, lattice)
    median = support or float(weights[start])
    for _ in range(2):  # the median is that of the columns, which the first pass finds
        taken = grown(peaks, weights, lattice, start, min_amplitude * median, _STRONG * median)
        median = float(np.median(weights[taken]))
    weakest, strong = min_amplitude * median, _STRONG * median
    while True:
        left = np.where(taken, 0.0, weights)
        start, support = start_of(peaks, left, lattice)
        group = grown(peaks, left, lattice, start, weakest, strong)
        if min(support, np.median(left[group])) < _ALIKE * median:
            break
        taken |= group
    return np.asarray(peaks[_spread(peaks, taken, weights >= strong, 1.1 * lattice.hole)])


def start_of(peaks: Places, weights: Reals, lattice: Lattice) -> tuple[int, float]:
    """Return the peak of step 2 of :func:`find_peaks` (of few columns, one of the highest pair), and its measure."""
    sites = peaks[:, None] + lattice.translations(1)
    distance, neighbour = scipy.spatial.cKDTree(peaks).query(sites, distance_upper_bound=TOLERANCE * lattice.spacing)
    heights = np.where(np.isfinite(distance), np.append(weights, 0.0)[neighbour], 0.0)
    support = np.minimum(weights, np.median(heights, axis=1))
    pair = np.minimum(weights, heights.max(axis=1))
    start = int(np.lexsort((weights, pair, support))[-1])
    return start, float(support[start])


def grown(peaks: Places, weights: Reals, lattice: Lattice, start: int, weakest: float, strong: float) -> Mask:
    """Return which of the peaks, strongest first, belong to the sublattice of one: step 3 of :func:`find_peaks`."""
    tree = scipy.spatial.cKDTree(peaks)
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
    tree = scipy.spatial.cKDTree(peaks)
    taken, crowded = taken.copy(), np.zeros(len(peaks), dtype=bool)
    for peak in [*np.flatnonzero(taken).tolist(), *np.flatnonzero(strong & ~taken).tolist()]:
        if taken[peak] or not crowded[peak]:
            taken[peak] = True
            crowded[tree.query_ball_point(peaks[peak], distance)] = True
    return taken


def _agreed(peak: int, peaks: Places, tree: scipy.spatial.cKDTree, taken: Mask, lattice: Lattice) -> bool:
    """Tell whether a peak sits on the lattice of most of the accepted peaks within two steps of it."""
    near = [other for other in tree.query_ball_point(peaks[peak], 2 * np.hypot(*lattice.b)) if taken[other]]
    if not near:
        return False
    basis = np.array([lattice.a, lattice.b])
    away = peaks[near] - peaks[peak]
    off = away - np.rint(away @ np.linalg.inv(basis)) @ basis
    return bool(np.mean(np.hypot(off[:, 0], off[:, 1]) <= TOLERANCE * lattice.spacing) >= 0.5)
