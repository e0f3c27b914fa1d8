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

    distances = np.asarray(cKDTree(places).query(places, k=2)[0])
    return float(np.median(distances[:, 1])) or None


def default_window(spacing_px: float) -> int:
    """Return the diameter of a window, odd, for columns at this distance from their neighbours: half of it.

    On CeO2 in [110] it reaches the flanks of the oxygen columns, which lie at 0.42 of that distance.

    Examples
    --------
    >>> default_window(82.8)
    43
    """
    return max(7, 2 * round(0.25 * spacing_px) + 1)


def check_window(window_px: int, shape: tuple[int, ...], reason: str = "") -> int:
    """Return ``window_px`` if it is odd and fits into a frame of ``shape`` (y, x).

    Raises
    ------
    SettingsError
        Where it does not; ``reason`` says where it came from.
    """
    if window_px % 2 == 0 or not SMALLEST_PX <= window_px <= min(shape):
        raise SettingsError(
            "the window cannot be used",
            "setting window_px (FitSettings)",
            f"an odd number from {SMALLEST_PX} to {min(shape)}, the shorter side of a frame",
            f"{window_px}{reason}",
            "Give another window_px, or spacing_px if that spacing is wrong",
        )
    return window_px
