"""Jobs over HTTP: what is accepted, what is refused and how; every event arrives once, in order, resumed or not."""

import asyncio
import dataclasses
import json
import threading
import time

import httpx
import numpy as np
import pytest
from fastapi.testclient import TestClient
from serviced import FRAMES, URL, listening, make_app

from tract_dask.run.plan import plan_run
from tract_dask.service import checks
from tract_dask.service import event_streams as feeding
from tract_dask.service.auth.tokens import Access
from tract_dask.service.event_streams import EventStreams
from tract_dask.service.jobs.states import State
from tract_dask.service.jobs.store import JobStore
from tract_dask.settings import RunSettings, from_dict, to_dict


def submit(api: TestClient, **more) -> dict:
    answer = api.post("jobs", json={"source": "movie.npy"} | more)
    assert answer.status_code == 201, answer.text
    return answer.json()


def put(api: TestClient, job: dict, *states: State) -> None:
    for state in states:
        api.app.state.services.store.change(job["id"], state)


def test_a_job_is_kept_as_it_was_submitted(api, root):
    settings = {"fit": {"window_px": 9}, "columns": {"method": "csv", "csv": "sub/columns.csv"}}
    job = submit(api, settings=settings, label="Cé O₂", curate=True)
    assert (job["state"], job["owner"], job["label"], job["curate"]) == ("queued", "local", "Cé O₂", True)
    assert job["output"] == f"jobs/{job['id']}"
    expected = to_dict(from_dict(RunSettings, settings))
    del expected["cluster"]
    assert job["settings"] == json.loads(json.dumps(expected))
    assert job["settings"]["columns"]["csv"] == "sub/columns.csv"  # still relative to the root
    detail = api.get(f"jobs/{job['id']}").json()
    assert {name: detail[name] for name in job} == job
    assert [change["state"] for change in detail["transitions"]] == ["queued"]
    assert detail["event"] == api.app.state.services.store.newest_event()
    assert detail["links"]["events"] == f"/api/v1/jobs/{job['id']}/events"


LONG = {"columns": {"lattices": [{"origin": [k, k]} for k in range(30_000)]}}
DEEP: dict = {"columns": {"lattices": [{"a": [[[[[1]]]]]}]}}


@pytest.mark.parametrize(
    ("body", "status", "words"),
    [
        ({"source": "none.npy"}, 404, ["none.npy", "no such file"]),
        ({"source": "notes.txt"}, 400, ["notes.txt", "format is unknown"]),
        ({"source": "sub/columns.csv"}, 400, ["format is unknown"]),
        ({"source": "../movie.npy"}, 403, ["data root"]),
        ({"source": "/etc/passwd"}, 403, ["data root"]),
        ({"source": "sub/..;/x"}, 404, []),
        ({"source": "movie.raw"}, 400, ["raw_shape"]),
        ({"source": ""}, 422, ["source"]),
        ({"source": "a\u0000b"}, 422, ["control characters"]),
        ({"source": "x" * 5000}, 422, ["source"]),
        ({"source": "movie.npy", "label": "x" * 201}, 422, ["label"]),
        ({"source": "movie.npy", "labl": "x"}, 422, ["labl"]),
        ({"source": "movie.npy", "output": "sub"}, 400, ["sub", "already holds other files"]),
        ({"source": "movie.npy", "output": "notes.txt"}, 400, ["notes.txt"]),
        ({"source": "movie.npy", "output": ".."}, 403, []),
        ({"source": "movie.npy", "output": ".tract_dask/x"}, 403, ["service's own"]),
        ({"source": "movie.npy", "settings": {"fit": {"window_px": 8}}}, 400, ["window_px", "odd", "8"]),
        ({"source": "movie.npy", "settings": {"fit": {"window_px": 401}}}, 400, ["window_px"]),
        ({"source": "movie.npy", "settings": {"fit": {"vacuum_box": [0, 9999, 0, 9]}}}, 400, ["vacuum_box", "rows"]),
        (
            {"source": "movie.npy", "settings": {"columns": {"method": "template", "template": [9999, 0]}}},
            400,
            ["template", "x from 0"],
        ),
        ({"source": "movie.npy", "settings": {"fit": {"threshold": "high"}}}, 400, ["threshold", "float"]),
        ({"source": "movie.npy", "settings": {"fit": {"nothing": 1}}}, 400, ["no setting 'nothing'"]),
        ({"source": "movie.npy", "settings": {"cluster": {"scheduler": "tcp://x:1"}}}, 400, ["cluster"]),
        ({"source": "movie.npy", "settings": {"columns": {"method": "csv"}}}, 400, ["method csv needs a file"]),
        (
            {"source": "movie.npy", "settings": {"columns": {"method": "csv", "csv": "../x.csv"}}},
            403,
            ["data root"],
        ),
        ({"source": "movie.npy", "settings": {"convert": {"dark": "../dark.npy"}}}, 403, ["data root"]),
        ({"source": "movie.npy", "settings": {"convert": {"defects": "/etc/passwd"}}}, 403, ["data root"]),
        ({"source": "movie.npy", "settings": {"convert": {"gain_reference": "../x.h5::/gain"}}}, 403, ["data root"]),
        ({"source": "movie.npy", "settings": {"convert": {"dark": "gone.npy"}}}, 404, ["gone.npy"]),
        ({"source": "movie.npy", "settings": {"convert": {"dark": "notes.txt"}}}, 400, ["format is unknown"]),
        ({"source": "movie.npy", "settings": {"convert": {"defects": "notes.txt"}}}, 400, ["line 1", "not a pixel"]),
        ({"source": "movie.npy", "settings": {"drift": {"method": "csv", "csv": "gone.csv"}}}, 404, ["gone.csv"]),
        ({"source": "movie.npy", "settings": {"drift": {"method": "csv", "csv": "sub/columns.csv"}}}, 400, ["frame"]),
        ({"source": "movie.npy", "settings": LONG}, 422, ["more than"]),
        ({"source": "movie.npy", "settings": DEEP}, 422, ["deep"]),
        ({"source": "movie.npy", "settings": {"metadata": {"gain": 10**400}}}, 422, ["2^53"]),
        ('{"source": "movie.npy", "settings": {"metadata": {"gain": NaN}}}', 422, ["not finite"]),
        ('{"source": "movie.npy", "settings": {"metadata": {"gain": -1e999}}}', 422, ["not finite"]),
        ('{"source": "movie.npy", "settings": {"fit": {"\\ud800": 1}}}', 422, ["halves"]),
        ('{"source": "movie.npy", "label": "\\udfff"}', 422, ["label"]),
        ('{"source": "movie.npy", "label": ' + "[" * 100_000 + "]" * 100_000 + "}", 422, []),
        ('{"source": "movie.npy"', 422, []),
        ('"movie.npy"', 422, []),
    ],
)
def test_what_cannot_be_done_is_refused_with_its_reason(api, body, status, words):
    content = body if isinstance(body, str) else json.dumps(body)
    answer = api.post("jobs", content=content, headers={"Content-Type": "application/json"})
    parts = answer.json()["error"]
    assert answer.status_code in ((400, 422) if status == 422 else (status,)), parts
    assert all(word in parts["text"] for word in words), parts["text"]
    assert parts["what"]
    assert str(api.app.state.services.root.path) not in answer.text  # a user knows the root's inside only
    assert api.get("jobs").json()["jobs"] == []


def test_pages_of_the_list_have_every_job_once(api):
    made = [submit(api, label=f"number {k}", source="sub/other.npy" if k % 3 else "movie.npy") for k in range(8)]
    put(api, made[2], State.RUNNING, State.FAILED)
    found, asked, pages = [], {"limit": 3}, 0
    while True:
        page = api.get("jobs", params=asked).json()
        assert page["counts"] | {"queued": 7, "failed": 1} == page["counts"]
        found += [job["id"] for job in page["jobs"]]
        pages += 1
        if page["next"] is None:
            break
        asked["before"] = page["next"]
    assert found == [job["id"] for job in reversed(made)]
    assert pages == 3
    several = api.get("jobs", params={"state": ["failed", "running"], "text": "number"}).json()["jobs"]
    assert [job["id"] for job in several] == [made[2]["id"]]
    assert api.get("jobs", params={"owner": "nobody"}).json()["counts"]["queued"] == 0
    assert len(api.get("jobs", params={"text": "other.npy"}).json()["jobs"]) == 5


def test_a_job_is_cancelled_tried_again_named_and_forgotten(api):
    job = submit(api)
    place = f"jobs/{job['id']}"
    cancelled = api.post(f"{place}/cancel").json()
    assert (cancelled["state"], cancelled["reason"]) == ("cancelled", "cancelled by local")
    assert api.post(f"{place}/cancel").status_code == 409
    assert api.post(f"{place}/retry").json()["state"] == "queued"
    assert api.post(f"{place}/retry").status_code == 409
    assert api.post(f"{place}/label", json={"label": "new"}).json()["label"] == "new"
    put(api, job, State.RUNNING)
    assert api.post(f"{place}/cancel").json()["state"] == "running"  # its process ends first
    assert api.app.state.services.store.cancel_requested(job["id"])
    assert api.delete(place).status_code == 409
    put(api, job, State.CANCELLED)
    assert api.delete(place).json() == {"id": job["id"], "files": False, "kept": ""}
    for method, route in [("GET", ""), ("POST", "/cancel"), ("POST", "/retry"), ("GET", "/log"), ("GET", "/events")]:
        answer = api.request(method, place + route)
        assert answer.status_code == 404, route
        assert answer.json()["error"]["kind"] == "UnknownJobError"
    assert api.get("jobs/no-such-id").status_code == 422


def test_a_folder_is_one_jobs_at_a_time(api):
    first = submit(api, output="mine")
    answer = api.post("jobs", json={"source": "movie.npy", "output": "mine"})
    assert answer.status_code == 409
    assert first["id"] in answer.json()["error"]["text"]
    api.post(f"jobs/{first['id']}/cancel")
    second = submit(api, output="mine")
    answer = api.post(f"jobs/{first['id']}/retry")
    assert answer.status_code == 409
    assert second["id"] in answer.json()["error"]["text"]


def test_a_plan_is_that_of_the_run(api, root, monkeypatch):
    settings = {"convert": {"shard_mb": 1.0}}
    plan = api.post("plan", json={"source": "movie.npy", "settings": settings}).json()
    truth = plan_run(FRAMES, np.dtype(np.uint8), from_dict(RunSettings, settings))
    for name in ("frames", "shards", "bytes_read", "bytes_written", "peak_memory"):
        assert plan[name] == getattr(truth, name)
    assert (plan["shape"], plan["dtype"], plan["fits"], plan["problem"]) == (list(FRAMES), "uint8", True, "")
    assert plan["seconds"] == pytest.approx(checks.STARTUP_S, abs=0.1)  # a tenth of a megabyte takes no time
    cluster = api.app.state.services.runner.cluster
    monkeypatch.setattr(cluster, "workers", lambda: [{"memory_limit": 10_000_000}, {"memory_limit": 0}])
    small = api.post("plan", json={"source": "movie.npy"}).json()
    assert (small["fits"], small["memory_limit"]) == (False, 10_000_000)
    assert "0.01 GB" in small["problem"]
    monkeypatch.setattr(checks.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 1000}))
    assert "disk" in api.post("plan", json={"source": "movie.npy"}).json()["problem"]
    assert api.post("plan", json={"source": "notes.txt"}).status_code == 400


def test_the_time_of_a_job_is_estimated_from_those_before(api, root, monkeypatch):
    job = submit(api)
    movie = type("Movie", (), {"shape": (1000, 1000, 1000), "dtype": np.dtype(np.uint8)})
    monkeypatch.setattr(checks, "open_movie", lambda path: movie)
    raw = np.prod(FRAMES)
    seconds = {"convert": 400.0, "drift": 200.0, "sum": 100.0, "columns": 10.0, "fit": 290.0}
    put(api, job, State.RUNNING)
    api.app.state.services.store.change(job["id"], State.DONE, outcome={"seconds": seconds})
    (root / job["output"]).mkdir(parents=True)
    plan = api.post("plan", json={"source": "movie.npy"}).json()
    assert plan["seconds"] == pytest.approx(checks.STARTUP_S + raw / 1e6, abs=0.06)  # a gigabyte took 1000 s


def test_files_and_what_they_say(api):
    listing = api.get("files").json()["entries"]
    assert [(entry["name"], entry["kind"]) for entry in listing] == [
        ("sub", "folder"),
        ("movie.npy", "movie"),
        ("movie.raw", "movie"),
        ("notes.txt", "file"),
    ]
    assert [entry["path"] for entry in api.get("files", params={"path": "sub"}).json()["entries"]] == [
        "sub/columns.csv",
        "sub/other.npy",
    ]
    about = api.get("files/about", params={"path": "sub/other.npy"}).json()
    assert (about["path"], about["shape"], about["dtype"], about["format"]) == (
        "sub/other.npy",
        [3, *FRAMES[1:]],
        "uint8",
        "NumPy",
    )
    assert about["pixel_size_pm"] is None
    raw = {"path": "movie.raw", "raw_shape": [0, *FRAMES[1:]], "raw_dtype": "uint8"}
    assert api.get("files/about", params=raw).json()["shape"] == list(FRAMES)
    assert api.get("files/about", params=raw | {"raw_dtype": "nothing"}).status_code == 400
    assert api.get("files/about", params={"path": "../x"}).status_code == 403


def test_every_setting_of_a_job_is_listed_as_it_is_declared(api):
    rows = {(row["group"], row["name"]): row for row in api.get("settings").json()["settings"]}
    groups = [item for item in dataclasses.fields(RunSettings) if item.name != "cluster"]
    fields = {(group.name, item.name): item for group in groups for item in dataclasses.fields(group.default_factory)}
    assert rows.keys() == fields.keys()
    for key, item in fields.items():
        meta, row = item.metadata, rows[key]
        assert (row["unit"], row["description"], row["low"], row["high"]) == tuple(
            meta[name] for name in ("unit", "description", "low", "high")
        )
        assert row["default"] == (list(item.default) if isinstance(item.default, tuple) else item.default)
        assert row["choices"] == list(meta["choices"])
    document = api.get("openapi.json").json()
    schema = document["components"]["schemas"]["NewJob"]["properties"]["settings"]["properties"]
    assert {(group, name) for group, table in schema.items() for name in table["properties"]} == fields.keys()
    assert schema["fit"]["properties"]["window_px"]["type"] == ["integer", "null"]


def test_workers_are_those_that_the_cluster_sees(api, monkeypatch):
    assert api.get("workers").json() == {"workers": [], "dashboard": False}
    worker = {"name": "0", "address": "tcp://127.0.0.1:1", "cpu": 99.5, "memory": 5, "memory_limit": 7}
    worker |= {"executing": 1, "stage": "fit"}
    monkeypatch.setattr(api.app.state.services.runner.cluster, "workers", lambda: [worker])
    assert api.get("workers").json()["workers"] == [worker]


KEEPS_NOTHING = ("refine", "lattice")
"""Routes of a job that compute from what they are sent, and change nothing."""


def test_jobs_of_others_are_seen_and_left_alone(root):
    app = make_app(root, tokens=True)
    access: Access = app.state.services.access
    clients = {}
    for name, role in (("ana", "user"), ("ben", "user"), ("root", "admin")):
        headers = {"Authorization": f"Bearer {access.create_token(name, role)}"}
        clients[name] = TestClient(app, base_url=URL, headers=headers)
    job = submit(clients["ana"])
    assert job["owner"] == "ana"
    place = f"jobs/{job['id']}"
    assert clients["ben"].get(place).status_code == 200
    before = app.state.services.store.job(job["id"]).to_record()
    changing = 0
    for route, operations in app.openapi()["paths"].items():
        for method in operations:
            if method == "get" or "{job_id}" not in route or route.rpartition("/")[2] in KEEPS_NOTHING:
                continue
            changing += 1
            body = {"label": "x", "version": 0, "columns": [{"x": 1, "y": 1}]}
            for fields in ({"label"}, {"version"}, {"columns"}):
                url = f"http://127.0.0.1:8000{route.replace('{job_id}', job['id'])}"
                answer = clients["ben"].request(method, url, json={name: body[name] for name in fields})
                assert answer.status_code in (403, 422), (method, route, answer.text)
                if answer.status_code == 403:
                    break
            assert "belongs to someone else" in answer.text, (method, route)
    assert changing >= 6
    assert app.state.services.store.job(job["id"]).to_record() == before
    assert clients["root"].post(f"{place}/cancel").json()["reason"] == "cancelled by root"
    assert clients["ana"].delete(place).status_code == 200


def test_a_log_is_read_in_parts(api):
    job = submit(api)
    store: JobStore = api.app.state.services.store
    for k in range(25):
        store.log(job["id"], "info", f"line {k}")
    found, after = [], 0
    while after is not None:
        part = api.get(f"jobs/{job['id']}/log", params={"limit": 10, "after": after}).json()
        found += [line["message"] for line in part["lines"]]
        after = part["next"]
    assert found == [f"line {k}" for k in range(25)]


class Listener:
    """A browser: it reads a stream in a thread, and keeps id, kind and data of each event."""

    def __init__(self, url: str, headers: dict | None = None) -> None:
        self.events: list[tuple[int | None, str, dict]] = []
        self.ended = threading.Event()
        self.opened = threading.Event()
        self._url, self._headers, self.stop = url, headers or {}, threading.Event()
        threading.Thread(target=self._read, daemon=True).start()
        assert self.opened.wait(10)

    def _read(self) -> None:
        with httpx.Client(timeout=20) as client, client.stream("GET", self._url, headers=self._headers) as answer:
            self.kind = answer.headers["content-type"]
            self.opened.set()
            part: dict[str, str] = {}
            for line in answer.iter_lines():
                name, _, value = line.partition(": ")
                if line:
                    part[name] = value
                elif "data" in part:
                    number = int(part["id"]) if "id" in part else None
                    self.events.append((number, part["event"], json.loads(part["data"])))
                    part = {}
                if self.stop.is_set():
                    break
        self.ended.set()

    def wait_for(self, count: int) -> list:
        deadline = time.monotonic() + 60
        while len(self.events) < count and time.monotonic() < deadline:
            time.sleep(0.01)
        assert len(self.events) >= count, self.events
        return self.events


def test_events_arrive_once_in_order_and_resume_where_they_broke(root):
    with listening(root) as (url, app), httpx.Client(base_url=f"{url}/api/v1") as api:
        store: JobStore = app.state.services.store
        first, other = (api.post("/jobs", json={"source": "movie.npy"}).json() for _ in range(2))
        place = f"{url}/api/v1/jobs/{first['id']}/events"
        listener, everything = Listener(place), Listener(f"{url}/api/v1/events")
        assert listener.kind.startswith("text/event-stream")
        number, kind, data = listener.wait_for(1)[0]
        assert (kind, data) == ("job", first)  # what it is now
        assert number == store.newest_event()
        assert [data["id"] for _, _, data in everything.wait_for(2)] == [first["id"], other["id"]]
        store.change(first["id"], State.RUNNING)
        store.log(other["id"], "info", "of another job")
        for k in range(5):
            store.progress(first["id"], {"stage": "fit", "done_frames": k})
            listener.wait_for(3 + k)  # only the newest is kept: let each be seen
            everything.wait_for(5 + k)
        store.log(first["id"], "info", "line\nwith an end")
        seen = listener.wait_for(8)[1:]
        assert [kind for _, kind, _ in seen] == ["job", *["progress"] * 5, "log"]
        assert [data["done_frames"] for _, kind, data in seen if kind == "progress"] == list(range(5))
        assert {data["job"] for _, kind, data in seen if kind != "job"} == {first["id"]}
        assert seen[-1][2]["message"] == "line\nwith an end"
        numbers = [number for number, _, _ in seen]
        assert numbers == sorted(set(numbers))
        assert len(everything.wait_for(10)) == 10  # two jobs, and eight events

        resumed = Listener(place, {"Last-Event-ID": str(numbers[0])})
        kept = [event for event in seen[1:] if event[1] != "progress" or event[2]["done_frames"] == 4]
        assert resumed.wait_for(2)[:2] == kept
        stranger = Listener(place, {"Last-Event-ID": "1000000"})  # of a store that is no more
        assert stranger.wait_for(1)[0][2]["state"] == "running"
        store.log(first["id"], "info", "last")
        assert resumed.wait_for(3)[2][2]["message"] == "last"
        store.change(first["id"], State.CANCELLED)
        assert resumed.wait_for(4)[3][2]["state"] == "cancelled"
        store.delete(first["id"])
        assert resumed.wait_for(5)[-1][1:] == ("job", {"id": first["id"], "deleted": True})
        began = time.monotonic()
        app.state.services.streams.close()
        assert all(one.ended.wait(10) for one in (listener, everything, resumed, stranger))
        assert time.monotonic() - began < 10  # not with the next heartbeat


def test_a_stream_of_a_revoked_token_ends(root):
    with listening(root, tokens=True) as (url, app):
        token = app.state.services.access.create_token("ana")
        listener = Listener(f"{url}/api/v1/events", {"Authorization": f"Bearer {token}"})
        app.state.services.access.revoke("ana")
        assert listener.ended.wait(5)


def test_many_streams_take_one_reader_and_all_get_everything(tmp_path):
    async def scenario() -> None:
        store, other = JobStore(tmp_path / "a.sqlite"), JobStore(tmp_path / "a.sqlite")
        job = store.submit(source="m", settings={}, owner="ana")
        streams, reads = EventStreams(store), 0
        events = store.events

        def counted(*args):
            nonlocal reads
            reads += 1
            return events(*args)

        store.events = counted

        found: list[list[bytes]] = [[] for _ in range(60)]

        async def listen(chunks: list[bytes]) -> None:
            async for chunk in streams.listen(store.newest_event()):
                chunks.append(chunk)  # noqa: PERF401  (looked at while it grows)

        began = time.perf_counter()
        tasks = [asyncio.create_task(listen(chunks)) for chunks in found]
        while len(streams) < 60:
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.3)
        for k in range(200):
            other.log(job.id, "info", str(k))  # as another process would
        async with asyncio.timeout(30):
            while any(len(chunks) < 200 for chunks in found):
                await asyncio.sleep(0.01)
        streams.close()
        await asyncio.gather(*tasks)
        assert all(len(chunks) == 200 for chunks in found)
        assert len({b"".join(chunks) for chunks in found}) == 1
        looks = (time.perf_counter() - began) / feeding._POLL_S  # of one reader
        assert reads <= 60 + looks + 1  # each looked once into the past
        assert len(streams) == 0
        assert [chunk async for chunk in streams.listen(0)] == []  # closed for good

    asyncio.run(scenario())


def test_a_slow_stream_is_ended_and_holds_up_nobody(tmp_path):
    async def scenario() -> None:
        store = JobStore(tmp_path / "a.sqlite")
        job = store.submit(source="m", settings={}, owner="ana")
        streams = EventStreams(store, places=50)
        start = store.newest_event()
        slow, quick = streams.listen(start), streams.listen(start)
        store.log(job.id, "info", "first")
        assert b"first" in await anext(slow)
        assert b"first" in await anext(quick)
        pending = asyncio.create_task(anext(quick))
        for part in range(4):
            for k in range(20):
                store.log(job.id, "info", f"{part} {k}")
            for _ in range(20):
                last = await pending
                pending = asyncio.create_task(anext(quick))
        assert b"3 19" in last
        with pytest.raises(StopAsyncIteration):  # it gets no gap: its client resumes after what it has had
            await anext(slow)
        pending.cancel()

    asyncio.run(scenario())


def test_a_quiet_stream_says_that_it_lives_and_a_broken_store_ends_it(tmp_path, monkeypatch):
    async def scenario() -> None:
        store = JobStore(tmp_path / "a.sqlite")
        stream = EventStreams(store, heartbeat_s=0.05).listen(0)
        assert await anext(stream) == feeding.HEARTBEAT

        def broken(*args):
            raise OSError("the disk is gone")

        monkeypatch.setattr(store, "events", broken)
        async with asyncio.timeout(10):
            assert {chunk async for chunk in stream} <= {feeding.HEARTBEAT}

    asyncio.run(scenario())
