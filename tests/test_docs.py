"""The documentation against the code: settings, commands, examples."""

import contextlib
import dataclasses
import importlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import typing
from pathlib import Path

import pytest
from conftest import Scene
from files_dm import write_dm

from tract_dask.settings import RunSettings
from tract_dask.simulate.movie import simulate_movie
from tract_dask.store.results import open_results

ROOT = Path(__file__).parents[1]
PATH = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
DOCUMENTS = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
RUN_BY = "scripts/test"
"""The one command that is not run here, since it is what runs this."""


def blocks(document: str, language: str) -> list[str]:
    """The fenced blocks of a document in one language."""
    text = (ROOT / document).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)


def call(*command: str, folder: Path, timeout: int = 300, **environment: str) -> str:
    """Run a command in a process group of its own, which ends with it; return what it printed."""
    with (
        tempfile.TemporaryFile("w+") as out,
        tempfile.TemporaryFile("w+") as err,
    ):  # a pipe would wait for background jobs
        process = subprocess.Popen(
            command,
            cwd=folder,
            env=os.environ | {"PATH": PATH} | environment,
            stdout=out,
            stderr=err,
            start_new_session=True,
        )
        try:
            code = process.wait(timeout)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
        out.seek(0)
        err.seek(0)
        printed = out.read()
        assert code == 0, printed + err.read()
    return printed


@contextlib.contextmanager
def served(block: str, folder: Path):
    """A service that a reader starts in one terminal, on a free port, while the next commands run in another."""
    process = subprocess.Popen(
        ["bash", "-c", f"exec {block.strip()} --port 0"],
        cwd=folder,
        env=os.environ | {"PATH": PATH},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        found = (re.search(r"http://127\.0\.0\.1:\d+", line) for line in process.stdout)
        address = next((match[0] for match in found if match), "")
        assert address, "it did not start"
        yield address
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a small movie and the scripts of the checkout, in which a reader's commands run."""
    place = tmp_path_factory.mktemp("reader")
    simulate_movie(place / "movie.tif", n_frames=16, shape=(256, 256))
    (place / "scripts").symlink_to(ROOT / "scripts")
    return place


def test_settings_doc_is_made_from_the_declarations():
    made = call(sys.executable, str(ROOT / "scripts" / "make_settings_doc"), folder=ROOT)
    assert (ROOT / "docs" / "settings.md").read_text(encoding="utf-8") == made, (
        "run scripts/make_settings_doc > docs/settings.md"
    )


def test_every_setting_is_documented():
    text = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    for group, kind in typing.get_type_hints(RunSettings).items():
        assert f"## [{group}]" in text
        for item in dataclasses.fields(kind):
            if item.default is dataclasses.MISSING:  # a group, which has a table of its own
                assert f"### [{group}.{item.name}]" in text
                continue
            assert item.metadata["description"], f"{group}.{item.name} has no description"
            assert re.search(rf"^\| `{item.name}` .*{re.escape(item.metadata['description'])} \|$", text, re.MULTILINE)


@pytest.mark.slow
def test_commands_and_examples_of_the_readme(folder):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    commands = blocks("README.md", "bash")
    assert commands
    environment = {}
    with contextlib.ExitStack() as services:
        for block in commands:
            assert RUN_BY not in block
            if block.startswith("tract-dask serve"):
                environment["TRACT_DASK_SERVER"] = services.enter_context(served(block, folder))
            else:
                call("bash", "-euo", "pipefail", "-c", block, folder=folder, **environment)
    assert list(folder.glob("jobs/*/results.zarr")), "what was submitted to the service"
    assert (folder / "demo_output" / "movie.tif").exists()
    for name in re.findall(r"^\| (`.*?`) \|", text, flags=re.MULTILINE):
        for path in re.findall(r"`(.*?)`", name):
            assert (folder / "out" / path).exists(), path
    call(sys.executable, "-c", "\n".join(blocks("README.md", "python")), folder=folder)


@pytest.mark.slow
def test_a_first_movie_from_a_dm4_file_to_a_figure(tmp_path):
    scene = Scene()
    write_dm(tmp_path / "movie.dm4", scene.counts(), [(8e-3, "nm"), (8e-3, "nm"), (0.5, "s")])
    for block in blocks("docs/first_movie.md", "bash"):
        if "serve" not in block:
            call("bash", "-euo", "pipefail", "-c", block, folder=tmp_path)
    said = call(sys.executable, "-c", "\n".join(blocks("docs/first_movie.md", "python")), folder=tmp_path)
    assert "moves most" in said
    tracks = open_results(tmp_path / "out" / "results.zarr")
    assert (tracks.attrs["pixel_size_pm"], tracks.attrs["frame_time_s"]) == (8.0, 0.5)
    assert tracks.sizes["column_id"] == len(scene.place)
    for name in re.findall(r"`(out/[\w./]+)`", (ROOT / "docs" / "first_movie.md").read_text(encoding="utf-8")):
        assert (tmp_path / name).exists(), name
    assert (tmp_path / "tracks.csv").exists()


@pytest.mark.slow
def test_commands_of_the_cluster_recipe(folder):
    for block in blocks("docs/cluster.md", "bash"):
        call("bash", "-euo", "pipefail", "-c", block, folder=folder)
    assert (folder / "out-cluster" / "results.zarr").is_dir()


@pytest.mark.slow
def test_examples_of_the_analysis(folder):
    for block in blocks("docs/analysis.md", "bash"):
        call("bash", "-euo", "pipefail", "-c", block, folder=folder)
    call(sys.executable, "-c", "\n".join(blocks("docs/analysis.md", "python")), folder=folder)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda document: document.name)
def test_links_to_files_lead_somewhere(document):
    links = re.findall(r"\]\(([^)\s:#]+)(?:#[^)]*)?\)", document.read_text(encoding="utf-8"))
    assert [link for link in links if not (document.parent / link).exists()] == []


@pytest.mark.parametrize("document", ["architecture.md", "kernels.md"])
def test_what_a_page_names_with_its_file_is_defined_there(document):
    text = (ROOT / "docs" / document).read_text(encoding="utf-8")
    found = re.findall(r"`(?:\w+\.)?(\w+)`\s+(?:in\s+|\()\[`[^`]+`\]\((\S+?\.py)\)", text)
    assert found
    for name, link in found:
        source = (ROOT / "docs" / link).read_text(encoding="utf-8")
        assert re.search(rf"(def|class) {name}\b|^ *{name}\b.* = ", source, re.MULTILINE), f"{name} in {link}"


def test_notebook_is_made_from_the_tutorial():
    made = call(sys.executable, str(ROOT / "scripts" / "make_notebook"), folder=ROOT)
    assert (ROOT / "docs" / "notebooks" / "paper.ipynb").read_text(encoding="utf-8") == made, (
        "run scripts/make_notebook > docs/notebooks/paper.ipynb"
    )


@pytest.mark.slow
def test_the_tutorial_runs_makes_its_figures_and_finds_the_truth(tmp_path):
    said = call(sys.executable, str(ROOT / "scripts" / "make_notebook"), "--figures", str(tmp_path), folder=tmp_path)
    shown = re.findall(r"\(images/tutorial/(.*?)\)", (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8"))
    assert sorted(shown) == sorted(file.name for file in tmp_path.glob("*.png"))
    absent, rejected = (
        set(re.search(rf"^{name}: \[(.*)\]$", said, re.MULTILINE)[1].split()) for name in ("absent", "not accepted")
    )
    assert absent <= rejected
    assert len(rejected - absent) <= 1  # of 31 frames in which the faint column is there
    jumping, frames = re.search(r"^column (\d+) jumps at frames \[(.*)\]$", said, re.MULTILINE).groups()
    assert f"the Wiener filter moved column {jumping}" in said
    found = re.findall(rf"^\d+ +{jumping} +(\d+) ", said.partition("p_value\njump")[2], re.MULTILINE)
    assert found == frames.split()
    assert int(re.search(r"^right: (\d+)%", said, re.MULTILINE)[1]) >= 85


def test_names_that_the_tutorial_links_to_the_paper_exist():
    table = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8").partition("## From the paper to the code")[2]
    rooms = {"plots", "simulate", "settings", "export"}
    analyses = {"motion", "jumps", "precision", "intensity", "lookup", "occupancy", "presence"}
    names = re.findall(r"`([a-z]+)\.(\w+)`", table)
    assert {room for room, _ in names} >= analyses
    for room, name in names:
        if name != "py":
            assert room in rooms | analyses, room
            module = importlib.import_module(f"tract_dask.{'' if room in rooms else 'analysis.'}{room}")
            assert hasattr(module, name), f"{room}.{name}"


def test_links_lead_somewhere():
    for document in [ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", document.read_text(encoding="utf-8")):
            assert (document.parent / target).exists(), f"{document.name}: {target}"


def test_every_script_is_run_by_the_checks():
    scripts = list((ROOT / "scripts").iterdir())
    callers = [ROOT / "README.md", ROOT / ".ci" / "run", *scripts, *(ROOT / "tests").rglob("*.py")]
    for script in scripts:
        assert os.access(script, os.X_OK), script.name
        texts = [file.read_text(encoding="utf-8") for file in callers if file != script]
        assert any(re.search(rf"\b{script.name}\b", text) for text in texts), script.name


def test_no_document_has_marks_of_a_merge():
    for document in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        assert not re.search(r"^(<{7}|\|{7}|={7}|>{7})", document.read_text(encoding="utf-8"), re.MULTILINE), document


def test_changelog_has_a_place_for_what_is_new():
    assert "## [Unreleased]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_what_shows_a_promise_is_there():
    text = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:tests|scripts)/[a-z_./]+)", text))
    assert len(named) > 15
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []
