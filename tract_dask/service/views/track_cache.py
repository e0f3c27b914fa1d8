"""Tracks laid out for looking: a column's whole series in one place, and the sums of every column and frame.

results.zarr lies frame by frame, as the fits are made; to see one column in time would mean to decode all of it. What
pages need is copied once, shard by shard as these are finished, into files that are read through memory maps. They may
be deleted at any time, and are made anew.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from ...analysis.overview import COUNTS, FRAME, MEANS, SERIES, ColumnSums, Flags, Floats, Part
from ...store import datasets, files, metadata, results
from ...store.locks import sole_use

_KEPT = repr((COUNTS, MEANS, FRAME, SERIES))
"""What the files hold: where another version holds other numbers, they are not its files."""
_MAX_FITS = 32 << 20
"""Of larger stores no series are copied, 48 bytes a fit; theirs are read from the store itself."""
_KEPT_BYTES = 4 << 30
_RUN_BYTES = 16 << 20
_SAVE_S = 3.0
_PATIENCE_S = 3600.0


@dataclass(frozen=True)
class Tracks:
    """What is known of the tracks in a store, of its finished shards.

    Attributes
    ----------
    path
        The results.zarr.
    done
        Which frames are done (frame).
    columns
        The sums over the frames that are done.
    frames
        By name (frame), see :meth:`.overview.Part.frames`; NaN where a frame is not done.
    """

    path: Path
    shards: Flags
    done: Flags
    columns: ColumnSums
    frames: dict[str, Floats]
    _series: Floats | None

    def series(self, column: int, start: int, stop: int) -> dict[str, Floats]:
        """Return x, y (px), intensity (counts), and their standard errors, of one column, by its place among all.

        Parameters
        ----------
        start, stop
            Frames.

        Returns
        -------
        dict
            By name (stop - start); NaN where a fit is not accepted, or not done.
        """
        if self._series is None:
            values = np.full((len(SERIES), stop - start), np.nan)
            opened = results.variables(self.path)
            for first, end in _runs(self.path, self.shards, start, stop):
                values[:, first - start : end - start] = Part(opened, first, end).series[:, :, column]
        else:
            values = np.where(self.done[start:stop], self._series[column, :, start:stop], np.nan)
        return dict(zip(SERIES, values, strict=True))


def open_tracks(path: Path, folder: Path) -> Tracks:
    """Return what the finished shards of the store at ``path`` hold, through files in ``folder``, brought up to date.

    Raises
    ------
    MissingStoreError
        Where there are no results.
    """
    finished = results.finished_shards(path)
    key = hashlib.sha256(f"{path}\0{metadata.attributes(path).get('key')}\0{_KEPT}".encode()).hexdigest()[:20]
    place = folder / key
    place.mkdir(parents=True, exist_ok=True)
    with sole_use(place / ".lock", "another process copies these tracks", patience_s=_PATIENCE_S):
        copy = _Copy(path, place)
        if (finished & ~copy.shards).any():
            copy.extend(finished)
        os.utime(place)
    _tidy(folder, place)
    return copy.tracks()


class _Copy:
    """The files beside each other in one folder: ``sums.npz``, which says what is done, and two memory maps."""

    def __init__(self, path: Path, place: Path) -> None:
        self.path, self.place = path, place
        fit = datasets.open_array(path / "fit")
        self.n_frames, self.n_columns, self.step = fit.shape[0], fit.shape[1], fit.chunks[0]
        self._load()

    def _load(self) -> None:
        file = self.place / "sums.npz"
        if file.exists() and (self.place / "frames.f8").exists():
            with np.load(file) as kept:
                self.shards, self.sums = kept["shards"], ColumnSums(kept["counts"], kept["moments"])
        else:
            self.shards = np.zeros(-(-self.n_frames // self.step), np.bool_)
            self.sums = ColumnSums.nothing(self.n_columns)

    def _map(self, name: str, shape: tuple[int, ...]) -> Any:
        file = self.place / f"{name}.f8"
        size = 8 * int(np.prod(shape))
        if not file.exists() or file.stat().st_size != size:
            with file.open("wb") as made:
                made.truncate(size)
        return np.memmap(file, np.float64, "r+", shape=shape)

    def _frame_map(self) -> Any:
        return self._map("frames", (len(FRAME), self.n_frames))

    def _series_map(self) -> Any:
        if self.n_frames * self.n_columns > _MAX_FITS:
            return None
        return self._map("series", (self.n_columns, len(SERIES), self.n_frames))

    def extend(self, finished: Flags) -> None:
        """Copy the shards that are finished and not here yet."""
        by_frame, series = self._frame_map(), self._series_map()
        opened, saved = results.variables(self.path), monotonic()
        for start, stop in list(_runs(self.path, finished & ~self.shards, 0, self.n_frames)):
            part = Part(opened, start, stop)
            if series is not None:
                series[:, :, start:stop] = part.series.transpose(2, 0, 1)
            by_frame[:, start:stop] = part.frames()
            self.sums += part.columns()
            self.shards[start // self.step : -(-stop // self.step)] = True
            if monotonic() - saved > _SAVE_S:
                self._save(by_frame, series)
                saved = monotonic()
        self._save(by_frame, series)

    def _save(self, *maps: Any) -> None:
        for mapped in maps:
            if mapped is not None:
                mapped.flush()
        aside = self.place / ".sums.npz"
        with aside.open("wb") as file:
            np.savez(file, shards=self.shards, counts=self.sums.counts, moments=self.sums.moments)
        aside.replace(self.place / "sums.npz")

    def tracks(self) -> Tracks:
        done = np.repeat(self.shards, self.step)[: self.n_frames]
        by_frame = np.where(done, self._frame_map(), np.nan)
        frames = dict(zip(FRAME, by_frame, strict=True))
        return Tracks(self.path, self.shards, done, self.sums, frames, self._series_map())


def _runs(path: Path, shards: Flags, start: int, stop: int) -> Iterator[tuple[int, int]]:
    """Yield runs of frames (first, end) between ``start`` and ``stop`` that some shards hold, neither few nor many."""
    fit = datasets.open_array(path / "fit")
    step = fit.chunks[0]
    most = max(1, _RUN_BYTES // (8 * int(np.prod(fit.chunks))))
    wanted = np.flatnonzero(shards)
    wanted = wanted[(wanted >= start // step) & (wanted * step < stop)]
    for neighbours in np.split(wanted, np.flatnonzero(np.diff(wanted) > 1) + 1):
        for k in range(0, len(neighbours), most):
            run = neighbours[k : k + most]
            yield max(start, int(run[0]) * step), min(stop, (int(run[-1]) + 1) * step, fit.shape[0])


def _tidy(folder: Path, kept: Path) -> None:
    """Delete copies that were not looked at for longest, while all take more room than they may."""
    places = sorted((place for place in folder.iterdir() if place.is_dir()), key=lambda place: place.stat().st_mtime)
    sizes = {place: sum(file.stat().st_blocks * 512 for file in place.iterdir()) for place in places}
    for place in places:
        if sum(sizes.values()) <= _KEPT_BYTES:
            return
        if place != kept:
            files.remove(place)
            del sizes[place]
