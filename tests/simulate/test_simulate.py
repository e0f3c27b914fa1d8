"""Simulated movies against the numbers that they were made from."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from tract_dask.errors import DestinationError, SettingsError
from tract_dask.kernels.rendering import add_columns, draw_counts, poisson_table
from tract_dask.readers import open_source
from tract_dask.simulate.ceria import CERIUM_AMPLITUDE, LATTICE_PM, SIGMA_PM, ceria_surface
from tract_dask.simulate.movie import simulate_movie
from tract_dask.simulate.scene import moving_scene

SHAPE = (160, 192)


def still_scene(contrast=0.5, drift=((0.0, 0.0),)):
    return moving_scene(SHAPE, 8.0, 3.2, contrast, np.asarray(drift), 15.0, np.random.default_rng(0))


def test_structure_is_fluorite():
    surface = ceria_surface(5000.0, 4000.0, 500.0)
    cerium, oxygen = surface.kind == "Ce", surface.kind == "O"
    position = np.stack([surface.x, surface.y], axis=1)
    between = np.linalg.norm(position[cerium][:, None] - position[cerium][None], axis=-1)
    np.fill_diagonal(between, np.inf)
    assert between.min(axis=1) == pytest.approx(LATTICE_PM * np.sqrt(3 / 8))

    to_cerium = np.sort(np.linalg.norm(position[oxygen][:, None] - position[cerium][None], axis=-1), axis=1)
    inner = (np.abs(position[oxygen] - [2000, 3500]) < [1900, 1400]).all(axis=1)
    assert to_cerium[inner, 0] == pytest.approx(LATTICE_PM / 4)
    assert to_cerium[inner, 1:3] == pytest.approx(LATTICE_PM * np.sqrt(3) / 4)  # the bond, which lies in the plane
    assert set(np.unique(surface.atoms[cerium])) == {1, 2, 3, 4, 5, 6}
    assert surface.atoms[oxygen].min() >= 1


def test_vacuum_is_at_the_top_and_the_step_near_the_middle():
    surface = ceria_surface(5000.0, 4000.0, 500.0)
    assert surface.y.min() > 0.2 * 5000
    highest = surface.row == -1
    assert surface.x[highest & (surface.kind == "Ce")].max() < surface.step_x < 0.5 * 4000


def test_frame_has_the_model_value_at_every_column():
    scene = still_scene()
    image = scene.expected_counts(0)
    assert image[:8].mean() == pytest.approx(3.2, rel=1e-3)
    for k in np.flatnonzero((scene.surface.kind == "Ce") & (scene.y[0] < 150) & (np.abs(scene.x[0] - 96) < 90)):
        row, column = np.rint([scene.y[0, k], scene.x[0, k]]).astype(int)
        distance = np.hypot(row - scene.y[0, k], column - scene.x[0, k]) * 8.0
        peak = CERIUM_AMPLITUDE[scene.atoms[0, k]] * np.exp(-0.5 * (distance / SIGMA_PM["Ce"]) ** 2)
        assert image[row, column] == pytest.approx(3.2 * (1 + 0.5 * peak), abs=3.2 * 0.5 * 0.16)


def test_columns_are_gaussians_at_exact_places():
    image = np.zeros((40, 50), dtype=np.float32)
    add_columns(image, np.array([20.3]), np.array([17.8]), np.array([2.0]), np.array([3.0]))
    y, x = np.mgrid[:40, :50]
    exact = 2 * np.exp(-((x - 20.3) ** 2 + (y - 17.8) ** 2) / 18)
    np.testing.assert_allclose(image, np.where(image > 0, exact, 0), rtol=1e-5, atol=1e-7)
    assert exact[image == 0].max() < 1e-6


def test_drift_shifts_the_model_and_not_the_pixels():
    still, shifted = still_scene(drift=[[0, 0], [0, 0]]), still_scene(drift=[[0, 0], [3, -5]])
    first, second = still.expected_counts(1), shifted.expected_counts(1)
    np.testing.assert_allclose(second[3:, :-5], first[:-3, 5:], rtol=1e-5)
    static = shifted.role == "static"
    np.testing.assert_allclose((shifted.x[1] - shifted.x[0])[static], -5, atol=1e-9)


@pytest.mark.parametrize("mean", [0.0, 0.05, 0.8, 3.2, 40.0, 900.0])
def test_counts_are_poisson(mean):
    n = 400_000
    table = poisson_table(0.5 * mean, 1.7 * mean + 0.1)
    counts = draw_counts(np.full((1, n), mean, dtype=np.float32), np.uint64(7), *table).astype(float)
    standard_error = np.sqrt(mean / n)
    assert counts.mean() == pytest.approx(mean, abs=4 * standard_error)
    error_of_variance = np.sqrt((mean + 2 * mean**2) / n)
    assert counts.var() == pytest.approx(mean, abs=4 * error_of_variance + 0.02 * mean)
    if 0 < mean < 10:
        assert (counts == 0).mean() == pytest.approx(np.exp(-mean), abs=4 / np.sqrt(n))


@settings(max_examples=25, deadline=None)
@given(low=st.floats(0, 50), spread=st.floats(0, 300), key=st.integers(0, 2**64 - 1))
def test_expected_counts_are_exact_between_the_tables(low, spread, key):
    mean = np.linspace(low, low + spread, 40_000, dtype=np.float32).reshape(200, 200)
    counts = draw_counts(mean, np.uint64(key), *poisson_table(low, low + spread))
    total = float(mean.sum(dtype=float))
    assert counts.sum() == pytest.approx(total, abs=6 * np.sqrt(1.1 * total + 0.1))


def test_movie_has_the_mean_of_its_model(tmp_path):
    truth = simulate_movie(tmp_path / "m.tif", n_frames=40, shape=SHAPE, drift_px=0.0, jump_pm=0.0, seed=3)
    movie = tifffile.imread(tmp_path / "m.tif")
    assert movie.shape == (40, *SHAPE)
    assert movie.dtype == np.uint16
    expected = moving_scene(SHAPE, 8.0, 3.2, 0.5, np.zeros((1, 2)), 0.0, np.random.default_rng(0)).expected_counts(0)
    absent = truth.isel(column_id=int(np.flatnonzero(truth.role == "absent")[0]), frame=0)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    elsewhere = np.hypot(x - float(absent.x), y - float(absent.y)) > 25
    pull = (movie.mean(axis=0) - expected) / np.sqrt(expected / 40)
    assert pull[elsewhere].mean() == pytest.approx(0, abs=4 / np.sqrt(elsewhere.sum()))
    assert pull[elsewhere].std() == pytest.approx(1, abs=0.03)


def test_truth_tells_who_jumps_and_who_is_absent(tmp_path):
    truth = simulate_movie(tmp_path / "m.tif", n_frames=40, shape=SHAPE, seed=1)
    moved = truth.x - truth.drift.sel(axis="x")
    moving = (moved.max("frame") - moved.min("frame")) > 1e-6
    assert list(truth.role.values[moving]) == ["jumping"]
    assert float((moved.max("frame") - moved.min("frame")).max()) == pytest.approx(15.0 / 8.0)
    gone = (truth.atoms == 0).sum("frame")
    assert list(truth.role.values[gone > 0]) == ["absent"]
    assert int(gone.max()) == 9  # frames 13 to 19, 30 and 31
    assert np.abs(truth.drift.diff("frame")).mean() == pytest.approx(0.3 * np.sqrt(2 / np.pi), rel=0.3)
    assert list(truth.column_id.values) == list(range(1, truth.sizes["column_id"] + 1))
    assert float(truth.x.isel(frame=0).min()) > -0.5
    assert float(truth.y.isel(frame=0).max()) < SHAPE[0] - 0.5


def test_same_seed_same_file(tmp_path):
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        simulate_movie(tmp_path / f"{name}.tif", n_frames=5, shape=SHAPE, seed=seed)
    a, b, c = ((tmp_path / f"{name}.tif").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_dark_columns(tmp_path):
    truth = simulate_movie(tmp_path / "m.tif", n_frames=20, shape=SHAPE, contrast=-0.15, dose=5000.0, drift_px=0.0)
    mean = tifffile.imread(tmp_path / "m.tif").mean(axis=0)
    deepest = truth.isel(column_id=int(np.argmax(truth.atoms[0].where(truth.kind == "Ce", 0).values)), frame=0)
    at_column = mean[round(float(deepest.y)), round(float(deepest.x))]
    assert at_column < 0.7 * truth.attrs["vacuum_counts"]


@pytest.mark.parametrize("limit", [None, 1000])
def test_file_says_pixel_size_and_frame_time(tmp_path, monkeypatch, limit):
    if limit:
        monkeypatch.setattr("tract_dask.simulate.movie._CLASSIC_TIFF_BYTES", limit)
    simulate_movie(tmp_path / "m.tif", n_frames=3, shape=SHAPE, frame_time_s=0.025)
    with tifffile.TiffFile(tmp_path / "m.tif") as file:
        assert file.is_bigtiff == bool(limit)
        assert file.imagej_metadata["unit"] == "nm"
        assert file.imagej_metadata["finterval"] == 0.025
        above, below = file.pages.first.tags["XResolution"].value
        assert 1000 * below / above == pytest.approx(8.0)
        assert file.series[0].shape == (3, *SHAPE)
        assert len(file.pages) == 3
        frames = file.asarray()
    source = open_source(tmp_path / "m.tif")
    assert source.metadata.pixel_size_pm == pytest.approx(8.0)
    assert source.metadata.frame_time_s == pytest.approx(0.025)
    np.testing.assert_array_equal(source.read(0, 3), frames)
    source.close()


@pytest.mark.parametrize(
    "wrong",
    [
        {"n_frames": 0},
        {"shape": (100, 512)},
        {"contrast": -0.5},
        {"drift_px": -1.0},
        {"dose": 1e8},
        {"pixel_size_pm": float("nan")},
    ],
)
def test_numbers_out_of_range_are_refused(tmp_path, wrong):
    with pytest.raises(SettingsError, match="simulate_movie"):
        simulate_movie(tmp_path / "m.tif", **wrong)
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_is_refused(tmp_path):
    Path(tmp_path / "file").touch()
    with pytest.raises(DestinationError, match="cannot be written"):
        simulate_movie(tmp_path / "file" / "m.tif", n_frames=1, shape=SHAPE)
