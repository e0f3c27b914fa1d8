"""The shard files of a movie: tiles, encoded and decoded straight between the file and memory that is used again.

A file holds what Zarr v3's ``sharding_indexed`` codec writes: the encoded tiles; then, for every tile of the shard in C
order, its offset and length (uint64, little-endian), both 2^64 - 1 where a tile is not stored; then the CRC-32C of that
index. General codec pipelines allocate the buffers of every tile and every shard anew, which costs as much as encoding.
"""

from __future__ import annotations

import math
import os
import uuid
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import google_crc32c
import imagecodecs
import imagecodecs._blosc  # which imagecodecs would import in the first tasks, several threads at once
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[Any]

_blosc: Any = imagecodecs  # its annotations leave out arrays, which it takes
_ABSENT = np.uint64(2**64 - 1)
_CHECKSUM_BYTES = 4
_BLOSC_HEADER_BYTES = 16

BLOSC: dict[str, dict[str, Any]] = {
    "lz4": {"cname": "lz4", "clevel": 5, "shuffle": "bitshuffle"},
    "zstd": {"cname": "zstd", "clevel": 1, "shuffle": "bitshuffle"},
}
"""What Blosc is told, by the name of the codec; ``none`` is not among them: its tiles are stored as they are."""


class Grid(NamedTuple):
    """Shape of an array, of its tiles and of its shards, each (t, y, x). A shard covers the whole field."""

    shape: tuple[int, int, int]
    chunk: tuple[int, int, int]
    shard: tuple[int, int, int]

    @property
    def tiles(self) -> tuple[int, int, int]:
        """Layers, rows and columns of tiles in a shard."""
        layers, rows, columns = (whole // part for whole, part in zip(self.shard, self.chunk, strict=True))
        return layers, rows, columns


def shard_path(array: Path, index: int) -> Path:
    """Return the file of a shard of the array at a path."""
    return array / "c" / str(index) / "0" / "0"


def encode(values: Pixels, codec: str, into: NDArray[np.uint8] | None = None) -> Any:
    """Return the bytes of a contiguous array, encoded; in the memory of ``into`` where it is given and used."""
    if codec not in BLOSC:
        return values
    told = BLOSC[codec]
    return _blosc.blosc_encode(
        values,
        level=told["clevel"],
        compressor=told["cname"],
        shuffle=told["shuffle"],
        typesize=values.itemsize,
        numthreads=1,
        out=into,
    )


def decode(data: memoryview, out: Pixels, *, encoded: bool) -> None:
    """Decode what :func:`encode` returned into ``out``, contiguous; ``encoded`` unless its codec was ``none``.

    Raises
    ------
    ValueError
        Where the data are damaged, or of another size.
    """
    target = out.reshape(-1).view(np.uint8)
    if not encoded:
        target[...] = np.frombuffer(data, np.uint8)
        return
    try:
        count = len(_blosc.blosc_decode(data, numthreads=1, out=target))
    except RuntimeError as error:
        raise ValueError(str(error)) from error
    if count != target.size:
        raise ValueError(f"{count} bytes instead of {target.size}")


class ShardWriter:
    """Writes one shard, frame by frame: aside first; in its place once the block of the ``with`` statement is over.

    Neither a killed task nor a second copy of it can leave a shard that is half written. Frames are laid into the tiles
    of the current layer, which are encoded once the layer is full, or the movie ends.

    Parameters
    ----------
    path
        The file's place.
    aside
        A folder on the same disk, for the file while it grows.
    """

    def __init__(self, path: Path, aside: Path, grid: Grid, dtype: np.dtype[Any], codec: str) -> None:
        self._path, self._aside, self._codec = path, aside / f"{uuid.uuid4().hex}.partial", codec
        layers, rows, columns = grid.tiles
        depth, height, width = grid.chunk
        self._index = np.full((layers, rows, columns, 2), _ABSENT, "<u8")
        self._layer = np.zeros((rows, columns, depth, height, width), dtype)
        self._encoded = np.empty(self._layer[0, 0].nbytes + _BLOSC_HEADER_BYTES, np.uint8)
        self._frames, self._offset = 0, 0

    def __enter__(self) -> ShardWriter:
        self._file = self._aside.open("wb", buffering=0)
        return self

    def add(self, frame: Pixels) -> None:
        """Write the next frame (y, x)."""
        layer, place = divmod(self._frames, self._layer.shape[2])
        height, width = self._layer.shape[3:]
        for row, column in np.ndindex(self._layer.shape[:2]):
            part = frame[row * height : (row + 1) * height, column * width : (column + 1) * width]
            self._layer[row, column, place, : part.shape[0], : part.shape[1]] = part
        self._frames += 1
        if place == self._layer.shape[2] - 1:
            self._encode(layer)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            with self._file:
                if error is None:
                    self._finish()
            if error is None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._aside.replace(self._path)
        finally:
            self._aside.unlink(missing_ok=True)

    def _finish(self) -> None:
        """Write the layer that the movie's end leaves unfinished, filled up with zeros, and the index."""
        layer, place = divmod(self._frames, self._layer.shape[2])
        if place:
            self._layer[:, :, place:] = 0
            self._encode(layer)
        index = self._index.tobytes()
        self._write(memoryview(index + _checksum(index)))

    def _encode(self, layer: int) -> None:
        for row, column in np.ndindex(self._layer.shape[:2]):
            data = memoryview(encode(self._layer[row, column], self._codec, self._encoded)).cast("B")
            self._index[layer, row, column] = self._offset, len(data)
            self._write(data)

    def _write(self, data: memoryview) -> None:
        """Write all of ``data``: one call of the system may take less."""
        self._offset += len(data)
        while len(data):
            data = data[self._file.write(data) :]


class ShardReader:
    """Reads tiles of one shard.

    Raises
    ------
    OSError
        Where the file is missing or cannot be read.
    ValueError
        Where its index or a tile is damaged.
    """

    def __init__(self, path: Path, grid: Grid, dtype: np.dtype[Any], *, encoded: bool) -> None:
        self._path, self._grid, self._encoded = path, grid, encoded
        self._scratch = np.empty(grid.chunk, dtype)

    def __enter__(self) -> ShardReader:
        self._file = self._path.open("rb", buffering=0)
        index_bytes = 16 * math.prod(self._grid.tiles) + _CHECKSUM_BYTES
        tail = os.pread(self._file.fileno(), index_bytes, max(0, os.fstat(self._file.fileno()).st_size - index_bytes))
        index, checksum = tail[:-_CHECKSUM_BYTES], tail[-_CHECKSUM_BYTES:]
        if len(tail) != index_bytes or checksum != _checksum(index):
            self._file.close()
            raise ValueError(f"the index at the end of {self._path} is damaged")
        self._index = np.frombuffer(index, "<u8").reshape(*self._grid.tiles, 2)
        lengths = self._index[..., 1]
        self._stored = memoryview(bytearray(int(lengths.max(where=lengths != _ABSENT, initial=0))))
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def read_tile(self, layer: int, row: int, column: int, out: Pixels) -> None:
        """Decode a tile into ``out``, contiguous and as large as a tile; zeros where it is not stored."""
        offset, length = self._index[layer, row, column].tolist()
        if offset == _ABSENT:
            out[...] = 0
            return
        try:
            count = os.preadv(self._file.fileno(), [self._stored[:length]], offset)
            decode(self._stored[:count], out, encoded=self._encoded)
        except ValueError as error:
            raise ValueError(f"tile {layer, row, column} of {self._path} is damaged: {error}") from error

    def read(self, part: tuple[slice, slice, slice], out: Pixels) -> None:
        """Decode a part of the shard, its frames, rows and columns, into ``out``."""
        for tile in product(*map(overlaps, part, self._grid.chunk)):
            (layer, t_in, t_out), (row, y_in, y_out), (column, x_in, x_out) = tile
            self.read_tile(layer, row, column, self._scratch)
            out[t_out, y_out, x_out] = self._scratch[t_in, y_in, x_in]


def overlaps(span: slice, side: int) -> Iterator[tuple[int, slice, slice]]:
    """Yield the tiles that ``span`` touches along one axis: number, the part inside the tile, its place in the span."""
    for number in range(span.start // side, -(-span.stop // side)):
        first, last = max(span.start, number * side), min(span.stop, (number + 1) * side)
        inside = slice(first - number * side, last - number * side)
        yield number, inside, slice(first - span.start, last - span.start)


def _checksum(data: bytes) -> bytes:
    return int(google_crc32c.value(data)).to_bytes(_CHECKSUM_BYTES, "little")
