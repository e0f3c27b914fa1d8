"""The client and its commands against a real service: what they return, how they watch, and how they fail."""

import contextlib
import dataclasses
import json
import socket
import threading
import time

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from serviced import listening, make_root
from test_service_results import Fits

import tract_dask
from tract_dask import open_results
from tract_dask.cli import jobs as cli_jobs
from tract_dask.cli.main import main
from tract_dask.errors import (
    ClusterError,
    DestinationError,
    InputError,
    MissingStoreError,
    ServiceError,
    SettingsError,
    SourceError,
)
from tract_dask.progress import RunDone, RunStarted, ShardDone, StageDone, StageStarted, Warned
from tract_dask.service.client import ServiceClient, ServiceEvent, ServiceJob, parse_events
from tract_dask.service.jobs.states import State
from tract_dask.service.jobs.store import JobStore
from tract_dask.settings import FitSettings, RunSettings


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """A service that runs nothing by itself, and its store: the tests decide what happens to the jobs."""
    with listening(make_root(tmp_path_factory.mktemp("service") / "data")) as (url, app):
        yield url, app.state.services.store, app


@pytest.fixture
def client(service):
    with ServiceClient(service[0]) as client:
        yield client


@pytest.fixture
def jobs(service) -> JobStore:
    _, store, app = service
    until(lambda: len(app.state.services.streams) == 0)
    for job in store.jobs(limit=500):
        if job.state == State.RUNNING:
            store.change(job.id, State.CANCELLED)
        store.delete(job.id)
    return store


def until(condition, timeout_s: float = 20.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert condition()


def stages(fit: str, done: int, seconds: float | None = None) -> dict:
    found = {"convert": {"state": "done", "seconds": 2.0, "frames": 12, "done_frames": 12, "summary": "12 frames"}}
    found["drift"] = {"state": "reused", "seconds": 0.0, "frames": 12, "done_frames": 12, "summary": ""}
    found["fit"] = {"state": fit, "seconds": seconds, "frames": 12, "done_frames": done, "summary": ""}
    return {"stage": "fit", "fits": 10 * done, "fraction": 0.5, "stages": found}


def run(app, job_id: str, end: State = State.DONE, reason: str = "") -> None:
    """What a runner would make of a job, once somebody watches."""
    store = app.state.services.store
    until(lambda: len(app.state.services.streams) > 0)
    time.sleep(0.1)
    store.change(job_id, State.RUNNING)
    store.progress(job_id, stages("running", 4))
    time.sleep(0.3)
    store.log(job_id, "warning", "the disk is nearly full")
    store.progress(job_id, stages("running", 8))
    time.sleep(0.3)
    store.progress(job_id, stages("done", 12, 3.0))
    store.change(job_id, end, reason, outcome={"frames": 12, "columns": 3, "fits": 36, "accepted": 35})


@contextlib.contextmanager
def aside(function, *args):
    thread = threading.Thread(target=function, args=args)
    thread.start()
    yield
    thread.join()


def test_what_is_submitted_is_read_listed_changed_and_forgotten(client, jobs):
    settings = RunSettings(fit=FitSettings(window_px=9))
    job = client.submit("movie.npy", settings, label="one", output="out/here")
    other = client.submit("sub/other.npy", {"fit": {"threshold": 2.0}}, curate=True)
    assert (job.state, job.label, job.output, job.settings["fit"]["window_px"]) == ("queued", "one", "out/here", 9)
    assert other.curate
    assert other.settings["fit"]["threshold"] == 2.0
    read = client.job(job.id)
    assert dataclasses.replace(read, transitions=[]) == job
    assert [change["state"] for change in read.transitions] == ["queued"]
    assert [found.id for found in client.jobs()] == [other.id, job.id]
    assert [found.id for found in client.jobs(text="one")] == [job.id]
    assert client.jobs(limit=1)[0].id == other.id
    assert client.cancel(job.id).state == State.CANCELLED
    assert client.jobs(states=[State.CANCELLED])[0].id == job.id
    assert client.retry(job.id).state == State.QUEUED
    assert client.label(job.id, "two").label == "two"
    assert client.delete(job.id, files=True)["kept"] == ""
    assert client.find(other.id[:6]).id == other.id
    assert client.plan("movie.npy")["frames"] == 12
    assert "movie.npy" in [entry["name"] for entry in client.files()]
    assert client.about("movie.npy")["dtype"] == "uint8"
    assert client.workers() == []


def test_all_pages_are_read(client, jobs, monkeypatch):
    monkeypatch.setattr("tract_dask.service.client._PAGE", 2)
    made = [jobs.submit(source="movie.npy", settings={}, owner="local").id for _ in range(5)]
    for k in range(3):
        jobs.log(made[0], "info", f"line {k}")
    assert [job.id for job in client.jobs()] == made[::-1]
    assert [job.id for job in client.jobs(limit=3)] == made[:1:-1]
    assert [line["message"] for line in client.log(made[0])] == ["line 0", "line 1", "line 2"]
    with pytest.raises(InputError, match="no job has an id"):
        client.find("0123456789")


@pytest.mark.parametrize(
    ("ask", "kind", "words"),
    [
        (lambda client: client.submit("gone.npy"), MissingStoreError, "gone.npy: there is no such file"),
        (lambda client: client.submit("notes.txt"), SourceError, "notes.txt: the format is unknown"),
        (lambda client: client.submit("movie.npy", {"fit": {"window_px": 8}}), SettingsError, "odd number from 5 to"),
        (lambda client: client.submit("movie.npy", output="sub"), DestinationError, "already holds other files"),
        (lambda client: client.submit("../x"), InputError, "data root"),
        (lambda client: client.job("0123456789"), InputError, "0123456789: there is no such job"),
        (lambda client: client.job("nothing"), InputError, "pattern"),
    ],
)
def test_errors_are_those_of_the_service_with_its_words(client, ask, kind, words):
    with pytest.raises(kind, match=words) as caught:
        ask(client)
    assert type(caught.value) is kind
    assert caught.value.what


def test_a_job_is_watched_to_its_end(client, jobs, service):
    job = client.submit("movie.npy")
    with aside(run, service[2], job.id):
        events = list(client.watch(job.id))
    assert events[0].job is not None
    assert events[0].job.state == "queued"
    assert [event.job.state for event in events if event.job][-1] == "done"
    assert {event.kind for event in events} == {"job", "progress", "log"}
    numbers = [event.id for event in events]
    assert numbers == sorted(set(numbers))
    assert client.wait(job.id).outcome["accepted"] == 35
    assert [event.kind for event in client.watch(job.id)] == ["job"]  # it has ended: nothing more comes


def test_waiting_ends_at_columns_in_time_or_with_the_job(client, jobs):
    curated, slow, gone = (client.submit("movie.npy") for _ in range(3))
    jobs.change(curated.id, State.RUNNING)
    jobs.change(curated.id, State.WAITING, "the columns can be looked at")
    assert client.wait(curated.id).state == "waiting_for_columns"
    began = time.monotonic()
    with pytest.raises(TimeoutError):
        client.wait(slow.id, timeout_s=0.5)
    assert time.monotonic() - began < 20
    with aside(lambda: (time.sleep(0.3), jobs.delete(gone.id))), pytest.raises(InputError, match="deleted"):
        client.wait(gone.id)


def test_watching_goes_on_over_a_restart_of_the_service_without_a_gap(tmp_path):
    root = make_root(tmp_path / "data")
    seen: list[str] = []
    with contextlib.ExitStack() as stack:
        url, app = stack.enter_context(listening(root))
        store = app.state.services.store
        job = store.submit(source="movie.npy", settings={}, owner="local")
        client = stack.enter_context(ServiceClient(url))

        def watch() -> None:
            seen.extend(event.data["message"] for event in client.watch(job.id) if event.kind == "log")

        thread = threading.Thread(target=watch)
        thread.start()
        until(lambda: len(app.state.services.streams) > 0)
        time.sleep(0.1)
        for k in range(3):
            store.log(job.id, "info", f"before {k}")
        time.sleep(0.4)
        app.state.services.streams.close()  # it ends the stream, and refuses others, as a service does that stops
        for k in range(3):
            store.log(job.id, "info", f"meanwhile {k}")
        app.state.services.streams._closed = False
        time.sleep(0.8)
        store.log(job.id, "info", "after")
        store.change(job.id, State.CANCELLED)
        thread.join(20)
    assert seen == [f"{when} {k}" for when in ("before", "meanwhile") for k in range(3)] + ["after"]


def test_a_service_that_is_not_there_is_said_to_be(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
    with ServiceClient(url, patience_s=0.0) as client:
        with pytest.raises(ServiceError, match="cannot be reached"):
            client.jobs()
        with pytest.raises(ServiceError, match="cannot be reached"):
            client.wait("0123456789")
    for wrong, words in (("localhost:8000", "not an address"), ("ftp://x", "not an address")):
        with pytest.raises(InputError, match=words):
            ServiceClient(wrong)
    with pytest.raises(InputError, match="certificate"):
        ServiceClient(url, ca=tmp_path / "ca.pem")


def test_an_answer_that_is_no_answer_is_an_error():
    import httpx

    newer = dict.fromkeys(("where", "expected", "got", "remedy"), "") | {"what": "x", "kind": "OfANewerVersion"}

    def answering(status: int, content: bytes) -> ServiceClient:
        transport = httpx.MockTransport(lambda request: httpx.Response(status, content=content))
        return ServiceClient("http://proxy", transport=transport)

    for status, content, kind in [
        (502, b"<html>Bad Gateway</html>", ClusterError),
        (403, b"[]", ServiceError),
        (500, b'{"error": {"kind": "annotations"}}', ServiceError),
        (418, json.dumps({"error": newer}).encode(), InputError),
    ]:
        with answering(status, content) as client, pytest.raises(kind):
            client.jobs()


def test_results_come_whole_or_not_at_all(client, jobs, service, tmp_path):
    _, _, app = service
    job = client.submit("movie.npy")
    with pytest.raises(MissingStoreError):
        client.download(job.id, tmp_path / "early.zip")
    fits = Fits(app.state.services.root.path / job.output)
    fits.create()
    fits.finish()
    truth = open_results(fits.path)
    opened = client.open_results(job.id)
    xr.testing.assert_identical(opened.load(), truth.load())
    kept = client.open_results(job.id, tmp_path / "kept")
    np.testing.assert_array_equal(kept["fit"], truth["fit"])
    assert [path.name for path in (tmp_path / "kept").iterdir()] == [f"{job.id}.zarr"]
    client.open_results(job.id, tmp_path / "kept")  # in place of the older one
    table = client.download(job.id, tmp_path / "tracks.csv")
    assert len(table.read_text().splitlines()) > truth["fit"].sizes["frame"]
    for wrong in (tmp_path / "tracks.csv", tmp_path / "tracks.xyz", tmp_path / "none" / "tracks.csv"):
        with pytest.raises(DestinationError):
            client.download(job.id, wrong)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kept", "tracks.csv"]


def test_columns_are_sent_as_the_service_takes_them(monkeypatch):
    sent = []

    def answer(self, method, path, **asked):
        sent.append((method, path, asked.get("json")))
        return {"version": 3, "versions": [{"version": 0}], "columns": [{"x": 1.0}]}

    monkeypatch.setattr(ServiceClient, "_ask", answer)
    with ServiceClient("http://x") as client:
        rows = [{"column_id": 4, "x": 1.5, "y": 2.5, "kind": "Ce", "flags": [], "amplitude": 3.0}, {"x": 7.0, "y": 8.0}]
        assert client.save_columns("j", rows, "mine") == 3
        assert client.columns_versions("j") == [{"version": 0}]
        assert client.columns("j", 2) == [{"x": 1.0}]
    saved = [{"column_id": 4, "x": 1.5, "y": 2.5, "kind": "Ce"}, {"x": 7.0, "y": 8.0}]
    assert sent[0] == ("POST", "/jobs/j/columns", {"columns": saved, "note": "mine"})
    assert [path for _, path, _ in sent[1:]] == ["/jobs/j/columns", "/jobs/j/columns/2"]


def test_a_token_is_needed_and_taken_where_the_service_demands_one(tmp_path, monkeypatch):
    with listening(make_root(tmp_path / "data"), tokens=True) as (url, app):
        token = app.state.services.access.create_token("ana")
        with ServiceClient(url) as nobody, pytest.raises(InputError, match="a token is needed"):
            nobody.jobs()
        with ServiceClient(url, token) as ana:
            assert ana.submit("movie.npy").owner == "ana"
        (tmp_path / "token").write_text(f"{token}\n")
        asked = ["jobs", "--server", url, "--json"]
        assert CliRunner().invoke(main, asked).exit_code == 2
        found = CliRunner().invoke(main, [*asked, "--token-file", str(tmp_path / "token")])
        assert json.loads(found.stdout)[0]["owner"] == "ana"
        monkeypatch.setenv("TRACT_DASK_TOKEN", token)
        assert CliRunner().invoke(main, asked).exit_code == 0
        assert "cannot be read" in CliRunner().invoke(main, [*asked, "--token-file", str(tmp_path / "none")]).stderr


def test_streams_are_parsed_however_they_are_written():
    text = "retry: 1000\n\nevent:job\ndata:{}\n\n: comment\n\nid: 5\n\nid: 6\nevent: log\ndata: {}\n\nid: 7\ndata: {"
    assert list(parse_events(text.split("\n"))) == [ServiceEvent(None, "job", {}), ServiceEvent(6, "log", {})]


def test_what_a_service_says_of_a_job_is_shown_as_a_run_is(client, jobs, service):
    job = client.submit("movie.npy")
    with aside(run, service[2], job.id, State.FAILED, "the disk was full"):
        translate = cli_jobs.Translation()
        shown = [event for one in client.watch(job.id) for event in translate(one)]
    assert shown[0] == RunStarted("movie.npy", job.output)
    assert [event for event in shown if isinstance(event, StageStarted)] == [
        StageStarted("convert", 12),
        StageStarted("drift", 12, 12),
        StageStarted("fit", 12, 4),
    ]
    assert [event for event in shown if isinstance(event, StageDone)] == [
        StageDone("convert", 2.0, summary="12 frames"),
        StageDone("drift", 0.0, reused=True),
        StageDone("fit", 3.0),
    ]
    fitted = [event for event in shown if isinstance(event, ShardDone) and event.stage == "fit"]
    assert sum(event.frames for event in fitted) == 8
    assert Warned("the disk is nearly full") in shown
    assert isinstance(shown[-1], RunDone)
    assert (shown[-1].state, shown[-1].message) == ("failed", "failed: the disk was full")


def test_the_commands(service, client, jobs, monkeypatch):
    monkeypatch.setenv("TRACT_DASK_SERVER", service[0])

    def command(*words: str, code: int = 0):
        found = CliRunner().invoke(main, words)
        assert found.exit_code == code, found.output
        return found

    assert "No jobs found" in command("jobs").stdout
    wrong = command("submit", "movie.npy", "--window-px", "8", code=2)
    assert "odd number" in wrong.stderr
    submitted = command("submit", "movie.npy", "--window-px", "9", "--label", "mine", "--curate", "--json")
    job = ServiceJob.from_record(json.loads(submitted.stdout))
    assert (job.settings["fit"]["window_px"], job.label, job.curate) == (9, "mine", True)
    table = command("jobs", "--text", "mine").stdout
    assert all(word in table for word in (job.id, "queued", "mine", "local"))
    with aside(run, service[2], job.id, State.DONE_WITH_FAILED_FRAMES):
        watched = command("watch", job.id[:7], code=3)
    assert "fit: done in 3.0 s" in watched.stderr
    assert "accepted  35" in watched.stdout
    assert command("cancel", job.id, code=2).stderr.startswith("Error: job")
    other = json.loads(command("submit", "movie.npy", "--json").stdout)["id"]
    assert json.loads(command("cancel", other[:8], "--json").stdout)["state"] == "cancelled"
    assert command("watch", other, code=1).stdout.splitlines()[1].startswith("state")
    command("watch", "zz", code=2)
    waiting = client.submit("movie.npy", curate=True)
    jobs.change(waiting.id, State.RUNNING)
    jobs.change(waiting.id, State.WAITING)
    assert f"{waiting.id}/columns" in command("watch", waiting.id).stdout


def test_the_client_is_a_public_name():
    assert tract_dask.ServiceClient is ServiceClient
