"""How far columns spread, how wide they are, and how precisely they are located against the dose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, ScalarFormatter

from ..analysis.motion import pixel_size_pm
from ..analysis.precision import column_precision
from ..errors import SettingsError
from ..kernels.gaussian.intensity import Floats
from ..kernels.gaussian.model import blurred
from ..kernels.gaussian.parameters import SIGMA_A, SIGMA_B, THETA
from ..kernels.windows import blur_variance
from ..store.columns import positions
from .base import (
    COLUMN_INCHES,
    FONT,
    LINE_MAP,
    LINES,
    SIZE_MAP,
    colour_bar,
    graph,
    image_panels,
    legend,
    mark_values,
    new_figure,
    save,
    scale_of,
    title,
)

_FWHM = 2 * np.sqrt(2 * np.log(2))
_MAPS = {"gaussian": "Gaussian fit", "centroid_all": "Centroid"}
_CURVES = {
    "gaussian": ("Gaussian fit", "o", "-", LINES[0]),
    "centroid": ("Centroid, accepted frames", "^", "-", LINES[1]),
    "centroid_all": ("Centroid, all frames", "v", "--", LINES[1]),
    "crlb": ("Cramér-Rao bound of the fit", "", "-", "black"),
    "theory": ("Paper's theory, width / √electrons", "", ":", LINES[5]),
}
"""Name, marker, line and colour of what is compared."""


def plot_spread(tracks: xr.Dataset, summed: xr.Dataset, path: str | Path | None = None) -> Figure:
    """Draw the standard deviation of each column's position over the summed image (Figure 4a and b of the paper).

    Parameters
    ----------
    tracks
        Results; only accepted fits count. Where they hold centroids, those are drawn beside the Gaussian fits, in the
        same colours; a centroid cannot be rejected, so all frames count.
    summed
        From :func:`tract_dask.sum_image`.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.

    Raises
    ------
    SettingsError
        Where the size of a pixel is not known.
    """
    found = column_precision(tracks, dose=1.0)
    found = found[[name for name in _MAPS if name in found]].compute()
    values = {str(name): found[name].to_numpy() for name in found}
    scale = scale_of(*values.values())
    figure, panels = image_panels(summed, len(values))
    for letter, axes, (name, spread) in zip("ab", panels, values.items(), strict=False):
        mark_values(axes, tracks, spread, scale.norm)
        middle = f", median {np.nanmedian(spread):.1f} pm" if np.isfinite(spread).any() else ""
        title(axes, letter if len(values) > 1 else "", f"{_MAPS[name]}{middle}")
    label = "Standard deviation per axis (pm)"
    colour_bar(panels[-1], scale.norm, SIZE_MAP, label, extend=scale.extend)
    return save(figure, path)


def plot_fwhm(tracks: xr.Dataset, summed: xr.Dataset, path: str | Path | None = None) -> Figure:
    """Draw each column's full width at half maximum as an ellipse of that size, in the colour of its mean width.

    Parameters
    ----------
    tracks
        Results, or columns of :func:`tract_dask.find_columns` with their size of a pixel. The widths are those in the
        summed image, from which the blur is taken off.
    summed
        From :func:`tract_dask.sum_image`.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.

    Raises
    ------
    SettingsError
        Where the size of a pixel, or the blur, is not known.
    """
    size = pixel_size_pm(tracks)
    blur = tracks.attrs.get("reference_blur_px", tracks.attrs.get("blur_sigma_px"))
    if blur is None:
        raise SettingsError(
            "the blur of the summed image is not known", "plot_fwhm", "the attribute blur_sigma_px", "none"
        )
    fits = blurred(tracks["fit_ref"].to_numpy().astype(np.float64), -blur_variance(float(blur)))
    width = _FWHM * size * np.sqrt(fits[:, SIGMA_A] * fits[:, SIGMA_B])
    scale = scale_of(width)
    figure, (axes,) = image_panels(summed)
    known = np.isfinite(fits).all(axis=1)
    rings = LineCollection(
        list(_ellipses(positions(tracks)[known], fits[known])), cmap=LINE_MAP, norm=scale.norm, linewidths=1.6
    )
    rings.set_array(width[known])
    axes.add_collection(rings, autolim=False)
    middle = f", median {np.nanmedian(width):.0f} pm" if known.any() else ""
    title(axes, "", f"Ellipses at half maximum{middle}")
    colour_bar(axes, scale.norm, LINE_MAP, "Full width at half maximum (pm)", extend=scale.extend)
    return save(figure, path)


def _ellipses(places: Floats, fits: Floats) -> Floats:
    """Return the outlines at half maximum, (columns, points, 2) rows of (x, y); the major axis is (cos, -sin) theta."""
    turn = np.linspace(0, 2 * np.pi, 49)
    along = 0.5 * _FWHM * fits[:, SIGMA_A, None] * np.cos(turn)
    across = 0.5 * _FWHM * fits[:, SIGMA_B, None] * np.sin(turn)
    cos, sin = np.cos(fits[:, THETA, None]), np.sin(fits[:, THETA, None])
    away = np.stack([along * cos + across * sin, across * cos - along * sin], axis=-1)
    return np.asarray(places[:, None] + away)


def plot_precision(table: xr.Dataset, path: str | Path | None = None) -> Figure:
    """Draw the precision of positions against the dose of a frame, with standard errors (Figure 4c of the paper).

    Below, the same in units of the Cramér-Rao bound.

    Parameters
    ----------
    table
        From :func:`tract_dask.analysis.precision.precision_table`.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.
    """
    figure = new_figure(COLUMN_INCHES, 4.3)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1))
    dose = table["dose"].to_numpy()
    for number, (name, (label, marker, line, colour)) in enumerate(_CURVES.items()):
        if name not in table:
            continue
        values, error = table[name].to_numpy(), np.nan_to_num(table[f"{name}_stderr"].to_numpy())
        if not marker:
            above.plot(dose, values, color=colour, ls=line, lw=1.2, label=label)
            continue
        style: dict[str, Any] = {"color": colour, "marker": marker, "ls": line, "ms": 3.5, "lw": 0.9, "capsize": 2}
        beside = dose * (1 + 0.03 * (number - 1))  # so that their errors do not hide each other
        above.errorbar(beside, values, error, label=label, **style)
        below.errorbar(beside, values / table["crlb"].to_numpy(), error / table["crlb"].to_numpy(), **style)
    above.set(xscale="log", yscale="log")
    _plain_ticks(above, dose)
    below.axhline(1, color="black", lw=1.2)
    graph(above, "", "Standard deviation\nper axis (pm)")
    graph(below, "Dose of a frame (e$^-$/Å$^2$)", "Ratio to\nthe bound")
    legend(above, loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=1, borderaxespad=0.2)
    title(below, "b")
    above.set_title("a", loc="left", fontsize=FONT, y=1.0, x=-0.12)
    return save(figure, path)


def _plain_ticks(axes: Axes, dose: Floats) -> None:
    """Write plain numbers on logarithmic axes: the doses below, and 1, 2, 3, 5 of each decade at the left."""
    axes.set_xticks(dose, [f"{value:g}" for value in dose])
    low, high = axes.get_ylim()
    ticks = [step * 10.0**power for power in range(-3, 6) for step in (1, 2, 3, 5, 7)]
    axes.set_yticks([tick for tick in ticks if low <= tick <= high])
    axes.yaxis.set_major_formatter(ScalarFormatter())
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_formatter(NullFormatter())
    axes.minorticks_off()
