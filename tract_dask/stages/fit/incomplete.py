"""Windows that miss pixels, fitted to those that are there (:mod:`tract_dask.stages.filled`).

Filled pixels bring no information, so the errors are those of the filled window times what is lost with the pixels
(:func:`.missing.widening`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.missing import widening
from ...kernels.gaussian.parameters import AMPLITUDE, X, Y
from ...kernels.windows import Tiles, gaussian_kernel
from ...settings.run import FitSettings
from ..filled import fill_windows
from .frame_fits import FrameFits

Bools = NDArray[np.bool_]

LARGEST_GROWTH = 3.0
"""A window is fitted while the error of its column's place grows by no more than this."""


def cut_raw(
    tiles: Tiles, frame: NDArray[np.int64], corner: NDArray[np.int64], side: int, gain: float
) -> NDArray[np.float32]:
    """Return square parts (n, side, side) of frames, times ``gain``; the edge pixel goes on beyond the frame.

    Parameters
    ----------
    frame, corner
        (n,) number of the frame among the tiles, and (n, 2) first row and column.
    """
    height, width = tiles.pixels.shape[2:]
    along = np.arange(side)
    y = np.clip(corner[:, :1] + along, 0, tiles.shape[0] - 1)[:, :, None]
    x = np.clip(corner[:, 1:] + along, 0, tiles.shape[1] - 1)[:, None, :]
    pixels = tiles.pixels[tiles.place[y // height, x // width], frame[:, None, None], y % height, x % width]
    counts: NDArray[np.float32] = np.multiply(pixels, np.float32(gain), dtype=np.float32)
    return counts


def fit_incomplete(
    raw: NDArray[np.float32],
    settings: FitSettings,
    fit: Callable[[NDArray[np.float32], NDArray[np.int64]], FrameFits],
    full_scale: float | None = None,
) -> tuple[FrameFits, Bools, Bools]:
    """Fit windows to the pixels that are there.

    Parameters
    ----------
    raw
        (n, side, side) pixels before the blur, with the margin that the blur reaches; NaN where missing, infinite where
        saturated.
    fit
        Fits blurred windows (m, h, w), which are those of these numbers (m,).
    full_scale
        What saturated pixels reach; None: they are as missing ones.

    Returns
    -------
    fits, missing, lost
        The fits, with errors as they are with the pixels that are there; (n,) whether a pixel of the round window is
        missing, and whether so many are that the column's place is not known.
    """
    margin = gaussian_kernel(settings.window_blur_px).size // 2
    size = raw.shape[-1] - 2 * margin
    inner = np.isfinite(raw[:, margin : margin + size, margin : margin + size])
    windows, moving = fill_windows(
        raw,
        settings.window_blur_px,
        lambda windows, numbers: fit(windows, numbers).estimates,
        full_scale=full_scale,
        counting=settings.counting,
        free=settings.shape == "free",
    )
    fits = fit(windows, np.arange(len(raw)))
    disc = np.hypot(*np.indices((size, size)) - size // 2) <= size / 2
    missing = np.invert(inner[:, disc].all(axis=1))
    factors, volume = widening(
        fits.estimates,
        inner,
        fixed_shape=settings.shape == "fixed",
        counting=settings.counting,
        likelihood=settings.estimator == "poisson",
    )
    lost: Bools = missing & (~(factors[:, [X, Y]].max(axis=1) <= LARGEST_GROWTH) | np.isin(np.arange(len(raw)), moving))
    grown = np.where(lost, np.nan, 1.0)[:, None] * factors
    fits.stderr[:] *= grown
    fits.volume_stderr[:] *= np.where(lost, np.nan, volume)
    fits.strength[:] /= grown[:, AMPLITUDE]
    share = disc.sum() / np.maximum(inner[:, disc].sum(axis=1), 1)  # what was filled has no residual
    fits.residual[:] *= np.sqrt(share)
    fits.ratio[:] *= share
    return fits, missing, lost
