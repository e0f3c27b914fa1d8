"""Chunks that are missing inside the shards of a Zarr array: by the index that each shard has."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..checks import open_binary

_MOST_SHARDS = 10_000
_NOWHERE = int(np.iinfo(np.uint64).max)


@dataclass(frozen=True)
class ShardIndex:
    """How a shard says where its chunks are.

    Attributes
    ----------
    chunk
        Shape of a chunk in a shard.
    n_checksum
        Bytes of the index's checksum.
    at_end
        Whether it is at the end of the file; else at its beginning.
    """

    chunk: tuple[int, ...]
    n_checksum: int
    at_end: bool


def shard_index(codecs: Any) -> ShardIndex | None:
    """Return the index of an array's shards by its codecs; None where there are none, or it is compressed."""
    first = codecs[0] if codecs else {}
    if len(codecs) != 1 or first.get("name") != "sharding_indexed":
        return None
    said = first["configuration"]
    names = [codec.get("name") for codec in said.get("index_codecs", [{"name": "bytes"}, {"name": "crc32c"}])]
    if names not in (["bytes"], ["bytes", "crc32c"]):
        return None
    return ShardIndex(tuple(map(int, said["chunk_shape"])), 4 * (len(names) - 1), said.get("index_location") != "start")


def missing_in_shards(
    index: ShardIndex, shape: tuple[int, ...], shard: tuple[int, ...], files: Iterable[tuple[tuple[int, ...], Path]]
) -> tuple[int, int]:
    """Return how many chunks inside the array are missing from shards that are there, and how many there should be.

    Parameters
    ----------
    files
        Place of each shard in the grid of shards, and its file. Of very many, the first are looked at.
    """
    counts = [length // step for length, step in zip(shard, index.chunk, strict=True)]
    missing = expected = 0
    for _, (place, file) in zip(range(_MOST_SHARDS), files, strict=False):
        there = _written(file, math.prod(counts), index)
        ends = [
            min(count, -(-(length - at * step) // chunk))
            for count, length, at, step, chunk in zip(counts, shape, place, shard, index.chunk, strict=True)
        ]
        inside = there.reshape(counts)[tuple(map(slice, ends))]
        missing += int((~inside).sum())
        expected += inside.size
    return missing, expected


def places_in_shard(file: Path, n_chunks: int, index: ShardIndex) -> list[tuple[int, int]]:
    """Return offset and bytes of the chunks that are written in a shard."""
    found = _index_of(file, n_chunks, index)
    return [(int(offset), int(length)) for offset, length in found.tolist() if (offset, length) != (_NOWHERE, _NOWHERE)]


def _written(file: Path, n_chunks: int, index: ShardIndex) -> NDArray[np.bool_]:
    """Return whether each chunk of a shard is written."""
    return np.asarray((_index_of(file, n_chunks, index) != _NOWHERE).any(axis=1))


def _index_of(file: Path, n_chunks: int, index: ShardIndex) -> NDArray[np.uint64]:
    """Return (chunks, 2) offset and bytes of each chunk of a shard."""
    n_bytes = 16 * n_chunks
    if file.stat().st_size < n_bytes + index.n_checksum:
        raise ValueError(f"the shard {file.name} is shorter than its index")
    with open_binary(file) as opened:
        if index.at_end:
            opened.seek(-n_bytes - index.n_checksum, 2)
        return np.frombuffer(opened.read(n_bytes), "<u8").reshape(n_chunks, 2)
