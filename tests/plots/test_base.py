"""Settings, errors, events, stores and the journal."""

from __future__ import annotations

import errno
import json
import os
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tract_dask import progress
from tract_dask.cluster.tasks import run_shards
from tract_dask.errors import DestinationError, SettingsError, SourceError, StoreError, TractError
from tract_dask.settings import ColumnSettings, FitSettings, RunSettings, toml
from tract_dask.store import datasets, files, metadata, provenance
from tract_dask.store.journal import Journal
from tract_dask.store.keys import counted
from tract_dask.store.shards import Shard, split


@given(n_frames=st.integers(1, 5000), per_shard=st.integers(1, 600))
def test_every_frame_is_in_exactly_one_shard(n_frames, per_shard):
    shards = split(n_frames, per_shard)
    frames = [frame for shard in shards for frame in range(shard.start, shard.stop)]
    assert frames == list(range(n_frames))
    assert [shard.index for shard in shards] == list(range(len(shards)))


def test_settings_survive_toml():
    made = RunSettings(
        fit=FitSettings(window_px=31, vacuum_box=(0, 10, 5, 50)),
        columns=ColumnSettings(method="lattice", lattices=({"origin": [1.0, 2.0], "a_count": 3},)),
    )
    assert toml.from_toml(RunSettings, toml.to_toml(made)) == made


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FitSettings(blur_sigma_px=-1), "blur_sigma_px.*at least 0 and at most 20 px; got -1"),
        (lambda: FitSettings(window_px=4.5), "window_px.*int; got 4.5"),
        (lambda: FitSettings(intensity_scale="box"), "one of paper, ellipse; got 'box'"),
        (lambda: FitSettings(threshold=float("nan")), "threshold.*out of range"),
        (lambda: toml.from_toml(RunSettings, "[fit]\nwindow = 3"), "no setting 'window'"),
        (lambda: toml.from_toml(RunSettings, "fit = 3"), "a table \\[fit\\]"),
        (lambda: toml.from_toml(RunSettings, "[fit\n"), "not valid TOML"),
        (lambda: toml.load(datasets.Path("nowhere.toml")), "nowhere.toml: the settings file cannot be read"),
    ],
)
def test_bad_settings_name_themselves(make, message):
    with pytest.raises(SettingsError, match=message):
        make()


def test_an_error_is_one_paragraph_and_crosses_processes():
    error = SourceError("page 3 has another shape", "movie.tif", "512 x 512", "512 x 500", "Export it again")
    text = "movie.tif: page 3 has another shape. Expected 512 x 512; got 512 x 500. Export it again."
    assert str(error) == text
    assert str(pickle.loads(pickle.dumps(error))) == text
    assert (TractError("x").exit_code, error.exit_code) == (1, 2)


def test_events_become_lines_of_json(tmp_path):
    sink = progress.JsonLines(tmp_path / "events.jsonl")
    seen = []
    send = progress.tee([sink, seen.append])
    send(progress.StageStarted("fit", 10))
    send(progress.ShardDone("fit", 0, 5, 100))
    lines = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert [line["event"] for line in lines] == ["StageStarted", "ShardDone"]
    assert lines[1]["fits"] == 100
    assert seen[1] == progress.ShardDone("fit", 0, 5, 100)


def test_a_full_disk_does_not_end_a_run_and_is_told_once(tmp_path):
    told = []
    (tmp_path / "events.jsonl").symlink_to("/dev/full")
    sink = progress.JsonLines(tmp_path / "events.jsonl", told.append)
    for shard in range(3):
        sink(progress.ShardDone("fit", shard, 5))
    (warned,) = told
    assert "incomplete" in warned.message
    assert "events.jsonl cannot be written: No space left on device" in warned.message


def test_a_torn_line_does_not_spoil_the_next(tmp_path):
    path = tmp_path / "events.jsonl"
    path.write_bytes(b'{"event": "ShardDone", "sha')
    sink = progress.JsonLines(path)
    sink(progress.ShardDone("fit", 1, 5))
    sink(progress.ShardDone("fit", 2, 5))
    torn, *whole = path.read_text().splitlines()
    assert torn == '{"event": "ShardDone", "sha'
    assert [json.loads(line)["shard"] for line in whole] == [1, 2]


def test_a_line_that_is_written_in_part_does_not_spoil_the_next(tmp_path, monkeypatch):
    path, told, write = tmp_path / "events.jsonl", [], os.write
    sink = progress.JsonLines(path, told.append)
    sink(progress.ShardDone("fit", 0, 5))
    monkeypatch.setattr(progress.os, "write", lambda file, data: write(file, data[:20]))
    sink(progress.ShardDone("fit", 1, 5))
    monkeypatch.undo()
    sink(progress.ShardDone("fit", 2, 5))
    first, torn, last = path.read_text().splitlines()
    assert (json.loads(first)["shard"], len(torn), json.loads(last)["shard"]) == (0, 20, 2)
    assert len(told) == 1


def test_a_pipe_in_the_place_of_the_record_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "events.jsonl")
    told = []
    progress.JsonLines(tmp_path / "events.jsonl", told.append)(progress.ShardDone("fit", 0, 5))
    assert len(told) == 1


def test_a_place_whose_name_is_not_utf8_is_refused(tmp_path):
    with pytest.raises(DestinationError, match=r"caf\\udce9.*not UTF-8"):
        metadata.check_destination(tmp_path / os.fsdecode(b"caf\xe9") / "movie.zarr")


def test_keys_tell_settings_apart_and_parts_from_each_other():
    key = provenance.stage_key
    assert key("fit", counted("fit", fit=FitSettings())) == key("fit", counted("fit", fit=FitSettings()))
    assert key("fit", counted("fit", fit=FitSettings())) != key("fit", counted("fit", fit=FitSettings(threshold=3.0)))
    assert key("fit", "ab", "c") != key("fit", "a", "bc")
    assert key("fit", "ab") != key("sum", "ab")


def test_a_fingerprint_changes_with_the_file(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"1" * 100)
    first = provenance.fingerprint(path)
    assert provenance.fingerprint(path) == first
    path.write_bytes(b"1" * 99 + b"2")
    assert provenance.fingerprint(path) != first


def test_the_journal_remembers_and_forgets_other_keys(tmp_path):
    journal = Journal(tmp_path / "j", "key")
    journal.record(Shard(3, 30, 40), {"fits": 5})
    assert Journal(tmp_path / "j", "key").done() == {3: {"fits": 5}}
    assert Journal(tmp_path / "j", "other").done() == {}


def test_run_shards_does_only_what_is_missing(tmp_path):
    journal = Journal(tmp_path / "j", "key")
    shards = split(10, 3)
    journal.record(shards[1], {"n": -1})
    ran = []
    payloads = run_shards(
        lambda shard: {"n": shard.index},
        shards,
        journal=journal,
        name="count",
        on_done=lambda shard, payload: ran.append((shard.index, payload["n"])),
    )
    assert ran == [(0, 0), (2, 2), (3, 3)]
    assert {k: p["n"] for k, p in payloads.items()} == {0: 0, 1: -1, 2: 2, 3: 3}


def test_an_error_in_a_task_keeps_what_is_done(tmp_path):
    journal = Journal(tmp_path / "j", "key")

    def task(shard):
        if shard.index == 2:
            raise StoreError("no")
        return {}

    with pytest.raises(StoreError):
        run_shards(task, split(10, 3), journal=journal, name="fail")
    assert sorted(journal.done()) == [0, 1]


def test_a_destination_that_holds_something_else_is_refused(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    with pytest.raises(DestinationError, match="holds something else"):
        metadata.check_destination(tmp_path / "mine")
    with pytest.raises(DestinationError, match="cannot be written"):
        metadata.check_destination(tmp_path / "mine" / "thesis.txt" / "movie.zarr")
    metadata.check_destination(tmp_path / "new" / "movie.zarr")


def test_a_small_disk_is_refused_with_both_numbers(tmp_path):
    with pytest.raises(DestinationError, match=r"Expected about 1000000000\.0 GB free; got"):
        files.check_free_space(tmp_path / "x", 10**18)


def test_a_full_disk_says_so(tmp_path):
    with pytest.raises(StoreError, match="what is done is kept"), files.disk_errors(tmp_path):
        raise OSError(errno.ENOSPC, "No space left on device")
