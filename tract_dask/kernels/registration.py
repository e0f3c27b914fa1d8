"""Registration of noisy frames by translation: the movie's spectrum, whole-pixel sums, and a bounded search.

A shift ``(dy, dx)`` says where the frame lies against a template: ``frame(y, x) = template(y - dy, x - dx)``. All
images that meet here have the same shape and a mean near zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .sums import overlap

Image: TypeAlias = NDArray[np.float32]
Floats: TypeAlias = NDArray[np.float64]

_DIRECT_LAGS = 9
"""So many shifts along a side, at most, are compared one by one, and more by FFT."""

_ABOUT_AS_GOOD = 0.95
"""Share of the best correlation."""

LEAST_OVERLAP = 0.25
"""Smallest share of a side that a frame must have in common with the template."""


def fast_length(n: int) -> int:
    """Return the smallest length from ``n`` upwards whose only prime factors are 2, 3 and 5.

    Examples
    --------
    >>> fast_length(17), fast_length(512)
    (18, 512)
    """
    while True:
        rest = n
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return n
        n += 1


class Spectrum(NamedTuple):
    """What a movie's frames have in common, whatever their drift, as a function of spatial frequency.

    Attributes
    ----------
    frequency
        Middle of each ring, cycles/px; shape (rings,).
    signal
        Mean power of the structure in each ring, (value)^2; 0 where it does not stand out of the noise.
    noise
        Power of the white noise of one frame, (value)^2.
    period_px
        Shortest lattice period; NaN where there is none.
    mean
        Mean value of the frames.
    """

    frequency: Floats
    signal: Floats
    noise: float
    period_px: float
    mean: float

    def gain(self, n_frames: float) -> Floats:
        """Return Wiener's gain S / (S + N / n) in each ring for a mean of ``n_frames`` aligned frames.

        Made to fall monotonically: a filter that lets through a narrow ring only would ring far into the image.
        """
        gain = self.signal / np.maximum(self.signal + self.noise / n_frames, np.finfo(np.float64).tiny)
        gain[0] = 1.0
        return np.asarray(np.maximum.accumulate(gain[::-1])[::-1])

    def loss(self, fold: int) -> float:
        """Return the share of the information on position that binning by ``fold`` more would lose.

        A ring holds information in proportion to its pixels, its signal and its frequency squared; a mean over
        ``fold`` pixels damps its signal by sinc(frequency * fold)^2. More than half a cycle a pixel is lost whole.
        """
        information = self.frequency**3 * self.signal
        kept = np.where(self.frequency * fold < 0.5, np.sinc(self.frequency * fold) ** 2, 0.0)
        total = float(information.sum())
        return 1.0 - float((information * kept).sum()) / total if total > 0.0 else 0.0


def measure_spectrum(frames: Sequence[Image]) -> Spectrum:
    """Return the spectrum of some frames of a movie.

    Periodograms do not depend on translation, so they are averaged without knowing the drift. White noise is what
    is found at the highest frequencies.
    """
    ny, nx = frames[0].shape
    window = np.outer(np.hanning(ny), np.hanning(nx)).astype(np.float32)
    means = [float(np.average(frame, weights=window)) for frame in frames]
    n, power = len(frames), np.zeros((ny, nx // 2 + 1))
    for frame, mean in zip(frames, means, strict=True):
        power += np.abs(forward_fft((frame - np.float32(mean)) * window)).astype(np.float64) ** 2
    power /= n * float(np.mean(window.astype(np.float64) ** 2))
    radius = spatial_frequency(ny, nx)
    width = 1.0 / min(ny, nx)
    ring = (radius / width).astype(np.intp)
    counts = np.bincount(ring.ravel())
    rings = np.bincount(ring.ravel(), power.ravel()) / np.maximum(counts, 1)
    frequency = (np.arange(rings.size) + 0.5) * width
    noise = float(np.median(rings[(frequency > 0.4) & (counts > 0)])) if min(ny, nx) > 8 else 0.0
    signal: Floats = np.where(rings - noise > 8.0 * noise / np.sqrt(np.maximum(counts, 1) * n), rings - noise, 0.0)
    spectrum = Spectrum(frequency, signal, noise, float("nan"), sum(means) / n)
    return spectrum._replace(period_px=_lattice_period(power, window, spectrum))


def forward_fft(image: Image, size: tuple[int, int] | None = None) -> NDArray[np.complex64]:
    """Return the orthonormal Fourier transform: with another norm numpy takes three times as long in float32."""
    return np.asarray(np.fft.rfft2(image, s=size, norm="ortho"), dtype=np.complex64)


def inverse_fft(spectrum: NDArray[np.complex64], size: tuple[int, int]) -> Image:
    """Return the image of this size that has an orthonormal Fourier transform."""
    return np.asarray(np.fft.irfft2(spectrum, s=size, norm="ortho"), dtype=np.float32)


@lru_cache(maxsize=4)
def spatial_frequency(ny: int, nx: int) -> Floats:
    """Return the spatial frequency of each coefficient of ``rfft2``, cycles/px."""
    return np.asarray(np.hypot(np.fft.fftfreq(ny)[:, None], np.fft.rfftfreq(nx)[None, :]), dtype=np.float64)


def _lattice_period(power: Floats, window: Image, spectrum: Spectrum) -> float:
    """Return the distance of the nearest of the high maxima of the autocorrelation, px; NaN where there is none."""
    ny, nx = window.shape
    radius = spatial_frequency(ny, nx)
    gain = np.interp(radius, spectrum.frequency, spectrum.gain(1.0)) * (radius > 3.0 / min(ny, nx))
    overlap = np.fft.irfft2(np.abs(np.fft.rfft2(window)) ** 2, s=(ny, nx))
    autocorrelation = np.fft.irfft2((power - spectrum.noise) * gain, s=(ny, nx))
    autocorrelation = np.fft.fftshift(autocorrelation / np.maximum(overlap, 0.05 * overlap.max()))
    cy, cx = ny // 2, nx // 2
    middle = autocorrelation[1:-1, 1:-1]
    peak = np.ones(middle.shape, bool)
    for dy in (0, 1, 2):
        for dx in (0, 1, 2):
            peak &= middle >= autocorrelation[dy : ny - 2 + dy, dx : nx - 2 + dx]
    y, x = np.nonzero(peak)
    distance = np.hypot(y + 1 - cy, x + 1 - cx)
    height = middle[y, x] / max(float(autocorrelation[cy, cx]), np.finfo(np.float64).tiny)
    apart = (distance > 2.0) & (distance < 0.4 * min(ny, nx)) & (height > 0.1)
    if not apart.any():
        return float("nan")
    return float(distance[apart & (height > 0.6 * height[apart].max())].min())


def correlation(frame: Image, template: Image, shift: Sequence[int] | NDArray[np.int64]) -> float:
    """Return Pearson's correlation of a frame that is shifted by whole pixels with the template; 0 where undefined."""
    sides = zip(template.shape, frame.shape, map(int, shift), strict=True)
    target, source = zip(*(overlap(*side) for side in sides), strict=True)
    if not template[target].size:
        return 0.0
    t, f = (piece - np.float32(piece.mean(dtype=np.float64)) for piece in (template[target], frame[source]))
    power = float(np.vdot(t, t)) * float(np.vdot(f, f))
    return float(np.vdot(t, f)) / power**0.5 if power > 0.0 else 0.0


def load_kernels() -> None:
    """Load a kernel: Numba sets itself up at the first, which takes a second, and loads others in milliseconds."""
    clean_image(np.zeros((8, 8), np.float32))


@njit(cache=True, nogil=True)
def clean_image(raw: NDArray[Any]) -> tuple[Image, bool]:
    """Return a frame in float32, its NaN and infinite pixels replaced by its mean, and whether it shows anything."""
    ny, nx = raw.shape
    image, odd = np.empty((ny, nx), np.float32), np.zeros(nx, np.float32)
    low, high = np.full(nx, np.float32(np.inf)), np.full(nx, np.float32(-np.inf))
    for y in range(ny):
        for x in range(nx):
            value = np.float32(raw[y, x])
            image[y, x] = value
            odd[x] += value - value  # NaN from where a value is not finite
            low[x] = min(low[x], value)
            high[x] = max(high[x], value)
    least, largest, strange = np.float32(np.inf), np.float32(-np.inf), np.float32(0)
    for x in range(nx):  # loops: what they replace of numpy takes Numba four times as long to compile
        least, largest, strange = min(least, low[x]), max(largest, high[x]), strange + odd[x]
    if strange == 0:
        return image, bool(least < largest)
    n, total = 0, 0.0
    least, largest = np.float32(np.inf), np.float32(-np.inf)
    for y in range(ny):
        for x in range(nx):
            value = image[y, x]
            if value - value == 0:
                n, total = n + 1, total + value
                least, largest = min(least, value), max(largest, value)
    mean = np.float32(total / max(1, n))
    for y in range(ny):
        for x in range(nx):
            if image[y, x] - image[y, x] != 0:
                image[y, x] = mean
    return image, bool(least < largest)


@njit(cache=True, nogil=True)
def fold_image(image: Image, fold: int) -> Image:
    """Return the means over ``fold`` x ``fold`` pixels, without those that hang over the edge."""
    if fold == 1:
        return image
    folded = np.zeros((image.shape[0] // fold, image.shape[1] // fold), np.float32)
    line = np.empty(folded.shape[1] * fold, np.float32)
    for y in range(folded.shape[0]):
        line[:] = 0.0
        for row in range(y * fold, (y + 1) * fold):
            source = image[row]
            for x in range(line.size):
                line[x] += source[x]
        target = folded[y]
        for k in range(fold):
            for x in range(target.size):
                target[x] += line[x * fold + k]
    folded *= np.float32(1.0 / fold**2)
    return folded


def search(frame: Image, template: Image, guess: tuple[float, float], radius: float) -> tuple[float, float, float]:
    """Return the shift of ``frame`` near a guess, and the normalised correlation there.

    The same pixels of the frame are compared at every shift, and each comparison is normalised by what the template
    holds under them, so neither the edges nor a step of brightness pull the result.

    Parameters
    ----------
    guess
        (dy, dx), px.
    radius
        Only shifts within this distance of the guess are admitted, px.

    Returns
    -------
    (dy, dx, correlation)
        From a parabola through the highest whole-pixel correlation and its neighbours; the guess and 0 where the
        images overlap by less than a quarter of a side.
    """
    centre = (round(guess[0]), round(guess[1]))
    reach = int(np.ceil(radius)) + 1
    score = _scores(frame, template, centre, reach)
    if score is None:
        return (*guess, 0.0)
    lag = np.arange(-reach, reach + 1)
    distance = np.hypot(lag[:, None] + centre[0] - guess[0], lag[None, :] + centre[1] - guess[1])
    i, j = np.unravel_index(int(np.argmax(np.where(distance <= radius, score, -np.inf))), score.shape)
    dy, dx = (centre[0] + lag[i] + _vertex(score[:, j], int(i)), centre[1] + lag[j] + _vertex(score[i, :], int(j)))
    return float(dy), float(dx), float(score[i, j])


class Rival(NamedTuple):
    """Another shift at which a frame resembles a template: (dy, dx) in px, and both correlations."""

    dy: float
    dx: float
    correlation: float
    near: float
    """At the shift that it is a rival of."""
    step: float
    """From the guess, px."""
    next_step: float
    """The same of the nearest other one that is about as good; infinite where there is none."""


def search_rival(
    frame: Image,
    template: Image,
    shift: tuple[float, float],
    guess: tuple[float, float],
    radius: float,
    apart: tuple[float, float],
) -> Rival | None:
    """Return the best shift of ``frame`` within ``radius`` px of a guess that is apart from another shift.

    Of shifts that are about as good it is the nearest one to the guess. Both are compared on the same pixels, each at
    the top of a parabola through the correlations at whole pixels. None where the images overlap by less than a quarter
    of a side.

    Parameters
    ----------
    apart
        Least distance from ``shift``, and that of one rival from another, px.
    """
    centre = (round(guess[0]), round(guess[1]))
    reach = int(np.ceil(radius)) + 1
    score = _scores(frame, template, centre, reach)
    if score is None:
        return None
    lag = np.arange(-reach, reach + 1)

    def away(y: float, x: float) -> Floats:
        return np.asarray(np.hypot(lag[:, None] + centre[0] - y, lag[None, :] + centre[1] - x))

    distance, step = away(*shift), away(*guess)
    wanted = (distance >= apart[0]) & (step <= radius)
    good = wanted & (score >= _ABOUT_AS_GOOD * np.max(np.where(wanted, score, -np.inf)))
    first = np.unravel_index(int(np.argmin(np.where(good, step, np.inf))), score.shape)
    from_first = away(lag[first[0]] + centre[0], lag[first[1]] + centre[1])
    best = _top(np.where(wanted & (from_first < apart[1] / 2), score, -np.inf), score)
    y, x = best[0] + centre[0] - reach, best[1] + centre[1] - reach
    others = good & (away(y, x) >= apart[1])
    near = _top(np.where(distance < 2, score, -np.inf), score)
    length = float(np.hypot(y - guess[0], x - guess[1]))
    return Rival(y, x, best[2], near[2], length, float(np.min(np.where(others, step, np.inf))))


def _top(allowed: Floats, score: Floats) -> tuple[float, float, float]:
    """Return where the highest of the allowed values is, by parabolas through the scores, and how high they are."""
    i, j = map(int, np.unravel_index(int(np.argmax(allowed)), score.shape))
    y, x, height = _vertex(score[:, j], i), _vertex(score[i, :], j), float(score[i, j])
    for line, k, top in ((score[:, j], i, y), (score[i, :], j, x)):
        height += 0.25 * float(line[k + 1] - line[k - 1]) * top if top else 0.0
    return i + y, j + x, height


def _scores(frame: Image, template: Image, centre: tuple[int, int], reach: int) -> Floats | None:
    """Return Pearson's correlations at whole shifts up to ``reach`` from a centre; None where too little overlaps."""
    rows, columns = (slice(max(0, c + reach), min(n, n + c - reach)) for n, c in zip(frame.shape, centre, strict=True))
    h, w = rows.stop - rows.start, columns.stop - columns.start
    if h < LEAST_OVERLAP * frame.shape[0] or w < LEAST_OVERLAP * frame.shape[1]:
        return None
    piece = frame[rows, columns] - frame[rows, columns].mean(dtype=np.float64).astype(np.float32)
    top, left = rows.start - centre[0] - reach, columns.start - centre[1] - reach
    under = template[top : top + h + 2 * reach, left : left + w + 2 * reach]
    return _correlations(piece, under, 2 * reach + 1)[::-1, ::-1]


def _correlations(piece: Image, under: Image, lags: int) -> Floats:
    """Return Pearson's correlation of ``piece`` (mean 0) with each of lags x lags windows of ``under``."""
    products = _products(piece, under, lags) if lags <= _DIRECT_LAGS else _products_by_fft(piece, under, lags)
    sums, squares = _window_sums(under, lags)
    power = float(np.sum(piece * piece, dtype=np.float64)) * np.maximum(squares - sums**2 / piece.size, 0.0)
    return np.asarray(products / np.sqrt(np.maximum(power, np.finfo(np.float64).tiny)))


@njit(cache=True, nogil=True, fastmath=True)
def _products(piece: Image, under: Image, lags: int) -> Floats:
    """Return the inner products of ``piece`` with lags x lags windows of ``under``, one by one."""
    products = np.zeros((lags, lags))
    for i in range(lags):
        for y in range(piece.shape[0]):
            line, below = piece[y], under[y + i]
            for j in range(lags):
                total = np.float32(0.0)
                for x in range(line.size):
                    total += line[x] * below[x + j]
                products[i, j] += total
    return products


def _products_by_fft(piece: Image, under: Image, lags: int) -> Floats:
    """Return the same, all at once, which costs less where there are many."""
    size = fast_length(under.shape[0]), fast_length(under.shape[1])
    product = forward_fft(under, size) * np.conj(forward_fft(piece, size))
    return np.asarray(np.sqrt(size[0] * size[1]) * inverse_fft(product, size)[:lags, :lags].astype(np.float64))


@njit(cache=True, nogil=True)
def _window_sums(image: Image, lags: int) -> tuple[Floats, Floats]:
    """Return the sums, and the sums of squares, over the windows that fit into ``image`` at lags x lags places."""
    height, width = image.shape[0] - lags + 1, image.shape[1] - lags + 1
    sums, squares = np.empty((lags, lags)), np.empty((lags, lags))
    column_sums, column_squares = np.zeros(image.shape[1]), np.zeros(image.shape[1])
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            column_sums[x] += image[y, x]
            column_squares[x] += np.float64(image[y, x]) ** 2
        i = y - height + 1
        if i < 0:
            continue
        for j in range(lags):
            sums[i, j], squares[i, j] = column_sums[j : j + width].sum(), column_squares[j : j + width].sum()
        for x in range(image.shape[1]):
            column_sums[x] -= image[i, x]
            column_squares[x] -= np.float64(image[i, x]) ** 2
    return sums, squares


def _vertex(score: Floats, k: int) -> float:
    """Return where, from ``k``, the parabola through three values has its top; 0 where the middle is no maximum."""
    if not 0 < k < len(score) - 1:
        return 0.0
    before, here, after = score[k - 1 : k + 2]
    curvature = before - 2.0 * here + after
    if curvature >= 0.0 or here < max(before, after):
        return 0.0
    return float(0.5 * (before - after) / curvature)
