"""What warnings advise helps: scenes with known truth that trigger each, and do not once the remedy is taken."""

import re
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from conftest import Scene
from test_remedies import told, told_of
from test_report import Run

from tract_dask import convert, find_columns, open_movie
from tract_dask.analysis.dose import fit_doses
from tract_dask.report import findings as room
from tract_dask.report.findings import findings
from tract_dask.report.survey import Survey, survey
from tract_dask.settings import ColumnSettings, FitSettings, RunSettings
from tract_dask.stages.fit.job import prepare
from tract_dask.store.camera import Camera
from tract_dask.store.columns import column_dataset


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return what makes a movie of a scene: the scene, its movie, and a run's numbers."""
    folder = tmp_path_factory.mktemp("scenes")
    run = folder / "run"
    run.mkdir()
    known = survey(Run(run).write(), [])

    def make(scene: Scene, name: str, counts: np.ndarray | None = None) -> tuple[Scene, object, Survey]:
        np.save(folder / f"{name}.npy", scene.counts() if counts is None else counts)
        return scene, open_movie(convert(folder / f"{name}.npy", folder / f"{name}.zarr")), known

    return make


@pytest.fixture(scope="module")
def still(made):
    """A crystal that stands still."""
    return made(Scene(n_frames=8, max_drift=0.0), "still")


@pytest.fixture(scope="module")
def dim(made):
    """A crystal that stands still, hardly above the noise."""
    return made(Scene(n_frames=24, max_drift=0.0, amplitude=0.55, background=2.0), "dim")


def test_sums_of_frames_are_not_faint_and_are_accepted(dim):
    scene, movie, known = dim
    tracks = fit_doses(movie, scene.columns(), scene.drift_dataset(), [1, 8], summed=scene.summed())
    single, summed = (told_of(known, of) for of in tracks)
    for name in ("faint", "accepted"):
        assert "rebin_frames" in single[name].remedy
        assert name not in summed


def test_the_wider_window_that_is_named_accepts_more(dim):
    default = told(dim, window_px=13)["accepted"]
    window = int(re.findall(r"--window-px (\d+)", default.remedy)[0])
    assert 13 < window <= 21
    wide = told(dim, window_px=window)
    assert "accepted" not in wide or share_of(wide["accepted"]) > share_of(default) + 0.02


def share_of(accepted):
    return float(re.findall(r"\(([\d.]+)%\)", accepted.text)[0]) / 100


def test_fixed_shapes_are_determined(dim):
    free = told(dim, shape="free")
    assert "--shape fixed" in free["shape_at_bound"].remedy
    assert "shape_at_bound" not in told(dim)


def test_columns_that_move_far_need_room(made):
    scene = Scene(n_frames=8, max_drift=0.0)
    scene.drift[::2] = 1.5
    moved = made(scene, "moved")
    nowhere = scene.drift_dataset(-scene.drift)
    near = told(moved, drift=nowhere, max_shift_px=1.0, refine_drift=False)
    assert "--max-shift-px" in near["at_bound"].remedy
    assert "at_bound" not in told(moved, drift=nowhere, max_shift_px=4.0, refine_drift=False)


def test_a_column_that_is_none_is_taken_out_of_the_table(made):
    scene = Scene(n_frames=12, max_drift=0.0)
    present = np.ones((scene.n_frames, len(scene.place)), bool)
    present[:, 4] = False
    gone = made(scene, "gone", scene.counts(present))
    columns = scene.columns()
    found = told(gone, columns)
    assert "(5)" in found["weak_columns"].text
    assert "columns.csv" in found["weak_columns"].remedy
    assert "weak_columns" not in told(gone, columns.isel(column_id=np.delete(np.arange(columns.sizes["column_id"]), 4)))


def test_a_smaller_window_fits_columns_at_the_edge(still):
    scene = still[0]
    edge = scene.parameters[:1]
    edge[:, 2] = 155.0
    more = column_dataset(edge[:, 1:3], ["Ce"], [99], edge).drop_vars(["group", "unresolved"])
    columns = xr.concat([scene.columns(), more], "column_id")
    columns.attrs = scene.columns().attrs
    assert "--window-px" in told(still, columns, window_px=19)["never_fitted"].remedy
    assert "never_fitted" not in told(still, columns, window_px=7)


def test_a_column_that_is_missing_is_added(made):
    """A neighbour that the table lacks, nine pixels from a column."""
    scene = Scene(n_frames=12, max_drift=0.0)
    other = Scene(n_frames=12, max_drift=0.0)
    other.place = np.vstack([scene.place, scene.place[4] + [9.0, 0.0]])
    pair = made(other, "pair")
    lacking = told(pair, scene.columns(), window_px=25)
    assert "columns.csv" in lacking["one_gaussian"].remedy
    both = other.columns()
    both["group"] = "column_id", np.isin(np.arange(len(other.place)), [4, len(scene.place)]).astype(np.int64)
    assert "one_gaussian" not in told(pair, both, window_px=25)


def test_noise_that_is_not_of_counts_is_said_to_be_so(made):
    scene = Scene(n_frames=24, max_drift=0.0, amplitude=60.0, background=1.0)
    expected = np.stack([scene.frame(shift) for shift in scene.drift])
    even = made(scene, "even", np.random.default_rng(4).normal(expected, 4.0).astype(np.float32))
    assert "--no-counting" in told(even)["scatter"].remedy
    assert "scatter" not in told(even, counting=False)


def test_the_drift_that_is_given_makes_no_jump(still):
    scene = still[0]
    step = np.where(np.arange(scene.n_frames) < 4, 0.0, 15.0)[:, None] * [1.0, 0.0]
    assert "--drift-csv" in told(still, drift=scene.drift_dataset(step))["long_step"].remedy
    assert "long_step" not in told(still)


def test_a_contrast_that_is_given_is_sure(still):
    """As many dark columns between the bright ones, as high."""
    scene, _, known = still
    image = scene.frame(np.zeros(2))
    image = 60 + image - np.roll(image, 15, axis=(0, 1))
    summed = scene.summed().assign(image=(("y", "x"), image))
    names = []
    for contrast in ("auto", "bright"):
        found = find_columns(summed, ColumnSettings(contrast=contrast))
        about = {name: value for name, value in found.attrs.items() if value is not None}
        run = replace(known, found=about, tracks=found.assign_attrs(known.tracks.attrs))
        names.append({finding.name for finding in room._found(run)})
    assert "contrast" in names[0]
    assert "contrast" not in names[1]


@pytest.mark.parametrize(
    ("measured", "right"), [({"per_electron": 2.0}, {"gain": 0.5}), ({"zero": 8.0}, {"offset": 8.0})]
)
def test_gain_and_offset_that_are_measured_are_right(still, measured, right):
    known = still[2]
    camera = {"per_electron": 1.0, "per_electron_stderr": 0.01, "zero": 0.0, "zero_stderr": 0.1} | measured
    summed = known.summed.assign_attrs(Camera(**camera).to_attribute())
    wrong, mended = (replace(known, summed=summed, about=known.about | {"movie": said}) for said in ({}, right))
    said = {finding.name: finding for finding in findings(wrong)}
    assert " auto" in said["camera"].remedy
    assert "camera" not in {finding.name for finding in findings(mended)}


def test_another_box_has_vacuum(made):
    """What lies above the columns was cut off; beside them it was not."""
    scene = Scene(n_frames=8, max_drift=0.0, background=6.0)
    counts = scene.counts()
    counts[:, :40] = 0
    counts[:, 2:38:7, 3::11] = 1
    cut, whole = ((4, 36, 4, 140), (45, 55, 4, 140))
    _, movie, _ = made(scene, "cut", counts)
    why = [
        prepare(movie, scene.columns(), None, FitSettings(vacuum_box=box), summed=scene.summed()).unusable
        for box in (cut, whole)
    ]
    assert why[0]
    assert why[1] is None


def test_intensities_of_free_widths_are_said_to_be_too_large(tmp_path):
    run = Run(tmp_path)
    shape = run.values["intensity"].shape
    run.values["intensity"][:] = 4000 * np.random.default_rng(1).normal(1, 0.6, shape)
    run.settings = RunSettings(fit=FitSettings(shape="free"))
    found = {finding.name: finding for finding in findings(survey(run.write(), []))}
    assert "% to 1" in found["faint"].text
    assert "--shape fixed" in found["faint"].remedy
    steady = Run(tmp_path / "steady")
    steady.folder.mkdir()
    steady.settings = run.settings
    assert "faint" not in steady.names()
