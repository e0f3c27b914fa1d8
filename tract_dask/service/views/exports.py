"""Downloads: a store as a zipped Zarr, streamed; other formats as files that are made once and kept for a while."""

from __future__ import annotations

import asyncio
import os
import time
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from ...export.tables import export
from ...store.parts import EVERY
from ...store.results import growing_files
from ..process_pool import ProcessPool
from .tracks import open_finished

FORMATS = {"zarr": "application/zip", "nc": "application/x-netcdf", "csv": "text/csv; charset=utf-8"}
"""What tracks can be downloaded as, and its media type."""

_PIECE = 1 << 20
_KEPT_S = 3600.0
_KEPT_BYTES = 20 << 30


class Exports:
    """Files in other formats: each made once for the same results, in the process pool, and deleted later.

    Parameters
    ----------
    folder
        Where they are; made when it is needed.
    """

    def __init__(self, folder: Path, pool: ProcessPool) -> None:
        self._folder, self._pool = folder, pool
        self._coming: dict[Path, asyncio.Task[None]] = {}

    def place(self, results: Path, version: str, suffix: str) -> Path:
        """Return where the file is, or will be."""
        return self._folder / f"{results.parent.name}-{version}.{suffix}"

    async def made(self, results: Path, version: str, suffix: str, wait_s: float | None = None) -> Path | None:
        """Return the file, made if it is not there; None where it is not ready after ``wait_s``, and goes on.

        Raises
        ------
        TractError
            Where it cannot be made.
        """
        place = self.place(results, version, suffix)
        if place.is_file():
            os.utime(place)
            return place
        task = self._coming.get(place)
        if task is None:
            self._folder.mkdir(parents=True, exist_ok=True)
            _tidy(self._folder)
            task = asyncio.create_task(self._pool.run_long(write_file, results, place, about=results))
            self._coming[place] = task
            task.add_done_callback(lambda _: self._coming.pop(place))
        done, _ = await asyncio.wait({task}, timeout=wait_s)
        if not done:
            return None
        task.result()
        return place


def write_file(results: Path, place: Path) -> None:
    """Write the finished shards of a store in the format that the suffix of ``place`` names."""
    export(open_finished(results), place, overwrite=True)


def zipped(results: Path) -> Iterator[bytes]:
    """Yield a store as a zip file, not compressed once more, piece by piece; of an unfinished one, its finished shards.

    ``zarr.storage.ZipStore`` opens it.
    """
    sink = _Sink()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:
        for entry, pieces in _contents(results):
            with archive.open(entry, "w") as target:
                for piece in pieces:
                    target.write(piece)
                    yield sink.taken()
    yield sink.taken()


def _contents(results: Path) -> Iterator[tuple[zipfile.ZipInfo, Iterator[bytes]]]:
    """Yield the files of a store and their bytes; of an unfinished one, those that its finished shards would make."""
    growing = growing_files(results)
    for path in sorted(results.rglob("*")):
        inside = path.relative_to(results)
        hidden = any(part.startswith(".") for part in inside.parts)
        if path.is_file() and not hidden and not (growing and path.name.startswith("c.") and path.parent.name in EVERY):
            yield _entry(path, inside.as_posix()), _pieces(path)
    for path, pieces in growing or ():
        yield _entry(results / "zarr.json", path.relative_to(results).as_posix()), pieces


def _pieces(path: Path) -> Iterator[bytes]:
    with path.open("rb") as source:
        while piece := source.read(_PIECE):
            yield piece


def _entry(path: Path, inside: str) -> zipfile.ZipInfo:
    written = time.gmtime(max(path.stat().st_mtime, 315532800.0))  # zip knows no time before 1980
    return zipfile.ZipInfo(inside, written[:6])


class _Sink:
    """What is written to it can be taken away, so that a zip file is never in memory as a whole."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def write(self, data: bytes, /) -> int:
        self._pieces.append(bytes(data))
        return len(data)

    def flush(self) -> None:
        pass

    def close(self) -> None:
        pass

    def taken(self) -> bytes:
        data, self._pieces = b"".join(self._pieces), []
        return data


def _tidy(folder: Path) -> None:
    """Delete files that nobody has asked for in the last hour, and the oldest while all are too large."""
    files = sorted((file for file in folder.iterdir() if file.is_file()), key=lambda file: file.stat().st_mtime)
    total = sum(file.stat().st_size for file in files)
    for file in files:
        status = file.stat()
        if time.time() - status.st_mtime > _KEPT_S or total > _KEPT_BYTES:
            with suppress(OSError):
                file.unlink()
            total -= status.st_size
