"""What is known of a movie's pixels, beside the frames in its store: which carry no data, and the references.

Array ``0`` holds the frames as they were recorded. In the group ``pixels`` lie ``mask`` (y, x), why a pixel is left out
of every frame; ``spikes`` (n, 3), frame, row and column of pixels that are left out of one frame; ``borders``
(frames, 4), first and last row and column (not included) of what a frame shows; ``dark`` and ``gain`` (y, x), what is
subtracted from a pixel, and what it is multiplied by then; ``full_scale`` (1,), the recorded value at which pixels are
cut off, and ``saturated`` (frames,), how many are; ``cut_off`` (1,), how many have a top of their own. Only what there
is is stored. A movie is read corrected, with NaN at the pixels that carry no data, and infinity where they are
saturated: what they hold is a lower bound.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from . import datasets
from .metadata import attributes
from .shard_files import CHUNK_KEYS, codecs

GROUP = "pixels"

KINDS = {1: "hot", 2: "dead", 3: "lines", 4: "given"}
"""What the numbers of a mask mean; 0: the pixel is used."""

_DIMENSIONS = {
    "mask": ("y", "x"),
    "spikes": ("spike", "place"),
    "borders": ("t", "edge"),
    "dark": ("y", "x"),
    "gain": ("y", "x"),
    "full_scale": ("level",),
    "saturated": ("t",),
    "cut_off": ("level",),
}


@dataclass(frozen=True)
class Pixels:
    """What is left out of the frames of a movie, and corrects the others; None: nothing of that kind.

    Attributes
    ----------
    mask
        (y, x) uint8, one of :data:`KINDS`, 0 for pixels that are used.
    spikes
        (n, 3) int32 frame, y and x, by frame.
    borders
        (frames, 4) int32 first row, stop row, first column, stop column of what each frame shows.
    dark
        (y, x) float32, what is subtracted from every frame, in detector units.
    gain
        (y, x) float32, what frames are multiplied by then.
    full_scale
        (1,) value at which pixels are cut off, detector units.
    saturated
        (frames,) how many pixels of a frame have it, beside those that are left out already.
    cut_off
        (1,) how many pixels are cut off, each at a value of its own, and not at a full scale.
    """

    mask: NDArray[np.uint8] | None = None
    spikes: NDArray[np.int32] | None = None
    borders: NDArray[np.int32] | None = None
    dark: NDArray[np.float32] | None = None
    gain: NDArray[np.float32] | None = None
    full_scale: NDArray[np.float64] | None = None
    saturated: NDArray[np.uint32] | None = None
    cut_off: NDArray[np.int64] | None = None

    def __bool__(self) -> bool:
        return any(getattr(self, field.name) is not None for field in fields(self))

    def counts(self, shape: tuple[int, ...]) -> dict[str, int]:
        """Return how many pixels are masked, by kind, how many spikes there are, and frames (y, x) with a border."""
        found: dict[str, int] = {}
        if self.mask is not None:
            number = np.bincount(self.mask.ravel(), minlength=max(KINDS) + 1)
            found |= {name: int(number[kind]) for kind, name in KINDS.items() if number[kind]}
        if self.spikes is not None:
            found["spikes"] = len(self.spikes)
        if self.borders is not None:
            found["frames with a border"] = int((self.borders != [0, shape[0], 0, shape[1]]).any(axis=1).sum())
        if self.saturated is not None:
            found["saturated"] = int(self.saturated.sum(dtype=np.int64))
            found["frames with saturated pixels"] = int(np.count_nonzero(self.saturated))
        if self.cut_off is not None:
            found["cut off"] = int(self.cut_off[0])
        return found

    def applied(self, block: NDArray[Any], first: int, top: int = 0, left: int = 0) -> NDArray[Any]:
        """Return frames (frames, y, x), corrected, as real numbers: NaN without data, infinite where saturated.

        Parameters
        ----------
        first, top, left
            Number of the first frame, and row and column of the first pixel.
        """
        shown = block.astype(real_of(block.dtype))
        n, height, width = block.shape
        rows, columns = slice(top, top + height), slice(left, left + width)
        for reference, correct in ((self.dark, np.subtract), (self.gain, np.multiply)):
            if reference is not None:  # tiles at the edges may reach beyond the field
                part = reference[rows, columns]
                inside = shown[:, : part.shape[0], : part.shape[1]]
                correct(inside, part, out=inside)
        if self.full_scale is not None:
            shown[block >= block.dtype.type(self.full_scale[0])] = np.inf
        if self.mask is not None and (masked := self.mask[rows, columns] > 0).any():
            shown[:, : masked.shape[0], : masked.shape[1]][:, masked] = np.nan
        if self.spikes is not None:
            start, stop = np.searchsorted(self.spikes[:, 0], [first, first + n])
            t, y, x = (self.spikes[start:stop] - [first, top, left]).T
            here = (y >= 0) & (y < height) & (x >= 0) & (x < width)
            shown[t[here], y[here], x[here]] = np.nan
        if self.borders is not None:
            for frame, (y0, y1, x0, x1) in zip(shown, self.borders[first : first + n], strict=False):
                y0, y1, x0, x1 = (max(0, edge) for edge in (y0 - top, y1 - top, x0 - left, x1 - left))
                frame[:y0], frame[y1:], frame[:, :x0], frame[:, x1:] = np.nan, np.nan, np.nan, np.nan
        return shown

    @cached_property
    def level_cut_off(self) -> float | None:
        """Value at which pixels are cut off, corrected as the median pixel is; None where they are not."""
        if self.full_scale is None:
            return None
        dark, gain = (1.0 * np.median(one) if one is not None else None for one in (self.dark, self.gain))
        return float((self.full_scale[0] - (dark or 0.0)) * (1.0 if gain is None else gain))

    def write(self, store: Path, shape: tuple[int, ...]) -> dict[str, Any]:
        """Write what there is into the ``store`` of a movie of frames (y, x); return what its attributes say of it."""
        names = [field.name for field in fields(self) if getattr(self, field.name) is not None]
        if names:
            zarr.create_group(store / GROUP, zarr_format=3, overwrite=True)
        for name in names:
            values = getattr(self, name)
            zarr.create_array(
                store / GROUP / name,
                shape=values.shape,
                chunks=values.shape,
                dtype=values.dtype,
                compressors=codecs("zstd"),
                chunk_key_encoding=CHUNK_KEYS,
                fill_value=0,
                dimension_names=_DIMENSIONS[name],
                zarr_format=3,
            )
            datasets.overwrite_array(store / GROUP / name, values)
        full = {} if self.full_scale is None else {"full scale": float(self.full_scale[0])}
        return {"arrays": names} | self.counts(shape) | full if names else {}


NO_PIXELS = Pixels()
"""Of a movie in which every pixel carries data, and none is corrected."""


def real_of(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the real numbers that hold pixels of a type, and NaN: float32, or float64 where that is too coarse."""
    coarse = dtype.itemsize > 4 or (dtype.itemsize == 4 and dtype.kind != "f")
    return np.dtype(np.float64 if coarse else np.float32)


def in_words(counts: dict[str, int]) -> list[str]:
    """Return in words how many pixels carry no data.

    Examples
    --------
    >>> in_words({"hot": 3, "lines": 512, "spikes": 1, "frames with a border": 20})
    ['3 hot pixels, 512 pixels in lines and 1 spike left out', '20 frames with a border']
    """
    forms = {
        "hot": "hot pixel",
        "dead": "dead pixel",
        "lines": "pixel",
        "given": "given pixel",
        "spikes": "spike",
        "saturated": "saturated pixel",
    }
    found = [
        f"{counts[name]} {form}{'s' if counts[name] != 1 else ''}{' in lines' if name == 'lines' else ''}"
        for name, form in forms.items()
        if counts.get(name)
    ]
    words = (
        [" and ".join([", ".join(found[:-1]), found[-1]] if len(found) > 1 else found) + " left out"] if found else []
    )
    framed = counts.get("frames with a border", 0)
    return words + ([f"{framed} frame{'s' if framed != 1 else ''} with a border"] if framed else [])


def nodes_of(about: dict[str, Any]) -> list[str]:
    """Return the arrays and the group of a movie's pixels, by what the movie says of itself."""
    names = about.get(GROUP, {}).get("arrays", ())
    return [GROUP, *(f"{GROUP}/{name}" for name in names)] if names else []


@lru_cache(maxsize=4)
def pixels_of(store: Path, key: str) -> Pixels:
    """Return which pixels of a complete movie carry no data; ``key`` tells the movie from a later one there.

    Raises
    ------
    StoreError
        Where it is damaged.
    """
    names = attributes(store).get(GROUP, {}).get("arrays", ())
    return Pixels(**{name: np.asarray(datasets.open_array(store / GROUP / name)[:]) for name in names})
