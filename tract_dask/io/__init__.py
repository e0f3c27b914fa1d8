"""Readers: one file a format behind one small protocol.

A format is a function from a path to a :class:`~tract_dask.io.source.Source` and its line in :data:`READERS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TypeAlias

from ..errors import SourceError
from ..settings import MetadataSettings, SourceSettings
from .hdf5 import open_hdf5
from .listing import FileList, list_files
from .mrc import open_mrc
from .npy import open_npy
from .raw import open_raw
from .sequence import open_sequence
from .source import FrameSource, Source, SourceMetadata, unreadable
from .tiff import open_tiff

__all__ = [
    "READERS",
    "FileList",
    "FrameSource",
    "Permit",
    "SourceMetadata",
    "list_files",
    "open_cached",
    "open_source",
    "unknown_format",
]

Opener: TypeAlias = Callable[[Path, str, SourceSettings], Source]
"""Takes a file, the path inside it (HDF5 only), and how to read it; makes every check."""

Permit: TypeAlias = Callable[[Path], object]
"""Takes the resolved path of a file that is about to be opened, and raises to refuse it."""

READERS: dict[str, Opener] = {
    ".tif": open_tiff,
    ".tiff": open_tiff,
    ".mrc": open_mrc,
    ".mrcs": open_mrc,
    ".st": open_mrc,
    ".npy": open_npy,
    ".h5": open_hdf5,
    ".hdf5": open_hdf5,
    ".hspy": open_hdf5,
    ".raw": open_raw,
    ".bin": open_raw,
    ".dat": open_raw,
}

DECLARED_NOTHING = SourceSettings()
AS_THE_FILE_SAYS = MetadataSettings()

_VENDORS = {".dm3": "DigitalMicrograph", ".dm4": "DigitalMicrograph", ".ser": "TIA", ".emd": "EMD"}


def open_source(
    path: str | Path | FileList,
    settings: SourceSettings = DECLARED_NOTHING,
    metadata: MetadataSettings = AS_THE_FILE_SAYS,
    *,
    permit: Permit | None = None,
) -> FrameSource:
    """Open a movie: a file, ``file.h5::/path/in/file``, a folder, or a glob of files that count up.

    Everything that can be wrong with it is found here, before any work.

    Parameters
    ----------
    path
        What to open. Of a folder, all files of its one readable format. Only the last part may be a pattern, and a
        path that exists is none. A list of files is opened as it is.
    settings
        Shape and type of raw files.
    metadata
        What the user knows better than the file.
    permit
        Called with the resolved path of every file before it is opened.

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
    name = str(path)
    try:
        source = _open(path, settings, permit)
    except OSError as error:
        raise unreadable(name, error) from error
    known = source.metadata
    merged = SourceMetadata(
        pixel_size_pm=known.pixel_size_pm if metadata.pixel_size_pm is None else metadata.pixel_size_pm,
        frame_time_s=known.frame_time_s if metadata.frame_time_s is None else metadata.frame_time_s,
        dose=metadata.dose,
        gain=metadata.gain,
        notes=known.notes,
    )
    return replace(source, path=name, metadata=merged)


def open_cached(
    path: str | Path | FileList,
    settings: SourceSettings = DECLARED_NOTHING,
    metadata: MetadataSettings = AS_THE_FILE_SAYS,
    *,
    permit: Permit | None = None,
) -> FrameSource:
    """Open a movie as :func:`open_source` does, or return it as this process last opened it, unless it has changed.

    For tasks, each of which opens the movie anew: to walk along 10,000 pages takes a while, to ask for a file's time
    does not.
    """
    place = Path(str(path).partition("::")[0])
    status = (place if place.exists() else place.parent).stat() if place.parent.exists() else None
    stamp = (status.st_size, status.st_mtime_ns) if status else None
    return _open_stamped(path if isinstance(path, FileList) else str(path), settings, metadata, permit, stamp)


@lru_cache(maxsize=4)
def _open_stamped(
    path: str | FileList,
    settings: SourceSettings,
    metadata: MetadataSettings,
    permit: Permit | None,
    stamp: tuple[int, int] | None,
) -> FrameSource:
    return open_source(path, settings, metadata, permit=permit)


def _open(path: str | Path | FileList, settings: SourceSettings, permit: Permit | None) -> Source:
    outer, _, inner = str(path).partition("::")
    open_file = partial(_open_file, inner=inner, settings=settings, permit=permit)
    listed = path if isinstance(path, FileList) else list_files(path, READERS)
    return open_file(Path(outer)) if listed is None else open_sequence(listed.name, list(listed.files), open_file)


def _open_file(path: Path, *, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
    if permit is not None:
        permit(path.resolve())
    if not path.exists():
        raise SourceError(
            "there is no such file",
            str(path),
            remedy="Check the path; on a cluster every worker must see it under the same name",
        )
    suffix = path.suffix.lower()
    declared = settings.raw_shape is not None and settings.raw_dtype is not None
    opener = READERS.get(suffix, open_raw if declared else None)
    if opener is None:
        raise unknown_format(path)
    if inner and opener is not open_hdf5:
        raise SourceError(
            "only HDF5 files have paths inside",
            f"{path}::{inner}",
            "the file's name alone",
            f"the path {inner}",
            f"Open {path}",
        )
    return opener(path, inner, settings)


def unknown_format(path: Path) -> SourceError:
    """Return the error for a file that no reader opens."""
    suffix = path.suffix.lower()
    return SourceError(
        f"{_VENDORS[suffix]} files are not read yet" if suffix in _VENDORS else "the format is unknown",
        str(path),
        f"a name that ends in one of {', '.join(READERS)}",
        suffix or "a name without a suffix",
        "Export the movie as TIFF or MRC"
        if suffix in _VENDORS
        else "Rename or export it; for a raw binary file declare --raw-shape and --raw-dtype",
    )
