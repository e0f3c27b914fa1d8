"""The conversion of a source into a movie store: lossless, in parallel, and resumed where it stopped.

On disk: a Zarr v3 group that is an OME-Zarr 0.5 image. Array ``0`` holds the frames (t, y, x), binned means lie at
``binned/4``, ``binned/16`` and so on; beside them 1-D coordinates ``t``, ``y``, ``x`` and the per-frame statistics.
"""

from __future__ import annotations

import time
import uuid
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from distributed import Client
from numpy.typing import NDArray
from zarr.codecs import BloscCodec

from . import schema, stores
from .errors import DestinationError, SourceError
from .io import FrameSource, SourceMetadata, open_cached, open_source
from .kernels.binning import measure_frame
from .layout import LEVEL_DTYPE, Grid, Layout, disk_bytes, plan_layout
from .ome import AXES, describe
from .progress import ShardDone, Sink, StageDone, StageStarted, Warned, silent
from .provenance import fingerprint, provenance, stage_key
from .settings import ConvertSettings, MetadataSettings, SourceSettings
from .shards import Journal, Payload, Shard, journal_beside, run_shards, split

_DEFAULT_LAYOUT = ConvertSettings()

STAGE = "convert"
_AS_THE_FILE_SAYS = MetadataSettings()
_DECLARED_NOTHING = SourceSettings()
_COMPRESSORS = {
    "lz4": BloscCodec(cname="lz4", clevel=5, shuffle="bitshuffle"),
    "zstd": BloscCodec(cname="zstd", clevel=1, shuffle="bitshuffle"),
    "none": None,
}


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
    if same and present.get("complete"):
        update_metadata(path, known)
        stores.remove(journal_beside(path))
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
            about = provenance(key, settings, movie.path) | {"format": movie.format}
            _create(path, layout, settings.codec, about, known)
        journal = Journal(journal_beside(path), key)
    done_frames = sum(shards[index].frames for index in journal.done())
    on_event(announce(done_frames=done_frames))
    payloads = run_shards(
        partial(_convert_shard, _Job(_absolute(movie.path), source_settings, path, layout, settings.codec)),
        shards,
        journal=journal,
        name=STAGE,
        client=client,
        on_done=lambda shard, payload: on_event(ShardDone(STAGE, shard.index, shard.frames)),
    )
    _finalise(path, payloads, known)
    journal.remove()
    on_event(StageDone(STAGE, time.perf_counter() - started, summary=f"{n_frames} frames in {len(shards)} shards"))
    return path


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
    layout: Layout
    codec: str


def _convert_shard(job: _Job, shard: Shard) -> Payload:
    """Read the frames of a shard, measure and bin them, write them; return their statistics."""
    source = open_cached(job.source, job.source_settings)
    block = np.ascontiguousarray(source.read(shard.start, shard.stop), dtype=job.layout.dtype)
    expected = (shard.frames, *job.layout.shape[1:])
    if block.shape != expected:
        raise SourceError(
            f"frames {shard.start} to {shard.stop - 1} are not what they were when the conversion began",
            job.source,
            f"shape {expected}",
            f"shape {block.shape}",
            "Do not change the file meanwhile; convert it again",
        )
    levels = [np.empty((shard.frames, *job.layout.grid(factor).shape[1:]), LEVEL_DTYPE) for factor in job.layout.bins]
    statistics: dict[str, list[float]] = {name: [] for name in schema.STATISTICS}
    for number, frame in enumerate(block):
        *measures, means = measure_frame(frame, len(levels))
        for level, mean in zip(levels, means, strict=True):
            level[number] = mean
        for values, measure in zip(statistics.values(), measures, strict=True):
            values.append(measure)
    _write_shard(job, "0", job.layout.grid(), shard.index, block)
    del block
    for factor, level in zip(job.layout.bins, levels, strict=True):
        _write_shard(job, f"binned/{factor}", job.layout.grid(factor), shard.index, level)
    return statistics


def _write_shard(job: _Job, name: str, grid: Grid, index: int, block: NDArray[Any]) -> None:
    """Write one whole shard of an array: aside first, then renamed to its place.

    Aside it is the only shard of an array of its own, so that neither a killed task nor a second copy of this one can
    leave a shard that is half written.
    """
    aside = journal_beside(job.path) / f"{uuid.uuid4().hex}.partial"
    place = job.path / name / "c" / str(index) / "0" / "0"
    try:
        with stores.disk_errors(place), stores.codec_pipeline():
            array = _create_array(aside, grid._replace(shape=grid.shard), block.dtype, job.codec)
            array[...] = _padded(block, grid.shard)
            written = aside / "c" / "0" / "0" / "0"
            if written.exists():
                place.parent.mkdir(parents=True, exist_ok=True)
                written.replace(place)
            else:  # nothing but zeros is not stored
                stores.remove(place)
    finally:
        stores.remove(aside)


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
    aside.replace(path)


def _create_array(path: Path, grid: Grid, dtype: np.dtype[Any], codec: str) -> zarr.Array[Any]:
    return zarr.create_array(
        str(path),
        shape=grid.shape,
        chunks=grid.chunk,
        shards=grid.shard,
        dtype=dtype,
        compressors=_COMPRESSORS[codec],
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
        fill_value=0,
        dimension_names=(axis,),
        attributes=attributes,
        zarr_format=3,
    )


def _finalise(path: Path, payloads: dict[int, Payload], known: SourceMetadata) -> None:
    """Write the statistics and the metadata, and say that the store is complete."""
    with stores.disk_errors(path):
        for name in schema.STATISTICS:
            values = chain.from_iterable(payloads[index][name] for index in sorted(payloads))
            zarr.open_array(str(path / name), mode="r+")[...] = np.array(list(values))
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
    stores.remove(journal_beside(path))
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


def _padded(block: NDArray[Any], shape: tuple[int, int, int]) -> NDArray[Any]:
    """Return ``block`` filled up with zeros to ``shape``; itself where nothing is missing."""
    if block.shape == shape:
        return block
    padded = np.zeros(shape, block.dtype)
    padded[tuple(slice(length) for length in block.shape)] = block
    return padded
