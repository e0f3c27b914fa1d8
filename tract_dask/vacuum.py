"""Where the noise is measured: a region of vacuum in the summed image, given or found."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from .errors import SettingsError
from .kernels.filters import blur
from .schema import AMPLITUDE

_SHARES = (1 / 2, 1 / 3, 1 / 4, 1 / 6, 1 / 8)
_FLAT = 0.1
_MIN_SIDE_PX = 24


def find_vacuum(summed: xr.Dataset, columns: xr.Dataset, sigma: float) -> tuple[int, int, int, int] | None:
    """Return the largest flat square of the summed image as (y0, y1, x0, x1), or None where nothing is flat.

    Parameters
    ----------
    summed
        Summed image with its exposure (:data:`schema.SUM`); only pixels that every frame covers are looked at.
    columns
        The columns: their median amplitude is what flatness is held against.
    sigma
        Blur before the fit, in px; flatness is that of the blurred image.

    Notes
    -----
    Squares of a half down to an eighth of the frame's shorter side are tried, largest first. A square is vacuum when
    its standard deviation is at most a tenth of the columns' amplitude, and less than twice the smallest found.
    """
    image = np.asarray(summed["image"].to_numpy(), dtype=np.float64)
    exposure = summed["exposure"].to_numpy()
    covered = exposure == exposure.max()
    smooth = blur(image.astype(np.float32), sigma).astype(np.float64)
    smooth -= smooth.mean()
    amplitude = float(np.nanmedian(np.abs(columns["fit_ref"].to_numpy()[:, AMPLITUDE])))
    sides = [side for share in _SHARES if (side := int(share * min(image.shape))) >= _MIN_SIDE_PX]
    flattest = [_flattest(smooth, covered, side) for side in sides]
    best = min((spread for spread, _, _ in flattest), default=np.inf)
    for side, (spread, y, x) in zip(sides, flattest, strict=True):
        if spread <= _FLAT * amplitude and spread <= 2 * best:
            return y, y + side, x, x + side
    return None


def check_box(box: tuple[int, ...], shape: tuple[int, ...], drift: NDArray[np.float64]) -> None:
    """Check that a vacuum box stays inside the frame whatever the drift.

    Raises
    ------
    SettingsError
        Naming the first frame where it leaves.
    """
    where = "setting vacuum_box (FitSettings)"
    if len(box) != 4 or box[0] >= box[1] or box[2] >= box[3]:
        raise SettingsError(
            "this is not a box", where, "y0, y1, x0, x1 with y0 < y1 and x0 < x1", str(box), "Correct it"
        )
    shift = np.rint(drift).astype(int)
    inside = (
        (shift[:, 0] + box[0] >= 0)
        & (shift[:, 0] + box[1] <= shape[0])
        & (shift[:, 1] + box[2] >= 0)
        & (shift[:, 1] + box[3] <= shape[1])
    )
    if not inside.all():
        frame = int(np.argmin(inside))
        raise SettingsError(
            f"the vacuum box leaves frame {frame}, drifted by {shift[frame, 1]}, {shift[frame, 0]} px in x, y",
            where,
            f"a box inside {shape[0]} rows and {shape[1]} columns in every frame",
            str(box),
            "Move it inwards or make it smaller",
        )


def _flattest(smooth: NDArray[np.float64], covered: NDArray[Any], side: int) -> tuple[float, int, int]:
    """Return standard deviation and corner (y, x) of the flattest square of ``side`` px that lies in ``covered``."""
    origin = -(side // 2)
    mean = uniform_filter(smooth, side, mode="constant", origin=origin)
    square = uniform_filter(smooth**2, side, mode="constant", origin=origin)
    share = uniform_filter(covered.astype(np.float64), side, mode="constant", origin=origin)
    spread = np.sqrt(np.maximum(square - mean**2, 0))
    spread[share < 1 - 0.5 / side**2] = np.inf
    spread[smooth.shape[0] - side + 1 :] = np.inf
    spread[:, smooth.shape[1] - side + 1 :] = np.inf
    y, x = np.unravel_index(int(np.argmin(spread)), spread.shape)
    return float(spread[y, x]), int(y), int(x)
