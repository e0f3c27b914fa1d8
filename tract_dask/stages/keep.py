"""Results of stages: kept under a key, reused where it is the right one."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import xarray as xr
from distributed import Client

from ..errors import DestinationError
from ..progress import Sink, StageDone, Warned
from ..settings.declare import Settings
from ..store import datasets, metadata
from ..store.arrays import DamagedArrayError
from ..store.journal import journal_beside, remove_journal
from ..store.movie import Movie
from ..store.provenance import provenance
from ..store.strangers import MOVIE_KEY

Workers = Callable[[], Client]
"""Gives the client; connects at its first call (:class:`tract_dask.cluster.connect.LazyClient`)."""

_ATTEMPTS = 3
"""So often a stage is gone through whose tasks left what is damaged then."""


def kept(
    stage: str,
    movie: Movie,
    path: Path,
    key: str,
    settings: Settings,
    make: Callable[[Path], xr.Dataset],
    on_event: Sink,
) -> xr.Dataset:
    """Return the Dataset at ``path`` if it has the right key; otherwise make it, with a journal beside, and keep it."""
    metadata.check_destination(path)
    if metadata.attributes(path).get("kind", stage) != stage:
        raise DestinationError(
            "this store is of another kind",
            str(path),
            f"nothing, or the result of stage {stage}",
            str(metadata.attributes(path)["kind"]),
            "Choose another place",
        )
    if is_done(path, key):
        remove_journal(journal_beside(path))  # of a run that was killed just before it had removed it
        on_event(StageDone(stage, 0.0, reused=True))
        dataset = datasets.open_dataset(path)
        if dataset.attrs.get("pixel_size_pm") == movie.pixel_size_pm:
            return dataset.assign_attrs({MOVIE_KEY: movie.key})
    else:
        dataset = _made(partial(make, journal_beside(path)), on_event)
    dataset.attrs["pixel_size_pm"] = movie.pixel_size_pm
    save(dataset, path, key, settings, stage, source=str(movie.path), **{MOVIE_KEY: movie.key})
    remove_journal(journal_beside(path))
    return dataset.assign_attrs({MOVIE_KEY: movie.key})


def _made(make: Callable[[], xr.Dataset], on_event: Sink) -> xr.Dataset:
    """Return the result of a stage; what its tasks left and the disk has damaged since is made anew."""
    for _ in range(_ATTEMPTS - 1):
        try:
            return make()
        except DamagedArrayError as error:
            on_event(Warned(f"{error.where} was damaged on disk: it is made again"))
    return make()


def save(dataset: xr.Dataset, path: Path, key: str, settings: Settings, kind: str, **more: Any) -> None:
    """Write the result of a stage with its provenance."""
    about = provenance(key, settings) | {"kind": kind, "complete": True} | more
    known = {name: value for name, value in dataset.attrs.items() if value is not None and name != MOVIE_KEY}
    stored = dataset.copy()
    stored.attrs = metadata.json_ready(known | {metadata.ATTRIBUTE: about})
    datasets.write_dataset(stored, path)


def is_done(path: Path, key: str) -> bool:
    """Tell whether the store at ``path`` is complete and has this key."""
    about = metadata.attributes(path)
    return about.get("key") == key and bool(about.get("complete"))


def content(path: str | Path | None) -> bytes:
    """Return the bytes of a small file, empty where there is none."""
    return Path(path).read_bytes() if path and Path(path).is_file() else b""
