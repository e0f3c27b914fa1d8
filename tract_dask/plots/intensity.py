"""Intensities: in time, against the dose of a frame, and how well they repeat."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..analysis.intensity import repeated_error
from ..kernels.gaussian.intensity import Floats
from ..store.results import accepted
from .base import (
    COLUMN_INCHES,
    FONT,
    LINES,
    PAGE_INCHES,
    SIZE_MAP,
    SMALL,
    check_columns,
    colour_bar,
    course,
    draw_course,
    graph,
    image_panels,
    legend,
    mark_values,
    new_figure,
    save,
    scale_of,
    time_of,
    title,
)
from .occupancy import draw_levels, unit_of

_NORMAL_95 = 1.96
_BARS = "#8FBEDD"
"""Of error bars behind points: a light tint of the first colour of lines."""
_SHOWN = 4
"""So many columns are drawn where none are named."""


def plot_intensity(
    tracks: xr.Dataset,
    columns: Sequence[int] | None = None,
    path: str | Path | None = None,
    *,
    table: xr.Dataset | None = None,
) -> Figure:
    """Draw the intensities of some columns in time, with the error bands that their fits state.

    Parameters
    ----------
    tracks
        Results, or what :func:`tract_dask.analysis.intensity.normalised` returns; only accepted fits count, and the
        frames without one are marked below. Of a long movie, bands show quantiles of runs of frames instead: the
        median, 68 % and all.
    columns
        IDs; None: the four that vary most against their errors.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.
    table
        A look-up table, to draw its intensities as bands with their numbers of atoms; for normalised intensities.

    Raises
    ------
    SettingsError
        Where there is no such column.
    """
    known = accepted(tracks) if "status" in tracks else tracks
    chosen = _restless(known) if columns is None else check_columns(known, columns, "plot_intensity")
    some = known[["intensity", "intensity_stderr"]].sel(column_id=chosen).compute()
    time, time_label = time_of(tracks)
    figure = new_figure(PAGE_INCHES, 0.5 + 1.25 * len(chosen))
    panels = figure.subplots(len(chosen), 1, sharex=True, squeeze=False)[:, 0]
    for axes, column in zip(panels, chosen, strict=True):
        one = some.sel(column_id=column)
        values, error = one["intensity"].to_numpy(), one["intensity_stderr"].to_numpy()
        _draw_band(axes, time, values, error)
        title(axes, "", f"Column {column}")
        graph(axes, "", "")
    panels[-1].set_xlabel(time_label, fontsize=FONT)
    figure.supylabel(f"Intensity ({unit_of(known['intensity'])})", fontsize=FONT)
    _legend_of_bands(panels[0], len(time))
    if table is not None:
        figure.draw_without_rendering()  # lays the panels out, on whose height the labels depend
        for axes in panels:
            draw_levels(axes, table)
    return save(figure, path)


def _restless(tracks: xr.Dataset) -> list[int]:
    """Return the IDs of the columns whose intensities vary most against their errors."""
    errors = repeated_error(tracks)[["sd", "fitted"]].compute()
    ratio = np.nan_to_num((errors["sd"] / errors["fitted"]).to_numpy(), nan=-1)
    order = np.argsort(-ratio, kind="stable")[:_SHOWN]
    return sorted(tracks["column_id"].to_numpy()[order].tolist())


def _draw_band(axes: Axes, time: Floats, values: Floats, error: Floats) -> None:
    """Draw one column's intensity: with its errors where each frame is drawn; frames without one as ticks below."""
    found = course(time, values)
    if found.low.size:
        draw_course(axes, found, LINES[0])
        return
    wide = float(np.clip(150 / len(time), 0.6, 3.0))
    known = np.isfinite(values + error)
    for factor, width in ((_NORMAL_95, 0.25 * wide), (1.0, wide)):
        low, high = values - factor * error, values + factor * error
        axes.vlines(time[known], low[known], high[known], color=_BARS, lw=width)
    axes.plot(time, values, "o-", color=LINES[0], ms=2.2, lw=0.7)
    top = float(np.max((values + 2.2 * error)[known])) if known.any() else 1.0
    axes.set_ylim(min(0.0, float(np.nanmin(values, initial=0.0))), top)
    missing = time[~np.isfinite(values)]
    if missing.size:
        low = np.full(len(missing), axes.get_ylim()[0])
        axes.plot(missing, low, "|", color=LINES[1], ms=7, mew=1.3, clip_on=False)


def _legend_of_bands(axes: Axes, n_frames: int) -> None:
    """Draw what the marks of :func:`_draw_band` mean above the first graph."""
    if course(np.zeros(n_frames), np.zeros(n_frames)).low.size:
        marks: list[Artist] = [
            Line2D([], [], color=LINES[0], lw=0.9, label="median of a run of frames"),
            Patch(color=LINES[0], alpha=0.45, lw=0, label="68 % of its fits"),
            Patch(color=LINES[0], alpha=0.15, lw=0, label="all"),
        ]
    else:
        marks = [
            Line2D([], [], color=LINES[0], marker="o", ms=2.2, lw=0.7, label="fit"),
            Line2D([], [], color=_BARS, lw=3, label="its error, 68 %"),
            Line2D([], [], color=_BARS, lw=0.75, label="95 %"),
            Line2D([], [], color=LINES[1], marker="|", ls="", ms=7, mew=1.3, label="not accepted"),
        ]
    beside = (0.97, 1.0)
    legend(axes, handles=marks, loc="lower right", bbox_to_anchor=beside, ncols=4, borderaxespad=0.1)


def plot_intensity_against_dose(
    against_dose: xr.Dataset,
    column_id: int | None = None,
    path: str | Path | None = None,
    *,
    table: xr.Dataset | None = None,
    max_atoms: int | None = None,
) -> Figure:
    """Draw a column's intensity against the dose of a frame, with errors of 68 and 95 % (Figure 6c of the paper).

    Parameters
    ----------
    against_dose
        From :func:`tract_dask.analysis.intensity.intensity_against_dose`. The bars are those of a single frame by
        Equation 5: bold 68 %, thin 95 %.
    column_id
        Of the column; None: the first.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.
    table, max_atoms
        A look-up table, to draw its intensities as bands, and the largest number of atoms that is drawn (None: the
        brightest).

    Raises
    ------
    SettingsError
        Where there is no such column.
    """
    column = int(against_dose["column_id"][0]) if column_id is None else column_id
    check_columns(against_dose, [column], "plot_intensity_against_dose")
    one = against_dose.sel(column_id=column)
    dose, values = one["dose"].to_numpy(), one["intensity"].to_numpy()
    figure = new_figure(COLUMN_INCHES, 2.9)
    axes = figure.subplots()
    for name, width, cap, label in (("error_95", 0.9, 3, "95 %"), ("error_68", 2.8, 0, "68 %")):
        axes.errorbar(
            dose, values, one[name].to_numpy(), fmt="none", ecolor=LINES[0], elinewidth=width, capsize=cap, label=label
        )
    axes.plot(dose, values, "o", color="white", mec=LINES[0], ms=4.5, mew=1.2, label="mean", zorder=4)
    axes.set_xscale("log")
    axes.set_xticks(dose, [f"{value:g}" for value in dose])
    axes.minorticks_off()
    reach = float(np.nanmax(values + one["error_95"].to_numpy()))
    if table is not None:
        levels = np.abs(table["intensity"].sel(atoms=table["atoms"] <= (max_atoms or np.inf)))
        reach = max(reach, float(levels.max()))
    axes.set_ylim(0, 1.08 * reach)
    if table is not None:
        draw_levels(axes, table, max_atoms)
    graph(axes, "Dose of a frame (e$^-$/Å$^2$)", f"Intensity of column {column} ({unit_of(against_dose['intensity'])})")
    legend(axes, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.1, columnspacing=1.0)
    return save(figure, path)


def plot_repeated_error(
    errors: xr.Dataset,
    columns: xr.Dataset,
    summed: xr.Dataset,
    path: str | Path | None = None,
    *,
    against_dose: xr.Dataset | None = None,
    column_id: int | None = None,
) -> Figure:
    """Draw how well intensities repeat: over the summed image, and against dose (Supplementary Figure 3a and c).

    Parameters
    ----------
    errors
        From :func:`tract_dask.analysis.intensity.repeated_error`.
    columns
        Tracks or columns, for where they are.
    summed
        From :func:`tract_dask.sum_image`.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.
    against_dose
        From :func:`tract_dask.analysis.intensity.intensity_against_dose`; None: only the map is drawn.
    column_id
        The column that is drawn against dose; None: the first of them.
    """
    spread = errors["sd"].to_numpy()
    scale = scale_of(spread)
    figure, panels = image_panels(summed, 1 if against_dose is None else 2, graph_beside=against_dose is not None)
    mark_values(panels[0], columns, spread, scale.norm)
    title(panels[0], "" if against_dose is None else "a", "Error by repetition")
    label = f"Standard deviation ({unit_of(errors['sd'])})"
    colour_bar(panels[0], scale.norm, SIZE_MAP, label, extend=scale.extend)
    if against_dose is not None:
        _draw_errors(panels[1], against_dose, column_id)
    return save(figure, path)


def _draw_errors(axes: Axes, against_dose: xr.Dataset, column_id: int | None) -> None:
    """Draw the error of one column's intensity, by repetition, by Equation 5 and by the fit, against dose."""
    column = int(against_dose["column_id"][0]) if column_id is None else column_id
    one = against_dose.sel(column_id=check_columns(against_dose, [column], "plot_repeated_error")[0])
    dose = one["dose"].to_numpy()
    spread, error = one["sd"].to_numpy(), one["sd_stderr"].to_numpy()
    axes.errorbar(dose, spread, error, fmt="x", color=LINES[0], ms=5, mew=1.5, capsize=2, label="by repetition")
    axes.plot(dose, one["error_68"], "s", color=LINES[1], ms=4, label="Poisson noise, Equation 5")
    axes.plot(dose, one["fitted"], "-", color=LINES[5], lw=1, label="stated by the fit")
    axes.set_xscale("log")
    axes.set_xticks(dose, [f"{value:g}" for value in dose])
    axes.minorticks_off()
    axes.set_ylim(bottom=0)
    axes.tick_params(labelsize=SMALL)
    graph(axes, "Dose of a frame (e$^-$/Å$^2$)", f"Error of the intensity ({unit_of(against_dose['sd'])})")
    title(axes, "b", f"Column {column}")
    legend(axes, loc="upper right")
