"""The drift of a movie: measured, or from a table."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter

import numpy as np
import xarray as xr
from distributed import Client

from ...errors import SettingsError, SourceError
from ...kernels.registration import Floats
from ...progress import Sink, StageDone, StageStarted, silent
from ...settings.run import DriftSettings
from ...store.files import read_small
from ...store.keys import counted, stage_key
from ...store.movie import Movie
from ...store.tables import decoded, parse_number, parse_table
from ..keep import Workers, content, kept
from .measure import drift_dataset, measure_drift


def estimate_drift(
    movie: Movie,
    settings: DriftSettings | None = None,
    *,
    client: Client | None = None,
    on_event: Sink = silent,
    journal: Path | None = None,
) -> xr.Dataset:
    """Return the drift of every frame, (frame, axis) in px, zero at its median, and a quality for each frame.

    Quality is Pearson's correlation of the filtered frame with the filtered mean of all other parts of the movie, cut
    to 0..1; it falls with the dose. It is 0 where a frame holds nothing to register (all NaN, or constant) or does
    not resemble the others (:func:`.measure.lost_frames`); the drift of such a frame is interpolated, and it is not
    part of the sum. For methods csv and none it is 1.

    Parameters
    ----------
    journal
        Folder for the journals and partial sums of this stage: a later call with the same folder goes on where this
        one stopped. Delete it once the result is stored. It must be seen by every worker; None takes a folder for
        temporary files.
    on_event
        Told of ``drift``; for method auto every frame counts twice, once for each run over the movie.

    Returns
    -------
    xr.Dataset
        :data:`schema.DRIFT`, with attributes ``method``, ``pixel_size_pm``, and for method auto ``processors`` (kinds
        that took part), ``bin``, ``search_px`` and ``period_px`` (None: no lattice found), in px of the movie.

    Raises
    ------
    SettingsError, SourceError
        For method csv, if the file cannot be used.
    """
    started = perf_counter()
    settings = settings or DriftSettings()
    if settings.method == "auto":
        return measure_drift(movie, settings, client, on_event, journal)
    on_event(StageStarted("drift", movie.n_frames))
    if settings.method == "none":
        drift = np.zeros((movie.n_frames, 2))
    elif settings.csv is None:
        raise SettingsError(
            "method csv needs a file", "setting csv (DriftSettings)", "a path", "None", "Give --drift-csv FILE"
        )
    else:
        drift = read_drift_csv(settings.csv, movie.n_frames)
    on_event(StageDone("drift", perf_counter() - started, summary=f"method {settings.method}"))
    return drift_dataset(drift, np.ones(movie.n_frames), movie, method=settings.method)


def read_drift_csv(path: str | Path, n_frames: int) -> Floats:
    """Return the drift in a CSV file with columns frame, y, x: (frames, 2) in px, as it stands there.

    Rows may come in any order; other columns are ignored; frames count from 0; separators and decimal commas are
    understood as :func:`~tract_dask.store.tables.parse_table` does. The file may have 1 MiB and 512 bytes
    a frame.

    Raises
    ------
    SourceError
        Naming the line: no such file, a missing column, something that is no number, a frame that is missing, twice
        there, or not in the movie.
    """
    remedy = "Give one row for each frame: frame (from 0), y, x, in px"
    drift = np.full((n_frames, 2), np.nan)
    line_of: dict[int, int] = {}
    try:
        text = decoded(read_small(path, (1 << 20) + 512 * n_frames))
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError("the drift file cannot be read", str(path), got=str(error), remedy=remedy) from error
    table = parse_table(text, str(path), SourceError)
    missing = [name for name in ("frame", "y", "x") if name not in table.header]
    if missing:
        expected, got = "columns frame, y, x", ", ".join(table.header) or "an empty file"
        raise SourceError(f"column {missing[0]!r} is missing", f"{path}, line {table.line}", expected, got, remedy)
    for line, values in table.rows:
        where = f"{path}, line {line}"
        frame, shift = _parse_row(dict(zip(table.header, values, strict=True)), where, n_frames, remedy)
        if frame in line_of:
            what = f"frame {frame} occurs twice"
            raise SourceError(what, where, "each frame once", f"also in line {line_of[frame]}", remedy)
        line_of[frame], drift[frame] = line, shift
    absent = np.flatnonzero(np.isnan(drift[:, 0]))
    if absent.size:
        got = f"{len(line_of)} frames; the first one missing is {absent[0]}"
        raise SourceError("frames are missing", str(path), f"all {n_frames} frames of the movie", got, remedy)
    return drift


def _parse_row(row: dict[str, str], where: str, n_frames: int, remedy: str) -> tuple[int, tuple[float, float]]:
    try:
        frame, y, x = (parse_number(row[name]) for name in ("frame", "y", "x"))
    except ValueError:
        got = ", ".join(repr(row[name]) for name in ("frame", "y", "x"))
        raise SourceError("this is not a number", where, "three numbers", got, remedy) from None
    if not np.isfinite([y, x]).all():
        raise SourceError("the drift is not finite", where, "two numbers in px", f"{y}, {x}", remedy)
    if not (frame.is_integer() and 0 <= frame < n_frames):
        raise SourceError("there is no such frame", where, f"0 to {n_frames - 1}", str(row["frame"]), remedy)
    return int(frame), (y, x)


def drift_stage(
    movie: Movie, path: Path, settings: DriftSettings, workers: Workers, on_event: Sink = silent
) -> xr.Dataset:
    """Return the drift of ``movie``, kept at ``path``."""
    given = content(settings.csv) if settings.method == "csv" else b""
    key = stage_key("drift", movie.key, counted("drift", drift=settings), given)

    def make(journal: Path) -> xr.Dataset:
        client = workers() if settings.method == "auto" else None
        return estimate_drift(movie, settings, client=client, on_event=on_event, journal=journal)

    return kept("drift", movie, path, key, settings, make, on_event)
