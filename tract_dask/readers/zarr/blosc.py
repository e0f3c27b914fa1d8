"""Blosc chunks are checked before they are decoded: Blosc believes its header, and damage there ends the process."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..checks import open_binary
from .shards import ShardIndex, places_in_shard

_HEAD, _CHECKSUM = 16, 4


def check_blosc(files: Sequence[Path], chunk_bytes: int, index: ShardIndex | None, n_inner: int) -> None:
    """Check that each chunk in some files says of itself how long it is.

    Parameters
    ----------
    chunk_bytes
        Of a chunk that is decoded.
    index, n_inner
        Of shards, and chunks in one; None and 1 where each file is one chunk.

    Raises
    ------
    ValueError
        Where one does not.
    """
    for path in files:
        size = path.stat().st_size
        places = [(0, size)] if index is None else places_in_shard(path, n_inner, index)
        with open_binary(path) as file:
            for offset, length in places:
                file.seek(min(offset, size))
                head = file.read(_HEAD)
                said, stored = int.from_bytes(head[4:8], "little"), int.from_bytes(head[12:16], "little")
                whole = len(head) == _HEAD and offset + length <= size and length - stored in (0, _CHECKSUM)
                if not whole or said > 8 * chunk_bytes + 1024:
                    raise ValueError(f"a chunk in {path.name} is damaged: its head says other lengths than it has")
