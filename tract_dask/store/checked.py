"""How Zarr reads the arrays of a complete store: a chunk that is missing is an error, and so is one of another place.

Zarr fills a chunk that is missing with the fill value, and does not know whose chunk a file is: that say the marks of
shard files (:mod:`tract_dask.store.shard_files`), and the root's list of the other chunks
(:mod:`tract_dask.store.metadata`). Arrays that are read through :class:`CheckedPipeline` raise, and name the file.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from zarr.abc.store import ByteGetter, ByteRequest
from zarr.codecs import ShardingCodec
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.core.codec_pipeline import BatchedCodecPipeline
from zarr.registry import register_pipeline
from zarr.storage import LocalStore, StorePath

from .damage import METADATA, reading, store_of
from .metadata import CHUNKS, attributes
from .shard_files import ELSEWHERE, MARKED, mark_of, read_index, trailing, unchecked


class _MissingError(ValueError):
    """A chunk is not there."""


@dataclass(frozen=True)
class _Whole:
    """Gives the bytes of a chunk, which has to be there; those that end with its checksum, where that is known."""

    inner: Any
    checksum: int | None = None

    async def get(self, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        found: Buffer | None = await self.inner.get(prototype, byte_range)
        if found is None:
            raise _MissingError("no such file")
        if not len(found):  # for Zarr an empty shard is one without tiles
            raise ValueError("the file is empty, or ends too early")
        data: Any = found.as_numpy_array()
        if self.checksum not in (None, trailing(data)):
            unchecked(memoryview(data))
            raise ValueError(ELSEWHERE)
        return found


def _file(place: object) -> Path | None:
    """Return the file that bytes come from; None where they come from inside a shard."""
    if not isinstance(place, StorePath) or not isinstance(place.store, LocalStore):
        return None
    return place.store.root / place.path


class CheckedPipeline(BatchedCodecPipeline):
    """Zarr's own pipeline, but for errors: they name the file, and a chunk that is missing is one.

    The tiles inside a shard are read by Zarr's own: its index, which has a checksum, says where they are. The mark
    before the index says whether the file is in its place; a chunk without an index says so by its checksum.
    """

    async def read(
        self, batch_info: Iterable[tuple[ByteGetter, Any, Any, Any, bool]], out: Any, drop_axes: tuple[int, ...] = ()
    ) -> None:
        """Read chunks into ``out``."""
        items: list[Any] = []
        for getter, spec, *rest in batch_info:
            checksum, file = None, _file(getter)
            if file is not None and isinstance(self.array_bytes_codec, ShardingCodec):
                tiles = zip(spec.shape, self.array_bytes_codec.chunk_shape, strict=True)
                _check_place(file, tuple(side // part for side, part in tiles))
            elif file is not None:
                store, about = _around(file)
                checksum = about.get(CHUNKS, {}).get(file.relative_to(store).as_posix())
            items.append((_Whole(getter, checksum), spec, *rest))
        files = [_file(item[0].inner) for item in items]
        try:
            await super().read(items, out, drop_axes)
        except (OSError, ValueError, RuntimeError):
            if None in files:
                raise
            for file, item in zip(files, items, strict=True):  # which one was it?
                await self._read_one(file, item, out, drop_axes)

    async def _read_one(self, file: Any, item: Any, out: Any, drop_axes: tuple[int, ...]) -> None:
        with reading(file):
            try:
                await super().read([item], out, drop_axes)
            except _MissingError as error:
                raise FileNotFoundError from error


def _check_place(file: Path, tiles: tuple[int, ...]) -> None:
    """Check that a shard file is the one of its place in its store.

    Raises
    ------
    StoreError
        Where it is another, is damaged, or cannot be read.
    """
    store, about = _around(file)
    key = about.get("key") if about.get(MARKED) else None
    if key:
        array, number = file.parent.relative_to(store).as_posix(), int(file.name.split(".")[1])
        with reading(file), file.open("rb", buffering=0) as opened:
            read_index(opened.fileno(), tiles, mark_of(key, array, number))


def _around(file: Path) -> tuple[Path, dict[str, Any]]:
    """Return the store that a chunk's file is part of, and what the store says of itself."""
    root = store_of(file) / METADATA
    with reading(root):
        state = root.stat()
    return root.parent, _said(root.parent, (state.st_ino, state.st_mtime_ns, state.st_size))


@lru_cache(64)
def _said(store: Path, state: tuple[int, ...]) -> dict[str, Any]:
    """Return what a store says of itself, known while its root's state is."""
    return attributes(store)


register_pipeline(CheckedPipeline)

CHECKED = {"codec_pipeline.path": f"{CheckedPipeline.__module__}.{CheckedPipeline.__qualname__}"}
"""Zarr's configuration in which arrays are opened that are to be whole."""
