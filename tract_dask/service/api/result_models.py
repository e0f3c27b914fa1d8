"""What the routes of the results answer with; null stands for what is not known."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

Number = float | None
Numbers = list[float | None]

_UNIT = "Of lengths: pm, or px where the size of a pixel is not known."
_TIME_UNIT = "Of times: s, or frames where the time of one is not known."


class Answer(BaseModel):
    """What every answer has."""

    version: str = Field(description="Another once more shards are done.", examples=["0f3a9c1122334455"])


class Share(BaseModel):
    """How much of something is done."""

    done: int
    total: int


class Summary(Answer):
    """How much is done, what was measured, and how."""

    complete: bool = Field(description="Whether every frame is fitted.")
    shards: Share
    frames: Share
    columns: int
    fits: int = Field(description="Fits that were made.")
    accepted: int = Field(description="Fits that nothing speaks against.")
    pixel_size_pm: Number
    frame_time_s: Number
    last_time: float = Field(description="Of the last frame, in ``time_unit``, from the first one on.")
    dose: Number = Field(description="Of one frame, e/A^2.")
    unit: str = Field(description=_UNIT)
    time_unit: str = Field(description=_TIME_UNIT)
    window_px: int | None = Field(description="Side of the windows that were fitted, px.")
    source: str
    created: str | None = Field(description="UTC, ISO 8601.")
    versions: dict[str, str] = Field(description="Of the packages that measured.")
    settings: dict[str, dict[str, Any]] = Field(description="By group and name.")
    bytes: dict[str, int] = Field(description="Sizes of downloads by format, estimated.")


class ColumnRow(BaseModel):
    """The numbers of a column, over its accepted fits."""

    column_id: int
    x: float = Field(description="Place in the summed image, px.")
    y: float
    kind: str = Field(description="Sublattice or element, free text.")
    fits: int
    accepted: int
    sd: Number = Field(description="Standard deviation per axis: root mean square of those along x and y.")
    sd_x: Number
    sd_y: Number
    stated: Number = Field(description="Root mean square of the standard errors that the fits state, per axis.")
    accepted_share: Number = Field(description="0 to 1.")
    intensity: Number = Field(description="Mean, counts.")


class ColumnNumbers(Answer):
    """The numbers of all columns."""

    unit: str = Field(description=_UNIT)
    columns: list[ColumnRow]


class Series(Answer):
    """One column in time. An accepted fit's place is drift-corrected."""

    model_config = ConfigDict(extra="allow")

    column_id: int
    kind: str
    x_ref: float = Field(description="Place in the summed image, px.")
    y_ref: float
    unit: str = Field(description=_UNIT)
    time_unit: str = Field(description=_TIME_UNIT)
    frames_per_point: int
    frame: list[int] = Field(description="First frame of each point.")
    t: Numbers = Field(description="Middle of each point.")
    accepted: list[int] = Field(description="Accepted fits of each point.")
    x: Numbers = Field(description="Mean place, px; like all means null where no fit is accepted.")
    x_stderr: Numbers = Field(description="Standard error of the mean.")
    x_low: Numbers | None = Field(None, description="Smallest of the fits; only where several frames make a point.")
    x_high: Numbers | None = None
    y: Numbers
    y_stderr: Numbers
    y_low: Numbers | None = None
    y_high: Numbers | None = None
    dx: Numbers = Field(description="x from the place in the summed image, in ``unit``.")
    dx_stderr: Numbers
    dx_low: Numbers | None = None
    dx_high: Numbers | None = None
    dy: Numbers
    dy_stderr: Numbers
    dy_low: Numbers | None = None
    dy_high: Numbers | None = None
    intensity: Numbers = Field(description="Counts.")
    intensity_stderr: Numbers
    intensity_low: Numbers | None = None
    intensity_high: Numbers | None = None


class FrameNumbers(Answer):
    """Curves over the frames; null where they are not done."""

    time_unit: str = Field(description=_TIME_UNIT)
    pixel_size_pm: Number
    frames_per_point: int
    frame: list[int] = Field(description="First frame of each point.")
    t: Numbers = Field(description="Middle of each point.")
    drift_x: Numbers = Field(description="Shift of the frame against the summed image, px.")
    drift_y: Numbers
    accepted_share: Numbers = Field(description="0 to 1.")
    amplitude: Numbers = Field(description="Mean amplitude of accepted fits, counts.")


class DisplacementRow(BaseModel):
    """How far a column moved."""

    column_id: int
    x: float = Field(description="Place in the summed image, px.")
    y: float
    dx: Number
    dy: Number
    stderr_x: Number
    stderr_y: Number
    distance: Number
    p_value: Number = Field(description="Probability of as much or more without motion.")


class Displacements(Answer):
    """How far the columns moved from one frame to another; null where a fit is not accepted."""

    first: int
    second: int
    unit: str = Field(description=_UNIT)
    columns: list[DisplacementRow]


class Prepared(BaseModel):
    """Whether a download is ready."""

    ready: bool
    bytes: int | None = Field(None, description="Size of the file, once it is there.")
