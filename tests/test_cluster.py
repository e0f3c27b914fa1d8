"""Clients from settings, and whether their workers are fit for the work."""

import importlib.metadata
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from tract_dask import cluster, forkserver
from tract_dask.errors import ClusterError, SettingsError
from tract_dask.settings import ClusterSettings

VERSION = importlib.metadata.version("tract_dask")


def environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if "THREAD" in name or "MALLOC" in name}


class FakeClient:
    """What the checks ask of a client."""

    def __init__(self, versions: dict[str, object], workers: list[tuple[int, int]] = ()) -> None:
        self.scheduler = SimpleNamespace(address="tcp://10.0.0.1:8786")
        self.versions = versions
        self.workers = workers

    def wait_for_workers(self, count: int, timeout: float) -> None:
        if not self.versions:
            raise TimeoutError

    def run(self, function: object, package: str, on_error: str) -> dict[str, object]:
        assert (function, package, on_error) == (importlib.metadata.version, "tract_dask", "return")
        return self.versions

    def scheduler_info(self, n_workers: int = 5) -> dict[str, object]:
        return {"workers": {k: {"memory_limit": m, "nthreads": n} for k, (m, n) in enumerate(self.workers)}}


def test_local_workers_have_one_thread_each_and_the_memory_that_was_set():
    settings = ClusterSettings(workers=1, memory_limit="700MB")
    with cluster.connect(settings) as client:
        cluster.check_workers(client)
        assert client.nthreads() == dict.fromkeys(client.nthreads(), 1)
        assert cluster.memory_budget(client) == 700_000_000
        (found,) = client.run(environment).values()
        names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "RAYON_NUM_THREADS", "BLOSC_NTHREADS")
        assert {found[name] for name in names} == {"1"}
        assert found["MALLOC_MMAP_THRESHOLD_"] == "33554432"
        assert client.dashboard_link.startswith("http://127.0.0.1:")


@pytest.mark.skipif(not forkserver.AVAILABLE, reason="workers are spawned here")
def test_forked_workers_have_everything_imported_and_the_driver_keeps_its_environment():
    before = environment()
    forkserver.start()
    assert environment() == before
    with cluster.connect(ClusterSettings(workers=1)) as client:
        (modules,) = client.run(lambda: set(sys.modules)).values()
    assert {"tract_dask.conversion", "tract_dask.drift", "tract_dask.fit"} <= modules


@pytest.mark.skipif(not forkserver.AVAILABLE, reason="workers are spawned here")
def test_what_the_fork_server_imports_starts_no_thread():
    """A thread would not live on in the workers, but what it holds locked would stay so."""
    forkserver.start()
    with cluster.connect(ClusterSettings(workers=1)) as client:
        (server,) = client.run(os.getppid).values()
        assert len(list(Path(f"/proc/{server}/task").iterdir())) == 1


def test_workers_are_spawned_where_there_is_no_fork_server(monkeypatch):
    monkeypatch.setattr(forkserver, "AVAILABLE", False)
    with cluster.connect(ClusterSettings(workers=1)) as client:
        assert client.submit(sum, [1, 2]).result() == 3
        (parent,) = client.run(os.getppid).values()
    assert parent == os.getpid()


def test_scheduler_file_of_a_running_scheduler(tmp_path):
    file = tmp_path / "scheduler.json"
    command = [sys.executable, "-m", "dask", "scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", file]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as scheduler:
        try:
            while not file.exists() or not file.read_text():
                assert scheduler.poll() is None
            with cluster.connect(ClusterSettings(scheduler_file=str(file))) as client:
                with pytest.raises(ClusterError, match="no workers") as caught:
                    cluster.check_workers(client, timeout_s=0.2)
                assert f"dask worker {client.scheduler.address}" in str(caught.value)
        finally:
            scheduler.terminate()


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense"])
def test_unreachable_scheduler_is_named_with_the_remedy(address):
    with (
        pytest.raises(ClusterError, match="cannot be reached") as caught,
        cluster.connect(ClusterSettings(scheduler=address), timeout_s=0.3),
    ):
        pass
    assert address in str(caught.value)
    assert "dask scheduler" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [None, "no json", "{}"])
def test_scheduler_file_that_cannot_be_used(tmp_path, content):
    file = tmp_path / "scheduler.json"
    if content is not None:
        file.write_text(content)
    with (
        pytest.raises(ClusterError, match="scheduler file"),
        cluster.connect(ClusterSettings(scheduler_file=str(file))),
    ):
        pass


def test_two_schedulers_contradict():
    settings = ClusterSettings(scheduler="tcp://a:1", scheduler_file="b.json")
    with pytest.raises(SettingsError, match="two schedulers"), cluster.connect(settings):
        pass


def test_memory_limit_that_is_no_size():
    with pytest.raises(SettingsError, match="no size"):
        cluster.local_memory_limit(ClusterSettings(memory_limit="lots"))


def test_worker_without_the_package_is_named():
    missing = importlib.metadata.PackageNotFoundError("tract_dask")
    client = FakeClient({"tcp://10.0.0.2:1": VERSION, "tcp://10.0.0.3:1": missing})
    with pytest.raises(ClusterError, match="lacks tract_dask") as caught:
        cluster.check_workers(client)
    assert caught.value.where == "tcp://10.0.0.3:1"
    assert VERSION in caught.value.expected
    assert "Install" in caught.value.remedy


def test_worker_with_another_version_is_named():
    with pytest.raises(ClusterError, match="another tract_dask") as caught:
        cluster.check_workers(FakeClient({"tcp://10.0.0.3:1": "0.0.1"}))
    assert caught.value.got == "0.0.1"


def test_memory_budget_is_that_of_the_poorest_thread():
    assert cluster.memory_budget(FakeClient({}, [(8_000, 2), (3_000, 1), (9_000, 1)])) == 3_000
    assert cluster.memory_budget(FakeClient({}, [(0, 2)])) is None


def test_lazy_client_connects_once_and_only_when_asked():
    asked = []
    client = FakeClient({"tcp://10.0.0.2:1": VERSION})
    lazy = cluster.LazyClient(client=client, on_connect=asked.append)
    assert asked == []
    assert lazy() is client
    assert lazy() is client
    assert asked == [client]
    lazy.close()


def test_workers_that_cannot_start_are_told_with_what_a_script_needs(monkeypatch):
    def refuse(**kwargs):
        raise RuntimeError("Nanny failed to start.")

    monkeypatch.setattr("tract_dask.cluster.LocalCluster", refuse)
    told = r"(?s)Nanny failed to start.*if __name__ == \"__main__\":"
    with pytest.raises(ClusterError, match=told), cluster.connect(ClusterSettings(workers=1)):
        pass
