"""What the page's scripts draw, as plain data: columns on the summed image, their series in time, drift."""

from __future__ import annotations

import json
from base64 import b64encode
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..analysis.overview import QUANTITIES
from ..kernels.greys import block_means, grey_levels
from .pictures import grey_data
from .survey import Survey, frame_curves

_IMAGE_PX = 900
_MISSING = -32768
_STEPS = 65534


@dataclass(frozen=True)
class Shade:
    """A number by which the columns on the image can be coloured."""

    name: str
    label: str
    unit: str
    factor: float = 1.0


def shades(run: Survey) -> list[Shade]:
    """Return the numbers by which columns can be coloured, as far as they are known."""
    every = [
        Shade("spread", "spread", run.known.unit),
        Shade("excess", "spread", "× stated error"),
        Shade("share", "accepted", "%", 100.0),
        Shade("r_squared", "R²", ""),
        Shade("intensity", "intensity", "counts"),
        Shade("residual", "residual", "% of amplitude", 100.0),
    ]
    return [shade for shade in every if np.isfinite(run.columns[shade.name]).any()]


def page_data(run: Survey, first: int) -> dict[str, Any]:
    """Return what is drawn, arrays as of :func:`packed`; ``first`` is the place of the column that is shown first."""
    columns, known = run.columns, shades(run)
    numbers = {"x": columns["x_ref"], "y": columns["y_ref"], "expected": columns["expected"]}
    numbers |= {shade.name: columns[shade.name] * shade.factor for shade in known}
    return {
        "unit": run.known.unit,
        "time_unit": run.known.time_unit,
        "first": first,
        "shades": [{"name": shade.name, "label": shade.label, "unit": shade.unit} for shade in known],
        "ids": columns["column_id"].to_numpy().tolist(),
        "kinds": [str(kind) for kind in columns["kind"].to_numpy()],
        "columns": {name: packed(values.to_numpy().astype(float)) for name, values in numbers.items()},
        "series": _series(run.series),
        "frames": _frames(run),
    }


def image_data(run: Survey) -> tuple[str, dict[str, Any]]:
    """Return the summed image as a data URL; and its size, how many px the picture covers, the size of a pixel."""
    exposed = (run.summed["exposure"] > 0).to_numpy()
    step = -(-max(exposed.shape) // _IMAGE_PX)
    levels = grey_levels(block_means(np.where(exposed, run.summed["image"], np.nan), step))
    ny, nx = exposed.shape
    covered = [side * step for side in reversed(levels.shape)]
    size = run.known.scale if run.known.unit == "pm" else None
    return grey_data(levels), {"width": nx, "height": ny, "covered": covered, "pixel_size_pm": size}


def packed(values: NDArray[Any]) -> dict[str, str]:
    """Return an array as its ``dtype``, int16 or float64, and ``base64`` of its little-endian bytes."""
    data = values.astype(values.dtype.newbyteorder("<")).tobytes()
    return {"dtype": values.dtype.name, "base64": b64encode(data).decode("ascii")}


def script_json(data: Any) -> str:
    r"""Return JSON that can stand in a script of a page, whatever its texts.

    Raises
    ------
    ValueError
        Where a number is not finite.

    Examples
    --------
    >>> print(script_json(["</script>", "Å"]))
    ["\u003c/script\u003e", "\u00c5"]
    """
    text = json.dumps(data, allow_nan=False)
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


def _series(series: xr.Dataset) -> dict[str, Any]:
    """Return the series of all columns as 16 bit numbers, one column after the other, with their zeros and steps."""
    kinds = ("mean", "error") if series.attrs["frames"] == 1 else ("mean", "error", "low", "high")
    found: dict[str, Any] = {"time": packed(series["time"].to_numpy()), "frames": series.attrs["frames"]}
    for quantity in QUANTITIES:
        own = series.sel(quantity=quantity).transpose("column_id", "bin")
        found[quantity] = {kind: _series_of(own[kind].to_numpy()) for kind in kinds}
    return found


def _series_of(values: NDArray[np.float64]) -> dict[str, Any]:
    numbers, zero, step = quantised(values)
    return {"numbers": packed(numbers), "zero": packed(zero), "step": packed(step)}


def quantised(values: NDArray[np.float64]) -> tuple[NDArray[np.int16], NDArray[np.float64], NDArray[np.float64]]:
    """Return rows of numbers in 16 bit: value = zero + step * number, with a step of 1/65534 of the row's range.

    Parameters
    ----------
    values
        (rows, points); what is not finite becomes -32768.

    Returns
    -------
    tuple
        The numbers one row after the other, and the zeros and steps of the rows.
    """
    known = np.isfinite(values)
    some = known.any(axis=1)
    low = np.where(some, np.min(values, axis=1, where=known, initial=np.inf), 0.0)
    high = np.where(some, np.max(values, axis=1, where=known, initial=-np.inf), 0.0)
    zero = (low + high) / 2
    step = np.where(high > low, (high - low) / _STEPS, 1.0)
    number = np.rint((np.where(known, values, zero[:, None]) - zero[:, None]) / step[:, None])
    return np.where(known, number, _MISSING).astype(np.int16).ravel(), zero, step


def _frames(run: Survey) -> dict[str, Any]:
    """Return the curves over the frames: drift, the share of accepted fits, and the correlation with the sum."""
    curve = frame_curves(run.frames)
    data = {"time": curve["time"], "share": 100 * curve["share"]}
    data |= {axis: run.known.scale * curve[f"drift_{axis}"] for axis in ("x", "y")}
    if "quality" in curve:
        data["quality"] = 100 * curve["quality"]
    return {name: packed(values) for name, values in data.items()}
