"""Shards of work that were done, and those that are missing."""

from __future__ import annotations

import pytest

from tract_dask.cluster.tasks import run_shards
from tract_dask.errors import StoreError
from tract_dask.store.journal import Journal
from tract_dask.store.shards import split


def test_run_shards_does_only_what_is_missing(tmp_path):
    journal = Journal(tmp_path / "j", "key")
    shards = split(10, 3)
    journal.record(shards[1], {"n": -1})
    ran = []
    payloads = run_shards(
        lambda shard: {"n": shard.index},
        shards,
        journal=journal,
        name="count",
        on_done=lambda shard, payload: ran.append((shard.index, payload["n"])),
    )
    assert ran == [(0, 0), (2, 2), (3, 3)]
    assert {k: p["n"] for k, p in payloads.items()} == {0: 0, 1: -1, 2: 2, 3: 3}


def test_an_error_in_a_task_keeps_what_is_done(tmp_path):
    journal = Journal(tmp_path / "j", "key")

    def task(shard):
        if shard.index == 2:
            raise StoreError("no")
        return {}

    with pytest.raises(StoreError):
        run_shards(task, split(10, 3), journal=journal, name="fail")
    assert sorted(journal.done()) == [0, 1]
