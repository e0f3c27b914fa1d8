"""Clients from settings, and whether their workers are fit for the work."""

import importlib.metadata
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from tract_dask.cli.options import collect
from tract_dask.cluster import connect as cluster
from tract_dask.cluster import forkserver, memory
from tract_dask.cluster.tls import using
from tract_dask.errors import ClusterError, SettingsError
from tract_dask.service.runner.cluster_process import ClusterProcess
from tract_dask.settings import ClusterSettings, from_toml, to_toml

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
        assert memory.memory_budget(client) == 700_000_000
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
    assert {
        "tract_dask.stages.convert.stage",
        "tract_dask.stages.drift.measure",
        "tract_dask.stages.fit.stage",
    } <= modules
    assert not {"scipy.ndimage", "scipy.spatial", "scipy.stats"} & modules, "these take a second, and are not needed"


OPEN_THE_DASHBOARD = """
import sys
from concurrent.futures import ThreadPoolExecutor
from urllib.request import urlopen

from tract_dask.cluster import connect as cluster
from tract_dask.settings import ClusterSettings

if __name__ == "__main__":
    with cluster.connect(ClusterSettings(workers=1)) as client:
        assert "bokeh" not in sys.modules
        with ThreadPoolExecutor(3) as several:
            pages = list(several.map(lambda _: urlopen(client.dashboard_link, timeout=60), range(3)))
        assert {page.url for page in pages} == {client.dashboard_link}
        print(*[page.read().decode().count("<title>Dask Diagnostic UI</title>") for page in pages])
"""


def test_the_dashboard_is_loaded_when_it_is_opened(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(OPEN_THE_DASHBOARD)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout.split() == ["1", "1", "1"], done.stderr


@pytest.mark.skipif(not forkserver.AVAILABLE, reason="workers are spawned here")
def test_what_the_fork_server_imports_starts_no_thread():
    """A thread would not live on in the workers, but what it holds locked would stay so."""
    forkserver.start()
    with cluster.connect(ClusterSettings(workers=1)) as client:
        (server,) = client.run(os.getppid).values()
        assert len(list(Path(f"/proc/{server}/task").iterdir())) == 1


def test_what_a_killed_process_leaves_is_removed_without_a_word():
    code = """
import multiprocessing, os
from tract_dask.cluster.forkserver import start_tracker
start_tracker()
held = multiprocessing.get_context("spawn").Semaphore()
os._exit(0)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


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
                time.sleep(0.02)
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
    with pytest.raises(SettingsError, match="not a size"):
        memory.local_memory_limit(ClusterSettings(memory_limit="lots"))


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
    assert memory.memory_budget(FakeClient({}, [(8_000, 2), (3_000, 1), (9_000, 1)])) == 3_000
    assert memory.memory_budget(FakeClient({}, [(0, 2)])) is None


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

    monkeypatch.setattr("tract_dask.cluster.connect.LocalCluster", refuse)
    told = r"(?s)Nanny failed to start.*if __name__ == \"__main__\":"
    with pytest.raises(ClusterError, match=told), cluster.connect(ClusterSettings(workers=1)):
        pass


RACE = """
import gc, sys, threading, time
from pathlib import Path
import numba, numpy as np
from tract_dask.store.arrays import load_array

path = Path(sys.argv[1])
np.save(path, np.zeros(3, dtype=[(f"field{k}", "f4") for k in range(300)]))
sys.setswitchinterval(1e-6)
gc.set_threshold(20, 2, 2)
gc.callbacks.append(lambda phase, about: list(range(10)))  # as a worker has one: the moment at which threads change
end = time.monotonic() + 1.5

def repeat(work):
    while time.monotonic() < end:
        work()

def compile_one():
    numba.njit(lambda x: x + 1)(1)

threads = [threading.Thread(target=repeat, args=(work,)) for work in 3 * [lambda: load_array(path)] + [compile_one]]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
"""


def test_threads_of_a_worker_read_arrays_while_others_compile(tmp_path):
    """With plain numpy.load this fails within 0.2 s: "AST constructor recursion depth mismatch"."""
    race = [sys.executable, "-c", RACE, str(tmp_path / "array.npy")]
    done = subprocess.run(race, capture_output=True, text=True, check=False)
    assert done.stderr == ""


def examples() -> list[str]:
    text = (Path(__file__).parents[2] / "docs" / "deploy.md").read_text(encoding="utf-8")
    return re.findall(r"^```toml\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def test_examples_of_the_documentation_are_settings():
    kinds = [from_toml(ClusterSettings, text).resolved_kind for text in examples()]
    assert kinds == ["ssh", "slurm"]


def test_cluster_file_takes_the_place_of_the_cluster_in_the_configuration(tmp_path):
    (tmp_path / "run.toml").write_text('[cluster]\nworkers = 3\nscheduler = "tcp://a:1"\n[fit]\nthreshold = 3.0')
    (tmp_path / "cluster.toml").write_text(examples()[1])
    given = {"cluster__workers": 7, "cluster__memory_limit": None}
    settings = collect(given, tmp_path / "run.toml", tmp_path / "cluster.toml")
    assert settings.fit.threshold == 3.0
    assert (settings.cluster.kind, settings.cluster.workers, settings.cluster.scheduler) == ("slurm", 7, None)
    assert settings.cluster.slurm.directives == ("--constraint=avx512", "--exclude=node7")
    assert from_toml(ClusterSettings, to_toml(settings.cluster)) == settings.cluster


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('kind = "pbs"', "no such choice"),
        ('kind = "address"', "scheduler or scheduler_file"),
        ('kind = "slurm"\nworkers = 4', "workers and memory_limit"),
        ('kind = "ssh"', r"hosts in the table \[ssh\]"),
        ('kind = "local"\nscheduler = "tcp://a:1"', "contradict"),
        ('kind = "slurm"\nworkers = 2\nmin_workers = 3\nmemory_limit = "1GB"', "at most workers, 2"),
        ('[slurm]\nwalltime = "an hour"', "wrong form"),
        ('[slurm]\ndirectives = ["exclusive"]', "begin with a dash"),
        ("[slurm]\ndirectives = [7]", "begin with a dash"),
        ('[slurm]\nqueue = "a b"', "letters, digits"),
        ('[slurm]\nprologue = ["a\\nb"]', "single lines"),
        ('[ssh]\nhosts = ["-oProxyCommand=x"]', "names such as node1"),
        ('[ssh]\nhosts = "node1"', "wrong type"),
        ("slurm = 3", "group of settings"),
        ("nodes = 3", "no setting 'nodes'"),
        ("threads = 0", "out of range"),
    ],
)
def test_cluster_settings_that_mean_nothing_are_named(text, said):
    with pytest.raises(SettingsError, match=said):
        from_toml(ClusterSettings, text)


def test_work_waits_for_a_queue_longer_than_for_a_machine():
    assert ClusterSettings().resolved_patience_s == 60
    assert from_toml(ClusterSettings, 'kind="slurm"\nworkers=1\nmemory_limit="1GB"').resolved_patience_s == 86400
    assert ClusterSettings(kind="local", patience_s=5).resolved_patience_s == 5


def wait_for(true: object, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def children(pid: int) -> list[psutil.Process]:
    return psutil.Process(pid).children(recursive=True)


def test_cluster_process_starts_a_killed_cluster_again_and_leaves_nothing_behind(tmp_path):
    cluster_process = ClusterProcess(ClusterSettings(workers=1, memory_limit="700MB"), tmp_path)
    with pytest.raises(ClusterError, match="not up"):
        cluster_process.ready(0.0)
    assert (cluster_process.workers(), cluster_process.dashboard()) == ([], None)
    cluster_process.start()
    try:
        found = cluster_process.ready(60.0)
        assert found.resolved_kind == "address"
        first = json.loads(Path(found.scheduler_file).read_text())["address"]
        wait_for(cluster_process.workers)
        (worker,) = cluster_process.workers()
        assert (worker["memory_limit"], worker["executing"], worker["stage"]) == (700_000_000, 0, "")
        assert cluster_process.dashboard().startswith("http://127.0.0.1:")
        cluster_main = next(
            child
            for child in psutil.Process().children()
            if "tract_dask.service.runner.cluster_main" in child.cmdline()
        )
        before = [cluster_main, *children(cluster_main.pid)]
        cluster_main.kill()
        file = Path(found.scheduler_file)
        wait_for(lambda: file.exists() and json.loads(file.read_text())["address"] != first)
        assert cluster_process.ready(1.0) == found
        with using(cluster_process.credentials), cluster.connect(found) as client:
            assert client.submit(sum, [1, 2]).result() == 3
        cluster_main = next(
            child
            for child in psutil.Process().children()
            if "tract_dask.service.runner.cluster_main" in child.cmdline()
        )
        after = [cluster_main, *children(cluster_main.pid)]
    finally:
        cluster_process.stop()
    wait_for(lambda: not any(process.is_running() for process in before + after))


SERVICE = """
import sys, time
from pathlib import Path
from tract_dask.service.runner.cluster_process import ClusterProcess
from tract_dask.settings import ClusterSettings
cluster_process = ClusterProcess(ClusterSettings(workers=1, memory_limit="700MB"), Path(sys.argv[1]))
cluster_process.start()
cluster_process.ready(60.0)
print("ready", flush=True)
time.sleep(600)
"""


def test_cluster_ends_with_a_killed_service(tmp_path):
    with subprocess.Popen([sys.executable, "-c", SERVICE, str(tmp_path)], stdout=subprocess.PIPE, text=True) as service:
        assert service.stdout.readline() == "ready\n"
        orphans = children(service.pid)
        assert len(orphans) >= 2
        service.kill()
    wait_for(lambda: not any(orphan.is_running() for orphan in orphans))
