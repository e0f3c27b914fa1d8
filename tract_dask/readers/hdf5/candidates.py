"""Which of the arrays in a file or store is the movie."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SourceError


@dataclass(frozen=True)
class Found:
    """A data set: its path as seen from the file that the user named, its axes, and the type of its pixels.

    ``signal`` tells whether its group says that it is what the group is about; ``label`` follows it in lists.
    """

    shown: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    signal: bool = False
    label: str = ""


def movies_of(found: list[Found]) -> list[Found]:
    """Return what could be the movie: first what is the subject of its group, then other arrays of numbers."""
    numbers = [item for item in found if item.dtype.kind in "iufcb"]
    signals = [item for item in found if item.signal]
    deep = [[item for item in items if len(item.shape) == 3] for items in (signals, numbers)]
    flat = [[item for item in items if len(item.shape) == 2] for items in (signals, numbers)]
    several = [[item for item in items if min(item.shape) > 1 and item.dtype.kind in "iufb"] for items in deep]
    if len(several[0] or several[1]) == 1 and not (flat[0] and not deep[0]):
        return several[0] or several[1]
    more = [item for item in signals if len(item.shape) > 3]
    thin = [item for item in numbers if len(item.shape) > 3 and 1 < sum(length > 1 for length in item.shape) <= 3]
    return deep[0] or (flat[0] + deep[1]) or more or thin or flat[1]


_SMALL = 16
"""Sides of images that are smaller are those of tables of results rather than of movies."""


def others_of(movie: Found, found: list[Found], where: str) -> tuple[str, ...]:
    """Return a note on what lies beside the movie that was chosen and could be a movie, or a reference of its size."""
    sides = [length for length in movie.shape if length > 1][-2:]
    numbers = (item for item in found if item.dtype.kind in "iufcb" and item.shown != movie.shown)
    others = [item for item in numbers if item.signal or _is_image(item.shape, sides)]
    if not others:
        return ()
    shown = ", ".join(f"{item.shown} {item.shape}{item.label}" for item in others[:5])
    more = f" and {len(others) - 5} more" if len(others) > 5 else ""
    return (f"{where}: {movie.shown} is read; the file also holds {shown}{more}",)


def _is_image(shape: tuple[int, ...], sides: list[int]) -> bool:
    """Tell whether a shape is that of images with these sides, or of a movie of others."""
    same = sorted(length for length in shape if length in sides)[-2:] == sorted(sides)
    return (same and len(shape) > 1) or (len(shape) > 2 and sorted(shape)[-2] >= _SMALL)


def ambiguous(
    path: Path, inner: str, movies: list[Found], found: list[Found], lost: list[str], *, there: bool
) -> SourceError:
    """Return the error where no array, or several, could be the movie; ``there``: whether ``inner`` leads somewhere."""
    listing = ", ".join(f"{item.shown} {item.shape} {item.dtype}{item.label}" for item in (movies or found)[:20])
    holds = f"a file that holds {listing}" if listing else "a file without data sets"
    return SourceError(
        f"there are {len(movies) or 'no'} data sets that could be the movie"
        if there
        else "there is nothing under this path",
        f"{path}::{inner}" if inner else str(path),
        "the path of one data set with axes (frames, y, x)",
        f"{holds}, where {'; '.join(lost[:9])}" if lost else holds,
        f"Name it, for example {path.name}::{movies[0].shown}" if movies else "Name one of those, or check the file",
    )
