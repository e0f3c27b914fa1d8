"""The figure of docs/performance.md: cost against number of columns, size of the window, length of the movie."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, PURPLE, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#666666"
"""Okabe and Ito's colours, which colour-blind readers can tell apart."""

STAGES = {"convert": BLUE, "drift": GREEN, "sum": PURPLE, "columns": GREY, "fit": ORANGE}
FITTERS = {
    "tract_dask lsq": (ORANGE, "o", "tract_dask, least squares"),
    "tract_dask poisson": (BLUE, "s", "tract_dask, Poisson likelihood"),
    "picasso lsq guess": (GREEN, "^", "picasso, least squares"),
    "scipy trf": (GREY, "D", "scipy trf with bounds"),
}

_STYLE: Any = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "axes.grid": True,
    "grid.color": "#E5E5E5",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "lines.markersize": 4.5,
}


def draw(sections: Mapping[str, Any], path: Path) -> None:
    """Write the figure of the sections kernel, stages and runs."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(10.5, 3.6), layout="constrained")
        columns, windows, frames = figure.subplots(1, 3)
        cost_of_columns(columns, sections["stages"])
        cost_of_windows(windows, sections["kernel"])
        cost_of_frames(frames, sections["runs"])
        figure.savefig(path, dpi=160)


def cost_of_columns(axes: Axes, stages: Mapping[str, Any]) -> None:
    """Draw the time of the fit stage against the number of columns, above the bare read."""
    counts, times = _series(stages["fit_by_columns"])
    megabytes = stages["input_mb"] / 1e3
    axes.plot(counts, times[:, 0] / megabytes, "o-", color=ORANGE, label="fit stage")
    axes.fill_between(counts, times[:, 1] / megabytes, times[:, 2] / megabytes, color=ORANGE, alpha=0.2, lw=0)
    bare = stages["seconds"]["bare fit"]["median"] / megabytes
    axes.axhline(bare, color=GREY, ls="--", lw=1.2, label="bare read of the tiles of all columns")
    axes.set(
        title="Stage fit, all cores",
        xlabel="columns in the movie",
        ylabel="s per GB of movie",
        ylim=(0, None),
        xlim=(0, None),
    )
    axes.legend(loc="best")


def cost_of_windows(axes: Axes, kernel: Mapping[str, Any]) -> None:
    """Draw the time of one fit on one core against the side of the window."""
    for fitter, (colour, marker, label) in FITTERS.items():
        found = {
            side: row["seconds_per_fit"]
            for side, rows in kernel["sides"].items()
            for row in rows
            if row["fitter"] == fitter
        }
        if found:
            sides, times = _series(found)
            axes.plot(sides, 1e6 * times[:, 0], marker=marker, color=colour, label=label)
    axes.set(title="Kernel, one core", xlabel="side of the window, px", ylabel="µs per fit", yscale="log")
    axes.set_ylim(axes.get_ylim()[0], axes.get_ylim()[1] * 8)  # room for the legend
    axes.legend(loc="upper left", fontsize=8)


def cost_of_frames(axes: Axes, runs: Mapping[str, Any]) -> None:
    """Draw the time of whole runs against the length of the movie, stage upon stage."""
    by_frames = runs["by_frames"]
    frames, total = _series({key: outcome["seconds"] for key, outcome in by_frames.items()})
    gigabytes = frames * runs["input_mb"] / runs["frames"] / 1e3
    stages = np.array([[by_frames[str(int(n))]["stages"][stage]["median"] for n in frames] for stage in STAGES])
    axes.stackplot(gigabytes, stages, colors=list(STAGES.values()), labels=list(STAGES), alpha=0.75, lw=0)
    axes.plot(gigabytes, total[:, 0], "ko-", label="whole run")
    axes.set(title="Whole run, all cores", xlabel="size of the movie, GB", ylabel="s", ylim=(0, None), xlim=(0, None))
    axes.legend(loc="upper left", fontsize=8)


def _series(found: Mapping[str, Mapping[str, float]]) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return the keys as numbers, ascending, and (n, 3) median, low and high for each."""
    keys = sorted(found, key=float)
    values = [[found[key][name] for name in ("median", "low", "high")] for key in keys]
    return np.array([float(key) for key in keys]), np.array(values)
