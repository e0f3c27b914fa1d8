"""The gate before every route, page and socket: where a request comes from, who sends it, and whether they still may.

Plain ASGI, so that streams stay streams. A connection that lasts, such as a stream of events, is asked again every
other second, and ends soon after its token was revoked.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from http.cookies import CookieError, SimpleCookie
from urllib.parse import quote, urlsplit

from starlette.datastructures import Headers
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..config import LOOPBACK, ServiceConfig
from ..errors import ForbiddenError, NoTokenError, answer
from .headers import host_name
from .tokens import IDENTITY, LOCAL, Access, Credential, Identity, Role

API = "/api/"
MONITORED = ("/api/v1/health", "/api/v1/metrics")
"""What the role ``monitor`` may read."""

STATIC = "/static/"
LOGIN = "/login"

ASKED_AGAIN_S = 2.0

_SAFE = ("GET", "HEAD", "OPTIONS")
_SAME_SITE = ("", "same-origin", "none")
_POLICY_VIOLATION = 1008
_COME_AGAIN = '<!doctype html><title>tract_dask</title><meta http-equiv="refresh" content="0">'


class Gate:
    """Lets through who may come in.

    Parameters
    ----------
    app
        What is behind it.
    access
        Who has which token.
    config
        The names under which the service is asked for.
    """

    def __init__(self, app: ASGIApp, access: Access, config: ServiceConfig) -> None:
        self.app, self.access, self.config = app, access, config

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on with its identity, or answer it here."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        try:
            self._check_origin(scope)
            credential = self._credential(scope)
            if not _is_open(scope["path"]):
                scope[IDENTITY] = self._identify(scope, credential)
        except ForbiddenError as error:
            await answer(error)(scope, receive, send)
        except NoTokenError as error:
            await _ask_for_token(scope, error)(scope, receive, send)
        else:
            await self._while_allowed(credential, scope, receive, send)

    def _check_origin(self, scope: Scope) -> None:
        """Refuse what another site makes a browser send: forms, scripts, sockets, and names that it gave our address.

        Raises
        ------
        ForbiddenError
            Where it does.
        """
        headers, method = Headers(scope=scope), scope.get("method", "GET")
        host, origin, site = (headers.get(name, "") for name in ("host", "origin", "sec-fetch-site"))
        if not self.access.demanded and not self._is_ours(host):
            raise ForbiddenError(
                "the service does not answer to this name",
                "header Host",
                f"{self.config.host}:{self.config.port}",
                host,
                "Open the address that serve prints, or allow this name with --allowed-host",
            )
        if "authorization" in headers and self.access.demanded:
            return  # no browser adds this by itself
        came_from_link = method == "GET" and headers.get("sec-fetch-mode") == "navigate" and scope["type"] == "http"
        foreign_site = site not in _SAME_SITE and not came_from_link
        acts = method not in _SAFE or scope["type"] == "websocket"
        foreign_origin = acts and bool(origin) and urlsplit(origin).netloc not in {host, *self.config.allowed_hosts}
        is_browser = "cookie" in headers or scope["path"] == LOGIN  # programs have no use for a login
        unknown = acts and is_browser and not origin and not site
        if foreign_site or foreign_origin or unknown:
            raise ForbiddenError(
                "the request comes from another site",
                scope["path"],
                f"the origin {host}",
                origin or site or "none",
                "Use the service's own pages, or a program with a token",
            )

    def _is_ours(self, host: str) -> bool:
        """Tell whether ``host`` is a name of the loopback with our port, or one that is allowed."""
        port = f":{self.config.port}"
        return host in self.config.allowed_hosts or (host.endswith(port) and host_name(host) in LOOPBACK)

    def _credential(self, scope: Scope) -> Credential | None:
        headers = Headers(scope=scope)
        scheme, _, token = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            return Credential("token", token.strip())
        cookie = read_cookie(headers, cookie_name(scope, self.config))
        return Credential("session", cookie) if cookie else None

    def _identify(self, scope: Scope, credential: Credential | None) -> Identity:
        if not self.access.demanded:
            return LOCAL
        who = self.access.identify(credential) if credential is not None else None
        if who is None:
            raise NoTokenError(
                "a token is needed" if credential is None else "the token or the session is not valid",
                scope["path"],
                remedy="Send a header Authorization: Bearer TOKEN, or log in; tract-dask token create makes tokens",
            )
        if who.role == Role.MONITOR and not (scope["path"] in MONITORED and scope.get("method") in _SAFE):
            raise ForbiddenError("this token may only read health and metrics", scope["path"], got=f"token {who.name}")
        return who

    async def _while_allowed(self, credential: Credential | None, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve the request; end it where its credential stops being valid."""
        if not self.access.demanded or _is_open(scope["path"]) or credential is None:
            await self.app(scope, receive, send)
            return
        loop, begun = asyncio.get_running_loop(), False
        timer: asyncio.TimerHandle | None = None

        async def noticed(message: Message) -> None:
            nonlocal begun
            begun = begun or message["type"] in ("http.response.start", "websocket.accept")
            await send(message)

        def ask() -> None:
            nonlocal timer
            if self.access.identify(credential) is None:
                deadline.reschedule(loop.time())
            else:
                timer = loop.call_later(ASKED_AGAIN_S, ask)

        try:
            async with asyncio.timeout(None) as deadline:
                timer = loop.call_later(ASKED_AGAIN_S, ask)
                await self.app(scope, receive, noticed)
        except TimeoutError:
            if not deadline.expired():
                raise
            await _end(scope, receive, send, begun=begun)
        finally:
            if timer is not None:
                timer.cancel()


def cookie_name(scope: Scope, config: ServiceConfig) -> str:
    """Return the name of the session's cookie: one a port, since cookies are shared among the ports of a host."""
    secure = scope["scheme"] in ("https", "wss")
    return "__Host-tract_dask" if secure else f"tract_dask_{config.port}"


def read_cookie(headers: Mapping[str, str], name: str) -> str:
    """Return the value of a cookie; "" where there is none."""
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(name)
    except CookieError:
        return ""
    return found.value if found is not None else ""


def _is_open(path: str) -> bool:
    return path == LOGIN or path.startswith(STATIC)


def _ask_for_token(scope: Scope, error: NoTokenError) -> Response:
    """Return 401 for programs and sockets, and the way to the login for pages."""
    if scope["type"] == "websocket" or scope["path"].startswith(API) or scope["method"] not in ("GET", "HEAD"):
        return answer(error, headers={"WWW-Authenticate": "Bearer"})
    if Headers(scope=scope).get("sec-fetch-site") == "cross-site":
        return HTMLResponse(_COME_AGAIN)  # a link on another site: the browser sends its cookie when we ask ourselves
    query = f"?{scope['query_string'].decode('latin-1')}" if scope["query_string"] else ""
    return RedirectResponse(f"{LOGIN}?next={quote(scope['path'] + query)}", 303)


async def _end(scope: Scope, receive: Receive, send: Send, *, begun: bool) -> None:
    if scope["type"] == "websocket" and begun:
        await send({"type": "websocket.close", "code": _POLICY_VIOLATION, "reason": "the token was revoked"})
    elif begun:
        await send({"type": "http.response.body", "body": b"", "more_body": False})
    else:
        await answer(NoTokenError("the token was revoked", scope["path"]))(scope, receive, send)
