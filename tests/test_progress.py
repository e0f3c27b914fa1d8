"""What a run tells, as lines of JSON."""

from __future__ import annotations

import json
import os

from tract_dask import progress


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
