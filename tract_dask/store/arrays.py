"""NumPy arrays on disk."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import StoreError
from . import disk
from .files import disk_errors
from .shard_files import CHECKSUM_BYTES, crc32c, unchecked


@contextmanager
def sole_parser() -> Iterator[None]:
    """Let no other thread of this process parse Python source in this block, nor compile with Numba.

    In CPython 3.11 (gh-106905) a thread that builds a syntax tree fails with "AST constructor recursion depth mismatch"
    where another one does so at the same time. Numba builds them under the lock that is held here; numpy builds one for
    the header of every .npy file that it reads.
    """
    from numba.core.compiler_lock import global_compiler_lock  # takes its time to import

    with global_compiler_lock:
        yield


def load_array(path: Path, mmap_mode: Literal["r"] | None = None) -> NDArray[Any]:
    """Return the array in a .npy file; safe where other threads of a worker read or compile."""
    with sole_parser():
        loaded: NDArray[Any] = np.load(path, mmap_mode=mmap_mode)
    return loaded


_HEAD_BYTES = 1 << 16
"""The head of a .npy file, at most."""


class DamagedArrayError(StoreError):
    """What a task left is damaged or gone: its shard is no longer done, and the same stage again makes it anew."""


def save_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array as .npy, and behind it a checksum of all: beside its place first, then synced and renamed."""
    pixels: Any = np.asarray(array, order="C")
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(pixels))
    checksum = crc32c(pixels, crc32c(head.getbuffer())).to_bytes(CHECKSUM_BYTES, "little")
    aside = disk.new_place(path.parent)
    with disk_errors(path):
        try:
            with aside.open("wb") as file:
                file.writelines((head.getbuffer(), pixels.reshape(-1).view(np.uint8), checksum))
            disk.place(aside, path)
        except BaseException:
            aside.unlink(missing_ok=True)
            raise


def load_saved(path: Path) -> NDArray[Any]:
    """Return what :func:`save_array` wrote.

    Raises
    ------
    DamagedArrayError
        Where it is missing, or damaged; it is then removed, so that no journal takes it for done.
    """
    try:
        with path.open("rb") as file:
            stored: Any = np.empty(os.fstat(file.fileno()).st_size, np.uint8)
            data = unchecked(memoryview(stored)[: file.readinto(stored)])
    except (FileNotFoundError, ValueError) as error:
        with suppress(OSError):
            path.unlink(missing_ok=True)
        raise DamagedArrayError(
            "what a task of this stage left is missing, or damaged",
            str(path),
            "an array with its checksum",
            str(error),
            "Run the same command again: it is made again",
        ) from error
    head = io.BytesIO(data[:_HEAD_BYTES])
    np.lib.format.read_magic(head)
    with sole_parser():
        shape, _, dtype = np.lib.format.read_array_header_1_0(head)
    array: NDArray[Any] = np.frombuffer(data, dtype, offset=head.tell()).reshape(shape)
    return array
