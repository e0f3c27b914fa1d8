"""Numbers of atoms: over the summed image, and the look-up table that they come from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from ..analysis.intensity import UNIT
from ..errors import SettingsError
from ..store.columns import positions
from .base import (
    COLUMN_INCHES,
    COUNT_MAP,
    FEW,
    LINES,
    SMALL,
    colour_bar,
    graph,
    image_panels,
    legend,
    mark_values,
    new_figure,
    save,
    title,
)

_LEVEL_INK = "#6b5d12"


def plot_occupancy(
    counts: xr.Dataset,
    columns: xr.Dataset,
    summed: xr.Dataset,
    frame: int | None = None,
    path: str | Path | None = None,
) -> Figure:
    """Draw the number of atoms in each column over the summed image; "?" where 95 % hold other numbers as well.

    Parameters
    ----------
    counts
        From :func:`tract_dask.analysis.occupancy.count_atoms`.
    columns
        Tracks or columns, for where they are.
    summed
        From :func:`tract_dask.sum_image`.
    frame
        Number of the frame; None where counts are those of the mean (``frames="mean"``).
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.

    Raises
    ------
    SettingsError
        Where counts have frames and none is named, or the other way round.
    """
    if ("frame" in counts.dims) != (frame is not None):
        raise SettingsError(
            "the frame to be drawn is not clear",
            "plot_occupancy: frame",
            "a frame of the counts" if "frame" in counts.dims else "none, for these are of the mean",
            f"{frame}",
        )
    shown = counts[["atoms", "low_95", "high_95", "ambiguous"]]
    shown = (shown if frame is None else shown.sel(frame=frame)).compute()
    atoms = shown["atoms"].to_numpy()
    known = np.isfinite(atoms)
    most = int(atoms[known].max()) if known.any() else 1
    cmap = ListedColormap(mpl.colormaps[COUNT_MAP](np.linspace(0, 1, most + 1)))
    norm = BoundaryNorm(np.arange(-0.5, most + 1), cmap.N)
    figure, (axes,) = image_panels(summed)
    few = len(atoms) <= FEW
    mark_values(axes, columns, atoms, norm, cmap, share=0.6 if few else 0.42)
    unsure = known & ((shown["low_95"] != shown["high_95"]) | shown["ambiguous"]).to_numpy()
    if few:
        for place, number, doubt in zip(positions(columns)[known], atoms[known], unsure[known], strict=True):
            axes.annotate(
                f"{number:.0f}{'?' if doubt else ''}",
                place,
                ha="center",
                va="center_baseline",
                fontsize=SMALL,
                color="white" if number < 0.55 * most else "black",
                zorder=4,
            )
    when = f"Frame {frame}" if frame is not None else "Mean of the frames"
    sure = int((known & ~unsure).sum())
    title(axes, "", f"{when}: {sure} of {int(known.sum())} columns certain")
    label = "Atoms in the column" + (" (?: 95 % hold other numbers as well)" if few and unsure.any() else "")
    colour_bar(axes, norm, cmap, label, ticks=np.arange(most + 1))
    return save(figure, path)


def plot_look_up(table: xr.Dataset, path: str | Path | None = None) -> Figure:
    """Draw the intensity that columns of 1, 2, 3 … atoms show, with its range over the sites (Figure 5d of the paper).

    Parameters
    ----------
    table
        From :func:`tract_dask.analysis.occupancy.look_up_table` or ``read_table``; with its sites where it has them.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.
    """
    known = table.dropna("atoms", subset=["intensity"])
    atoms, middle = known["atoms"].to_numpy(), known["intensity"].to_numpy()
    below, above = middle - known["low"].to_numpy(), known["high"].to_numpy() - middle
    figure = new_figure(COLUMN_INCHES, 2.7)
    axes = figure.subplots()
    if "site_intensity" in table:
        sites = known["site_intensity"].transpose("atoms", "site").to_numpy()
        beside = np.repeat(atoms + 0.25, sites.shape[1])
        axes.plot(beside, sites.ravel(), ".", color=LINES[1], ms=3, alpha=0.6, label="sites")
    axes.errorbar(
        atoms, middle, [below, above], fmt="o-", color=LINES[0], ms=4, lw=1.2, capsize=2.5, label="mean and range"
    )
    brightest = int(atoms[int(np.abs(middle).argmax())])
    if brightest < atoms.max():
        axes.axvspan(brightest + 0.5, atoms.max() + 0.5, color="#d9d9d9", alpha=0.5, lw=0, zorder=0)
        axes.annotate(
            "brighter columns\nhave fewer atoms",
            (brightest + 0.65, 0.02),
            xycoords=("data", "axes fraction"),
            fontsize=SMALL,
            color="#444444",
            va="bottom",
        )
    axes.set_xlim(atoms.min() - 0.5, atoms.max() + 0.5)
    axes.set_xticks(atoms)
    graph(axes, "Atoms in the column", f"Intensity ({unit_of(table['intensity'])})")
    legend(axes, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.1)
    return save(figure, path)


def unit_of(values: xr.DataArray) -> str:
    """Return the unit of intensities as a label says it."""
    unit = str(values.attrs.get("units", "counts"))
    return "1 Å$^2$ of vacuum = 1" if unit == UNIT else unit


def draw_levels(axes: Axes, table: xr.Dataset, max_atoms: int | None = None) -> None:
    """Draw the intensities of a look-up table as horizontal bands, with the numbers of atoms at the right.

    Parameters
    ----------
    max_atoms
        Largest number that is drawn; None: the brightest, beyond which intensities fall among the others.
    """
    known = table[["intensity", "low", "high"]].dropna("atoms")
    numbers = known["atoms"].to_numpy()
    last = numbers[int(np.abs(known["intensity"].to_numpy()).argmax())] if max_atoms is None else max_atoms
    low, high = axes.get_ylim()
    level = known.sel(atoms=numbers[numbers <= last]).sortby("intensity")
    middle = level["intensity"].to_numpy()
    for bottom, top, line in zip(level["low"].to_numpy(), level["high"].to_numpy(), middle, strict=True):
        axes.axhspan(bottom, top, color="#c9b458", alpha=0.35, lw=0, zorder=0)
        axes.axhline(line, color="#8a7a2a", lw=0.6, zorder=0)
    style: dict[str, Any] = {"fontsize": SMALL, "color": _LEVEL_INK}
    line_height = SMALL * (high - low) / (72 * axes.bbox.height / axes.figure.dpi)
    apart = np.flatnonzero(np.diff(middle) > 1.3 * line_height) + 1
    for near in np.split(np.arange(len(middle)), apart):
        if low <= middle[near].mean() <= high:
            text = ", ".join(str(number) for number in sorted(level["atoms"].to_numpy()[near]))
            place = (1.012, float(middle[near].mean()))
            axes.annotate(text, place, xycoords=("axes fraction", "data"), va="center", **style)
    axes.set_ylim(low, high)
    axes.annotate("atoms", (1.0, 1.01), xycoords="axes fraction", va="bottom", **style)
