"""The times of frames, from the stamps that cameras write."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..settings.run import is_step_of
from .source import FrameValues, SourceMetadata

_LOST = 1.5
"""A step so many times the usual one is a gap, in which frames were lost."""

SHOWN = "; the times of frames show it"
"""The end of the note on a gap, where the stamps are the times of the frames."""


def timed(stamps_s: ArrayLike, where: str) -> SourceMetadata:
    """Return times and frame time of frames by their time stamps; the frame time is the median step.

    Parameters
    ----------
    stamps_s
        (frames,) seconds since any moment.
    where
        The file, for notes.

    Returns
    -------
    SourceMetadata
        With ``time`` along the frames and ``frame_time_s``; a note where frames were lost. Of stamps that are not
        finite, or do not grow, there is only a note. ``start_s`` is the first stamp, also where it is the only one.

    Examples
    --------
    >>> timed([5.0, 5.5, 6.5, 7.0], "a.seq").frame_time_s
    0.5
    >>> timed([5.0, 5.5, 6.5, 7.0], "a.seq").notes
    ('a.seq: the time stamps have a gap of 1 s after frame 1, where a frame takes 0.5 s; the times of frames show it',)
    """
    stamps = np.asarray(stamps_s, np.float64)
    if not np.any(stamps):
        return SourceMetadata()  # a header that was left empty
    return _course(stamps, float(stamps[0]), where)


def has_stamps(known: SourceMetadata) -> bool:
    """Tell whether the time stamps are the times of the frames: not where the user gave another frame time."""
    stamps = known.along_frames.get("time")
    return stamps is not None and (len(stamps.values) < 2 or is_step_of(usual_step(stamps.values), known.frame_time_s))


def timed_ticks(ticks: NDArray[np.int64], per_second: int, where: str) -> SourceMetadata:
    """Return what :func:`timed` does, by stamps in whole parts of a second since 1970.

    Their differences are exact, where seconds in float64 would be good to a quarter of a microsecond.
    """
    if not ticks.any():
        return SourceMetadata()
    return _course((ticks - ticks[0]) / per_second, float(ticks[0]) / per_second, where)


def _course(stamps: NDArray[np.float64], start_s: float, where: str) -> SourceMetadata:
    if len(stamps) < 2:
        return SourceMetadata(start_s=start_s if np.isfinite(stamps).all() else None)
    since = np.round(stamps - stamps[0], 12)
    steps = np.diff(since)
    if not np.isfinite(since).all() or not (steps > 0).all():
        return SourceMetadata(notes=_unfit(steps, where))
    usual = usual_step(since)
    along = {"time": FrameValues(since, "s")}
    notes = _gaps(steps, usual, where)
    return SourceMetadata(frame_time_s=usual, notes=notes, start_s=start_s, along_frames=along)


def usual_step(times_s: NDArray[np.float64]) -> float:
    """Return the median step between the times of two frames or more, in s.

    Examples
    --------
    >>> usual_step(np.array([0, 0.04, 0.08, 0.2]))
    0.04
    """
    return float(f"{np.median(np.diff(times_s)):.9g}")


def agreed(known: SourceMetadata, where: str) -> SourceMetadata:
    """Return what is known of a movie with one frame time: the median step of its time stamps, where it has some.

    Where it has another frame time from a place that counts more, that is kept, without the stamps, and with a note.

    Examples
    --------
    >>> stamps = {"time": FrameValues(np.array([0, 0.0401, 0.0802]), "s")}
    >>> agreed(SourceMetadata(frame_time_s=0.04, along_frames=stamps), "a.mrc").frame_time_s
    0.0401
    >>> agreed(SourceMetadata(frame_time_s=0.02, along_frames=stamps), "a.mrc").notes
    ('a.mrc: its time stamps are 0.0401 s apart, its frame time is 0.02 s; the stamps are not used',)
    """
    times = known.along_frames.get("time")
    usual = usual_step(times.values) if times is not None and len(times.values) > 1 else None
    if usual is None or known.frame_time_s == usual:
        return known
    if known.frame_time_s is None or math.isclose(known.frame_time_s, usual, rel_tol=0.01):
        return replace(known, frame_time_s=usual)
    said = f"its time stamps are {usual:.6g} s apart, its frame time is {known.frame_time_s:.6g} s"
    along = {name: of for name, of in known.along_frames.items() if name != "time"}
    return replace(known, notes=(*known.notes, f"{where}: {said}; the stamps are not used"), along_frames=along)


def _unfit(steps: NDArray[np.float64], where: str) -> tuple[str, ...]:
    bad = int(np.argmax(~(steps > 0))) + 1
    return (f"{where}: the time stamps of its frames do not grow (first at frame {bad}); they are not used",)


def _gaps(steps: NDArray[np.float64], usual: float, where: str) -> tuple[str, ...]:
    wide = np.flatnonzero(steps > _LOST * usual)
    if not len(wide):
        return ()
    more = f" (and {len(wide) - 1} more)" if len(wide) > 1 else ""
    return (
        f"{where}: the time stamps have a gap of {steps[wide[0]]:.6g} s after frame {wide[0]}{more}, where a frame"
        f" takes {usual:.6g} s{SHOWN}",
    )
