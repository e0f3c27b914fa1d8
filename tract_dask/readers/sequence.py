"""Many files, one movie: a folder or a pattern, in the order of the numbers in their names, or a list."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingSourceError, SourceError
from .checks import Frames
from .naming import gaps, notes_on
from .source import FrameValues, Source, SourceMetadata
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


def open_sequence(
    path: str,
    files: list[Path],
    open_file: Callable[[Path], Source],
    *,
    listed: bool = False,
    references: Mapping[str, Path] | None = None,
) -> SequenceSource:
    """Open files as one movie, in their order.

    What is odd about their names, or differs between them, becomes a note.

    Parameters
    ----------
    path
        What the user named.
    files
        The files.
    open_file
        Opens one of them.
    listed
        The user listed the files, so that their names matter less.
    references
        Files of the folder that are references of the detector, by what they are.

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
    lengths, behind, known = [first.shape[0]], dict.fromkeys(first.files), [first.metadata]
    for file in files[1:]:
        part = open_file(file)
        _check_alike(part, first.shape, first.dtype, files[0].name)
        lengths.append(part.shape[0])
        known.append(part.metadata)
        behind.update(dict.fromkeys(part.files))
    firsts = np.cumsum([0, *lengths])
    names = [file.name for file in files]
    notes = (gaps if listed else notes_on)(names) + _left_out(references or {})
    notes += _unlike(lengths, names) + _repeated(files)
    metadata = _joined(known, lengths, names)
    return SequenceSource(
        path=path,
        files=tuple(behind),
        format=f"sequence of {first.format}",
        shape=(int(firsts[-1]), *first.shape[1:]),
        dtype=first.dtype,
        metadata=replace(
            metadata, notes=metadata.notes + notes, references={**metadata.references, **(references or {})}
        ),
        parts=tuple(files),
        firsts=firsts,
        inside=first.inside,
        open_file=open_file,
    )


def _unlike(lengths: Sequence[int], names: Sequence[str]) -> tuple[str, ...]:
    """Return a note where files hold different numbers of frames; the last one may have fewer."""
    odd = next((k for k, n in enumerate(lengths) if n != lengths[0] and (k < len(lengths) - 1 or n > lengths[0])), None)
    if odd is None:
        return ()
    return (f"the files hold different numbers of frames: {names[0]} {lengths[0]}, {names[odd]} {lengths[odd]}",)


def _repeated(files: Sequence[Path]) -> tuple[str, ...]:
    """Return a note where a file is a link to another one of the sequence."""
    links = [file for file in files if file.is_symlink()]
    others = {str(file.resolve()): file.name for file in files if file not in links} if links else {}
    found = [(link.name, others[there]) for link in links if (there := str(link.resolve())) in others]
    if not found:
        return ()
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    return (f"{found[0][0]} is a link to {found[0][1]}{more}; both are read as frames",)


def _left_out(references: Mapping[str, Path]) -> tuple[str, ...]:
    if not references:
        return ()
    named = ", ".join(f"{file.name} ({kind})" for kind, file in references.items())
    return (f"by their names these files are references of the detector, not frames, and were left out: {named}",)


def _joined(known: Sequence[SourceMetadata], lengths: Sequence[int], names: Sequence[str]) -> SourceMetadata:
    """Return what the files say together: what the first one says, the times and values of all, and what differs."""
    if len(known) == 1:
        return known[0]
    first = known[0]
    times = _times(known, lengths, names[0])
    named = dict.fromkeys(name for part in known for name in part.along_frames if name != "time")
    along = {name: _values(name, known, lengths) for name in named}
    silent = [k for k, part in enumerate(known) if part.start_s is None]
    if 0 < len(silent) < len(known):
        note = f"{names[silent[0]]} does not say when it was taken, other files do; the times of frames are not known"
        times = replace(times, notes=(*times.notes, note))
    elif _say_time(known, lengths) and not times.along_frames:
        note = f"each file has the times of its frames, but not when it began: the times of {names[0]} on are not known"
        times = replace(times, notes=(*times.notes, note))
    return replace(
        first,
        frame_time_s=times.frame_time_s or first.frame_time_s,
        notes=_notes(known, names) + _changes(known, names) + times.notes,
        along_frames={**along, **times.along_frames},
        part=None,
    )


def _say_time(known: Sequence[SourceMetadata], lengths: Sequence[int]) -> bool:
    return any("time" in part.along_frames for part in known) and max(lengths) > 1


def _times(known: Sequence[SourceMetadata], lengths: Sequence[int], where: str) -> SourceMetadata:
    """Return the times of all frames where every file says when it began, and when its frames were taken after that."""
    stamps = []
    for part, length in zip(known, lengths, strict=True):
        within = part.along_frames.get("time")
        step = part.frame_time_s if length > 1 else 0.0
        if part.start_s is None or (within is None and step is None):
            return SourceMetadata()
        stamps.append(part.start_s + (within.values if within is not None else np.arange(length) * (step or 0.0)))
    every = np.concatenate(stamps)
    since = np.round(every - every[0], 6)  # what float64 keeps of seconds since 1970
    return timed(since, f"{where} and the files after it") if since.any() else SourceMetadata()


def _values(name: str, known: Sequence[SourceMetadata], lengths: Sequence[int]) -> FrameValues:
    """Return the values of all files' frames; NaN where a file lacks them in the first one's units."""
    units = next(part.along_frames[name].units for part in known if name in part.along_frames)
    parts = [part.along_frames.get(name) for part in known]
    return FrameValues(
        np.concatenate(
            [
                part.values if part is not None and part.units == units else np.full(length, np.nan)
                for part, length in zip(parts, lengths, strict=True)
            ]
        ),
        units,
    )


_MOST_NOTES = 8
"""So many notes of files are kept."""


def _notes(known: Sequence[SourceMetadata], names: Sequence[str]) -> tuple[str, ...]:
    """Return the notes of all files, each kind once, with the number of other files that it holds for, too."""
    kinds: dict[str, list[str]] = {}
    for part, name in zip(known, names, strict=True):
        for note in part.notes:
            kinds.setdefault(note.replace(name, "*"), []).append(note)
    shown = [
        f"{notes[0]} (and so of {len(notes) - 1} more files)" if len(notes) > 1 and "*" in kind else notes[0]
        for kind, notes in kinds.items()
    ]
    more = (f"and {len(shown) - _MOST_NOTES} more notes on single files",) if len(shown) > _MOST_NOTES else ()
    return (*shown[:_MOST_NOTES], *more)


def _changes(known: Sequence[SourceMetadata], names: Sequence[str]) -> tuple[str, ...]:
    """Return notes on calibrations that are not those of the first file."""
    notes = []
    for field, words, unit in (
        ("pixel_size_pm", "pixel size", "pm"),
        ("frame_time_s", "frame time", "s"),
        ("dose", "dose", "e/A^2"),
    ):
        values = [getattr(part, field) for part in known]
        others = [k for k, value in enumerate(values) if not _alike(value, values[0])]
        if others:
            here, there = (f"{value:.6g} {unit}" if value else "unknown" for value in (values[0], values[others[0]]))
            more = f" (and {len(others) - 1} more files)" if len(others) > 1 else ""
            notes.append(
                f"the {words} is {here} in {names[0]}, and {there} in {names[others[0]]}{more}; the first is used"
            )
    return tuple(notes)


def _alike(one: float | None, other: float | None) -> bool:
    return one is other or (one is not None and other is not None and math.isclose(one, other, rel_tol=0.001))


def _check_alike(part: Source, shape: tuple[int, int, int], dtype: np.dtype[Any], first: str) -> None:
    if part.shape[1:] != shape[1:] or part.dtype != dtype:
        raise SourceError(
            "this file of the sequence differs from the first",
            part.path,
            f"{shape[1]} x {shape[2]} {dtype}, as in {first}",
            f"{part.shape[1]} x {part.shape[2]} {part.dtype}",
            "Take it out of the folder, or choose the frames by a pattern",
        )
