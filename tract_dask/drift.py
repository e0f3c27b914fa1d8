"""Drift of the whole field, frame by frame, and the drift-corrected sum of a movie.

A frame's drift says where its content lies against the summed image: raw position = summed position + drift.

Drift is measured on a level of about a million pixels a frame, in three runs over the movie, each a task a shard.
The first run follows the movie: a frame is searched for near the one before it, against the sum of those before, and
the shards' means are then chained in the same way. No step may exceed the search range, 0.4 of the lattice period
unless the user says otherwise, so one lattice vector more or less is never an answer. The second and third run fit
every frame to the mean of all others, to sub-pixel.
"""

from __future__ import annotations

import csv
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import xarray as xr
from distributed import Client
from numpy.typing import NDArray

from . import schema
from .errors import SettingsError, SourceError
from .kernels.registration import (
    Image,
    LowPass,
    Spectrum,
    add_shifted,
    align,
    correlation,
    fold_image,
    measure_spectrum,
    moments,
    search,
)
from .movie import Movie
from .passes import Passes, save_array
from .progress import Sink, StageDone, StageStarted, Warned, silent
from .provenance import stage_key
from .settings import DriftSettings
from .shards import Payload, Shard

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LEVEL_PIXELS = 1 << 20
"""Drift is measured on the finest level with at most this many pixels a frame."""

FOLD_LOSS = 0.03
"""It is binned by 2 and 2 again as long as that loses less than this share of the information on position."""

SMALLEST_SIDE = 64
"""But not below this, px."""

SEARCH_SHARE = 0.4
"""Search range as a share of the lattice period: two answers within it are never a period apart."""

PASSES = ("follow", "refine-1", "refine-2")

_BLOCK_BYTES = 64 << 20
_SAMPLES, _SAMPLE_FRAMES = 4, 4
_TRUST = 0.5
_MEMORY = 16


def estimate_drift(
    movie: Movie,
    settings: DriftSettings | None = None,
    *,
    client: Client | None = None,
    on_event: Sink = silent,
    journal: Path | None = None,
) -> xr.Dataset:
    """Return the drift of every frame, (frame, axis) in px, zero at its median, and a quality for each frame.

    Quality is Pearson's correlation of the filtered frame with the filtered mean of all others, cut to 0..1; it falls
    with the dose. It is 0 where a frame holds nothing to register (all NaN, or constant); the drift of such a frame
    is interpolated. For methods csv and none it is 1.

    Parameters
    ----------
    journal
        Folder for the journals and partial sums of this stage: a later call with the same folder goes on where this
        one stopped. Delete it once the result is stored. It must be seen by every worker; None takes a folder for
        temporary files.
    on_event
        Told of ``drift``; for method auto every frame counts three times, once for each run over the movie.

    Returns
    -------
    xr.Dataset
        :data:`schema.DRIFT`, with attributes ``method``, ``pixel_size_pm``, and for method auto ``bin``,
        ``search_px`` and ``period_px`` (None: no lattice found), in px of the movie.

    Raises
    ------
    SettingsError, SourceError
        For method csv, if the file cannot be used.
    """
    started = perf_counter()
    settings = settings or DriftSettings()
    if settings.method == "auto":
        return _measure_drift(movie, settings, client, on_event, journal)
    on_event(StageStarted("drift", movie.n_frames))
    if settings.method == "none":
        drift = np.zeros((movie.n_frames, 2))
    elif settings.csv is None:
        raise SettingsError(
            "method csv needs a file", "setting csv (DriftSettings)", "a path", "None", "Give --drift-csv FILE"
        )
    else:
        drift = read_drift_csv(settings.csv, movie.n_frames)
    on_event(StageDone("drift", perf_counter() - started, summary=f"method {settings.method}"))
    return _dataset(drift, np.ones(movie.n_frames), movie, method=settings.method)


def read_drift_csv(path: str | Path, n_frames: int) -> Floats:
    """Return the drift in a CSV file with columns frame, y, x: (frames, 2) in px, as it stands there.

    Rows may come in any order; other columns are ignored; frames count from 0.

    Raises
    ------
    SourceError
        Naming the line: no such file, a missing column, something that is no number, a frame that is missing, twice
        there, or not in the movie.
    """
    remedy = "Give one row for each frame: frame (from 0), y, x, in px"
    drift = np.full((n_frames, 2), np.nan)
    line_of: dict[int, int] = {}
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            header = [name.strip() for name in reader.fieldnames or ()]
            reader.fieldnames = header
            missing = [name for name in ("frame", "y", "x") if name not in header]
            if missing:
                expected, got = "columns frame, y, x", ", ".join(header) or "an empty file"
                raise SourceError(f"column {missing[0]!r} is missing", f"{path}, line 1", expected, got, remedy)
            for row in reader:
                where = f"{path}, line {reader.line_num}"
                frame, shift = _parse_row(row, where, n_frames, remedy)
                if frame in line_of:
                    what = f"frame {frame} is there twice"
                    raise SourceError(what, where, "each frame once", f"also in line {line_of[frame]}", remedy)
                line_of[frame], drift[frame] = reader.line_num, shift
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError("the drift file cannot be read", str(path), got=str(error), remedy=remedy) from error
    absent = np.flatnonzero(np.isnan(drift[:, 0]))
    if absent.size:
        got = f"{len(line_of)} frames; the first one missing is {absent[0]}"
        raise SourceError("frames are missing", str(path), f"all {n_frames} frames of the movie", got, remedy)
    return drift


def _parse_row(row: dict[str, Any], where: str, n_frames: int, remedy: str) -> tuple[int, tuple[float, float]]:
    try:
        frame, y, x = (float(row[name]) for name in ("frame", "y", "x"))
    except (TypeError, ValueError):
        got = ", ".join(repr(row[name]) for name in ("frame", "y", "x"))
        raise SourceError("this is not a number", where, "three numbers", got, remedy) from None
    if not np.isfinite([y, x]).all():
        raise SourceError("the drift is not finite", where, "two numbers in px", f"{y}, {x}", remedy)
    if not (frame.is_integer() and 0 <= frame < n_frames):
        raise SourceError("there is no such frame", where, f"0 to {n_frames - 1}", str(row["frame"]), remedy)
    return int(frame), (y, x)


def _dataset(drift: Floats, quality: Floats, movie: Movie, **attributes: Any) -> xr.Dataset:
    variables = {"drift": drift, "quality": quality}
    return xr.Dataset(
        {name: (schema.DRIFT[name].dims, values, schema.DRIFT[name].attributes) for name, values in variables.items()},
        coords={"frame": np.arange(len(drift)), "axis": ("axis", schema.texts(schema.AXES))},
        attrs={"pixel_size_pm": movie.pixel_size_pm, **attributes},
    )


# --- one stage: journals, events -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Level:
    """The level that drift is measured on.

    Attributes
    ----------
    stored
        Binning of the level as it is read; 1 for the movie itself.
    fold
        Further binning after it is read.
    shape
        (y, x) of a frame of the level.
    spectrum
        Of the movie's frames on this level.
    search
        Search range, px of the level.
    """

    stored: int
    fold: int
    shape: tuple[int, int]
    spectrum: Spectrum
    search: float

    @property
    def bin(self) -> int:
        """Pixels of the movie along one side of a pixel of the level."""
        return self.stored * self.fold

    def low_pass(self, n_frames: float) -> LowPass:
        """Return the filter for a mean of ``n_frames`` frames."""
        return LowPass(self.shape, self.spectrum.frequency, self.spectrum.gain(n_frames))


@dataclass
class Track:
    """What is known of every frame between two runs; px of the level.

    Attributes
    ----------
    drift
        (frames, 2).
    placed
        (frames, 2) whole pixels by which the frame was moved into the present sum.
    trusted
        (frames,) whether it is part of that sum.
    """

    drift: Floats
    placed: NDArray[np.int64]
    trusted: Bools

    def save(self, path: Path) -> None:
        """Write it as one table."""
        save_array(path, np.column_stack([self.drift, self.placed, self.trusted]))

    @classmethod
    def load(cls, path: Path, shard: Shard) -> Track:
        """Return the part of a saved track that belongs to a shard."""
        table = np.load(path, mmap_mode="r")[shard.start : shard.stop]
        return cls(np.array(table[:, :2]), table[:, 2:4].astype(np.int64), table[:, 4] > 0)


def _measure_drift(
    movie: Movie, settings: DriftSettings, client: Client | None, on_event: Sink, folder: Path | None
) -> xr.Dataset:
    level = _choose_level(movie, settings)
    with Passes("drift", movie, on_event, folder, client, len(PASSES)) as stage:
        key = stage_key(movie.key, f"drift {settings.search_px!r}")
        journals = [stage.journal(name, f"{name} {key}") for name in PASSES]
        stage.begin([(journal, movie.shards) for journal in journals])
        follow = journals[0]
        payloads = stage.run(partial(_follow_shard, movie, level, follow.path), movie.shards, follow)
        track, template = _chain(level, movie.shards, payloads, follow.path)
        quality = np.zeros(movie.n_frames)
        for journal in journals[1:]:
            save_array(journal.path / "template.npy", template)
            track.save(journal.path / "track.npy")
            payloads = stage.run(partial(_refine_shard, movie, level, journal.path), movie.shards, journal)
            found = np.concatenate([np.array(payloads[shard.index]["drift"]) for shard in movie.shards])
            quality = np.concatenate([np.array(payloads[shard.index]["quality"]) for shard in movie.shards])
            template = np.zeros_like(template)
            for shard in movie.shards:
                template += np.load(journal.path / f"{shard.index}.npy")
            track = Track(found, np.rint(found).astype(np.int64), track.trusted)
        drift = _fill(track.drift, quality > 0.0)
        if not (quality > 0.0).any():
            on_event(Warned("no frame shows a structure to measure drift by; drift is taken as zero"))
        drift = level.bin * (drift - np.median(drift, axis=0))
        stage.end(f"largest {np.abs(drift).max():.1f} px, median quality {np.median(quality):.2f}")
    return _dataset(
        drift,
        quality,
        movie,
        method="auto",
        bin=level.bin,
        search_px=level.search * level.bin,
        period_px=level.spectrum.period_px * level.bin if np.isfinite(level.spectrum.period_px) else None,
    )


def _choose_level(movie: Movie, settings: DriftSettings) -> Level:
    """Return the finest stored level that is small enough, binned further where that loses next to nothing."""
    ny, nx = movie.shape[1:]
    bins = sorted({1, *movie.bins})
    stored = next((b for b in bins if (ny // b) * (nx // b) <= LEVEL_PIXELS), bins[-1])
    samples = _samples(movie, stored)
    spectrum, fold = measure_spectrum(samples), 1
    while spectrum.loss(2) < FOLD_LOSS and min(ny, nx) // (stored * fold) >= 2 * SMALLEST_SIDE:
        fold *= 2
        samples = [fold_image(image, 2) for image in samples]
        spectrum = measure_spectrum(samples)
    shape = (ny // stored // fold, nx // stored // fold)
    period = spectrum.period_px if np.isfinite(spectrum.period_px) else min(shape) / (8 * SEARCH_SHARE)
    reach = settings.search_px / (stored * fold) if settings.search_px is not None else SEARCH_SHARE * period
    return Level(stored, fold, shape, spectrum, max(1.0, reach))


def _samples(movie: Movie, stored: int) -> list[Image]:
    """Return some frames spread over the movie; a blank one where none of them holds anything."""
    starts = sorted({k * movie.n_frames // _SAMPLES for k in range(_SAMPLES)})
    stops = [*starts[1:], movie.n_frames]
    runs = [Shard(0, start, min(stop, start + _SAMPLE_FRAMES)) for start, stop in zip(starts, stops, strict=True)]
    images = [image for run in runs for image in _read(movie, stored, run) if image is not None]
    return images or [np.zeros((movie.shape[1] // stored, movie.shape[2] // stored), np.float32)]


def _frames(movie: Movie, level: Level, shard: Shard) -> Iterator[Image | None]:
    """Yield the frames of a shard on a level, less the movie's mean; None for one that holds nothing."""
    for image in _read(movie, level.stored, shard):
        yield None if image is None else fold_image(image, level.fold) - np.float32(level.spectrum.mean)


def _read(movie: Movie, stored: int, shard: Shard) -> Iterator[Image | None]:
    """Yield the frames of a shard on a stored level, a few read at a time; None for one that holds nothing.

    NaN and infinite pixels are replaced by the frame's mean.
    """
    ny, nx = movie.shape[1] // stored, movie.shape[2] // stored
    step = max(1, _BLOCK_BYTES // (ny * nx * (movie.dtype.itemsize if stored == 1 else 4)))
    for start in range(shard.start, shard.stop, step):
        stop = min(start + step, shard.stop)
        block = movie.read(start, stop) if stored == 1 else movie.read_binned(stored, start, stop)
        for raw in block[:, :ny, :nx]:  # without bins that hang over the edge
            image = raw.astype(np.float32)
            if raw.dtype.kind == "f" and not (finite := np.isfinite(image)).all():
                image[~finite] = image[finite].mean(dtype=np.float64) if finite.any() else 0.0
            yield image if image.min() < image.max() else None


class _Reference:
    """The running sum of images that move: keeps itself where the newest is, and its filtered form up to date."""

    def __init__(self, level: Level) -> None:
        self.level = level
        self.total, self.exposure = np.zeros(level.shape, np.float32), np.zeros(level.shape, np.float32)
        self.origin = np.zeros(2)
        self._template, self._count = np.zeros(level.shape, np.float32), 0.0

    @property
    def empty(self) -> bool:
        return not self.exposure.any()

    def find(self, image: Image, guess: Floats) -> tuple[Floats, float]:
        """Return the shift of an image near a guess, and its score."""
        template, origin = self.template(), self.origin
        dy, dx, score = search(image, template, tuple(guess - origin), self.level.search)
        return np.array([dy, dx]) + origin, score

    def template(self) -> Image:
        """Return the filtered mean; it is made anew whenever the sum has grown by a quarter."""
        count = float(self.exposure.max())
        if count >= 1.25 * self._count:
            self._template, self._count = self.level.low_pass(count)(self.total) / np.float32(count), count
        return self._template

    def add(self, total: Image, exposure: Image, shift: Floats) -> None:
        """Add an image, or a sum of images, that lies at ``shift``; move along where it is far from the origin."""
        away = np.rint(shift) - self.origin
        if (np.abs(away) > np.array(self.level.shape) / 8).any():
            for name in ("total", "exposure"):
                moved = np.zeros(self.level.shape, np.float32)
                add_shifted(moved, getattr(self, name), _whole(-away))
                setattr(self, name, moved)
            self.origin, self._count, away = self.origin + away, 0.0, np.zeros(2)
        add_shifted(self.total, total, _whole(away))
        add_shifted(self.exposure, exposure, _whole(away))


def _follow_shard(movie: Movie, level: Level, folder: Path, shard: Shard) -> Payload:
    """Follow the drift through a shard; leave the sum of its frames, aligned to whole pixels, in ``folder``."""
    reference, ones = _Reference(level), np.ones(level.shape, np.float32)
    shifts, guess = np.full((shard.frames, 2), np.nan), np.zeros(2)
    recent: deque[float] = deque(maxlen=_MEMORY)
    for k, image in enumerate(_frames(movie, level, shard)):
        if image is None:
            continue
        shifts[k] = guess
        if not reference.empty:
            shifts[k], score = reference.find(image, guess)
            if recent and score < _TRUST * np.median(recent):
                continue
            recent.append(score)
        reference.add(image, ones, shifts[k])
        guess = shifts[k]
    shifts -= reference.origin
    trusted = _trusted(movie, level, shard, reference, shifts)
    save_array(folder / f"{shard.index}.npy", np.stack([reference.total, reference.exposure]))
    return {"drift": shifts.tolist(), "trusted": trusted.tolist()}


def _trusted(movie: Movie, level: Level, shard: Shard, reference: _Reference, shifts: Floats) -> Bools:
    """Tell which frames of a shard resemble its mean: at least half as much as their median does."""
    if reference.empty:
        return np.zeros(shard.frames, np.bool_)
    template = reference.template()
    weight = (reference.exposure > 0.5 * reference.exposure.max()).astype(np.float32)
    scores = np.array(
        [
            np.nan if image is None else correlation(moments(image, template, weight, dy, dx))
            for image, (dy, dx) in zip(_frames(movie, level, shard), shifts, strict=True)
        ]
    )
    return np.asarray(scores >= _TRUST * np.nanmedian(scores))


def _chain(
    level: Level, shards: tuple[Shard, ...], payloads: dict[int, Payload], folder: Path
) -> tuple[Track, NDArray[np.float32]]:
    """Join the shards: each mean is searched for where the shard before it ended. Return the track and the sum."""
    n_frames = shards[-1].stop
    track = Track(np.full((n_frames, 2), np.nan), np.zeros((n_frames, 2), np.int64), np.zeros(n_frames, np.bool_))
    offsets: dict[Shard, Floats] = {}
    reference, last = _Reference(level), np.zeros(2)
    for shard in shards:
        shifts, trusted = np.array(payloads[shard.index]["drift"]), np.array(payloads[shard.index]["trusted"])
        if not trusted.any():
            continue
        total, exposure = np.load(folder / f"{shard.index}.npy")
        first, final = np.flatnonzero(trusted)[[0, -1]]
        offset = np.zeros(2)
        if offsets:
            offset, _ = reference.find(total / max(1.0, float(exposure.max())), last - shifts[first])
        reference.add(total, exposure, offset)
        offsets[shard], last = offset, offset + shifts[final]
        here = slice(shard.start, shard.stop)
        track.drift[here], track.trusted[here] = shifts + offset, trusted
        track.placed[here][trusted] = np.rint(shifts[trusted])
    track.drift = _fill(track.drift, track.trusted)
    zero = np.rint(np.median(track.drift, axis=0))
    track.drift -= zero
    template = np.zeros((2, *level.shape), np.float32)
    for shard, offset in offsets.items():
        place = np.rint(offset - zero)
        track.placed[shard.start : shard.stop] += place.astype(np.int64)
        for target, part in zip(template, np.load(folder / f"{shard.index}.npy"), strict=True):
            add_shifted(target, part, _whole(place))
    return track, template


def _refine_shard(movie: Movie, level: Level, folder: Path, shard: Shard) -> Payload:
    """Fit each frame of a shard to the mean of all other frames; leave the sum of its frames at their new places."""
    track = Track.load(folder / "track.npy", shard)
    total, exposure = np.load(folder / "template.npy")
    count = float(exposure.max())
    low_pass = level.low_pass(max(1.0, count - 1.0))
    total, exposure, one = low_pass(total), low_pass(exposure), low_pass(np.ones(level.shape, np.float32))
    drift, quality = track.drift.copy(), np.zeros(shard.frames)
    sums = np.zeros((2, *level.shape), np.float32)
    ones = np.ones(level.shape, np.float32)
    for k, image in enumerate(_frames(movie, level, shard)):
        if image is None:
            continue
        smooth = low_pass(image)
        others, seen, n = total, exposure, max(count, 1.0)
        if track.trusted[k] and count > 1.0:
            others, seen, n = total.copy(), exposure.copy(), count - 1.0
            add_shifted(others, -smooth, _whole(track.placed[k]))
            add_shifted(seen, -one, _whole(track.placed[k]))
        weight = (seen > 0.5 * n).astype(np.float32)
        template: Image = np.divide(others * weight, np.maximum(seen, 0.5 * n), dtype=np.float32)
        fit = align(image, template, weight, tuple(track.drift[k]), limit=level.search / 2)
        drift[k] = fit.dy, fit.dx
        quality[k] = np.clip(correlation(moments(smooth, template, weight, fit.dy, fit.dx)), 0.0, 1.0)
        if track.trusted[k]:
            add_shifted(sums[0], image, _whole(drift[k]))
            add_shifted(sums[1], ones, _whole(drift[k]))
    save_array(folder / f"{shard.index}.npy", sums)
    return {"drift": drift.tolist(), "quality": quality.tolist()}


def _fill(drift: Floats, good: Bools) -> Floats:
    """Return the drift with the frames that are not good interpolated from their neighbours; zeros if none is good."""
    if not good.any():
        return np.zeros_like(drift)
    frames, known = np.arange(len(drift)), np.flatnonzero(good)
    filled = np.stack([np.interp(frames, known, drift[known, axis]) for axis in range(2)], axis=1)
    return np.where(good[:, None], drift, filled)


def _whole(shift: NDArray[Any]) -> tuple[int, int]:
    """Return a shift in whole pixels."""
    dy, dx = np.rint(shift)
    return int(dy), int(dx)
