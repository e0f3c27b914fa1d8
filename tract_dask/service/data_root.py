"""The folder that the service may read and write, and nothing above it.

A request names files relative to it. A name is checked as text first, then as what the file system makes of it: links
are followed, and have to end inside. What can write into the folder by other ways than the service could still swap a
link between check and use; the service itself makes no links.
"""

from __future__ import annotations

import os
import re
import stat
import unicodedata
from bisect import bisect_right
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast

from ..errors import DestinationError, InputError, MissingStoreError, StoreError
from ..readers import READERS, is_movie_folder
from ..readers.movie_files import WILD, FileList, list_files
from ..readers.recipes import unknown_format
from ..store import metadata
from ..store.damage import METADATA

T = TypeVar("T")

STATE_FOLDER = ".tract_dask"
"""Where earlier versions kept the service's own store, under the data root; no request reaches it."""

PAGE = 1000
"""Entries of a page of a listing, where nobody says how many."""

MOST_NAMES = 1_000_000
"""Entries of a folder that can be listed."""

MAX_NAME_BYTES = 255
MAX_PATH_BYTES = 2048

_LISTED_BYTES = 1 << 18
"""Metadata of a store that are read for a listing; ours have a tenth of that."""

STORES = (".zarr", ".zspy")
"""Suffixes of folders that are shown as one thing: a movie, or another store."""

_INNER = "::"


class OutsideError(InputError):
    """A path leaves the data root, or could."""


@dataclass(frozen=True)
class Entry:
    """A line of a folder's listing.

    Attributes
    ----------
    name, path
        Its name, and its path relative to the data root, with "/" between.
    kind
        ``folder``; ``movie`` for what a reader opens by its suffix, for a store with a movie, and for a Zarr store of
        others; ``unusable`` for what has a name that is not UTF-8, and so no path; ``file`` for the rest, other stores
        (.zarr) among them.
    bytes
        Size of a file; None for folders and stores.
    modified
        UTC, ISO 8601.
    """

    name: str
    path: str
    kind: str
    bytes: int | None
    modified: str


@dataclass(frozen=True)
class Page:
    """A part of a folder's listing; ``next`` names the one that follows, None: there is none."""

    entries: list[Entry]
    next: str | None


@dataclass(frozen=True)
class Bounds:
    """What may be opened: it is called with a path before that is opened; see :func:`tract_dask.readers.open_source`.

    Attributes
    ----------
    root
        The data root, resolved.
    closed
        Folders that no request reaches, even where they are under it.
    """

    root: Path
    closed: tuple[Path, ...] = ()

    def __call__(self, path: Path) -> None:
        """Refuse a file that does not lie under the root once all links are followed.

        Raises
        ------
        OutsideError
            Where it does not, or belongs to the service; or where it is a device, a pipe or a socket.
        """
        place = Path(os.path.realpath(path))
        if not place.is_relative_to(self.root):
            raise OutsideError(
                "a link in the movie leads out of the data root",
                path.name,
                "files under the data root",
                remedy="Copy that file into the data root, and link it there",
            )
        if self.is_closed(place):
            raise _outside("this folder is the service's own", path.name)
        if place.exists() and not (place.is_file() or place.is_dir()):
            raise _outside("this is neither a file nor a folder", path.name)

    def is_closed(self, place: Path) -> bool:
        """Tell whether a resolved path is the service's own, or in a folder of its own."""
        old = place.relative_to(self.root).parts[:1] == (STATE_FOLDER,)
        return old or any(place.is_relative_to(folder) for folder in self.closed)


class DataRoot:
    """The folder with the movies and the results.

    Parameters
    ----------
    root
        An existing folder; links in its own path are followed once, here.
    closed
        Folders that no request reaches: that of the service's own store, wherever it is.

    Attributes
    ----------
    path
        The folder, resolved.
    permit
        Refuses what is not under it; for whatever opens files.

    Raises
    ------
    DestinationError
        Where it is no folder.
    """

    def __init__(self, root: Path, closed: tuple[Path, ...] = ()) -> None:
        self.path = Path(os.path.realpath(root))
        own = "(?!)" if self.path == Path("/") else re.escape(str(self.path))
        self._own_path = re.compile(rf"(?<![\w.-]){own}(?:(/(?=[^\s/'\"):;,]))|/?(?![\w-]|\.\w))")
        self.permit = Bounds(self.path, tuple(Path(os.path.realpath(folder)) for folder in closed))
        if not self.path.is_dir():
            raise DestinationError(
                "the data root is not a folder",
                str(root),
                "a folder that is there",
                "a file" if self.path.exists() else "nothing",
                "Make it first, or name another with --data-root",
            )

    def resolve(self, relative: str, *, must_exist: bool = True) -> Path:
        """Return the absolute path, all links followed, of what ``relative`` names; "" is the root itself.

        Parameters
        ----------
        relative
            Names with "/" between. It is taken as it is: a "%2e" in it is a name with a per cent sign.
        must_exist
            Whether it has to be there. Where it is there, it is a file or a folder in any case.

        Raises
        ------
        OutsideError
            Where it is absolute, has empty parts, "." or "..", signs that a file system may read as such, or links that
            lead out; or names the service's own folder, a device, a pipe or a socket.
        MissingStoreError
            Where it must exist and does not.
        """
        _check_text(relative)
        place = Path(os.path.realpath(self.path / relative))
        if not place.is_relative_to(self.path):
            raise _outside("a link leads out of the data root", relative)
        if self.permit.is_closed(place):
            raise _outside("this folder is the service's own", relative)
        try:
            mode = place.stat().st_mode
        except (OSError, ValueError) as error:
            if must_exist:
                raise MissingStoreError(
                    "there is no such file or folder",
                    relative or "/",
                    "a path relative to the data root",
                    remedy="Choose one that the listing shows",
                ) from error
            return place
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise _outside("this is neither a file nor a folder", relative)
        return place

    def source(self, relative: str, *, must_exist: bool = True) -> str | FileList:
        """Return a movie for :func:`tract_dask.readers.open_source`: a file, or the files of a folder or a pattern.

        Parameters
        ----------
        relative
            A file, ``file.h5::/path/in/file``, a folder, a store (.zarr), or a pattern for the files of one folder
            (``folder/*.tif``). Only the last part may be a pattern, and what exists is none.
        must_exist
            Whether it has to be there; the source of a movie that is converted need not.

        Raises
        ------
        OutsideError, MissingStoreError
            As :meth:`resolve`, of every file.
        SourceError
            Where a file is of a format that no reader opens; raw files are known by their suffix only.
        """
        outer, sign, inner = relative.partition(_INNER)
        if any(ord(letter) < 32 for letter in inner):
            raise _outside("the path inside the file has control characters", ascii(relative))
        _check_text(outer)
        folder, _, name = outer.rpartition("/")
        if any(letter in name for letter in WILD) and not os.path.lexists(self.path / outer):
            return self._listed(self.resolve(folder, must_exist=must_exist) / name, f"{sign}{inner}")
        place = self.resolve(outer, must_exist=must_exist)
        if not place.exists():
            return f"{place}{sign}{inner}"
        if place.is_file():
            _check_format(place)
        elif place.suffix == ".zarr" or is_movie_folder(place):
            self.check_links(place)
        else:
            return self._listed(place, f"{sign}{inner}")
        if sign and os.path.lexists(f"{place}{sign}{inner}"):
            raise _outside("the path inside the file is that of another file, too", relative)
        return f"{place}{sign}{inner}"

    def _listed(self, outer: Path, inner: str) -> FileList:
        """Return the files that a folder or a pattern names; each is resolved and checked."""
        found = list_files(f"{outer}{inner}", outer, READERS) or FileList(f"{outer}{inner}", ())
        for file in found.files:
            if file.is_symlink() or not file.is_file():  # any other lies where it seems to lie
                self.permit(file)
            _check_format(Path(os.path.realpath(file)) if file.is_symlink() else file)
        return found

    def store(self, relative: str) -> Path:
        """Return the path of a file or a store that a job wrote, whether it is there or not.

        Raises
        ------
        OutsideError
            As :meth:`resolve`; also where a link in it leads out.
        """
        place = self.resolve(relative, must_exist=False)
        if place.is_dir():
            self.check_links(place)
        return place

    def check_links(self, folder: Path) -> None:
        """Refuse a folder, such as a store, in which a link leads out, at any depth.

        Raises
        ------
        OutsideError
            Where one does.
        InputError
            Where it holds more than :data:`MOST_NAMES` files and folders, or one cannot be looked at.
        """
        seen, waiting, looked = {folder}, [folder], 0
        try:
            while waiting:
                with os.scandir(waiting.pop()) as found:
                    for item in found:
                        looked += 1
                        if looked > MOST_NAMES:
                            raise self._crowded(folder)
                        place = self._below(item)
                        if place is not None and place not in seen:
                            seen.add(place)
                            waiting.append(place)
        except OSError as error:
            got = error.strerror or str(error)
            remedy = "Check the permissions and the depth of its folders, or make the copy again"
            raise InputError(
                "a folder in it cannot be listed", self.relative(folder), "files and folders", got, remedy
            ) from error

    def _crowded(self, folder: Path) -> InputError:
        return InputError(
            "there are too many files and folders in it",
            self.relative(folder),
            f"at most {MOST_NAMES}",
            "more",
            "Convert the movie with tract-dask convert, or store it with larger chunks or shards",
        )

    def _below(self, item: os.DirEntry[str]) -> Path | None:
        """Return the folder that an entry of a folder is, or leads to; None where it is none."""
        if item.is_symlink():
            place = Path(os.path.realpath(item.path))
            self.permit(place)
            return place if place.is_dir() else None
        if item.is_dir():
            return Path(item.path)
        if not item.is_file():
            self.permit(Path(item.path))  # a pipe, which a library would wait for
        return None

    def shown(self, value: T) -> T:
        """Return a text, or a JSON value with texts in it, as users are to see it: paths relative to the root."""
        found: Any = value
        match value:
            case str():
                found = self._own_path.sub(lambda match: "" if match[1] else "the data root", value)
            case list():
                found = [self.shown(part) for part in value]
            case dict():
                found = {name: self.shown(part) for name, part in value.items()}
        return cast("T", found)

    def relative(self, path: Path) -> str:
        """Return the name, relative to the root, of a path under it.

        Raises
        ------
        OutsideError
            Where it is not under it.
        """
        place = Path(os.path.realpath(path))
        if not place.is_relative_to(self.path):
            raise _outside("the path is not under the data root", path.name)
        found = place.relative_to(self.path).as_posix()
        return "" if found == "." else found

    def listing(self, relative: str = "", after: str = "", limit: int = PAGE) -> Page:
        """Return what a folder holds: folders first, by name; hidden names, and what :meth:`resolve` refuses, left out.

        A name that is not UTF-8 is shown escaped, and marked as not usable.

        Parameters
        ----------
        after
            :attr:`Page.next` of the page before; "": the first page.
        limit
            Entries of a page, at most. Only those are looked at; of the others their names are read.

        Raises
        ------
        OutsideError, MissingStoreError
            As :meth:`resolve`; also where it is a file.
        InputError
            Where it holds more than :data:`MOST_NAMES` entries, or ``after`` is none.
        """
        place = self.resolve(relative)
        if not place.is_dir():
            raise MissingStoreError("this is a file", relative, "a folder", "a file", "List the folder that it is in")
        with os.scandir(place) as found:
            keys = sorted(_key(item) for item in islice(found, MOST_NAMES + 1) if not item.name.startswith("."))
        if len(keys) > MOST_NAMES:
            raise InputError("the folder holds too many files", relative, f"at most {MOST_NAMES}", "more", "Divide it")
        begin = bisect_right(keys, _cursor_key(after)) if after else 0
        chosen = keys[begin : begin + limit]
        entries = [entry for key in chosen if (entry := self._entry(relative, key[-1])) is not None]
        return Page(entries, _cursor(chosen[-1]) if begin + limit < len(keys) else None)

    def _entry(self, folder: str, name: str) -> Entry | None:
        path = f"{folder}/{name}" if folder else name
        if not _is_text(name):
            shown = os.fsencode(name).decode(errors="backslashreplace")
            return Entry(shown, "", "unusable", None, _moment(0.0))
        try:
            place = self.resolve(path)
            status = place.stat()
        except (InputError, MissingStoreError, OSError):
            return None
        is_folder = stat.S_ISDIR(status.st_mode)
        size = None if is_folder else status.st_size
        return Entry(name, path, _kind(place, is_folder), size, _moment(status.st_mtime))


_Key: TypeAlias = tuple[bool, str, str]
"""How a folder's entries are sorted: whether it is no folder to be opened, its name folded, its name."""


def _key(item: os.DirEntry[str]) -> _Key:
    try:
        is_folder = item.is_dir()
    except OSError:
        is_folder = False
    return not is_folder or item.name.lower().endswith(STORES), item.name.lower(), item.name


def _cursor(key: _Key) -> str:
    return f"{int(key[0])}{os.fsencode(key[-1]).hex()}"


def _cursor_key(cursor: str) -> _Key:
    kind, code = cursor[:1], cursor[1:]
    try:
        name = os.fsdecode(bytes.fromhex(code))
    except ValueError:
        name = ""
    if kind not in ("0", "1") or not name:
        raise InputError("there is no such page", "after", "what the page before gave as next", cursor[:40])
    return kind == "1", name.lower(), name


def _is_text(name: str) -> bool:
    return not any(0xD800 <= ord(sign) < 0xE000 for sign in name)


def _moment(seconds: float) -> str:
    """Return a time as listings show it; the nearest that there is for one beyond the calendar."""
    moment = datetime.fromtimestamp(min(max(seconds, 0.0), 253402300799.0), UTC)
    return moment.isoformat(timespec="seconds").replace("+00:00", "Z")


def _kind(place: Path, is_folder: bool) -> str:
    if is_folder and place.suffix.lower() not in STORES:
        return "folder"
    if is_folder:
        return "movie" if _is_movie_store(place) else "file"
    return "movie" if place.suffix.lower() in READERS else "file"


def _is_movie_store(place: Path) -> bool:
    """Tell whether a store holds a movie; damaged ones do not, and of long metadata, none of which are ours, all do.

    A page may have thousands of stores: what would take long to parse is not read, and no link is followed.
    """
    file = place / METADATA
    try:
        status = file.lstat() if os.path.lexists(file) else None
        if status is not None and (stat.S_ISLNK(status.st_mode) or status.st_size > _LISTED_BYTES):
            return is_movie_folder(place)
        kind = metadata.attributes(place).get("kind")
    except (StoreError, OSError):  # a damaged store does not keep others from being listed
        return False
    return kind == "movie" or (kind is None and is_movie_folder(place))


def folded(path: str) -> tuple[str, ...]:
    """Return the names in a path such that those are the same which some file system takes for the same.

    Examples
    --------
    >>> folded("Jobs/ONE ") == folded("jobs/one")
    True
    """
    return tuple(unicodedata.normalize("NFKC", part).casefold().rstrip(" .") for part in path.split("/") if part)


def overlap(one: str, other: str) -> bool:
    """Tell whether two folders, relative to the data root, are one, or one lies in the other.

    Examples
    --------
    >>> overlap("a", "A/b"), overlap("a/b", "a"), overlap("a", "ab")
    (True, True, False)
    """
    return all(mine == theirs for mine, theirs in zip(folded(one), folded(other), strict=False))


def _check_format(place: Path) -> None:
    if place.suffix.lower() not in READERS:
        raise unknown_format(place, READERS)


def _check_text(relative: str) -> None:
    """Refuse a name that leaves the root, or would on some file system or after some decoding of letters."""
    try:
        size = len(relative.encode())
    except UnicodeEncodeError as error:
        raise _outside("the path is not valid Unicode", ascii(relative)) from error
    if not relative:
        return
    if size > MAX_PATH_BYTES:
        raise _outside("the path is too long", f"{relative[:40]}…", f"at most {MAX_PATH_BYTES} bytes", f"{size}")
    if any(ord(sign) < 32 or ord(sign) == 127 for sign in relative):
        raise _outside("the path has control characters", ascii(relative))
    for part in relative.split("/"):
        if len(part.encode()) > MAX_NAME_BYTES:
            raise _outside("a name in the path is too long", f"{part[:40]}…", f"at most {MAX_NAME_BYTES} bytes")
        folded = unicodedata.normalize("NFKC", part)
        if folded.strip(" .") == "" or "/" in folded or "\\" in folded:
            raise _outside(
                "the path is not one relative to the data root",
                relative,
                'names with one "/" between, none of them "." or "..", no "\\"',
            )
        if folded.casefold() == STATE_FOLDER:
            raise _outside("this folder is the service's own", relative)


def _outside(what: str, where: str, expected: str = "", got: str = "") -> OutsideError:
    return OutsideError(what, where, expected, got, "Name a file or folder under the data root")
