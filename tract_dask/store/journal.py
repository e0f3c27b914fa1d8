"""The record of finished shards: the journal is the truth, as far as the disk bears it out.

A task writes its shard; once the shard is on disk, a line in the journal says so, with the length and a checksum of
each of its files. A later run of the same stage reads the journal, looks at the files, and does the rest. A task may
run twice: it writes the same bytes.

A journal is a folder: the file ``key``, which names the key of the stage and its current run, and a folder of that
run, in which its tasks write all that they write. A new run takes the folder of the old one away before it touches the
store. A task that was left over has then nothing to write to, and no file that it could rename into the store.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ..errors import DestinationError, StoreError, TractError
from . import disk
from .files import disk_errors, remove, write_aside
from .held import Folder, around, check_held, hold
from .metadata import json_ready
from .shard_files import crc32c
from .shards import Shard

_PROCESS = uuid.uuid4().hex[:12]
"""Tells this process from all others, also from those on other machines."""

_TAIL_BYTES = 4096
"""The end of a file, of which a line holds the checksum; the index of a shard lies there."""

_LINE_BYTES = 64 << 20
"""No line is longer; a longer one is damage."""

_SUFFIX = ".journal"

GROWING = ".parts"
"""Suffix of files that a line names a piece of, and that may have grown since."""

Payload: TypeAlias = dict[str, Any]
"""What a task leaves in the journal: small, JSON-ready."""

Fields: TypeAlias = Mapping[str, tuple[int | None, ...]]
"""What payloads hold: the shape of each number or array; None: the frames of the shard."""

Mark: TypeAlias = tuple[str, int, int]
"""A file, from the folder of the run; where in it the shard's bytes end; the CRC-32C of the last of them."""


def journal_beside(path: Path) -> Path:
    """Return the folder of the journal of the store at ``path``, which is there while the store is unfinished."""
    return path.with_name(f"{path.name}{_SUFFIX}")


def _home(journal: Path) -> Path:
    """Return the folder of the store of a journal, or of one inside another's."""
    return journal.parent.parent if journal.parent.name.endswith(_SUFFIX) else journal.parent


def remove_journal(folder: Path) -> None:
    """Delete a journal, at once for all tasks that still write to it."""
    remove(folder)


def left_over(place: Path, expected: str, got: str) -> StoreError:
    """Return the error for a task that an earlier run has left."""
    return StoreError(
        "a task is left over from an earlier run, and has written nothing more",
        str(place),
        expected,
        got,
        "Go on with the newer run: it does all shards itself",
    )


def _gone(folder: Path) -> StoreError:
    """Return the error for a run whose folder was moved or deleted while it worked."""
    return StoreError(
        "the folder of the run is not there any more",
        str(folder),
        "the folder that the run began in, until it ends",
        "none",
        "Put it back, or give the same command with its new place: what is done is kept",
    )


def own_file(run: Path, suffix: str) -> Path:
    """Return the file in the folder of a run that this thread alone writes."""
    return run / f"{os.getpid()}-{_PROCESS}-{threading.get_native_id()}{suffix}"


def entries(folder: Path) -> Iterator[tuple[int, Payload]]:
    """Yield index and payload of every entry in the journal at ``folder``; a shard that ran twice comes twice.

    Lines that are torn, or of something else, are no entries. The shards' files are not looked at.
    """
    _, run = _current(folder)
    for index, payload, _ in _lines(folder / run) if run else ():
        yield index, payload


def logs(folder: Path) -> list[Path]:
    """Return the files of the current run that hold its lines."""
    _, run = _current(folder)
    return sorted((folder / run).glob("*.jsonl")) if run else []


class Journal:
    """The record of finished shards of one stage, of one run and of those that go on from it.

    Parameters
    ----------
    folder
        Made, or cleared, where it holds no journal of this key.
    key
        Key of the stage (:func:`tract_dask.store.keys.stage_key`). What was done under another key is
        thrown away.
    fields
        What the payloads hold; an entry with less is none.
    run
        Name of the run that is read, or added to; unset: the current one of this key, or a new one.

    Attributes
    ----------
    path
        Folder of the run, for the files of its tasks. No task may make it.
    """

    def __init__(self, folder: Path, key: str, fields: Fields | None = None, *, run: str = "") -> None:
        self.folder, self.key, self.fields = folder, key, fields or {}
        self.path = folder / (run or self._run() or self._begin())
        store = folder.with_name(folder.name.removesuffix(_SUFFIX))
        self._around = () if run else tuple(around(folder)) or (Folder.at(_home(folder)),)
        self._store = (Folder.at(store),) if not run and store != folder and store.is_dir() else ()

    @classmethod
    def existing(cls, folder: Path, key: str) -> Journal | None:
        """Return the journal at ``folder``, to be read; None where there is none of this key."""
        found, run = _current(folder)
        return cls(folder, key, run=run) if found == key and run else None

    def _run(self) -> str:
        """Return the name of the current run; empty where none of this key is."""
        key, run = _current(self.folder)
        return run if key == self.key and (self.folder / run).is_dir() else ""

    def _begin(self) -> str:
        remove_journal(self.folder)
        check_held(self.folder)
        run = f"{hashlib.sha256(self.key.encode()).hexdigest()[:16]}-{uuid.uuid4().hex[:8]}"
        (self.folder / run).mkdir(parents=True)
        write_aside(self.folder / "key", f"{self.key}\n{run}".encode())
        return run

    def check(self) -> None:
        """Check that the run is still the current one, and works in the folders in which it began.

        Raises
        ------
        StoreError
            Where another has taken its place, or it is over.
        DestinationError
            Where its folder or its store was replaced.
        """
        for place in self._around:
            place.check()
        if self._run() != self.path.name:
            if not self.folder.parent.is_dir():
                raise _gone(self.folder.parent) from None
            now = _current(self.folder)[1]
            got = f"run {now}" if now else "none: the run is over"
            raise left_over(self.folder, f"run {self.path.name}", got) from None
        for place in self._store:
            place.check()

    @contextmanager
    def batch(self) -> Iterator[Callable[[Shard, Payload], None]]:
        """Run tasks in this block, and call what it yields with each shard that is done, and its payload.

        At the end of the block the files of those shards are synced and put in place, then the lines are written; also
        where a later task of the batch has failed.
        """
        done: list[tuple[Shard, Payload, list[disk.Written]]] = []
        with self._only_the_current_run(), self._held(), disk.together() as files:
            try:
                yield lambda shard, payload: done.append((shard, payload, files.keep()))
            except Exception:
                with suppress(OSError, TractError):
                    self._commit(files, done)
                raise
            self._commit(files, done)

    def record(self, shard: Shard, payload: Payload) -> None:
        """Note that ``shard`` is done, with what its task returned."""
        with self.batch() as done:
            done(shard, payload)

    def _commit(self, files: disk.Batch, done: list[tuple[Shard, Payload, list[disk.Written]]]) -> None:
        if not done:
            return
        self.check()
        with disk_errors(self.path):
            files.commit()
            lines = b"".join(self._line(*entry) for entry in done)
            self.check()
            with own_file(self.path, ".jsonl").open("ab") as log:
                log.write(lines)

    def _line(self, shard: Shard, payload: Payload, written: list[disk.Written]) -> bytes:
        """Return a line that starts anew: the one before it may be torn, by a disk that was full."""
        marks = [self._mark(*piece) for piece in written]
        text = json.dumps([shard.index, json_ready(payload), marks]).encode()
        return b"\n%08x %b\n" % (crc32c(text), text)

    def _mark(self, path: Path, end: int) -> Mark:
        with path.open("rb", buffering=0) as file:
            return os.path.relpath(path, self.path), end, _tail(file.fileno(), end)

    @contextmanager
    def _held(self) -> Iterator[None]:
        with ExitStack() as stack:
            for place in (*self._around, *self._store):
                stack.enter_context(hold(place))
            yield

    @contextmanager
    def _only_the_current_run(self) -> Iterator[None]:
        """Where something is missing, or another, because the run is over, say that."""
        try:
            yield
        except (OSError, DestinationError):
            self.check()
            raise

    def sound(self, shards: Sequence[Shard]) -> Iterator[tuple[int, Payload, list[Mark]]]:
        """Yield the finished ones of ``shards``, each once: index, payload, and where its bytes are.

        Their lines are whole, their payloads have the fields, and their files are on disk: as long as they were, with
        the same last bytes. What lies before these is checked where it is read: tiles and arrays have checksums.
        """
        seen = np.zeros(len(shards), np.bool_)
        for index, payload, marks in _lines(self.path):
            if index >= len(shards) or seen[index] or not _has(payload, self.fields, shards[index]):
                continue
            if all(self._is_there(*mark) for mark in marks):
                seen[index] = True
                yield index, payload, marks

    def _is_there(self, name: str, end: int, tail: int) -> bool:
        try:
            with (self.path / name).open("rb", buffering=0) as file:
                size = os.fstat(file.fileno()).st_size
                whole = size == end or (size > end and name.endswith(GROWING))
                return whole and _tail(file.fileno(), end) == tail
        except (OSError, ValueError):
            return False

    def done(self) -> dict[int, Payload]:
        """Return the payloads of the finished shards by index."""
        return {index: payload for index, payload, _ in _lines(self.path)}

    def frames_done(self, shards: Sequence[Shard]) -> int:
        """Return how many frames the finished ones of ``shards`` hold."""
        return sum(shards[index].frames for index, _, _ in self.sound(shards))

    def remove(self) -> None:
        """Delete the journal, once the store itself says that it is complete."""
        remove_journal(self.folder)


def _current(folder: Path) -> tuple[str, str]:
    """Return the key of the journal at ``folder``, and the name of its run; both empty where there is none."""
    try:
        key, run = (folder / "key").read_bytes().decode().split("\n")
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return "", ""
    return key, run


def _lines(run: Path) -> Iterator[tuple[int, Payload, list[Mark]]]:
    for file in sorted(run.glob("*.jsonl")):
        with file.open("rb") as lines:
            whole = True
            while line := lines.readline(_LINE_BYTES):
                ended = line.endswith(b"\n")
                if whole and ended and (entry := _parsed(line)):
                    yield entry
                whole = ended


def _parsed(line: bytes) -> tuple[int, Payload, list[Mark]] | None:
    """Return what a line says; None where it is not as :meth:`Journal._line` made it."""
    checksum, _, text = line.rstrip(b"\n").partition(b" ")
    if checksum != b"%08x" % crc32c(text):
        return None
    try:
        index, payload, marks = json.loads(text)
        marks = [(str(name), int(end), int(tail)) for name, end, tail in marks]
    except (ValueError, TypeError, RecursionError):
        return None
    sane = type(index) is int and index >= 0 and isinstance(payload, dict) and all(end >= 0 for _, end, _ in marks)
    return (index, payload, marks) if sane else None


def _has(payload: Payload, fields: Fields, shard: Shard) -> bool:
    """Tell whether a payload holds numbers of the shapes that it should."""
    try:
        values = {name: np.asarray(payload[name]) for name in fields}
    except (KeyError, ValueError):
        return False
    shapes = {name: tuple(shard.frames if n is None else n for n in shape) for name, shape in fields.items()}
    return all(value.shape == shapes[name] and value.dtype.kind in "biuf" for name, value in values.items())


def _tail(handle: int, end: int) -> int:
    """Return the CRC-32C of the last bytes before ``end``."""
    count = min(end, _TAIL_BYTES)
    return crc32c(os.pread(handle, count, end - count))
