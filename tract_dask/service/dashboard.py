"""Dask's dashboard under the service's own address: a reverse proxy for its pages, and for the sockets that feed them.

Only what is read passes: no method but GET and HEAD, no cookie and no token of ours, and none of the ways through which
a scheduler can reach other servers (its proxy to workers, Jupyter). Its pages link relative to themselves, so they work
under any prefix; redirects are given ours.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import suppress
from http import HTTPStatus
from urllib.parse import urlsplit

import httpcore  # noqa: F401  httpx would import it with its first client, while other threads import h11 and anyio
import httpx
import websockets
from fastapi import APIRouter, Request, WebSocket
from fastapi.responses import RedirectResponse, Response, StreamingResponse
from starlette.background import BackgroundTask
from starlette.types import Scope
from starlette.websockets import WebSocketDisconnect

from ..tls import web_context
from .pages import templates

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
_REFUSED = ("jupyter", "proxy")

_TIMEOUT = httpx.Timeout(60.0, connect=5.0)
_MAX_MESSAGE_BYTES = 64 << 20
_GOING_AWAY, _NO_DASHBOARD = 1001, 1013

log = logging.getLogger(__name__)

dashboard = APIRouter(include_in_schema=False)


class Upstream:
    """Connections to the dashboard, shared by all requests; opened with the first.

    Parameters
    ----------
    certificates
        Folder of those that the dashboard may use (setting tls).
    """

    def __init__(self, certificates: str | None = None) -> None:
        self.context = web_context(certificates)
        self._client: httpx.AsyncClient | None = None

    async def get(self, url: str, method: str, headers: dict[str, str]) -> httpx.Response:
        """Return a response whose body is still to come."""
        if self._client is None:
            self._client = httpx.AsyncClient(timeout=_TIMEOUT, trust_env=False, verify=self.context or True)
        return await self._client.send(self._client.build_request(method, url, headers=headers), stream=True)

    async def close(self) -> None:
        """Close the connections."""
        if self._client is not None:
            await self._client.aclose()


@dashboard.get(PREFIX)
@dashboard.get(f"{PREFIX}/")
def home() -> Response:
    """Go to the dashboard's first page."""
    return RedirectResponse(HOME, HTTPStatus.SEE_OTHER)


@dashboard.api_route(PREFIX + "/{path:path}", methods=["GET", "HEAD"])
async def page(request: Request, path: str) -> Response:
    """Pass a page of the dashboard, or a part of one, on."""
    address = request.app.state.runner.keeper.dashboard()
    if address is None or not _may_pass(path):
        return _missing(request)
    headers = {name: request.headers[name] for name in _SENT_ON if name in request.headers}
    try:
        found = await request.app.state.upstream.get(_url(address, request.scope), request.method, headers)
    except httpx.HTTPError as error:
        log.info("the dashboard at %s does not answer: %s", address, error or type(error).__name__)
        return _missing(request)
    kept = {name: found.headers[name] for name in _SENT_BACK if name in found.headers}
    if location := found.headers.get("location"):
        kept["location"] = _under_prefix(location, address)
    kept["content-security-policy"] = CONTENT_SECURITY_POLICY
    return StreamingResponse(found.aiter_raw(), found.status_code, kept, background=BackgroundTask(found.aclose))


@dashboard.websocket(PREFIX + "/{path:path}")
async def socket(client: WebSocket, path: str) -> None:
    """Pass the messages of a page's socket on, both ways."""
    address = client.app.state.runner.keeper.dashboard()
    if address is None or not _may_pass(path):
        await client.close(_NO_DASHBOARD)
        return
    url = _url(address, client.scope)
    protocols = [websockets.Subprotocol(name) for name in client.scope["subprotocols"]]
    try:
        upstream = await websockets.connect(
            url.replace("http", "ws", 1),
            ssl=client.app.state.upstream.context if url.startswith("https") else None,
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


def _may_pass(path: str) -> bool:
    """Tell whether a path stays with the dashboard's own pages."""
    parts = path.strip("/").split("/")
    return parts[0] not in _REFUSED and ".." not in parts


def _url(address: str, scope: Scope) -> str:
    """Return where the dashboard has what is asked for; the path goes on as it came, still encoded."""
    raw = str(scope["raw_path"], "latin-1").removeprefix(PREFIX)
    query = str(scope["query_string"], "latin-1")
    return f"{address.rstrip('/')}{raw}{'?' if query else ''}{query}"


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
