"""The master files of DECTRIS detectors: data files that follow one another, times, and the mask of pixels."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..calibration import as_number
from ..checks import DAMAGE, untested
from ..source import SourceMetadata
from ..units import to_seconds
from .axes import single, text, within

_PART = re.compile(r"data_\d{6}")
_FILE = re.compile(r"(?P<stem>.+)_data_\d{6}\.h(df)?5", re.IGNORECASE)

_GROUP = "entry/data"


def parts_of(file: Any, group: Any) -> list[str]:
    """Return the names of the parts of a movie in a group of a master file, in order; nothing where it is no such."""
    if not isinstance(group, h5py.Group) or group.file != file or (group.name or "").strip("/") != _GROUP:
        return []
    names = sorted(name for name in group if _PART.fullmatch(name))
    return names if names and (_detector(file) is not None or len(names) == len(group)) else []


def is_part(path: Path) -> bool:
    """Tell whether a file belongs to a master file beside it: data, or a microscope's metadata."""
    found = _FILE.fullmatch(path.name)
    stem = found["stem"] if found else path.stem
    return any(os.path.lexists(path.parent / f"{stem}_master{suffix}") for suffix in (".h5", ".hdf5"))


def master_metadata(file: Any, names: list[str], n_frames: int, path: Path) -> SourceMetadata:
    """Return the frame time, and notes on the pixel mask and on frames that are missing.

    The pixel size of the file is that of the detector, not that of the specimen: it is not used.
    """
    notes = (*_gaps(names, path.name), untested("DECTRIS master files", path.name))
    try:
        detector = _detector(file)
        if detector is None:
            return SourceMetadata(notes=notes)
        return replace(_described(detector, n_frames, path), notes=notes + _described(detector, n_frames, path).notes)
    except DAMAGE as error:
        said = " ".join(str(error).split())
        return SourceMetadata(notes=(*notes, f"{path.name}: the detector's description cannot be read ({said})"))


def _described(detector: Any, n_frames: int, path: Path) -> SourceMetadata:
    seconds = _seconds(detector, "frame_time") or _seconds(detector, "count_time")
    notes, references = [], {}
    specific = within(detector, "detectorSpecific", h5py.Group)
    claimed = _number(specific, "nimages") * max(1.0, _number(specific, "ntrigger"))
    if claimed == claimed and claimed != n_frames:
        notes.append(f"{path.name}: the detector was to take {claimed:,.0f} frames, and {n_frames:,} are there")
    for holder in (detector, specific):
        mask = within(holder, "pixel_mask", h5py.Dataset)
        if mask is None or mask.ndim != 2 or mask.dtype.kind not in "iu" or mask.size > 1 << 26:
            continue
        if masked := int(np.count_nonzero(mask[()])):
            references["defects"] = Path(f"{path}::{mask.name}")
            notes.append(
                f"{path.name}: the detector masks {masked:,} pixels ({mask.name}), which hold no counts"
                " but, in most files, the largest value of their type"
            )
        break
    return SourceMetadata(frame_time_s=seconds, notes=tuple(notes), references=references)


def _detector(file: Any) -> Any:
    at = file
    for name in ("entry", "instrument", "detector"):
        at = within(at, name, h5py.Group)
    return at


def _seconds(detector: Any, name: str) -> float | None:
    item = within(detector, name, h5py.Dataset)
    unit = "" if item is None else text(single(item, "units"))
    return to_seconds(_number(detector, name), unit or "s")


def _number(group: Any, name: str) -> float:
    item = within(group, name, h5py.Dataset)
    return float("nan") if item is None or item.size != 1 else as_number(item[()])


def _gaps(names: list[str], where: str) -> tuple[str, ...]:
    numbers = [int(name[5:]) for name in names]
    lost = [before + 1 for before, after in pairwise([0, *numbers]) if after - before > 1 and before + numbers[0] > 0]
    if not lost:
        return ()
    return (f"{where}: part data_{lost[0]:06d} is missing; the frames are read without one for the gap",)
