"""A movie store, opened: its frames, read where they are asked for, its binned levels and its statistics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import dask.array as da
import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray

from . import schema, stores
from .errors import StoreError
from .ome import AXES
from .shards import Shard, journal_beside, split

Frames: TypeAlias = NDArray[Any]
_EVERYTHING = slice(None)


def open_movie(path: str | Path) -> Movie:
    """Open a movie store that :func:`convert` has finished.

    Raises
    ------
    StoreError
        Where there is none, or it is unfinished; with the number of shards that are missing.
    """
    path = Path(path).absolute()
    present = stores.attributes(path)
    if present.get("kind") != "movie":
        raise StoreError(
            "there is no movie store here",
            str(path),
            "a store made by tract_dask's convert",
            "something else" if path.exists() else "nothing",
            "Convert the movie first",
        )
    shape = tuple(present["shape"])
    if not present["complete"]:
        n_shards = len(split(shape[0], present["frames_per_shard"]))
        n_done = len(list(journal_beside(path).glob("[0-9]*.json")))
        raise StoreError(
            f"the movie is unfinished: {n_shards - n_done} of {n_shards} shards are missing",
            str(path),
            remedy=f"Run convert on {present['source']} again: it goes on from there",
        )
    return Movie(
        path=path,
        shape=shape,
        dtype=np.dtype(present["dtype"]),
        key=present["key"],
        frames_per_shard=present["frames_per_shard"],
        bins=tuple(present["bins"]),
        **{name: present[name] for name in schema.CALIBRATION},
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
        Pixel type.
    key
        Key of what it was made from.
    frames_per_shard
        Frames in each shard but the last.
    bins
        Factors of the binned levels, ascending.
    pixel_size_pm, frame_time_s, dose, gain
        As :class:`tract_dask.io.SourceMetadata` has them.
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

    def __reduce__(self) -> tuple[Callable[[Path], Movie], tuple[Path]]:
        return open_movie, (self.path,)

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self.shape[0]

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame, uncompressed."""
        return self.shape[1] * self.shape[2] * self.dtype.itemsize

    @property
    def shards(self) -> tuple[Shard, ...]:
        """The shards, in order: every frame in exactly one."""
        return split(self.n_frames, self.frames_per_shard)

    def read(self, start: int, stop: int, y: slice = _EVERYTHING, x: slice = _EVERYTHING) -> Frames:
        """Return frames ``start`` to ``stop`` (not included), or a part of their field; (frames, y, x).

        Only the tiles that the part touches are read.
        """
        return self._part("0", slice(start, stop), y, x)

    def read_boxes(self, start: int, stop: int, boxes: NDArray[np.int64]) -> Frames:
        """Return frames ``start`` to ``stop`` (not included), whole fields, read only where boxes are; (frames, y, x).

        Parameters
        ----------
        boxes
            (n, 4) first row, first column, last row and last column (not included) of each; clipped to the field.

        Notes
        -----
        Tiles that no box touches are never written to, so they take up no memory; their values mean nothing.
        """
        tile = _open_level(self.path, self.key, "0").chunks[1:]
        touched = np.zeros([-(-length // side) for length, side in zip(self.shape[1:], tile, strict=True)], dtype=bool)
        first = np.maximum(boxes[:, :2], 0) // tile
        last = -(-np.clip(boxes[:, 2:], 0, self.shape[1:]) // tile)
        for (y0, x0), (y1, x1) in np.unique(np.stack([first, last], axis=1), axis=0):
            touched[y0:y1, x0:x1] = True
        frames = np.empty((stop - start, *self.shape[1:]), self.dtype)
        for row, tiles in enumerate(touched):
            edges = np.flatnonzero(np.diff(tiles, prepend=False, append=False))
            for left, right in edges.reshape(-1, 2) * tile[1]:
                part = slice(row * tile[0], (row + 1) * tile[0]), slice(left, right)
                frames[:, *part] = self.read(start, stop, *part)
        return frames

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
        return self._part(f"binned/{factor}", slice(start, stop), _EVERYTHING, _EVERYTHING)

    def statistics(self) -> xr.Dataset:
        """Return the per-frame statistics (``schema.STATISTICS``) on ``t``, in memory."""
        store = xr.open_zarr(self.path, consolidated=False, chunks=None)
        statistics: xr.Dataset = store[list(schema.STATISTICS)].load()
        return statistics

    @property
    def frames(self) -> xr.DataArray:
        """The frames as a lazy array (t, y, x) with coordinates, one Dask chunk a shard."""
        pixels = da.from_array(
            _LazyFrames(self),
            chunks=(self.frames_per_shard, *self.shape[1:]),
            name=f"movie-{self.key}",
            meta=np.empty((0, 0, 0), self.dtype),
            inline_array=True,
        )
        store = xr.open_zarr(self.path, consolidated=False, chunks=None)
        known = {name: getattr(self, name) for name in schema.CALIBRATION}
        attributes = {name: value for name, value in known.items() if value is not None}
        return xr.DataArray(pixels, {axis: store[axis] for axis in AXES}, AXES, "movie", attributes)

    def _part(self, name: str, *part: slice) -> Frames:
        try:
            return np.asarray(_open_level(self.path, self.key, name)[part])
        except RuntimeError as error:  # what the zarrs pipeline raises, whatever is wrong
            raise StoreError(
                f"frames {part[0].start} to {part[0].stop - 1} cannot be read",
                str(self.path / name),
                got=str(error),
                remedy="The shard is damaged: remove the store and convert the movie again",
            ) from error


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
        return np.asarray(_open_level(self.movie.path, self.movie.key, "0")[part])


@lru_cache(maxsize=32)
def _open_level(path: Path, key: str, name: str) -> zarr.Array[Any]:
    """Open an array of a movie once in a process; the key tells a store from another later at the same place."""
    return stores.open_array(path / name)
