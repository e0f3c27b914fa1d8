"""What goes wrong, as an HTTP response: one shape of body for every error, and one table of status codes."""

from __future__ import annotations

import json
import logging
import sqlite3
from collections.abc import Mapping, Sequence
from http import HTTPMethod, HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response
from starlette.routing import Match

from ..errors import ClusterError, InputError, MissingStoreError, StoreError, TractError
from .data.crashes import CrashError, ExhaustedError
from .folders import DataRoot, OutsideError
from .jobs.store import ConflictError, JobStoreError, UnknownJobError, UnknownVersionError
from .jobs.tables import store_error
from .pages import error_page
from .refusals import ForbiddenError, InvalidError, NoTokenError, TooLargeError, TooManyError, invalid

log = logging.getLogger(__name__)


STATUS: dict[type[TractError], int] = {
    NoTokenError: 401,
    ForbiddenError: 403,
    OutsideError: 403,
    UnknownJobError: 404,
    UnknownVersionError: 404,
    MissingStoreError: 404,
    ConflictError: 409,
    TooLargeError: 413,
    InvalidError: 422,
    CrashError: 422,
    ExhaustedError: 422,
    TooManyError: 429,
    JobStoreError: 503,
    ClusterError: 503,
    InputError: 400,
    StoreError: 500,
    TractError: 500,
}
"""Status codes of errors; the nearest ancestor counts."""


class Problem(BaseModel):
    """An error with its place and its remedy."""

    what: str = Field(description="What is wrong.", examples=["there is no job with this id"])
    where: str = Field("", description="File, setting, field or route.", examples=["0123456789"])
    expected: str = Field("", description="What was needed.")
    got: str = Field("", description="What was found.")
    remedy: str = Field("", description="What to do.", examples=["List the jobs"])
    text: str = Field(description="All of it as one paragraph.")
    kind: str = Field(description="Its class, as in tract_dask.errors.", examples=["UnknownJobError"])


class ErrorBody(BaseModel):
    """The body of every response that is an error."""

    error: Problem


ERRORS: dict[int | str, dict[str, Any]] = {
    400: {"model": ErrorBody, "description": "The input cannot be used."},
    401: {"model": ErrorBody, "description": "No token, or one that is wrong, revoked or expired."},
    403: {"model": ErrorBody, "description": "Not allowed: of another owner, outside the data root, or cross-site."},
    404: {"model": ErrorBody, "description": "There is no such job, file, version or result."},
    409: {"model": ErrorBody, "description": "The job's state forbids it."},
    413: {"model": ErrorBody, "description": "The body is too large."},
    422: {
        "model": ErrorBody,
        "description": "A field is missing or invalid, or a file makes its reader crash.",
    },
    500: {"model": ErrorBody, "description": "The service failed."},
    503: {"model": ErrorBody, "description": "The cluster does not answer, or the job store cannot be used."},
}
"""What every route of the API may answer with, for its OpenAPI document."""


def answer(error: TractError, root: DataRoot | None = None, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """Return the response for an error; paths in it are shown relative to the data root."""
    status = next(STATUS[kind] for kind in type(error).__mro__ if kind in STATUS)
    return JSONResponse(body(error, root), status, headers)


def body(error: TractError, root: DataRoot | None = None) -> dict[str, dict[str, str]]:
    """Return the body of the response for an error."""
    parts = {name: str(getattr(error, name)) for name in ("what", "where", "expected", "got", "remedy")}
    parts["text"] = str(error)
    shown = parts if root is None else root.shown(parts)
    return {"error": shown | {"kind": type(error).__name__}}


def install(app: FastAPI) -> None:
    """Let the application answer every error that a route may raise in one shape."""
    app.add_exception_handler(TractError, _tract_error)
    app.add_exception_handler(sqlite3.Error, _store_fails)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _http)


def _tract_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, TractError)
    found = answer(error, request.app.state.root)
    if found.status_code >= HTTPStatus.INTERNAL_SERVER_ERROR:
        log.warning("%s %s: %s", request.method, request.url.path, error)
    return _as_asked(request, found)


def _store_fails(request: Request, error: Exception) -> Response:
    assert isinstance(error, sqlite3.Error)
    return _tract_error(request, store_error(request.app.state.store.path, error))


def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    first: Mapping[str, Any] = error.errors()[0]
    problem = invalid(str(first.get("msg", "a field is invalid")), _place(first.get("loc", ())))
    return JSONResponse(body(problem), HTTPStatus.UNPROCESSABLE_ENTITY)


def _place(loc: Sequence[Any]) -> Sequence[Any]:
    return loc[1:] if len(loc) > 1 else loc


def _http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    what = "there is nothing here" if error.status_code == HTTPStatus.NOT_FOUND else str(error.detail)
    problem = TractError(what, f"{request.method} {request.url.path}")
    headers = dict(error.headers or {})
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED and (methods := _methods(request)):
        headers["Allow"] = ", ".join(methods)  # the framework names those of one route only
    return _as_asked(request, JSONResponse(body(problem), error.status_code, headers))


def _methods(request: Request) -> list[str]:
    """Return the methods that the path of a request takes."""
    asked = ({**request.scope, "method": method} for method in HTTPMethod)
    routes = request.app.routes
    return [scope["method"] for scope in asked if any(route.matches(scope)[0] == Match.FULL for route in routes)]


def _as_asked(request: Request, found: JSONResponse) -> Response:
    """Return an error as a page where a browser asks for one, else as it is."""
    if request.url.path.startswith("/api/") or "text/html" not in request.headers.get("accept", ""):
        return found
    return error_page(request, json.loads(bytes(found.body))["error"], found.status_code)


def unexpected(request: Request, error: Exception) -> Response:
    """Return the response for what nobody foresaw; it tells nothing of it."""
    if isinstance(error, sqlite3.Error):  # in what stands in front of the routes
        return _store_fails(request, error)
    problem = TractError(
        "the service failed", f"{request.method} {request.url.path}", remedy="Try again; its log says why it failed"
    )
    return _as_asked(request, JSONResponse(body(problem), HTTPStatus.INTERNAL_SERVER_ERROR))
