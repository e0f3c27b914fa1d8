"""What the attributes of an array say of its numbers, by the conventions of netCDF: without a sign, missing, scaled."""

from __future__ import annotations

import base64
import binascii
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .calibration import as_number
from .checks import Frames
from .source import Source

_FILLS = ("_FillValue", "missing_value")
STATED = ("_Unsigned", *_FILLS, "valid_range", "valid_min", "valid_max", "scale_factor", "add_offset")
"""The attributes that count here."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeantSource(Source):
    """A movie whose numbers are meant otherwise than they are stored.

    Attributes
    ----------
    stored
        The movie as it is stored; its pixels are of the same size.
    missing
        Numbers that stand for pixels without data, which are read as NaN.
    """

    stored: Source
    missing: tuple[float, ...] = ()

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""
        return self.stored.one_by_one

    def files_of(self, start: int, stop: int) -> slice:
        """Return which of ``files`` hold frames ``start`` to ``stop`` (not included)."""
        return self.stored.files_of(start, stop)

    def _read(self, start: int, stop: int) -> Frames:
        frames: Frames = self.stored.read(start, stop).view(self.dtype)
        for number in self.missing:
            frames[frames == self.dtype.type(number)] = np.nan
        return frames

    def close(self) -> None:
        """Release what the reader holds open."""
        self.stored.close()


def as_meant(source: Source, attributes: Mapping[str, Any], where: str) -> Source:
    """Return a movie with its numbers as the attributes of its array say, and notes on what they say.

    Numbers that lost their sign get it back, or lose it (``_Unsigned``). Pixels of a floating-point movie that carry no
    data (``_FillValue``, ``missing_value``) become NaN. What would need another type of pixels is only noted: missing
    pixels of whole numbers, limits of valid ones, and scaling.

    Parameters
    ----------
    attributes
        Those of :data:`STATED` that the array has.
    where
        The array, for notes.
    """
    dtype, notes = _sign(source.dtype, attributes.get("_Unsigned"), where)
    given = {name: as_value(attributes[name]) for name in _FILLS if name in attributes}
    names: dict[float, list[str]] = {}
    for name, value in given.items():
        if (number := _stored_as(value, source.dtype, dtype)) is not None:
            names.setdefault(number, []).append(name)
    for number, said in names.items():
        what = f"{where}: pixels of {number:.9g} are meant to carry no data ({', '.join(said)}); they are read as "
        notes += (what + ("missing" if dtype.kind == "f" else "that number"),)
    notes += _limits(attributes, where) + packing(attributes, where)
    missing = tuple(names) if dtype.kind == "f" else ()
    known = replace(source.metadata, notes=(*source.metadata.notes, *notes))
    if dtype == source.dtype and not missing:
        return replace(source, metadata=known) if notes else source
    return MeantSource(
        path=source.path,
        files=source.files,
        format=source.format,
        shape=source.shape,
        dtype=dtype,
        metadata=known,
        inside=source.inside,
        listed=source.listed,
        permit=source.permit,
        stored=source,
        missing=missing,
    )


def _sign(dtype: np.dtype[Any], unsigned: Any, where: str) -> tuple[np.dtype[Any], tuple[str, ...]]:
    """Return the type of whole numbers with or without a sign, as is meant; and a note."""
    if unsigned is None or dtype.kind not in "iu":
        return dtype, ()
    said = unsigned.item() if isinstance(unsigned, np.ndarray) and unsigned.size == 1 else unsigned
    said = (said.decode("latin-1") if isinstance(said, bytes) else str(said)).strip().lower()
    meant = {"true": "u", "1": "u", "false": "i", "0": "i"}.get(said)
    if meant is None:
        return dtype, (f"{where}: its attribute _Unsigned cannot be understood; it is not used",)
    if meant == dtype.kind:
        return dtype, ()
    sign = "without a sign" if meant == "u" else "with a sign"
    note = f"{where}: its numbers are meant {sign} (_Unsigned); they are read so"
    return np.dtype(f"{meant}{dtype.itemsize}"), (note,)


def as_value(value: Any) -> float:
    """Return the number of a fill value; in Zarr stores some are texts that hold the bytes of a float64. NaN: none."""
    number = as_number(value)
    if math.isnan(number) and isinstance(value, str) and len(value) == 12:
        try:
            (number,) = struct.unpack("<d", base64.b64decode(value, validate=True))
        except (binascii.Error, struct.error):
            return math.nan
    return number


def _stored_as(value: float, stored: np.dtype[Any], meant: np.dtype[Any]) -> float | None:
    """Return a fill value as a number of the movie; None where no pixel can have it, and for NaN."""
    if meant.kind == "f":
        with np.errstate(over="ignore"):
            return None if math.isnan(value) else float(meant.type(value))
    if not math.isfinite(value) or value != int(value):
        return None
    for dtype in (meant, stored):  # it may be written with the sign that the pixels have lost
        if np.iinfo(dtype).min <= value <= np.iinfo(dtype).max:
            return int(np.array([int(value)], dtype).view(meant)[0])
    return None


def _limits(attributes: Mapping[str, Any], where: str) -> tuple[str, ...]:
    """Return a note where only some numbers are valid."""
    said = attributes.get("valid_range")
    ends = [attributes.get(name, math.nan) for name in ("valid_min", "valid_max")]
    if isinstance(said, list) or (isinstance(said, np.ndarray) and said.ndim == 1):
        ends = [*said] if len(said) == 2 else ends
    low, high = (as_number(end) for end in ends)
    if math.isnan(low) and math.isnan(high):
        return ()
    within = " and ".join(
        text for text, end in ((f"from {low:.9g}", low), (f"up to {high:.9g}", high)) if not math.isnan(end)
    )
    return (f"{where}: only numbers {within} are meant to be valid (valid_range); all are read as they are stored",)


def packing(attributes: Mapping[str, Any], where: str) -> tuple[str, ...]:
    """Return a note where netCDF says that values are to be scaled: they are read as they are stored."""
    scale, offset = (as_number(attributes.get(name, math.nan)) for name in ("scale_factor", "add_offset"))
    factor, added = 1.0 if math.isnan(scale) else scale, 0.0 if math.isnan(offset) else offset
    if (factor, added) == (1.0, 0.0):
        return ()
    return (
        f"{where}: its values are meant to be multiplied by {factor:g} and {added:g} added (scale_factor, add_offset);"
        " they are read as they are stored",
    )
