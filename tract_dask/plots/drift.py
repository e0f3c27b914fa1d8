"""The drift of the frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from .base import (
    LINES,
    PAGE_INCHES,
    SIZE_MAP,
    SMALL,
    colour_bar,
    course,
    draw_course,
    graph,
    legend,
    new_figure,
    save,
    time_of,
    title,
)

_PATH_POINTS = 1000
_FAR_PM = 1000.0
"""A drift beyond this is drawn in nm."""


def plot_drift(drift: xr.Dataset, path: str | Path | None = None) -> Figure:
    """Draw the drift of every frame along both axes in time, and its path in the plane.

    Parameters
    ----------
    drift
        From :func:`tract_dask.estimate_drift`, or tracks, which hold the drift as the columns refined it, and the time.
        In pm or nm where the attribute ``pixel_size_pm`` is known, in px elsewhere.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.
    """
    size = drift.attrs.get("pixel_size_pm")
    shift = drift["drift"].transpose("frame", "axis").to_numpy() * (size or 1.0)
    far = bool(size) and float(np.nanmax(np.abs(shift), initial=0)) > _FAR_PM
    unit = ("nm" if far else "pm") if size else "px"
    shift = shift / 1000 if far else shift
    time, time_label = time_of(drift)
    figure = new_figure(PAGE_INCHES, 2.6)
    course_axes, plane = figure.subplots(1, 2, width_ratios=(1.7, 1))
    for name, values, colour in zip(("y, down", "x, right"), shift.T, LINES[:2], strict=True):
        draw_course(course_axes, course(time, values), colour, name)
    graph(course_axes, time_label, f"Drift ({unit})")
    legend(course_axes, ncols=2, loc="lower left", bbox_to_anchor=(0.3, 0.98), borderaxespad=0)
    title(course_axes, "a")
    step = -(-len(time) // _PATH_POINTS)
    places, when = shift[::step, ::-1], time[::step]
    norm = Normalize(float(time[0]), float(time[-1]) if len(time) > 1 else float(time[0]) + 1)
    known = np.isfinite(places).all(axis=1)
    places, when = places[known], when[known]
    line = LineCollection(list(np.stack([places[:-1], places[1:]], axis=1)), cmap=SIZE_MAP, norm=norm, linewidths=1.1)
    line.set_array(when[:-1])
    plane.add_collection(line)
    plane.plot(*places[:1].T, "o", color="black", ms=4)
    plane.annotate("start", places[0] if len(places) else (0, 0), (4, 4), textcoords="offset points", fontsize=SMALL)
    plane.set_aspect("equal", adjustable="datalim")
    plane.margins(0.08)
    plane.autoscale_view()
    plane.invert_yaxis()
    graph(plane, f"x ({unit})", f"y ({unit})")
    title(plane, "b", "Path of the specimen")
    colour_bar(plane, norm, SIZE_MAP, time_label)
    return save(figure, path)
