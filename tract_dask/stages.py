"""Each stage from a store to a store: movie, drift, sum, columns, fit.

A stage's result carries a key: a hash of its settings and of what it read. A stage whose store carries the key that
it should have is done; one with another key is made anew, and with it whatever depends on it; one that was interrupted
goes on from its journal.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import chain, count
from pathlib import Path
from time import perf_counter
from typing import Any

import xarray as xr
from distributed import Client

from . import fit, stores
from .conversion import convert
from .drift import estimate_drift
from .errors import DestinationError
from .io import FrameSource
from .journal import journal_beside, remove_journal
from .keyed import counted
from .movie import Movie, open_movie
from .passes import DamagedArrayError
from .pixel_range import check_pixels
from .progress import Sink, StageDone, StageStarted, Warned, silent
from .provenance import provenance, stage_key
from .schema import Status
from .seeds import check_inside, read_columns_csv, write_columns_csv
from .settings import ColumnSettings, DriftSettings, FitSettings, RunSettings, Settings
from .summing import sum_image

Workers = Callable[[], Client]
"""Gives the client; connects at its first call (:class:`tract_dask.cluster.LazyClient`)."""

Aside = Callable[[Callable[[], object]], object]
"""Takes work that nothing waits for but the end of the run."""


_ATTEMPTS = 3
"""So often a stage is gone through whose tasks left what is damaged then."""

_OUR_TABLE = b"column_id,x,y,kind,"
"""How a table begins that a run has written."""


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
    convert(
        source,
        path,
        settings=settings.convert,
        source_settings=settings.source,
        metadata=settings.metadata,
        client=workers,
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
    given = _content(settings.csv) if settings.method == "csv" else b""
    key = stage_key("drift", movie.key, counted("drift", drift=settings), given)

    def make(journal: Path) -> xr.Dataset:
        client = workers() if settings.method == "auto" else None
        return estimate_drift(movie, settings, client=client, on_event=on_event, journal=journal)

    return _kept("drift", movie, path, key, settings, make, on_event)


def sum_stage(
    movie: Movie, drift: xr.Dataset | None, path: Path, workers: Workers, on_event: Sink = silent
) -> xr.Dataset:
    """Return the drift-corrected sum of ``movie``, kept at ``path``."""
    moved = [] if drift is None else [drift[name].to_numpy() for name in ("drift", "quality")]
    key = stage_key("sum", movie.key, counted("sum"), movie.gain, *moved)

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
    as it is, whatever other setting changes; only another method or file of columns takes its place, after it was put
    away. The figure is drawn by ``aside``.

    Raises
    ------
    DestinationError
        Where ``csv`` is a table of other origin.
    """
    from .columns import find_columns  # workers, which are forked once this room is imported, do not need it

    store, figure = csv.with_suffix(".zarr"), csv.with_suffix(".png")
    window, blur = fit_settings.window_px, fit_settings.blur_sigma_px
    find = partial(find_columns, summed, window_px=window, blur_sigma_px=blur)
    before = _Table.read(csv, settings)
    if before.is_foreign and not overwrite:
        raise DestinationError(
            "this table was not written by tract-dask",
            str(csv),
            "nothing, or a table of an earlier run",
            "another file",
            "Choose another place, say --overwrite, or give the table as --columns",
        )
    counts = counted("columns", columns=settings, fit=fit_settings)
    key = _columns_key(summed, counts, before.seeds)
    about, pixel_size = before.about, summed.attrs.get("pixel_size_pm")
    same = bool(before.content) and about.get("key") == key
    if same and figure.exists() and about.get("pixel_size_pm") == pixel_size:
        on_event(StageDone("columns", 0.0, reused=True))
        return _reopened(store)
    began = perf_counter()
    on_event(StageStarted("columns", 0))
    if same:
        found, edited = _reopened(store), before.is_edited
    else:
        found, edited = _found(find, before, settings, on_event)
        key = _columns_key(summed, counts, before.content if edited else before.given)
    found.attrs["pixel_size_pm"] = pixel_size
    table = before.content if same or edited else _render(found, csv)
    if table != before.content:
        before.make_room(on_event)  # before the store, which would else take the old table for an edited one
    known = {"table": _digest(table), "edited": edited, "seeds": before.origin, "pixel_size_pm": pixel_size}
    _save(found, store, key, settings, "columns", **known)
    if not csv.exists():
        stores.write_aside(csv, table)
    figure.unlink(missing_ok=True)  # it is of other columns
    aside(partial(_draw, summed, found.copy(), figure))
    on_event(StageDone("columns", perf_counter() - began, summary=_columns_summary(found)))
    return found


def check_edited(csv: Path, settings: ColumnSettings, shape: tuple[int, ...]) -> None:
    """Check a table that was edited by hand, from which :func:`columns_stage` will start in images of ``shape`` (y, x).

    Raises
    ------
    SettingsError
        Where it cannot be read, or columns lie outside the image.
    DestinationError
        Where something else has its place: a link that leads nowhere may be one to columns that were edited.
    """
    if os.path.lexists(csv) and not csv.is_file():
        raise DestinationError(
            "the table of columns cannot be reached",
            str(csv),
            "a file, or nothing",
            f"a link to {csv.readlink()}, which is not there" if csv.is_symlink() else "no file",
            "Bring it back, or move what is there away: then columns are found anew",
        )
    if _Table.read(csv, settings).is_edited:
        check_inside(read_columns_csv(csv), shape, str(csv))


def _columns_key(summed: xr.Dataset, counts: dict[str, Any], seeds: bytes) -> str:
    """Return the key of the columns: other drifts may give the same image, but displaced, or of fewer frames."""
    image, exposure = (summed[name].to_numpy() for name in ("image", "exposure"))
    return stage_key("columns", image, exposure, summed.attrs.get("rounding_px"), counts, seeds)


@dataclass(frozen=True)
class _Table:
    """A table of columns that an earlier run may have left.

    Attributes
    ----------
    content
        What it holds; empty where there is none.
    about
        What the store beside it says of itself.
    given
        What the file holds that the settings name for method csv; empty for other methods.
    origin
        What the settings take columns from. Another origin ends what was edited.
    is_given
        Whether the settings name this very table.
    """

    csv: Path
    content: bytes
    about: dict[str, Any]
    given: bytes
    origin: dict[str, str]
    is_given: bool

    @classmethod
    def read(cls, csv: Path, settings: ColumnSettings) -> _Table:
        by_file = settings.method == "csv" and settings.csv is not None
        given = _content(settings.csv) if by_file else b""
        origin = {"method": settings.method, "csv": _digest(given)}
        about = stores.attributes(csv.with_suffix(".zarr"))
        return cls(csv, _content(csv), about, given, origin, by_file and Path(settings.csv or "").absolute() == csv)

    @property
    def is_changed(self) -> bool:
        """Whether it is not as a run has written it."""
        found = bool(self.content and self.about)
        return found and (_digest(self.content) != self.about.get("table") or bool(self.about.get("edited")))

    @property
    def is_foreign(self) -> bool:
        """Whether it is none that a run has written."""
        return bool(self.content) and not self.about and not self.content.startswith(_OUR_TABLE) and not self.is_given

    @property
    def is_edited(self) -> bool:
        """Whether its columns are to be refined, and not found anew."""
        return bool(self.content) and (
            self.is_given or (self.is_changed and self.about.get("seeds", self.origin) == self.origin)
        )

    @property
    def seeds(self) -> bytes:
        """The table that columns are taken from; empty where they are looked for."""
        return self.content if self.is_edited else self.given

    def make_room(self, on_event: Sink) -> None:
        """Take the table away for another: for ever, where it is as a run has written it."""
        now = _content(self.csv)
        if now and (self.is_changed or not self.about or now != self.content):
            put_away(self.csv, on_event)
        self.csv.unlink(missing_ok=True)


def _found(
    find: Callable[[ColumnSettings], xr.Dataset], before: _Table, settings: ColumnSettings, on_event: Sink
) -> tuple[xr.Dataset, bool]:
    """Return the columns that an edited table or else the settings lead to, and whether the table does.

    A table of ours whose store is gone is an edited one, unless it is just what the settings lead to.
    """
    lost = bool(before.content) and not before.about and not before.is_foreign
    if not before.is_edited:
        found = find(settings)
        if not lost or _render(found, before.csv) == before.content:
            return found, False
    on_event(Warned(f"{before.csv.name} was edited: your columns are kept, and refined on the summed image"))
    return find(dataclasses.replace(settings, method="csv", csv=str(before.csv))), True


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
        dataset = _made(partial(make, journal_beside(path)), on_event)
    dataset.attrs["pixel_size_pm"] = movie.pixel_size_pm
    _save(dataset, path, key, settings, stage, source=str(movie.path))
    remove_journal(journal_beside(path))
    return dataset


def _made(make: Callable[[], xr.Dataset], on_event: Sink) -> xr.Dataset:
    """Return the result of a stage; what its tasks left and the disk has damaged since is made anew."""
    for _ in range(_ATTEMPTS - 1):
        try:
            return make()
        except DamagedArrayError as error:
            on_event(Warned(f"{error.where} was damaged on disk: it is made anew"))
    return make()


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


def put_away(csv: Path, on_event: Sink) -> None:
    """Keep a table that was edited by hand under another name, under which nothing lies yet."""
    names = (csv.with_stem(f"{csv.stem}-edited{suffix}") for suffix in chain([""], (f"-{k}" for k in count(2))))
    kept = next(path for path in names if not path.exists() or path.read_bytes() == csv.read_bytes())
    csv.replace(kept)
    on_event(Warned(f"other columns take the place of {csv.name}: your edited table is now {kept.name}"))


def clear_columns(csv: Path, on_event: Sink, *, keep_edited: bool) -> None:
    """Remove what the columns stage has left at ``csv``; a table that was edited by hand is kept, or put away."""
    if not stores.is_sound(csv.with_suffix(".zarr")):
        stores.remove(csv.with_suffix(".zarr"))
    before = _Table.read(csv, ColumnSettings())
    edited = before.is_changed or bool(before.content and not before.about)
    csv.with_suffix(".png").unlink(missing_ok=True)
    if edited and keep_edited and not before.is_foreign:
        return
    if edited:
        put_away(csv, on_event)
    csv.unlink(missing_ok=True)
    stores.remove(csv.with_suffix(".zarr"))
