"""Where a Zarr store lies: a folder, or a ZIP file; its metadata and the files of its chunks."""

from __future__ import annotations

import json
import os
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from zarr.abc.store import Store
from zarr.storage import LocalStore, ZipStore

from ...errors import SourceError
from ..checks import Permit, checked_file, is_named

METADATA = ("zarr.json", ".zarray", ".zgroup")
"""Files by which a folder is known to be an array or a group."""

_MOST_JSON, _MOST_FILES = 16 << 20, 10_000_000


def is_zarr(folder: Path) -> bool:
    """Tell whether a folder is a Zarr array or group; links are not followed."""
    return any(is_named(folder / name) for name in METADATA)


@dataclass(frozen=True)
class Place:
    """A folder with a store.

    Attributes
    ----------
    root
        The folder.
    permit
        Asked before a file is opened or listed.
    used
        Metadata that were read, in order.
    """

    root: Path
    permit: Permit | None = None
    used: dict[Path, None] = field(default_factory=dict)

    def json(self, name: str) -> dict[str, Any] | None:
        """Return the object in a file of the store; None where there is no such file.

        Raises
        ------
        ValueError
            Where it is not a JSON object, or very large.
        """
        file = self.root / name
        if not os.path.lexists(file):
            return None
        if checked_file(file, self.permit).st_size > _MOST_JSON:
            raise ValueError(f"{name} has more than {_MOST_JSON:,} bytes")
        self.used[file] = None
        return _object(file.read_bytes(), name)

    def folders(self, name: str) -> list[str]:
        """Return the names of the folders in a folder of the store."""
        with os.scandir(self.root / name) as found:
            return sorted(item.name for item in found if item.is_dir() and not item.name.startswith("."))

    def sizes(self, name: str, depth: int) -> Iterator[tuple[str, int]]:
        """Yield path and bytes of every file below a folder of the store, at most so many folders deep."""
        top = str(self.root / name)
        waiting = [(top, os.path.realpath(top), "", 0)]
        while waiting:
            folder, real, shown, level = waiting.pop()
            with os.scandir(folder) as found:
                for item in found:
                    place = os.path.realpath(item.path) if item.is_symlink() else f"{real}/{item.name}"
                    if self.permit is not None and not item.is_file(follow_symlinks=False):
                        self.permit(Path(place))  # a file that is no link lies in its folder
                    if not item.is_dir():
                        yield f"{shown}{item.name}", item.stat().st_size
                    elif level < depth:
                        waiting.append((item.path, place, f"{shown}{item.name}/", level + 1))

    def files(self, names: list[str]) -> tuple[Path, ...]:
        """Return the files with these paths, of which the frames come."""
        return tuple(self.root / name for name in names)

    def store(self) -> Store:
        """Return the store as Zarr opens it."""
        return LocalStore(self.root, read_only=True)


@dataclass(frozen=True)
class Archive(Place):
    """A ZIP file with a store; ``root`` is the file."""

    within: str = ""

    def json(self, name: str) -> dict[str, Any] | None:
        """Return the object in a file of the store; None where there is no such file."""
        with zipfile.ZipFile(self.root) as archive:
            try:
                about = archive.getinfo(f"{self.within}{name}")
            except KeyError:
                return None
            if about.file_size > _MOST_JSON:
                raise ValueError(f"{name} has more than {_MOST_JSON:,} bytes")
            return _object(archive.read(about), name)

    def folders(self, name: str) -> list[str]:
        """Return the names of the folders in a folder of the store."""
        before = f"{self.within}{name}/" if name else self.within
        with zipfile.ZipFile(self.root) as archive:
            below = (found[len(before) :] for found in archive.namelist() if found.startswith(before))
            return sorted({path.partition("/")[0] for path in below if "/" in path})

    def sizes(self, name: str, depth: int) -> Iterator[tuple[str, int]]:
        """Yield path and bytes of every file below a folder of the store."""
        before = f"{self.within}{name}/" if name else self.within
        with zipfile.ZipFile(self.root) as archive:
            for about in archive.infolist():
                if about.filename.startswith(before) and not about.is_dir():
                    yield about.filename[len(before) :], about.file_size

    def files(self, names: list[str]) -> tuple[Path, ...]:
        """Return the ZIP file, which holds all."""
        return ()

    def store(self) -> Store:
        """Return the store as Zarr opens it."""
        return ZipStore(self.root, mode="r", read_only=True)


def open_place(path: Path, permit: Permit | None) -> Place:
    """Return the store at a path; of a ZIP file also one that lies in its only folder.

    Raises
    ------
    SourceError
        Where there is none.
    """
    if path.is_dir():
        place = Place(path, permit)
        if permit is not None:
            permit(Path(os.path.realpath(path)))
        return place
    archive = Archive(path, permit, {path: None})
    if not any(archive.json(name) is not None for name in METADATA):
        inside = archive.folders("")
        archive = Archive(path, permit, {path: None}, f"{inside[0]}/" if len(inside) == 1 else "")
        if not any(archive.json(name) is not None for name in METADATA):
            raise SourceError(
                "there is no Zarr store in the ZIP file",
                str(path),
                f"one of {', '.join(METADATA)} at its top",
                ", ".join(inside[:9]) or "no folders",
                "Zip the content of the store's folder",
            )
    return archive


def plain_path(name: str) -> str:
    """Return a path inside a store without dots and double slashes.

    Raises
    ------
    ValueError
        Where it would lead out of the store.

    Examples
    --------
    >>> plain_path("/a//./b/")
    'a/b'
    """
    parts = [part for part in PurePosixPath(name).parts if part not in ("/", ".")]
    if ".." in parts or any(re.search(r"[\\\0]", part) for part in parts):
        raise ValueError(f"the path {name!r} may lead out of the store")
    return "/".join(parts)


def _object(data: bytes, name: str) -> dict[str, Any]:
    found = json.loads(data)
    if not isinstance(found, dict):
        raise ValueError(f"{name} is not a JSON object")
    return found
