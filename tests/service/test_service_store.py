"""The store of jobs: what it allows, what it keeps, who comes next, and that nothing that happens to it loses a job."""

import errno
import hashlib
import itertools
import json
import multiprocessing
import os
import random
import signal
import sqlite3
import threading
import time
from contextlib import closing

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tract_dask.errors import InputError, StoreError
from tract_dask.service.jobs import store, tables
from tract_dask.service.jobs.records import ConflictError, Job, UnknownJobError
from tract_dask.service.jobs.states import CURATABLE, ENDED, RETRYABLE, TRANSITIONS, State
from tract_dask.service.jobs.store import JobStore
from tract_dask.service.runner.runner import next_job

TABLES = ("jobs", "transitions", "events", "columns")


@pytest.fixture
def jobs(tmp_path) -> JobStore:
    return JobStore(tmp_path / "service.sqlite")


def submit(jobs: JobStore, state: State = State.QUEUED, **more) -> Job:
    """A job that is in ``state``, whatever way leads there."""
    job = jobs.submit(**{"source": "a/movie.tif", "settings": {"fit": {"window_px": 21}}, "owner": "ana"} | more)
    jobs.connection().execute("UPDATE jobs SET state = ? WHERE id = ?", (state, job.id))
    return jobs.job(job.id)


def contents(jobs: JobStore) -> dict[str, list[tuple]]:
    return {name: [tuple(row) for row in jobs.connection().execute(f"SELECT * FROM {name}")] for name in TABLES}


@pytest.mark.parametrize(("before", "after"), list(itertools.product(State, State)))
def test_only_what_the_table_allows_happens_and_a_refusal_leaves_no_trace(jobs, before, after):
    job = submit(jobs, before)
    if after in TRANSITIONS[before]:
        assert jobs.change(job.id, after, "why").state == after
        newest = jobs.transitions(job.id)[-1]
        assert (newest["state"], newest["reason"]) == (after, "why")
        assert jobs.events()[-1].data == json.loads(json.dumps(jobs.job(job.id).to_record()))
    else:
        known = contents(jobs)
        with pytest.raises(ConflictError, match=f"is {before} cannot become {after}"):
            jobs.change(job.id, after, "why")
        assert contents(jobs) == known


def test_the_way_of_a_job():
    """Nothing but the runner's start makes a job run; what has ended goes on by way of the queue."""
    assert {state for state, next_ones in TRANSITIONS.items() if State.RUNNING in next_ones} == {State.QUEUED}
    assert all(TRANSITIONS[state] == {State.QUEUED} for state in ENDED)
    assert set(TRANSITIONS) == set(State)
    assert all(TRANSITIONS.values())


def test_a_job_is_found_again_as_it_was(jobs):
    job = jobs.submit(source="a.tif", settings={"fit": {"threshold": 1.5}}, owner="ana", label="Ceria", curate=True)
    assert (job.state, job.output, job.attempts) == (State.QUEUED, f"jobs/{job.id}", 0)
    running = jobs.change(job.id, State.RUNNING, "its turn")
    jobs.stage(job.id, "fit")
    jobs.progress(job.id, {"fraction": 0.5})
    ended = jobs.change(job.id, State.DONE, outcome={"frames": 7})
    again = JobStore(jobs.path).job(job.id)
    assert again == ended
    assert (again.stage, again.progress, again.outcome) == ("fit", {"fraction": 0.5}, {"frames": 7})
    assert job.created <= running.started == again.started <= again.ended
    assert (again.attempts, again.label, again.curate, again.settings) == (
        1,
        "Ceria",
        True,
        {"fit": {"threshold": 1.5}},
    )
    assert [(row["state"], row["stage"]) for row in jobs.transitions(job.id)] == [
        ("queued", ""),
        ("running", ""),
        ("done", "fit"),
    ]


@pytest.mark.parametrize(
    "call",
    [
        lambda jobs: jobs.job("0123456789"),
        lambda jobs: jobs.change("no", State.RUNNING),
        lambda jobs: jobs.progress("no", {}),
        lambda jobs: jobs.log("no", "info", "text"),
        lambda jobs: jobs.workers("no", {}),
        lambda jobs: jobs.label("no", "label"),
        lambda jobs: jobs.transitions("no"),
        lambda jobs: jobs.add_columns("no", "", "ana"),
        lambda jobs: jobs.delete("no"),
    ],
)
def test_a_job_that_is_not_there_is_said_to_be_unknown(jobs, call):
    with pytest.raises(UnknownJobError):
        call(jobs)
    assert jobs.newest_event() == 0


@pytest.mark.parametrize("state", State)
def test_who_may_be_cancelled_retried_continued_deleted(jobs, state):
    def attempt(call) -> bool:
        job = submit(jobs, state)
        try:
            call(job.id)
        except ConflictError:
            return False
        return True

    assert attempt(lambda job: jobs.request_cancel(job, "enough")) == (state not in ENDED)
    assert attempt(jobs.retry) == (state in RETRYABLE)
    assert attempt(lambda job: jobs.go_on(job, 0)) == (state in CURATABLE)
    assert attempt(jobs.delete) == (state != State.RUNNING)


def test_a_queued_job_is_cancelled_at_once_a_running_one_when_its_process_has_ended(jobs):
    queued, running = submit(jobs), submit(jobs)
    jobs.change(running.id, State.RUNNING)
    assert jobs.request_cancel(queued.id, "a mistake").state == State.CANCELLED
    assert jobs.transitions(queued.id)[-1]["reason"] == "a mistake"
    assert jobs.request_cancel(running.id, "a mistake").state == State.RUNNING
    assert jobs.cancel_requested(running.id)
    jobs.change(running.id, State.CANCELLED, jobs.cancel_reason(running.id))
    assert not jobs.cancel_requested(jobs.retry(running.id).id), "a new try is not cancelled by an old request"


def test_versions_of_columns(jobs):
    job = submit(jobs, State.WAITING)
    assert jobs.add_columns(job.id, "x,y\n1,2\n3,4\n", "ana", "first") == 1
    assert jobs.add_columns(job.id, "x,y\n5,6\n", "ben") == 2
    assert [(row["version"], row["author"], row["note"], row["count"]) for row in jobs.columns_versions(job.id)] == [
        (1, "ana", "first", 2),
        (2, "ben", "", 1),
    ]
    assert jobs.columns(job.id, 1) == "x,y\n1,2\n3,4\n"
    with pytest.raises(InputError, match="no such version"):
        jobs.go_on(job.id, 3)
    assert jobs.job(job.id).state == State.WAITING
    continued = jobs.go_on(job.id, 2)
    assert (continued.state, continued.columns_version) == (State.QUEUED, 2)


def test_two_jobs_that_have_not_ended_never_write_to_the_same_folder(jobs):
    first = submit(jobs, output="out")
    with pytest.raises(ConflictError, match=first.id):
        submit(jobs, output="out")
    jobs.request_cancel(first.id, "")
    assert submit(jobs, output="out").output == "out"
    with pytest.raises(ConflictError, match="another job writes"):
        jobs.retry(first.id)


def test_a_deleted_job_leaves_nothing_but_the_news(jobs, monkeypatch):
    monkeypatch.setattr(store, "KEPT_DELETIONS", 3)
    kept = submit(jobs)
    for _ in range(5):
        job = submit(jobs)
        jobs.add_columns(job.id, "x,y\n", "ana")
        jobs.log(job.id, "info", "line")
        jobs.progress(job.id, {"fraction": 1})
        jobs.delete(job.id)
        left = [(name, row) for name, found in contents(jobs).items() for row in found if job.id in row]
        assert [name for name, _ in left] == ["events"]
        assert jobs.events()[-1].data == {"id": job.id, "deleted": True}
    assert sum(bool(event.data.get("deleted")) for event in jobs.events()) == 3
    assert jobs.jobs() == [kept]


def test_of_progress_and_workers_only_the_newest_is_kept(jobs):
    job, other = submit(jobs), submit(jobs)
    for k in range(50):
        jobs.progress(job.id, {"done_frames": k})
        jobs.workers(job.id, {"workers": [], "dashboard": bool(k % 2)})
    jobs.progress(other.id, {"done_frames": 1})
    found = {(event.job_id, event.kind): event.data for event in jobs.events() if event.kind != "job"}
    assert len(jobs.events()) == 2 + len(found) == 5
    assert found[job.id, "progress"] == {"done_frames": 49} == jobs.job(job.id).progress


def test_the_log_keeps_its_last_lines(jobs, monkeypatch):
    monkeypatch.setattr(store, "KEPT_LINES", 20)
    job, other = submit(jobs), submit(jobs)
    jobs.log(other.id, "warning", "mine")
    for k in range(50):
        jobs.log(job.id, "info", str(k))
    assert [event.data["message"] for event in jobs.log_of(job.id)] == [str(k) for k in range(30, 50)]
    after = jobs.log_of(job.id)[-3].id
    assert [event.data["message"] for event in jobs.log_of(job.id, after)] == ["48", "49"]
    assert len(jobs.log_of(other.id)) == 1


def test_whoever_reads_events_from_where_they_stopped_ends_with_the_truth(jobs):
    """A reader that comes now and then, and resumes by number, knows what the store knows."""
    chance = random.Random(3)
    known: dict[str, dict] = {}
    after, names, seen = 0, [], set()
    for _ in range(300):
        match chance.choice(["submit", "label", "progress", "delete", "read", "read"]):
            case "submit":
                names.append(submit(jobs).id)
            case "label" if names:
                jobs.label(chance.choice(names), str(chance.random()))
            case "progress" if names:
                jobs.progress(chance.choice(names), {"fraction": chance.random()})
            case "delete" if names:
                jobs.delete(names.pop(chance.randrange(len(names))))
            case "read":
                for event in jobs.events(after, limit=chance.randint(1, 5)):
                    assert event.id > after
                    after = event.id
                    apply(known, event)
                    seen.add(event.id)
    for event in jobs.events(after):
        apply(known, event)
    truth = {job.id: (job.label, job.progress) for job in jobs.jobs(limit=1000)}
    assert {name: (data["label"], data["progress"]) for name, data in known.items()} == truth
    assert jobs.newest_event() == jobs.events(limit=10**6)[-1].id
    one = names[0]
    assert [event.id for event in jobs.events(job_id=one)] == [e.id for e in jobs.events() if e.job_id == one]


def apply(known: dict[str, dict], event: store.JobEvent) -> None:
    if event.kind == "progress":
        known[event.job_id]["progress"] = event.data
    elif event.data.get("deleted"):
        known.pop(event.job_id, None)
    else:
        known[event.job_id] = event.data


def test_pages_filters_and_counts(jobs):
    for k in range(23):
        submit(jobs, State.DONE if k % 3 else State.FAILED, owner="ana" if k % 2 else "ben", label=f"movie {k}")
    pages, before = [], None
    while page := jobs.jobs(before=before, limit=5):
        pages += page
        before = page[-1].number
    assert [job.number for job in pages] == list(range(23, 0, -1))
    found = jobs.jobs(states=[State.FAILED], owner="ben", limit=50)
    assert [job.label for job in found] == [f"movie {k}" for k in range(22, -1, -1) if k % 3 == 0 and k % 2 == 0]
    assert [job.label for job in jobs.jobs(text="VIE 1")] == [f"movie {k}" for k in range(19, 9, -1)] + ["movie 1"]
    assert jobs.counts(owner="ana") == dict.fromkeys(State, 0) | {State.DONE: 7, State.FAILED: 4}
    assert sum(jobs.counts(text="movie 2").values()) == 4


@pytest.mark.parametrize("text", ["%", "_", "\\", "'; DROP TABLE jobs; --", '"', "Ångström", "?", ":a"])
def test_text_of_users_is_never_more_than_text(jobs, text):
    job = submit(jobs, label=f"a{text}b", owner=text, source=f"{text}.tif")
    submit(jobs, label="other")
    assert [found.id for found in jobs.jobs(text=f"a{text}b")] == [job.id]
    assert [found.id for found in jobs.jobs(owner=text)] == [job.id]
    assert jobs.job(job.id).label == f"a{text}b"
    with pytest.raises(TypeError, match="a job has no"):
        jobs.change(job.id, State.RUNNING, **{"label = 'x' --": 1})


def test_small_queries_use_an_index(jobs):
    """None of what is asked many times a second reads through a whole table."""
    asked: list[str] = []
    jobs.connection().set_trace_callback(asked.append)
    jobs.queued()
    jobs.running()
    jobs.jobs(states=[State.DONE], before=7)
    jobs.jobs(owner="ana")
    jobs.events(5)
    jobs.events(5, "name")
    jobs.newest_event()
    jobs.cancel_requested("name")
    jobs.connection().set_trace_callback(None)
    for query in asked:
        plan = " ".join(row["detail"] for row in jobs.connection().execute(f"EXPLAIN QUERY PLAN {query}"))
        assert "USING" in plan or "SEARCH" in plan or "ORDER BY number DESC" in query, f"{query}: {plan}"


def write_much(path, count: int) -> None:
    """Let two threads submit jobs and bring each to its end."""

    def write(name: str) -> None:
        jobs = JobStore(path)
        for k in range(count):
            job = jobs.submit(source="m.tif", settings={}, owner=name, label=str(k))
            jobs.change(job.id, State.RUNNING)
            jobs.progress(job.id, {"fraction": 1.0})
            jobs.change(job.id, State.DONE)

    threads = [threading.Thread(target=write, args=(f"{os.getpid()}-{k}",)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def test_threads_of_two_processes_write_and_a_reader_misses_nothing(jobs):
    count, context = 10, multiprocessing.get_context("spawn")
    writers = [context.Process(target=write_much, args=(jobs.path, count)) for _ in range(2)]
    for writer in writers:
        writer.start()
    seen, after = [], 0
    while any(writer.is_alive() for writer in writers) or jobs.newest_event() > after:
        for event in jobs.events(after):
            after = event.id
            seen.append((event.job_id, event.data["state"])) if event.kind == "job" else None
    assert all(writer.exitcode == 0 for writer in writers)
    found = jobs.jobs(limit=1000)
    assert len({job.id for job in found}) == len({job.number for job in found}) == 4 * count
    assert jobs.counts()[State.DONE] == 4 * count
    assert sorted(seen) == sorted((job.id, state) for job in found for state in ("queued", "running", "done"))


def test_a_writer_that_is_killed_leaves_whole_records(jobs):
    """Of a job's record, its transitions and its events, all or none tell of a change."""
    context, chance = multiprocessing.get_context("spawn"), random.Random(5)
    for _ in range(3):
        writer = context.Process(target=write_much, args=(jobs.path, 10_000))
        writer.start()
        before = jobs.newest_event()
        while jobs.newest_event() < before + 10:
            time.sleep(0.01)
        time.sleep(chance.uniform(0, 0.2))
        os.kill(writer.pid, signal.SIGKILL)
        writer.join()
        for job in jobs.jobs(limit=10_000):
            told = [event.data["state"] for event in jobs.events(job_id=job.id) if event.kind == "job"]
            assert [row["state"] for row in jobs.transitions(job.id)] == told
            assert told[-1] == job.state
        assert jobs.connection().execute("PRAGMA integrity_check").fetchone()[0] == "ok"


def test_an_older_file_is_brought_up_to_date_and_a_newer_one_refused(jobs, monkeypatch):
    job = submit(jobs, label="kept")
    monkeypatch.setattr(
        tables, "MIGRATIONS", (*tables.MIGRATIONS, "ALTER TABLE jobs ADD COLUMN extra TEXT DEFAULT 'new'")
    )
    newer = JobStore(jobs.path)
    assert newer.job(job.id) == job
    assert newer.connection().execute("SELECT extra FROM jobs").fetchone()[0] == "new"
    assert JobStore(jobs.path).connection().execute("PRAGMA user_version").fetchone()[0] == len(tables.MIGRATIONS)
    monkeypatch.undo()
    with pytest.raises(StoreError, match="newer version"):
        JobStore(jobs.path)


def test_a_step_that_fails_leaves_the_file_at_its_version(jobs, monkeypatch):
    job = submit(jobs)
    monkeypatch.setattr(tables, "MIGRATIONS", (*tables.MIGRATIONS, "DELETE FROM jobs; SELECT nonsense FROM nowhere"))
    with pytest.raises(StoreError, match="no such table"):
        JobStore(jobs.path)
    monkeypatch.undo()
    assert JobStore(jobs.path).job(job.id) == job


def waiting(number: int, owner: str, created: int, not_before: str | None = None) -> Job:
    more = dict.fromkeys(("label", "source", "output", "reason", "stage"), "")
    empty: dict = {"settings": {}, "progress": {}, "outcome": {}}
    times = {"created": clock(created), "started": None, "ended": None, "not_before": not_before}
    counts = {"attempts": 0, "lost_tries": 0, "columns_version": None}
    named = {"id": str(number), "number": number, "owner": owner, "curate": False, "state": State.QUEUED}
    return Job(**named, **more, **empty, **times, **counts)


def clock(step: int) -> str:
    return f"2026-01-01T{step:08}Z"


def test_the_queue_goes_round_among_owners():
    queued = [waiting(k, owner, 0) for k, owner in enumerate(["ana"] * 4 + ["ben"] * 2 + ["eva"])]
    running, served, order = [], {}, []
    for step in range(1, 8):
        job = next_job(queued, running, served, clock(step))
        queued.remove(job)
        served[job.owner] = clock(step)
        order.append(job.owner)
    assert order == ["ana", "ben", "eva", "ana", "ben", "ana", "ana"]
    two = [waiting(10, "ana", 0), waiting(11, "ben", 5)]
    assert next_job(two, [waiting(9, "ana", 0)], {"ben": clock(9)}, clock(10)).owner == "ben", "ana has one running"
    assert next_job([waiting(1, "ana", 0, clock(7))], [], {}, clock(6)) is None
    assert next_job([waiting(1, "ana", 0, clock(7))], [], {}, clock(7)).number == 1


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 4), st.integers(1, 6))
def test_nobody_starves(seed, concurrency, owners):
    """However others submit, and new ones come: who has no job running is passed over once by each other at most."""
    chance = random.Random(seed)
    queued, running, served, number, ticks = [], [], {}, 0, itertools.count()
    waits: dict[str, set[str]] = {}  # who was served since an owner began to wait with none running
    for step in range(1, 150):
        for _ in range(chance.choice([0, 1, 1, 3])):
            number += 1
            owner = f"new {number}" if chance.random() < 0.1 else f"owner {chance.randrange(owners)}"
            queued.append(waiting(number, owner, next(ticks)))
        running = [(job, end) for job, end in running if end > step]
        while len(running) < concurrency and queued:
            at_work = [job for job, _ in running]
            hungry = {job.owner for job in queued} - {job.owner for job in at_work}
            job = next_job(queued, at_work, served, clock(next(ticks)))
            assert not hungry or job.owner in hungry
            assert job.number == min(other.number for other in queued if other.owner == job.owner)
            for owner in hungry - {job.owner}:
                passed = waits.setdefault(owner, set())
                assert job.owner not in passed, f"{owner} was passed over twice by {job.owner}"
                passed.add(job.owner)
            waits.pop(job.owner, None)
            for owner in waits.keys() - hungry:
                del waits[owner]
            queued.remove(job)
            running.append((job, step + chance.randint(1, 10)))
            served[job.owner] = clock(next(ticks))


# --- files that are old, damaged, locked, or somebody else's ---------------------------------------------------------

VERSION_1 = "2562789d0d876e3482ef5b7ca15842a73d13c8654f9b214bf0e7f0c8b5212aef"
"""Of the tables of version 1, which are frozen: there are such files."""


@pytest.fixture
def full(tmp_path):
    """A store with jobs, closed, all of it in its one file."""
    made = JobStore(tmp_path / "service.sqlite")
    for k in range(60):
        made.submit(source=f"{k}.tif", settings={"fit": list(range(50))}, owner="ana", label="x" * 100)
    made.connection().execute("PRAGMA wal_checkpoint(TRUNCATE)")
    made.close()
    for name in ("-wal", "-shm"):
        made.path.with_name(made.path.name + name).unlink(missing_ok=True)
    return made.path


def test_a_file_of_version_1_is_copied_and_brought_up_to_date(tmp_path):
    first = tables.MIGRATIONS[0]
    assert hashlib.sha256(first.encode()).hexdigest() == VERSION_1
    path = tmp_path / "service.sqlite"
    with closing(sqlite3.connect(path)) as db:
        db.executescript(f"{first}; PRAGMA user_version = 1; PRAGMA journal_mode = WAL;")
        row = (
            "0123456789",
            "two",
            "ana",
            "m.tif",
            "jobs/0123456789",
            '{"fit": {}}',
            0,
            "queued",
            "then",
        )
        with db:
            db.execute(
                "INSERT INTO jobs (id, label, owner, source, output, settings, curate, state, created)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                row,
            )
            db.execute("INSERT INTO events (job_id, time, kind, data) VALUES ('0123456789', 'then', 'job', '{}')")
    brought = JobStore(path)
    job = brought.job("0123456789")
    assert (job.label, job.owner, job.settings, job.state) == ("two", "ana", {"fit": {}}, State.QUEUED)
    assert brought.change(job.id, State.RUNNING).attempts == 1
    assert brought.connection().execute("PRAGMA user_version").fetchone()[0] == len(tables.MIGRATIONS)
    copy = path.with_name("service.sqlite.version-1")
    with closing(sqlite3.connect(copy)) as db:
        assert db.execute("PRAGMA user_version").fetchone()[0] == 1
        assert db.execute("SELECT id, state FROM jobs").fetchall() == [("0123456789", "queued")]
    assert copy.stat().st_mode & 0o777 == 0o600
    assert sorted(file.name for file in tmp_path.iterdir() if not file.name.endswith(("-wal", "-shm"))) == [
        "service.sqlite",
        "service.sqlite.version-1",
    ]
    JobStore(path)  # and once more, with nothing to do


def test_without_room_for_the_copy_nothing_is_changed(full, monkeypatch):
    monkeypatch.setattr(tables, "MIGRATIONS", (*tables.MIGRATIONS, "DELETE FROM jobs"))

    class Full(sqlite3.Connection):
        def backup(self, *_: object, **__: object) -> None:
            raise sqlite3.OperationalError("database or disk is full")

    connect = sqlite3.connect
    monkeypatch.setattr(store.sqlite3, "connect", lambda *a, **more: connect(*a, **more, factory=Full))
    with pytest.raises(StoreError, match="disk is full"):
        JobStore(full)
    monkeypatch.undo()
    assert len(JobStore(full).jobs(limit=100)) == 60
    assert not list(full.parent.glob(".*partial"))


def overwrite(start: int, data: bytes):
    def damage(path) -> None:
        with path.open("r+b") as file:
            file.seek(start)
            file.write(data)

    return damage


def cut(path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def replace_by_log(path) -> None:
    path.unlink()
    path.with_name(path.name + "-wal").write_bytes(bytes(1000))


def replace_by_folder(path) -> None:
    path.unlink()
    path.mkdir()


def replace_by_pipe(path) -> None:
    path.unlink()
    os.mkfifo(path)


def replace_by_another_program_s(path) -> None:
    path.unlink()
    with closing(sqlite3.connect(path)) as db:
        db.execute("CREATE TABLE bookmarks (address TEXT)")


def lock_exclusively(path) -> None:
    monster = sqlite3.connect(path, isolation_level=None)
    monster.execute("PRAGMA locking_mode = EXCLUSIVE")
    monster.execute("BEGIN EXCLUSIVE")
    monster.execute("UPDATE jobs SET label = 'z'")
    LOCKED.append(monster)


LOCKED = []


@pytest.mark.parametrize(
    ("damage", "what", "remedy"),
    [
        (overwrite(0, bytes(range(256)) * 16), "is not a database", "Restore it from a backup"),
        (overwrite(0, b"sQLite"), "is not a database", "Restore it from a backup"),
        (overwrite(8192, bytes(4096)), "is damaged", "Restore it from a backup"),
        (cut, "is damaged", "Restore it from a backup"),
        (replace_by_log, "is gone, and its log is still there", "service.sqlite-wal aside"),
        (replace_by_folder, "is not a file", "Move it aside"),
        (replace_by_pipe, "is not a file", "Move it aside"),
        (replace_by_another_program_s, "is not a job store", "Move it aside"),
        (lock_exclusively, "is locked by another program", "Stop the program"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_with_what_to_do(full, monkeypatch, damage, what, remedy):
    monkeypatch.setattr(store, "BUSY_TIMEOUT_S", 0.2)
    damage(full)
    try:
        with pytest.raises(StoreError) as caught:
            JobStore(full)
    finally:
        while LOCKED:
            LOCKED.pop().close()
    assert caught.value.where == str(full)
    assert what in caught.value.what or what in str(caught.value)
    assert remedy in caught.value.remedy


@pytest.mark.parametrize("held", [False, True])
def test_an_emptied_file_is_no_new_store(full, held):
    """Jobs and tokens are lost, so it is not begun anew in silence; nor waited for while another connection is open."""
    other = JobStore(full).connection() if held else None
    full.write_bytes(b"")
    for end in ("-wal", "-shm"):
        full.with_name(full.name + end).unlink(missing_ok=True)
    began = time.monotonic()
    with pytest.raises(StoreError, match="the job store is empty") as caught:
        JobStore(full)
    assert time.monotonic() - began < 1
    assert "begin without jobs and tokens" in caught.value.remedy
    assert other is None or other.execute("SELECT 1").fetchone()


@pytest.mark.parametrize("links", [True, False])
def test_a_new_store_is_there_whole_or_not_at_all(tmp_path, monkeypatch, links):
    """What is killed while it makes a store leaves no file that the next one could not use."""
    path = tmp_path / "service.sqlite"
    if not links:

        def refused(*_):
            raise PermissionError(errno.EPERM, "no links here")

        monkeypatch.setattr(tables.os, "link", refused)
    seen, whole = [], tables.migrate
    monkeypatch.setattr(tables, "migrate", lambda db, place: (whole(db, place), seen.append(path.exists())))
    tables.create(path)
    assert seen == [False]
    assert [found.name for found in tmp_path.iterdir()] == [path.name]
    kept = JobStore(path).submit(source="movie.tif", settings={}, owner="maria")
    tables.create(path) if links else None  # another process was as fast
    assert JobStore(path).job(kept.id) == kept
