"""Runs that lose processes: killed whole, killed in part, and spread over processes that were started by hand."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from conftest import Scene

from tract_dask.cluster.connect import connect
from tract_dask.progress import ShardDone
from tract_dask.run import pipeline
from tract_dask.service import deletion
from tract_dask.settings import ClusterSettings, ConvertSettings, RunSettings
from tract_dask.store import files, run_folder
from tract_dask.store.results import open_results

ROOT = Path(__file__).parents[2]
SETTINGS = RunSettings(convert=ConvertSettings(shard_mb=1), cluster=ClusterSettings(workers=2))


@pytest.fixture(scope="module")
def movie(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("resume") / "movie.npy"
    np.save(path, Scene(n_frames=48).counts())
    return path


@pytest.fixture(scope="module")
def client():
    with connect(SETTINGS.cluster) as client:
        yield client


@pytest.fixture(scope="module")
def whole(movie, client) -> pipeline.RunOutcome:
    """What an uninterrupted run gives."""
    return pipeline.run(movie, movie.with_name("whole"), SETTINGS, client=client)


@pytest.mark.parametrize(
    ("name", "delete"),
    [("movie.zarr", files.remove), ("results.zarr", files.remove), ("movie.zarr", deletion._remove)],
)
def test_a_deletion_that_was_interrupted_is_no_damage(movie, client, whole, tmp_path, monkeypatch, name, delete):
    outputs = run_folder.RunFolder(tmp_path / "run")
    shutil.copytree(whole.outputs.root, outputs.root)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", killed_at)
        patch.setattr(os, "walk", killed_at)
        with pytest.raises(KeyboardInterrupt):
            delete(outputs.root / name)
    again = pipeline.run(movie, outputs.root, SETTINGS, client=client)
    assert open_results(again.outputs.results).equals(open_results(whole.outputs.results))


def killed_at(path: Path, **_: object) -> None:
    """Delete the metadata of an array in a store, and stop."""
    inside = path if path.suffix != ".zarr" else next(item for item in path.iterdir() if item.is_dir())
    (inside / "zarr.json").unlink()
    raise KeyboardInterrupt


@pytest.mark.slow
def test_killed_runs_end_as_an_uninterrupted_one(movie, tmp_path):
    options = [
        "--moments",
        "1",
        "--stage",
        "fit",
        "--movie",
        movie,
        "--shard-mb",
        "1",
        "--workers",
        "1",
        "--folder",
        tmp_path,
    ]
    found = subprocess.run(
        [sys.executable, ROOT / "scripts" / "kill_test", *options], capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, found.stdout + found.stderr
    assert "1 of 1 identical" in found.stdout


def test_killed_worker_is_replaced_and_nothing_is_lost(movie, client, whole, tmp_path):
    killed = []

    def kill_once_in_a_stage(event):
        if isinstance(event, ShardDone) and event.stage in {"convert", "fit"} - set(killed):
            killed.append(event.stage)
            pid = min(client.run(os.getpid).values())
            os.kill(pid, signal.SIGKILL)

    hurt = pipeline.run(movie, tmp_path / "hurt", SETTINGS, client=client, on_event=kill_once_in_a_stage)
    assert killed == ["convert", "fit"]
    assert hurt.fits == whole.fits
    xr.testing.assert_equal(open_results(whole.outputs.results).load(), open_results(hurt.outputs.results).load())


@pytest.mark.slow
def test_scheduler_and_workers_started_by_hand_give_the_same_results(movie, whole, tmp_path):
    file = tmp_path / "scheduler.json"
    options = ["--scheduler-file", str(file), "--no-dashboard"]
    commands = [["scheduler", "--port", "0", *options]] + 2 * [
        ["worker", "--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path), *options]
    ]
    processes = []
    try:
        for command in commands:
            processes.append(
                subprocess.Popen([sys.executable, "-m", "dask", *command], cwd=tmp_path, stderr=subprocess.DEVNULL)
            )
            while not file.exists() or not file.read_text():
                assert processes[0].poll() is None
                time.sleep(0.02)
        far = ClusterSettings(scheduler_file=str(file))
        spread = pipeline.run(movie, tmp_path / "far", RunSettings(convert=SETTINGS.convert, cluster=far))
    finally:
        for process in processes:
            process.kill()
            process.wait()
    xr.testing.assert_equal(open_results(spread.outputs.results).load(), open_results(whole.outputs.results).load())
