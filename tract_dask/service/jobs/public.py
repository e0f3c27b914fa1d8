"""A job as the API shows it."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints, model_validator
from pydantic.dataclasses import dataclass as pydantic_dataclass

from .records import Job, PublicJob

MAX_ITEMS, MAX_DEPTH, MAX_TEXT = 20_000, 6, 4096
"""Values in the settings of a request, how deep they may be nested, and characters of one text."""

_NOT_PLAIN = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


def plain_text(text: str) -> str:
    """Return ``text`` if it can be stored and shown.

    Raises
    ------
    ValueError
        Where it has control characters or halves of characters (lone surrogates).
    """
    if _NOT_PLAIN.search(text):
        raise ValueError("the text has control characters or halves of characters")
    return text


def plain_number(value: Any) -> Any:
    """Return ``value`` if it is neither a text nor a truth value, which would count as numbers otherwise.

    Raises
    ------
    ValueError
        Where it is.
    """
    if isinstance(value, str | bool):
        raise ValueError("a number is needed")
    return value


def plain_values(value: dict[str, Any]) -> dict[str, Any]:
    """Return ``value`` if it is a bounded tree of plain JSON values.

    Raises
    ------
    ValueError
        Where a number is not finite or a text not plain, or there is too much of anything.
    """
    left, level = MAX_ITEMS, [("settings", value)]
    for _ in range(MAX_DEPTH):
        left -= len(level)
        if left < sum(_count(item) for _, item in level):
            raise ValueError(f"these are more than {MAX_ITEMS} values")
        level = [part for name, item in level for part in _parts(name, item)]
    if level:
        raise ValueError(f"{level[0][0]}: the values are nested more than {MAX_DEPTH} deep")
    return value


def _count(value: Any) -> int:
    """Return how many parts a value has; see :func:`_parts`."""
    return len(value) * (1 + isinstance(value, dict)) if isinstance(value, dict | list) else 0


def _parts(name: str, value: Any) -> list[tuple[str, Any]]:
    """Return what a value consists of, with names; a text, a number or nothing has no parts."""
    match value:
        case dict():
            return [*((name, key) for key in value), *((f"{name}.{key[:80]}", part) for key, part in value.items())]
        case list():
            return [(f"{name}[{k}]", part) for k, part in enumerate(value)]
        case str() if len(value) > MAX_TEXT:
            raise ValueError(f"{name}: a text has more than {MAX_TEXT} characters")
        case str():
            plain_text(value)
        case float() if not math.isfinite(value):
            raise ValueError(f"{name}: a number is not finite")
        case int() if abs(value) > 2**53:
            raise ValueError(f"{name}: a whole number is beyond 2^53")
    return []


Text = Annotated[
    str, AfterValidator(plain_text), Field(json_schema_extra={"pattern": "^[^\\u0000-\\u001f\\u007f-\\u009f]*$"})
]

Plain = BeforeValidator(plain_number)
"""Of a number in a body."""

Label = Annotated[Text, StringConstraints(max_length=200)]

EXAMPLE_JOB: dict[str, Any] = {
    "id": "3f9a0c12de",
    "number": 17,
    "label": "CeO2, 500 e/A^2",
    "owner": "maria",
    "source": "2026-11/ceo2_surface.tif",
    "output": "jobs/3f9a0c12de",
    "settings": {"metadata": {"pixel_size_pm": 8.0}, "fit": {"window_px": 25}},
    "curate": False,
    "state": "running",
    "reason": "",
    "stage": "fit",
    "created": "2026-11-22T10:00:00.000Z",
    "started": "2026-11-22T10:00:01.250Z",
    "ended": None,
    "attempts": 1,
    "progress": {
        "stage": "fit",
        "done_frames": 512,
        "frames": 2048,
        "passes": 1,
        "fits": 61440,
        "frames_per_s": 210.5,
        "fits_per_s": 25260.0,
        "seconds_left": 7.3,
        "fraction": 0.71,
        "stages": {
            "convert": {
                "state": "done",
                "seconds": 4.2,
                "started": "2026-11-22T10:00:01.300Z",
                "ended": "2026-11-22T10:00:05.500Z",
                "frames": 2048,
                "done_frames": 2048,
                "summary": "",
            }
        },
    },
    "outcome": {},
    "columns_version": None,
    "not_before": None,
}


class StageRecord(BaseModel):
    """How far a stage of a job is."""

    state: Literal["pending", "running", "done", "reused"]
    seconds: float | None = Field(None, description="Time that it took, in s.")
    started: str | None = Field(None, description="UTC, ISO 8601.")
    ended: str | None = None
    frames: int = 0
    done_frames: int = 0
    summary: str = ""


class ProgressRecord(BaseModel):
    """How far a job is."""

    stage: str = ""
    done_frames: int = Field(0, description="Frames of the stage that are done; a frame counts once in every pass.")
    frames: int = 0
    passes: int = 1
    fits: int = 0
    frames_per_s: float | None = None
    fits_per_s: float | None = None
    seconds_left: float | None = Field(None, description="Estimated time to the end of the stage, in s.")
    fraction: float = Field(0.0, description="Of the whole run, 0 to 1.")
    stages: dict[str, StageRecord] = Field(default_factory=dict)


class OutcomeRecord(BaseModel):
    """What a job measured; nothing of it is set before the end."""

    frames: int | None = None
    columns: int | None = None
    fits: int | None = None
    accepted: int | None = None
    bad_frames: int | None = None
    seconds: dict[str, float] | None = Field(None, description="Time of every stage that worked, in s.")


@pydantic_dataclass(frozen=True, kw_only=True, config=ConfigDict(json_schema_extra={"example": EXAMPLE_JOB}))
class JobRecord(PublicJob):
    """A job."""

    progress: ProgressRecord  # type: ignore[assignment]  # over the wire with all its defaults
    outcome: OutcomeRecord  # type: ignore[assignment]

    @model_validator(mode="before")
    @classmethod
    def _of_job(cls, value: Any) -> Any:
        return vars(value) if isinstance(value, Job) else value
