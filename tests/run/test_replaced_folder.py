"""A folder is moved away while a run works in it: nothing is written into what lies in its place, and it is said."""

import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import Scene

from tract_dask.cluster.connect import connect
from tract_dask.errors import DestinationError, TractError
from tract_dask.progress import STAGES, JsonLines, ShardDone, StageDone, StageStarted, Warned
from tract_dask.run import pipeline
from tract_dask.service.data_root import DataRoot
from tract_dask.service.deletion import delete_files
from tract_dask.service.jobs.records import Deletion
from tract_dask.service.jobs.store import JobStore
from tract_dask.service.outputs import Mark, claim, claimed, seal
from tract_dask.settings import ClusterSettings, ConvertSettings, RunSettings
from tract_dask.store import locks
from tract_dask.store.files import remove, write_aside
from tract_dask.store.held import is_held
from tract_dask.store.journal import Journal
from tract_dask.store.locks import sole_use
from tract_dask.store.run_folder import RunFolder
from tract_dask.store.shards import Shard

SETTINGS = RunSettings(convert=ConvertSettings(shard_mb=1), cluster=ClusterSettings(workers=1))
REPLACED = "this folder was replaced while it was worked in"


@pytest.fixture(scope="module")
def client():
    with connect(SETTINGS.cluster) as client:
        yield client


@pytest.fixture(scope="module")
def movie(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("replaced") / "movie.npy"
    np.save(path, Scene(n_frames=40).counts())
    return path


@pytest.fixture(scope="module")
def whole(movie, client) -> Path:
    return pipeline.run(movie, movie.with_name("whole"), SETTINGS, client=client).outputs.root


def state(folder: Path) -> dict[str, tuple[int, bytes]]:
    """What is in a folder, and when it was written."""
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes() if path.is_file() else b"")
        for path in (folder, *folder.rglob("*"))
    }


def by_link(place: Path, other: Path) -> None:
    place.rename(place.with_name(f"{place.name} moved"))
    place.symlink_to(other)


def by_folder(place: Path, other: Path) -> None:
    place.rename(place.with_name(f"{place.name} moved"))
    other.rename(place)


KINDS = pytest.mark.parametrize("replace", [by_link, by_folder])


def is_first(moment: tuple[str, str]) -> Callable[[object], bool]:
    kinds = {"start": StageStarted, "shard": ShardDone, "end": StageDone}
    return lambda event: isinstance(event, kinds[moment[1]]) and event.stage == moment[0]


MOMENTS = [((stage, "start"), by_link) for stage in STAGES]
MOMENTS += [(("convert", "shard"), by_folder), (("fit", "shard"), by_folder), (("fit", "end"), by_link)]


@pytest.mark.parametrize(("moment", "replace"), MOMENTS)
def test_a_run_writes_into_no_other_folder(movie, client, whole, tmp_path, moment, replace):
    other, place, done = tmp_path / "other", tmp_path / "run", []
    shutil.copytree(whole, other)
    before = state(other)

    def watch(event: object) -> None:
        if not done and is_first(moment)(event):
            done.append(event)
            replace(place, other)

    with pytest.raises(DestinationError, match=REPLACED):
        pipeline.run(movie, place, SETTINGS, client=client, on_event=watch)
    assert state(place) == before, "something was written into the other folder"
    if moment == ("fit", "shard"):  # what the message advises
        place.rename(other)
        (tmp_path / "run moved").rename(place)
        assert pipeline.run(movie, place, SETTINGS, client=client).frames == 40


@KINDS
@pytest.mark.parametrize(("store", "moment"), [("movie.zarr", "convert"), ("results.zarr", "fit")])
def test_a_run_writes_into_no_other_store(movie, client, whole, tmp_path, store, moment, replace):
    other, place, done = tmp_path / "other", tmp_path / "run", []
    shutil.copytree(whole, other)
    before = state(other / store)

    def watch(event: object) -> None:
        if not done and is_first((moment, "shard"))(event):
            done.append(event)
            replace(place / store, other / store)

    with pytest.raises(DestinationError, match=REPLACED) as caught:
        pipeline.run(movie, place, SETTINGS, client=client, on_event=watch)
    assert store in caught.value.where
    assert state(place / store) == before


def test_links_that_were_there_are_the_users(movie, client, tmp_path):
    """Who puts the movie on a larger disk, and leads there by a link, may do so."""
    (tmp_path / "large").mkdir()
    pipeline.run(movie, tmp_path / "run", SETTINGS, client=client, until="convert")
    (tmp_path / "run" / "movie.zarr").rename(tmp_path / "large" / "movie.zarr")
    (tmp_path / "run" / "movie.zarr").symlink_to(tmp_path / "large" / "movie.zarr")
    (tmp_path / "linked").symlink_to(tmp_path / "run")
    assert pipeline.run(movie, tmp_path / "linked", SETTINGS, client=client).frames == 40


@KINDS
def test_a_lock_gives_no_sign_of_life_elsewhere(tmp_path, monkeypatch, replace):
    monkeypatch.setattr(locks, "BEAT_S", 0.02)
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    before = state(tmp_path / "b")
    with sole_use(tmp_path / "a" / ".lock", "busy"):
        replace(tmp_path / "a", tmp_path / "b")
        for write in (lambda: write_aside(tmp_path / "a" / "x", b"x"), lambda: remove(tmp_path / "a" / "y")):
            with pytest.raises(DestinationError, match=REPLACED):
                write()
        time.sleep(0.1)
    assert state(tmp_path / "a") == before


def test_no_file_is_written_through_a_link(tmp_path):
    (tmp_path / "secret").write_text("mine")
    (tmp_path / f".x.{os.getpid()}.partial").symlink_to(tmp_path / "secret")
    with pytest.raises(OSError, match="symbolic links"):
        write_aside(tmp_path / "x", b"x")
    assert (tmp_path / "secret").read_text() == "mine"


@KINDS
@pytest.mark.parametrize("name", ["", "store"])
def test_a_line_of_the_journal_is_written_in_its_own_folder_only(tmp_path, replace, name):
    for folder in ("a", "b"):
        (tmp_path / folder / "store").mkdir(parents=True)
    other = Journal(tmp_path / "b" / "store.journal", "key")
    journal, before = Journal(tmp_path / "a" / "store.journal", "key"), state(tmp_path / "b" / name)
    if not name:  # not even where it was prepared for this run
        shutil.copytree(journal.folder, tmp_path / "b" / "store.journal", dirs_exist_ok=True)
        before = state(tmp_path / "b")
    replace(tmp_path / "a" / name, tmp_path / "b" / name)
    with pytest.raises(DestinationError, match=REPLACED):
        journal.record(Shard(0, 0, 1), {})
    assert state(tmp_path / "a" / name) == before
    assert other.key == journal.key


@KINDS
def test_a_job_writes_and_deletes_in_its_own_folder_only(tmp_path, replace):
    root, mark = DataRoot(tmp_path), Mark("ana", "0123456789", "run")
    claim(root, mark)
    claim(root, Mark("ben", "1123456789", "other"))
    (tmp_path / "other" / "run.toml").write_text("ben's")
    before = state(tmp_path / "other")
    with claimed(root, mark):
        replace(tmp_path / "run", tmp_path / "other")
        with pytest.raises(DestinationError, match=REPLACED):
            write_aside(RunFolder(tmp_path / "run").settings, b"ana's")
    with pytest.raises(TractError), claimed(root, mark):
        pass
    seal(root, mark)
    kept = delete_files(root, JobStore(tmp_path / "state" / "service.sqlite"), Deletion("0123456789", "ana", "run"))
    assert kept
    assert state(tmp_path / "run") == before


def test_a_job_follows_no_link_in_its_folder(tmp_path):
    root, mark = DataRoot(tmp_path), Mark("ana", "0123456789", "run")
    claim(root, mark)
    (tmp_path / "other.zarr").mkdir()
    (tmp_path / "run" / "movie.zarr").symlink_to(tmp_path / "other.zarr")
    (tmp_path / "run" / "events.jsonl").symlink_to(tmp_path / "notes.txt")
    with claimed(root, mark), pytest.raises(DestinationError, match=REPLACED):
        write_aside(tmp_path / "run" / "movie.zarr" / "zarr.json", b"{}")
    with claimed(root, mark):
        JsonLines(tmp_path / "run" / "events.jsonl", is_held=is_held)(Warned("something"))
    assert not (tmp_path / "notes.txt").exists()
    assert not any((tmp_path / "other.zarr").iterdir())
