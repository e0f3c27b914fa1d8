"""Movies of Gatan's in-situ cameras: a director image with frames beside it, and folders by hour, minute and second."""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ...errors import MissingSourceError, SourceError
from ...settings.run import SourceSettings
from ..blocks import open_block
from ..checks import Permit, checked_file, reading, untested, without_empty_end
from ..naming import in_order
from ..raw import open_raw
from ..sequence import open_sequence
from ..source import Source, SourceMetadata
from ..times import timed
from . import Document, image_of, open_image, read_document
from .calibration import calibration
from .image import Image
from .tags import number

SUFFIXES = (".dm3", ".dm4", ".dm5")
"""Of DigitalMicrograph's files."""

_DIRECTORS = (".dm4", ".dm5")
_LEVELS = ("hour", "minute", "second")
_SECONDS = {"hour": 3600.0, "minute": 60.0, "second": 1.0}


def open_gatan(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
    """Open a DM3, DM4 or DM5 file, the in-situ movie that it directs, or a folder that is such a movie.

    Raises
    ------
    SourceError
        Where a file is damaged or missing, the pixels are no intensities, or a folder holds several movies.
    """
    if path.is_dir():
        director = _director_in(path)
        if director is None:
            return _open_seconds(path, inner, settings, permit)
        checked_file(director, permit)
        return replace(open_gatan(director, inner, settings, permit), path=str(path))
    document = read_document(path, permit)
    image, notes = image_of(document, inner)
    has_parts = _has_parts(path)
    if inner or not (has_parts or _n_recorded(image)):
        return open_image(document, image, notes, settings, permit)
    parts = _parts(path, permit) if has_parts else ()
    n_frames, more = _count(document, image, parts, permit)
    if not n_frames:
        return open_image(document, image, notes + more, settings, permit)
    return _open_parts(document, image, parts, n_frames, notes + more)


def open_raw_or_movie(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
    """Open a raw file: as declared or, where nothing is declared, as the in-situ movie whose director lies beside it.

    Raises
    ------
    SettingsError
        Where shape or pixel type are not declared, and there is no director.
    SourceError
        Where the file's size does not fit.
    """
    director = director_of(path)
    if director is None or settings.raw_shape is not None or settings.raw_dtype is not None:
        return open_raw(path, inner, settings, permit)
    checked_file(director, permit)
    with reading(str(director)):
        source = open_gatan(director, "", settings, permit)
    return source if path in source.files else open_raw(path, inner, settings, permit)


def director_of(path: Path) -> Path | None:
    """Return the file that may direct a ``.raw`` file: of its name, beside it; None where there is none."""
    if path.suffix.lower() != ".raw":
        return None
    ends = (*_DIRECTORS, *(end.upper() for end in _DIRECTORS))
    return next((file for end in ends if os.path.lexists(file := path.with_suffix(end))), None)


def is_part(path: Path) -> bool:
    """Tell whether a raw file belongs to the director beside it."""
    return director_of(path) is not None


def is_movie(folder: Path) -> bool:
    """Tell whether a folder holds a director with its frames, or folders by hour, minute and second."""
    try:
        with os.scandir(folder) as found:
            names = {item.name for item in found}
    except OSError:
        return False  # who opens it is told why
    stems = {name[:-4] for name in names if name.lower().endswith(".raw")}
    directed = any(name[:-4] in stems for name in names if name.lower().endswith(_DIRECTORS))
    return directed or any(_level(name) and _may_be_folder(folder / name) for name in names)


def _may_be_folder(place: Path) -> bool:
    """Tell whether a path is a folder, or a link, which is followed only once it is permitted."""
    return place.is_symlink() or place.is_dir()


def _director_in(folder: Path) -> Path | None:
    """Return the director of the only movie in a folder; None where none has frames beside it."""
    files = sorted(
        file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and not file.name.startswith(".")
    )
    directors = {file.stem: file for file in reversed(files) if _has_parts(file)}
    others = [file.name for file in files if file.stem not in directors]
    if not directors:
        return None
    if len(directors) > 1 or others:
        names = sorted(file.name for file in directors.values()) + others
        raise SourceError(
            "the folder holds several movies or images",
            str(folder),
            "one director image with its .raw files",
            ", ".join(names[:20]),
            f"Name one of them, for example {folder / names[0]}",
        )
    return next(iter(directors.values()))


def _has_parts(director: Path) -> bool:
    """Tell whether frames lie beside a file, without a look at the whole folder, which may be large."""
    parts = (director.with_suffix(end) for end in (".raw", ".raw_1", ".RAW", ".RAW_1"))
    return director.suffix.lower() in _DIRECTORS and any(map(os.path.lexists, parts))


def _parts(director: Path, permit: Permit | None) -> tuple[Path, ...]:
    """Return the files that hold a movie's frames, in order.

    Raises
    ------
    SourceError
        Where one of them is missing.
    """
    pattern = re.compile(re.escape(director.stem) + r"\.(?i:raw)(?:_(\d{1,9}))?")
    with os.scandir(director.parent) as found:
        numbers = {int(match[1] or 0): item.name for item in found if (match := pattern.fullmatch(item.name))}
    for expected, got in enumerate(sorted(numbers)):
        if expected != got:
            missing = f"{director.stem}.raw" + (f"_{expected}" if expected else "")
            raise MissingSourceError(
                "a file of the movie's frames is missing",
                str(director),
                missing,
                f"{numbers[got]} without it",
                "Copy all files of the movie into one folder",
            )
    parts = [director.parent / numbers[k] for k in sorted(numbers)]
    return tuple(without_empty_end(parts, permit))


def _n_recorded(image: Image) -> float | None:
    """Return how many frames the tags of a director say were recorded; None where they do not say."""
    count = number(image.tags, "ImageTags", "In-situ", "Recorded", "# Frames")
    return count if count is not None and math.isfinite(count) and count > 0 else None


def _count(
    document: Document, image: Image, parts: tuple[Path, ...], permit: Permit | None
) -> tuple[int, tuple[str, ...]]:
    """Return how many frames the files beside a director hold, and notes; 0 where its own image is the movie."""
    name, recorded = document.path.name, _n_recorded(image)
    if not parts:
        return 0, (_ALONE.format(name, f"{recorded:.6g}", document.path.stem),) if len(image.axes) == 2 else ()
    if len(image.axes) != 2:
        return 0, (f"{name}: it holds frames itself; {parts[0].name} next to it is not read",)
    size = sum(checked_file(part, permit).st_size for part in parts)
    frame = image.n_pixels * document.stored(image).itemsize
    held, rest = divmod(size, max(1, frame))
    if recorded is None:
        if rest or held < 2:
            return 0, (f"{name}: {parts[0].name} next to it does not hold its frames, and is not read",)
        return held, (f"{name}: its tags do not say how many frames it has; {parts[0].name} holds {held}",)
    if held < recorded:
        raise _too_few(document, image, recorded, frame, size)
    if (held, rest) == (int(recorded), 0):
        return held, ()
    return held, (f"{name}: it was recorded with {recorded:.0f} frames; its files hold {held} and {rest:,} bytes",)


_ALONE = "{}: {} frames were recorded, but {}.raw is not next to it; only the image in this file is read"


def _too_few(document: Document, image: Image, recorded: float, frame: int, size: int) -> SourceError:
    lengths = ",".join(str(axis.size) for axis in reversed(image.axes))
    declared = f"--raw-shape 0,{lengths} --raw-dtype {document.stored(image)}"
    return SourceError(
        "the files of the movie hold fewer frames than were recorded",
        str(document.path),
        f"{recorded * frame:,.0f} bytes for {recorded:.0f} frames",
        f"{size:,} bytes, {size // max(1, frame)} whole frames",
        f"Copy all of its .raw files again; to read what is there, open the .raw file with {declared}",
    )


def _open_parts(
    document: Document, image: Image, parts: tuple[Path, ...], n_frames: int, notes: tuple[str, ...]
) -> Source:
    known = calibration(image)
    more = (untested("Gatan in-situ movies", document.path.name),)
    source = open_block(
        parts[0],
        name=f"Gatan in-situ {document.name}",
        shape=(n_frames, *(axis.size for axis in reversed(image.axes))),
        stored=document.stored(image),
        offset=0,
        metadata=replace(known, notes=tuple(dict.fromkeys((*more, *notes, *known.notes)))),
        parts=parts[1:],
    )
    return replace(source, path=str(document.path), files=(*parts, document.path))


def _level(name: str) -> str:
    """Return whether a folder is one of an hour, a minute or a second; empty for others."""
    match = re.fullmatch(r"(hour|minute|second)_\d{1,9}", name.lower())
    return match[1] if match else ""


def _below(folder: Path, began: float, level: int, permit: Permit | None) -> Iterator[tuple[float, Path]]:
    """Yield the files of the folders by hour, minute and second below a folder, with the second of each."""
    for item in folder.iterdir():
        kind = _level(item.name)
        if kind and permit is not None:
            permit(Path(os.path.realpath(item)))
        if kind and _LEVELS.index(kind) >= level and item.is_dir():
            start = began + _SECONDS[kind] * int(item.name.rsplit("_", 1)[1])
            yield from _below(item, start, _LEVELS.index(kind) + 1, permit)
        elif level == len(_LEVELS) and item.suffix.lower() in SUFFIXES and not item.name.startswith("."):
            yield began, item


def _open_seconds(folder: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
    """Open the frames in folders by hour, minute and second, in the order of time."""
    below = list(_below(folder, 0.0, 0, permit))
    rank = {name: number for number, name in enumerate(in_order([file.name for _, file in below]))}
    found = sorted(below, key=lambda item: (item[0], rank[item[1].name]))
    open_file = partial(_open_frame, inner=inner, settings=settings, permit=permit)
    source = open_sequence(str(folder), [file for _, file in found], open_file, listed=True)
    known = replace(source.metadata, notes=(untested("Gatan in-situ folders", str(folder)), *source.metadata.notes))
    source = replace(source, metadata=known)
    if "time" in known.along_frames or source.shape[0] != len(found):
        return source
    times = _times([second for second, _ in found], known.frame_time_s, str(folder))
    merged = replace(
        known,
        frame_time_s=times.frame_time_s or known.frame_time_s,
        notes=known.notes + times.notes,
        along_frames=dict(known.along_frames) | dict(times.along_frames),
    )
    return replace(source, metadata=merged)


def _open_frame(path: Path, *, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
    checked_file(path, permit)
    with reading(str(path)):
        document = read_document(path, permit)
        return open_image(document, *image_of(document, inner), settings, permit)


def _times(seconds: list[float], frame_time_s: float | None, where: str) -> SourceMetadata:
    """Return the times of frames by the second of each, and the frame time by the usual number in a second.

    ``frame_time_s`` is that of the files' tags, which counts more. Of seconds that follow one another and are full
    there are no times: each frame follows the last one by the frame time.
    """
    counts = Counter(seconds)
    inner = [counts[second] for second in sorted(counts)[1:-1]] or [counts[second] for second in sorted(counts)[:-1]]
    if not inner:
        return SourceMetadata()
    usual = float(np.median(inner))
    step = float(f"{1 / usual:.9g}") if frame_time_s is None else frame_time_s
    note = f"{where}: the frame time is one second by the {usual:g} frames in the folder of a second"
    notes = (note,) if frame_time_s is None else ()
    full = all(abs(count * step - 1) < _LOST for count in inner)
    if full and seconds[-1] - seconds[0] + 1 == len(counts):
        return SourceMetadata(frame_time_s=step, notes=notes)
    step, seen = min(step, 1 / max(counts.values())), Counter[float]()
    stamps = []
    for second in seconds:
        stamps.append(second + seen[second] * step)
        seen[second] += 1
    times = timed(stamps, where)
    return replace(times, notes=(*notes, *times.notes))


_LOST = 0.1
"""Where so much of a second has no frames, some were lost."""
