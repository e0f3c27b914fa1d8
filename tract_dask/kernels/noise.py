"""The noise of a camera from differences of successive frames: its size at each level, and how pixels share it.

A camera that gives G detector units an electron, on an offset o and with read noise r (rms, in detector units), has
noise whose variance is G (m - o) + r^2 = G (m - z) where the mean is m: a straight line that is zero at z = o - r^2 / G
(J. R. Janesick, Photon Transfer, 2007). Half the variance of the difference of two frames is that variance, whatever
the specimen looks like, as long as it keeps still. What moves adds its slope squared times a variance of places, so
pixels are sorted by level and slope, and both are fitted together.

A detector that spreads an electron over several pixels makes neighbours share noise: the variance of a pixel falls,
and the sum of the autocorrelation over all lags says how far. Sums of many pixels have the variance of electrons.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Frames = NDArray[np.float32]

LEVELS, SLOPES = 16, 4
"""Groups of pixels by their level, and of each by its slope."""
_CLIPPED = 6.0
"""Differences beyond so many standard deviations are left out: something happened there."""


_USUAL_MOTION_PX2 = 0.15
"""Variance of places that columns rarely exceed."""


_DOUBT = 0.3
"""Share of what motion adds that slopes may not explain."""


class Cells(NamedTuple):
    """What groups of pixels of like level and slope have in common, each (cells,)."""

    level: Floats
    """Mean of the frames, detector units."""
    slope: Floats
    """Mean square of the slope of the mean image, (detector units / px)^2."""
    variance: Floats
    """Half the mean square of the differences of successive frames, (detector units)^2."""
    third: Floats
    """Third moment of the frames about the mean image, (detector units)^3."""
    number: Floats
    """Differences that went in."""

    @classmethod
    def joined(cls, parts: list[Cells]) -> Cells:
        """Return the cells of several parts as one list."""
        return cls(*(np.concatenate(values) for values in zip(*parts, strict=True)))


class Law(NamedTuple):
    """The line variance = per_count (mean - zero), and what its points say of how sure it is."""

    per_count: float
    """Variance for a detector unit of the mean, detector units."""
    per_count_stderr: float
    zero: float
    """Level at which the line is zero, detector units."""
    zero_stderr: float
    motion: float
    """Variance of places that explains what is more where the image is steep, px^2."""


def gather(frames: Frames, differences: Frames, level: Frames, slope: Frames, usable: NDArray[np.bool_]) -> Cells:
    """Return the cells of a field.

    Parameters
    ----------
    frames, differences
        (f, y, x) at the places of the mean image, and (f - 1, y, x) of successive ones.
    level, slope
        (y, x) of the mean image, smoothed; the slope squared.
    usable
        (y, x) pixels that count.
    """
    chosen = np.flatnonzero(usable)
    count = max(1, min(LEVELS * SLOPES, chosen.size // 64))
    levels = max(1, count // SLOPES)
    by_level = chosen[np.argsort(level.ravel()[chosen], kind="stable")]
    cells = []
    flat, moved = frames.reshape(len(frames), -1), differences.reshape(len(differences), -1)
    for group in np.array_split(by_level, levels):
        by_slope = group[np.argsort(slope.ravel()[group], kind="stable")]
        for cell in np.array_split(by_slope, min(SLOPES, count)):
            values, jumps = flat[:, cell].astype(np.float64), moved[:, cell].astype(np.float64)
            for _ in range(2):
                near = np.abs(jumps) <= _CLIPPED * jumps.std() if jumps.size else np.zeros(jumps.shape, bool)
                jumps = np.where(near, jumps, 0.0)
            n = len(frames)
            about = values - values.mean(axis=0)
            unbiased = n**2 / max(1, (n - 1) * (n - 2))
            cells.append(
                (
                    values.mean(),
                    slope.ravel()[cell].mean(dtype=np.float64),
                    (jumps**2).sum() / max(1, near.sum()) / 2,
                    (about**3).mean() * unbiased,
                    near.sum(),
                )
            )
    return Cells(*np.array(cells, np.float64).reshape(-1, 5).T)


def fit_law(cells: Cells) -> Law | None:
    """Return the line that fits the cells; None where they do not tell: too few, one level, or no line through them.

    Errors are those of the cells' scatter, where that is more than chance.
    """
    known = (cells.number > 0) & (cells.variance > 0)
    level, slope, variance, count = (values[known] for values in (*cells[:3], cells.number))
    if level.size < 6 or np.ptp(level) <= 0:
        return None
    centre, width = level.mean(), np.ptp(level)
    steep = max(float(slope.max()), np.finfo(float).tiny)
    design = np.stack([(level - centre) / width, np.ones(level.size), slope / steep], axis=1)
    fit = _robust_line(design, variance, count, _USUAL_MOTION_PX2 * steep)
    if fit is None or fit[0][0] <= 0:
        return None
    (by_level, middle, moving), covariance = fit
    per_count = by_level / width
    of_zero = np.array([middle / by_level, -1.0]) / per_count  # its derivatives, by the line's slope and middle
    return Law(
        per_count=float(per_count),
        per_count_stderr=float(np.sqrt(covariance[0, 0]) / width),
        zero=float(centre - middle / per_count),
        zero_stderr=float(np.sqrt(of_zero @ covariance[:2, :2] @ of_zero)),
        motion=max(0.0, float(moving / steep)),
    )


def _robust_line(design: Floats, variance: Floats, count: Floats, usual: float) -> tuple[Floats, Floats] | None:
    """Return coefficients and their covariance: cells far off the line weigh less, by Huber's rule.

    The last coefficient is 0 within ``usual`` unless the cells know better, for levels and slopes go together.
    """
    doubt, expected, trust, prior = 0.0 * variance, variance, np.ones(variance.size), np.array([[0.0, 0.0, 1 / usual]])
    for _ in range(6):
        weight = np.sqrt(trust / (2 / count * expected**2 + doubt**2))
        rows = np.concatenate([design * weight[:, None], prior])
        found, *_ = np.linalg.lstsq(rows, np.append(variance * weight, 0.0), rcond=None)
        fitted = design @ found
        if (fitted <= 0).all():
            return None
        expected = np.maximum(fitted, 0.05 * np.median(variance))
        doubt = _DOUBT * max(0.0, float(found[2])) * design[:, 2]
        off = np.abs(variance - fitted) / np.sqrt(2 / count * expected**2 + doubt**2)
        trust = np.minimum(1.0, 3 * max(1.0, 1.5 * float(np.median(off))) / np.maximum(off, 1e-9))
    left = (fitted - variance) * weight
    scatter = max(1.0, float((left**2).sum()) / max(1, variance.size - 3))
    return found, np.linalg.pinv(rows.T @ rows) * scatter


class Lags(NamedTuple):
    """Sums of products of pixels by their distance, of one field or of several."""

    products: Floats
    """(2 r + 1, 2 r + 1) sum of products at each lag, the lag 0 in the middle."""
    pairs: Floats
    """(2 r + 1, 2 r + 1) pixels that have one at that lag."""
    mean_of: float
    """Pixels of which the mean was taken away together."""


_LEAST_SHARED = 0.01
"""Columns that move make neighbours alike by less than this, but over their whole width: added up over some hundred
pixels it would be half of the noise. Of a detector with a spread of 0.5 to 2 px it cuts off at most 2 % of the sum."""


def lag_sums(differences: Frames, usable: NDArray[np.bool_], reach: int) -> Lags:
    """Return the sums of products of differences (f, y, x), already divided by their size, at lags up to ``reach``."""
    shape = tuple(-(-(side + reach) // 16) * 16 for side in usable.shape)
    mask = usable.astype(np.float32)
    per = max(1.0, float(mask.sum()))
    power = np.zeros((shape[0], shape[1] // 2 + 1))
    for one in differences:
        own = one * mask
        own = (own - own.sum(dtype=np.float64) / per) * mask
        spectrum = np.fft.rfft2(own, shape)
        power += spectrum.real**2 + spectrum.imag**2
    seen = np.fft.rfft2(mask, shape)
    counted = seen.real**2 + seen.imag**2
    lags = [np.roll(np.fft.irfft2(values, shape), (reach, reach), (0, 1)) for values in (power, counted)]
    products, pairs = (values[: 2 * reach + 1, : 2 * reach + 1] for values in lags)
    return Lags(products, np.rint(pairs) * len(differences), per)


def correlation(fields: list[Lags]) -> tuple[Floats, float]:
    """Return the autocorrelation of the noise (2 r + 1, 2 r + 1), cut to where it is known, and its standard error.

    A detector's spread falls off with distance: rings whose mean is no larger than chance, or than what columns leave
    that move by themselves, end it, and no ring is above the one inside it. ``[[1.0]]`` where neighbours share nothing.
    """
    products = np.sum([f.products for f in fields], axis=0)
    pairs = np.maximum(1.0, np.sum([f.pairs for f in fields], axis=0))
    reach = len(products) // 2
    covariance = products / pairs
    found = covariance / covariance[reach, reach]
    area = float(np.average([f.mean_of for f in fields], weights=[f.pairs[reach, reach] for f in fields]))
    found = found + (found.sum() / max(1.0, area - found.size) if area > 2 * found.size else 0.0)
    found /= found[reach, reach]
    error = float(1 / np.sqrt(pairs[reach, reach]))
    lag = np.arange(-reach, reach + 1)
    ring = np.rint(np.hypot(lag[:, None], lag)).astype(int)
    kept, last = np.where(ring == 0, 1.0, 0.0), 1.0
    for radius in range(1, reach + 1):
        here = ring == radius
        mean, chance = float(found[here].mean()), 4 * error / np.sqrt(here.sum() / 2)
        if abs(mean) <= max(chance, _LEAST_SHARED) or mean > last:
            break
        kept[here] = found[here] if radius <= 2 else mean
        last = mean
    used = int(np.abs(lag[(kept != 0).any(axis=0)]).max())
    middle = slice(reach - used, reach + used + 1)
    return kept[middle, middle], error
