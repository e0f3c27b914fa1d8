"""Who may come in, from where, and what browsers are told: every route, page and socket."""

import asyncio
import re
import sqlite3
import threading
from types import SimpleNamespace

import httpx
import pytest
import uvicorn
import websockets
from starlette.testclient import TestClient, WebSocketDenialResponse

from tract_dask.cluster.certificates import make_certificates
from tract_dask.errors import DestinationError, InputError
from tract_dask.service import server as service_server
from tract_dask.service.app import create_app
from tract_dask.service.auth import gate
from tract_dask.service.auth.tokens import Credential, Identity, may_change
from tract_dask.service.config import ServiceConfig
from tract_dask.service.errors import ForbiddenError
from tract_dask.service.jobs.states import State
from tract_dask.service.pages import pages
from tract_dask.service.pages.dask_proxy import canonical, dashboard, may_pass
from tract_dask.service.pages.login import login
from tract_dask.settings import ClusterSettings, SshSettings

HERE = "http://localhost:8000"
ERROR_PARTS = {"what", "where", "expected", "got", "remedy", "text", "kind"}
NOBODY = {"cluster": SimpleNamespace(dashboard=lambda: None, workers=list), "is_alive": lambda: True}


def make_app(folder, **options):
    app = create_app(ServiceConfig(folder, **options))
    app.state.services.runner = SimpleNamespace(**NOBODY, start=lambda: None, stop=lambda: None, wake=lambda: None)
    return app


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    """An application that demands tokens."""
    return make_app(tmp_path_factory.mktemp("guarded"), tokens=True)


@pytest.fixture
def client(guarded):
    return TestClient(guarded, base_url=HERE, follow_redirects=False, raise_server_exceptions=False)


@pytest.fixture
def open_client(tmp_path):
    """A client of an application for everybody on this machine."""
    return TestClient(make_app(tmp_path), base_url=HERE, follow_redirects=False, raise_server_exceptions=False)


@pytest.fixture(scope="module")
def tokens(guarded):
    access = guarded.state.services.access
    made = {role: access.create_token(role, role) for role in ("admin", "user", "monitor")}
    made["revoked"] = access.create_token("gone", "admin")
    access.revoke("gone")
    made["wrong"] = f"{made['admin'][:-1]}{'a' if made['admin'][-1] != 'a' else 'b'}"
    return made


def bearer(token):
    return {"Authorization": f"Bearer {token}"}


def api_routes(app):
    """Method and path of every operation of the OpenAPI document, with something in place of its parameters."""
    for path, operations in app.openapi()["paths"].items():
        for method in operations:
            yield method.upper(), re.sub(r"\{[^}]*\}", "0123456789", path)


def page_paths():
    """Paths of every page; the login is open."""
    routes = [route for router in (pages, login, dashboard) for route in router.routes]
    paths = {route.path for route in routes if "GET" in getattr(route, "methods", ())}
    return [re.sub(r"\{[^}]*\}", "0123456789", path) for path in sorted(paths - {"/login"})]


@pytest.mark.parametrize("which", [None, "wrong", "revoked", "monitor"])
def test_every_route_of_the_api_asks_who_it_is(guarded, client, tokens, which):
    routes = [*api_routes(guarded), ("GET", "/api/v1/openapi.json"), ("GET", "/api/v1/none")]
    assert len(routes) > 30
    for method, path in routes:
        monitored = which == "monitor" and path in gate.MONITORED
        expected = 200 if monitored else 403 if which == "monitor" else 401
        answer = client.request(method, path, headers=bearer(tokens[which]) if which else {})
        assert answer.status_code == expected, (method, path)
        if expected == 401:
            assert answer.headers["www-authenticate"] == "Bearer"
            assert set(answer.json()["error"]) == ERROR_PARTS


@pytest.mark.parametrize("which", [None, "wrong", "revoked", "monitor"])
def test_every_page_and_socket_asks_who_it_is(client, tokens, which):
    paths = page_paths()
    assert {"/", "/new", "/jobs/0123456789", "/jobs/0123456789/results", "/dask/0123456789"} <= set(paths)
    headers = bearer(tokens[which]) if which else {}
    for path in paths:
        answer = client.get(path, headers=headers)
        assert answer.status_code == (403 if which == "monitor" else 303), path
        if which != "monitor":
            assert answer.headers["location"].startswith("/login?next=/")
    assert client.post("/logout", headers=headers).status_code == (403 if which == "monitor" else 401)
    with pytest.raises(WebSocketDenialResponse) as denied, client.websocket_connect("/dask/status/ws", headers=headers):
        pass
    assert denied.value.status_code == (403 if which == "monitor" else 401)


def test_only_the_login_and_static_files_are_open(client, tokens):
    assert client.get("/login").status_code == 200
    assert client.get("/static/style.css").status_code == 200
    for path in ("/login/", "/loginx", "/staticx", "/LOGIN", "//login", "/static"):
        assert client.get(HERE + path).status_code in (303, 401), path
    assert client.get("/", headers=bearer(tokens["user"])).status_code == 200
    assert client.get("/?token=" + tokens["user"]).status_code == 303  # no token in an address


def test_a_token_is_known_by_its_hash_only(guarded, tokens):
    access, store = guarded.state.services.access, guarded.state.services.store
    secrets = [token.split("_", 2)[2] for token in tokens.values()]
    dump = "\n".join(sqlite3.connect(store.path).iterdump())
    assert not any(secret in dump for secret in secrets)
    assert access.identify(Credential("token", tokens["user"])) == Identity("user", "user")
    assert tokens["user"] not in repr(Credential("token", tokens["user"]))
    named = {token.name: (token.role, token.revoked is None) for token in access.tokens()}
    assert named == {
        "admin": ("admin", True),
        "user": ("user", True),
        "monitor": ("monitor", True),
        "gone": ("admin", False),
    }
    other = tokens["admin"].split("_")[1]
    broken = ("", "x", "tract_", tokens["user"][:-1], tokens["user"] + "x", tokens["user"].upper(), "\ud800", "_" * 9)
    mixed = f"tract_{other}_{tokens['user'].split('_', 2)[2]}"
    for secret in (*broken, mixed, tokens["user"].replace("tract_", "other_")):
        assert access.identify(Credential("token", secret)) is None
        assert access.identify(Credential("session", secret)) is None


def test_tokens_have_names_that_are_free(guarded, tokens):
    access = guarded.state.services.access
    for name, role, text in (
        ("user", "user", "has a token"),
        ("a b", "user", "cannot be"),
        ("x", "king", "no such role"),
    ):
        with pytest.raises(InputError, match=text):
            access.create_token(name, role)
    with pytest.raises(InputError, match="no token in use"):
        access.revoke("gone")
    before = access.create_token("again")
    assert access.revoke(before.split("_")[1]).name == "again"  # by its ID
    after = access.create_token("again")
    assert access.identify(Credential("token", before)) is None
    assert access.identify(Credential("token", after)) == Identity("again", "user")
    access.revoke("again")


def test_a_job_is_changed_by_its_owner_or_an_admin():
    job = SimpleNamespace(id="0123456789", owner="ann")
    may_change(Identity("ann", "user"), job)
    may_change(Identity("root", "admin"), job)
    with pytest.raises(ForbiddenError, match="someone else"):
        may_change(Identity("bob", "user"), job)


def test_a_browser_logs_in_and_out(guarded, client, tokens):
    answer = client.post("/login", headers={"Origin": HERE}, data={"token": f" {tokens['user']}\n", "next": "/new?x=1"})
    assert (answer.status_code, answer.headers["location"]) == (303, "/new?x=1")
    cookie = answer.headers["set-cookie"]
    assert cookie.startswith("tract_dask_8000=")
    assert {"HttpOnly", "Path=/", "SameSite=strict", "Max-Age=43200"} <= set(cookie.split("; "))
    assert tokens["user"] not in cookie
    session = client.cookies["tract_dask_8000"]
    assert session not in "\n".join(sqlite3.connect(guarded.state.services.store.path).iterdump())
    assert client.get("/api/v1/jobs").status_code == client.get("/").status_code == 200
    assert client.post("/logout", headers={"Origin": HERE}).headers["location"] == "/login"
    assert client.get("/api/v1/jobs").status_code == 401
    again = httpx.Cookies({"tract_dask_8000": session})  # what somebody kept is of no use
    assert (
        client.get("/api/v1/jobs", headers={"Cookie": f"tract_dask_8000={again['tract_dask_8000']}"}).status_code == 401
    )


def test_a_cookie_under_tls_belongs_to_this_host_alone(guarded, tokens):
    here = "https://tract.example.org"
    client = TestClient(guarded, base_url=here, follow_redirects=False)
    cookie = client.post("/login", headers={"Origin": here}, data={"token": tokens["user"]}).headers["set-cookie"]
    assert cookie.startswith("__Host-tract_dask=")
    assert "Secure" in cookie.split("; ")
    assert "Domain" not in cookie
    assert client.get("/").status_code == 200
    assert client.get("/").headers["strict-transport-security"].startswith("max-age=")


def test_a_session_ends_with_its_token_and_with_its_time(guarded, tmp_path):
    access = guarded.state.services.access
    session = access.open_session(access.create_token("brief"))
    assert access.identify(Credential("session", session)) == Identity("brief", "user")
    assert access.identify(Credential("token", session)) is None
    access.revoke("brief")
    assert access.identify(Credential("session", session)) is None
    short = make_app(tmp_path, tokens=True, session_hours=0.0).state.services.access
    assert short.identify(Credential("session", short.open_session(short.create_token("x")))) is None


@pytest.mark.parametrize(
    "to", ["//evil.example", "https://evil.example", "/\\evil", "javascript:x", "/login", "/a\nb", ""]
)
def test_the_login_leads_nowhere_else(client, tokens, to):
    assert (
        client.post("/login", headers={"Origin": HERE}, data={"token": tokens["user"], "next": to}).headers["location"]
        == "/"
    )


def test_another_site_cannot_log_a_browser_in(client, tokens):
    for headers in (*FOREIGN, {}):  # every browser says where a form comes from
        answer = client.post("/login", headers=headers, data={"token": tokens["user"]})
        assert answer.status_code == 403, headers
        assert "set-cookie" not in answer.headers


def test_failed_logins_lock_nobody_out(client, tokens):
    """A guess at 256 bits never succeeds, and others may share the address of who guesses: a proxy's, say."""
    for _ in range(20):
        assert client.post("/login", headers={"Origin": HERE}, data={"token": "tract_0_x"}).status_code == 401
    assert client.post("/login", headers={"Origin": HERE}, data={"token": tokens["user"]}).status_code == 303


FOREIGN = [
    {"Origin": "https://evil.example"},
    {"Origin": "http://localhost:3000"},
    {"Origin": "null"},
    {"Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "same-site"},
]
OURS = [{"Origin": HERE}, {"Sec-Fetch-Site": "same-origin"}, {"Origin": HERE, "Sec-Fetch-Site": "same-origin"}]


def test_another_site_cannot_act_with_the_cookie(client, tokens):
    client.post("/login", headers={"Origin": HERE}, data={"token": tokens["user"]})
    path = "/api/v1/jobs/0123456789/cancel"
    for headers in (*FOREIGN, {}):  # a browser says one of the two; without, nothing is known
        assert client.post(path, headers=headers).status_code == 403, headers
    for headers in OURS:
        assert client.post(path, headers=headers).status_code == 404, headers
    assert (
        client.post(path, headers=bearer(tokens["user"]) | FOREIGN[0]).status_code == 404
    )  # no browser sends it unasked
    assert (
        client.get("/api/v1/jobs", headers={"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"}).status_code
        == 403
    )
    link = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}
    assert client.get("/", headers=link).status_code == 200
    client.cookies.clear()
    asked_again = client.get("/", headers=link)  # the browser keeps a strict cookie back until we ask ourselves
    assert asked_again.status_code == 200
    assert 'http-equiv="refresh"' in asked_again.text
    assert "nav" not in asked_again.text


def test_without_tokens_only_this_machine_is_let_in(open_client, tmp_path):
    for host in (
        "evil.example:8000",
        "localhost",
        "127.0.0.1:9999",
        "localhost:8000.evil.example",
        "",
        "x@localhost:8000",
    ):
        assert open_client.get("/api/v1/jobs", headers={"Host": host}).status_code == 403, host
    for host in ("localhost:8000", "127.0.0.1:8000", "[::1]:8000"):
        assert open_client.get("/api/v1/jobs", headers={"Host": host}).status_code == 200, host
    path = "/api/v1/jobs/0123456789/cancel"
    for headers in FOREIGN:
        assert open_client.post(path, headers=headers).status_code == 403, headers
    for headers in (*OURS, {}):
        assert open_client.post(path, headers=headers).status_code == 404, headers
    named = TestClient(make_app(tmp_path, allowed_hosts=("tract.example.org",)), base_url="https://tract.example.org")
    assert named.get("/api/v1/jobs", headers={"Origin": "https://tract.example.org"}).status_code == 200
    assert open_client.get("/login").headers["location"] == "/"


def test_sockets_are_for_our_own_pages(open_client):
    for headers in FOREIGN:
        with (
            pytest.raises(WebSocketDenialResponse) as denied,
            open_client.websocket_connect("/dask/status/ws", headers=headers),
        ):
            pass
        assert denied.value.status_code == 403


def test_a_body_has_its_limit(tmp_path):
    client = TestClient(make_app(tmp_path, max_body_bytes=1000), base_url=HERE)
    kind = {"Content-Type": "application/json"}
    for body in (b"x" * 1001, iter([b"x" * 600] * 2)):  # said beforehand, or sent in chunks
        answer = client.post("/api/v1/jobs", content=body, headers=kind)
        assert (answer.status_code, "1000 bytes" in answer.json()["error"]["text"]) == (413, True)
    assert client.post("/api/v1/jobs", content=b"x" * 1000, headers=kind).status_code == 422


def test_browsers_are_told_what_they_may_do(open_client):
    store = open_client.app.state.services.store
    store.counts = lambda **_: 1 / 0  # an error inside
    for path, status in (
        ("/", 200),
        ("/static/style.css", 200),
        ("/nothing", 404),
        ("/api/v1/jobs/x", 422),
        ("/api/v1/jobs", 500),
    ):
        answer = open_client.get(path)
        assert answer.status_code == status
        if status == 500:
            assert "ZeroDivision" not in answer.text
            assert answer.json()["error"]["what"] == "the service failed"
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["x-frame-options"] == "DENY"
        policy = dict(part.split(" ", 1) for part in answer.headers["content-security-policy"].split("; "))
        assert policy["script-src"] == policy["connect-src"] == policy["default-src"] == "'self'"
        assert policy["frame-ancestors"] == "'none'"
        assert answer.headers["cache-control"] == ("no-cache" if "static" in path else "no-store")
        assert {"referrer-policy", "permissions-policy"} <= set(answer.headers)
        assert "strict-transport-security" not in answer.headers
        assert "server" not in answer.headers


@pytest.mark.parametrize("part", ["identify", "page"])
def test_what_nobody_foresaw_is_a_page_for_a_browser_and_tells_nothing(guarded, client, tokens, monkeypatch, part):
    """Also where the gate itself fails, before it knows who asks."""
    if part == "identify":
        monkeypatch.setattr(guarded.state.services.access, "identify", lambda credential: 1 / 0)
    else:
        monkeypatch.setattr(guarded.state.services.store, "job", lambda job_id: 1 / 0)
    answer = client.get("/jobs/0123456789", headers=bearer(tokens["user"]) | {"Accept": "text/html"})
    assert (answer.status_code, answer.headers["content-type"]) == (500, "text/html; charset=utf-8")
    assert "The service failed" in answer.text
    assert "ZeroDivision" not in answer.text
    assert "default-src 'self'" in answer.headers["content-security-policy"]
    assert answer.headers["cache-control"] == "no-store"


def test_errors_have_one_shape_and_show_no_folder(open_client, tmp_path):
    (tmp_path / "broken.tif").write_bytes(b"x")
    for path, status in (
        ("/api/v1/jobs/0123456789", 404),
        ("/api/v1/jobs?limit=x", 422),
        ("/api/v1/files?path=none", 404),
    ):
        answer = open_client.get(path)
        assert answer.status_code == status
        assert set(answer.json()["error"]) == ERROR_PARTS
        assert str(tmp_path) not in answer.text


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_what_lasts_ends_when_its_token_is_revoked(guarded, monkeypatch, kind):
    monkeypatch.setattr(gate, "ASKED_AGAIN_S", 0.02)
    access, sent = guarded.state.services.access, []
    token = access.create_token(f"lasting-{kind}")
    begin = (
        {"type": "http.response.start", "status": 200, "headers": []}
        if kind == "http"
        else {"type": "websocket.accept"}
    )

    async def endless(scope, receive, send):
        assert scope[gate.IDENTITY].role == "user"
        await send(begin)
        await asyncio.Event().wait()

    async def send(message):
        sent.append(message)

    async def run():
        scope = {"type": kind, "path": "/api/v1/events", "method": "GET", "scheme": "http", "query_string": b""}
        scope["headers"] = [(b"authorization", b"Bearer " + token.encode()), (b"host", b"localhost:8000")]
        lasting = asyncio.create_task(gate.Gate(endless, access, guarded.state.services.config)(scope, None, send))
        await asyncio.sleep(0.1)
        assert not lasting.done()
        access.revoke(f"lasting-{kind}")
        await asyncio.wait_for(lasting, 2.0)

    asyncio.run(run())
    end = {"type": "http.response.body", "body": b"", "more_body": False}
    assert sent[0] == begin
    assert sent[1:] == [end] if kind == "http" else sent[1]["type"] == "websocket.close"


@pytest.fixture
def served(tmp_path):
    """An application on a port of its own, beside the dashboard of a real scheduler."""
    from distributed import LocalCluster

    listener = service_server.listen("127.0.0.1", 0)
    port = listener.getsockname()[1]
    with LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as cluster:
        app = make_app(tmp_path, port=port)
        address = f"http://127.0.0.1:{cluster.scheduler.http_server.port}"
        app.state.services.runner.cluster = SimpleNamespace(dashboard=lambda: address, workers=list)
        server = uvicorn.Server(uvicorn.Config(app, log_config=None, server_header=False, timeout_graceful_shutdown=1))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{port}"
        server.should_exit = True
        thread.join(10)


def test_the_dashboard_is_passed_on(served):
    with httpx.Client(base_url=served, timeout=60, trust_env=False) as client:
        assert client.get("/dask").headers["location"] == "/dask/status"
        page = client.get("/dask/status")
        assert page.status_code == 200
        assert "unsafe-eval" in page.headers["content-security-policy"]
        assert "set-cookie" not in page.headers
        linked = re.findall(r'(?:src|href)="([^":]+)"', page.text)
        assert not [link for link in linked if link.startswith("/")]  # all are relative, so the prefix stays
        script = next(link for link in linked if "bokeh.min.js" in link)
        assert (
            client.get(f"/dask/{script}")
            .headers["content-type"]
            .startswith(("text/javascript", "application/javascript"))
        )
        assert client.get("/dask/statics/css/base.css").status_code == 200
        assert client.post("/dask/api/v1/retire_workers").status_code == 405
        assert client.get("/dask/./x/%2e%2e//st%61tus").status_code == 200
        workers = client.get("/dask/info/main/workers.html")
        assert workers.status_code == 200
        token = re.search(r'"token":\s*"([^"]+)"', page.text)[1]

    async def converse():
        url = f"{served.replace('http', 'ws')}/dask/status/ws"
        async with websockets.connect(url, subprotocols=["bokeh", token], proxy=None, origin=served) as socket:
            assert socket.subprotocol == "bokeh"
            return await asyncio.wait_for(socket.recv(), 30)

    async def refused():
        for path in ("/dask/eventstream", "/dask/status", "/dask/x/ws", "/dask/proxy/1/a/ws", "/dask/./proxy/1/a/ws"):
            with pytest.raises(websockets.InvalidStatus, match="403"):
                await websockets.connect(f"{served.replace('http', 'ws')}{path}", proxy=None, origin=served)

    asyncio.run(refused())
    assert '"msgtype":"ACK"' in asyncio.run(converse()).replace(" ", "")


REFUSED = (
    *("proxy/80/127.0.0.1/x", "./proxy/80/evil/x", "%70roxy/80/evil/x", "/proxy/80/evil/x", ".//proxy/80/evil/x"),
    *("x/../proxy/80/evil/x", "%2e/proxy/80/evil/x", "x/%2e%2e/proxy/1/a", "%2E%2e/proxy/1/a", "%2570roxy/80/evil/x"),
    *("..%2fproxy/80/evil/x", "status/../proxy/80/evil/x", "info/..%2f..%2fproxy/1/a", "statics/../proxy/80/evil/x"),
    *("statics/%2e%2e/proxy/80/evil/x", "statics/..%2f..%2fproxy/1/a", "Proxy/80/evil/x", "proxy%2f80%2fevil%2fx"),
    *("api/v1/get_workers", "./api/v1/adaptive_target", "api/v1/retire_workers", "%61pi/v1/get_workers"),
    *("jupyter/lab", "./jupyter", "jupyter", "json/identity.json", "metrics", "sitemap.json", "health", "eventstream"),
    *("individual-plots.json", "info/main/../../proxy/1/a", "info/x/y.html", "status/ws", "status/metadata", "\\proxy"),
    *("status;/../proxy/1/a", "status%00", "status%0d%0aX:y", "status%3f", "%c0%ae%c0%ae/proxy/1/a", "static"),
    *("info/main/workers.html/../../../api/v1/get_workers", "statics/.htaccess", "statics/a%00b", "statics/%2f"),
)  # fmt: skip


@pytest.mark.parametrize("path", REFUSED)
def test_no_path_of_the_dashboard_but_those_of_its_pages_is_passed_on(path):
    for prefix in ("/dask/", "/dask//", "/dask/./"):
        assert not may_pass(canonical({"raw_path": f"{prefix}{path}".encode()}))


def test_every_page_of_the_dashboard_that_dask_has_is_passed_on():
    from distributed.dashboard.scheduler import applications

    for page in applications:
        assert may_pass((page.strip("/"),)), page


def test_without_a_dashboard_a_page_says_so(open_client):
    answer = open_client.get("/dask/status")
    assert answer.status_code == 503
    assert "dashboard is not there" in answer.text


def test_health_says_what_needs_help(open_client, monkeypatch):
    state = open_client.app.state.services
    assert open_client.get("/api/v1/health").json()["status"] == "degraded"  # no scheduler is known
    state.runner.cluster = SimpleNamespace(dashboard=lambda: None, workers=lambda: [{"name": "w"}])
    well = open_client.get("/api/v1/health")
    assert (well.status_code, well.json()["status"], well.json()["workers"]) == (200, "ok", 1)
    state.runner.is_alive = lambda: False
    ill = open_client.get("/api/v1/health")
    assert (ill.status_code, ill.json()["status"]) == (503, "failed")
    state.runner.is_alive = lambda: True

    def fail(**_):
        raise sqlite3.OperationalError("disk I/O error")

    monkeypatch.setattr(state.store, "counts", fail)
    ill = open_client.get("/api/v1/health")
    assert (ill.status_code, ill.json()["database"], ill.json()["queue"]) == (503, "disk I/O error", None)


def test_the_figures_count_what_jobs_do(open_client):
    store = open_client.app.state.services.store

    def figures():
        text = open_client.get("/api/v1/metrics").text
        found = re.findall(r"^(tract_dask_\w+)(?:\{(.*)\})? (\S+)$", text, re.M)
        return {f"{name} {labels}".strip(): float(value) for name, labels, value in found}

    def stage(started, ended, frames):
        return {
            "state": "done" if ended else "running",
            "seconds": 2.5,
            "started": started,
            "ended": ended,
            "done_frames": frames,
        }

    now = "2999-01-01T00:00:00.000Z"
    first, second = (store.submit(source="a.tif", settings={}, owner="ann") for _ in range(2))
    assert figures()['tract_dask_jobs state="queued"'] == figures()["tract_dask_queue_length"] == 2
    store.change(first.id, State.RUNNING)
    for frames, fits in ((10, 100), (30, 300)):
        store.progress(first.id, {"stage": "fit", "fits": fits, "stages": {"fit": stage(now, None, frames)}})
        found = figures()
        assert (found["tract_dask_frames_total"], found["tract_dask_fits_total"]) == (frames, fits)
    store.progress(first.id, {"stage": "report", "fits": 0, "stages": {"fit": stage(now, now, 40)}})
    store.change(first.id, State.DONE, outcome={"fits": 400})
    store.change(second.id, State.RUNNING)
    for _ in range(2):  # what was counted is not counted again
        found = figures()
        assert (found["tract_dask_frames_total"], found["tract_dask_fits_total"]) == (40, 400)
        assert found['tract_dask_stage_seconds_total stage="fit"'] == 2.5
        assert found['tract_dask_stages_total stage="fit"'] == 1
    open_client.get("/api/v1/jobs/0123456789")
    open_client.get("/jobs/0123456789")
    open_client.get("/some/thing")
    routes = {name for name in figures() if name.startswith("tract_dask_requests_total")}
    assert 'tract_dask_requests_total method="GET",route="/api/v1/jobs/{job_id}",status="404"' in routes
    assert 'tract_dask_requests_total method="GET",route="/jobs/{job_id}",status="404"' in routes
    assert 'tract_dask_requests_total method="GET",route="none",status="404"' in routes


def test_serve_refuses_what_cannot_work(tmp_path):
    def serve(**options):
        service_server.serve(ServiceConfig(**({"data_root": tmp_path} | options)), print)

    with pytest.raises(DestinationError, match="not a folder"):
        serve(data_root=tmp_path / "none")
    for others in ({"host": "0.0.0.0"}, {"tokens": True}):
        with pytest.raises(InputError, match="tract-dask token create NAME --data-root"):
            serve(**others, port=0)
    service_server.create_token(ServiceConfig(tmp_path), "probe", "monitor")  # such a token cannot do anything
    with pytest.raises(InputError, match="there is none"):
        serve(tokens=True, port=0)
    with service_server.listen("127.0.0.1", 0) as taken, pytest.raises(DestinationError, match="--port"):
        serve(port=taken.getsockname()[1])
    with pytest.raises(InputError, match="cannot be read"):
        serve(certificates=tmp_path / "none", port=0)
    with (
        service_server.sole_use(ServiceConfig(tmp_path).lock, "another"),
        pytest.raises(DestinationError, match="another service works on this data root"),
    ):
        serve(port=0)
    assert ServiceConfig(tmp_path).state.stat().st_mode & 0o777 == 0o700


def test_serve_warns_of_what_is_not_encrypted(tmp_path):
    def notes(cluster=None, **options):
        config = ServiceConfig(tmp_path, cluster=cluster or ClusterSettings(), **options)
        return " ".join(service_server.check_access(config) + service_server.check_traffic(config))

    service_server.create_token(ServiceConfig(tmp_path), "ann", "user")
    assert notes() == notes(ClusterSettings(scheduler="tcp://127.0.0.1:8786")) == ""
    assert "--tls" in notes(ClusterSettings(scheduler="tcp://10.0.0.5:8786"))
    assert notes(ClusterSettings(scheduler="tls://10.0.0.5:8786", tls="certificates")) == ""
    for open_to_all in (
        ClusterSettings(scheduler="tcp://127.0.0.1:8786"),
        ClusterSettings(scheduler_file="scheduler.json"),
        ClusterSettings(kind="ssh", ssh=SshSettings(hosts=("node1",))),
    ):
        with pytest.raises(InputError, match="tokens would not protect the service") as caught:
            notes(open_to_all, tokens=True)
        assert "--tls" in caught.value.remedy
    assert notes(ClusterSettings(kind="local"), tokens=True) == ""
    assert "unencrypted" in notes(host="0.0.0.0")
    make_certificates(tmp_path / "certs")
    assert notes(host="0.0.0.0", certificates=tmp_path / "certs") == ""
    make_certificates(tmp_path / "soon", days=10)
    assert "expires in" in notes(certificates=tmp_path / "soon")
    shown = "\n".join(
        service_server.banner(ServiceConfig(tmp_path, host="::1", port=8443, certificates=tmp_path), ["a note"])
    )
    assert "https://[::1]:8443" in shown
    assert "a note" in shown


def test_a_token_goes_into_a_file_for_one_pair_of_eyes(tmp_path):
    file = tmp_path / "token"
    made = service_server.create_token(ServiceConfig(tmp_path), "ann", "user", file)
    assert file.read_text() == f"{made}\n"
    assert file.stat().st_mode & 0o777 == 0o600
    with pytest.raises(DestinationError, match="cannot be written"):
        service_server.create_token(ServiceConfig(tmp_path), "bob", "user", file)
    with pytest.raises(InputError, match="has a token"):
        service_server.create_token(ServiceConfig(tmp_path), "ann", "user", tmp_path / "other")
    assert not (tmp_path / "other").exists()
    assert [token.name for token in service_server.list_tokens(ServiceConfig(tmp_path))] == ["ann"]
    assert service_server.revoke_token(ServiceConfig(tmp_path), "ann").name == "ann"
