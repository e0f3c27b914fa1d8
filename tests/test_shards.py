"""The loop that keeps workers busy, on a cluster."""

from __future__ import annotations

import threading
import time

import pytest
from distributed import Client, LocalCluster

from tract_dask import shards
from tract_dask.errors import ClusterError, StoreError
from tract_dask.shards import Journal, Shard, run_shards, split


@pytest.fixture
def cluster():
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0") as local:
        yield local


def count(shard: Shard) -> dict[str, int]:
    return {"frames": shard.frames}


def fail_at_three(shard: Shard) -> dict[str, int]:
    if shard.index == 3:
        raise StoreError("the third shard is damaged")
    return {}


def wait_long(shard: Shard) -> dict[str, int]:
    time.sleep(0.2)
    return {}


def test_every_shard_runs_once_and_is_recorded(cluster, tmp_path):
    journal = Journal(tmp_path / "journal", "key")
    seen = []
    with Client(cluster) as client:
        payloads = run_shards(
            count,
            split(100, 3),
            journal=journal,
            name="count",
            client=client,
            on_done=lambda shard, _: seen.append(shard.index),
        )
    assert sorted(seen) == sorted(payloads) == list(range(34))
    assert sum(payload["frames"] for payload in journal.done().values()) == 100


def test_the_error_of_a_task_is_the_error_of_the_stage(cluster, tmp_path):
    journal = Journal(tmp_path / "journal", "key")
    with Client(cluster) as client, pytest.raises(StoreError, match="third shard"):
        run_shards(fail_at_three, split(100, 3), journal=journal, name="fail", client=client)
    assert 3 not in journal.done()


def test_a_cluster_that_loses_all_its_workers_is_given_up(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "_PATIENCE_S", 1.0)
    journal = Journal(tmp_path / "journal", "key")
    threading.Timer(0.5, cluster.scale, args=(0,)).start()
    with Client(cluster) as client, pytest.raises(ClusterError, match="without a worker"):
        run_shards(wait_long, split(1000, 1), journal=journal, name="wait", client=client)
    assert 0 < len(journal.done()) < 1000
