"""Answers of a service, and the errors in them."""

from __future__ import annotations

import ssl
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import httpcore  # noqa: F401  httpx would import it with its first client, which two threads may make at once
import httpx

from .. import errors
from ..errors import ClusterError, InputError, ServiceError, TractError
from ..settings.run import RunSettings
from ..settings.toml import to_dict

_COME_BACK = (502, 503, 504)

_KINDS = {name: kind for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, TractError)}
"""Classes of errors by name; what the service alone knows comes out as the nearest one."""


def check_answer(answer: httpx.Response) -> None:
    """Raise the error that an answer is, if it is one."""
    if answer.is_success:
        return
    answer.read()
    try:
        parts = answer.json()["error"]
        kind = _KINDS.get(parts.get("kind", "")) or _kind(answer.status_code)
        raise kind(**{name: parts[name] for name in ("what", "where", "expected", "got", "remedy")})
    except (ValueError, KeyError, TypeError, AttributeError):
        kind = ClusterError if answer.status_code in _COME_BACK else ServiceError
        raise kind(
            "the service gives an answer that cannot be understood",
            str(answer.request.url),
            got=f"{answer.status_code} {answer.reason_phrase}",
            remedy="Check that there is a tract-dask service at this address, and no proxy that keeps you out",
        ) from None


def _kind(status: int) -> type[TractError]:
    return InputError if status < 500 else ClusterError if status in _COME_BACK else ServiceError


def values_of(settings: RunSettings | Mapping[str, Mapping[str, Any]] | None) -> dict[str, Any]:
    """Return settings as they are sent: without the cluster, which is the service's."""
    values = to_dict(settings) if isinstance(settings, RunSettings) else dict(settings or {})
    return {group: value for group, value in values.items() if group != "cluster"}


def trusting(ca: str | Path | None) -> ssl.SSLContext | bool:
    """Return what certificates are trusted."""
    if ca is None:
        return True
    try:
        return ssl.create_default_context(cafile=str(ca))
    except (OSError, ssl.SSLError) as error:
        raise InputError(
            "the certificate of the authority cannot be read",
            str(ca),
            "a PEM file, such as ca.pem of tract-dask certs",
            str(error),
            "Check its path",
        ) from error
