"""The command line: options, exit codes, and what is printed where."""

import dataclasses
import io
import json
import operator
import re
import signal
import subprocess
import sys
import time
from functools import partial
from importlib.metadata import entry_points

import numpy as np
import pytest
from click.testing import CliRunner
from rich.console import Console

from tract_dask.cli import main as cli
from tract_dask.cli import options
from tract_dask.cli.terminal import Terminal
from tract_dask.errors import ClusterError
from tract_dask.progress import Noticed, RunDone, RunStarted, ShardDone, StageDone, StageStarted, Warned
from tract_dask.run import pipeline, session
from tract_dask.run import plan as run_plan
from tract_dask.settings import RunSettings, declare, to_toml
from tract_dask.store import run_folder

GROUPS = tuple(options.TITLES)


def tract(*arguments: object):
    return CliRunner().invoke(cli.main, [str(argument) for argument in arguments])


@pytest.fixture
def captured(monkeypatch):
    """Settings and arguments that the command ``run`` hands to the library, which then does nothing."""
    found = {}

    def run(source, output, settings, **more):
        found.update(source=source, output=output, settings=settings, **more)
        plan = run_plan.plan_run((8, 64, 64), np.dtype("u1"), settings)
        return pipeline.RunOutcome(run_folder.RunFolder(output), plan, "done", 8, 3, 24, 20)

    monkeypatch.setattr(pipeline, "run", run)
    return found


@pytest.fixture
def inline(monkeypatch):
    """Run everything in this process."""
    from distributed import Client, LocalCluster

    from tract_dask.cluster import connect as cluster

    with (
        LocalCluster(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None) as local,
        Client(local) as client,
    ):

        class Here(cluster.LazyClient):
            def __init__(self, settings, given=None, on_connect=lambda client: None):
                super().__init__(settings, client, on_connect)

        monkeypatch.setattr(session, "LazyClient", Here)
        yield client


def test_every_setting_has_an_option_with_its_sentence():
    text = " ".join(tract("run", "--help-all").output.split())
    for group in dataclasses.fields(RunSettings()):
        for item in dataclasses.fields(getattr(RunSettings(), group.name)):
            if item.metadata["in_files_only"]:
                continue
            assert declare.option(group.name, item) in text
            assert item.metadata["description"] in text
    assert all(title in text for title in options.TITLES.values())


def test_help_lists_the_common_options_and_how_to_reach_the_rest():
    command = cli.main.commands["run"]
    settings = [option for option in command.params if isinstance(option, options.SettingOption)]
    common = [option for option in settings if option.common]
    text = tract("run", "--help").output
    listed = set(re.findall(r"^  (--[a-z-]+)", text, flags=re.MULTILINE))
    assert 15 <= len(common) <= 25 < len(settings)
    assert {option.opts[0] for option in settings} & listed == {option.opts[0] for option in common}
    assert {"--help-all", "--set", "--config"} <= listed
    assert len(text.splitlines()) < 100


def test_an_option_is_its_setting_with_dashes_after_the_group_where_the_name_alone_says_too_little():
    grouped = set()
    for group in dataclasses.fields(RunSettings()):
        for item in dataclasses.fields(getattr(RunSettings(), group.name)):
            flag = declare.option(group.name, item)
            name = item.name.replace("_", "-")
            assert flag in (f"--{name}", f"--{group.name}-{name}")
            grouped |= {flag} if flag != f"--{name}" else set()
    assert grouped == {"--drift-method", "--drift-csv", "--drift-search-px", "--columns-method", "--columns-csv"}


@pytest.mark.parametrize(
    ("assignment", "path", "value"),
    [
        ("fit.window_px=31", "fit.window_px", 31),
        ("fit.window_px=unset", "fit.window_px", None),
        ("fit.vacuum_box=0,8,0,9", "fit.vacuum_box", (0, 8, 0, 9)),
        ("fit.vacuum_box=[0, 8, 0, 9]", "fit.vacuum_box", (0, 8, 0, 9)),
        ("fit.counting=false", "fit.counting", False),
        ("fit.threshold=2", "fit.threshold", 2.0),
        ("columns.csv=my table=1.csv", "columns.csv", "my table=1.csv"),
        ("columns.csv=a.csv", "columns.method", "csv"),
        ("columns.lattices={origin = [1, 2]}", "columns.lattices", ({"origin": [1, 2]},)),
        ("columns.lattices=unset", "columns.method", "auto"),
        ("convert.codec=zstd", "convert.codec", "zstd"),
        ("cluster.threads=2", "cluster.threads", 2),
        ("cluster.slurm.queue=short", "cluster.slurm.queue", "short"),
        ("cluster.ssh.hosts=node1,10.0.0.2", "cluster.ssh.hosts", ("node1", "10.0.0.2")),
    ],
)
def test_any_setting_can_be_set(captured, tmp_path, assignment, path, value):
    (tmp_path / "run.toml").write_text("[fit]\nwindow_px = 21\nthreshold = 3.0\n")
    result = tract("run", "m.tif", "out", "--config", tmp_path / "run.toml", "--blur-sigma-px", 1, "--set", assignment)
    assert result.exit_code == 0, result.output
    assert operator.attrgetter(path)(captured["settings"]) == value
    assert captured["settings"].fit.blur_sigma_px == 1


@pytest.mark.parametrize(
    ("command", "assignment", "message"),
    [
        ("run m out", "fit.threshold=1000", "setting threshold .*at least 0 and at most 100; got 1000"),
        ("run m out", "fit.threshold=high", "setting threshold .*float; got 'high'"),
        ("run m out", "fit.window_px=2.5", "setting window_px .*int; got '2.5'"),
        ("run m out", "fit.threshold=unset", "setting threshold .*float; got 'unset'"),
        ("run m out", "columns.lattices={", "setting lattices .*list; got"),
        ("run m out", "fit.vacuum_box=1,high", "setting vacuum_box .*list; got"),
        ("run m out", "convert.codec=zip", "setting codec .*one of lz4, zstd, none; got 'zip'"),
        ("run m out", "fit.window=3", "no setting 'window'.*one of window_px, .*got fit.window"),
        ("run m out", "fits.window_px=3", "no setting 'fits'.*one of source, .*got fits.window_px"),
        ("run m out", "fit.window_px.x=3", "no setting 'x'.*fit.window_px without a further name"),
        ("run m out", "fit=3", "group.name=value; got fit=3"),
        ("run m out", "fit.window_px", "group.name=value; got fit.window_px"),
        ("drift m.zarr d.zarr", "fit.window_px=31", "a setting of drift, cluster; got fit.window_px"),
        ("columns m.zarr c.csv", "fit.threshold=2", "fit.window_px, fit.blur_sigma_px, cluster; got fit.threshold"),
        ("submit m.tif", "cluster.workers=2", "a setting of source, .*fit; got cluster.workers"),
    ],
)
def test_set_names_the_setting_its_range_and_what_it_got(captured, command, assignment, message):
    result = tract(*command.split(), "--set", assignment)
    assert result.exit_code == 2, result.output
    assert re.search(message, result.stderr)
    assert not captured


WITH_SETTINGS = pytest.mark.parametrize(
    "command",
    [
        "run",
        "inspect",
        "convert",
        "drift",
        "columns",
        "fit",
        "demo",
        "compare-filters",
        "submit",
        "serve",
        "simulate table",
    ],
)


@WITH_SETTINGS
def test_no_option_of_a_command_hides_another(command):
    found = cli.main
    for name in command.split():
        found = found.commands[name]
    flags = [flag for option in found.params for flag in (*option.opts, *option.secondary_opts)]
    assert sorted(flags) == sorted(set(flags))


@WITH_SETTINGS
def test_commands_with_settings_take_them_all_alike(command):
    text = tract(*command.split(), "--help").output
    assert {"--set", "--config", "--help-all"} <= set(re.findall(r"^  (--[a-z-]+)", text, flags=re.MULTILINE))
    assert len(tract(*command.split(), "--help-all").output) >= len(text)


def test_options_override_the_configuration(captured, tmp_path):
    config = tmp_path / "run.toml"
    start = dataclasses.replace(
        RunSettings(), fit=dataclasses.replace(RunSettings().fit, threshold=3.0, blur_sigma_px=1.0)
    )
    config.write_text(to_toml(start))
    result = tract("run", "m.tif", "out", "--config", config, "--threshold", 2.5, "--vacuum-box", "0,8,0,9")
    assert result.exit_code == 0, result.output
    fit = captured["settings"].fit
    assert (fit.threshold, fit.blur_sigma_px, fit.vacuum_box) == (2.5, 1.0, (0, 8, 0, 9))


@pytest.mark.parametrize(
    ("arguments", "group", "expected"),
    [
        (("--columns-csv", "a.csv"), "columns", {"method": "csv", "csv": "a.csv"}),
        (("--drift-csv", "d.csv"), "drift", {"method": "csv", "csv": "d.csv"}),
        (("--no-drift",), "drift", {"method": "none"}),
        (("--no-refine-drift",), "fit", {"refine_drift": False}),
        (("--lattices", "[{origin = [1, 2]}]"), "columns", {"method": "lattice", "lattices": ({"origin": [1, 2]},)}),
        (("--raw-shape", "0,64,32", "--raw-dtype", "u2"), "source", {"raw_shape": (0, 64, 32), "raw_dtype": "u2"}),
        (("--workers", "3", "--memory-limit", "2GB"), "cluster", {"workers": 3, "memory_limit": "2GB"}),
        (("--pixel-size-pm", "7.8"), "metadata", {"pixel_size_pm": 7.8}),
        (("--contrast", "dark"), "columns", {"contrast": "dark", "method": "auto"}),
    ],
)
def test_options_become_settings(captured, arguments, group, expected):
    result = tract("run", "m.tif", "out", *arguments)
    assert result.exit_code == 0, result.output
    found = getattr(captured["settings"], group)
    assert {name: getattr(found, name) for name in expected} == expected


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--threshold", "1000"), "out of range"),
        (("--threshold", "high"), "setting threshold (FitSettings): the value is of the wrong type. Expected float"),
        (("--codec", "zip"), "zip"),
        (("--vacuum-box", "1;2"), "setting vacuum_box (FitSettings): the value is of the wrong type. Expected list"),
        (("--lattices", "{"), "setting lattices (ColumnSettings): the value is of the wrong type. Expected list"),
        (("--window-px", "2.5"), "setting window_px (FitSettings): the value is of the wrong type. Expected int"),
        (("--config", "nowhere.toml"), "cannot be read"),
        (("--no-such-option",), "No such option"),
    ],
)
def test_bad_usage_ends_with_2_and_one_paragraph(captured, arguments, message):
    result = tract("run", "m.tif", "out", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert not captured


def test_missing_movie_ends_with_2(tmp_path):
    result = tract("run", tmp_path / "none.tif", tmp_path / "out")
    assert result.exit_code == 2
    assert result.stderr.startswith("Error: ")
    assert str(tmp_path / "none.tif") in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("error", "code"), [(ClusterError("no", "x"), 1), (KeyboardInterrupt(), 130), (ValueError("odd"), 1)]
)
def test_errors_become_exit_codes(monkeypatch, error, code):
    def run(*_, **__):
        raise error

    monkeypatch.setattr(pipeline, "run", run)
    result = tract("run", "m.tif", "out")
    assert result.exit_code == code
    assert "Traceback" not in result.stderr
    if code == 1:
        assert "Traceback" in tract("run", "m.tif", "out", "--debug").stderr


def test_json_is_all_that_stands_on_stdout(captured):
    result = tract("run", "m.tif", "out", "--json")
    record = json.loads(result.stdout)
    assert (record["state"], record["columns"], record["accepted"]) == ("done", 3, 20)
    assert record["outputs"]["results"].endswith("results.zarr")


def test_plan_is_printed(npy, scene, tmp_path):
    movie = npy(scene.counts())
    result = tract("run", movie, tmp_path / "out", "--plan", "--shard-mb", 1)
    assert result.exit_code == 0, result.output
    assert "6 of 2 frames" in result.stdout
    assert not (tmp_path / "out").exists()
    record = json.loads(tract("run", movie, tmp_path / "out", "--plan", "--json").stdout)
    assert record["plan"]["frames"] == scene.n_frames


def test_plan_over_budget_is_refused(npy, scene, tmp_path):
    result = tract("run", npy(scene.counts()), tmp_path / "out", "--plan", "--memory-limit", "100MB")
    assert result.exit_code == 1
    assert "at most 0.10 GB a task" in result.stderr


def test_run_and_inspect(npy, scene, tmp_path, inline):
    movie, out = npy(scene.counts()), tmp_path / "out"
    result = tract("run", movie, out, "--shard-mb", 1)
    assert result.exit_code == 0, result.output
    assert ["columns", str(len(scene.place))] in [line.split() for line in result.stdout.splitlines()]
    assert "results.zarr" in result.stdout
    assert "fit: done in" in result.stderr
    assert json.loads(tract("inspect", movie, "--json").stdout)["frames"] == scene.n_frames
    assert json.loads(tract("inspect", out, "--json").stdout)["results.zarr"] == "complete"
    for name in ("movie.zarr", "drift.zarr", "results.zarr"):
        assert json.loads(tract("inspect", out / name, "--json").stdout)["frames"] == scene.n_frames
    assert json.loads(tract("inspect", out / "columns.zarr", "--json").stdout)["columns"] == len(scene.place)
    assert "pixel size" in tract("inspect", out / "sum.zarr").stdout


def test_inspect_counts_pixels_without_data(npy, scene, tmp_path, inline):
    frames = scene.counts()
    frames[:, [10, 30], [40, 50]] = 9000
    frames[2, 60, 70] = 5000
    assert tract("convert", npy(frames), tmp_path / "m.zarr").exit_code == 0
    found = json.loads(tract("inspect", tmp_path / "m.zarr", "--json").stdout)
    assert {name: found[name] for name in ("masked pixels", "of them hot", "spikes", "frames with a border")} == {
        "masked pixels": 2,
        "of them hot": 2,
        "spikes": 1,
        "frames with a border": 0,
    }


def test_frames_that_cannot_be_fitted_end_with_3(npy, scene, tmp_path, inline):
    frames = scene.counts().astype(np.float32)
    frames[3, 20:] = np.inf  # most of it
    result = tract("run", npy(frames), tmp_path / "out")
    assert result.exit_code == 3, result.output
    assert "could not be fitted" in result.stderr
    assert "frames not fitted" in result.stdout


def test_stage_by_stage(npy, scene, tmp_path, inline):
    movie, drift, columns, results = (tmp_path / name for name in ("m.zarr", "d.zarr", "c.csv", "r.zarr"))
    for arguments in (
        ("convert", npy(scene.counts()), movie, "--shard-mb", 1),
        ("drift", movie, drift),
        ("columns", movie, columns, "--drift-from", drift),
        ("fit", movie, columns, results, "--drift-from", drift, "--json"),
    ):
        result = tract(*arguments)
        assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["fits"] == scene.n_frames * len(scene.place)


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_shows_what_is_done_and_how_fast(terminal):
    file = io.StringIO()
    console = Console(file=file, force_terminal=terminal, width=120, color_system=None)
    with Terminal(console) as show:
        show(RunStarted("movie.tif", "out"))
        show(RunStarted("movie.tif", "out", "http://127.0.0.1:8787/status"))
        show(StageDone("convert", 0.0, reused=True))
        show(StageStarted("fit", 600, 100, 40, 1 << 20))
        show.lines["fit"].began -= 10.0
        show(ShardDone("fit", 0, 100, 4000))
        show(Warned("look at this"))
        console.print(show.table())
        show(StageDone("fit", 20.0, summary="3900 of 4000 fits accepted"))
        show(Noticed("contrast", "Bright or dark is not sure", "It speaks for both.", "Give --contrast dark."))
        show(RunDone("done_with_bad_frames", 75.0))
    text = file.getvalue()
    assert "! Bright or dark is not sure. It speaks for both.\n  → Give --contrast dark.\n" in text
    assert text.count("movie.tif → out") == 1
    assert "dashboard http://127.0.0.1:8787/status" in text
    assert "200/600 frames" in text
    assert re.search(r"(9\.\d+|10) frames/s +(39\d|400) fits/s", text)
    assert re.search(r"4\d s left", text)
    assert "warning: look at this" in text
    assert "could not be fitted (1:15)" in text


def test_dask_knows_the_command():
    (entry,) = [entry for entry in entry_points(group="dask_cli") if entry.name == "tract"]
    assert entry.load() is cli.main


def test_help_needs_none_of_the_heavy_modules():
    code = "import sys, tract_dask.cli.main; print([m for m in ('numpy', 'dask', 'zarr', 'numba') if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_run_ends_cleanly(npy, scene, tmp_path, number):
    import psutil

    scene.n_frames = 12
    movie, out = npy(np.tile(scene.counts(), (80, 1, 1))), tmp_path / "out"
    command = [sys.executable, "-m", "tract_dask.cli", "run", movie, out, "--workers", "1", "--shard-mb", "1"]
    heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a shell's background jobs do not hear Ctrl-C
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, text=True, preexec_fn=heard) as process:
        events = out / "events.jsonl"
        deadline = time.monotonic() + 120
        while not (events.exists() and "ShardDone" in events.read_text()):
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() < deadline
            time.sleep(0.02)
        workers = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "what is done is kept" in errors
    assert "Traceback" not in errors
    assert not psutil.wait_procs(workers, timeout=60)[1]
    assert json.loads(events.read_text().splitlines()[-1])["state"] == "interrupted"
