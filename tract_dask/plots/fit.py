"""The fit of one column in one frame: data, model, residual, and cross-sections along both axes (Figure 2)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle
from scipy.ndimage import map_coordinates

from ..analysis.motion import places_in_frames
from ..errors import SettingsError
from ..kernels.gaussian.intensity import Floats
from ..kernels.gaussian.model import evaluate
from ..kernels.gaussian.parameters import AMPLITUDE, SIGMA_A, SIGMA_B, THETA, X, Y
from ..kernels.windows import blur, gaussian_kernel
from ..store.movie import Movie
from .base import (
    FONT,
    LINES,
    PAGE_INCHES,
    SIGNED_MAP,
    colour_bar,
    graph,
    legend,
    new_figure,
    outline,
    save,
    scale_bar,
    title,
)

_FWHM = 2 * np.sqrt(2 * np.log(2))
_AXES = (("major", SIGMA_A, 0.0, LINES[1]), ("minor", SIGMA_B, np.pi / 2, LINES[2]))
"""Name, sigma, angle from the major axis and colour of both axes of the ellipse."""


class _Window(NamedTuple):
    """The pixels that a column was fitted to, and its fit in their coordinates.

    Attributes
    ----------
    pixels
        (y, x), counts, after the blur.
    origin
        (x, y) of the first pixel, px of the frame.
    fit
        (7,) parameters of Equation 1, px of the frame.
    radius
        Of the round window, px.
    """

    pixels: Floats
    origin: tuple[int, int]
    fit: Floats
    radius: float


def plot_fit(
    tracks: xr.Dataset,
    image: Movie | xr.Dataset,
    column_id: int,
    frame: int | None = None,
    path: str | Path | None = None,
) -> Figure:
    """Draw the fit of one column: its pixels, the model, what is left, and cuts along both axes of the ellipse.

    Parameters
    ----------
    tracks
        Results; a fit is drawn whether it is accepted or not.
    image
        The movie that was fitted, for a frame of it; or the summed image, for the fit there (``frame`` None). Pixels
        are blurred as they were for the fit; a filter of whole frames (``wiener``, ``tv-l1``) is not repeated.
    column_id
        Of the column.
    frame
        Number of the frame; None: the summed image.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.

    Raises
    ------
    SettingsError
        Where there is no such column or frame, image and frame do not go together, or nothing was fitted there.
    """
    _check(tracks, image, column_id, frame)
    one = tracks.sel(column_id=column_id)
    cut = (
        _in_sum(one, image, column_id)
        if isinstance(image, xr.Dataset)
        else _in_frame(tracks.sel(column_id=[column_id]), image, frame, column_id)
    )
    figure = new_figure(PAGE_INCHES, 4.4)
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.15, 1))
    above, below = parts
    _images(above, cut, tracks.attrs.get("pixel_size_pm"))
    lower = below.subplots(1, 2, sharey=True)
    for axes, letter, (name, sigma, turn, colour) in zip(lower, "de", _AXES, strict=True):
        _cross_section(axes, cut, cut.fit[THETA] + turn, colour, tracks.attrs.get("pixel_size_pm"))
        width = _length(_FWHM * cut.fit[sigma], tracks.attrs.get("pixel_size_pm"))
        title(axes, letter, f"Along the {name} axis, FWHM {width}")
    lower[1].set_ylabel("")
    figure.suptitle(_heading(one, column_id, frame), fontsize=FONT)
    return save(figure, path)


def _check(tracks: xr.Dataset, image: Movie | xr.Dataset, column_id: int, frame: int | None) -> None:
    if column_id not in tracks["column_id"]:
        known = tracks["column_id"].to_numpy()
        raise SettingsError("there is no such column", "plot_fit", f"{known[0]} to {known[-1]}", f"{column_id}")
    if isinstance(image, xr.Dataset) != (frame is None):
        raise SettingsError(
            "image and frame do not go together",
            "plot_fit",
            "a movie and a frame, or the summed image and none",
            f"{type(image).__name__}, frame {frame}",
        )
    if frame is not None and frame not in tracks["frame"]:
        known = tracks["frame"].to_numpy()
        raise SettingsError("there is no such frame", "plot_fit", f"{known[0]} to {known[-1]}", f"{frame}")


def _in_sum(one: xr.Dataset, summed: xr.Dataset, column_id: int) -> _Window:
    """Return the window in the summed image."""
    fit = one["fit_ref"].to_numpy().astype(np.float64)
    return _window(summed["image"].to_numpy(), (0, 0), fit, one.attrs, one.attrs["reference_blur_px"], column_id)


def _in_frame(one: xr.Dataset, movie: Movie, frame: int | None, column_id: int) -> _Window:
    """Return the window in a frame; only its pixels, and those that the blur reaches, are read."""
    number = int(frame or 0)
    fit = one["fit"].sel(frame=number)[0].to_numpy().copy()
    fit[[Y, X]] = places_in_frames(one.sel(frame=[number]))[0, 0]
    if "motion" in one:
        fit[THETA] -= one["motion"].sel(frame=number).to_numpy()[0]
    sigma = one.attrs["window_blur_px"]
    reach = one.attrs["window_px"] // 2 + 2 + gaussian_kernel(sigma).size // 2
    if not np.isfinite(fit).all():
        raise SettingsError("the column was not fitted here", "plot_fit", "a fit", f"column {column_id}, frame {frame}")
    row, column = (max(0, int(np.rint(fit[k])) - reach) for k in (Y, X))
    rows, columns = (slice(start, start + 2 * reach + 1) for start in (row, column))
    pixels = movie.counts(movie.read(number, number + 1, rows, columns)[0])
    return _window(pixels, (column, row), fit, one.attrs, sigma, column_id)


def _window(
    pixels: Floats, origin: tuple[int, int], fit: Floats, about: dict[str, float], sigma: float, column_id: int
) -> _Window:
    """Return the window around a fit, of pixels that begin at ``origin`` (x, y), after the blur."""
    if not np.isfinite(fit).all():
        raise SettingsError("the column was not fitted here", "plot_fit", "a fit", f"column {column_id}, NaN")
    half = int(about["window_px"]) // 2 + 1
    smooth = blur(pixels, sigma).astype(np.float64)
    left, top = (max(0, int(np.rint(fit[k])) - half - start) for k, start in zip((X, Y), origin, strict=True))
    right, bottom = (int(np.rint(fit[k])) + half + 1 - start for k, start in zip((X, Y), origin, strict=True))
    part = smooth[top : max(bottom, top + 1), left : max(right, left + 1)]
    return _Window(part, (origin[0] + left, origin[1] + top), fit, about["window_px"] / 2)


def _images(figure: SubFigure, cut: _Window, pixel_size_pm: float | None) -> None:
    """Draw pixels, model and residual; the first two in the same colours."""
    x0, y0 = cut.origin
    ny, nx = cut.pixels.shape
    rows, columns = np.mgrid[y0 : y0 + ny, x0 : x0 + nx]
    model = evaluate(cut.fit, columns, rows)
    residual = cut.pixels - model
    inside = np.hypot(columns - cut.fit[X], rows - cut.fit[Y]) <= cut.radius
    low, high = float(np.nanmin(cut.pixels)), float(np.nanmax(cut.pixels))
    most = float(np.nanmax(np.abs(residual[inside]))) or 1.0
    norms = (Normalize(low, high), Normalize(low, high), Normalize(-most, most))
    panels = figure.subplots(1, 3)
    extent = (x0 - 0.5, x0 + nx - 0.5, y0 + ny - 0.5, y0 - 0.5)
    names = ("Data", "Model", "Residual")
    colours = ("gray", "gray", SIGNED_MAP)
    for axes, letter, name, values, norm, cmap in zip(
        panels, "abc", names, (cut.pixels, model, residual), norms, colours, strict=True
    ):
        image: AxesImage = axes.imshow(values, cmap=cmap, norm=norm, extent=extent, interpolation="nearest")
        image.set_label(name)
        edge = "white" if cmap == "gray" else "#444444"
        axes.add_patch(Circle((cut.fit[X], cut.fit[Y]), cut.radius, fill=False, ls=":", lw=0.8, ec=edge))
        axes.set_axis_off()
        title(axes, letter, name)
    for _, sigma, turn, colour in _AXES:
        ends = _along(cut, cut.fit[THETA] + turn, 2 * cut.fit[sigma])
        panels[0].plot(*ends, color=colour, lw=1.5, path_effects=outline(2.6, "white"))
    panels[0].set(xlim=extent[:2], ylim=extent[2:])
    scale_bar(panels[0], pixel_size_pm)
    colour_bar(panels[1], norms[0], "gray", "Counts")
    colour_bar(panels[2], norms[2], SIGNED_MAP, "Data less model (counts)")


def _along(cut: _Window, angle: float, reach: float) -> tuple[Floats, Floats]:
    """Return both ends, (x, x) and (y, y), of a line through the column; angles as in Equation 1."""
    ends = np.array([-reach, reach])
    return cut.fit[X] + ends * np.cos(angle), cut.fit[Y] - ends * np.sin(angle)


def _cross_section(axes: Axes, cut: _Window, angle: float, colour: str, pixel_size_pm: float | None) -> None:
    """Draw data and model along an axis, a point for each px, inside the round window."""
    unit = pixel_size_pm or 1.0
    distance = np.arange(-np.floor(cut.radius), np.floor(cut.radius) + 1)
    x, y = cut.fit[X] + distance * np.cos(angle), cut.fit[Y] - distance * np.sin(angle)
    data = map_coordinates(
        np.nan_to_num(cut.pixels), [y - cut.origin[1], x - cut.origin[0]], order=1, mode="constant", cval=np.nan
    )
    fine = np.linspace(-cut.radius, cut.radius, 200)
    model = evaluate(cut.fit, cut.fit[X] + fine * np.cos(angle), cut.fit[Y] - fine * np.sin(angle))
    axes.plot(distance * unit, data, "o", color=colour, ms=3, label="data")
    axes.plot(fine * unit, model, color="black", lw=1.1, label="fit")
    graph(axes, f"Distance from the centre ({'pm' if pixel_size_pm else 'px'})", "Counts a pixel")
    legend(axes, loc="upper right" if cut.fit[AMPLITUDE] > 0 else "lower right")


def _length(px: float, pixel_size_pm: float | None) -> str:
    return f"{px * pixel_size_pm:.0f} pm" if pixel_size_pm else f"{px:.1f} px"


def _heading(one: xr.Dataset, column_id: int, frame: int | None) -> str:
    """Return which fit this is, after what blur, and how good."""
    sigma = one.attrs["reference_blur_px"] if frame is None else one.attrs["window_blur_px"]
    blurred = f", blurred by {sigma:g} px" if sigma else ""
    if frame is None:
        return f"Column {column_id} in the summed image{blurred}"
    quality = float(one["r_squared"].sel(frame=frame))
    return f"Column {column_id}, frame {frame}{blurred}; R$^2$ = {quality:.2f}"
