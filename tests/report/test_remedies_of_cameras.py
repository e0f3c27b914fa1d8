"""What warnings of the camera, of lost frames and of touching columns advise helps, on scenes with known truth."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import Scene
from test_report import Run

from tract_dask import convert, estimate_drift, open_movie, sum_image
from tract_dask.report.findings import findings
from tract_dask.report.survey import survey
from tract_dask.settings import ConvertSettings, DriftSettings


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    return Run(folder)


def told(run: Run) -> dict[str, object]:
    return {finding.name: finding for finding in findings(survey(run.write(), []))}


def drifting(n_frames: int = 16) -> Scene:
    scene = Scene(n_frames=n_frames, background=20.0)
    scene.drift = np.random.default_rng(6).uniform(-4, 4, (n_frames, 2))
    return scene


def test_a_gain_reference_takes_the_pattern_away(run, tmp_path):
    scene, rng = drifting(), np.random.default_rng(7)
    expected = np.stack([scene.frame(shift) for shift in scene.drift])
    pattern = rng.normal(1, 0.08, expected.shape[1:])
    np.save(tmp_path / "movie.npy", rng.poisson(expected * pattern).astype(np.uint16))
    np.save(tmp_path / "gain.npy", 1 / pattern)
    known, names = survey(run.write(), []), []
    for reference in (None, str(tmp_path / "gain.npy")):
        settings = ConvertSettings(gain_reference=reference)
        movie = open_movie(convert(tmp_path / "movie.npy", tmp_path / f"{len(names)}.zarr", settings=settings))
        summed = sum_image(movie, scene.drift_dataset())
        attributes = {name: value for name, value in summed.attrs.items() if name == "camera"}
        names.append({one.name: one for one in findings(replace(known, summed=known.summed.assign_attrs(attributes)))})
    assert "--gain-reference" in names[0]["gain_pattern"].remedy
    assert "gain_pattern" not in names[1]


def test_the_original_of_a_file_with_8_bits_is_not_saturated(run, tmp_path):
    scene = Scene(n_frames=8, max_drift=0.0, amplitude=12.0)
    counts = scene.counts()
    pixels = []
    for name, frames in (("stretched", np.clip(counts * 14, 0, 255).astype(np.uint8)), ("original", counts)):
        np.save(tmp_path / f"{name}.npy", frames)
        movie = open_movie(convert(tmp_path / f"{name}.npy", tmp_path / f"{name}.zarr"))
        pixels.append(movie.pixels.counts(frames.shape[1:]) if movie.pixels else {})
    assert pixels[0].get("saturated", 0) > 10
    assert not pixels[1].get("saturated")


def test_a_larger_search_finds_frames_that_were_lost(tmp_path):
    """The stage jumps by half a cell for three frames: a search of 8 px loses them, one of 40 px does not."""
    scene = Scene(n_frames=10, max_drift=0.0, background=6.0)
    scene.drift[4:7] = [16.0, 14.0]
    np.save(tmp_path / "movie.npy", scene.counts())
    movie = open_movie(convert(tmp_path / "movie.npy", tmp_path / "movie.zarr"))
    near, far = (estimate_drift(movie, DriftSettings(search_px=reach))["quality"].to_numpy() for reach in (8.0, 40.0))
    assert (near == 0).sum() == 3
    assert (far > 0).all()


def test_errors_that_all_frames_share_are_told_of_touching_columns(run):
    run.columns["group"] = "column_id", np.where(np.arange(run.columns.sizes["column_id"]) < 4, 1, 0)
    run.about["shared_place_error"] = 0.9
    found = told(run)["shared_error"]
    assert "4 columns touch" in found.text
    assert "that of one frame is too small by a factor of 1.35" in found.text
    run.about["shared_place_error"] = 0.02
    assert "shared_error" not in told(run)


def test_columns_that_are_twice_as_long_as_others_are_told(run):
    run.columns["fit_ref"][2, 3] *= 2.5
    assert "(3)" in told(run)["one_gaussian"].text
    run.columns["fit_ref"][2, 3] /= 2.0
    assert "one_gaussian" not in told(run)
