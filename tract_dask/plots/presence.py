"""Which columns are there, in time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ..analysis.presence import looked, present
from ..kernels.gaussian.intensity import Floats
from .base import LINES, PAGE_INCHES, colour_bar, graph, legend, new_figure, save, time_of

_THERE = LinearSegmentedColormap.from_list("there", ["#e6e6e6", LINES[0]])
_UNSEEN = "#f2d9a6"
"""Where a column was not looked at."""
_MOST_COLUMNS = 1200
"""Of the raster along time: more frames are drawn as the share of each run in which the column is there."""


def plot_presence(
    tracks: xr.Dataset,
    path: str | Path | None = None,
    *,
    false_alarm_rate: float = 0.01,
    events: xr.Dataset | None = None,
) -> Figure:
    """Draw in which frames each column is there, not there, or not looked at, a row for each.

    Parameters
    ----------
    tracks
        Results, with ``presence``.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.
    false_alarm_rate
        Share of the frames in which a place without a column would be taken for one.
    events
        From :func:`tract_dask.analysis.presence.appearances`: when columns appear and vanish.

    Raises
    ------
    SettingsError
        Where the tracks do not tell who is there, or the rate is out of range.
    """
    time, time_label = time_of(tracks)
    run = -(-len(time) // _MOST_COLUMNS)
    there = present(tracks, false_alarm_rate).where(looked(tracks)).transpose("column_id", "frame").astype(np.float32)
    share = there.coarsen(frame=run, boundary="pad").mean().to_numpy()
    ids = tracks["column_id"].to_numpy()
    figure = new_figure(PAGE_INCHES, float(np.clip(0.8 + 0.1 * len(ids), 1.8, 6.0)))
    axes = figure.subplots()
    norm = Normalize(0, 1)
    edges = _edges(time[::run], time[-1] + (time[-1] - time[0]) / max(len(time) - 1, 1))
    axes.set_facecolor(_UNSEEN)
    axes.pcolormesh(edges, np.arange(len(ids) + 1) - 0.5, share, cmap=_THERE, norm=norm, rasterized=True)
    if events is not None:
        when = edges[np.searchsorted(tracks["frame"].to_numpy()[::run], events["frame"].to_numpy(), side="right") - 1]
        rows = np.searchsorted(ids, events["column_id"].to_numpy())
        kinds = events["kind"].to_numpy().astype(str)
        for kind, marker in (("appears", "^"), ("vanishes", "v")):
            some = kinds == kind
            style: dict[str, Any] = {"color": LINES[1], "mec": "white", "mew": 0.6, "ms": 6, "clip_on": False}
            axes.plot(when[some], rows[some], marker, ls="", label=kind, **style)
    marks = axes.get_legend_handles_labels()[0]
    if run == 1:
        marks = [Patch(color=_THERE(1.0), label="there"), Patch(color=_THERE(0.0), label="not there"), *marks]
    if np.isnan(share).any():
        marks.append(Patch(color=_UNSEEN, label="not looked at"))
    else:
        colour_bar(axes, norm, _THERE, f"Share of {run} frames with the column")
    legend(axes, handles=marks, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, borderaxespad=0.1)
    step = max(1, len(ids) // 20)
    axes.set_yticks(np.arange(0, len(ids), step), [str(column) for column in ids[::step]])
    axes.set(xlim=(edges[0], edges[-1]), ylim=(len(ids) - 0.5, -0.5))
    graph(axes, time_label, "Column")
    return save(figure, path)


def _edges(starts: Floats, end: float) -> Floats:
    """Return the limits of runs that begin at ``starts``."""
    return np.append(starts, end)
