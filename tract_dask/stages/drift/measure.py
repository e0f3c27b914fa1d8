"""Measuring the drift: following by parts of the movie, then against the mean of the others."""

from __future__ import annotations

from bisect import insort
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from distributed import Client
from numpy.typing import NDArray

from ...cluster.stage_run import StageRun
from ...kernels.alignment import Template, align
from ...kernels.filling import fill_near
from ...kernels.magnitude import unit_of
from ...kernels.registration import (
    Floats,
    Image,
    clean_image,
    fold_image,
    measure_spectrum,
)
from ...kernels.sums import Whole, add_shifted
from ...progress import Sink, Warned
from ...settings.run import DriftSettings
from ...store import schema
from ...store.arrays import load_array, load_saved, save_array
from ...store.journal import Fields, Payload
from ...store.keys import counted, stage_key
from ...store.movie import Movie
from ...store.provenance import processor
from ...store.shards import Shard, Shards, split
from .follow import MEMORY, TRUST, Follower, Level, MovingSum, whole

Bools = NDArray[np.bool_]

LEVEL_PIXELS = 1 << 20
"""Drift is measured on the finest level with at most this many pixels a frame."""

FOLD_LOSS = 0.03
"""It is binned by 2 and 2 again as long as that loses less than this share of the information on position."""

SMALLEST_SIDE = 64
"""But not below this, px."""

SEARCH_SHARE = 0.4
"""Search range as a share of the lattice period: two answers within it are never a period apart."""

SEARCH_LOSS = 0.75
"""For the search it is binned by 2 and 2 again as long as that loses less than this share of the information."""

PASSES: dict[str, Fields] = {
    "follow": {"drift": (None, 2), "placed": (None, 2), "trusted": (None,), "doubtful": (None,)},
    "refine": {"drift": (None, 2), "quality": (None,)},
}
"""The two runs over the movie, and what a shard's payload holds after each."""

MOST_NAMED = 12
"""Frames that a warning names."""

_BLOCK_BYTES = 16 << 20

_SAMPLES, _SAMPLE_FRAMES = 4, 2

_FEWEST_PARTS, _PART_FRAMES = 8, 64

_FAINT, _BEYOND = 0.05, 6.0
"""A frame is lost that shows less than this share of the structure's usual power, and whose quality is more than so
many standard deviations below the usual."""


def drift_dataset(drift: Floats, quality: Floats, movie: Movie, **attributes: Any) -> xr.Dataset:
    """Return the drift (frame, axis) and its quality (frame,) as a Dataset."""
    variables = {"drift": drift, "quality": quality}
    return xr.Dataset(
        {name: (schema.DRIFT[name].dims, values, schema.DRIFT[name].attributes) for name, values in variables.items()},
        coords={"frame": np.arange(len(drift)), "axis": ("axis", schema.texts(schema.AXES))},
        attrs={"pixel_size_pm": movie.pixel_size_pm, **attributes},
    )


# --- one stage: journals, events -----------------------------------------------------------------------------------


@dataclass
class Track:
    """What is known of every frame between the two runs; px of the level.

    Attributes
    ----------
    drift
        (frames, 2).
    placed
        (frames, 2) whole pixels by which the frame was moved into the sum.
    trusted
        (frames,) whether it is part of that sum.
    doubtful
        (frames,) whether the step to it may be wrong by a whole period.
    """

    drift: Floats
    placed: Whole
    trusted: Bools
    doubtful: Bools

    def save(self, path: Path) -> None:
        """Write it as one table."""
        save_array(path, np.column_stack([self.drift, self.placed, self.trusted, self.doubtful]))

    @classmethod
    def load(cls, path: Path, shard: Shard) -> Track:
        """Return the part of a saved track that belongs to a shard."""
        table = load_array(path, mmap_mode="r")[shard.start : shard.stop]
        return cls(np.array(table[:, :2]), table[:, 2:4].astype(np.int64), table[:, 4] > 0, table[:, 5] > 0)


def measure_drift(
    movie: Movie, settings: DriftSettings, client: Client | None, on_event: Sink, folder: Path | None
) -> xr.Dataset:
    """Measure the drift of a movie; ``folder`` is the journal's."""
    level = _choose_level(movie, settings)
    shards = _parts(movie)
    with StageRun("drift", movie, on_event, folder, client, len(PASSES)) as stage:
        key = stage_key("drift", movie.key, counted("drift", drift=settings))
        follow, refine = (stage.journal(name, f"{name} {key}", fields) for name, fields in PASSES.items())
        stage.begin([(follow, shards), (refine, shards)])
        payloads = stage.run(partial(_follow_shard, movie, level, follow.path), shards, follow)
        track, places = _chain(level, shards, payloads, follow.path)
        save_array(refine.path / "sum.npy", _add_up(level, places, follow.path))
        save_array(refine.path / "places.npy", places)
        track.save(refine.path / "track.npy")
        payloads = stage.run(partial(_refine_shard, movie, level, follow.path, refine.path), shards, refine)
        found = np.concatenate([np.array(payloads[shard.index]["drift"]) for shard in shards])
        quality = np.concatenate([np.array(payloads[shard.index]["quality"]) for shard in shards])
        quality[lost_frames(quality)] = 0.0
        drift = _fill(_on_one_scale(found, track, shards), quality > 0.0)
        doubtful = np.flatnonzero(track.doubtful & (quality > 0.0))
        if doubtful.size:
            on_event(Warned(doubt_in_words(doubtful.tolist())))
        if not (quality > 0.0).any():
            on_event(Warned("no frame shows a structure to measure drift by; drift is taken as zero"))
        drift = level.bin * (drift - np.median(drift, axis=0))
        held = int((quality == 0).sum())
        lost = f", {held} frames lost" if held else ""
        stage.end(f"largest {np.abs(drift).max():.1f} px, median quality {np.median(quality):.2f}{lost}")
    return drift_dataset(
        drift,
        quality,
        movie,
        method="auto",
        bin=level.bin,
        processors=sorted({payload["processor"] for payload in payloads.values()}),
        search_px=level.search * level.bin,
        doubtful=doubtful.tolist(),
        period_px=level.spectrum.period_px * level.bin if np.isfinite(level.spectrum.period_px) else None,
    )


def doubt_in_words(frames: Sequence[int]) -> str:
    """Return what is said of frames whose drift may be wrong by a whole period.

    Examples
    --------
    >>> doubt_in_words([20])
    'the step of the drift to frame 20 may be wrong by a whole period of the lattice: give it by --drift-csv'
    """
    named = ", ".join(map(str, frames[:MOST_NAMED])) + ("" if len(frames) <= MOST_NAMED else " …")
    many = "s" if len(frames) > 1 else ""
    steps = f"the step{many} of the drift to frame{many} {named} may be wrong by a whole period of the lattice"
    return f"{steps}: give {'them' if many else 'it'} by --drift-csv"


def _parts(movie: Movie) -> Shards:
    """Return the parts of the movie that are worked on at a time: whole shards, or less where an eighth of it is less.

    Each part is compared with the mean of all others: it must be a small part of the movie, but a task spends some time
    on that mean, whatever the number of its frames.
    """
    per_shard, eighth = movie.shards[0].frames, -(-movie.n_frames // _FEWEST_PARTS)
    return split(movie.n_frames, max(min(per_shard, eighth), min(_PART_FRAMES, eighth) // per_shard * per_shard))


def _choose_level(movie: Movie, settings: DriftSettings) -> Level:
    """Return the finest stored level that is small enough, binned further where that loses next to nothing."""
    ny, nx = movie.shape[1:]
    bins = sorted({1, *movie.bins})
    stored = next((b for b in bins if (ny // b) * (nx // b) <= LEVEL_PIXELS), bins[-1])
    samples = _samples(movie, stored)
    unit = unit_of(samples[0])
    samples = [_in_units(image, unit) for image in samples]
    spectrum, fold = measure_spectrum(samples), 1
    while spectrum.loss(2) < FOLD_LOSS and min(ny, nx) // (stored * fold) >= 2 * SMALLEST_SIDE:
        fold *= 2
        samples = [fold_image(image, 2) for image in samples]
        spectrum = measure_spectrum(samples)
    shape = (ny // stored // fold, nx // stored // fold)
    period = spectrum.period_px if np.isfinite(spectrum.period_px) else min(shape) / (8 * SEARCH_SHARE)
    reach = settings.search_px / (stored * fold) if settings.search_px is not None else SEARCH_SHARE * period
    search_fold = 1
    while spectrum.loss(2 * search_fold) < SEARCH_LOSS and min(shape) // search_fold >= 2 * SMALLEST_SIDE:
        search_fold *= 2
    return Level(stored, fold, shape, spectrum, max(1.0, reach), search_fold, unit, settings.search_px is None)


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
        if image is None:
            yield None
        else:
            yield fold_image(_in_units(image, level.unit), level.fold) - np.float32(level.spectrum.mean)


def _in_units(image: Image, unit: float) -> Image:
    return image if unit == 1 else (image / unit).astype(np.float32)


def _read(movie: Movie, stored: int, shard: Shard) -> Iterator[Image | None]:
    """Yield the frames of a shard on a stored level, a few read at a time; None for one that holds nothing.

    Pixels without data are filled with the mean of what is near.
    """
    ny, nx = movie.shape[1] // stored, movie.shape[2] // stored
    step = max(1, _BLOCK_BYTES // (ny * nx * (movie.dtype.itemsize if stored == 1 else 4)))
    for start in range(shard.start, shard.stop, step):
        stop = min(start + step, shard.stop)
        block = movie.read(start, stop) if stored == 1 else movie.read_binned(stored, start, stop)
        if stored == 1 and movie.full_scale is not None:
            block[np.isposinf(block)] = movie.full_scale
        for raw in block[:, :ny, :nx]:  # without bins that hang over the edge
            odd = raw.dtype.kind == "f" and not np.isfinite(raw).all()
            image, shows_anything = clean_image(fill_near(raw) if odd else raw)
            yield image if shows_anything else None


# --- the first run: following the movie ------------------------------------------------------------------------------


def _follow_shard(movie: Movie, level: Level, folder: Path, shard: Shard) -> Payload:
    """Follow the drift through a shard; leave the sum of its frames, moved by whole pixels, in ``folder``.

    Frames with less than half the usual score are not part of it. The first ones are judged again, by all of them
    together, before any is added: the very first had nothing to be compared with.
    """
    follower, added = Follower(level), MovingSum((2, *level.shape))
    shifts, scores, guess = np.zeros((shard.frames, 2)), np.full(shard.frames, np.nan), np.zeros(2)
    trusted, doubtful = np.zeros((2, shard.frames), np.bool_)
    images = _frames(movie, level, shard)
    pairs = ((image, None if image is None else fold_image(image, level.search_fold)) for image in images)
    opening = list(islice(pairs, MEMORY))
    for k, (_, small) in enumerate(opening):
        if small is not None:
            shifts[k], _ = guess, _ = follower.follow(small, guess)
            doubtful[k] = follower.is_doubtful
    for k, (_, small) in enumerate(opening):
        if small is not None:
            scores[k] = follower.resemblance(small, shifts[k])
    ranked = sorted(scores[~np.isnan(scores)].tolist())
    counted = np.ones((2, *level.shape), np.float32)
    for k, (image, small) in enumerate(chain(opening, pairs)):
        if image is None or small is None:
            continue
        if k >= len(opening):
            shifts[k], scores[k] = guess, score = follower.follow(small, guess)
            doubtful[k] = follower.is_doubtful
            if not np.isnan(score):
                insort(ranked, score)
        trusted[k] = scores[k] >= TRUST * _middle(ranked)
        if trusted[k]:
            counted[0] = image
            added.add(counted, whole(shifts[k]))
    save_array(folder / f"{shard.index}.npy", added.total)
    placed = whole(shifts) - added.origin
    return {"drift": shifts - added.origin, "placed": placed, "trusted": trusted, "doubtful": doubtful}


def _middle(ranked: Sequence[float]) -> float:
    """Return the median of numbers in order; NaN if there are none."""
    return (ranked[(len(ranked) - 1) // 2] + ranked[len(ranked) // 2]) / 2 if ranked else np.nan


def _chain(level: Level, shards: Sequence[Shard], payloads: dict[int, Payload], folder: Path) -> tuple[Track, Whole]:
    """Join the shards: the sum of each is searched for where the shard before it ended.

    Returns the track, and by how many pixels the sum of each shard is moved into that of all, (shards, 2).
    """
    n_frames = shards[-1].stop
    trusted, doubtful = np.zeros((2, n_frames), np.bool_)
    track = Track(np.zeros((n_frames, 2)), np.zeros((n_frames, 2), np.int64), trusted, doubtful)
    offsets, follower, last = np.zeros((len(shards), 2)), Follower(level), np.zeros(2)
    for shard in shards:
        drift, placed, trusted = (np.array(payloads[shard.index][name]) for name in ("drift", "placed", "trusted"))
        if not trusted.any():
            continue
        here = slice(shard.start, shard.stop)
        first, final = np.flatnonzero(trusted)[[0, -1]]
        total, exposure = load_saved(folder / f"{shard.index}.npy")
        guess = last - drift[first] if track.trusted.any() else np.zeros(2)
        small = fold_image(total / np.float32(max(1.0, exposure.max())), level.search_fold)
        offset, _ = follower.follow(small, guess)
        offsets[shard.index] = offset
        if not follower.is_sure:  # a part without crystal: what its frames seem to do leads nowhere
            continue
        last = offset + drift[final]
        track.doubtful[here] = payloads[shard.index]["doubtful"]
        track.doubtful[shard.start + first] |= follower.is_doubtful
        track.drift[here], track.placed[here], track.trusted[here] = drift + offset, placed, trusted
    track.drift = _fill(track.drift, track.trusted)
    zero = np.rint(np.median(track.drift, axis=0))
    track.drift -= zero
    places = whole(offsets - zero)
    track.placed += np.repeat(places, [shard.frames for shard in shards], axis=0)
    return track, places


def _add_up(level: Level, places: Whole, folder: Path) -> Image:
    """Return the sum of all shards and how many frames cover each of its pixels, (2, y, x)."""
    total = np.zeros((2, *level.shape), np.float32)
    for index, place in enumerate(places):
        add_shifted(total, load_saved(folder / f"{index}.npy"), place)
    return total


# --- the second run: each frame against the mean of all other shards --------------------------------------------------


def _refine_shard(movie: Movie, level: Level, follow: Path, folder: Path, shard: Shard) -> Payload:
    """Fit each frame of a shard to the mean of all other shards."""
    track = Track.load(folder / "track.npy", shard)
    template = _mean_of_others(level, follow, folder, shard)
    drift, quality = track.drift.copy(), np.zeros(shard.frames)
    for k, image in enumerate(_frames(movie, level, shard)):
        if image is not None:
            fit = align(image, template, tuple(track.drift[k]), limit=level.search / 2)
            drift[k], quality[k] = (fit.dy, fit.dx), max(0.0, fit.correlation)
    return {"drift": drift, "quality": quality, "processor": processor()}


def _mean_of_others(level: Level, follow: Path, folder: Path, shard: Shard) -> Template:
    """Return the mean of all shards but one; of all, where there is no other."""
    every, place = load_saved(folder / "sum.npy"), load_saved(folder / "places.npy")[shard.index]
    others = every.copy()
    add_shifted(others, -load_saved(follow / f"{shard.index}.npy"), place)
    total, exposure = others if others[1].any() else every
    return Template(total, exposure, level.spectrum.frequency, level.spectrum.gain(max(1.0, float(exposure.max()))))


def _on_one_scale(found: Floats, track: Track, shards: Sequence[Shard]) -> Floats:
    """Return the drift against the mean of all frames.

    What is left of the drift after rounding, drift - placed, moves a mean of frames by its own mean. For the mean that
    a shard was fitted to that is (its sum over all frames - its sum over the shard) / their number, to first order,
    also where this very correction is counted in; the sum over all moves every frame alike.
    """
    left = (found - track.placed) * track.trusted[:, None]
    own = np.add.reduceat(left, [shard.start for shard in shards])
    own = np.repeat(own, [shard.frames for shard in shards], axis=0)
    return found - own / max(1, int(track.trusted.sum()))


def lost_frames(quality: Floats) -> Bools:
    """Return which frames do not resemble the others: where the crystal is away, out of focus, or beyond the search.

    A quality of q means that q^2 / (1 - q^2) times the noise's power is structure. A frame must have a twentieth of
    what is usual, or a quality within six standard deviations of it: at a low dose quality scatters by itself.

    Examples
    --------
    >>> lost_frames(np.array([0.81, 0.8, 0.05, 0.79, 0.8, 0.0])).tolist()
    [False, False, True, False, False, True]
    """
    usual = np.median(quality[quality > 0.0]) if (quality > 0.0).any() else 0.0
    spread = np.median(np.abs(quality - usual)) / 0.6745
    power = quality**2 / np.maximum(1 - quality**2, 1e-6)
    faint = power < _FAINT * usual**2 / max(1 - usual**2, 1e-6)
    return np.asarray(faint & (quality < usual - _BEYOND * spread))


def _fill(drift: Floats, good: Bools) -> Floats:
    """Return the drift with the frames that are not good interpolated from their neighbours; zeros if none is good."""
    if not good.any():
        return np.zeros_like(drift)
    frames, known = np.arange(len(drift)), np.flatnonzero(good)
    filled = np.stack([np.interp(frames, known, drift[known, axis]) for axis in range(2)], axis=1)
    return np.where(good[:, None], drift, filled)
