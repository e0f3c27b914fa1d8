"""Deleting what a job wrote: what it has left in its folder, unless it was changed since; and the folder, if empty."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from .. import stores
from ..errors import TractError
from ..journal import journal_beside
from ..locks import lock_files, sole_use
from ..pipeline import Outputs
from .folders import DataRoot, overlap
from .jobs.store import Job, JobStore
from .outputs import LOCK, MARK, Mark, read_mark, signature

_OF_A_STORE = re.compile(r"zarr\.json|c?[\d.]+|c(\.\d+)*|.*\.partial")
"""Names of the files that a run writes into its stores."""


def delete_folder(root: DataRoot, store: JobStore, job: Job) -> str:
    """Delete what a job wrote, if it is this job's alone; the job itself is forgotten already.

    Links are never followed, nor deleted: no job makes one.

    Returns
    -------
    str
        Why something was kept; empty: all is gone, or was never there, but for what others have put there.
    """
    place = root.path / job.output
    try:
        if Path(os.path.realpath(place)) != place:
            return "a link leads to it"
        if other := _other(store, job):
            return f"job {other} uses it, too"
        if not place.exists():
            return ""
        with sole_use(place / LOCK, "another run works in this folder"):
            kept = _delete(place, Mark(job.owner, job.id, job.output))
        with suppress(OSError):  # something else is in it
            place.rmdir()
        return kept
    except (TractError, OSError) as error:
        return str(error).replace(f"{root.path}/", "")


def _other(store: JobStore, job: Job) -> str:
    """Return the id of a job whose folder is this one, in it, or around it; "" where there is none."""
    for row in store.connection().execute("SELECT id, output FROM jobs WHERE id != ?", (job.id,)):
        if overlap(row["output"], job.output):
            return str(row["id"])
    return ""


def _delete(place: Path, mark: Mark) -> str:
    """Delete what the job of a mark has left in its folder; return why something of a run was kept."""
    found = read_mark(place)
    if found is None and not mark.named_by_id:
        return "no job has made it"
    if found is not None and replace(found, made={}) != mark:
        return f"job {found.job} has worked in it since"
    made = found.made if found is not None else {}
    changed = [path.name for path in _left(place) if made and made.get(path.name) != signature(path)]
    for path in _left(place):
        if path.name not in changed:
            _remove(path)
            _clear(journal_beside(path))
    for aside in (*place.glob(".*.partial"), *place.glob(".*.removed")):
        _clear(aside)
    for file in () if changed else (place / MARK, *lock_files(place / LOCK)):
        file.unlink(missing_ok=True)
    return f"{', '.join(changed)} changed since the job wrote it" if changed else ""


def _left(place: Path) -> list[Path]:
    return [path for path in Outputs(place).written() if os.path.lexists(path)]


def _clear(path: Path) -> None:
    """Delete a journal, or what was written aside, as a whole: nobody else puts anything there."""
    if not path.is_symlink():
        stores.remove(path)


def _remove(path: Path) -> None:
    """Delete a file, or of a store what a run writes into it."""
    if path.is_symlink():
        return
    if not path.is_dir():
        path.unlink(missing_ok=True)
        return
    stores.abandon(path)
    for folder, _, names in os.walk(path, topdown=False):
        for file in (Path(folder, name) for name in names if _OF_A_STORE.fullmatch(name)):
            if not file.is_symlink():
                file.unlink()
        with suppress(OSError):  # something else is in it
            Path(folder).rmdir()
