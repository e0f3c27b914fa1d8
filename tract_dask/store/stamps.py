"""How a change of files is noticed without reading them: by their sizes and times."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import ChangedSourceError

_SIZE, _WRITTEN, _CHANGED = range(3)


@dataclass(frozen=True, eq=False)
class Stamps:
    """What the system said of some files at one time.

    Attributes
    ----------
    host
        The machine that was asked.
    values
        (files, 3) bytes, time of the last writing, and time of the last change of whatever kind, which nobody can set
        back; both in ns. An inode's number says no more, and some file systems change it for a file that they keep.
    """

    host: str
    values: NDArray[np.int64]

    @classmethod
    def of(cls, files: Sequence[Path]) -> Stamps:
        """Ask about files now.

        Raises
        ------
        OSError
            Where one cannot be looked at.
        """
        values = np.array([_stamp(file.stat()) for file in files], dtype=np.int64).reshape(-1, 3)
        return cls(socket.gethostname(), values)

    @property
    def total_bytes(self) -> int:
        """Bytes of all files."""
        return int(self.values[:, _SIZE].sum())

    @property
    def written(self) -> str:
        """A hash of sizes and times of writing, which stay where files are moved."""
        return sha256(self.values[:, : _WRITTEN + 1].tobytes()).hexdigest()

    @property
    def digest(self) -> str:
        """A hash of everything."""
        return sha256(self.values.tobytes()).hexdigest()

    def check(self, files: Sequence[Path], part: slice = slice(None)) -> None:
        """Check that files, or a part of them, are as they were.

        Another machine compares sizes and times of writing only: not all shared file systems give each the same time of
        the last change.

        Raises
        ------
        ChangedSourceError
            Naming the first that is not, and how it differs.
        """
        if len(files) != len(self.values):
            raise changed(str(files[0].parent), f"{len(self.values)} files", f"{len(files)} files")
        here = socket.gethostname() == self.host
        for file, expected in zip(files[part], self.values[part].tolist(), strict=True):
            try:
                if not _same(expected, _stamp(file.stat()), here=here) and not _same(
                    expected, found := _fresh(file), here=here
                ):
                    raise changed(str(file), *_described(expected, found))
            except FileNotFoundError as error:
                raise changed(str(file), "the file that was there", "none") from error


def _stamp(status: os.stat_result) -> tuple[int, int, int]:
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _fresh(file: Path) -> tuple[int, int, int]:
    """Ask about a file by opening it, which a network file system answers from the server and not from memory."""
    with file.open("rb") as opened:
        return _stamp(os.fstat(opened.fileno()))


def _same(one: Sequence[int], other: Sequence[int], *, here: bool) -> bool:
    count = _CHANGED + 1 if here else _CHANGED
    return tuple(one[:count]) == tuple(other[:count])


def _described(expected: Sequence[int], found: Sequence[int]) -> tuple[str, str]:
    """Return in words how two stamps differ."""
    if expected[_SIZE] != found[_SIZE]:
        return f"{expected[_SIZE]:,} bytes", f"{found[_SIZE]:,} bytes"
    which, verb = (_WRITTEN, "written") if expected[_WRITTEN] != found[_WRITTEN] else (_CHANGED, "changed or replaced")
    return f"a file last {verb} at {_time(expected[which])}", f"one last {verb} at {_time(found[which])}"


def _time(ns: int) -> str:
    return datetime.fromtimestamp(ns / 1e9, UTC).isoformat(timespec="milliseconds")


def changed(where: str, expected: str, got: str) -> ChangedSourceError:
    """Return the error for files that are not what they were."""
    return ChangedSourceError(
        "the movie has changed since the conversion began",
        where,
        expected,
        got,
        "Do not change it until it is converted, and run the same command again: the conversion starts again",
    )
