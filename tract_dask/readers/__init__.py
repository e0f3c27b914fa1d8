"""Readers: one file a format behind one small protocol.

A format is a function from a path to a :class:`~tract_dask.readers.source.Source` and its line in
:data:`~tract_dask.readers.registry.BUILT_IN`. Other packages add a :class:`~tract_dask.readers.reader.Reader` by an
entry point of the group ``tract_dask.readers``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path

from ..errors import SettingsError, SourceError
from ..settings.run import MetadataSettings, SourceSettings
from .checks import Permit, checked_file, reading
from .movie_files import FileList, is_pattern, list_files
from .reader import Reader
from .recipes import unknown_format
from .registry import READERS
from .selection import overridden, select
from .sequence import SequenceSource, open_sequence
from .source import FrameSource, Source, SourceMetadata
from .times import agreed

__all__ = [
    "READERS",
    "FileList",
    "FrameSource",
    "Permit",
    "Reader",
    "SourceMetadata",
    "files_named_now",
    "is_movie_folder",
    "list_files",
    "open_cached",
    "open_reference",
    "open_source",
]

DECLARED_NOTHING = SourceSettings()
AS_THE_FILE_SAYS = MetadataSettings()

_RAW = READERS[".raw"]

_OPTIONS = {"dark": "--dark", "gain": "--gain-reference", "defects": "--defects"}
"""What applies the references that lie beside a movie."""

_GAIN_SUFFIX = ".gain"
"""TIFF images that hold the gain references of Falcon cameras."""

_NO_REFERENCE = (".xml", ".txt")
"""Descriptions of cameras, which are no images and no lists of pixels."""


def open_source(
    path: Path | str | FileList | Sequence[Path | str],
    settings: SourceSettings = DECLARED_NOTHING,
    metadata: MetadataSettings = AS_THE_FILE_SAYS,
    *,
    permit: Permit | None = None,
) -> FrameSource:
    """Open a movie: a file, ``file.h5::/path/in/file``, a folder, a pattern for the files of one folder, or a list.

    Everything that can be wrong with it is found here, before any work.

    Parameters
    ----------
    path
        What to open. In a folder, all files of its one readable format; of several files, the frames in their order.
        A path that is there is never taken for a pattern. A :class:`FileList` is opened as it is.
    settings
        Shape and type of raw files; which frames, field and bins of any movie are read.
    metadata
        What the user knows better than the file: size and time of its pixels and frames, whatever part is read.
    permit
        Called with the resolved path of every file before it is opened, also of those that links inside of HDF5 files
        lead to; raises to refuse it. It is asked again where the files of a sequence are opened to be read.

    Returns
    -------
    FrameSource
        Frames (frames, y, x), read on demand.

    Raises
    ------
    SourceError
        Where the movie is missing, damaged, or not a movie; with file, place and remedy.
    SettingsError
        Where a raw file is not, or wrongly, declared.
    """
    place = path if isinstance(path, FileList) else str(path) if isinstance(path, str | Path) else list(map(str, path))
    name = next(iter(place), "an empty list") if isinstance(place, list) else str(place)
    with reading(name):
        source = _open_list(place, settings, permit) if isinstance(place, list) else _open(place, settings, permit)
    known = agreed(source.metadata, Path(name).name)
    merged = replace(known, notes=known.notes + _not_applied(known))
    listed = tuple(place) if isinstance(place, list) else ()
    part = select(replace(source, path=name, metadata=merged, listed=listed, permit=permit), settings)
    return replace(part, metadata=overridden(part.metadata, metadata, settings))


def open_reference(path: str, *, permit: Permit | None = None) -> FrameSource:
    """Open an image of the detector, or several, as :func:`open_source`; files of Falcon cameras in ``.gain`` are TIFF.

    Raises
    ------
    SourceError
        As :func:`open_source`; also for raw files, which do not say what shape they have.
    """
    suffix = Path(_split(path)[0]).suffix.lower()
    if suffix == _GAIN_SUFFIX:
        checked_file(Path(path), permit)
        return replace(_opened(READERS[".tif"], Path(path), "", DECLARED_NOTHING, permit), permit=permit)
    try:
        return open_source(path, permit=permit)
    except SettingsError as error:  # only raw files have to be declared
        raise SourceError(
            "a raw file cannot be a reference",
            path,
            "a format that says what shape and type it holds",
            error.what,
            "Save it as NumPy, TIFF or MRC",
        ) from error


def _not_applied(known: SourceMetadata) -> tuple[str, ...]:
    """Return notes on the references of the detector: those that no note names yet, and the options that apply them."""
    notes = []
    for kind, file in known.references.items():
        outer, sign, inner = str(file).partition("::")
        name = f"{Path(outer).name}{sign}{inner}"
        applied = f"{_OPTIONS[kind]} {name}" if kind in _OPTIONS and file.suffix.lower() not in _NO_REFERENCE else ""
        if kind != "metadata" and not any(file.name in note for note in known.notes):
            without = f" without {applied}" if applied else ""
            what = f"is by its name the detector's {kind} reference; it is not applied{without}"
            notes.append(f"{name} next to the movie {what}")
        elif applied:
            notes.append(f"{applied} applies the detector's {kind} reference")
    return tuple(notes)


def open_cached(
    path: str | Path | FileList | tuple[str | Path, ...],
    settings: SourceSettings = DECLARED_NOTHING,
    metadata: MetadataSettings = AS_THE_FILE_SAYS,
    *,
    permit: Permit | None = None,
) -> FrameSource:
    """Open a movie as :func:`open_source` does, or return it as this process last opened it, unless it has changed.

    For tasks, each of which opens the movie anew: to walk along 10,000 pages takes a while, to ask for a file's time
    does not.
    """
    first = path[0] if isinstance(path, tuple) and path else path
    place = Path(_split(str(first))[0])
    status = next((at.stat() for at in (place, place.parent) if at.exists()), None)
    stamp = (status.st_size, status.st_mtime_ns) if status else None
    return _open_stamped(path if isinstance(path, tuple | FileList) else str(path), settings, metadata, permit, stamp)


@lru_cache(maxsize=4)
def _open_stamped(
    path: str | FileList | tuple[str | Path, ...],
    settings: SourceSettings,
    metadata: MetadataSettings,
    permit: Permit | None,
    stamp: tuple[int, int] | None,
) -> FrameSource:
    return open_source(path, settings, metadata, permit=permit)


def _open(path: str | FileList, settings: SourceSettings, permit: Permit | None) -> Source:
    name = str(path)
    outer, inner = _split(name)
    open_file = partial(_open_file, inner=inner, settings=settings, permit=permit)
    if not isinstance(path, FileList) and (reader := _reader_of_folder(Path(outer))):
        return _opened(reader, Path(outer), inner, settings, permit)
    listed = path if isinstance(path, FileList) else list_files(name, Path(outer), READERS)
    if listed is None:
        return open_file(Path(outer))
    return open_sequence(name, list(listed.files), open_file, references=listed.references)


def is_movie_folder(place: Path) -> bool:
    """Tell whether a folder is one movie by itself, such as a Zarr array; of a folder of files each may be one."""
    return _reader_of_folder(place) is not None


def _reader_of_folder(place: Path) -> Reader | None:
    return READERS.of_folder(place) if place.is_dir() else None


def files_named_now(source: FrameSource) -> tuple[tuple[Path, ...], tuple[Path, ...]] | None:
    """Return the files that a movie's folder or pattern named when it was opened, and those that it names now.

    None for a movie of one file, or of a list of files.

    Raises
    ------
    SourceError
        Where a folder holds files of several formats now, or cannot be read.
    """
    if source.listed or not isinstance(source, SequenceSource) or is_movie_folder(Path(_split(source.path)[0])):
        return None
    with reading(source.path):
        found = list_files(source.path, Path(_split(source.path)[0]), READERS)
    return source.parts, found.files if found else ()


def _open_list(names: list[str], settings: SourceSettings, permit: Permit | None) -> Source:
    """Open files as one movie in the order of the list; all have the same path inside."""
    split = [_split(name) for name in names]
    inside = {inner for _, inner in split}
    if len(inside) > 1:
        raise SourceError(
            "the files of a list have different paths inside",
            names[0],
            "one path",
            ", ".join(repr(path) for path in sorted(inside)[:9]),
            "Name the same data set in each of them",
        )
    open_file = partial(_open_file, inner=next(iter(inside), ""), settings=settings, permit=permit)
    return open_sequence(names[0] if names else "", [Path(outer) for outer, _ in split], open_file, listed=True)


def _split(name: str) -> tuple[str, str]:
    """Return the path of a file, and the path inside it after two colons; a file whose name has colons is that file."""
    ends = [match.start() for match in re.finditer("::", name)]
    there = [end for end in (len(name), *reversed(ends)) if os.path.lexists(name[:end])]
    files = (end for end in there if not name[:end].endswith("/"))
    fitting = (end for end in (*ends, len(name)) if is_pattern(Path(name[:end])))
    end = next(chain(files, fitting, there), ends[0] if ends else len(name))
    return name[:end], name[end + 2 :]


def _open_file(path: Path, *, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
    checked_file(path, permit)
    declared = settings.raw_shape is not None and settings.raw_dtype is not None
    reader = READERS.get(path.suffix.lower(), _RAW if declared else None)
    if reader is None:
        raise unknown_format(path, READERS)
    return _opened(reader, path, inner, settings, permit)


def _opened(reader: Reader, path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
    if inner and not reader.inside:
        raise SourceError(
            f"{reader.name} files have no paths inside",
            f"{path}::{inner}",
            "the file's name alone",
            f"the path {inner}",
            f"Open {path}",
        )
    with reading(str(path)):
        return reader.open(path, inner, settings, permit)
