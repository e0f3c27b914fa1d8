"""What is imported, and when: not in two threads at once, which may find a module half made."""

from __future__ import annotations

import subprocess
import sys
import time

from conftest import Scene
from distributed import Client, LocalCluster

from tract_dask.run import pipeline, session
from tract_dask.stages.columns import stage as stages

SPY = """
import sys, threading

class Spy:
    seen = set()

    def find_spec(self, name, path=None, target=None):
        if threading.current_thread() is not threading.main_thread():
            self.seen.add(name)

def in_threads(*functions):
    sys.meta_path.insert(0, Spy())
    threads = [threading.Thread(target=function) for function in functions]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print(*sorted(name for name in Spy.seen if name.split(".")[0] in WATCHED))
"""


def imported_in_threads(watched: tuple[str, ...], code: str) -> list[str]:
    """Return which modules of the packages ``watched`` a fresh process imports in threads."""
    done = subprocess.run(
        [sys.executable, "-c", f"WATCHED = {watched!r}\n{SPY}\n{code}"], capture_output=True, text=True, check=True
    )
    return done.stdout.split()


def test_a_client_and_the_dashboard_import_nothing_in_threads():
    """Of httpx, which imports httpcore at its first client, and with it h11 and anyio, which uvicorn imports too."""
    code = """
import asyncio, httpx
from tract_dask.{module} import __name__

def ask():
    with httpx.Client(trust_env=False, verify=False) as client:
        try:
            client.get("http://127.0.0.1:9/")
        except httpx.HTTPError:
            pass

async def ask_as_the_service_does():
    async with httpx.AsyncClient(trust_env=False, verify=False) as client:
        try:
            await client.get("http://127.0.0.1:9/")
        except httpx.HTTPError:
            pass

in_threads(ask, lambda: asyncio.run(ask_as_the_service_does()))
"""
    watched = ("httpx", "httpcore", "h11")
    for module in ("service.client", "service.upstream"):
        assert imported_in_threads(watched, code.format(module=module)) == []


def test_tasks_import_no_codec():
    code = """
import numpy as np
from tract_dask.run import worker_imports
from tract_dask.store.shard_files import _blosc

in_threads(lambda: _blosc.blosc_encode(np.zeros(64, np.uint8)))
"""
    assert imported_in_threads(("imagecodecs",), code) == []


def test_columns_are_looked_for_once_the_other_thread_has_imported_its_part(npy, tmp_path, monkeypatch):
    ready, found_ready = [], []

    def get_ready():
        time.sleep(3)
        ready.append(True)

    def columns_stage(*args, **more):
        found_ready.extend(ready)
        return stages.columns_stage(*args, **more)

    monkeypatch.setattr(session, "_get_ready", get_ready)
    monkeypatch.setattr(pipeline, "columns_stage", columns_stage)
    with (
        LocalCluster(processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        pipeline.run(npy(Scene(n_frames=4).counts()), tmp_path / "out", client=client, report=False)
    assert found_ready == [True]
