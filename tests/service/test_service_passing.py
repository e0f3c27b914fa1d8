"""Errors of disks that pass, met by the service itself: an answer that says so, and no job that is lost."""

import errno
import os
import sqlite3
import sys
from threading import Event

import pytest

from tract_dask.errors import SourceError, StoreError
from tract_dask.service import process_pool
from tract_dask.service.crashes import UnreachableError, of_system
from tract_dask.service.jobs.states import State
from tract_dask.service.runner.job_process import JobProcess
from tract_dask.service.runner.runner import Runner

NUMBERS = [errno.EIO, errno.ESTALE, errno.EMFILE, errno.ENOTCONN]
CALLS = {"open", "os.scandir", "os.listdir"}


class Disk:
    """Lets this process's calls of the system fail below a folder, of those that Python audits."""

    def __init__(self) -> None:
        self.folder, self.number, self.failed = "", 0, 0
        sys.addaudithook(self.audit)

    def audit(self, call: str, arguments: tuple[object, ...]) -> None:
        if not self.folder or call not in CALLS or not isinstance(arguments[0], str | bytes | os.PathLike):
            return
        if (path := os.fsdecode(arguments[0])).startswith(self.folder):
            self.failed += 1
            raise OSError(self.number, os.strerror(self.number), path)


DISK = Disk()  # an audit hook stays for ever


@pytest.fixture(params=NUMBERS, ids=lambda number: errno.errorcode[number])
def broken(request, root):
    """A function that breaks the disk below a folder of the data root."""

    def do(name: str) -> None:
        DISK.folder, DISK.number, DISK.failed = str(root / name), request.param, 0

    yield do
    DISK.folder = ""


ROUTES = ["files", "files/about?path=movie.npy", "files/frame.png?path=movie.npy", "files/histogram?path=movie.npy"]


@pytest.mark.parametrize("route", ROUTES)
def test_a_disk_that_does_not_answer_is_said(api, broken, route):
    assert api.get(route).status_code == 200
    broken("movie.npy" if "path" in route else "")
    answer = api.get(route)
    if DISK.failed:  # what is known already is shown
        assert answer.status_code == 503, answer.text
        assert os.strerror(DISK.number) in answer.json()["error"]["text"]
        assert "Try again" in answer.json()["error"]["remedy"]
    DISK.folder = ""
    assert api.get(route).status_code == 200


@pytest.mark.parametrize("route", ["results", "results/columns", "sum.png", "frame.png", "columns", "report"])
def test_so_it_is_for_what_a_job_has_made(api, root, broken, route):
    job = api.post("jobs", json={"source": "movie.npy"}).json()
    for name in ("movie.zarr", "sum.zarr", "columns.zarr", "results.zarr"):
        (root / job["output"] / name).mkdir(parents=True)
        (root / job["output"] / name / "zarr.json").write_text("{}")
    (root / job["output"] / "report.html").write_text("<html></html>")
    broken("jobs")
    answer = api.get(f"jobs/{job['id']}/{route}")
    assert answer.status_code in ((503,) if DISK.failed else (200, 404, 503)), answer.text


def test_the_processes_of_the_pool_say_it_too():
    def read() -> None:
        try:
            raise OSError(errno.EIO, "Input/output error", "/data/movie.tif")
        except OSError as error:
            raise SourceError("the file cannot be read", "/data/movie.tif") from error

    found = of_system(_raised(read))
    assert isinstance(found, UnreachableError)
    assert found.where == "/data/movie.tif"
    error, _ = process_pool._answered(_packed(), 0)
    assert isinstance(error, UnreachableError)


def _raised(work) -> Exception:
    with pytest.raises(SourceError) as caught:
        work()
    return caught.value


def _packed() -> bytes:
    import pickle

    return pickle.dumps((_read_stale, ()))


def _read_stale() -> None:
    raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), "/data/movie.tif")


def test_other_errors_stay_what_they_are():
    assert of_system(ValueError("x")) is None
    assert of_system(ConnectionResetError(errno.ECONNRESET, "x")) is None
    assert of_system(StoreError("x")) is None
    assert type(of_system(FileNotFoundError(errno.ENOENT, "x", "y"))).__name__ == "MissingStoreError"


@pytest.mark.parametrize("number", NUMBERS)
def test_a_job_that_meets_one_as_it_begins_is_tried_again(api, monkeypatch, number):
    job = api.post("jobs", json={"source": "movie.npy"}).json()
    services = api.app.state.services
    services.store.change(job["id"], State.RUNNING)
    process = JobProcess(services.store.job(job["id"]), services.store, services.root, None, Event(), lambda: None)

    def refuse() -> None:
        raise OSError(number, os.strerror(number), "/data")

    monkeypatch.setattr(process, "_order", refuse)
    process.run()
    found = services.store.job(job["id"])
    assert (found.state, found.lost_tries) == (State.QUEUED, 1)
    assert os.strerror(number) in found.reason


@pytest.mark.parametrize("error", [OSError(errno.EMFILE, "x"), RuntimeError("can't start new thread"), sqlite3.Error()])
def test_the_queue_is_looked_at_again(api, monkeypatch, error):
    runner, looks = api.app.state.services.runner, []

    def fill() -> None:
        looks.append(1)
        if len(looks) == 1:
            runner.wake()
            raise error
        runner._stopping.set()

    monkeypatch.setattr(runner, "_fill", fill)
    assert isinstance(runner, Runner)
    runner._stopping.clear()
    runner._loop()
    assert len(looks) == 2
