"""Costs that must not grow with the length of a movie, or with the number of tasks.

``python -m benchmarks.cases.integrity.cost``. Right: the processor time of a stage for a frame is the same for any
number of frames, and a scheduler hands out about as many tasks a second as its workers can take.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
from distributed import Client, LocalCluster

import tract_dask as td
from tract_dask.cluster.tasks import stream_shards
from tract_dask.settings import FitSettings
from tract_dask.store.columns import column_dataset
from tract_dask.store.journal import Journal, Payload
from tract_dask.store.shards import Shard, split

from ..common import Clock, work_folder

T = TypeVar("T")

SIDE = 32
SITES = [[10.0, 10.0], [22.0, 10.0], [10.0, 22.0], [22.0, 22.0]]
WINDOW = 9


def stages(n_frames: int) -> None:
    """Track tiny frames, so that shards are long, and print the processor time of each stage for a frame."""
    y, x = np.mgrid[:SIDE, :SIDE]
    expected = 2.0 + sum(12 * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 8) for a, b in SITES)
    with work_folder() as folder:
        np.save(folder / "movie.npy", np.random.default_rng(0).poisson(expected, (n_frames, SIDE, SIDE)).astype("u1"))
        clock = partial(_clocked, n_frames=n_frames)
        clock("convert", lambda: td.convert(folder / "movie.npy", folder / "movie.zarr"))
        movie = td.open_movie(folder / "movie.zarr")
        drift = clock("drift", lambda: td.estimate_drift(movie))
        summed = clock("sum", lambda: td.sum_image(movie, drift))
        columns = td.find_columns(summed, seeds=column_dataset(SITES), window_px=WINDOW)
        fit = FitSettings(window_px=WINDOW)
        clock("fit", lambda: td.fit_columns(movie, columns, drift, fit, summed=summed))


def _clocked(name: str, work: Callable[[], T], *, n_frames: int) -> T:
    with Clock() as clock:
        made = work()
    print(f"{n_frames} frames, {name}: {1e3 * clock.cpu_s / n_frames:.3f} ms of processor time a frame", flush=True)
    return made


def tasks(threads: int, nap_s: float = 0.6) -> None:
    """Hand out tasks that only sleep."""
    number = 6 * threads
    cluster = LocalCluster(n_workers=1, threads_per_worker=threads, processes=False, dashboard_address=None)
    with cluster, Client(cluster) as client, work_folder() as folder:
        client.submit(int).result()
        journal = Journal(folder / "tasks", "key")
        with Clock() as clock:
            stream_shards(partial(_nap, nap_s), split(number, 1), _nothing, journal=journal, name="nap", client=client)
    print(
        f"{threads} threads: {number / clock.wall_s:.0f} tasks of {nap_s} s a second of {threads / nap_s:.0f}; "
        f"{1e3 * clock.cpu_s / number:.2f} ms of processor time a task",
        flush=True,
    )


def _nap(seconds: float, shard: Shard) -> Payload:
    time.sleep(seconds)
    return {"fits": 1}


def _nothing(shard: Shard, payload: Payload) -> None:
    """Take what a task gave."""


def main() -> None:
    """Print a line for each stage and length, and for each number of threads."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, nargs="*", default=[2000, 8000, 32000])
    parser.add_argument("--threads", type=int, nargs="*", default=[50, 100])
    options = parser.parse_args()
    for n_frames in options.frames:
        stages(n_frames)
    for threads in options.threads:
        tasks(threads)


if __name__ == "__main__":
    main()
