"""Folders that this process works in, and whether they are still those in which it began.

Who may write beside a folder can move it away while a run works, and put another folder, or a link to one, in its
place. What the run wrote by the folder's name would then lie in the other one. So a folder is opened when the work
begins, and kept open: its device and number then stay, and are no other folder's. They are compared right before
whatever is made, renamed or deleted under it (:func:`check_held`). Between the comparison and the change a few
microseconds are left.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import TypeAlias

from ..errors import DestinationError, StoreError

Identity: TypeAlias = tuple[int, int]
"""Device and number of a folder; no other has them while it is open."""

_OPEN = getattr(os, "O_PATH", os.O_RDONLY) | getattr(os, "O_DIRECTORY", 0)


@dataclass(frozen=True)
class Folder:
    """A folder as it was when work in it began; tasks take it along.

    Attributes
    ----------
    links
        The links that were in it then, by name, and where each leads: those are the user's, and are followed.
    machine
        Where the identity counts: elsewhere the same folder may have another.
    """

    path: Path
    identity: Identity
    links: dict[str, Identity] = field(default_factory=dict)
    machine: str = ""

    @classmethod
    def at(cls, path: Path, *, links: bool = True) -> Folder:
        """Return the folder that is at ``path`` now; ``links`` tells whether those in it are the user's.

        Raises
        ------
        OSError
            Where there is none.
        """
        found = {item.name: item for item in os.scandir(path) if item.is_symlink()} if links else {}
        known = {}
        for name, item in found.items():
            with suppress(OSError):
                known[name] = _identity(item.stat())
        return cls(path, _identity(path.stat()), known, machine())

    def check(self) -> None:
        """Check that the folder is the same; one that is gone is left to who wants to write into it.

        Raises
        ------
        DestinationError
            Where another has its place.
        """
        if self.machine != machine():
            return
        with suppress(FileNotFoundError):
            if _identity(self.path.stat()) != self.identity:
                raise _replaced(self.path)

    def check_below(self, path: Path) -> None:
        """Check, as :meth:`check`, also that no new link lies on the way to a place in the folder."""
        self.check()
        here = self.path
        for name in path.relative_to(self.path).parts[:-1]:
            here /= name
            if here.is_symlink() and not (here.parent == self.path and self._is_known(here)):
                raise _replaced(here)

    def _is_known(self, link: Path) -> bool:
        return self.links.get(link.name) == _identity(link.stat())


_held: dict[Path, list[Folder]] = {}
_changing = Lock()


@contextmanager
def hold(place: Path | Folder, *, links: bool = True) -> Iterator[Folder]:
    """Have :func:`check_held` check everything under a folder in this block, in all threads of this process.

    Of a path that is held already, the folder counts that it was then; of a :class:`Folder`, that one.

    Raises
    ------
    OSError
        Where there is none.
    DestinationError
        Where it was replaced since.
    """
    path = place.path if isinstance(place, Folder) else place
    descriptor = os.open(path, _OPEN)
    try:
        with _changing:
            before = _held.get(path, [])
            folder = place if isinstance(place, Folder) else before[-1] if before else Folder.at(path, links=links)
            _held[path] = [*before, folder]
        try:
            folder.check()
            yield folder
        except (OSError, StoreError):
            folder.check()  # which says why a file is not there that was a moment ago
            raise
        finally:
            with _changing:
                _held[path].remove(folder)
                if not _held[path]:
                    del _held[path]
    finally:
        os.close(descriptor)


def check_held(path: Path) -> None:
    """Check that the folders which this process holds, and which ``path`` is in, are still the same.

    Raises
    ------
    DestinationError
        Where one was replaced by another folder, or a link was put on the way.
    """
    for folder in around(path) if _held else ():
        folder.check_below(path)


def around(path: Path) -> list[Folder]:
    """Return the folders that this process holds and ``path`` is in, as they were when work in them began."""
    return [folders[-1] for place in path.parents if (folders := _held.get(place))]


def is_held(path: Path) -> bool:
    """Tell whether a file at ``path``, which may be added to, lies where it did when work began, as :func:`check_held`.

    It is no new link either.
    """
    try:
        check_held(path / "its end")
    except DestinationError:
        return False
    return True


def _identity(status: os.stat_result) -> Identity:
    return status.st_dev, status.st_ino


def _replaced(path: Path) -> DestinationError:
    return DestinationError(
        "this folder was replaced while it was worked in",
        str(path),
        "the folder in which the work began",
        f"a link to {path.readlink()}" if path.is_symlink() else "another folder",
        "Nothing more was written. Put the first folder back, and run again: what is done is kept",
    )


@lru_cache(maxsize=1)
def machine() -> str:
    """Return what tells a running system and a container from all others."""
    parts = [platform.node()]
    with suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip())
    with suppress(OSError):
        parts.append(str(Path("/proc/self/ns/pid").readlink()))
    return " ".join(parts)
