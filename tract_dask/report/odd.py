"""Which columns are odd among the others: fits that leave far more than noise, and shapes that are far longer."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.special import bdtrc

from ..analysis.overview import UNLIKELY

UNLIKE, UNLIKE_OTHERS = 0.1, 5.0
"""A column is not one Gaussian where a larger share of its fits is unlike one, and larger by this factor than usual:
noise that is not as the fit takes it is so in all columns."""
LONG = 2.0
"""A column that is longer than the median one by this factor is more than one."""
BY_CHANCE = 0.01
"""Probability that chance names a column in a movie in which all are one Gaussian."""


def unlike_one(number: NDArray[np.int64], accepted: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which columns have too many fits that are unlike one Gaussian: more than chance has in any of them.

    Parameters
    ----------
    number, accepted
        (columns,) accepted fits that leave more than noise does once in a thousand fits, and all that were accepted.
    """
    share = number / np.maximum(accepted, 1)
    usual = float(np.median(share))
    chance = bdtrc(number - 1, accepted, min(UNLIKELY + usual, 1.0))
    return np.asarray((share > UNLIKE) & (share > UNLIKE_OTHERS * usual) & (chance < BY_CHANCE / len(number)))


def far_longer(tracks: xr.Dataset) -> NDArray[np.bool_]:
    """Return which columns, fitted alone, are far longer than usual: another column is half in their windows.

    Parameters
    ----------
    tracks
        With ``fit_ref``, and ``group`` where columns were fitted together: these do not count.
    """
    sigma = tracks["fit_ref"].sel(parameter=["sigma_a", "sigma_b"]).to_numpy().max(axis=1)
    alone = tracks["group"].to_numpy() == 0 if "group" in tracks else np.ones(len(sigma), np.bool_)
    return np.asarray(alone & (sigma > LONG * np.nanmedian(sigma))) if np.isfinite(sigma).any() else alone & False
