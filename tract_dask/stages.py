"""Each stage from a store to a store: movie, drift, sum, columns, fit.

A stage's result carries a key: a hash of its settings and of what it read. A stage whose store carries the key that
it should have is done; one with another key is made anew, and with it whatever depends on it; one that was interrupted
goes on from its journal.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import xarray as xr
from distributed import Client

from . import fit, stores
from .conversion import convert, movie_key
from .drift import estimate_drift
from .errors import DestinationError
from .io import FrameSource
from .journal import journal_beside, remove_journal
from .movie import Movie, open_movie
from .pixel_range import check_pixels
from .progress import Sink, StageDone, StageStarted, Warned, silent
from .provenance import provenance, stage_key
from .schema import Status
from .seeds import write_columns_csv
from .settings import ColumnSettings, DriftSettings, FitSettings, RunSettings, Settings
from .summing import sum_image

Workers = Callable[[], Client]
"""Gives the client; connects at its first call (:class:`tract_dask.cluster.LazyClient`)."""

Aside = Callable[[Callable[[], object]], object]
"""Takes work that nothing waits for but the end of the run."""


def at_once(work: Callable[[], object]) -> object:
    """Do the work now."""
    return work()


def convert_stage(
    source: FrameSource,
    path: Path,
    settings: RunSettings,
    workers: Workers,
    on_event: Sink = silent,
    *,
    overwrite: bool = False,
) -> Movie:
    """Return the movie at ``path``, converted if it is not there yet; its metadata are made those of ``source``."""
    done = _is_done(path, movie_key(source, settings.convert, settings.source))
    convert(
        source,
        path,
        settings=settings.convert,
        source_settings=settings.source,
        client=None if done else workers(),
        on_event=on_event,
        overwrite=overwrite,
    )
    movie = open_movie(path)
    if coarse := check_pixels(movie.statistics(), source.path):
        on_event(Warned(coarse))
    return movie


def drift_stage(
    movie: Movie, path: Path, settings: DriftSettings, workers: Workers, on_event: Sink = silent
) -> xr.Dataset:
    """Return the drift of ``movie``, kept at ``path``."""
    measured = dataclasses.replace(
        settings, csv=None, refine=True, refine_columns=10
    )  # what the measurement depends on
    key = stage_key(movie.key, measured, _content(settings.csv))

    def make(journal: Path) -> xr.Dataset:
        client = workers() if settings.method == "auto" else None
        return estimate_drift(movie, settings, client=client, on_event=on_event, journal=journal)

    return _kept("drift", movie, path, key, settings, make, on_event)


def sum_stage(
    movie: Movie, drift: xr.Dataset | None, path: Path, workers: Workers, on_event: Sink = silent
) -> xr.Dataset:
    """Return the drift-corrected sum of ``movie``, kept at ``path``."""
    moved = [] if drift is None else [drift[name].to_numpy().tobytes() for name in ("drift", "quality")]
    key = stage_key(movie.key, repr(movie.gain), *moved)

    def make(journal: Path) -> xr.Dataset:
        return sum_image(movie, drift, client=workers(), on_event=on_event, journal=journal)

    return _kept("sum", movie, path, key, Settings(), make, on_event)


def columns_stage(
    summed: xr.Dataset,
    csv: Path,
    settings: ColumnSettings,
    fit_settings: FitSettings,
    on_event: Sink = silent,
    *,
    overwrite: bool = False,
    aside: Aside = at_once,
) -> xr.Dataset:
    """Return the columns of a summed image, kept as the table ``csv``, with ``.zarr`` and ``.png`` of the same name.

    Where the table was edited by hand since, its columns are refined and returned instead, and the table is left
    as it is. The figure is drawn by ``aside``.

    Raises
    ------
    DestinationError
        Where ``csv`` is a table of other origin.
    """
    store, figure = csv.with_suffix(".zarr"), csv.with_suffix(".png")
    plain = dataclasses.replace(settings, csv=None)
    window, blur = fit_settings.window_px, fit_settings.blur_sigma_px
    from .columns import find_columns  # workers, which are forked once this room is imported, do not need it

    find = partial(find_columns, summed, window_px=window, blur_sigma_px=blur)
    key = stage_key(summed["image"].to_numpy().tobytes(), plain, _content(settings.csv), f"{window} {blur}")
    about, table, pixel_size = stores.attributes(store), _content(csv), summed.attrs.get("pixel_size_pm")
    if table and not about and not overwrite:
        raise DestinationError(
            "this table was not written by tract-dask",
            str(csv),
            "nothing, or a table of an earlier run",
            "another file",
            "Choose another place, say --overwrite, or give the table as --columns",
        )
    edited = bool(table and about) and _digest(table) != about.get("table")
    same = bool(table) and about.get("key") == key
    if same and not edited and figure.exists() and about.get("pixel_size_pm") == pixel_size:
        on_event(StageDone("columns", 0.0, reused=True))
        return _reopened(store)
    began = perf_counter()
    on_event(StageStarted("columns", 0))
    if same and edited:
        on_event(Warned(f"{csv.name} was edited: your columns are kept, and refined on the summed image"))
        found = find(dataclasses.replace(settings, method="csv", csv=str(csv)))
    else:
        found = _reopened(store) if same else find(settings)
    found.attrs["pixel_size_pm"] = pixel_size
    by_hand = edited or bool(about.get("edited"))
    if not same:
        if by_hand and table:
            _put_away(csv, on_event)
        table, by_hand = _render(found, csv), False
        csv.unlink(missing_ok=True)  # before the store, which would else take the old table for an edited one
    _save(found, store, key, settings, "columns", pixel_size_pm=pixel_size, table=_digest(table), edited=by_hand)
    if not csv.exists():
        stores.write_aside(csv, table)
    figure.unlink(missing_ok=True)  # it is of other columns
    aside(partial(_draw, summed, found.copy(), figure))
    on_event(StageDone("columns", perf_counter() - began, summary=_columns_summary(found)))
    return found


def fit_stage(
    movie: Movie,
    columns: xr.Dataset,
    drift: xr.Dataset | None,
    summed: xr.Dataset | None,
    path: Path,
    settings: FitSettings,
    refine_columns: int | None,
    workers: Workers,
    on_event: Sink = silent,
) -> fit.FitSummary:
    """Fit every column in every frame into ``path``."""
    job = fit.prepare(movie, columns, drift, settings, summed=summed, refine_columns=refine_columns)
    client = None if _is_done(path, fit.fit_key(movie, columns, job)) else workers()
    return fit.fit_movie(movie, columns, job, path, client=client, on_event=on_event)


def _draw(summed: xr.Dataset, columns: xr.Dataset, figure: Path) -> None:
    """Draw the columns beside the place of their figure, then put them there, so that a figure is always whole."""
    from .plots import plot_columns  # matplotlib takes its time, and not every run draws

    partial_figure = figure.with_name(f".{figure.stem}.partial{figure.suffix}")
    plot_columns(summed, columns, partial_figure)
    partial_figure.replace(figure)


def _kept(
    stage: str,
    movie: Movie,
    path: Path,
    key: str,
    settings: Settings,
    make: Callable[[Path], xr.Dataset],
    on_event: Sink,
) -> xr.Dataset:
    """Return the Dataset at ``path`` if it has the right key; otherwise make it, with a journal beside, and keep it."""
    stores.check_destination(path)
    if stores.attributes(path).get("kind", stage) != stage:
        raise DestinationError(
            "this store is of another kind",
            str(path),
            f"nothing, or the result of stage {stage}",
            str(stores.attributes(path)["kind"]),
            "Choose another place",
        )
    if _is_done(path, key):
        remove_journal(journal_beside(path))  # of a run that was killed just before it had removed it
        on_event(StageDone(stage, 0.0, reused=True))
        dataset = stores.open_dataset(path)
        if dataset.attrs.get("pixel_size_pm") == movie.pixel_size_pm:
            return dataset
    else:
        journal = journal_beside(path)
        dataset = make(journal)
    dataset.attrs["pixel_size_pm"] = movie.pixel_size_pm
    _save(dataset, path, key, settings, stage, source=str(movie.path))
    remove_journal(journal_beside(path))
    return dataset


def _save(dataset: xr.Dataset, path: Path, key: str, settings: Settings, kind: str, **more: Any) -> None:
    about = provenance(key, settings) | {"kind": kind, "complete": True} | more
    known = {name: value for name, value in dataset.attrs.items() if value is not None}
    stored = dataset.copy()
    stored.attrs = stores.json_ready(known | {stores.ATTRIBUTE: about})
    stores.write_dataset(stored, path)


def _reopened(store: Path) -> xr.Dataset:
    """Return the columns in ``store`` as they were found: without provenance."""
    found = stores.open_dataset(store)
    del found.attrs[stores.ATTRIBUTE]
    return found


def _render(columns: xr.Dataset, csv: Path) -> bytes:
    """Return the table of ``columns`` as it will stand in ``csv``."""
    aside = csv.with_name(f".{csv.name}.partial")
    write_columns_csv(columns, aside)
    table = aside.read_bytes()
    aside.unlink()
    return table


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _is_done(path: Path, key: str) -> bool:
    about = stores.attributes(path)
    return about.get("key") == key and bool(about.get("complete"))


def _content(path: str | Path | None) -> bytes:
    """Return the bytes of a small file, empty where there is none."""
    return Path(path).read_bytes() if path and Path(path).is_file() else b""


def _columns_summary(columns: xr.Dataset) -> str:
    outside = int(((columns["status_ref"].to_numpy() & Status.OUTSIDE_FRAME) > 0).sum())
    merged = len(columns.attrs.get("merged", ()))
    parts = (
        f"{columns.sizes['column_id']} columns",
        f"{outside} outside the frame" if outside else "",
        f"{merged} seeds merged" if merged else "",
    )
    return ", ".join(filter(None, parts))


def _put_away(csv: Path, on_event: Sink) -> None:
    """Keep a table that was edited by hand under another name, before a new one takes its place."""
    kept = csv.with_stem(f"{csv.stem}-edited")
    csv.replace(kept)
    on_event(Warned(f"the settings of the columns have changed: your edited {csv.name} is now {kept.name}"))
