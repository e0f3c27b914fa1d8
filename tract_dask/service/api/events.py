"""What happens, as server-sent events."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from typing import Annotated, Any

import anyio.to_thread
from fastapi import APIRouter, Header, Query
from fastapi.responses import StreamingResponse

from ..event_streams import EventStreams, chunk, public_record
from ..jobs.records import Job
from ..jobs.store import JobStore
from ..services import Served, Services
from .models import JobId, errors

router = APIRouter(tags=["events"])

_NEWEST_JOBS = 50
_RETRY = b"retry: 1000\n\n"
_EXAMPLE = 'id: 7\nevent: job\ndata: {"id": "3f9a0c12de", "state": "running"}\n\n'
_EVENT = {
    "type": "object",
    "properties": {
        "id": {"type": "string", "description": "Number of the event, to resume from."},
        "event": {"type": "string", "enum": ["job", "progress", "workers", "log"]},
        "data": {"type": "string", "contentMediaType": "application/json"},
    },
}
_STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Server-sent events. `job`: a job's record after a change, or its id and `deleted`; `progress`, "
        "`workers`, `log`: what their names say, with the id of the `job` and the `time`.",
        "content": {"text/event-stream": {"schema": _EVENT, "example": _EXAMPLE}},
    }
}

LastEventId = Annotated[
    str | None,
    Header(description="The last event that was received: what came after it follows.", max_length=32),
]
Since = Annotated[
    int | None, Query(alias="after", ge=0, le=2**53, description="The same, for a first connection; the header wins.")
]


@router.get("/events", response_class=StreamingResponse, responses=_STREAM | errors())
def watch_all(services: Served, last_event_id: LastEventId = None, after: Since = None) -> StreamingResponse:
    """Watch all jobs.

    Without the number of an event it begins with the newest jobs and those that run, as they are now.
    """
    return _stream(services, _resumed(last_event_id, after), None, _newest_jobs)


@router.get("/jobs/{job_id}/events", response_class=StreamingResponse, responses=_STREAM | errors(404))
def watch_job(
    job_id: JobId, services: Served, last_event_id: LastEventId = None, after: Since = None
) -> StreamingResponse:
    """Watch a job; without the number of an event it begins with the job as it is now."""
    services.store.job(job_id)
    return _stream(services, _resumed(last_event_id, after), job_id, lambda store: [store.job(job_id)])


def _newest_jobs(store: JobStore) -> list[Job]:
    """Return the newest jobs and those that run, oldest first."""
    found = {job.number: job for job in (*store.jobs(limit=_NEWEST_JOBS), *store.running())}
    return [found[number] for number in sorted(found)]


def _resumed(header: str | None, after: int | None) -> int | None:
    """Return the number of the last event that the client has; None: it has none."""
    if header is not None and header.isascii() and header.isdigit():
        return min(int(header), 2**53)
    return after


def _stream(
    services: Services, after: int | None, job_id: str | None, snapshot: Callable[[JobStore], list[Job]]
) -> StreamingResponse:
    chunks = _chunks(services.streams, services.store, after, job_id, snapshot)
    return StreamingResponse(chunks, media_type="text/event-stream")


async def _chunks(
    streams: EventStreams,
    store: JobStore,
    after: int | None,
    job_id: str | None,
    snapshot: Callable[[JobStore], list[Job]],
) -> AsyncGenerator[bytes]:
    yield _RETRY
    begin, jobs = await anyio.to_thread.run_sync(_beginning, store, after, snapshot)
    for job in jobs[:-1]:
        yield chunk(None, "job", public_record(job))
    for job in jobs[-1:]:  # who has had the last one has had them all
        yield chunk(begin, "job", public_record(job))
    async with aclosing(streams.listen(begin, job_id)) as found:
        async for part in found:
            yield part


def _beginning(store: JobStore, after: int | None, snapshot: Callable[[JobStore], list[Job]]) -> tuple[int, list[Job]]:
    """Return the event after which a stream goes on, and the jobs that it begins with.

    These are none where the client knows an event of this store. The event is read first: what happens before the jobs
    are read comes as an event, too.
    """
    newest = store.newest_event()
    return (newest, snapshot(store)) if after is None or after > newest else (after, [])
