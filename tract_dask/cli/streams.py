"""Standard output and error: there from the start, and no reason for a run to end."""

from __future__ import annotations

import errno
import io
import os
import select
import sys
from contextlib import suppress
from typing import IO

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EIO)


def open_standard() -> None:
    """Open those of standard input, output and error that the caller has closed, onto nothing.

    Otherwise the next file that is opened, such as one of a store, gets the number of the missing one; what any library
    prints would then be written into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the system gives the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8", closefd=False))  # noqa: SIM115


class Lasting(io.TextIOBase):
    """A stream that takes text for as long as it can be written, and then forgets it.

    Progress goes to it: a terminal that is closed, or a log on a full disk, ends no run.
    """

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """The stream's encoding."""
        return getattr(self._stream, "encoding", None) or "utf-8"

    def isatty(self) -> bool:
        """Tell whether the stream is a terminal."""
        with suppress(OSError, ValueError):
            return self._stream.isatty()
        return False

    def fileno(self) -> int:
        """Return the stream's number."""
        return self._stream.fileno()

    def write(self, text: str) -> int:
        """Write text, if the stream takes it."""
        with suppress(OSError, ValueError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream, if it takes it."""
        with suppress(OSError, ValueError):
            self._stream.flush()


def nobody_reads() -> bool:
    """Tell whether the program that read standard output or error through a pipe has gone, such as ``head``."""
    watch = select.poll()
    for number in (1, 2):
        watch.register(number, 0)
    return any(event & select.POLLERR for _, event in watch.poll(0))


def is_full(error: OSError) -> bool:
    """Tell whether an error of no file says that what is printed cannot be written."""
    return error.filename is None and error.errno in _FULL
