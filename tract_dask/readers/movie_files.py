"""Which files are one movie: those of a folder, or those of a folder that a pattern names."""

from __future__ import annotations

import fnmatch
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import SourceError
from .naming import in_order, references
from .reader import Reader

WILD = "*?["
"""Signs that make the last part of a path a pattern, unless there is a file or folder of this very name."""


@dataclass(frozen=True)
class FileList:
    """Files that are one movie.

    Attributes
    ----------
    name
        The folder or the pattern that named them; with ``::`` and a path inside each file, where that was given. It
        opens as the same files, unless they have changed meanwhile.
    files
        In the order of the numbers in their names.
    references
        Those that by their names are references of the detector, by what they are; one of each kind.
    """

    name: str
    files: tuple[Path, ...]
    references: Mapping[str, Path] = field(default_factory=dict, compare=False)

    def __str__(self) -> str:
        return self.name


def list_files(name: str, outer: Path, readers: Mapping[str, Reader]) -> FileList | None:
    """Return the files that a folder or a pattern names; None where ``outer`` is one file.

    A path that exists is never a pattern, and only its last part may be one: the folder is taken as it is written.

    Parameters
    ----------
    name
        As the list is to be called.
    outer
        The folder or the pattern.
    readers
        Readers by suffix: of a folder the files of its one readable format are taken.

    Raises
    ------
    SourceError
        Where the folder of a pattern is not there, or a folder holds files of several formats.
    """
    if outer.is_dir():
        found = _readable(outer, readers)
    elif is_pattern(outer):
        found = _whole(_matching(outer), readers)
    else:
        _check_folder(outer)
        return None
    folder = outer if outer.is_dir() else outer.parent
    names = [file.name for file in found]
    apart = references(names)
    files = tuple(folder / name for name in in_order([name for name in names if name not in apart]))
    return FileList(name, files, {kind: folder / name for name, kind in sorted(apart.items(), reverse=True)})


def is_pattern(place: Path) -> bool:
    """Tell whether a path that is not there is a pattern for the files of a folder that is."""
    return any(sign in place.name for sign in WILD) and not os.path.lexists(place) and place.parent.is_dir()


def _check_folder(place: Path) -> None:
    """Refuse a pattern for folders: only the last part of a path may be one."""
    if any(sign in str(place.parent) for sign in WILD) and not os.path.lexists(place.parent):
        raise SourceError(
            "there is no such folder",
            str(place.parent),
            "a folder, and a pattern for the names in it only",
            str(place),
            "Name the folder without * ? or [",
        )


def _matching(pattern: Path) -> list[Path]:
    """Return the files whose names fit a pattern of ``*``, ``?`` or ``[]``; hidden ones where it begins with a dot."""
    with os.scandir(pattern.parent) as found:
        names = [item.name for item in found if fnmatch.fnmatchcase(item.name, pattern.name) and not item.is_dir()]
    return [pattern.parent / name for name in names if name.startswith(".") <= pattern.name.startswith(".")]


def _readable(folder: Path, readers: Mapping[str, Reader]) -> list[Path]:
    """Return the files of the one readable format in a folder, without those that only belong to another one."""
    there = [file for file in folder.iterdir() if file.suffix.lower() in readers and not file.name.startswith(".")]
    parts = _parts(there, readers)
    files = [file for file in there if file not in parts]
    apart = references([file.name for file in files])
    kinds = Counter(file.suffix.lower() for file in files if file.name not in apart)
    if len({readers[kind] for kind in kinds}) > 1:
        raise SourceError(
            "the folder holds files of several formats",
            str(folder),
            "one format",
            ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items())),
            f"Choose by a pattern, for example {folder}/*{next(iter(kinds))}",
        )
    return files


def _whole(files: list[Path], readers: Mapping[str, Reader]) -> list[Path]:
    """Return files without those that only belong to another one; all where each does."""
    parts = _parts(files, readers)
    return [file for file in files if file not in parts] or files


def _parts(files: Sequence[Path], readers: Mapping[str, Reader]) -> set[Path]:
    """Return which files of a folder only belong to others; each reader is asked once, since folders may be large."""
    kinds = {file.suffix.lower() for file in files}
    found = {readers[kind] for kind in kinds if kind in readers}
    return {
        part
        for reader in found
        for part in reader.parts([file for file in files if file.suffix.lower() in reader.suffixes])
    }
