"""What a format is here: a name, suffixes, and a function that opens a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from ..settings.run import SourceSettings
from .checks import Permit
from .source import Source

Opener: TypeAlias = Callable[[Path, str, SourceSettings, Permit | None], Source]
"""Takes a file or folder, the path inside it, how to read it, and what to ask before other files; makes every check."""


def _never(path: Path) -> bool:
    return False


def _none(files: Sequence[Path]) -> set[Path]:
    return set()


def one_by_one(is_part: Callable[[Path], bool]) -> Callable[[Sequence[Path]], set[Path]]:
    """Return what tells of many files which are parts, from what tells it of one, without a look at its folder."""
    return lambda files: set(filter(is_part, files))


@dataclass(frozen=True)
class Reader:
    """A format.

    Attributes
    ----------
    name
        The format's name, for people.
    suffixes
        Of its files, in lower case and with the dot.
    open
        Opens a movie.
    inside
        What may follow a path after two colons, in words; empty where nothing may.
    is_movie
        Tells whether a folder is one movie of this format, which ``open`` takes as a whole.
    parts
        Takes files of one folder, whose suffixes are these; returns those that only belong to the movie of another file
        beside them.
    """

    name: str
    suffixes: tuple[str, ...]
    open: Opener
    inside: str = ""
    is_movie: Callable[[Path], bool] = _never
    parts: Callable[[Sequence[Path]], set[Path]] = _none
