"""Units as microscopes and programs spell them, to picometres and seconds."""

from __future__ import annotations

import math

_PM = {
    "pm": 1.0,
    "a": 100.0,
    "å": 100.0,
    "angstrom": 100.0,
    "ångström": 100.0,
    "nm": 1e3,
    "nanometer": 1e3,
    "nanometre": 1e3,
    "um": 1e6,
    "µm": 1e6,
    "μm": 1e6,
    "\\u00b5m": 1e6,
    "micron": 1e6,
    "micrometer": 1e6,
    "micrometre": 1e6,
    "mm": 1e9,
    "cm": 1e10,
    "m": 1e12,
}
_SECONDS = {"ns": 1e-9, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ms": 1e-3, "msec": 1e-3, "s": 1.0, "sec": 1.0}
_SECONDS |= {"second": 1.0, "min": 60.0, "minute": 60.0, "h": 3600.0, "hour": 3600.0}

_PLAUSIBLE_PM = (0.01, 1e7)
_PLAUSIBLE_S = (1e-12, 1e6)


def to_pm(value: float, unit: str) -> float | None:
    """Return a pixel size in picometres; None where the unit says nothing or the size is implausible.

    Inches are never meant: they come from programs that write a printer's resolution.

    Examples
    --------
    >>> to_pm(0.5, "nm"), to_pm(0.04, "Å"), to_pm(1 / 72, "inch"), to_pm(0.0, "nm")
    (500.0, 4.0, None, None)
    """
    return _convert(value, unit, _PM, _PLAUSIBLE_PM)


def to_seconds(value: float, unit: str) -> float | None:
    """Return a time in seconds; None where the unit says nothing or the time is implausible.

    Examples
    --------
    >>> to_seconds(25, "ms"), to_seconds(0, "s")
    (0.025, None)
    """
    return _convert(value, unit, _SECONDS, _PLAUSIBLE_S)


def square_pixel(x_pm: float | None, y_pm: float | None) -> tuple[float | None, tuple[str, ...]]:
    """Return the pixel size, which is that along x, and a note where that along y differs by more than 1 %."""
    if x_pm is None or y_pm is None or math.isclose(x_pm, y_pm, rel_tol=0.01):
        return x_pm, ()
    return x_pm, (f"the pixels are not square (x {x_pm:.6g} pm, y {y_pm:.6g} pm); the size along x is used",)


def _convert(value: float, unit: str, table: dict[str, float], plausible: tuple[float, float]) -> float | None:
    name = unit.strip("\0 \t\r\n").lower()
    scale = table.get(name) or table.get(name.removesuffix("s"))
    if scale is None or not math.isfinite(value):
        return None
    converted = float(f"{value * scale:.12g}")  # 0.04 Å is 4 pm, not 4.000000000000001
    return converted if plausible[0] <= converted <= plausible[1] else None
