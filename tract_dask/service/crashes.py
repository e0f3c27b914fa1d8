"""Files that a reader dies on, or that a disk does not give: what is said of them, and for how long it holds."""

from __future__ import annotations

import os
import signal
from collections import OrderedDict
from pathlib import Path
from time import monotonic

from ..cluster.deaths import CRASHES
from ..cluster.retries import Place, trouble
from ..errors import InputError, MissingStoreError, StoreError, TractError

_CRASHES = CRASHES | {signal.SIGFPE}
"""A process that does nothing but read this file, and divides by zero, does so by the file."""

_KEPT_S = 600.0
_MOST = 1000


class CrashError(InputError):
    """The library that reads a file crashed on it, or did not come to an end."""


class ExhaustedError(InputError):
    """What was asked for needs more memory than the service gives one request."""


def crash_of(code: int | None) -> str:
    """Return the name of the signal that a process crashed with, from its exit code; "" where it did not crash.

    Examples
    --------
    >>> crash_of(-11), crash_of(-9), crash_of(1)
    ('SIGSEGV', '', '')
    """
    return signal.Signals(-code).name if code is not None and -code in _CRASHES else ""


def crashed(file: str, sign: str) -> CrashError:
    """Return the error for a file on which a reader died of the signal ``sign``."""
    return CrashError(
        "the reader crashed on this file",
        file,
        "a file that can be read to its end",
        sign,
        "It may be damaged, or another program changed it meanwhile: write it again from its origin",
    )


def unending(file: str, seconds: float) -> CrashError:
    """Return the error for a file that was not read within ``seconds``."""
    return CrashError(
        "the reader did not finish with this file in time",
        file,
        f"an answer within {seconds:g} s",
        "none",
        "It may be damaged, or its disk does not answer: check both, and write the file again from its origin",
    )


def exhausted(where: str, limit: int) -> ExhaustedError:
    """Return the error for work that needs more than ``limit`` bytes of memory."""
    return ExhaustedError(
        "this needs more memory than the service gives one request",
        where,
        f"at most {limit / 1e6:.0f} MB",
        "more",
        "Ask for less, or give the service more with --memory-limit",
    )


class Blamed:
    """Files that were blamed in the last minutes, so that each of them costs one crash and not one a request."""

    def __init__(self) -> None:
        self._errors: OrderedDict[tuple[str, int, int], tuple[float, CrashError]] = OrderedDict()

    def add(self, file: str, error: CrashError) -> None:
        """Remember ``error`` for as long as the file stays as it is."""
        if key := _key(file):
            self._errors[key] = monotonic(), error
            while len(self._errors) > _MOST:
                self._errors.popitem(last=False)

    def check(self, file: str) -> None:
        """Raise the error of a file that is remembered."""
        if not self._errors or (key := _key(file)) is None:
            return
        when, error = self._errors.get(key, (0.0, None))
        if error is not None and monotonic() - when < _KEPT_S:
            raise error


def _key(file: str) -> tuple[str, int, int] | None:
    """Return what changes with a file; None for folders, whose files may change unseen, and for what is not there."""
    try:
        place = Path(file.partition("::")[0])
        status = place.stat()
    except (OSError, ValueError):
        return None
    return None if place.is_dir() else (file, status.st_size, status.st_mtime_ns)


class UnreachableError(StoreError):
    """A disk, or the system, did not give a file; it may at the next try."""


def of_system(error: BaseException) -> TractError | None:
    """Return what an error of the system, or one that comes of it, means to who asks; None for all others.

    What passes is no fault of a file, whatever a reader made of it.
    """
    if isinstance(error, ConnectionError | TimeoutError):  # of a client, say
        return None
    met = trouble(error, Place(), "a file of the service")
    if met is not None and met.passes:
        got, remedy = os.strerror(met.number), "Try again in a while; where that does not help, its disk needs a look"
        return UnreachableError("a file cannot be reached now", met.where, got=got, remedy=remedy)
    if not isinstance(error, OSError) or not error.errno:
        return None
    where = str(error.filename or "a file of the service")
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return MissingStoreError("the file is not there any more", where, remedy="Look again what is there")
    remedy = "Correct the permissions, or free some space, where the service runs"
    return UnreachableError("the service cannot use a file", where, got=os.strerror(error.errno), remedy=remedy)
