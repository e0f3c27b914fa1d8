"""The web application: the API, the pages, and what stands in front of both."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version

from fastapi import Depends, FastAPI
from fastapi.routing import APIRoute
from fastapi.security import HTTPBearer
from starlette.middleware.errors import ServerErrorMiddleware

from .api import columns, events, files, health, jobs, plan, previews, results
from .auth.gate import Gate
from .auth.headers import BodyLimit, SecurityHeaders
from .config import ServiceConfig
from .error_handlers import ErrorHandlers
from .metrics import CountRequests
from .pages import pages, static_files
from .pages.dask_proxy import dashboard
from .pages.login import login
from .services import Services

PREFIX = "/api/v1"

_BEARER = HTTPBearer(
    auto_error=False,  # for the document only: the gate has asked already
    scheme_name="token",
    description="As tract-dask token create shows it; browsers log in instead.",
)


def _operation_id(route: APIRoute) -> str:
    return route.name


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    services: Services = app.state.services
    services.runner.start()
    services.pool.start()
    try:
        yield
    finally:
        services.streams.close()
        await services.upstream.close()
        services.runner.stop()
        services.pool.close()


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
    app.state.services = services = Services(config)
    handlers = ErrorHandlers(services.root, services.store.path)
    handlers.install(app)
    documented = [Depends(_BEARER)] if services.access.demanded else []
    for part in (jobs, events, files, plan, previews, columns, results, health):
        app.include_router(part.router, prefix=PREFIX, dependencies=documented)
    app.include_router(pages)
    app.include_router(login)
    app.include_router(dashboard)
    app.mount("/static", static_files, name="static")
    app.add_middleware(BodyLimit, most=config.max_body_bytes)  # the last one added is the first to see a request
    app.add_middleware(Gate, access=services.access, config=config)
    app.add_middleware(ServerErrorMiddleware, handler=handlers.unexpected)  # what it answers has the headers, too
    app.add_middleware(SecurityHeaders)
    app.add_middleware(CountRequests, metrics=services.metrics)
    return app
