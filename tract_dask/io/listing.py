"""Which files are one movie: those of a folder, or those of a folder that a pattern names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from ..errors import SourceError

WILD = "*?["
"""Signs that make the last part of a path a pattern, unless there is a file or folder of this very name."""


@dataclass(frozen=True)
class FileList:
    """Files that are one movie.

    Attributes
    ----------
    name
        The folder or the pattern that named them; with ``::`` and a path inside each file, where that was given.
    files
        Whole paths, in any order.
    """

    name: str
    files: tuple[Path, ...]

    def __str__(self) -> str:
        return self.name


def list_files(path: str | Path, readers: Mapping[str, Any]) -> FileList | None:
    """Return the files that a folder or a pattern names; None where the path is that of one file.

    A path that exists is never a pattern, and only its last part may be one: the folder is taken as it is written.

    Parameters
    ----------
    path
        As :func:`tract_dask.io.open_source` takes it.
    readers
        Readers by suffix: of a folder the files of its one readable format are taken.

    Raises
    ------
    SourceError
        Where the folder of a pattern is not there, or a folder holds files of several formats.
    """
    outer = Path(str(path).partition("::")[0])
    if outer.is_dir():
        return FileList(str(path), tuple(_readable(outer, readers)))
    if outer.exists() or not any(sign in outer.name for sign in WILD):
        return None
    if not outer.parent.is_dir():
        raise SourceError(
            "there is no such folder",
            str(outer.parent),
            "a folder that is there; only the last part of a path may be a pattern",
            remedy="Check the path",
        )
    return FileList(str(path), tuple(matching(outer.parent, outer.name)))


def matching(folder: Path, pattern: str) -> list[Path]:
    """Return the files of a folder whose names fit a pattern of ``*``, ``?`` and ``[]``; hidden ones only by a dot."""
    hidden = pattern.startswith(".")
    return [
        file
        for file in folder.iterdir()
        if fnmatchcase(file.name, pattern) and file.name.startswith(".") == hidden and file.is_file()
    ]


def _readable(folder: Path, readers: Mapping[str, Any]) -> list[Path]:
    """Return the files of the one readable format in a folder."""
    files = [file for file in folder.iterdir() if file.suffix.lower() in readers and not file.name.startswith(".")]
    kinds = Counter(file.suffix.lower() for file in files)
    if len({readers[kind] for kind in kinds}) > 1:
        raise SourceError(
            "the folder holds files of several formats",
            str(folder),
            "one format",
            ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items())),
            f"Choose by a glob, for example {folder}/*{next(iter(kinds))}",
        )
    return files
