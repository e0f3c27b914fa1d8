"""How large the disc is that a column is fitted in, and how wide the blur before."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ...errors import SettingsError
from ...kernels.gaussian.model import blurred
from ...kernels.gaussian.parameters import SIGMA_A, SIGMA_B
from ...kernels.windows import blur_variance

SMALLEST_PX = 5

BLUR_SHARE = 0.4
"""Of the columns' sigma: what the blur before a fit is where it is not set. Fits hardly feel it from 0.2 to 0.6."""

BLURS_PX = (0.5, 1.0, 2.0)
"""The blurs that are taken, or none. The largest is the paper's."""


def neighbour_distance(places: NDArray[np.float64]) -> float | None:
    """Return the median distance of places (n, 2) to their nearest neighbours, px; None where there is none."""
    if len(places) < 2:
        return None
    from scipy.spatial import cKDTree  # takes its time, and workers do not need it

    # A tree compares all places that are the same one with each other; as complex numbers they are sorted fast.
    pairs = np.ascontiguousarray(places, np.float64).view(np.complex128).ravel()
    found, back, count = np.unique(pairs, return_inverse=True, return_counts=True)
    apart = found.view(np.float64).reshape(-1, 2)
    nearest = np.zeros(len(apart))
    if len(apart) > 1:
        nearest[count == 1] = np.asarray(cKDTree(apart).query(apart[count == 1], k=2)[0]).reshape(-1, 2)[:, 1]
    return float(np.median(nearest[back])) or None


def default_window(spacing_px: float) -> int:
    """Return the diameter of a window, odd, for columns at this distance from their neighbours: half of it.

    On CeO2 in [110] it reaches the flanks of the oxygen columns, which lie at 0.42 of that distance.

    Examples
    --------
    >>> default_window(82.8)
    43
    """
    return max(7, 2 * round(0.25 * spacing_px) + 1)


def default_blur(sigma_px: float) -> float:
    """Return sigma of the blur, px, for columns of this sigma: of :data:`BLURS_PX` the nearest to 0.4 of it, or none.

    Examples
    --------
    >>> [default_blur(sigma) for sigma in (0.8, 1.2, 2.5, 5.0, 20.0)]
    [0.0, 0.5, 1.0, 2.0, 2.0]
    """
    suiting = BLUR_SHARE * sigma_px
    nearest = min(BLURS_PX, key=lambda blur: abs(math.log(blur / suiting)))
    return nearest if suiting > nearest / math.sqrt(2) else 0.0


def usual_sigma(fit: NDArray[np.float64], blur_sigma_px: float) -> float | None:
    """Return the median sigma of fits (n, 7) without the blur that the pixels had, px; None where there is none."""
    known = blurred(fit[np.isfinite(fit).all(axis=1)], -blur_variance(blur_sigma_px))
    return float(np.median(np.sqrt(known[:, SIGMA_A] * known[:, SIGMA_B]))) if len(known) else None


def resolve_blur(blur_sigma_px: float | None, columns: xr.Dataset) -> float:
    """Return sigma of the blur before the fit of these columns, px: what is given, or what suits their sigma.

    Columns know their sigma (attribute ``sigma_px``) from :func:`tract_dask.find_columns`. For others it is that of
    their fits, less the blur that these have had (``blur_sigma_px``). Columns without fits have the paper's blur.
    """
    if blur_sigma_px is not None:
        return blur_sigma_px
    sigma = columns.attrs.get("sigma_px")
    if sigma is None:
        sigma = usual_sigma(columns["fit_ref"].to_numpy().astype(np.float64), columns.attrs.get("blur_sigma_px", 0.0))
    return default_blur(sigma) if sigma else BLURS_PX[-1]


def resolve_window(window_px: int | None, shape: tuple[int, ...], spacing_px: float | None = None) -> int:
    """Return the diameter of the windows in frames of ``shape`` (y, x): ``window_px``, or what suits ``spacing_px``.

    Raises
    ------
    SettingsError
        Where it is even, too small or larger than the frame; or where neither is given.
    """
    if window_px:
        resolved, reason = window_px, ""
    elif spacing_px is not None:
        resolved, reason = default_window(spacing_px), f", from a spacing of {spacing_px:.4g} px"
    else:
        raise SettingsError(
            "one column alone does not tell how large its window should be",
            "setting window_px (FitSettings)",
            "two columns or more, or a window",
            "one column",
            "Give window_px",
        )
    if resolved % 2 == 0 or not SMALLEST_PX <= resolved <= min(shape):
        raise SettingsError(
            "the window cannot be used",
            "setting window_px (FitSettings)",
            f"an odd number from {SMALLEST_PX} to {min(shape)}, the shorter side of a frame",
            f"{resolved}{reason}",
            "Give another window_px, or spacing_px if that spacing is wrong",
        )
    return resolved
