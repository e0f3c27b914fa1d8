"""The files behind an HDF5 data set: external links, virtual sources and raw storage, found as libhdf5 finds them.

Every file is permitted, and looked at, before it is opened. libhdf5 itself would read what is missing as zeros.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ...errors import MissingSourceError, SourceError
from ..checks import DAMAGE, MOST_FRAMES, Permit, checked_file, reading, truncated, words
from .axes import is_signal
from .candidates import Found
from .heaps import check_heaps
from .storage import unwritten
from .velox import detector_of, is_velox

MOST_LINKS = 16
"""So many links may follow each other, as in libhdf5; more are a circle."""

MOST_OBJECTS = 10_000
"""So many groups and data sets are looked at for one that could be the movie."""


@dataclass(frozen=True)
class Access:
    """Asks before a file is opened, and keeps its path."""

    permit: Permit | None = None
    files: dict[Path, None] = field(default_factory=dict)

    def check(self, path: Path) -> os.stat_result:
        """Return the status of a file that may be opened; see :func:`tract_dask.readers.source.checked_file`."""
        status = checked_file(path, self.permit)
        self.files[path] = None
        return status

    def check_absent(self, path: Path) -> None:
        """Refuse a path that may not be opened although nothing is there: what others have is not to be told."""
        if self.permit is not None:
            self.permit(Path(os.path.realpath(path)))


@dataclass
class Search:
    """The movies below a path, and what could not be looked at on the way."""

    found: list[Found] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    seen: set[tuple[int, int]] = field(default_factory=set)
    looked: int = 0


@contextmanager
def opened(path: Path, access: Access) -> Iterator[Any]:
    """Open an HDF5 file once it is permitted and known to be a file."""
    check_heaps(path, access.check(path).st_size)
    with reading(
        str(path),
        "the file cannot be opened as HDF5",
        "Check the copy: it may be cut short, still being written, or of another format",
    ):
        file = h5py.File(path, "r")
    with file:
        yield file


def follow(file: Any, path: str, access: Access, stack: ExitStack) -> Any:
    """Return the group or data set at ``path``; None where there is none. ``stack`` keeps files open.

    Links are followed one by one, here and not in libhdf5, so that no file is opened unseen.

    Raises
    ------
    SourceError
        Where a link leads to a file that is missing, or in a circle.
    """
    at, parts, links = file["/"], deque(_parts(path)), 0
    while parts:
        part = parts.popleft()
        link = at.get(part, getlink=True) if isinstance(at, h5py.Group) else None
        if link is None:
            return None
        if isinstance(link, h5py.HardLink):
            at = at[part]
            continue
        if (links := links + 1) > MOST_LINKS:
            raise SourceError(
                "the links inside the file lead in a circle",
                f"{file.filename}::{path}",
                f"at most {MOST_LINKS} links",
                remedy="Name the data set by another path",
            )
        if isinstance(link, h5py.ExternalLink):
            at = stack.enter_context(opened(_target(at, part, link, access), access))["/"]
        elif link.path.startswith("/"):
            at = at.file["/"]
        parts.extendleft(reversed(_parts(link.path)))
    return at


def movies_below(group: Any, path: str, access: Access) -> Search:
    """Return the data sets with axes below a group, also those behind external links; soft links lead to no others.

    ``path`` is the group's as the user named it.
    """
    search = Search()
    _search(group, "".join(f"/{part}" for part in _parts(path)), access, search, 0)
    return search


def _search(group: Any, shown: str, access: Access, search: Search, depth: int) -> None:
    waiting = deque([(group, shown)])
    while waiting:
        at, path = waiting.popleft()
        if isinstance(at, h5py.Dataset):
            found = _look(search, path, partial(_found, at, path))
            search.found += [found] if found is not None and found.shape else []
            continue
        for name in _names(at, search, path):
            below = f"{path}/{name}"
            link = _look(search, below, partial(at.get, name, getlink=True))
            if isinstance(link, h5py.HardLink):
                item = _look(search, below, partial(at.__getitem__, name))
                if item is not None and _look(search, below, partial(_is_new, item, search)):
                    waiting.append((item, below))
            elif isinstance(link, h5py.ExternalLink) and depth < MOST_LINKS:
                _search_outside(at, name, below, access, search, depth)


def _search_outside(at: Any, name: str, shown: str, access: Access, search: Search, depth: int) -> None:
    link = at.get(name, getlink=True)
    holder = Path(at.file.filename)
    target = _existing(link.filename, holder, "HDF5_EXT_PREFIX", access)
    if target is None:
        search.lost.append(f"{shown} leads to {link.filename}, which is not there")
        return
    with opened(target, access) as file, ExitStack() as stack:
        item = follow(file, link.path, access, stack)
        if item is not None and _is_new(item, search):
            _search(item, shown, access, search, depth + 1)


def _found(dataset: Any, shown: str) -> Found:
    label = _label(dataset) if is_velox(dataset) else ""
    return Found(shown, dataset.shape or (), dataset.dtype, is_signal(dataset), label)


def _label(dataset: Any) -> str:
    try:
        name = detector_of(dataset)
    except DAMAGE:
        name = ""
    return f" ({name[:40]})" if name else ""


def _names(group: Any, search: Search, path: str) -> list[str]:
    names: list[str] = []
    if isinstance(group, h5py.Group):
        _look(search, path, lambda: names.extend(islice(group, MOST_OBJECTS + 1)))
    search.looked += len(names)
    if search.looked > MOST_OBJECTS:
        raise SourceError(
            f"the file holds more than {MOST_OBJECTS:,} groups and data sets",
            group.file.filename,
            "the path of one data set with axes (frames, y, x)",
            "no path, or that of a group",
            f"Name it, for example {Path(group.file.filename).name}::/entry/data",
        )
    return names


def _look(search: Search, path: str, at: Callable[[], Any]) -> Any:
    """Return what a look at an object gives; None, and a note, where it is damaged: others may be whole."""
    try:
        return at()
    except DAMAGE as error:
        search.lost.append(f"{path or '/'} cannot be read: {words(error)}")
        return None


def _is_new(item: Any, search: Search) -> bool:
    """Tell whether an object is met for the first time: hard links, too, may lead in a circle."""
    information = h5py.h5o.get_info(item.id)
    key = (information.fileno, information.addr)
    new = key not in search.seen
    search.seen.add(key)
    return new


@dataclass(frozen=True)
class Segment:
    """A part of a file that holds raw pixels."""

    path: Path
    offset: int
    n_bytes: int


@dataclass(frozen=True)
class Behind:
    """The files that pixels come from: of HDF5, each with its frames, that which holds the data set first; and raw.

    ``notes`` say what was never written in the sources of a virtual data set.
    """

    hdf5: dict[Path, range] = field(default_factory=dict)
    raw: list[Segment] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    seen: set[tuple[str, str]] = field(default_factory=set)


def files_behind(dataset: Any, access: Access) -> Behind:
    """Return all files that the pixels of a data set come from.

    Raises
    ------
    SourceError
        Where one is missing or too short, which libhdf5 would read as zeros.
    """
    behind = Behind()
    _behind(dataset, access, behind, 0, range(MOST_FRAMES))
    return behind


def _behind(dataset: Any, access: Access, behind: Behind, depth: int, frames: range) -> None:
    holder = Path(dataset.file.filename)
    key = (str(holder), dataset.name)
    if key in behind.seen:
        return
    behind.seen.add(key)
    known = behind.hdf5.get(holder, frames)
    behind.hdf5[holder] = range(min(known.start, frames.start), max(known.stop, frames.stop))
    properties = dataset.id.get_create_plist()
    behind.notes.extend(unwritten(dataset, f"{holder}::{dataset.name}") if depth else ())
    for number in range(properties.get_external_count()):
        name, offset, size = properties.get_external(number)
        behind.raw.append(_segment(dataset, os.fsdecode(name), offset, size, access, virtual=depth > 0))
    if properties.get_layout() != h5py.h5d.VIRTUAL:
        return
    if depth >= MOST_LINKS:
        raise SourceError(
            "virtual data sets lead in a circle",
            f"{holder}::{dataset.name}",
            f"at most {MOST_LINKS} on top of each other",
            remedy="Write the movie again, as an ordinary data set",
        )
    for (name, inner), (extent, span) in _virtual_sources(properties).items():
        for block in count() if "%b" in name + inner else (0,):
            with ExitStack() as stack:
                names = (_numbered(name, block), _numbered(inner, block))
                source = _virtual_source(dataset, *names, extent, access, stack, optional=block > 0)
                if source is None:
                    break
                behind.notes.extend(_converted(source, dataset))
                _behind(source, access, behind, depth + 1, span if depth == 0 else frames)


def _numbered(name: str, block: int) -> str:
    """Return a name with %b for the number of a block of frames, as libhdf5 spells it."""
    return name.replace("%%", "\0").replace("%b", str(block)).replace("\0", "%")


def _virtual_sources(properties: Any) -> dict[tuple[str, str], tuple[tuple[int, ...], range]]:
    """Return file and data set of every source: the shape that it has at least, () if unknown, and its frames."""
    sources: dict[tuple[str, str], tuple[tuple[int, ...], range]] = {}
    for number in range(properties.get_virtual_count()):
        key = (properties.get_virtual_filename(number), properties.get_virtual_dsetname(number))
        space, target = properties.get_virtual_srcspace(number), properties.get_virtual_vspace(number)
        whole = space.get_select_type() == h5py.h5s.SEL_ALL
        extent = _lengths(target) if whole else tuple(stop for _, stop in _bounds(space))
        first, stop = next(iter(_bounds(target)), (0, MOST_FRAMES))
        known, frames = sources.get(key, (extent, range(first, stop)))
        span = range(min(first, frames.start), max(stop, frames.stop))
        sources[key] = (tuple(map(max, known, extent)), span)
    return sources


def _lengths(space: Any) -> tuple[int, ...]:
    """Return how much of each axis is selected; () where the selection has no end or is not regular."""
    if not (_bounds(space) and space.is_regular_hyperslab()):
        return ()
    _, _, counts, blocks = space.get_regular_hyperslab()
    return tuple(int(n * block) for n, block in zip(counts, blocks, strict=True))


def _bounds(space: Any) -> list[tuple[int, int]]:
    """Return first and last + 1 of a selection along each axis; nothing where it has no end, or is all there is."""
    if space.get_select_type() != h5py.h5s.SEL_HYPERSLABS:
        return []
    if space.is_regular_hyperslab():
        _, _, counts, blocks = space.get_regular_hyperslab()
        if h5py.h5s.UNLIMITED in (*counts, *blocks):
            return []
    return [(int(first), int(last) + 1) for first, last in zip(*space.get_select_bounds(), strict=True)]


def _virtual_source(
    dataset: Any,
    name: str,
    inner: str,
    extent: tuple[int, ...],
    access: Access,
    stack: ExitStack,
    *,
    optional: bool,
) -> Any:
    """Return a source of a virtual data set; None where an optional one is not there."""
    holder = Path(dataset.file.filename)
    path = holder if name == "." else _existing(name, holder, "HDF5_VDS_PREFIX", access)
    if path is None:
        if optional:
            return None
        raise _missing(holder, dataset.name, name, "a source of the virtual data set is missing")
    file = dataset.file if name == "." else stack.enter_context(opened(path, access))
    source = follow(file, inner, access, stack)
    if source is None and optional:
        return None
    found = source.shape if isinstance(source, h5py.Dataset) else ()
    has, needs = (found, extent) if len(found) == len(extent) else map(_longer_than_1, (found, extent))
    if not found or len(has) < len(needs) or any(one < other for one, other in zip(has, needs, strict=False)):
        raise SourceError(
            f"a source of the virtual data set is {'too short' if found else 'missing'}",
            f"{holder}::{dataset.name}",
            f"the data set {inner} in {path}, of at least {' x '.join(map(str, extent))}",
            " x ".join(map(str, found)) or "nothing under this path",
            "Copy that file again, or write the movie again",
        )
    return source


def _longer_than_1(lengths: tuple[int, ...]) -> tuple[int, ...]:
    """Return lengths without those of 1: a frame of a movie may be a whole image with two axes."""
    return tuple(length for length in lengths if length > 1)


def _converted(source: Any, dataset: Any) -> list[str]:
    """Return a note where a virtual data set is of a type that cannot hold all values of a source."""
    if np.can_cast(source.dtype, dataset.dtype, "safe"):
        return []
    where = f"{dataset.file.filename}::{dataset.name}"
    change = f"{source.dtype} to {dataset.dtype}, which cannot hold all of them"
    return [f"{where}: values of {Path(source.file.filename).name}::{source.name} are converted from {change}"]


def _segment(dataset: Any, name: str, offset: int, size: int, access: Access, *, virtual: bool) -> Segment:
    """Return a part of the raw pixels; its file lies beside that which names it, unless HDF5_EXTFILE_PREFIX is set."""
    holder = Path(dataset.file.filename)
    if virtual and not Path(name).is_absolute():
        raise SourceError(
            "raw pixels behind a virtual data set have no whole path, so that HDF5 would take those of any folder",
            f"{holder}::{dataset.name}",
            "an absolute path",
            name,
            "Open the file that holds them, or write the movie again",
        )
    prefix = os.environ.get("HDF5_EXTFILE_PREFIX", "").replace("${ORIGIN}", str(holder.parent))
    path = (Path(prefix) if prefix else holder.parent) / name
    if not _is_there(path):
        access.check_absent(path)
        raise _missing(holder, dataset.name, str(path), "a file of raw pixels is missing")
    status = access.check(path)
    n_bytes = max(0, status.st_size - offset) if size == h5py.h5s.UNLIMITED else size
    if status.st_size < offset + n_bytes:
        raise truncated(
            str(path), f"before the raw pixels of {holder}::{dataset.name}", offset + n_bytes, status.st_size
        )
    return Segment(path, offset, n_bytes)


def _target(group: Any, name: str, link: Any, access: Access) -> Path:
    """Return the file that an external link leads to."""
    holder = Path(group.file.filename)
    path = _existing(link.filename, holder, "HDF5_EXT_PREFIX", access)
    if path is None:
        shown = f"{group.name.rstrip('/')}/{name}"
        raise _missing(holder, shown, link.filename, "the file that an external link leads to is missing")
    return path


def _existing(name: str, holder: Path, variable: str, access: Access) -> Path | None:
    """Return the first place where libhdf5 looks for another file and there is something."""
    named = holder.parent / name
    prefixes = [prefix for prefix in os.environ.get(variable, "").split(":") if prefix]
    prefixes += [prefix.replace("${ORIGIN}", str(holder.parent)) for prefix in prefixes if "${ORIGIN}" in prefix]
    name, absolute = (Path(name).name, [Path(name)]) if Path(name).is_absolute() else (name, [])
    folders = [*map(Path, prefixes), holder.parent, Path(), Path(os.path.realpath(holder)).parent]
    found = next((path for path in (*absolute, *(folder / name for folder in folders)) if _is_there(path)), None)
    if found is None:
        access.check_absent(named)
    return found


def _is_there(path: Path) -> bool:
    """Tell whether there is something; also where only others may look at it."""
    try:
        path.stat()
    except PermissionError:
        return True
    except (OSError, ValueError):
        return False
    return True


def _missing(holder: Path, inner: str, name: str, what: str) -> SourceError:
    return MissingSourceError(
        what,
        f"{holder}::{inner}",
        f"{name}, in the folder of {holder.name} where it names no folder",
        "no such file",
        "Copy all files of the movie, and keep their names and folders",
    )


def _parts(path: str) -> list[str]:
    return [part for part in path.split("/") if part not in ("", ".")]
