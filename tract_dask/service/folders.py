"""The folder that the service may read and write, and nothing above it.

A request names files relative to it. A name is checked as text first, then as what the file system makes of it: links
are followed, and have to end inside. What can write into the folder by other ways than the service could still swap a
link between check and use; the service itself makes no links.
"""

from __future__ import annotations

import os
import stat
import unicodedata
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from .. import stores
from ..errors import DestinationError, InputError, MissingStoreError, StoreError
from ..io import READERS

STATE_FOLDER = ".tract_dask"
"""Where the service keeps its own store, under the data root; no request reaches it."""

MAX_NAME_BYTES = 255
MAX_PATH_BYTES = 2048

_INNER, _WILD = "::", "*?["


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
        ``folder``; ``movie`` for what a reader opens by its suffix, and for a store with a movie; ``file`` for the
        rest, other stores (.zarr) among them.
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


class DataRoot:
    """The folder with the movies and the results.

    Parameters
    ----------
    root
        An existing folder; links in its own path are followed once, here.

    Raises
    ------
    DestinationError
        Where it is no folder.
    """

    def __init__(self, root: Path) -> None:
        self.path = Path(os.path.realpath(root))
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
        if place.relative_to(self.path).parts[:1] == (STATE_FOLDER,):
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

    def source(self, relative: str) -> str:
        """Return a movie's path for :func:`tract_dask.io.open_source`.

        It is a file, ``file.h5::/path/in/file``, a folder, or a pattern for the files of one folder (``folder/*.tif``).

        Raises
        ------
        OutsideError, MissingStoreError
            As :meth:`resolve`; also where a folder of single frames holds a link that leads out.
        """
        outer, sign, inner = relative.partition(_INNER)
        if any(ord(letter) < 32 for letter in inner):
            raise _outside("the path inside the file has control characters", ascii(relative))
        folder, _, name = outer.rpartition("/")
        _check_text(outer)
        if any(letter in name for letter in _WILD) and not (self.path / outer).exists():
            place = self.resolve(folder)
            self._check_links(place)
            return f"{place}/{name}{sign}{inner}"
        place = self.resolve(outer)
        if place.is_dir() and place.suffix != ".zarr":
            self._check_links(place)
        return f"{place}{sign}{inner}"

    def _check_links(self, folder: Path) -> None:
        """Refuse a folder with a link that leads out: whoever reads all that is in it would follow it."""
        with os.scandir(folder) as found:
            links = [item.name for item in found if item.is_symlink()]
        for link in links:
            self.resolve(f"{self.relative(folder)}/{link}".removeprefix("/"), must_exist=False)

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

    def listing(self, relative: str = "") -> list[Entry]:
        """Return what a folder holds: folders first, by name; hidden names, and what :meth:`resolve` refuses, left out.

        Raises
        ------
        OutsideError, MissingStoreError
            As :meth:`resolve`; also where it is a file.
        """
        place = self.resolve(relative)
        if not place.is_dir():
            raise MissingStoreError("this is a file", relative, "a folder", "a file", "List the folder that it is in")
        with os.scandir(place) as found:
            entries = [entry for item in found if (entry := self._entry(relative, item)) is not None]
        return sorted(entries, key=lambda entry: (entry.kind != "folder", entry.name.lower(), entry.name))

    def _entry(self, folder: str, item: os.DirEntry[str]) -> Entry | None:
        if item.name.startswith("."):
            return None
        path = f"{folder}/{item.name}" if folder else item.name
        try:
            place = self.resolve(path)
            status = place.stat()
        except (InputError, MissingStoreError, OSError):
            return None
        modified = datetime.fromtimestamp(status.st_mtime, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
        is_folder = stat.S_ISDIR(status.st_mode)
        return Entry(item.name, path, _kind(place, is_folder), None if is_folder else status.st_size, modified)


def _kind(place: Path, is_folder: bool) -> str:
    if is_folder and place.suffix.lower() != ".zarr":
        return "folder"
    if is_folder:
        try:
            return "movie" if stores.attributes(place).get("kind") == "movie" else "file"
        except StoreError:  # a damaged store does not keep others from being listed
            return "file"
    return "movie" if place.suffix.lower() in READERS else "file"


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
