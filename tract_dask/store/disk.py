"""What is on disk: free space, and files that are there before anything says so: written aside, synced, then renamed.

A rename keeps a killed process from leaving half a file. Only a sync before it keeps a loss of power from leaving a
name without its bytes. To sync is to wait for the disk: the files of a batch are synced together, and large files are
sent to the disk while they are still being written.
"""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
import uuid
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import DestinationError
from .held import check_held

_WRITE_BACK = 2
"""SYNC_FILE_RANGE_WRITE: start writing, and do not wait."""

_AT_ONCE = 16
"""So many files are synced at a time."""

_NO_SYNC = (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP)
"""What file systems say that cannot sync."""


class Written(NamedTuple):
    """Bytes that a task wrote: their file, and where in it they end."""

    path: Path
    end: int


class Batch:
    """What the tasks of a batch wrote, waiting to be synced; see :func:`together`."""

    def __init__(self) -> None:
        self._waiting: list[tuple[Path, Written]] = []
        self._ready: list[tuple[Path, Written]] = []

    def add(self, now: Path, written: Written) -> None:
        """Take in a file that is to be synced at ``now``, and then to be at the path of ``written``."""
        self._waiting.append((now, written))

    def keep(self) -> list[Written]:
        """Have what was added since the last call committed later, and return it."""
        added, self._waiting = self._waiting, []
        self._ready += added
        return [written for _, written in added]

    def commit(self) -> None:
        """Sync all that is kept, then put it in place."""
        sync_all({now for now, _ in self._ready})
        for now, written in self._ready:
            check_held(written.path)
            if now != written.path:
                now.replace(written.path)
        self._ready = []

    def discard(self) -> None:
        """Remove what lies aside and was not committed."""
        for now, written in self._waiting + self._ready:
            if now != written.path:
                with suppress(OSError):
                    now.unlink()


_open: ContextVar[Batch | None] = ContextVar("tract_dask_batch", default=None)


@contextmanager
def together() -> Iterator[Batch]:
    """Let :func:`place` and :func:`append` leave their files to a batch, in this block and thread."""
    batch = Batch()
    token = _open.set(batch)
    try:
        yield batch
    finally:
        _open.reset(token)
        batch.discard()


PARTIAL = ".partial"
"""How the names of files and stores end that are being written."""


def aside(path: Path, mark: object = "", suffix: str = "") -> Path:
    """Return the hidden place beside ``path`` to write it at first; ``mark`` tells it from those of other writers."""
    return path.with_name(f".{path.name}{f'.{mark}' if mark else ''}{PARTIAL}{suffix}")


def new_place(folder: Path) -> Path:
    """Return a place in ``folder`` to write a file at first, which nobody else has."""
    return folder / f"{uuid.uuid4().hex}{PARTIAL}"


def place(aside: Path, path: Path) -> None:
    """Put a file that is whole in its place as :func:`place_now` does; in an open batch, when that is committed."""
    batch = _open.get()
    if batch is None:
        place_now(aside, path)
        return
    size = aside.stat().st_size
    with aside.open("rb") as file:
        write_back(file.fileno(), 0, size)
    batch.add(aside, Written(path, size))


def place_now(aside: Path, path: Path) -> None:
    """Put a file that is whole in its place: synced, then renamed, and the name synced too."""
    sync(aside)
    check_held(path)
    aside.replace(path)
    sync(path.parent)


def place_folder(aside: Path, path: Path) -> None:
    """Put a folder of small files in its place, where there is none: every file synced, then the folder renamed."""
    walked = _walk(aside)
    sync_all([folder / name for folder, names in walked for name in names])
    sync_all([folder for folder, _ in walked])
    check_held(path)
    aside.replace(path)
    sync(path.parent)


def sync_folders(store: Path, small: Collection[str] = ()) -> None:
    """Sync the names in every folder of a store, and the files of its ``small`` arrays, before it is complete."""
    walked = _walk(store)
    sync_all([folder / name for folder, names in walked if folder.name in small for name in names])
    sync_all([folder for folder, _ in walked])


def _walk(top: Path) -> list[tuple[Path, list[str]]]:
    """Return every folder from ``top`` down, each with the names of its files; :func:`os.walk` leaves out errors."""

    def fail(error: OSError) -> None:
        raise error

    return [(Path(folder), names) for folder, _, names in os.walk(top, onerror=fail)]


def append(path: Path, data: bytes) -> None:
    """Write data at the end of a file that no other thread writes; synced, in an open batch when that is committed."""
    check_held(path)
    with path.open("ab") as file:
        file.write(data)
        end = file.tell()
        file.flush()
        write_back(file.fileno(), end - len(data), len(data))
    batch = _open.get()
    if batch is None:
        sync(path)
    else:
        batch.add(path, Written(path, end))


def sync_all(paths: Collection[Path]) -> None:
    """Sync files or folders at the same time: the disk then writes its own journal once for many of them."""
    if len(paths) <= 1:
        for path in paths:
            sync(path)
        return
    with ThreadPoolExecutor(min(len(paths), _AT_ONCE), "sync") as pool:
        list(pool.map(sync, paths))


def sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on disk; file systems that cannot tell are believed."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _NO_SYNC:
            raise
    finally:
        os.close(handle)


def write_back(handle: int, start: int, count: int) -> None:
    """Have the system start to write ``count`` bytes of an open file (0: all that follow) to disk, and do not wait."""
    begin = _sync_file_range()
    if begin is not None:
        begin(handle, start, count, _WRITE_BACK)


@cache
def _sync_file_range() -> Any:
    """Return Linux's function of that name; None elsewhere."""
    try:
        begin = ctypes.CDLL(None).sync_file_range
    except (AttributeError, OSError, TypeError):
        return None
    begin.argtypes = (ctypes.c_int, ctypes.c_int64, ctypes.c_int64, ctypes.c_uint)
    return begin


def check_free_space(path: Path, needed: int) -> None:
    """Check that the disk under ``path`` has ``needed`` bytes free.

    Raises
    ------
    DestinationError
        With both numbers.
    """
    free = shutil.disk_usage(next(p for p in (path, *path.absolute().parents) if p.exists())).free
    if free < needed:
        raise DestinationError(
            "the disk is too small for this",
            str(path),
            f"about {_readable(needed)} free",
            _readable(free),
            "Free some space, or choose another disk",
        )


def _readable(size: int) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"
