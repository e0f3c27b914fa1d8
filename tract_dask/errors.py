"""The errors that users see: each says what is wrong, where, what was expected, what was found, and what to do."""

from __future__ import annotations

import sys
from enum import IntEnum

_LONGEST = 200


def shown(value: object) -> str:
    """Return a value as an error tells it: as Python writes it, the beginning of what is long.

    Examples
    --------
    >>> shown("a b"), shown(10**9999)
    ("'a b'", 'a very large number')
    """
    try:
        text = repr(value)
    except ValueError:  # Python writes integers of some thousand digits only
        return "a very large number"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


class ExitCode(IntEnum):
    """How commands, and processes of jobs, say that they ended."""

    DONE = 0
    FAILED = 1
    BAD_INPUT = 2
    """Also where a command is not used as it should be."""
    BAD_FRAMES = 3
    """Done, but for frames that could not be fitted."""
    INTERRUPTED = 130


class TractError(Exception):
    """An error with its place and its remedy; its text is one paragraph.

    Parameters
    ----------
    what
        What is wrong, as a sentence without its full stop.
    where
        File, page, setting or address.
    expected, got
        What was needed and what was found.
    remedy
        What the user can do, as a sentence without its full stop.

    Examples
    --------
    >>> print(TractError("the movie has no frames", where="empty.tif", remedy="Check the export"))
    empty.tif: the movie has no frames. Check the export.
    """

    exit_code = ExitCode.FAILED

    def __init__(self, what: str, where: str = "", expected: str = "", got: str = "", remedy: str = "") -> None:
        super().__init__(what, where, expected, got, remedy)  # positional, so that it pickles between workers
        self.what, self.where, self.expected, self.got, self.remedy = what, where, expected, got, remedy

    def __str__(self) -> str:
        found = "; ".join(
            part
            for part in (
                f"expected {self.expected}" if self.expected else "",
                f"got {self.got}" if self.got else "",
            )
            if part
        )
        sentences = [f"{self.where}: {self.what}" if self.where else self.what]
        if found:
            sentences.append(found[0].upper() + found[1:])
        if self.remedy:
            sentences.append(self.remedy)
        return ". ".join(sentences) + "."


class InputError(TractError):
    """The user's input cannot be used; nothing was started."""

    exit_code = ExitCode.BAD_INPUT


class SourceError(InputError):
    """A movie file is missing, damaged, or not a movie."""


class MissingSourceError(SourceError):
    """A movie file is not there, or one that it leads to."""


class ChangedSourceError(SourceError):
    """A movie's files changed while they were read."""


class SettingsError(InputError):
    """A setting is out of range, unknown, or contradicts another."""


class DestinationError(InputError):
    """The place to write to holds something else or cannot be written."""


class StoreError(TractError):
    """A store is damaged, unfinished, or could not be written (a full disk)."""


class MissingStoreError(StoreError):
    """What is to be read is not there, is not finished, or is something else; nothing was started."""

    exit_code = ExitCode.BAD_INPUT


class ClusterError(TractError):
    """The scheduler or its workers cannot do the work."""


class ServiceError(TractError):
    """The service cannot be reached, or its answer cannot be understood."""


def check_system() -> None:
    """Check that this is not Windows, which lacks what workers and stores are built on (fork, pread, file locks).

    Raises
    ------
    InputError
        Where it is.
    """
    if sys.platform == "win32":
        raise InputError(
            "tract_dask does not run on Windows",
            expected="Linux",
            got="Windows",
            remedy="Install and run it in WSL, the Linux inside Windows (wsl --install)",
        )
