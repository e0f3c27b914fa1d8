"""What every response says to browsers, and how much a request may say; plain ASGI, so that streams stay streams."""

from __future__ import annotations

import re
from http import HTTPStatus

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..config import LOOPBACK
from ..errors import TooLargeError, answer

CONTENT_SECURITY_POLICY = "; ".join(
    (
        "default-src 'self'",
        "script-src 'self'",
        "style-src 'self' 'unsafe-inline'",
        "img-src 'self' data: blob:",
        "connect-src 'self'",
        "object-src 'none'",
        "base-uri 'none'",
        "form-action 'self'",
        "frame-ancestors 'none'",
    )
)
"""Scripts come from our own files only; nothing is loaded from elsewhere; nobody shows our pages in a frame."""

_ALWAYS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=(), payment=(), usb=()",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
_HSTS = "max-age=31536000"
_TABLES = re.compile(r"/api/v1/jobs/[^/]*/columns(/refine|/lattice)?")


class SecurityHeaders:
    """Adds the headers that a browser application should have; a route's own come first."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and add to what comes back."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                add(MutableHeaders(scope=message), scope)
            await send(message)

        await self.app(scope, receive, send_with_headers)


def add(headers: MutableHeaders, scope: Scope) -> None:
    """Add the headers of a response to the request ``scope``."""
    for name, value in _ALWAYS.items():
        headers.setdefault(name, value)
    headers.setdefault("Content-Security-Policy", CONTENT_SECURITY_POLICY)
    is_static = scope["path"].startswith("/static/")
    headers.setdefault("Cache-Control", "no-cache" if is_static else "no-store")
    if scope["scheme"] in ("https", "wss") and host_name(Headers(scope=scope).get("host", "")) not in LOOPBACK:
        headers.setdefault("Strict-Transport-Security", _HSTS)


def host_name(host: str) -> str:
    """Return the name in a Host header, without its port and the brackets of IPv6.

    Examples
    --------
    >>> host_name("localhost:8000"), host_name("[::1]:8000"), host_name("::1")
    ('localhost', '::1', '::1')
    """
    if host.startswith("["):
        return host[1:].partition("]")[0].lower()
    return (host if host.count(":") > 1 else host.partition(":")[0]).lower()


class BodyLimit:
    """Refuses requests whose body is too large, whether they say so or send it in chunks.

    Parameters
    ----------
    most
        Bytes of a table of columns, which a process of the pool reads.
    small
        Bytes of all others, which are read between other requests.
    """

    def __init__(self, app: ASGIApp, most: int, small: int = 1 << 20) -> None:
        self.app, self.most, self.small = app, most, min(most, small)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and count what it brings."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        said, came = Headers(scope=scope).get("content-length", ""), 0
        most = self.most if _TABLES.fullmatch(scope["path"]) else self.small
        text = f"the body is larger than {most} bytes"
        if said.isdecimal() and int(said[:20]) > most:
            await answer(TooLargeError(text))(scope, receive, send)
            return

        async def counted() -> Message:
            nonlocal came
            message = await receive()
            came += len(message.get("body", b""))
            if came > most:
                raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, text)  # the framework lets this one pass
            return message

        await self.app(scope, counted, send)
