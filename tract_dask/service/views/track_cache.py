"""Tracks laid out for looking: a column's whole series in one place, and the sums of every column and frame.

results.zarr lies frame by frame, as the fits are made; to see one column in time would mean to decode all of it. What
pages need is copied once, shard by shard as these are finished, into files that are read through memory maps. They may
be deleted at any time, and are made anew.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.parameters import AMPLITUDE, X, Y
from ...store import datasets, files, metadata, results
from ...store.locks import sole_use
from ...store.schema import REJECTED, Status

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]
Flags = NDArray[np.bool_]

QUANTITIES = ("x", "y", "intensity")
_SERIES = (*QUANTITIES, *(f"{name}_stderr" for name in QUANTITIES))
_SUMS = ("fits", "accepted", "x", "xx", "y", "yy", "intensity", "variance")
_FRAME = ("fits", "accepted", "amplitude", "drift_y", "drift_x")

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
        By name (column): ``fits`` that were made, ``accepted`` ones; over these the means ``x``, ``y`` (px) and
        ``intensity``, the sums of squares ``xx`` and ``yy`` about the means, and of the stated variances of x and y.
    frames
        By name (frame): ``fits``, ``accepted``, mean ``amplitude`` of the accepted, ``drift_y``, ``drift_x`` (px);
        NaN where a frame is not done.
    """

    path: Path
    shards: Flags
    done: Flags
    columns: dict[str, Floats]
    frames: dict[str, Floats]
    _series: NDArray[np.float64] | None

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
            values = np.full((len(_SERIES), stop - start), np.nan)
            opened = results.variables(self.path)
            for first, end in _runs(self.path, self.shards, start, stop):
                values[:, first - start : end - start] = _series(_read(opened, first, end))[:, :, column]
        else:
            values = np.where(self.done[start:stop], self._series[column, :, start:stop], np.nan)
        return dict(zip(_SERIES, values, strict=True))


def open_tracks(path: Path, folder: Path) -> Tracks:
    """Return what the finished shards of the store at ``path`` hold, through files in ``folder``, brought up to date.

    Raises
    ------
    MissingStoreError
        Where there are no results.
    """
    finished = results.finished_shards(path)
    key = hashlib.sha256(f"{path}\0{metadata.attributes(path).get('key')}".encode()).hexdigest()[:20]
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
                self.shards, self.sums = kept["shards"], kept["sums"]
        else:
            self.shards = np.zeros(-(-self.n_frames // self.step), np.bool_)
            self.sums = np.zeros((len(_SUMS), self.n_columns))

    def _map(self, name: str, shape: tuple[int, ...]) -> Any:
        file = self.place / f"{name}.f8"
        size = 8 * int(np.prod(shape))
        if not file.exists() or file.stat().st_size != size:
            with file.open("wb") as made:
                made.truncate(size)
        return np.memmap(file, np.float64, "r+", shape=shape)

    def _frame_map(self) -> Any:
        return self._map("frames", (len(_FRAME), self.n_frames))

    def _series_map(self) -> Any:
        if self.n_frames * self.n_columns > _MAX_FITS:
            return None
        return self._map("series", (self.n_columns, len(_SERIES), self.n_frames))

    def extend(self, finished: Flags) -> None:
        """Copy the shards that are finished and not here yet."""
        by_frame, series = self._frame_map(), self._series_map()
        opened, saved = results.variables(self.path), monotonic()
        for start, stop in list(_runs(self.path, finished & ~self.shards, 0, self.n_frames)):
            part = _read(opened, start, stop)
            values = _series(part)
            if series is not None:
                series[:, :, start:stop] = values.transpose(2, 0, 1)
            by_frame[:, start:stop] = _frame_numbers(part, np.asarray(opened("drift")[start:stop]))
            self.sums = _merged(self.sums, _column_sums(values, part["status"]))
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
            np.savez(file, shards=self.shards, sums=self.sums)
        aside.replace(self.place / "sums.npz")

    def tracks(self) -> Tracks:
        done = np.repeat(self.shards, self.step)[: self.n_frames]
        by_frame = np.where(done, self._frame_map(), np.nan)
        sums = dict(zip(_SUMS, self.sums, strict=True))
        return Tracks(self.path, self.shards, done, sums, dict(zip(_FRAME, by_frame, strict=True)), self._series_map())


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


def _read(opened: Callable[[str], Any], start: int, stop: int) -> dict[str, NDArray[Any]]:
    """Return some frames of the variables that are needed."""
    names = ("fit", "stderr", "intensity", "intensity_stderr", "status")
    return {name: np.asarray(opened(name)[start:stop]) for name in names}


def _series(part: dict[str, NDArray[Any]]) -> Floats:
    """Return the series of some frames (quantity, frame, column); NaN where a fit is not accepted."""
    fit, stderr = part["fit"], part["stderr"]
    values = np.stack(
        [fit[..., X], fit[..., Y], part["intensity"], stderr[..., X], stderr[..., Y], part["intensity_stderr"]]
    )
    values[:, (part["status"] & int(REJECTED)) > 0] = np.nan
    return values


def _column_sums(values: Floats, status: NDArray[np.uint8]) -> Floats:
    """Return the numbers of :data:`_SUMS` for some frames, (number, column)."""
    x, y, intensity, x_stderr, y_stderr, _ = values
    accepted = (status & int(REJECTED)) == 0
    count = np.maximum(accepted.sum(axis=0), 1)
    means = {name: np.nansum(of, axis=0) / count for name, of in (("x", x), ("y", y), ("intensity", intensity))}
    return np.stack(
        [
            _made(status).sum(axis=0),
            accepted.sum(axis=0),
            means["x"],
            np.nansum((x - means["x"]) ** 2, axis=0),
            means["y"],
            np.nansum((y - means["y"]) ** 2, axis=0),
            means["intensity"],
            np.nansum(x_stderr**2 + y_stderr**2, axis=0),
        ]
    )


def _merged(one: Floats, other: Floats) -> Floats:
    """Return the sums of two lots of frames (Chan, Golub and LeVeque 1983)."""
    both = one + other
    index = {name: k for k, name in enumerate(_SUMS)}
    n, m = one[index["accepted"]], other[index["accepted"]]
    share = m / np.maximum(n + m, 1)
    for name in ("x", "y", "intensity"):
        k = index[name]
        step = other[k] - one[k]
        both[k] = one[k] + share * step
        if name != "intensity":
            both[index[2 * name]] += share * n * step**2
    return both


def _frame_numbers(part: dict[str, NDArray[Any]], drift: Floats) -> Floats:
    """Return the numbers of :data:`_FRAME` for some frames, (number, frame)."""
    accepted = (part["status"] & int(REJECTED)) == 0
    count = accepted.sum(axis=1)
    total = np.where(accepted, part["fit"][..., AMPLITUDE], 0).sum(axis=1)
    amplitude = total / np.where(count > 0, count, np.nan)
    return np.stack([_made(part["status"]).sum(axis=1), count, amplitude, *drift.T])


def _made(status: NDArray[np.uint8]) -> Flags:
    """Tell which fits were made: neither does the window leave the frame, nor has the frame bad pixels."""
    made: Flags = (status & int(Status.OUTSIDE_FRAME | Status.BAD_FRAME)) == 0
    return made


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
