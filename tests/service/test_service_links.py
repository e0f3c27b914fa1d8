"""Links inside of movies, stores and folders of frames: followed where they lead to the data root, else refused."""

import io
import json
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
import zarr
from fastapi.testclient import TestClient
from files_classic import mrc
from files_dm import write_director
from files_stamped import write_mib, write_seq
from serviced import FRAMES, URL, make_app, make_root

from tract_dask.errors import ChangedSourceError, MissingSourceError, TractError
from tract_dask.progress import ShardDone, StageStarted
from tract_dask.readers import READERS, merlin, open_source
from tract_dask.readers.movie_files import FileList, list_files
from tract_dask.service.data_root import Bounds, DataRoot, OutsideError
from tract_dask.service.jobs.states import State
from tract_dask.service.outputs import Mark
from tract_dask.service.runner.job_process import JobProcess
from tract_dask.service.runner.job_work import Reporter, run_order
from tract_dask.settings import RunSettings, to_dict
from tract_dask.stages.convert.stage import convert
from tract_dask.store import metadata
from tract_dask.store.stamps import Stamps

SHAPE = (4, 48, 40)
KINDS = ("external", "virtual", "raw", "chain", "nested", "soft")


@pytest.fixture
def root(tmp_path) -> Path:
    (tmp_path / "outside").mkdir()
    return make_root(tmp_path / "data")


def write_target(folder: Path) -> Path:
    """Put what links lead to into a folder."""
    folder.mkdir(exist_ok=True)
    movie = np.full(SHAPE, 77, np.uint8)
    with h5py.File(folder / "target.h5", "w") as file:
        file["d"] = movie
    (folder / "target.bin").write_bytes(movie.tobytes())
    return folder


def write_link(path: Path, kind: str, folder: Path) -> str:
    """Write an HDF5 file whose movie lies in the files of ``folder``; return what to open."""
    target = folder / "target.h5"
    with h5py.File(path, "w") as file:
        match kind:
            case "external":
                file["m"] = h5py.ExternalLink(str(target), "/d")
            case "virtual":
                layout = h5py.VirtualLayout(SHAPE, "u1")
                layout[:] = h5py.VirtualSource(str(target), "d", SHAPE)
                file.create_virtual_dataset("m", layout)
            case "raw":
                file.create_dataset("m", SHAPE, "u1", external=[(str(folder / "target.bin"), 0, 4 * 48 * 40)])
            case "chain":  # a link to a link
                with h5py.File(path.with_name("middle.h5"), "w") as middle:
                    middle["x"] = h5py.ExternalLink(str(target), "/d")
                file["m"] = h5py.ExternalLink("middle.h5", "/x")
            case "nested":  # a virtual movie behind a link, of a relative name
                write_link(path.with_name("inner.h5"), "virtual", folder)
                file["m"] = h5py.ExternalLink("inner.h5", "/m")
            case "soft":
                file["link"] = h5py.ExternalLink(str(target), "/")
                file["m"] = h5py.SoftLink("/link/d")
    return f"{path.name}::/m"


def ask_everywhere(api: TestClient, name: str) -> dict[str, tuple[int, str]]:
    found = {kind: api.get(f"files/{kind}", params={"path": name}) for kind in ("about", "frame.png", "histogram")} | {
        kind: api.post(kind, json={"source": name}) for kind in ("plan", "jobs")
    }
    return {kind: (answer.status_code, answer.text[:2000]) for kind, answer in found.items()}


@pytest.mark.parametrize("kind", KINDS)
def test_a_link_inside_of_an_hdf5_file_is_followed_within_the_data_root_only(api, root, kind):
    inside, outside = write_target(root / "inside"), write_target(root.parent / "outside")
    name = write_link(root / "good.h5", kind, inside)
    assert {status for status, _ in ask_everywhere(api, name).values()} <= {200, 201}
    assert api.get("files/histogram", params={"path": name}).json()["range"] == [77, 77]
    for number, target in enumerate((outside, root / "linked")):
        if not target.exists():
            target.symlink_to(outside)
        name = write_link(root / f"bad{number}.h5", kind, target)
        for route, (status, text) in ask_everywhere(api, name).items():
            assert status == 403, (route, text)
            assert "leads out of the data root" in text
            assert str(root.parent) not in text


@pytest.mark.parametrize("kind", KINDS)
def test_nobody_learns_from_links_what_there_is_outside(api, root, kind):
    outside = write_target(root.parent / "outside")
    answers = []
    for _ in range(2):
        name = write_link(root / "probe.h5", kind, outside)
        answers.append({route: status for route, (status, _) in ask_everywhere(api, name).items()})
        for file in outside.iterdir():  # the second time nothing is there
            file.unlink()
    assert answers[0] == answers[1] == dict.fromkeys(answers[0], 403)


def test_a_link_to_the_services_own_folder_is_refused(root):
    state = root / "state"
    app = TestClient(make_app(root, state_dir=state), base_url=URL)
    write_target(state)
    for kind in KINDS[:3]:
        name = write_link(root / f"{kind}.h5", kind, state)
        assert {status for status, _ in ask_everywhere(app, name).values()} == {403}
    for path in ("state", "state/service.sqlite", "state/target.h5", "state/*.h5", "state/new"):
        assert app.get("files", params={"path": path}).status_code in (403, 404)
        assert app.get("files/about", params={"path": path}).status_code == 403, path
        assert app.post("jobs", json={"source": "movie.npy", "output": path}).status_code in (400, 403)
    assert "state" not in [entry["name"] for entry in app.get("files").json()["entries"]]


def test_frames_that_are_links_are_followed_within_the_data_root_only(api, root):
    for folder in (root.parent / "outside", root / "inside"):
        folder.mkdir(exist_ok=True)
        np.save(folder / "f.npy", np.full((1, 48, 40), 7, np.uint8))
        np.full((1, 48, 40), 7, np.uint8).tofile(folder / "secret.sqlite")
    for name, target in (("good", root / "inside"), ("bad", root.parent / "outside")):
        (root / name).mkdir()
        for number in range(3):
            np.save(root / name / f"f_{number}.npy", np.full((1, 48, 40), number, np.uint8))
        (root / name / "f_3.npy").symlink_to(target / "f.npy")
    for source in ("good", "good/*.npy", "good/f_[3].npy", "good/f_3.npy"):
        assert {status for status, _ in ask_everywhere(api, source).values()} <= {200, 201}, source
        for job in api.get("jobs").json()["jobs"]:
            api.post(f"jobs/{job['id']}/cancel")
    for source in ("bad", "bad/*.npy", "bad/f_?.npy", "bad/f_[3].npy", "bad/f_3.npy"):
        assert {status for status, _ in ask_everywhere(api, source).values()} == {403}, source
    assert {status for status, _ in ask_everywhere(api, "bad/f_[012].npy").values()} <= {200, 201}
    (root / "raw.raw").symlink_to("inside/secret.sqlite")
    (root / "raws").mkdir()
    (root / "raws" / "a.raw").symlink_to("../inside/secret.sqlite")
    raw = {"raw_shape": "1,48,40", "raw_dtype": "uint8"}
    for source in ("raw.raw", "raws", "raws/*.raw", "inside/secret.sqlite", "inside/*.sqlite", "notes.txt"):
        answer = api.get("files/frame.png", params={"path": source} | raw)
        assert (answer.status_code, "format is unknown" in answer.text) == (400, True), source


def test_a_path_in_a_file_is_no_path_of_another(api, root):
    assert api.post("jobs", json={"source": "movie.npy", "output": "movie.npy::"}).status_code == 400
    (root / "movie.npy::").mkdir()
    raw = {"raw_shape": "1,1,1", "raw_dtype": "uint8"}
    for source in ("movie.npy::/../notes.txt", "movie.npy::/../../outside/secret.npy", "movie.npy::"):
        answer = api.get("files/frame.png", params={"path": source} | raw)
        assert answer.status_code in (400, 403, 404), answer.text


def test_folders_with_brackets_are_themselves(api, root):
    for folder, value in (("scan [2]", 2), ("scan 2", 22), ("out[1]", 3)):
        (root / folder).mkdir()
        np.save(root / folder / "f_1.npy", np.full((2, 48, 40), value, np.uint8))
    for source, value in (("scan [2]/f_*.npy", 2), ("scan [2]", 2), ("scan [2]/f_1.npy", 2), ("out[1]/f_[1].npy", 3)):
        assert api.get("files/histogram", params={"path": source}).json()["range"] == [value, value], source
    for source in ("scan ?/f_1.npy", "scan*/f_*.npy", "*/f_1.npy", "**/f_1.npy"):
        assert api.get("files/about", params={"path": source}).status_code == 404, source


def test_a_store_with_a_link_that_leads_out_is_refused(api, root):
    convert(root / "movie.npy", root / "movie.zarr")
    convert(root / "movie.npy", root.parent / "outside" / "movie.zarr")
    shown = ("frame.png", "histogram")
    assert {api.get(f"files/{kind}", params={"path": "movie.zarr"}).status_code for kind in shown} == {200}
    level = root / "movie.zarr" / "0"
    level.rename(root / "level")
    level.symlink_to(root / "level")
    assert {api.get(f"files/{kind}", params={"path": "movie.zarr"}).status_code for kind in shown} == {200}
    for target in (root.parent / "outside" / "movie.zarr" / "0", "/etc", "/dev/zero"):
        level.unlink()
        level.symlink_to(target)
        assert {api.get(f"files/{kind}", params={"path": "movie.zarr"}).status_code for kind in shown} == {403}


def test_what_a_job_wrote_is_not_shown_through_links_that_lead_out(api, root):
    job = api.post("jobs", json={"source": "movie.npy"}).json()
    place, folder = f"jobs/{job['id']}", root / job["output"]
    secret = root.parent / "outside" / "secret"
    secret.mkdir()
    for name in ("zarr.json", "report.html"):
        (secret / name).write_text(json.dumps({"attributes": {"tract_dask": {"complete": True}}}))
    folder.mkdir(parents=True)
    for name in ("results.zarr", "sum.zarr", "movie.zarr", "columns.zarr"):
        (folder / name).symlink_to(secret)
    (folder / "report.html").symlink_to(secret / "report.html")
    for route in ("results", "results/columns", "results/download", "sum", "sum.png", "frame.png", "report", "columns"):
        answer = api.get(f"{place}/{route}")
        assert answer.status_code == 403, (route, answer.text)
    (folder / "results.zarr").unlink()
    (folder / "results.zarr").mkdir()
    (folder / "results.zarr" / "zarr.json").symlink_to(secret / "zarr.json")
    assert api.get(f"{place}/results").status_code == 403


def test_tables_that_are_links_are_followed_within_the_data_root_only(api, root):
    (root.parent / "outside" / "columns.csv").write_text("x,y\n10,12\n")
    (root / "good.csv").symlink_to("sub/columns.csv")
    (root / "bad.csv").symlink_to(root.parent / "outside" / "columns.csv")
    for group in ("columns", "drift"):
        for name, codes in (("bad.csv", {403}), ("good.csv", {200, 201} if group == "columns" else {400})):
            body = {"source": "movie.npy", "settings": {group: {"method": "csv", "csv": name}}}
            assert {api.post(route, json=body).status_code for route in ("plan", "jobs")} <= codes, (group, name)


def order_of(root: DataRoot, source: str) -> dict:
    place = root.source(source)
    settings = to_dict(RunSettings())
    del settings["cluster"]
    return {
        "job": "0123456789",
        "source": str(place),
        "files": list(map(str, place.files)) if isinstance(place, FileList) else None,
        "output": str(root.path / "jobs/0123456789"),
        "root": str(root.path),
        "closed": [],
        "mark": vars(Mark("ana", "0123456789", "jobs/0123456789")),
        "content": "",
        "settings": settings,
        "cluster": to_dict(RunSettings())["cluster"],
        "columns": None,
        "until": None,
    }


def test_the_process_of_a_job_looks_again(root):
    """What was checked at submission, and even when the order was written, has changed since."""
    outside = write_target(root.parent / "outside")
    data, silent = DataRoot(root), Reporter(io.StringIO(), {})
    order = order_of(data, "movie.npy")
    (root / "movie.npy").unlink()
    np.save(outside / "movie.npy", np.zeros(FRAMES, np.uint8))
    (root / "movie.npy").symlink_to(outside / "movie.npy")
    with pytest.raises(OutsideError, match="leads out"):
        run_order(order, silent)
    for kind in KINDS:
        name = write_link(root / f"{kind}.h5", kind, write_target(root / "inside"))
        order = order_of(data, name)
        write_link(root / f"{kind}.h5", kind, outside)
        with pytest.raises(OutsideError, match="leads out"):
            run_order(order, silent)
    (root / "frames").mkdir()
    for number in range(2):
        np.save(root / "frames" / f"{number}.npy", np.zeros(FRAMES, np.uint8))
    order = order_of(data, "frames")
    (root / "frames" / "1.npy").unlink()
    (root / "frames" / "1.npy").symlink_to(outside / "movie.npy")
    with pytest.raises(OutsideError, match="leads out"):
        run_order(order, silent)
    assert not (root / "jobs" / "0123456789" / "movie.zarr").exists()


def test_a_job_fails_whose_source_came_to_lead_out(api, root):
    write_target(root / "inside")
    job = api.post("jobs", json={"source": "sub/other.npy"}).json()
    (root / "sub" / "other.npy").unlink()
    (root / "sub" / "other.npy").symlink_to("/etc/passwd")
    state = api.app.state.services
    state.store.change(job["id"], State.RUNNING)
    process = JobProcess(state.store.job(job["id"]), state.store, state.root, None, None, lambda: None)
    with pytest.raises(TractError, match="data root"):
        process._order()


@pytest.mark.parametrize("change", ["other pixels", "longer", "one more file"])
def test_a_movie_that_was_replaced_since_its_job_was_submitted_is_refused(api, root, change):
    (root / "frames").mkdir()
    for number in range(2):
        np.save(root / "frames" / f"f_{number}.npy", np.full(FRAMES, number, np.uint8))
    source = "frames" if change == "one more file" else "movie.npy"
    job = api.post("jobs", json={"source": source}).json()
    other = np.ones((FRAMES[0] + (change == "longer"), *FRAMES[1:]), np.uint8)
    status = (root / "movie.npy").stat()
    np.save(root / ("frames/f_2.npy" if change == "one more file" else "movie.npy"), other)
    os.utime(root / "movie.npy", ns=(status.st_atime_ns, status.st_mtime_ns))
    state = api.app.state.services
    state.store.change(job["id"], State.RUNNING)
    order = JobProcess(state.store.job(job["id"]), state.store, state.root, None, None, lambda: None)._order()
    cluster = to_dict(RunSettings())["cluster"]
    with pytest.raises(ChangedSourceError, match="changed since the job was submitted"):
        run_order(order | {"cluster": cluster}, Reporter(io.StringIO(), {}))
    assert not (root / job["output"] / "movie.zarr").exists()


def test_an_order_has_the_settings_as_they_are_stored(api, root):
    """Only the paths in them are made whole; nothing is built anew."""
    settings = {"columns": {"method": "csv", "csv": "sub/columns.csv"}, "fit": {"window_px": 9}}
    job = api.post("jobs", json={"source": "movie.npy", "settings": settings}).json()
    services = api.app.state.services
    services.store.change(job["id"], State.RUNNING)
    process = JobProcess(services.store.job(job["id"]), services.store, services.root, None, None, lambda: None)
    whole = job["settings"]["columns"] | {"csv": str(root / "sub" / "columns.csv")}
    assert process._order()["settings"] == job["settings"] | {"columns": whole}


@pytest.mark.parametrize("source", ["sub/other.npy", "frames", "frames/f_*.npy"])
def test_a_source_that_was_archived_is_the_runs_to_judge(api, root, source):
    """A job that waited for its columns goes on with the movie that it has converted."""
    (root / "frames").mkdir()
    np.save(root / "frames" / "f_1.npy", np.zeros(FRAMES, np.uint8))
    job = api.post("jobs", json={"source": source}).json()
    (root / source.split("/")[0]).rename(root / "archive")
    state = api.app.state.services
    state.store.change(job["id"], State.RUNNING)
    order = JobProcess(state.store.job(job["id"]), state.store, state.root, None, None, lambda: None)._order()
    assert order["source"] == str(root / source)
    cluster = to_dict(RunSettings())["cluster"]
    with pytest.raises(MissingSourceError):
        run_order(order | {"cluster": cluster}, Reporter(io.StringIO(), {}))


def test_bounds_are_equal_where_they_mean_the_same(tmp_path):
    """They travel between processes, and what was opened under the same ones is kept."""
    first, second = (DataRoot(tmp_path, (tmp_path / "state",)).permit for _ in range(2))
    assert first == second == Bounds(tmp_path.resolve(), (tmp_path.resolve() / "state",))
    assert hash(first) == hash(second)
    for name in ("state", "state/x", ".tract_dask/x", "../x"):
        with pytest.raises(OutsideError):
            first(tmp_path / name)
    first(tmp_path / "statement")


@pytest.mark.parametrize(("kind", "event"), [("file", ShardDone), *((kind, StageStarted) for kind in ("file", *KINDS))])
def test_the_tasks_of_a_job_look_again_where_links_lead(root, monkeypatch, kind, event):
    """A link is turned after the job's process has looked; what the file system says of the files is hidden."""
    name = turned(root, kind, write_target(root / "inside"))
    monkeypatch.setattr(Stamps, "check", lambda *_: None)

    def turn(met: object) -> None:
        if isinstance(met, event):
            turned(root, kind, write_target(root.parent / "outside"))

    source = open_source(root / name, permit=DataRoot(root).permit)
    with pytest.raises(OutsideError, match="leads out of the data root"):
        convert(source, root / "movie.zarr", on_event=turn)
    assert bool(list((root / "movie.zarr" / "0").glob("c.*"))) == (event is ShardDone)
    assert not metadata.attributes(root / "movie.zarr")["complete"]


def turned(root: Path, kind: str, target: Path) -> str:
    """Let a movie lead to the files of a folder; return what to open."""
    if kind != "file":
        return write_link(root / "turned.h5", kind, target)
    np.save(target / "frames.npy", np.zeros(SHAPE, np.uint8))
    (root / "turned.npy").unlink(missing_ok=True)
    (root / "turned.npy").symlink_to(target / "frames.npy")
    return "turned.npy"


def companions(root: Path) -> dict[str, str]:
    """Movies, and the names beside them that their readers look for."""
    frames = np.arange(256, dtype="i2").reshape(4, 8, 8)
    mrc(root / "m.mrc", frames, 1)
    mrc(root / "n.mrc", frames, 1)
    (root / "n.mrc.mdoc").write_text("PixelSpacing = 2\n[FrameSet = 0]\nGainReference = gain.mrc\n")
    write_mib(root / "k.mib", frames.astype("u2"))
    write_seq(root / "q.seq", frames.astype("u2"))
    (root / "insitu").mkdir()
    write_director(root / "insitu" / "d.dm4", frames.astype("u2"))
    (root / "insitu" / "d.raw").unlink()
    (root / "folder").mkdir()
    zarr.create_array(root / "z.zarr", data=frames, chunks=(1, 8, 8))
    return {
        "m.mrc.mdoc": "m.mrc",
        "m_info.txt": "m.mrc",
        "gain.mrc": "n.mrc",
        "k.hdr": "k.mib",
        "q.dark.mrc": "q.seq",
        "insitu/d.raw": "insitu/d.dm4",
        "folder/zarr.json": "folder",
        "folder/hour_01": "folder",
        "z.zarr/.zattrs": "z.zarr",
    }


def test_nobody_learns_from_links_beside_a_movie_what_there_is_outside(api, root):
    outside = root.parent / "secret"
    for name, movie in companions(root).items():
        (root / name).symlink_to(outside)
        answers = []
        for there in (False, True):
            if there:
                outside.write_text("HDR,\n")
            answers.append({kind: status for kind, (status, _) in ask_everywhere(api, movie).items() if kind != "jobs"})
        (root / name).unlink()
        outside.unlink()
        assert answers[0] == answers[1], name


def test_a_pipe_inside_of_a_store_is_not_waited_for(api, root):
    zarr.create_array(root / "z.zarr", data=np.ones((4, 8, 8), "u1"), chunks=(1, 8, 8))
    os.mkfifo(root / "z.zarr" / ".zattrs")  # Zarr would open it
    assert {status for status, _ in ask_everywhere(api, "z.zarr").values()} == {403}


def test_a_store_with_folders_that_cannot_be_listed_is_refused_in_words(api, root, monkeypatch):
    zarr.create_array(root / "z.zarr", data=np.ones((4, 8, 8), "u1"), chunks=(1, 8, 8))
    assert {status for status, _ in ask_everywhere(api, "z.zarr").values()} <= {200, 201}  # pictures, too
    (root / "z.zarr" / "loop").symlink_to(root / "z.zarr" / "loop")
    assert {status for status, _ in ask_everywhere(api, "z.zarr").values()} == {400}
    (root / "z.zarr" / "loop").unlink()
    monkeypatch.setattr("tract_dask.service.data_root.MOST_NAMES", 3)
    for status, text in ask_everywhere(api, "z.zarr").values():
        assert status == 400
        assert "too many files and folders" in text


def test_long_metadata_of_stores_are_not_read_for_a_listing(api, root, monkeypatch):
    for name, size in (("long.zarr", 1 << 19), ("short.zarr", 1)):
        (root / name).mkdir()
        (root / name / "zarr.json").write_text(json.dumps({"node_type": "group", "attributes": {"x": "y" * size}}))
    parsed = []
    look = metadata.attributes
    monkeypatch.setattr(metadata, "attributes", lambda path: parsed.append(path.name) or look(path))
    found = {entry["name"]: entry["kind"] for entry in api.get("files").json()["entries"]}
    assert (found["long.zarr"], found["short.zarr"], parsed) == ("movie", "movie", ["short.zarr"])


def test_headers_beside_many_files_cost_one_look_at_their_folder(root, monkeypatch):
    for k in range(50):
        (root / "sub" / f"a{k}x.hdr").write_text("HDR")
        (root / "sub" / f"A{k}x_{k:06}.mib").write_text("MQ1")
    (root / "sub" / "other.npy").unlink()
    looks = []
    names = merlin._names
    monkeypatch.setattr(merlin, "_names", lambda beside: looks.append(beside) or names(beside))
    found = list_files("sub", root / "sub", READERS)
    assert found is not None
    assert ({file.suffix for file in found.files}, len(found.files), len(looks)) == ({".mib"}, 50, 1)
