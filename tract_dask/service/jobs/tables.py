"""The tables of the job store, and how older files are brought to them."""

from __future__ import annotations

import os
import sqlite3
import threading
from contextlib import closing, suppress
from pathlib import Path

from ...errors import StoreError
from ...store import disk

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

_SECOND = """
CREATE INDEX jobs_by_end ON jobs (ended);
PRAGMA application_id = 1414676801;
"""

_THIRD = """
CREATE TABLE deletions (
    job_id TEXT PRIMARY KEY,
    owner TEXT NOT NULL,
    output TEXT NOT NULL
) WITHOUT ROWID
"""

_FOURTH = "ALTER TABLE jobs ADD COLUMN content TEXT NOT NULL DEFAULT ''"

MIGRATIONS = (_FIRST, _SECOND, _THIRD, _FOURTH)
"""The steps from each version to the next; a file's version is how many of them it has had."""

_TABLES = frozenset({"jobs", "transitions", "events", "columns", "owners"})


class JobStoreError(StoreError):
    """The file of the jobs cannot be used: it is damaged, locked or another program's, or its disk fails."""


def migrate(db: sqlite3.Connection, path: Path) -> None:
    """Check the store at ``path``, and bring it to the newest version, step by step; several processes may try at once.

    A store of an older version is copied first, to a file beside it that is named by its version.

    Raises
    ------
    JobStoreError
        Where it is damaged, of another program, or of a newer version.
    """
    if (version := _version(db)) > len(MIGRATIONS):
        raise JobStoreError(
            "the job store is of a newer version",
            str(path),
            f"version {len(MIGRATIONS)} or older",
            f"version {version}",
            "Update tract_dask, or choose another data root",
        )
    _check(db, path, version)
    if 0 < version < len(MIGRATIONS):
        _back_up(db, path, version)
    while (version := _version(db)) < len(MIGRATIONS):
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


def check_place(path: Path) -> None:
    """Check that a database can be at ``path``, before it is opened.

    Raises
    ------
    JobStoreError
        Where a folder, a pipe, a device or an empty file is there, or only the log of a database that is gone.
    """
    log = path.with_name(f"{path.name}-wal")
    if path.exists() and not path.is_file():
        raise JobStoreError(
            "the job store is not a file", str(path), "a file", "a folder, a pipe or a device", "Move it aside"
        )
    if not path.exists() and log.exists() and log.stat().st_size:
        raise JobStoreError(
            "the job store is gone, and its log is still there",
            str(path),
            f"a database next to {log.name}",
            "none",
            f"Restore it from a backup; or move {log.name} aside, to begin without jobs and tokens",
        )
    if path.exists() and not path.stat().st_size:
        raise JobStoreError("the job store is empty", str(path), "a database", "0 bytes", _BEGIN_ANEW)


def create(path: Path) -> None:
    """Make a store where none is, whole: other processes see none, or all of it.

    Raises
    ------
    sqlite3.Error, OSError
        Where it cannot be written.
    """
    aside = disk.aside(path, f"{os.getpid()}-{threading.get_native_id()}")
    aside.unlink(missing_ok=True)
    try:
        with closing(sqlite3.connect(aside, isolation_level=None)) as made:
            migrate(made, aside)
        disk.sync(aside)
        try:
            with suppress(FileExistsError):  # another process has just made it
                os.link(aside, path)
        except OSError:  # a disk without links
            aside.replace(path)
        disk.sync(path.parent)
    finally:
        aside.unlink(missing_ok=True)


def store_error(path: Path, error: sqlite3.Error) -> JobStoreError:
    """Return what an error of SQLite means to the user."""
    name = getattr(error, "sqlite_errorname", "")
    for begin, (what, remedy) in _MEANINGS.items():
        if name.startswith(begin):
            return JobStoreError(what, str(path), got=str(error), remedy=remedy)
    return JobStoreError("the job store cannot be used", str(path), got=str(error), remedy=_LOOK)


_LOOK = "Check the disk, its free space and the file's permissions"
_BEGIN_ANEW = "Restore it from a backup; or move it and the files next to it away, to begin without jobs and tokens"
_WAIT = "Stop the program that has it (fuser shows which one it is), and try again"
_MEANINGS = {
    "SQLITE_NOTADB": ("the job store is not a database", _BEGIN_ANEW),
    "SQLITE_CORRUPT": ("the job store is damaged", _BEGIN_ANEW),
    "SQLITE_BUSY": ("the job store is locked by another program", _WAIT),
    "SQLITE_LOCKED": ("the job store is locked by another program", _WAIT),
    "SQLITE_PROTOCOL": ("the job store cannot be locked", "Put it on a local disk"),
    "SQLITE_FULL": ("the disk of the job store is full", "Free some space"),
    "SQLITE_READONLY": ("the job store cannot be written", "Correct its permissions and those of its folder"),
}


def _check(db: sqlite3.Connection, path: Path, version: int) -> None:
    """Check that what is there is whole, and a job store."""
    problems = [row[0] for row in db.execute("PRAGMA quick_check(1)")]
    if problems != ["ok"]:
        got = " ".join(str(problems[0]).split())[:200]
        raise JobStoreError("the job store is damaged", str(path), "a whole database", got, _BEGIN_ANEW)
    found = {row[0] for row in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if _version(db) == version and (not found >= _TABLES if version else found):
        raise JobStoreError(
            "this database is not a job store",
            str(path),
            "the tables of a job store",
            ", ".join(sorted(found))[:200] or "no tables",
            "Move it aside, or choose another data root",
        )


def _back_up(db: sqlite3.Connection, path: Path, version: int) -> None:
    """Copy the store beside itself, whole or not at all, unless that was done before."""
    copy = path.with_name(f"{path.name}.version-{version}")
    if copy.exists():
        return
    aside = disk.aside(copy, os.getpid())
    aside.unlink(missing_ok=True)
    try:
        with closing(sqlite3.connect(aside)) as target:
            aside.chmod(0o600)
            db.backup(target)
            target.execute("PRAGMA journal_mode = DELETE")
        aside.replace(copy)
    finally:
        aside.unlink(missing_ok=True)


def _version(db: sqlite3.Connection) -> int:
    return int(db.execute("PRAGMA user_version").fetchone()[0])
