"""The conversion of a source into a movie store: lossless, in parallel, and resumed where it stopped.

On disk: a Zarr v3 group that is an OME-Zarr 0.5 image. Array ``0`` holds the frames (t, y, x), binned means lie at
``binned/4``, ``binned/16`` and so on; beside them 1-D coordinates ``t``, ``y``, ``x`` and the per-frame statistics.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from distributed import Client
from numpy.typing import NDArray

from . import disk, schema, stores
from .errors import DestinationError, SourceError
from .io import FrameSource, SourceMetadata, open_cached, open_source
from .journal import Journal, Payload, journal_beside, remove_journal
from .kernels.binning import FrameMeter
from .layout import LEVEL_DTYPE, Layout, disk_bytes, plan_layout
from .ome import AXES, describe
from .progress import ShardDone, Sink, StageDone, StageStarted, Warned, silent
from .provenance import fingerprint, provenance, stage_key
from .settings import ConvertSettings, MetadataSettings, SourceSettings, from_toml, to_toml
from .shard_files import CHUNK_KEYS, Grid, ShardWriter, chunk_path, codecs
from .shards import Shard, split
from .tasks import stream_shards

_DEFAULT_LAYOUT = ConvertSettings()

STAGE = "convert"
_AS_THE_FILE_SAYS = MetadataSettings()
_DECLARED_NOTHING = SourceSettings()
_AHEAD_BYTES = 32 << 20


def convert(
    source: FrameSource | str | Path,
    destination: str | Path,
    *,
    settings: ConvertSettings = _DEFAULT_LAYOUT,
    source_settings: SourceSettings = _DECLARED_NOTHING,
    metadata: MetadataSettings = _AS_THE_FILE_SAYS,
    client: Client | None = None,
    on_event: Sink = silent,
    overwrite: bool = False,
) -> Path:
    """Convert a movie to Zarr, losslessly, with binned levels and per-frame statistics; return the store's path.

    What an interrupted call has finished is kept, and the same call goes on from there. A store that is complete is
    left as it is, but for its metadata.

    Parameters
    ----------
    source
        An open source or its path. Tasks open it anew by its path and ``source_settings``.
    destination
        Where to write the store.
    metadata
        What the user knows better than the file.
    client
        The cluster to run on; None runs in this process.
    on_event
        Told how the work goes.
    overwrite
        Replace a store or a file that was made from something else. Other folders are never replaced.

    Raises
    ------
    SourceError
        Where the source cannot be read.
    DestinationError
        Where the destination holds something else, cannot be written, or is too small; nothing was started.
    StoreError
        Where a shard could not be written, as on a disk that became full; finished shards are kept.
    """
    started = time.perf_counter()
    movie = open_source(source, source_settings, metadata) if isinstance(source, str | Path) else source
    known = _overridden(movie.metadata, metadata)
    path = Path(destination).absolute()
    key = movie_key(movie, settings, source_settings)
    for note in known.notes:
        on_event(Warned(note))
    n_frames, n_y, n_x = movie.shape
    announce = partial(StageStarted, STAGE, n_frames, frame_bytes=n_y * n_x * movie.dtype.itemsize)

    present = stores.attributes(path)
    same = present.get("kind") == "movie" and present.get("key") == key
    if not present.get("complete"):
        same &= stores.format_of(present) == stores.FORMAT  # shards of an older format do not go with ours
    if same and present.get("complete"):
        update_metadata(path, known)
        remove_journal(journal_beside(path))
        on_event(announce(done_frames=n_frames))
        on_event(StageDone(STAGE, time.perf_counter() - started, reused=True, summary="already converted"))
        return path

    layout = plan_layout(movie.shape, movie.dtype, settings)
    shards = split(n_frames, layout.frames_per_shard)
    _check_destination(path, movie, same=same, overwrite=overwrite)
    stores.check_free_space(path, disk_bytes(layout, settings) - _size(path))
    with stores.disk_errors(path):
        if not same:
            _clear(path)
            about = provenance(key, settings, movie.path) | {"source_format": movie.format}
            about["source_settings"] = to_toml(source_settings)
            _create(path, layout, settings.codec, about, known)
        journal = Journal(journal_beside(path), key, dict.fromkeys(schema.STATISTICS, (None,)))
    on_event(announce(done_frames=journal.frames_done(shards)))
    statistics = {name: np.empty(n_frames) for name in schema.STATISTICS}

    def keep(shard: Shard, payload: Payload) -> None:
        for name, values in statistics.items():
            values[shard.start : shard.stop] = payload[name]

    stream_shards(
        partial(
            _convert_shard, _Job(_absolute(movie.path), source_settings, path, journal.path, layout, settings.codec)
        ),
        shards,
        keep,
        journal=journal,
        name=STAGE,
        client=client,
        on_done=lambda shard, payload: on_event(ShardDone(STAGE, shard.index, shard.frames)),
        file=movie.path,
        on_event=on_event,
    )
    _finalise(path, statistics, known)
    journal.remove()
    on_event(StageDone(STAGE, time.perf_counter() - started, summary=f"{n_frames} frames in {len(shards)} shards"))
    return path


def remake(path: Path, shards: Collection[int], *, everything: bool = False, on_event: Sink = silent) -> None:
    """Make some shards of a complete movie anew from its source, in this process.

    Parameters
    ----------
    shards
        Their indices.
    everything
        Make all shards, and the statistics and coordinates too.

    Raises
    ------
    SourceError
        Where the source is not there, or is not what the movie was made from.
    """
    about = stores.attributes(path)
    settings = from_toml(ConvertSettings, about["settings"], str(path))
    declared = from_toml(SourceSettings, about["source_settings"], str(path))
    source = open_source(about["source"], declared)
    if movie_key(source, settings, declared) != about["key"]:
        raise SourceError(
            "the source is not what the movie was made from",
            source.path,
            "the same file",
            "another one",
            f"Remove {path}, and convert what you have",
        )
    layout = plan_layout(source.shape, source.dtype, settings)
    chosen = [shard for shard in split(layout.shape[0], layout.frames_per_shard) if everything or shard.index in shards]
    aside = path.with_name(f".{path.name}.repair")
    stores.remove(aside)
    aside.mkdir()
    job = _Job(_absolute(source.path), declared, path, aside, layout, settings.codec)
    frame_bytes = math.prod(layout.shape[1:]) * layout.dtype.itemsize
    on_event(StageStarted(STAGE, sum(shard.frames for shard in chosen), frame_bytes=frame_bytes))
    started = time.perf_counter()
    statistics = {name: np.empty(layout.shape[0]) for name in schema.STATISTICS}
    for shard in chosen:
        for name, values in _convert_shard(job, shard).items():
            statistics[name][shard.start : shard.stop] = values
        on_event(ShardDone(STAGE, shard.index, shard.frames))
    if everything:
        _finalise(path, statistics, SourceMetadata(**{name: about[name] for name in schema.CALIBRATION}))
    stores.remove(aside)
    on_event(StageDone(STAGE, time.perf_counter() - started, summary=f"{len(chosen)} shards made anew"))


def movie_key(
    source: FrameSource,
    settings: ConvertSettings = _DEFAULT_LAYOUT,
    source_settings: SourceSettings = _DECLARED_NOTHING,
) -> str:
    """Return the key of the movie that :func:`convert` makes; pixel size, times, dose and gain are not part of it."""
    return stage_key(fingerprint(*source.files), settings, source_settings)


def update_metadata(path: Path, metadata: SourceMetadata) -> None:
    """Write pixel size, frame time, dose and gain into a movie store, if they differ: coordinates, scales, attributes.

    Raises
    ------
    StoreError
        Where it cannot be written.
    """
    present = stores.attributes(path)
    if any(present[name] != value for name, value in _quantities(metadata).items()):
        with stores.disk_errors(path):
            describe(path, present | _quantities(metadata))


@dataclass(frozen=True)
class _Job:
    """What every task of a conversion needs: paths and plans, no data."""

    source: str
    source_settings: SourceSettings
    path: Path
    aside: Path
    layout: Layout
    codec: str


def _convert_shard(job: _Job, shard: Shard) -> Payload:
    """Read the frames of a shard, measure and bin them, write them; return their statistics."""
    source = open_cached(job.source, job.source_settings)
    found, expected = (f"shape {it.shape}, {it.dtype}" for it in (source, job.layout))
    if found != expected:
        raise SourceError(
            "the movie is not what it was when the conversion began",
            job.source,
            expected,
            found,
            "Do not change the file meanwhile; convert it again",
        )
    meter = FrameMeter(job.layout.shape[1:], job.layout.dtype, len(job.layout.bins))
    statistics: dict[str, list[float]] = {name: [] for name in schema.STATISTICS}
    with stores.disk_errors(job.path), ExitStack() as stack:
        writers = [stack.enter_context(_writer(job, factor, shard.index)) for factor in (1, *job.layout.bins)]
        for frame in _read_ahead(source, shard, job.layout.chunk[0]):
            *measures, levels = meter.measure(frame)
            for writer, pixels in zip(writers, (frame, *levels), strict=True):
                writer.add(pixels)
            for values, measure in zip(statistics.values(), measures, strict=True):
                values.append(measure)
    return statistics


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


def _writer(job: _Job, factor: int, index: int) -> ShardWriter:
    """Return the writer of a shard of the frames (``factor`` 1) or of a binned level."""
    array = job.path / ("0" if factor == 1 else f"binned/{factor}")
    dtype = job.layout.dtype if factor == 1 else LEVEL_DTYPE
    place = chunk_path(array, index, 0, 0)
    return ShardWriter(place, job.aside, job.layout.grid(factor), dtype, job.codec)


def _create(path: Path, layout: Layout, codec: str, about: dict[str, Any], known: SourceMetadata) -> None:
    """Make the store with all its arrays, still empty: whole or not at all."""
    aside = path.with_name(f".{path.name}.partial")
    stores.remove(aside)
    zarr.create_group(str(aside), zarr_format=3)
    zarr.create_group(str(aside / "binned"), zarr_format=3)
    _create_array(aside / "0", layout.grid(), layout.dtype, codec)
    for factor in layout.bins:
        _create_array(aside / "binned" / str(factor), layout.grid(factor), LEVEL_DTYPE, codec)
    for axis, length in zip(AXES, layout.shape, strict=True):
        _create_vector(aside / axis, length, axis, "float64")
    for variable in schema.STATISTICS.values():
        _create_vector(aside / variable.name, layout.shape[0], "t", variable.dtype, variable.attributes)
    plan = {
        "kind": "movie",
        "complete": False,
        "shape": layout.shape,
        "dtype": layout.dtype.name,
        "frames_per_shard": layout.frames_per_shard,
        "bins": layout.bins,
    }
    describe(aside, about | plan | _quantities(known))
    disk.place_folder(aside, path)


def _create_array(path: Path, grid: Grid, dtype: np.dtype[Any], codec: str) -> zarr.Array[Any]:
    return zarr.create_array(
        str(path),
        shape=grid.shape,
        chunks=grid.chunk,
        shards=grid.shard,
        dtype=dtype,
        compressors=codecs(codec),
        chunk_key_encoding=CHUNK_KEYS,
        fill_value=0,
        dimension_names=AXES,
        zarr_format=3,
    )


def _create_vector(path: Path, length: int, axis: str, dtype: str, attributes: dict[str, Any] | None = None) -> None:
    zarr.create_array(
        str(path),
        shape=(length,),
        chunks=(length,),
        dtype=dtype,
        compressors=codecs("zstd"),
        chunk_key_encoding=CHUNK_KEYS,
        fill_value=0,
        dimension_names=(axis,),
        attributes=attributes,
        zarr_format=3,
    )


def _finalise(path: Path, statistics: dict[str, NDArray[np.float64]], known: SourceMetadata) -> None:
    """Write the statistics (frames,) and the metadata, and say that the store is complete."""
    with stores.disk_errors(path):
        for name, values in statistics.items():
            stores.overwrite_array(path / name, values)
        disk.sync_folders(path, tuple(statistics))
        describe(path, stores.attributes(path) | _quantities(known) | {"complete": True})


def _check_destination(path: Path, source: FrameSource, *, same: bool, overwrite: bool) -> None:
    """Check that the store may be made, or gone on with, at ``path``; see :func:`convert`."""
    present = stores.attributes(path)
    if present and not same and not overwrite and (present.get("kind") != "movie" or present.get("complete")):
        raise DestinationError(
            "this store was made from something else, or with other settings",
            str(path),
            f"nothing, or the movie {source.path} with these settings",
            f"a store made from {present.get('source') or 'an unknown source'}",
            "Choose another place, or say --overwrite",
        )
    if path.exists() and any(path == file or path in file.parents for file in map(Path.absolute, source.files)):
        raise DestinationError(
            "this place holds the source itself",
            str(path),
            "another place than the source",
            source.path,
            "Choose another destination",
        )
    if path.is_dir() and any(path.iterdir()) and not _is_zarr(path):
        raise DestinationError(
            "this folder holds something else",
            str(path),
            "nothing, or a Zarr store",
            f"a folder with {next(path.iterdir()).name}",
            "Choose another place, or empty the folder",
        )
    stores.check_destination(path, overwrite=overwrite)


def _is_zarr(folder: Path) -> bool:
    return any((folder / name).exists() for name in ("zarr.json", ".zgroup", ".zarray"))


def _clear(path: Path) -> None:
    """Remove a store and its journal; renamed first, so that what is at ``path`` is always whole."""
    remove_journal(journal_beside(path))
    aside = path.with_name(f".{path.name}.removed")
    stores.remove(aside)
    if path.exists():
        path.replace(aside)
    stores.remove(aside)


def _size(path: Path) -> int:
    """Return the bytes of the files under ``path``: what replacing it frees, or what is written already."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def _overridden(found: SourceMetadata, metadata: MetadataSettings) -> SourceMetadata:
    """Return what is known of the movie, with what the user says above what the source says."""
    said = {name: value for name, value in _quantities(metadata).items() if value is not None}
    if said["gain"] == _AS_THE_FILE_SAYS.gain:
        del said["gain"]
    return replace(found, **said)


def _quantities(metadata: SourceMetadata | MetadataSettings) -> dict[str, Any]:
    return {name: getattr(metadata, name) for name in schema.CALIBRATION}


def _absolute(source: str) -> str:
    """Return the source's path as any worker can use it, whatever folder it runs in."""
    outer, inside, inner = source.partition("::")
    return f"{Path(outer).absolute()}{inside}{inner}"
