"""The noise where a column is.

The noise of counts grows with their level, and the crystal may be brighter or darker than the vacuum in which the noise
is measured.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...kernels.gaussian.intensity import Floats
from ...kernels.gaussian.parameters import BACKGROUND
from ...settings.run import FitSettings
from .common_motion import masked_median

_FARTHEST = 100.0
"""Levels that differ by more than this factor do not tell each other's noise: a background was subtracted."""


class Vacuum(NamedTuple):
    """What the vacuum of some frames shows, (frames,): standard deviation and mean of its blurred pixels."""

    noise: Floats
    level: Floats


def noise_at_columns(vacuum: Vacuum, estimates: Floats, reference: Floats, settings: FitSettings) -> Floats:
    """Return the noise at each column's background, (frames, columns), by the law that variance grows as the level.

    Parameters
    ----------
    vacuum
        Of the same frames, with the blur that the noise is meant for.
    estimates
        (frames, columns, 7) fits. What all their backgrounds have in common is the brightness of a frame.
    reference
        (columns, 7) fits on the summed image: their backgrounds are the levels.
    settings
        Without ``counting``, or with a filter of whole frames, the noise is the same everywhere.

    Returns
    -------
    Floats
        NaN where the levels do not tell the noise: one is not above 0, or more than 100 times the other.
    """
    if settings.filters_frames or not settings.counting:
        return np.repeat(vacuum.noise[:, None], len(reference), axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = reference[:, BACKGROUND] * brightness(estimates, reference)[:, None] / vacuum.level[:, None]
        known = (share > 1 / _FARTHEST) & (share < _FARTHEST) & (vacuum.level[:, None] > 0)
        return vacuum.noise[:, None] * np.sqrt(np.where(known, share, np.nan))


def brightness(estimates: Floats, reference: Floats) -> Floats:
    """Return how bright each frame is against the summed image, (frames,): the median share of the backgrounds."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = estimates[..., BACKGROUND] / reference[:, BACKGROUND]
    common = masked_median(share, np.isfinite(share))
    return np.where(common > 0, common, 1.0)


def noise_without_vacuum(residual: Floats, reference: Floats, settings: FitSettings) -> Floats:
    """Return the noise at each column, (frames, columns), from the median residual of the frames' fits (frames,)."""
    level = reference[:, BACKGROUND]
    counted = settings.counting and not settings.filters_frames and (level > 0).all()
    share = np.sqrt(level / np.median(level)) if counted else np.ones(len(level))
    return np.asarray(residual[:, None] * share)
