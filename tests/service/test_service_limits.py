"""What one request may cost: files, tables, bodies and lists that are too large or deadly are refused by name."""

import asyncio
import gc
import json
import os
import time
from contextlib import closing, contextmanager
from pathlib import Path

import httpx
import pytest
from fastapi.testclient import TestClient
from serviced import URL, make_app, make_root
from starving import reserved

from tract_dask.errors import SettingsError, SourceError
from tract_dask.readers import READERS, Reader, open_source
from tract_dask.service.api.answers import whole
from tract_dask.service.config import ServiceConfig
from tract_dask.service.jobs import public
from tract_dask.service.process_pool import ProcessPool
from tract_dask.service.server import make_application
from tract_dask.settings import (
    ColumnSettings,
    ConvertSettings,
    FitSettings,
    MetadataSettings,
    SourceSettings,
    from_dict,
)
from tract_dask.stages.columns.sites import lattice_columns, settings_lattices
from tract_dask.stages.convert.references import check_references
from tract_dask.stages.drift.stage import read_drift_csv
from tract_dask.store import columns as table_of_columns
from tract_dask.store.columns import MOST_BYTES, parse_columns_csv, read_columns_csv
from tract_dask.store.files import read_small

# --- files that kill their reader ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def deadly(tmp_path_factory):
    """A service with its processes, in which readers of made-up formats crash, hang and starve."""
    root = make_root(tmp_path_factory.mktemp("deadly") / "data")
    for kind in ("crash", "hang", "starve"):
        (root / f"bad.{kind}").write_bytes(b"x")
    app = make_app(root)
    patch = pytest.MonkeyPatch()
    for suffix in (".crash", ".hang", ".starve"):
        patch.setitem(READERS, suffix, Reader("made up", (suffix,), open))
    app.state.services.pool = ProcessPool(2, memory=512 << 20, imported=("starving",))
    yield TestClient(app, base_url=URL, raise_server_exceptions=False)
    app.state.services.pool.close()
    patch.undo()


@pytest.mark.parametrize("ask", ["about", "plan", "jobs"])
@pytest.mark.parametrize(
    ("kind", "words"), [("crash", "the reader crashed on this file"), ("starve", "more memory than the service gives")]
)
def test_a_file_that_kills_or_starves_its_reader_is_named(deadly, ask, kind, words):
    path = f"bad.{kind}"
    if ask == "about":
        answer = deadly.get("files/about", params={"path": path})
    else:
        answer = deadly.post(ask, json={"source": path})
    assert answer.status_code == 422, answer.text
    assert (answer.json()["error"]["where"], words in answer.json()["error"]["what"]) == (path, True)
    assert deadly.get("files/about", params={"path": "movie.npy"}).status_code == 200


def test_a_file_that_hangs_its_reader_is_named(deadly, monkeypatch):
    run = deadly.app.state.services.pool.run

    async def soon(*args, **limits):
        return await run(*args, **limits | {"timeout_s": 1.0})

    monkeypatch.setattr(deadly.app.state.services.pool, "run", soon)
    answer = deadly.get("files/about", params={"path": "bad.hang"})
    assert answer.status_code == 422
    assert "did not finish" in answer.json()["error"]["what"]


# --- tables, lattices, lists -----------------------------------------------------------------------------------------


def sparse(path: Path, size: int) -> Path:
    with path.open("wb") as file:
        file.truncate(size)
    return path


def test_large_tables_are_refused_before_they_are_read(tmp_path):
    large = sparse(tmp_path / "large.csv", 6 << 30)
    with pytest.raises(SettingsError, match=rf"large.csv.*has {6 << 30} bytes, and may have {MOST_BYTES}"):
        read_columns_csv(large)
    with pytest.raises(SourceError, match=rf"large.csv.*has {6 << 30} bytes, and may have {(1 << 20) + 512 * 10}"):
        read_drift_csv(large, 10)


def test_pipes_and_folders_are_no_tables(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    for place in (tmp_path / "pipe.csv", tmp_path):
        with pytest.raises(SettingsError, match="cannot be read"):
            read_columns_csv(place)
        with pytest.raises(SourceError, match="cannot be read"):
            read_drift_csv(place, 3)


def test_a_file_that_grows_is_read_no_further_than_it_may(tmp_path):
    (tmp_path / "a").write_bytes(bytes(100))
    assert read_small(tmp_path / "a", 100) == bytes(100)
    with pytest.raises(OSError, match="has 100 bytes, and may have 99"):
        read_small(tmp_path / "a", 99)
    with pytest.raises(OSError, match="may have 10"):
        read_small("/proc/self/maps", 10)  # of no size, as it says


def test_a_table_has_so_many_rows(monkeypatch):
    monkeypatch.setattr(table_of_columns, "MOST_ROWS", 5)
    row = "1,2\n"
    assert parse_columns_csv("x,y\n" + row * 5, "t").sizes["column_id"] == 5
    with pytest.raises(SettingsError, match=r"too long\. Expected at most 5 lines"):
        parse_columns_csv("x,y\n" + row * 6, "t")


def test_a_field_beyond_csv_s_limit_is_no_crash(tmp_path):
    (tmp_path / "a.csv").write_text("frame,y,x\n0,1," + "9" * 200_000)
    with pytest.raises(SourceError, match="cannot be read"):
        read_drift_csv(tmp_path / "a.csv", 1000)


LATTICE = {"origin": [10, 10], "a": [20, 10], "a_count": 1, "b": [10, 20], "b_count": 1}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"a_repeats": 10**9, "b_repeats": 10**9}, "a_repeats cannot be used"),
        ({"a_repeats": 1001, "b_repeats": 1000}, "too many sites"),
        ({"a_count": 10**400}, "a_count cannot be used"),
        ({"a_count": 10**5000}, "a very large number"),
        ({"origin": [10**400, 1]}, "origin is not a position"),
        ({"origin": [[1, 2], [3, 4]]}, "origin is not a position"),
        ({"b": ["x", None]}, "b is not a position"),
    ],
)
def test_a_lattice_has_so_many_sites(change, words):
    with pytest.raises(SettingsError, match=words):
        lattice_columns(**LATTICE | change)


def test_lattices_have_so_many_sites_together():
    one = LATTICE | {"a_repeats": 700, "b_repeats": 1000}
    with pytest.raises(SettingsError, match=r"lattice 2: the lattice has too many sites. Expected at most 1000000"):
        settings_lattices([one, one])


@pytest.mark.parametrize(
    ("kind", "values", "words"),
    [
        (ColumnSettings, {"lattices": [{}] * 1001}, "the list is too long"),
        (SourceSettings, {"raw_shape": [1, "2", 3]}, "raw_shape.*whole numbers"),
        (SourceSettings, {"raw_shape": [1, 2.5, 3]}, "whole numbers"),
        (SourceSettings, {"raw_shape": [True, 2, 3]}, "whole numbers"),
        (SourceSettings, {"raw_shape": [10**30, 2, 3]}, "whole numbers"),
        (FitSettings, {"threshold": 10**5000}, "threshold"),
        (FitSettings, {"threshold": float("inf")}, "threshold"),
        (FitSettings, {"window_px": 10**5000}, "window_px"),
        (FitSettings, {"estimator": "x" * 10**6}, "x…"),
    ],
)
def test_settings_of_a_wrong_size_or_type_are_named(kind, values, words):
    with pytest.raises(SettingsError, match=words) as caught:
        from_dict(kind, values)
    assert len(str(caught.value)) < 2000


def test_the_plan_of_a_job_meets_these_limits(api, root):
    sparse(root / "large.csv", 6 << 30)
    for settings in (
        {"columns": {"method": "csv", "csv": "large.csv"}},
        {"drift": {"method": "csv", "csv": "large.csv"}},
        {"columns": {"method": "lattice", "lattices": [LATTICE | {"a_repeats": 12000, "b_repeats": 12000}]}},
    ):
        answer = api.post("plan", json={"source": "movie.npy", "settings": settings})
        assert answer.status_code == 400, answer.text
    answer = api.get("files/frame.png", params={"path": "movie.npy", "raw_shape": "1,9,9"})
    assert answer.status_code == 200


def test_a_frame_that_is_too_large_is_not_shown(api, root):
    sparse(root / "large.raw", 40 << 30)
    asked = {"path": "large.raw", "raw_shape": "1,200000,200000", "raw_dtype": "uint8"}
    answer = api.get("files/frame.png", params=asked)
    assert answer.status_code == 400
    assert "too large to be shown" in answer.json()["error"]["what"]


# --- bodies and values -----------------------------------------------------------------------------------------------

BODIES = {
    "deep lists": b'{"source":"movie.npy","settings":{"fit":' + b"[" * 100_000 + b"]" * 100_000 + b"}}",
    "open lists": b"[" * 900_000,
    "a long text": b'{"source":"' + b"a" * 900_000 + b'"}',
    "many keys": b'{"settings":{"fit":{' + b",".join(b'"k%d":1' % k for k in range(50_000)) + b"}}}",
    "a huge integer": b'{"source":"movie.npy","settings":{"fit":{"window_px":' + b"9" * 500_000 + b"}}}",
    "a large integer": b'{"source":"movie.npy","settings":{"fit":{"window_px":' + b"9" * 4000 + b"}}}",
    "1e999": b'{"source":"movie.npy","settings":{"fit":{"threshold":1e999}}}',
    "NaN": b'{"source":"movie.npy","settings":{"fit":{"threshold":NaN}}}',
    "-Infinity": b'{"source":"movie.npy","settings":{"fit":{"threshold":-Infinity}}}',
    "not UTF-8": b'{"source":"\xff\xfe"}',
    "half a letter": b'{"source":"\\ud800"}',
    "a zero": b'{"source":"a\\u0000b"}',
    "nothing": b"",
    "a number": b"1",
    "null": b"null",
    "a list": b"[]",
    "an unknown field": b'{"source":"movie.npy","more":1}',
    "a wrong type": b'{"source":["movie.npy"]}',
    "settings of settings": b'{"source":"movie.npy","settings":{"fit":{"window_px":{"a":1}}}}',
    "a group that is a list": b'{"source":"movie.npy","settings":{"fit":[]}}',
    "a group that is none": b'{"source":"movie.npy","settings":{"nonsense":{}}}',
    "a name as long as can be": b'{"source":"movie.npy","settings":{"fit":{"' + b"x" * 4000 + b'":1}}}',
}


@pytest.mark.parametrize("route", ["plan", "jobs"])
@pytest.mark.parametrize("name", BODIES)
def test_a_bad_body_is_refused(api, route, name):
    answer = api.post(route, content=BODIES[name], headers={"Content-Type": "application/json"})
    assert 400 <= answer.status_code < 500, answer.text
    assert answer.json()["error"]["what"]
    assert len(answer.content) < 20_000


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("end", ["", "/refine", "/lattice"])
def test_a_bad_body_of_columns_is_refused(api, name, end):
    job = api.app.state.services.store.submit(source="movie.npy", settings={}, owner="local")
    answer = api.post(f"jobs/{job.id}/columns{end}", content=BODIES[name])
    assert answer.status_code == 422, answer.text
    assert answer.json()["error"]["what"]
    assert len(answer.content) < 20_000


def test_libraries_reserve_little_of_the_memory_of_a_request():
    """A pool of memory that Arrow reserves for itself, 1 GiB, left half of the limit to a table of columns."""

    async def first() -> int:
        pool = ProcessPool(1, memory=2 << 30)
        try:
            return await pool.run(reserved)
        finally:
            pool.close()

    assert asyncio.run(first()) < 256 << 20


def test_too_many_values_are_counted_before_they_are_looked_at(monkeypatch):
    seen, parts = [], public._parts
    monkeypatch.setattr(public, "_parts", lambda name, value: seen.append(value) or parts(name, value))
    many = [1.5] * (public.MAX_ITEMS + 1)
    with pytest.raises(ValueError, match="more than 20000 values"):
        public.plain_values({"columns": {"lattices": [many]}})
    assert many not in seen
    public.plain_values({"columns": {"lattices": [[1.5] * (public.MAX_ITEMS - 6)]}})
    with pytest.raises(ValueError, match="more than 20000 values"):
        public.plain_values({"columns": {"lattices": [[1.5] * (public.MAX_ITEMS - 5)]}})


@pytest.mark.parametrize("text", ["a\x00", "\x1f", "\x7f", "\x9fb", "\ud800", "x\udfff"])
def test_texts_are_plain(text):
    with pytest.raises(ValueError, match="control characters"):
        public.plain_text(text)
    assert public.plain_text("Å ü 漢 \xa0\ue000\ud7ff~") == "Å ü 漢 \xa0\ue000\ud7ff~"


def test_a_large_answer_goes_out_in_parts():
    async def sent(response) -> list[bytes]:
        return [part async for part in response.body_iterator]

    content = bytes(range(256)) * 3000
    response = whole(content, "application/json", {"ETag": "x"})
    found = asyncio.run(sent(response))
    assert b"".join(found) == content
    assert max(map(len, found)) == 1 << 18
    assert (response.headers["content-length"], response.headers["etag"]) == (str(len(content)), "x")
    assert whole(b"{}", "application/json").body == b"{}"


def test_a_job_is_kept_by_another_thread_than_that_of_the_requests(api, monkeypatch):
    """The job store waits for the disk."""
    submit = api.app.state.services.store.submit

    def kept(**about):
        with pytest.raises(RuntimeError, match="no running event loop"):
            asyncio.get_running_loop()
        return submit(**about)

    monkeypatch.setattr(api.app.state.services.store, "submit", kept)
    assert api.post("jobs", json={"source": "movie.npy"}).status_code == 201


def test_the_first_requests_wait_for_nothing(tmp_path):
    before = gc.get_freeze_count()
    app = make_application(ServiceConfig(tmp_path, state_dir=tmp_path / "state"))
    assert app.openapi_schema["paths"]
    assert gc.get_freeze_count() > before + 10_000


def test_only_tables_of_columns_may_be_long(api):
    long = json.dumps({"columns": [{"x": 1, "y": 2, "kind": ""}] * 50_000}).encode()
    assert len(long) > 1 << 20
    assert api.post("plan", content=long).status_code == 413
    job = api.app.state.services.store.submit(source="movie.npy", settings={}, owner="local")
    assert api.post(f"jobs/{job.id}/columns", content=long).status_code == 404  # read, and there is no image yet
    assert api.post(f"jobs/{job.id}/label", content=long).status_code == 413


DTYPES = ("O", "V", "S1", "U1", "m8", "c8", "i4,i4", "(2,)i4", "{}", "3i4", "a", "object", "M8[s]")
DTYPES += ("0i4", "V0", "S0", ",", "i4,", "(0,)i4", "(1000000,)i8", "nonsense")


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_pixel_type_that_is_none_is_refused(api, root, dtype):
    (root / "x.raw").write_bytes(bytes(64))
    for path, asked in (
        ("files/about", {"raw_shape": [0, 1, 1], "raw_dtype": dtype}),
        ("files/frame.png", {"raw_shape": "0,1,1", "raw_dtype": dtype[:16]}),
    ):
        answer = api.get(path, params={"path": "x.raw"} | asked)
        assert 400 <= answer.status_code < 500, answer.text
    settings = {"source": {"raw_shape": [0, 1, 1], "raw_dtype": dtype}}
    answer = api.post("plan", json={"source": "x.raw", "settings": settings})
    assert 400 <= answer.status_code < 500, answer.text


@pytest.mark.parametrize("shape", [[-1, 1, 1], [0, 0, 0], [2**62, 2**62, 4], [1, -8, -8], [0, 2**31, 2**31]])
def test_a_shape_that_is_none_is_refused(api, root, shape):
    (root / "x.raw").write_bytes(bytes(64))
    answer = api.get("files/about", params={"path": "x.raw", "raw_shape": shape, "raw_dtype": "uint8"})
    assert 400 <= answer.status_code < 500, answer.text


def test_jobs_with_long_settings_come_in_shorter_pages(api):
    store = api.app.state.services.store
    text = "x" * 400_000
    jobs = [store.submit(source=f"{k}", settings={"fit": {"a": text}}, owner="local") for k in range(12)]
    first = api.get("jobs", params={"limit": 100}).json()
    assert [job["id"] for job in first["jobs"]] == [job.id for job in jobs[:-6:-1]]
    rest = api.get("jobs", params={"limit": 100, "before": first["next"]}).json()
    assert rest["jobs"][0]["id"] == jobs[-6].id


# --- the event loop --------------------------------------------------------------------------------------------------


@contextmanager
def slow_steps():
    """Collect the steps of the event loop that take its thread more than 50 ms of processor time."""
    found: list[str] = []
    run = asyncio.events.Handle._run

    def timed(handle: asyncio.Handle) -> None:
        began, what = time.thread_time(), repr(handle)
        run(handle)
        if time.thread_time() - began > 0.05:
            found.append(what)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asyncio.events.Handle, "_run", timed)
        yield found


def test_nothing_holds_the_event_loop_up(root):
    (root / "many").mkdir()
    for k in range(2000):
        (root / "many" / f"{k}.npy").touch()
    app = make_app(root)
    app.state.services.pool = ProcessPool(
        1, imported=("tract_dask.service.views.pictures", "tract_dask.service.api.columns")
    )
    store = app.state.services.store
    for k in range(40):
        job = store.submit(source=f"{k}.npy", settings={"columns": {"lattices": [LATTICE] * 20}}, owner="local")
    columns = json.dumps({"columns": [{"x": k, "y": k, "kind": "Ce"} for k in range(40_000)]}).encode()
    requests = [
        ("GET", "files", {"params": {"path": "many"}}),
        ("GET", "files/about", {"params": {"path": "many"}}),
        ("POST", "plan", {"json": {"source": "movie.npy"}}),
        ("GET", "files/frame.png", {"params": {"path": "movie.npy"}}),
        ("GET", "jobs", {"params": {"limit": 100}}),
        ("GET", f"jobs/{job.id}", {}),
        ("GET", f"jobs/{job.id}/log", {}),
        ("GET", "settings", {}),
        ("GET", "metrics", {}),
        ("POST", f"jobs/{job.id}/columns", {"content": columns}),
        ("POST", f"jobs/{job.id}/columns/refine", {"content": columns}),
    ]

    async def ask() -> list[tuple[str, list[str]]]:
        slow = []
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url=f"{URL}/", timeout=120) as client:
            for method, path, more in requests:
                await client.request(method, path, **more)  # what is made once, at the first request
                with slow_steps() as found:
                    answer = await client.request(method, path, **more)
                assert answer.status_code < 500, (path, answer.text)
                slow += [(path, found)] if found else []
        return slow

    try:
        assert asyncio.run(ask()) == []
    finally:
        app.state.services.pool.close()


def test_a_list_of_faulty_pixels_that_would_take_minutes_is_no_list(tmp_path):
    root = make_root(tmp_path / "data")
    (root / "defects.csv").write_text("1,1\n" * (1 << 20) + "1,1\n")
    with closing(open_source(root / "movie.npy")) as movie, pytest.raises(SourceError, match="give a mask") as error:
        check_references(movie, ConvertSettings(defects=str(root / "defects.csv")), MetadataSettings())
    assert error.value.where == str(root / "defects.csv")
