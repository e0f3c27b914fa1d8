"""What a movie store says of itself: OME-Zarr 0.5 metadata, coordinates with units, and our own attributes."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from ..settings.run import is_step_of
from . import datasets, metadata, schema
from .damage import METADATA, read_json
from .pixels import nodes_of

AXES = ("t", "y", "x")

CHANGING = "changing"
"""Attribute that a movie has while its coordinates and its calibration are changed, and where that was cut off."""


def write_metadata(path: Path, ours: dict[str, Any], changed: Collection[str] = ()) -> None:
    """Write the coordinates, then what the root says, in one rename: OME-Zarr's attributes and our own.

    ``changed`` are other arrays that have been written anew.

    Raises
    ------
    StoreError
        Where metadata of the store are damaged; nothing is written then.
    """
    metadata.check_nodes(path, ours, AXES)
    frame_time, pixel = ours["frame_time_s"], ours["pixel_size_pm"]
    for axis, values, step, units in (
        ("t", _times(path, ours), frame_time, ("s", "frame")),
        ("y", np.arange(ours["shape"][1]) * (pixel or 1.0), pixel, ("pm", "px")),
        ("x", np.arange(ours["shape"][2]) * (pixel or 1.0), pixel, ("pm", "px")),
    ):
        datasets.overwrite_array(path / axis, values)
        zarr.open_array(path / axis, mode="r+").attrs["units"] = units[0] if step else units[1]
    root = read_json(path / METADATA)
    root["attributes"] = {
        "ome": _ome_metadata(path.name, tuple(ours["bins"]), pixel, frame_time),
        metadata.ATTRIBUTE: ours,
    }
    nodes = _nodes(path, (*map(frame_array, ours.get("frame_values", ())), *nodes_of(ours)))
    root["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": nodes}
    metadata.write_root(path, root, changed=(*AXES, *changed))


def frame_array(name: str) -> str:
    """Return the name of the array that holds what the headers of the frames say, such as ``frame_temperature``."""
    return f"frame_{name}"


def _times(path: Path, ours: dict[str, Any]) -> NDArray[np.float64]:
    """Return the start of each frame in s, or its number where no frame time is known.

    Those of the time stamps, unless the user gave a frame time that is not their median step.
    """
    n_frames, step = ours["shape"][0], ours["frame_time_s"]
    if step and n_frames > 1 and "time" in ours.get("frame_values", ()):
        opened: Any = datasets.open_array if ours["complete"] else zarr.open_array  # to which missing chunks are NaN
        stamps = np.asarray(opened(path / frame_array("time"))[:], np.float64)
        if is_step_of(float(np.median(np.diff(stamps))), step):
            return stamps
    return np.arange(n_frames) * (step or 1.0)


def _nodes(path: Path, more: Iterable[str]) -> dict[str, Any]:
    """Return the metadata of all arrays and groups of the store, so that xarray opens it by reading one file."""
    names = (
        *AXES,
        *schema.STATISTICS,
        *more,
        "0",
        "binned",
        *(f"binned/{file.name}" for file in (path / "binned").glob("[0-9]*")),
    )
    return {name: read_json(path / name / METADATA) for name in names}


def _ome_metadata(name: str, bins: tuple[int, ...], pixel: float | None, frame_time: float | None) -> dict[str, Any]:
    """Return the OME-Zarr 0.5 multiscales; a binned level is translated so that the centres of its pixels agree."""
    time_axis = {"name": "t", "type": "time"} | ({"unit": "second"} if frame_time else {})
    length = {"type": "space"} | ({"unit": "picometer"} if pixel else {})
    side = pixel or 1.0

    def level(path: str, factor: int) -> dict[str, Any]:
        offset = side * (factor - 1) / 2
        scale = {"type": "scale", "scale": [frame_time or 1.0, side * factor, side * factor]}
        shift = {"type": "translation", "translation": [0.0, offset, offset]}
        return {"path": path, "coordinateTransformations": [scale, shift] if factor > 1 else [scale]}

    return {
        "version": "0.5",
        "multiscales": [
            {
                "name": name.removesuffix(".zarr"),
                "type": "mean",
                "axes": [time_axis, {"name": "y"} | length, {"name": "x"} | length],
                "datasets": [level("0", 1), *(level(f"binned/{factor}", factor) for factor in bins)],
            }
        ],
    }
