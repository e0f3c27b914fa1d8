"""Reads everything of the stores of a run, and names each file that is damaged, missing or left over."""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, TypeAlias

import numpy as np

from ..errors import MissingStoreError, StoreError
from ..progress import ShardDone, Sink, StageDone, StageStarted, silent
from ..stages.convert.stage import remake
from ..store import metadata
from ..store.damage import FRAME_AXES, METADATA
from ..store.journal import Journal, entries, journal_beside
from ..store.locks import sole_use
from ..store.ome import AXES, CHANGING
from ..store.parts import Parts, layout
from ..store.shard_files import ABSENT, ELSEWHERE, MARKED, mark_of, read_index, trailing, unchecked
from ..store.strangers import WHY, advice, strangers
from .beside import Beside, look_beside
from .faults import STRANGE, Fault

_AT_ONCE = 8
"""Files that are read at a time."""

_Place: TypeAlias = tuple[int, ...] | None
"""Numbers of a chunk along the axes of its array; None of a file that holds none."""

_STAGES = {"movie": "convert", "results": "fit"}
"""Stages whose stores have other names."""


@dataclass(frozen=True)
class Verified:
    """What :func:`verify` found.

    Attributes
    ----------
    files
        How many were read.
    unfinished
        Stores whose stage is not finished; what is missing there is no fault.
    without_checksums
        Stores of an older format, of which damage cannot be told.
    notes
        Sentences on what is no fault, such as a table that was edited.
    """

    faults: tuple[Fault, ...]
    files: int
    unfinished: tuple[Path, ...]
    without_checksums: tuple[Path, ...]
    notes: tuple[str, ...] = ()

    @property
    def sound(self) -> bool:
        """Whether nothing is damaged, missing or unreadable."""
        return all(fault.what == "left over" for fault in self.faults)

    @property
    def remedies(self) -> list[str]:
        """What to do, a sentence for each store, or file, that needs it."""
        kinds = ((STRANGE,), ("damaged", "missing"), ("left over",))
        found = [fault.remedy for kind in kinds for fault in self.faults if fault.what in kind]
        unreadable = [fault.file for fault in self.faults if fault.what == "unreadable"]
        found += [f"Repair the disk or the permissions of {unreadable[0]}"] if unreadable else []
        return list(dict.fromkeys(found))

    def text(self) -> str:
        """Return it as lines: each fault, what to do, and how many there are."""
        lines = [*map(str, self.faults), *(f"{sentence}." for sentence in self.remedies)]
        lines += [f"{store}: unfinished; the same run again goes on with it" for store in self.unfinished]
        lines += [f"{store}: of an older format, without checksums" for store in self.without_checksums]
        lines += self.notes
        bad = sum(fault.what != "left over" for fault in self.faults)
        return "\n".join([*lines, f"{self.files:,} files read: " + (f"{bad:,} are not sound" if bad else "all sound")])

    def to_record(self) -> dict[str, Any]:
        """Return it as a mapping for JSON."""
        return {
            "sound": self.sound,
            "files": self.files,
            "faults": [fault.to_record() for fault in self.faults],
            "remedies": self.remedies,
            "unfinished": list(map(str, self.unfinished)),
            "without_checksums": list(map(str, self.without_checksums)),
            "notes": list(self.notes),
        }


def verify(path: Path, on_event: Sink = silent) -> Verified:
    """Read everything of a store, or of a run's folder with all stores and files in it, and check it.

    Raises
    ------
    MissingStoreError
        Where there is no store.
    """
    there = stores_in(path)
    found = [_verify_store(store, on_event) for store in there]
    alone = there == [path.absolute()]
    beside = Beside((), (), 0) if alone else look_beside(path.absolute(), there)
    others = () if alone else tuple(map(_stranger, strangers(path.absolute())))
    return Verified(
        (*(fault for one in found for fault in one.faults), *others, *beside.faults),
        sum(one.files for one in found) + beside.files,
        tuple(store for one in found for store in one.unfinished),
        tuple(store for one in found for store in one.without_checksums),
        beside.notes,
    )


def _stranger(store: Path) -> Fault:
    stage = _STAGES.get(store.stem, store.stem)
    return Fault(store / METADATA, store, stage, STRANGE, WHY, help=advice(store.parent))


def stores_in(path: Path) -> list[Path]:
    """Return the store at ``path``, or those of the run's folder that it is."""
    path = path.absolute()
    if (path / METADATA).exists() or path.suffix == ".zarr":
        found = [path] if path.is_dir() else []
    else:
        found = sorted(folder for folder in path.glob("[!.]*.zarr") if folder.is_dir())
    if not found:
        raise MissingStoreError(
            "there is no store here", str(path), "a store, or the folder of a run", remedy="Correct the path"
        )
    return found


def repair(found: Verified, on_event: Sink = silent) -> tuple[Path, ...]:
    """Make what is damaged or missing in movies anew from their sources; return the movies.

    Raises
    ------
    SourceError
        Where a movie's source is not there, or is not what it was.
    StoreError
        Where it could not be written.
    """
    movies: dict[Path, list[Fault]] = {}
    for fault in found.faults:
        if fault.stage == "convert" and fault.what in ("damaged", "missing") and fault.file.name != METADATA:
            movies.setdefault(fault.store, []).append(fault)
    for movie, faults in movies.items():
        step = metadata.attributes(movie)["frames_per_shard"]
        shards = {fault.frames[0] // step for fault in faults if fault.frames and _is_shard(movie, fault.file)}
        with sole_use(movie.parent / ".lock", "another run works in this folder"):
            remake(
                movie, shards, everything=not all(_is_shard(movie, fault.file) for fault in faults), on_event=on_event
            )
    return tuple(movies)


def _is_shard(movie: Path, file: Path) -> bool:
    """Tell whether a file holds pixels of frames, not statistics or coordinates."""
    return file.relative_to(movie).parts[0] in ("0", "binned")


def _verify_store(store: Path, on_event: Sink) -> Verified:
    """Check one store."""
    began = perf_counter()
    stage = _STAGES.get(store.stem, store.stem)
    try:
        about = metadata.attributes(store)
        names = metadata.nodes(store)
    except StoreError as error:
        return Verified((_fault(error, store / METADATA, store, stage),), 1, (), ())
    stage = _STAGES.get(str(about.get("kind")), str(about.get("kind", stage)))
    faults: list[Fault] = []
    arrays: list[_Array] = []
    if about.get(CHANGING):
        why = "its pixel size or frame time is being changed, or that was cut off"
        faults.append(Fault(store / METADATA, store, stage, "damaged", why, help="Run the same command again"))
        names = [name for name in names if name not in AXES]
    for name in names:
        try:
            arrays += _Array.of(store, name, about)
        except StoreError as error:
            faults.append(_fault(error, store / name / METADATA, store, stage))
    complete = bool(about.get("complete", True)) and metadata.format_of(about) >= metadata.FORMAT
    files = [(array, *item) for array in arrays for item in array.files(whole=complete)]
    timed = [array for array in arrays if array.in_frames]
    on_event(StageStarted(store.name, sum(array.shape[0] for array in timed), passes=max(1, len(timed))))

    def look(item: tuple[_Array, Path, _Place]) -> tuple[tuple[int, int] | None, Fault | None]:
        array, file, place = item
        frames = array.frames(place)
        return frames, _look(array, file, place, Fault(file, store, stage, "", "", frames))

    with ThreadPoolExecutor(_AT_ONCE, "verify") as pool:
        for frames, fault in pool.map(look, files):
            if frames:
                on_event(ShardDone(store.name, 0, frames[1] - frames[0]))
            faults += [fault] if fault else []
    if stage == "fit" and not about.get("complete"):
        faults += _damaged_parts(store, str(about.get("key")))
    bad = sum(fault.what != "left over" for fault in faults)
    on_event(StageDone(store.name, perf_counter() - began, summary=f"{bad} faults" if bad else "sound"))
    unfinished = () if about.get("complete", True) else (store,)
    plain = (store,) if metadata.format_of(about) < metadata.FORMAT else ()
    return Verified(tuple(faults), len(names) + 1 + len(files), unfinished, plain)


def _damaged_parts(store: Path, key: str) -> list[Fault]:
    """Check what is fitted of results that are not complete."""
    journal = Journal.existing(journal_beside(store), key)
    if journal is None:
        return []
    n_frames, step, _ = layout(store)
    parts, faults = Parts.of(journal, n_frames, step), []
    for index in sorted({index for index, _ in entries(journal.folder) if index < len(parts.done)}):
        frames = (index * step, min(n_frames, (index + 1) * step))
        if not parts.done[index]:
            why = "not as its line in the journal says"
            faults.append(Fault(journal.path, store, "fit", "damaged", why, frames))
            continue
        fault = Fault(parts.file(index), store, "fit", "damaged", "", frames)
        try:
            for name in parts.names(index):
                parts.stored(index, name)
        except OSError as error:
            faults.append(dataclasses.replace(fault, what="unreadable", why=error.strerror or str(error)))
        except ValueError as error:
            faults.append(dataclasses.replace(fault, why=str(error)))
    return faults


def _fault(error: StoreError, file: Path, store: Path, stage: str) -> Fault:
    what = "unreadable" if isinstance(error.__cause__, OSError) else "damaged" if file.exists() else "missing"
    return Fault(file, store, stage, what, error.got or error.what)


def _look(array: _Array, file: Path, place: _Place, fault: Fault) -> Fault | None:
    """Read a file and check it; return what is wrong."""
    if place is None:
        return dataclasses.replace(fault, what="left over", why="no part of the store")
    try:
        array.check(file, place)
    except FileNotFoundError:
        return dataclasses.replace(fault, what="missing", why="no such file")
    except OSError as error:
        return dataclasses.replace(fault, what="unreadable", why=error.strerror or str(error))
    except ValueError as error:
        return dataclasses.replace(fault, what="damaged", why=str(error))
    return None


@dataclass(frozen=True)
class _Array:
    """How an array lies on disk.

    Attributes
    ----------
    chunk
        What a file holds.
    tile
        What in it has a checksum of its own; None where the file is one.
    checked
        Whether there are checksums.
    key
        Of the store; None where its shard files have no marks.
    chunks
        Checksums that the store knows of chunks without marks, by their files.
    """

    path: Path
    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    tile: tuple[int, ...] | None
    separator: str
    checked: bool
    in_frames: bool
    name: str
    key: str | None
    chunks: Mapping[str, int]

    @classmethod
    def of(cls, store: Path, name: str, said: Mapping[str, Any]) -> list[_Array]:
        """Read the metadata of an array, which are checked; none of a group. ``said`` is what the store says."""
        about = metadata.read_node(store, name)
        if about.get("node_type") != "array":
            return []
        codecs = {codec["name"]: codec.get("configuration", {}) for codec in about["codecs"]}
        sharding = codecs.get("sharding_indexed")
        inner = sharding["codecs"] if sharding else about["codecs"]
        axes = about.get("dimension_names") or [None]
        settled = said.get("complete", True) or said.get("kind") != "movie"  # else coordinates may be half written
        found = cls(
            store / name,
            tuple(about["shape"]),
            tuple(about["chunk_grid"]["configuration"]["chunk_shape"]),
            tuple(sharding["chunk_shape"]) if sharding else None,
            about["chunk_key_encoding"].get("configuration", {}).get("separator", "/"),
            any(codec["name"] == "crc32c" for codec in inner),
            bool(axes) and axes[0] in FRAME_AXES,
            name,
            str(said.get("key")) if said.get(MARKED) else None,
            said.get(metadata.CHUNKS, {}) if settled else {},
        )
        return [found]

    def frames(self, place: _Place) -> tuple[int, int] | None:
        """Return the first frame in a file and the one behind its last."""
        if not self.in_frames or place is None:
            return None
        return place[0] * self.chunk[0], min(self.shape[0], (place[0] + 1) * self.chunk[0])

    def files(self, *, whole: bool) -> Iterator[tuple[Path, _Place]]:
        """Yield the files, and which chunk each holds; None for one that is left over.

        ``whole`` also yields those that have to be there and are not.
        """
        counts = [-(-length // side) for length, side in zip(self.shape, self.chunk, strict=True)]
        names = {
            self.separator.join(["c", *map(str, place)]): place for place in itertools.product(*map(range, counts))
        }
        there = set(_files_under(self.path)) - {METADATA}
        for name in sorted(there | (names.keys() if whole else set()), key=lambda name: names.get(name, ())):
            yield self.path / name, names.get(name)

    def check(self, file: Path, place: tuple[int, ...]) -> None:
        """Read the file of a chunk.

        Raises
        ------
        OSError
            Where it cannot be read.
        ValueError
            Where it is damaged, or a part of it is missing.
        """
        with file.open("rb", buffering=0) as opened:
            if self.tile is not None:
                self._check_tiles(opened.fileno(), place)
            elif self.checked:
                unchecked(data := memoryview(opened.read()))
                if self.chunks.get(f"{self.name}/{file.name}", trailing(data)) != trailing(data):
                    raise ValueError(ELSEWHERE)

    def _check_tiles(self, handle: int, place: tuple[int, ...]) -> None:
        sides = self.tile or self.chunk
        tiles = [side // part for side, part in zip(self.chunk, sides, strict=True)]
        mark = mark_of(self.key, self.name, place[0]) if self.key else b""
        index = read_index(handle, tuple(tiles), mark)
        for tile in np.ndindex(*tiles):
            first = [p * side + t * part for p, side, t, part in zip(place, self.chunk, tile, sides, strict=True)]
            if all(at < length for at, length in zip(first, self.shape, strict=True)):
                self._check_tile(handle, tile, *index[tile].tolist())

    def _check_tile(self, handle: int, tile: tuple[int, ...], offset: int, length: int) -> None:
        if offset == ABSENT:
            raise ValueError(f"tile {tile} is missing")
        data = os.pread(handle, length, offset)
        try:
            if self.checked:
                unchecked(memoryview(data))
        except ValueError as error:
            raise ValueError(f"tile {tile} is damaged: {error}") from error


def _files_under(folder: Path) -> Iterator[str]:
    """Yield the names of all files in a folder and below, from it."""
    for place, _, names in os.walk(folder):
        inside = Path(place).relative_to(folder)
        yield from ((inside / name).as_posix() for name in names)
