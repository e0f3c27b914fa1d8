"""Direct Electron's _info.txt, which its server writes beside each acquisition."""

from __future__ import annotations

from ..source import SourceMetadata
from ..units import number, square_pixel, to_pm, to_seconds


def parse(text: str, stem: str, n_frames: int, where: str) -> SourceMetadata:
    """Return what an _info.txt says of a movie.

    Parameters
    ----------
    text
        Its text: lines of a key, an equals sign and a value.
    stem
        The movie's name without its suffix: an acquisition has sums and virtual images, too.
    n_frames
        Frames of the movie.
    where
        Its name, for notes.
    """
    fields = fields_of(text)
    sizes = [_length(fields, f"Specimen Pixel Size {axis}") for axis in "XY"]
    pixel, notes = square_pixel(sizes[0], sizes[1])
    if n_frames < 2 and "movie" not in stem.lower():
        return SourceMetadata(pixel, notes=notes)
    written = number(fields.get("Autosave Movie Frames Written", fields.get("Autosave Raw Frames - Frames Written")))
    if written > 0 and written != n_frames:
        notes += (f"{where} says that {written:g} frames were written; the movie has {n_frames}",)
    if fields.get("Scan - Enable", "").lower() in ("enable", "on", "true"):
        notes += (f"{where}: the frames belong to the points of a scan ({_points(fields)}), not only to moments",)
    return SourceMetadata(pixel, _frame_time(fields), notes=notes)


def fields_of(text: str) -> dict[str, str]:
    """Return the keys and values of an _info.txt."""
    lines = (line.partition("=") for line in text.splitlines())
    return {key.strip(): value.strip() for key, equals, value in lines if equals}


def _points(fields: dict[str, str]) -> str:
    return f"{fields.get('Scan - Size Y', '?')} x {fields.get('Scan - Size X', '?')}"


def _length(fields: dict[str, str], name: str) -> float | None:
    """Return a size, whose unit is in brackets behind the key; the server writes -1 where it does not know it."""
    found = next((key for key in fields if key.startswith(f"{name} (")), "")
    return to_pm(number(fields.get(found)), found[len(name) :])


def _frame_time(fields: dict[str, str]) -> float | None:
    """Return the time of a frame of the movie, which may be a sum of several of the camera."""
    summed = number(fields.get("Autosave Movie Sum Count", fields.get("Autosave Raw Frames - Sum Count", "1")))
    count = summed if summed >= 1 else 1.0
    rate = number(fields.get("Frames Per Second"))
    one = to_seconds(number(fields.get("Frame Time (nanoseconds)")), "ns") or (
        to_seconds(1 / rate, "s") if rate > 0 else None
    )
    return None if one is None else float(f"{one * count:.9g}")
