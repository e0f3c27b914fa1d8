"""A stage that runs over the movie once or more often: its journals, its events, and the arrays its tasks leave."""

from __future__ import annotations

import io
import os
import tempfile
import uuid
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from distributed import Client
from numpy.typing import NDArray

from . import disk
from .errors import StoreError
from .journal import Fields, Journal, Payload
from .movie import Movie
from .progress import ShardDone, Sink, StageDone, StageStarted
from .shard_files import CHECKSUM_BYTES, crc32c, unchecked
from .shards import Shard
from .stores import disk_errors, sole_parser
from .tasks import run_shards

_HEAD_BYTES = 1 << 16
"""The head of a .npy file, at most."""


class DamagedArrayError(StoreError):
    """What a task left is damaged or gone: its shard is no longer done, and the same stage again makes it anew."""


class Passes:
    """The journals and events of one stage that runs over the movie once or more often."""

    def __init__(
        self, name: str, movie: Movie, on_event: Sink, folder: Path | None, client: Client | None, runs: int
    ) -> None:
        self.name, self.movie, self.on_event, self.client, self.runs = name, movie, on_event, client, runs
        self._folder, self._stack, self._started, self._computed = folder, ExitStack(), perf_counter(), False

    def __enter__(self) -> Passes:
        if self._folder is None:
            self._folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="tract_dask-")))
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def journal(self, name: str, key: str, fields: Fields) -> Journal:
        """Return the journal of one of the stage's runs, whose payloads hold ``fields``."""
        assert self._folder is not None
        return Journal(self._folder / name, key, fields)

    def begin(self, runs: list[tuple[Journal, Sequence[Shard]]]) -> None:
        """Tell that the stage begins, and how much of it is done."""
        done = sum(journal.frames_done(shards) for journal, shards in runs)
        self.on_event(
            StageStarted(self.name, self.runs * self.movie.n_frames, done, 0, self.movie.frame_bytes, self.runs)
        )

    def run(self, task: Any, shards: Sequence[Shard], journal: Journal) -> dict[int, Payload]:
        """Run the task on the shards that are not done; return the payloads of all."""

        def tell(shard: Shard, payload: Payload) -> None:
            self._computed = True
            self.on_event(ShardDone(self.name, shard.index, shard.frames))

        return run_shards(
            task,
            shards,
            journal=journal,
            name=self.name,
            client=self.client,
            on_done=tell,
            file=str(self.movie.path),
            on_event=self.on_event,
        )

    def end(self, summary: str) -> None:
        """Tell that the stage is done."""
        self.on_event(StageDone(self.name, perf_counter() - self._started, not self._computed, summary))


def save_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array as .npy, and behind it a checksum of all: beside its place first, then synced and renamed."""
    pixels: Any = np.asarray(array, order="C")
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(pixels))
    checksum = crc32c(pixels, crc32c(head.getbuffer())).to_bytes(CHECKSUM_BYTES, "little")
    aside = path.with_name(f"{path.stem}.{uuid.uuid4().hex}.partial")
    with disk_errors(path):
        try:
            with aside.open("wb") as file:
                file.writelines((head.getbuffer(), pixels.reshape(-1).view(np.uint8), checksum))
            disk.place(aside, path)
        except BaseException:
            aside.unlink(missing_ok=True)
            raise


def load_saved(path: Path) -> NDArray[Any]:
    """Return what :func:`save_array` wrote.

    Raises
    ------
    DamagedArrayError
        Where it is missing, or damaged; it is then removed, so that no journal takes it for done.
    """
    try:
        with path.open("rb") as file:
            stored: Any = np.empty(os.fstat(file.fileno()).st_size, np.uint8)
            data = unchecked(memoryview(stored)[: file.readinto(stored)])
    except (FileNotFoundError, ValueError) as error:
        with suppress(OSError):
            path.unlink(missing_ok=True)
        raise DamagedArrayError(
            "what a task of this stage left is missing, or damaged",
            str(path),
            "an array with its checksum",
            str(error),
            "Run the same command again: it is made anew",
        ) from error
    head = io.BytesIO(data[:_HEAD_BYTES])
    np.lib.format.read_magic(head)
    with sole_parser():
        shape, _, dtype = np.lib.format.read_array_header_1_0(head)
    array: NDArray[Any] = np.frombuffer(data, dtype, offset=head.tell()).reshape(shape)
    return array
