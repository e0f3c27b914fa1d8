"""Sub-pixel fit of frames to a filtered mean of others, by least squares over the pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .registration import Floats, Image, fast_length, forward_fft, inverse_fft, spatial_frequency

PAD = 32
"""Zeros between the two edges of an image that a filter would otherwise join, px."""

EDGE = 2
"""Pixels along the edges of a template that are not compared: what the filter makes of them is not exact."""

_SAME_PLACE_PX = 0.75
_HALF_KNOWN = 0.5
_LEAST_KNOWN = 0.25


class Template:
    """The filtered mean of frames, sampled at every half pixel, so that a cubic reaches any point between.

    Parameters
    ----------
    total
        (y, x) sum of the frames, each less the movie's mean.
    exposure
        (y, x) how many frames cover each pixel.
    frequency, gain
        The filter: gain at spatial frequencies, cycles/px.

    Attributes
    ----------
    samples
        (2 y, 2, x): value [r, p, c] lies at row r / 2 and column c + p / 2.
    weight
        (y, x) 1 where at least half of the frames lie, 0 elsewhere.
    noise_passed
        Share of the power of white noise that the filter lets through.
    """

    def __init__(self, total: Image, exposure: Image, frequency: Floats, gain: Floats) -> None:
        ny, nx = total.shape
        n_frames = np.float32(max(1.0, float(exposure.max())))
        self.noise_passed = float(np.mean(np.interp(spatial_frequency(ny, nx), frequency, gain) ** 2))
        values, seen = (_filtered_at_half_pixels(image, frequency, gain) for image in (total, exposure))
        self.weight = (seen[::2, ::2] > _HALF_KNOWN * n_frames).astype(np.float32)
        values /= np.maximum(seen, _LEAST_KNOWN * n_frames)
        self.samples = np.ascontiguousarray(values.reshape(len(values), -1, 2).swapaxes(1, 2))


def _filtered_at_half_pixels(image: Image, frequency: Floats, gain: Floats) -> Image:
    """Return an image, zero beyond its edges, filtered and sampled twice as finely: (2 y, 2 x)."""
    ny, nx = (fast_length(side + PAD) for side in image.shape)
    spectrum = forward_fft(image, (ny, nx)) * np.interp(spatial_frequency(ny, nx), frequency, gain).astype(np.float32)
    finer = np.zeros((2 * ny, nx + 1), np.complex64)
    rows = np.flatnonzero(np.abs(np.fft.fftfreq(ny)) < 0.5)
    columns = slice(0, (nx + 1) // 2)
    finer[np.rint(np.fft.fftfreq(ny)[rows] * ny).astype(int), columns] = spectrum[rows, columns]
    finer *= np.float32(2.0)  # orthonormal transforms of four times as many points
    return inverse_fft(finer, (2 * ny, 2 * nx))[: 2 * image.shape[0], : 2 * image.shape[1]]


class Alignment(NamedTuple):
    """The sub-pixel shift of a frame: (dy, dx) in px, the correlation, and whether the fit converged.

    The correlation is Pearson's of template and frame after the template's filter, if the frame's noise is white.
    """

    dy: float
    dx: float
    correlation: float
    converged: bool


def align(
    frame: Image,
    template: Template,
    start: tuple[float, float],
    *,
    limit: float,
    tolerance: float = 0.01,
    max_iterations: int = 20,
) -> Alignment:
    """Fit the shift by least squares: minimise sum w (frame - a template(shifted) - b)^2 over dy, dx, a, b.

    Gauss-Newton: each step is one linear regression of the frame on the shifted template, its two derivatives and a
    constant. With white noise in the frame and little in the template its errors are at the Cramer-Rao bound. Which
    pixels are compared stays as it is while the shift changes by fractions of a pixel: steps would else not end.

    Parameters
    ----------
    limit
        A fit that goes further from its start than this has failed, px.
    tolerance
        Last step, px. Each step leaves less than a tenth of the one before.

    Returns
    -------
    Alignment
        At the start, not converged, where the fit fails.
    """
    place = round(start[0]), round(start[1])
    first = moments(frame, template.samples, template.weight, start, place)
    sums, (dy, dx) = first, start
    for _ in range(max_iterations):
        step_y, step_x = _step(sums)
        length = float(np.hypot(step_y, step_x))
        if not np.isfinite(length):
            break
        scale = min(1.0, 1.0 / length) if length > 0.0 else 1.0
        dy, dx = dy + scale * step_y, dx + scale * step_x
        if np.hypot(dy - start[0], dx - start[1]) > limit:
            break
        if length < tolerance:
            return Alignment(dy, dx, _filtered_correlation(sums, template.noise_passed), True)
        if max(abs(dy - place[0]), abs(dx - place[1])) > _SAME_PLACE_PX:
            place = round(dy), round(dx)
        sums = moments(frame, template.samples, template.weight, (dy, dx), place)
    return Alignment(*start, _filtered_correlation(first, template.noise_passed), False)


def correlation(sums: Floats) -> float:
    """Return Pearson's correlation of the frame with the shifted template from their moments; 0 where undefined."""
    n, t, f, tt, ft, ff = sums[0], sums[1], sums[4], sums[5], sums[6], sums[14]
    power = (tt - t * t / n) * (ff - f * f / n) if n > 0.0 else 0.0
    return float((ft - f * t / n) / np.sqrt(power)) if power > 0.0 else 0.0


def _filtered_correlation(sums: Floats, noise_passed: float) -> float:
    """Return the correlation that is left once a filter has taken a part of the power that is not the template's."""
    raw = correlation(sums)
    return raw / float(np.sqrt(raw**2 + (1.0 - raw**2) * noise_passed)) if raw else 0.0


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
def _cubic(t: float) -> tuple[Image, Image]:
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
    return value.astype(np.float32), slope.astype(np.float32)


@njit(cache=True, nogil=True, fastmath=True)
def moments(
    frame: Image, samples: NDArray[np.float32], weight: Image, shift: tuple[float, float], place: tuple[int, int]
) -> Floats:
    """Return the weighted sums of products that the regression of ``frame`` on the shifted template needs.

    With T the shifted template and Ty, Tx its derivatives: sums of 1, T, Ty, Tx, f, TT, fT, TTy, TTx, TyTy, TyTx,
    TxTx, fTy, fTx, ff, over the frame's pixels. Each has the weight of the template's pixel ``place`` away from it,
    whole pixels that are no further than 1 px from the shift. Samples and weight are as :class:`Template` has them:
    four successive samples along a row come in turn from one and the other half.
    """
    ny, nx = frame.shape
    row_shift, column_shift = int(np.floor(-2.0 * shift[0])), int(np.floor(-2.0 * shift[1]))
    vy, sy = _cubic(-2.0 * shift[0] - row_shift)
    vx, sx = _cubic(-2.0 * shift[1] - column_shift)
    sy, sx = sy * np.float32(2.0), sx * np.float32(2.0)  # samples lie half a pixel apart
    half, offset = (column_shift - 1) % 2, (column_shift - 1) // 2
    first = max(0, place[1] + EDGE)
    width = max(0, min(nx, nx + place[1] - EDGE) - first)
    here, after = first + offset, first + offset + half
    value, slope = np.empty((2, samples.shape[2]), np.float32), np.empty((2, samples.shape[2]), np.float32)
    zero = np.float32(0.0)
    sums = np.zeros(15)
    for y in range(max(0, place[0] + EDGE), min(ny, ny + place[0] - EDGE)):
        row = 2 * y + row_shift
        for p in range(2):
            t0, t1, t2, t3 = samples[row - 1, p], samples[row, p], samples[row + 1, p], samples[row + 2, p]
            v, s = value[p], slope[p]
            for x in range(v.size):
                v[x] = vy[0] * t0[x] + vy[1] * t1[x] + vy[2] * t2[x] + vy[3] * t3[x]
                s[x] = sy[0] * t0[x] + sy[1] * t1[x] + sy[2] * t2[x] + sy[3] * t3[x]
        v0, v1, s0, s1 = value[half, here:], value[1 - half, after:], slope[half, here:], slope[1 - half, after:]
        line, weights = frame[y, first:], weight[y - place[0], first - place[1] :]
        n = s_t = s_y = s_x = s_f = tt = ft = ty = tx = yy = yx = xx = fy = fx = ff = zero
        for x in range(width):
            w, f = weights[x], line[x]
            t = vx[0] * v0[x] + vx[1] * v1[x] + vx[2] * v0[x + 1] + vx[3] * v1[x + 1]
            gx = sx[0] * v0[x] + sx[1] * v1[x] + sx[2] * v0[x + 1] + sx[3] * v1[x + 1]
            gy = vx[0] * s0[x] + vx[1] * s1[x] + vx[2] * s0[x + 1] + vx[3] * s1[x + 1]
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
