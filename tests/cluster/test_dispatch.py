"""Machines that fail: errors that pass or do not, workers that die, and workers that hang."""

from __future__ import annotations

import errno
import os
import signal
import time
from functools import partial
from pathlib import Path

import dask
import numpy as np
import pytest
from distributed import Client, LocalCluster, get_worker

from tract_dask.cluster import batch, crew, deaths, dispatch, retries
from tract_dask.cluster.connect import connect
from tract_dask.cluster.deaths import Death, is_to_blame
from tract_dask.cluster.retries import Place, Trouble, is_hopeless, places_to_avoid, trouble
from tract_dask.cluster.tasks import run_shards
from tract_dask.errors import ClusterError, SourceError, StoreError
from tract_dask.progress import Warned
from tract_dask.run import one_stage
from tract_dask.settings import ClusterSettings, RunSettings
from tract_dask.store.journal import Journal
from tract_dask.store.shards import Shard, split

PASSING = ["ESTALE", "EIO", "EMFILE", "ENFILE", "ENOTCONN", "ETIMEDOUT", "EAGAIN", "EREMOTEIO", "EHOSTDOWN"]
A, B, C, D = "tls://10.0.0.1:1", "tls://10.0.0.1:2", "tls://10.0.0.2:1", "tls://10.0.0.3:1"
QUICK = {retries.RETRY: 0.02, crew.HANG: 2.0}


@pytest.fixture(scope="module")
def client():
    with connect(ClusterSettings(workers=2, memory_limit="600MB")) as client:
        yield client


@pytest.fixture
def run(client, tmp_path):
    """Run a task on forty shards; return how often each was begun, the payloads, and what was told."""

    def start(task, client=client, count=40):
        told = []
        with dask.config.set(QUICK):
            found = run_shards(
                partial(task, tmp_path),
                split(count, 1),
                journal=Journal(tmp_path / "journal", "key"),
                name="work",
                client=client,
                file="movie.tif",
                on_event=lambda event: told.append(event.message) if isinstance(event, Warned) else None,
            )
        assert sorted(found) == list(range(count))
        return told

    return start


def first_time(folder: Path, name: str) -> bool:
    """Tell whether nobody has asked before."""
    try:
        os.close(os.open(folder / name, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True


def begun(folder: Path, name: str) -> int:
    """Count how often this was asked."""
    with (folder / name).open("a") as file:
        file.write("x")
    return (folder / name).stat().st_size


def fails_once(number: int, folder: Path, shard: Shard) -> dict[str, int]:
    if shard.index == 7 and first_time(folder, "failed"):
        raise OSError(number, os.strerror(number), "/data/movie.tif")
    return {}


@pytest.mark.parametrize("name", PASSING)
def test_an_error_that_passes_is_met_once_more_and_named(run, name):
    (told,) = run(partial(fails_once, getattr(errno, name)))
    assert "worker tls://127.0.0.1:" in told
    assert "/data/movie.tif" in told
    assert name in told


@pytest.mark.parametrize("name", PASSING)
def test_an_error_that_passes_is_met_once_more_without_a_cluster(run, name):
    (told,) = run(partial(fails_once, getattr(errno, name)), client=None)
    assert "/data/movie.tif" in told


def fails_always(number: int, folder: Path, shard: Shard) -> dict[str, int]:
    if shard.index == 7:
        begun(folder, "tries")
        raise OSError(number, os.strerror(number))
    return {}


@pytest.mark.parametrize("here", [False, True])
def test_an_error_that_does_not_pass_is_raised_after_some_tries_with_worker_and_file(run, client, tmp_path, here):
    with pytest.raises(StoreError, match="Input/output error") as caught:
        run(partial(fails_always, errno.EIO), client=None if here else client)
    assert caught.value.where == "movie.tif"
    assert ("on worker tls://127.0.0.1:" in caught.value.got) != here
    assert (tmp_path / "tries").stat().st_size == retries.MOST_TRIES


@pytest.mark.parametrize("number", [errno.ENOENT, errno.EACCES])
def test_what_only_another_machine_may_have_is_not_tried_again_on_this_one(run, tmp_path, number):
    with pytest.raises(StoreError, match=os.strerror(number)):
        run(partial(fails_always, number))
    assert (tmp_path / "tries").stat().st_size <= 2


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS])
@pytest.mark.parametrize("here", [False, True])
def test_a_full_disk_is_not_tried_again(run, client, tmp_path, number, here):
    with pytest.raises(OSError, match=os.strerror(number)):
        run(partial(fails_always, number), client=None if here else client)
    assert (tmp_path / "tries").stat().st_size == 1


def damaged(folder: Path, shard: Shard) -> dict[str, int]:
    begun(folder, "tries")
    raise SourceError("the file is damaged", "movie.tif")


def test_our_own_errors_are_not_tried_again(run, tmp_path):
    with pytest.raises(SourceError, match="damaged"):
        run(damaged, client=None)
    assert (tmp_path / "tries").stat().st_size == 1


def sick_worker(folder: Path, shard: Shard) -> dict[str, int]:
    if get_worker().name == 0:
        begun(folder, "tries")
        raise OSError(errno.EIO, os.strerror(errno.EIO), "/data/movie.tif")
    time.sleep(0.03)
    return {}


def test_a_worker_that_always_fails_is_left_out(run, tmp_path):
    told = run(sick_worker, count=120)
    assert any("is left out" in text for text in told)
    assert (tmp_path / "tries").stat().st_size < 60


def test_what_an_error_is_told_from():
    place = Place(A, "10.0.0.1")
    stale = OSError(errno.ESTALE, "Stale file handle", "movie.tif")
    assert trouble(ValueError("bad"), place, "x") is None
    assert trouble(OSError("no number"), place, "x") is None
    assert trouble(OSError(errno.ENOSPC, "full"), place, "x") is None
    hdf5 = OSError("Can't read data (file read failed: filename = 'm.h5', errno = 5, error message = 'I/O error')")
    assert trouble(hdf5, place, "m.h5").number == errno.EIO
    try:
        try:
            raise stale
        except OSError as error:
            raise SourceError("the file cannot be read", "m.tif", got="Stale file handle") from error
    except SourceError as error:
        met = trouble(error, place, "x")
    assert isinstance(met.error, SourceError)
    assert met.error.got == f"Stale file handle, on worker {A}"


def meet(worker: str, number: int = errno.EIO) -> Trouble:
    return Trouble(number, "movie.tif", Place(worker, retries.host_of(worker)), StoreError("x"))


def test_work_ends_where_every_worker_or_three_hosts_have_failed_often_enough():
    assert not is_hopeless([meet(A)] * 5, [A])
    assert is_hopeless([meet(A)] * 6, [A])
    assert not is_hopeless([meet(A)] * 6, [A, B])
    assert is_hopeless([meet(A)] * 5 + [meet(B)], [A, B])
    assert is_hopeless([meet(A), meet(C), meet(D)] * 2, [A, B, C, D, "tls://10.0.0.4:1"])
    gone = partial(meet, number=errno.ENOENT)
    assert is_hopeless([gone(A)], [A, B]), "the other worker is on the same machine"
    assert not is_hopeless([gone(A)], [A, C])
    assert is_hopeless([gone(A), gone(C), gone(D)], [A, C, D, "tls://10.0.0.4:1"])
    assert places_to_avoid([meet(A)], [A, B, C]) == {A, B}
    assert places_to_avoid([meet(A)], [A, B]) == {A}


def dies(number: int, times: int, folder: Path, shard: Shard) -> dict[str, int]:
    if shard.index == 11 and begun(folder, "tries") <= times:
        os.kill(os.getpid(), number)
        time.sleep(60)
    return {}


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_worker_that_is_ended_costs_nothing_however_often(run, number):
    told = run(partial(dies, number, 5))
    assert any(number.name in text or "exit code" in text for text in told)


@pytest.mark.parametrize("number", [signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGILL])
def test_a_shard_that_crashes_its_workers_ends_the_run_with_file_and_frames(run, tmp_path, number):
    with pytest.raises(StoreError, match="frames 11 to 11 crash every worker") as caught:
        run(partial(dies, number, 1000))
    assert caught.value.where == "movie.tif"
    assert number.name in caught.value.got
    assert (tmp_path / "tries").stat().st_size <= 3


def test_a_crash_that_does_not_come_again_ends_nothing(run):
    told = run(partial(dies, signal.SIGSEGV, 1))
    assert any("SIGSEGV" in text for text in told)


def test_who_is_to_blame():
    unknown = [Death(worker) for worker in (A, B, C)]
    assert is_to_blame(unknown, others_finished=True)
    assert not is_to_blame(unknown, others_finished=False)
    assert not is_to_blame(unknown[:2] * 4, others_finished=True)
    assert not is_to_blame([Death(A, -9), Death(B, -15), Death(C, 0)] * 3, others_finished=True)
    assert "more memory" in str(Death(A, -15, out_of_memory=True))
    assert Death(A, -15).is_of_node


class StandIn:
    """A client, or a future, of no cluster: it notes what was submitted."""

    status = "pending"

    def __init__(self, workers: tuple[str, ...] = (), key: object = None) -> None:
        self.workers, self.key, self.sent = workers, key, []

    def nthreads(self) -> dict[str, int]:
        return dict.fromkeys(self.workers, 1)

    def submit(self, *work: object, key: object, pure: bool, workers: object = None) -> StandIn:
        self.sent.append(workers)
        return StandIn(key=key)

    def add_done_callback(self, call: object) -> None: ...


@pytest.mark.parametrize("workers", [(A,), (A, C)])
def test_suspects_are_tried_one_a_worker(workers):
    client = StandIn(workers)
    work = dispatch.Dispatch(client, np.sum, np.arange(5), split(5, 1), "work", "movie.tif", print)
    work._crew.ended.set()
    work._suspects = batch.Batch(np.arange(5)).split(is_suspect=True)
    work._test_suspects()
    work._test_suspects()
    assert sorted(client.sent) == [[worker] for worker in workers]
    assert len(work._suspects) == 5 - len(workers)


def test_a_run_warns_once_of_a_cluster_that_is_open_to_all(tmp_path):
    np.save(tmp_path / "movie.npy", np.ones((3, 32, 32), np.uint16))
    told = []

    def convert(cluster: ClusterSettings, name: str) -> None:
        one_stage.run_convert(
            tmp_path / "movie.npy",
            tmp_path / name,
            RunSettings(cluster=cluster),
            on_event=lambda event: told.append(event.message) if isinstance(event, Warned) else None,
        )

    with LocalCluster(n_workers=1, protocol="tcp://", processes=False, dashboard_address=":0") as everybodys:
        convert(ClusterSettings(scheduler=everybodys.scheduler_address), "open.zarr")
    assert len(told) == 1
    assert "--tls" in told[0]
    assert "tract-dask certs" in told[0]
    convert(ClusterSettings(workers=1), "closed.zarr")
    assert len(told) == 1


def swell(folder: Path, shard: Shard) -> dict[str, int]:
    if shard.index == 3:
        held = np.ones(100_000_000)
        time.sleep(20)
        return {"sum": int(held.sum())}
    return {}


def test_a_shard_that_is_too_large_for_memory_is_named_as_that(run, monkeypatch):
    monkeypatch.setattr(crew, "MOST_SWOLLEN", 2)
    monkeypatch.setitem(QUICK, crew.HANG, 60.0)
    with pytest.raises(ClusterError, match="frames 3 to 3") as caught:
        run(swell)
    assert "more memory" in caught.value.got
    assert "--memory-limit" in caught.value.remedy


def stops(folder: Path, shard: Shard) -> dict[str, int]:
    if shard.index == 5 and first_time(folder, "stopped"):
        os.kill(os.getpid(), signal.SIGSTOP)
    time.sleep(0.01)
    return {}


def sleeps(folder: Path, shard: Shard) -> dict[str, int]:
    if shard.index == 20 and first_time(folder, "asleep"):
        time.sleep(60)
    time.sleep(0.01)
    return {}


@pytest.mark.parametrize(("task", "how"), [(stops, "silent"), (sleeps, "busy")])
def test_a_worker_that_hangs_is_named_and_its_work_done_by_another(run, monkeypatch, task, how):
    monkeypatch.setattr(dispatch, "SLOW", 3)
    began = time.monotonic()
    told = run(task)
    assert time.monotonic() - began < 45, "it sleeps for a minute"
    assert any(f"has been {how} for" in text and "127.0.0.1" in text and "movie.tif" in text for text in told)


def test_a_lone_worker_that_is_stopped_is_replaced(tmp_path):
    told = []
    with connect(ClusterSettings(workers=1, memory_limit="600MB")) as client, dask.config.set({crew.HANG: 1.0}):
        found = run_shards(
            partial(stops, tmp_path),
            split(10, 1),
            journal=Journal(tmp_path / "journal", "key"),
            name="work",
            client=client,
            on_event=told.append,
        )
    assert sorted(found) == list(range(10))
    assert "there is no other worker" in told[0].message


def test_a_cluster_ends_in_time_though_its_worker_is_stopped():
    with connect(ClusterSettings(workers=1, memory_limit="600MB")) as client:
        (pid,) = client.run(os.getpid).values()
        os.kill(pid, signal.SIGSTOP)
        began = time.monotonic()
    assert time.monotonic() - began < 30


def test_a_cluster_of_others_begins_to_tell_how_workers_die():
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster, Client(cluster) as client:
        assert deaths.death(client, "tcp://gone").code is None
        (address, pid), *_ = client.run(os.getpid).items()
        os.kill(pid, signal.SIGSEGV)
        deadline = time.monotonic() + 20
        while deaths.death(client, address).code is None:
            assert time.monotonic() < deadline
            time.sleep(0.1)
        assert deaths.death(client, address).is_crash
