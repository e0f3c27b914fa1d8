"""No name that a request can give leads out of the data root: as text, through links, and over HTTP."""

import asyncio
import json
import os
import socket
from functools import partial
from itertools import product
from pathlib import Path

import httpx
import numpy as np
import pytest
import zarr

from tests.helpers.files_dm import write_seconds
from tract_dask.errors import InputError, MissingStoreError
from tract_dask.readers import open_source
from tract_dask.readers.movie_files import FileList
from tract_dask.service.app import create_app
from tract_dask.service.config import ServiceConfig
from tract_dask.service.data_root import DataRoot, OutsideError, Page

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
    folder_of_links = {
        ("resolve", "frames"): root / "frames",
        ("listing", "frames"): Page([], None),
    }  # to be named, not to be read
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


def test_a_folder_that_is_one_movie_is_named_as_a_whole(tmp_path):
    frames = np.arange(4 * 5 * 6, dtype="u2").reshape(4, 5, 6)
    write_seconds(tmp_path / "run", frames, [2, 2])
    data = DataRoot(tmp_path)
    place = data.source("run")
    assert place == f"{data.path}/run"
    np.testing.assert_array_equal(open_source(place, permit=data.permit).read(0, 4), frames)
    write_seconds(tmp_path / "out/of", frames, [4])
    (tmp_path / "root").mkdir()
    (tmp_path / "root/run").mkdir()
    (tmp_path / "root/run/Hour_00").symlink_to(tmp_path / "out/of/Hour_00")
    with pytest.raises(OutsideError):
        DataRoot(tmp_path / "root").source("run")


def test_a_data_root_may_be_a_link_itself(root, tmp_path):
    (tmp_path / "link").symlink_to(root)
    assert DataRoot(tmp_path / "link").resolve("movie.tif") == root.resolve() / "movie.tif"
    with pytest.raises(InputError, match="not a folder"):
        DataRoot(tmp_path / "nothing")


def test_a_listing_shows_movies_folders_and_files(root):
    found = [(entry.path, entry.kind, entry.bytes) for entry in DataRoot(root).listing().entries]
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
    inner = DataRoot(root).listing("same").entries
    assert [(entry.path, entry.kind) for entry in inner] == [
        ("same/back.tif", "movie"),
        ("same/inner.mrc", "movie"),
        ("same/notes.txt", "file"),
    ]
    assert inner[0].modified.endswith("Z")


class NobodyWorks:
    """Stands where files are opened: what a request gets there has passed every check of its path."""

    async def run(self, function, *args, **limits):
        raise InputError(OPENED)


@pytest.fixture(scope="module")
def app(root):
    app = create_app(ServiceConfig(root))
    app.state.services.pool = NobodyWorks()
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


def test_a_listing_comes_in_pages(tmp_path):
    names = [f"{k:03}.tif" for k in range(23)] + ["B.zarr", "a é ½.mrc"]
    for name in names[:-2]:
        (tmp_path / name).touch()
    (tmp_path / "a é ½.mrc").touch()
    (tmp_path / "B.zarr").mkdir()
    for name in ("y", "Z"):
        (tmp_path / name).mkdir()
    data, found, after, pages = DataRoot(tmp_path), [], "", 0
    while after is not None:
        page = data.listing("", after, 5)
        assert len(page.entries) <= 5
        found += [entry.name for entry in page.entries]
        after, pages = page.next, pages + 1
    assert pages == 6
    assert found == ["y", "Z", *names[:-2], "a é ½.mrc", "B.zarr"]
    assert [entry.name for entry in data.listing().entries] == found


def test_only_a_page_s_entries_are_looked_at(tmp_path, monkeypatch):
    for k in range(300):
        (tmp_path / f"{k}.tif").touch()
    asked = []
    resolve = DataRoot.resolve

    def counted(self, *path, **more):
        asked.append(path)
        return resolve(self, *path, **more)

    monkeypatch.setattr(DataRoot, "resolve", counted)
    DataRoot(tmp_path).listing("", "", 10)
    assert len(asked) <= 11


@pytest.mark.parametrize("after", ["1zz", "x", "1f"])
def test_a_page_that_is_none_is_refused(tmp_path, after):
    with pytest.raises(InputError, match="no such page"):
        DataRoot(tmp_path).listing("", after)


@pytest.mark.parametrize("name", ["a.zarr", "a.zspy", "plain folder"])
def test_a_zarr_store_of_others_is_a_movie(name, tmp_path):
    frames = np.arange(24, dtype="u2").reshape(2, 3, 4)
    zarr.create_array(tmp_path / name, data=frames, chunks=(1, 3, 4))
    data = DataRoot(tmp_path)
    (entry,) = data.listing().entries
    assert entry.kind == ("folder" if name == "plain folder" else "movie")
    place = data.source(name)
    assert place == str(data.path / name)
    np.testing.assert_array_equal(open_source(place, permit=data.permit).read(0, 2), frames)
    (tmp_path / name / "c/1/0/0").unlink()
    (tmp_path / name / "c/1/0/0").symlink_to("/etc/hostname")
    with pytest.raises(OutsideError):
        data.source(name)


def test_names_that_are_not_utf8_are_shown_and_pipes_left_out(tmp_path):
    (tmp_path / "good.tif").touch()
    (tmp_path / os.fsdecode(b"caf\xe9.tif")).touch()
    os.mkfifo(tmp_path / "pipe.tif")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s.tif"))
    (tmp_path / "fake.zarr").mkdir()
    os.mkfifo(tmp_path / "fake.zarr" / "zarr.json")  # is not waited for
    found = [(entry.name, entry.path, entry.kind) for entry in DataRoot(tmp_path).listing().entries]
    assert found == [
        ("caf\\xe9.tif", "", "unusable"),
        ("fake.zarr", "fake.zarr", "file"),
        ("good.tif", "good.tif", "movie"),
    ]
    for page in (DataRoot(tmp_path).listing("", "", 1), DataRoot(tmp_path).listing()):
        json.dumps([page.next, *(entry.name for entry in page.entries)], ensure_ascii=False).encode()
    for name in ("pipe.tif", "s.tif"):
        with pytest.raises(OutsideError, match="neither a file nor a folder"):
            DataRoot(tmp_path).source(name)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("{root}/a b/c.tif: gone", "a b/c.tif: gone"),
        ("'{root}/x' and ({root}/y), at {root}/", "'x' and (y), at the data root"),
        ("in {root}. Or {root}: or {root}", "in the data root. Or the data root: or the data root"),
        ("{root}2/x, {root}-old, {root}.old, /mnt{root}/x", "{root}2/x, {root}-old, {root}.old, /mnt{root}/x"),
        ("file://{root}/x, PosixPath('{root}/y')", "file://x, PosixPath('y')"),
    ],
)
def test_paths_are_shown_relative_to_the_root(tmp_path, text, shown):
    root = DataRoot(tmp_path)
    text, shown = (part.replace("{root}", str(tmp_path)) for part in (text, shown))
    assert root.shown(text) == shown
    assert root.shown({"a": [text, 1.5, None], "b": {"c": text}}) == {"a": [shown, 1.5, None], "b": {"c": shown}}
    assert DataRoot(Path("/")).shown("/tmp/x") == "/tmp/x"
