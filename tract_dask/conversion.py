"""The conversion of a source into a movie store: lossless, in parallel, and resumed where it stopped.

On disk: a Zarr v3 group that is an OME-Zarr 0.5 image. Array ``0`` holds the frames (t, y, x), binned means lie at
``binned/4``, ``binned/16`` and so on; beside them 1-D coordinates ``t``, ``y``, ``x`` and the per-frame statistics.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import zarr
from distributed import Client
from numpy.typing import NDArray

from . import disk, schema, stores
from .errors import ChangedSourceError, DestinationError, MissingSourceError, SourceError, StoreError
from .io import FrameSource, Permit, SourceMetadata, files_named_now, open_source
from .io.source import Source, check_permitted, reading
from .journal import Journal, Payload, journal_beside, remove_journal
from .kernels.binning import FrameMeter
from .keyed import counted, default_of
from .layout import LEVEL_DTYPE, Layout, disk_bytes, plan_layout
from .ome import AXES, CHANGING, describe
from .progress import ShardDone, Sink, StageDone, StageStarted, Warned, silent
from .provenance import ALGORITHMS, WHOLE_BYTES, digest_of, fingerprint, provenance, stage_key
from .settings import ConvertSettings, MetadataSettings, SourceSettings, from_toml, to_toml
from .shard_files import CHUNK_KEYS, Grid, ShardWriter, chunk_path, codecs
from .shards import Shard, split
from .stamps import Stamps, changed
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
    client: Client | Callable[[], Client] | None = None,
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
        The cluster to run on, or what gives it, called where there is work; None runs in this process.
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
    for note in known.notes:
        on_event(Warned(note))
    n_frames, n_y, n_x = movie.shape
    announce = partial(StageStarted, STAGE, n_frames, frame_bytes=n_y * n_x * movie.dtype.itemsize)

    replaces = overwrite and not stores.is_sound(path)
    if not replaces and is_converted(path, movie, settings, source_settings):
        update_metadata(path, known, **_remembered(movie))
        remove_journal(journal_beside(path))
        on_event(announce(done_frames=n_frames))
        on_event(StageDone(STAGE, time.perf_counter() - started, reused=True, summary="already converted"))
        return path

    layout = plan_layout(movie.shape, movie.dtype, settings)
    shards = split(n_frames, layout.frames_per_shard)
    _check_destination(path, movie, settings, source_settings, overwrite=overwrite)
    workers = client() if callable(client) else client
    journal = _begun(path, movie, known, layout, settings, source_settings, on_event)
    on_event(announce(done_frames=journal.frames_done(shards)))
    statistics = {name: np.empty(n_frames) for name in schema.STATISTICS}

    def keep(shard: Shard, payload: Payload) -> None:
        for name, values in statistics.items():
            values[shard.start : shard.stop] = payload[name]

    origin = origin_of(movie)
    job = _Job(_place(movie), source_settings, path, journal.path, layout, settings.codec, origin.stamps, movie.permit)
    with _unchanged(path, movie, origin):
        stream_shards(
            partial(_convert_shard, job),
            shards,
            keep,
            journal=journal,
            name=STAGE,
            client=workers,
            on_done=lambda shard, payload: on_event(ShardDone(STAGE, shard.index, shard.frames)),
            file=movie.path,
            on_event=on_event,
        )
    _finalise(path, statistics, known)
    journal.remove()
    on_event(StageDone(STAGE, time.perf_counter() - started, summary=f"{n_frames} frames in {len(shards)} shards"))
    return path


def _begun(
    path: Path,
    movie: FrameSource,
    known: SourceMetadata,
    layout: Layout,
    settings: ConvertSettings,
    source_settings: SourceSettings,
    on_event: Sink,
) -> Journal:
    """Return the journal of the store at ``path``, which is made anew unless it can be gone on with."""
    origin, key = origin_of(movie), movie_key(movie, settings, source_settings)
    same = _goes_on(path, key, origin.stamps, on_event)
    stores.check_free_space(path, disk_bytes(layout, settings) - _size(path))
    with stores.disk_errors(path):
        if not same:
            _clear(path)
            about = provenance(key, settings) | _made(origin, settings, source_settings) | _remembered(movie)
            about["source_settings"] = to_toml(source_settings)
            _create(path, layout, settings.codec, about, known)
        return Journal(journal_beside(path), key, dict.fromkeys(schema.STATISTICS, (None,)))


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
    source = open_source(about.get("source_files") or about["source"], declared)
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
    frame_bytes = math.prod(layout.shape[1:]) * layout.dtype.itemsize
    on_event(StageStarted(STAGE, sum(shard.frames for shard in chosen), frame_bytes=frame_bytes))
    started = time.perf_counter()
    statistics = {name: np.empty(layout.shape[0]) for name in schema.STATISTICS}
    aside = path.with_name(f".{path.name}.repair.partial")
    stores.remove(aside)
    with stores.disk_errors(path), ExitStack() as stack:
        stack.callback(stores.remove, aside)
        aside.mkdir()
        job = _Job(_place(source), declared, path, aside, layout, settings.codec, origin_of(source).stamps)
        for shard in chosen:
            for name, values in _convert_shard(job, shard).items():
                statistics[name][shard.start : shard.stop] = values
            on_event(ShardDone(STAGE, shard.index, shard.frames))
    if everything:
        _finalise(path, statistics, SourceMetadata(**{name: about[name] for name in schema.CALIBRATION}))
    on_event(StageDone(STAGE, time.perf_counter() - started, summary=f"{len(chosen)} shards made anew"))


@dataclass(frozen=True)
class Origin:
    """What a movie is made from, as it was when it was first looked at.

    Attributes
    ----------
    stamps
        What the system said of the files.
    content
        A hash of what they hold, whatever their names, folders and times.
    """

    stamps: Stamps
    content: str


_origins: WeakKeyDictionary[FrameSource, Origin] = WeakKeyDictionary()


def origin_of(source: FrameSource) -> Origin:
    """Return the origin of an opened source; it is looked at once.

    Raises
    ------
    SourceError
        Where a file cannot be read.
    """
    if source not in _origins:
        with reading(source.path):
            stamps = Stamps.of(source.files)  # first: a change meanwhile has to be noticed later
            _origins[source] = Origin(stamps, _content(source))
    return _origins[source]


def _content(source: FrameSource) -> str:
    if isinstance(source, GoneSource):
        return source.content
    return digest_of(source.inside, fingerprint(*source.files))


def movie_key(
    source: FrameSource,
    settings: ConvertSettings = _DEFAULT_LAYOUT,
    source_settings: SourceSettings = _DECLARED_NOTHING,
) -> str:
    """Return the key of the movie that :func:`convert` makes; pixel size, times, dose and gain are not part of it."""
    return stage_key(STAGE, origin_of(source).content, counted_of(settings, source_settings))


def counted_of(settings: ConvertSettings, source_settings: SourceSettings) -> dict[str, Any]:
    """Return the settings of a movie's key that differ from their defaults, by their names in keys."""
    return counted(STAGE, convert=settings, source=source_settings)


def _made(origin: Origin, settings: ConvertSettings, source_settings: SourceSettings) -> dict[str, Any]:
    """Return what a movie's key is made of, by which the movie is known again without its source."""
    made = {
        "content": origin.content,
        "algorithm": ALGORITHMS[STAGE],
        "settings": counted_of(settings, source_settings),
    }
    return {"made": made, "written": origin.stamps.written}


def is_converted(path: Path, source: FrameSource, settings: ConvertSettings, source_settings: SourceSettings) -> bool:
    """Tell whether the movie at ``path`` is complete, and what :func:`convert` would make."""
    present = stores.attributes(path)
    whole = present.get("kind") == "movie" and bool(present.get("complete"))
    return whole and not _differences(present, source, settings, source_settings)


def is_movie_of(path: Path, source: FrameSource) -> bool:
    """Tell whether the store at ``path``, complete or not, was made from what ``source`` holds."""
    present = stores.attributes(path)
    return bool(present) and present.get("made", {}).get("content") == origin_of(source).content


def check_kept(path: Path, source: FrameSource, settings: ConvertSettings, source_settings: SourceSettings) -> None:
    """Check that making the movie at ``path`` would throw no other complete one away.

    Raises
    ------
    DestinationError
        Saying what differs, old and new, and what would be made again.
    """
    present = stores.attributes(path)
    if not present or (present.get("kind") == "movie" and not present.get("complete")):
        return
    if present.get("kind") != "movie" or not is_movie_of(path, source):
        raise DestinationError(
            "this store was made from something else",
            str(path),
            f"nothing, or a movie made from what {source.path} holds now",
            f"a store made from {present.get('source') or 'an unknown source'}",
            "Choose another place, or say --overwrite",
        )
    if found := _differences(present, source, settings, source_settings):
        frames, *sides = present["shape"]
        raise DestinationError(
            "this movie was converted otherwise",
            str(path),
            "the settings and the version that made it",
            "; ".join(found),
            "Use those, choose another place, or say --overwrite: then its"
            f" {frames} frames of {sides[0]} x {sides[1]} px are converted again from {source.path},"
            " and drift, sum and tracks are made again",
        )


_LAID_OUT = ("convert.shard_mb", "convert.tile_px")
"""Settings that count by the layout that comes of them."""


def _differences(
    present: dict[str, Any], source: FrameSource, settings: ConvertSettings, source_settings: SourceSettings
) -> list[str]:
    """Return in words how a complete movie differs from what would be made; nothing where it does not."""
    made, now = present.get("made", {}), counted_of(settings, source_settings)
    then = made.get("settings", {})
    layout = plan_layout(source.shape, source.dtype, settings)
    laid = [layout.frames_per_shard, list(layout.chunk)] == [present.get("frames_per_shard"), present.get("chunk")]
    found = [] if made.get("content") == origin_of(source).content else ["the source holds something else"]
    if made.get("algorithm") != ALGORITHMS[STAGE]:
        found.append(f"its conversion's number was {made.get('algorithm')}, and is {ALGORITHMS[STAGE]}")
    for name in sorted({*then, *now} - {*(_LAID_OUT if laid else ())}):
        old, new = (values.get(name, default_of(STAGE, name)) for values in (then, now))
        if old != new:
            found.append(f"{name} was {_in_words(old)}, and is {_in_words(new)}")
    return found


def _in_words(value: Any) -> str:
    return "unset" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True, kw_only=True, eq=False)
class GoneSource(Source):
    """A source that is not there any more, as the movie remembers it that was made from it; it has no frames to read.

    Attributes
    ----------
    content
        A hash of what it held.
    """

    content: str


def remembered_source(path: Path, source: str, error: SourceError) -> GoneSource | None:
    """Return the source of the complete movie at ``path``, which is not there; None where it is, or is another.

    Parameters
    ----------
    source
        Where it should be. It has the name that it had, in any folder.
    error
        Why it cannot be opened.
    """
    present = stores.attributes(path)
    known = present.get("complete") and present.get("made") and _name(present["source"]) == _name(source)
    if not known or not (isinstance(error, MissingSourceError) or _is_out_of_reach(source)):
        return None
    note = f"{source} is not there: the run goes on with the movie that was converted from it"
    return GoneSource(
        path=source,
        files=(),
        format=present["source_format"],
        shape=tuple(present["shape"]),
        dtype=np.dtype(present["dtype"]),
        metadata=SourceMetadata(**present["file_says"], notes=(note,)),
        content=present["made"]["content"],
    )


def _name(source: str) -> tuple[str, str]:
    """Return the name of a source without its folder, and the path inside it."""
    outer, _, inner = source.partition("::")
    return Path(outer).name, inner


def _is_out_of_reach(source: str) -> bool:
    """Tell whether the system does not even say what is at a source's path, as where a mount has gone."""
    try:
        Path(source.partition("::")[0]).stat()
    except FileNotFoundError:
        return False  # a pattern, or the reader knows better
    except OSError:
        return True
    return False


def _remembered(source: FrameSource) -> dict[str, Any]:
    """Return what a movie remembers of a source that is there."""
    if isinstance(source, GoneSource):
        return {}
    return {
        "source": _absolute(source.path),
        "source_files": list(map(_absolute, source.listed)),
        "source_format": source.format,
        "file_says": _quantities(source.metadata),
    }


def update_metadata(path: Path, metadata: SourceMetadata, **more: Any) -> None:
    """Write pixel size, frame time, dose and gain into a movie store, if they differ: coordinates, scales, attributes.

    ``more`` are attributes of the store that are written with them.

    Raises
    ------
    StoreError
        Where it cannot be written.
    """
    present, now = stores.attributes(path), _quantities(metadata) | more
    cut_off = present.pop(CHANGING, False)
    if cut_off or any(present.get(name) != value for name, value in now.items()):
        mark: dict[str, Any] = {CHANGING: True}
        with stores.disk_errors(path):
            stores.update_attributes(path, **mark)  # coordinates and root change one after the other
            describe(path, present | now)


def _goes_on(path: Path, key: str, stamps: Stamps, on_event: Sink) -> bool:
    """Tell whether the unfinished store at ``path`` can be gone on with.

    Where only samples of the source are compared, its files have to be as old as they were.
    """
    try:
        present = stores.attributes(path)
    except StoreError as error:
        if stores.is_of_system(error):
            raise
        return False  # --overwrite replaces it
    ours = stores.format_of(present) == stores.FORMAT  # shards of an older format do not go with ours
    if present.get("kind") != "movie" or present.get("key") != key or present.get("complete") or not ours:
        return False
    if stamps.total_bytes > WHOLE_BYTES and present.get("written") != stamps.written:
        on_event(Warned("the movie was written again since its conversion was interrupted, which begins anew"))
        return False
    try:
        stores.check_nodes(path, present, AXES)
    except StoreError as error:
        if stores.is_of_system(error):
            raise
        on_event(Warned(f"{error.where} is damaged: the conversion, which was interrupted, begins anew"))
        return False
    return True


@contextmanager
def _unchanged(path: Path, source: FrameSource, origin: Origin) -> Iterator[None]:
    """Check after the work in this block that the source is what it was before; otherwise remove the unfinished store.

    Raises
    ------
    ChangedSourceError
        Where it is not, whatever else was raised in the block.
    """
    try:
        yield
        check_permitted(source.permit, source.files)
        origin.stamps.check(source.files)
        _check_names(source)
        if _content(source) != origin.content:
            raise changed(source.path, "what it held then", "something else")
    except ChangedSourceError:
        _clear(path)
        raise
    except Exception:
        check_permitted(source.permit, source.files)
        try:
            origin.stamps.check(source.files)
        except ChangedSourceError:
            _clear(path)
            raise
        raise


def _check_names(source: FrameSource) -> None:
    """Check that the folder or the pattern of a movie names the same files as when it was opened.

    Raises
    ------
    ChangedSourceError
        Naming a file that was added or taken away.
    """
    named = files_named_now(source)
    if named is None or named[0] == named[1]:
        return
    before, now = (frozenset(files) for files in named)
    differing = ((now - before, "added"), (before - now, "taken away"))
    words = [f"{min(files).name} was {verb}" for files, verb in differing if files]
    got = f"{len(now)} files: " + (", ".join(words) or "in another order")
    raise changed(source.path, f"{len(before)} files", got)


@dataclass(frozen=True)
class _Job:
    """What every task of a conversion needs: paths and plans, no data."""

    source: str | tuple[str, ...]
    source_settings: SourceSettings
    path: Path
    aside: Path
    layout: Layout
    codec: str
    stamps: Stamps
    permit: Permit | None = None


@lru_cache(maxsize=4)
def _opened(source: str | tuple[str, ...], settings: SourceSettings, permit: Permit | None, stamps: str) -> FrameSource:
    """Open the source once in a process; ``stamps`` tells it from another one later at the same place."""
    return open_source(source, settings, permit=permit)


def _check_files(job: _Job, source: FrameSource, shard: Shard) -> None:
    """Check that the files of a shard may be opened, and are as they were; in this order, which tells less."""
    part = source.files_of(shard.start, shard.stop)
    check_permitted(job.permit, source.files[part])
    job.stamps.check(source.files, part)


def _convert_shard(job: _Job, shard: Shard) -> Payload:
    """Read the frames of a shard, measure and bin them, write them; return their statistics."""
    source = _opened(job.source, job.source_settings, job.permit, job.stamps.digest)
    check = partial(_check_files, job, source, shard)
    check()
    found, expected = (f"shape {it.shape}, {it.dtype}" for it in (source, job.layout))
    if found != expected:
        raise SourceError(
            "the movie is not what it was when the conversion began",
            source.path,
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
        check()  # before the shards take their places
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
    zarr.create_group(aside, zarr_format=3)
    zarr.create_group(aside / "binned", zarr_format=3)
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
        "chunk": layout.chunk,
        "bins": layout.bins,
    }
    describe(aside, about | plan | _quantities(known))
    disk.place_folder(aside, path)


def _create_array(path: Path, grid: Grid, dtype: np.dtype[Any], codec: str) -> zarr.Array[Any]:
    return zarr.create_array(
        path,
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
        path,
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


def _check_destination(
    path: Path, source: FrameSource, settings: ConvertSettings, source_settings: SourceSettings, *, overwrite: bool
) -> None:
    """Check that the store may be made, or gone on with, at ``path``; see :func:`convert`."""
    if not overwrite:
        check_kept(path, source, settings, source_settings)
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
    """Remove a store and its journal."""
    remove_journal(journal_beside(path))
    stores.remove(path)


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


def _place(source: FrameSource) -> str | tuple[str, ...]:
    """Return what a task opens to have the same movie: one name, or those of a list."""
    return tuple(map(_absolute, source.listed)) or _absolute(source.path)


def _absolute(source: str) -> str:
    """Return the source's path as any worker can use it, whatever folder it runs in."""
    outer, inside, inner = source.partition("::")
    return f"{Path(outer).absolute()}{inside}{inner}"
