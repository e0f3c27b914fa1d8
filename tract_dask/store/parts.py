"""The fits of single shards while a fit stage runs, and how they are joined into the files of results.zarr.

A worker adds the fits of a shard to one file of its own, in the folder of the journal's run: a *part*. It holds one
piece a variable, which is, byte for byte, the inner chunk that the variable's file will hold; then the shard's index
and the lengths of the pieces (uint64, little-endian), and the CRC-32C of these. A piece ends with a CRC-32C of its own.

Once all shards are done, the pieces of each variable are joined: those of some dozens of shards make one file, which is
a Zarr shard (``sharding_indexed``). No piece is decoded for that; each is checked.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import StoreError
from . import datasets, disk, schema
from .files import disk_errors
from .journal import GROWING, Journal, own_file
from .shard_files import CHECKSUM_BYTES, checksum, decode, encode, mark_of, unchecked
from .shards import Shard, split

CODEC = "lz4"

SHARDED = tuple(name for name in schema.RESULTS if name not in ("drift_measured", "time"))
"""The variables of which every shard of the movie makes one piece; the others are known from the start."""

WRITTEN = schema.RESULTS | schema.SCAN_ROWS

EVERY = (*SHARDED, *schema.SCAN_ROWS)
"""These, and those that some results have: in parts of the others their pieces are empty."""

_TAIL_BYTES = 8 * (1 + len(EVERY)) + CHECKSUM_BYTES

_ABSENT = 2**64 - 1

AGAIN = "Run the same command again: they are made again"


class DamagedPartError(StoreError):
    """The parts of some shards are damaged or gone: the shards are to be fitted again."""


def write(run: Path, shard: Shard, values: dict[str, NDArray[Any]], frames_per_shard: int) -> None:
    """Write the values of every variable for the frames of ``shard``, as a part in the folder of a run.

    Pieces have the frames of a whole shard; those of the last shard are filled up.
    """
    pieces = [piece(name, values[name], frames_per_shard) if name in values else b"" for name in EVERY]
    lengths = [*map(len, pieces)]
    tail = np.array([shard.index, *lengths], "<u8").tobytes()
    with disk_errors(run):
        disk.append(own_file(run, GROWING), b"".join([*pieces, tail, checksum(tail)]))


def piece(name: str, array: NDArray[Any], frames: int) -> bytes:
    """Return the values of a variable for the frames of one shard as a piece, with the frames of a whole shard."""
    variable = WRITTEN[name]
    chunk = np.full((frames, *array.shape[1:]), variable.fill, variable.dtype)
    chunk[: len(array)] = array
    data = bytes(encode(chunk, CODEC))
    return data + checksum(data)


@dataclass(frozen=True)
class Parts:
    """Where the part of each finished shard is.

    Attributes
    ----------
    run
        Folder of the journal's run.
    files
        Names of files in it.
    place
        (shards, 2) number of the file of each part, and where it ends; -1 of a shard that is not done.
    """

    run: Path
    files: tuple[str, ...]
    place: NDArray[np.int64]

    @classmethod
    def of(cls, journal: Journal, n_frames: int, frames_per_shard: int) -> Parts:
        """Return the parts that a journal names, and that are there."""
        shards = split(n_frames, frames_per_shard)
        files: dict[str, int] = {}
        place = np.full((len(shards), 2), -1)
        for index, _, marks in journal.sound(shards):
            if len(marks) == 1:
                (name, end, _) = marks[0]
                place[index] = files.setdefault(name, len(files)), end
        return cls(journal.path, tuple(files), place)

    @property
    def done(self) -> NDArray[np.bool_]:
        """Which shards are done, (shards,)."""
        finished: NDArray[np.bool_] = self.place[:, 0] >= 0
        return finished

    def stored(self, index: int, name: str) -> bytes:
        """Return the piece of a variable, encoded as it is stored, and checked.

        Raises
        ------
        ValueError
            Where the part is damaged, or that of another shard.
        OSError
            Where it cannot be read.
        """
        end = int(self.place[index, 1])
        with self.file(index).open("rb", buffering=0) as file:
            lengths = self._lengths(file.fileno(), index, end)
            k = EVERY.index(name)
            start = end - _TAIL_BYTES - sum(lengths[k:])
            piece = os.pread(file.fileno(), lengths[k], max(0, start))
        unchecked(memoryview(piece))
        return piece

    @staticmethod
    def _lengths(handle: int, index: int, end: int) -> list[int]:
        tail = os.pread(handle, _TAIL_BYTES, max(0, end - _TAIL_BYTES))
        numbers: list[int] = np.frombuffer(unchecked(memoryview(tail)), "<u8").tolist()
        own, *lengths = numbers
        if own != index or sum(lengths) > end:
            raise ValueError("this is the part of another shard")
        return lengths

    def names(self, index: int) -> list[str]:
        """Return the variables of which a part has pieces; errors as of :meth:`stored`."""
        with self.file(index).open("rb", buffering=0) as file:
            lengths = self._lengths(file.fileno(), index, int(self.place[index, 1]))
        return [name for name, length in zip(EVERY, lengths, strict=True) if length]

    def read(self, index: int, name: str, out: NDArray[Any]) -> None:
        """Decode the piece of a variable into ``out``, (frames of a whole shard, ...).

        Raises
        ------
        StoreError
            Where it cannot be read.
        """
        try:
            decode(memoryview(self.stored(index, name))[:-CHECKSUM_BYTES], out, encoded=True)
        except (OSError, ValueError) as error:
            raise StoreError(
                f"the fits of shard {index} cannot be read",
                str(self.file(index)),
                got=str(error),
                remedy=AGAIN,
            ) from error

    def file(self, index: int) -> Path:
        """Return the file that the part of a shard is in."""
        return self.run / self.files[int(self.place[index, 0])]

    def strike_damaged(self) -> None:
        """Spoil the ends of parts that are damaged: nobody takes their shards for done any more."""
        for index in np.flatnonzero(self.done).tolist():
            try:
                for name in self.names(index):
                    self.stored(index, name)
            except ValueError:
                with self.file(index).open("r+b", buffering=0) as file:
                    os.pwrite(file.fileno(), bytes(CHECKSUM_BYTES), int(self.place[index, 1]) - CHECKSUM_BYTES)


@dataclass(frozen=True)
class Growing:
    """A variable of a store whose fits are not all done, as an array: at its fill value where they are not."""

    array: Any
    name: str
    parts: Parts

    @property
    def shape(self) -> tuple[int, ...]:
        """Frames, and what else the variable has."""
        return tuple(self.array.shape)

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values."""
        dtype: np.dtype[Any] = self.array.dtype
        return dtype

    @property
    def chunks(self) -> tuple[int, ...]:
        """Shape of the piece of a shard."""
        return tuple(self.array.chunks)

    def __getitem__(self, part: Any) -> NDArray[Any]:
        try:
            return self._read(part)
        except StoreError:
            if self.parts.run.exists():
                raise
            return np.asarray(self.array[part])  # all fits are done meanwhile, and in the store's own files

    def _read(self, part: Any) -> NDArray[Any]:
        frames, *rest = part if isinstance(part, tuple) else (part,)
        wanted = np.arange(self.shape[0])[frames]
        values = np.full((wanted.size, *self.shape[1:]), self.array.fill_value, self.dtype)
        piece = np.empty(self.chunks, self.dtype)
        shard, inside = np.divmod(wanted.reshape(-1), self.chunks[0])
        for index in np.unique(shard).tolist():
            if self.parts.done[index]:
                self.parts.read(index, self.name, piece)
                values[shard == index] = piece[inside[shard == index]]
        picked: NDArray[Any] = values.reshape(*wanted.shape, *self.shape[1:])
        return picked[(*[slice(None)] * wanted.ndim, *rest)]


def layout(path: Path) -> tuple[int, int, int]:
    """Return the frames of the store at ``path``, those of a shard of the movie, and the shards that share a file."""
    fit: Any = datasets.open_array(path / "fit")
    return fit.shape[0], fit.chunks[0], (fit.shards or fit.chunks)[0] // fit.chunks[0]


def sharded(path: Path) -> list[str]:
    """Return the variables of the store at ``path`` of which every shard of the movie makes one piece."""
    return [name for name in EVERY if name in SHARDED or (path / name).is_dir()]


def file_place(name: str) -> list[int]:
    """Return the numbers that follow a file's own in the name of a file of a variable: zeros, for its other axes."""
    return [0] * (len(WRITTEN[name].dims) - 1)


def joined(
    parts: Parts,
    key: str,
    name: str,
    shards: range,
    per_file: int,
    changed: Mapping[int, bytes] = MappingProxyType({}),
) -> Iterator[bytes]:
    """Yield the bytes of the file that holds a variable of some shards; those that are not done are not in it.

    Parameters
    ----------
    key
        That of the store.
    changed
        Pieces by the number of their shard, where they are not those of the parts.

    Raises
    ------
    DamagedPartError
        Where parts are damaged.
    """
    index = np.full((per_file, 2), _ABSENT, "<u8")
    offset = 0
    for k, shard in enumerate(shards):
        if parts.done[shard]:
            data = changed.get(shard) or checked(parts, shard, name)
            index[k] = offset, len(data)
            offset += len(data)
            yield data
    yield mark_of(key, name, shards.start // per_file) + index.tobytes() + checksum(index)


def checked(parts: Parts, shard: int, name: str) -> bytes:
    """Return the piece of a variable, checked.

    Raises
    ------
    DamagedPartError
        Where it is damaged or gone.
    """
    try:
        return parts.stored(shard, name)
    except (ValueError, FileNotFoundError) as error:
        raise DamagedPartError(
            f"the fits of shard {shard} were damaged on disk", str(parts.file(shard)), got=str(error), remedy=AGAIN
        ) from error
