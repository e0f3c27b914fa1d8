"""The fit stage: every column of every frame, one task a shard; into results.zarr, or lazily for a notebook."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import xarray as xr
from distributed import Client

from ...cluster.tasks import stream_shards
from ...progress import ShardDone, Sink, StageDone, StageStarted, Warned, silent
from ...settings.run import FitSettings
from ...store import metadata, results
from ...store.held import Folder, hold
from ...store.journal import Journal, Payload, journal_beside, remove_journal
from ...store.keys import counted, stage_key
from ...store.movie import Movie
from ...store.parts import DamagedPartError, write
from ...store.provenance import processor, widths
from ...store.schema import Status, is_accepted
from ...store.shards import Shard
from ..keep import Workers, is_done
from .crystal import Crystal, judged
from .empty import calibrated
from .job import Job, calibration, prepare
from .join import join
from .measure import measure

_COUNTS = ("fits", "accepted", "bad_frames")

_ATTEMPTS = 3
"""So often shards are fitted whose fits turn out to be damaged on disk."""


@dataclass(frozen=True)
class FitSummary:
    """What the fit stage did: numbers of fits, of accepted ones, and of frames that could not be fitted."""

    fits: int
    accepted: int
    bad_frames: int


def fit_movie(
    movie: Movie, job: Job, path: Path, *, client: Client | None = None, on_event: Sink = silent
) -> FitSummary:
    """Fit every column in every frame into the store at ``path``; go on where an earlier call stopped.

    A finished store with the same key is left as it is, but for its calibration; one with another key is made anew.

    Parameters
    ----------
    job
        From :func:`prepare`, with the same movie.
    client
        The cluster to run on; None runs in this process.
    """
    started = perf_counter()
    key = fit_key(movie, job)
    about = metadata.attributes(path)
    if about.get("key") == key and about.get("complete"):
        remove_journal(journal_beside(path))  # of a run that was killed just before it had removed it
        results.calibrate(path, movie.times(), **calibration(movie))
        on_event(StageDone("fit", 0.0, reused=True))
        return FitSummary(**about["summary"])
    if not _goes_on(path, key, on_event):
        calibrated(job).save(path, movie, key)
    journal = Journal(journal_beside(path), key, dict.fromkeys(_COUNTS, ()))
    done_frames = journal.frames_done(movie.shards)
    on_event(StageStarted("fit", movie.n_frames, done_frames, len(job.reference), movie.frame_bytes))
    with hold(Folder.at(path)):
        summary, processors, crystal = _fit_whole(movie, path, journal, job, client, on_event)
        results.finish(path, summary=summary, processors=sorted(processors), **(crystal.told(job) if crystal else {}))
    journal.remove()
    if len(mixed := widths(processors)) > 1:
        lanes = " and ".join(map(str, mixed))
        on_event(Warned(f"processors with vectors of {lanes} numbers took part: last digits depend on which did what"))
    on_event(
        StageDone("fit", perf_counter() - started, summary=f"{summary['accepted']} of {summary['fits']} fits accepted")
    )
    return FitSummary(**summary)


def _fit_whole(
    movie: Movie, path: Path, journal: Journal, job: Job, client: Client | None, on_event: Sink
) -> tuple[dict[str, int], set[str], Crystal | None]:
    """Fit and join all shards, those again that are found damaged then; return what :func:`_fit_shards` does.

    The last value is how positions were put right.
    """
    for attempt in range(_ATTEMPTS):
        found = _fit_shards(movie, path, journal, client, on_event)
        try:
            crystal = judged(journal, path, job)
            join(path, journal, client, on_event, attempt, crystal)
            break
        except DamagedPartError as error:
            if attempt == _ATTEMPTS - 1:
                raise
            on_event(Warned(f"{error.what}: they are made again"))
    return *found, crystal


def _goes_on(path: Path, key: str, on_event: Sink) -> bool:
    """Tell whether the unfinished store at ``path`` can be gone on with; fits with another key are thrown away."""
    if metadata.attributes(path).get("key") != key:
        remove_journal(journal_beside(path))
        return False
    if damage := results.damage(path):
        on_event(Warned(f"{damage.where} is damaged: the store is made again, with the fits that are done"))
        return False
    return True


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


def fit_key(movie: Movie, job: Job) -> str:
    """Return the key of the fit stage: the movie, the gain, and every number that the fit starts from."""
    arrays = (job.reference, job.drift, job.columns["column_id"].to_numpy().astype(np.int64))
    vacuum = None if job.vacuum is None else [int(edge) for edge in job.vacuum]
    numbers: list[Any] = [movie.gain, int(job.window_px), vacuum, job.refined_by, *job.noise_key]
    kinds = [str(kind) for kind in job.columns["kind"].to_numpy()]
    numbers += [list(job.lost)] if job.lost else []
    numbers += [{"groups": job.group_numbers.tolist()}] if job.group_numbers.any() else []
    return stage_key("fit", movie.key, counted("fit", fit=job.settings), *arrays, numbers, kinds)


def _fit_task(movie: Movie, path: Path, key: str, run: Path, shard: Shard) -> Payload:
    job = Job.load(path, movie, key)
    values = measure(movie, shard, job)
    write(run, shard, values, movie.shards[0].frames)
    fitted = (values["status"] & Status.OUTSIDE_FRAME) == 0
    return {
        "fits": int(fitted.sum()),
        "accepted": int(is_accepted(values["status"]).sum()),
        "bad_frames": int(job.bad[shard.start : shard.stop].sum()),
        "processor": processor(),
    }


def fit_stage(
    movie: Movie,
    columns: xr.Dataset,
    drift: xr.Dataset | None,
    summed: xr.Dataset | None,
    path: Path,
    settings: FitSettings,
    workers: Workers,
    on_event: Sink = silent,
) -> FitSummary:
    """Fit every column in every frame into ``path``."""
    job = prepare(movie, columns, drift, settings, summed=summed)
    client = None if is_done(path, fit_key(movie, job)) else workers()
    return fit_movie(movie, job, path, client=client, on_event=on_event)
