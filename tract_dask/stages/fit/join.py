"""Join the fits of shards into the files of the results."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from distributed import Client

from ...cluster.tasks import stream_shards
from ...progress import Sink, silent
from ...store import disk, schema
from ...store.files import disk_errors
from ...store.journal import Journal, Payload
from ...store.parts import AGAIN, DamagedPartError, Parts, checked, file_place, joined, layout, piece, sharded
from ...store.shard_files import chunk_path
from ...store.shards import Shard, split
from .crystal import CHANGED, Crystal

_AT_ONCE = 4
"""So many files a variable are joined in this process; more are work for the cluster."""


@dataclass(frozen=True)
class _Joining:
    """What every task needs that joins parts: paths and sizes, no data."""

    path: Path
    journal: Journal
    aside: Path
    n_frames: int
    step: int
    per_file: int
    attempt: int
    crystal: Crystal | None
    """How positions are put right; None where they stay as they were fitted."""


def join(
    path: Path,
    journal: Journal,
    client: Client | None = None,
    on_event: Sink = silent,
    attempt: int = 0,
    crystal: Crystal | None = None,
) -> None:
    """Join the parts of all shards into the files of the store at ``path``.

    It has a journal of its own, inside that of the fits: what an earlier call has joined is kept.

    Parameters
    ----------
    attempt
        Number of the call: workers remember where the parts are, for one call.
    crystal
        How positions are put right; None where they stay as they were fitted.

    Raises
    ------
    DamagedPartError
        Where parts are damaged: fit their shards again, then call this again.
    """
    n_frames, step, per_file = layout(path)
    files = split(n_frames, step * per_file)
    own = Journal(journal.path / "files", journal.key)
    job = _Joining(path, journal, own.path, n_frames, step, per_file, attempt, crystal)
    if len(files) <= _AT_ONCE:
        client = None
    try:
        stream_shards(
            partial(_join_task, job),
            files,
            _nothing,
            journal=own,
            name="fit",
            client=client,
            file=str(path),
            on_event=on_event,
        )
    except DamagedPartError:
        Parts.of(journal, n_frames, step).strike_damaged()
        raise


def _nothing(file: Shard, payload: Payload) -> None:
    pass


def _join_task(job: _Joining, file: Shard) -> Payload:
    """Join the parts of some shards into one file a variable."""
    parts = _load_parts(job.journal, job.n_frames, job.step, job.attempt)
    shards = range(file.start // job.step, -(-file.stop // job.step))
    if not parts.done[shards].all():
        raise DamagedPartError("the fits of some shards are no longer on disk", str(parts.run), remedy=AGAIN)
    changed = _put_right(job, parts, shards)
    with disk_errors(job.path), ExitStack() as stack:
        for name in sharded(job.path):
            place = disk.new_place(job.aside)
            stack.callback(place.unlink, missing_ok=True)
            with place.open("wb") as target:
                target.writelines(joined(parts, job.journal.key, name, shards, job.per_file, changed.get(name, {})))
            disk.place(place, chunk_path(job.path / name, file.index, *file_place(name)))
        stack.pop_all()
    return {}


def _put_right(job: _Joining, parts: Parts, shards: range) -> dict[str, dict[int, bytes]]:
    """Return the pieces of some shards with which positions are put right, by variable and shard; none where none is.

    Raises
    ------
    DamagedPartError
        Where parts are damaged.
    """
    changed: dict[str, dict[int, bytes]] = {}
    if job.crystal is None:
        return changed
    sizes = schema.SIZES | {"column_id": len(job.crystal.reference)}
    for shard in shards:
        frames, values = min(job.step, job.n_frames - shard * job.step), {}
        for name in CHANGED:
            checked(parts, shard, name)
            variable = schema.RESULTS[name]
            whole = np.empty((job.step, *(sizes[dim] for dim in variable.dims[1:])), variable.dtype)
            parts.read(shard, name, whole)
            values[name] = whole[:frames]
        for name, array in job.crystal.put_right(values).items():
            changed.setdefault(name, {})[shard] = piece(name, array, job.step)
    return changed


@lru_cache(maxsize=2)
def _load_parts(journal: Journal, n_frames: int, step: int, attempt: int) -> Parts:
    return Parts.of(journal, n_frames, step)
