"""Files: written aside, synced and renamed; deleted; read whole."""

from __future__ import annotations

import errno
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import StoreError
from . import disk
from .held import check_held


def write_aside(path: Path, data: bytes) -> None:
    """Write a small file so that it is either whole or not there: beside its place first, synced, then renamed."""
    aside = disk.aside(path, os.getpid())
    check_held(path)
    with disk_errors(path):
        with open(aside, "wb", opener=_no_link) as file:
            file.write(data)
        disk.place_now(aside, path)


def _no_link(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


def remove(path: Path) -> None:
    """Delete a store, a folder or a file, if it is there.

    A folder goes at once for everybody who looks, also where this process is killed meanwhile: renamed, then deleted.
    """
    check_held(path)
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        path.unlink(missing_ok=True)
        return
    if not path.name.startswith("."):
        aside = path.with_name(f".{path.name}.removed")
        remove(aside)  # of a process that was killed
        with suppress(FileNotFoundError):
            path.replace(aside)
        path = aside
    with suppress(FileNotFoundError):
        shutil.rmtree(path)


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn a full disk or a refused write inside this block into a StoreError; other errors of the system name it."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS):
            error.filename = error.filename or str(path)
            raise
        raise StoreError(
            "writing failed",
            str(path),
            got=os.strerror(error.errno),
            remedy="Free some space or correct the permissions, then run again: what is done is kept",
        ) from error


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
