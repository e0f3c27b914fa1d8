"""Registration of noisy frames by translation: the movie's spectrum, a bounded search, and a sub-pixel fit.

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

Image: TypeAlias = NDArray[np.float32]
Floats: TypeAlias = NDArray[np.float64]

PAD = 32
"""Zeros between the two edges of an image that a filter would otherwise join, px."""

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
        power += np.abs(_fft((frame - np.float32(mean)) * window)).astype(np.float64) ** 2
    power /= n * float(np.mean(window.astype(np.float64) ** 2))
    radius = _radius(ny, nx)
    width = 1.0 / min(ny, nx)
    ring = (radius / width).astype(np.intp)
    counts = np.bincount(ring.ravel())
    rings = np.bincount(ring.ravel(), power.ravel()) / np.maximum(counts, 1)
    frequency = (np.arange(rings.size) + 0.5) * width
    noise = float(np.median(rings[(frequency > 0.4) & (counts > 0)])) if min(ny, nx) > 8 else 0.0
    signal: Floats = np.where(rings - noise > 8.0 * noise / np.sqrt(np.maximum(counts, 1) * n), rings - noise, 0.0)
    spectrum = Spectrum(frequency, signal, noise, float("nan"), sum(means) / n)
    return spectrum._replace(period_px=_lattice_period(power, window, spectrum))


def _fft(image: Image, size: tuple[int, int] | None = None) -> NDArray[np.complex64]:
    """Return the orthonormal Fourier transform: with another norm numpy takes three times as long in float32."""
    return np.asarray(np.fft.rfft2(image, s=size, norm="ortho"), dtype=np.complex64)


def _inverse_fft(spectrum: NDArray[np.complex64], size: tuple[int, int]) -> Image:
    return np.asarray(np.fft.irfft2(spectrum, s=size, norm="ortho"), dtype=np.float32)


@lru_cache(maxsize=4)
def _radius(ny: int, nx: int) -> Floats:
    """Return the spatial frequency of each coefficient of ``rfft2``, cycles/px."""
    return np.asarray(np.hypot(np.fft.fftfreq(ny)[:, None], np.fft.rfftfreq(nx)[None, :]), dtype=np.float64)


def _lattice_period(power: Floats, window: Image, spectrum: Spectrum) -> float:
    """Return the distance of the nearest of the high maxima of the autocorrelation, px; NaN where there is none."""
    ny, nx = window.shape
    radius = _radius(ny, nx)
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


class LowPass:
    """A filter for images of one shape, by FFT; beyond its edges an image is zero.

    Parameters
    ----------
    shape
        Shape of the images, (y, x).
    frequency, gain
        Gain at spatial frequencies, cycles/px.
    """

    def __init__(self, shape: tuple[int, int], frequency: Floats, gain: Floats) -> None:
        self.shape = shape
        self._padded = fast_length(shape[0] + PAD), fast_length(shape[1] + PAD)
        self._gain = np.interp(_radius(*self._padded), frequency, gain).astype(np.float32)

    def __call__(self, image: Image) -> Image:
        """Return the filtered image."""
        spectrum = _fft(image, self._padded)
        spectrum *= self._gain
        return np.ascontiguousarray(_inverse_fft(spectrum, self._padded)[: self.shape[0], : self.shape[1]])


def add_shifted(total: NDArray[Any], image: NDArray[Any], shift: tuple[int, int]) -> None:
    """Add an image to a running sum in the template's frame: ``total(y, x) += image(y + dy, x + dx)``.

    What leaves the template's frame is dropped; the image may be of another shape.
    """
    sides = zip(total.shape, image.shape, shift, strict=True)
    target, source = zip(*(overlap(*side) for side in sides), strict=True)
    np.add(total[target], image[source], out=total[target], casting="same_kind")


def fold_image(image: Image, fold: int) -> Image:
    """Return the means over ``fold`` x ``fold`` pixels, without those that hang over the edge."""
    if fold == 1:
        return image
    ny, nx = image.shape[0] // fold * fold, image.shape[1] // fold * fold
    total = np.zeros((ny // fold, nx // fold), np.float32)
    for y in range(fold):
        for x in range(fold):
            total += image[y:ny:fold, x:nx:fold]
    total *= np.float32(1.0 / fold**2)
    return total


def overlap(n_template: int, n_frame: int, shift: int) -> tuple[slice, slice]:
    """Return the parts of template and frame, along an axis, that lie on one another where the frame is shifted.

    Examples
    --------
    >>> overlap(100, 100, 3)
    (slice(0, 97, None), slice(3, 100, None))
    """
    start = min(max(0, -shift), n_template)
    stop = max(start, min(n_template, n_frame - shift))
    return slice(start, stop), slice(start + shift, stop + shift)


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
    rows, columns = (slice(max(0, c + reach), min(n, n + c - reach)) for n, c in zip(frame.shape, centre, strict=True))
    h, w = rows.stop - rows.start, columns.stop - columns.start
    if h < LEAST_OVERLAP * frame.shape[0] or w < LEAST_OVERLAP * frame.shape[1]:
        return (*guess, 0.0)
    piece = frame[rows, columns] - frame[rows, columns].mean(dtype=np.float64).astype(np.float32)
    top, left = rows.start - centre[0] - reach, columns.start - centre[1] - reach
    under = template[top : top + h + 2 * reach, left : left + w + 2 * reach]
    score = _correlations(piece, under, 2 * reach + 1)[::-1, ::-1]
    lag = np.arange(-reach, reach + 1)
    distance = np.hypot(lag[:, None] + centre[0] - guess[0], lag[None, :] + centre[1] - guess[1])
    i, j = np.unravel_index(int(np.argmax(np.where(distance <= radius, score, -np.inf))), score.shape)
    dy, dx = (centre[0] + lag[i] + _vertex(score[:, j], int(i)), centre[1] + lag[j] + _vertex(score[i, :], int(j)))
    return float(dy), float(dx), float(score[i, j])


def _correlations(piece: Image, under: Image, lags: int) -> Floats:
    """Return Pearson's correlation of ``piece`` (mean 0) with each of lags x lags windows of ``under``."""
    size = fast_length(under.shape[0]), fast_length(under.shape[1])
    product = _fft(under, size) * np.conj(_fft(piece, size))
    covariance = np.sqrt(size[0] * size[1]) * _inverse_fft(product, size)[:lags, :lags].astype(np.float64)
    mean = _window_sums(under, lags) / piece.size
    spread = _window_sums(under * under, lags) - piece.size * mean**2
    power = float(np.sum(piece * piece, dtype=np.float64)) * np.maximum(spread, 0.0)
    return np.asarray(covariance / np.sqrt(np.maximum(power, np.finfo(np.float64).tiny)))


def _window_sums(image: Image, lags: int) -> Floats:
    """Return the sums over the windows that fit into ``image`` at lags x lags places."""

    def along(lines: NDArray[Any]) -> Floats:
        size = len(lines) - lags + 1
        first = lines[:size].sum(axis=0, dtype=np.float64)
        steps = lines[size:].astype(np.float64) - lines[: lags - 1]
        return np.asarray(np.concatenate([first[None], first + np.cumsum(steps, axis=0)]))

    return np.asarray(along(np.ascontiguousarray(along(image).T)).T)


def _vertex(score: Floats, k: int) -> float:
    """Return where, from ``k``, the parabola through three values has its top; 0 where the middle is no maximum."""
    if not 0 < k < len(score) - 1:
        return 0.0
    before, here, after = score[k - 1 : k + 2]
    curvature = before - 2.0 * here + after
    if curvature >= 0.0 or here < max(before, after):
        return 0.0
    return float(0.5 * (before - after) / curvature)


class Alignment(NamedTuple):
    """The sub-pixel shift of a frame: (dy, dx) in px, Pearson's correlation, and whether the fit converged."""

    dy: float
    dx: float
    correlation: float
    converged: bool


def align(
    frame: Image,
    template: Image,
    weight: Image,
    start: tuple[float, float],
    *,
    limit: float,
    tolerance: float = 1e-3,
    max_iterations: int = 20,
) -> Alignment:
    """Fit the shift by least squares: minimise sum w (frame - a template(shifted) - b)^2 over dy, dx, a, b.

    Gauss-Newton: each step is one linear regression of the frame on the shifted template, its two derivatives and a
    constant. With white noise in the frame and little in the template its errors are at the Cramer-Rao bound.

    Parameters
    ----------
    weight
        Weight of the template's pixels; 0 leaves a pixel out.
    limit
        A fit that goes further from its start than this has failed, px.
    tolerance
        Last step, px.

    Returns
    -------
    Alignment
        At the start, not converged, where the fit fails.
    """
    dy, dx = start
    for _ in range(max_iterations):
        step_y, step_x = _step(moments(frame, template, weight, dy, dx))
        length = float(np.hypot(step_y, step_x))
        if not np.isfinite(length):
            break
        scale = min(1.0, 1.0 / length) if length > 0.0 else 1.0
        dy, dx = dy + scale * step_y, dx + scale * step_x
        if np.hypot(dy - start[0], dx - start[1]) > limit:
            break
        if length < tolerance:
            return Alignment(dy, dx, correlation(moments(frame, template, weight, dy, dx)), True)
    return Alignment(*start, correlation(moments(frame, template, weight, *start)), False)


def correlation(sums: Floats) -> float:
    """Return Pearson's correlation of the frame with the shifted template from their moments; 0 where undefined."""
    n, t, f, tt, ft, ff = sums[0], sums[1], sums[4], sums[5], sums[6], sums[14]
    power = (tt - t * t / n) * (ff - f * f / n) if n > 0.0 else 0.0
    return float((ft - f * t / n) / np.sqrt(power)) if power > 0.0 else 0.0


def _step(m: Floats) -> tuple[float, float]:
    """Return the Gauss-Newton step (dy, dx) from the moments; NaN where the regression is singular or inverted."""
    normal = np.array(
        [
            [m[0], m[1], m[2], m[3]],
            [m[1], m[5], m[7], m[8]],
            [m[2], m[7], m[9], m[10]],
            [m[3], m[8], m[10], m[11]],
        ]
    )
    scale = np.sqrt(np.diag(normal))
    if not scale.all():
        return float("nan"), float("nan")
    try:
        found = np.linalg.solve(normal / np.outer(scale, scale), np.array([m[4], m[6], m[12], m[13]]) / scale) / scale
    except np.linalg.LinAlgError:
        return float("nan"), float("nan")
    if found[1] <= 0.0:
        return float("nan"), float("nan")
    return float(-found[2] / found[1]), float(-found[3] / found[1])


@njit(cache=True, nogil=True)
def _cubic(t: float) -> tuple[Floats, Floats]:
    """Weights of Catmull and Rom's cubic at -1, 0, 1, 2 for a point ``t`` after 0, and of its derivative."""
    value = np.array(
        [
            0.5 * (-t + 2.0 * t * t - t**3),
            0.5 * (2.0 - 5.0 * t * t + 3.0 * t**3),
            0.5 * (t + 4.0 * t * t - 3.0 * t**3),
            0.5 * (t**3 - t * t),
        ]
    )
    slope = np.array(
        [
            0.5 * (-1.0 + 4.0 * t - 3.0 * t * t),
            0.5 * (-10.0 * t + 9.0 * t * t),
            0.5 * (1.0 + 8.0 * t - 9.0 * t * t),
            0.5 * (3.0 * t * t - 2.0 * t),
        ]
    )
    return value, slope


@njit(cache=True, nogil=True, fastmath=True)
def moments(frame: Image, template: Image, weight: Image, dy: float, dx: float) -> Floats:
    """Return the weighted sums of products that the regression of ``frame`` on the shifted template needs.

    With T the shifted template and Ty, Tx its derivatives: sums of 1, T, Ty, Tx, f, TT, fT, TTy, TTx, TyTy, TyTx,
    TxTx, fTy, fTx, ff, over the frame's pixels, each with the weight of the nearest pixel of the template.
    """
    ny, nx = frame.shape
    row_shift, column_shift = int(np.floor(-dy)), int(np.floor(-dx))
    vy, sy = _cubic(-dy - row_shift)
    vx, sx = _cubic(-dx - column_shift)
    near_y, near_x = int(np.rint(-dy)), int(np.rint(-dx))
    first, last = max(0, 1 - column_shift), min(nx, nx - 2 - column_shift)
    vy0, vy1, vy2, vy3 = np.float32(vy[0]), np.float32(vy[1]), np.float32(vy[2]), np.float32(vy[3])
    sy0, sy1, sy2, sy3 = np.float32(sy[0]), np.float32(sy[1]), np.float32(sy[2]), np.float32(sy[3])
    vx0, vx1, vx2, vx3 = np.float32(vx[0]), np.float32(vx[1]), np.float32(vx[2]), np.float32(vx[3])
    sx0, sx1, sx2, sx3 = np.float32(sx[0]), np.float32(sx[1]), np.float32(sx[2]), np.float32(sx[3])
    value, slope = np.empty(nx, np.float32), np.empty(nx, np.float32)
    zero = np.float32(0.0)
    sums = np.zeros(15)
    for y in range(max(0, 1 - row_shift), min(ny, ny - 2 - row_shift)):
        row = y + row_shift
        t0, t1, t2, t3 = template[row - 1], template[row], template[row + 1], template[row + 2]
        for x in range(nx):
            value[x] = vy0 * t0[x] + vy1 * t1[x] + vy2 * t2[x] + vy3 * t3[x]
            slope[x] = sy0 * t0[x] + sy1 * t1[x] + sy2 * t2[x] + sy3 * t3[x]
        line, weights = frame[y], weight[y + near_y]
        n = s_t = s_y = s_x = s_f = tt = ft = ty = tx = yy = yx = xx = fy = fx = ff = zero
        for x in range(first, last):
            c = x + column_shift
            w, f = weights[x + near_x], line[x]
            t = vx0 * value[c - 1] + vx1 * value[c] + vx2 * value[c + 1] + vx3 * value[c + 2]
            gx = sx0 * value[c - 1] + sx1 * value[c] + sx2 * value[c + 1] + sx3 * value[c + 2]
            gy = vx0 * slope[c - 1] + vx1 * slope[c] + vx2 * slope[c + 1] + vx3 * slope[c + 2]
            wt, wy, wx, wf = w * t, w * gy, w * gx, w * f
            n += w
            s_t += wt
            s_y += wy
            s_x += wx
            s_f += wf
            tt += wt * t
            ft += wf * t
            ty += wt * gy
            tx += wt * gx
            yy += wy * gy
            yx += wy * gx
            xx += wx * gx
            fy += wf * gy
            fx += wf * gx
            ff += wf * f
        for k, item in enumerate((n, s_t, s_y, s_x, s_f, tt, ft, ty, tx, yy, yx, xx, fy, fx, ff)):
            sums[k] += item
    return sums
