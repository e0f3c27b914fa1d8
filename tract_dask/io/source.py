"""What a reader is: frames by number, and what the file says about them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..errors import SourceError

Frames: TypeAlias = NDArray[Any]
"""An array (frames, y, x)."""


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
    """

    pixel_size_pm: float | None = None
    frame_time_s: float | None = None
    dose: float | None = None
    gain: float = 1.0
    notes: tuple[str, ...] = ()


NOTHING_KNOWN = SourceMetadata()
"""The metadata of a file that says nothing."""


class FrameSource(Protocol):
    """A movie on disk, in any format. All checks were made when it was opened."""

    @property
    def path(self) -> str:
        """The path as the user gave it."""

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that hold the frames, in order."""

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

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""
        return False

    @property
    def inside(self) -> str:
        """The path of the frames inside their file; empty where the file is the movie."""
        return ""

    def files_of(self, start: int, stop: int) -> slice:
        """Return which of ``files`` hold frames ``start`` to ``stop`` (not included): all, where that is not known."""
        return slice(None)

    def read(self, start: int, stop: int) -> Frames:
        """Return frames ``start`` to ``stop`` (not included) as a new array (frames, y, x)."""
        raise NotImplementedError

    def read_into(self, start: int, frames: Frames) -> None:
        """Fill ``frames`` (frames, y, x), contiguous and of this movie's type, with those from ``start`` on."""
        frames[...] = self.read(start, start + len(frames))

    def close(self) -> None:
        """Do nothing: no file stays open."""


def checked_dtype(dtype: np.dtype[Any], where: str) -> np.dtype[Any]:
    """Return ``dtype`` in the machine's byte order.

    Raises
    ------
    SourceError
        Where a pixel is not one integer or floating-point number of at most 8 bytes.
    """
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        kinds = {"c": "complex numbers", "b": "true or false", "V": "several values a pixel"}
        got = f"{dtype} ({kinds[dtype.kind]})" if dtype.kind in kinds else str(dtype)
        raise SourceError(
            "the pixels cannot be used as intensities",
            where,
            "integers or floating-point numbers of 8 to 64 bits",
            got,
            "Convert the movie, for example to its modulus, and save it as uint16 or float32",
        )
    return dtype.newbyteorder("=")


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
    return n_frames, n_y, n_x


def unreadable(where: str, error: OSError, what: str = "the file cannot be read") -> SourceError:
    """Return the error for what the system, or a library on its behalf, says of a file."""
    reason = error.strerror or " ".join(str(error).split())
    return SourceError(what, where, got=reason, remedy="Check that it is there, its permissions, and its disk")


def truncated(where: str, place: str, expected: int, got: int) -> SourceError:
    """Return the error for a file that ends too early; ``expected`` and ``got`` are in bytes."""
    return SourceError(
        f"the file ends {place}",
        where,
        f"at least {expected:,} bytes",
        f"{got:,} bytes",
        "The copy or export was cut short: make it again",
    )
