"""Conversion of uncompressed formats against a bare loop: ``python -m benchmarks.cases.reading.rates --gb 2``.

The loop reads the same frames of the same file and writes them to an array of the same layout and codecs, by the zarrs
pipeline, in one process with one thread for encoding. Right: at least 0.9 of its rate. The conversion also measures
every frame and writes the binned levels.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import mrcfile
import numpy as np
import zarr
from numpy.typing import NDArray

import tract_dask as td
from tract_dask.readers import open_source
from tract_dask.readers.blocks import BlockSource
from tract_dask.store.files import remove
from tract_dask.store.shards import split

from ..common import Clock, work_folder

SIDE, TIMES = 2048, 3


def _mrc(path: Path, frames: NDArray[Any]) -> None:
    with mrcfile.new(path) as file:
        file.set_data(frames)


def _writers() -> dict[str, Callable[[Path, NDArray[Any]], object]]:
    """Return what writes a movie of each format: the writers of the tests."""
    dm, stamped = (importlib.import_module(f"tests.helpers.files_{name}") for name in ("dm", "stamped"))
    return {".dm4": dm.write_dm, ".seq": stamped.write_seq, ".mrc": _mrc, ".mib": stamped.write_mib}


def _bare(path: Path, like: Path, store: Path) -> float:
    """Read and encode a movie into an array like ``like``; return the seconds."""
    source = open_source(path)
    assert isinstance(source, BlockSource)
    model = zarr.open_array(str(like / "0"), mode="r")
    remove(store)
    with zarr.config.set({"codec_pipeline.path": "zarrs.ZarrsCodecPipeline", "threading.max_workers": 1}):
        target = zarr.create_array(
            str(store),
            shape=model.shape,
            chunks=model.chunks,
            shards=model.shards,
            dtype=model.dtype,
            compressors=model.compressors,
            fill_value=0,
        )
        with Clock() as clock, path.open("rb", buffering=0) as file:
            for shard in split(source.shape[0], target.shards[0] if target.shards else 1):
                frames = np.empty((shard.frames, *source.shape[1:]), source.stored)
                for number, frame in enumerate(frames):
                    file.seek(int(source.offsets[shard.start + number]))
                    file.readinto(frame.view(np.uint8).data)
                target[shard.start : shard.stop] = frames
    return clock.wall_s


def _ours(path: Path, store: Path) -> float:
    remove(store)
    with Clock() as clock:
        td.convert(path, store)
    return clock.wall_s


def main() -> None:
    """Print both rates for each format."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gb", type=float, default=2.0, help="size of each movie in GB")
    n_frames = max(8, round(parser.parse_args().gb * 1e9 / SIDE**2 / 2))
    frames = np.resize(np.random.default_rng(0).poisson(40, (8, SIDE, SIDE)).astype("u2"), (n_frames, SIDE, SIDE))
    for suffix, write in _writers().items():
        with work_folder() as folder:
            path = folder / f"movie{suffix}"
            write(path, frames)
            _ours(path, folder / "like.zarr")
            pairs = [
                (_bare(path, folder / "like.zarr", folder / "bare"), _ours(path, folder / "ours.zarr"))
                for _ in range(TIMES)
            ]
            bare, ours = (median(column) for column in zip(*pairs, strict=True))
            rate = frames.nbytes / 1e6
            print(
                f"{suffix}: loop {rate / bare:.0f} MB/s, convert {rate / ours:.0f} MB/s, {bare / ours:.2f}", flush=True
            )


if __name__ == "__main__":
    main()
