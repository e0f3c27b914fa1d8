"""What the job store reads and writes inside a transaction."""

from __future__ import annotations

import dataclasses
import json
import sqlite3
from collections.abc import Sequence
from typing import Any

from ..data_root import overlap
from .records import ConflictError, Job, JobEvent, UnknownJobError, UnknownVersionError, utc_now
from .states import ENDED, TRANSITIONS, State

AFRESH: dict[str, Any] = {"ended": None, "not_before": None, "lost_tries": 0, "outcome": {}}
"""What a job forgets when somebody queues it again."""

_JSON = ("settings", "progress", "outcome")


def to_job(row: sqlite3.Row) -> Job:
    """Return the job of a row of the table of jobs."""
    values = {item.name: row[item.name] for item in dataclasses.fields(Job)}
    values |= {name: json.loads(row[name]) for name in _JSON}
    return Job(**values | {"curate": bool(row["curate"]), "state": State(row["state"])})


def to_event(row: sqlite3.Row) -> JobEvent:
    """Return the event of a row; to the outside, that a job is deleted is of kind ``job``."""
    kind = "job" if row["kind"] == "deleted" else row["kind"]
    return JobEvent(row["id"], row["job_id"], row["time"], kind, json.loads(row["data"]))


def read_job(db: sqlite3.Connection, job_id: str) -> Job:
    """Return a job; raise UnknownJobError where there is none."""
    row = db.execute("SELECT * FROM jobs WHERE id = ?", (job_id,)).fetchone()
    if row is None:
        raise UnknownJobError("there is no such job", job_id[:40], remedy="See the list of jobs")
    return to_job(row)


def read_columns(db: sqlite3.Connection, job_id: str, version: int) -> str:
    """Return a version of a job's columns; raise UnknownVersionError where there is none."""
    row = db.execute("SELECT csv FROM columns WHERE job_id = ? AND version = ?", (job_id, version)).fetchone()
    if row is None:
        raise UnknownVersionError(
            "there is no such version of the columns", f"job {job_id}", remedy="See the job's list of versions"
        )
    return str(row["csv"])


def change_state(db: sqlite3.Connection, job_id: str, state: State, reason: str, fields: dict[str, Any]) -> Job:
    """Put a job into another state; raise ConflictError where that may not follow."""
    job, now = read_job(db, job_id), utc_now()
    if state not in TRANSITIONS[job.state]:
        raise ConflictError(
            f"a job that is {job.state} cannot become {state}",
            f"job {job_id}",
            f"one of {', '.join(sorted(TRANSITIONS[job.state]))}",
            state,
            "Check its state",
        )
    if job.state in ENDED:
        require_sole_output(db, job.output)
    changes: dict[str, Any] = {"state": state, "reason": reason, "cancel_reason": None}
    if state == State.RUNNING:
        changes |= {"started": job.started or now, "ended": None, "attempts": job.attempts + 1, "not_before": None}
        db.execute(
            "INSERT INTO owners (name, served) VALUES (?, ?) ON CONFLICT (name) DO UPDATE SET served = excluded.served",
            (job.owner, now),
        )
    if state in ENDED:
        changes["ended"] = now
    update(db, job_id, changes | fields)
    record_transition(db, job_id, reason, now)
    return tell(db, job_id, now)


def update(db: sqlite3.Connection, job_id: str, changes: dict[str, Any]) -> None:
    """Change columns of a job's row; their names come from here, never from a user."""
    known = {item.name for item in dataclasses.fields(Job)} | {"cancel_reason"}
    if not changes.keys() <= known:
        raise TypeError(f"a job has no {', '.join(sorted(changes.keys() - known))}")
    values = [json.dumps(value) if name in _JSON else value for name, value in changes.items()]
    names = ", ".join(f"{name} = ?" for name in changes)
    if db.execute(f"UPDATE jobs SET {names} WHERE id = ?", (*values, job_id)).rowcount == 0:
        read_job(db, job_id)


def require_sole_output(db: sqlite3.Connection, output: str) -> None:
    """Raise ConflictError where a job that has not ended writes to the folder ``output``, in it, or around it."""
    found = db.execute(f"SELECT id, output FROM jobs WHERE state NOT IN ({marks(ENDED)})", sorted(ENDED))
    other = next((row for row in found if overlap(row["output"], output)), None)
    if other:
        raise ConflictError(
            "another job writes to this folder",
            output,
            "a folder that no queued or running job writes to",
            f"job {other['id']}",
            "Choose another folder, or wait for that job to end",
        )


def record_transition(db: sqlite3.Connection, job_id: str, reason: str, now: str) -> None:
    """Note the state that a job is in now, with its reason."""
    db.execute(
        "INSERT INTO transitions (job_id, time, state, stage, reason)"
        " SELECT id, ?, state, stage, ? FROM jobs WHERE id = ?",
        (now, reason, job_id),
    )


def tell(db: sqlite3.Connection, job_id: str, now: str) -> Job:
    """Add the event of a changed job, and return the job."""
    job = read_job(db, job_id)
    add_event(db, job_id, "job", job.to_record(), now)
    return job


def tell_newest(db: sqlite3.Connection, job_id: str, kind: str, data: dict[str, Any]) -> None:
    """Add an event of which only the newest is kept."""
    db.execute("DELETE FROM events WHERE job_id = ? AND kind = ?", (job_id, kind))
    add_event(db, job_id, kind, data)


def add_event(db: sqlite3.Connection, job_id: str, kind: str, data: dict[str, Any], now: str | None = None) -> None:
    """Add an event; its number is above those of all before."""
    db.execute(
        "INSERT INTO events (job_id, time, kind, data) VALUES (?, ?, ?, ?)",
        (job_id, now or utc_now(), kind, json.dumps(data)),
    )


def require(job: Job, states: frozenset[State], what: str) -> None:
    """Raise ConflictError where a job is in none of ``states``, and so cannot be ``what``."""
    if job.state not in states:
        raise ConflictError(
            f"a job that is {job.state} cannot be {what}",
            f"job {job.id}",
            f"one that is {', '.join(sorted(states))}",
            job.state,
            "Wait for it to end, or cancel it"
            if job.state in (State.RUNNING, State.QUEUED)
            else "Nothing is left to do",
        )


def conditions(owner: str, text: str) -> tuple[list[str], list[Any]]:
    """Return conditions, and the values that stand for their question marks."""
    where, values = ["TRUE"], list[Any]()
    if owner:
        where.append("owner = ?")
        values.append(owner)
    if text:
        escaped = text.replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_")
        where.append("(" + " OR ".join(f"{name} LIKE ? ESCAPE '\\'" for name in _SEARCHED) + ")")
        values += [f"%{escaped}%"] * len(_SEARCHED)
    return where, values


_SEARCHED = ("label", "source", "owner", "id")


def marks(values: Sequence[object] | frozenset[State]) -> str:
    """Return a question mark for each value."""
    return ", ".join("?" * len(values))
