"""What every reader checks and says: types, shapes, sizes, files; what libraries raise becomes an error of ours."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingSourceError, SourceError, TractError

Frames: TypeAlias = NDArray[Any]
"""An array (frames, y, x)."""

Permit: TypeAlias = Callable[[Path], object]
"""Called with the resolved path of every file before it is opened; raises to refuse it."""


def check_permitted(permit: Permit | None, files: Sequence[Path]) -> None:
    """Ask once more whether files may be opened: a link among them may lead elsewhere now."""
    if permit is None:
        return
    for file in files:
        permit(Path(os.path.realpath(file)))


def checked_dtype(dtype: np.dtype[Any], where: str) -> np.dtype[Any]:
    """Return the type in which pixels are read, in the machine's byte order.

    Types that few programs compute with are widened, exactly: float16 to float32, true and false to uint8.

    Raises
    ------
    SourceError
        Where a pixel is not one integer or floating-point number of at most 8 bytes, or one bit.
    """
    if dtype.kind not in "iufb" or dtype.itemsize > 8:
        kinds = {"c": "complex numbers", "V": "several values a pixel", "f": "extended precision"}
        got = f"{dtype} ({kinds[dtype.kind]})" if dtype.kind in kinds else str(dtype)
        raise SourceError(
            "the pixels cannot be used as intensities",
            where,
            "integers or floating-point numbers of 8 to 64 bits",
            got,
            "Convert the movie, for example to its modulus, and save it as uint16 or float32",
        )
    return np.dtype({"b1": "u1", "f2": "f4"}.get(dtype.str[1:], dtype)).newbyteorder("=")


def widened(frames: Frames, dtype: np.dtype[Any]) -> Frames:
    """Return frames as stored (any order of bytes and of axes) as an array of a type from :func:`checked_dtype`."""
    if frames.dtype.kind == "b":
        frames = frames.view(np.uint8) != 0  # what is not 0 is true, also where a byte is not 1
    return np.ascontiguousarray(frames, dtype)


def checked_shape(shape: tuple[int, ...], where: str) -> tuple[int, int, int]:
    """Return ``shape`` as (frames, y, x); one image is a movie of one frame.

    Raises
    ------
    SourceError
        Where there are no frames or another number of axes.
    """
    if len(shape) not in (2, 3):
        raise SourceError(
            "the data are not a movie",
            where,
            "axes (frames, y, x) or (y, x)",
            f"{len(shape)} axes of lengths {shape}",
            "Save one channel or one slice of it as an array with three axes",
        )
    n_frames, n_y, n_x = (1, *shape) if len(shape) == 2 else shape
    if min(n_frames, n_y, n_x) < 1:
        raise SourceError(
            "the movie has no frames", where, "at least one frame", f"shape {shape}", "Check how it was exported"
        )
    if n_frames > MOST_FRAMES:
        raise SourceError(
            "the number of frames is impossible",
            where,
            f"at most {MOST_FRAMES:,}",
            f"{n_frames:,}",
            "The header is damaged: make the copy or the export again",
        )
    return n_frames, n_y, n_x


DAMAGE = (OSError, ValueError, RuntimeError, LookupError, TypeError, ArithmeticError)
"""What libraries raise on damaged files."""

FRAME_BYTES, RATIO = 64 << 20, 1000
"""A frame may claim so many bytes, and so many times the bytes of its file, before it is believed to be damaged."""

MOST_FRAMES = 2**31 - 1
"""More are a damaged header."""

EXACT = 2**53


def checked_claim(n_bytes: int, size: int, where: str, what: str = "one frame") -> None:
    """Check what a compressed file says of its own size before so much memory is taken; ``size`` is the file's.

    Raises
    ------
    SourceError
        Where no compression makes so much of so little.
    """
    if n_bytes > FRAME_BYTES + RATIO * size:
        raise SourceError(
            f"{what} would be far larger than the file can hold",
            where,
            f"at most {FRAME_BYTES + RATIO * size:,} bytes from a file of {size:,}",
            f"{n_bytes:,} bytes",
            "The header is damaged: make the copy or the export again",
        )


def is_named(file: Path) -> bool:
    """Tell whether there is a file of this name, or a link, which is not followed: for what is named only."""
    return file.is_symlink() or file.is_file()


def lies_there(file: Path, permit: Permit | None) -> bool:
    """Tell whether a file of a name lies beside a movie and is not empty; a link is asked for before it is followed.

    What ``permit`` refuses is refused whether something lies there or not: nobody learns from links what there is.
    """
    if permit is not None and file.is_symlink():
        permit(Path(os.path.realpath(file)))
    return file.is_file() and file.stat().st_size > 0


def _is_empty(file: Path, permit: Permit | None) -> bool:
    """Tell whether a file has no bytes; a link is asked for before it is followed, as in :func:`lies_there`."""
    if permit is not None and file.is_symlink():
        permit(Path(os.path.realpath(file)))
    return file.is_file() and file.stat().st_size == 0


def without_empty_end(parts: Sequence[Path], permit: Permit | None) -> Sequence[Path]:
    """Return the files of a movie without empty ones at the end: a camera may have opened a file for no more frames."""
    last = max((k for k, part in enumerate(parts) if not k or not _is_empty(part, permit)), default=-1)
    return parts[: last + 1]


def checked_file(path: Path, permit: Permit | None = None) -> os.stat_result:
    """Return the status of a file that may be opened, without opening it: to open a pipe would take forever.

    Raises
    ------
    SourceError
        Where it is not there, cannot be looked at, is not a file, or is empty.
    """
    if permit is not None:
        permit(Path(os.path.realpath(path)))
    with reading(str(path), "the file cannot be opened"):
        try:
            status = path.stat()
        except (FileNotFoundError, NotADirectoryError) as error:
            raise MissingSourceError(
                f"the link leads to {path.readlink()}, which is not there"
                if path.is_symlink()
                else "there is no such file",
                str(path),
                remedy="Check the path; on a cluster every worker must see it under the same name",
            ) from error
    kind = next((name for test, name in _KINDS.items() if test(status.st_mode)), None)
    if kind or not status.st_size:
        raise SourceError(
            "the file is empty" if kind is None else "this is not a file",
            str(path),
            "a file that holds a movie",
            kind or "no bytes",
            "Name the movie's file" if kind else "Check the copy: it may not have begun",
        )
    return status


_KINDS: dict[Callable[[int], bool], str] = {
    stat.S_ISDIR: "a folder",
    stat.S_ISFIFO: "a pipe",
    stat.S_ISSOCK: "a socket",
    stat.S_ISCHR: "a device",
    stat.S_ISBLK: "a device",
}


def open_binary(path: Path, buffering: int = -1) -> BinaryIO:
    """Open a file to be read; at once, also where something else has taken its place since it was looked at.

    Raises
    ------
    SourceError
        Where it is a pipe, a socket or a device: to wait for one could take forever.
    OSError
        As the system says.
    """
    file = open(path, "rb", buffering, opener=_without_waiting)  # noqa: SIM115 - pathlib has no opener
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        checked_file(path)
    return file


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)


@contextmanager
def reading(
    where: str, what: str = "the file cannot be read", remedy: str = "Make the copy or the export again"
) -> Iterator[None]:
    """Turn whatever goes wrong in this block into an error of ours: the border between libraries and the rest.

    Raises
    ------
    SourceError
        For what the system and the libraries say of a file; ours pass as they are.
    TractError
        Where there is not enough memory, which is not the file's fault.
    """
    try:
        yield
    except TractError:
        raise
    except OSError as error:
        raise unreadable(where, _plain(error), what, remedy) from _plain(error)
    except MemoryError as error:
        raise TractError(
            "memory ran out while the movie was read",
            where,
            got=words(error),
            remedy="Give each worker more memory, for example by fewer workers",
        ) from error
    except Exception as error:
        raise SourceError(what, where, got=words(error), remedy=remedy) from error


def words(error: BaseException) -> str:
    """Return what an error says, in one line that is not too long; its name where it says nothing."""
    text = " ".join(str(error).split())
    return text[:300] or type(error).__name__


def _plain(error: OSError) -> OSError:
    """Return the system's own error where HDF5 hides its number in a sentence."""
    found = re.search(r"errno = (\d+)", str(error)) if error.errno is None else None
    return OSError(int(found[1]), os.strerror(int(found[1]))) if found and int(found[1]) else error


_BUSY = (
    ("unable to lock file", "another program has locked the file", "Wait until it is written, or close it there"),
    (
        "already open for write",
        "another program is writing the file, or ended before it had written it",
        "Wait until it is written; if nothing writes it any more, run h5clear -s on a copy",
    ),
)
"""What HDF5 says of a file that is being written, and what we say."""


def unreadable(where: str, error: OSError, what: str, remedy: str) -> SourceError:
    """Return the error for what the system says of a file, or, with ``remedy``, what a library says of its content."""
    for sign, said, advice in _BUSY:
        if sign in str(error):
            return SourceError(said, where, got=words(error), remedy=advice)
    if error.errno is not None:
        remedy = "Check that it is there, its permissions, and its disk"
    return SourceError(what, where, got=error.strerror or words(error), remedy=remedy)


def unaccounted(where: str, n_bytes: int, frame_bytes: int, least: int = 1) -> tuple[str, ...]:
    """Return a note where a file holds bytes, ``least`` of them, that its header does not account for."""
    if n_bytes < least:
        return ()
    frames = f", as many as {n_bytes / frame_bytes:.3g} frames," if 0 < frame_bytes <= n_bytes else ""
    bytes_ = "1 byte" if n_bytes == 1 else f"{n_bytes:,} bytes"
    return (f"{where} holds {bytes_}{frames} that its header does not account for; they are not read",)


FILLING = 8192
"""In formats whose parts lie anywhere in a file, so many bytes between them may be filling."""


_HALVES = {(7420, 3838): "K2", (3838, 7420): "K2", (4092, 2880): "K3", (8184, 5760): "K3"}
"""Rows and columns of frames of whose columns there are half as many as the camera has."""


def maybe_packed(dtype: np.dtype[Any], shape: tuple[int, ...], where: str) -> tuple[str, ...]:
    """Return a note on bytes that by a frame's size (y, x) hold two pixels of 4 bits each, which no header says."""
    camera = _HALVES.get((shape[0], shape[1])) if dtype.itemsize == 1 else None
    if camera is None:
        return ()
    return (
        f"{where}: frames of {shape[0]} x {shape[1]} bytes may be those of a {camera} with two pixels of 4 bits in a"
        " byte; they are read as one pixel a byte",
    )


def untested(name: str, where: str) -> str:
    """Return the note for a format that was never tested with a camera's file."""
    return (
        f"{where}: this reader of {name} was not tested with a file from a camera; compare a frame with the vendor's"
        " program"
    )


def truncated(where: str, place: str, expected: int, got: int) -> SourceError:
    """Return the error for a file that ends too early; ``expected`` and ``got`` are in bytes."""
    return SourceError(
        f"the file ends {place}",
        where,
        f"at least {expected:,} bytes",
        f"{got:,} bytes",
        "The copy or export was cut short: make it again",
    )
