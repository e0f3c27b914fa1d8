"""The pages: templates and scripts without a build step; all that they show comes through the API."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse
from fastapi.staticfiles import StaticFiles
from fastapi.templating import Jinja2Templates

from ...web.bundle import STATIC
from ..auth.tokens import IDENTITY, identity
from ..services import services

_FOLDER = Path(__file__).parent

templates = Jinja2Templates(_FOLDER / "templates")
static_files = StaticFiles(directory=_FOLDER / "static", packages=[("tract_dask.web", STATIC.name)])
pages = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)


def error_page(request: Request, problem: dict[str, str], status: int) -> HTMLResponse:
    """Return the page for an error, given as in :func:`tract_dask.service.errors.body`."""
    about = {"problem": problem, "who": request.scope.get(IDENTITY)}
    return templates.TemplateResponse(request, "error.html", about, status)


def _page(request: Request, name: str, **values: Any) -> HTMLResponse:
    """Return a page; ``here`` marks it in the navigation, ``who`` looks at it."""
    about = {"here": name, "who": identity(request), "may_log_out": services(request).access.demanded}
    return templates.TemplateResponse(request, f"{name}.html", about | values)


def _job_page(request: Request, name: str, job_id: str) -> HTMLResponse:
    """Return a page about a job."""
    return _page(request, name, job=services(request).store.job(job_id))


@pages.get("/")
def jobs(request: Request) -> HTMLResponse:
    """Show every job."""
    return _page(request, "jobs")


@pages.get("/new")
def new_job(request: Request) -> HTMLResponse:
    """Choose a movie and settings, and submit a job."""
    return _page(request, "new")


@pages.get("/jobs/{job_id}")
def job(request: Request, job_id: str) -> HTMLResponse:
    """Watch a job."""
    return _job_page(request, "job", job_id)


@pages.get("/jobs/{job_id}/columns")
def columns(request: Request, job_id: str) -> HTMLResponse:
    """Edit the columns of a job."""
    return _job_page(request, "columns", job_id)


@pages.get("/jobs/{job_id}/results")
def results(request: Request, job_id: str) -> HTMLResponse:
    """Look at what a job measured."""
    return _job_page(request, "results", job_id)
