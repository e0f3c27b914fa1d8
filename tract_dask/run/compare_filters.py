"""Compare filters on a finished run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import xarray as xr

from ..analysis.filters import compare_filters, filtered_region, wiener_shifts, write_comparison
from ..errors import MissingStoreError
from ..settings.run import FitSettings
from ..store import datasets
from ..store.movie import open_movie


def compare_in_run(
    run: Path, output: Path, frames: Sequence[int], column_ids: Sequence[int] | None, settings: FitSettings
) -> tuple[xr.Dataset, list[str]]:
    """Compare the filters on the movie and columns of a run, into ``filters.csv`` and ``filters.png``.

    Parameters
    ----------
    run
        The folder of a run (:class:`tract_dask.store.run_folder.RunFolder`).
    output
        The folder to write to.

    Returns
    -------
    compared, warnings
        As :func:`compare_filters` and :func:`wiener_shifts` give them. The figure is of the first frame.

    Raises
    ------
    MissingStoreError
        Where the folder holds no run that has come as far as its columns.
    """
    from ..plots.filters import plot_filters  # matplotlib takes its time

    stage = {name: run / f"{name}.zarr" for name in ("movie", "drift", "columns")}
    if missing := [path.name for path in stage.values() if not path.is_dir()]:
        raise MissingStoreError(
            "the run is not finished", str(run), "movie.zarr, drift.zarr and columns.zarr", f"no {missing[0]}", "Run it"
        )
    movie, drift, columns = open_movie(stage["movie"]), *(datasets.open_dataset(stage[k]) for k in ("drift", "columns"))
    compared = compare_filters(movie, columns, drift, frames=frames, column_ids=column_ids, settings=settings)
    output.mkdir(parents=True, exist_ok=True)
    write_comparison(compared, output / "filters.csv")
    plot_filters(filtered_region(movie, compared, frames[0], settings), compared, output / "filters.png")
    return compared, wiener_shifts(compared)
