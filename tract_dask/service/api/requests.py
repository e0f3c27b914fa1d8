"""Who asks, and whether the job is theirs to change: the dependencies of routes."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request

from ..auth.tokens import Identity, identity, may_change
from ..jobs.records import Job
from .models import JobId

Who = Annotated[Identity, Depends(identity)]
"""Who asks."""


def own_job(job_id: JobId, request: Request, who: Who) -> Job:
    """Return the job, which who asks owns, or may change as an admin.

    Raises
    ------
    UnknownJobError
        Where there is none.
    ForbiddenError
        Where it is someone else's.
    """
    job: Job = request.app.state.store.job(job_id)
    may_change(who, job)
    return job


OwnJob = Annotated[Job, Depends(own_job)]
"""The job of a route that changes it: every such route takes it in this way."""
