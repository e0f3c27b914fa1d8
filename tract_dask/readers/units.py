"""Units as microscopes and programs spell them, to picometres and seconds."""

from __future__ import annotations

import math
import re
import unicodedata
from html import unescape

_PREFIXES = {"p": 1e-12, "n": 1e-9, "u": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1, "": 1.0}
_NAMED = {"pico": 1e-12, "nano": 1e-9, "micro": 1e-6, "milli": 1e-3, "centi": 1e-2, "deci": 1e-1, "": 1.0}

_PM = {f"{prefix}m": 1e12 * factor for prefix, factor in _PREFIXES.items()}
_PM |= {f"{prefix}{word}": 1e12 * factor for prefix, factor in _NAMED.items() for word in ("meter", "metre", "m")}
_PM |= {"fm": 1e-3, "femtometer": 1e-3, "femtometre": 1e-3, "km": 1e15, "micron": 1e6, "mkm": 1e6, "mu": 1e6}
_PM |= dict.fromkeys(
    ("a", "å", "a°", "ang", "angs", "angstrom", "angstroem", "angström", "ångström", "ångstrom", "aa"), 100.0
)

_SECONDS = {f"{prefix}{word}": factor for prefix, factor in _PREFIXES.items() for word in ("s", "sec", "second")}
_SECONDS |= {f"{prefix}{word}": factor for prefix, factor in _NAMED.items() for word in ("second", "sec", "s")}
_SECONDS |= {"fs": 1e-15, "femtosecond": 1e-15, "ks": 1e3} | dict.fromkeys(("min", "minute", "mn"), 60.0)
_SECONDS |= dict.fromkeys(("h", "hr", "hrs", "hour"), 3600.0) | dict.fromkeys(("d", "day"), 86400.0)

_UNKNOWN = frozenset(
    ("", "pixel", "px", "pix", "pixels", "inch", "inches", "in", "null", "none", "unknown", "undefined")
)
"""What programs write that know no size."""

_PLAUSIBLE_PM = (0.01, 1e7)
_PLAUSIBLE_S = (1e-12, 1e6)


def to_pm(value: float, unit: str) -> float | None:
    r"""Return a pixel size in picometres; None where the unit says nothing or the size is implausible.

    Inches are never meant: they come from programs that write a printer's resolution.

    Examples
    --------
    >>> to_pm(0.5, "nm"), to_pm(0.04, "Å"), to_pm(1 / 72, "inch"), to_pm(0.0, "nm")
    (500.0, 4.0, None, None)
    >>> to_pm(2, r"\u00C5"), to_pm(1e-10, "Meters"), to_pm(0.1, "1/nm"), to_pm(0.1, "nm/px")
    (200.0, 100.0, None, 100.0)
    """
    return _convert(value, unit, _PM, _PLAUSIBLE_PM)


def to_seconds(value: float, unit: str) -> float | None:
    """Return a time in seconds; None where the unit says nothing or the time is implausible.

    Examples
    --------
    >>> to_seconds(25, "ms"), to_seconds(0, "s"), to_seconds(25, "milliseconds")
    (0.025, None, 0.025)
    """
    return _convert(value, unit, _SECONDS, _PLAUSIBLE_S)


def odd_length(unit: str, where: str) -> tuple[str, ...]:
    """Return a note where a unit is there and is not one of length, so that the pixel size is not known.

    Examples
    --------
    >>> odd_length("1/nm", "a.tif")
    ("a.tif: the pixel size is in '1/nm', which is not a length; it is not used",)
    >>> odd_length("nm", "a.tif"), odd_length("pixel", "a.tif")
    ((), ())
    """
    return _odd(unit, _PM, f"{where}: the pixel size is in {unit.strip()!r}, which is not a length; it is not used")


def odd_time(unit: str, where: str) -> tuple[str, ...]:
    """Return a note where a unit is there and is not one of time, so that the frame time is not known."""
    return _odd(unit, _SECONDS, f"{where}: the frame time is in {unit.strip()!r}, which is not a time; it is not used")


def square_pixel(x_pm: float | None, y_pm: float | None) -> tuple[float | None, tuple[str, ...]]:
    """Return the pixel size, which is that along x, and a note where that along y differs by more than 1 %."""
    if x_pm is None or y_pm is None or math.isclose(x_pm, y_pm, rel_tol=0.01):
        return x_pm, ()
    return x_pm, (f"the pixels are not square (x {x_pm:.6g} pm, y {y_pm:.6g} pm); the size along x is used",)


def number(text: object) -> float:
    """Return the number that a header has as text, also with a comma for its point; NaN where it is none.

    Examples
    --------
    >>> number(" 0.05 "), number("0,05"), number("1,234.5"), number(None)
    (0.05, 0.05, nan, nan)
    """
    words = str(text).strip("\0 \t\r\n")
    if words.count(",") == 1 and "." not in words:
        words = words.replace(",", ".")
    try:
        return float(words)
    except ValueError:
        return math.nan


def quantity(text: str) -> tuple[float, str]:
    """Return a number and the unit that follows it; NaN and the text where it does not begin with a number.

    Examples
    --------
    >>> quantity("1.25 nm"), quantity("25ms"), quantity("nm")
    ((1.25, 'nm'), (25.0, 'ms'), (nan, 'nm'))
    """
    found = re.match(r"\s*([-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?)\s*(.*)", text)
    return (number(found[1]), found[2].strip()) if found else (math.nan, text.strip())


def _convert(value: float, unit: str, table: dict[str, float], plausible: tuple[float, float]) -> float | None:
    scale = _scale(unit, table)
    if scale is None or not math.isfinite(value):
        return None
    converted = float(f"{value * scale:.12g}")  # 0.04 Å is 4 pm, not 4.000000000000001
    return converted if plausible[0] <= converted <= plausible[1] else None


def _scale(unit: str, table: dict[str, float]) -> float | None:
    """Return what one of a unit is; units come in any case, in brackets, in the plural and with a full stop."""
    name = _SPLIT.sub(r"\1", _OF_ONE.sub("", _plain(unit)))
    singular = name.removesuffix("s") if len(name) > 3 else name
    return table.get(name, table.get(singular))


_OF_ONE = re.compile(r"\s*(?:/|\bper\b)\s*(?:px|pix|pixels?|frames?|images?)\.?$")
"""``nm/px`` and ``s per frame``: of one pixel, of one frame."""

_SPLIT = re.compile(r"^(pico|nano|micro|milli|centi|deci)[\s-]+")
"""``nano-meter`` in two words."""


def _plain(unit: str) -> str:
    """Return a unit in one spelling: Java's escapes and twice encoded letters are undone."""
    text = re.sub(r"\\u([0-9A-Fa-f]{4})", lambda found: chr(int(found[1], 16)), unescape(unit[:64]))
    for wrong in ("cp1252", "latin-1"):
        try:
            text = text.encode(wrong).decode("utf-8")
            break
        except UnicodeError:
            continue
    return unicodedata.normalize("NFKC", text).lower().strip("\0 \t\r\n.").strip("[](){}<>\"'")


def _odd(unit: str, table: dict[str, float], note: str) -> tuple[str, ...]:
    return () if _plain(unit) in _UNKNOWN or _scale(unit, table) is not None else (note,)
