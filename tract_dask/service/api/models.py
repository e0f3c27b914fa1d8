"""What goes over the wire: the requests, the answers, and the errors, each with its limits and an example."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Path, Query
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints, WithJsonSchema
from pydantic.dataclasses import dataclass as pydantic_dataclass

from ..errors import ERRORS
from ..jobs.public import EXAMPLE_JOB, JobRecord, Label, Text, plain_values
from ..jobs.states import State
from .settings_schema import settings_schema

Shape = Annotated[list[int], Field(min_length=3, max_length=3, description="Frames, rows and columns.")]

RelativePath = Annotated[Text, StringConstraints(max_length=1024)]

SettingValues = Annotated[
    dict[str, dict[str, Any]],
    AfterValidator(plain_values),
    WithJsonSchema(settings_schema()),
]

JobId = Annotated[str, Path(pattern="^[0-9a-f]{10}$", description="The job's id.", examples=["3f9a0c12de"])]

After = Annotated[int, Query(ge=0, le=2**53, description="Only what came after the event of this number.")]


def errors(*codes: int) -> dict[int | str, dict[str, Any]]:
    """Return the declaration of the errors that a route can answer: these, and what any request may meet."""
    return {code: ERRORS[code] for code in sorted({401, 403, 413, 422, 500, *codes})}


class Transition(BaseModel):
    """A change of a job's state or stage."""

    time: str
    state: State
    stage: str
    reason: str


_Event = Annotated[
    int, Field(description="Number of the newest event when this was read: subscribe to what comes after it.")
]

_EXAMPLE_DETAIL = EXAMPLE_JOB | {
    "transitions": [{"time": "2026-11-22T10:00:00.000Z", "state": "queued", "stage": "", "reason": "submitted"}],
    "links": {"self": "/api/v1/jobs/3f9a0c12de"},
    "event": 311,
}


@pydantic_dataclass(frozen=True, kw_only=True, config=ConfigDict(json_schema_extra={"example": _EXAMPLE_DETAIL}))
class JobDetail(JobRecord):
    """A job with its history, and where the rest of it is found."""

    transitions: list[Transition]
    links: dict[str, str]
    event: _Event


class JobList(BaseModel):
    """A page of jobs, the newest first."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {"jobs": [EXAMPLE_JOB], "counts": {"queued": 3, "running": 1}, "next": None, "event": 311}
        }
    )

    jobs: list[JobRecord]
    counts: dict[State, int] = Field(description="Jobs by state, of all that owner and text let through.")
    next: int | None = Field(description="What to give as ``before`` for the next page; null: this is the last.")
    event: _Event


class NewJob(BaseModel):
    """A job to be done."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {
                "source": "2026-11/ceo2_surface.tif",
                "settings": {"metadata": {"pixel_size_pm": 8.0}},
                "label": "CeO2, 500 e/A^2",
                "curate": True,
            }
        },
    )

    source: RelativePath = Field(
        min_length=1,
        description="The movie: a file, file.h5::/path/in/file, a folder or a pattern below the data root.",
    )
    settings: SettingValues = Field(default_factory=dict, description="By group and name; the rest has its default.")
    label: Label = ""
    output: RelativePath = Field(
        "", description="A folder under the data root, new or made by a job of yours; empty: one below jobs/."
    )
    curate: bool = Field(
        False, strict=True, description="Stop after the summed image, for columns to be edited by hand."
    )


class NewLabel(BaseModel):
    """Another label for a job."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"label": "second try"}})

    label: Label


class Deleted(BaseModel):
    """What was deleted."""

    model_config = ConfigDict(json_schema_extra={"example": {"id": "3f9a0c12de", "files": False, "kept": ""}})

    id: str
    files: bool = Field(description="Whether its folder went with it.")
    kept: str = Field(description="Why the folder was kept although it was to go; empty: it was not to go, or it went.")


class LogLine(BaseModel):
    """A line of a job's log."""

    id: int
    time: str
    level: str
    message: str


class Log(BaseModel):
    """A part of a job's log, in the order of time."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "lines": [
                    {"id": 12, "time": "2026-11-22T10:00:01.250Z", "level": "info", "message": "convert: 2048 frames"}
                ],
                "next": None,
            }
        }
    )

    lines: list[LogLine]
    next: int | None = Field(description="What to give as ``after`` for what follows; null: there is no more.")
