"""The journal and the disk: nothing is done before it is on disk, and no run writes into the next one's store."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from conftest import store_fits
from hypothesis import HealthCheck, given
from hypothesis import settings as limits
from hypothesis import strategies as st

from tract_dask import convert, open_movie, open_results
from tract_dask.cluster import tasks
from tract_dask.errors import StoreError
from tract_dask.progress import ShardDone, Warned
from tract_dask.settings import ColumnSettings, ConvertSettings, DriftSettings, FitSettings, to_toml
from tract_dask.stages.columns.detect import detect_columns
from tract_dask.stages.drift.stage import drift_stage, estimate_drift
from tract_dask.stages.fit import join
from tract_dask.stages.fit.job import prepare
from tract_dask.stages.fit.stage import fit_movie
from tract_dask.stages.sum import sum_image, sum_stage
from tract_dask.store import datasets, disk, metadata, parts, results, schema
from tract_dask.store import files as store_files
from tract_dask.store.arrays import load_saved, save_array
from tract_dask.store.journal import Journal, entries, journal_beside
from tract_dask.store.shard_files import crc32c
from tract_dask.store.shards import Shard, split

SMALL = ConvertSettings(tile_px=32)


class Stopped(BaseException):
    """The process ends here."""


def stop_after(count: int) -> Callable[[Any], None]:
    left = [count]

    def watch(event):
        if isinstance(event, ShardDone):
            left[0] -= 1
            if not left[0]:
                raise Stopped

    return watch


@pytest.fixture
def source(scene, npy):
    return npy(scene.counts())


@pytest.fixture
def movie(source, tmp_path):
    return open_movie(convert(source, tmp_path / "movie.zarr", settings=SMALL))


@dataclass
class Stage:
    """A stage: how it is run into a place, with one setting or another, and what it made there."""

    run: Callable[..., Any]
    made: Callable[[Path], Any]
    variants: tuple[Any, Any]


@pytest.fixture(params=["convert", "fit", "sum", "drift", "detect"])
def stage(request, scene, source, movie) -> Stage:
    """A stage with two settings that give different results, written to ``place`` or, of arrays, beside it."""

    def converted(place, settings, on_event=lambda event: None):
        return convert(source, place, settings=settings, overwrite=True, on_event=on_event)

    def frames(place):
        opened = open_movie(place)
        found = {"frames": opened.read(0, opened.n_frames), "binned": opened.read_binned(4, 0, opened.n_frames)}
        return xr.Dataset({name: ((f"{name}t", f"{name}y", f"{name}x"), of) for name, of in found.items()})

    def fitted(place, settings, on_event=lambda event: None):
        columns = scene.columns()
        job = prepare(movie, columns, scene.drift_dataset(), settings)
        return fit_movie(movie, job, place, on_event=on_event)

    def tracks(place):
        return open_results(place).drop_attrs().load()

    kept: dict[Path, Any] = {}

    def keeping(function, *args, **how):
        def run(place, settings, on_event=lambda event: None):
            folder = journal_beside(place)
            kept[place] = function(*args, **how, **settings, journal=folder, on_event=on_event)

        return run

    drifts = [scene.drift_dataset(), scene.drift_dataset()]
    drifts[1]["drift"] = drifts[1]["drift"] + 3.0
    return {
        "convert": Stage(converted, frames, (SMALL, ConvertSettings(tile_px=32, codec="none"))),
        "fit": Stage(fitted, tracks, (FitSettings(), FitSettings(intensity_scale="ellipse"))),
        "sum": Stage(keeping(sum_image, movie), kept.get, ({"drift": drifts[0]}, {"drift": drifts[1]})),
        "drift": Stage(
            keeping(estimate_drift, movie),
            kept.get,
            ({"settings": DriftSettings(search_px=3.0)}, {"settings": DriftSettings(search_px=5.0)}),
        ),
        "detect": Stage(
            keeping(detect_columns, movie),
            kept.get,
            tuple({"settings": ColumnSettings(spacing_px=20.0, detection_threshold=of)} for of in (3.0, 12.0)),
        ),
    }[request.param]


@pytest.fixture
def work(monkeypatch):
    """The task, the shards and the journal of every piece of work that is done, in order."""
    seen, real = [], tasks._work

    def spy(task, shards, journal, batch):
        seen.append((task, shards, journal))
        return real(task, shards, journal, batch)

    monkeypatch.setattr(tasks, "_work", spy)
    return seen


def overtaken(task, shard, journal, next_run, folder) -> set[str]:
    """Run a task during which another run begins, in a thread without an open batch; return the files at its end."""
    files = set()

    def both(shard):
        payload = task(shard)
        with ThreadPoolExecutor(1) as pool:
            pool.submit(next_run).result()
        files.update(files_under(folder))
        return payload

    with pytest.raises(StoreError, match="left over"):
        tasks._work(both, {shard.index: shard}, journal, np.array([shard.index]))
    return files


def files_under(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if "whole" not in str(path)}


# Tasks of earlier runs


@pytest.mark.parametrize("after", ["its end", "two shards"])
def test_a_task_of_an_earlier_run_writes_nothing(stage, work, tmp_path, after):
    one, other = stage.variants
    place = tmp_path / "out.zarr"
    with pytest.raises(Stopped):
        stage.run(place, one, on_event=stop_after(2))
    task, shards, journal = work[-1]
    work.clear()

    def next_run():
        if after == "its end":
            stage.run(place, other)
        else:
            with pytest.raises(Stopped):
                stage.run(place, other, on_event=stop_after(2))

    files = overtaken(task, shards[4], journal, next_run, tmp_path)
    assert files_under(tmp_path) == files
    assert all(4 not in newer.done() for _, _, newer in work[-1:] if after == "two shards")
    with pytest.raises(StoreError, match="left over"):
        tasks._work(task, shards, journal, np.array([5]))
    assert files_under(tmp_path) == files
    stage.run(place, other)
    stage.run(tmp_path / "whole.zarr", other)
    xr.testing.assert_equal(stage.made(place), stage.made(tmp_path / "whole.zarr"))


def test_the_same_settings_begun_anew_are_another_run(stage, work, tmp_path):
    place = tmp_path / "out.zarr"
    with pytest.raises(Stopped):
        stage.run(place, stage.variants[0], on_event=stop_after(2))
    task, shards, journal = work[-1]

    def begin_anew():
        store_files.remove(place)
        store_files.remove(journal_beside(place))
        with pytest.raises(Stopped):
            stage.run(place, stage.variants[0], on_event=stop_after(1))

    overtaken(task, shards[4], journal, begin_anew, tmp_path)
    assert sum(1 for _ in work[-1][2].sound(shards)) == 1


def test_a_task_makes_no_journal_that_was_removed(tmp_path):
    journal = Journal(tmp_path / "j", "key")
    journal.remove()
    with pytest.raises(StoreError, match="the run is over"):
        journal.record(Shard(0, 0, 1), {})
    assert not list(tmp_path.iterdir())


def test_a_reader_begins_no_run(tmp_path):
    Journal(tmp_path / "j", "key")
    assert Journal.existing(tmp_path / "j", "other") is None
    assert Journal.existing(tmp_path / "j", "key").path.is_dir()


# What is on disk


def missing(file: Path, start: int, end: int) -> None:
    file.unlink()


def empty(file: Path, start: int, end: int) -> None:
    file.write_bytes(b"")


def torn(file: Path, start: int, end: int) -> None:
    os.truncate(file, end - 7)


def zeroed(file: Path, start: int, end: int) -> None:
    with file.open("r+b") as opened:
        opened.seek(start)
        opened.write(bytes(end - start))


def other_bytes(file: Path, start: int, end: int) -> None:
    with file.open("r+b") as opened:
        opened.seek(max(start, end - 20))
        opened.write(b"something else")


@pytest.mark.parametrize(
    ("hurt", "which"), [(missing, 0), (missing, -1), (empty, 0), (torn, -1), (zeroed, 0), (other_bytes, -1)]
)
def test_a_shard_that_is_not_on_disk_is_made_again(stage, work, tmp_path, hurt, which):
    place = tmp_path / "out.zarr"
    with pytest.raises(Stopped):
        stage.run(place, stage.variants[0], on_event=stop_after(3))
    _, shards, journal = work[-1]
    found = {index: marks for index, _, marks in journal.sound(shards)}
    name, end, _ = found[2][which]
    start = max(0, end - 60)
    hurt(journal.path / name, start, end)
    again = []
    stage.run(place, stage.variants[0], on_event=again.append)
    assert 2 in {event.shard for event in again if isinstance(event, ShardDone)}
    stage.run(tmp_path / "whole.zarr", stage.variants[0])
    xr.testing.assert_equal(stage.made(place), stage.made(tmp_path / "whole.zarr"))


def test_a_shard_that_is_lost_while_the_stage_runs_is_made_again(stage, work, tmp_path):
    place, lost = tmp_path / "out.zarr", []

    def lose_the_second(event):
        if isinstance(event, ShardDone) and event.shard == 3 and not lost:
            _, shards, journal = work[-1]
            lost.append({index: marks for index, _, marks in journal.sound(shards)}[1][0][0])
            os.truncate(journal.path / lost[0], 10)

    stage.run(place, stage.variants[0], on_event=lose_the_second)
    assert lost
    stage.run(tmp_path / "whole.zarr", stage.variants[0])
    xr.testing.assert_equal(stage.made(place), stage.made(tmp_path / "whole.zarr"))


def test_a_disk_that_loses_what_is_written_ends_the_stage(tmp_path):
    def lose(shard):
        save_array(journal.path / f"{shard.index}.npy", np.zeros(3))
        return {}

    def vanish(shard, payload):
        (journal.path / f"{shard.index}.npy").unlink()

    journal = Journal(tmp_path / "j", "key")
    said: list[Any] = []
    with pytest.raises(StoreError, match="10 shards of stage lose were written, and are not on disk"):
        tasks.stream_shards(
            lose, split(10, 1), lambda *_: None, journal=journal, name="lose", on_done=vanish, on_event=said.append
        )
    assert [event.message.partition(":")[2] for event in said] == [" they are made again"] * 2


def test_files_are_synced_before_they_are_renamed_and_renamed_before_they_are_journaled(tmp_path, monkeypatch):
    journal, seen = Journal(tmp_path / "j", "key"), []
    place = tmp_path / "array.npy"
    real, replace = disk.sync, Path.replace

    def state():
        return place.exists(), len(journal.done())

    def sync(path):
        seen.append(("sync", path.suffix, *state()))
        real(path)

    def renamed(self, target):
        seen.append(("rename", self.suffix, *state()))
        return replace(self, target)

    monkeypatch.setattr(disk, "sync", sync)
    monkeypatch.setattr(Path, "replace", renamed)
    with journal.batch() as done:
        save_array(place, np.arange(5))
        done(Shard(0, 0, 1), {})
    assert seen == [("sync", ".partial", False, 0), ("rename", ".partial", False, 0)]
    assert state() == (True, 1)


def test_of_a_batch_that_fails_the_shards_before_are_kept(tmp_path):
    journal = Journal(tmp_path / "j", "key")

    def task(shard):
        save_array(journal.path / f"{shard.index}.npy", np.zeros(3))
        if shard.index == 2:
            raise StoreError("the third shard is damaged")
        return {}

    with pytest.raises(StoreError, match="third shard"):
        tasks._work(task, split(5, 1), journal, np.arange(5))
    assert {index for index, _, _ in journal.sound(split(5, 1))} == {0, 1}
    assert sorted(path.name for path in journal.path.glob("*[!l]")) == ["0.npy", "1.npy"]


def test_arrays_that_are_damaged_are_refused(tmp_path):
    array = np.arange(12.0).reshape(3, 4).T
    save_array(tmp_path / "a.npy", array)
    np.testing.assert_array_equal(load_saved(tmp_path / "a.npy"), array)
    good = (tmp_path / "a.npy").read_bytes()
    for place in (22, 60, 140, len(good) - 1):
        (tmp_path / "a.npy").write_bytes(good[:place] + bytes([good[place] ^ 2]) + good[place + 1 :])
        with pytest.raises(StoreError, match="missing, or damaged"):
            load_saved(tmp_path / "a.npy")


# Lines of the journal

COUNTS = {"fits": (), "drift": (None, 2)}
GOOD = {"fits": 3, "drift": [[0.0, 1.0]] * 4}


def line(entry: Any) -> bytes:
    text = json.dumps(entry).encode() if not isinstance(entry, bytes) else entry
    return b"%08x %b\n" % (crc32c(text), text)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@limits(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150, deadline=None)
@given(
    noise=st.lists(st.binary(max_size=80) | json_values.map(line) | st.binary(max_size=40).map(line), max_size=6),
    torn=st.integers(0, 60),
)
def test_absurd_lines_are_skipped(tmp_path_factory, noise, torn):
    shards = split(12, 4)
    journal = Journal(tmp_path_factory.mktemp("j") / "j", "key", COUNTS)
    journal.record(shards[1], GOOD)
    (log,) = journal.path.glob("*.jsonl")
    whole = log.read_bytes()
    log.write_bytes(b"\n".join(noise) + b"\n" + whole[: max(1, len(whole) - 2 - torn)])
    journal.record(shards[2], GOOD)
    journal.record(shards[2], GOOD)
    (journal.path / "foreign.jsonl").write_bytes(b"\n".join(noise))
    found = [index for index, _, _ in journal.sound(shards)]
    assert found.count(2) == 1
    assert set(found) <= {1, 2}
    assert journal.frames_done(shards) == 4 * len(found)
    list(entries(journal.folder))


@pytest.mark.parametrize(
    "entry",
    [
        [3, GOOD, []],
        [-1, GOOD, []],
        [10**30, GOOD, []],
        [True, GOOD, []],
        [1.0, GOOD, []],
        ["1", GOOD, []],
        [1, GOOD],
        [1, GOOD, [], []],
        [1, {}, []],
        [1, {"fits": 3}, []],
        [1, {"fits": "3", "drift": GOOD["drift"]}, []],
        [1, {"fits": 3, "drift": GOOD["drift"][:3]}, []],
        [1, {"fits": 3, "drift": [[0.0], [1.0, 2.0]]}, []],
        [1, [GOOD], []],
        [1, GOOD, [["gone", 3, 5]]],
        [1, GOOD, [["../key", -1, 5]]],
        [1, GOOD, [["\0", 1, 5]]],
        [1, GOOD, [["key"]]],
        [1, GOOD, 7],
        {"index": 1},
        b"[" * 100_000,
        b"\xff\xfe",
    ],
    ids=lambda entry: repr(entry)[:40],
)
def test_an_entry_that_cannot_be_is_none(tmp_path, entry):
    journal = Journal(tmp_path / "j", "key", COUNTS)
    (journal.path / "x.jsonl").write_bytes(line(entry) + line([0, GOOD, []]))
    assert [index for index, _, _ in journal.sound(split(12, 4))] == [0]


def test_a_huge_line_is_skipped(tmp_path, monkeypatch):
    monkeypatch.setattr("tract_dask.store.journal._LINE_BYTES", 1000)
    journal = Journal(tmp_path / "j", "key")
    (journal.path / "x.jsonl").write_bytes(
        b"x" * 5000 + line([2, {}, []]) + line([0, {}, []]) + line([1, {"long": "x" * 2000}, []])
    )
    assert [index for index, _, _ in journal.sound(split(12, 4))] == [0]


def test_a_line_that_was_changed_is_none(tmp_path):
    journal = Journal(tmp_path / "j", "key")
    journal.record(Shard(1, 4, 8), {"fits": 3})
    (log,) = journal.path.glob("*.jsonl")
    log.write_bytes(log.read_bytes().replace(b"3}", b"8}"))
    assert not journal.done()


@pytest.mark.parametrize("key", [b"", b"key", b"key\n", b"\xff\xfe\n\xff", b"key\nrun\nmore", b"key\ngone"])
def test_a_key_file_that_makes_no_sense_begins_a_new_run(tmp_path, key):
    journal = Journal(tmp_path / "j", "key")
    journal.record(Shard(0, 0, 1), {})
    (tmp_path / "j" / "key").write_bytes(key)
    assert not Journal(tmp_path / "j", "key").done()


# The fits


def fit(movie, scene, place, **more):
    columns = scene.columns()
    return fit_movie(movie, prepare(movie, columns, scene.drift_dataset(), FitSettings()), place, **more)


def same(one: Path, other: Path) -> None:
    xr.testing.assert_equal(open_results(one).drop_attrs().load(), open_results(other).drop_attrs().load())


def test_results_are_few_files_that_any_reader_opens(scene, tmp_path):
    place, columns, rng = tmp_path / "results.zarr", scene.columns(), np.random.default_rng(0)
    sizes = {"frame": 199, "column_id": columns.sizes["column_id"]} | schema.SIZES
    values = {name: rng.random([sizes[dim] for dim in schema.RESULTS[name].dims]) for name in parts.SHARDED}
    about = {"key": "key", "settings": to_toml(FitSettings(blur_sigma_px=2.0)), "window": 19, "reference_blur_px": 2.0}
    results.create(place, columns, np.zeros((199, 2)), np.arange(199.0), 2, **about)
    store_fits(place, values, 2)
    assert sum(1 for _ in place.rglob("*")) < 1.2 * 100
    assert [path.name for path in tmp_path.iterdir()] == ["results.zarr"]
    anybody = xr.open_zarr(place, consolidated=False).load()
    for name in parts.SHARDED:
        np.testing.assert_array_equal(anybody[name], values[name].astype(schema.RESULTS[name].dtype))
        stored = datasets.open_array(place / name)
        assert (stored.chunks[0], stored.shards[0]) == (2, 128)
        assert len(list((place / name).iterdir())) == 3


@pytest.mark.parametrize("calls", [1, 7, 13])
def test_a_run_that_is_killed_while_it_joins_files_goes_on(movie, scene, tmp_path, monkeypatch, calls):
    place, left = tmp_path / "results.zarr", [calls]
    fit(movie, scene, tmp_path / "whole.zarr")

    def killed(aside, path):
        left[0] -= 1
        if not left[0]:
            raise Stopped
        aside.replace(path)

    with monkeypatch.context() as patch:
        patch.setattr(disk, "place", killed)
        with pytest.raises(Stopped):
            fit(movie, scene, place)
    shown = open_results(place, unfinished=True).drop_attrs().load()
    xr.testing.assert_equal(shown, open_results(tmp_path / "whole.zarr").drop_attrs().load())
    events = []
    fit(movie, scene, place, on_event=events.append)
    assert not any(isinstance(event, ShardDone) for event in events)
    same(place, tmp_path / "whole.zarr")
    assert sorted(path.name for path in tmp_path.glob("*res*")) == ["results.zarr"]


def test_many_files_are_joined_and_gone_on_with(movie, scene, tmp_path, monkeypatch):
    place = tmp_path / "results.zarr"
    fit(movie, scene, tmp_path / "whole.zarr")
    monkeypatch.setattr("tract_dask.store.results._FILE_SHARDS", (4, 4))
    real, joined = join._join_task, []

    def once(job, file):
        if joined:
            raise Stopped
        joined.append(file.index)
        return real(job, file)

    with monkeypatch.context() as patch:
        patch.setattr(join, "_join_task", once)
        with pytest.raises(Stopped):
            fit(movie, scene, place)
    monkeypatch.setattr(join, "_join_task", lambda job, file: joined.append(file.index) or real(job, file))
    fit(movie, scene, place)
    assert joined == [0, 1]
    same(place, tmp_path / "whole.zarr")


def test_fits_that_are_damaged_before_they_are_joined_are_made_again(movie, scene, tmp_path, monkeypatch):
    place, real = tmp_path / "results.zarr", join.join
    monkeypatch.setattr("tract_dask.store.journal._TAIL_BYTES", 150)
    fit(movie, scene, tmp_path / "whole.zarr")

    def damaged(path, journal, *args):
        monkeypatch.setattr("tract_dask.stages.fit.stage.join", real)
        for index, _, ((name, end, _),) in journal.sound(movie.shards):
            if index in (2, 5):
                zeroed(journal.path / name, end - 400, end - 390)  # before what is looked at in the journal
        real(path, journal, *args)

    monkeypatch.setattr("tract_dask.stages.fit.stage.join", damaged)
    events = []
    assert fit(movie, scene, place, on_event=events.append).fits == scene.n_frames * len(scene.place)
    assert [event.shard for event in events if isinstance(event, ShardDone)] == [*range(len(movie.shards)), 2, 5]
    assert any(isinstance(event, Warned) and "damaged" in event.message for event in events)
    same(place, tmp_path / "whole.zarr")


def test_a_store_that_is_not_finished_shows_what_is(movie, scene, tmp_path):
    fit(movie, scene, tmp_path / "whole.zarr")
    with pytest.raises(Stopped):
        fit(movie, scene, tmp_path / "results.zarr", on_event=stop_after(3))
    found = open_results(tmp_path / "results.zarr", unfinished=True)
    whole, done = open_results(tmp_path / "whole.zarr"), movie.shards[3].start
    xr.testing.assert_equal(found.isel(frame=slice(done)).load(), whole.isel(frame=slice(done)).load())
    assert np.isnan(found["fit"][done:]).all()
    assert (found["status"][done:] == schema.Status.NOT_CONVERGED).all()
    np.testing.assert_array_equal(found["fit"][2, 1, [0, 3]], whole["fit"][2, 1, [0, 3]])


def test_the_summary_counts_each_shard_of_the_store_once(movie, scene, tmp_path, work):
    expected = fit(movie, scene, tmp_path / "whole.zarr")
    place = tmp_path / "results.zarr"
    with pytest.raises(Stopped):
        fit(movie, scene, place, on_event=stop_after(3))
    task, shards, journal = work[-1]
    tasks._work(task, shards, journal, np.array([1, 1, 4]))  # copies of tasks
    journal.record(shards[3], {"fits": 10**6})
    journal.record(shards[5], {"fits": 5, "accepted": 5, "bad_frames": "none"})
    (log,) = (file for file in journal.path.glob("*.jsonl"))
    log.write_bytes(log.read_bytes() + b"[5, {" + log.read_bytes())
    assert fit(movie, scene, place) == expected
    assert metadata.attributes(place)["summary"] == vars(expected)
    same(place, tmp_path / "whole.zarr")


def test_parts_of_another_shard_are_refused(tmp_path):
    journal = Journal(tmp_path / "j", "key")
    disk.append(journal.path / "x.parts", b"nothing of ours" * 20)
    place = np.array([[0, 300], [-1, -1]])
    with pytest.raises(StoreError, match="shard 0 cannot be read"):
        parts.Parts(journal.path, ("x.parts",), place).read(0, "fit", np.empty((1, 1, 7)))


# Damage that is found late

CONFUSED = [lambda data: data[: len(data) // 2], lambda data: b"", lambda data: data.replace(b"shape", b"shale"), None]


@pytest.mark.parametrize("confuse", CONFUSED)
@pytest.mark.parametrize("name", ["0", "binned/4", "frame_max"])
def test_an_unfinished_movie_with_damaged_metadata_is_begun_anew(scene, npy, tmp_path, name, confuse):
    movie, said = npy(scene.counts()), []
    with pytest.raises(Stopped):
        convert(movie, tmp_path / "m.zarr", settings=SMALL, on_event=stop_after(2))
    harm(tmp_path / "m.zarr" / name / "zarr.json", confuse)
    convert(movie, tmp_path / "m.zarr", settings=SMALL, on_event=said.append)
    convert(movie, tmp_path / "whole.zarr", settings=SMALL)
    assert files(tmp_path / "m.zarr") == files(tmp_path / "whole.zarr")
    assert any("is damaged" in event.message for event in said if isinstance(event, Warned))


@pytest.mark.parametrize("confuse", CONFUSED)
@pytest.mark.parametrize("file", ["fit/zarr.json", "fit_ref/c.0.0", "axis/zarr.json"])
def test_unfinished_results_that_are_damaged_keep_the_fits_that_are_done(movie, scene, tmp_path, file, confuse):
    columns, said = scene.columns(), []
    job = prepare(movie, columns, scene.drift_dataset(), FitSettings())
    with pytest.raises(Stopped):
        fit_movie(movie, job, tmp_path / "r.zarr", on_event=stop_after(3))
    harm(tmp_path / "r.zarr" / file, confuse if file.endswith("json") or confuse != CONFUSED[2] else zeros)
    fit_movie(movie, job, tmp_path / "r.zarr", on_event=said.append)
    fit_movie(movie, job, tmp_path / "whole.zarr")
    assert len([event for event in said if isinstance(event, ShardDone)]) == len(movie.shards) - 3
    assert any("is damaged" in event.message for event in said if isinstance(event, Warned))
    found, whole = (open_results(tmp_path / f"{name}.zarr").drop_attrs().load() for name in ("r", "whole"))
    xr.testing.assert_identical(found, whole)


@pytest.mark.parametrize("stage_of", [sum_stage, drift_stage])
def test_a_bit_that_flipped_in_what_a_task_left_is_made_again(movie, scene, tmp_path, stage_of):
    how = {sum_stage: scene.drift_dataset(), drift_stage: DriftSettings()}[stage_of]
    args = (movie, how) if stage_of is sum_stage else (movie,)
    more = () if stage_of is sum_stage else (how,)
    with pytest.raises(Stopped):
        stage_of(*args, tmp_path / "a.zarr", *more, lambda: None, stop_after(2))
    left = next(journal_beside(tmp_path / "a.zarr").rglob("0.npy"))
    data = bytearray(left.read_bytes())
    data[200] ^= 4  # not at the end, of which the journal knows
    left.write_bytes(data)
    said: list[Any] = []
    found = stage_of(*args, tmp_path / "a.zarr", *more, lambda: None, said.append)
    assert any("was damaged on disk" in event.message for event in said if isinstance(event, Warned))
    xr.testing.assert_equal(found, stage_of(*args, tmp_path / "b.zarr", *more, lambda: None))


def test_a_conversion_that_is_to_overwrite_replaces_a_damaged_movie(source, tmp_path):
    movie = convert(source, tmp_path / "m.zarr", settings=SMALL)
    whole = files(movie)
    for name in ("zarr.json", "0/zarr.json"):
        (movie / name).write_bytes(b"\xff")
        assert not metadata.is_sound(movie)
        convert(source, movie, settings=SMALL, overwrite=True)
        assert files(movie) == whole
        assert metadata.is_sound(movie)


@pytest.mark.parametrize(("worker", "sees"), [("tls://127.0.0.1:4", 2), ("tls://10.0.0.7:4", 5)])
def test_shards_that_are_not_to_be_seen_are_waited_for_aloud(tmp_path, monkeypatch, worker, sees):
    journal, shards, waits, said = Journal(tmp_path / "j", "key"), split(10, 5), [], []
    monkeypatch.setattr(tasks, "sleep", waits.append)
    client: Any = SimpleNamespace(nthreads=lambda: {worker: 1})
    lost = tasks._lost(journal, shards, lambda *_: None, client, said.append)
    assert lost.tolist() == [0, 1]
    assert len(waits) == sees
    assert len(said) == (sees > 2)
    assert all("2 shards are not to be seen" in text and "95 s" in text for text in said)
    assert tasks._looks(None) == ()


def harm(file: Path, confuse: Callable[[bytes], bytes] | None) -> None:
    if confuse is None:
        file.unlink()
    else:
        file.write_bytes(confuse(file.read_bytes()))


def zeros(data: bytes) -> bytes:
    return bytes(len(data))


def files(store: Path) -> dict[str, bytes]:
    found = {path.relative_to(store).as_posix(): path.read_bytes() for path in store.rglob("*") if path.is_file()}
    return {name: data for name, data in found.items() if name != "zarr.json"}
