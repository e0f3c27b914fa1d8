"""Many files, one movie: a folder or a glob, in the order of the numbers in their names."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..errors import SourceError
from .source import Frames, Source


@dataclass(frozen=True, kw_only=True, eq=False)
class SequenceSource(Source):
    """Files read one after the other; ``firsts`` holds each file's first frame and, last, the number of frames."""

    firsts: tuple[int, ...]
    inner: str
    open_file: Callable[[Path], Source]

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""
        return len(self.files) == self.shape[0]

    @property
    def inside(self) -> str:
        """The path of the frames inside each file; empty where the files are the movie."""
        return self.inner

    def files_of(self, start: int, stop: int) -> slice:
        """Return which of ``files`` hold frames ``start`` to ``stop`` (not included)."""
        if len(self.files) != len(self.firsts) - 1:  # some files are made of others
            return slice(None)
        first = int(np.searchsorted(self.firsts, start, side="right")) - 1
        return slice(first, int(np.searchsorted(self.firsts, stop, side="left")))

    def read(self, start: int, stop: int) -> Frames:
        """Return frames ``start`` to ``stop`` (not included) as a new array (frames, y, x)."""
        start, stop, _ = slice(start, stop).indices(self.shape[0])
        frames = np.empty((max(0, stop - start), *self.shape[1:]), self.dtype)
        number = int(np.searchsorted(self.firsts, start, side="right")) - 1
        while start < stop:
            first, until = self.firsts[number], min(stop, self.firsts[number + 1])
            part = self.open_file(self.files[number]).read(start - first, until - first)
            frames[start - stop + len(frames) : until - stop + len(frames)] = part
            start, number = until, number + 1
        return frames


def open_sequence(path: str, files: list[Path], open_file: Callable[[Path], Source]) -> SequenceSource:
    """Open files as one movie; ``open_file`` opens one of them. A gap in their numbers becomes a note.

    Raises
    ------
    SourceError
        Where there are no files, one is damaged, or one differs from the first in shape or type.
    """
    if not files:
        raise SourceError(
            "the movie has no frames", path, "at least one file to read", "none", "Check the folder or the pattern"
        )
    files = sorted(files, key=lambda file: natural_key(file.name))
    parts = [open_file(file) for file in files]
    for part in parts:
        if part.shape[1:] != parts[0].shape[1:] or part.dtype != parts[0].dtype:
            raise SourceError(
                "this file of the sequence differs from the first",
                part.path,
                f"{parts[0].shape[1]} x {parts[0].shape[2]} {parts[0].dtype}, as in {files[0].name}",
                f"{part.shape[1]} x {part.shape[2]} {part.dtype}",
                "Take it out of the folder, or choose the frames by a glob",
            )
    firsts = (0, *np.cumsum([part.shape[0] for part in parts]).tolist())
    metadata = parts[0].metadata
    return SequenceSource(
        path=path,
        files=tuple(files),
        format=f"sequence of {parts[0].format}",
        shape=(firsts[-1], *parts[0].shape[1:]),
        dtype=parts[0].dtype,
        metadata=replace(metadata, notes=metadata.notes + gaps([file.name for file in files])),
        firsts=firsts,
        inner=parts[0].inside,
        open_file=open_file,
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
    ('the sequence has a gap in its numbers: f_005.tif follows f_002.tif; the frames are taken as they are',)
    """
    if len({re.sub(r"\d+", "#", name) for name in names}) > 1:
        return ()
    fields = list(zip(*(map(int, re.findall(r"\d+", name)) for name in names), strict=True))
    varying = [field for field in fields if len(set(field)) > 1]
    if len(varying) != 1:
        return ()
    steps = [after - before for before, after in pairwise(varying[0])]
    usual = min(step for step in steps if step > 0)
    wide = [number for number, step in enumerate(steps) if step > usual]
    if not wide:
        return ()
    more = f" (and {len(wide) - 1} more)" if len(wide) > 1 else ""
    return (
        f"the sequence has a gap in its numbers: {names[wide[0] + 1]} follows {names[wide[0]]}{more};"
        " the frames are taken as they are",
    )
