"""The readers of other packages: looked for where a suffix is not known here; one that fails hinders no other."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path
from threading import Lock
from typing import Any

from ..settings.run import SourceSettings
from .checks import Permit, reading, words
from .reader import Reader
from .source import Source


class Readers(dict[str, Reader]):
    """Readers by the suffixes of their files.

    Those of other packages, of the entry points ``tract_dask.readers``, are looked for once: when someone asks for a
    suffix, or for a folder, that no reader here knows. They take no suffix that is taken. One that cannot be loaded is
    a warning, and its format stays unknown.
    """

    def __init__(self, readers: Iterable[Reader]) -> None:
        super().__init__({suffix: reader for reader in readers for suffix in reader.suffixes})
        self._lock, self._looked = Lock(), False

    def __contains__(self, suffix: object) -> bool:
        return self.get(str(suffix)) is not None

    def get(self, suffix: str, default: Any = None) -> Any:
        """Return the reader of a suffix; ``default`` where there is none."""
        self._look(suffix if not super().__contains__(suffix) else "")
        return super().get(suffix, default)

    def of_folder(self, folder: Path) -> Reader | None:
        """Return the reader for which a folder is one movie; None where it is a folder of files."""
        for reader in dict.fromkeys(self.values()):
            if reader.is_movie(folder):
                return reader
        known = set(self)
        self._look(".")
        return next(
            (reader for suffix, reader in self.items() if suffix not in known and reader.is_movie(folder)), None
        )

    def _look(self, suffix: object) -> None:
        """Add the readers of other packages, once; files without a suffix are of no format."""
        if not suffix or self._looked:
            return
        with self._lock:
            if not self._looked:
                for reader in _of_others():
                    for name in reader.suffixes:
                        self.setdefault(name, reader)
            self._looked = True


def _of_others() -> Iterator[Reader]:
    """Yield the readers of other packages; what is wrong with one is a warning that names it."""
    for entry in entry_points(group="tract_dask.readers"):
        name = f"the reader {entry.name} ({entry.value})"
        try:
            found = entry.load()
        except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever another package does when it is imported
            warnings.warn(f"{name} cannot be loaded: {words(error)}", stacklevel=2)
            continue
        suffixes = getattr(found, "suffixes", ())
        if not isinstance(found, Reader):
            warnings.warn(f"{name} does not name a Reader", stacklevel=2)
        elif not suffixes or not all(isinstance(one, str) and one.startswith(".") for one in suffixes):
            warnings.warn(f"{name} has no suffixes with a dot, but {suffixes!r}", stacklevel=2)
        else:
            yield _apart(found, name)


def _apart(reader: Reader, name: str) -> Reader:
    """Return a reader of another package; what it raises names it, and hinders no other reader."""

    def opened(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
        with reading(str(path), f"{name} cannot read the file", "Tell those who wrote that reader"):
            return reader.open(path, inner, settings, permit)

    def is_movie(folder: Path) -> bool:
        return bool(_or_warned(reader.is_movie, folder, name, default=False))

    def parts(files: Sequence[Path]) -> set[Path]:
        found: set[Path] = _or_warned(reader.parts, files, name, default=set())
        return found

    return replace(
        reader,
        open=opened,
        is_movie=is_movie,
        parts=parts,
        suffixes=tuple(suffix.lower() for suffix in reader.suffixes),
    )


def _or_warned(function: Callable[[Any], Any], at: Any, name: str, *, default: Any) -> Any:
    try:
        return function(at)
    except Exception as error:  # noqa: BLE001 - whatever another package does
        warnings.warn(f"{name} fails: {words(error)}", stacklevel=2)
        return default
