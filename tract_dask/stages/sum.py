"""The sum stage: the drift-corrected mean of a movie, by whole-pixel shifts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from distributed import Client
from numpy.typing import NDArray

from ..cluster.stage_run import StageRun
from ..errors import InputError
from ..kernels.filling import fill_near
from ..kernels.sums import Whole, add_frames, coverage
from ..progress import Sink, silent
from ..settings.declare import Settings
from ..store import metadata, schema
from ..store.arrays import load_saved, save_array
from ..store.camera import Camera
from ..store.journal import Payload
from ..store.keys import Part, counted, stage_key
from ..store.movie import Movie
from ..store.shards import Shard, split
from .keep import Workers, kept
from .noise import measure_camera

Bools = NDArray[np.bool_]

SUM_PARTS = 16
"""The sum is made in at most this many parts, whatever the number of workers."""

_SHARED = 1.5
"""Sum of the noise's autocorrelation from which read noise, which pixels do not share, matters for the gain."""
_SATURATED = 0.03
"""Where a larger share of a pixel's values is cut off, its mean is not known; up to here it lacks 1 % of the noise."""
_SURE = 4.0
"""Standard errors by which the level without noise must be above the offset."""


def sum_image(
    movie: Movie,
    drift: xr.Dataset | None = None,
    *,
    client: Client | None = None,
    on_event: Sink = silent,
    journal: Path | None = None,
) -> xr.Dataset:
    """Return the drift-corrected mean of a movie in counts a frame, and how many frames cover each pixel.

    Frames are moved by whole pixels, so no value is resampled. What is left of the drift after rounding blurs the mean
    a little (0.29 px standard deviation) and moves it by its own mean, the attribute ``rounding_px`` (y, x): a
    feature at p in the summed image lies at p - rounding_px + drift in a frame. It is within 0.29 / sqrt(frames).
    How much it blurs is ``rounding_variance_px2``, up to about 1/12 px^2, the mean of y and x.

    Pixels without data, bad frames and frames whose drift has quality 0 are left out. A pixel that no frame covers has
    exposure 0, and image 0; where it is one that carries no data, the mean of what is near. Pixels that are saturated
    in more than 3 % of the frames have exposure 0, too, and the mean of what was recorded. What some of the frames
    tell of gain, offset and noise is the attribute ``camera``, which :meth:`tract_dask.store.camera.Camera.of` reads.

    Parameters
    ----------
    drift
        As :func:`estimate_drift` returns it; None for no drift.
    journal
        As for :func:`estimate_drift`.

    Returns
    -------
    xr.Dataset
        :data:`schema.SUM`, with attributes ``n_frames``, ``pixel_size_pm``, ``rounding_px``,
        ``rounding_variance_px2``, ``camera``. The same, bit for bit, for any number of workers.

    Raises
    ------
    SettingsError
        If the drift is of another movie.
    """
    shift, used = _whole_pixels(movie, drift)
    per_part = -(-len(movie.shards) // SUM_PARTS)
    parts = split(movie.n_frames, max(1, movie.shards[0].frames) * per_part)
    with StageRun("sum", movie, on_event, journal, client, runs=1) as stage:
        done = stage.journal("parts", stage_key("sum", movie.key, shift, used), {"missing": (), "saturated": ()})
        stage.begin([(done, parts)])
        payloads = stage.run(partial(_sum_part, movie, shift, used, done.path), parts, done)
        exposure = coverage(movie.shape[1:], shift[used])
        total = np.zeros(movie.shape[1:], _accumulator(movie, np.iinfo(np.int64).max))
        for part in parts:
            add_frames(total, load_saved(done.path / f"{part.index}.npy")[None], np.zeros((1, 2), np.int64))
        missing, saturated = (_count(name, done.path, parts, payloads) for name in ("missing", "saturated"))
        if missing is not None:
            exposure -= missing
        image = np.divide(total * movie.gain, exposure, out=np.zeros(total.shape), where=exposure > 0)
        image -= movie.gain * movie.offset * (exposure > 0)
        if missing is not None and not exposure.all() and exposure.any():
            image = fill_near(np.where(exposure > 0, image, np.nan)).astype(np.float64)
        mean = np.where((exposure > 0) | (image != 0), image / movie.gain + movie.offset, np.nan)
        if saturated is not None:
            exposure[saturated > _SATURATED * exposure] = 0
        rest = np.zeros((1, 2)) if drift is None else (drift["drift"].to_numpy() - shift)[used]
        covered = (exposure > used.sum() / 2) & _is_whole(image, saturated)
        camera = measure_camera(movie, mean, covered, schema.drift_of(drift, movie.n_frames), used)
        stage.end(f"mean of {int(used.sum())} frames")
    variables = {"image": image, "exposure": exposure.astype(np.uint32)}
    return xr.Dataset(
        {name: (schema.SUM[name].dims, values, schema.SUM[name].attributes) for name, values in variables.items()},
        attrs={
            "n_frames": int(used.sum()),
            "pixel_size_pm": movie.pixel_size_pm,
            "rounding_px": [float(value) for value in rest.mean(axis=0)],
            "rounding_variance_px2": float(rest.var(axis=0).mean()),
            **camera.to_attribute(),
            **({"saturated": True} if saturated is not None else {}),
        },
    )


def _count(what: str, folder: Path, parts: Sequence[Shard], payloads: dict[int, Payload]) -> Whole | None:
    """Return how often each pixel (y, x) of the sum was missing, or saturated; None where none was."""
    found = [load_saved(folder / f"{part.index}-{what}.npy") for part in parts if payloads[part.index][what]]
    return np.sum(found, axis=0, dtype=np.int64) if found else None


def _is_whole(image: NDArray[np.float64], saturated: Whole | None) -> Bools:
    """Tell which pixels (y, x) are at levels at which noise is not cut off: below nearly all saturated ones."""
    limit = np.inf if saturated is None else np.quantile(image[saturated > 0], _SATURATED)
    return np.asarray(image < limit)


def _whole_pixels(movie: Movie, drift: xr.Dataset | None) -> tuple[NDArray[np.int64], Bools]:
    """Return the drift of every frame in whole pixels, and which frames are to be summed."""
    shift = np.rint(schema.drift_of(drift, movie.n_frames)).astype(np.int64)
    used = ~schema.bad_frames(movie.statistics(), math.prod(movie.shape[1:]))
    if drift is not None:
        used &= drift["quality"].to_numpy() > 0.0
    return shift, used | (not used.any())


def _accumulator(movie: Movie, n_frames: int) -> np.dtype[Any]:
    """Return the smallest dtype that holds the sum of ``n_frames`` frames exactly; float64 for real values."""
    if movie.dtype.kind == "f":
        return np.dtype(np.float64)
    if movie.dtype.kind == "i":
        return np.dtype(np.int64)
    bits = 8 * movie.dtype.itemsize + n_frames.bit_length()
    return np.dtype(np.uint32 if bits <= 32 else np.uint64)


def _sum_part(movie: Movie, shift: NDArray[np.int64], used: Bools, folder: Path, part: Shard) -> Payload:
    """Add up some frames at their places; leave the sum, and counts of missing and saturated pixels, in ``folder``."""
    total = np.zeros(movie.shape[1:], _accumulator(movie, part.frames))
    missing = np.zeros(movie.shape[1:] if movie.dtype.kind == "f" else (0, 0), np.int64)
    full = movie.full_scale
    saturated = np.zeros(movie.shape[1:] if full is not None else (0, 0), np.int64)
    first, last = part.start // movie.frames_per_shard, -(-part.stop // movie.frames_per_shard)
    for start, top, left, tile in chain.from_iterable(map(movie.tiles, movie.shards[first:last])):
        here = slice(start, start + len(tile))
        frames, places = tile, shift[here] - [top, left]
        if not used[here].all():
            frames, places = frames[used[here]], places[used[here]]
        if full is not None and (reached := np.isposinf(frames)).any():
            add_frames(saturated, reached, places)
            frames = np.where(reached, frames.dtype.type(full), frames)
        if missing.size and not (finite := np.isfinite(frames)).all():
            add_frames(missing, ~finite, places)
            frames = np.where(finite, frames, 0.0)
        add_frames(total, frames, places)
    save_array(folder / f"{part.index}.npy", total)
    if missing.any():
        save_array(folder / f"{part.index}-missing.npy", missing)
    if saturated.any():
        save_array(folder / f"{part.index}-saturated.npy", saturated)
    return {"missing": bool(missing.any()), "saturated": bool(saturated.any())}


def sum_stage(
    movie: Movie, drift: xr.Dataset | None, path: Path, workers: Workers, on_event: Sink = silent
) -> xr.Dataset:
    """Return the drift-corrected sum of ``movie``, kept at ``path``.

    Gain and offset that are to be measured go into the movie's store, and into the sum: open the movie again.

    Raises
    ------
    InputError
        Where they are to be measured, and cannot be.
    """
    moved = [] if drift is None else [drift[name].to_numpy() for name in ("drift", "quality")]
    key = stage_key("sum", movie.key, counted("sum"), *_scale(movie), *moved)

    def make(journal: Path) -> xr.Dataset:
        summed = sum_image(movie, drift, client=workers(), on_event=on_event, journal=journal)
        if not movie.to_measure:
            return summed
        gain, offset = _measured(movie, summed)
        image = (summed["image"] / movie.gain + movie.offset - offset) * gain
        known = (summed["exposure"] > 0) | (summed["image"] != 0)  # what was filled is not 0
        return summed.assign(image=image.where(known, 0.0).assign_attrs(summed["image"].attrs))

    summed = kept("sum", movie, path, key, Settings(), make, on_event)
    gain, offset = _measured(movie, summed)
    if (gain, offset) != (movie.gain, movie.offset):
        metadata.update_attributes(movie.path, gain=gain, offset=offset)
    return summed


def _scale(movie: Movie) -> tuple[Part, ...]:
    """Return what counts of gain and offset in the key of the sum."""
    if movie.to_measure:
        return ("measured", *movie.to_measure)
    return (movie.gain, movie.offset) if movie.offset else (movie.gain,)


def _hides_read_noise(camera: Camera, offset: float | None) -> bool:
    """Tell whether pixels share electrons, and the offset, or None, does not tell how much read noise is with them."""
    if camera.shared.sum() < _SHARED or camera.zero is None:
        return False
    return offset is None or offset < camera.zero - _SURE * (camera.zero_stderr or 0.0)


def _measured(movie: Movie, summed: xr.Dataset) -> tuple[float, float]:
    """Return the gain and the offset of a movie, from its camera where they are to be measured."""
    wanted, camera = movie.to_measure, Camera.of(summed.attrs)
    if wanted and camera.per_electron is None:
        raise InputError(
            f"{' and '.join(wanted)} cannot be measured: {camera.reason}",
            str(movie.path),
            "vacuum and columns of different brightness in a dozen frames or more",
            f"{movie.n_frames} frames",
            f"Give {' and '.join(f'--{name}' for name in wanted)} as numbers",
        )
    if "gain" in wanted and _hides_read_noise(camera, None if "offset" in wanted else movie.offset):
        raise InputError(
            "the gain cannot be measured: pixels share their electrons, but not their read noise",
            str(movie.path),
            "an offset that is known, which tells how much of the noise is read noise",
            "no offset" if "offset" in wanted else f"an offset of {movie.offset:.4g}",
            "Give the level of a frame without beam as --offset, or the gain as --gain",
        )
    gain = 1 / camera.per_electron if "gain" in wanted and camera.per_electron else movie.gain
    level = camera.zero if camera.offset is None else camera.offset
    return gain, movie.offset if "offset" not in wanted or level is None else level
