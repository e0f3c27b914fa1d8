"""Many files, one movie: a folder or a pattern, in the order of the numbers in their names."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingSourceError, SourceError
from .source import Frames, FrameValues, Source, SourceMetadata
from .times import timed


@dataclass(frozen=True, kw_only=True, eq=False)
class SequenceSource(Source):
    """Files read one after the other.

    Attributes
    ----------
    parts
        The files in order; ``files`` also holds those behind them.
    firsts
        Each file's first frame and, last, the number of frames.
    open_file
        Opens one of them.
    """

    parts: tuple[Path, ...]
    firsts: NDArray[np.int64]
    open_file: Callable[[Path], Source]

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""
        return len(self.parts) == self.shape[0]

    def files_of(self, start: int, stop: int) -> slice:
        """Return which of ``files`` hold frames ``start`` to ``stop`` (not included): all, where files have others."""
        if len(self.files) != len(self.parts):
            return slice(None)
        first = int(np.searchsorted(self.firsts, start, side="right")) - 1
        return slice(first, int(np.searchsorted(self.firsts, stop, side="left")))

    def _read(self, start: int, stop: int) -> Frames:
        frames = np.empty((max(0, stop - start), *self.shape[1:]), self.dtype)
        number = int(np.searchsorted(self.firsts, start, side="right")) - 1
        while start < stop:
            first, until = int(self.firsts[number]), min(stop, int(self.firsts[number + 1]))
            source = self.open_file(self.parts[number])
            _check_alike(source, self.shape, self.dtype, str(self.parts[0]))
            frames[start - stop + len(frames) : until - stop + len(frames)] = source.read(start - first, until - first)
            start, number = until, number + 1
        return frames


def open_sequence(path: str, files: list[Path], open_file: Callable[[Path], Source]) -> SequenceSource:
    """Open files as one movie, in their order; ``open_file`` opens one of them. A gap in their numbers becomes a note.

    Raises
    ------
    SourceError
        Where there are no files, one is damaged, or one differs from the first in shape or type.
    """
    if not files:
        raise MissingSourceError(
            "the movie has no frames", path, "at least one file to read", "none", "Check the folder or the pattern"
        )
    first = open_file(files[0])
    parts, behind = [first], dict.fromkeys(first.files)
    for file in files[1:]:
        part = open_file(file)
        _check_alike(part, first.shape, first.dtype, files[0].name)
        parts.append(part)
        behind.update(dict.fromkeys(part.files))
    firsts = np.cumsum([0, *(part.shape[0] for part in parts)])
    metadata = _joined(parts, path)
    return SequenceSource(
        path=path,
        files=tuple(behind),
        format=f"sequence of {first.format}",
        shape=(int(firsts[-1]), *first.shape[1:]),
        dtype=first.dtype,
        metadata=replace(metadata, notes=metadata.notes + gaps([file.name for file in files])),
        parts=tuple(files),
        firsts=firsts,
        inside=first.inside,
        open_file=open_file,
    )


def _joined(parts: list[Source], where: str) -> SourceMetadata:
    """Return what the first file says, and along the frames what all of them say; times by their moments."""
    first = parts[0].metadata
    if len(parts) == 1:
        return first
    names = set.intersection(*(set(part.metadata.along_frames) for part in parts)) - {"time"}
    along = {
        name: FrameValues(
            np.concatenate([part.metadata.along_frames[name].values for part in parts]), first.along_frames[name].units
        )
        for name in sorted(names)
    }
    stamps = np.concatenate([_stamps(part) for part in parts])
    if not np.isfinite(stamps).all() or (stamps == stamps[0]).all():
        return replace(first, along_frames=along)
    times = timed(np.round(stamps - stamps[0], 6), where)
    return replace(
        first,
        frame_time_s=times.frame_time_s or first.frame_time_s,
        notes=first.notes + times.notes,
        along_frames=along | dict(times.along_frames),
    )


def _stamps(part: Source) -> NDArray[np.float64]:
    """Return the moments of a file's frames in seconds since 1970; NaN where the file does not say."""
    known = part.metadata
    began = np.nan if known.start_s is None else known.start_s
    if "time" in known.along_frames:
        return began + known.along_frames["time"].values
    step = np.nan if known.frame_time_s is None else known.frame_time_s
    return np.array([began + (number * step if number else 0.0) for number in range(part.shape[0])])


def _check_alike(part: Source, shape: tuple[int, int, int], dtype: np.dtype[Any], first: str) -> None:
    if part.shape[1:] != shape[1:] or part.dtype != dtype:
        raise SourceError(
            "this file of the sequence differs from the first",
            part.path,
            f"{shape[1]} x {shape[2]} {dtype}, as in {first}",
            f"{part.shape[1]} x {part.shape[2]} {part.dtype}",
            "Take it out of the folder, or choose the frames by a pattern",
        )


def natural_key(name: str) -> tuple[tuple[int, str], ...]:
    """Return a key that sorts names by their numbers.

    Examples
    --------
    >>> sorted(["frame_10.tif", "frame_2.tif"], key=natural_key)
    ['frame_2.tif', 'frame_10.tif']
    """
    return tuple((int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name))


def gaps(names: list[str]) -> tuple[str, ...]:
    """Return a note on the numbers that are missing from a sorted sequence of names; none where they do not count up.

    Examples
    --------
    >>> gaps(["f_001.tif", "f_002.tif", "f_005.tif"])
    ('the sequence has a gap in its numbers: f_005.tif follows f_002.tif; the frames are read without one for the gap',)
    """
    if len({re.sub(r"\d+", "#", name) for name in names}) > 1:
        return ()
    fields = list(zip(*(map(int, re.findall(r"\d+", name)) for name in names), strict=True))
    varying = [field for field in fields if len(set(field)) > 1]
    if len(varying) != 1:
        return ()
    steps = [after - before for before, after in pairwise(varying[0])]
    usual = min((step for step in steps if step > 0), default=0)
    wide = [number for number, step in enumerate(steps) if step > usual > 0]
    if not wide:
        return ()
    more = f" (and {len(wide) - 1} more)" if len(wide) > 1 else ""
    return (
        f"the sequence has a gap in its numbers: {names[wide[0] + 1]} follows {names[wide[0]]}{more};"
        " the frames are read without one for the gap",
    )
