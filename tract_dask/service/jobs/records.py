"""Times as the store writes them: UTC, ISO 8601 with milliseconds, so that the texts sort as the times do."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Job:
    """A job as it stands.

    Attributes
    ----------
    number
        Order of submission.
    source, output
        Relative to the data root, with "/" between folders.
    settings
        Nested, as :func:`tract_dask.settings.to_dict` returns them; without the cluster.
    curate
        Whether it stops for columns after the summed image.
    stage
        The stage that it is in, or ended in: one of :data:`tract_dask.progress.STAGES` or ``report``; or empty.
    created, started, ended
        UTC, ISO 8601 with milliseconds; ``started`` for the first time.
    attempts
        How often it has been started.
    progress, outcome
        As :class:`tract_dask.service.runner.timeline.Timeline` and :class:`tract_dask.run.pipeline.RunOutcome` tell
        them.
    columns_version
        Of the columns that are fitted; 0: those found automatically; None: nobody has chosen.
    not_before
        When a job whose cluster was lost is tried again.
    lost_tries
        How often its cluster was lost since it last got any further.
    """

    id: str
    number: int
    label: str
    owner: str
    source: str
    output: str
    settings: dict[str, Any]
    curate: bool
    state: State
    reason: str
    stage: str
    created: str
    started: str | None
    ended: str | None
    attempts: int
    progress: dict[str, Any]
    outcome: dict[str, Any]
    columns_version: int | None
    not_before: str | None
    lost_tries: int

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
