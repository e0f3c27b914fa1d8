"""Who may come in: tokens, the sessions of browsers that logged in with one, and what each role may do.

A token is ``tract_ID_SECRET``, a session's cookie ``ID_SECRET``: the ID finds the row, and the secret, 256 random bits,
is known by its SHA-256 only. A session ends with its token.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import sqlite3
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from typing import Literal

from starlette.requests import HTTPConnection

from ...errors import InputError
from ..config import ServiceConfig
from ..errors import ForbiddenError, NoTokenError
from ..jobs.records import Job
from ..jobs.store import JobStore

TOKEN_PREFIX = "tract"
IDENTITY = "tract_dask.identity"
"""Key of the ASGI scope under which the gate leaves who asks."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")

_TABLES = """
CREATE TABLE IF NOT EXISTS tokens (
    id TEXT PRIMARY KEY, name TEXT NOT NULL, role TEXT NOT NULL, digest BLOB NOT NULL,
    created TEXT NOT NULL, revoked TEXT
);
CREATE UNIQUE INDEX IF NOT EXISTS tokens_in_use ON tokens (name) WHERE revoked IS NULL;
CREATE TABLE IF NOT EXISTS sessions (
    id TEXT PRIMARY KEY, token_id TEXT NOT NULL REFERENCES tokens (id), digest BLOB NOT NULL, expires REAL NOT NULL
);
"""


class Role(StrEnum):
    """What the holder of a token may do."""

    ADMIN = "admin"
    USER = "user"
    MONITOR = "monitor"


@dataclass(frozen=True)
class Identity:
    """Who asks: ``name`` owns the jobs that it submits."""

    name: str
    role: str


LOCAL = Identity("local", Role.ADMIN)
"""Who asks over loopback, where no tokens are demanded."""


@dataclass(frozen=True)
class Credential:
    """What a request came with: the token of a program, or the session of a browser."""

    kind: Literal["token", "session"]
    secret: str = field(repr=False)


@dataclass(frozen=True)
class Token:
    """A token as it is listed; its secret is known to its holder alone."""

    id: str
    name: str
    role: str
    created: str
    revoked: str | None


class Access:
    """The tokens and sessions in the service's store.

    Parameters
    ----------
    store
        Of the jobs; tokens and sessions have tables of their own in its database.
    config
        Whether tokens are demanded, and how long a session lasts.
    """

    def __init__(self, store: JobStore, config: ServiceConfig) -> None:
        self._store, self._config = store, config
        self.demanded = config.needs_tokens
        store.connection().executescript(_TABLES)

    def create_token(self, name: str, role: str = Role.USER) -> str:
        """Return a new token; it is shown here, and never again.

        Raises
        ------
        InputError
            Where the name is not one of 1 to 64 letters, digits, ".", "_", "@" and "-", or has a token already.
        """
        if not _NAME.fullmatch(name):
            raise InputError(
                "this cannot be the name of a token",
                "NAME",
                'letters, digits, ".", "_", "@", "-"; at most 64',
                repr(name),
            )
        if role not in list(Role):
            raise InputError("there is no such role", "role", f"one of {', '.join(Role)}", repr(role))
        identifier, secret = secrets.token_hex(4), secrets.token_urlsafe(32)
        row = (identifier, name, str(role), _digest(secret), _now())
        try:
            self._db.execute("INSERT INTO tokens (id, name, role, digest, created) VALUES (?, ?, ?, ?, ?)", row)
        except sqlite3.IntegrityError as error:
            raise InputError(
                "this name has a token already", name, remedy="Choose another name, or revoke that token first"
            ) from error
        return f"{TOKEN_PREFIX}_{identifier}_{secret}"

    def revoke(self, name: str) -> Token:
        """Revoke the token with this name or ID, and end its sessions; return what is known of it.

        Raises
        ------
        InputError
            Where there is no such token in use.
        """
        found = next((token for token in self.tokens() if name in (token.name, token.id) and not token.revoked), None)
        if found is None:
            raise InputError(
                "there is no token in use with this name or ID", name, remedy="List them with: tract-dask token list"
            )
        self._db.execute("UPDATE tokens SET revoked = ? WHERE id = ?", (_now(), found.id))
        self._db.execute("DELETE FROM sessions WHERE token_id = ?", (found.id,))
        return found

    def tokens(self) -> list[Token]:
        """Return all tokens, the revoked ones too, in the order of their making."""
        rows = self._db.execute("SELECT id, name, role, created, revoked FROM tokens ORDER BY rowid")
        return [Token(*row) for row in rows]

    def identify(self, credential: Credential) -> Identity | None:
        """Return whose credential this is; None where it is wrong, revoked or expired."""
        if not credential.secret.isascii():
            return None
        row = self._token_row(credential.secret) if credential.kind == "token" else self._session_row(credential.secret)
        return Identity(row["name"], row["role"]) if row is not None else None

    def open_session(self, token: str) -> str | None:
        """Return the cookie of a new session; None where the token is wrong or revoked. Expired ones are cleared."""
        row = self._token_row(token) if token.isascii() else None
        if row is None:
            return None
        identifier, secret, now = secrets.token_hex(8), secrets.token_urlsafe(32), time.time()
        self._db.execute("DELETE FROM sessions WHERE expires < ?", (now,))
        self._db.execute(
            "INSERT INTO sessions (id, token_id, digest, expires) VALUES (?, ?, ?, ?)",
            (identifier, row["id"], _digest(secret), now + 3600 * self._config.session_hours),
        )
        return f"{identifier}_{secret}"

    def close_session(self, cookie: str) -> None:
        """End a session, if it is one."""
        if cookie.isascii() and self._session_row(cookie) is not None:
            self._db.execute("DELETE FROM sessions WHERE id = ?", (cookie.partition("_")[0],))

    @property
    def _db(self) -> sqlite3.Connection:
        return self._store.connection()

    def _token_row(self, token: str) -> sqlite3.Row | None:
        prefix, _, rest = token.partition("_")
        identifier, _, secret = rest.partition("_")
        query = "SELECT id, name, role, digest FROM tokens WHERE id = ? AND revoked IS NULL"
        row = self._db.execute(query, (identifier,)).fetchone()
        return _proven(row, secret) if prefix == TOKEN_PREFIX else None

    def _session_row(self, cookie: str) -> sqlite3.Row | None:
        identifier, _, secret = cookie.partition("_")
        query = """SELECT tokens.name, tokens.role, sessions.digest FROM sessions
            JOIN tokens ON tokens.id = sessions.token_id
            WHERE sessions.id = ? AND sessions.expires > ? AND tokens.revoked IS NULL"""
        return _proven(self._db.execute(query, (identifier, time.time())).fetchone(), secret)


def identity(request: HTTPConnection) -> Identity:
    """Return who asks; a dependency of routes.

    Raises
    ------
    NoTokenError
        Where the gate has let nobody in: the application was put together without it.
    """
    found = request.scope.get(IDENTITY)
    if not isinstance(found, Identity):
        raise NoTokenError("the request has no valid token", request.url.path)
    return found


def may_change(who: Identity, job: Job) -> None:
    """Check that ``who`` owns the job, or is an admin.

    Raises
    ------
    ForbiddenError
        Where not.
    """
    if who.role != Role.ADMIN and who.name != job.owner:
        raise ForbiddenError(
            "this job belongs to someone else", job.id, job.owner, who.name, "Ask its owner, or an administrator"
        )


def _proven(row: sqlite3.Row | None, secret: str) -> sqlite3.Row | None:
    """Return the row if the secret is its own; takes as long where there is none."""
    known = row["digest"] if row is not None else bytes(32)
    same = hmac.compare_digest(known, _digest(secret))
    return row if same and row is not None else None


def _digest(secret: str) -> bytes:
    return hashlib.sha256(secret.encode()).digest()


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
