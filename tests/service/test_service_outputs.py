"""A folder of results is the job's that made it: nobody else writes there, and nothing is deleted but what it wrote."""

import json
import os
import shutil
import threading
from contextlib import suppress
from dataclasses import asdict
from itertools import count
from pathlib import Path
from time import monotonic, sleep

import pytest
from fastapi.testclient import TestClient
from serviced import URL, make_app

from tract_dask.errors import DestinationError, InputError, TractError
from tract_dask.service.data_root import DataRoot, OutsideError
from tract_dask.service.deletion import delete_files, finish_deletions
from tract_dask.service.errors import ForbiddenError
from tract_dask.service.jobs.states import State
from tract_dask.service.outputs import MARK, Mark, check_owner, claim, read_mark, seal
from tract_dask.service.runner.cluster_process import ClusterProcess
from tract_dask.store import metadata
from tract_dask.store.locks import sole_use
from tract_dask.store.run_folder import RunFolder

OWNERS = {"ana": "user", "ben": "user", "root": "admin"}


@pytest.fixture
def app(root):
    return make_app(root, tokens=True)


@pytest.fixture
def clients(app) -> dict[str, TestClient]:
    tokens = {name: app.state.services.access.create_token(name, role) for name, role in OWNERS.items()}
    return {
        name: TestClient(app, base_url=URL, headers={"Authorization": f"Bearer {token}"})
        for name, token in tokens.items()
    }


def mark_of(job: dict) -> Mark:
    return Mark(job["owner"], job["id"], job["output"])


def submit(client: TestClient, **more) -> dict:
    answer = client.post("jobs", json={"source": "movie.npy"} | more)
    assert answer.status_code == 201, answer.text
    return answer.json()


def write_run(folder: Path) -> RunFolder:
    """Leave what a run leaves, by name."""
    outputs = RunFolder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for path in (outputs.settings, outputs.columns, outputs.events, outputs.report):
        path.write_text("x")
    for store in (outputs.movie, outputs.results):
        (store / "0").mkdir(parents=True, exist_ok=True)
        about = {metadata.ATTRIBUTE: {"kind": "movie", "complete": False}}
        (store / "zarr.json").write_text(json.dumps({"attributes": about}))
        for name in ("0/zarr.json", "0/c.0.0.0"):
            (store / name).write_text("x")
    (folder / "results.zarr.journal").mkdir(exist_ok=True)
    (folder / "results.zarr.journal" / "worker.jsonl").write_text("x")
    return outputs


def done(app, root: Path, client: TestClient, **more) -> tuple[dict, Path]:
    """A job that has been through its stages."""
    job = submit(client, **more)
    work(app, root, job)
    return job, root / job["output"]


def work(app, root: Path, job: dict) -> None:
    app.state.services.store.change(job["id"], State.RUNNING)
    claim(DataRoot(root), mark_of(job))
    write_run(root / job["output"])
    seal(DataRoot(root), mark_of(job))
    app.state.services.store.change(job["id"], State.DONE)


def files(folder: Path) -> list[str]:
    return sorted(
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_symlink() or not path.is_dir()
    )


def delete(client: TestClient, job: dict) -> dict:
    answer = client.delete(f"jobs/{job['id']}", params={"files": True})
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.mark.parametrize("output", ["movie.npy", "movie.npy/x", "movie.npy/x/y"])
def test_a_file_is_no_folder_for_results(clients, output):
    answer = clients["ana"].post("jobs", json={"source": "movie.npy", "output": output})
    assert answer.status_code == 400, answer.text
    assert answer.json()["error"]["where"] == output


def test_a_folder_of_another_owner_is_refused(app, root, clients):
    _, folder = done(app, root, clients["ana"], output="here/ana")
    before = files(folder)
    for name in ("ben", "root"):  # an administrator deletes that job first, if that is what is meant
        for route in ("jobs", "plan"):
            answer = clients[name].post(route, json={"source": "movie.npy", "output": "here/ana"})
            assert (answer.status_code, answer.json()["error"]["what"]) == (403, "this folder belongs to someone else")
        for inside in ("here/ana/below", "here/ana/movie.zarr/0", "here/ana/results.zarr"):
            answer = clients[name].post("jobs", json={"source": "movie.npy", "output": inside})
            assert answer.status_code == 400
            assert "output of another run" in answer.text
    assert files(folder) == before
    again = submit(clients["ana"], output="here/ana")
    work(app, root, again)
    assert read_mark(folder).job == again["id"]


@pytest.mark.parametrize("spelling", ["OUT/Run", "out/ＲＵＮ", "Out/run", "out/run ", "out/run.", "oUt/other"])
def test_a_name_that_differs_only_as_letters_may_is_refused(app, root, clients, spelling):
    done(app, root, clients["ana"], output="out/run")
    answer = clients["ana"].post("jobs", json={"source": "movie.npy", "output": spelling})
    assert answer.status_code == 400, answer.text


@pytest.mark.parametrize(
    ("output", "status"),
    [
        *((name, 400) for name in (".tract_das?", "a*", "[x]", "x/[!a]", "x?/y", "jobs", "JOBS", "sub", "notes.txt")),
        *((name, 400) for name in (".x", "x/.y", "x ", "x./y", "..\u200b/x", "x\u202e", ".tract_dask\ufeff/x", "x::y")),
        *((name, 400) for name in ("hand", "hand/below", "by_toml/below", "x.zarr/y", "empty", "sub/other.npy")),
        *(
            (name, 403)
            for name in ("link", "link/below", "jobs/../x", "/x", "x//y", ".", ".tract_dask", ".Tract_Dask/x")
        ),
    ],
)
def test_a_folder_that_no_job_has_made_is_refused(app, root, clients, output, status):
    write_run(root / "hand")
    (root / "by_toml").mkdir()
    (root / "by_toml" / "run.toml").touch()
    (root / "empty").mkdir()
    (root / "real").mkdir()
    (root / "link").symlink_to("real")
    for name in ("ana", "root"):
        for route in ("jobs", "plan"):
            answer = clients[name].post(route, json={"source": "movie.npy", "output": output})
            assert answer.status_code == status, answer.text
            assert str(root) not in answer.text
    with pytest.raises(InputError):
        claim(DataRoot(root), Mark("ana", "0123456789", output))
    assert not (root / output / MARK).exists()


def test_a_copy_of_a_folder_is_nobodys(app, root, clients):
    _, folder = done(app, root, clients["ana"], output="one")
    shutil.copytree(folder, root / "two")
    answer = clients["ana"].post("jobs", json={"source": "movie.npy", "output": "two"})
    assert answer.status_code == 400
    for text in ("", "{", "[]", '{"owner": "ana"}', json.dumps({"owner": "ana", "job": "x", "output": "one"})):
        (root / "two" / MARK).write_text(text)
        with pytest.raises(DestinationError, match="already holds other files"):
            check_owner(DataRoot(root), Mark("ana", "", "two"))


def test_one_of_two_jobs_gets_a_folder(app, root, clients):
    first = submit(clients["ana"], output="a/b")
    for output in ("a/b", "A/b", "a", "a/b/c", "a/B/c"):
        for name in ("ana", "ben"):
            answer = clients[name].post("jobs", json={"source": "movie.npy", "output": output})
            assert answer.status_code == 409, output
            assert first["id"] in answer.text
    submit(clients["ben"], output="a/c")
    clients["ana"].post(f"jobs/{first['id']}/cancel")
    second = submit(clients["ben"], output="a/b")
    work(app, root, second)
    assert clients["ana"].post(f"jobs/{first['id']}/retry").status_code == 200
    with pytest.raises(ForbiddenError):  # what its process does first
        claim(DataRoot(root), mark_of(first))


def test_of_many_processes_that_claim_a_folder_at_once_one_owner_gets_it(root):
    for number in range(20):
        won, barrier = list[str](), threading.Barrier(4)

        def take(name: str, output: str, won=won, barrier=barrier) -> None:
            barrier.wait()
            try:
                claim(DataRoot(root), Mark(name, f"{name}0", output), patience_s=10)
            except TractError:
                return
            won.append(name)

        threads = [threading.Thread(target=take, args=(name, f"raced{number}")) for name in ("a", "b", "a", "c")]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(set(won)) == 1
        assert read_mark(root / f"raced{number}").owner == won[0]
        assert files(root / f"raced{number}") == [".lock", MARK]


def test_what_a_job_wrote_goes_with_it(app, root, clients):
    for more in ({}, {"output": "named/run"}):
        job, folder = done(app, root, clients["ana"], **more)
        assert delete(clients["ana"], job) == {"id": job["id"], "files": True, "kept": ""}
        assert not folder.exists()
    job = submit(clients["ana"])
    clients["ana"].post(f"jobs/{job['id']}/cancel")
    assert delete(clients["ana"], job)["files"]


class KilledError(BaseException):
    """The process ended here."""


@pytest.mark.parametrize("more", [{}, {"output": "named/run"}])
def test_a_deletion_that_is_cut_off_anywhere_is_gone_on_with_at_the_next_start(app, root, clients, more, monkeypatch):
    store = app.state.services.store
    for steps in count():
        job, folder = done(app, root, clients["ana"], **more)
        (folder / ".movie.zarr.x.partial").mkdir()
        store.delete(job["id"], files=True)
        (left,) = store.deletions()
        with monkeypatch.context() as patch:
            _kill_after(steps, patch)
            with suppress(KilledError):
                assert delete_files(DataRoot(root), store, left) == ""
        was_cut_off = store.deletions() == [left]
        finish_deletions(DataRoot(root), store)
        assert not folder.exists(), steps
        assert store.deletions() == []
        assert folder.parent.exists()
        if not was_cut_off:
            break
    assert steps > 20


def _kill_after(steps: int, patch: pytest.MonkeyPatch) -> None:
    """Let the process end before the file that would be deleted or replaced next, after ``steps`` of them.

    Not at the files of the lock, which end with their process: this one goes on.
    """
    left = iter(range(steps))

    def cut(function):
        def wrapped(path, *args, **options):
            if not Path(path).name.startswith(".lock") and next(left, None) is None:
                raise KilledError
            return function(path, *args, **options)

        return wrapped

    for name in ("unlink", "rmdir", "replace", "rename"):
        patch.setattr(os, name, cut(getattr(os, name)))


def test_what_was_changed_stays_also_where_its_deletion_was_cut_off(app, root, clients, monkeypatch):
    job, folder = done(app, root, clients["ana"], output="run")
    (folder / "run.toml").write_text("made by hand")
    app.state.services.store.delete(job["id"], files=True)
    with monkeypatch.context() as patch:
        _kill_after(6, patch)
        with pytest.raises(KilledError):
            finish_deletions(DataRoot(root), app.state.services.store)
    finish_deletions(DataRoot(root), app.state.services.store)
    assert set(files(folder)) == {"run.toml", ".lock", MARK}
    assert app.state.services.store.deletions() == []


def test_a_new_job_may_take_a_folder_whose_deletion_was_cut_off(app, root, clients):
    job, folder = done(app, root, clients["ana"], output="run")
    app.state.services.store.delete(job["id"], files=True)
    following = submit(clients["ana"], output="run")
    work(app, root, following)
    before = files(folder)
    finish_deletions(DataRoot(root), app.state.services.store)
    assert files(folder) == before
    assert app.state.services.store.deletions() == []


def test_the_runner_goes_on_with_deletions_when_it_starts(app, root, clients, monkeypatch):
    job, folder = done(app, root, clients["ana"])
    app.state.services.store.delete(job["id"], files=True)
    for name in ("start", "stop"):
        monkeypatch.setattr(ClusterProcess, name, lambda cluster: None)
    app.state.services.runner.start()
    deadline = monotonic() + 20
    while app.state.services.store.deletions() and monotonic() < deadline:
        sleep(0.01)
    app.state.services.runner.stop()
    assert not folder.exists()


def test_what_others_put_there_stays(app, root, clients):
    job, folder = done(app, root, clients["ana"])
    (root / "precious").mkdir()
    (root / "precious" / "zarr.json").write_text("precious")
    (folder / "notes.txt").write_text("mine")
    (folder / "more").mkdir()
    (folder / "more" / "run.toml").write_text("mine")
    (folder / "results.zarr" / "notes.txt").write_text("mine")
    (folder / "results.zarr" / "link").symlink_to(root / "precious")
    (folder / "drift.zarr").symlink_to(root / "precious")
    (folder / "movie.zarr" / "0" / "c.1.0.0").symlink_to(root / "movie.npy")
    answer = delete(clients["ana"], job)
    assert "drift.zarr" in answer["kept"]
    kept = {"notes.txt", "more/run.toml", "results.zarr/notes.txt", "results.zarr/link", "drift.zarr", ".lock", MARK}
    assert set(files(folder)) == kept | {"movie.zarr/0/c.1.0.0"}
    assert files(root / "precious") == ["zarr.json"]
    assert (root / "movie.npy").exists()


def test_what_was_made_anew_by_hand_stays(app, root, clients):
    job, folder = done(app, root, clients["ana"], output="run")
    for path in (folder / "results.zarr" / "zarr.json", folder / "run.toml"):
        path.unlink()
        path.write_text("made by hand")
    (folder / "sum.zarr").mkdir()
    answer = delete(clients["ana"], job)
    assert not answer["files"]
    assert all(name in answer["kept"] for name in ("results.zarr", "run.toml", "sum.zarr"))
    assert (folder / "results.zarr" / "0" / "c.0.0.0").exists()
    assert not (folder / "movie.zarr").exists()


def test_a_folder_that_another_job_has_taken_stays(app, root, clients):
    first, folder = done(app, root, clients["ana"], output="run")
    second = submit(clients["ana"], output="run")
    assert second["id"] in delete(clients["ana"], first)["kept"]
    work(app, root, second)
    third = submit(clients["ana"], output="run")
    work(app, root, third)
    clients["ana"].delete(f"jobs/{third['id']}")  # forgotten, and its files left
    before = files(folder)
    assert third["id"] in delete(clients["ana"], second)["kept"]
    assert files(folder) == before


def test_a_folder_is_left_while_a_run_works_there_and_where_a_link_leads_to_it(app, root, clients):
    job, folder = done(app, root, clients["ana"], output="run")
    linked = submit(clients["ana"])
    with sole_use(folder / ".lock", "another"):
        answer = delete(clients["ana"], job)
    assert "another run works in this folder" in answer["kept"]
    assert str(root) not in answer["kept"]
    (root / "jobs").mkdir(exist_ok=True)
    (root / linked["output"]).symlink_to(folder)
    clients["ana"].post(f"jobs/{linked['id']}/cancel")
    assert "link" in delete(clients["ana"], linked)["kept"]
    with pytest.raises(OutsideError, match="link"):
        claim(DataRoot(root), mark_of(linked))
    by_hand = submit(clients["ana"], output="later")
    write_run(root / "later")  # while the job waits
    clients["ana"].post(f"jobs/{by_hand['id']}/cancel")
    assert delete(clients["ana"], by_hand)["kept"] == "no job has made it"
    assert (root / "later" / "run.toml").exists()


def test_an_unsealed_folder_goes_by_the_names_of_a_run(app, root, clients):
    """The service was killed with the job's process: nothing says what was made."""
    job = submit(clients["ana"], output="run")
    claim(DataRoot(root), mark_of(job))
    write_run(root / "run")
    (root / "run" / ".movie.zarr.partial").mkdir()
    (root / "run" / "notes.txt").touch()
    clients["ana"].post(f"jobs/{job['id']}/cancel")
    assert delete(clients["ana"], job)["kept"] == ""
    assert files(root / "run") == ["notes.txt"]


def test_a_job_of_an_older_version_goes_on_in_its_own_folder(root):
    mark = Mark("ana", "0123456789", "jobs/0123456789")
    write_run(root / "jobs" / "0123456789")
    claim(DataRoot(root), mark)
    assert read_mark(root / mark.output) == mark


def test_a_mark_is_whole_and_is_no_result(root):
    mark = Mark("ana", "0123456789", "run")
    claim(DataRoot(root), mark)
    write_run(root / "run")
    seal(DataRoot(root), mark)
    found = json.loads((root / "run" / MARK).read_text())
    assert found == asdict(read_mark(root / "run"))
    left = {"run.toml", "columns.csv", "events.jsonl", "report.html", "movie.zarr", "results.zarr"}
    assert set(found["made"]) == left
    seal(DataRoot(root), Mark("ana", "other", "run"))  # not its folder any more
    assert read_mark(root / "run").job == "0123456789"
    assert [entry.name for entry in DataRoot(root).listing("run").entries if entry.name.startswith(".")] == []
