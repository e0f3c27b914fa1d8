"""Runs on a real SLURM of one node, whose jobs are cancelled under them."""

import dataclasses
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import dask
import numpy as np
import pytest
import xarray as xr
from conftest import Scene
from slurm_daemons import slurm_daemons

from tract_dask.cluster import connect as cluster
from tract_dask.cluster import slurm
from tract_dask.cluster.certificates import make_certificates
from tract_dask.errors import ClusterError
from tract_dask.progress import ShardDone
from tract_dask.run import pipeline
from tract_dask.settings import ClusterSettings, ConvertSettings, RunSettings, SlurmSettings
from tract_dask.store.results import open_results

pytestmark = pytest.mark.timeout(600)  # many processes start: minutes where a machine is busy

CONVERT = ConvertSettings(shard_mb=1)


@pytest.fixture(scope="module")
def daemons():
    with slurm_daemons() as config, pytest.MonkeyPatch.context() as patch:
        patch.setenv("SLURM_CONF", str(config))
        yield config


@pytest.fixture
def settings(daemons, tmp_path) -> ClusterSettings:
    """One worker of one SLURM job, so that nothing goes on until another job follows it."""
    make_certificates(tmp_path / "certificates")
    return ClusterSettings(
        kind="slurm",
        workers=1,
        memory_limit="1GB",
        tls=str(tmp_path / "certificates"),
        interface="lo",
        local_directory=str(tmp_path),
        slurm=SlurmSettings(queue="test", walltime="10", log_directory=str(tmp_path), directives=("--comment=test",)),
    )


def jobs(form: str = "%i") -> list[str]:
    command = ["squeue", "--noheader", f"--format={form}", "--states=PENDING,RUNNING"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()


def wait_for(true, seconds: float = 30.0) -> None:
    deadline = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_cancelled_job_is_followed_by_another_and_the_run_ends_as_if_nothing_had_been(settings, tmp_path):
    movie = tmp_path / "movie.npy"
    np.save(movie, Scene(n_frames=48).counts())
    seen = []

    def cancel_the_first(event):
        if isinstance(event, ShardDone):
            queued = jobs()
            if not seen:
                subprocess.run(["scancel", *queued], check=True)
            seen.append((event.stage, queued))

    far = RunSettings(convert=CONVERT, cluster=settings)
    hurt = pipeline.run(movie, tmp_path / "hurt", far, on_event=cancel_the_first, report=False)
    assert hurt.state == "done"
    (first, (cancelled,)), (last, (follower,)) = seen[0], seen[-1]
    assert (first, last) == ("convert", "fit")
    assert follower != cancelled
    assert jobs() == []  # the last ends with the run
    here = ClusterSettings(workers=1)
    whole = pipeline.run(movie, tmp_path / "whole", RunSettings(convert=CONVERT, cluster=here), report=False)
    xr.testing.assert_identical(
        open_results(hurt.outputs.results).load().drop_attrs(), open_results(whole.outputs.results).load().drop_attrs()
    )


def test_a_place_that_dask_has_given_up_is_filled_again(settings, monkeypatch):
    monkeypatch.setattr(slurm, "_LOOK_S", 3.0)  # so that Dask notices first that the worker has gone
    lost_at_once = dask.config.set({"distributed.deploy.lost-worker-timeout": "100ms"})
    with lost_at_once, cluster.hold(settings) as held, held.get_client() as client:
        wait_for(client.nthreads, 60.0)
        cancelled = jobs()
        subprocess.run(["scancel", *cancelled], check=True)
        wait_for(lambda: len(jobs()) == 1 and jobs() != cancelled, 60.0)


def test_jobs_come_with_clients_and_go_after_them(settings, monkeypatch):
    monkeypatch.setattr(slurm, "_IDLE_S", 0.5)
    monkeypatch.setattr(slurm, "_LOOK_S", 0.1)
    settings = dataclasses.replace(settings, min_workers=0)
    with cluster.hold(settings) as held:
        wait_for(lambda: jobs() == [])
        with held.get_client():
            wait_for(lambda: len(jobs()) == 1)
            # asked of SLURM: the worker's memory and 256 MB for the process that watches it
            assert jobs("%P_%m_%l_%k") == ["test_1198M_10:00_test"]
        wait_for(lambda: jobs() == [])


def test_ctrl_c_is_answered_as_before(settings, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "dask_jobqueue"]:
        monkeypatch.delitem(sys.modules, name)
    wrong = dataclasses.replace(settings, slurm=SlurmSettings(queue="nowhere"))
    with ThreadPoolExecutor(1) as threads, pytest.raises(ClusterError, match="in the main thread"):
        threads.submit(cluster.connect(wrong).__enter__).result()
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(ClusterError, match="invalid partition"), cluster.connect(wrong):
        pass
    assert signal.getsignal(signal.SIGINT) == before


def test_what_slurm_refuses_is_told(settings):
    wrong = dataclasses.replace(settings, slurm=SlurmSettings(queue="nowhere"))
    with pytest.raises(ClusterError, match="invalid partition") as caught, cluster.connect(wrong):
        pass
    assert "sbatch" in caught.value.where
