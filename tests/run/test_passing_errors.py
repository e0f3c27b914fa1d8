"""Errors of file systems that pass, met by the process that drives a run: it goes on by itself, and says so."""

import errno
import os
import shutil
import sys
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path

import dask
import numpy as np
import pytest
from conftest import Scene

from tract_dask.cluster import retries
from tract_dask.cluster.connect import connect
from tract_dask.errors import ClusterError, StoreError, TractError
from tract_dask.progress import ShardDone, StageStarted, Warned
from tract_dask.run import one_stage, pipeline
from tract_dask.settings import ClusterSettings, ConvertSettings, RunSettings
from tract_dask.store import run_folder
from tract_dask.store.results import open_results

SETTINGS = RunSettings(convert=ConvertSettings(shard_mb=1), cluster=ClusterSettings(workers=2))
CALLS = {"open", "os.rename", "os.mkdir"}


class Faults:
    """Lets calls of the system fail in this process, of those that Python audits.

    ``left`` tells, for each call and pattern of paths, how often it is still to fail.
    """

    def __init__(self) -> None:
        self.left: dict[tuple[str, str], int] = {}
        self.number = errno.EIO
        sys.addaudithook(self.audit)

    def begin(self, *places: tuple[str, str], number: int = errno.EIO, times: int = 1) -> None:
        self.left, self.number = dict.fromkeys(places, times), number

    def audit(self, call: str, arguments: tuple[object, ...]) -> None:
        if self.left and call in CALLS and isinstance(arguments[0], str | bytes | os.PathLike):
            self.look(call, os.fsdecode(arguments[0]))

    def look(self, call: str, path: str) -> None:
        for place, left in self.left.items():
            if left and place[0] == call and fnmatch(path, f"*{place[1]}*"):
                self.left[place] -= 1
                raise OSError(self.number, os.strerror(self.number), path)


HARM = Faults()  # an audit hook stays for ever


@pytest.fixture
def faults():
    with dask.config.set({retries.RETRY: 0.01}):
        yield HARM
    HARM.left = {}


@pytest.fixture(scope="module")
def movie(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("passing") / "movie.npy"
    np.save(path, Scene(n_frames=40).counts())
    return path


@pytest.fixture(scope="module")
def client():
    with connect(SETTINGS.cluster) as client:
        yield client


@pytest.fixture(scope="module")
def whole(movie, client) -> run_folder.RunFolder:
    """What an undisturbed run makes."""
    return pipeline.run(movie, movie.with_name("whole"), SETTINGS, client=client).outputs


@pytest.fixture
def run(movie, client) -> Callable[[Path], list[str]]:
    """Make a run in a folder; return its warnings."""

    def start(folder: Path, on_event=lambda event: None, **more) -> list[str]:
        told = []

        def send(event: object) -> None:
            if isinstance(event, Warned):
                told.append(event.message)
            on_event(event)

        pipeline.run(movie, folder, SETTINGS, client=client, on_event=send, **more)
        return told

    return start


def check(whole: run_folder.RunFolder, folder: Path) -> None:
    made = run_folder.RunFolder(folder)
    assert open_results(made.results).equals(open_results(whole.results))
    assert made.columns.read_bytes() == whole.columns.read_bytes()
    assert not list(folder.glob("*.journal"))


PLACES = [
    ("open", "/movie.npy"),  # the source is opened
    ("open", "/.lock"),
    ("open", "/.run.toml."),
    ("os.mkdir", "movie.zarr.journal/"),
    ("open", "movie.zarr.journal/.key."),
    ("open", "movie.zarr.journal/*.jsonl"),
    ("open", ".movie.zarr.partial/.zarr.json."),  # the metadata of a store are written
    ("open", "/movie.zarr/frame_mean/"),
    ("open", "drift.zarr/zarr.json"),
    ("os.rename", ".drift.zarr.partial"),
    ("open", "sum.zarr.journal"),
    ("os.rename", "/sum.zarr.journal"),  # the journal is taken away
    ("os.rename", "/.columns.csv.*.partial"),
    ("os.rename", "/.columns.png.*.partial.png"),
    ("open", "columns.zarr/"),
    ("open", "results.zarr/zarr.json"),
    ("os.rename", "results.zarr"),
    ("open", "/.report.html."),
]


def test_a_run_goes_on_after_errors_that_pass(faults, run, whole, tmp_path):
    faults.begin(*PLACES, number=errno.ESTALE)
    told = run(tmp_path / "run")
    assert not any(faults.left.values()), "these have not failed"
    assert len(told) == len(PLACES)
    for _, match in PLACES:
        assert any(fnmatch(said, f"*{match}*: Stale file handle (ESTALE); it is tried again in * s") for said in told)
    check(whole, tmp_path / "run")


def test_a_sync_that_fails_is_said_with_its_file(faults, run, whole, tmp_path, monkeypatch):
    sync, failed = os.fsync, []

    def fail_once(handle: int) -> None:
        if "drift.zarr" in str(Path(f"/proc/self/fd/{handle}").readlink()) and not failed:
            failed.append(handle)
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        sync(handle)

    monkeypatch.setattr(os, "fsync", fail_once)
    (told,) = run(tmp_path / "run")
    assert failed
    assert "drift.zarr" in told
    check(whole, tmp_path / "run")


def test_it_is_tried_several_times(faults, run, whole, tmp_path):
    faults.begin(("open", ".sum.zarr.partial/.zarr.json."), number=errno.ETIMEDOUT, times=retries.MOST_TRIES - 1)
    assert len(run(tmp_path / "run")) == retries.MOST_TRIES - 1
    check(whole, tmp_path / "run")


def test_what_does_not_pass_ends_the_run_with_the_file_and_is_gone_on_with(faults, run, whole, tmp_path):
    told = []
    faults.begin(("open", "drift.zarr/zarr.json"), times=10**6)
    with pytest.raises(StoreError, match="Input/output error") as caught:
        run(tmp_path / "run", told.append)
    assert sum(isinstance(event, Warned) for event in told) == retries.MOST_TRIES - 1
    assert caught.value.where.endswith("run/drift.zarr/zarr.json")
    faults.left = {}
    assert not run(tmp_path / "run")
    check(whole, tmp_path / "run")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES])
def test_a_full_disk_ends_the_run_at_once(faults, run, tmp_path, number):
    faults.begin(("open", "movie.zarr.journal/.key."), number=number, times=10)
    with pytest.raises(TractError, match=os.strerror(number)):
        run(tmp_path / "run")
    assert sum(faults.left.values()) == 9


def test_overwriting_goes_on_too(faults, run, whole, tmp_path):
    shutil.copytree(whole.root, tmp_path / "run")
    faults.begin(("os.rename", "/drift.zarr"), number=errno.ENOTCONN)
    (told,) = run(tmp_path / "run", overwrite=True)
    assert "drift.zarr.journal: Transport endpoint is not connected (ENOTCONN)" in told
    check(whole, tmp_path / "run")


@pytest.mark.parametrize("number", [errno.EIO, errno.EPIPE])
def test_what_the_sink_raises_ends_the_run_at_once(faults, run, tmp_path, number):
    asked = []

    def refuse(event: object) -> None:
        if isinstance(event, StageStarted):
            asked.append(event)
            raise OSError(number, os.strerror(number))

    with pytest.raises((OSError, StoreError)):
        run(tmp_path / "run", refuse)
    assert len(asked) == 1


def test_a_stage_alone_goes_on_too(faults, movie, client, tmp_path):
    told = []
    faults.begin(("os.rename", ".movie.zarr.partial"))
    made = one_stage.run_convert(movie, tmp_path / "movie.zarr", SETTINGS, client=client, on_event=told.append)
    assert made.n_frames == 40
    assert sum(isinstance(event, Warned) for event in told) == 1
    assert sum(event.frames for event in told if isinstance(event, ShardDone)) == 40


def test_waits_grow_and_can_be_interrupted(monkeypatch):
    waited = []

    def wait(seconds: float) -> None:
        waited.append(seconds)
        if len(waited) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(retries, "sleep", wait)
    with pytest.raises(KeyboardInterrupt):
        retries.persist(fail, lambda event: None, "movie.tif")
    assert waited == [1.0, 2.0, 4.0]


def fail() -> None:
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def test_what_a_cluster_raises_is_not_tried_again():
    asked = []

    def lose() -> None:
        asked.append(1)
        raise ClusterError("the cluster has gone") from ConnectionResetError(errno.ECONNRESET, "reset")

    with pytest.raises(ClusterError):
        retries.persist(lose, lambda event: None, "movie.tif")
    assert len(asked) == 1
