"""What a reader is: frames by number, and what the file says about them."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeAlias

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


@dataclass(frozen=True, eq=False)
class FrameValues:
    """One number for each frame, as the headers of the frames have it.

    Attributes
    ----------
    values
        (frames,) float64; NaN where a frame does not say.
    units
        Such as ``s``, ``degC``, ``deg``, ``V``.
    """

    values: NDArray[np.float64]
    units: str


@dataclass(frozen=True)
class Part:
    """Which part of the frames on disk a movie is.

    Attributes
    ----------
    first_frame, frame_step
        Frame k of the part is frame ``first_frame + k * frame_step`` on disk.
    top, left
        Row and column, on disk, of the part's first pixel.
    bin_px
        Side of the squares whose pixels are summed.
    """

    first_frame: int = 0
    frame_step: int = 1
    top: int = 0
    left: int = 0
    bin_px: int = 1


@dataclass(frozen=True)
class SourceMetadata:
    """What is known about a movie beside its pixels; None where neither the file nor the user says.

    Attributes
    ----------
    pixel_size_pm
        Side of a pixel in picometres.
    frame_time_s
        Time from one frame to the next in seconds.
    dose
        Electron dose of one frame in e/A^2.
    gain
        Electron counts for one detector unit.
    notes
        Sentences that the user should read, such as one on a gap in a sequence.
    start_s
        When the first frame began, in seconds since 1970; for files that are parts of one movie.
    along_frames
        What each frame says of itself, by name: ``time`` (s, from the first frame on), ``temperature`` and others.
    part
        Which part of the movie is read; None: all of it.
    references
        Files of the detector that lie beside the movie, by what they are: ``dark``, ``gain``, ``defects``,
        ``metadata``.
    """

    pixel_size_pm: float | None = None
    frame_time_s: float | None = None
    dose: float | None = None
    gain: float = 1.0
    notes: tuple[str, ...] = ()
    start_s: float | None = None
    along_frames: Mapping[str, FrameValues] = field(default_factory=dict)
    part: Part | None = None
    references: Mapping[str, Path] = field(default_factory=dict)


NOTHING_KNOWN = SourceMetadata()
"""The metadata of a file that says nothing."""


class FrameSource(Protocol):
    """A movie on disk, in any format. All checks were made when it was opened."""

    @property
    def path(self) -> str:
        """The path as the user gave it."""

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that the frames come from, in order: also those behind the links of an HDF5 file."""

    @property
    def format(self) -> str:
        """The format's name, for people."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows and columns."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Pixel type, in the machine's byte order."""

    @property
    def metadata(self) -> SourceMetadata:
        """Pixel size and the like; the user's word counts more than the file's."""

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""

    @property
    def inside(self) -> str:
        """The path of the frames inside their file; empty where the file is the movie."""

    @property
    def listed(self) -> tuple[str, ...]:
        """The names of the list that the movie was opened by, of which ``path`` is the first; empty for one name."""

    @property
    def permit(self) -> Permit | None:
        """What was asked before its files were opened, and is to be asked wherever they are opened anew."""

    def files_of(self, start: int, stop: int) -> slice:
        """Return which of ``files`` hold frames ``start`` to ``stop`` (not included)."""

    def read(self, start: int, stop: int) -> Frames:
        """Return frames ``start`` to ``stop`` (not included) as a new array (frames, y, x)."""

    def read_into(self, start: int, frames: Frames) -> None:
        """Fill ``frames`` (frames, y, x), contiguous and of this movie's type, with those from ``start`` on."""

    def close(self) -> None:
        """Release what the reader holds open."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Source:
    """What every reader here has in common.

    Nothing stays open between reads, so a source pickles, and threads can share it.
    """

    path: str
    files: tuple[Path, ...]
    format: str
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    metadata: SourceMetadata
    inside: str = ""
    listed: tuple[str, ...] = ()
    permit: Permit | None = None

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""
        return False

    def files_of(self, start: int, stop: int) -> slice:
        """Return which of ``files`` hold frames ``start`` to ``stop`` (not included): all, where that is not known."""
        return slice(None)

    def read(self, start: int, stop: int) -> Frames:
        """Return frames ``start`` to ``stop`` (not included) as a new array (frames, y, x).

        Raises
        ------
        SourceError
            For whatever is wrong with the file.
        """
        start, stop, _ = slice(start, stop).indices(self.shape[0])
        with reading(self.path, f"the file cannot be read at frames {start} to {stop - 1}"):
            frames = self._read(start, stop)
        expected = (max(0, stop - start), *self.shape[1:])
        if frames.shape != expected:
            raise SourceError(
                "the file has changed since it was opened",
                self.path,
                f"{expected[0]} frames from frame {start} on, each {expected[1]} x {expected[2]}",
                " x ".join(map(str, frames.shape)),
                "Wait until it has been written, then begin again",
            )
        self._check_exact(start, frames)
        return frames

    def read_into(self, start: int, frames: Frames) -> None:
        """Fill ``frames`` (frames, y, x), contiguous and of this movie's type, with those from ``start`` on.

        Raises
        ------
        SourceError
            For whatever is wrong with the file.
        """
        frames[...] = self.read(start, start + len(frames))

    def _check_exact(self, start: int, frames: Frames) -> None:
        """Refuse whole numbers that sums and fits, which are done in float64, would round without a word."""
        if self.dtype.kind not in "iu" or self.dtype.itemsize < 8 or not frames.size:
            return
        low, high = int(frames.min()), int(frames.max())
        if max(-low, high) > _EXACT:
            raise SourceError(
                f"frames {start} to {start + len(frames) - 1} hold whole numbers that float64 cannot tell apart",
                self.path,
                f"values from -{_EXACT:,} to {_EXACT:,}",
                f"values from {low:,} to {high:,}",
                "Subtract an offset or divide by a factor, and save the movie as float64 or uint32",
            )

    def _read(self, start: int, stop: int) -> Frames:
        """Return frames as :meth:`read` does; what libraries raise becomes a SourceError there."""
        raise NotImplementedError

    def close(self) -> None:
        """Do nothing: no file stays open."""


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

_EXACT = 2**53


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


def unaccounted(where: str, n_bytes: int, frame_bytes: int, least: int | None = None) -> tuple[str, ...]:
    """Return a note where a file holds bytes, ``least`` or a frame of them, that its header does not account for."""
    if n_bytes < max(1, frame_bytes if least is None else least):
        return ()
    return (
        f"{where} holds {n_bytes:,} bytes, as many as {n_bytes / max(1, frame_bytes):.3g} frames, that its header does"
        " not account for; they are not read",
    )


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
