"""Why a request is refused, whatever it asks for."""

from __future__ import annotations

from ..errors import InputError


class ForbiddenError(InputError):
    """Who asks is known, and may not do this."""


class NoTokenError(InputError):
    """Who asks is not known."""


class TooLargeError(InputError):
    """The body of the request is larger than the service takes."""


class TooManyError(InputError):
    """Too many attempts in a short time."""
