"""What checksums, syncs and journals cost: their share of the processor time of convert and fit.

``python -m benchmarks.cases.integrity.checksums``. Right: 3 % at most of a long movie; some hundredths of a second are
the same for any length. The time inside these functions is added up, by the clock of each thread: on a busy machine
two runs, with and without them, differ by more than that.
"""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from types import SimpleNamespace
from typing import Any
from unittest import mock

import google_crc32c
import numpy as np

import tract_dask as td
from tract_dask.settings import FitSettings
from tract_dask.stages.fit.job import prepare
from tract_dask.stages.fit.stage import fit_movie
from tract_dask.store import disk, metadata, shard_files
from tract_dask.store.columns import column_dataset
from tract_dask.store.journal import Journal

from ..common import Clock, crystal, work_folder

WINDOW = 25


class Spent:
    """Processor time, s, inside some functions, in all threads; of functions inside one another only the outer."""

    def __init__(self) -> None:
        self.cpu_s, self._lock, self._inside = 0.0, threading.Lock(), threading.local()

    def counted(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function whose time counts."""

        @wraps(function)
        def call(*args: Any, **more: Any) -> Any:
            if getattr(self._inside, "now", False):
                return function(*args, **more)
            self._inside.now, began = True, time.thread_time()
            try:
                return function(*args, **more)
            finally:
                self._inside.now = False
                with self._lock:
                    self.cpu_s += time.thread_time() - began

        return call


@contextmanager
def watched() -> Iterator[Spent]:
    """Add up the time of checksums, syncs, the journal's lines and the roots' metadata in this block."""
    spent = Spent()
    crc = SimpleNamespace(extend=spent.counted(google_crc32c.extend))
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(shard_files, "google_crc32c", crc))
        for place, name in ((disk, "sync"), (Journal, "_commit"), (Journal, "sound"), (metadata, "write_root")):
            stack.enter_context(mock.patch.object(place, name, spent.counted(getattr(place, name))))
        yield spent


def tell(stage: str, work: Callable[[], Any]) -> None:
    """Do the work of a stage and print the share."""
    with watched() as spent, Clock() as clock:
        work()
    share = spent.cpu_s / clock.cpu_s
    print(f"{stage}: {share:.1%}, {spent.cpu_s:.3f} of {clock.cpu_s:.2f} s of processor time", flush=True)


def track(n_frames: int, side: int) -> None:
    """Convert and fit a crystal."""
    scene, _ = crystal(n_frames, (side, side))
    places = scene.places[0]
    with work_folder() as folder:
        np.save(folder / "movie.npy", scene.counts())
        tell("convert", lambda: td.convert(folder / "movie.npy", folder / "movie.zarr"))
        movie = td.open_movie(folder / "movie.zarr")
        drift = td.estimate_drift(movie)
        summed = td.sum_image(movie, drift)
        seeds = column_dataset(places[((places > WINDOW) & (places < side - WINDOW)).all(axis=1)])
        columns = td.find_columns(summed, seeds=seeds, window_px=WINDOW)
        job = prepare(movie, columns, drift, FitSettings(window_px=WINDOW), summed=summed)
        tell("fit", lambda: fit_movie(movie, job, folder / "results.zarr"))


def main() -> None:
    """Print the shares; those of a first movie, which loads what is compiled, too."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=64)
    parser.add_argument("--side", type=int, default=1024)
    options = parser.parse_args()
    for n_frames in (6, options.frames, 4 * options.frames):
        track(n_frames, options.side)


if __name__ == "__main__":
    main()
