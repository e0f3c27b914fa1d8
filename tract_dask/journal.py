"""The record of finished shards: the journal is the truth.

A task writes its shard, then its entry in the journal; whoever runs the same stage again reads the journal and does the
rest. A task may run twice: it writes the same bytes.
"""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from .shards import Shard
from .stores import disk_errors, json_ready, remove, write_aside

_PROCESS = uuid.uuid4().hex[:12]
"""Tells this process from all others, also from those on other machines."""

Payload: TypeAlias = dict[str, Any]
"""What a task leaves in the journal: small, JSON-ready."""


def journal_beside(path: Path) -> Path:
    """Return the folder of the journal of the store at ``path``, which is there while the store is unfinished."""
    return path.with_name(f"{path.name}.journal")


def entries(folder: Path) -> Iterator[tuple[int, Payload]]:
    """Yield index and payload of every entry in the journal at ``folder``; a shard that ran twice comes twice.

    The last line of a process that was killed may be torn; it is no entry.
    """
    for file in sorted(folder.glob("*.jsonl")):
        with file.open("rb") as lines:
            for line in lines:
                try:
                    index, payload = json.loads(line)
                except ValueError:
                    continue
                yield index, payload


class Journal:
    """The record of finished shards of one stage: a folder with one file a process, to which it adds a line a shard.

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
        line = json.dumps([shard.index, json_ready(payload)]).encode()
        file = self.path / f"{os.getpid()}-{_PROCESS}.jsonl"
        with disk_errors(file), file.open("ab") as log:
            log.write(b"\n" + line + b"\n")  # the line before may be torn, by a disk that was full

    def done(self) -> dict[int, Payload]:
        """Return the payloads of the finished shards by index."""
        return dict(entries(self.path))

    def frames_done(self, shards: Sequence[Shard]) -> int:
        """Return how many frames the finished ones of ``shards`` hold."""
        return sum(shards[index].frames for index in {index for index, _ in entries(self.path)})

    def remove(self) -> None:
        """Delete the journal, once the store itself says that it is complete."""
        remove(self.path)
