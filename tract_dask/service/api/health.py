"""Whether the service is well, and its figures for Prometheus."""

from __future__ import annotations

import sqlite3
from http import HTTPStatus
from importlib.metadata import version
from typing import Literal

from fastapi import APIRouter, Depends, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel, ConfigDict, Field

from ..auth.tokens import identity
from ..jobs.states import State
from ..jobs.store import JobStore
from ..services import Served
from .models import errors

router = APIRouter(tags=["health"], dependencies=[Depends(identity)])


class Health(BaseModel):
    """Whether the service is well, part by part."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "status": "ok",
                "version": "0.1.0",
                "database": "ok",
                "runner": "ok",
                "cluster": "ok",
                "workers": 4,
                "queue": 2,
                "running": 1,
            }
        }
    )

    status: Literal["ok", "degraded", "failed"] = Field(
        description="degraded: jobs wait for the cluster, which restarts by itself; failed: an administrator must act."
    )
    version: str = Field(description="Of tract_dask.")
    database: str = Field(description='"ok", or what is wrong with the job store.')
    runner: str = Field(description='"ok", or what is wrong with the thread that starts jobs.')
    cluster: str = Field(description='"ok", or what is wrong with the cluster.')
    workers: int = Field(description="Workers of the cluster.", ge=0)
    queue: int | None = Field(description="Jobs in the queue; null where the database does not say.")
    running: int | None = Field(description="Jobs that run; null where the database does not say.")


@router.get("/health", responses=errors() | {503: {"model": Health, "description": "The service needs help."}})
def health(services: Served, response: Response) -> Health:
    """Say whether the database, the runner and the cluster are well; 503 where jobs cannot go on without help."""
    database, counts = _database(services.store)
    runner = "ok" if services.runner.is_alive() else "its thread has ended: see the service's log, and start it again"
    workers = len(services.runner.cluster.workers())
    cluster = "ok" if workers or services.runner.cluster.dashboard() else "its scheduler does not answer"
    failed = database != "ok" or runner != "ok"
    response.status_code = HTTPStatus.SERVICE_UNAVAILABLE if failed else HTTPStatus.OK
    return Health(
        status="failed" if failed else "ok" if cluster == "ok" else "degraded",
        version=version("tract_dask"),
        database=database,
        runner=runner,
        cluster=cluster,
        workers=workers,
        queue=counts.get(State.QUEUED),
        running=counts.get(State.RUNNING),
    )


@router.get(
    "/metrics",
    response_class=Response,
    responses=errors()
    | {200: {"content": {"text/plain": {"schema": {"type": "string"}}}, "description": "Prometheus' text."}},
)
def metrics(services: Served) -> Response:
    """Return the service's figures in Prometheus' text format."""
    return Response(services.metrics.text(), media_type=CONTENT_TYPE_LATEST)


def _database(store: JobStore) -> tuple[str, dict[State, int]]:
    try:
        with store.writing():  # a file that cannot be written, or a lock that nobody lets go of, shows here
            pass
        return "ok", store.counts()
    except sqlite3.Error as error:
        return str(error), {}
