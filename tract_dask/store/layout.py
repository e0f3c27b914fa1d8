"""How a movie lies on disk: frames in shards, shards in tiles, binned levels; decided by pure functions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..kernels.binning import FACTOR
from ..settings.run import ConvertSettings
from .shard_files import Grid

LEVEL_DTYPE = np.dtype(np.float32)
"""Pixel type of the binned levels."""

_DEFAULT_LAYOUT = ConvertSettings()
_FEWEST_SHARDS = 8
_CHUNK_FRAMES = 16
_SMALLEST_LEVEL_PX = 64
_COMPRESSION = 2
"""Ratio that is counted on when the free space is checked; low-dose counts reach about 3."""


@dataclass(frozen=True)
class Layout:
    """How a movie lies on disk.

    Attributes
    ----------
    shape
        Frames, rows and columns.
    dtype
        Pixel type.
    frames_per_shard
        Frames that are written, and worked on, together.
    chunk
        Frames, rows and columns of an inner chunk; a shard is a whole number of them and covers the whole field.
    bins
        Factors of the binned levels, ascending.
    """

    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    frames_per_shard: int
    chunk: tuple[int, int, int]
    bins: tuple[int, ...]

    def grid(self, factor: int = 1) -> Grid:
        """Return the grid of the frames (``factor`` 1) or of a binned level."""
        n_frames, n_y, n_x = self.shape
        y, x = -(-n_y // factor), -(-n_x // factor)
        tile_y, tile_x = _tile(y, self.chunk[1]), _tile(x, self.chunk[2])
        shard = (self.frames_per_shard, _round_up(y, tile_y), _round_up(x, tile_x))
        return Grid((n_frames, y, x), (self.chunk[0], tile_y, tile_x), shard)


def plan_layout(
    shape: tuple[int, int, int], dtype: np.dtype[Any] | str, settings: ConvertSettings = _DEFAULT_LAYOUT
) -> Layout:
    """Return the layout of a movie.

    A shard holds as many frames as fit into ``shard_mb`` (at least one), but no more than an eighth of the movie, so
    that a short one still occupies several workers. Tiles are of equal size, at most ``tile_px``.

    Examples
    --------
    >>> layout = plan_layout((600, 4096, 4096), "uint16")
    >>> layout.frames_per_shard, layout.chunk, layout.bins
    (7, (7, 256, 256), (4, 16, 64))
    """
    dtype = np.dtype(dtype).newbyteorder("=")
    n_frames, n_y, n_x = shape
    tile_y, tile_x = _tile(n_y, settings.tile_px), _tile(n_x, settings.tile_px)
    frame_bytes = _round_up(n_y, tile_y) * _round_up(n_x, tile_x) * dtype.itemsize
    most = min(int(settings.shard_mb * 1e6) // frame_bytes, -(-n_frames // _FEWEST_SHARDS))
    frames = max(1, most)
    chunks = -(-frames // _CHUNK_FRAMES)
    chunk_frames = frames // chunks
    return Layout(shape, dtype, chunks * chunk_frames, (chunk_frames, tile_y, tile_x), _plan_bins(max(n_y, n_x)))


def peak_memory(layout: Layout) -> int:
    """Return the bytes that a task needs at its peak, above the process itself (about 250 MB), with a fifth to spare.

    To convert a shard: a layer of tiles, up to two more of frames that are read ahead, a layer of the binned levels,
    and the sums and counts of one frame's bins. To fit its columns: the tiles of the shard.
    """
    layers = [_bytes((layout.chunk[0], *layout.grid().shard[1:]), layout.dtype)] * 3
    layers += [_bytes((layout.chunk[0], *layout.grid(factor).shard[1:]), LEVEL_DTYPE) for factor in layout.bins]
    sums = 16 * math.prod(layout.grid(FACTOR).shape[1:])
    return int(1.2 * max(sum(layers) + sums, _bytes(layout.grid().shard, layout.dtype)))


def disk_bytes(layout: Layout, settings: ConvertSettings) -> int:
    """Return the bytes that the store is likely to take."""
    levels = sum(_bytes(layout.grid(factor).shape, LEVEL_DTYPE) for factor in layout.bins)
    return (_bytes(layout.shape, layout.dtype) + levels) // (1 if settings.codec == "none" else _COMPRESSION)


def _bytes(shape: tuple[int, ...], dtype: np.dtype[Any]) -> int:
    return math.prod(shape) * dtype.itemsize


def _plan_bins(longer_side: int) -> tuple[int, ...]:
    """Return 4, 16, 64 ... as long as the longer side keeps 64 px, and 4 already where it has 128 px itself."""
    bins = [FACTOR] if longer_side >= 2 * _SMALLEST_LEVEL_PX else []
    while longer_side >= _SMALLEST_LEVEL_PX * FACTOR ** (len(bins) + 1):
        bins.append(FACTOR ** (len(bins) + 1))
    return tuple(bins)


def _tile(length: int, largest: int) -> int:
    """Return the side of equal tiles, at most ``largest``, so that as little as possible hangs over the edge."""
    return -(-length // -(-length // largest))


def _round_up(length: int, tile: int) -> int:
    return -(-length // tile) * tile
