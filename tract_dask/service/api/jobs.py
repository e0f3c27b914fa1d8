"""Jobs: submit, list, read, cancel, retry, label, delete."""

from __future__ import annotations

import json
from itertools import accumulate
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from ..checks import check_job
from ..deletion import delete_files
from ..jobs.public import JobRecord, Label
from ..jobs.records import Deletion, Job
from ..jobs.states import State
from ..services import Served
from .models import After, Deleted, JobDetail, JobId, JobList, Log, LogLine, NewJob, NewLabel, errors
from .requests import OwnJob, Who

router = APIRouter(tags=["jobs"])

_PAGE_BYTES = 2 << 20
_LINKS = ("events", "log", "columns", "sum", "results", "report")


@router.post("/jobs", status_code=201, response_model=JobRecord, responses=errors(400, 404, 409, 503))
async def submit_job(new: NewJob, request: Request, response: Response, services: Served, who: Who) -> Job:
    """Queue a job, after the checks that a run makes before it starts: the movie opens, and the settings fit it."""
    settings, output, checked = await check_job(services, who.name, new.source, new.settings, new.output)
    job = await run_in_threadpool(
        services.store.submit,
        source=new.source,
        settings=settings,
        owner=who.name,
        label=new.label,
        output=output,
        curate=new.curate,
        content=checked.content,
    )
    services.runner.wake()
    response.headers["Location"] = str(request.url_for("read_job", job_id=job.id).path)
    return job


@router.get("/jobs", response_model=JobList, responses=errors())
def list_jobs(
    services: Served,
    state: Annotated[list[State], Query(description="Only jobs in one of these states.", max_length=10)] = [],  # noqa: B006
    owner: Annotated[Label, Query(description="Only this owner's jobs.")] = "",
    text: Annotated[Label, Query(description="Only jobs with this in label, source, owner or id.")] = "",
    before: Annotated[int | None, Query(ge=0, le=2**53, description="Only jobs with smaller numbers.")] = None,
    limit: Annotated[int, Query(ge=1, le=500, description="Jobs of a page, fewer where their settings are long.")] = 50,
) -> dict[str, Any]:
    """List jobs, the newest first."""
    store = services.store
    event = store.newest_event()  # first: what happens meanwhile comes as an event, too
    found = store.jobs(states=state, owner=owner, text=text, before=before, limit=limit + 1)
    shown = _fitting(found[:limit])
    return {
        "jobs": shown,
        "counts": store.counts(owner=owner, text=text),
        "next": shown[-1].number if len(found) > len(shown) else None,
        "event": event,
    }


def _fitting(jobs: list[Job]) -> list[Job]:
    """Return as many of the first jobs as make a page of a moderate size, at least one."""
    sizes = accumulate(len(json.dumps(job.settings)) for job in jobs)
    return [job for job, size in zip(jobs, sizes, strict=True) if size <= _PAGE_BYTES or job is jobs[0]]


@router.get("/jobs/{job_id}", response_model=JobDetail, responses=errors(404))
def read_job(job_id: JobId, request: Request, services: Served) -> dict[str, Any]:
    """Read a job, its history, and where to find the rest of it."""
    store = services.store
    event = store.newest_event()
    job = store.job(job_id)
    place = request.url_for("read_job", job_id=job_id).path
    links = {"self": place} | {name: f"{place}/{name}" for name in _LINKS}
    return job.to_record() | {"transitions": store.transitions(job_id), "links": links, "event": event}


@router.post("/jobs/{job_id}/cancel", response_model=JobRecord, responses=errors(404, 409))
def cancel_job(own: OwnJob, services: Served, who: Who) -> Job:
    """Cancel a job: at once, or as soon as its process has ended; what is done is kept, and can be gone on from."""
    job = services.store.request_cancel(own.id, f"cancelled by {who.name}")
    services.runner.wake()
    return job


@router.post("/jobs/{job_id}/retry", response_model=JobRecord, responses=errors(404, 409))
def retry_job(own: OwnJob, services: Served) -> Job:
    """Queue a job again that failed, was cancelled, or could not fit some frames; it goes on from what is done."""
    job = services.store.retry(own.id)
    services.runner.wake()
    return job


@router.post("/jobs/{job_id}/label", response_model=JobRecord, responses=errors(400, 404))
def label_job(own: OwnJob, new: NewLabel, services: Served) -> Job:
    """Give a job another label."""
    return services.store.label(own.id, new.label)


@router.delete("/jobs/{job_id}", response_model=Deleted, responses=errors(404, 409))
def delete_job(
    own: OwnJob,
    services: Served,
    files: Annotated[
        bool, Query(description="Delete what it wrote, too: only files of a run, and only its own.")
    ] = False,
) -> Deleted:
    """Delete a job that has ended, or waits; its files stay where they are, unless they are to go with it."""
    services.store.delete(own.id, files=files)
    kept = delete_files(services.root, services.store, Deletion(own.id, own.owner, own.output)) if files else ""
    return Deleted(id=own.id, files=files and not kept, kept=kept)


@router.get("/jobs/{job_id}/log", response_model=Log, responses=errors(404))
def read_log(
    job_id: JobId,
    services: Served,
    after: After = 0,
    limit: Annotated[int, Query(ge=1, le=2000, description="Lines of a page.")] = 1000,
) -> Log:
    """Read a job's log."""
    found = services.store.log_of(job_id, after, limit + 1)
    lines = [LogLine(id=event.id, time=event.time, **event.data) for event in found[:limit]]
    return Log(lines=lines, next=lines[-1].id if len(found) > limit else None)
