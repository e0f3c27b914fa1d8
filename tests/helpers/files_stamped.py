"""Small movies of formats with a header or a time stamp for each frame, written as their cameras do."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

SER_TYPES = {"u1": 1, "u2": 2, "u4": 3, "i1": 4, "i2": 5, "i4": 6, "f4": 7, "f8": 8, "c8": 9, "c16": 10}


def write_ser(
    path: Path,
    frames: Sequence[NDArray[Any]],
    *,
    version: int = 0x0210,
    planned: int = 0,
    steps_m: Sequence[float] = (1e-11,),
    stamps: Sequence[int] = (),
    axes: Sequence[tuple[int, float, str, str]] = (),
    kind: int = 0x4122,
) -> Path:
    """Write a TIA series; rows are stored from the lowest one on, offsets of images that were never written are 0."""
    item = "I" if version == 0x0210 else "Q"
    total = planned or len(frames)
    head = struct.pack("<3H2I2i", 0x4949, 0x0197, version, kind, 0x4152, total, len(frames))
    described = b""
    for length, step, name, unit in axes or [(total, 1.0, "Number", "")]:
        described += struct.pack("<iddi", length, 0.0, step, 0)
        described += struct.pack("<i", len(name)) + name.encode() + struct.pack("<i", len(unit)) + unit.encode()
    table = len(head) + struct.calcsize(f"<{item}i") + len(described)
    head += struct.pack(f"<{item}i", table, len(axes) or 1) + described
    body, places, tags = b"", [0] * total, [0] * total
    first = table + 2 * total * struct.calcsize(item)
    for k, frame in enumerate(frames):
        places[k] = first + len(body)
        step = steps_m[min(k, len(steps_m) - 1)]
        number = SER_TYPES[frame.dtype.str[1:]]
        body += struct.pack("<ddiddi", 0.0, step, 0, 0.0, step, 0)
        body += struct.pack("<Hii", number, frame.shape[1], frame.shape[0])
        body += np.ascontiguousarray(frame[::-1], frame.dtype.newbyteorder("<")).tobytes()
        tags[k] = first + len(body)
        body += struct.pack("<HHI", 0x4152, 0, stamps[k] if stamps else 1_456_000_000 + 20 * k)
    path.write_bytes(head + struct.pack(f"<{2 * total}{item}", *places, *tags) + body)
    return path


def tvips_series(
    frames: NDArray[Any],
    version: int = 2,
    header: int = 84,
    pixel_nm: int = 3,
    magnification: int = 0,
    binning: int = 1,
) -> bytes:
    """Return the header of a TVIPS movie."""
    bits = 8 * frames.itemsize
    numbers = (
        256,
        version,
        frames.shape[2],
        frames.shape[1],
        bits,
        0,
        0,
        binning,
        binning,
        pixel_nm,
        300,
        magnification,
    )
    return struct.pack("<13i", *numbers, header if version == 2 else 0).ljust(256, b"\0")


def tvips_frame(
    frame: NDArray[Any],
    k: int,
    ms: int,
    *,
    version: int = 2,
    header: int = 84,
    mode: int = 1,
    values: Sequence[float] = (),
) -> bytes:
    """Return a frame with its header; ``values``: tilts, temperature measured and set, bias set and measured."""
    stamp = struct.pack("<3I", k, *divmod(ms, 1000))
    tilt, tilt_beta, measured, wanted, bias_set, bias = values or (0.0,) * 6
    rest = struct.pack("<IfII3f2f", 0, 1.5, 1000, mode, 0.0, 0.0, 0.0, tilt, tilt_beta)
    rest += struct.pack("<I4f2f2f", 0, measured, wanted, 0.0, 0.0, 0.0, 0.0, bias_set, bias)
    said = stamp if version == 1 else (stamp + rest).ljust(header, b"\0")[:header]
    return said + np.ascontiguousarray(frame, frame.dtype.newbyteorder("<")).tobytes()


def write_tvips(path: Path, frames: NDArray[Any], *, per_file: int = 0, step_ms: int = 40, **options: Any) -> Path:
    """Write a TVIPS movie; with ``per_file`` its parts are ``NAME_000.tvips``, ``NAME_001.tvips`` and so on."""
    of_series = {key: value for key, value in options.items() if key in ("pixel_nm", "magnification", "binning")}
    shared = {key: value for key, value in options.items() if key in ("version", "header")}
    of_frame = {key: value for key, value in options.items() if key not in of_series and key not in shared}
    stored = [
        tvips_frame(frame, k, 1_700_000_000_000 + step_ms * k, **shared, **of_frame) for k, frame in enumerate(frames)
    ]
    per_file = per_file or len(frames)
    for number, first in enumerate(range(0, len(frames), per_file)):
        head = b"" if number else tvips_series(frames, **of_series, **shared)
        place = path if per_file >= len(frames) else path.with_name(f"{path.stem}_{number:03d}.tvips")
        place.write_bytes(head + b"".join(stored[first : first + per_file]))
    return path if per_file >= len(frames) else path.with_name(f"{path.stem}_000.tvips")


def write_seq(
    path: Path,
    frames: NDArray[Any],
    *,
    version: int = 5,
    stamps_us: Sequence[int] = (),
    said: int | None = None,
    bits: int = 0,
    compression: int = 0,
    image_format: int = 100,
    padding: int = 100,
) -> Path:
    """Write a StreamPix sequence."""
    n_bytes = frames[0].nbytes
    stride = n_bytes + 8 + padding
    head = struct.pack("<I", 0xFEED) + "Norpix seq".encode("utf-16-le").ljust(24, b"\0")
    head = (head + struct.pack("<2i", version, 1024)).ljust(548, b"\0")
    bits = bits or 8 * frames.itemsize
    count = len(frames) if said is None else said
    head += struct.pack("<9I", frames.shape[2], frames.shape[1], bits, bits, n_bytes, image_format, count, 0, stride)
    head = (head + struct.pack("<d", 25.0)).ljust(620, b"\0") + struct.pack("<I", compression)
    body = b""
    for k, frame in enumerate(frames):
        time = stamps_us[k] if stamps_us else 1_700_000_000_000_000 + 40_000 * k
        stamp = struct.pack("<IHH", time // 1_000_000, time // 1000 % 1000, time % 1000)
        body += (np.ascontiguousarray(frame, frame.dtype.newbyteorder("<")).tobytes() + stamp).ljust(stride, b"\0")[
            :stride
        ]
    path.write_bytes(head.ljust(8192 if version >= 5 else 1024, b"\0") + body)
    return path


def raw_words(frame: NDArray[Any], depth: int) -> bytes:
    """Return pixels (y, x) as Merlin's raw words: big-endian, the first pixel in the lowest bits."""
    if depth == 24:
        return raw_words(frame >> 12, 12) + raw_words(frame & 0xFFF, 12)
    width = {1: 1, 6: 8, 12: 16}[depth]
    values, n = frame.ravel().tolist(), 64 // width
    words = (sum(value << width * k for k, value in enumerate(values[i : i + n])) for i in range(0, len(values), n))
    return b"".join(struct.pack(">Q", word) for word in words)


def side_by_side(image: NDArray[Any]) -> NDArray[Any]:
    """Return the four chips of a quad as it sends them: lower right and lower left turned, upper right, upper left."""
    y, x = image.shape[0] // 2, image.shape[1] // 2
    return np.hstack([np.rot90(image[y:, x:], 2), np.rot90(image[y:, :x], 2), image[:y, x:], image[:y, :x]])


def write_mib(
    path: Path,
    frames: NDArray[Any],
    *,
    raw: int = 0,
    layout: str = "1x1",
    stamps_us: Sequence[int] = (),
    exact: bool = True,
    doubled: bool = False,
) -> Path:
    """Write a Merlin file: processed, or raw with a depth of 1, 6, 12 or 24 bits."""
    chips = 4 if layout.startswith("2x2") else 1
    length = 768 if chips == 4 else 384
    parts = []
    for k, image in enumerate(frames):
        frame = side_by_side(image) if raw and chips == 4 else image
        time = stamps_us[k] if stamps_us else 2500 * k
        moment = str(np.datetime64("2026-03-04T05:06:07.000000") + np.timedelta64(time, "us"))
        width = frame.shape[1] * (2 if doubled else 1)
        kind = "R64" if raw else f"U{8 * frame.itemsize:02d}"
        head = f"MQ1,{k + 1:06d},{length:05d},{chips:02d},{width:04d},{frame.shape[0]:04d},{kind},{layout:>6},0F,"
        head += f"{moment.replace('T', ' ')},0.002000,0,0,0,,"
        if exact:
            head += f"MQ1A,{moment}000Z,2000000ns,{raw or 12},"
        data = raw_words(frame, raw) if raw else frame.astype(frame.dtype.newbyteorder(">")).tobytes()
        parts.append(head.encode().ljust(length, b"\0") + data)
    path.write_bytes(b"".join(parts))
    return path


def write_hdr(path: Path, n_frames: int, depth: int = 12, more: str = "") -> Path:
    """Write the text file beside a Merlin file."""
    lines = f"HDR,\t\nCounter Depth (number):\t{depth}\nFrames in Acquisition (Number):\t{n_frames}\n{more}End\t   "
    path.write_text(lines)
    return path
