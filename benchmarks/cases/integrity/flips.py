"""Flip bits of a finished run's stores, cut files short, remove them, and read.

``python -m benchmarks.cases.integrity.flips`` does more harm than tests/store/test_integrity.py has time for. Right:
each damage is refused by an error of ours, or is harmless; SILENT means other numbers and no word, and RAW an error of
a library.
"""

from __future__ import annotations

import argparse
import random
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import xarray as xr

import tract_dask as td
from tract_dask.errors import TractError
from tract_dask.store.datasets import open_dataset

from ..common import crystal, work_folder


def _bytes_of(dataset: xr.Dataset) -> bytes:
    return b"".join(repr(values.to_numpy().tolist()).encode() for values in dataset.variables.values())


def _movie(path: Path) -> bytes:
    movie = td.open_movie(path)
    frames = [movie.read(0, movie.n_frames), *(movie.read_binned(side, 0, movie.n_frames) for side in movie.bins)]
    return b"".join(pixels.tobytes() for pixels in frames) + _bytes_of(movie.statistics())


READERS: dict[str, Callable[[Path], bytes]] = {
    "movie.zarr": _movie,
    "drift.zarr": lambda path: _bytes_of(open_dataset(path)),
    "sum.zarr": lambda path: _bytes_of(open_dataset(path)),
    "columns.zarr": lambda path: _bytes_of(open_dataset(path)),
    "results.zarr": lambda path: _bytes_of(td.open_results(path).compute(scheduler="synchronous")),
}


def damages(data: bytes, rng: random.Random) -> Iterator[tuple[str, bytes | None]]:
    """Yield the name of a damage and the file's bytes after it; None: no file."""
    place = rng.randrange(len(data))
    yield "a bit", data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)]) + data[place + 1 :]
    yield "64 bytes zeroed", data[:place] + bytes(len(data[place : place + 64])) + data[place + 64 :]
    yield "cut short", data[:place]
    yield "empty", b""
    yield "removed", None


def outcome(read: Callable[[Path], bytes], store: Path, good: bytes) -> str:
    """Return what a reader makes of a store."""
    try:
        return "harmless" if read(store) == good else "SILENT"
    except TractError:
        return "refused"
    except Exception as error:  # noqa: BLE001 - any is what is looked for
        return f"RAW {type(error).__name__}"


def harm(store: Path, times: int, rng: random.Random) -> Iterator[tuple[str, str]]:
    """Damage files of a store one at a time, and yield the kind of each damage with its outcome."""
    read = READERS[store.name]
    good = read(store)
    files = sorted(file for file in store.rglob("*") if file.is_file() and file.stat().st_size)
    for _ in range(times):
        file = rng.choice(files)
        data = file.read_bytes()
        for kind, harmed in damages(data, rng):
            if harmed == data:
                continue
            file.unlink()
            if harmed is not None:
                file.write_bytes(harmed)
            yield kind, outcome(read, store, good)
            file.write_bytes(data)


def main() -> None:
    """Track a small movie, and print for each store how its damages end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=16, help="files of each store; each is damaged in five ways")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    scene, _ = crystal(12, (200, 200))
    with work_folder() as folder:
        np.save(folder / "movie.npy", scene.counts())
        td.run(folder / "movie.npy", folder / "out", report=False)
        for name in READERS:
            ends = Counter(
                f"{kind}: {end}"
                for kind, end in harm(folder / "out" / name, options.times, random.Random(options.seed))
            )
            print(name, dict(sorted(ends.items())), flush=True)


if __name__ == "__main__":
    main()
