"""Motion: displacements between two frames, tracks, and jumps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import BoundaryNorm, ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from numpy.typing import NDArray

from ..analysis.motion import displacement, pixel_size_pm, places_in_frames, spread, standard_errors
from ..analysis.motion import positions as positions_pm
from ..kernels.gaussian.intensity import Floats
from ..kernels.windows import blur, gaussian_kernel
from ..store.columns import positions
from ..store.movie import Movie
from .base import (
    COUNT_MAP,
    FIRST,
    FONT,
    LINE_MAP,
    LINES,
    PAGE_INCHES,
    SECOND,
    SIZE_MAP,
    SMALL,
    check_columns,
    colour_bar,
    course,
    draw_course,
    graph,
    legend,
    mark_values,
    new_figure,
    outline,
    round_length,
    save,
    scale_bar,
    scale_of,
    show_pixels,
    spacing_px,
    time_of,
    title,
    write_ids,
)

_SIGNIFICANT = 0.05
"""Displacements are drawn as certain where chance makes as much with a probability below this."""
_MARGIN = 0.6
"""Of a region beyond its outermost columns, in units of their spacing."""
_WRITTEN = 16
"""Up to so many displacements their lengths are written beside them."""
_PATH_POINTS = 250
"""Of a track on the map; more frames are averaged in runs."""
_SHOWN = 4
"""So many columns are drawn in time where none are named."""


def plot_displacement(
    tracks: xr.Dataset,
    movie: Movie,
    first: int,
    second: int,
    columns: Sequence[int] | None = None,
    path: str | Path | None = None,
) -> Figure:
    """Draw two frames with the positions of columns in them, and how far these moved in between (Figure 3).

    Parameters
    ----------
    tracks
        Results; only accepted fits count.
    movie
        That was fitted. Its frames are blurred as the summed image was, and drawn where their drift puts them.
    first, second
        Numbers of the frames.
    columns
        IDs, four of them in the paper; None: all. Frames are drawn around them.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.

    Raises
    ------
    SettingsError
        Where there is no such frame or column, or the size of a pixel is not known.
    """
    chosen = tracks["column_id"].to_numpy().tolist() if columns is None else columns
    some = tracks.sel(column_id=check_columns(tracks, chosen, "plot_displacement"))
    size = pixel_size_pm(tracks)
    moved = displacement(some, first, second).compute()
    two = some.sel(frame=[first, second])
    accepted = np.isfinite(positions_pm(two).sel(axis=["x", "y"]).to_numpy())
    seen = places_in_frames(two).sel(axis=["x", "y"]).to_numpy() - two["drift"].sel(axis=["x", "y"]).to_numpy()[:, None]
    places = np.where(accepted, seen, np.nan)
    box = _region(some, movie.shape[1:], spacing_px(tracks))
    shift = some["drift"].sel(frame=[first, second]).to_numpy()
    sigma = tracks.attrs["reference_blur_px"]
    images = [_frame(movie, frame, drift, box, sigma) for frame, drift in zip((first, second), shift, strict=True)]
    tall = (box[1] - box[0]) / (box[3] - box[2])
    width = PAGE_INCHES / 2 - 0.1
    figure = new_figure(PAGE_INCHES, 2 * (width * min(tall, 1.3) + 0.25))
    panels = np.ravel(figure.subplots(2, 2))
    both = (np.mean([image for image, _ in images], axis=0), images[0][1])
    marks = ((0,), (1,), (0, 1))
    names = (f"Frame {first}", f"Frame {second}", "Mean of both")
    for axes, letter, name, (image, origin), drawn in zip(panels, "abc", names, (*images, both), marks, strict=False):
        show_pixels(axes, image, origin, width * max(1, tall))
        axes.set(xlim=(box[2] - 0.5, box[3] - 0.5), ylim=(box[1] - 0.5, box[0] - 0.5))
        for number in drawn:
            colour = (FIRST, SECOND)[number]
            style: dict[str, Any] = {"color": colour, "ms": 11 - 4 * number, "mew": 1.5, "path_effects": outline(2.6)}
            axes.plot(*places[number].T, "+", label=names[number], **style)
        title(axes, letter, name)
    scale_bar(panels[0], size)
    _arrows(panels[3], moved, positions(some), box, spacing_px(tracks), size)
    return save(figure, path)


def _region(columns: xr.Dataset, shape: tuple[int, ...], spacing: float) -> tuple[int, int, int, int]:
    """Return the part of the summed image around columns: first row, last row (not included), first and last column."""
    places, margin = positions(columns), _MARGIN * spacing
    low, high = np.floor(places.min(axis=0) - margin), np.ceil(places.max(axis=0) + margin) + 1
    left, top = np.maximum(low, 0).astype(int)
    right, bottom = np.minimum(high, (shape[1], shape[0])).astype(int)
    return int(top), int(bottom), int(left), int(right)


def _frame(
    movie: Movie, frame: int, drift: Floats, box: tuple[int, int, int, int], sigma: float
) -> tuple[NDArray[np.float64], tuple[float, float]]:
    """Return what a frame shows of a region of the summed image, blurred, and where its first pixel lies, (x, y).

    The frame is moved by whole pixels; the place of its first pixel has the rest. NaN beyond the frame.
    """
    whole = np.rint(drift).astype(int)
    reach = gaussian_kernel(sigma).size // 2
    image = np.full((box[1] - box[0], box[3] - box[2]), np.nan)
    spans = [
        (max(0, start + move), min(length, stop + move))
        for start, stop, move, length in zip(box[::2], box[1::2], whole, movie.shape[1:], strict=True)
    ]
    (top, bottom), (left, right) = spans
    rows, columns = slice(max(0, top - reach), bottom + reach), slice(max(0, left - reach), right + reach)
    if bottom > top and right > left:
        pixels = blur(movie.counts(movie.read(frame, frame + 1, rows, columns)[0]), sigma)
        part = pixels[top - rows.start : bottom - rows.start, left - columns.start : right - columns.start]
        y, x = top - whole[0] - box[0], left - whole[1] - box[2]
        image[y : y + part.shape[0], x : x + part.shape[1]] = part
    rest = whole - drift
    return image, (box[2] + float(rest[1]), box[0] + float(rest[0]))


def _arrows(
    axes: Axes, moved: xr.Dataset, places: Floats, box: tuple[int, int, int, int], spacing: float, size: float
) -> None:
    """Draw the displacements as arrows, enlarged: dark where they are certain, light elsewhere."""
    step = moved["displacement"].sel(axis=["x", "y"]).to_numpy()
    distance, p_value = moved["distance"].to_numpy(), moved["p_value"].to_numpy()
    known = np.isfinite(distance)
    longest = float(distance[known].max()) if known.any() else 1.0
    factor = 0.55 * spacing / max(longest, 1e-9)  # px of the figure for a pm
    axes.plot(*places.T, "o", color="#888888", ms=2.5)
    for certain, colour, label in (
        (False, "#a8a8a8", f"p ≥ {_SIGNIFICANT:g}"),
        (True, LINES[1], f"p < {_SIGNIFICANT:g}"),
    ):
        some = known & ((p_value < _SIGNIFICANT) == certain)
        _quiver(axes, places[some], factor * step[some], colour, label=label)
    if len(places) <= _WRITTEN:
        for place, length, (_, down) in zip(places[known], distance[known], step[known], strict=True):
            aside: dict[str, Any] = {"xytext": (0, 7), "va": "bottom"} if down > 0 else {"xytext": (0, -7), "va": "top"}
            text = f"{length:.1f} pm"
            axes.annotate(text, place, textcoords="offset points", fontsize=SMALL, ha="center", **aside)
    axes.set(xlim=(box[2] - 0.5, box[3] - 0.5), ylim=(box[1] - 0.5, box[0] - 0.5), aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set(linewidth=0.6, color="#999999")
    key = round_length(longest)
    title(axes, "d", f"Displacements, {factor * size:.0f} times enlarged, longest {longest:.1f} pm")
    hidden = _quiver(axes, places[:1], np.array([[factor * key, 0.0]]), "black", alpha=0)
    written: dict[str, Any] = {"label": f"{key:g} pm", "labelpos": "E", "fontproperties": {"size": SMALL}}
    axes.quiverkey(hidden, 0.8, -0.062, factor * key, coordinates="axes", color="black", alpha=1, **written)
    legend(axes, loc="upper left", bbox_to_anchor=(-0.02, -0.02), ncols=2, borderaxespad=0.2)


def _quiver(axes: Axes, places: Floats, steps: Floats, colour: str, **options: Any) -> Quiver:
    """Draw arrows, all (x, y) in px; heads of short ones stay heads."""
    shape: dict[str, Any] = {
        "width": 0.006,
        "headwidth": 3.5,
        "headlength": 4.0,
        "headaxislength": 3.6,
        "minlength": 0.1,
    }
    in_px: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0}
    return axes.quiver(*places.T, *steps.T, color=colour, **shape, **in_px, **options)


def plot_tracks(
    tracks: xr.Dataset,
    summed: xr.Dataset,
    columns: Sequence[int] | None = None,
    path: str | Path | None = None,
) -> Figure:
    """Draw the tracks of all columns over the summed image, enlarged, and those of some in time.

    Parameters
    ----------
    tracks
        Results; only accepted fits count. Frames of a long movie are averaged in runs on the map, and drawn in time as
        quantiles of runs: the median, 68 % and all.
    summed
        From :func:`tract_dask.sum_image`.
    columns
        IDs of those that are drawn in time; None: the four that spread most.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.

    Raises
    ------
    SettingsError
        Where there is no such column, or the size of a pixel is not known.
    """
    size = pixel_size_pm(tracks)
    chosen = _widest(tracks) if columns is None else check_columns(tracks, columns, "plot_tracks")
    figure, axes, side = _map_and_graphs(summed, len(chosen))
    time, time_label = time_of(tracks)
    _draw_paths(axes, tracks, time, size)
    write_ids(axes, tracks, chosen)
    norm = Normalize(float(time[0]), float(time[-1]) if time[-1] > time[0] else float(time[0]) + 1)
    colour_bar(axes, norm, LINE_MAP, time_label, below=True)
    some = tracks.sel(column_id=chosen)
    both = xr.Dataset({"place": positions_pm(some), "error": standard_errors(some)}).compute()
    for panel, column in zip(side, chosen, strict=True):
        _draw_in_time(panel, both.sel(column_id=column), time)
        title(panel, "", f"Column {column}")
    side[-1].set_xlabel(time_label, fontsize=FONT)
    legend(side[0], ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1)
    return save(figure, path)


def _map_and_graphs(summed: xr.Dataset, count: int) -> tuple[Figure, Axes, list[Axes]]:
    """Return a figure with the summed image at the left and graphs, one above the other, at the right."""
    ny, nx = summed["image"].shape
    width = PAGE_INCHES * 0.52
    figure = new_figure(PAGE_INCHES, max(width * min(ny / nx, 1.5) + 1.2, 0.6 + 1.05 * count))
    parts: Any = figure.subfigures(1, 2, width_ratios=(0.52, 0.48))
    left, right = parts
    axes = left.subplots()
    show_pixels(axes, np.where(summed["exposure"] > 0, summed["image"], np.nan), (0.0, 0.0), width * max(1, ny / nx))
    scale_bar(axes, summed.attrs.get("pixel_size_pm"))
    axes.set_anchor("N")
    return figure, axes, list(right.subplots(max(count, 1), 1, sharex=True, squeeze=False)[:, 0])


def _widest(tracks: xr.Dataset) -> list[int]:
    """Return the IDs of the columns that spread most."""
    sd = np.nan_to_num(spread(tracks)["sd"].to_numpy(), nan=-1.0)
    order = np.argsort(-sd, kind="stable")[:_SHOWN]
    return sorted(tracks["column_id"].to_numpy()[order].tolist())


def _draw_paths(axes: Axes, tracks: xr.Dataset, time: Floats, size: float) -> None:
    """Draw every column's track about its mean place, enlarged so that the usual one fills a third of the spacing."""
    place = positions_pm(tracks).sel(axis=["x", "y"]).transpose("column_id", "frame", "axis") / size
    run = -(-len(time) // _PATH_POINTS)
    path = place.coarsen(frame=run, boundary="pad").mean().to_numpy()
    when = np.array([time[start : start + run].mean() for start in range(0, len(time), run)])
    with np.errstate(invalid="ignore"):
        mean = np.nanmean(np.where(np.isfinite(path).any(axis=1, keepdims=True), path, 0.0), axis=1, keepdims=True)
    away = path - mean
    reach = np.hypot(away[..., 0], away[..., 1])
    usual = float(np.percentile(reach[np.isfinite(reach)], 95)) if np.isfinite(reach).any() else 1.0
    factor = max(1.0, round_length(0.3 * spacing_px(tracks) / max(usual, 1e-6)))
    drawn = positions(tracks)[:, None] + factor * away
    segments = np.stack([drawn[:, :-1], drawn[:, 1:]], axis=2)
    colours = np.broadcast_to(when[:-1], segments.shape[:2])
    whole = np.isfinite(segments).all(axis=(2, 3))
    norm = Normalize(float(time[0]), float(time[-1]) if time[-1] > time[0] else float(time[0]) + 1)
    lines = LineCollection(list(segments[whole]), cmap=LINE_MAP, norm=norm, linewidths=0.7, rasterized=True)
    lines.set_array(colours[whole])
    axes.add_collection(lines, autolim=False)
    averaged = f", means of {run} frames" if run > 1 else ""
    title(axes, "", f"Tracks, {factor:g} times enlarged{averaged}")


def _draw_in_time(axes: Axes, one: xr.Dataset, time: Floats) -> None:
    """Draw the displacements of one column from its mean place along x and y, with the errors of its fits."""
    for name, colour in (("x", LINES[0]), ("y", LINES[1])):
        place, error = (one[variable].sel(axis=name).to_numpy() for variable in ("place", "error"))
        away = place - np.nanmean(place) if np.isfinite(place).any() else place
        found = course(time, away)
        if not found.low.size:
            axes.fill_between(time, away - error, away + error, color=colour, alpha=0.2, lw=0)
        draw_course(axes, found, colour, name)
    graph(axes, "", "From mean (pm)")


def plot_jumps(jumps: xr.Dataset, tracks: xr.Dataset, summed: xr.Dataset, path: str | Path | None = None) -> Figure:
    """Draw how often each column jumps and where to, over the summed image, and all jumps in time.

    Parameters
    ----------
    jumps
        From :func:`tract_dask.analysis.jumps.change_points` or ``threshold_jumps``.
    tracks
        The results in which they were found.
    summed
        From :func:`tract_dask.sum_image`.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.
    """
    ids = tracks["column_id"].to_numpy()
    rows = np.searchsorted(ids, jumps["column_id"].to_numpy())
    number = np.bincount(rows, minlength=len(ids))
    most = max(int(number.max(initial=0)), 1)
    levels = min(most, 12)
    cmap = ListedColormap(mpl.colormaps[COUNT_MAP](np.linspace(0, 1, levels)))
    edges = np.linspace(0.5, most + 0.5, levels + 1)
    norm = BoundaryNorm(edges, cmap.N)
    figure, axes, (side,) = _map_and_graphs(summed, 1)
    mark_values(axes, tracks, np.where(number > 0, number, np.nan), norm, cmap)
    steps = jumps["step"].sel(axis=["x", "y"]).to_numpy()
    size = jumps["size"].to_numpy()
    if len(size):
        factor = 0.6 * spacing_px(tracks) / float(np.percentile(size, 95))
        _quiver(axes, positions(tracks)[rows], factor * steps, SECOND, zorder=4)
        write_ids(axes, tracks, sorted(set(jumps["column_id"].to_numpy().tolist()))[:_WRITTEN])
        enlarged = factor * pixel_size_pm(tracks)
        title(axes, "a", f"{len(size)} jumps of {int((number > 0).sum())} columns, {enlarged:.0f} times enlarged")
    else:
        title(axes, "a", "No jumps were found")
    colour_bar(axes, norm, cmap, "Jumps of a column", ticks=_ticks(most), below=True)
    _draw_raster(side, jumps, tracks)
    return save(figure, path)


def _ticks(most: int) -> NDArray[np.int64]:
    return np.arange(1, most + 1, max(1, -(-most // 10)))


def _draw_raster(axes: Axes, jumps: xr.Dataset, tracks: xr.Dataset) -> None:
    """Draw all jumps in time, a row for each column, in the colour of their size."""
    time, time_label = time_of(tracks)
    when = time[np.searchsorted(tracks["frame"].to_numpy(), jumps["frame"].to_numpy())]
    size = jumps["size"].to_numpy()
    scale = scale_of(size, low=0.0)
    style: dict[str, Any] = {"s": 22, "edgecolors": "black", "linewidths": 0.4}
    axes.scatter(when, jumps["column_id"], c=size, cmap=SIZE_MAP, norm=scale.norm, **style)
    ids = tracks["column_id"].to_numpy()
    pad = 0.02 * (time[-1] - time[0]) or 0.5
    axes.set(xlim=(time[0] - pad, time[-1] + pad), ylim=(ids.max() + 1, ids.min() - 1))
    axes.grid(axis="y", color="#e3e3e3", lw=0.5)
    axes.set_axisbelow(True)
    graph(axes, time_label, "Column")
    title(axes, "b", "When")
    colour_bar(axes, scale.norm, SIZE_MAP, "Length of the jump (pm)", extend=scale.extend)
