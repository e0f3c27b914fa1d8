"""Answers that the process pool makes, and that browsers may keep: with an ETag, by what they are made from."""

from __future__ import annotations

import hashlib
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar

from fastapi import Query, Request, Response
from fastapi.responses import StreamingResponse

from ...readers.movie_files import FileList
from ...store.journal import logs

Version = Annotated[
    str,
    Query(
        alias="v",
        max_length=64,
        pattern="^[0-9a-f]*$",
        description="The ``version`` that another answer gave: then this one is kept without asking again.",
    ),
]

NOT_MODIFIED: dict[int | str, dict[str, Any]] = {304: {"description": "As the client has it (If-None-Match)."}}

_PART_BYTES = 256 << 10
_FOREVER = "private, max-age=31536000, immutable"
_ASK = "private, no-cache"

T = TypeVar("T")


class Pool(Protocol):
    """Does the work of requests, as :class:`tract_dask.service.process_pool.ProcessPool` does in other processes."""

    async def run(self, function: Callable[..., T], *args: Any, about: str | Path = "") -> T:
        """Return ``function(*args)``; ``about`` is the file or folder that it reads."""

    async def run_cached(self, key: str, function: Callable[..., bytes], *args: Any, about: str | Path = "") -> bytes:
        """Return ``function(*args)``, which may have been kept under this ``key``."""


def stamp(*paths: Path) -> str:
    """Return a text that is another once one of the files has changed, has come or has gone; a folder's files count."""
    digest = hashlib.sha256()
    for path in paths:
        files = logs(path) if path.suffix == ".journal" else [path]
        for file in files:
            try:
                status = file.stat()
                digest.update(f"{file}\0{status.st_ino}\0{status.st_mtime_ns}\0{status.st_size}\0".encode())
            except OSError:
                digest.update(f"{file}\0-\0".encode())
    return digest.hexdigest()[:16]


def whole(content: bytes, media_type: str, headers: Mapping[str, str] | None = None) -> Response:
    """Return a response; a large one goes out in parts, so that other requests are answered between them."""
    if len(content) <= _PART_BYTES:
        return Response(content, media_type=media_type, headers=headers)
    size = {"Content-Length": str(len(content))}
    return StreamingResponse(_parts(content), media_type=media_type, headers={**(headers or {}), **size})


async def _parts(content: bytes) -> AsyncIterator[bytes]:
    for begin in range(0, len(content), _PART_BYTES):
        yield content[begin : begin + _PART_BYTES]


async def kept_answer(
    request: Request,
    pool: Pool,
    media_type: str,
    version: str,
    function: Callable[..., bytes],
    *args: Any,
    about: str | Path | FileList,
    said: str = "",
) -> Response:
    """Return what ``function`` makes of ``args`` in the pool, or 304 where the client has it.

    Parameters
    ----------
    version
        From :func:`stamp`: of all that the function reads.
    about
        The file or folder that it reads.
    said
        The version that the client named in its request.
    """
    key = hashlib.sha256(f"{version}\0{function.__qualname__}\0{args!r}".encode()).hexdigest()[:32]
    headers = {"ETag": f'"{key}"', "Cache-Control": _FOREVER if said == version else _ASK}
    if key in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    content = await pool.run_cached(key, function, *args, about=str(about))
    return whole(content, media_type, headers)
