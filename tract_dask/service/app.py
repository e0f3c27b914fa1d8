"""The web application: the API, the pages, and what stands in front of both."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version

from fastapi import Depends, FastAPI
from fastapi.routing import APIRoute
from fastapi.security import HTTPBearer
from starlette.middleware.errors import ServerErrorMiddleware

from ..cluster.connect import local_memory_limit
from . import error_handlers
from .api import columns, events, files, health, jobs, plan, previews, results
from .auth.gate import Gate
from .auth.headers import BodyLimit, SecurityHeaders
from .auth.tokens import Access
from .config import ServiceConfig
from .events import Feed
from .jobs.store import JobStore
from .metrics import CountRequests, Metrics
from .pages import pages, static_files
from .pages.dask_proxy import Upstream, dashboard
from .pages.login import login
from .process_pool import Workshop
from .runner.runner import Runner
from .views.exports import Exports

PREFIX = "/api/v1"

REQUEST_BYTES = 2 << 30
"""Private memory that a request may take, or as much as a worker of the cluster may have, if that is less."""

_BEARER = HTTPBearer(
    auto_error=False,  # for the document only: the gate has asked already
    scheme_name="token",
    description="As tract-dask token create shows it; browsers log in instead.",
)


def _operation_id(route: APIRoute) -> str:
    return route.name


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    app.state.runner.start()
    app.state.workshop.start()
    try:
        yield
    finally:
        app.state.feed.close()
        await app.state.upstream.close()
        app.state.runner.stop()
        app.state.workshop.close()


def create_app(config: ServiceConfig) -> FastAPI:
    """Return the application; its runner starts and stops with it."""
    app = FastAPI(
        title="tract_dask",
        version=version("tract_dask"),
        openapi_url=f"{PREFIX}/openapi.json",
        docs_url=None,  # it loads scripts from elsewhere
        redoc_url=None,
        generate_unique_id_function=_operation_id,
        lifespan=_lifespan,
    )
    config.state.mkdir(mode=0o700, parents=True, exist_ok=True)
    app.state.config, app.state.root = config, config.root
    app.state.store = JobStore(config.database)
    app.state.workshop = Workshop(memory=min(REQUEST_BYTES, local_memory_limit(config.cluster)))
    app.state.exports = Exports(config.state / "exports", app.state.workshop)
    app.state.feed = Feed(app.state.store)
    app.state.metrics = Metrics(app.state.store, app.state.feed)
    app.state.access = Access(app.state.store, config)
    app.state.runner, app.state.upstream = Runner(config, app.state.store), Upstream(config.cluster.tls)
    error_handlers.install(app)
    documented = [Depends(_BEARER)] if app.state.access.demanded else []
    for part in (jobs, events, files, plan, previews, columns, results, health):
        app.include_router(part.router, prefix=PREFIX, dependencies=documented)
    app.include_router(pages)
    app.include_router(login)
    app.include_router(dashboard)
    app.mount("/static", static_files, name="static")
    app.add_middleware(BodyLimit, most=config.max_body_bytes)  # the last one added is the first to see a request
    app.add_middleware(Gate, access=app.state.access, config=config)
    app.add_middleware(ServerErrorMiddleware, handler=error_handlers.unexpected)  # what it answers has the headers, too
    app.add_middleware(SecurityHeaders)
    app.add_middleware(CountRequests, metrics=app.state.metrics)
    return app
