"""Every error that a route raises, answered in one shape: to a program as JSON, to a browser as a page."""

from __future__ import annotations

import json
import logging
import sqlite3
from collections.abc import Mapping, Sequence
from http import HTTPMethod, HTTPStatus
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response
from starlette.routing import Match

from ..errors import TractError
from .crashes import of_system
from .data_root import DataRoot
from .errors import answer, body, invalid
from .jobs.tables import store_error
from .pages import error_page

log = logging.getLogger(__name__)


class ErrorHandlers:
    """Answers every error that a route of an application may raise.

    Parameters
    ----------
    root
        Paths in errors are shown relative to it.
    database
        The file of the job store; None: the application has none.
    """

    def __init__(self, root: DataRoot, database: Path | None = None) -> None:
        self._root, self._database = root, database

    def install(self, app: FastAPI) -> None:
        """Let the application answer in this way."""
        app.add_exception_handler(TractError, self._tract_error)
        app.add_exception_handler(sqlite3.Error, self.unexpected)
        app.add_exception_handler(OSError, self._of_system)
        app.add_exception_handler(RequestValidationError, _invalid)
        app.add_exception_handler(HTTPException, _http)

    def unexpected(self, request: Request, error: Exception) -> Response:
        """Return the response for what nobody foresaw; it tells nothing of it, but where the job store fails."""
        if isinstance(error, sqlite3.Error) and self._database is not None:  # also in front of the routes
            return self._tract_error(request, store_error(self._database, error))
        problem = TractError(
            "the service failed", f"{request.method} {request.url.path}", remedy="Try again; its log says why it failed"
        )
        return _as_asked(request, JSONResponse(body(problem), HTTPStatus.INTERNAL_SERVER_ERROR))

    def _of_system(self, request: Request, error: Exception) -> Response:
        found = of_system(error)
        if found is None:
            raise error
        return self._tract_error(request, found)

    def _tract_error(self, request: Request, error: Exception) -> Response:
        assert isinstance(error, TractError)
        found = answer(of_system(error) or error, self._root)
        if found.status_code >= HTTPStatus.INTERNAL_SERVER_ERROR:
            log.warning("%s %s: %s", request.method, request.url.path, error)
        return _as_asked(request, found)


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
