"""References of a detector: images without electrons, gain references, and pixels that are known to be faulty."""

from __future__ import annotations

import os
import re
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SourceError
from ...readers import open_reference
from ...readers.checks import Permit, checked_file, reading
from ...readers.selection import SelectedSource
from ...readers.source import FrameSource
from ...store.files import read_small
from ...store.provenance import fingerprint
from ...store.tables import decoded

Image = NDArray[np.float64]

_LISTS = (".csv", ".txt", ".tsv")
_LIST_BYTES = 4 << 20
"""Some hundred thousand pixels, which take a few seconds; more of them are a mask."""
_BLOCK_BYTES = 64 << 20
_MOST = 0.5
"""A mask of a larger share of the pixels is the wrong way round."""
_MEANING = "Give one pixel in a line: x, y, counted from 0 in whole frames, as the file of the movie has them"


def is_list(place: str) -> bool:
    """Tell whether a reference is a list of pixels, by its name.

    Examples
    --------
    >>> is_list("defects.csv"), is_list("mask.tif")
    (True, False)
    """
    return Path(place).suffix.lower() in _LISTS


def content_of_reference(place: str, permit: Permit | None = None) -> tuple[str, str]:
    """Return what a reference holds, whatever its name: a fingerprint, and the path inside its file.

    Raises
    ------
    SourceError
        Where it cannot be read.
    """
    if is_list(place):
        checked_file(Path(place), permit)
        with reading(place):
            return fingerprint(Path(place)), ""
    with closing(open_reference(place, permit=permit)) as image, reading(place):
        return fingerprint(*image.files), image.inside


def check_reference(place: str, movie: FrameSource, *, may_be_list: bool = False) -> None:
    """Check that a reference is there and fits the frames of a movie; its pixels are not read.

    Raises
    ------
    SourceError
        As :func:`read_reference`; only lists are read.
    """
    if may_be_list and is_list(place):
        _listed(Path(place), _whole(movie).shape[1:], movie.permit)
        return
    with closing(open_reference(place, permit=movie.permit)) as image:
        _check_shape(place, image.shape, movie)


def read_reference(place: str, movie: FrameSource) -> Image:
    """Return the mean of the frames of an image, (y, x): of whole frames of the movie, or of the part that is read.

    Raises
    ------
    SourceError
        Where it is not there, cannot be read, or has another shape than the frames.
    """
    with closing(open_reference(place, permit=movie.permit)) as image:
        _check_shape(place, image.shape, movie)
        n_frames, total = image.shape[0], np.zeros(image.shape[1:])
        step = max(1, _BLOCK_BYTES // max(1, total.nbytes))
        for start in range(0, n_frames, step):
            total += image.read(start, min(n_frames, start + step)).sum(axis=0, dtype=np.float64)
        return total / n_frames


def read_defects(place: str, movie: FrameSource) -> NDArray[np.bool_]:
    """Return which pixels are faulty, (y, x), of whole frames or of the part that is read: a list, or not 0 in a mask.

    In a mask that stores white as 0, these are the fewer pixels.

    Raises
    ------
    SourceError
        As :func:`read_reference`; where a line is no place in the frames; and where a mask has most pixels.
    """
    if is_list(place):
        return _listed(Path(place), _whole(movie).shape[1:], movie.permit)
    mask: NDArray[np.bool_] = read_reference(place, movie) != 0
    if mask.mean() > _MOST and _white_is_zero(place, movie):
        mask = ~mask
    if mask.mean() > _MOST:
        raise SourceError(
            "the mask leaves out most pixels",
            place,
            "0 where a pixel is good, another number where it is faulty",
            f"{mask.mean():.0%} of the pixels are not 0",
            "Save it the other way round",
        )
    return mask


def _white_is_zero(place: str, movie: FrameSource) -> bool:
    """Tell whether an image stores white as 0, as masks of single bits often do: its numbers are then turned over."""
    with closing(open_reference(place, permit=movie.permit)) as image:
        return any("MinIsWhite" in note for note in image.metadata.notes)


def in_part(image: NDArray[Any], movie: FrameSource) -> NDArray[Any]:
    """Return what lies under each pixel of the part that is read, (y, x, pixels), of an image of frames or of the part.

    Under a pixel lies one, or the bin that is summed.
    """
    if not isinstance(movie, SelectedSource) or image.shape == movie.shape[1:]:
        return image[..., None]
    (top, bottom, left, right), side = movie.field, movie.bin_px
    cut = image[top:bottom, left:right]
    rows, columns = movie.shape[1:]
    return cut.reshape(rows, side, columns, side).swapaxes(1, 2).reshape(rows, columns, side**2)


def _whole(movie: FrameSource) -> FrameSource:
    return movie.whole if isinstance(movie, SelectedSource) else movie


def _check_shape(place: str, found: tuple[int, int, int], movie: FrameSource) -> None:
    fitting = {movie.shape[1:]: "the part of it that is read", _whole(movie).shape[1:]: "a frame of the movie"}
    if found[1:] not in fitting:
        turned = found[:0:-1] in fitting
        raise SourceError(
            "the reference has another shape than the frames",
            place,
            " or ".join(f"{rows} x {columns} px, as {what} has" for (rows, columns), what in fitting.items()),
            f"{found[1]} x {found[2]} px",
            "Turn it by 90 degrees, as the frames are"
            if turned
            else "Use the reference of this camera at this binning, cut to the field that was recorded",
        )


def _listed(path: Path, shape: tuple[int, ...], permit: Permit | None) -> NDArray[np.bool_]:
    """Return the pixels of a list as a mask; its first line may name its columns, x and y among them."""
    checked_file(path, permit)
    try:
        text = decoded(read_small(path, _LIST_BYTES))
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(
            "the list of pixels cannot be read",
            os.fspath(path),
            got=str(error),
            remedy=f"{_MEANING}; or give a mask, an image that is not 0 where a pixel is faulty",
        ) from error
    mask = np.zeros(shape, bool)
    names: tuple[str, ...] | None = None
    for number, line in enumerate(text.splitlines(), 1):
        words = _words(line)
        if not words or words[0].startswith("#"):
            continue
        if names is None and {"x", "y"} <= set(words):
            names = words
            continue
        names = names or ("x", "y")
        x, y = _place(names, words, shape, f"{path}, line {number}")
        mask[y, x] = True
    return mask


def _words(line: str) -> tuple[str, ...]:
    """Return what stands in a line between commas, semicolons or white space, without quotes and empty ends.

    Examples
    --------
    >>> _words('"3"; "5";')
    ('3', '5')
    """
    words = [word.strip('"').strip() for word in re.split(r"\s*[,;\s]\s*", line.strip().lower())]
    while words and not words[-1]:
        del words[-1]
    return tuple(words)


def _place(names: tuple[str, ...], words: tuple[str, ...], shape: tuple[int, ...], where: str) -> tuple[int, int]:
    row = dict(zip(names, words, strict=False))
    try:
        if len(words) > len(names):
            raise ValueError  # which of them are x and y?
        x, y = float(row["x"]), float(row["y"])
    except (KeyError, ValueError):
        found = " ".join(words)
        raise SourceError(
            "this is not a pixel",
            where,
            "two whole numbers, or as many words as a first line names, x and y among them",
            f"{len(words)} words: {found[:80]}" if len(words) > len(names) else found[:80],
            f"{_MEANING}; save a mask as an image",
        ) from None
    if not (x.is_integer() and y.is_integer() and 0 <= x < shape[1] and 0 <= y < shape[0]):
        raise SourceError(
            "there is no such pixel in the frames",
            where,
            f"x from 0 to {shape[1] - 1}, y from 0 to {shape[0] - 1}",
            f"{row['x']}, {row['y']}",
            _MEANING,
        )
    return int(x), int(y)
