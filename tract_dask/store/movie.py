"""A movie store, opened: its frames, read where they are asked for, its binned levels and its statistics."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..errors import MissingStoreError, StoreError
from ..kernels.windows import Tiles
from . import datasets, metadata, schema
from .damage import reading
from .journal import entries, journal_beside
from .ome import AXES, CHANGING, frame_array
from .pixels import Pixels, nodes_of, pixels_of, real_of
from .shard_files import MARKED, Grid, ShardReader, chunk_path, mark_of, overlaps
from .shards import Shard, Shards, split

Frames: TypeAlias = NDArray[Any]
_EVERYTHING = slice(None)


def open_movie(path: str | Path) -> Movie:
    """Open a movie store that :func:`convert` has finished.

    Raises
    ------
    MissingStoreError
        Where there is none, or it is unfinished; with the number of shards that are missing.
    StoreError
        Where its metadata are damaged, or a change of them was cut off.
    """
    path = Path(path).absolute()
    present = metadata.attributes(path)
    if present.get("kind") != "movie":
        raise MissingStoreError(
            "there is no movie store here",
            str(path),
            "a store made by tract_dask's convert",
            "something else" if path.exists() else "nothing",
            "Convert the movie first",
        )
    check_known(path, present)
    if present.get(CHANGING):
        raise StoreError(
            "its pixel size or frame time is being changed, or that was cut off",
            str(path),
            remedy="Run the same command again",
        )
    shape = tuple(present["shape"])
    if not present["complete"]:
        n_shards = len(split(shape[0], present["frames_per_shard"]))
        n_done = len({index for index, _ in entries(journal_beside(path))})
        raise MissingStoreError(
            f"the movie is unfinished: {n_shards - n_done} of {n_shards} shards are missing",
            str(path),
            remedy=f"Run convert on {present['source']} again: it goes on from there",
        )
    dtype = np.dtype(present["dtype"])
    return Movie(
        path=path,
        shape=shape,
        dtype=real_of(dtype) if nodes_of(present) else dtype,
        key=present["key"],
        frames_per_shard=present["frames_per_shard"],
        bins=tuple(present["bins"]),
        **{name: present[name] for name in schema.CALIBRATION if name in present},
    )


_NEEDED = ("shape", "complete", "frames_per_shard", "dtype", "key", "bins", *schema.CALIBRATION[:4])


def check_known(path: Path, present: Mapping[str, Any]) -> None:
    """Check that a movie store says all of itself that this version needs.

    Raises
    ------
    MissingStoreError
        Naming what it does not say.
    """
    if lacking := [name for name in _NEEDED if name not in present]:
        raise MissingStoreError(
            "this movie store is of another version",
            str(path),
            "all that this version knows of a movie",
            f"no {', '.join(lacking)}",
            "Convert the movie again, with --overwrite",
        )


@dataclass(frozen=True, kw_only=True)
class Movie:
    """A movie store, open for reading; small, and pickled by its path.

    Attributes
    ----------
    path
        The store.
    shape
        Frames, rows and columns.
    dtype
        Pixel type of what is read: that of the file, or real numbers where pixels carry no data, which are NaN, or are
        saturated, and infinite.
    key
        Key of what it was made from.
    frames_per_shard
        Frames in each shard but the last.
    bins
        Factors of the binned levels, ascending.
    pixel_size_pm, frame_time_s, dose, gain, offset
        As :class:`tract_dask.readers.SourceMetadata` has them.
    """

    path: Path
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    key: str
    frames_per_shard: int
    bins: tuple[int, ...]
    pixel_size_pm: float | None
    frame_time_s: float | None
    dose: float | None
    gain: float
    offset: float = 0.0

    def __reduce__(self) -> tuple[Callable[..., Movie], tuple[Any, ...]]:
        return open_movie, (self.path,)

    def counts(self, pixels: Frames) -> Frames:
        """Return pixels as they are read, (..., y, x), in electron counts, float32."""
        whole = pixels - np.float32(self.offset) if self.offset else pixels
        return np.asarray(whole * np.float32(self.gain), np.float32)

    @property
    def summed(self) -> int:
        """Frames of the camera in a frame of this movie."""
        return 1

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self.shape[0]

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame, uncompressed."""
        return self.shape[1] * self.shape[2] * self.dtype.itemsize

    @property
    def shards(self) -> Shards:
        """The shards, in order: every frame in exactly one."""
        return split(self.n_frames, self.frames_per_shard)

    @property
    def layer_frames(self) -> int:
        """Frames in a layer of tiles: those that are decoded together."""
        return _open_level(self.path, self.key, "0").grid.chunk[0]

    def read(self, start: int, stop: int, y: slice = _EVERYTHING, x: slice = _EVERYTHING) -> Frames:
        """Return frames ``start`` to ``stop`` (not included), or a part of their field; (frames, y, x).

        Only the tiles that the part touches are read.
        """
        part = self._part("0", start, stop, y, x)
        if not (pixels := self.pixels):
            return part
        first, top, left = (span.indices(n)[0] for span, n in zip((slice(start, stop), y, x), self.shape, strict=True))
        return pixels.applied(part, first, top, left)

    @property
    def pixels(self) -> Pixels:
        """Which pixels carry no data: they are read as NaN, or as infinity where they are saturated."""
        return pixels_of(self.path, self.key)

    @property
    def full_scale(self) -> float | None:
        """Detector units at which pixels are cut off; None where they are not, or it is not known.

        With references it is that of the median pixel, corrected.
        """
        return self.pixels.level_cut_off

    def read_tiles(self, start: int, stop: int, boxes: NDArray[np.int64]) -> Tiles:
        """Return the tiles of frames ``start`` to ``stop`` (not included) that boxes touch, as they are decoded.

        They are valid until the next call in the same thread, which decodes into the same memory.

        Parameters
        ----------
        start, stop
            Inside one shard; ``start`` the first frame of a layer of its tiles, as that of a shard is.
        boxes
            (n, 4) first row, first column, last row and last column (not included) of each; clipped to the field.
        """
        level = _open_level(self.path, self.key, "0")
        depth, height, width = level.grid.chunk
        place = _touched(boxes, self.shape[1:], (height, width))
        wanted = np.argwhere(place >= 0).tolist()
        number, first = divmod(start, self.frames_per_shard)
        layers = range(first // depth, -(-(stop - number * self.frames_per_shard) // depth))
        pixels = _reused((len(wanted), len(layers) * depth, height, width), level.dtype)
        with self._shard("0", number) as reader:
            for k, layer in enumerate(layers):
                for tile, (row, column) in zip(pixels, wanted, strict=True):
                    reader.read_tile(layer, row, column, tile[k * depth : (k + 1) * depth])
        if left_out := self.pixels:
            shown = np.empty(pixels.shape, self.dtype)
            for target, tile, (row, column) in zip(shown, pixels, wanted, strict=True):
                target[...] = left_out.applied(tile, start, row * height, column * width)
            pixels = shown
        return Tiles(pixels, place, self.shape[1:])

    def tiles(self, shard: Shard) -> Iterator[tuple[int, int, int, Frames]]:
        """Yield the tiles of a shard of the movie: first frame, row and column, and pixels (frames, y, x).

        The pixels are valid until the next tile: all are decoded into the same memory.
        """
        level = _open_level(self.path, self.key, "0")
        depth, height, width = level.grid.chunk
        _, rows, columns = level.grid.tiles
        tile, left_out = np.empty(level.grid.chunk, level.dtype), self.pixels
        with self._shard("0", shard.index) as reader:
            for layer, row, column in np.ndindex(-(-shard.frames // depth), rows, columns):
                reader.read_tile(layer, row, column, tile)
                start, top, left = layer * depth, row * height, column * width
                pixels = tile[: shard.frames - start, : self.shape[1] - top, : self.shape[2] - left]
                first = shard.start + start
                yield first, top, left, left_out.applied(pixels, first, top, left) if left_out else pixels

    def read_binned(self, factor: int, start: int, stop: int) -> NDArray[np.float32]:
        """Return frames ``start`` to ``stop`` (not included) of a binned level: means (frames, y, x).

        Raises
        ------
        StoreError
            Where the movie has no such level.
        """
        if factor not in self.bins:
            levels = ", ".join(map(str, self.bins)) or "none: its frames are too small"
            raise StoreError(
                "the movie has no such binned level", str(self.path), levels, str(factor), "Use one of these"
            )
        return self._part(f"binned/{factor}", start, stop, _EVERYTHING, _EVERYTHING)

    def statistics(self) -> xr.Dataset:
        """Return the per-frame statistics (``schema.STATISTICS``) on ``t``, in memory."""
        return datasets.open_dataset(self.path, only=tuple(schema.STATISTICS))

    @property
    def part(self) -> dict[str, int] | None:
        """Which part of its source the movie is, as :class:`tract_dask.readers.source.Part` says; None: all of it."""
        part: dict[str, int] | None = metadata.attributes(self.path).get("part")
        return part

    @property
    def to_measure(self) -> tuple[str, ...]:
        """What of ``gain`` and ``offset`` is to be measured: until the frames are summed they are 1 and 0."""
        return tuple(metadata.attributes(self.path).get("to_measure", ()))

    def times(self) -> NDArray[np.float64]:
        """Return the start of each frame (frames,) in s; the frame's number where the frame time is not known."""
        return np.asarray(datasets.open_dataset(self.path, only=("t",))["t"].to_numpy(), np.float64)

    def frame_values(self) -> dict[str, xr.Variable]:
        """Return what the headers of the frames say beside their times, by name: variables on ``frame`` with units."""
        names = [name for name in metadata.attributes(self.path).get("frame_values", ()) if name != "time"]
        if not names:
            return {}
        stored = datasets.open_dataset(self.path, only=tuple(map(frame_array, names)))
        found = {name: stored[frame_array(name)].variable for name in names}
        return {name: xr.Variable("frame", of.to_numpy(), of.attrs) for name, of in found.items()}

    @property
    def frames(self) -> xr.DataArray:
        """The frames as a lazy array (t, y, x) with coordinates, one Dask chunk a shard."""
        import dask.array as da  # takes its time, and workers do not need it

        pixels = da.from_array(
            _LazyFrames(self),
            chunks=(self.frames_per_shard, *self.shape[1:]),
            name=f"movie-{self.key}",
            meta=np.empty((0, 0, 0), self.dtype),
            inline_array=True,
            fancy=False,
        )
        store = datasets.open_dataset(self.path, only=AXES)
        known = {name: getattr(self, name) for name in schema.CALIBRATION}
        attributes = {name: value for name, value in known.items() if value is not None}
        return xr.DataArray(pixels, {axis: store[axis] for axis in AXES}, AXES, "movie", attributes)

    def _part(self, name: str, start: int, stop: int, y: slice, x: slice) -> Frames:
        level = _open_level(self.path, self.key, name)
        y, x = (slice(*span.indices(length)[:2]) for span, length in zip((y, x), level.grid.shape[1:], strict=True))
        start, stop, _ = slice(start, stop).indices(self.n_frames)
        part = np.empty((stop - start, max(0, y.stop - y.start), max(0, x.stop - x.start)), level.dtype)
        for number, inside, place in overlaps(slice(start, stop), self.frames_per_shard):
            with self._shard(name, number) as reader:
                reader.read((inside, y, x), part[place])
        return part

    @contextmanager
    def _shard(self, name: str, number: int) -> Iterator[ShardReader]:
        """Open a shard of the frames or of a binned level; what is wrong with it becomes a StoreError."""
        level = _open_level(self.path, self.key, name)
        path = chunk_path(self.path / name, number, 0, 0, separator=level.separator)
        with (
            reading(path),
            ShardReader(
                path,
                level.grid,
                level.dtype,
                encoded=level.encoded,
                checked=level.checked,
                mark=mark_of(self.key, name, number) if level.marked else b"",
            ) as reader,
        ):
            yield reader


@dataclass(frozen=True)
class _LazyFrames:
    """What Dask slices: the frames of a movie, read when asked for."""

    movie: Movie
    ndim = 3

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.movie.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        return self.movie.dtype

    def __getitem__(self, part: Any) -> Frames:
        (t, inside_t), (y, inside_y), (x, inside_x) = map(_run, part, self.movie.shape)
        return self.movie.read(t.start, t.stop, y, x)[inside_t, inside_y, inside_x]


def _run(index: int | slice, length: int) -> tuple[slice, int | slice]:
    """Return the shortest run along an axis that holds what an index picks, and the index inside the run.

    Examples
    --------
    >>> _run(slice(-2, 1, -3), 10)
    (slice(2, 9, None), slice(None, None, -3))
    """
    if not isinstance(index, slice):
        place = range(length)[index]
        return slice(place, place + 1), 0
    picked = range(length)[index]
    first, last = (min(picked[0], picked[-1]), max(picked[0], picked[-1])) if picked else (0, -1)
    return slice(first, last + 1), slice(None, None, picked.step)


@dataclass(frozen=True)
class _Level:
    """How the frames, or a binned level, lie on disk; ``encoded`` unless their codec is ``none``."""

    grid: Grid
    dtype: np.dtype[Any]
    encoded: bool
    checked: bool
    marked: bool
    separator: str


@lru_cache(maxsize=32)
def _open_level(path: Path, key: str, name: str) -> _Level:
    """Read how a level lies on disk, once in a process; the key tells a store from another later at the same place."""
    array: Any = datasets.open_array(path / name)
    named = [codec.to_dict()["name"] for codec in array.compressors]
    grid = Grid(array.shape, array.chunks, array.shards)
    separator = array.metadata.chunk_key_encoding.separator
    marked = bool(metadata.attributes(path).get(MARKED))
    return _Level(grid, array.dtype, "blosc" in named, "crc32c" in named, marked, separator)


def _touched(boxes: NDArray[np.int64], shape: tuple[int, ...], tile: tuple[int, int]) -> NDArray[np.int64]:
    """Return a number for every tile (rows, columns) that a box touches, counted in their order; -1 for the others."""
    rows, columns = (-(-length // side) for length, side in zip(shape, tile, strict=True))
    top, left = (np.clip(boxes[:, :2], 0, shape) // tile).T
    bottom, right = (-(-np.clip(boxes[:, 2:], 0, shape) // tile)).T
    corners = np.zeros((rows + 1, columns + 1), np.int64)  # summed along both axes, boxes that touch a tile
    for row, column, step in ((top, left, 1), (top, right, -1), (bottom, left, -1), (bottom, right, 1)):
        np.add.at(corners, (row, column), step)
    touched = corners.cumsum(axis=0).cumsum(axis=1)[:rows, :columns] > 0
    return np.where(touched, np.cumsum(touched).reshape(touched.shape) - 1, -1)


_memory = threading.local()


def _reused(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Frames:
    """Return an array, not initialised, in memory that the next call in the same thread uses again.

    Fresh memory is cleared by the system page by page, which costs a quarter of what decoding into it does.
    """
    size = math.prod(shape) * dtype.itemsize
    if getattr(_memory, "room", np.empty(0)).size < size:
        _memory.room = None  # freed before the larger one is taken
        _memory.room = np.empty(size, np.uint8)
    room: Frames = _memory.room[:size].view(dtype).reshape(shape)
    return room
