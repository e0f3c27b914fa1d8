"""What reading costs where files are many or chunks lie across frames: ``python -m benchmarks.cases.reading.cost``.

Right: opening a folder and reading a frame of it cost about the same for a frame whatever the number of files; HDF5
that is read 16 frames at a time takes about as long as at once, unless its chunks hold many frames each.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import h5py
import numpy as np
import tifffile

from tract_dask.readers import open_source

from ..common import Clock, work_folder

CHUNKS = (None, (1, 512, 512), (64, 64, 64), (128, 32, 32))
STEP = 16
READS = 100


def folder_of_files(folder: Path, number: int) -> None:
    """Open a folder of small TIFFs, and read frames in its middle."""
    for k in range(number):
        tifffile.imwrite(folder / f"frame_{k:06d}.tif", np.zeros((64, 64), "u2"))
    with Clock() as opening:
        source = open_source(folder)
    with Clock() as reading:
        for k in range(number // 2, number // 2 + READS):
            source.read(k % number, k % number + 1)
    print(
        f"{number} files: opened in {opening.wall_s:.2f} s, {1e3 * opening.wall_s / number:.3f} ms a file; "
        f"{1e3 * reading.wall_s / READS:.2f} ms a frame",
        flush=True,
    )


def chunked(folder: Path, chunks: tuple[int, int, int] | None, n_frames: int) -> None:
    """Read an HDF5 movie in steps, and at once."""
    path = folder / "movie.h5"
    if chunks:
        chunks = (min(chunks[0], n_frames), *chunks[1:])
    with h5py.File(path, "w") as file:
        frames = np.random.default_rng(0).poisson(3, (n_frames, 512, 512)).astype("u2")
        stored = file.create_dataset(
            "movie", data=frames, chunks=chunks or True, compression="gzip", compression_opts=1
        )
        shape = stored.chunks
    source = open_source(path)
    with Clock() as steps:
        for k in range(0, n_frames, STEP):
            source.read(k, min(k + STEP, n_frames))
    with Clock() as once:
        source.read(0, n_frames)
    print(
        f"chunks {shape}: {STEP} frames at a time {steps.wall_s / once.wall_s:.1f} times as long as at once", flush=True
    )


def main() -> None:
    """Print a line for each folder and each shape of chunks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, nargs="+", default=[500, 2000, 8000])
    parser.add_argument("--frames", type=int, default=128, help="of the HDF5 movies")
    options = parser.parse_args()
    for number in options.files:
        with work_folder() as folder:
            folder_of_files(folder, number)
    for chunks in CHUNKS:
        with work_folder() as folder:
            chunked(folder, chunks, options.frames)


if __name__ == "__main__":
    main()
