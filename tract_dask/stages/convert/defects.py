"""Pixels without data, found while a movie is converted: those of all frames in a sample, the others frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...kernels.borders import shown_part
from ...kernels.defects import History, Moments, Noise, find_spikes, look_at_few, look_back
from ...kernels.saturation import full_scale
from ...readers.selection import SelectedSource
from ...readers.source import FrameSource
from ...settings.run import ConvertSettings
from ...store.arrays import DamagedArrayError, load_saved, save_array
from ...store.pixels import NO_PIXELS, Pixels
from .reference_checks import check_fits
from .reference_files import in_part
from .references import read_references

_SAMPLE_FRAMES = 32
FEWEST_FRAMES = 6
"""With fewer only pixels that are higher than their neighbours are found."""


@dataclass(frozen=True)
class Finder:
    """Corrects frames, and finds what carries no data in them.

    Attributes
    ----------
    history
        What the sample of the movie told; None where it told nothing.
    references
        What corrects frames, and pixels that were given as faulty.
    searches
        Whether anything is looked for.
    """

    history: History | None
    references: Pixels = NO_PIXELS
    searches: bool = True

    def corrected(self, frame: NDArray[Any]) -> NDArray[Any]:
        """Return a frame (y, x) by the references; the frame itself where there are none."""
        return self.references.applied(frame[None], 0)[0] if self.references else frame

    def look(self, frame: NDArray[Any], corrected: NDArray[Any]) -> Pixels:
        """Return what is left out of a frame (y, x), as the first one of a movie, with what references say."""
        if not self.searches:
            return Pixels(self.mask)
        if self.history is None:
            return Pixels(self.mask, borders=_border(frame))
        spikes = find_spikes(corrected, self.history)
        placed = np.column_stack([np.zeros(len(spikes), np.int32), spikes]).astype(np.int32)
        return Pixels(self.mask, placed if len(placed) else None, _border(frame))

    @cached_property
    def mask(self) -> NDArray[np.uint8] | None:
        """What is left out of all frames; None: nothing."""
        both = self.references.mask, self.history.mask if self.history else None
        masks = [mask for mask in both if mask is not None and mask.any()]
        return np.where(masks[0] > 0, masks[0], masks[-1]) if masks else None

    def saturated(self, frame: NDArray[Any], shown: NDArray[Any]) -> tuple[int, int]:
        """Return how many pixels of a frame (y, x) are at full scale, and how many are higher.

        Those that carry no data do not count: ``shown`` is the frame with NaN there.
        """
        full = self.history.full_scale if self.history else None
        if full is None or not (reached := frame >= frame.dtype.type(full)).any():
            return 0, 0
        reached &= np.isfinite(shown)
        return int(np.count_nonzero(reached)), int(np.count_nonzero(frame[reached] > full))


def _border(frame: NDArray[Any]) -> NDArray[np.int32] | None:
    shown = shown_part(frame)
    return None if shown is None else np.array([shown], np.int32)


_REFERENCES = ("given", "dark", "gain")


def finder_for(source: FrameSource, folder: Path, settings: ConvertSettings) -> None:
    """Read the references, look at a sample of a movie, and leave both in ``folder``, for the tasks; once."""
    try:
        _load(folder)
    except DamagedArrayError:
        references = read_references(source, settings)
        check_fits(source, settings, references)
        for name, values in zip(_REFERENCES, (references.mask, references.dark, references.gain), strict=True):
            save_array(folder / f"{name}.npy", np.empty((0, 0), np.float32) if values is None else values)
        history = _history(source, Finder(None, references)) if settings.find_defects else None
        shape = source.shape[1:] if history else (0, 0)
        save_array(folder / "mask.npy", history.mask if history else np.zeros(shape, np.uint8))
        save_array(folder / "usual.npy", history.usual if history else np.zeros(shape, np.float32))
        save_array(folder / "searches.npy", np.array(settings.find_defects))
        _save_limits(folder / "limits.npy", history)


@lru_cache(maxsize=2)
def found_in(folder: Path) -> Finder:
    """Return the finder that :func:`finder_for` has left."""
    return _load(folder)


def _load(folder: Path) -> Finder:
    mask, usual, limits, searches = (
        load_saved(folder / f"{name}.npy") for name in ("mask", "usual", "limits", "searches")
    )
    named, dark, gain = (
        values if values.size else None for values in (load_saved(folder / f"{name}.npy") for name in _REFERENCES)
    )
    even, slope, full, relief, cut_off = map(float, limits)
    scale = None if np.isnan(full) else full
    history = History(mask, usual, Noise(even, slope), scale, relief, int(cut_off)) if mask.size else None
    return Finder(history, Pixels(mask=named, dark=dark, gain=gain), bool(searches))


def _save_limits(path: Path, history: History | None) -> None:
    full = history.full_scale if history else None
    known = (*history.noise, np.nan if full is None else full, history.relief, history.cut_off) if history else (0,) * 5
    save_array(path, np.array(known, np.float64))


def _history(source: FrameSource, finder: Finder) -> History | None:
    """Return what pairs of frames, spread over the movie and corrected, tell of its pixels."""
    n_frames = source.shape[0]
    if n_frames < FEWEST_FRAMES:
        return look_at_few([finder.corrected(source.read(number, number + 1)[0]) for number in range(n_frames)])
    moments, pairs = Moments(source.shape[1:]), _SAMPLE_FRAMES // 2
    whole = n_frames <= _SAMPLE_FRAMES
    starts = range(n_frames) if whole else [k * (n_frames - 2) // (pairs - 1) for k in range(pairs)]
    highest, high = np.full((2, *(source.shape[1:] if finder.references else (0, 0))), -np.inf, np.float32)
    for number, start in enumerate(starts):
        frames = source.read(start, start + (1 if whole else 2))
        for k, frame in enumerate(frames):
            moments.add(finder.corrected(frame), follows=k > 0 or (whole and number > 0))
            if finder.references:
                high, highest = np.maximum(high, np.minimum(highest, frame)), np.maximum(highest, frame)
    with np.errstate(invalid="ignore", over="ignore"):  # pixels that hold no number
        history = look_back(moments)
    if history and history.full_scale is None and (cut_off := _cut_off_in_bins(source)):
        return history._replace(cut_off=cut_off)
    if history and finder.references:  # recorded values are cut off, and not corrected ones
        full = full_scale(high.astype(np.float32), frame, history.mask == 0)
        return history._replace(full_scale=full, cut_off=history.cut_off if full is None else 0)
    return history


_BIN_FRAMES = 8
"""Of so many frames it is looked whether pixels were cut off before they were summed in bins."""


def _cut_off_in_bins(source: FrameSource) -> int:
    """Return in how many bins of a frame, the most of a few, pixels have a largest value that cuts them off."""
    if not isinstance(source, SelectedSource) or source.bin_px == 1:
        return 0
    numbers = np.unique(np.linspace(0, source.shape[0] - 1, _BIN_FRAMES).astype(int)).tolist()
    frames = [source.whole.read(number, number + 1)[0] for number in (source.frames[k] for k in numbers)]
    high = np.sort(np.stack(frames), axis=0)[-2:][0]
    full = full_scale(high.astype(np.float32), frames[-1], np.ones(high.shape, np.bool_))
    if full is None:
        return 0
    reached = [in_part(frame >= full, source).any(axis=2) for frame in frames]
    return int(max(np.count_nonzero(one) for one in reached))


def in_payload(found: dict[int, Pixels]) -> dict[str, Any]:
    """Return the spikes and borders of frames, by their numbers, as what a task leaves in its journal."""
    spikes = [
        [number, int(y), int(x)] for number, one in found.items() if one.spikes is not None for _, y, x in one.spikes
    ]
    borders = {str(number): one.borders[0].tolist() for number, one in found.items() if one.borders is not None}
    return ({"spikes": spikes} if spikes else {}) | ({"borders": borders} if borders else {})


_HIGHER = 0.1
"""Where a larger share of these pixels is higher than what was taken for full scale, it is not."""


class Gathered:
    """What the tasks of a conversion have found."""

    def __init__(self, n_frames: int, shape: tuple[int, int]) -> None:
        self._whole, self._n_frames = np.array([0, shape[0], 0, shape[1]], np.int32), n_frames
        self._spikes: list[list[int]] = []
        self._borders: dict[str, list[int]] = {}
        self._saturated, self._higher = np.zeros(n_frames, np.uint32), 0

    def add(self, payload: dict[str, Any]) -> None:
        """Add what a task left."""
        self._spikes += payload.get("spikes", [])
        self._borders |= payload.get("borders", {})
        for number, (reached, higher) in payload.get("saturated", {}).items():
            self._saturated[int(number)] = reached
            self._higher += higher

    def pixels(self, finder: Path | None) -> Pixels:
        """Return what is left out of the movie, with the mask that is in the finder's folder."""
        known = found_in(finder) if finder else Finder(None)
        spikes = np.array(sorted(self._spikes), np.int32) if self._spikes else None
        every = replace(known.references, mask=known.mask, spikes=spikes)
        if self._borders:
            borders = np.tile(self._whole, (self._n_frames, 1))
            borders[[int(number) for number in self._borders]] = list(self._borders.values())
            every = replace(every, borders=borders)
        if known.history and known.history.cut_off:
            return replace(every, cut_off=np.array([known.history.cut_off]))
        full = known.history.full_scale if known.history else None
        if full is None or not self._saturated.any() or self._higher > _HIGHER * self._saturated.sum():
            return every
        return replace(every, full_scale=np.array([full]), saturated=self._saturated)
