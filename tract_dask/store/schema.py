"""Every stored array, declared once: name, dimensions, dtype, unit, and a sentence that says what it is.

Conventions: arrays are (frame, y, x); an integer coordinate is a pixel's centre, counted from 0; x to the right,
y down.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..errors import SettingsError, StoreError
from ..kernels.gaussian.parameters import PARAMETER_UNITS, PARAMETERS
from ..kernels.linear_motion import NAMES as MOTIONS
from ..kernels.linear_motion import UNITS as MOTION_UNITS

CALIBRATION = ("pixel_size_pm", "frame_time_s", "dose", "gain", "offset")
"""What a movie's numbers mean: size of a pixel, time and dose of a frame, counts for one detector unit, and the
detector units of none."""

AXES = ("y", "x")
"""Labels of the ``axis`` dimension of a drift."""

SIZES = {"parameter": len(PARAMETERS), "axis": len(AXES), "place": 16, "motion_kind": len(MOTIONS)}
"""Dimensions of the results that have one length always; a ``place`` is one in vacuum."""


class Status(enum.IntFlag):
    """What speaks against a fit; 0 where nothing does.

    ``AT_BOUND`` is about position, amplitude and background. ``SHAPE_AT_BOUND`` is about the sigmas alone: the position
    is then the best one for a column of that shape, and is accepted. ``INCOMPLETE`` is a window in which pixels are
    missing: the fit is to those that are there, its errors say what is lost, and it is accepted. ``LOST_FRAME`` is one
    that does not resemble the others, for the crystal is away or out of focus: its drift is interpolated.
    ``HOPPED`` is a column that was found away from its place, beyond the bounds of the usual fit: it is accepted.
    ``SAME_ATOM`` is a fit that lies on the atom of another column, which is nearer to its own place: this column is not
    there.
    """

    OK = 0
    BELOW_NOISE = 1
    NOT_CONVERGED = 2
    AT_BOUND = 4
    OUTSIDE_FRAME = 8
    BAD_FRAME = 16
    SHAPE_AT_BOUND = 32
    INCOMPLETE = 64
    LOST_FRAME = 128
    HOPPED = 256
    SAME_ATOM = 512


NOT_SEEN = Status.OUTSIDE_FRAME | Status.BAD_FRAME | Status.LOST_FRAME
"""With any of these flags the frame does not show the column's place: whether it is there is not known."""

REJECTED = Status.BELOW_NOISE | Status.NOT_CONVERGED | Status.AT_BOUND | Status.SAME_ATOM | NOT_SEEN
"""A fit with any of these flags is not accepted."""


def is_accepted(status: Any) -> Any:
    """Tell which fits are accepted, from their flags, as an array or a DataArray of them.

    Examples
    --------
    >>> is_accepted(np.array([Status.OK, Status.INCOMPLETE, Status.HOPPED, Status.AT_BOUND])).tolist()
    [True, True, True, False]
    """
    return (status & np.uint16(REJECTED)) == 0


STATUS_ATTRIBUTES = {
    "flag_masks": [int(flag) for flag in Status if flag],
    "flag_meanings": " ".join(str(flag.name).lower() for flag in Status if flag),
}


@dataclass(frozen=True)
class Variable:
    """A stored array: what it is called, how it is laid out, and what it means."""

    name: str
    dims: tuple[str, ...]
    dtype: str
    unit: str
    description: str
    fill: Any = 0

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes to store with the array (CF names)."""
        attributes: dict[str, Any] = {"units": self.unit, "long_name": self.description}
        return attributes | (STATUS_ATTRIBUTES if self.name == "status" else {})


def _declare(*variables: Variable) -> dict[str, Variable]:
    return {variable.name: variable for variable in variables}


_FIT = ("frame", "column_id", "parameter")

_COLUMN = ("frame", "column_id")

_MOTION = ("frame", "motion_kind")

_MOTION_UNITS = ", ".join(MOTION_UNITS)

_NAN = float("nan")

RESULTS = _declare(
    Variable("fit", _FIT, "float64", "mixed", "Estimates of Equation 1; x and y are drift-corrected", _NAN),
    Variable(
        "stderr",
        _FIT,
        "float64",
        "mixed",
        "Standard errors of the estimates, from the fit's covariance",
        _NAN,
    ),
    Variable(
        "centroid",
        ("frame", "column_id", "axis"),
        "float64",
        "px",
        "Centroid in a round mask that has moved onto the column; drift-corrected",
        _NAN,
    ),
    Variable("intensity", _COLUMN, "float64", "counts", "Column intensity, Equation 3", _NAN),
    Variable("intensity_error", _COLUMN, "float64", "counts", "Error of the intensity, Equation 5", _NAN),
    Variable("intensity_stderr", _COLUMN, "float64", "counts", "Standard error of the intensity, from the fit", _NAN),
    Variable("status", _COLUMN, "uint16", "1", "Flags that speak against a fit", int(Status.NOT_CONVERGED)),
    Variable(
        "presence",
        _COLUMN,
        "float32",
        "1",
        "Matched filter at the column's place: amplitude over its standard error where there is no column",
        _NAN,
    ),
    Variable("presence_vacuum", ("frame", "place"), "float32", "1", "The same at places in vacuum", _NAN),
    Variable("r_squared", _COLUMN, "float32", "1", "Share of the window's variance that the fit explains", _NAN),
    Variable(
        "p_value",
        _COLUMN,
        "float32",
        "1",
        "How probable so large a residual is where there is one Gaussian and the noise of the frame",
        _NAN,
    ),
    Variable("n_iterations", _COLUMN, "int16", "1", "Iterations of the fit", 0),
    Variable("drift", ("frame", "axis"), "float64", "px", "Shift of the frame against the summed image", _NAN),
    Variable(
        "motion",
        _MOTION,
        "float64",
        _MOTION_UNITS,
        "Rotation from x towards y, magnification and shears of all columns, which positions are freed from",
        0.0,
    ),
    Variable(
        "motion_measured",
        _MOTION,
        "float64",
        _MOTION_UNITS,
        "The same, of every frame",
        _NAN,
    ),
    Variable("motion_stderr", _MOTION, "float64", _MOTION_UNITS, "Standard errors of these", _NAN),
    Variable("drift_measured", ("frame", "axis"), "float64", "px", "The same, before the columns refined it", _NAN),
    Variable("noise", _COLUMN, "float64", "counts", "Noise of a pixel at the column's level, after the filter", _NAN),
    Variable(
        "time",
        ("frame",),
        "float64",
        "s",
        "Start of the frame; frame number where no frame time is known",
        _NAN,
    ),
)
"""results.zarr: the tracks."""

SCAN_ROWS = _declare(
    Variable("row_offset", ("frame", "row"), "float64", "px", "Offset of a row of the frame along x", _NAN),
    Variable("row_offset_stderr", ("frame", "row"), "float64", "px", "Standard error of the offset", _NAN),
    Variable("row_shift", _COLUMN, "float64", "px", "What offsets of rows had added to x, which is freed from it", 0.0),
)
"""Variables that results have beside these where offsets of scanned rows are undone."""

COLUMNS = _declare(
    Variable("x_ref", ("column_id",), "float64", "px", "Position in the summed image", _NAN),
    Variable("y_ref", ("column_id",), "float64", "px", "Position in the summed image", _NAN),
    Variable("kind", ("column_id",), "str", "1", "Sublattice or element, free text", ""),
    Variable("fit_ref", ("column_id", "parameter"), "float64", "mixed", "Fit on the summed image, per frame", _NAN),
    Variable("status_ref", ("column_id",), "uint8", "1", "Flags of the fit on the summed image", 0),
)
"""The columns as found in the summed image; also part of results.zarr."""

GROUP = Variable("group", ("column_id",), "int64", "1", "Touching columns that are fitted together; 0: alone", 0)
"""A variable that columns may have; without it all are alone."""

SHAPE_ERROR = Variable(
    "shape_error",
    ("column_id",),
    "float64",
    "1",
    "Error of the intensity that all frames share, from the column's shape in the summed image, over intensity_stderr",
    _NAN,
)
"""A variable that tracks have beside :data:`RESULTS`; 0 where shapes are free."""

UNRESOLVED = Variable(
    "unresolved",
    ("column_id",),
    "bool",
    "1",
    "Touching columns that one frame cannot tell apart: a fit of two or more, or of one of two that were given",
    False,
)
"""Another one; without it all are resolved."""

OF_GROUPS = (GROUP, UNRESOLVED)

DRIFT = _declare(
    Variable("drift", ("frame", "axis"), "float64", "px", "Shift of the frame against the summed image", _NAN),
    Variable(
        "quality",
        ("frame",),
        "float64",
        "1",
        "Correlation of the shifted frame with the reference, 0 to 1; 0 where it does not resemble it",
        _NAN,
    ),
)
"""drift.zarr."""

SUM = _declare(
    Variable("image", ("y", "x"), "float64", "counts", "Drift-corrected mean of the frames, counts a frame", _NAN),
    Variable("exposure", ("y", "x"), "uint32", "frames", "Frames that cover the pixel", 0),
)
"""sum.zarr: the summed image, divided by the frames that cover each pixel."""

STATISTICS = _declare(
    Variable("frame_min", ("t",), "float64", "detector units", "Smallest finite pixel of the frame", _NAN),
    Variable("frame_max", ("t",), "float64", "detector units", "Largest finite pixel of the frame", _NAN),
    Variable("frame_mean", ("t",), "float64", "detector units", "Mean of the frame's finite pixels", _NAN),
    Variable(
        "frame_std",
        ("t",),
        "float64",
        "detector units",
        "Standard deviation of the frame's finite pixels",
        _NAN,
    ),
    Variable("frame_bad_pixels", ("t",), "int64", "px", "Pixels that hold no number or are left out", 0),
)
"""Per-frame statistics in movie.zarr."""


FRAME_VALUES = _declare(
    Variable("time", ("t",), "float64", "s", "Time stamp of the frame, from the first one on", _NAN),
    Variable("temperature", ("t",), "float64", "degC", "Temperature of the holder, measured", _NAN),
    Variable("temperature_set", ("t",), "float64", "degC", "Temperature of the holder, as it was set", _NAN),
    Variable("stage_tilt", ("t",), "float64", "deg", "Tilt of the stage about its axis", _NAN),
    Variable("stage_tilt_beta", ("t",), "float64", "deg", "Tilt of the stage about its second axis", _NAN),
    Variable("bias", ("t",), "float64", "V", "Voltage at the specimen", _NAN),
    Variable("current", ("t",), "float64", "A", "Current through the specimen", _NAN),
)
"""What the headers of frames may say: ``frame_`` and the name in movie.zarr, coordinates on ``frame`` in the tracks."""


SOURCE = _declare(
    Variable("source_frame", ("frame",), "int64", "", "Number of the frame in the movie on disk", -1),
    Variable("x_source_px", ("column_id",), "float64", "px", "x_ref in the pixels of the movie on disk", _NAN),
    Variable("y_source_px", ("column_id",), "float64", "px", "y_ref in the pixels of the movie on disk", _NAN),
)
"""Coordinates of tracks of which only a part of the movie on disk was read; they are computed, not stored."""


def texts(values: Iterable[str]) -> np.ndarray[Any, Any]:
    """Return strings as an array of objects: the only form of text that Zarr v3 stores by its specification."""
    return np.array([str(value) for value in values], dtype=object)


def coordinates(n_frames: int) -> dict[str, Any]:
    """Return the coordinates that every results Dataset shares: frame, parameter (with its units) and axis."""
    return {
        "frame": np.arange(n_frames),
        "parameter": ("parameter", texts(PARAMETERS)),
        "unit": ("parameter", texts(PARAMETER_UNITS)),
        "axis": ("axis", texts(AXES)),
        "motion_kind": ("motion_kind", texts(MOTIONS)),
    }


def validate(dataset: xr.Dataset, variables: dict[str, Variable], where: str) -> xr.Dataset:
    """Return ``dataset`` if it holds every declared variable with its dimensions.

    Raises
    ------
    StoreError
        Naming the first variable that is missing or laid out differently.
    """
    for name, variable in variables.items():
        if name not in dataset:
            raise StoreError(
                f"the Dataset has no {name!r}",
                where,
                f"variables {', '.join(variables)}",
                ", ".join(map(str, dataset.variables)),
                "Make it with the function that this stage offers",
            )
        if dataset[name].dims != variable.dims:
            raise StoreError(
                f"{name!r} is laid out differently",
                where,
                f"dimensions {variable.dims}",
                f"{dataset[name].dims}",
                "Transpose or rename its dimensions",
            )
    return dataset


def bad_frames(statistics: xr.Dataset, pixels: int) -> NDArray[np.bool_]:
    """Return which frames show nothing, (frames,): all their pixels are equal, or more than half of them are missing.

    Parameters
    ----------
    statistics
        :data:`STATISTICS` of the frames, or of sums of frames, which have no ``frame_std``.
    pixels
        Of a frame.
    """
    bad: NDArray[np.bool_] = statistics["frame_bad_pixels"].to_numpy() > 0.5 * pixels
    if "frame_std" in statistics:
        bad = bad | ~(statistics["frame_std"].to_numpy() > 0)
    return bad


def drift_of(drift: xr.Dataset | None, n_frames: int) -> NDArray[np.float64]:
    """Return the drift of every frame of a movie, (n_frames, 2) in px; zero where there is none.

    Raises
    ------
    SettingsError
        Where it is that of another movie.
    """
    if drift is None:
        return np.zeros((n_frames, 2))
    shift = validate(drift, DRIFT, "drift")["drift"].to_numpy().astype(np.float64)
    if len(shift) != n_frames:
        raise SettingsError(
            "the drift is of another movie", "drift", f"{n_frames} frames", f"{len(shift)}", "Measure it on this one"
        )
    return shift
