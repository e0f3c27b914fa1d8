"""Units in every spelling."""

from __future__ import annotations

import pytest

from tract_dask.readers.units import number, odd_length, odd_time, quantity, to_pm, to_seconds

LENGTHS = {
    1.0: "pm PM picometer Picometres pm\0",
    100.0: "Å å A \u212b angstrom Angstroms Ångström \\u00C5 \\u00c5 \\u212B Ã… [Å] Å/px A/pixel"
    " A° Angstroem &Aring; &#197;",
    1e3: "nm NM nanometer nanometres nm. (nm) nm/px nm/pixel [nm/pix] nano-meter",
    1e6: "um µm μm micron Microns micrometer micrometres \\u00B5m \\u03BCm Âµm",
    1e9: "mm millimeter millimetres",
}
TIMES = {
    1e-9: "ns nanosecond nsec",
    1e-6: "us µs μs usec microsecond microseconds \\u00B5s \\u00b5sec",
    1e-3: "ms msec msecs millisecond milliseconds Millisec ms. ms/frame milli-seconds",
    1.0: "s S sec Sec. secs second seconds",
    60.0: "min mins minute minutes",
    3600.0: "h hr hrs hour hours",
    86400.0: "d day days",
}


@pytest.mark.parametrize(("size", "unit"), [(size, unit) for size, units in LENGTHS.items() for unit in units.split()])
def test_lengths(size: float, unit: str) -> None:
    value = 1e-6 if size > 1e6 else 1.0
    assert to_pm(value, unit) == pytest.approx(size * value)
    assert odd_length(unit, "a") == ()


def test_units_of_one_pixel_or_frame_in_words() -> None:
    assert to_pm(0.02, "nm per pixel") == 20.0
    assert to_seconds(2.0, "milli seconds per frame") == 0.002
    assert to_pm(0.02, "1/nm") is None
    assert to_seconds(25.0, "frames/s") is None


def test_metres() -> None:
    for unit in ("m", "M", "meter", "Metres"):
        assert to_pm(4e-11, unit) == 40.0
    assert to_pm(2e-9, "cm") == 20.0


@pytest.mark.parametrize(("size", "unit"), [(size, unit) for size, units in TIMES.items() for unit in units.split()])
def test_times(size: float, unit: str) -> None:
    assert to_seconds(2.0, unit) == pytest.approx(2 * size)
    assert odd_time(unit, "a") == ()


@pytest.mark.parametrize("unit", ["1/nm", "nm^-1", "mrad", "eV", "1/Å", "nm-1", "nm⁻¹", "deg", "ms", "s"])
def test_what_is_no_length_is_noted(unit: str) -> None:
    assert to_pm(1.0, unit) is None
    assert repr(unit) in odd_length(unit, "a.tif")[0]


@pytest.mark.parametrize("unit", ["", " ", "pixel", "Pixels", "px", "inch", "\0", "None"])
def test_units_that_say_nothing(unit: str) -> None:
    assert to_pm(1.0, unit) is None
    assert odd_length(unit, "a.tif") == ()


def test_numbers_with_units() -> None:
    assert quantity("0,05 nm") == (0.05, "nm")
    assert quantity("-1.5e-3 \u00b5m") == (-0.0015, "µm")
    assert number(b"1.5".decode()) == 1.5
    assert to_pm(float("nan"), "nm") is None
