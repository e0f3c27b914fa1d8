"""The login of browsers: a token in a form, for a session in a cookie."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Form, Query, Request
from fastapi.responses import RedirectResponse, Response

from ..auth.gate import LOGIN, cookie_name, read_cookie
from ..services import Served
from . import templates

login = APIRouter(include_in_schema=False)


@login.get(LOGIN)
def show_form(request: Request, services: Served, to: Annotated[str, Query(alias="next")] = "/") -> Response:
    """Ask for a token; where none is demanded, go on."""
    if not services.access.demanded:
        return RedirectResponse("/", 303)
    return _form(request, to)


@login.post(LOGIN)
def log_in(
    request: Request,
    services: Served,
    token: Annotated[str, Form(max_length=256)] = "",
    to: Annotated[str, Form(alias="next")] = "/",
) -> Response:
    """Open a session for the holder of a token."""
    session = services.access.open_session(token.strip())
    if session is None:
        return _form(request, to, "This token is not valid.", 401)
    config = services.config
    response = RedirectResponse(_local(to), 303)
    response.set_cookie(
        cookie_name(request.scope, config),
        session,
        max_age=int(3600 * config.session_hours),
        secure=request.url.scheme == "https",
        httponly=True,
        samesite="strict",
    )
    return response


@login.post("/logout")
def log_out(request: Request, services: Served) -> Response:
    """End the session."""
    name = cookie_name(request.scope, services.config)
    services.access.close_session(read_cookie(request.headers, name))
    response = RedirectResponse(LOGIN, 303)
    response.delete_cookie(name, secure=request.url.scheme == "https", httponly=True, samesite="strict")
    return response


def _form(request: Request, to: str, problem: str = "", status: int = 200) -> Response:
    values = {"next": _local(to), "problem": problem}
    return templates.TemplateResponse(request, "login.html", values, status_code=status)


def _local(to: str) -> str:
    """Return where to go after the login: a path of ours, whatever a link said."""
    is_local = to.startswith("/") and not to.startswith(("//", "/\\")) and to.isprintable()
    return to if is_local and not to.startswith(LOGIN) else "/"
