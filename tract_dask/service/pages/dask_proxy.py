"""Dask's dashboard under the service's own address: a reverse proxy for its pages, and for the sockets that feed them.

Only what its pages need passes: no method but GET and HEAD, no cookie and no token of ours, and no path but those named
here. Others change things (Dask's own API), or reach other servers (its proxy to workers, Jupyter). A path is decoded
once and tidied up before it is judged, and goes on in that form. Its pages link relative to themselves, so they work
under any prefix; redirects are given ours.
"""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import AsyncIterator
from contextlib import suppress
from http import HTTPStatus
from urllib.parse import quote, unquote, urlsplit

import httpx
import websockets
from fastapi import APIRouter, Request, WebSocket
from fastapi.responses import RedirectResponse, Response, StreamingResponse
from starlette.background import BackgroundTask
from starlette.exceptions import HTTPException
from starlette.types import Scope
from starlette.websockets import WebSocketDisconnect

from ..services import Served
from . import templates

PREFIX = "/dask"
HOME = f"{PREFIX}/status"

CONTENT_SECURITY_POLICY = "; ".join(
    (
        "default-src 'self'",
        "script-src 'self' 'unsafe-inline' 'unsafe-eval'",
        "style-src 'self' 'unsafe-inline'",
        "img-src 'self' data: blob:",
        "font-src 'self' data:",
        "connect-src 'self'",
        "object-src 'none'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
"""Dask's pages have scripts in them, and Bokeh compiles some; they still reach no other server."""

_SENT_ON = ("accept", "accept-encoding", "accept-language", "if-modified-since", "if-none-match", "range")
_SENT_BACK = (
    "accept-ranges",
    "cache-control",
    "content-disposition",
    "content-encoding",
    "content-length",
    "content-range",
    "content-type",
    "etag",
    "last-modified",
    "vary",
)
_PAGES = (
    *("status", "workers", "tasks", "system", "profile", "profile-server", "graph", "groups", "gpu", "hardware"),
    *("shuffle", "stealing", "events", "counters", "exceptions"),
)
_PLOT = re.compile(r"individual-[a-z0-9-]+")
_FILE = re.compile(r"[\w@+-][\w@+.-]*", re.ASCII)
_TABLES = frozenset(("main", "worker", "task", "call-stack", "call-stacks", "logs"))
_SOCKET = "ws"

_MAX_MESSAGE_BYTES = 64 << 20
_GOING_AWAY, _NO_DASHBOARD = 1001, 1013

log = logging.getLogger(__name__)

dashboard = APIRouter(include_in_schema=False)


@dashboard.get(PREFIX)
@dashboard.get(f"{PREFIX}/")
def home() -> Response:
    """Go to the dashboard's first page."""
    return RedirectResponse(HOME, HTTPStatus.SEE_OTHER)


@dashboard.api_route(PREFIX + "/{path:path}", methods=["GET", "HEAD"])
async def page(request: Request, services: Served, path: str) -> Response:
    """Pass a page of the dashboard, or a part of one, on."""
    address, parts = services.runner.cluster.dashboard(), canonical(request.scope)
    if not may_pass(parts):
        raise HTTPException(HTTPStatus.NOT_FOUND)
    if address is None:
        return _missing(request)
    headers = {name: request.headers[name] for name in _SENT_ON if name in request.headers}
    try:
        found = await services.upstream.get(_url(address, parts, request.scope), request.method, headers)
    except httpx.HTTPError as error:
        log.info("the dashboard at %s does not answer: %s", address, error or type(error).__name__)
        return _missing(request)
    kept = {name: found.headers[name] for name in _SENT_BACK if name in found.headers}
    if location := found.headers.get("location"):
        kept["location"] = _under_prefix(location, address)
    kept["content-security-policy"] = CONTENT_SECURITY_POLICY
    return StreamingResponse(found.aiter_raw(), found.status_code, kept, background=BackgroundTask(found.aclose))


@dashboard.websocket(PREFIX + "/{path:path}")
async def socket(client: WebSocket, services: Served, path: str) -> None:
    """Pass the messages of a page's socket on, both ways."""
    address, parts = services.runner.cluster.dashboard(), canonical(client.scope)
    if address is None or not (parts[-1:] == (_SOCKET,) and _is_page(parts[:-1])):
        await client.close(_NO_DASHBOARD)
        return
    url = _url(address, parts, client.scope)
    protocols = [websockets.Subprotocol(name) for name in client.scope["subprotocols"]]
    try:
        upstream = await websockets.connect(
            url.replace("http", "ws", 1),
            ssl=services.upstream.context if url.startswith("https") else None,
            origin=websockets.Origin(address.rstrip("/")),
            subprotocols=protocols or None,
            max_size=_MAX_MESSAGE_BYTES,
            compression=None,
            proxy=None,
        )
    except (OSError, websockets.WebSocketException) as error:
        log.info("the dashboard at %s does not take a socket: %s", address, error)
        await client.close(_NO_DASHBOARD)
        return
    async with upstream:
        await client.accept(upstream.subprotocol)
        await _exchange(client, upstream)


async def _exchange(client: WebSocket, upstream: websockets.ClientConnection) -> None:
    """Pass messages on until either side is gone."""
    ways = [
        asyncio.ensure_future(_to_dashboard(client, upstream)),
        asyncio.ensure_future(_to_browser(client, upstream)),
    ]
    try:
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for way in ways:
            way.cancel()
        await asyncio.gather(*ways, return_exceptions=True)
    with suppress(RuntimeError, WebSocketDisconnect):  # the browser has closed it already
        await client.close(_GOING_AWAY)


async def _to_dashboard(client: WebSocket, upstream: websockets.ClientConnection) -> None:
    with suppress(WebSocketDisconnect, websockets.ConnectionClosed):
        async for message in _messages(client):
            await upstream.send(message)


async def _to_browser(client: WebSocket, upstream: websockets.ClientConnection) -> None:
    with suppress(WebSocketDisconnect, websockets.ConnectionClosed):
        async for message in upstream:
            await (client.send_text(message) if isinstance(message, str) else client.send_bytes(message))


async def _messages(client: WebSocket) -> AsyncIterator[str | bytes]:
    while True:
        message = await client.receive()
        if message["type"] == "websocket.disconnect":
            return
        text = message.get("text")
        yield message["bytes"] if text is None else text


def canonical(scope: Scope) -> tuple[str, ...]:
    """Return the parts of the path below the prefix: decoded once, without empty ones, "." and "..".

    Examples
    --------
    >>> canonical({"raw_path": b"/dask/./x/%2e%2e//info/worker/tcp%3A%2F%2F127.0.0.1%3A1.html"})
    ('info', 'worker', 'tcp://127.0.0.1:1.html')
    """
    raw = str(scope["raw_path"], "latin-1").partition("?")[0]
    parts: list[str] = []
    for part in map(unquote, raw.removeprefix(PREFIX).split("/")):
        if part == "..":
            parts = parts[:-1]
        elif part not in ("", "."):
            parts.append(part)
    return tuple(parts)


def may_pass(parts: tuple[str, ...]) -> bool:
    """Tell whether a path is one that the dashboard's pages need."""
    return _is_page(parts) or _is_file(parts) or _is_table(parts)


def _is_page(parts: tuple[str, ...]) -> bool:
    """Tell whether it is a page of plots, or the script that loads one."""
    match parts:
        case (name,) | (name, "autoload.js"):
            return name in _PAGES or _PLOT.fullmatch(name) is not None
    return False


def _is_file(parts: tuple[str, ...]) -> bool:
    """Tell whether it is a script, a style sheet or a picture."""
    match parts:
        case ("static" | "statics", _, *_):
            return all(_FILE.fullmatch(part) for part in parts)
    return False


def _is_table(parts: tuple[str, ...]) -> bool:
    """Tell whether it is a page about a worker or a task, whose names may hold anything."""
    match parts:
        case ("info",):
            return True
        case ("info", table, name):
            return table in _TABLES and name.endswith(".html")
    return False


def _url(address: str, parts: tuple[str, ...], scope: Scope) -> str:
    """Return where the dashboard has what is asked for."""
    path = "/".join(quote(part, safe="") for part in parts)
    query = str(scope["query_string"], "latin-1")
    return f"{address.rstrip('/')}/{path}{'?' if query else ''}{query}"


def _under_prefix(location: str, address: str) -> str:
    """Return a redirect of the dashboard as one of ours.

    Examples
    --------
    >>> _under_prefix("/status", "http://127.0.0.1:8787"), _under_prefix("http://127.0.0.1:8787/info", "http://127.0.0.1:8787")
    ('/dask/status', '/dask/info')
    >>> _under_prefix("status", "http://127.0.0.1:8787"), _under_prefix("https://example.org/", "http://127.0.0.1:8787")
    ('status', '/dask/status')
    """
    target = urlsplit(location)
    if target.netloc and target.netloc != urlsplit(address).netloc:
        return HOME
    path = target.path if target.path.startswith("/") or not target.netloc else "/"
    query = f"?{target.query}" if target.query else ""
    return f"{PREFIX if path.startswith('/') else ''}{path}{query}"


def _missing(request: Request) -> Response:
    return templates.TemplateResponse(request, "dashboard.html", status_code=HTTPStatus.SERVICE_UNAVAILABLE)
