"""The shard files of a movie: tiles, encoded and decoded straight between the file and memory that is used again.

A file holds what Zarr v3's ``sharding_indexed`` codec writes: the encoded tiles, each followed by its CRC-32C; then,
for every tile of the shard in C order, its offset and length (uint64, little-endian), both 2^64 - 1 where a tile is not
stored; then the CRC-32C of that index. Between tiles and index, where Zarr reads nothing, a *mark* says whose shard it
is and which: a file that was copied to another's place has true checksums, too. General codec pipelines allocate the
buffers of every tile and every shard anew, which costs as much as encoding.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import product
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import google_crc32c
import imagecodecs
import imagecodecs._blosc  # which imagecodecs would import in the first tasks, several threads at once
import numpy as np
from numpy.typing import NDArray

from . import disk

Pixels = NDArray[Any]

_blosc: Any = imagecodecs  # its annotations leave out arrays, which it takes
ABSENT = 2**64 - 1
"""Offset and length of a tile that is not stored."""

CHECKSUM_BYTES = 4
"""Bytes of a CRC-32C, behind the data that it is of."""

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


SEPARATOR = "."
"""What stands between the numbers in a chunk's name: a full stop, so that a chunk costs a file and no folders."""

CHUNK_KEYS: Any = {"name": "default", "separator": SEPARATOR}
"""The same, as Zarr takes it for a new array."""


def chunk_path(array: Path, *place: int, separator: str = SEPARATOR) -> Path:
    """Return the file of a chunk, or of a shard, by its numbers along the axes of the array at a path.

    Examples
    --------
    >>> chunk_path(Path("movie.zarr/0"), 3, 0, 0).as_posix()
    'movie.zarr/0/c.3.0.0'
    """
    return array / separator.join(["c", *map(str, place)])


def codecs(codec: str) -> list[dict[str, Any]]:
    """Return Zarr's names of what encodes a tile's bytes, in order: Blosc unless ``codec`` is ``none``; CRC-32C."""
    blosc = [{"name": "blosc", "configuration": BLOSC[codec]}] if codec in BLOSC else []
    return [*blosc, {"name": "crc32c"}]


def crc32c(data: Any, before: int = 0) -> int:
    """Return the CRC-32C of contiguous bytes, or of an array's; ``before`` is that of the bytes before them.

    Examples
    --------
    >>> hex(crc32c(b"123456789"))
    '0xe3069283'
    """
    return int(google_crc32c.extend(before, np.frombuffer(data, np.uint8)))


MARKED = "shards_marked"
"""Attribute of a store whose shard files have marks."""


def mark_of(key: str, array: str, number: int) -> bytes:
    """Return what stands before the index of a shard file: the CRC-32C of a store's key, an array's name, a number."""
    return checksum(f"{key} {array} {number}".encode())


def checksum(data: Any) -> bytes:
    """Return the CRC-32C of contiguous data as Zarr's ``crc32c`` codec writes it behind them."""
    return crc32c(data).to_bytes(CHECKSUM_BYTES, "little")


def unchecked(data: memoryview) -> memoryview:
    """Return data without the CRC-32C at their end, which is checked.

    Raises
    ------
    ValueError
        Where it is that of other data.
    """
    inner = data[:-CHECKSUM_BYTES]
    if len(data) < CHECKSUM_BYTES or checksum(inner) != data[-CHECKSUM_BYTES:]:
        raise ValueError("its checksum is that of other data")
    return inner


def trailing(data: Any) -> int:
    """Return the CRC-32C that is written behind contiguous data, as a number; it is not checked."""
    return int.from_bytes(bytes(data[-CHECKSUM_BYTES:]), "little")


ELSEWHERE = "this file belongs to another place, or to another store"
"""What is wrong with a sound file that is not the one of its place."""


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

    In an open batch (:func:`tract_dask.store.disk.together`) it is there once that is committed. Neither a killed task
    nor a second copy of it can leave a shard that is half written. Frames are laid into the tiles of the current
    layer, which are encoded once the layer is full, or the movie ends.

    Parameters
    ----------
    path
        The file's place.
    aside
        A folder on the same disk, for the file while it grows.
    mark
        As :func:`mark_of` returns it.
    """

    def __init__(
        self, path: Path, aside: Path, grid: Grid, dtype: np.dtype[Any], codec: str, *, mark: bytes = b""
    ) -> None:
        self._path, self._aside, self._codec, self._mark = path, disk.new_place(aside), codec, mark
        layers, rows, columns = grid.tiles
        depth, height, width = grid.chunk
        self._index = np.full((layers, rows, columns, 2), ABSENT, "<u8")
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
        with ExitStack() as stack:
            stack.callback(self._aside.unlink, missing_ok=True)
            with self._file:
                if error is not None:
                    return
                self._finish()
            disk.place(self._aside, self._path)
            stack.pop_all()

    def _finish(self) -> None:
        """Write the layer that the movie's end leaves unfinished, filled up with zeros, the mark and the index."""
        layer, place = divmod(self._frames, self._layer.shape[2])
        if place:
            self._layer[:, :, place:] = 0
            self._encode(layer)
        index = self._index.tobytes()
        self._write(self._mark + index, checksum(index))

    def _encode(self, layer: int) -> None:
        began = self._offset
        for row, column in np.ndindex(self._layer.shape[:2]):
            data = encode(self._layer[row, column], self._codec, self._encoded)
            offset = self._offset
            self._write(data, checksum(data))
            self._index[layer, row, column] = offset, self._offset - offset
        disk.write_back(self._file.fileno(), began, self._offset - began)

    def _write(self, data: Any, behind: bytes) -> None:
        """Write data and what stands behind them: one call of the system may take less."""
        parts = [memoryview(data).cast("B"), memoryview(behind)]
        self._offset += sum(map(len, parts))
        while parts:
            written = os.writev(self._file.fileno(), parts)
            while parts and written >= len(parts[0]):
                written -= len(parts.pop(0))
            if parts:
                parts[0] = parts[0][written:]


def read_index(handle: int, tiles: tuple[int, ...], mark: bytes = b"") -> NDArray[np.uint64]:
    """Return the index at the end of an open shard file: offset and length of each tile, (..., 2).

    Raises
    ------
    ValueError
        Where it is damaged, or ``mark`` does not stand before it.
    """
    tail_bytes = len(mark) + 16 * math.prod(tiles) + CHECKSUM_BYTES
    tail = os.pread(handle, tail_bytes, max(0, os.fstat(handle).st_size - tail_bytes))
    try:
        index: NDArray[np.uint64] = np.frombuffer(unchecked(memoryview(tail)[len(mark) :]), "<u8").reshape(*tiles, 2)
    except ValueError as error:
        raise ValueError("the index at the end is damaged") from error
    if tail[: len(mark)] != mark:
        raise ValueError(ELSEWHERE)
    return index


class ShardReader:
    """Reads tiles of one shard, and checks each.

    Parameters
    ----------
    encoded
        Whether tiles went through Blosc.
    checked
        Whether a CRC-32C follows each tile, as it does since format 2.
    mark
        What stands before the index, as :func:`mark_of` returns it.

    Raises
    ------
    OSError
        Where the file is missing or cannot be read.
    ValueError
        Where its index or a tile is damaged, a tile is not stored, or it is another shard.
    """

    def __init__(
        self, path: Path, grid: Grid, dtype: np.dtype[Any], *, encoded: bool, checked: bool = True, mark: bytes = b""
    ) -> None:
        self._path, self._grid, self._encoded, self._checked, self._mark = path, grid, encoded, checked, mark
        self._scratch = np.empty(grid.chunk, dtype)

    def __enter__(self) -> ShardReader:
        self._file = self._path.open("rb", buffering=0)
        try:
            self._index = read_index(self._file.fileno(), self._grid.tiles, self._mark)
        except (OSError, ValueError):
            self._file.close()
            raise
        lengths = self._index[..., 1]
        self._stored = memoryview(bytearray(int(lengths.max(where=lengths != ABSENT, initial=0))))
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def read_tile(self, layer: int, row: int, column: int, out: Pixels) -> None:
        """Decode a tile into ``out``, contiguous and as large as a tile."""
        offset, length = self._index[layer, row, column].tolist()
        if offset == ABSENT:
            raise ValueError(f"tile {layer, row, column} is missing")
        try:
            count = os.preadv(self._file.fileno(), [self._stored[:length]], offset)
            data = self._stored[:count]
            decode(unchecked(data) if self._checked else data, out, encoded=self._encoded)
        except ValueError as error:
            raise ValueError(f"tile {layer, row, column} is damaged: {error}") from error

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
