"""The parts of the application, for its routes and pages."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends
from starlette.requests import HTTPConnection

from ..cluster.memory import local_memory_limit
from .auth.tokens import Access
from .config import ServiceConfig
from .event_streams import EventStreams
from .jobs.store import JobStore
from .metrics import Metrics
from .process_pool import ProcessPool
from .runner.runner import Runner
from .upstream import Upstream
from .views.exports import Exports

REQUEST_BYTES = 2 << 30
"""Private memory that a request may take, or as much as a worker of the cluster may have, if that is less."""


class Services:
    """The parts of the application, made from its configuration; none has started."""

    def __init__(self, config: ServiceConfig) -> None:
        config.state.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.config, self.root = config, config.root
        self.store = JobStore(config.database)
        self.pool = ProcessPool(memory=min(REQUEST_BYTES, local_memory_limit(config.cluster)))
        self.exports = Exports(config.state / "exports", self.pool)
        self.streams = EventStreams(self.store)
        self.metrics = Metrics(self.store, self.streams)
        self.access = Access(self.store, config)
        self.runner = Runner(config, self.store)
        self.upstream = Upstream(config.cluster.tls)


def services(connection: HTTPConnection) -> Services:
    """Return the parts of the application that answers a request or holds a socket."""
    found = connection.app.state.services
    assert isinstance(found, Services)
    return found


Served = Annotated[Services, Depends(services)]
"""The parts of the application, for a route."""
