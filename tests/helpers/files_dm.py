"""Small DigitalMicrograph files: DM3 and DM4 of both byte orders, DM5, and in-situ movies."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

TYPES = {"i2": 1, "f4": 2, "c8": 3, "u1": 6, "i4": 7, "i1": 9, "u2": 10, "u4": 11, "f8": 12, "c16": 13, "b1": 14}
TYPES |= {"i8": 39, "u8": 40}
_NUMBERS = {"i2": 2, "i4": 3, "u2": 4, "u4": 5, "f4": 6, "f8": 7, "u1": 10, "i1": 9, "i8": 11, "u8": 12, "b1": 8}


class _Writer:
    """Writes tags; ``order`` is that of the values, the tags' own numbers are big-endian."""

    def __init__(self, version: int, order: str) -> None:
        self.wide, self.order = version == 4, order

    def word(self, *numbers: int) -> bytes:
        return struct.pack(f">{len(numbers)}{'Q' if self.wide else 'I'}", *numbers)

    def group(self, tags: dict[str, Any]) -> bytes:
        return b"\1\0" + self.word(len(tags)) + b"".join(self.tag(name, tags[name]) for name in tags)

    def tag(self, name: str, value: Any) -> bytes:
        label = b"" if name.startswith("[") else name.encode("latin-1")
        kind, body = (20, self.group(value)) if isinstance(value, dict) else (21, self.value(value))
        size = struct.pack(">Q", len(body)) if self.wide else b""
        return struct.pack(">BH", kind, len(label)) + label + size + body

    def value(self, value: Any) -> bytes:
        if isinstance(value, str):
            value = np.frombuffer(value.encode("utf-16-le"), "<u2")
        if isinstance(value, tuple):
            words = [15, 0, len(value), *(number for _ in value for number in (0, 7))]
            return self._said(words, struct.pack(f"{self.order}{len(value)}d", *value))
        if isinstance(value, np.ndarray):
            data = value.astype(value.dtype.newbyteorder(self.order)).tobytes()
            name = value.dtype.str[1:]
            if value.dtype.kind == "c":
                part = _NUMBERS[f"f{value.dtype.itemsize // 2}"]
                return self._said([20, 15, 0, 2, 0, part, 0, part, value.size], data)
            if value.dtype.names:
                return self._said([20, 15, 0, 4, 0, 10, 0, 10, 0, 10, 0, 10, value.size], data)
            return self._said([20, _NUMBERS[name], value.size], data)
        kind, sign = (8, "?") if isinstance(value, bool) else (5, "I") if isinstance(value, int) else (7, "d")
        return self._said([kind], struct.pack(self.order + sign, value))

    def _said(self, words: list[int], data: bytes) -> bytes:
        return b"%%%%" + self.word(len(words), *words) + data


def write_tags(path: Path, tags: dict[str, Any], version: int = 4, order: str = "<") -> Path:
    """Write a tree of tags as a DM3 or DM4 file."""
    writer = _Writer(version, order)
    body = writer.group(tags) + bytes(8)
    path.write_bytes(struct.pack(">I", version) + writer.word(len(body)) + struct.pack(">I", order == "<") + body)
    return path


def numbered(items: Sequence[Any]) -> dict[str, Any]:
    """Return entries without names."""
    return {f"[{k}]": item for k, item in enumerate(items)}


def image(
    frames: np.ndarray,
    calibrations: Sequence[tuple[float, str]] = (),
    tags: dict[str, Any] | None = None,
    brightness: tuple[float, float, str] = (0.0, 1.0, ""),
) -> dict[str, Any]:
    """Return the tags of an image; ``calibrations`` are scale and unit of x, y and so on."""
    axes = [*calibrations, *[(1.0, "")] * frames.ndim][: frames.ndim]
    data = {
        "Calibrations": {
            "Brightness": dict(zip(("Origin", "Scale", "Units"), brightness, strict=True)),
            "Dimension": numbered([{"Origin": 0.0, "Scale": scale, "Units": unit} for scale, unit in axes]),
        },
        "Data": frames.reshape(-1),
        "DataType": 23 if frames.dtype.names else TYPES[frames.dtype.str[1:]],
        "Dimensions": numbered([int(size) for size in reversed(frames.shape)]),
        "PixelDepth": frames.dtype.itemsize,
    }
    return {"ImageData": data, "ImageTags": tags or {}, "Name": "movie"}


def thumbnail(side: int = 8) -> dict[str, Any]:
    """Return the tags of a thumbnail."""
    return image(np.zeros((side, side), [(name, "u1") for name in "RGBA"]))


def document(*images: dict[str, Any]) -> dict[str, Any]:
    """Return the tags of a file with a thumbnail and images."""
    sources = numbered([{"ClassName": "ImageSource:Simple", "ImageRef": k + 1} for k in range(len(images))])
    return {
        "DocumentObjectList": numbered([{"ImageSource": k, "Rectangle": (0.0, 0.0, 1.0)} for k in range(len(images))]),
        "ImageList": numbered([thumbnail(), *images]),
        "ImageSourceList": sources,
        "Thumbnails": numbered([{"ImageIndex": 0, "SourceSize_Pixels": (8.0, 8.0)}]),
    }


def write_dm(
    path: Path,
    frames: np.ndarray,
    calibrations: Sequence[tuple[float, str]] = (),
    tags: dict[str, Any] | None = None,
    order: str = "<",
    **options: Any,
) -> Path:
    """Write an image or a stack with a thumbnail; the version is that of the suffix."""
    if path.suffix == ".dm5":
        return write_dm5(path, frames, calibrations, tags)
    return write_tags(path, document(image(frames, calibrations, tags, **options)), int(path.suffix[3]), order)


def write_dm5(
    path: Path, frames: np.ndarray, calibrations: Sequence[tuple[float, str]] = (), tags: dict[str, Any] | None = None
) -> Path:
    """Write an image or a stack as DM5."""
    shown = document(image(frames, calibrations, tags))
    data = shown["ImageList"]["[1]"]["ImageData"]
    del data["Data"], data["Dimensions"], data["DataType"], data["PixelDepth"]
    del shown["ImageList"]["[0]"]["ImageData"]["Data"]
    with h5py.File(path, "w") as file:
        _fill(file, shown)
        file["ImageList/[1]/ImageData/Data"] = frames
        file["ImageList/[0]/ImageData/Data"] = np.zeros((99, 99), "u4")
    return path


def _fill(group: Any, tags: dict[str, Any]) -> None:
    for name, value in tags.items():
        if isinstance(value, dict):
            _fill(group.create_group(name), value)
        else:
            group.attrs[name] = value


def in_situ(n_frames: int) -> dict[str, Any]:
    """Return the tags of a recording."""
    return {"In-situ": {"Recorded": {"# Frames": n_frames}}}


def write_director(path: Path, frames: np.ndarray, ends: Sequence[int] = (), n_frames: int | None = None) -> Path:
    """Write a director image (.dm4 or .dm5) and its frames; ``ends`` are the bytes at which a further file begins."""
    tags = in_situ(len(frames) if n_frames is None else n_frames) if n_frames != 0 else {}
    write_dm(path, frames.mean(axis=0).astype(frames.dtype), [(0.01, "nm"), (0.01, "nm")], tags)
    data = frames.astype(frames.dtype.newbyteorder("<")).tobytes()
    for number, (first, last) in enumerate(zip((0, *ends), (*ends, len(data)), strict=True)):
        path.with_suffix(f".raw_{number}" if number else ".raw").write_bytes(data[first:last])
    return path


def write_seconds(folder: Path, frames: np.ndarray, each: Sequence[int], tags: dict[str, Any] | None = None) -> Path:
    """Write frames into folders by hour, minute and second, from 59 minutes and 58 seconds on."""
    number = 0
    for second, count in enumerate(each, start=3598):
        hour, minute = divmod(second // 60, 60)
        name = f"Hour_{hour:02}/Minute_{minute:02}/Second_{second % 60:02}"
        place = folder / name
        place.mkdir(parents=True)
        for k in range(count):
            file = place / f"movie_{name.replace('/', '_')}_Frame_{k:04}.dm4"
            write_dm(file, frames[number], [(0.01, "nm"), (0.01, "nm")], tags)
            number += 1
    return folder
