"""The unit of work: runs of frames, the journal of those that are done, and the loop that keeps workers busy.

The journal is the truth. A task writes its shard, then its entry in the journal (aside, then renamed); whoever runs
the same stage again reads the journal and does the rest. A task may run twice: it writes the same bytes.
"""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from threading import Event, Thread
from time import monotonic
from typing import Any, TypeAlias

from distributed import Client, as_completed
from distributed.scheduler import KilledWorker

from .errors import ClusterError
from .stores import json_ready, remove, write_aside

_PATIENCE_S = 60.0

Payload: TypeAlias = dict[str, Any]
"""What a task leaves in the journal: small, JSON-ready."""


@dataclass(frozen=True)
class Shard:
    """A run of frames, ``start`` to ``stop`` (not included); number ``index`` of the movie."""

    index: int
    start: int
    stop: int

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.stop - self.start


def split(n_frames: int, frames_per_shard: int) -> tuple[Shard, ...]:
    """Return the shards of a movie: every frame in exactly one, in order.

    Examples
    --------
    >>> [shard.frames for shard in split(10, 4)]
    [4, 4, 2]
    """
    starts = range(0, n_frames, frames_per_shard)
    return tuple(Shard(k, start, min(start + frames_per_shard, n_frames)) for k, start in enumerate(starts))


def journal_beside(path: Path) -> Path:
    """Return the folder of the journal of the store at ``path``, which is there while the store is unfinished."""
    return path.with_name(f"{path.name}.journal")


class Journal:
    """The record of finished shards of one stage: a folder with one small file a shard.

    Parameters
    ----------
    path
        The folder; made at the first entry.
    key
        Key of the stage (:func:`tract_dask.provenance.stage_key`). Entries made under another key are thrown away.
    """

    def __init__(self, path: Path, key: str) -> None:
        self.path, self.key = path, key
        key_file = path / "key"
        if not key_file.exists() or key_file.read_text(encoding="utf-8") != key:
            remove(path)
            path.mkdir(parents=True)
            write_aside(key_file, key.encode())

    def record(self, shard: Shard, payload: Payload) -> None:
        """Note that ``shard`` is done, with what its task returned."""
        write_aside(self.path / f"{shard.index}.json", json.dumps(json_ready(payload)).encode())

    def done(self) -> dict[int, Payload]:
        """Return the payloads of the finished shards by index."""
        return {int(file.stem): json.loads(file.read_bytes()) for file in self.path.glob("[0-9]*.json")}

    def remove(self) -> None:
        """Delete the journal, once the store itself says that it is complete."""
        remove(self.path)


def run_shards(
    task: Callable[[Shard], Payload],
    shards: Sequence[Shard],
    *,
    journal: Journal,
    name: str,
    client: Client | None = None,
    on_done: Callable[[Shard, Payload], None] = lambda shard, payload: None,
) -> dict[int, Payload]:
    """Run ``task`` on every shard that the journal does not know, and return the payloads of all.

    Parameters
    ----------
    task
        Takes a shard, writes its result, returns its payload. Pass paths to it, not data.
    client
        The cluster to run on; None runs in this process.
    name
        Stage name, shown on the dashboard.
    on_done
        Called with each shard that this call finished, as it comes.

    Raises
    ------
    TractError
        The first error of a task; finished shards stay in the journal.
    ClusterError
        Where workers die under a task again and again.
    """
    payloads = journal.done()
    todo = [shard for shard in shards if shard.index not in payloads]
    work = partial(_run_one, task, journal)
    for shard, payload in _run_here(work, todo) if client is None else _run_on(client, work, todo, name):
        payloads[shard.index] = payload
        on_done(shard, payload)
    return payloads


def _run_one(task: Callable[[Shard], Payload], journal: Journal, shard: Shard) -> Payload:
    payload = task(shard)
    journal.record(shard, payload)
    return payload


def _run_here(work: Callable[[Shard], Payload], todo: Iterable[Shard]) -> Iterable[tuple[Shard, Payload]]:
    for shard in todo:
        yield shard, work(shard)


def _run_on(
    client: Client, work: Callable[[Shard], Payload], todo: Sequence[Shard], name: str
) -> Iterable[tuple[Shard, Payload]]:
    """Keep a bounded window of futures in flight, so that neither driver nor scheduler grows with the movie."""
    threads = max(1, sum(client.nthreads().values()))
    token = uuid.uuid4().hex
    waiting = iter(todo)
    running: dict[Any, Shard] = {}

    def submit(shard: Shard) -> Any:
        future = client.submit(work, shard, key=(f"{name}-{token}", shard.index), pure=False)
        running[future] = shard
        return future

    completed = as_completed([submit(shard) for shard in islice(waiting, 4 * threads + 4)])
    ended = Event()
    Thread(target=_watch, args=(client, running, ended), daemon=True).start()
    try:
        for future in completed:
            shard = running.pop(future)
            with _cluster_errors(client, name, shard):
                payload = future.result()
            for following in islice(waiting, 1):
                completed.add(submit(following))
            yield shard, payload
    finally:
        ended.set()
        if running and client.status == "running":
            client.cancel(list(running), force=True)


def _watch(client: Client, running: dict[Any, Shard], ended: Event) -> None:
    """Cancel what is running once the cluster has had no worker for a minute: nobody would ever finish it."""
    alone_since = monotonic()
    while not ended.wait(1.0):
        if client.status != "running":
            return
        if client.nthreads():
            alone_since = monotonic()
        elif monotonic() - alone_since > _PATIENCE_S:
            client.cancel(list(running), force=True)
            return


@contextmanager
def _cluster_errors(client: Client, name: str, shard: Shard) -> Iterator[None]:
    """Turn what the cluster says of a lost task into a ClusterError."""
    try:
        yield
    except KilledWorker as error:
        raise ClusterError(
            f"workers died again and again under frames {shard.start} to {shard.stop - 1} in stage {name}",
            str(error.last_worker.address),
            remedy="Give them more memory (--memory-limit) or make shards smaller (--shard-mb), and run again",
        ) from error
    except CancelledError as error:
        raise ClusterError(
            f"stage {name} was left without a worker or a scheduler",
            "the cluster",
            remedy="See the workers' logs, start the cluster anew, and run again: what is done is kept",
        ) from error
