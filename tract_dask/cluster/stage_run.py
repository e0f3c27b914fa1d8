"""A stage that runs over the movie once or more often: its journals, its events, and the arrays its tasks leave."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter
from typing import Any

from distributed import Client

from ..progress import ShardDone, Sink, StageDone, StageStarted
from ..store.journal import Fields, Journal, Payload
from ..store.movie import Movie
from ..store.shards import Shard
from .tasks import run_shards


class StageRun:
    """The journals and events of one stage that runs over the movie once or more often."""

    def __init__(
        self, name: str, movie: Movie, on_event: Sink, folder: Path | None, client: Client | None, runs: int
    ) -> None:
        self.name, self.movie, self.on_event, self.client, self.runs = name, movie, on_event, client, runs
        self._folder, self._stack, self._started, self._computed = folder, ExitStack(), perf_counter(), False

    def __enter__(self) -> StageRun:
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
