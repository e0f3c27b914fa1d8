"""No name that a request can give leads out of the data root: as text, through links, and over HTTP."""

import asyncio
import json
import os
from functools import partial
from itertools import product

import httpx
import pytest

from tract_dask.errors import InputError, MissingStoreError
from tract_dask.io import FileList
from tract_dask.service.app import create_app
from tract_dask.service.config import ServiceConfig
from tract_dask.service.folders import DataRoot, OutsideError

SECRET = "nobody may read this"
OPENED = "the file would be opened now"

_UPS = ("..", "%2e%2e", "%252e%252e", "..%00", "..;", ". .", ".. ", "．．", "‥", "%c0%ae%c0%ae", "..%c0%af", "．.")
_SLASHES = ("/", "//", "\\", "%2f", "%252f", "%5c", "/./", "∕", "／", "⁄", "%c0%af")

TRICKS = [
    *(f"{start}{up}{slash}{up}{slash}secret.tif" for start, up, slash in product(("", "folder/"), _UPS, _SLASHES)),
    "/etc/passwd", "//etc/passwd", "///etc/passwd", "\\etc\\passwd", "C:\\Windows\\win.ini", "C:/Windows",
    "\\\\host\\share", "file:///etc/passwd", "http://127.0.0.1/", "s3://bucket/key", "~/secret.tif", "~root",
    "$HOME/secret.tif", "`id`", "$(id)", "movie.tif\0", "movie.tif\0.png", "\0", "folder\0/../..", "movie.tif\n",
    "\r\nX: y", "\x7f", "a\tb", "\x1b[2J", "..", "../", ".", "./", "./movie.tif", "folder/..", "folder/../..",
    "folder/./../..", "...", "....//....//", "folder//movie.tif", "folder/", " ", "  /x",
    "\u2024\u2024/secret.tif", "\u202e..", "\ud800", "..\udc2f", "\udcff", "out", "out/secret.tif", "secret_link",
    "chain", "chain/secret.tif", "loop", "loop/x", "up", "up/secret.tif", "folder/out/secret.tif", "pipe", "device",
    "state", "state/service.sqlite", ".tract_dask", ".tract_dask/service.sqlite", ".TRACT_DASK/service.sqlite",
    "folder/../.tract_dask", ".tract_dask/", ".tract_dask/../movie.tif", "frames", "out/*.tif", "../*.tif",
    "*/../../*.tif", "frames/*.tif", "../secret.tif::/x", "/etc/passwd::/x", "movie.h5::\n", "a" * 256, "a/" * 2000,
    "é" * 200, "folder/" + "b" * 300,
]  # fmt: skip
"""Some name what is there and may be read in a way that must not: every one of them has to be refused."""


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    above = tmp_path_factory.mktemp("above")
    (above / "secret.tif").write_text(SECRET)
    (above / "outside").mkdir()
    (above / "outside" / "secret.tif").write_text(SECRET)
    root = above / "root"
    (root / "folder").mkdir(parents=True)
    (root / "frames").mkdir()
    (root / "clean").mkdir()
    (root / ".tract_dask").mkdir()
    for name in (
        "movie.tif",
        "folder/inner.mrc",
        "folder/notes.txt",
        "clean/f1.tif",
        "100 % dose, ½.tif",
        ".hidden.tif",
    ):
        (root / name).write_bytes(b"x" * 10)
    links = {
        "out": above / "outside",
        "folder/out": "../../outside",
        "secret_link": above / "secret.tif",
        "chain": "out",
        "loop": "loop",
        "up": "..",
        "device": "/dev/zero",
        "state": ".tract_dask",
        "frames/f1.tif": above / "secret.tif",
        "same": "folder",
        "folder/back.tif": "../movie.tif",
    }
    for name, target in links.items():
        (root / name).symlink_to(target)
    os.mkfifo(root / "pipe")
    for name, kind in (("movie.zarr", "movie"), ("results.zarr", "results")):
        (root / name).mkdir()
        (root / name / "zarr.json").write_text(json.dumps({"attributes": {"tract_dask": {"kind": kind}}}))
    return root


def test_there_are_enough_tricks():
    assert len(set(TRICKS)) == len(TRICKS) > 200


def test_no_trick_leaves_the_root(root):
    data = DataRoot(root)
    followed = {}
    for trick in TRICKS:
        for ask in (data.resolve, data.source, data.listing):
            try:
                followed[ask.__name__, trick] = ask(trick)
            except (OutsideError, MissingStoreError):
                continue
    folder_of_links = {("resolve", "frames"): root / "frames", ("listing", "frames"): []}  # to be named, not to be read
    assert followed == folder_of_links


def test_no_trick_names_a_new_place_outside(root):
    data = DataRoot(root)
    for trick in TRICKS:
        try:
            place = data.resolve(trick, must_exist=False)
        except OutsideError:
            continue
        assert place.is_relative_to(root.resolve()), trick
        assert place != root.resolve(), trick


def test_what_lies_inside_is_found(root):
    data = DataRoot(root)
    real = root.resolve()
    assert data.resolve("") == real
    assert data.resolve("movie.tif") == real / "movie.tif"
    assert data.resolve("100 % dose, ½.tif") == real / "100 % dose, ½.tif"
    assert data.resolve("same/back.tif") == real / "movie.tif"
    assert data.resolve("jobs/new/results.zarr", must_exist=False) == real / "jobs/new/results.zarr"
    assert data.relative(real / "folder" / "inner.mrc") == "folder/inner.mrc"
    assert data.relative(real) == ""
    assert data.source("movie.tif::/a/b") == f"{real}/movie.tif::/a/b"
    frames = (real / "clean" / "f1.tif",)
    assert data.source("clean") == FileList(f"{real}/clean", frames)
    assert data.source("clean/*.tif") == FileList(f"{real}/clean/*.tif", frames)
    with pytest.raises(OutsideError):
        data.relative(real.parent / "secret.tif")
    with pytest.raises(MissingStoreError, match="no such file"):
        data.resolve("jobs/new")


def test_a_data_root_may_be_a_link_itself(root, tmp_path):
    (tmp_path / "link").symlink_to(root)
    assert DataRoot(tmp_path / "link").resolve("movie.tif") == root.resolve() / "movie.tif"
    with pytest.raises(InputError, match="not a folder"):
        DataRoot(tmp_path / "nothing")


def test_a_listing_shows_movies_folders_and_files(root):
    found = [(entry.path, entry.kind, entry.bytes) for entry in DataRoot(root).listing()]
    assert found == [
        ("clean", "folder", None),
        ("folder", "folder", None),
        ("frames", "folder", None),
        ("same", "folder", None),
        ("100 % dose, ½.tif", "movie", 10),
        ("movie.tif", "movie", 10),
        ("movie.zarr", "movie", None),
        ("results.zarr", "file", None),
    ]
    inner = DataRoot(root).listing("same")
    assert [(entry.path, entry.kind) for entry in inner] == [
        ("same/back.tif", "movie"),
        ("same/inner.mrc", "movie"),
        ("same/notes.txt", "file"),
    ]
    assert inner[0].modified.endswith("Z")


class NobodyWorks:
    """Stands where files are opened: what a request gets there has passed every check of its path."""

    async def run(self, function, *args):
        raise InputError(OPENED)


@pytest.fixture(scope="module")
def app(root):
    app = create_app(ServiceConfig(root))
    app.state.workshop = NobodyWorks()
    return app


def _asked_by_path(app):
    """Every request that takes a path, by the OpenAPI document: from its name to how it is made with a trick."""
    document, found = app.openapi(), {}
    for route, operations in document["paths"].items():
        for method, about in operations.items():
            if method == "get" and "path" in {parameter["name"] for parameter in about.get("parameters", ())}:
                found[route] = partial(_get, route)
            schema = about.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema", {})
            fields = (
                document["components"]["schemas"].get(schema.get("$ref", "").split("/")[-1], {}).get("properties", {})
            )
            for name in {"source", "output"} & set(fields):
                found[f"{route} {name}"] = partial(_post, route, lambda trick, name=name: {name: trick})
            for group in ("columns", "drift") if "settings" in fields else ():
                settings = partial(_settings, group)
                found[f"{route} {group}.csv"] = partial(_post, route, settings)
    return found


def _get(route, client, trick):
    return client.get(route, params={"path": trick, "frame": 0})


def _post(route, changes, client, trick):
    return client.post(route, json={"source": "movie.tif", "settings": {}} | changes(trick))


def _settings(group, trick):
    return {"settings": {group: {"csv": trick, "method": "csv"}}}


def test_no_trick_leaves_the_root_over_http(app, root):
    asked = _asked_by_path(app)
    assert {f"/api/v1/files{end}" for end in ("", "/about", "/frame.png", "/histogram")} <= set(asked)
    assert {"/api/v1/jobs source", "/api/v1/jobs output", "/api/v1/jobs columns.csv", "/api/v1/plan source"} <= set(
        asked
    )
    sendable = [trick for trick in TRICKS if not any(0xD800 <= ord(sign) < 0xE000 for sign in trick)]

    async def ask_all():
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost:8000") as client:
            for k, (name, ask) in enumerate(asked.items()):
                for trick in sendable if name == "/api/v1/files" else sendable[k :: len(asked)]:
                    yield name, trick, await ask(client, trick)

    async def look():
        async for name, trick, answer in ask_all():
            inside = trick == "frames" and name == "/api/v1/files"  # itself, it may be listed
            assert inside or 400 <= answer.status_code < 500, (name, trick, answer.text)
            assert name.endswith("output") or OPENED not in answer.text, (name, trick)
            assert SECRET not in answer.text
            assert str(root.parent) not in answer.text

    asyncio.run(look())


def test_no_trick_leaves_the_folder_of_static_files(app):
    """A path as it comes, for clients tidy it up before they send it."""

    async def status(path):
        sent = []
        scope = {
            "type": "http",
            "method": "GET",
            "path": path,
            "raw_path": path.encode(errors="replace"),
            "query_string": b"",
        }
        scope |= {"headers": [(b"host", b"localhost:8000")], "scheme": "http", "root_path": "", "http_version": "1.1"}

        async def receive():
            return {"type": "http.disconnect"}

        async def send(message):
            sent.append(message)

        await app(scope, receive, send)
        return sent[0]["status"]

    async def look():
        assert await status("/static/style.css") == 200
        for up, slash in product((*_UPS, "/.."), _SLASHES):
            for target in ("__init__.py", "templates/base.html"):
                path = f"/static/{up}{slash}{target}"
                assert await status(path) in (400, 404, 405), path

    asyncio.run(look())
