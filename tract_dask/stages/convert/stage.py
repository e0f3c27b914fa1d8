"""The conversion of a source into a movie store: lossless, in parallel, and resumed where it stopped.

On disk: a Zarr v3 group that is an OME-Zarr 0.5 image. Array ``0`` holds the frames (t, y, x), binned means lie at
``binned/4``, ``binned/16`` and so on; beside them 1-D coordinates ``t``, ``y``, ``x`` and the per-frame statistics.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from distributed import Client
from numpy.typing import NDArray

from ...cluster.tasks import stream_shards
from ...errors import ChangedSourceError, DestinationError, SourceError, StoreError
from ...progress import ShardDone, Sink, StageDone, StageStarted, Warned, silent
from ...readers import files_named_now, open_source
from ...readers.checks import check_permitted
from ...readers.selection import overridden
from ...readers.source import FrameSource, SourceMetadata
from ...settings.run import ConvertSettings, MetadataSettings, RunSettings, SourceSettings
from ...settings.toml import from_toml, to_toml
from ...store import disk, schema
from ...store.files import disk_errors, remove
from ...store.held import Folder, hold
from ...store.journal import Journal, Payload, journal_beside, remove_journal
from ...store.layout import Layout, disk_bytes, plan_layout
from ...store.metadata import FORMAT, attributes, check_destination, check_nodes, format_of, is_of_system, is_sound
from ...store.movie import Movie, open_movie
from ...store.ome import AXES, frame_array
from ...store.pixels import Pixels, in_words
from ...store.provenance import WHOLE_BYTES, provenance
from ...store.shards import Shard, split
from ...store.stamps import Stamps, changed
from ..keep import Workers
from ..pixel_range import check_pixels
from .create import create, finalise, update_metadata
from .defects import Gathered, finder_for
from .origin import (
    AS_THE_FILE_SAYS,
    DECLARED_NOTHING,
    DEFAULT_LAYOUT,
    STAGE,
    Origin,
    absolute,
    check_kept,
    content_of,
    is_converted,
    made_of,
    movie_key,
    origin_of,
    remembered,
)
from .references import applied_by, check_references, contents, given, with_whole_paths, without_effect
from .shard import Job, convert_shard


def convert(
    source: FrameSource | str | Path,
    destination: str | Path,
    *,
    settings: ConvertSettings = DEFAULT_LAYOUT,
    source_settings: SourceSettings = DECLARED_NOTHING,
    metadata: MetadataSettings = AS_THE_FILE_SAYS,
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
    movie = open_source(source, source_settings) if isinstance(source, str | Path) else source
    path = Path(destination).absolute()
    settings = with_whole_paths(settings)
    known = _known(movie, settings, source_settings, metadata, on_event)
    n_frames, n_y, n_x = movie.shape
    announce = partial(StageStarted, STAGE, n_frames, frame_bytes=n_y * n_x * movie.dtype.itemsize)

    replaces = overwrite and not is_sound(path)
    if not replaces and is_converted(path, movie, settings, source_settings):
        update_metadata(path, known, **remembered(movie), to_measure=_to_measure(metadata))
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
    key, aside, codec, stamps = journal.key, journal.path, settings.codec, origin_of(movie).stamps
    finder = _finder(movie, settings, aside)
    job = Job(_place(movie), source_settings, path, key, aside, layout, codec, stamps, movie.permit, finder)
    with hold(Folder.at(path)):
        statistics, pixels = _write_shards(movie, job, shards, journal, workers, on_event)
        finalise(path, statistics, known, pixels)
        update_metadata(path, known, to_measure=_to_measure(metadata))
    journal.remove()
    corrected = _corrections(settings, pixels, on_event)
    words = [f"{n_frames} frames in {len(shards)} shards", *corrected, *in_words(pixels.counts((n_y, n_x)))]
    on_event(StageDone(STAGE, time.perf_counter() - started, summary=", ".join(words)))
    return path


def _known(
    movie: FrameSource,
    settings: ConvertSettings,
    source_settings: SourceSettings,
    metadata: MetadataSettings,
    on_event: Sink,
) -> SourceMetadata:
    """Check the references; return what is known of a movie once they are applied, and tell its notes but for these."""
    check_references(movie, settings, metadata)
    known = overridden(movie.metadata, metadata, source_settings)
    options = applied_by(settings)
    for note in known.notes:
        if not any(option in note for option in options):
            on_event(Warned(note))
    return known if settings.dark is None else replace(known, offset=0.0)


def _corrections(settings: ConvertSettings, pixels: Pixels, on_event: Sink) -> list[str]:
    """Return in words which references corrected the frames; warn of those that change nothing."""
    for sentence in without_effect(settings, pixels):
        on_event(Warned(sentence))
    return [f"corrected by {' and '.join(options)}"] if (options := applied_by(settings)) else []


def _to_measure(metadata: MetadataSettings) -> list[str]:
    """Return what of gain and offset the sum of the frames is to tell."""
    return [name for name in ("gain", "offset") if isinstance(getattr(metadata, name), str)]


def _said(about: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a movie's attributes say of its calibration."""
    return {name: about[name] for name in schema.CALIBRATION if name in about}


def _write_shards(
    movie: FrameSource, job: Job, shards: Sequence[Shard], journal: Journal, workers: Client | None, on_event: Sink
) -> tuple[dict[str, NDArray[np.float64]], Pixels]:
    """Write the shards that the journal does not know; return the statistics (frames,) of all, and what is left out."""
    statistics = {name: np.empty(movie.shape[0]) for name in schema.STATISTICS}
    gathered = Gathered(movie.shape[0], movie.shape[1:])

    def keep(shard: Shard, payload: Payload) -> None:
        gathered.add(payload)
        for name, values in statistics.items():
            values[shard.start : shard.stop] = payload[name]

    with _unchanged(job.path, movie, origin_of(movie)):
        stream_shards(
            partial(convert_shard, job),
            shards,
            keep,
            journal=journal,
            name=STAGE,
            client=workers,
            on_done=lambda shard, payload: on_event(ShardDone(STAGE, shard.index, shard.frames)),
            file=movie.path,
            on_event=on_event,
        )
    return statistics, gathered.pixels(job.finder)


def _finder(source: FrameSource, settings: ConvertSettings, folder: Path) -> Path | None:
    """Read references, look for pixels without data in a sample of the movie; return the folder of what was found."""
    if not settings.find_defects and not given(settings):
        return None
    with disk_errors(folder):
        finder_for(source, folder, settings)
    return folder


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
    disk.check_free_space(path, disk_bytes(layout, settings) - _size(path))
    with disk_errors(path):
        if not same:
            _clear(path)
            about = provenance(key, settings) | made_of(movie, settings, source_settings) | remembered(movie)
            about["source_settings"] = to_toml(source_settings)
            create(path, layout, settings.codec, about, known)
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
    about = attributes(path)
    settings = from_toml(ConvertSettings, about["settings"], str(path))
    declared = from_toml(SourceSettings, about["source_settings"], str(path))
    source = open_source(about.get("source_files") or about["source"], declared)
    _check_key(path, source, settings, declared, about)
    layout = plan_layout(source.shape, source.dtype, settings)
    chosen = [shard for shard in split(layout.shape[0], layout.frames_per_shard) if everything or shard.index in shards]
    frame_bytes = math.prod(layout.shape[1:]) * layout.dtype.itemsize
    on_event(StageStarted(STAGE, sum(shard.frames for shard in chosen), frame_bytes=frame_bytes))
    started = time.perf_counter()
    statistics = {name: np.empty(layout.shape[0]) for name in schema.STATISTICS}
    aside = disk.aside(path, "repair")
    remove(aside)
    with disk_errors(path), ExitStack() as stack:
        stack.callback(remove, aside)
        aside.mkdir()
        stamps, finder = origin_of(source).stamps, _finder(source, settings, aside)
        job = Job(_place(source), declared, path, about["key"], aside, layout, settings.codec, stamps, finder=finder)
        gathered = Gathered(source.shape[0], source.shape[1:])
        for shard in chosen:
            payload = convert_shard(job, shard)
            gathered.add(payload)
            for name, values in statistics.items():
                values[shard.start : shard.stop] = payload[name]
            on_event(ShardDone(STAGE, shard.index, shard.frames))
    if everything:
        known = source.metadata.along_frames
        statistics |= {frame_array(name): known[name].values for name in about.get("frame_values", ())}
        finalise(path, statistics, SourceMetadata(**_said(about)), gathered.pixels(finder))
    on_event(StageDone(STAGE, time.perf_counter() - started, summary=f"{len(chosen)} shards made again"))


def _check_key(
    path: Path, source: FrameSource, settings: ConvertSettings, declared: SourceSettings, about: Mapping[str, Any]
) -> None:
    """Check that the movie at ``path``, which says this ``about`` itself, was made from this source and its references.

    Raises
    ------
    SourceError
        Naming what is another.
    """
    if movie_key(source, settings, declared) == about["key"]:
        return
    made, now = about["made"], contents(settings)
    other = [] if made["content"] == content_of(source) else [source.path]
    for name, place in given(settings).items():
        other += [place] if now[f"convert.{name}"] != made["settings"].get(f"convert.{name}") else []
    raise SourceError(
        "this is not what the movie was made from",
        ", ".join(other) or source.path,
        "the same file",
        "another one",
        f"Remove {path}, and convert what you have",
    )


def _goes_on(path: Path, key: str, stamps: Stamps, on_event: Sink) -> bool:
    """Tell whether the unfinished store at ``path`` can be gone on with.

    Where only samples of the source are compared, its files have to be as old as they were.
    """
    try:
        present = attributes(path)
    except StoreError as error:
        if is_of_system(error):
            raise
        return False  # --overwrite replaces it
    ours = format_of(present) == FORMAT  # shards of an older format do not go with ours
    if present.get("kind") != "movie" or present.get("key") != key or present.get("complete") or not ours:
        return False
    if stamps.total_bytes > WHOLE_BYTES and present.get("written") != stamps.written:
        on_event(
            Warned("the movie was written again since its conversion was interrupted: the conversion starts again")
        )
        return False
    try:
        check_nodes(path, present, AXES)
    except StoreError as error:
        if is_of_system(error):
            raise
        on_event(Warned(f"{error.where} is damaged: the interrupted conversion starts again"))
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
        if content_of(source) != origin.content:
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
            "the output folder already holds other files",
            str(path),
            "nothing, or a Zarr store",
            f"a folder with {next(path.iterdir()).name}",
            "Choose another place, or empty the folder",
        )
    check_destination(path, overwrite=overwrite)


def _is_zarr(folder: Path) -> bool:
    return any((folder / name).exists() for name in ("zarr.json", ".zgroup", ".zarray"))


def _clear(path: Path) -> None:
    """Remove a store and its journal."""
    remove_journal(journal_beside(path))
    remove(path)


def _size(path: Path) -> int:
    """Return the bytes of the files under ``path``: what replacing it frees, or what is written already."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def _place(source: FrameSource) -> str | tuple[str, ...]:
    """Return what a task opens to have the same movie: one name, or those of a list."""
    return tuple(map(absolute, source.listed)) or absolute(source.path)


def convert_stage(
    source: FrameSource,
    path: Path,
    settings: RunSettings,
    workers: Workers,
    on_event: Sink = silent,
    *,
    overwrite: bool = False,
) -> Movie:
    """Return the movie at ``path``, converted if it is not there yet; its metadata are made those of ``source``."""
    convert(
        source,
        path,
        settings=settings.convert,
        source_settings=settings.source,
        metadata=settings.metadata,
        client=workers,
        on_event=on_event,
        overwrite=overwrite,
    )
    movie = open_movie(path)
    if coarse := check_pixels(movie.statistics(), source.path):
        on_event(Warned(coarse))
    return movie
