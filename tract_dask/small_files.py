"""Reading a small file as a whole: nothing but a file, and not more of it than it may hold."""

from __future__ import annotations

import os
import stat
from pathlib import Path


def read_small(path: str | Path, most: int) -> bytes:
    """Return what a file of at most ``most`` bytes holds; its size is looked at before anything is read.

    Raises
    ------
    OSError
        Where it cannot be opened, is a folder, a pipe, a device or a socket, or is larger. Nothing is waited for.
    """
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise OSError("it is not a file but a folder, a pipe, a device or a socket")
        data = file.read(most + 1) if status.st_size <= most else b""
    if max(len(data), status.st_size) > most:
        raise OSError(f"it has {max(len(data), status.st_size)} bytes, and may have {most}")
    return data
