"""A part of a movie: some of its frames, a field of them, and pixels summed in squares."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import SettingsError, SourceError
from ..settings.run import MetadataSettings, SourceSettings
from .checks import EXACT, Frames
from .source import FrameValues, Part, Source, SourceMetadata
from .times import SHOWN, has_stamps, usual_step


@dataclass(frozen=True, kw_only=True, eq=False)
class SelectedSource(Source):
    """Frames ``start``, ``start + step`` and so on of a whole movie, cut to a field, binned.

    Attributes
    ----------
    whole
        The movie on disk.
    frames
        Which of its frames.
    field
        First row, row after the last, first column, column after the last; whole bins.
    bin_px
        Side of the squares whose pixels are summed.
    """

    whole: Source
    frames: range
    field: tuple[int, int, int, int]
    bin_px: int

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""
        return self.whole.one_by_one

    def files_of(self, start: int, stop: int) -> slice:
        """Return which of ``files`` hold frames ``start`` to ``stop`` (not included)."""
        chosen = self.frames[start:stop]
        return self.whole.files_of(chosen.start, chosen[-1] + 1) if chosen else slice(0, 0)

    def _read(self, start: int, stop: int) -> Frames:
        chosen = self.frames[start:stop]
        frames = np.empty((len(chosen), *self.shape[1:]), self.dtype)
        if chosen.step == 1 and not self.whole.one_by_one:
            frames[...] = self._part(self.whole.read(chosen.start, chosen.stop))
            return frames
        for k, number in enumerate(chosen):
            frames[k] = self._part(self.whole.read(number, number + 1))[0]
        return frames

    def _part(self, frames: Frames) -> Frames:
        top, bottom, left, right = self.field
        cut: Frames = frames[:, top:bottom, left:right]
        if self.bin_px == 1:
            return cut
        side, (n_frames, n_y, n_x) = self.bin_px, cut.shape
        squares = cut.reshape(n_frames, n_y // side, side, n_x // side, side)
        whole = self.dtype.kind in "iu" and self.dtype.itemsize < 8
        summed: Frames = squares.sum((2, 4), dtype=self.dtype if whole else np.float64)
        if self.dtype.kind in "iu" and not whole and np.abs(summed).max(initial=0) > EXACT:  # it would wrap
            raise SourceError(
                "the sums of the bins are whole numbers that float64 cannot tell apart",
                self.path,
                f"sums from -{EXACT:,} to {EXACT:,}",
                f"{float(np.abs(summed).max()):.6g}",
                "Use smaller bins, or save the movie as float64 or uint32",
            )
        return summed

    def close(self) -> None:
        """Release what the reader holds open."""
        self.whole.close()


def select(whole: Source, settings: SourceSettings) -> Source:
    """Return the part of a movie that the settings name; the movie itself where they name none.

    Raises
    ------
    SettingsError
        Where the part is empty, outside the movie, or cannot be understood.
    """
    if settings.frames is None and settings.roi is None and settings.bin == 1:
        return whole
    frames = _frames(settings.frames, whole)
    field = _field(settings.roi, settings.bin, whole)
    top, bottom, left, right = field
    return SelectedSource(
        path=whole.path,
        files=whole.files,
        format=whole.format,
        shape=(len(frames), (bottom - top) // settings.bin, (right - left) // settings.bin),
        dtype=_summed(whole.dtype, settings.bin),
        metadata=_metadata(whole.metadata, frames, field, settings, whole.shape),
        inside=whole.inside,
        listed=whole.listed,
        permit=whole.permit,
        whole=whole,
        frames=frames,
        field=field,
        bin_px=settings.bin,
    )


_SPAN = re.compile(r"\s*(-?\d*)\s*:\s*(-?\d*)\s*(?::\s*(\d*)\s*)?")


def span(text: str, length: int, setting: str) -> range:
    """Return what ``start:stop`` or ``start:stop:step`` names of ``length`` things, as slices do in Python.

    Raises
    ------
    SettingsError
        Where it cannot be understood, or names nothing.

    Examples
    --------
    >>> span("100:2000:2", 5000, "frames"), span("-10:", 50, "frames")
    (range(100, 2000, 2), range(40, 50))
    """
    found = _SPAN.fullmatch(text)
    step = int(found[3] or 1) if found else 0
    start, stop = (int(part) if part else None for part in found.groups()[:2]) if found else (None, None)
    chosen: range = range(length)[start:stop:step] if step else range(0)
    beyond = any(end is not None and not -length <= end <= length for end in (start, stop))
    if not chosen or beyond:
        raise SettingsError(
            "this part of the movie does not exist",
            f"setting {setting} (SourceSettings)",
            f"start:stop or start:stop:step within 0 to {length}, such as 0:{max(1, length // 2)}",
            repr(text),
        )
    return chosen


def frame_step(settings: SourceSettings) -> int:
    """Return how many frames of the whole movie one of the part's frames takes."""
    found = _SPAN.fullmatch(settings.frames or "")
    return int(found[3] or 1) if found else 1


def overridden(found: SourceMetadata, said: MetadataSettings, declared: SourceSettings) -> SourceMetadata:
    """Return what is known of the part that is read, with what the user says above what the source says.

    The user speaks of the pixels and frames of the source, whatever part of it is read. A note tells of time stamps
    that do not count because of it.
    """
    known = found
    if said.pixel_size_pm is not None:
        known = replace(known, pixel_size_pm=said.pixel_size_pm * declared.bin)
    if said.dose is not None:
        known = replace(known, dose=said.dose)
    if said.gain != MetadataSettings().gain:
        known = replace(known, gain=number_of(said.gain, known.gain))
    if said.offset != MetadataSettings().offset:
        known = replace(known, offset=number_of(said.offset, 0.0) * declared.bin**2)
    if said.frame_time_s is None:
        return known
    known = replace(known, frame_time_s=said.frame_time_s * frame_step(declared))
    return known if "time" not in known.along_frames or has_stamps(known) else _without_stamps(known)


def number_of(said: float | str, until_measured: float) -> float:
    """Return a setting that is a number; what stands for it until it is measured where it is ``auto``."""
    return until_measured if isinstance(said, str) else said


def _without_stamps(known: SourceMetadata) -> SourceMetadata:
    """Return what is known, with the note that the frame time of the user counts more than the time stamps."""
    step = usual_step(known.along_frames["time"].values)
    note = (
        f"the frames are {known.frame_time_s:.9g} s apart, as you say; their time stamps, usually {step:.9g} s apart, "
        "are not used, and gaps do not show in the times of frames. Leave the frame time out to use the time stamps"
    )
    notes = tuple(text.removesuffix(SHOWN) for text in known.notes if text != note)
    return replace(known, notes=(*notes, note))


def _frames(text: str | None, whole: Source) -> range:
    return span(text, whole.shape[0], "frames") if text else range(whole.shape[0])


def _field(text: str | None, side: int, whole: Source) -> tuple[int, int, int, int]:
    """Return the field in rows and columns, without those at its end that fill no bin."""
    rows, columns = (range(length) for length in whole.shape[1:])
    if text:
        parts = text.split(",")
        if len(parts) != 2 or text.count(":") != 2:
            raise SettingsError(
                "the field cannot be understood",
                "setting roi (SourceSettings)",
                "rows and columns as y0:y1,x0:x1, such as 0:512,256:768",
                repr(text),
            )
        rows, columns = (span(part, length, "roi") for part, length in zip(parts, whole.shape[1:], strict=True))
    if min(len(rows), len(columns)) < side:
        raise SettingsError(
            "the field is smaller than one bin",
            "setting bin (SourceSettings)",
            f"at most {min(len(rows), len(columns))} px",
            f"{side} px",
        )
    return (
        rows.start,
        rows.stop - len(rows) % side,
        columns.start,
        columns.stop - len(columns) % side,
    )


def _summed(dtype: np.dtype[Any], side: int) -> np.dtype[Any]:
    """Return the smallest type of the same kind that holds the sum of a bin exactly.

    Examples
    --------
    >>> _summed(np.dtype("u1"), 2), _summed(np.dtype("i2"), 4), _summed(np.dtype("f4"), 2)
    (dtype('uint16'), dtype('int32'), dtype('float32'))
    """
    if side == 1 or dtype.kind == "f":
        return dtype
    most = int(np.iinfo(dtype).max) * side**2
    sizes = [size for size in (1, 2, 4, 8) if most <= np.iinfo(f"{dtype.kind}{size}").max]
    return np.dtype(f"{dtype.kind}{sizes[0]}" if sizes else f"{dtype.kind}8")


def _metadata(
    known: SourceMetadata,
    frames: range,
    field: tuple[int, int, int, int],
    settings: SourceSettings,
    shape: tuple[int, int, int],
) -> SourceMetadata:
    """Return what is known of the part: counts stay counts, so gain and dose do; pixel size and times follow."""
    along = {
        name: FrameValues(of.values[frames.start : frames.stop : frames.step], of.units)
        for name, of in known.along_frames.items()
    }
    if "time" in along:
        times = along["time"]
        along["time"] = FrameValues(np.round(times.values - times.values[0], 12), times.units)
    pixel, seconds = known.pixel_size_pm, known.frame_time_s
    seconds = seconds and seconds * frames.step
    if has_stamps(known) and len(frames) > 1:  # steps vary, and frames may be lost
        seconds = usual_step(along["time"].values)
    return replace(
        known,
        pixel_size_pm=pixel and pixel * settings.bin,
        frame_time_s=seconds,
        notes=(*known.notes, *_said(frames, field, settings, shape)),
        along_frames=along,
        part=(known.part or Part()).of(Part(frames.start, frames.step, field[0], field[2], settings.bin)),
    )


def _said(
    frames: range, field: tuple[int, int, int, int], settings: SourceSettings, shape: tuple[int, int, int]
) -> tuple[str, ...]:
    """Return a sentence on what is read of the movie."""
    top, bottom, left, right = field
    parts = []
    if frames != range(shape[0]):
        every = f", every {frames.step} of them" if frames.step > 1 else ""
        parts.append(f"frames {frames.start} to {frames[-1]} of {shape[0]}{every}")
    if field != (0, shape[1], 0, shape[2]):
        parts.append(f"rows {top} to {bottom - 1} and columns {left} to {right - 1} of {shape[1]} x {shape[2]}")
    if settings.bin > 1:
        parts.append(f"sums of {settings.bin} x {settings.bin} pixels")
    return (f"a part of the movie is read: {'; '.join(parts)}",) if parts else ()
