"""Whether the references of a detector make the frames better: on the mean of some frames, before any work.

A reference's pattern has to be in the frames, where it lies, and as it lies. It is looked for elsewhere and turned, so
that the user is told what to do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import SourceError
from ...kernels.patterns import Measured, added_likeness, likeness, shift_of
from ...readers.source import FrameSource
from ...settings.run import ConvertSettings
from ...store.pixels import Pixels
from .reference_files import in_part, read_reference
from .references import sensitivity

Image = NDArray[np.float64]

_SAMPLE_FRAMES = 32
_SURE = 5.0
"""Standard errors by which a reference has to be wrong."""
_HALF = 0.5
"""With less than this share of its pattern in the frames, a reference adds more than it takes away."""

_TURNS: dict[str, Callable[[Image], Image]] = {
    "flip it top to bottom": np.flipud,
    "flip it left to right": np.fliplr,
    "turn it by 180 degrees": lambda image: np.rot90(image, 2),
    "turn it by 90 degrees to the left": np.rot90,
    "turn it by 90 degrees to the right": lambda image: np.rot90(image, 3),
    "exchange its rows and columns": np.transpose,
    "exchange its rows and columns, and turn it by 180 degrees": lambda image: np.rot90(image, 2).T,
}
"""The other ways in which an image can lie, by what brings it there."""


class _Placed(NamedTuple):
    """How a reference is moved or turned, and how much of its pattern is in the frames then."""

    how: str
    found: Measured

    @property
    def least(self) -> float:
        """How much there is at least, of the pattern or of its inverse."""
        return abs(self.found.value) - _SURE * self.found.stderr


class _Reference(NamedTuple):
    """A reference as the user gave it, and how frames are compared with it.

    Attributes
    ----------
    name
        What it is called in errors.
    place
        Where it lies.
    mean
        (y, x) mean of frames, NaN where pixels are faulty.
    pattern
        (y, x) what is looked for in it.
    turned
        (y, x) the same, of an image of the file that is turned.
    compared
        How much of a pattern there is in a mean.
    """

    name: str
    place: str
    mean: Image
    pattern: Image
    turned: Callable[[Image], Image]
    compared: Callable[[Image, Image], Measured | None]


def check_fits(movie: FrameSource, settings: ConvertSettings, references: Pixels) -> None:
    """Check on the mean of some frames that references make them better: that they are this camera's, and not applied.

    Raises
    ------
    SourceError
        Where the dark image is brighter than the frames, and where a reference would add a pattern; naming how to move
        or turn it, where that helps.
    """
    if references.dark is None and references.gain is None:
        return
    mean = _sample_mean(movie)
    if references.mask is not None:
        mean[references.mask > 0] = np.nan
    if references.dark is not None:
        place, dark = str(settings.dark), references.dark.astype(np.float64)
        _check_level(place, mean - dark)

        def summed(image: Image) -> Image:
            return np.asarray(in_part(image, movie).sum(axis=2))

        _check_dark(movie, _Reference("the dark image", place, mean, dark, summed, added_likeness))
        mean = mean - dark
    if references.gain is not None:
        place, by = str(settings.gain_reference), settings.gain_reference_by
        known = 1 / references.gain.astype(np.float64)

        def averaged(image: Image) -> Image:
            return np.asarray(in_part(sensitivity(image, place, by), movie).mean(axis=2))

        _check_gain(movie, _Reference("the gain reference", place, mean, known, averaged, likeness), by)


def _check_level(place: str, above: Image) -> None:
    good = above[np.isfinite(above)]
    if good.size and good.mean() < -_SURE * good.std() / math.sqrt(good.size):
        raise SourceError(
            "the dark image is brighter than the frames",
            place,
            "an image without electrons, with the exposure of a frame",
            f"frames that are {-good.mean():.4g} darker than it in the mean",
            "Take a dark image of this exposure, or leave out --dark where frames were corrected before",
        )


def _check_dark(movie: FrameSource, dark: _Reference) -> None:
    found = dark.compared(dark.mean, dark.pattern)  # its noise is a pattern that is in no frame
    if found is None or (placed := _placed(movie, dark, found)) is None or placed.found.value < 0:
        return
    raise _lies_otherwise(dark, found, placed)


def _check_gain(movie: FrameSource, gain: _Reference, by: str) -> None:
    found = gain.compared(gain.mean, gain.pattern)
    if found is None:
        return
    other = f"--gain-reference-by {'divide' if by == 'multiply' else 'multiply'}"
    if placed := _placed(movie, gain, found):
        raise _lies_otherwise(gain, found, placed, f", and use {other}" if placed.found.value < 0 else "")
    if found.value + _SURE * found.stderr < _HALF:
        inverted = found.value < -_HALF
        raise SourceError(
            "the gain reference is inverted"
            if inverted
            else "the frames do not have the pattern of the gain reference",
            gain.place,
            "a pattern that it takes away (1.00 of it is in the frames)",
            f"{found.value:.2f} of it, with an error of {found.stderr:.2f}",
            f"Use {other}"
            if inverted
            else "Leave it out where frames were corrected before; else give --dark, or the reference of this camera",
        )


def _lies_otherwise(one: _Reference, found: Measured, placed: _Placed, also: str = "") -> SourceError:
    return SourceError(
        f"{one.name} lies otherwise than the frames",
        one.place,
        "a pattern that it takes away (1.00 of it is in the frames)",
        f"{found.value:.2f} of it; {placed.found.value:.2f} where it is moved or turned",
        f"Before you give it, {placed.how}{also}",
    )


def _placed(movie: FrameSource, one: _Reference, found: Measured) -> _Placed | None:
    """Return how a reference has to be moved or turned so that its pattern is in the frames; None where it has not."""
    here = _Placed("", found)
    moved = _moved(one)
    if moved and moved.least > max(_HALF, abs(found.value) + _SURE * found.stderr):
        return moved
    if abs(found.value) + _SURE * found.stderr >= _HALF:
        return None
    image = read_reference(one.place, movie)
    best = here
    for how, turned in _turned(image):
        if (there := one.compared(one.mean, one.turned(turned))) and abs(there.value) > abs(best.found.value):
            best = _Placed(how, there)
    return best if best is not here and best.least > _HALF else None


def _moved(one: _Reference) -> _Placed | None:
    y, x = shift_of(one.mean, one.pattern)
    if (y, x) == (0, 0):
        return None
    pattern = np.full_like(one.pattern, np.nan)
    (to_y, from_y), (to_x, from_x) = _overlap(y), _overlap(x)
    pattern[to_y, to_x] = one.pattern[from_y, from_x]
    found = one.compared(one.mean, pattern)
    words = [
        f"{abs(by)} px {ahead if by > 0 else back}"
        for by, ahead, back in ((x, "to the right", "to the left"), (y, "down", "up"))
        if by
    ]
    return _Placed(f"move it by {' and '.join(words)}", found) if found else None


def _overlap(shift: int) -> tuple[slice, slice]:
    """Return where an axis lies that is moved by so many pixels, and what of it."""
    return (slice(shift, None), slice(None, -shift)) if shift > 0 else (slice(None, shift or None), slice(-shift, None))


def _turned(image: Image) -> Iterator[tuple[str, Image]]:
    """Yield an image as it can lie otherwise in its shape, and how it comes there."""
    for how, turn in _TURNS.items():
        turned = turn(image)
        if turned.shape == image.shape:
            yield how, turned


def _sample_mean(movie: FrameSource) -> Image:
    """Return the mean (y, x) of at most 32 frames, spread over the movie."""
    n_frames = movie.shape[0]
    numbers = np.unique(np.linspace(0, n_frames - 1, min(n_frames, _SAMPLE_FRAMES)).astype(int)).tolist()
    total = np.zeros(movie.shape[1:])
    for number in numbers:
        total += movie.read(number, number + 1)[0]
    return total / len(numbers)
