"""The picture of the columns that a run leaves beside their table."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from ..store import disk


def draw_columns(summed: xr.Dataset, columns: xr.Dataset, figure: Path) -> None:
    """Draw the columns beside the place of their figure, then put them there, so that a figure is always whole."""
    from ..plots.columns import plot_columns  # matplotlib takes its time, and not every run draws

    partial_figure = disk.aside(figure, suffix=figure.suffix)
    plot_columns(summed, columns, partial_figure)
    partial_figure.replace(figure)
