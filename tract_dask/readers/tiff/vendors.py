"""What microscopes' programs leave in tags of their own: MetaMorph's stacks, and the texts of FEI and Zeiss."""

from __future__ import annotations

import math
import re
import struct
from pathlib import Path

import numpy as np

from ..checks import open_binary
from ..source import SourceMetadata
from ..times import timed
from ..units import number, quantity, square_pixel, to_pm
from .pages import SEM_TEXTS, STK_ABOUT, STK_PLANES, Tags

_FEI = SEM_TEXTS[:2]
_X_SCALE, _Y_SCALE, _UNIT = 4, 5, 6
_MOST_ENTRIES = 1000


def of_stk(tags: Tags, path: Path) -> tuple[int, SourceMetadata]:
    """Return the number of planes of a MetaMorph stack, which follow each other, with their times and pixel size."""
    n_planes, place = tags[STK_PLANES]
    data = np.fromfile(path, "<u4", 6 * min(n_planes, path.stat().st_size // 24), offset=place)
    planes = data[: len(data) // 6 * 6].reshape(-1, 6).astype(np.float64)
    since = planes - planes[:1]
    stamps = since[:, 2] * 86400.0 + since[:, 3] / 1000.0  # days, and milliseconds of the day
    known = timed(stamps, path.name) if stamps.any() and len(planes) == n_planes else SourceMetadata()
    pixel, notes = _stk_pixel(tags, path)
    return n_planes, SourceMetadata(
        pixel, known.frame_time_s, notes=notes + known.notes, along_frames=known.along_frames
    )


def _stk_pixel(tags: Tags, path: Path) -> tuple[float | None, tuple[str, ...]]:
    """Return the pixel size: entries of a number and the place of a fraction, or of a text after its length."""
    count, place = tags.get(STK_ABOUT) or (0, 0)
    with open_binary(path) as file:
        file.seek(place)
        entries = dict(struct.iter_unpack("<2I", _whole(file.read(8 * min(count, _MOST_ENTRIES)), 8)))

        def at(name: int, n_bytes: int) -> bytes:
            file.seek(entries.get(name, 0))
            return file.read(n_bytes) if name in entries else b""

        fractions = [
            struct.unpack("<2I", data) if len(data := at(name, 8)) == 8 else (0, 0) for name in (_X_SCALE, _Y_SCALE)
        ]
        text = at(_UNIT, 68)
    unit = text[4 : 4 + min(64, int.from_bytes(text[:4], "little"))].decode("latin-1")
    x, y = (to_pm(top / bottom, unit) if bottom else None for top, bottom in fractions)
    return square_pixel(x, y)


def _whole(data: bytes, size: int) -> bytes:
    return data[: len(data) // size * size]


def of_sem(tags: Tags, n_rows: int, where: str) -> SourceMetadata | None:
    """Return the pixel size that FEI's or Zeiss's program wrote, and a note on a bar of text; None without its tag."""
    texts = {tag: tags[tag].decode("latin-1") for tag in SEM_TEXTS if isinstance(tags.get(tag), bytes)}
    fei = next((texts[tag] for tag in _FEI if tag in texts), None)
    if fei is not None:
        sizes = [to_pm(_entry(fei, f"Pixel{name}"), "m") for name in ("Width", "Height")]
        pixel, notes = square_pixel(*sizes)
        return SourceMetadata(pixel, notes=notes + _bar(n_rows, _entry(fei, "ResolutionY"), where))
    if not texts:
        return None
    found = re.search(r"(?:Image )?Pixel Size\s*=\s*([^\r\n]+)", next(iter(texts.values())))
    return SourceMetadata(to_pm(*quantity(found[1])) if found else None)


def _entry(text: str, name: str) -> float:
    found = re.search(rf"^{name}=([^\r\n]*)", text, re.MULTILINE)
    return number(found[1]) if found else math.nan


def _bar(n_rows: int, n_scanned: float, where: str) -> tuple[str, ...]:
    if not 0 < n_scanned < n_rows:
        return ()
    return (f"{where}: the last {n_rows - int(n_scanned)} of its {n_rows} rows are a bar of text, not the specimen",)
