"""Merlin detectors (Quantum Detectors): ``.mib`` files with a line of text before each frame, ``.hdr`` beside them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import MissingSourceError, SourceError
from ...settings.run import SourceSettings
from ..blocks import BlockSource, checked_records, read_records
from ..checks import Permit, checked_dtype, checked_file, checked_shape, lies_there, open_binary, truncated, untested
from ..source import SourceMetadata
from ..times import timed_ticks
from ..units import to_seconds
from .raw_pixels import RawLayout, RawSource

_LINE = re.compile(
    rb"MQ1,\s*(?P<number>\d{1,9}),\s*(?P<length>\d{1,6}),\s*(?P<chips>\d{1,3}),\s*(?P<x>\d{1,6}),\s*(?P<y>\d{1,6}),"
    rb"\s*(?P<kind>[UR]\d\d),\s*(?P<layout>[0-9NxXG]+),[^,]*,\s*(?P<time>[^,]*),\s*(?P<exposure>[^,]*),"
)
_EXACT = re.compile(rb"MQ1[A-Z],\s*(?P<time>[^,]+?)Z?,\s*(?P<exposure>\d{1,18})ns,\s*(?P<depth>\d{1,2})\b")
_PROCESSED = {"U08": "u1", "U16": ">u2", "U32": ">u4", "U64": ">u8"}
_LIKE_THE_FIRST = ("length", "chips", "x", "y", "kind", "layout")
_MOST_HEADER_BYTES = 1 << 14
_BATCH = 1000
"""So many headers are in memory at once."""

_MOMENT = re.compile(r"[12]\d{3}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(\.\d{1,9})?")
_FRAME_TIME = re.compile(r"(?:frame (?:time|period)|acquisition period)\s*\((\w+)\)", re.IGNORECASE)


def open_merlin(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> BlockSource:
    """Open a ``.mib`` file; an ``.hdr`` file opens the ``.mib`` beside it.

    Raises
    ------
    SourceError
        Where a header is damaged, the frames differ, or their kind is unknown.
    """
    if path.suffix.lower() == ".hdr":
        path = _frames_of(path)
        checked_file(path, permit)
    text = _text_beside(path, permit)
    first = _first(path, text)
    layout = _layout(path, first) if first.kind == "R64" else None
    stored = np.dtype(">u8" if layout else _PROCESSED[first.kind])
    n_bytes = layout.n_words * 8 if layout else first.n_y * first.n_x * stored.itemsize
    size, stride = path.stat().st_size, first.length + n_bytes
    count, rest = divmod(size, stride)
    n_frames, n_y, n_x = checked_shape(
        (max(1, count), *(layout.shape if layout else (first.n_y, first.n_x))), str(path)
    )
    if not count:
        raise truncated(str(path), "in its first frame", stride, size)
    checked_records(n_frames, str(path))
    starts = stride * np.arange(n_frames, dtype=np.int64)
    known = _metadata(path, first, text, starts, rest)
    source = BlockSource(
        path=str(path),
        files=(path,),
        format=f"Merlin {first.kind}",
        shape=(n_frames, n_y, n_x),
        dtype=checked_dtype(layout.dtype if layout else stored, str(path)),
        metadata=known,
        offsets=starts + first.length,
        stored=stored,
    )
    return RawSource(**vars(source), layout=layout) if layout else source


def headers_of_mibs(files: Iterable[Path]) -> set[Path]:
    """Return which files of a folder are the ``.hdr`` of a ``.mib`` beside them, which opens by itself."""
    headers = [file for file in files if file.suffix.lower() == ".hdr"]
    stems = {stem for name in (_names(headers[0]) if headers else ()) for stem in _header_stems(name)}
    return {header for header in headers if header.stem.lower() in stems}


def _header_stems(name: str) -> Iterator[str]:
    """Yield how the header of a ``.mib`` file may be named, without its suffix and in lower case.

    Examples
    --------
    >>> list(_header_stems("a_12.mib"))
    ['a_12', 'a_', 'a_1', 'a']
    """
    stem, dot, suffix = name.lower().rpartition(".")
    if suffix == "mib" and dot:
        bare = stem.rstrip("0123456789")
        yield stem
        yield from (stem[:length] for length in range(len(bare), len(stem)))
        yield bare.removesuffix("_")


def _mib_of(header: Path) -> list[Path]:
    """Return the ``.mib`` files of a header: that of the same name, or all whose names only add a number."""
    name = re.compile(rf"{re.escape(header.stem)}_?(\d*)\.mib", re.IGNORECASE | re.DOTALL)
    named = [(found[1], header.with_name(found[0])) for found in map(name.fullmatch, _names(header)) if found]
    return [file for number, file in named if not number] or sorted(file for _, file in named)


def _names(beside: Path) -> list[str]:
    return [file.name for file in beside.parent.iterdir()]


def _frames_of(header: Path) -> Path:
    found = _mib_of(header)
    if len(found) == 1:
        return found[0]
    if not found:
        raise MissingSourceError(
            "the frames of this header lie in a .mib file, which is not there",
            str(header),
            f"{header.stem}.mib in the same folder",
            "no such file",
            "Copy the .mib file, too",
        )
    raise SourceError(
        "several .mib files belong to this header",
        str(header),
        "one",
        ", ".join(file.name for file in found[:9]),
        f"Open them as one movie by a pattern, such as '{header.with_suffix('')}*.mib'",
    )


def _text_beside(path: Path, permit: Permit | None) -> dict[str, str]:
    """Return what the ``.hdr`` of a file says, line by line; nothing where there is none."""
    names = (path.with_suffix(end) for end in (".hdr", ".HDR"))
    header = next((file for file in names if lies_there(file, permit)), None)
    if header is None:
        return {}
    checked_file(header, permit)
    with open_binary(header) as file:
        lines = file.read(_MOST_HEADER_BYTES).decode("latin-1").splitlines()
    if not lines or not lines[0].startswith("HDR"):
        return {}
    split = (line.partition("\t") for line in lines[1:])
    return {name.rstrip(": "): value.strip() for name, _, value in split}


@dataclass(frozen=True)
class _Header:
    """What the line before the first frame says."""

    length: int
    n_chips: int
    n_y: int
    n_x: int
    kind: str
    layout: str
    depth: int


def _first(path: Path, text: dict[str, str]) -> _Header:
    """Return the first header, with the counter's depth from it or from the ``.hdr`` file."""
    with open_binary(path) as file:
        data = file.read(_MOST_HEADER_BYTES)
    line = _LINE.match(data)
    kind = line["kind"].decode() if line else ""
    if line is None or not line.end() <= int(line["length"]) <= _MOST_HEADER_BYTES or kind not in (*_PROCESSED, "R64"):
        raise SourceError(
            "the header is not that of a Merlin file",
            str(path),
            "MQ1, a number, the header's length, and a type U08, U16, U32 or R64",
            repr(data[:50].decode("latin-1")),
            "Check the copy; frames of other types can be saved processed as U16",
        )
    exact = _EXACT.search(data, 0, int(line["length"]))
    depth = exact["depth"].decode() if exact else text.get("Counter Depth (number)", "0")
    return _Header(
        int(line["length"]),
        int(line["chips"]),
        int(line["y"]),
        int(line["x"]),
        kind,
        line["layout"].decode(),
        int(depth) if depth.isdecimal() and len(depth) < 4 else 0,
    )


def _layout(path: Path, first: _Header) -> RawLayout:
    """Return how raw frames are stored; at 24 bits a header may count the columns of both halves.

    Raises
    ------
    SourceError
        Where it cannot be.
    """
    quad = first.n_chips == 4 and first.layout.lower().startswith("2x2")
    layout = RawLayout(first.depth, first.n_y, first.n_x, quad)
    layout.check(str(path))
    halved = replace(layout, n_x=first.n_x // 2)
    if first.depth != 24 or _goes_on(path, first.length + 8 * layout.n_words):
        return layout
    halved.check(str(path))
    return halved


def _goes_on(path: Path, end: int) -> bool:
    """Tell whether the first frame ends here: at the end of the file, or before another header."""
    if path.stat().st_size <= end:
        return path.stat().st_size == end
    with open_binary(path) as file:
        file.seek(end)
        return file.read(4) == b"MQ1,"


def _metadata(path: Path, first: _Header, text: dict[str, str], starts: NDArray[np.int64], rest: int) -> SourceMetadata:
    stamps, exposure_s = _stamps(path, first, starts)
    known = _timed(path, stamps)
    notes = (*_notes(path, first, text, len(starts), rest), *known.notes)
    frame_time = known.frame_time_s or _frame_time(text)
    if frame_time is None and exposure_s is not None:
        frame_time = exposure_s
        notes += (f"{path.name}: the frame time is the exposure of its first frame, {exposure_s:.6g} s",)
    return replace(known, frame_time_s=frame_time, notes=notes)


def _frame_time(text: dict[str, str]) -> float | None:
    """Return the frame time in seconds that the ``.hdr`` file states."""
    for name, value in text.items():
        found = _FRAME_TIME.fullmatch(name)
        if found and re.fullmatch(r"[0-9.eE+-]{1,30}", value):
            return _number(value, found[1])
    return None


def _number(value: str, unit: str) -> float | None:
    try:
        return to_seconds(float(value), unit)
    except ValueError:
        return None


def _notes(path: Path, first: _Header, text: dict[str, str], n_frames: int, rest: int) -> Iterator[str]:
    if first.kind == "R64":
        yield untested("raw Merlin frames", path.name)
        if "g" in first.layout.lower():
            yield f"{path.name}: the gap between the chips is not filled; positions across it are too close"
    said = text.get("Frames in Acquisition (Number)", "")
    if said.isdecimal() and len(said) < 12 and int(said) != n_frames:
        yield f"{path.name}: it holds {n_frames} frames, its .hdr file says {int(said)}; {n_frames} are read"
    if rest:
        yield f"{path.name}: {rest} bytes after its last whole frame are not read; the end may be missing"


def _stamps(path: Path, first: _Header, starts: NDArray[np.int64]) -> tuple[list[str], float | None]:
    """Return the time stamps of all frames as text, and the exposure of the first in seconds.

    Raises
    ------
    SourceError
        Where a frame has no header, or one that differs from the first.
    """
    stamps: list[str] = []
    exposure: float | None = None
    expected: tuple[bytes, ...] = ()
    for begin in range(0, len(starts), _BATCH):
        lines = read_records(path, starts[begin : begin + _BATCH], np.dtype(f"S{first.length}")).tolist()
        for k, data in enumerate(lines, begin):
            line, exact = _LINE.match(data), _EXACT.search(data)
            alike = line.group(*_LIKE_THE_FIRST) if line else ()
            expected = expected or alike
            if line is None or alike != expected:
                raise _differs(path, k, expected, data)
            stamps.append((exact or line)["time"].decode("latin-1"))
            if not k:
                exposure = _number((exact or line)["exposure"].decode("latin-1"), "ns" if exact else "s")
    return stamps, exposure


def _differs(path: Path, k: int, expected: tuple[bytes, ...], data: bytes) -> SourceError:
    return SourceError(
        f"the header of frame {k} differs from the first",
        str(path),
        ", ".join(part.decode("latin-1") for part in expected),
        repr(data[:50].decode("latin-1")),
        "The file is damaged, or two recordings were put together: make the copy again",
    )


def _timed(path: Path, stamps: list[str]) -> SourceMetadata:
    """Return times by stamps such as ``2019-09-18 11:15:08.157060`` or ``2019-09-18T10:15:08.157060199``."""
    try:
        times = np.array(list(map(_moment, stamps)), "datetime64[ns]").astype(np.int64)
    except ValueError as error:
        return SourceMetadata(notes=(f"{path.name}: the time stamps of its frames cannot be read: {error}",))
    return timed_ticks(times, 1_000_000_000, path.name)


def _moment(stamp: str) -> str:
    if not _MOMENT.fullmatch(stamp.strip()):
        raise ValueError(repr(stamp[:40]))
    return stamp.strip()
