"""The fit stage: every column of every frame, one task a shard; into results.zarr, or lazily for a notebook."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import xarray as xr
from distributed import Client
from numpy.typing import NDArray

from . import results, schema, stores
from .errors import SettingsError
from .journal import Journal, Payload, journal_beside, left_over, remove_journal
from .kernels.gaussian import blurred
from .keyed import counted
from .measure import Floats, Job, measure
from .movie import Movie
from .parts import DamagedPartError, join, write
from .pixel_range import check_pixels
from .processor import processor, widths
from .progress import ShardDone, Sink, StageDone, StageStarted, Warned, silent
from .provenance import provenance, stage_key
from .schema import REJECTED, Status, X, Y
from .settings import FitSettings, from_toml
from .shards import Shard
from .tasks import stream_shards
from .vacuum import check_box, find_vacuum
from .windows import check_window, default_window, neighbour_distance

_COUNTS = ("fits", "accepted", "bad_frames")
_ATTEMPTS = 3
"""So often shards are fitted whose fits turn out to be damaged on disk."""


@dataclass(frozen=True)
class FitSummary:
    """What the fit stage did: numbers of fits, of accepted ones, and of frames that could not be fitted."""

    fits: int
    accepted: int
    bad_frames: int


def fit_columns(
    movie: Movie,
    columns: xr.Dataset,
    drift: xr.Dataset | None = None,
    settings: FitSettings | None = None,
    *,
    summed: xr.Dataset | None = None,
    refine_columns: int | None = 10,
) -> xr.Dataset:
    """Fit every column in every frame, lazily: the Dataset computes what is asked of it, shard by shard.

    Parameters
    ----------
    movie
        An opened movie.
    columns
        From :func:`tract_dask.find_columns`.
    drift
        From :func:`tract_dask.estimate_drift`; None means none.
    settings
        Defaults to least squares on blurred pixels, with every column's shape as in the summed image.
    summed
        From :func:`tract_dask.sum_image`; the vacuum for the noise is looked for in it. Without it, and without
        ``settings.vacuum_box``, the noise of a frame is the rms residual of its fits.
    refine_columns
        Fewest accepted columns that may refine a frame's drift by their common motion; None: never.

    Returns
    -------
    xr.Dataset
        As declared in :data:`schema.RESULTS`, with the columns and coordinates; x and y in px, drift-corrected.

    Raises
    ------
    SettingsError
        Where a window is larger than the frame, the vacuum box leaves it, or counts (``poisson``) are negative.
    InputError
        Where float32 does not hold the pixels (:func:`tract_dask.pixel_range.check_pixels`).
    """
    import dask.array as da  # takes its time, and workers do not need it

    job = prepare(movie, columns, drift, settings or FitSettings(), summed=summed, refine_columns=refine_columns)
    n_columns = len(job.reference)
    names = [name for name in schema.RESULTS if name not in ("time", "drift_measured")]
    sizes = {"frame": movie.n_frames, "column_id": n_columns} | schema.SIZES
    chunk = {shard.index: shard for shard in movie.shards}

    def fit_packed(index: NDArray[np.int64]) -> Floats:
        values = measure(movie, chunk[int(index[0])], job)
        return np.concatenate(
            [values[name].reshape(len(values["noise"]), -1) for name in names], axis=1, dtype=np.float64
        )

    width = sum(int(np.prod([sizes[dim] for dim in schema.RESULTS[name].dims[1:]], dtype=int)) for name in names)
    packed = da.map_blocks(
        fit_packed,
        da.arange(len(chunk), chunks=1),
        new_axis=1,
        chunks=(tuple(shard.frames for shard in movie.shards), (width,)),
        dtype=np.float64,
        name=False,
    )
    variables: dict[str, Any] = {}
    offset = 0
    for name in names:
        variable = schema.RESULTS[name]
        tail = tuple(sizes[dim] for dim in variable.dims[1:])
        count = int(np.prod(tail, dtype=int))
        block = packed[:, offset : offset + count].reshape((movie.n_frames, *tail))
        variables[name] = (variable.dims, block.astype(variable.dtype), variable.attributes)
        offset += count
    dataset = columns.assign_coords(schema.coordinates(movie.n_frames)).assign(variables)
    dataset["drift_measured"] = (("frame", "axis"), job.drift, schema.RESULTS["drift_measured"].attributes)
    dataset["time"] = ("frame", frame_times(movie), schema.RESULTS["time"].attributes)
    blur = columns.attrs.get("blur_sigma_px", job.settings.blur_sigma_px)
    dataset.attrs = _calibration(movie) | results.how_fitted(job.settings, job.window, blur)
    return dataset


def fit_movie(
    movie: Movie, columns: xr.Dataset, job: Job, path: Path, *, client: Client | None = None, on_event: Sink = silent
) -> FitSummary:
    """Fit every column in every frame into the store at ``path``; go on where an earlier call stopped.

    A finished store with the same key is left as it is, but for its calibration; one with another key is made anew.

    Parameters
    ----------
    job
        From :func:`prepare`, with the same movie and columns.
    client
        The cluster to run on; None runs in this process.
    """
    started = perf_counter()
    key = fit_key(movie, columns, job)
    about = stores.attributes(path)
    if about.get("key") == key and about.get("complete"):
        remove_journal(journal_beside(path))  # of a run that was killed just before it had removed it
        results.calibrate(path, frame_times(movie), **_calibration(movie))
        on_event(StageDone("fit", 0.0, reused=True))
        return FitSummary(**about["summary"])
    goes_on = about.get("key") == key
    if not goes_on:
        remove_journal(journal_beside(path))
    elif damage := results.damage(path):
        goes_on = False
        on_event(Warned(f"{damage.where} is damaged: the store is made anew, with the fits that are done"))
    if not goes_on:
        results.create(
            path,
            columns,
            job.drift,
            frame_times(movie),
            movie.shards[0].frames,
            **provenance(key, job.settings, str(movie.path)),
            **_calibration(movie),
            window=job.window,
            vacuum=job.vacuum,
            reference_blur_px=columns.attrs.get("blur_sigma_px", job.settings.blur_sigma_px),
            refine_columns=job.refine_columns,
        )
    journal = Journal(journal_beside(path), key, dict.fromkeys(_COUNTS, ()))
    done_frames = journal.frames_done(movie.shards)
    on_event(StageStarted("fit", movie.n_frames, done_frames, len(job.reference), movie.frame_bytes))
    for attempt in range(_ATTEMPTS):
        summary, processors = _fit_shards(movie, path, journal, client, on_event)
        try:
            join(path, journal, client, on_event, attempt)
            break
        except DamagedPartError as error:
            if attempt == _ATTEMPTS - 1:
                raise
            on_event(Warned(f"{error.what}: they are made anew"))
    results.finish(path, summary=summary, processors=sorted(processors))
    journal.remove()
    if len(mixed := widths(processors)) > 1:
        lanes = " and ".join(map(str, mixed))
        on_event(Warned(f"processors with vectors of {lanes} numbers took part: last digits depend on which did what"))
    on_event(
        StageDone("fit", perf_counter() - started, summary=f"{summary['accepted']} of {summary['fits']} fits accepted")
    )
    return FitSummary(**summary)


def _fit_shards(
    movie: Movie, path: Path, journal: Journal, client: Client | None, on_event: Sink
) -> tuple[dict[str, int], set[str]]:
    """Fit the shards that are not on disk; return the counts of all, and the processors that took part."""
    summary, processors = dict.fromkeys(_COUNTS, 0), set[str]()

    def add(shard: Shard, payload: Payload) -> None:
        for name in summary:
            summary[name] += payload[name]
        processors.add(payload["processor"])

    stream_shards(
        partial(_fit_task, movie, path, journal.key, journal.path),
        movie.shards,
        add,
        journal=journal,
        name="fit",
        client=client,
        on_done=lambda shard, payload: on_event(ShardDone("fit", shard.index, shard.frames, payload["fits"])),
        file=str(movie.path),
        on_event=on_event,
    )
    return summary, processors


def prepare(
    movie: Movie,
    columns: xr.Dataset,
    drift: xr.Dataset | None,
    settings: FitSettings,
    *,
    summed: xr.Dataset | None = None,
    refine_columns: int | None = 10,
) -> Job:
    """Return all that the tasks need, checked; see :func:`fit_columns` for the arguments and errors."""
    schema.validate(columns, schema.COLUMNS, "columns")
    shift = schema.drift_of(drift, movie.n_frames)
    window = settings.window_px or int(columns.attrs.get("window_px") or default_window(_spacing(columns)))
    check_window(window, movie.shape[1:])
    box = settings.vacuum_box
    if box is not None:
        check_box(box, movie.shape[1:], shift)
    elif summed is not None:
        box = find_vacuum(summed, columns, settings.blur_sigma_px)
    statistics = movie.statistics()
    check_pixels(statistics, str(movie.path))
    bad = statistics["frame_bad_pixels"].to_numpy() > 0
    if settings.estimator == "poisson":
        check_counts(statistics["frame_min"].to_numpy())
    blur = columns.attrs.get("blur_sigma_px", settings.blur_sigma_px)
    refine = refine_columns if drift is not None else None
    return Job(_reference(columns, blur, settings), shift, bad, window, box, refine, settings)


def check_counts(smallest: Floats) -> None:
    """Check that the smallest pixels of the frames can be counts.

    Raises
    ------
    SettingsError
        Where one is negative.
    """
    if (smallest < 0).any():
        frame = int(np.nanargmin(smallest))
        raise SettingsError(
            "a pixel is negative, so the frames are not counts",
            "setting estimator (FitSettings)",
            "counts, or a multiple of counts, for poisson",
            f"{smallest[frame]:g} in frame {frame}",
            "Choose the estimator lsq, or convert frames from which nothing was subtracted",
        )


def fit_key(movie: Movie, columns: xr.Dataset, job: Job) -> str:
    """Return the key of the fit stage: the movie, the gain, and every number that the fit starts from."""
    arrays = (job.reference, job.drift, columns["column_id"].to_numpy().astype(np.int64))
    vacuum = None if job.vacuum is None else [int(edge) for edge in job.vacuum]
    numbers = [movie.gain, int(job.window), vacuum, job.refine_columns]
    kinds = [str(kind) for kind in columns["kind"].to_numpy()]
    return stage_key("fit", movie.key, counted("fit", fit=job.settings), *arrays, numbers, kinds)


def _spacing(columns: xr.Dataset) -> float:
    """Return the median distance from a column to its nearest neighbour, px."""
    place = np.stack([columns["y_ref"].to_numpy(), columns["x_ref"].to_numpy()], axis=1)
    distance = neighbour_distance(place)
    if distance is None:
        raise SettingsError(
            "one column alone does not tell how large its window should be",
            "setting window_px (FitSettings)",
            "two columns or more, or a window",
            "one column",
            "Give --window-px",
        )
    return distance


def frame_times(movie: Movie) -> Floats:
    """Return the start of each frame in s; the frame's number where the frame time is not known."""
    return np.arange(movie.n_frames, dtype=np.float64) * (movie.frame_time_s or 1.0)


def _fit_task(movie: Movie, path: Path, key: str, run: Path, shard: Shard) -> Payload:
    job = _load(movie, path, key)
    values = measure(movie, shard, job)
    write(run, shard, values, movie.shards[0].frames)
    fitted = (values["status"] & Status.OUTSIDE_FRAME) == 0
    return {
        "fits": int(fitted.sum()),
        "accepted": int(((values["status"] & REJECTED) == 0).sum()),
        "bad_frames": int(job.bad[shard.start : shard.stop].sum()),
        "processor": processor(),
    }


@lru_cache(maxsize=4)
def _load(movie: Movie, path: Path, key: str) -> Job:
    """Return what the tasks of one fit stage share, from the stores; ``key`` tells one stage from the next."""
    store = stores.open_dataset(path, only=(*schema.COLUMNS, "drift_measured"))
    about = stores.attributes(path)
    if about.get("key") != key:
        raise left_over(path, f"key {key}", f"key {about.get('key')}")
    bad = movie.statistics()["frame_bad_pixels"].to_numpy() > 0
    vacuum = tuple(about["vacuum"]) if about["vacuum"] else None
    settings = from_toml(FitSettings, about["settings"], str(path))
    drift = store["drift_measured"].to_numpy()
    reference = _reference(store, about["reference_blur_px"], settings)
    return Job(reference, drift, bad, about["window"], vacuum, about["refine_columns"], settings)


def _reference(columns: xr.Dataset, blur_sigma_px: float, settings: FitSettings) -> Floats:
    """Return the fit on the summed image, which went through that blur, as it would be after that of the windows.

    Columns that have none get the median shape at their seed's place.
    """
    reference: Floats = columns["fit_ref"].to_numpy().astype(np.float64)
    known = np.isfinite(reference).all(axis=1)
    if not known.any():
        raise SettingsError(
            "no column could be fitted in the summed image",
            "columns",
            "at least one",
            "0",
            "Check the contrast and the seeds",
        )
    reference[~known] = np.median(reference[known], axis=0)
    reference[:, X] = np.where(known, reference[:, X], columns["x_ref"].to_numpy())
    reference[:, Y] = np.where(known, reference[:, Y], columns["y_ref"].to_numpy())
    return blurred(reference, settings.window_blur_px**2 - blur_sigma_px**2)


def _calibration(movie: Movie) -> dict[str, float | None]:
    return {"pixel_size_pm": movie.pixel_size_pm, "frame_time_s": movie.frame_time_s, "dose": movie.dose}
