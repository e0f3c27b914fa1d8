"""How large the disc is that a column is fitted in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...errors import SettingsError

SMALLEST_PX = 5


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
