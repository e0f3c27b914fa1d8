"""Conversion of one shard of frames: read, measure, bin, write."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SourceError
from ...kernels.binning import FrameMeter
from ...readers import open_source
from ...readers.checks import Permit, check_permitted
from ...readers.source import FrameSource
from ...settings.run import SourceSettings
from ...store import files, schema
from ...store.journal import Payload
from ...store.layout import LEVEL_DTYPE, Layout
from ...store.pixels import Pixels
from ...store.shard_files import ShardWriter, chunk_path, mark_of
from ...store.shards import Shard
from ...store.stamps import Stamps
from .defects import found_in, in_payload

_AHEAD_BYTES = 32 << 20


@dataclass(frozen=True)
class Job:
    """What every task of a conversion needs: paths and plans, no data."""

    source: str | tuple[str, ...]
    source_settings: SourceSettings
    path: Path
    key: str
    aside: Path
    layout: Layout
    codec: str
    stamps: Stamps
    permit: Permit | None = None
    finder: Path | None = None
    """Folder of the references, and of what finds pixels without data; None: there is neither."""


@lru_cache(maxsize=4)
def _opened(source: str | tuple[str, ...], settings: SourceSettings, permit: Permit | None, stamps: str) -> FrameSource:
    """Open the source once in a process; ``stamps`` tells it from another one later at the same place."""
    return open_source(source, settings, permit=permit)


def check_files(job: Job, source: FrameSource, shard: Shard) -> None:
    """Check that the files of a shard may be opened, and are as they were; in this order, which tells less."""
    part = source.files_of(shard.start, shard.stop)
    check_permitted(job.permit, source.files[part])
    job.stamps.check(source.files, part)


def convert_shard(job: Job, shard: Shard) -> Payload:
    """Read the frames of a shard, measure and bin them, write them; return their statistics.

    Pixels are written as they were recorded; statistics and binned means are of corrected ones, and leave out those
    without data. Beside the statistics are the spikes of frames, ``spikes`` (n, 3) frame, y, x, and, by frame, their
    ``borders`` and how many pixels are ``saturated``, and higher.
    """
    source = _opened(job.source, job.source_settings, job.permit, job.stamps.digest)
    check = partial(check_files, job, source, shard)
    check()
    found, expected = (f"shape {it.shape}, {it.dtype}" for it in (source, job.layout))
    if found != expected:
        raise SourceError(
            "the movie has changed since the conversion began",
            source.path,
            expected,
            found,
            "Do not change the file meanwhile; convert it again",
        )
    meters = _Meters(job.layout)
    finder = found_in(job.finder) if job.finder else None
    statistics: dict[str, list[float]] = {name: [] for name in schema.STATISTICS}
    left_out: dict[int, Pixels] = {}
    saturated: dict[str, tuple[int, int]] = {}
    with files.disk_errors(job.path), ExitStack() as stack:
        writers = [stack.enter_context(_writer(job, factor, shard.index)) for factor in (1, *job.layout.bins)]
        for number, frame in enumerate(_read_ahead(source, shard, job.layout.chunk[0]), shard.start):
            shown = finder.corrected(frame) if finder else frame
            if finder and (odd := finder.look(frame, shown)):
                shown, left_out[number] = odd.applied(shown[None], 0)[0], odd
            if finder and any(reached := finder.saturated(frame, shown)):
                saturated[str(number)] = reached
            *measures, levels = meters[shown.dtype].measure(shown)
            for writer, pixels in zip(writers, (frame, *levels), strict=True):
                writer.add(pixels)
            for values, measure in zip(statistics.values(), measures, strict=True):
                values.append(measure)
        check()  # before the shards take their places
    return statistics | in_payload(left_out) | ({"saturated": saturated} if saturated else {})


class _Meters(dict[np.dtype[Any], FrameMeter]):
    """The meters of frames, by their pixel type: some frames of a movie may miss pixels."""

    def __init__(self, layout: Layout) -> None:
        super().__init__()
        self._layout = layout

    def __missing__(self, dtype: np.dtype[Any]) -> FrameMeter:
        self[dtype] = FrameMeter(self._layout.shape[1:], dtype, len(self._layout.bins))
        return self[dtype]


def _read_ahead(source: FrameSource, shard: Shard, depth: int) -> Iterator[NDArray[Any]]:
    """Yield the frames of a shard, while a thread reads those that follow; a frame is valid until the next."""
    step = 1 if source.one_by_one else depth
    starts = range(shard.start, shard.stop, step)
    frame_bytes = math.prod(source.shape[1:]) * source.dtype.itemsize
    n_blocks = min(len(starts), max(2, _AHEAD_BYTES // (step * frame_bytes)))
    blocks = [np.empty((step, *source.shape[1:]), source.dtype) for _ in range(n_blocks)]

    def read(number: int) -> NDArray[Any]:
        block = blocks[number % n_blocks][: shard.stop - starts[number]]
        source.read_into(starts[number], block)
        return block

    with ThreadPoolExecutor(1, "read-ahead") as reader:
        ahead = deque(reader.submit(read, number) for number in range(n_blocks))
        for following in range(n_blocks, len(starts) + n_blocks):
            yield from ahead.popleft().result()
            if following < len(starts):
                ahead.append(reader.submit(read, following))


def _writer(job: Job, factor: int, index: int) -> ShardWriter:
    """Return the writer of a shard of the frames (``factor`` 1) or of a binned level."""
    name = "0" if factor == 1 else f"binned/{factor}"
    dtype = job.layout.dtype if factor == 1 else LEVEL_DTYPE
    place = chunk_path(job.path / name, index, 0, 0)
    mark = mark_of(job.key, name, index)
    return ShardWriter(place, job.aside, job.layout.grid(factor), dtype, job.codec, mark=mark)
