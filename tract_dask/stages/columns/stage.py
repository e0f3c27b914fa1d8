"""Columns from a summed image, as a table that may be edited."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import chain, count
from pathlib import Path
from time import perf_counter
from typing import Any

import xarray as xr

from ...errors import DestinationError
from ...progress import Sink, StageDone, StageStarted, Warned, silent
from ...settings.run import ColumnSettings, FitSettings
from ...store import datasets, files, metadata
from ...store.columns import check_inside, columns_csv, read_columns_csv
from ...store.held import check_held
from ...store.keys import counted, stage_key
from ...store.schema import Status, texts
from ...store.strangers import MOVIE_KEY
from ..keep import content, save

Draw = Callable[[xr.Dataset, xr.Dataset, Path], object]
"""Draws summed image and columns into a file, at once or in the background."""

_KINDS = 6
"""Kinds that a summary counts."""
_ONE_OF_TWO = "the other one pulls at them; leave out --columns-csv, or give both"

_OUR_TABLE = b"column_id,x,y,kind,"
"""How a table begins that a run has written."""


def columns_stage(
    summed: xr.Dataset,
    csv: Path,
    settings: ColumnSettings,
    fit_settings: FitSettings,
    on_event: Sink = silent,
    *,
    overwrite: bool = False,
    part: Mapping[str, int] | None = None,
    draw: Draw,
) -> xr.Dataset:
    """Return the columns of a summed image, kept as the table ``csv``, with ``.zarr`` and ``.png`` of the same name.

    Where the table was edited by hand since, its columns are refined and returned instead, and the table is left
    as it is, whatever other setting changes; only another method or file of columns, or another field or bin of the
    movie, takes its place, after it was put away. The figure is drawn by ``draw``.

    Parameters
    ----------
    part
        Which part of its source the movie is, as :attr:`tract_dask.store.movie.Movie.part` says.

    Raises
    ------
    DestinationError
        Where ``csv`` is a table of other origin.
    """
    from .find import find_columns  # workers, which are forked once this room is imported, do not need it

    store, figure = csv.with_suffix(".zarr"), csv.with_suffix(".png")
    window, blur = fit_settings.window_px, fit_settings.blur_sigma_px
    find = partial(find_columns, summed, window_px=window, blur_sigma_px=blur)
    before = _Table.read(csv, settings, part)
    if not overwrite:
        before.check_ours()
    counts = counted("columns", columns=settings, fit=fit_settings)
    key = _columns_key(summed, counts, before.seeds)
    about, pixel_size = before.about, summed.attrs.get("pixel_size_pm")
    same = bool(before.content) and about.get("key") == key
    if same and figure.exists() and about.get("pixel_size_pm") == pixel_size:
        on_event(StageDone("columns", 0.0, reused=True))
        return reopened(store)
    began = perf_counter()
    on_event(StageStarted("columns", 0))
    if same:
        found, edited = reopened(store), before.is_edited
    else:
        found, edited = _found(find, before, settings, on_event)
        key = _columns_key(summed, counts, before.content if edited else before.given)
    found.attrs["pixel_size_pm"] = pixel_size
    table = before.content if same or edited else columns_csv(found).encode()
    if table != before.content:
        before.make_room(on_event)  # before the store, which would else take the old table for an edited one
    known = {"table": _digest(table), "edited": edited, "seeds": before.origin, "pixel_size_pm": pixel_size}
    save(found, store, key, settings, "columns", **known, **{MOVIE_KEY: summed.attrs.get(MOVIE_KEY)})
    if not csv.exists():
        files.write_aside(csv, table)
    figure.unlink(missing_ok=True)  # it is of other columns
    draw(summed, found.copy(), figure)
    _tell(found, began, on_event)
    return found


def _tell(columns: xr.Dataset, began: float, on_event: Sink) -> None:
    """Tell what was found, and warn of given columns that touch one that was not given."""
    if half := columns.attrs.get("one_of_two"):
        on_event(Warned(f"{len(half)} of the given columns are one of two that touch: {_ONE_OF_TWO}"))
    on_event(StageDone("columns", perf_counter() - began, summary=_columns_summary(columns)))


def check_edited(
    csv: Path, settings: ColumnSettings, shape: tuple[int, ...], part: Mapping[str, int] | None = None
) -> None:
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
            "Bring it back, or move what is there away: then columns are found again",
        )
    if _Table.read(csv, settings, part).is_edited:
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
        What the settings take columns from, and from where and in what places are counted. Another origin ends what was
        edited.
    is_given
        Whether the settings name this very table.
    """

    csv: Path
    content: bytes
    about: dict[str, Any]
    given: bytes
    origin: dict[str, Any]
    is_given: bool

    @classmethod
    def read(cls, csv: Path, settings: ColumnSettings, part: Mapping[str, int] | None = None) -> _Table:
        by_file = settings.method == "csv" and settings.csv is not None
        given = content(settings.csv) if by_file else b""
        origin = {"method": settings.method, "csv": _digest(given)} | _counted_in(part)
        about = metadata.attributes(csv.with_suffix(".zarr"))
        return cls(csv, content(csv), about, given, origin, by_file and Path(settings.csv or "").absolute() == csv)

    @property
    def is_changed(self) -> bool:
        """Whether it is not as a run has written it."""
        found = bool(self.content and self.about)
        return found and (_digest(self.content) != self.about.get("table") or bool(self.about.get("edited")))

    @property
    def is_foreign(self) -> bool:
        """Whether it is none that a run has written."""
        return bool(self.content) and not self.about and not self.content.startswith(_OUR_TABLE) and not self.is_given

    def check_ours(self) -> None:
        """Refuse a table of other origin."""
        if self.is_foreign:
            raise DestinationError(
                "this table was not written by tract-dask",
                str(self.csv),
                "nothing, or a table of an earlier run",
                "another file",
                "Choose another place, use --overwrite, or give the table with --columns-csv",
            )

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
        now = content(self.csv)
        if now and (self.is_changed or not self.about or now != self.content):
            put_away(self.csv, on_event)
        check_held(self.csv)
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
        if not lost or columns_csv(found).encode() == before.content:
            return found, False
    on_event(Warned(f"{before.csv.name} was edited: your columns are kept, and refined on the summed image"))
    return find(dataclasses.replace(settings, method="csv", csv=str(before.csv))), True


def reopened(store: Path) -> xr.Dataset:
    """Return the columns in ``store`` as they were found: without provenance."""
    found = datasets.open_dataset(store)
    del found.attrs[metadata.ATTRIBUTE]
    return found


def _counted_in(part: Mapping[str, int] | None) -> dict[str, Any]:
    """Return the pixel on disk from which places in a movie count, and their unit; nothing where it is the first, 1."""
    pixels = [part[name] for name in ("top", "left", "bin_px")] if part else []
    return {"pixels": pixels} if pixels not in ([], [0, 0, 1]) else {}


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _columns_summary(columns: xr.Dataset) -> str:
    outside = int(((columns["status_ref"].to_numpy() & Status.OUTSIDE_FRAME) > 0).sum())
    merged = len(columns.attrs.get("merged", ()))
    kinds = Counter(kind for kind in texts(columns["kind"].to_numpy()).tolist() if kind)
    of_kinds = ", ".join(f"{number} {kind}" for kind, number in sorted(kinds.items()))
    unresolved = int(columns["unresolved"].sum())
    parts = (
        f"{columns.sizes['column_id']} columns" + f" ({of_kinds})" * (0 < len(kinds) <= _KINDS),
        f"{columns.attrs['contrast']}, as the image says" if "contrast_rival" in columns.attrs else "",
        f"{outside} outside the frame" if outside else "",
        f"{merged} seeds merged" if merged else "",
        f"{unresolved} not resolved in single frames" if unresolved else "",
    )
    return ", ".join(filter(None, parts))


def put_away(csv: Path, on_event: Sink) -> None:
    """Keep a table that was edited by hand under another name, under which nothing lies yet."""
    names = (csv.with_stem(f"{csv.stem}-edited{suffix}") for suffix in chain([""], (f"-{k}" for k in count(2))))
    kept = next(path for path in names if not path.exists() or path.read_bytes() == csv.read_bytes())
    check_held(csv)
    csv.replace(kept)
    on_event(Warned(f"other columns take the place of {csv.name}: your edited table is now {kept.name}"))


def clear_columns(csv: Path, on_event: Sink, *, keep_edited: bool) -> None:
    """Remove what the columns stage has left at ``csv``; a table that was edited by hand is kept, or put away."""
    if not metadata.is_sound(csv.with_suffix(".zarr")):
        files.remove(csv.with_suffix(".zarr"))
    before = _Table.read(csv, ColumnSettings())
    edited = before.is_changed or bool(before.content and not before.about)
    check_held(csv)
    csv.with_suffix(".png").unlink(missing_ok=True)
    if edited and keep_edited and not before.is_foreign:
        return
    if edited:
        put_away(csv, on_event)
    csv.unlink(missing_ok=True)
    files.remove(csv.with_suffix(".zarr"))
