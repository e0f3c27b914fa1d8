"""The tables of the job store, and how older files are brought to them."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from ...errors import StoreError

_FIRST = """
CREATE TABLE jobs (
    number INTEGER PRIMARY KEY AUTOINCREMENT,
    id TEXT NOT NULL UNIQUE,
    label TEXT NOT NULL,
    owner TEXT NOT NULL,
    source TEXT NOT NULL,
    output TEXT NOT NULL,
    settings TEXT NOT NULL,
    curate INTEGER NOT NULL,
    state TEXT NOT NULL,
    reason TEXT NOT NULL DEFAULT '',
    stage TEXT NOT NULL DEFAULT '',
    created TEXT NOT NULL,
    started TEXT,
    ended TEXT,
    attempts INTEGER NOT NULL DEFAULT 0,
    progress TEXT NOT NULL DEFAULT '{}',
    outcome TEXT NOT NULL DEFAULT '{}',
    columns_version INTEGER,
    not_before TEXT,
    lost_tries INTEGER NOT NULL DEFAULT 0,
    cancel_reason TEXT
);
CREATE INDEX jobs_by_state ON jobs (state, number);
CREATE INDEX jobs_by_owner ON jobs (owner, state, number);
CREATE INDEX jobs_by_output ON jobs (output, state);
CREATE TABLE transitions (
    id INTEGER PRIMARY KEY,
    job_id TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    time TEXT NOT NULL,
    state TEXT NOT NULL,
    stage TEXT NOT NULL,
    reason TEXT NOT NULL
);
CREATE INDEX transitions_by_job ON transitions (job_id, id);
CREATE TABLE events (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    job_id TEXT NOT NULL,
    time TEXT NOT NULL,
    kind TEXT NOT NULL,
    data TEXT NOT NULL
);
CREATE INDEX events_by_job ON events (job_id, kind, id);
CREATE INDEX events_by_kind ON events (id) WHERE kind = 'deleted';
CREATE TABLE columns (
    job_id TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    version INTEGER NOT NULL,
    time TEXT NOT NULL,
    author TEXT NOT NULL,
    note TEXT NOT NULL,
    count INTEGER NOT NULL,
    csv TEXT NOT NULL,
    PRIMARY KEY (job_id, version)
) WITHOUT ROWID;
CREATE TABLE owners (
    name TEXT PRIMARY KEY,
    served TEXT NOT NULL
) WITHOUT ROWID;
"""

MIGRATIONS = (_FIRST,)
"""The steps from each version to the next; a file's version is how many of them it has had."""


def migrate(db: sqlite3.Connection, path: Path) -> None:
    """Bring the store at ``path`` to the newest version, step by step; several processes may try at once.

    Raises
    ------
    StoreError
        Where a newer version of the program has written it.
    """
    while (version := _version(db)) != len(MIGRATIONS):
        if version > len(MIGRATIONS):
            raise StoreError(
                "the job store is of a newer version",
                str(path),
                f"version {len(MIGRATIONS)} or older",
                f"version {version}",
                "Update tract_dask, or choose another data root",
            )
        db.execute("BEGIN IMMEDIATE")
        try:
            if _version(db) == version:
                for statement in MIGRATIONS[version].split(";"):
                    db.execute(statement)
                db.execute(f"PRAGMA user_version = {version + 1}")
        except BaseException:
            db.execute("ROLLBACK")
            raise
        db.execute("COMMIT")


def _version(db: sqlite3.Connection) -> int:
    return int(db.execute("PRAGMA user_version").fetchone()[0])
