"""The folders that jobs write: whose each is, and what in it a job has made.

A mark, a small hidden file that is written before anything else, names the job of a folder. A folder without one was
made by hand; it is nobody's, and no job writes there. The mark counts only in the place for which it was written, so
that the copy of a folder is nobody's, too.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath

from ..errors import DestinationError
from ..readers.movie_files import WILD
from ..store import files
from ..store.files import read_small
from ..store.held import hold
from ..store.locks import sole_use
from ..store.run_folder import RunFolder
from .data_root import DataRoot, OutsideError, folded
from .errors import ForbiddenError

MARK = ".tract_dask.json"
LOCK = ".lock"
"""As :func:`tract_dask.store.run_folder.sole_run` names it."""

JOBS = "jobs"
"""The folder of the outputs that jobs do not name themselves."""

GOING = [-1]
"""Instead of a signature, of what is being deleted."""

_TRIES = 5
_MARK_BYTES = 1 << 16


@dataclass(frozen=True)
class Mark:
    """Whose a folder is.

    Attributes
    ----------
    owner, job
        Who submitted the job that writes here, or was the last to do so, and the job's id.
    output
        The folder, relative to the data root.
    made
        What the job has left, by name, as :func:`signature` tells it, or :data:`GOING`; empty while it works.
    """

    owner: str
    job: str
    output: str
    made: dict[str, list[int]] = field(default_factory=dict)

    @property
    def named_by_id(self) -> bool:
        """Whether the folder has the job's own name, which no other job can have been given."""
        return self.output == f"{JOBS}/{self.job}"


def read_mark(folder: Path) -> Mark | None:
    """Return the mark of a folder; None where it has none, or one that cannot be read."""
    try:
        return Mark(**json.loads(read_small(folder / MARK, _MARK_BYTES)))
    except (OSError, ValueError, TypeError, RecursionError):
        return None


def checked_place(root: DataRoot, mark: Mark) -> Path:
    """Return the path of a folder that a job may have, whether it is there or not.

    Raises
    ------
    OutsideError
        Where it is not under the data root, or a link leads to it.
    DestinationError
        Where the name could be taken for a pattern or for another name, or belongs to all jobs.
    """
    output = mark.output
    place = root.resolve(output, must_exist=False)
    if place != root.path / output:
        raise OutsideError(
            "a link leads to this folder", output, "a folder itself", root.relative(place), "Name the folder itself"
        )
    if mark.named_by_id:
        return place
    if any(sign in output for sign in (*WILD, "::")):
        raise _refused("this name could be taken for a pattern", output, "a name without *, ?, [ and ::")
    if any(map(_is_odd, PurePosixPath(output).parts)):
        raise _refused(
            "this name would hide the folder",
            output,
            'names that do not begin with ".", nor end with " " or ".", nor have signs that cannot be seen',
        )
    if folded(output) in ((), folded(JOBS)):
        raise _refused("a job cannot write to the data root itself", output or "output", "a folder in it")
    if twin := _twin(root.path, PurePosixPath(output).parts):
        raise _refused("this name differs from one that is there only as letters may", output, twin)
    return place


def check_owner(root: DataRoot, mark: Mark) -> None:
    """Check that a job may write to a folder: it is new, or a job of the same owner has made it.

    Raises
    ------
    ForbiddenError
        Where another owner's job has made it.
    DestinationError
        Where no job has made it, or it lies in what another run wrote.
    """
    place = checked_place(root, mark)
    for around in place.relative_to(root.path).parents:
        if around.parts and _holds_run(root.path / around):
            raise _refused(
                "this folder lies in the output of another run", mark.output, "a folder outside of it", str(around)
            )
    for folder in (root.path / around for around in place.relative_to(root.path).parents):
        if os.path.lexists(folder) and not folder.is_dir():
            raise _refused("the output lies below a file", mark.output, "a folder", root.relative(folder))
    if not os.path.lexists(place):
        return
    if not place.is_dir():
        raise _refused("the output is not a folder", mark.output, "a folder", "a file")
    found = read_mark(place)
    if found is None and mark.named_by_id:  # of a version that left no marks
        return
    if found is None or found.output != mark.output:
        raise _refused(
            "the output folder already holds other files",
            mark.output,
            "a new folder, or one that a job of yours has made",
        )
    if found.owner != mark.owner:
        raise ForbiddenError(
            "this folder belongs to someone else",
            mark.output,
            "a new folder, or one that a job of yours has made",
            f"one that a job of {found.owner} has made",
            "Choose another folder; who may delete that job can delete its files with it, and make room",
        )


def claim(root: DataRoot, mark: Mark, patience_s: float = 0.0) -> None:
    """Make the folder of a job, marked, or take over one that a job of the same owner has made.

    Raises
    ------
    ForbiddenError, DestinationError
        As :func:`check_owner`; also where another run works there, and still does after ``patience_s``.
    """
    place = root.path / mark.output
    for _ in range(_TRIES):
        check_owner(root, mark)
        if not place.exists():
            _make(place, mark)
        with suppress(FileNotFoundError), sole_use(place / LOCK, "another run works in this folder", patience_s):
            check_owner(root, mark)
            if place.is_dir() and (mark.named_by_id or read_mark(place) is not None):
                write_mark(place, mark)
                return
    raise _refused("another program keeps removing this folder", mark.output, "a folder that no other program uses")


@contextmanager
def claimed(root: DataRoot, mark: Mark) -> Iterator[None]:
    """Let nothing in this block write anywhere but into the folder that :func:`claim` gave, nor through a link in it.

    Raises
    ------
    ForbiddenError, DestinationError
        Where another folder has taken its place meanwhile; in this block, where one does so later.
    """
    with hold(root.path / mark.output, links=False):
        check_owner(root, mark)
        yield


def seal(root: DataRoot, mark: Mark) -> None:
    """Note in the mark what the job has left in its folder, now that it has ended."""
    place = root.path / mark.output
    found = read_mark(place) if _is_itself(place) else None
    if found is not None and found.job == mark.job:
        made = {path.name: signature(path) for path in RunFolder(place).written() if path.exists()}
        with suppress(OSError):  # on a full disk nothing is noted, and what has a run's name counts as the job's
            write_mark(place, replace(found, made=made))


def _is_itself(place: Path) -> bool:
    """Tell whether no link leads to a folder."""
    return Path(os.path.realpath(place)) == place


def signature(path: Path) -> list[int]:
    """Return size and time of a file, or of the metadata of a store; they are others once it is made anew."""
    try:
        status = (path / "zarr.json" if path.is_dir() else path).stat()
    except OSError:
        return []
    return [status.st_size, status.st_mtime_ns]


def _make(place: Path, mark: Mark) -> None:
    """Make the folder with its mark, at once: it is never there without."""
    place.parent.mkdir(parents=True, exist_ok=True)
    aside = place.with_name(f".{mark.job}.{secrets.token_hex(4)}.new")
    try:
        aside.mkdir()
        write_mark(aside, mark)
        aside.rename(place)
    except OSError:  # somebody else made it meanwhile: looked at again
        shutil.rmtree(aside, ignore_errors=True)
        if not place.exists():
            raise


def write_mark(folder: Path, mark: Mark) -> None:
    """Write the mark of a folder, whole or not at all."""
    files.write_aside(folder / MARK, json.dumps(asdict(mark)).encode())


def _holds_run(folder: Path) -> bool:
    """Tell whether a folder is the output of a run, of a job or by hand, or a store."""
    outputs = RunFolder(folder)
    signs = (folder / MARK, outputs.settings, outputs.events, folder / "zarr.json")
    return folder.suffix.lower() == ".zarr" or any(sign.exists() for sign in signs)


def _is_odd(name: str) -> bool:
    return name.startswith(".") or name.endswith((" ", ".")) or any(unicodedata.category(sign) == "Cf" for sign in name)


def _twin(folder: Path, parts: tuple[str, ...]) -> str:
    """Return the name in a folder that is the same as the first part that is not there, but for its letters; or ""."""
    if not parts:
        return ""
    if os.path.lexists(folder / parts[0]):
        return _twin(folder / parts[0], parts[1:])
    return next((name for name in _names(folder) if folded(name) == folded(parts[0])), "")


def _names(folder: Path) -> Iterator[str]:
    with suppress(OSError), os.scandir(folder) as found:
        yield from (item.name for item in found)


def _refused(what: str, output: str, expected: str, got: str = "") -> DestinationError:
    return DestinationError(what, output, expected, got, "Choose another folder, or leave output out")
