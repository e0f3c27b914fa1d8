"""SerialEM's .mdoc files: what each section of a stack, or all frames of a movie, were taken with."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from ..source import FrameValues, SourceMetadata
from ..times import timed
from ..units import number, square_pixel, to_pm, to_seconds

Fields = dict[str, str]
"""Keys and values of one section."""

_DATES = ("%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S", "%Y-%b-%d %H:%M:%S", "%Y-%m-%d %H:%M:%S")


def parse(text: str, n_frames: int, where: str) -> SourceMetadata:
    """Return what an .mdoc says of a movie.

    Parameters
    ----------
    text
        Its text.
    n_frames
        Frames of the movie: what is said of each is used only where the numbers agree.
    where
        Its name, for notes.
    """
    about, sections, frame_set = _sections(text)
    known = _of_all(about | (frame_set or next(iter(sections), {})), where)
    if frame_set is not None:
        known = _joined(known, _of_frame_set(about | frame_set, n_frames, where))
        return replace(known, references=_references(about | frame_set))
    if not sections:
        return known
    if len(sections) != n_frames:
        note = f"{where} describes {len(sections)} sections, the movie has {n_frames}; what it says of each is not used"
        return replace(known, notes=(*known.notes, note))
    return _joined(known, _of_sections(sections, where))


def _sections(text: str) -> tuple[Fields, list[Fields], Fields | None]:
    """Return what is said of the whole file, of each section in the order of the frames, and of a set of frames."""
    about: Fields = {}
    numbered: list[tuple[float, Fields]] = []
    frame_set: Fields | None = None
    now = about
    for line in text.splitlines():
        key, equals, value = (part.strip() for part in line.strip().strip("[]").partition("="))
        if not equals:
            continue
        if not line.lstrip().startswith("["):
            now[key] = value
        elif key in ("ZValue", "Image"):
            now = {}
            numbered.append((number(value) if key == "ZValue" else len(numbered), now))
        elif key == "FrameSet":
            now = frame_set = frame_set if frame_set is not None else {}
        else:
            now = {}  # a title, or a montage's pieces
    return about, [fields for _, fields in sorted(numbered, key=lambda section: section[0])], frame_set


def _joined(first: SourceMetadata, second: SourceMetadata) -> SourceMetadata:
    return replace(second, pixel_size_pm=first.pixel_size_pm, notes=first.notes + second.notes)


def _of_all(fields: Fields, where: str) -> SourceMetadata:
    """Return the pixel size (Å, or two of them), and a note on counts that are not those of the camera."""
    sizes = [to_pm(number(size), "Å") for size in fields.get("PixelSpacing", "").split()] or [None]
    pixel, notes = square_pixel(sizes[0], sizes[-1])
    if number(fields.get("DividedBy2", "0")) > 0:
        notes += (f"{where}: SerialEM divided the counts by 2; --gain takes that into account",)
    return SourceMetadata(pixel, notes=notes)


def _of_frame_set(fields: Fields, n_frames: int, where: str) -> SourceMetadata:
    """Return frame time and dose of a movie by its exposure, the number of its frames, and pairs of dose and number."""
    notes: tuple[str, ...] = ()
    seconds = None
    exposure, count = number(fields.get("ExposureTime")), number(fields.get("NumSubFrames"))
    if count > 0 and count != n_frames:
        notes += (f"{where} counts {count:g} frames, the movie has {n_frames}; its exposure time is not used",)
    elif exposure > 0:
        seconds = to_seconds(float(f"{exposure / n_frames:.9g}"), "s")
    dose, more = _dose(fields.get("FrameDosesAndNumber", ""), n_frames, where)
    return SourceMetadata(frame_time_s=seconds, dose=dose, notes=notes + more, start_s=_started(fields))


def _references(fields: Fields) -> dict[str, Path]:
    """Return the names of the detector's references; SerialEM names them where frames were saved without them."""
    names = {"gain": fields.get("GainReference", ""), "defects": fields.get("DefectFile", "")}
    return {kind: Path(re.split(r"[\\/]", name)[-1]) for kind, name in names.items() if name}


def _dose(text: str, n_frames: int, where: str) -> tuple[float | None, tuple[str, ...]]:
    """Return the dose of a frame in e/Å^2, from pairs of a dose and the number of frames that have it."""
    values = [number(word) for word in text.split()]
    pairs = list(zip(values[::2], values[1::2], strict=False))
    if not pairs or not all(0 < dose < math.inf and 0 < count < math.inf for dose, count in pairs):
        return None, ()
    total = sum(count for _, count in pairs)
    if total != n_frames:
        return None, (f"{where} has doses of {total:g} frames, the movie has {n_frames}; they are not used",)
    mean = float(f"{sum(dose * count for dose, count in pairs) / total:.9g}")
    if len({dose for dose, _ in pairs}) > 1:
        return mean, (f"{where}: the dose changes between frames; its mean, {mean:.4g} e/A^2, is used",)
    return mean, ()


def _of_sections(sections: list[Fields], where: str) -> SourceMetadata:
    """Return times and tilts of sections."""
    stamps = np.array([_seconds(section.get("DateTime", "")) for section in sections], np.float64)
    known = timed(np.round(stamps - stamps[0], 6), where)
    if not any("DateTime" in section for section in sections):
        known = SourceMetadata()
    tilts = np.array([number(section.get("TiltAngle")) for section in sections], np.float64)
    along = dict(known.along_frames)
    if np.isfinite(tilts).any():
        along["stage_tilt"] = FrameValues(tilts, "deg")
    doses = {number(section.get("ExposureDose")) for section in sections}
    dose = doses.pop() if len(doses) == 1 else math.nan
    return replace(known, along_frames=along, dose=dose if 0 < dose < math.inf else None, start_s=_started(sections[0]))


def _started(fields: Fields) -> float | None:
    seconds = _seconds(fields.get("DateTime", ""))
    return seconds if math.isfinite(seconds) else None


def _seconds(text: str) -> float:
    """Return a date as seconds; NaN where it is none. The months are English, whatever the machine speaks."""
    whole, _, fraction = re.sub(r"\s+", " ", text.strip()).partition(".")
    for form in _DATES:
        try:
            moment = datetime.strptime(whole, form).replace(tzinfo=UTC)
        except ValueError:
            continue
        return moment.timestamp() + (float(f"0.{fraction}") if fraction.isdecimal() else 0.0)
    return math.nan
