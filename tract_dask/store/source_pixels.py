"""Tracks of a part of a movie, in the pixels and frames of the movie on disk."""

from __future__ import annotations

import numpy as np
import xarray as xr

from ..kernels.gaussian.parameters import PARAMETER_UNITS, PARAMETERS
from . import schema

_PART = ("first_frame", "frame_step", "top", "left", "bin_px")


def with_source_coordinates(tracks: xr.Dataset) -> xr.Dataset:
    """Return tracks with coordinates of the movie on disk (:data:`.schema.SOURCE`), where a part of it was read.

    ``x_source_px`` and ``y_source_px`` (column_id) are ``x_ref`` and ``y_ref`` with field and bins undone, in pixels on
    disk; ``source_frame`` (frame) is the number of each frame on disk.
    """
    if "source_bin_px" not in tracks.attrs:
        return tracks
    first, step, side, origin = _place(tracks)
    values = {
        "source_frame": first + step * np.arange(tracks.sizes["frame"]),
        "x_source_px": tracks["x_ref"].to_numpy() * side + origin["x"],
        "y_source_px": tracks["y_ref"].to_numpy() * side + origin["y"],
    }
    return tracks.assign_coords({name: (of.dims, values[name], of.attributes) for name, of in schema.SOURCE.items()})


def _place(tracks: xr.Dataset) -> tuple[int, int, int, dict[str, float]]:
    """Return first frame, step, side of a bin, and where on disk the middle of the part's first pixel is (x, y)."""
    first, step, top, left, side = (int(tracks.attrs[f"source_{name}"]) for name in _PART)
    return first, step, side, {"x": left + (side - 1) / 2, "y": top + (side - 1) / 2}


def in_source_pixels(tracks: xr.Dataset) -> xr.Dataset:
    """Return tracks with places, lengths and frames of the movie on disk, where a part of it was read (roi, bin).

    Positions of the results count from the first pixel of the part, in its pixels. Those that are returned count from
    the first pixel on disk, in its pixels, and so do sigmas, drifts and their errors; frame numbers are those on disk.

    Examples
    --------
    ``in_source_pixels(open_results("out/results.zarr"))``
    """
    if "source_bin_px" not in tracks.attrs:
        return tracks
    first, step, side, origin = _place(tracks)
    tracks = tracks.drop_vars([*schema.SOURCE], errors="ignore")
    scale = xr.DataArray([side if unit == "px" else 1.0 for unit in PARAMETER_UNITS], dims="parameter")
    shift = xr.DataArray([origin.get(name, 0.0) for name in PARAMETERS], dims="parameter")
    middles = xr.DataArray([origin[axis] for axis in schema.AXES], dims="axis")
    moved = {
        "fit": tracks["fit"] * scale + shift,
        "fit_ref": tracks["fit_ref"] * scale + shift,
        "stderr": tracks["stderr"] * scale,
        "centroid": tracks["centroid"] * side + middles,
        "drift": tracks["drift"] * side,
        "drift_measured": tracks["drift_measured"] * side,
        "x_ref": tracks["x_ref"] * side + origin["x"],
        "y_ref": tracks["y_ref"] * side + origin["y"],
    }
    with_attributes = {name: values.assign_attrs(tracks[name].attrs) for name, values in moved.items()}
    frames = first + step * tracks["frame"]
    pixel = tracks.attrs.get("pixel_size_pm")
    kept = {name: value for name, value in tracks.attrs.items() if not name.startswith("source_")}
    seen = tracks.assign(with_attributes).assign_coords(frame=frames)
    seen.attrs = kept | {"pixel_size_pm": pixel and pixel / side}
    if "motion_centre" in kept:
        centre = zip(kept["motion_centre"], ("x", "y"), strict=True)
        seen.attrs["motion_centre"] = [float(side * place + origin[axis]) for place, axis in centre]
    return seen
