"""What filters do to a frame and to its columns (Supplementary Figures 1 and 2)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .base import FONT, PAGE_INCHES, SMALL, graph, new_figure, outline, save, scale_bar, show_grey, title

_FILTERS = {
    "none": ("Unfiltered", "#000000"),
    "gaussian": ("Gaussian blur", "#0072B2"),
    "wiener": ("Wiener", "#D55E00"),
    "tv-l1": ("TV-L1", "#009E73"),
}
"""Title and colour of each filter, dark enough for lines on white (after Okabe and Ito)."""
_PROFILE_INCHES = 2.3


def plot_filters(images: xr.DataArray, compared: xr.Dataset, path: str | Path | None = None) -> Figure:
    """Draw a region of one frame after each filter, with the fitted positions, and profiles along a line.

    After Supplementary Figure 1 of Levin et al. Circles mark where the columns are without a filter. The line goes
    through the two compared columns that are farthest apart (from left to right through the only one); its profiles are
    offset from each other, and not scaled.

    Parameters
    ----------
    images
        (filter, y, x) from :func:`tract_dask.analysis.filters.filtered_region`.
    compared
        From :func:`tract_dask.analysis.filters.compare_filters`.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.
    """
    frame, pixel_size = images.attrs["frame"], images.attrs.get("pixel_size_pm")
    filters = [str(name) for name in images["filter"].to_numpy()]
    ny, nx = images.shape[1:]
    width = PAGE_INCHES / len(filters)
    tall = width * ny / nx + 0.4
    figure = new_figure(PAGE_INCHES, tall + _PROFILE_INCHES)
    parts: Any = figure.subfigures(2, 1, height_ratios=(tall, _PROFILE_INCHES))
    above, below = parts
    places = compared.sel(frame=frame)
    ends = _profile_ends(images, places.sel(filter="gaussian"))
    for letter, axes, name in zip("abcd", above.subplots(1, len(filters)), filters, strict=False):
        _show_filtered(axes, images.sel(filter=name), places.sel(filter=name), places.sel(filter=filters[0]))
        title(axes, letter, _FILTERS[name][0])
        if letter == "a":
            axes.annotate(
                "", ends[1], ends[0], arrowprops={"arrowstyle": "->", "ls": "--", "lw": 1.3, "color": "#F0E442"}
            )
            scale_bar(axes, pixel_size)
    _draw_profiles(below.subplots(), images, ends, pixel_size)
    return save(figure, path)


def _show_filtered(axes: Axes, image: xr.DataArray, places: xr.Dataset, plain: xr.Dataset) -> None:
    """Draw one panel: the image in its own greys, a cross and the ID at each position, a circle where it was before."""
    x, y = image["x"].to_numpy(), image["y"].to_numpy()
    extent = (x[0] - 0.5, x[-1] + 0.5, y[-1] + 0.5, y[0] - 0.5)
    show_grey(axes, image.to_numpy(), extent)
    axes.plot(plain["x"], plain["y"], "o", ms=10, mew=1, mfc="none", mec="#F0E442")
    axes.plot(places["x"], places["y"], "+", ms=8, mew=1.4, color="#56B4E9", path_effects=outline(2.4))
    for column in places["column_id"].to_numpy():
        place = float(places["x"].sel(column_id=column)), float(places["y"].sel(column_id=column))
        if np.isfinite(place).all():
            axes.annotate(
                str(int(column)),
                place,
                (6, 5),
                textcoords="offset points",
                fontsize=SMALL,
                color="white",
                path_effects=outline(2.4),
                annotation_clip=True,
            )
    axes.set(xlim=extent[:2], ylim=extent[2:])


def _profile_ends(images: xr.DataArray, places: xr.Dataset) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return both ends (x, y) of the line of the profiles: through two columns, to the edges of the region."""
    corners = np.array([[images[axis][0], images[axis][-1]] for axis in ("x", "y")], dtype=np.float64)
    known = np.stack([places["x"], places["y"]], axis=1)
    known = known[np.isfinite(known).all(axis=1)]
    if not len(known):
        known = corners.mean(axis=1)[None]
    apart = np.hypot(*np.moveaxis(known[:, None] - known, -1, 0))
    first, second = np.unravel_index(int(apart.argmax()), apart.shape)
    along = known[second] - known[first] if apart.any() else np.array([1.0, 0.0])
    along = along if along[0] >= 0 else -along
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (corners - known[first][:, None]) / along[:, None]
    reach = np.sort(np.where(np.isfinite(reach), reach, [[-np.inf, np.inf]]), axis=1)
    start, stop = reach[:, 0].max(), reach[:, 1].min()
    tail, head = known[first] + start * along, known[first] + stop * along
    return (float(tail[0]), float(tail[1])), (float(head[0]), float(head[1]))


def _draw_profiles(
    axes: Axes, images: xr.DataArray, ends: tuple[tuple[float, float], tuple[float, float]], pixel_size_pm: float | None
) -> None:
    """Draw the profiles of all filters, the first on top, with labels beside them instead of a legend."""
    (x0, y0), (x1, y1) = ends
    length = float(np.hypot(x1 - x0, y1 - y0))
    share = np.linspace(0, 1, max(2, round(2 * length)))
    unit = pixel_size_pm / 1000 if pixel_size_pm else 1.0
    line = {"x": x0 + share * (x1 - x0), "y": y0 + share * (y1 - y0)}
    grid = {axis: images[axis].to_numpy() for axis in line}
    inside = {
        axis: np.clip(values, grid[axis][0], grid[axis][-1]) for axis, values in line.items()
    }  # rounding leads out
    profiles = images.interp({axis: xr.DataArray(values, dims="s") for axis, values in inside.items()})
    spread = [float(np.ptp(profile.to_numpy())) for profile in profiles]
    offset = 0.0
    for name, profile, range_ in zip(images["filter"].to_numpy()[::-1], profiles[::-1], spread[::-1], strict=True):
        label, colour = _FILTERS[str(name)]
        low = float(profile.min())
        axes.plot(share * length * unit, profile - low + offset, color=colour, lw=1.2)
        middle = offset + range_ / 2
        axes.annotate(
            label, (1.01, middle), xycoords=("axes fraction", "data"), color=colour, fontsize=FONT, va="center"
        )
        offset += range_ + 0.12 * max(spread)
    axes.set_xlim(0, length * unit)
    graph(axes, f"Distance along the arrow ({'nm' if pixel_size_pm else 'px'})", "Counts a pixel, offset")
    title(axes, "e", "Profiles")
    axes.set_title("+ fitted position, o that without a filter", loc="right", fontsize=SMALL, color="#555555")
