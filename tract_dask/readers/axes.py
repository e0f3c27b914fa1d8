"""Which axis of an array is the frames, which y and which x: by the names and units that a file gives to its axes."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SourceError
from .checks import checked_shape
from .units import to_pm, to_seconds


@dataclass(frozen=True, eq=False)
class Axis:
    """What a file says of one axis of an array.

    Attributes
    ----------
    name, unit
        Empty where it does not say.
    scale
        Step from one place to the next, in ``unit``; NaN where it does not say.
    in_image
        Whether HyperSpy counts it to the image (its signal) or to the places where there is one; None: does not say.
    values
        The place of each element, where the file lists them all.
    """

    name: str = ""
    unit: str = ""
    scale: float = math.nan
    in_image: bool | None = None
    values: NDArray[np.float64] | None = None

    @property
    def kind(self) -> str:
        """What the name, else the unit, says: ``x``, ``y``, ``frame``, ``spectrum``, ``colour``, ``length`` or ""."""
        if plain_unit(self.unit).lower() in _ENERGIES:
            return "spectrum"
        name = re.sub(r"[^a-z0-9]+", "_", self.name.lower()).strip("_")
        known = next((kind for kind, names in _NAMES.items() if name in names), "")
        if known or not plain_unit(self.unit):
            return known
        if to_seconds(1.0, plain_unit(self.unit)):
            return "frame"
        return "length" if to_pm(1.0, plain_unit(self.unit)) else ""

    def __str__(self) -> str:
        return f"{self.name or 'without a name'}{f' ({self.unit})' if self.unit else ''}"


_UNIT_IN_NAME = re.compile(r"(.*\S)\s*[(\[]\s*([^()\[\]]+?)\s*[)\]]")


def spelled_out(axes: Sequence[Axis]) -> list[Axis]:
    """Return axes with the units that programs write into their names, where those are units that are known.

    Examples
    --------
    >>> [str(axis) for axis in spelled_out([Axis("Time (ms)"), Axis("Y [nm]"), Axis("x (left)")])]
    ['Time (ms)', 'Y (nm)', 'x (left)']
    """
    return [_spelled_out(axis) for axis in axes]


def _spelled_out(axis: Axis) -> Axis:
    found = None if axis.unit else _UNIT_IN_NAME.fullmatch(axis.name)
    unit = plain_unit(found[2]) if found else ""
    if not found or not (to_pm(1.0, unit) or to_seconds(1.0, unit) or unit.lower() in _ENERGIES):
        return axis
    return replace(axis, name=found[1], unit=found[2])


_ENERGIES = ("ev", "kev", "mev", "1/cm", "cm-1", "cm^-1")
_NAMES = {
    "x": (
        "x",
        "r_x",
        "rx",
        "q_x",
        "qx",
        "k_x",
        "kx",
        "pos_x",
        "x_axis",
        "x_pixel",
        "width",
        "column",
        "columns",
        "col",
    ),
    "y": ("y", "r_y", "ry", "q_y", "qy", "k_y", "ky", "pos_y", "y_axis", "y_pixel", "height", "row", "rows", "line"),
    "frame": (
        *(
            "t",
            "time",
            "times",
            "frame",
            "frames",
            "frame_number",
            "frame_numbers",
            "frame_index",
            "frame_nr",
            "frame_id",
        ),
        *("image", "images", "image_nr", "image_number", "image_index", "index", "number", "n", "shot", "exposure"),
        *("stack", "stack_index", "slice", "z"),
    ),
    "spectrum": ("energy", "energies", "energy_loss", "eloss", "wavelength", "spectrum", "spectral"),
    "colour": ("c", "channel", "channels", "rgb", "rgba", "colour", "color"),
}
"""Names of axes, in small letters and with _ for all other signs."""


@dataclass(frozen=True)
class Order:
    """Where the axes of a movie are in a stored array.

    Attributes
    ----------
    frame
        None for one image. Axes that are none of the three have the length 1.
    notes
        What was guessed.
    """

    frame: int | None
    y: int
    x: int
    notes: tuple[str, ...] = ()

    @property
    def chosen(self) -> tuple[int, ...]:
        """The stored axes in the movie's order."""
        return (self.y, self.x) if self.frame is None else (self.frame, self.y, self.x)

    def shape(self, stored: tuple[int, ...]) -> tuple[int, int, int]:
        """Return the movie's shape."""
        return (1 if self.frame is None else stored[self.frame], stored[self.y], stored[self.x])

    def selection(self, n_axes: int, start: int, stop: int) -> tuple[slice | int, ...]:
        """Return what to take of a stored array for frames ``start`` to ``stop`` (not included)."""
        whole = {self.y: slice(None), self.x: slice(None)}
        if self.frame is not None:
            whole[self.frame] = slice(start, stop)
        return tuple(whole.get(axis, 0) for axis in range(n_axes))

    def movie(self, taken: NDArray[Any]) -> NDArray[Any]:
        """Return what :meth:`selection` took as (frames, y, x)."""
        kept = sorted(self.chosen)
        turned = taken.transpose([kept.index(axis) for axis in self.chosen])
        return turned[None] if self.frame is None else turned


def ordered(axes: Sequence[Axis], shape: tuple[int, ...], where: str) -> Order:
    """Return which axes of an array are frame, y and x.

    Parameters
    ----------
    axes
        One for each axis of the array, as it is stored; ``Axis()`` where the file says nothing.
    shape
        Of the array.
    where
        The array, for errors and notes.

    Raises
    ------
    SourceError
        Where it is a spectrum, a spectrum image, colours, or has more than three axes.

    Examples
    --------
    >>> ordered([Axis("y"), Axis("x"), Axis("time", "s")], (20, 24, 6), "a.h5").chosen
    (2, 0, 1)
    """
    kept = _without_ones(axes, shape)
    named = [axes[k] for k in kept]
    kinds = [axis.kind for axis in named]
    _check_kinds(named, kinds, where)
    if len(kept) not in (2, 3):
        if any(axis.name for axis in named):
            raise _refused(f"the data have {len(kept)} axes, such as an image at each place of a scan", named, where)
        checked_shape(tuple(shape[k] for k in kept), where)
    places = _places(named, kinds, where)
    notes = (
        ()
        if any(kinds) or any(axis.in_image is not None for axis in named)
        else doubts(tuple(shape[k] for k in kept), where)
    )
    notes += _passed_over([axes[k] for k in range(len(shape)) if k not in kept], where)
    frame, y, x = (None if place is None else kept[place] for place in places)
    assert y is not None
    assert x is not None
    checked_shape(Order(frame, y, x).shape(shape), where)
    return Order(frame, y, x, notes)


def _without_ones(axes: Sequence[Axis], shape: tuple[int, ...]) -> list[int]:
    """Return the axes without those of length 1 that no movie has: channel, depth, one energy, more than three axes."""
    kept = list(range(len(shape)))
    for kind in ("colour", "spectrum", "frame", ""):
        for k in range(len(shape)):
            drops = kind in ("colour", "spectrum") or len(kept) > 3
            if shape[k] == 1 and k in kept and drops and len(kept) > 2 and axes[k].kind == kind:
                kept.remove(k)
    return kept


def _passed_over(axes: list[Axis], where: str) -> tuple[str, ...]:
    if not axes:
        return ()
    return (f"{where}: of the axes, those of length 1 are passed over: {', '.join(map(str, axes))}",)


def _check_kinds(axes: list[Axis], kinds: list[str], where: str) -> None:
    if "spectrum" in kinds:
        raise _refused("this is a spectrum or a spectrum image", axes, where)
    if "colour" in kinds:
        raise _refused("the pixels are RGB colours, or there are several channels", axes, where)
    in_image = [axis.in_image for axis in axes]
    if in_image.count(False) and in_image.count(True) == 1:
        raise _refused("this is a spectrum at each place, or a spectrum image", axes, where)


def _refused(what: str, axes: list[Axis], where: str) -> SourceError:
    return SourceError(
        what,
        where,
        "a movie with axes (frames, y, x), or one image",
        f"the axes {', '.join(map(str, axes))}",
        "Save one channel, one energy or one virtual image of it as an array with three axes",
    )


def _places(axes: list[Axis], kinds: list[str], where: str) -> tuple[int | None, int, int]:
    """Return the places of frame, y and x among two or three axes."""
    numbers = list(range(len(axes)))
    frame = None if len(axes) == 2 else _frame(axes, kinds)
    if len(axes) == 2 and "frame" in kinds and ("x" in kinds) != ("y" in kinds):
        raise _refused("this is a line profile along time, not a movie", axes, where)
    if frame is not None:
        numbers.remove(frame)
    first, second = numbers
    turned = kinds[first] == "x" or kinds[second] == "y"
    return (frame, second, first) if turned and kinds[first] != "y" else (frame, first, second)


def _frame(axes: list[Axis], kinds: list[str]) -> int:
    """Return which of three axes is the frames: what is left by x and y, or is named so, else the first."""
    rules = (
        [k for k, kind in enumerate(kinds) if kind not in ("x", "y")] if {"x", "y"} <= {*kinds} else [],
        [k for k, axis in enumerate(axes) if axis.in_image is False],
        [k for k, kind in enumerate(kinds) if kind == "frame"],
        [k for k, kind in enumerate(kinds) if kind == ""] if any(kinds) else [],
    )
    return next(chain.from_iterable(rule for rule in rules if len(rule) == 1), 0)


_FAR, _FAR_OF_SQUARES = 3, 16


def doubts(shape: tuple[int, ...], where: str) -> tuple[str, ...]:
    """Return a note where nothing names three axes, and the first is far longer than the frames would be wide.

    Examples
    --------
    >>> doubts((4096, 4096, 10), "a.h5")[0][:60]
    'a.h5: nothing in the file names its axes; they are read as ('
    >>> doubts((1000, 512, 512), "a.h5")
    ()
    """
    if len(shape) != 3 or shape[0] < shape[2] * (_FAR_OF_SQUARES if shape[1] == shape[2] else _FAR):
        return ()
    return (
        f"{where}: nothing in the file names its axes; they are read as (frame, y, x), {shape[0]:,} frames of"
        f" {shape[1]} x {shape[2]}: check that the frames are not along another axis",
    )


def plain_unit(unit: str) -> str:
    """Return a unit without the signs of EMD, in which ``[n_m]`` is nm, and without the moment from which time runs.

    Examples
    --------
    >>> plain_unit("[n_m]"), plain_unit("[]"), plain_unit("1/nm"), plain_unit("seconds since 2026-11-30 10:00:00")
    ('nm', '', '1/nm', 'seconds')
    """
    unit = unit.partition(" since ")[0].strip("\0 \t\r\n")
    return unit[1:-1].replace("_", "") if unit.startswith("[") and unit.endswith("]") else unit


def evenly(values: NDArray[np.float64]) -> float:
    """Return the step of values that lie at even distances; the median step otherwise, NaN of less than two."""
    return float(np.median(np.diff(values))) if len(values) > 1 else math.nan
