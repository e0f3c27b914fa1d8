"""The whole run on a small scene: what it writes, what it keeps, and what it does again."""

import csv
import dataclasses
import errno
import os
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from conftest import Scene
from distributed import Client

from tract_dask.cluster import connect as cluster
from tract_dask.cluster import retries
from tract_dask.errors import ClusterError, DestinationError, InputError, SettingsError, StoreError
from tract_dask.progress import REPORT, STAGES, RunDone, RunStarted, ShardDone, StageDone, StageStarted, Warned
from tract_dask.run import one_stage, pipeline, session
from tract_dask.run import plan as run_plan
from tract_dask.settings import ConvertSettings, RunSettings, toml
from tract_dask.store import datasets, files, run_folder
from tract_dask.store.results import open_results

SETTINGS = RunSettings(convert=ConvertSettings(shard_mb=1))


class Job:
    """A run of one movie, again and again, with changed settings."""

    def __init__(self, source: Path, output: Path, client: Client) -> None:
        self.source, self.output, self.client = source, output, client
        self.events = []

    def __call__(self, changed: RunSettings = SETTINGS, **more) -> pipeline.RunOutcome:
        self.events.clear()
        more = {"client": self.client, "report": False} | more
        return pipeline.run(self.source, self.output, changed, on_event=self.events.append, **more)

    def of(self, kind: type) -> list:
        return [event for event in self.events if isinstance(event, kind)]

    @property
    def worked(self) -> set[str]:
        return {event.stage for event in self.of(StageDone) if not event.reused}


def change(**groups: dict) -> RunSettings:
    return dataclasses.replace(
        SETTINGS, **{name: dataclasses.replace(getattr(SETTINGS, name), **values) for name, values in groups.items()}
    )


@pytest.fixture(scope="module")
def base(client, tmp_path_factory) -> Job:
    """A finished run, to be copied."""
    folder = tmp_path_factory.mktemp("base")
    np.save(folder / "movie.npy", Scene().counts())
    job = Job(folder / "movie.npy", folder / "out", client)
    job()
    return job


@pytest.fixture
def done(base, tmp_path) -> Job:
    """The same movie with a finished run of its own."""
    shutil.copytree(base.output, tmp_path / "out")
    return Job(base.source, tmp_path / "out", base.client)


@pytest.fixture
def job(scene, npy, tmp_path, client) -> Job:
    return Job(npy(scene.counts()), tmp_path / "out", client)


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_run_writes_everything_and_finds_the_scene(job, scene):
    outcome = job(report=True)
    assert outcome.state == "done"
    assert outcome.columns == len(scene.place)
    assert outcome.frames == scene.n_frames
    assert outcome.fits == scene.n_frames * len(scene.place)
    assert set(outcome.seconds) == {*STAGES, REPORT}
    assert all(Path(path).exists() for path in outcome.outputs.paths().values())
    results = open_results(outcome.outputs.results).load()
    place = np.stack([results["x_ref"], results["y_ref"]], axis=1)
    nearest = np.linalg.norm(place[:, None] - scene.place[None], axis=-1).min(axis=1)
    assert nearest.max() < 1.0  # px; noise and the drift's own zero
    assert job.of(RunStarted)[0].source == str(job.source)
    assert job.of(RunDone)[-1].state == "done"


def test_a_report_that_fails_is_a_warning_of_a_finished_run(done, monkeypatch):
    monkeypatch.setattr("tract_dask.report.look.write_page", lambda *_, **__: 1 / 0)
    assert done(report=True).state == "done"
    assert "division by zero" in done.of(Warned)[0].message
    assert not (done.output / "report.html").exists()


def test_second_run_does_nothing_and_starts_no_cluster(done, scene, monkeypatch):
    monkeypatch.setattr(cluster, "connect", lambda *_: pytest.fail("a cluster was started"))
    again = done(client=None)
    assert again.reused == STAGES
    assert again.seconds == {}
    assert (again.fits, again.columns) == (scene.n_frames * len(scene.place), len(scene.place))
    assert "nothing to do" in done.of(RunDone)[0].message


@pytest.mark.parametrize(
    ("changed", "worked"),
    [
        ({"fit": {"threshold": 3.0}}, {"fit"}),
        ({"fit": {"window_px": 21}}, {"columns", "fit"}),
        ({"fit": {"refine_drift": False}}, {"fit"}),
        ({"columns": {"min_amplitude": 0.2}}, {"columns"}),
        ({"columns": {"search_radius_px": 0.0}}, {"columns"}),
        ({"drift": {"method": "none"}}, {"drift", "sum", "columns", "fit"}),
        ({"metadata": {"gain": 2.0}}, {"sum", "columns", "fit"}),
        ({"cluster": {"workers": 1}}, set()),
    ],
)
def test_changed_setting_redoes_only_what_it_affects(done, changed, worked):
    done(change(**changed))
    assert done.worked == worked


def test_changed_pixel_size_and_time_are_only_written_down(done):
    outcome = done(change(metadata={"pixel_size_pm": 7.8, "frame_time_s": 0.5}))
    assert done.worked <= {"columns"}  # its figure has a scale bar
    for path in (outcome.outputs.drift, outcome.outputs.sum, outcome.outputs.columns.with_suffix(".zarr")):
        assert datasets.open_dataset(path).attrs["pixel_size_pm"] == 7.8
    assert open_results(outcome.outputs.results).attrs["pixel_size_pm"] == 7.8
    assert xr.open_zarr(outcome.outputs.results, consolidated=False).attrs["pixel_size_pm"] == 7.8
    assert tomllib.loads(outcome.outputs.settings.read_text())["metadata"]["frame_time_s"] == 0.5


def test_edited_columns_are_kept_and_fitted_anew(done, scene):
    file = done.output / "columns.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([lines[0], *lines[2:]]) + "\n")
    edited = file.read_text()
    second = done()
    assert done.worked == {"columns", "fit"}
    assert any("was edited" in event.message for event in done.of(Warned))
    assert second.columns == len(scene.place) - 1
    assert file.read_text() == edited
    assert done().reused == STAGES
    assert done.of(Warned) == []


def test_interrupted_and_failed_runs_go_on_to_the_same_result(base, done, monkeypatch):
    expected = open_results(base.output / "results.zarr").load()
    files.remove(done.output / "results.zarr")
    from tract_dask.stages.fit import stage as fit_stage

    measure, calls = fit_stage.measure, []

    def fail_at_the_third(*arguments):
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return measure(*arguments)

    monkeypatch.setattr(fit_stage, "measure", fail_at_the_third)
    fit_here = fit_stage.fit_movie
    monkeypatch.setattr(fit_stage, "fit_movie", lambda *args, **more: fit_here(*args, **(more | {"client": None})))
    with pytest.raises(KeyboardInterrupt):
        done()
    assert done.of(RunDone)[-1].state == "interrupted"
    monkeypatch.setattr(fit_stage, "measure", measure)
    done()
    (started,) = [event for event in done.of(StageStarted) if event.stage == "fit"]
    assert started.done_frames == 4
    found = open_results(done.output / "results.zarr").load()
    xr.testing.assert_equal(found, expected)


def test_plan_says_what_will_be_done_and_writes_nothing(job):
    outcome = job(plan_only=True)
    assert outcome.state == "planned"
    assert not job.output.exists()
    plan = outcome.plan
    raw = 12 * 160 * 144 * 2
    assert (plan.frames, plan.shards, plan.frames_per_shard) == (12, 6, 2)
    assert raw < plan.bytes_written < 1.2 * raw
    assert plan.bytes_read > 3 * raw
    assert run_plan.WORKER_BYTES < plan.peak_memory < plan.memory_limit


def test_work_over_budget_is_refused_with_both_numbers(job):
    plan = run_plan.plan_run((600, 4096, 4096), np.dtype("uint16"), RunSettings(), 500_000_000)
    with pytest.raises(ClusterError, match=r"at most 0\.50 GB") as caught:
        plan.check()
    assert f"{plan.peak_memory / 1e9:.2f} GB" in caught.value.got
    assert "--shard-mb" in caught.value.remedy


def test_memory_is_checked_before_work(job, monkeypatch):
    monkeypatch.setattr(session, "memory_budget", lambda client: 1_000)
    with pytest.raises(ClusterError, match="does not fit"):
        job()
    assert not (job.output / "movie.zarr").exists()
    assert job.of(RunDone)[-1].state == "failed"


def test_folder_that_holds_something_else_is_left_alone(job):
    job.output.mkdir()
    (job.output / "thesis.txt").write_text("years of work")
    with pytest.raises(DestinationError, match="already holds other files") as caught:
        job()
    assert "thesis.txt" in caught.value.got
    job(overwrite=True)
    assert (job.output / "thesis.txt").read_text() == "years of work"


def test_file_in_the_place_of_the_folder(job):
    job.output.write_text("")
    with pytest.raises(DestinationError, match="the output is not a folder"):
        job(overwrite=True)


def test_run_of_another_movie_is_not_replaced(done, npy, scene):
    other = npy(scene.counts()[:8], "other.npy")
    with pytest.raises(DestinationError, match="another movie"):
        pipeline.run(other, done.output, SETTINGS, client=done.client)
    outcome = pipeline.run(other, done.output, SETTINGS, client=done.client, overwrite=True)
    assert outcome.frames == 8


def test_two_runs_in_one_folder(job):
    job.output.mkdir()
    with (
        run_folder.sole_run(run_folder.RunFolder(job.output)),
        pytest.raises(DestinationError, match="another run works"),
    ):
        job()


def test_frames_without_numbers_end_as_bad_frames(npy, scene, tmp_path, client):
    frames = scene.counts().astype(np.float32)
    frames[5], frames[7, 80, 70] = np.nan, np.nan
    outcome = Job(npy(frames), tmp_path / "out", client)()
    assert (outcome.state, outcome.bad_frames) == ("done_with_bad_frames", 1)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"columns": {"method": "csv"}}, "needs a file"),
        ({"columns": {"method": "csv", "csv": "nowhere.csv"}}, "nowhere.csv"),
        ({"drift": {"method": "csv", "csv": "nowhere.csv"}}, "nowhere.csv"),
        ({"cluster": {"memory_limit": "much"}}, "not a size"),
    ],
)
def test_faults_in_small_inputs_are_found_before_anything_is_written(job, changed, message):
    with pytest.raises(InputError, match=message):
        job(change(**changed))
    assert not job.output.exists()


def test_run_toml_gives_the_same_settings_and_says_what_was_unset(job):
    outcome = job(change(metadata={"pixel_size_pm": 8.0}))
    text = outcome.outputs.settings.read_text()
    assert toml.load(outcome.outputs.settings) == change(metadata={"pixel_size_pm": 8.0})
    assert "# fit.window_px = " in text
    assert "# cluster.scheduler  (" in text


def test_a_name_may_hold_two_colons(done):
    done.output = done.output.rename(done.output.parent / "a::b [1] c")
    assert done().reused == STAGES
    expected = open_results(done.output / "results.zarr")["fit"].load()
    assert done(overwrite=True).state == "done"
    xr.testing.assert_identical(open_results(done.output / "results.zarr")["fit"].load(), expected)


def test_columns_move_with_a_drift_that_gives_the_same_image(done, tmp_path):
    drift = xr.open_zarr(done.output / "drift.zarr", consolidated=False)["drift"].to_numpy()
    whole, moved = np.rint(drift), np.rint(drift) + 0.3
    places = []
    for shift in (whole, moved):
        table = np.column_stack([np.arange(len(shift)), shift])
        np.savetxt(tmp_path / "drift.csv", table, delimiter=",", header="frame,y,x", comments="")
        done(change(drift={"method": "csv", "csv": str(tmp_path / "drift.csv")}))
        places.append(open_results(done.output / "results.zarr")["x_ref"].to_numpy())
    np.testing.assert_allclose(places[0] - places[1], 0.3, atol=0.01)


def corners_of(tracks):
    """Return which pixels the middles of the windows lie in, (frames, columns, 2)."""
    places = tracks["fit_ref"].sel(parameter=["y", "x"]).to_numpy()
    return np.rint(places[None] + tracks["drift_measured"].to_numpy()[:, None])


def test_single_stages_end_as_the_run_does(base, tmp_path):
    expected = open_results(base.output / "results.zarr").load()
    movie, drift, columns, results = (tmp_path / name for name in ("m.zarr", "d.zarr", "c.csv", "r.zarr"))
    one_stage.run_convert(base.source, movie, SETTINGS, client=base.client)
    one_stage.run_drift(movie, drift, SETTINGS, client=base.client)
    found = one_stage.run_columns(movie, columns, SETTINGS, drift, client=base.client)
    assert found.sizes["column_id"] == expected.sizes["column_id"]
    summary = one_stage.run_fit(movie, columns, results, SETTINGS, drift, client=base.client)
    assert summary.fits == expected.sizes["frame"] * expected.sizes["column_id"]
    again = open_results(results).load()
    place = {"parameter": ["x", "y"]}  # shapes are found anew, from the table: places differ by 4e-5 px
    same = (corners_of(again) == corners_of(expected)).all(axis=2)
    assert same.mean() > 0.99  # a window whose middle lies next to the edge of a pixel may be cut one pixel on
    fits, others = (one["fit"].sel(place).to_numpy()[same] for one in (again, expected))
    np.testing.assert_allclose(fits, others, rtol=0, atol=1e-4)
    np.testing.assert_allclose(again["intensity"].to_numpy()[same], expected["intensity"].to_numpy()[same], rtol=1e-3)
    assert columns.with_suffix(".png").exists()


def test_single_stage_does_not_replace_a_store_of_another_kind(job, tmp_path):
    movie = tmp_path / "m.zarr"
    one_stage.run_convert(job.source, movie, SETTINGS, client=job.client)
    with pytest.raises(DestinationError, match="another kind"):
        one_stage.run_drift(movie, movie, SETTINGS, client=job.client)


def test_columns_need_a_table_and_do_not_replace_a_foreign_one(job, tmp_path):
    movie, mine = tmp_path / "m.zarr", tmp_path / "mine.csv"
    one_stage.run_convert(job.source, movie, SETTINGS, client=job.client)
    with pytest.raises(DestinationError, match=r"ends in \.csv"):
        one_stage.run_columns(movie, tmp_path / "c.zarr", SETTINGS, client=job.client)
    mine.write_text("x,y\n1,2\n")
    with pytest.raises(DestinationError, match="not written by tract-dask"):
        one_stage.run_columns(movie, mine, SETTINGS, client=job.client)
    assert mine.read_text() == "x,y\n1,2\n"


AWAY = {"origin": [900, 900], "a": [940, 900], "a_count": 1, "b": [900, 940], "b_count": 1}

UNFIT = {
    "table": ({"columns": {"method": "csv", "csv": "seeds.csv"}}, "y from 0 to 159"),
    "lattice": ({"columns": {"method": "lattice", "lattices": (AWAY,)}}, "from 0 to 143, 159"),
    "template": ({"columns": {"method": "template", "template": (20, 160)}}, "y from 0 to 159"),
    "template of one number": ({"columns": {"method": "template", "template": (20,)}}, "y from 0 to 159"),
    "spacing": ({"columns": {"spacing_px": 161.0}}, "160 rows and 144 columns"),
    "search radius": ({"columns": {"search_radius_px": 500.0}}, "160 rows and 144 columns"),
    "centroid radius": ({"columns": {"centroid_radius_px": 500.0}}, "160 rows and 144 columns"),
    "even window": ({"fit": {"window_px": 20}}, "to 144, the shorter side"),
    "large window": ({"fit": {"window_px": 145}}, "to 144, the shorter side"),
    "box below": ({"fit": {"vacuum_box": (100, 161, 0, 20)}}, "160 rows and 144 columns"),
    "box to the right": ({"fit": {"vacuum_box": (0, 20, 100, 145)}}, "160 rows and 144 columns"),
    "box above": ({"fit": {"vacuum_box": (-1, 20, 0, 20)}}, "160 rows and 144 columns"),
    "no box": ({"fit": {"vacuum_box": (20, 0, 0, 20)}}, "y0 < y1"),
    "box and drift": (
        {"fit": {"vacuum_box": (0, 20, 0, 20)}, "drift": {"method": "csv", "csv": "drift.csv"}},
        r"leaves frame 3, drifted by 0, -5 px",
    ),
    "drift of another movie": ({"drift": {"method": "csv", "csv": "short.csv"}}, "all 12 frames"),
}


@pytest.fixture
def tables(job) -> Path:
    """Small inputs that do not fit the movie, in its folder."""
    (job.source.parent / "seeds.csv").write_text("x,y\n20,1000\n")
    rows = [f"{frame},{-5 * (frame == 3)},0" for frame in range(12)]
    (job.source.parent / "drift.csv").write_text("\n".join(["frame,y,x", *rows]))
    (job.source.parent / "short.csv").write_text("\n".join(["frame,y,x", *rows[:11]]))
    return job.source.parent


@pytest.mark.parametrize("name", UNFIT)
def test_what_does_not_fit_the_movie_is_refused_before_any_work(job, tables, monkeypatch, name):
    monkeypatch.chdir(tables)
    changed, message = UNFIT[name]
    for more in ({}, {"plan_only": True}):
        with pytest.raises(InputError, match=message):
            job(change(**changed), **more)
    assert job.events == []
    assert not job.output.exists()


@pytest.mark.parametrize("name", sorted(UNFIT.keys() - {"box and drift"}))
def test_what_does_not_fit_the_movie_is_refused_by_single_stages(base, tables, monkeypatch, tmp_path, name):
    monkeypatch.chdir(tables)
    movie, drift = base.output / "movie.zarr", base.output / "drift.zarr"
    (changed, message), events = UNFIT[name], []
    keep = {
        "drift": lambda how: one_stage.run_drift(movie, tmp_path / "d.zarr", how, on_event=events.append),
        "columns": lambda how: one_stage.run_columns(movie, tmp_path / "c.csv", how, drift, on_event=events.append),
        "fit": lambda how: one_stage.run_fit(
            movie, base.output / "columns.csv", tmp_path / "r.zarr", how, drift, on_event=events.append
        ),
    }
    stage = next(stage for stage in ("drift", "columns", "fit") if stage in changed)
    with pytest.raises(InputError, match=message):
        keep[stage](change(**changed))
    assert events == []
    assert not list(tmp_path.glob("*.zarr"))


@pytest.mark.parametrize(
    ("table", "box", "message"),
    [("seeds.csv", None, "y from 0 to 159"), ("", (0, 160, 0, 20), r"leaves frame \d+, drifted")],
)
def test_the_fit_alone_holds_table_and_box_against_the_frame(base, tables, tmp_path, table, box, message):
    given = tables / table if box is None else base.output / "columns.csv"
    movie, drift, events = base.output / "movie.zarr", base.output / "drift.zarr", []
    with pytest.raises(SettingsError, match=message):
        one_stage.run_fit(
            movie, given, tmp_path / "r.zarr", change(fit={"vacuum_box": box}), drift, on_event=events.append
        )
    assert events == []


def test_a_box_that_the_drift_takes_out_is_refused_before_the_sum(job):
    with pytest.raises(SettingsError, match=r"leaves frame \d+, drifted by"):
        job(change(fit={"vacuum_box": (0, 160, 0, 144)}))
    assert job.worked == {"convert", "drift"}


def test_pixels_that_are_no_counts_are_refused_right_after_the_conversion(scene, npy, tmp_path, client):
    job = Job(npy(scene.counts().astype("i4") - 1000), tmp_path / "out", client)
    with pytest.raises(SettingsError, match="negative"):
        job(change(fit={"estimator": "poisson"}))
    assert job.worked == {"convert"}


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (b"x,y\n20,1000\n", "y from 0 to 159"),
        (b"column_id,x,y\n1,20,20\n1,60,60\n", "comes twice"),
        (b"x,y\n20,nan\n", "y cannot be read"),
        (b"x,y\n20,20\n\xff", "cannot be read"),
        (b"\n", "is empty"),
        (b"column_id,x,y\n1,60,5,70,5\n", "more values than the first line names"),
        (b"a;b\n20;20\n", "does not say where"),
    ],
)
def test_a_table_that_was_edited_wrongly_is_refused_before_any_work(done, table, message):
    (done.output / "columns.csv").write_bytes(table)
    with pytest.raises(SettingsError, match=message) as caught:
        done(change(drift={"search_px": 7.0}))
    assert "columns.csv" in caught.value.where
    assert done.events == []
    assert (done.output / "columns.csv").read_bytes() == table


@pytest.mark.parametrize("table", ["link", "pipe", "folder"])
def test_a_table_that_cannot_be_reached_is_not_taken_for_none(done, tmp_path, table):
    csv = done.output / "columns.csv"
    csv.rename(tmp_path / "mine.csv")
    if table == "link":
        csv.symlink_to(tmp_path / "unmounted" / "mine.csv")
    elif table == "pipe":
        os.mkfifo(csv)
    else:
        csv.mkdir()
    with pytest.raises(DestinationError) as caught:
        done()
    assert "columns.csv" in caught.value.where
    assert done.events == []
    assert os.path.lexists(csv)


@pytest.mark.parametrize("name", ["drift.zarr", "sum.zarr", "columns.zarr", "results.zarr"])
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_has_the_place_of_a_store_is_not_deleted(done, name, kind):
    shutil.rmtree(done.output / name)
    mine = done.output / name / "notes.txt" if kind == "folder" else done.output / name
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("mine")
    with pytest.raises(DestinationError, match="already holds other data"):
        done()
    assert done.events == []
    assert mine.read_text() == "mine"


def test_a_link_to_a_folder_that_is_not_there_is_named(job, tmp_path):
    job.output.symlink_to(tmp_path / "unmounted")
    with pytest.raises(DestinationError, match=r"a link to .*unmounted, which is not there"):
        job()


def test_a_folder_that_is_moved_while_a_run_works_is_said_and_goes_on_in_its_new_place(base, job, tmp_path):
    moved = tmp_path / "moved"

    def move(event):
        if isinstance(event, ShardDone) and event.stage == "drift" and job.output.exists():
            job.output.rename(moved)

    with pytest.raises(StoreError, match=r"not there any more|no movie store here"):
        pipeline.run(job.source, job.output, SETTINGS, client=job.client, on_event=move, report=False)
    assert not job.output.exists()
    again = Job(job.source, moved, job.client)
    assert again().reused == ("convert",)
    fits = [open_results(place / "results.zarr")["fit"].load() for place in (moved, base.output)]
    xr.testing.assert_identical(*fits)


@pytest.mark.parametrize("number", [errno.EIO, errno.ESTALE, errno.EMFILE])
def test_an_error_of_the_system_in_the_driver_is_one_of_ours(job, monkeypatch, number):
    def fails(*args, **more):
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patched:
        patched.setattr(pipeline, "sum_stage", fails)
        patched.setattr(retries, "wait_s", lambda count: 0.0)
        with pytest.raises(StoreError) as caught:
            job()
    assert str(job.output) in str(caught.value)
    assert os.strerror(number) in str(caught.value)
    assert "run the same command again" in str(caught.value)
    assert job.of(RunDone)[-1].state == "failed"
    assert job().state == "done"
