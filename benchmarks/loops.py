"""Bare loops: the least that a stage has to do, on the same workers, with nothing around it.

Every loop is a plain function of a shard, mapped over the shards by Dask.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeAlias

import dask
import dask.array as da
import numpy as np
import tifffile
import zarr
from distributed import Client
from numpy.typing import NDArray

from tract_dask.store.shards import Shard, split

Part: TypeAlias = tuple[slice, slice]
"""Rows and columns of a frame."""


def over_shards(client: Client, task: Callable[[Shard], None], shards: Iterable[Shard]) -> None:
    """Run a task on every shard, and wait for all."""
    client.gather(client.map(task, list(shards), pure=False))


def convert(client: Client, movie: Path, like: Path, store: Path) -> None:
    """Read pages, encode them as the array ``like`` is encoded, write them to a new array ``store``."""
    model = _open_array(like)
    _create_like(model, store)
    over_shards(client, partial(_convert_shard, movie, store), split(*_frames(model)))


def convert_with_dask(client: Client, movie: Path, like: Path, store: Path) -> None:
    """Convert by ``dask.array.to_zarr`` of tifffile's pages, with zarr-python's own pipeline, to the same layout."""
    model = zarr.open_array(str(like), mode="r")
    target = _create_like(model, store)
    blocks = [
        da.from_delayed(
            dask.delayed(_read_pages, pure=False)(movie, shard.start, shard.stop),
            (shard.frames, *model.shape[1:]),
            model.dtype,
        )
        for shard in split(*_frames(model))
    ]
    write = da.concatenate(blocks).to_zarr(target, compute=False)
    client.compute(write).result()


def read_arrays(client: Client, arrays: Sequence[Path]) -> None:
    """Read and decode whole arrays, one after the other, shard by shard."""
    for path in arrays:
        array = _open_array(path)
        over_shards(client, partial(_read_parts, path, [(slice(None), slice(None))]), split(*_frames(array)))


def read_tiles(client: Client, path: Path, parts: Sequence[Sequence[Part]]) -> None:
    """Read and decode some parts of an array; ``parts`` has those of every shard."""
    shards = split(*_frames(_open_array(path)))
    tasks = [
        client.submit(_read_parts, path, part, shard, pure=False) for shard, part in zip(shards, parts, strict=True)
    ]
    client.gather(tasks)


def touched_parts(boxes: NDArray[np.int64], shape: tuple[int, ...], tile: tuple[int, ...]) -> list[Part]:
    """Return the tiles that boxes touch, as few parts as whole runs of tiles in a row make.

    Parameters
    ----------
    boxes
        (n, 4) first row, first column, last row and last column (not included).
    shape, tile
        Of a frame and of a tile, px.

    Examples
    --------
    >>> touched_parts(np.array([[0, 10, 5, 20], [0, 5, 3, 7]]), (16, 32), (8, 8))
    [(slice(0, 8, None), slice(0, 24, None))]
    """
    touched = np.zeros([-(-length // side) for length, side in zip(shape, tile, strict=True)], np.bool_)
    for y0, x0, y1, x1 in np.clip(boxes, 0, [*shape, *shape]):
        touched[y0 // tile[0] : -(-y1 // tile[0]), x0 // tile[1] : -(-x1 // tile[1])] = True
    parts = []
    for row, tiles in enumerate(touched):
        edges = np.flatnonzero(np.diff(tiles, prepend=False, append=False)).reshape(-1, 2) * tile[1]
        rows = slice(row * tile[0], min((row + 1) * tile[0], shape[0]))
        parts += [(rows, slice(int(left), min(int(right), shape[1]))) for left, right in edges]
    return parts


def _convert_shard(movie: Path, store: Path, shard: Shard) -> None:
    _open_array(store)[shard.start : shard.stop] = _read_pages(movie, shard.start, shard.stop)


def _read_pages(movie: Path, start: int, stop: int) -> NDArray[Any]:
    return np.asarray(_open_tiff(movie).asarray(key=slice(start, stop)))


def _read_parts(path: Path, parts: Sequence[Part], shard: Shard) -> None:
    array = _open_array(path)
    for part in parts:
        np.asarray(array[shard.start : shard.stop, *part])


@lru_cache(maxsize=4)
def _open_tiff(movie: Path) -> tifffile.TiffFile:
    return tifffile.TiffFile(movie)


@lru_cache(maxsize=8)
def _open_array(path: Path) -> zarr.Array[Any]:
    with zarr.config.set({"codec_pipeline.path": "zarrs.ZarrsCodecPipeline"}):
        return zarr.open_array(str(path), mode="r+")


def _create_like(model: zarr.Array[Any], store: Path) -> zarr.Array[Any]:
    return zarr.create_array(
        str(store),
        shape=model.shape,
        chunks=model.chunks,
        shards=model.shards,
        dtype=model.dtype,
        compressors=model.compressors,
        fill_value=0,
        overwrite=True,
    )


def _frames(array: zarr.Array[Any]) -> tuple[int, int]:
    """Return the frames of an array, and of one of its shards."""
    assert array.shards is not None
    return array.shape[0], array.shards[0]
