"""Runs on workers that an sshd of the test's own starts on this machine."""

import os
import shutil
import signal
import socket
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import pytest
import xarray as xr
from conftest import Scene
from distributed.scheduler import KilledWorker

from tract_dask.cluster import connect as cluster
from tract_dask.cluster.certificates import make_certificates
from tract_dask.errors import ClusterError, SettingsError
from tract_dask.run import pipeline
from tract_dask.settings import ClusterSettings, ConvertSettings, RunSettings, SshSettings
from tract_dask.store.results import open_results

pytestmark = pytest.mark.timeout(600)  # many processes start: minutes where a machine is busy

CONVERT = ConvertSettings(shard_mb=1)

CONFIG = """
HostKey {folder}/host_key
AuthorizedKeysFile {folder}/key.pub
StrictModes no
UsePAM no
PasswordAuthentication no
PidFile none
"""


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    """Arguments with which ssh reaches the sshd of this module."""
    sshd = shutil.which("sshd", path="/usr/sbin:/usr/local/sbin:/usr/bin")
    assert sshd, "sshd is missing (on Debian: apt-get install openssh-server)"
    folder = tmp_path_factory.mktemp("ssh")
    for name in ("host_key", "key"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / name], check=True)
    (folder / "config").write_text(CONFIG.format(folder=folder))
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    Path("/run/sshd").mkdir(exist_ok=True)
    host_key = (folder / "host_key.pub").read_text()
    (folder / "known_hosts").write_text(f"[127.0.0.1]:{port} {host_key}")
    listening = ["-o", "ListenAddress=127.0.0.1", "-p", str(port), "-E", folder / "log"]
    with subprocess.Popen([sshd, "-D", "-f", folder / "config", *listening]) as daemon:
        known = ("-o", f"UserKnownHostsFile={folder / 'known_hosts'}", "-o", "StrictHostKeyChecking=yes")
        yield ("-F", "none", "-p", str(port), "-i", str(folder / "key"), *known)
        daemon.terminate()


def settings(options: tuple[str, ...], folder: Path, **more: object) -> ClusterSettings:
    make_certificates(folder / "certificates")
    return ClusterSettings(
        kind="ssh",
        workers=1,
        memory_limit="1GB",
        interface="lo",
        tls=str(folder / "certificates"),
        local_directory=str(folder),
        ssh=SshSettings(hosts=("127.0.0.1",), options=options),
        **more,
    )


def test_run_through_ssh_outlives_the_loss_of_its_only_host(options, tmp_path):
    movie = tmp_path / "movie.npy"
    np.save(movie, Scene(n_frames=24).counts())

    def of_worker() -> tuple[int, int, str]:
        """The worker, the process that started it, and whether it came by ssh."""
        return os.getpid(), os.getppid(), os.environ.get("SSH_CONNECTION", "")

    with cluster.connect(settings(options, tmp_path)) as client:
        cluster.check_workers(client)
        assert client.scheduler.address.startswith("tls://127.0.0.1:")
        (worker, nanny, connection) = client.run(of_worker).popitem()[1]
        assert connection
        far = pipeline.run(movie, tmp_path / "far", RunSettings(convert=CONVERT), client=client, report=False)
        for pid in (nanny, worker):
            os.kill(pid, signal.SIGKILL)
        again = worker
        while again == worker:
            with suppress(KilledWorker):  # where it was given to the one that has just died
                (again, nanny, _) = client.submit(of_worker, pure=False).result(timeout=60)
    deadline = time.monotonic() + 20
    while psutil.pid_exists(again) or psutil.pid_exists(nanny):
        assert time.monotonic() < deadline, "workers outlive the scheduler"
        time.sleep(0.1)
    here = RunSettings(convert=CONVERT, cluster=ClusterSettings(workers=1))
    whole = pipeline.run(movie, tmp_path / "whole", here, report=False)
    xr.testing.assert_equal(open_results(far.outputs.results).load(), open_results(whole.outputs.results).load())


def test_host_that_cannot_be_reached_is_named_with_what_ssh_said(options, tmp_path):
    wrong = settings(tuple("1" if part.isdigit() else part for part in options), tmp_path)
    with pytest.raises(ClusterError, match="no host starts a worker") as caught, cluster.connect(wrong):
        pass
    assert "Connection refused" in caught.value.got


def test_interface_that_is_not_there(options, tmp_path):
    wrong = ClusterSettings(kind="ssh", interface="none7", ssh=SshSettings(hosts=("127.0.0.1",)))
    with pytest.raises(SettingsError, match="no such network interface"), cluster.connect(wrong):
        pass
