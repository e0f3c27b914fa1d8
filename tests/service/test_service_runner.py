"""Jobs from the queue to their end: through real processes and clusters that are killed, cancelled and stopped."""

import json
import runpy
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import Scene
from distributed import Client, LocalCluster

from tract_dask import progress
from tract_dask.errors import ClusterError, DestinationError, InputError, TractError
from tract_dask.progress import REPORT, STAGES, ShardDone, StageDone, StageStarted
from tract_dask.run import pipeline
from tract_dask.service.config import ServiceConfig
from tract_dask.service.jobs.records import utc_now
from tract_dask.service.jobs.states import ENDED, State
from tract_dask.service.jobs.store import JobStore
from tract_dask.service.runner import job_process
from tract_dask.service.runner.job_process import ProcessReport, ending
from tract_dask.service.runner.job_work import place_columns
from tract_dask.service.runner.runner import Runner
from tract_dask.service.runner.timeline import SHARES, Timeline
from tract_dask.settings import ClusterSettings, RunSettings, from_dict
from tract_dask.store import run_folder

ROOT = Path(__file__).parents[2]
differences = runpy.run_path(str(ROOT / "scripts" / "kill_test"))["differences"]
SETTINGS = {"convert": {"shard_mb": 1}}
PATIENCE_S = 90.0


def said(**more) -> ProcessReport:
    return ProcessReport(**more)


OUTCOMES = [
    (said(outcome={"state": "done"}), 0, None, False, State.DONE),
    (said(outcome={"state": "done_with_bad_frames"}), 0, None, False, State.DONE_WITH_FAILED_FRAMES),
    (said(outcome={"state": "stopped"}), 0, None, False, State.WAITING),
    (said(outcome={"state": "done"}), 0, "too late", False, State.DONE),
    (said(outcome={"state": "stopped"}), 0, "enough", False, State.CANCELLED),
    (said(), 130, "enough", False, State.CANCELLED),
    (said(), 130, "enough", True, State.CANCELLED),
    (said(), 130, None, True, State.QUEUED),
    (said(error="no columns"), 1, None, True, State.QUEUED),
    (said(error="no columns"), 1, None, False, State.FAILED),
    (said(error="no workers", lost=True), 1, None, False, State.QUEUED),
    (said(), -9, None, False, State.QUEUED),
    (said(), -15, None, False, State.QUEUED),
    *((said(), -sign, None, False, State.FAILED) for sign in (4, 6, 7, 11)),  # ILL, ABRT, BUS, SEGV
    (said(), -11, "enough", False, State.CANCELLED),
]


@pytest.mark.parametrize(("heard", "code", "cancelled", "stopping", "state"), OUTCOMES)
def test_what_becomes_of_a_job_when_its_process_has_ended(store, heard, code, cancelled, stopping, state):
    end = ending(queue(store), heard, code, cancel_reason=cancelled, stopping=stopping)
    assert end.state == state
    if state == State.CANCELLED:
        assert end.reason == "enough"
    if state == State.FAILED and code > 0:
        assert end.reason == "no columns"
    elif state == State.FAILED:
        assert "the reader crashed on this file" in end.reason
        assert end.reason.startswith(queue(store).source)
    if code == -9:
        assert "SIGKILL" in end.reason


def test_a_lost_job_is_tried_again_later_and_later_and_not_for_ever(store):
    job, waits = queue(store), []
    while True:
        store.change(job.id, State.RUNNING)
        end = job_process.after_loss(store.job(job.id), "no workers", progressed=False)
        if end.state == State.FAILED:
            break
        backoff = min(2.0 ** len(waits), job_process.LONGEST_BACKOFF_S)
        waits.append(utc_now(later_s=backoff - 0.5) < end.fields["not_before"] <= utc_now(later_s=backoff))
        job = store.change(job.id, end.state, end.reason, **end.fields)
    assert waits == [True] * job_process.MOST_LOST_TRIES
    assert "no workers" in end.reason
    assert job_process.after_loss(job, "no workers", progressed=True).fields["lost_tries"] == 1


@pytest.fixture
def store(tmp_path) -> JobStore:
    (tmp_path / "movie.npy").touch()
    return JobStore(ServiceConfig(tmp_path).database)


def queue(store: JobStore, **more):
    return store.submit(**{"source": "movie.npy", "settings": SETTINGS, "owner": "ana"} | more)


class NoCluster:
    """A cluster that is there but for the first ``absent`` times that it is asked for."""

    credentials = None

    def __init__(self, absent: int = 0) -> None:
        self.absent = absent

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def ready(self, timeout_s: float) -> ClusterSettings:
        if self.absent > 0:
            self.absent -= 1
            raise ClusterError("the cluster is not up")
        return ClusterSettings(scheduler="tcp://127.0.0.1:1")

    def workers(self) -> list[dict]:
        return []

    def dashboard(self) -> None:
        return None


SPEECH = """
import json, os, pathlib, signal, sys, time
order = json.loads(sys.stdin.readline())
def say(**record): print(json.dumps(record), flush=True)
def until_cancelled():
    assert sys.stdin.readline() == "cancel\\n"
    say(kind="interrupted")
    sys.exit(130)
def progress(shards): say(kind="progress", shards=shards, data={"fraction": shards / 10, "stages": {}})
def done(state="done"): say(kind="outcome", state=state, frames=3)
tries = pathlib.Path(order["output"]).with_suffix(".tries")
tries.parent.mkdir(exist_ok=True)
number = len(tries.read_text()) if tries.exists() else 0
tries.write_text("x" * (number + 1))
"""
"""What the processes of these tests begin with: they speak as the real one does, and work as each test needs."""


@pytest.fixture
def started(store, tmp_path, monkeypatch):
    """Start a runner whose jobs' processes do what the given lines of Python say."""
    monkeypatch.setattr(job_process, "SHORTEST_BACKOFF_S", 0.01)
    monkeypatch.setattr("tract_dask.service.runner.runner._LOOK_S", 0.02)
    monkeypatch.setattr(job_process, "_LOOK_S", 0.02)
    runners = []

    def start(lines: str, cluster: NoCluster | None = None, concurrency: int = 1) -> Runner:
        monkeypatch.setattr(job_process, "COMMAND", (sys.executable, "-c", SPEECH + lines))
        runner = Runner(ServiceConfig(tmp_path, concurrency=concurrency), store)
        runner.cluster = cluster or NoCluster()
        runners.append(runner)
        runner.start()
        return runner

    yield start
    for runner in runners:
        runner.stop()


def wait(condition, what: str = "") -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)


def wait_for(store: JobStore, job, *states: State):
    wait(lambda: store.job(job.id).state in states, f"{store.job(job.id)} is not {states}")
    return store.job(job.id)


def states(store: JobStore, job) -> list[str]:
    return [row["state"] for row in store.transitions(job.id)]


def test_so_many_jobs_at_a_time_and_every_owner_in_turn(store, started):
    jobs = [queue(store, owner=owner) for owner in ("ana", "ana", "ana", "ben")]
    started("progress(1); time.sleep(0.15); done()", concurrency=2)
    most = 0
    while not all(store.job(job.id).state in ENDED for job in jobs):
        most = max(most, len(store.running()))
        time.sleep(0.005)
    assert most == 2
    assert all(store.job(job.id).state == State.DONE for job in jobs)
    order = sorted(jobs, key=lambda job: store.job(job.id).started)
    assert [job.owner for job in order] == ["ana", "ben", "ana", "ana"]
    assert store.job(jobs[0].id).outcome == {"state": "done", "frames": 3}


def test_a_running_job_is_cancelled_with_the_reason(store, started):
    job, runner = queue(store), started("progress(1); until_cancelled()")
    wait(lambda: store.job(job.id).progress)
    store.request_cancel(job.id, "a mistake")
    runner.wake()
    assert wait_for(store, job, *ENDED).reason == "a mistake"
    assert states(store, job) == ["queued", "running", "cancelled"]


def test_a_process_that_does_not_obey_is_killed_with_all_that_it_started(store, started, monkeypatch):
    monkeypatch.setattr(job_process, "GRACE_S", 0.2)
    job = queue(store)
    started(
        "import subprocess; child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        "say(kind='log', level='info', message=str(child.pid)); progress(1); time.sleep(600)"
    )
    wait(lambda: store.job(job.id).progress)
    store.request_cancel(job.id, "enough")
    assert wait_for(store, job, *ENDED).state == State.CANCELLED
    child = Path("/proc") / store.log_of(job.id)[0].data["message"]
    wait(lambda: not child.exists() or "Z" in (child / "stat").read_text().split()[2])


def test_a_job_whose_process_is_killed_goes_on_and_one_that_never_gets_anywhere_fails(store, started, monkeypatch):
    monkeypatch.setattr(job_process, "MOST_LOST_TRIES", 2)
    job = queue(store)
    runner = started(
        "progress(1 if number == 0 else 0)\n"
        "if number < 3: print('{\"kind\": \"prog', end='', flush=True); os.kill(os.getpid(), signal.SIGKILL)\n"
        "done()"
    )
    ended = wait_for(store, job, *ENDED)
    assert (ended.state, ended.attempts) == (State.FAILED, 3), "one that got further, and the two that were left"
    assert "SIGKILL" in ended.reason
    store.retry(job.id)
    runner.wake()
    assert wait_for(store, job, State.DONE).attempts == 4


def test_an_error_in_data_fails_at_once_with_its_text_and_what_the_process_said_last(store, started):
    job = queue(store)
    started("print('last words', file=sys.stderr); say(kind='error', lost=False, text='no columns'); sys.exit(1)")
    ended = wait_for(store, job, *ENDED)
    assert (ended.state, ended.reason, ended.attempts) == (State.FAILED, "no columns", 1)
    assert {"last words", "no columns"} <= {event.data["message"] for event in store.log_of(job.id)}


def test_paths_are_shown_relative_to_the_data_root(store, started, tmp_path):
    job = queue(store)
    started(
        "root = order['root']\n"
        "print(f'File \"{root}/one.py\", line 3', file=sys.stderr)\n"
        "say(kind='stage', stage='fit')\n"
        "say(kind='log', level='warning', message=f'{root}/movie.npy: frame 3, {root}2/movie.npy: frame 4')\n"
        "say(kind='progress', shards=1, data={'stages': {'fit': {'summary': f'see {root}/jobs/x/columns.csv'}}})\n"
        "say(kind='error', lost=False, text=f'{root}/jobs/x/movie.zarr: cannot be read. Free room in {root}.')\n"
        "sys.exit(1)"
    )
    ended = wait_for(store, job, *ENDED)
    assert ended.reason == "jobs/x/movie.zarr: cannot be read. Free room in the data root."
    lines = [event.data["message"] for event in store.log_of(job.id)]
    assert lines == [f"movie.npy: frame 3, {tmp_path}2/movie.npy: frame 4", 'File "one.py", line 3', ended.reason]
    seen = json.dumps([event.data for event in store.events()] + store.transitions(job.id) + [ended.progress])
    assert "see jobs/x/columns.csv" in seen
    assert f"{tmp_path}/" not in seen


def test_paths_in_what_the_service_finds_itself_are_shown_relative_to_the_data_root(store, started, tmp_path):
    class Broken(NoCluster):
        def ready(self, timeout_s: float) -> ClusterSettings:
            raise TractError("no", f"{tmp_path}/jobs")

    job = queue(store)
    started("", Broken())
    assert wait_for(store, job, *ENDED).reason == "jobs: no."


def test_a_process_that_dies_before_it_has_its_order_is_tried_again(store, started, monkeypatch):
    class Late(NoCluster):
        def ready(self, timeout_s: float) -> ClusterSettings:
            time.sleep(0.3)
            return super().ready(timeout_s)

    monkeypatch.setattr(job_process, "MOST_LOST_TRIES", 1)
    monkeypatch.setattr(sys.modules[__name__], "SPEECH", "raise SystemExit(3)\n")
    job = queue(store)
    started("", Late())
    ended = wait_for(store, job, *ENDED)
    assert (ended.state, ended.attempts) == (State.FAILED, 2)
    assert "exit code 3" in ended.reason


def test_paths_are_checked_again_when_a_job_starts(store, started, tmp_path):
    job = queue(store)
    (tmp_path / "movie.npy").unlink()
    (tmp_path / "movie.npy").symlink_to("/etc/passwd")
    started("done()")
    ended = wait_for(store, job, *ENDED)
    assert ended.state == State.FAILED
    assert "leads out of the data root" in ended.reason


def test_a_cluster_that_is_not_there_yet_is_waited_for(store, started):
    job = queue(store)
    started("done()", NoCluster(absent=3))
    assert wait_for(store, job, *ENDED).state == State.DONE
    assert states(store, job) == ["queued", "running", "done"]


def test_the_service_stops_and_starts_and_each_job_goes_on(store, started):
    jobs = [queue(store), queue(store)]
    runner = started("progress(1)\nif number == 0: until_cancelled()\ndone()")
    wait(lambda: store.job(jobs[0].id).progress)
    runner.stop()
    assert [store.job(job.id).state for job in jobs] == [State.QUEUED, State.QUEUED]
    assert store.transitions(jobs[0].id)[-1]["reason"] == "the service was stopped"
    store.change(jobs[1].id, State.RUNNING)  # as a service leaves it that is killed
    runner = started("done()")
    for job in jobs:
        wait_for(store, job, State.DONE)
    assert states(store, jobs[1]) == ["queued", "running", "queued", "running", "done"]
    assert store.transitions(jobs[1].id)[2]["reason"] == "the service had been killed"


def test_a_job_that_was_to_be_cancelled_when_the_service_was_killed_is(store, started):
    job = queue(store)
    store.change(job.id, State.RUNNING)
    store.request_cancel(job.id, "enough")
    started("done()")
    assert wait_for(store, job, *ENDED).reason == "enough"
    assert states(store, job) == ["queued", "running", "cancelled"]


def test_a_curated_job_stops_for_its_columns_and_goes_on_with_a_version_of_them(store, started):
    job = queue(store, curate=True)
    runner = started(
        "say(kind='log', level='info', message=json.dumps([order['until'], order['columns']]))\n"
        "done('stopped' if order['until'] else 'done')"
    )
    wait_for(store, job, State.WAITING)
    version = store.add_columns(job.id, "x,y\n1,2\n", "ana")
    store.go_on(job.id, version)
    runner.wake()
    wait_for(store, job, State.DONE)
    store.go_on(job.id, 0)
    runner.wake()
    wait(lambda: states(store, job).count("done") == 2)
    assert [event.data["message"] for event in store.log_of(job.id)] == [
        '["columns", null]',
        '[null, "x,y\\n1,2\\n"]',
        '[null, ""]',
    ]


class Clock:
    """A monotonic time that the test moves."""

    def __init__(self, monkeypatch) -> None:
        self.now = 1000.0
        monkeypatch.setattr(progress, "monotonic", lambda: self.now)


@pytest.fixture
def moved(monkeypatch) -> Clock:
    return Clock(monkeypatch)


def test_rates_and_the_time_left(moved):
    found = progress.StageMeter.start(StageStarted("fit", 200, done_frames=40, passes=2))
    found.began = moved.now
    assert (found.seconds_left, found.recent_rates) == (None, (0.0, 0.0))
    for _ in range(4):
        moved.now += 2.0
        found.add(ShardDone("fit", 0, 20, 50))
    assert (found.movie_frames, found.done_frames) == (100, 60)
    assert found.rates == found.recent_rates == (5.0, 25.0)
    assert found.seconds_left == 8.0, "80 of 200 at 10 a second"
    moved.now += 9.0  # nothing comes: of the last ten seconds, only the last shard is in the first
    assert found.recent_rates == (1.0, 5.0)
    assert found.rates == (40 / 17, 200 / 17)
    moved.now += 2.0
    assert found.recent_rates == (0.0, 0.0)


def test_the_timeline_of_a_job(moved):
    timeline = Timeline({"convert": {"state": "done", "seconds": 12.0, "summary": "of the first try"}})
    timeline(StageDone("convert", 0.0, reused=True))
    timeline(StageDone("drift", 0.0, reused=True))
    timeline(StageStarted("sum", 100))
    timeline._meters["sum"].began = moved.now
    record = timeline.to_record()
    assert record["stages"]["convert"]["summary"] == "of the first try"
    assert [stage["state"] for stage in record["stages"].values()] == [
        "done",
        "reused",
        "running",
        "pending",
        "pending",
        "pending",
    ]
    assert list(record["stages"]) == [*STAGES, REPORT]
    assert record["seconds_left"] is None
    moved.now += 6.0
    timeline(ShardDone("sum", 0, 60))
    record = timeline.to_record()
    assert record["fraction"] == pytest.approx(SHARES["convert"] + SHARES["drift"] + 0.6 * SHARES["sum"])
    assert (record["stage"], record["done_frames"], record["frames"]) == ("sum", 60, 100)
    assert record["frames_per_s"] == 10.0
    later = (SHARES["columns"] + SHARES["fit"] + SHARES[REPORT]) * 6.0 / (0.6 * SHARES["sum"])
    assert record["seconds_left"] == pytest.approx(4.0 + later)
    assert timeline.shards == 1
    for stage in ("sum", "columns", "fit", REPORT):
        timeline(StageDone(stage, 1.0))
    assert timeline.to_record()["fraction"] == pytest.approx(1.0)
    assert timeline.to_record()["seconds_left"] == 0.0
    json.dumps(timeline.to_record())


@pytest.fixture(scope="module")
def client():
    with (
        LocalCluster(1, 2, False, protocol="tcp://", dashboard_address=None) as cluster,
        Client(cluster.scheduler_address) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def whole(client, tmp_path_factory) -> run_folder.RunFolder:
    """What an undisturbed run gives of the movie beside it."""
    folder = tmp_path_factory.mktemp("whole")
    np.save(folder / "movie.npy", Scene(n_frames=24).counts())
    return run(folder / "movie.npy", folder / "out", client).outputs


def run(movie: Path, output: Path, client: Client, **more) -> pipeline.RunOutcome:
    return pipeline.run(movie, output, from_dict(RunSettings, SETTINGS), client=client, report=False, **more)


class Stopped(Exception):
    """What a sink raises to end a run."""


@pytest.mark.parametrize("kind", [Stopped, KeyboardInterrupt])
def test_a_sink_ends_a_run_at_any_moment_and_the_next_one_ends_as_an_undisturbed_one(whole, client, tmp_path, kind):
    movie, output = whole.root.parent / "movie.npy", tmp_path / "out"
    moments = {"convert": 1, "drift": 2, "sum": 0, "columns": 0, "fit": 1}
    left = dict(moments)

    def stop(event) -> None:
        stage = getattr(event, "stage", "")
        if isinstance(event, ShardDone | StageStarted) and stage in left:
            left[stage] -= 1
            if left[stage] < 0:
                del left[stage]
                raise kind

    for _ in moments:
        with pytest.raises(kind):
            run(movie, output, client, on_event=stop)
        busy = client.run(lambda dask_worker: len(dask_worker.state.executing))
        assert set(busy.values()) == {0}, "nothing of it is at work any more"
    run(movie, output, client, on_event=stop)
    assert not left
    assert differences(whole.root, output) == []


def test_a_run_stops_after_a_stage_and_takes_columns_of_others_or_its_own_again(whole, client, tmp_path):
    movie, output = whole.root.parent / "movie.npy", tmp_path / "out"
    stopped = run(movie, output, client, until="columns")
    outputs = stopped.outputs
    assert (stopped.state, stopped.fits) == ("stopped", 0)
    assert not outputs.results.exists()
    automatic = outputs.columns.read_text()
    assert stopped.columns == len(automatic.splitlines()) - 1
    fewer = "".join(automatic.splitlines(keepends=True)[:-2])
    for _ in range(2):  # the second time as after a crash
        place_columns(outputs, fewer)
        assert run(movie, output, client).columns == stopped.columns - 2
    assert outputs.columns.read_text() == fewer
    place_columns(outputs, "")
    assert run(movie, output, client).columns == stopped.columns
    place_columns(outputs, "")
    assert differences(whole.root, output) == []
    with pytest.raises(InputError, match="no such stage"):
        run(movie, output, client, until="colums")


def test_a_folder_that_another_run_holds_is_waited_for(whole, client, tmp_path):
    movie, output = whole.root.parent / "movie.npy", tmp_path / "out"
    output.mkdir()
    holder = f"import fcntl, time; file = open({str(output / '.lock')!r}, 'w'); fcntl.flock(file, fcntl.LOCK_EX)"
    with subprocess.Popen(
        [sys.executable, "-c", f"{holder}; print(flush=True); time.sleep(0.7)"], stdout=-1
    ) as process:
        process.stdout.readline()
        with pytest.raises(DestinationError, match="another run works"):
            run(movie, output, client, until="convert")
        assert run(movie, output, client, until="convert", patience_s=30.0).state == "stopped"


def groups(dask_scheduler) -> list[str]:
    return list(dask_scheduler.task_groups)


def test_a_process_ends_with_its_standard_input(whole, client):
    """What a killed service leaves behind ends at once, and its tasks with it."""
    order = {
        "job": "3f9a0c12de",
        "source": str(whole.root.parent / "movie.npy"),
        "files": None,
        "output": str(whole.root.parent / "cut_short"),
        "root": str(whole.root.parent),
        "closed": [],
        "content": "",
        "mark": {"owner": "ana", "job": "3f9a0c12de", "output": "cut_short"},
        "settings": SETTINGS,
        "cluster": {"scheduler": client.scheduler.address},
        "credentials": None,
        "columns": None,
        "until": None,
        "stages": {},
    }
    with subprocess.Popen(
        job_process.COMMAND, stdin=-1, stdout=-1, encoding="utf-8", start_new_session=True
    ) as process:
        process.stdin.write(json.dumps(order) + "\n")
        process.stdin.flush()
        assert any('"convert"' in line for line in process.stdout), "it is at work"
        wait(lambda: any("convert-job_3f9a0c12de-" in name for name in client.run_on_scheduler(groups)))
        process.stdin.close()
        began = time.monotonic()
        assert process.wait(PATIENCE_S) == -signal.SIGKILL
    wait(lambda: not any(client.run(lambda dask_worker: len(dask_worker.state.tasks)).values()))
    assert time.monotonic() - began < 5.0


@pytest.mark.slow
def test_what_is_killed_goes_on_and_ends_with_the_same_bytes(tmp_path):
    """The service, and all at once, with a small movie; the script's own choice is longer."""
    options = "--moments 2 --targets service,all --longest 0.3 --jobs 1 --concurrency 1 --workers 1 --frames 12"
    found = subprocess.run(
        [sys.executable, ROOT / "scripts" / "service_kill_test", *options.split(), "--folder", tmp_path],
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stdout + found.stderr
    assert "jobs done and identical" in found.stdout
