"""Images as grey levels: which counts are black and white, and the means of blocks of pixels."""

from __future__ import annotations

from typing import Any

import numpy as np

CONTRAST = (0.5, 99.5)
"""Percentiles of the known pixels that are black and white where it is not said what should be."""

TRANSPARENT, BLACK, WHITE = 0, 1, 255


def contrast(image: np.ndarray[Any, Any]) -> tuple[float, float]:
    """Return the counts of an image that are black and white; NaN are no pixels."""
    known = image[np.isfinite(image)]
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, CONTRAST)
    return float(low), float(high)


def grey_levels(
    image: np.ndarray[Any, Any], low: float | None = None, high: float | None = None
) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return values as grey levels: 1 at ``low`` and below, 255 at ``high`` and above, 0 where there is no value.

    Parameters
    ----------
    low, high
        Counts that are black and white; None: those of :func:`contrast`.
    """
    known = np.isfinite(image)
    usual = contrast(image) if low is None or high is None else (0.0, 1.0)
    black, white = (usual[0] if low is None else low), (usual[1] if high is None else high)
    span = white - black if white - black > np.finfo(np.float32).tiny else 1.0
    with np.errstate(over="ignore"):  # it is clipped
        share = (np.where(known, image, 0) - black) / span
    level = BLACK + np.rint((WHITE - BLACK) * np.clip(share, 0, 1))
    return np.where(known, level, TRANSPARENT).astype(np.uint8)


def block_means(image: np.ndarray[Any, Any], step: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the means of the known pixels in blocks of ``step`` x ``step``, NaN where a block has none.

    Blocks at the right and the bottom may be smaller.
    """
    known = np.isfinite(image)
    total, count = (_block_sums(part, step) for part in (np.where(known, image, 0), known))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _block_sums(image: np.ndarray[Any, Any], step: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    ny, nx = (-(-size // step) for size in image.shape)
    whole = np.zeros((ny * step, nx * step), image.dtype)
    whole[: image.shape[0], : image.shape[1]] = image
    rows = whole.reshape(ny, step, nx * step).sum(axis=1, dtype=np.float64)
    return np.asarray(rows.reshape(ny, nx, step).sum(axis=2))
