"""Maps over the kinds of a crystal's columns: strain, off-centring, and distances of neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from ..analysis.strain import COMPONENTS
from ..errors import SettingsError
from ..store.columns import positions
from .base import (
    LINE_MAP,
    PAGE_INCHES,
    SIGNED_MAP,
    SIZE_MAP,
    colour_bar,
    image_panels,
    mark_values,
    outline,
    points_per_px,
    save,
    scale_of,
    spacing_px,
    title,
)

_LONGEST = 0.9
"""Of the arrows, in units of the columns' distance."""


def plot_strain(
    found: xr.Dataset,
    summed: xr.Dataset,
    path: str | Path | None = None,
    components: Sequence[str] = ("xx", "yy", "xy"),
) -> Figure:
    """Draw components of the strain at each column over the summed image, with one scale of colours.

    Parameters
    ----------
    found
        From :func:`tract_dask.analysis.strain.strain` of mean places.
    summed
        From :func:`tract_dask.sum_image`.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.
    components
        Of xx, yy, xy and rotation.

    Raises
    ------
    SettingsError
        Where there is no such component.
    """
    if not components or not set(components) <= set(COMPONENTS):
        raise SettingsError("there is no such component", "plot_strain", ", ".join(COMPONENTS), ", ".join(components))
    values = {name: 100 * found[name].to_numpy() for name in components}
    norm, extend = _about(0.0, *values.values())
    figure, panels = image_panels(summed, len(values))
    for letter, axes, (name, value) in zip("abcd", panels, values.items(), strict=False):
        mark_values(axes, found, value, norm, SIGNED_MAP)
        unit = "rad / 100" if name == "rotation" else "%"
        error = float(np.nanmedian(100 * found[f"{name}_stderr"])) if np.isfinite(value).any() else np.nan
        title(axes, letter if len(values) > 1 else "", f"{name}, ± {error:.2g} {unit}")
    colour_bar(panels[-1], norm, SIGNED_MAP, "Strain (%)" if "rotation" not in values else "%, rad/100", extend=extend)
    return save(figure, path)


def plot_polarisation(found: xr.Dataset, summed: xr.Dataset, path: str | Path | None = None) -> Figure:
    """Draw how far each column is from the centre of its neighbours: enlarged arrows, in the colour of their length.

    Parameters
    ----------
    found
        From :func:`tract_dask.analysis.polarisation.polarisation` of mean places.
    summed
        From :func:`tract_dask.sum_image`.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.
    """
    moved = found["displacement"].sel(axis=["x", "y"]).to_numpy()
    length = np.hypot(*moved.T)
    seen = np.isfinite(length)
    scale = scale_of(length, low=0.0)
    figure, (axes,) = image_panels(summed)
    factor = _LONGEST * spacing_px(found) / max(float(scale.norm.vmax or 0), 1e-12)
    width = max(0.9, 0.05 * spacing_px(found) * points_per_px(axes)) / points_per_px(axes)
    arrows = axes.quiver(
        *positions(found)[seen].T,
        *(factor * moved[seen]).T,
        length[seen],
        cmap=LINE_MAP,
        norm=scale.norm,
        angles="xy",
        scale_units="xy",
        scale=1,
        units="xy",
        width=width,
        pivot="middle",
        zorder=3,
    )
    arrows.set_path_effects([*outline(1.2)])
    error = float(np.nanmedian(found["displacement_stderr"])) if seen.any() else np.nan
    what = f"{found.attrs['kind']} from the centre of {found.attrs['neighbours']} {found.attrs['around']}"
    mean = " and ".join(f"{value:.1f}" for value in (moved[seen].mean(axis=0) if seen.any() else (np.nan, np.nan)))
    title(axes, "", f"{what}: mean {mean} pm along x and y, ± {error:.2g} each")
    colour_bar(axes, scale.norm, LINE_MAP, "Displacement (pm)", extend=scale.extend)
    return save(figure, path)


def plot_neighbour_distances(found: xr.Dataset, summed: xr.Dataset, path: str | Path | None = None) -> Figure:
    """Draw a line between neighbours in the colour of their distance.

    Parameters
    ----------
    found
        From :func:`tract_dask.analysis.polarisation.neighbour_distances`.
    summed
        From :func:`tract_dask.sum_image`; its pixels have a size.
    path
        Where to save the figure, in the format that its suffix names; None: nowhere.

    Raises
    ------
    SettingsError
        Where the size of a pixel is not known.
    """
    size = summed.attrs.get("pixel_size_pm")
    if not size:
        raise SettingsError("the size of a pixel is not known", "summed.attrs['pixel_size_pm']", "pm", repr(size))
    distance = found["distance"].to_numpy()
    half = 0.5 * distance / size * np.stack([np.cos(found["angle"]), np.sin(found["angle"])])
    middle = np.stack([found["x"], found["y"]])
    figure, (axes,) = image_panels(summed)
    middles = np.median(distance) if len(distance) else 0.0
    norm, extend = _about(float(middles), distance)
    lines = LineCollection(np.stack([(middle - half).T, (middle + half).T], axis=1).tolist(), cmap=SIZE_MAP, norm=norm)
    lines.set_array(distance)
    lines.set_linewidth(min(3.0, PAGE_INCHES / 3))
    lines.set_capstyle("round")
    axes.add_collection(lines)
    error = float(np.median(found["distance_stderr"])) if len(distance) else np.nan
    spread = float(distance.std()) if len(distance) else np.nan
    title(axes, "", f"{len(distance):,} pairs, {middles:.1f} pm, sd {spread:.2g}, ± {error:.2g} each")
    colour_bar(axes, norm, SIZE_MAP, "Distance (pm)", extend=extend)
    return save(figure, path)


def _about(middle: float, *values: np.ndarray[Any, Any]) -> tuple[Normalize, str]:
    """Return a scale of colours that reaches as far below a middle as above it, and which of its ends go on."""
    away = np.concatenate([np.abs(value[np.isfinite(value)] - middle) for value in values])
    reach = scale_of(away, low=0.0)
    most = float(reach.norm.vmax or 1)
    return Normalize(middle - most, middle + most), "both" if reach.extend == "max" else "neither"
