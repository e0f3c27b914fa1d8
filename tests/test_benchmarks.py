"""The benchmark: its windows and scores against theory, and the whole of it on small data, peers included."""

import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from benchmarks import loops, report
from benchmarks.__main__ import DOCUMENT, FIGURES, SECTIONS, UNPUBLISHED
from benchmarks.fitters import LSQ, POISSON
from benchmarks.peers.protocol import equation_1, slopes_1
from benchmarks.sizes import SMALL
from benchmarks.windows import Case, draw, score
from tract_dask.kernels.gaussian.model import evaluate

ROOT = Path(__file__).parents[1]
PARAMETERS = np.array([60.0, 11.4, 12.7, 4.1, 2.8, 0.4, 20.0])


def test_peers_fit_the_model_of_this_project():
    y, x = np.mgrid[:25, :25].astype(float)
    np.testing.assert_allclose(equation_1(PARAMETERS, x, y), evaluate(PARAMETERS, x, y), rtol=1e-12)


def test_derivatives_that_scipy_gets():
    x, y = np.array([3.0, 11.0, 20.0]), np.array([15.0, 12.0, 8.0])
    numerical = approx_fprime(PARAMETERS, lambda p: equation_1(p, x, y), 1e-6)
    np.testing.assert_allclose(slopes_1(PARAMETERS, x, y), numerical, rtol=1e-4, atol=1e-4)


def test_scores_of_fits_whose_errors_are_known():
    windows = draw(Case(15, 50.0, 20.0), 400)
    chance = np.random.default_rng(1)
    centres = windows.truth[:, 1:3] + chance.normal(size=(400, 2)) * 1.1 * np.sqrt(windows.crlb)
    fine = np.ones(400, bool)
    centres[:40], fine[40:60] = np.nan, False
    found = score(centres, fine, windows)
    assert found["success"] == 340 / 400
    assert abs(found["precision"] - 1.1) < 4 * found["precision_sd"]
    assert score(centres[:40], fine[:40], windows)["precision"] is None


def test_windows_hold_what_their_truth_says():
    windows = draw(Case(25, 300.0, 300.0), 200)
    y, x = np.mgrid[:25, :25]
    expected = evaluate(windows.truth, x, y)
    pull = (windows.counts - expected) / np.sqrt(expected)
    assert abs(pull.mean()) < 0.02
    assert abs(pull.std() - 1) < 0.02
    assert (windows.lower <= windows.truth).all()
    assert (windows.truth <= windows.upper).all()


def test_tiles_of_boxes_are_read_once_and_all_of_them():
    boxes = np.array([[-3, 10, 5, 20], [0, 5, 3, 7], [30, 30, 99, 99]])
    parts = loops.touched_parts(boxes, (40, 36), (8, 8))
    times = np.zeros((40, 36), int)
    for rows, columns in parts:
        times[rows, columns] += 1
    assert times.max() == 1
    assert times[:8, :24].all()
    assert times[24:, 24:].all()
    assert times.sum() == 8 * 24 + 16 * 12


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The small benchmark, run by its one command; peers are installed where they are missing."""
    out = tmp_path_factory.mktemp("bench")
    command = [ROOT / "scripts" / "bench", "--small", "--out", out, "--work", out]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=590)
    assert done.returncode == 0, done.stderr[-5000:]
    kept = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert (out / "results.md").read_text(encoding="utf-8") in done.stdout
    assert (out / "performance.png").stat().st_size > 10_000
    assert kept["sections"].keys() == SECTIONS.keys()
    return kept


@pytest.mark.slow
def test_every_fitter_recovers_the_truth(results):
    cases = results["sections"]["kernel"]["cases"]
    assert len(cases) == 6
    for case, rows in cases.items():
        names = {row["fitter"] for row in rows}
        assert {LSQ.name, POISSON.name} < names
        assert {name.split()[0] for name in names} == {"tract_dask", *SMALL.peers}
        if case.endswith("5 on 20"):
            continue
        for row in rows:
            assert row["success"] == 1, (case, row)
            assert row["seconds_per_fit"]["median"] > 0
            if row["same_task"]:
                assert abs(row["precision"] - 1) < 0.06 + 4 * row["precision_sd"], (case, row)


@pytest.mark.slow
def test_stages_and_runs_were_measured(results):
    sections = results["sections"]
    stages, runs = sections["stages"], sections["runs"]
    assert stages["columns"] > 10
    assert {"convert", "drift", "sum", "fit", "bare convert", "bare fit", "dask to_zarr"} < stages["seconds"].keys()
    assert len(stages["fit_by_columns"]) == 1 + len(SMALL.sweep_columns)
    assert runs["by_workers"].keys() == {"1", str(runs["workers"])}
    assert runs["by_frames"].keys() == {str(SMALL.frames)}
    for outcome in (*runs["by_workers"].values(), *runs["by_frames"].values()):
        assert 50 < outcome["worker_peak_mb"]["median"] < 2000
        assert sum(times["median"] for times in outcome["stages"].values()) < outcome["seconds"]["median"]
    assert sections["scheduler"]["shards"] == SMALL.shards
    startup = sections["startup"]
    assert startup["import tract_dask"]["median"] < startup["first fit, warm cache"]["median"]


@pytest.mark.slow
def test_every_goal_has_its_row(results):
    rows = report.goals(results["sections"]).splitlines()[2:]
    assert len(rows) == sum(goal.limit is not None for goal in report.GOALS)
    missing = "picasso (2), a quarter of the movie and cold starts are not in the small benchmark"
    assert sum("not compared" in row for row in rows) == 4, missing


def test_the_document_shows_the_published_figures():
    published = json.loads(FIGURES.read_text(encoding="utf-8"))
    assert published["sections"].keys() == SECTIONS.keys() - UNPUBLISHED
    text = DOCUMENT.read_text(encoding="utf-8")
    assert f"{report.BEGIN}\n\n{report.markdown(published)}\n{report.END}" in text


def test_the_table_of_scenes_maps_warnings_that_there_are():
    from benchmarks.cases.scenes.table import EXPLAINS

    listed = set(re.findall(r"^\| `(\w+)` \|", (ROOT / "docs" / "trust.md").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(EXPLAINS) <= listed
    assert set().union(*EXPLAINS.values()) == {"missing", "false", "bias", "pull", "absent", "intensity"}
