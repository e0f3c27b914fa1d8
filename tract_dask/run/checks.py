"""Checks of sources, settings and destinations before any work."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cluster.memory import local_memory_limit
from ..errors import DestinationError, InputError, SettingsError, SourceError
from ..progress import STAGES
from ..readers import open_source
from ..readers.checks import Permit
from ..readers.movie_files import FileList
from ..readers.source import FrameSource
from ..settings.run import ColumnSettings, DriftSettings, FitSettings, RunSettings
from ..stages.columns.sites import lattice_sites
from ..stages.columns.window_size import resolve_window
from ..stages.convert import references
from ..stages.convert.origin import check_kept, is_movie_of, remembered_source
from ..stages.drift.stage import read_drift_csv
from ..stages.fit.job import check_counts
from ..stages.fit.vacuum import check_box
from ..store import metadata
from ..store.columns import check_inside, read_columns_csv
from ..store.movie import Movie
from ..store.run_folder import RunFolder

_LENGTHS = ("spacing_px", "search_radius_px", "centroid_radius_px")
"""Settings of the columns that are lengths in the summed image."""


def check_inputs(shape: tuple[int, int, int], settings: RunSettings) -> None:
    """Check all settings of a run of a movie of ``shape`` (frames, y, x), and read its small inputs once.

    Raises
    ------
    InputError
        Naming what cannot be used, and the shape that it does not fit.
    """
    drift = check_drift(shape[0], settings.drift)
    check_columns(shape[1:], settings.columns, settings.fit.window_px)
    check_box(settings.fit.vacuum_box, shape[1:], drift)
    local_memory_limit(settings.cluster)


def check_drift(n_frames: int, settings: DriftSettings) -> NDArray[np.float64] | None:
    """Return the drift of a movie of ``n_frames``, (frames, 2) in px, where a file gives it.

    Raises
    ------
    InputError
        As :func:`check_inputs`.
    """
    if settings.method != "csv":
        return None
    return read_drift_csv(_required(settings.csv, "--drift-csv"), n_frames)


def check_columns(shape: tuple[int, ...], settings: ColumnSettings, window_px: int | None) -> None:
    """Check where columns are to be looked for in frames of ``shape`` (y, x), and the window of their fit.

    Raises
    ------
    SettingsError
        As :func:`check_inputs`.
    """
    if settings.method == "csv":
        table = _required(settings.csv, "--columns-csv")
        check_inside(read_columns_csv(table), shape, str(table))
    if settings.method == "lattice":
        lattice_sites(settings.lattices, shape)
    if settings.method == "template" and settings.template is not None:
        _check_place(settings.template, shape)
    for name in _LENGTHS:
        _check_length(name, getattr(settings, name), shape)
    spacing_px = None if settings.method == "auto" else settings.spacing_px
    if window_px is not None or spacing_px is not None:
        resolve_window(window_px, shape, spacing_px)


def check_pixels_of(movie: Movie, settings: FitSettings) -> None:
    """Check that a converted movie holds what the fit needs.

    Raises
    ------
    SettingsError
        Where the estimator needs counts, and a pixel is negative.
    """
    if settings.estimator == "poisson" and movie.offset == 0 and movie.pixels.dark is None:
        check_counts(movie.statistics()["frame_min"].to_numpy())


def _check_place(place: tuple[int, ...], shape: tuple[int, ...]) -> None:
    if len(place) != 2 or not (0 <= place[0] < shape[1] and 0 <= place[1] < shape[0]):
        raise SettingsError(
            "the template lies outside the frame" if len(place) == 2 else "this is not a place",
            "setting template (ColumnSettings)",
            f"x, y with x from 0 to {shape[1] - 1}, y from 0 to {shape[0] - 1}",
            str(place),
            "Give the place of a column in px of the summed image, x first",
        )


def _check_length(name: str, value: float | None, shape: tuple[int, ...]) -> None:
    if value is not None and value > max(shape):
        raise SettingsError(
            "the value is larger than the frame",
            f"setting {name} (ColumnSettings)",
            f"at most {max(shape)} px, the longer side of a frame of {shape[0]} rows and {shape[1]} columns",
            f"{value:g}",
            "Give it in px of the frame",
        )


def _required(path: str | None, option: str) -> Path:
    if path is None:
        raise InputError("method csv needs a file", "settings", option, "none", f"Give one with {option}")
    return Path(path)


def open_input(
    source: str | Path | FileList, settings: RunSettings, kept: Path | None, permit: Permit | None = None
) -> FrameSource:
    """Open the source by its whole path, which any worker can use.

    A source that is not there is taken from the complete movie at ``kept``, if it is that movie's.
    """
    place = source if isinstance(source, FileList) else str(Path(source).absolute())
    try:
        return open_source(place, settings.source, permit=permit)
    except SourceError as error:
        gone = None if kept is None else remembered_source(kept, str(place), error)
        if gone is None:
            raise
        return gone


def check_suffix(path: Path, suffix: str) -> None:
    """Check that the name of a file ends as it has to."""
    if path.suffix != suffix:
        raise DestinationError(
            "the file name has the wrong suffix", str(path), f"a name that ends in {suffix}", path.name, "Change it"
        )


def with_whole_paths(settings: RunSettings) -> RunSettings:
    """Return the settings with whole paths, so that they mean the same from any folder."""
    cluster = settings.cluster

    def whole(path: str | None) -> str | None:
        return None if path is None else str(Path(path).absolute())

    return dataclasses.replace(
        settings,
        convert=references.with_whole_paths(settings.convert),
        drift=dataclasses.replace(settings.drift, csv=whole(settings.drift.csv)),
        columns=dataclasses.replace(settings.columns, csv=whole(settings.columns.csv)),
        cluster=dataclasses.replace(cluster, scheduler_file=whole(cluster.scheduler_file), tls=whole(cluster.tls)),
    )


def check_stage(until: str | None) -> None:
    """Check that there is a stage of this name."""
    if until is not None and until not in STAGES:
        raise InputError("there is no such stage", "until", f"one of {', '.join(STAGES)}", until, "Correct its name")


def check_output(
    outputs: RunFolder, source: FrameSource, settings: RunSettings | None = None, *, overwrite: bool
) -> None:
    """Check that the folder is empty or holds a run of this movie, and can be written.

    Without ``settings``, those of its conversion are taken to be the same.

    Raises
    ------
    DestinationError
        Also where a complete movie would have to be thrown away.
    """
    root = outputs.root
    ours = outputs.settings.exists() or outputs.events.exists()
    if root.exists() and not root.is_dir():
        raise DestinationError("the output is not a folder", str(root), "a folder", "a file", "Choose another place")
    for path in outputs.written():
        if path.suffix != ".zarr" and path.is_dir():
            raise DestinationError(
                "a folder lies where a file is written", str(path), "a file, or nothing", "a folder", "Move it away"
            )
    others = sorted(path.name for path in root.glob("[!.]*"))
    if others and not ours and not overwrite:
        raise DestinationError(
            "the output folder already holds other files",
            str(root),
            "an empty folder, or that of an earlier run",
            ", ".join(others[:3]),
            "Choose another folder, or use --overwrite",
        )
    if not overwrite:
        _check_movie(outputs, source, settings)
        for path in outputs.stages()[1:]:
            metadata.check_place(path)
    metadata.check_destination(outputs.movie, overwrite=overwrite)


def _check_movie(outputs: RunFolder, source: FrameSource, settings: RunSettings | None) -> None:
    """Check that the movie in a run's folder is one of this source, and would not have to be thrown away."""
    present = metadata.attributes(outputs.movie)
    before = str(present.get("source", source.path))
    unfinished_of_it = before == source.path and not present.get("complete")
    if present.get("kind") == "movie" and not unfinished_of_it and not is_movie_of(outputs.movie, source):
        raise DestinationError(
            "this folder holds the run of another movie",
            str(outputs.root),
            f"an empty folder, or a run of what {source.path} holds now",
            f"a run of what {before} held on {present.get('created', 'an unknown day')}",
            "Choose another folder, or use --overwrite: then all of that run is made again",
        )
    if settings is not None:
        check_kept(outputs.movie, source, settings.convert, settings.source)
