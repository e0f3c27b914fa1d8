"""What all figures share: style, the summed image with its columns, scale bar, colour bar, points in time."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PathCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike, NDArray

from ..analysis.motion import frame_times
from ..errors import SettingsError
from ..kernels.gaussian.intensity import Floats
from ..kernels.greys import block_means, contrast
from ..store import schema
from ..store.columns import positions

COLOURS = ("#56B4E9", "#E69F00", "#2CC295", "#CC79A7", "#F0E442", "#D55E00", "#FFFFFF")
"""One for each kind, on grey images: the colour-blind can tell them apart (after Okabe and Ito)."""
LINES = ("#0072B2", "#D55E00", "#009E73", "#AA4499", "#A6761D", "#444444")
"""Of lines and markers on white, in the order of their use: as dark as text needs."""
FIRST, SECOND = "#22D3EE", "#FF5C5C"
"""Of two places that are compared on a grey image: the paper's cyan and red."""
SIZE_MAP, SIGNED_MAP, COUNT_MAP = "viridis", "RdBu_r", "cividis"
"""Maps of what is never negative, of what has a sign, and of numbers that are counted."""
LINE_MAP = ListedColormap(mpl.colormaps[SIZE_MAP](np.linspace(0.3, 1, 256)))
"""Of lines on grey images: without the colours that are as dark."""

DPI = 200
COLUMN_INCHES, PAGE_INCHES = 3.5, 7.2
"""Widths of a column and of a page of a journal."""
FONT, SMALL = 8.0, 7.0
"""Font sizes in points, for the widths above."""
FEW = 80
"""Up to so many columns something is written beside each."""

_PNG = {"compress_level": 1}
"""Noise does not compress: higher levels take three times as long for the same size."""
_HIGHEST = 97.0
"""Percentile of the values that ends a colour bar, so that one restless column does not flatten all others."""
_MOST_POINTS = 800
"""More frames than these are drawn as quantiles of runs of frames."""
_RUNS = 300


def new_figure(width: float, height: float, layout: str = "constrained") -> Figure:
    """Return an empty white figure of a size in inches, with a canvas of its own."""
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white", layout=layout)  # type: ignore[arg-type]
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: str | Path | None, dpi: float = DPI) -> Figure:
    """Save the figure in the format that the suffix of ``path`` names, if there is one; return it."""
    if path is not None:
        options: dict[str, Any] = {"pil_kwargs": _PNG} if Path(path).suffix == ".png" else {}
        figure.savefig(path, dpi=dpi, **options)
    return figure


def graph(axes: Axes, xlabel: str, ylabel: str) -> None:
    """Give axes their labels, and the look that all graphs have."""
    axes.set_xlabel(xlabel, fontsize=FONT)
    axes.set_ylabel(ylabel, fontsize=FONT)
    axes.tick_params(labelsize=SMALL, width=0.7)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["bottom", "left"]].set_linewidth(0.7)


def title(axes: Axes, letter: str, text: str = "") -> None:
    """Write the letter of a panel, if there are several, and what it shows above its left corner."""
    axes.set_title("  ".join(part for part in (letter, text) if part), loc="left", fontsize=FONT)


def legend(axes: Axes, **options: Any) -> None:
    """Draw the legend of a graph, without a frame."""
    axes.legend(fontsize=SMALL, **({"frameon": False, "handlelength": 1.6} | options))


def outline(width: float = 1.8, colour: str = "black") -> list[withStroke]:
    """Return the effect that lets text or lines stand out of an image."""
    return [withStroke(linewidth=width, foreground=colour)]


def show_sum(axes: Axes, summed: xr.Dataset, inches: float, dpi: float = DPI) -> None:
    """Draw the summed image, in grey where it is exposed, with pixels of the movie as coordinates.

    Parameters
    ----------
    inches
        The longer side of the image as drawn.
    """
    schema.validate(summed, schema.SUM, "summed image")
    show_pixels(axes, np.where(summed["exposure"] > 0, summed["image"], np.nan), (0.0, 0.0), inches, dpi)


def show_pixels(axes: Axes, image: NDArray[Any], origin: tuple[float, float], inches: float, dpi: float = DPI) -> None:
    """Draw part of an image (y, x), NaN where it is not known, whose first pixel lies at ``origin`` (x, y).

    A large image is first binned to about the figure's own pixels, which matplotlib would do at many times the cost.

    Parameters
    ----------
    inches
        The longer side of the image as drawn.
    """
    (ny, nx), (left, top) = image.shape, (origin[0] - 0.5, origin[1] - 0.5)
    step = max(1, round(max(ny, nx) / (inches * dpi)))
    shown = block_means(image, step)
    show_grey(axes, shown, (left, left + step * shown.shape[1], top + step * shown.shape[0], top))
    axes.set(xlim=(left, left + nx), ylim=(top + ny, top))


def show_grey(axes: Axes, image: NDArray[Any], extent: tuple[float, float, float, float]) -> None:
    """Draw an image (y, x) in grey, without axes; what is not known is a light blue grey.

    Parameters
    ----------
    extent
        Left, right, bottom, top edge in px of the summed image.
    """
    low, high = contrast(image)
    grey = mpl.colormaps["gray"].with_extremes(bad="#c8d0d8")
    axes.imshow(image, cmap=grey, vmin=low, vmax=high, extent=extent)
    axes.set(xlim=extent[:2], ylim=extent[2:])
    axes.set_axis_off()


def scale_bar(axes: Axes, pixel_size_pm: float | None) -> None:
    """Draw a bar of a round length, in nm or px, up to a fifth of an image, below its right corner."""
    left, right = axes.get_xlim()
    nm_per_px = pixel_size_pm / 1000 if pixel_size_pm else 1.0
    length = round_length((right - left) * nm_per_px / 5)
    width, below = length / nm_per_px, axes.get_xaxis_transform()  # px along the image, shares of its height
    points = 72 * axes.bbox.height / axes.figure.dpi
    base, height = -8 / points, 2.5 / points
    bar = Rectangle((right - width, base), width, height, facecolor="black", lw=0, transform=below, clip_on=False)
    axes.add_patch(bar)
    label = f"{length:g} {'nm' if pixel_size_pm else 'px'} "
    axes.text(
        right - width, base + height / 2, label, fontsize=SMALL, ha="right", va="center_baseline", transform=below
    )


def round_length(longest: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above ``longest``.

    Examples
    --------
    >>> [round_length(longest) for longest in (0.7, 2.0, 49.0)]
    [0.5, 2.0, 20.0]
    """
    decade = 10.0 ** np.floor(np.log10(longest))
    return float(max(step * decade for step in (1, 2, 5) if step * decade <= longest))


def image_panels(summed: xr.Dataset, count: int = 1, *, graph_beside: bool = False) -> tuple[Figure, list[Axes]]:
    """Return a figure with ``count`` summed images side by side, with scale bars and room for a colour bar.

    Parameters
    ----------
    graph_beside
        Whether the last panel is left empty, for a graph.
    """
    ny, nx = summed["image"].shape
    width = (PAGE_INCHES - 0.8) / 2 if count > 1 else PAGE_INCHES - 2.4
    width = width if nx >= ny else width * max(nx / ny, 0.6)
    tall = width * ny / nx
    layout = "constrained" if graph_beside else "compressed"  # the latter is for panels that are all alike
    figure = new_figure(PAGE_INCHES if graph_beside else count * width + 0.8, tall + 0.35, layout)
    panels = list(np.ravel(figure.subplots(1, count)))
    for axes in panels[: count - graph_beside]:
        show_sum(axes, summed, max(width, tall))
        scale_bar(axes, summed.attrs.get("pixel_size_pm"))
    return figure, panels


class Scale(NamedTuple):
    """Colours of values: the norm, and which end of it values lie beyond (as a colour bar's ``extend`` says it)."""

    norm: Normalize
    extend: str


def scale_of(*values: ArrayLike, low: float | None = None) -> Scale:
    """Return the colours of positive values, of which a few may lie above: from the smallest, or ``low``."""
    every = np.concatenate([np.ravel(np.asarray(part, np.float64)) for part in values])
    every = every[np.isfinite(every)]
    if not every.size:
        return Scale(Normalize(0, 1), "neither")
    bottom = float(every.min()) if low is None else low
    top = float(every.max())
    usual = float(np.percentile(every, _HIGHEST))
    above = top - bottom > 1.3 * (usual - bottom) > 0
    top = usual if above else top
    return Scale(Normalize(bottom, top if top > bottom else bottom + 1), "max" if above else "neither")


def colour_bar(axes: Axes, norm: Normalize, cmap: Any, label: str, *, below: bool = False, **options: Any) -> None:
    """Draw a colour bar with its label, which names the unit, along the right or the lower edge of axes."""
    place = (0.0, -0.1, 1.0, 0.03) if below else (1.03, 0.0, 0.035, 1.0)
    orientation = "horizontal" if below else "vertical"
    inset = axes.inset_axes(place)
    figure = axes.figure.get_figure(root=True)
    bar = figure.colorbar(ScalarMappable(norm, cmap), cax=inset, orientation=orientation, **options)
    bar.set_label(label, fontsize=FONT)
    bar.ax.tick_params(labelsize=SMALL, width=0.7)
    bar.outline.set_linewidth(0.5)


def points_per_px(axes: Axes) -> float:
    """Return how many points of the figure a pixel of the image is wide; the figure is laid out for that."""
    figure = axes.figure.get_figure(root=True)
    figure.draw_without_rendering()
    left, right = axes.transData.transform([(0.0, 0.0), (1.0, 0.0)])[:, 0]
    return float(72 * (right - left) / figure.dpi)


def spacing_px(columns: xr.Dataset) -> float:
    """Return the usual distance from a column to the nearest one, px."""
    places = positions(columns)
    if len(places) < 2:
        return 40.0
    nearest = [np.partition(np.hypot(*(places - place).T), 1)[1] for place in places]
    return float(np.median(nearest))


def mark_values(
    axes: Axes, columns: xr.Dataset, values: ArrayLike, norm: Normalize, cmap: Any = SIZE_MAP, share: float = 0.42
) -> PathCollection:
    """Draw a disc in the colour of its value at each column; an empty grey circle where the value is not known.

    Parameters
    ----------
    values
        (column_id,).
    share
        Diameter of the discs, in units of the columns' spacing.
    """
    places, shown = positions(columns), np.asarray(values, np.float64)
    known = np.isfinite(shown)
    diameter = float(np.clip(share * spacing_px(columns) * points_per_px(axes), 2.5, 22))
    discs = axes.scatter(
        places[known, 0],
        places[known, 1],
        s=diameter**2,
        c=shown[known],
        cmap=cmap,
        norm=norm,
        edgecolors="white",
        linewidths=min(0.9, diameter / 8),
        zorder=3,
    )
    if not known.all():
        axes.scatter(
            places[~known, 0],
            places[~known, 1],
            s=diameter**2,
            facecolors="none",
            edgecolors="#b0b0b0",
            linewidths=0.9,
            zorder=3,
            label="not known",
        )
    return discs


def write_ids(axes: Axes, columns: xr.Dataset, chosen: Sequence[int], colours: Sequence[str] = ("white",)) -> None:
    """Write the IDs of some columns beside them."""
    places = dict(zip(columns["column_id"].to_numpy().tolist(), positions(columns), strict=True))
    for number, column in enumerate(chosen):
        axes.annotate(
            str(column),
            places[column],
            (6, 6),
            textcoords="offset points",
            fontsize=SMALL,
            fontweight="bold",
            color=colours[number % len(colours)],
            path_effects=outline(),
            zorder=6,
        )


def time_of(tracks: xr.Dataset) -> tuple[Floats, str]:
    """Return the time of every frame and what it is called: in s where the time of a frame is known."""
    if tracks.attrs.get("frame_time_s"):
        return frame_times(tracks), "Time (s)"
    return tracks["frame"].to_numpy().astype(np.float64), "Frame"


class Course(NamedTuple):
    """A value in time, as it is drawn: every frame, or quantiles of runs of frames.

    Attributes
    ----------
    time, middle
        (points,): the frames' own, or the means of runs and the medians in them; NaN where frames were lost.
    low, high
        (points,): the 16 and 84 % quantiles of runs; empty where every frame is drawn.
    least, most
        (points,): the smallest and largest value of runs; empty where every frame is drawn.
    """

    time: Floats
    middle: Floats
    low: Floats
    high: Floats
    least: Floats
    most: Floats


_LOST = 1.5
"""A step so many times the usual one is a gap, which no line crosses."""


def course(time: Floats, values: Floats) -> Course:
    """Return a value in time, as it is to be drawn: no more than some hundred points, whatever the number of frames."""
    nothing = np.empty(0)
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > _LOST * np.median(steps)) + 1 if len(steps) > 1 else np.empty(0, int)
    if len(time) <= _MOST_POINTS:
        apart = np.insert(time, gaps, np.nan), np.insert(np.asarray(values, np.float64), gaps, np.nan)
        return Course(*apart, nothing, nothing, nothing, nothing)
    runs = np.linspace(0, len(time), _RUNS + 1).round().astype(int)
    edges = np.unique(np.concatenate([runs, gaps[: _RUNS // 2]]))
    rows = np.full((5, len(edges) - 1), np.nan)
    for number, (start, stop) in enumerate(pairwise(edges)):
        run = values[start:stop]
        run = run[np.isfinite(run)]
        if run.size:
            rows[:, number] = np.quantile(run, [0.5, 0.16, 0.84, 0.0, 1.0])
    middle = np.array([time[start:stop].mean() for start, stop in pairwise(edges)])
    before = np.flatnonzero(np.isin(edges, gaps))
    return Course(np.insert(middle, before, np.nan), *np.insert(rows, before, np.nan, axis=1))


def draw_course(axes: Axes, found: Course, colour: str, label: str = "") -> None:
    """Draw a value in time: points joined by a thin line, or the median of runs in bands of 68 % and of all."""
    if not found.low.size:
        axes.plot(found.time, found.middle, "o-", color=colour, ms=2.2, lw=0.7, label=label)
        return
    axes.fill_between(found.time, found.least, found.most, color=colour, alpha=0.15, lw=0)
    axes.fill_between(found.time, found.low, found.high, color=colour, alpha=0.35, lw=0)
    axes.plot(found.time, found.middle, color=colour, lw=0.9, label=label)


def check_columns(tracks: xr.Dataset, columns: Sequence[int], where: str) -> list[int]:
    """Return the IDs of columns, if the tracks have them all.

    Raises
    ------
    SettingsError
        Naming those that they do not have.
    """
    known = tracks["column_id"].to_numpy().tolist()
    missing = [column for column in columns if column not in known]
    if missing or not len(columns):
        expected = f"IDs from {known[0]} to {known[-1]}" if known else "tracks with columns"
        raise SettingsError("there are no such columns", where, expected, ", ".join(map(str, missing)) or "none")
    return list(columns)
