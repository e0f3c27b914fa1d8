"""Single stages, as the command line runs them."""

from __future__ import annotations

import dataclasses
from contextlib import closing
from functools import partial
from pathlib import Path

import xarray as xr
from distributed import Client

from ..cluster.retries import persist
from ..progress import Sink, silent
from ..settings.run import RunSettings
from ..stages.columns.stage import check_edited, columns_stage
from ..stages.convert.stage import convert_stage
from ..stages.drift.stage import drift_stage
from ..stages.fit.stage import FitSummary, fit_stage
from ..stages.fit.vacuum import check_box
from ..stages.sum import sum_stage
from ..store import datasets, files, metadata
from ..store.movie import Movie, open_movie
from ..store.run_folder import sum_beside
from ..store.schema import drift_of
from .checks import check_columns, check_drift, check_pixels_of, check_suffix, open_input, with_whole_paths
from .plan import plan_run
from .session import Session, draw_columns


def run_convert(
    source: str | Path,
    destination: str | Path,
    settings: RunSettings | None = None,
    *,
    client: Client | None = None,
    on_event: Sink = silent,
    overwrite: bool = False,
) -> Movie:
    """Convert a movie to the store ``destination``; the first stage of :func:`run`, alone."""
    settings, path = with_whole_paths(settings or RunSettings()), Path(destination).absolute()
    opening = partial(open_input, source, settings, None if overwrite else path)
    with closing(persist(opening, on_event, str(source))) as opened:
        plan = plan_run(opened.shape, opened.dtype, settings)
        if overwrite and metadata.is_sound(path) and metadata.attributes(path).get("kind") == "movie":
            files.remove(path)  # also the very movie that would be made: a shard of it may be damaged
        with Session(opened.path, path, settings.cluster, client, on_event, plan) as session:
            return session.attempt(
                partial(convert_stage, opened, path, settings, session.workers, session.send, overwrite=overwrite)
            )


def run_drift(
    movie: str | Path,
    output: str | Path,
    settings: RunSettings | None = None,
    *,
    client: Client | None = None,
    on_event: Sink = silent,
) -> xr.Dataset:
    """Measure the drift of a movie store into the store ``output``."""
    settings, path, opened = with_whole_paths(settings or RunSettings()), Path(output).absolute(), open_movie(movie)
    check_drift(opened.n_frames, settings.drift)
    with Session(str(movie), path, settings.cluster, client, on_event) as session:
        return session.attempt(partial(drift_stage, opened, path, settings.drift, session.workers, session.send))


def run_columns(
    movie: str | Path,
    output: str | Path,
    settings: RunSettings | None = None,
    drift: str | Path | None = None,
    *,
    client: Client | None = None,
    on_event: Sink = silent,
    overwrite: bool = False,
) -> xr.Dataset:
    """Find the columns of a movie store into the table ``output`` (.csv); the summed image is kept beside it."""
    settings, path, opened = with_whole_paths(settings or RunSettings()), Path(output).absolute(), open_movie(movie)
    check_suffix(path, ".csv")
    check_columns(opened.shape[1:], settings.columns, settings.fit.window_px)
    check_edited(path, settings.columns, opened.shape[1:], opened.part)
    shift = None if drift is None else datasets.open_dataset(Path(drift))
    with Session(str(movie), path, settings.cluster, client, on_event) as session:
        attempt, send = session.attempt, session.send
        summed = attempt(partial(sum_stage, opened, shift, sum_beside(path), session.workers, send))
        find = partial(columns_stage, summed, path, settings.columns, settings.fit, send, draw=draw_columns)
        return attempt(partial(find, part=opened.part, overwrite=overwrite))


def run_fit(
    movie: str | Path,
    columns: str | Path,
    results: str | Path,
    settings: RunSettings | None = None,
    drift: str | Path | None = None,
    *,
    client: Client | None = None,
    on_event: Sink = silent,
) -> FitSummary:
    """Fit the columns of a table (.csv) in every frame of a movie store, into the store ``results``."""
    settings, path, opened = with_whole_paths(settings or RunSettings()), Path(results).absolute(), open_movie(movie)
    table = Path(columns).absolute()
    metadata.check_destination(path)
    shift = None if drift is None else datasets.open_dataset(Path(drift))
    chosen = dataclasses.replace(settings.columns, method="csv", csv=str(table))
    check_columns(opened.shape[1:], chosen, settings.fit.window_px)
    check_box(settings.fit.vacuum_box, opened.shape[1:], drift_of(shift, opened.n_frames))
    check_pixels_of(opened, settings.fit)
    with Session(str(movie), path, settings.cluster, client, on_event) as session:
        attempt, workers, send = session.attempt, session.workers, session.send
        summed = attempt(partial(sum_stage, opened, shift, sum_beside(path), workers, send))
        opened = open_movie(movie)  # its gain and offset may have been measured
        csv = path.with_name(f"{path.stem}_columns.csv")
        find = partial(columns_stage, summed, csv, chosen, settings.fit, send, draw=draw_columns)
        found = attempt(partial(find, part=opened.part))
        return attempt(partial(fit_stage, opened, found, shift, summed, path, settings.fit, workers, send))
