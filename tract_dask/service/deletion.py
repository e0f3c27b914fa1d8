"""Deleting what a job wrote: what it has left in its folder, unless it was changed since; and the folder, if empty.

The job store knows of a deletion until it is through, and the folder's mark names what goes; so one that was cut off
is gone on with when the service starts again.
"""

from __future__ import annotations

import logging
import os
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from ..errors import TractError
from ..store import files, metadata
from ..store.disk import PARTIAL
from ..store.held import check_held, hold
from ..store.journal import journal_beside
from ..store.locks import lock_files, sole_use
from ..store.run_folder import RunFolder
from .data_root import DataRoot, overlap
from .jobs.records import Deletion
from .jobs.store import JobStore
from .outputs import GOING, LOCK, MARK, Mark, read_mark, signature, write_mark

_log = logging.getLogger(__name__)

_OF_A_STORE = re.compile(rf"zarr\.json|c?[\d.]+|c(\.\d+)*|.*{re.escape(PARTIAL)}")
"""Names of the files that a run writes into its stores."""


def finish_deletions(root: DataRoot, store: JobStore) -> None:
    """Go on with what a service before has begun to delete."""
    for deletion in store.deletions():
        kept = delete_files(root, store, deletion)
        _log.info("the files of the deleted job %s: %s", deletion.job_id, f"kept, {kept}" if kept else "gone")


def delete_files(root: DataRoot, store: JobStore, deletion: Deletion) -> str:
    """Delete what a job wrote, if it is this job's alone; the job itself is forgotten already.

    Links are never followed, nor deleted: no job makes one.

    Returns
    -------
    str
        Why something was kept; empty: all is gone, or was never there, but for what others have put there.
    """
    kept = _delete_folder(root, store, deletion)
    store.end_deletion(deletion.job_id)
    return kept


def _delete_folder(root: DataRoot, store: JobStore, deletion: Deletion) -> str:
    place = root.path / deletion.output
    try:
        if Path(os.path.realpath(place)) != place:
            return "a link leads to it"
        if other := _other(store, deletion):
            return f"job {other} uses it, too"
        if not place.exists():
            return ""
        found = read_mark(place)
        if found is not None and found.job != deletion.job_id:
            return f"job {found.job} has worked in it since"
        with hold(place, links=False), sole_use(place / LOCK, "another run works in this folder"):
            if Path(os.path.realpath(place)) != place:
                return "a link leads to it"
            kept = _delete(place, Mark(deletion.owner, deletion.job_id, deletion.output))
        with suppress(OSError):  # something else is in it
            place.rmdir()
        return kept
    except (TractError, OSError) as error:
        return root.shown(str(error))


def _other(store: JobStore, deletion: Deletion) -> str:
    """Return the id of a job whose folder is this one, in it, or around it; "" where there is none."""
    for row in store.connection().execute("SELECT id, output FROM jobs WHERE id != ?", (deletion.job_id,)):
        if overlap(row["output"], deletion.output):
            return str(row["id"])
    return ""


def _delete(place: Path, mark: Mark) -> str:
    """Delete what the job of a mark has left in its folder; return why something of a run was kept."""
    found = read_mark(place)
    if found is None and not mark.named_by_id and _holds_more(place):
        return "no job has made it"
    if found is not None and replace(found, made={}) != mark:
        return f"job {found.job} has worked in it since"
    made = found.made if found is not None else {}
    changed = [path.name for path in _left(place) if made and made.get(path.name) not in (GOING, signature(path))]
    _note(place, found, [path.name for path in _left(place) if path.name not in changed])
    for path in _left(place):
        if path.name not in changed:
            _clear(journal_beside(path))  # first: as long as the store is there, this is not forgotten
            _remove(path)
    for aside in (*place.glob(f".*{PARTIAL}"), *place.glob(".*.removed")):
        _clear(aside)
    check_held(place / MARK)
    for file in () if changed else (place / MARK, *lock_files(place / LOCK)):
        file.unlink(missing_ok=True)
    return f"{', '.join(changed)} changed since the job wrote it" if changed else ""


def _holds_more(place: Path) -> bool:
    """Tell whether there is anything but locks; a deletion that was cut off at its very end leaves nothing else."""
    return bool({*place.iterdir()} - {*lock_files(place / LOCK)})


def _note(place: Path, found: Mark | None, names: list[str]) -> None:
    """Note in the mark what is being deleted: half of it is gone where that is cut off, and the rest is to follow."""
    if found is not None and names:
        with suppress(OSError):  # on a full disk
            write_mark(place, replace(found, made=dict.fromkeys(names, GOING)))


def _left(place: Path) -> list[Path]:
    return [path for path in RunFolder(place).written() if os.path.lexists(path)]


def _clear(path: Path) -> None:
    """Delete a journal, or what was written aside, as a whole: nobody else puts anything there."""
    if not path.is_symlink():
        files.remove(path)


def _remove(path: Path) -> None:
    """Delete a file, or of a store what a run writes into it."""
    check_held(path)
    if path.is_symlink():
        return
    if not path.is_dir():
        path.unlink(missing_ok=True)
        return
    metadata.abandon(path)
    for folder, _, names in os.walk(path, topdown=False):
        for file in (Path(folder, name) for name in names if _OF_A_STORE.fullmatch(name)):
            check_held(file)
            if not file.is_symlink():
                file.unlink()
        with suppress(OSError):  # something else is in it
            Path(folder).rmdir()
