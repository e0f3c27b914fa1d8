"""What checksums and syncs of stores cost: processor time of convert and fit with them and without, in turn.

``python -m benchmarks.cases.integrity.checksums``. Right: within 3 % of the time without.
"""

from __future__ import annotations

import argparse
import os
import statistics
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

import tract_dask as td
from tract_dask.settings import ConvertSettings, FitSettings
from tract_dask.stages.fit.job import prepare
from tract_dask.stages.fit.stage import fit_movie
from tract_dask.store import shard_files
from tract_dask.store.columns import column_dataset

from ..common import Clock, crystal, work_folder

WINDOW = 25


@contextmanager
def without(off: bool) -> Iterator[None]:
    """Let every checksum be 0 and no file be synced in this block, where ``off``."""
    if not off:
        yield
        return
    none = SimpleNamespace(extend=lambda before, data: 0)
    with mock.patch.object(shard_files, "google_crc32c", none), mock.patch.object(os, "fsync", return_value=None):
        yield


def once(folder: Path, frames: NDArray[Any], places: NDArray[np.float64]) -> dict[str, float]:
    """Convert and fit once; return the processor time of each in s."""
    took = {}
    np.save(folder / "movie.npy", frames)
    with Clock() as clock:
        td.convert(folder / "movie.npy", folder / "movie.zarr", settings=ConvertSettings(shard_mb=8))
    took["convert"] = clock.cpu_s
    movie = td.open_movie(folder / "movie.zarr")
    drift = td.estimate_drift(movie)
    summed = td.sum_image(movie, drift)
    columns = td.find_columns(summed, seeds=column_dataset(places), window_px=WINDOW)
    job = prepare(movie, columns, drift, FitSettings(window_px=WINDOW), summed=summed)
    with Clock() as clock:
        fit_movie(movie, job, folder / "results.zarr")
    took["fit"] = clock.cpu_s
    return took


def main() -> None:
    """Print the ratio of processor times with checksums and without, pair by pair."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=7)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--side", type=int, default=1024)
    options = parser.parse_args()
    scene, _ = crystal(options.frames, (options.side, options.side))
    frames, places = scene.counts(), scene.places[0]
    ratios: dict[str, list[float]] = defaultdict(list)
    for pair in range(-1, options.pairs):  # the first compiles, or loads what is compiled
        both = {}
        for off in (True, False) if pair % 2 else (False, True):
            with work_folder() as folder, without(off):
                both[off] = once(folder, frames, places)
        for stage in both[True] if pair >= 0 else ():
            ratios[stage].append(both[False][stage] / both[True][stage])
            print(f"{stage}: {both[False][stage]:.3f} s with, {both[True][stage]:.3f} s without", flush=True)
    for stage, found in ratios.items():
        print(f"{stage}: {statistics.median(found):.3f} of the time without (median of {len(found)} pairs)")


if __name__ == "__main__":
    main()
