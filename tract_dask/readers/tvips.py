"""Movies of TVIPS cameras: a header for the series, a header for each frame, often split into several files."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingSourceError, SourceError
from ..settings.run import SourceSettings
from .blocks import BlockSource, checked_records, read_records
from .checks import Permit, checked_file, checked_shape, open_binary, truncated, untested, without_empty_end
from .source import FrameValues, SourceMetadata
from .times import timed_ticks
from .units import to_pm

_SERIES_BYTES = 256
_SERIES = np.dtype(
    [(name, "<i4") for name in ("size", "version", "nx", "ny", "bits", "x0", "y0", "x_bin", "y_bin", "pixel_nm")]
    + [(name, "<i4") for name in ("kilovolts", "magnification", "image_header")]
)
_STAMP = [("counter", "<u4"), ("seconds", "<u4"), ("milliseconds", "<u4")]
_VERSION_1 = np.dtype(_STAMP)
_VERSION_2 = np.dtype(
    [*_STAMP, ("table", "<u4"), ("faraday", "<f4"), ("magnification", "<u4"), ("mode", "<u4")]
    + [(name, "<f4") for name in ("x", "y", "z", "stage_tilt", "stage_tilt_beta")]
    + [("rotator", "<u4"), ("temperature", "<f4"), ("temperature_set", "<f4"), ("power", "<f4"), ("lens", "<f4")]
    + [(name, "<f4") for name in ("scan_x", "scan_y", "bias_set", "bias")]
)
_ALONG = {"stage_tilt": "deg", "stage_tilt_beta": "deg", "temperature": "degC", "temperature_set": "degC", "bias": "V"}
_MOST_HEADER_BYTES = 1 << 16
_DIFFRACTION = 2
_CAMERA_NM = 2000
"""Pixels this large are the camera's: an image with such pixels would be millimetres wide."""

_PART = re.compile(r"(.*)_(\d{3,})", re.DOTALL)


def open_tvips(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> BlockSource:
    """Open a movie with all of its files, ``NAME_000.tvips``, ``NAME_001.tvips`` and so on.

    Raises
    ------
    SourceError
        Where a file is a later part, is damaged or too short, or a part is missing.
    """
    series = _series(path)
    files = (path, *_later_parts(path, permit))
    sizes = [checked_file(file, None if file == path else permit).st_size for file in files]
    starts = tuple(np.cumsum([0, *sizes[:-1]]).tolist())
    counts, notes = _counts(files, sizes, series)
    checked_records(sum(counts), str(path))
    headers = _headers(files, counts, series)
    n_frames, n_y, n_x = checked_shape((len(headers), series.n_y, series.n_x), str(path))
    offsets = [start + part for start, part in zip(starts, _offsets(counts, series), strict=True)]
    known = _metadata(path, series, headers)
    return BlockSource(
        path=str(path),
        files=files,
        format=f"TVIPS {series.version}",
        shape=(n_frames, n_y, n_x),
        dtype=series.stored.newbyteorder("="),
        metadata=replace(known, notes=notes + known.notes),
        offsets=np.concatenate(offsets) + series.header_bytes,
        stored=series.stored,
        firsts=starts,
    )


def is_later_part(path: Path) -> bool:
    """Tell whether a file only belongs to the movie of the file ``_000`` beside it."""
    split = _PART.fullmatch(path.stem)
    return split is not None and int(split[2]) > 0 and os.path.lexists(_first_part(path, split))


def _first_part(path: Path, split: re.Match[str]) -> Path:
    return path.with_name(f"{split[1]}_{'0' * len(split[2])}{path.suffix}")


@dataclass(frozen=True)
class _Series:
    """What the header of the series says."""

    version: int
    n_y: int
    n_x: int
    stored: np.dtype[Any]
    binned: bool
    pixel_nm: int
    magnification: int
    header_bytes: int

    @property
    def stride(self) -> int:
        """Bytes of a frame with its header."""
        return self.header_bytes + self.n_y * self.n_x * self.stored.itemsize


def _series(path: Path) -> _Series:
    with open_binary(path) as file:
        data = file.read(_SERIES_BYTES)
    record = np.frombuffer(data.ljust(_SERIES_BYTES, b"\0"), _SERIES, 1)[0]
    header = dict(zip(_SERIES.names or (), record.tolist(), strict=True))
    if header["size"] != _SERIES_BYTES or header["version"] not in (1, 2):
        raise _not_a_series(path, header)
    if len(data) < _SERIES_BYTES:
        raise truncated(str(path), "in its header", _SERIES_BYTES, len(data))
    bytes_of_header = _VERSION_1.itemsize if header["version"] == 1 else header["image_header"]
    if header["bits"] not in (8, 16) or not _VERSION_1.itemsize <= bytes_of_header <= _MOST_HEADER_BYTES:
        raise SourceError(
            "the header of the series is impossible",
            str(path),
            f"8 or 16 bits a pixel, and headers of {_VERSION_1.itemsize} to {_MOST_HEADER_BYTES} bytes",
            f"{header['bits']} bits, {bytes_of_header} bytes",
            "Export the movie as TIFF with the camera's program",
        )
    checked_shape((header["ny"], header["nx"]), str(path))
    return _Series(
        header["version"],
        header["ny"],
        header["nx"],
        np.dtype(f"<u{header['bits'] // 8}"),
        max(header["x_bin"], header["y_bin"]) > 1,
        header["pixel_nm"],
        header["magnification"],
        bytes_of_header,
    )


def _not_a_series(path: Path, header: dict[str, int]) -> SourceError:
    split = _PART.fullmatch(path.stem)
    if split and int(split[2]):
        first = _first_part(path, split)
        return SourceError(
            "this file is a later part of a movie",
            str(path),
            f"the first part, {first.name}",
            f"part {int(split[2])}, without the header of the series",
            f"Open {first}",
        )
    return SourceError(
        "the header is not that of a TVIPS movie",
        str(path),
        f"its size {_SERIES_BYTES} and version 1 or 2",
        f"size {header['size']} and version {header['version']}",
        "Check the copy, or export the movie as TIFF with the camera's program",
    )


def _later_parts(path: Path, permit: Permit | None) -> tuple[Path, ...]:
    """Return the files that go on after ``_000``.

    Raises
    ------
    SourceError
        Where one in between is missing.
    """
    split = _PART.fullmatch(path.stem)
    if split is None or int(split[2]):
        return ()
    name = re.compile(rf"{re.escape(split[1])}_(\d{{3,}}){re.escape(path.suffix)}", re.DOTALL)
    named = (name.fullmatch(file.name) for file in path.parent.iterdir())
    there = {int(found[1]): path.with_name(found[0]) for found in named if found and int(found[1])}
    missing = next((number for number in range(1, max(there, default=0)) if number not in there), None)
    if missing is not None:
        raise MissingSourceError(
            "a part of the movie is missing",
            str(path.with_name(f"{split[1]}_{missing:0{len(split[2])}d}{path.suffix}")),
            f"all parts up to {there[max(there)].name}",
            "no such file",
            "Copy it, too; to read only the frames before it, move the later parts into another folder",
        )
    return tuple(without_empty_end([path, *(there[number] for number in sorted(there))], permit))[1:]


def _counts(files: tuple[Path, ...], sizes: list[int], series: _Series) -> tuple[list[int], tuple[str, ...]]:
    """Return how many whole frames each file holds, by its size, and notes on what is left over at the end.

    Raises
    ------
    SourceError
        Where a file ends within a frame although others follow, or there is no whole frame.
    """
    counts = []
    for k, (file, size) in enumerate(zip(files, sizes, strict=True)):
        head = 0 if k else _SERIES_BYTES
        count, rest = divmod(size - head, series.stride)
        if (rest and k < len(files) - 1) or (not count and not k):
            raise truncated(str(file), f"in frame {count} of this part", head + (count + 1) * series.stride, size)
        counts.append(count)
    note = (
        f"{files[-1].name}: {rest} bytes after its last whole frame are not read; the recording may have been cut short"
    )
    return counts, (note,) if rest else ()


def _offsets(counts: list[int], series: _Series) -> list[NDArray[np.int64]]:
    """Return for each file where its frames' headers begin."""
    return [
        (0 if k else _SERIES_BYTES) + series.stride * np.arange(count, dtype=np.int64) for k, count in enumerate(counts)
    ]


def _headers(files: tuple[Path, ...], counts: list[int], series: _Series) -> NDArray[Any]:
    """Return the headers of all frames, as far as their names are known."""
    full = _VERSION_1 if series.version == 1 else _VERSION_2
    fields = [(name, full[name]) for name in full.names or ()]
    known = [k for k in range(1, len(fields) + 1) if np.dtype(fields[:k]).itemsize <= series.header_bytes]
    layout = np.dtype(fields[: known[-1]])
    parts = zip(files, _offsets(counts, series), strict=True)
    return np.concatenate([read_records(file, offsets, layout) for file, offsets in parts])


def _metadata(path: Path, series: _Series, headers: NDArray[Any]) -> SourceMetadata:
    stamps = headers["seconds"].astype(np.int64) * 1000 + headers["milliseconds"]
    known = timed_ticks(stamps, 1000, path.name)
    names = headers.dtype.names or ()
    along = {name: FrameValues(headers[name].astype(np.float64), _ALONG[name]) for name in _ALONG if name in names}
    told = {name: found for name, found in along.items() if np.any(found.values)}
    modes = set(headers["mode"].tolist()) if "mode" in names else set()
    pixel, notes = _pixel_size(path, series, modes)
    if series.version == 1:
        notes += (untested("TVIPS 1", path.name),)
    notes += _jump(path, headers["counter"].astype(np.int64))
    return replace(
        known,
        pixel_size_pm=pixel,
        notes=notes + known.notes,
        along_frames={**known.along_frames, **told},
    )


def _jump(path: Path, counters: NDArray[np.int64]) -> tuple[str, ...]:
    """Return a note where the frames' own numbers do not count up one by one; none where they were not written."""
    wrong = np.flatnonzero(np.diff(counters) != 1)
    if not len(wrong) or not counters.any():
        return ()
    k = int(wrong[0])
    return (
        f"{path.name}: the camera's number of frame {k + 1} is {counters[k + 1]} after {counters[k]}; frames were lost,"
        " or the parts belong to different movies",
    )


def _pixel_size(path: Path, series: _Series, modes: set[int]) -> tuple[float | None, tuple[str, ...]]:
    """Return the pixel size in pm, where the movie is one of images; else a note."""
    if _DIFFRACTION in modes:
        mixed = " for some of its frames" * (len(modes) > 1)
        return None, (f"{path.name}: the microscope was in diffraction mode{mixed}, with pixels in 1/nm",)
    if series.pixel_nm < _CAMERA_NM:
        return to_pm(series.pixel_nm, "nm"), ()
    if series.binned or series.magnification <= 0:
        return None, (f"{path.name}: the header has the camera's pixel ({series.pixel_nm} nm), not that of the image",)
    return to_pm(series.pixel_nm / series.magnification, "nm"), ()
