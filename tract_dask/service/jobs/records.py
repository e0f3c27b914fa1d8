"""A job, its events and its deletion, and times as the store writes them.

Times are UTC, ISO 8601 with milliseconds, so that the texts sort as the times do.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

from ...errors import InputError
from .states import State


def utc_now(later_s: float = 0.0) -> str:
    """Return the time now, or ``later_s`` seconds later.

    Examples
    --------
    >>> len(utc_now()) == len("2026-01-31T12:00:00.000Z"), utc_now() < utc_now(later_s=1.0)
    (True, True)
    """
    time = datetime.now(UTC) + timedelta(seconds=later_s)
    return time.isoformat(timespec="milliseconds").replace("+00:00", "Z")


class UnknownJobError(InputError):
    """There is no such job."""


class UnknownVersionError(InputError):
    """There is no such version of a job's columns."""


class ConflictError(InputError):
    """The job's state does not allow this."""


@dataclass(frozen=True, kw_only=True)
class PublicJob:
    """A job as the API and its clients know it; the one list of its fields.

    Descriptions are those of the API's document.
    """

    id: str = field(metadata={"description": "10 hexadecimal digits."})
    number: int = field(metadata={"description": "Order of submission."})
    label: str
    owner: str
    source: str = field(metadata={"description": "The movie, relative to the data root."})
    output: str = field(metadata={"description": "The folder of its results, relative to the data root."})
    settings: dict[str, Any] = field(metadata={"description": "By group and name; what is not here has its default."})
    curate: bool = field(
        metadata={"description": "Whether it stops after the summed image, for columns to be edited by hand."}
    )
    state: State
    reason: str = field(metadata={"description": "Why it is in this state, where that needs saying."})
    stage: str
    created: str = field(metadata={"description": "UTC, ISO 8601."})
    started: str | None
    ended: str | None
    attempts: int
    progress: dict[str, Any]
    outcome: dict[str, Any]
    columns_version: int | None = field(
        metadata={
            "description": "Version of the columns that is fitted; 0: those found automatically; null: none chosen yet."
        }
    )
    not_before: str | None = field(
        default=None, metadata={"description": "When a job whose cluster was lost is tried again."}
    )


@dataclass(frozen=True, kw_only=True)
class Job(PublicJob):
    """A job as it stands in the store.

    Attributes
    ----------
    settings
        Nested, as :func:`tract_dask.settings.to_dict` returns them; without the cluster.
    stage
        The stage that it is in, or ended in: one of :data:`tract_dask.progress.STAGES` or ``report``; or empty.
    created, started, ended
        With milliseconds; ``started`` for the first time.
    progress, outcome
        As :class:`tract_dask.service.runner.timeline.Timeline` and :class:`tract_dask.run.pipeline.RunOutcome` tell
        them.
    lost_tries
        How often its cluster was lost since it last got any further.
    content
        A hash of what its movie held when it was submitted; "" of jobs of earlier versions.
    """

    lost_tries: int
    content: str = ""

    def to_record(self) -> dict[str, Any]:
        """Return the job as a JSON-ready mapping."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class Deletion:
    """The files of a job that was deleted with them; ``output`` is relative to the data root."""

    job_id: str
    owner: str
    output: str


@dataclass(frozen=True)
class JobEvent:
    """Something that happened to a job.

    ``kind`` is ``job`` (data: the job's record, or that it is deleted), ``progress``, ``workers`` or ``log``.
    """

    id: int
    job_id: str
    time: str
    kind: str
    data: dict[str, Any]
