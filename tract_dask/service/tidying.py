"""Deleting what a job wrote: nothing but its own folder, or the files of a run in a folder that somebody named."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path, PurePosixPath

from .. import stores
from ..errors import TractError
from ..pipeline import Outputs, clear_run
from .folders import DataRoot
from .jobs.store import Job, JobStore


def delete_folder(root: DataRoot, store: JobStore, job: Job) -> str:
    """Delete what a job wrote, if it is this job's alone; the job itself is forgotten already.

    A folder that the job was given by its id goes as a whole. In one that was named at submission only the files of a
    run go, and the folder if nothing else is in it.

    Returns
    -------
    str
        Why it was kept; empty: it is gone, or was never there.
    """
    try:
        folder = root.resolve(job.output, must_exist=False)
        if folder != root.path / job.output:
            return "a link leads to it"
        if other := _other(store, job):
            return f"job {other} uses it, too"
        if not folder.exists():
            return ""
        if job.output == f"jobs/{job.id}":
            shutil.rmtree(folder)
            return ""
        return _delete_run(root, folder, job)
    except (TractError, OSError) as error:
        return str(error)


def _other(store: JobStore, job: Job) -> str:
    """Return the id of a job whose folder is this one, in it, or around it; "" where there is none."""
    mine = PurePosixPath(job.output)
    for row in store.connection().execute("SELECT id, output FROM jobs WHERE id != ?", (job.id,)):
        theirs = PurePosixPath(row["output"])
        if mine.is_relative_to(theirs) or theirs.is_relative_to(mine):
            return str(row["id"])
    return ""


def _delete_run(root: DataRoot, folder: Path, job: Job) -> str:
    outputs = Outputs(folder)
    made_of = stores.attributes(outputs.movie).get("source")
    if made_of is not None and made_of != root.source(job.source):
        return "it holds the run of another movie"
    clear_run(outputs)
    (folder / ".lock").unlink(missing_ok=True)
    with suppress(OSError):  # something else is in it
        folder.rmdir()
    return ""
