"""The unit of work, the journal, and the loop that keeps workers busy, on a cluster."""

from __future__ import annotations

import threading
import time
from functools import partial
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import pytest
from distributed import Client, LocalCluster
from hypothesis import given
from hypothesis import strategies as st

from tract_dask.cluster import batch as cluster_batch
from tract_dask.cluster import crew, dispatch, tasks
from tract_dask.cluster.tasks import run_shards, stream_shards
from tract_dask.errors import ClusterError, StoreError
from tract_dask.store.journal import Journal
from tract_dask.store.shards import Shard, split


@pytest.fixture
def cluster():
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0") as local:
        yield local


def count(shard: Shard) -> dict[str, int]:
    return {"frames": shard.frames}


def note(folder: Path, shard: Shard) -> dict[str, int]:
    with (folder / "ran").open("a") as file:
        file.write(f"{shard.index}\n")
    return {}


def fail_at_three(shard: Shard) -> dict[str, int]:
    if shard.index == 3:
        raise StoreError("the third shard is damaged")
    return {}


def wait_long(shard: Shard) -> dict[str, int]:
    time.sleep(0.2)
    return {}


@given(st.integers(1, 300), st.integers(1, 40))
def test_shards_are_a_sequence_that_is_made_as_it_is_read(n_frames, per_shard):
    found = split(n_frames, per_shard)
    assert list(found) == [found[k] for k in range(len(found))]
    assert found[-1].stop == n_frames
    assert found[1:] == tuple(found)[1:]
    with pytest.raises(IndexError):
        found[len(found)]


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


def test_thousands_of_small_shards_each_run_once(cluster, tmp_path):
    journal, taken = Journal(tmp_path / "journal", "key"), []
    journal.record(Shard(7, 7, 8), {})
    with Client(cluster) as client:
        stream_shards(
            partial(note, tmp_path),
            split(5000, 1),
            lambda shard, _: taken.append(shard.index),
            journal=journal,
            name="note",
            client=client,
        )
    assert taken[0] == 7
    assert sorted(taken) == list(range(5000))
    assert sorted(map(int, (tmp_path / "ran").read_text().split())) == [k for k in range(5000) if k != 7]


def test_a_batch_ends_when_its_time_is_up(tmp_path, monkeypatch):
    monkeypatch.setattr(tasks, "BATCH_S", 0.3)
    journal = Journal(tmp_path / "journal", "key")
    payloads, seconds = tasks._work(wait_long, split(100, 1), journal, np.arange(4, 90))
    assert sorted(journal.done()) == list(range(4, 4 + len(payloads)))
    assert 0 < len(payloads) <= 2
    assert seconds > 0.3


def test_what_a_batch_leaves_comes_first_again():
    queue = cluster_batch.Todo(np.arange(10))
    batch = queue.take(6)
    queue.give_back(batch[2:])
    assert queue.left == 8
    assert queue.take(3).tolist() == [2, 3, 4]
    assert queue.take(3).tolist() == [5]
    assert queue.take(9).tolist() == [6, 7, 8, 9]
    assert queue.left == 0


def test_the_torn_line_of_a_killed_process_is_no_entry(tmp_path):
    journal = Journal(tmp_path / "journal", "key")
    journal.record(Shard(0, 0, 4), {"fits": 1})
    (file,) = journal.path.glob("*.jsonl")
    with file.open("ab") as log:
        log.write(b'\n[1, {"fi')
    journal.record(Shard(2, 8, 10), {"fits": 3})
    journal.record(Shard(2, 8, 10), {"fits": 3})
    assert journal.done() == {0: {"fits": 1}, 2: {"fits": 3}}
    assert journal.frames_done(split(10, 4)) == 6


def test_the_error_of_a_task_is_the_error_of_the_stage(cluster, tmp_path):
    journal = Journal(tmp_path / "journal", "key")
    with Client(cluster) as client, pytest.raises(StoreError, match="third shard"):
        run_shards(fail_at_three, split(100, 3), journal=journal, name="fail", client=client)
    assert 3 not in journal.done()


def test_whoever_takes_the_payloads_may_stop_the_work(cluster, tmp_path):
    journal = Journal(tmp_path / "journal", "key")

    def stop(shard, payload):
        raise KeyboardInterrupt

    with Client(cluster) as client, pytest.raises(KeyboardInterrupt):
        stream_shards(wait_long, split(100, 1), stop, journal=journal, name="wait", client=client)
    assert 0 < len(journal.done()) < 100


def test_a_cluster_that_loses_all_its_workers_is_given_up(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(crew, "PATIENCE_S", 1.0)
    journal = Journal(tmp_path / "journal", "key")

    def leave():
        while not journal.done():
            time.sleep(0.02)
        cluster.scale(0)

    threading.Thread(target=leave, daemon=True).start()
    with Client(cluster) as client, pytest.raises(ClusterError, match="without a worker"):
        run_shards(wait_long, split(1000, 1), journal=journal, name="wait", client=client)
    assert 0 < len(journal.done()) < 1000


def test_a_result_that_its_worker_took_along_is_not_waited_for(cluster, tmp_path, monkeypatch):
    class Leaving(SimpleQueue):
        def get(self, *args, **kwargs):
            future = super().get(*args, **kwargs)
            cluster.scale(0)
            while future.client.nthreads():
                time.sleep(0.01)
            return future

    monkeypatch.setattr(crew, "PATIENCE_S", 1.0)
    monkeypatch.setattr(dispatch, "SimpleQueue", Leaving)
    with Client(cluster) as client, pytest.raises(ClusterError, match="without a worker"):
        run_shards(wait_long, split(10, 1), journal=Journal(tmp_path / "journal", "key"), name="wait", client=client)
