"""Errors of the service: why a request is refused, and how each is shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, Field
from starlette.responses import JSONResponse

from ..errors import ClusterError, InputError, MissingStoreError, StoreError, TractError
from .crashes import CrashError, ExhaustedError, UnreachableError
from .data_root import DataRoot, OutsideError
from .jobs.records import ConflictError, UnknownJobError, UnknownVersionError
from .jobs.tables import JobStoreError


class ForbiddenError(InputError):
    """Who asks is known, and may not do this."""


def invalid(what: str, place: Sequence[int | str]) -> InvalidError:
    """Return the error for a field that is missing or invalid; ``place`` leads to it."""
    return InvalidError(what, ".".join(map(str, place)), remedy="Correct it and send it again")


class NoTokenError(InputError):
    """Who asks is not known."""


class InvalidError(InputError):
    """A field of the body is missing or invalid."""


class TooLargeError(InputError):
    """The body of the request is larger than the service takes."""


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
    JobStoreError: 503,
    UnreachableError: 503,
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
    503: {"model": ErrorBody, "description": "The cluster, the job store or a disk does not answer now."},
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
