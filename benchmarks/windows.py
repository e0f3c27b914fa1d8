"""Windows with one column each, of which everything is known: truth, start, bounds, and the best precision possible.

Coordinates are pixels from the centre of a window's first pixel, parameters those of Equation 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tract_dask.kernels.gaussian.information import column_bounds
from tract_dask.kernels.gaussian.model import evaluate

Floats = NDArray[np.float64]

SIGMA_SHARE = (0.1, 0.17)
"""Range of the sigmas, as a share of the window's side."""

MAX_OFFSET_PX = 2.0
"""Farthest a column is from its window's centre, per axis."""

LOST_PX = 3.0
"""A fit that is farther than this from the truth, on either axis, has failed."""

_CHUNK = 200


@dataclass(frozen=True)
class Case:
    """A kind of window: its side in px, the mean peak of its column and its background in counts."""

    side: int
    peak: float
    background: float

    @property
    def name(self) -> str:
        """For tables: ``25 x 25, 20 on 20``."""
        return f"{self.side} x {self.side}, {self.peak:g} on {self.background:g}"


@dataclass(frozen=True)
class Windows:
    """Windows of one case.

    Attributes
    ----------
    counts
        (n, side, side) float32 Poisson counts.
    truth
        (n, 7).
    crlb
        (n, 2) Cramér-Rao bounds of the variances of x and y, all seven parameters being free.
    start, lower, upper
        (n, 7) start values and bounds, the same for all fitters.
    """

    case: Case
    counts: NDArray[np.float32]
    truth: Floats
    crlb: Floats
    start: Floats
    lower: Floats
    upper: Floats


def draw(case: Case, n: int, seed: int = 0) -> Windows:
    """Return ``n`` windows of a case: peaks within half of the mean, any orientation, any place near the centre."""
    rng = np.random.default_rng([seed, case.side, int(case.peak), n])
    centre, (narrow, wide) = (case.side - 1) / 2, (share * case.side for share in SIGMA_SHARE)
    truth = np.stack(
        [
            case.peak * rng.uniform(0.5, 1.5, n),
            centre + rng.uniform(-MAX_OFFSET_PX, MAX_OFFSET_PX, n),
            centre + rng.uniform(-MAX_OFFSET_PX, MAX_OFFSET_PX, n),
            rng.uniform(narrow, wide, n),
            rng.uniform(narrow, wide, n),
            rng.uniform(-np.pi / 4, np.pi / 4, n),
            np.full(n, case.background),
        ],
        axis=1,
    )
    y, x = np.mgrid[: case.side, : case.side]
    counts = np.empty((n, case.side, case.side), np.float32)
    crlb = np.empty((n, 2))
    for first in range(0, n, _CHUNK):
        part = slice(first, first + _CHUNK)
        counts[part] = rng.poisson(evaluate(truth[part], x, y))
        crlb[part] = np.transpose(column_bounds(truth[part], case.side)[:2])
    return Windows(case, counts, truth, crlb, *_guesses(case, counts))


def score(centres: Floats, fine: NDArray[np.bool_], windows: Windows) -> dict[str, float | None]:
    """Return how good the centres (n, 2), (x, y), of the first n windows are; of pairs (n, 2, 2).

    Returns
    -------
    dict
        ``success``: share of the fits that say they are ``fine`` and are within :data:`LOST_PX` of the truth;
        ``precision``: rms error of those against the square root of their mean Cramér-Rao bound; ``precision_sd``: the
        standard deviation that chance gives it (both None where all are lost); ``windows``: n.
    """
    n = len(centres)
    error = centres - windows.truth[:n, ..., 1:3]
    good = fine & np.all(np.abs(error).reshape(n, -1) < LOST_PX, axis=1)
    if not good.any():
        return {"success": 0.0, "precision": None, "precision_sd": None, "windows": n}
    precision = np.sqrt((error[good] ** 2).mean() / windows.crlb[:n][good].mean())
    return {
        "success": float(good.mean()),
        "precision": float(precision),
        "precision_sd": float(precision / np.sqrt(2 * error[good].size)),
        "windows": n,
    }


def _guesses(case: Case, counts: NDArray[np.float32]) -> tuple[Floats, Floats, Floats]:
    """Return start, lower and upper (n, 7).

    The starting sigmas differ a little: where they are equal the angle has no influence, and fitters that work on it
    stand still.
    """
    n, side = counts.shape[:2]
    pixels = counts.reshape(n, -1)
    centre, middle = (side - 1) / 2, side * sum(SIGMA_SHARE) / 2
    start = np.tile([0.0, centre, centre, 1.1 * middle, 0.9 * middle, 0.0, 0.0], (n, 1))
    start[:, 0] = pixels.max(axis=1) - pixels.min(axis=1)
    start[:, 6] = np.median(pixels, axis=1)
    reach = side / 4
    lower = [0.0, centre - reach, centre - reach, 1.0, 1.0, -np.pi / 4, 0.0]
    upper = [20 * case.peak + 100, centre + reach, centre + reach, side / 2, side / 2, np.pi / 4, 10 * case.background]
    return start, np.tile(lower, (n, 1)), np.tile(upper, (n, 1))
