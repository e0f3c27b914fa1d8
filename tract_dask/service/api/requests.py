"""Who asks, whether the job is theirs to change, and where its files are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, Query

from ..auth.tokens import Identity, identity, may_change
from ..jobs.records import Job
from ..services import Served, Services
from .models import JobId

Who = Annotated[Identity, Depends(identity)]
"""Who asks."""


def own_job(job_id: JobId, services: Served, who: Who) -> Job:
    """Return the job, which who asks owns, or may change as an admin.

    Raises
    ------
    UnknownJobError
        Where there is none.
    ForbiddenError
        Where it is someone else's.
    """
    job = services.store.job(job_id)
    may_change(who, job)
    return job


OwnJob = Annotated[Job, Depends(own_job)]
"""The job of a route that changes it: every such route takes it in this way."""


def part_of_movie(
    frames: Annotated[str, Query(max_length=64, description="Frames start:stop:step of a part; all where empty.")] = "",
    roi: Annotated[str, Query(max_length=64, description="Rows and columns y0:y1,x0:x1 of a part.")] = "",
    side: Annotated[int, Query(alias="bin", ge=1, le=1 << 15, description="Side of squares that are summed, px.")] = 1,
) -> dict[str, Any]:
    """Return which part of a movie is meant, as the settings of the source have it."""
    return {"frames": frames or None, "roi": roi or None, "bin": side}


PartOfMovie = Annotated[dict[str, Any], Depends(part_of_movie)]
"""Which part of a movie is looked at."""


def folder_of(services: Services, job_id: str, *names: str) -> Path:
    """Return the folder of a job's output.

    Parameters
    ----------
    names
        What is about to be read there.

    Raises
    ------
    OutsideError
        Where a link in it leads out of the data root.
    """
    output = services.store.job(job_id).output
    for name in names:
        services.root.store(f"{output}/{name}")
    return services.root.resolve(output, must_exist=False)
