"""Why a request is refused, whatever it asks for."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import InputError


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


class TooManyError(InputError):
    """Too many attempts in a short time."""
