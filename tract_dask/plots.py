"""Figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from . import schema
from .schema import Status
from .seeds import positions

COLOURS = ("#56B4E9", "#E69F00", "#2CC295", "#CC79A7", "#F0E442", "#D55E00", "#FFFFFF")
"""One for each kind: the colour-blind can tell them apart, on grey too (after Okabe and Ito)."""

DPI = 150
_PNG = {"compress_level": 1}
"""Noise does not compress: higher levels take three times as long for the same size."""
_SIDE_INCHES = 7.5
_NARROW_INCHES = 3.6
_LINE_INCHES = 0.24
_LABEL_INCHES = 1.65
_BAR_INCHES = 1.6
_BAR_MARGIN = 0.015
_FEW = 80
"""Up to so many columns their IDs are written beside them."""
_STATES = (("o", 1.0, ""), ("s", 0.95, "window leaves the image"), ("D", 0.8, "fit in doubt"))
"""Marker, relative size and legend of a sound fit, of one that could not be made, and of one with another flag."""


def plot_columns(summed: xr.Dataset, columns: xr.Dataset, path: str | Path | None = None) -> Figure:
    """Draw the summed image with its columns: a colour for each kind, a circle where the fit is sound.

    Parameters
    ----------
    summed
        From :func:`tract_dask.sum_image`.
    columns
        From :func:`tract_dask.find_columns`; with IDs beside them where they are few.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.

    Returns
    -------
    Figure
        With a scale bar in nm where the pixel size is known, in px where it is not.
    """
    schema.validate(summed, schema.SUM, "summed image")
    schema.validate(columns, schema.COLUMNS, "columns")
    ny, nx = summed["image"].shape
    scale = _SIDE_INCHES / max(nx, ny)
    width = max(nx * scale, _NARROW_INCHES)
    legend = _legend(columns)
    per_line = max(1, int((width - _BAR_INCHES) / _LABEL_INCHES))
    strip = _LINE_INCHES * -(-len(legend) // per_line) + 0.12
    height = ny * scale + strip
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, ny * scale / height))
    axes.set_axis_off()
    _show(axes, summed)
    _mark(axes, columns, 72 * scale)
    figure.legend(
        handles=legend,
        loc="center left",
        bbox_to_anchor=(0, 1 - strip / height, 1, strip / height),
        ncols=min(len(legend), per_line),
        frameon=False,
        fontsize=9,
        borderaxespad=0.6,
        borderpad=0.2,
        handletextpad=0.2,
        columnspacing=1.2,
    )
    pixel_size = columns.attrs.get("pixel_size_pm") or summed.attrs.get("pixel_size_pm")
    _scale_bar(
        figure.add_axes((0, 1 - strip / height, 1, strip / height)), nx, strip / scale, width / scale, pixel_size
    )
    if path is not None:
        options: dict[str, Any] = {"pil_kwargs": _PNG} if Path(path).suffix == ".png" else {}
        figure.savefig(path, dpi=DPI, **options)
    return figure


def _show(axes: Axes, summed: xr.Dataset) -> None:
    """Draw the summed image, in grey where it is exposed, with pixels of the movie as coordinates.

    A large image is first binned to about the figure's own pixels, which matplotlib would do at many times the cost.
    """
    exposed = (summed["exposure"] > 0).to_numpy()
    image = np.where(exposed, summed["image"].to_numpy(), 0.0)
    ny, nx = image.shape
    step = max(1, round(max(ny, nx) / (_SIDE_INCHES * DPI)))
    count = _block_sums(exposed, step)
    shown = np.where(count > 0, _block_sums(image, step) / np.maximum(count, 1), np.nan)
    known = shown[count > 0]
    low, high = np.percentile(known, [0.5, 99.7]) if known.size else (0.0, 1.0)
    below, right = step * np.array(shown.shape) - 0.5
    grey = mpl.colormaps["gray"].with_extremes(bad="#c8d0d8")
    axes.imshow(shown, cmap=grey, vmin=low, vmax=high, extent=(-0.5, right, below, -0.5))
    axes.set(xlim=(-0.5, nx - 0.5), ylim=(ny - 0.5, -0.5))


def _block_sums(image: NDArray[Any], step: int) -> NDArray[np.float64]:
    """Return the sums of blocks of ``step`` x ``step`` pixels; those at the right and the bottom may be smaller."""
    ny, nx = (-(-size // step) for size in image.shape)
    whole = np.zeros((ny * step, nx * step), image.dtype)
    whole[: image.shape[0], : image.shape[1]] = image
    rows = whole.reshape(ny, step, nx * step).sum(axis=1, dtype=np.float64)
    return np.asarray(rows.reshape(ny, nx, step).sum(axis=2))


def _states(columns: xr.Dataset) -> NDArray[np.int64]:
    """Return for each column which of the states it is in."""
    status = columns["status_ref"].to_numpy().astype(np.int64)
    return np.where(status & Status.OUTSIDE_FRAME, 1, np.where(status != Status.OK, 2, 0))


def _kinds(columns: xr.Dataset) -> dict[str, str]:
    """Return the colour of each kind."""
    kinds = sorted(set(map(str, columns["kind"].to_numpy())))
    return {kind: COLOURS[number % len(COLOURS)] for number, kind in enumerate(kinds)}


def _legend(columns: xr.Dataset) -> list[Line2D]:
    kinds, states = schema.texts(columns["kind"].to_numpy()), _states(columns)
    handles = []
    for kind, colour in _kinds(columns).items():
        count = int((kinds == kind).sum())
        label = f"{kind or ('column' if count == 1 else 'columns')} ({count})"
        handles.append(_handle("o", colour, label))
    for state, (marker, _, meaning) in enumerate(_STATES):
        if meaning and (states == state).any():
            handles.append(_handle(marker, "#999999", f"{meaning} ({int((states == state).sum())})"))
    return handles


def _handle(marker: str, colour: str, label: str) -> Line2D:
    return Line2D(
        [],
        [],
        linestyle="none",
        marker=marker,
        markersize=8,
        markerfacecolor="#555555",
        markeredgecolor=colour,
        markeredgewidth=2,
        label=label,
    )


def _mark(axes: Axes, columns: xr.Dataset, points_per_px: float) -> None:
    """Draw a marker around each column, about half the spacing wide, and its ID."""
    places, states = positions(columns), _states(columns)
    kinds = schema.texts(columns["kind"].to_numpy())
    spacing = float(columns.attrs.get("spacing_px") or 20 / points_per_px)
    diameter = float(np.clip(0.5 * spacing * points_per_px, 3, 26))
    width = float(np.clip(diameter / 12, 0.7, 1.6))
    for kind, colour in _kinds(columns).items():
        for state, (marker, size, _) in enumerate(_STATES):
            some = (kinds == kind) & (states == state)
            if some.any():
                axes.scatter(
                    places[some, 0],
                    places[some, 1],
                    s=(size * diameter) ** 2,
                    marker=marker,
                    facecolors="none",
                    edgecolors=colour,
                    linewidths=width,
                    path_effects=[withStroke(linewidth=width + 1.2, foreground="#000000b0")],
                )
    if len(places) > _FEW:
        return
    right = axes.get_xlim()[1] - 30 / points_per_px
    for column, (x, y) in zip(columns["column_id"].to_numpy(), places, strict=True):
        aside = -1 if x > right else 1
        axes.annotate(
            str(int(column)),
            (x, y),
            (aside * (0.36 * diameter + 1), 0.36 * diameter + 1),
            textcoords="offset points",
            ha="left" if aside > 0 else "right",
            va="bottom" if y * points_per_px > 16 + diameter / 2 else "top",
            fontsize=7,
            color="white",
            path_effects=[withStroke(linewidth=1.8, foreground="black")],
        )


def _scale_bar(axes: Axes, nx: int, height: float, width: float, pixel_size_pm: float | None) -> None:
    """Draw a bar of a round length, up to a sixth of the image, at the right of the strip above it; units are px."""
    axes.set_axis_off()
    axes.set(xlim=(0, width), ylim=(height, 0))
    nm_per_px = pixel_size_pm / 1000 if pixel_size_pm else 1.0
    longest = nx * nm_per_px / 6
    decade = 10.0 ** np.floor(np.log10(longest))
    length = max(step * decade for step in (1, 2, 5) if step * decade <= longest)
    left, right = (1 - _BAR_MARGIN) * width - length / nm_per_px, (1 - _BAR_MARGIN) * width
    axes.add_patch(Rectangle((left, 0.44 * height), right - left, 0.12 * height, facecolor="black", edgecolor="none"))
    axes.text(
        left - _BAR_MARGIN * width / 2,
        height / 2,
        f"{length:g} {'nm' if pixel_size_pm else 'px'}",
        fontsize=9,
        ha="right",
        va="center_baseline",
    )
