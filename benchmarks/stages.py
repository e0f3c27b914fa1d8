"""Each stage of a run beside a bare loop of the same workers: convert, drift and sum, fit; and fit against columns."""

from __future__ import annotations

import csv
import dataclasses
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from distributed import Client
from numpy.typing import NDArray

import tract_dask
from tract_dask.cluster.connect import connect
from tract_dask.kernels.windows import gaussian_kernel
from tract_dask.run.pipeline import RunOutcome
from tract_dask.settings import ClusterSettings, ColumnSettings, FitSettings, RunSettings
from tract_dask.stages.drift import measure
from tract_dask.store import datasets, files, metadata
from tract_dask.store.run_folder import RunFolder
from tract_dask.store.shards import split

from . import loops, movies
from .sizes import Size
from .timing import summary, timed

_WARM_FRAMES = 16


def run(size: Size, work: Path) -> dict[str, Any]:
    """Return the times of the stages and of the bare loops, taken in turns, and of the fit stage for some columns."""
    workers = psutil.cpu_count() or 1
    movie = movies.simulate(work / "stages.tif", size, size.stage_frames)
    warm = movies.first_frames(movie, _WARM_FRAMES, work / "warm.tif")
    settings = RunSettings(fit=FitSettings(window_px=size.window_px))
    output = work / "stages"
    times: dict[str, list[float]] = {}
    with connect(ClusterSettings(workers=workers)) as client:
        with finished_run(warm, output, settings, client):
            pass  # compiles the kernels, or loads them
        for last in (*[False] * (size.long_repeats - 1), True):
            with finished_run(movie, output, settings, client) as outcome:
                for name, seconds in (outcome.seconds | bare_loops(client, movie, outcome.outputs, work)).items():
                    times.setdefault(name, []).append(seconds)
                if last:
                    sweep = fit_sweep(size, movie, outcome.outputs, settings, client)
    movie.unlink()
    warm.unlink()
    return {
        "workers": workers,
        "frames": size.stage_frames,
        "columns": outcome.columns,
        "window_px": size.window_px,
        "input_mb": size.stage_frames * size.frame_bytes / 1e6,
        "seconds": {name: summary(values) for name, values in times.items()},
        "fit_by_columns": {str(count): summary(values) for count, values in sweep.items()},
    }


@contextmanager
def finished_run(movie: Path, output: Path, settings: RunSettings, client: Client) -> Iterator[RunOutcome]:
    """Yield what a new run of a movie did; its folder is removed at the end."""
    os.sync()
    try:
        yield tract_dask.run(movie, output, settings, client=client)
    finally:
        shutil.rmtree(output, ignore_errors=True)


def bare_loops(client: Client, movie: Path, outputs: RunFolder, work: Path) -> dict[str, float]:
    """Return how long the bare loops beside the stages of a finished run take, s."""
    frames, copy = outputs.movie / "0", work / "bare.zarr"
    tasks = {
        "bare convert": partial(loops.convert, client, movie, frames, copy),
        "dask to_zarr": partial(loops.convert_with_dask, client, movie, frames, copy),
        "bare drift and sum": partial(loops.read_arrays, client, arrays_of_drift_and_sum(outputs)),
        "bare fit": partial(loops.read_tiles, client, frames, parts_of_fit(outputs)),
    }
    seconds = {}
    for name, task in tasks.items():
        seconds[name] = timed(task)()
        shutil.rmtree(copy, ignore_errors=True)
    return seconds


def arrays_of_drift_and_sum(outputs: RunFolder) -> list[Path]:
    """Return what the drift and the sum stages read: a level in each of the drift's passes, then the frames."""
    about = metadata.attributes(outputs.movie)
    _, height, width = about["shape"]
    fine = (bins for bins in (1, *about["bins"]) if (height // bins) * (width // bins) <= measure.LEVEL_PIXELS)
    level = next(fine, about["bins"][-1])
    frames = outputs.movie / "0"
    return [frames if level == 1 else outputs.movie / "binned" / str(level)] * len(measure.PASSES) + [frames]


def parts_of_fit(outputs: RunFolder) -> list[list[loops.Part]]:
    """Return the parts of the frames that the fit stage needs, shard by shard: its windows, and the vacuum."""
    about, array = metadata.attributes(outputs.results), datasets.open_array(outputs.movie / "0")
    tracks = tract_dask.open_results(outputs.results)
    places = np.stack([tracks["y_ref"].to_numpy(), tracks["x_ref"].to_numpy()], axis=1)
    margin = gaussian_kernel(tracks.attrs["window_blur_px"]).size // 2
    assert array.shards is not None
    parts = []
    for shard in split(array.shape[0], array.shards[0]):
        shift = tracks["drift_measured"].to_numpy()[shard.start : shard.stop]
        corner = np.rint(places + shift[:, None]).astype(np.int64) - about["window"] // 2
        boxes = np.concatenate([corner, corner + about["window"]], axis=-1).reshape(-1, 4)
        if about["vacuum"]:
            y0, y1, x0, x1 = about["vacuum"]
            moved = np.rint(np.tile(shift, 2)).astype(np.int64) + np.array([y0, x0, y1, x1])
            boxes = np.concatenate([boxes, moved])
        wide = boxes + np.array([-margin, -margin, margin, margin])
        parts.append(loops.touched_parts(wide, array.shape[1:], array.chunks[1:]))
    return parts


def fit_sweep(
    size: Size, movie: Path, outputs: RunFolder, settings: RunSettings, client: Client
) -> dict[int, list[float]]:
    """Return how long the fit stage takes with some of the columns of a finished run, s; its results are replaced."""
    tracks = tract_dask.open_results(outputs.results)
    places = np.stack([tracks["x_ref"].to_numpy(), tracks["y_ref"].to_numpy()], axis=1)
    counts = sorted({*(count for count in size.sweep_columns if count < len(places)), len(places)})
    tables = {count: outputs.root.with_name(f"columns-{count}.csv") for count in counts}
    times: dict[int, list[float]] = {count: [] for count in counts}
    for count, table in tables.items():
        write_table(places[np.linspace(0, len(places) - 1, count).astype(int)], table)
    for _ in range(size.long_repeats):
        for count, table in tables.items():
            columns = ColumnSettings(method="csv", csv=str(table))
            files.remove(outputs.results)
            outcome = tract_dask.run(movie, outputs.root, dataclasses.replace(settings, columns=columns), client=client)
            times[count].append(outcome.seconds["fit"])
    return times


def write_table(places: NDArray[np.float64], table: Path) -> None:
    """Write places (n, 2), (x, y), as a table of columns."""
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["x", "y"])
        writer.writerows(places.tolist())
