"""What a reader is: frames by number, and what the file says about them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import SourceError
from .checks import EXACT, Frames, Permit, reading


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

    def of(self, inner: Part) -> Part:
        """Return which part of the movie on disk a part of this part is.

        Examples
        --------
        >>> Part(10, 2, top=8, left=4, bin_px=2).of(Part(3, 5, top=1, bin_px=4))
        Part(first_frame=16, frame_step=10, top=10, left=4, bin_px=8)
        """
        return Part(
            self.first_frame + self.frame_step * inner.first_frame,
            self.frame_step * inner.frame_step,
            self.top + self.bin_px * inner.top,
            self.left + self.bin_px * inner.left,
            self.bin_px * inner.bin_px,
        )


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
    offset
        Detector units of a pixel without electrons.
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
    offset: float = 0.0
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
        if max(-low, high) > EXACT:
            raise SourceError(
                f"frames {start} to {start + len(frames) - 1} hold whole numbers that float64 cannot tell apart",
                self.path,
                f"values from -{EXACT:,} to {EXACT:,}",
                f"values from {low:,} to {high:,}",
                "Subtract an offset or divide by a factor, and save the movie as float64 or uint32",
            )

    def _read(self, start: int, stop: int) -> Frames:
        """Return frames as :meth:`read` does; what libraries raise becomes a SourceError there."""
        raise NotImplementedError

    def close(self) -> None:
        """Do nothing: no file stays open."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FilledSource(Source):
    """A source that reads straight into the array that is to hold the frames."""

    def _read(self, start: int, stop: int) -> Frames:
        frames = np.empty((max(0, stop - start), *self.shape[1:]), self.dtype)
        self._fill(start, frames)
        return frames

    def read_into(self, start: int, frames: Frames) -> None:
        """Fill ``frames`` (frames, y, x), contiguous and of this movie's type, with those from ``start`` on."""
        with reading(self.path, f"the file cannot be read at frames {start} to {start + len(frames) - 1}"):
            self._fill(start, frames)
        self._check_exact(start, frames)

    def _fill(self, start: int, frames: Frames) -> None:
        """Fill ``frames`` as :meth:`read_into` does; what libraries raise becomes a SourceError there."""
        raise NotImplementedError
