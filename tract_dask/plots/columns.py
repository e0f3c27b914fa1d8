"""The summed image: with the columns that were found in it, and with its Fourier transform."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from scipy import fft

from ..store import schema
from ..store.columns import positions
from ..store.schema import Status
from .base import (
    COLOURS,
    FEW,
    FONT,
    PAGE_INCHES,
    SMALL,
    new_figure,
    outline,
    points_per_px,
    round_length,
    save,
    scale_bar,
    show_sum,
    spacing_px,
    title,
)

_DPI = 150
_SIDE_INCHES = 7.5
_NARROW_INCHES = 3.6
_LINE_INCHES = 0.24
_LABEL_INCHES = 1.65
_BAR_INCHES = 1.6
_BAR_MARGIN = 0.015
_STATES = (("o", 1.0, ""), ("s", 0.95, "window leaves the image"), ("D", 0.8, "fit in doubt"))
"""Marker, relative size and legend of a sound fit, of one that could not be made, and of one with another flag."""

_MOST_TRANSFORMED = 2048
"""Of a larger image, the middle of so many pixels is transformed."""
_STANDS_OUT = 6.0
"""A spot stands out where its amplitude is so many times the median at its distance from the centre."""


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
    figure = Figure(figsize=(width, height), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, ny * scale / height))
    axes.set_axis_off()
    show_sum(axes, summed, _SIDE_INCHES, _DPI)
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
    _strip_bar(
        figure.add_axes((0, 1 - strip / height, 1, strip / height)), nx, strip / scale, width / scale, pixel_size
    )
    return save(figure, path, _DPI)


def plot_sum(summed: xr.Dataset, path: str | Path | None = None, *, columns: xr.Dataset | None = None) -> Figure:
    """Draw the summed image and the amplitude of its Fourier transform (Figure 1a and b of the paper).

    Parameters
    ----------
    summed
        From :func:`tract_dask.sum_image`.
    columns
        Columns to mark by circles, a colour for each kind; None: none.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.

    Notes
    -----
    The image goes through a Hann window first, against the cross that its edges would make. Of the transform the part
    is drawn in which spots stand out, on a logarithmic scale.
    """
    schema.validate(summed, schema.SUM, "summed image")
    pixel_size = summed.attrs.get("pixel_size_pm")
    ny, nx = summed["image"].shape
    aspect = float(np.clip(nx / ny, 0.4, 2.0))
    tall = (PAGE_INCHES - 0.3) / (aspect + 1)
    figure = new_figure(PAGE_INCHES, tall + 0.3)
    image, transform = figure.subplots(1, 2, width_ratios=(aspect, 1))
    show_sum(image, summed, tall * max(1.0, nx / ny))
    scale_bar(image, pixel_size)
    n_frames = summed.attrs.get("n_frames")
    title(image, "a", f"Mean of {n_frames} frames" if n_frames else "Summed image")
    if columns is not None:
        _circle(image, schema.validate(columns, schema.COLUMNS, "columns"))
    _show_transform(transform, summed, pixel_size)
    return save(figure, path)


def _circle(axes: Axes, columns: xr.Dataset) -> None:
    """Draw a circle around each column, a colour for each kind, and a legend where there are kinds."""
    places, kinds = positions(columns), schema.texts(columns["kind"].to_numpy())
    diameter = float(np.clip(0.45 * spacing_px(columns) * points_per_px(axes), 2.5, 20))
    for kind, colour in _kinds(columns).items():
        some = kinds == kind
        axes.scatter(
            places[some, 0],
            places[some, 1],
            s=diameter**2,
            facecolors="none",
            edgecolors=colour,
            linewidths=1.0,
            path_effects=outline(2.0),
            label=kind or None,
        )
    if any(kinds):
        axes.legend(fontsize=SMALL, loc="upper left", framealpha=0.85, handletextpad=0.3, borderpad=0.3)


def _show_transform(axes: Axes, summed: xr.Dataset, pixel_size_pm: float | None) -> None:
    """Draw the middle of the Fourier transform, with a scale bar in 1/nm (1/px without a pixel size)."""
    image = np.where(summed["exposure"] > 0, summed["image"], np.nan).astype(np.float32)
    spans = (slice(max(0, (n - _MOST_TRANSFORMED) // 2), (n + _MOST_TRANSFORMED) // 2) for n in image.shape)
    image = image[tuple(spans)]
    mean = np.nanmean(image) if np.isfinite(image).any() else 0.0
    faded = np.where(np.isnan(image), 0, image - mean) * np.outer(*(np.hanning(n) for n in image.shape))
    amplitude = np.abs(fft.fftshift(fft.fft2(faded.astype(np.float32))))
    ky, kx = (fft.fftshift(fft.fftfreq(n)) for n in image.shape)
    reach = _reach_of_spots(amplitude, np.hypot(ky[:, None], kx))
    rows, columns = (np.flatnonzero(np.abs(k) <= reach) for k in (ky, kx))
    shown = np.log10(amplitude[np.ix_(rows, columns)] + 1e-9 * amplitude.max(initial=1e-30))
    low, high = np.percentile(shown, [30, 99.97])
    half_y, half_x = 0.5 / len(ky), 0.5 / len(kx)
    extent = (
        kx[columns[0]] - half_x,
        kx[columns[-1]] + half_x,
        ky[rows[-1]] + half_y,
        ky[rows[0]] - half_y,
    )
    axes.imshow(shown, cmap="gray", vmin=low, vmax=high, extent=extent, interpolation="nearest")
    axes.set_axis_off()
    title(axes, "b", "Fourier transform, logarithmic")
    unit = 1000 / pixel_size_pm if pixel_size_pm else 1.0  # cycles in a nm for one in a px
    length = round_length(2 * reach * unit / 4)
    left, bottom = extent[0] + 0.08 * reach, extent[2] - 0.1 * reach
    axes.add_patch(
        Rectangle((left, bottom), length / unit, 0.025 * reach, facecolor="white", edgecolor="black", linewidth=0.6)
    )
    axes.text(
        left + length / unit / 2,
        bottom - 0.02 * reach,
        f"{length:g} {'nm' if pixel_size_pm else 'px'}$^{{-1}}$",
        color="white",
        fontsize=FONT,
        ha="center",
        va="bottom",
        path_effects=outline(),
    )


def _reach_of_spots(amplitude: NDArray[Any], distance: NDArray[np.float64]) -> float:
    """Return how far from the centre spots stand out, with a margin; cycles a px."""
    ring = np.minimum((distance * 2 * min(amplitude.shape)).astype(int), min(amplitude.shape))
    order = np.argsort(ring, axis=None)
    starts = np.searchsorted(ring.ravel()[order], np.arange(ring.max() + 2))
    sizes = amplitude.ravel()[order]
    reach = 0.02
    for number, (start, stop) in enumerate(pairwise(starts)):
        if stop > start and sizes[start:stop].max() > _STANDS_OUT * np.median(sizes[start:stop]):
            reach = max(reach, number / (2 * min(amplitude.shape)))
    return float(min(1.5 * reach, 0.5))


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
    if len(places) > FEW:
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


def _strip_bar(axes: Axes, nx: int, height: float, width: float, pixel_size_pm: float | None) -> None:
    """Draw a bar of a round length, up to a sixth of the image, at the right of the strip above it; units are px."""
    axes.set_axis_off()
    axes.set(xlim=(0, width), ylim=(height, 0))
    nm_per_px = pixel_size_pm / 1000 if pixel_size_pm else 1.0
    length = round_length(nx * nm_per_px / 6)
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
