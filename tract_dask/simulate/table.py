"""The look-up table of a simulated thickness series, measured as the experiment is."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from ..analysis.lookup import look_up_table
from ..errors import SettingsError
from ..settings.run import FitSettings
from ..stages.columns.window_size import neighbour_distance
from ..store.columns import positions

_REACH = 2.0
"""In spacings: how far a column's neighbours may be away."""


def tabulate(
    series: xr.Dataset, settings: FitSettings | None = None, *, kind: str = "", contrast: str = "bright"
) -> xr.Dataset:
    """Measure the look-up table of a thickness series: what intensity a column of 1, 2, 3 ... atoms has.

    Measured are the columns of one kind that have a neighbour to the left, to the right and below, so that the sides of
    the block do not count, and its upper surface does.

    Parameters
    ----------
    series
        From :func:`tract_dask.simulate.thickness_series`.
    settings
        Those of the experiment's fit; see :func:`tract_dask.analysis.lookup.look_up_table`.
    kind
        The columns to measure; without it, the heaviest.
    contrast
        ``bright`` or ``dark`` columns; ``auto``: those of which more can be fitted.

    Returns
    -------
    Dataset
        As :func:`tract_dask.analysis.lookup.look_up_table`, with the attribute ``microscope``.

    Raises
    ------
    SettingsError
        Where there are no such columns, or none could be measured.
    """
    kinds = series["kind"].to_numpy()
    kind = kind or str(kinds[0])
    columns = series[["x_ref", "y_ref", "atoms"]].isel(column_id=kinds == kind)
    if not columns.sizes["column_id"]:
        raise SettingsError("there are no such columns", "tabulate: kind", ", ".join(dict.fromkeys(kinds)), kind)
    columns = columns.isel(column_id=_surrounded(positions(columns)))
    if not columns.sizes["column_id"]:
        raise SettingsError(
            f"no column of {kind} is away from the sides of the block",
            "tabulate",
            f"one or more, of {', '.join(dict.fromkeys(kinds))}",
            f"{int((kinds == kind).sum())} columns of {kind}",
            "Make the block larger",
        )
    scenes = [columns.isel(n_periods=k) for k in range(series.sizes["n_periods"])]
    table = look_up_table(series["image"], scenes, settings, contrast=contrast)
    return table.assign_attrs(microscope=series.attrs["microscope"])


def _surrounded(places: np.ndarray[Any, Any]) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Tell which places (n, (x, y)) have others within reach to the left, to the right and below."""
    spacing = neighbour_distance(places)
    if spacing is None:
        return np.zeros(len(places), dtype=bool)
    dx, dy = np.moveaxis(places[None] - places[:, None], -1, 0)
    near = np.hypot(dx, dy) < _REACH * spacing
    beside, below = near & (np.abs(dy) <= np.abs(dx)), near & (np.abs(dx) < dy)
    found: np.ndarray[Any, np.dtype[np.bool_]] = (
        (beside & (dx < 0)).any(axis=1) & (beside & (dx > 0)).any(axis=1) & below.any(axis=1)
    )
    return found
