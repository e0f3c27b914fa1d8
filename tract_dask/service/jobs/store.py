"""The jobs on disk: the truth of the service, which it finds again however it ended.

One SQLite file in write-ahead mode. Every thread has a connection of its own, and several processes may use the file.
A job's record, its transitions and its events change together, in one transaction.
"""

from __future__ import annotations

import json
import secrets
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from . import rows
from .records import ConflictError, Deletion, Job, JobEvent, UnknownJobError, UnknownVersionError, utc_now
from .states import CURATABLE, RETRYABLE, State
from .tables import JobStoreError, check_place, create, migrate, store_error

__all__ = ["ConflictError", "Job", "JobEvent", "JobStore", "JobStoreError", "UnknownJobError", "UnknownVersionError"]

BUSY_TIMEOUT_S = 30.0
KEPT_LINES = 2000
"""Lines of a job's log; older ones go."""

KEPT_DELETIONS = 1000
"""Events that tell of deleted jobs; older ones go."""


class JobStore:
    """The jobs in the SQLite file at ``path``, which is made if it is not there.

    Raises
    ------
    JobStoreError
        Where the file was written by a newer version, is damaged or another program's, or cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._local = threading.local()
        check_place(path)
        try:
            if not path.exists():
                create(path)
            migrate(self.connection(), path)
        except sqlite3.Error as error:
            raise store_error(path, error) from error

    def connection(self) -> sqlite3.Connection:
        """Return this thread's connection; it closes with the thread."""
        found: sqlite3.Connection | None = getattr(self._local, "connection", None)
        if found is None:
            found = sqlite3.connect(self.path, timeout=BUSY_TIMEOUT_S, isolation_level=None)
            found.row_factory = sqlite3.Row
            found.execute("PRAGMA journal_mode = WAL")
            found.execute("PRAGMA synchronous = FULL")  # what was acknowledged outlives the machine's power
            found.execute("PRAGMA foreign_keys = ON")
            self._local.connection = found
        return found

    def close(self) -> None:
        """Close this thread's connection."""
        found: sqlite3.Connection | None = getattr(self._local, "connection", None)
        if found is not None:
            self._local.connection = None
            found.close()

    @contextmanager
    def writing(self) -> Iterator[sqlite3.Connection]:
        """Hold the write lock for a transaction: all of it is kept, or nothing."""
        db = self.connection()
        db.execute("BEGIN IMMEDIATE")
        try:
            yield db
        except BaseException:
            db.execute("ROLLBACK")
            raise
        db.execute("COMMIT")

    def submit(
        self,
        *,
        source: str,
        settings: dict[str, Any],
        owner: str,
        label: str = "",
        output: str = "",
        curate: bool = False,
        content: str = "",
    ) -> Job:
        """Add a job to the queue; without ``output`` it gets a folder of its own under ``jobs``.

        Raises
        ------
        ConflictError
            Where a job that has not ended writes to the same folder.
        """
        name, now = secrets.token_hex(5), utc_now()
        output = output or f"jobs/{name}"
        with self.writing() as db:
            rows.require_sole_output(db, output)
            db.execute(
                "INSERT INTO jobs (id, label, owner, source, output, settings, curate, state, created, content)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (name, label, owner, source, output, json.dumps(settings), curate, State.QUEUED, now, content),
            )
            rows.record_transition(db, name, "submitted", now)
            return rows.tell(db, name, now)

    def job(self, job_id: str) -> Job:
        """Return a job.

        Raises
        ------
        UnknownJobError
            Where there is none of this name.
        """
        return rows.read_job(self.connection(), job_id)

    def jobs(
        self,
        *,
        states: Sequence[State] = (),
        owner: str = "",
        text: str = "",
        before: int | None = None,
        limit: int = 50,
    ) -> list[Job]:
        """Return jobs, newest first; those numbered below ``before``, with ``text`` in label, source, owner or id."""
        where, values = rows.conditions(owner, text)
        if states:
            where.append(f"state IN ({rows.marks(states)})")
            values += list(states)
        if before is not None:
            where.append("number < ?")
            values.append(before)
        found = self.connection().execute(
            f"SELECT * FROM jobs WHERE {' AND '.join(where)} ORDER BY number DESC LIMIT ?", (*values, limit)
        )
        return [rows.to_job(row) for row in found]

    def counts(self, *, owner: str = "", text: str = "") -> dict[State, int]:
        """Return how many jobs are in each state."""
        where, values = rows.conditions(owner, text)
        groups = self.connection().execute(
            f"SELECT state, COUNT(*) AS n FROM jobs WHERE {' AND '.join(where)} GROUP BY state", values
        )
        found = {row["state"]: row["n"] for row in groups}
        return {state: found.get(state, 0) for state in State}

    def queued(self) -> list[Job]:
        """Return the jobs in the queue, oldest first."""
        return self._in_state(State.QUEUED)

    def running(self) -> list[Job]:
        """Return the jobs that run, oldest first."""
        return self._in_state(State.RUNNING)

    def served(self) -> dict[str, str]:
        """Return when a job of each owner was last started."""
        return {row["name"]: row["served"] for row in self.connection().execute("SELECT name, served FROM owners")}

    def change(self, job_id: str, state: State, reason: str = "", **fields: Any) -> Job:
        """Put a job into another state, and record it; ``fields`` of :class:`Job` change with it.

        Raises
        ------
        UnknownJobError
            Where there is no such job.
        ConflictError
            Where ``state`` may not follow the state that it has.
        """
        with self.writing() as db:
            return rows.change_state(db, job_id, state, reason, fields)

    def transitions(self, job_id: str) -> list[dict[str, Any]]:
        """Return every change of a job's state: time, state, stage, reason; oldest first."""
        found = self.connection().execute(
            "SELECT time, state, stage, reason FROM transitions WHERE job_id = ? ORDER BY id",
            (self.job(job_id).id,),
        )
        return [dict(row) for row in found]

    def progress(self, job_id: str, data: dict[str, Any]) -> None:
        """Note how far a job is; its event takes the place of the one before."""
        with self.writing() as db:
            rows.update(db, job_id, {"progress": data})
            rows.tell_newest(db, job_id, "progress", data)

    def workers(self, job_id: str, data: dict[str, Any]) -> None:
        """Note what a job's workers do; the event takes the place of the one before."""
        with self.writing() as db:
            rows.read_job(db, job_id)
            rows.tell_newest(db, job_id, "workers", data)

    def log(self, job_id: str, level: str, message: str) -> None:
        """Add a line to a job's log."""
        with self.writing() as db:
            rows.read_job(db, job_id)
            rows.add_event(db, job_id, "log", {"level": level, "message": message})
            db.execute(
                "DELETE FROM events WHERE job_id = ? AND kind = 'log' AND id <="
                " (SELECT id FROM events WHERE job_id = ? AND kind = 'log' ORDER BY id DESC LIMIT 1 OFFSET ?)",
                (job_id, job_id, KEPT_LINES),
            )

    def stage(self, job_id: str, stage: str) -> Job:
        """Note the stage that a job is in."""
        with self.writing() as db:
            rows.update(db, job_id, {"stage": stage})
            return rows.tell(db, job_id, utc_now())

    def label(self, job_id: str, label: str) -> Job:
        """Give a job another label."""
        with self.writing() as db:
            rows.update(db, job_id, {"label": label})
            return rows.tell(db, job_id, utc_now())

    def request_cancel(self, job_id: str, reason: str) -> Job:
        """Cancel a job: at once, or as soon as its process has ended.

        Raises
        ------
        ConflictError
            Where it has ended.
        """
        with self.writing() as db:
            job = rows.read_job(db, job_id)
            if job.state != State.RUNNING:
                return rows.change_state(db, job_id, State.CANCELLED, reason, {})
            rows.update(db, job_id, {"cancel_reason": reason, "reason": "cancelling"})
            return rows.tell(db, job_id, utc_now())

    def cancel_requested(self, job_id: str) -> bool:
        """Tell whether a running job is to be cancelled."""
        return self.cancel_reason(job_id) is not None

    def cancel_reason(self, job_id: str) -> str | None:
        """Return why a running job is to be cancelled; None where it is not."""
        row = self.connection().execute("SELECT cancel_reason FROM jobs WHERE id = ?", (job_id,)).fetchone()
        return None if row is None else row["cancel_reason"]

    def retry(self, job_id: str) -> Job:
        """Queue a job again that failed, was cancelled, or could not fit some frames.

        Raises
        ------
        ConflictError
            Where it is in another state, or another job writes to its folder.
        """
        with self.writing() as db:
            rows.require(rows.read_job(db, job_id), RETRYABLE, "tried again")
            return rows.change_state(db, job_id, State.QUEUED, "tried again on request", rows.AFRESH)

    def go_on(self, job_id: str, version: int) -> Job:
        """Queue a job that waits for columns, or has ended, with a version of its columns (0: the automatic ones).

        Raises
        ------
        ConflictError
            Where it is in another state, or another job writes to its folder.
        UnknownVersionError
            Where there is no such version.
        """
        with self.writing() as db:
            rows.require(rows.read_job(db, job_id), CURATABLE, "continued")
            if version:
                rows.read_columns(db, job_id, version)
            what = f"version {version} of the columns" if version else "the columns found automatically"
            return rows.change_state(
                db, job_id, State.QUEUED, f"goes on with {what}", {**rows.AFRESH, "columns_version": version}
            )

    def delete(self, job_id: str, *, files: bool = False) -> None:
        """Forget a job, with all that is known of it here.

        Parameters
        ----------
        files
            Note that its files are to go, too: :meth:`deletions` tells of them until :meth:`end_deletion`.

        Raises
        ------
        ConflictError
            Where it runs.
        """
        with self.writing() as db:
            rows.require(job := rows.read_job(db, job_id), frozenset(State) - {State.RUNNING}, "deleted")
            if files:
                db.execute(
                    "INSERT INTO deletions (job_id, owner, output) VALUES (?, ?, ?)", (job_id, job.owner, job.output)
                )
            db.execute("DELETE FROM jobs WHERE id = ?", (job_id,))
            db.execute("DELETE FROM events WHERE job_id = ?", (job_id,))
            rows.add_event(db, job_id, "deleted", {"id": job_id, "deleted": True})
            db.execute(
                "DELETE FROM events WHERE kind = 'deleted' AND id <="
                " (SELECT id FROM events WHERE kind = 'deleted' ORDER BY id DESC LIMIT 1 OFFSET ?)",
                (KEPT_DELETIONS,),
            )

    def deletions(self) -> list[Deletion]:
        """Return the files of deleted jobs that are still to go."""
        return [Deletion(**row) for row in self.connection().execute("SELECT job_id, owner, output FROM deletions")]

    def end_deletion(self, job_id: str) -> None:
        """Note that the files of a deleted job are gone, or are to stay."""
        with self.writing() as db:
            db.execute("DELETE FROM deletions WHERE job_id = ?", (job_id,))

    def events(self, after: int = 0, job_id: str | None = None, limit: int = 1000) -> list[JobEvent]:
        """Return what happened after the event ``after``, to one job or to all, oldest first."""
        where, values = ("id > ? AND job_id = ?", [after, job_id]) if job_id else ("id > ?", [after])
        found = self.connection().execute(f"SELECT * FROM events WHERE {where} ORDER BY id LIMIT ?", (*values, limit))
        return [rows.to_event(row) for row in found]

    def newest_event(self) -> int:
        """Return the number of the newest event; 0 where nothing has happened."""
        return int(self.connection().execute("SELECT COALESCE(MAX(id), 0) FROM events").fetchone()[0])

    def log_of(self, job_id: str, after: int = 0, limit: int = 1000) -> list[JobEvent]:
        """Return the lines of a job's log after the event ``after``, oldest first."""
        found = self.connection().execute(
            "SELECT * FROM events WHERE job_id = ? AND kind = 'log' AND id > ? ORDER BY id LIMIT ?",
            (self.job(job_id).id, after, limit),
        )
        return [rows.to_event(row) for row in found]

    def add_columns(self, job_id: str, csv: str, author: str, note: str = "") -> int:
        """Keep a table of columns as the next version; return its number, from 1."""
        count = max(0, sum(bool(line.strip()) for line in csv.splitlines()) - 1)
        with self.writing() as db:
            rows.read_job(db, job_id)
            newest = db.execute("SELECT COALESCE(MAX(version), 0) FROM columns WHERE job_id = ?", (job_id,))
            version = int(newest.fetchone()[0]) + 1
            db.execute(
                "INSERT INTO columns (job_id, version, time, author, note, count, csv) VALUES (?, ?, ?, ?, ?, ?, ?)",
                (job_id, version, utc_now(), author, note, count, csv),
            )
        return version

    def columns_versions(self, job_id: str) -> list[dict[str, Any]]:
        """Return the versions of a job's columns: version, time, author, note, count; oldest first."""
        found = self.connection().execute(
            "SELECT version, time, author, note, count FROM columns WHERE job_id = ? ORDER BY version",
            (self.job(job_id).id,),
        )
        return [dict(row) for row in found]

    def columns(self, job_id: str, version: int) -> str:
        """Return a version of a job's columns, as a CSV table.

        Raises
        ------
        UnknownVersionError
            Where there is no such version.
        """
        return rows.read_columns(self.connection(), self.job(job_id).id, version)

    def _in_state(self, state: State) -> list[Job]:
        found = self.connection().execute("SELECT * FROM jobs WHERE state = ? ORDER BY number", (state,))
        return [rows.to_job(row) for row in found]
