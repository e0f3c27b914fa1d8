"""Rows of a scanned frame that are displaced along x: how far, and where columns are without that.

A pixel tells the offset of its row by the slope of the columns there. Columns that one row meets share its offset, and
a column shares its own displacement with all rows that it is seen in, so that offsets of neighbouring rows are not
independent. All of this is one set of linear equations a frame, with a band as wide as a column is high:

    measured offset = offset of the row + displacement of the column + noise

An offset is a fast part, different in every row, and a slow one, whose neighbouring values are alike (Ornstein and
Uhlenbeck, Phys. Rev. 36, 823, 1930). Displacements are from a normal distribution. How large all of these are, and the
noise, is estimated from the frame itself.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, THETA, X, Y

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Numbers = NDArray[np.int64]

_ROUNDS = 20
_REACH = 3.0
"""Columns are drawn so many sigmas far."""
_NARROWEST = 0.1
"""Share of its variance that a column keeps at least without the offsets of rows."""
_DIMMEST = 0.01
"""Pixels are no less noisy than those of this share of the brightest."""
_FAINT = 1e-4
"""Rows of a window with a smaller share of what the best one tells do not count."""
_ASTRAY = 5.0
"""A column so many standard deviations from its place does not say where it belongs."""
_LEAST_OWN = 0.1
"""Columns are displaced by this share of their error at least: equations need a number."""
_LEAST_OFFSET = 1e-3
"""Offsets are so large at least, px."""
_HEIGHT = 2.355
"""Slow offsets are alike over so many sigmas of a column: what changes faster is seen inside of columns."""
_MEDIAN_SQUARE = 0.4549
"""Median of the square of a normal number."""


class Rows(NamedTuple):
    """Displaced rows of a frame.

    Attributes
    ----------
    offset, variance
        (rows,) px along x, and the square of its error; NaN where a frame does not tell.
    x, x_variance
        (columns,) where columns are in the frame without the offsets, and the square of its error, px; NaN for those
        that are not known.
    """

    offset: Floats
    variance: Floats
    x: Floats
    x_variance: Floats


def displaced_rows(image: Floats, columns: Floats, home: Floats, size: int, *, counting: bool) -> Rows:
    """Return by how much the rows of a frame are displaced, and where its columns are without that.

    Parameters
    ----------
    image
        (ny, nx); NaN where a pixel is missing.
    columns
        (n, 7) of Equation 1, where the frame shows them, and as wide; NaN for those that are not known.
    home
        (n,) x where they belong in this frame, px; NaN: not known, for columns that do not tell of slow offsets.
    size
        Diameter of the windows whose pixels tell, px.
    counting
        Whether pixels have the noise of counts; otherwise all have the same.

    Notes
    -----
    Gauss-Newton steps towards the most probable offsets and displacements. Offsets have the errors of the whole set of
    equations. Where a column is, the pixels of its window tell together with the offsets that the other columns know,
    and not how far columns usually are displaced.
    """
    known = np.flatnonzero(np.isfinite(columns).all(axis=1))
    x, x_variance = np.full((2, len(columns)), np.nan)
    if np.isfinite(home[known]).sum() < 2:
        nothing = np.full(image.shape[0], np.nan)
        return Rows(nothing, nothing, x, x_variance)
    frame = _Frame(image, columns[known], home[known], size, counting)
    for _ in range(_ROUNDS):
        frame.step()
    x[known], x_variance[known] = frame.home + frame.alone, frame.alone_variance
    return Rows(frame.offset, frame.variance, x, x_variance)


class _Windows(NamedTuple):
    """Pixels about columns: rows and columns of the image (n, side), which of them there are, and which tell."""

    y: Numbers
    x: Numbers
    there: Bools
    telling: Bools

    @classmethod
    def about(cls, columns: Floats, image: Floats, size: int) -> _Windows:
        reach = max(int(np.ceil(_REACH * np.median(columns[:, SIGMA_A]))), size // 2)
        along = np.arange(-reach, reach + 1)
        middle = np.rint(columns[:, [Y, X]]).astype(np.int64)
        y, x = (middle[:, k, None] + along for k in (0, 1))
        inside = ((y >= 0) & (y < image.shape[0]))[:, :, None] & ((x >= 0) & (x < image.shape[1]))[:, None]
        y, x = np.clip(y, 0, image.shape[0] - 1), np.clip(x, 0, image.shape[1] - 1)
        telling = inside & np.isfinite(image[y[:, :, None], x[:, None]])
        return cls(y, x, inside, telling & (np.hypot(along[:, None], along) <= size / 2))

    def drawn(self, values: Floats, shape: tuple[int, ...]) -> Floats:
        """Return the image of the sums of values (n, side, side)."""
        at = (self.y[:, :, None] * shape[1] + self.x[:, None])[self.there]
        return np.asarray(np.bincount(at, values[self.there], shape[0] * shape[1]).reshape(shape), np.float64)


class _Shapes(NamedTuple):
    """Columns as Gaussians with covariances [[xx, xy], [xy, yy]] (n,), px^2, at x and y, px."""

    amplitude: Floats
    x: Floats
    y: Floats
    xx: Floats
    xy: Floats
    yy: Floats

    @classmethod
    def of(cls, columns: Floats, x: Floats, wider: float) -> _Shapes:
        """Return those of Equation 1 at other x, with more variance along x, and the same volumes."""
        amplitude, y, sigma_a, sigma_b, theta = columns[:, [AMPLITUDE, Y, SIGMA_A, SIGMA_B, THETA]].T
        a, b, cosine, sine = sigma_a**2, sigma_b**2, np.cos(theta), np.sin(theta)
        yy, xy = a * sine**2 + b * cosine**2, (b - a) * sine * cosine
        area = np.maximum(a * b + wider * yy, _NARROWEST * a * b)
        return cls(amplitude * np.sqrt(a * b / area), x, y, (area + xy**2) / yy, xy, yy)

    def seen(self, windows: _Windows, offset: Floats) -> tuple[Floats, Floats, Floats]:
        """Return heights in windows whose rows are displaced, slopes along x, and the slopes of more variance."""
        xx, xy, yy = (values[:, None, None] for values in (self.xx, self.xy, self.yy))
        dx = windows.x[:, None] - self.x[:, None, None] - offset[windows.y][:, :, None]
        dy = windows.y[:, :, None] - self.y[:, None, None]
        area = xx * yy - xy**2
        along, across = (yy * dx - xy * dy) / area, (xx * dy - xy * dx) / area
        height = self.amplitude[:, None, None] * np.exp(-0.5 * (dx * along + dy * across))
        return height, height * along, height * (along**2 - yy / area) / 2


class _Frame:
    """The state of the iteration: offsets of rows, displacements of columns, and how large they are."""

    def __init__(self, image: Floats, columns: Floats, home: Floats, size: int, counting: bool) -> None:
        self.image, self.columns, self.counting = image, columns, counting
        self.bound = np.isfinite(home)
        self.home = np.where(self.bound, home, columns[:, X])
        self.windows = _Windows.about(columns, image, size)
        self.own, self.offset = columns[:, X] - self.home, np.zeros(len(image))
        self.still = self.bound
        usual = 1.4826 * float(np.median(np.abs(self.own[self.bound] - np.median(self.own[self.bound]))))
        self.fast = self.slow = self.usual = max(usual, _LEAST_OFFSET)
        self.alike = float(np.exp(-1 / (_HEIGHT * np.median(columns[:, SIGMA_B]))))
        self.noise, self.wider = 1.0, 0.0

    def step(self) -> None:
        """Solve the equations where the state is now, then say anew how large its parts are."""
        told, weight = self._told()
        self._solve(told, weight)
        self._size_offsets(told, weight)
        self._size_displacements(weight)

    def _told(self) -> tuple[Floats, Floats]:
        """Return what each row of a column tells of its offset from the column's home, (n, side), and its weight."""
        shape, windows = self.image.shape, self.windows
        shapes = _Shapes.of(self.columns, self.home + self.own, self.wider)
        height, slope, growth = shapes.seen(windows, self.offset)
        near = np.maximum(height / shapes.amplitude[:, None, None], 1e-6)
        level = windows.drawn(near * self.columns[:, BACKGROUND, None, None], shape)
        model = windows.drawn(height, shape) + level / np.maximum(windows.drawn(near, shape), 1e-12)
        variance = np.maximum(np.abs(model), _DIMMEST * np.abs(model).max()) if self.counting else np.ones(shape)
        at = windows.y[:, :, None], windows.x[:, None]
        left, known = np.where(windows.telling, (self.image - model)[at], 0), np.where(windows.telling, 1, 0)
        self.wider += float((left * growth / variance[at]).sum() / (known * growth**2 / variance[at]).sum())
        weight = (known * slope**2 / variance[at]).sum(axis=2)
        weight[weight < _FAINT * weight.max()] = 0
        told = (left * slope / variance[at]).sum(axis=2) / np.where(weight > 0, weight, np.inf)
        return told + self.offset[windows.y] + self.own[:, None], weight / self.noise

    def _bonds(self) -> Floats:
        """Return 1 over the variances of displacements, (n,); 0 for columns that do not say where they belong."""
        return np.where(self.still, 1 / self.usual**2, 0.0)

    def _solve(self, told: Floats, weight: Floats) -> None:
        total = np.maximum(weight.sum(axis=1) + self._bonds(), 1e-300)
        pulled, y = weight * told, self.windows.y
        band = _prior(len(self.image), 2 * weight.shape[1], self.fast, self.slow, self.alike)
        right = np.zeros(len(band))
        _add(band, right, y, weight, pulled, total)
        solution, inverse = _solved(band, right)
        self.low, self.offset = solution[::2], solution[1::2]
        self.inverse, self.variance = inverse, inverse[1::2, 0]
        self.own = (pulled - weight * self.offset[y]).sum(axis=1) / total
        share = weight / total[:, None]
        low, high = np.minimum(y[:, :, None], y[:, None]), np.maximum(y[:, :, None], y[:, None])
        block = inverse[1::2, ::2][low, high - low]
        self.own_variance = 1 / total + np.einsum("nk,nkl,nl->n", share, block, share)

    def _size_offsets(self, told: Floats, weight: Floats) -> None:
        """Say how large noise and offsets are."""
        known = np.clip(1 - self.variance / (self.fast**2 + self.slow**2), 0, 1)
        left = told - self.offset[self.windows.y] - self.own[:, None]
        free = max(1.0, np.count_nonzero(weight) - known.sum() - len(self.own))
        self.noise *= float((weight * left**2).sum() / free)
        low, between = self.inverse[::2, 0], self.inverse[::2, 1]
        fast = (self.offset - self.low) ** 2 + self.variance + low - 2 * between
        self.fast, self.slow = (
            max(_LEAST_OFFSET, float(np.sqrt((known * square).sum() / max(known.sum(), 1e-12))))
            for square in (fast, self.low**2 + low)
        )

    def _size_displacements(self, weight: Floats) -> None:
        """Say where columns are by themselves, how far they are displaced, and which say where they belong."""
        self.alone_variance = 1 / np.maximum(1 / self.own_variance - self._bonds(), 1e-12)
        self.alone = self.alone_variance * self.own / self.own_variance
        alone, variance = self.alone[self.bound], self.alone_variance[self.bound]
        spread = 1.4826 * float(np.median(np.abs(alone - np.median(alone))))
        self.still = self.bound & (np.abs(self.alone) <= _ASTRAY * max(spread, 1e-9))
        alone, variance = self.alone[self.still], self.alone_variance[self.still]
        usual = np.median(alone**2) / _MEDIAN_SQUARE - np.median(variance)
        least = _LEAST_OWN**2 * np.median(1 / np.maximum(weight.sum(axis=1), 1e-12))
        self.usual = float(np.sqrt(max(usual, least)))


def _prior(height: int, size: int, fast: float, slow: float, alike: float) -> Floats:
    """Return the band (2 rows, size) of the inverse covariance of slow parts and offsets in turn, from its diagonal."""
    band = np.zeros((2 * height, size))
    scale = 1 / (slow**2 * (1 - alike**2))
    band[::2, 0] = scale * (1 + alike**2)
    band[[0, -2], 0] = scale
    band[:-2:2, 2] = -scale * alike
    band[:, 0] += 1 / fast**2
    band[::2, 1] = -1 / fast**2
    return band


@njit(cache=True, nogil=True)
def _add(band: Any, right: Any, y: Any, weight: Any, pulled: Any, total: Any) -> None:
    """Add what columns tell, whose own displacements are eliminated."""
    for n in range(len(y)):
        share = pulled[n].sum() / total[n]
        for i in range(y.shape[1]):
            if weight[n, i] > 0:
                right[2 * y[n, i] + 1] += pulled[n, i] - weight[n, i] * share
                band[2 * y[n, i] + 1, 0] += weight[n, i]
                for j in range(i, y.shape[1]):
                    if weight[n, j] > 0:
                        band[2 * y[n, i] + 1, 2 * (y[n, j] - y[n, i])] -= weight[n, i] * weight[n, j] / total[n]


@njit(cache=True, nogil=True)
def _solved(band: Any, right: Any) -> Any:
    """Return the solution of equations with a band, and the band of the inverse matrix.

    By L D L^T; the inverse from its end on (Takahashi, Fagan and Chin, Proc. 8th PICA Conf., 63, 1973).
    """
    height, size = band.shape
    factor, solution = band.copy(), right.copy()
    for i in range(height):
        most = min(size, height - i)
        for j in range(1, most):
            ratio = factor[i, j] / factor[i, 0]
            if ratio != 0:
                for k in range(j, most):
                    factor[i + j, k - j] -= ratio * factor[i, k]
                solution[i + j] -= ratio * solution[i]
        for j in range(1, most):
            factor[i, j] /= factor[i, 0]
    inverse = np.zeros_like(band)
    for i in range(height - 1, -1, -1):
        most = min(size, height - i)
        solution[i] /= factor[i, 0]
        for j in range(1, most):
            solution[i] -= factor[i, j] * solution[i + j]
            value = 0.0
            for k in range(1, most):
                low, high = min(j, k), max(j, k)
                value -= factor[i, k] * inverse[i + low, high - low]
            inverse[i, j] = value
        inverse[i, 0] = 1 / factor[i, 0]
        for k in range(1, most):
            inverse[i, 0] -= factor[i, k] * inverse[i, k]
    return solution, inverse
