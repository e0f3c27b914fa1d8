"""Encrypted clusters: local ones, running ones, and what is told where certificates and addresses do not fit."""

import asyncio
import contextlib
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import numpy as np
import psutil
import pytest
import xarray as xr
from conftest import Scene
from distributed import Client
from distributed.core import rpc

from tract_dask.cluster import connect as cluster
from tract_dask.cluster import tls
from tract_dask.cluster.certificates import make_certificates
from tract_dask.errors import ClusterError
from tract_dask.run import pipeline
from tract_dask.service.runner.cluster_process import ClusterProcess
from tract_dask.settings import ClusterSettings, ConvertSettings, RunSettings
from tract_dask.store.results import open_results

pytestmark = pytest.mark.timeout(600)  # many processes start: minutes where a machine is busy


@pytest.fixture(scope="module")
def certificates(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("tls") / "certificates"
    make_certificates(folder)
    return folder


@contextmanager
def process(*command: object) -> Iterator[subprocess.Popen]:
    with subprocess.Popen([sys.executable, *map(str, command)], stderr=subprocess.DEVNULL) as started:
        try:
            yield started
        finally:
            started.terminate()


def wait_for(true, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture(scope="module")
def running(certificates, tmp_path_factory) -> Iterator[Path]:
    """The scheduler file of an encrypted scheduler, which has a worker of two threads."""
    folder = tmp_path_factory.mktemp("running")
    file = folder / "scheduler.json"
    flags = tls.worker_flags(tls.security(str(certificates)))
    listening = ["--host", "127.0.0.1", "--scheduler-file", file, *flags]
    scheduler = ["--port", "0", "--protocol", "tls", "--dashboard-address", "127.0.0.1:0"]
    with process("-m", "distributed.cli.dask_scheduler", *scheduler, *listening):
        wait_for(lambda: file.exists() and file.read_text())
        worker = ["--nthreads", "2", "--no-nanny", "--no-dashboard", "--local-directory", folder]
        with process("-m", "distributed.cli.dask_worker", *worker, *listening):
            yield file


def test_local_cluster_is_encrypted(certificates):
    with cluster.connect(ClusterSettings(workers=1, memory_limit="1GB", tls=str(certificates))) as client:
        assert client.scheduler.address.startswith("tls://127.0.0.1:")
        assert client.submit(sum, [1, 2]).result() == 3
        assert all(worker.startswith("tls://") for worker in client.scheduler_info()["workers"])


def test_run_on_two_threads_of_an_encrypted_worker(running, certificates, tmp_path):
    movie = tmp_path / "movie.npy"
    np.save(movie, Scene(n_frames=24).counts())
    convert = ConvertSettings(shard_mb=1)
    far = ClusterSettings(scheduler_file=str(running), tls=str(certificates))
    spread = pipeline.run(movie, tmp_path / "far", RunSettings(convert=convert, cluster=far), report=False)
    here = RunSettings(convert=convert, cluster=ClusterSettings(workers=1))
    whole = pipeline.run(movie, tmp_path / "whole", here, report=False)
    xr.testing.assert_equal(open_results(spread.outputs.results).load(), open_results(whole.outputs.results).load())


def test_cluster_process_only_looks_at_a_cluster_of_somebody_else(running, certificates, tmp_path):
    settings = ClusterSettings(scheduler_file=str(running), tls=str(certificates))
    cluster_process = ClusterProcess(settings, tmp_path)
    cluster_process.start()
    try:
        assert cluster_process.ready(1.0) == settings
        wait_for(cluster_process.workers)
        (worker,) = cluster_process.workers()
        assert worker["address"].startswith("tls://127.0.0.1:")
        assert worker["memory"] > 0
        assert str(cluster_process.dashboard()).startswith("http://127.0.0.1:")
    finally:
        cluster_process.stop()


def test_certificates_of_another_authority_are_refused(running, tmp_path):
    make_certificates(tmp_path)
    settings = ClusterSettings(scheduler_file=str(running), tls=str(tmp_path))
    with pytest.raises(ClusterError, match="cannot be reached"), cluster.connect(settings, timeout_s=2.0):
        pass


def test_encrypted_scheduler_wants_certificates_and_a_plain_one_none(running, certificates):
    address = json.loads(running.read_text())["address"]
    with (
        pytest.raises(ClusterError, match="speaks TLS and no certificates") as caught,
        cluster.connect(ClusterSettings(scheduler=address)),
    ):
        pass
    assert "--tls" in caught.value.expected
    plain = ClusterSettings(scheduler=address.replace("tls", "tcp"), tls=str(certificates))
    with pytest.raises(ClusterError, match="traffic is not encrypted"), cluster.connect(plain):
        pass


def test_address_without_a_protocol_gets_the_one_that_is_meant():
    assert tls.checked_address("node1:8786", None) == "tcp://node1:8786"
    assert tls.checked_address("node1:8786", "certificates") == "tls://node1:8786"


def test_scheduler_without_workers_is_told_with_the_certificates(certificates):
    with (
        cluster.hold(ClusterSettings(workers=1, tls=str(certificates))) as held,
        held.get_client() as client,
    ):
        held.scale(0)
        wait_for(lambda: not client.nthreads())
        with pytest.raises(ClusterError, match="no workers") as caught:
            cluster.check_workers(client, timeout_s=0.2)
    flags = f"--tls-ca-file {certificates}/ca.pem --tls-cert {certificates}/dask.pem --tls-key"
    assert flags in caught.value.remedy


def test_missing_certificate_is_named(tmp_path):
    make_certificates(tmp_path)
    (tmp_path / "dask-key.pem").unlink()
    with pytest.raises(ClusterError, match="certificate is missing") as caught:
        tls.security(str(tmp_path))
    assert "dask-key.pem" in caught.value.got
    assert "tract-dask certs" in caught.value.remedy


def listening(pids: list[int]) -> set[int]:
    """Ports on which processes listen and speak Dask's protocol: all but those of pages."""
    found = {
        connection.laddr.port
        for pid in pids
        for connection in psutil.Process(pid).net_connections()
        if connection.status == psutil.CONN_LISTEN
    }
    return {port for port in found if not speaks_http(port)}


def speaks_http(port: int) -> bool:
    with socket.create_connection(("127.0.0.1", port), timeout=5) as line:
        line.sendall(b"GET /health HTTP/1.0\r\n\r\n")
        line.settimeout(2)
        with contextlib.suppress(OSError):
            return line.recv(4) == b"HTTP"
    return False


async def says(address: str, **arguments: object) -> object:
    """What the process at an address answers to Dask's own question who it is."""
    async with rpc(address, timeout=2, **arguments) as other:
        return await asyncio.wait_for(other.identity(), 4)


def test_nobody_else_can_say_a_word_to_a_local_cluster():
    with cluster.connect(ClusterSettings(workers=1, memory_limit="1GB")) as client:
        children = [process.pid for process in psutil.Process().children(recursive=True)]
        ports = listening([os.getpid(), *children])
        mine = {int(str(address).rpartition(":")[2]) for address in about(client)}
        assert mine <= ports, "scheduler, worker and nanny"
        stranger = tls.in_memory(tls.temporary_credentials()).get_connection_args("client")
        for port in ports:
            with pytest.raises((OSError, asyncio.TimeoutError)):
                asyncio.run(says(f"tcp://127.0.0.1:{port}"))
            with pytest.raises((OSError, asyncio.TimeoutError)):
                asyncio.run(says(f"tls://127.0.0.1:{port}", connection_args=stranger))
        friend = client.security.get_connection_args("client")
        for address in about(client):
            assert asyncio.run(says(address, connection_args=friend))


def about(client: Client) -> list[str]:
    """Addresses of scheduler, workers and nannies."""
    workers = client.scheduler_info()["workers"]
    return [client.scheduler.address, *workers, *(worker["nanny"] for worker in workers.values())]


@pytest.mark.parametrize("address", ["tcp", "tls"])
def test_a_client_without_the_credentials_does_not_get_in(address):
    with cluster.connect(ClusterSettings(workers=1, memory_limit="1GB")) as client:
        port = client.scheduler.address.rpartition(":")[2]
        others = tls.in_memory(tls.temporary_credentials()) if address == "tls" else None
        with pytest.raises(OSError, match=r"(?i)timed out|closed|connect|certificate"):
            Client(f"{address}://127.0.0.1:{port}", security=others, timeout=1)


def test_credentials_are_neither_in_arguments_nor_in_the_environment_nor_in_files(tmp_path):
    cluster_process = ClusterProcess(ClusterSettings(workers=1, memory_limit="1GB"), tmp_path)
    cluster_process.start()
    try:
        settings = cluster_process.ready(60.0)
        secret = cluster_process.credentials["key"].splitlines()[1]
        wait_for(cluster_process.workers)
        for process_ in psutil.Process().children(recursive=True):
            with contextlib.suppress(psutil.Error):
                assert secret not in " ".join(process_.cmdline())
                assert secret not in str(process_.environ())
        assert not any(secret in file.read_text() for file in tmp_path.rglob("*") if file.is_file())
        assert secret not in str(settings)
        with pytest.raises(ClusterError, match="speaks TLS"), cluster.connect(settings, timeout_s=2.0):
            pass
        with tls.using(cluster_process.credentials), cluster.connect(settings) as client:
            assert client.submit(sum, [1, 2]).result() == 3
    finally:
        cluster_process.stop()


def test_the_pages_of_a_local_cluster_let_nobody_change_anything():
    with cluster.connect(ClusterSettings(workers=1, memory_limit="1GB")) as client:
        page = client.dashboard_link.rsplit("/", 1)[0]
        for path in ("/api/v1/retire_workers", "/api/v1/adaptive_target", "/api/v1/get_workers"):
            with pytest.raises(HTTPError) as caught:
                urlopen(f"{page}{path}", data=b"{}", timeout=60)
            assert caught.value.code in (404, 405)
        assert client.submit(sum, [1, 2]).result() == 3
