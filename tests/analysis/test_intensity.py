"""Intensities against closed forms and counts of which everything is known."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from tract_dask import accepted, convert, fit_columns, fit_doses, open_movie
from tract_dask.analysis.intensity import (
    intensity_against_dose,
    mean_intensity,
    normalised,
    repeated_error,
    vacuum_level,
    with_scale,
)
from tract_dask.errors import SettingsError
from tract_dask.kernels.gaussian.intensity import intensities
from tract_dask.settings import ConvertSettings, FitSettings, MetadataSettings
from tract_dask.store import schema
from tract_dask.store.schema import Status

PIXEL_PM = 8.0
ELLIPSE = 1 - np.exp(-2)
PAPER = 0.9545**2


@pytest.fixture
def make_movie(tmp_path, npy):
    def make(frames, **metadata):
        place = tmp_path / f"movie{len(list(tmp_path.iterdir()))}.zarr"
        known = MetadataSettings(**({"pixel_size_pm": PIXEL_PM, "dose": 125.0} | metadata))
        settings = ConvertSettings(find_defects=False)  # vacuum without noise has one value, as a border has
        return open_movie(convert(npy(frames), place, settings=settings, metadata=known))

    return make


def draw_tracks(n_frames: int = 300, n_columns: int = 6, spread: float = 50.0) -> xr.Dataset:
    """Tracks of columns whose intensities are normal about 1000, 2000 …, with errors that say so."""
    rng = np.random.default_rng(0)
    both = ("frame", "column_id")
    column = np.array([60.0, 12.3, 11.6, 3.5, 2.6, 0.4, 20.0])
    level = 1000.0 * np.arange(1, n_columns + 1)
    fit = np.tile(column, (n_frames, n_columns, 1))
    intensity = level + rng.normal(0, spread, (n_frames, n_columns))
    fit[..., 0] = intensity / (PAPER * 2 * np.pi * 3.5 * 2.6)
    return xr.Dataset(
        {
            "fit": ((*both, "parameter"), fit),
            "stderr": ((*both, "parameter"), np.ones_like(fit)),
            "intensity": (both, intensity, {"units": "counts"}),
            "intensity_error": (both, intensities(fit)[1]),
            "intensity_stderr": (both, np.full((n_frames, n_columns), spread)),
            "status": (both, np.zeros((n_frames, n_columns), np.uint16)),
        },
        coords={"column_id": np.arange(1, n_columns + 1), **schema.coordinates(n_frames)},
        attrs={"pixel_size_pm": PIXEL_PM, "dose": 125.0, "intensity_scale": "paper"},
    )


# Equations 3 and 5


@pytest.mark.parametrize("lazy", [False, True])
def test_equations_under_both_scales(lazy):
    tracks = draw_tracks()
    tracks["status"][3] = Status.BELOW_NOISE
    changed = with_scale(tracks.chunk(frame=50) if lazy else tracks, "ellipse")
    assert (changed["intensity"].chunks is not None) == lazy
    a, sa, sb, b = (accepted(tracks)["fit"].isel(parameter=k, drop=True) for k in (0, 3, 4, 6))
    volume = ELLIPSE * 2 * np.pi * a * sa * sb
    np.testing.assert_allclose(changed["intensity"], volume)
    np.testing.assert_allclose(changed["intensity_error"], np.sqrt(volume + 8 * np.pi * b * sa * sb))
    np.testing.assert_allclose(changed["intensity_stderr"], accepted(tracks)["intensity_stderr"] * ELLIPSE / PAPER)
    assert changed.attrs["intensity_scale"] == "ellipse"
    back = with_scale(changed, "paper")
    for name in ("intensity", "intensity_error", "intensity_stderr"):
        np.testing.assert_allclose(back[name], accepted(tracks)[name])


def test_a_scale_that_there_is_not():
    with pytest.raises(SettingsError, match=r"no such scale.*paper, ellipse"):
        with_scale(draw_tracks(), "box")


# Errors by repetition


def test_repeated_errors_are_those_of_the_draw():
    tracks = draw_tracks()
    tracks["status"][:100, 2] = Status.NOT_CONVERGED
    errors = repeated_error(tracks)
    np.testing.assert_allclose(errors["mean"], 1000.0 * np.arange(1, 7), atol=4 * 50 / np.sqrt(200))
    np.testing.assert_allclose(errors["sd"], 50.0, atol=4 * 50 / np.sqrt(2 * 199))
    np.testing.assert_allclose(errors["sd_stderr"], errors["sd"] / np.sqrt(2 * (errors["n"] - 1)))
    np.testing.assert_allclose(errors["predicted"] ** 2, errors["mean"] + 8 * np.pi * 20.0 * 3.5 * 2.6, rtol=1e-3)
    np.testing.assert_allclose(errors["fitted"], 50.0)
    assert errors["n"].to_numpy().tolist() == [300, 300, 200, 300, 300, 300]
    assert repeated_error(tracks.chunk(frame=50))["sd"].chunks is not None


def test_intensities_of_counts_scatter_as_the_fits_say(scene, make_movie):
    scene.n_frames = 40
    scene.__post_init__()
    movie = make_movie(scene.counts())
    tracks = fit_columns(movie, scene.columns(), scene.drift_dataset(), FitSettings(refine_drift=False)).compute()
    errors = repeated_error(tracks)
    volume = PAPER * 2 * np.pi * scene.amplitude * scene.sigma_a * scene.sigma_b
    assert float(errors["mean"].mean()) == pytest.approx(volume, rel=0.02)
    ratio = np.sqrt(float((errors["sd"] ** 2).mean() / (errors["fitted"] ** 2).mean()))
    assert ratio == pytest.approx(1.0, abs=0.12)  # 12 columns, 40 frames: known to 3 %
    blur = tracks.attrs["window_blur_px"] ** 2
    blurred = np.sqrt((scene.sigma_a**2 + blur) * (scene.sigma_b**2 + blur))
    equation_5 = np.sqrt(volume + 8 * np.pi * scene.background * blurred)
    np.testing.assert_allclose(errors["predicted"], equation_5, rtol=0.03)


# Vacuum


def test_vacuum_is_the_mean_of_its_box(scene, make_movie):
    scene.n_frames = 6
    scene.__post_init__()
    scene.drift = np.round(scene.drift)
    box = (10, 40, 20, 120)
    movie = make_movie(scene.counts(), gain=0.5)
    level = vacuum_level(movie, box, drift=scene.drift_dataset())
    assert level["level"].chunks is not None
    assert level.attrs["area"] == pytest.approx(30 * 100 * 0.08**2)
    np.testing.assert_allclose(level["stderr"], 0.5 * np.sqrt(scene.background / 3000), rtol=0.06)
    np.testing.assert_allclose(level["level"], 0.5 * scene.background, atol=4 * 0.5 * np.sqrt(scene.background / 3000))
    frames = movie.frames.compute().to_numpy()
    dy, dx = scene.drift[3].astype(int)
    by_hand = frames[3, 10 + dy : 40 + dy, 20 + dx : 120 + dx].mean()
    assert float(level["level"][3]) == pytest.approx(0.5 * by_hand)


def test_vacuum_of_a_summed_image_is_found(scene):
    summed = scene.summed().assign_attrs(pixel_size_pm=PIXEL_PM)
    summed["image"] += np.random.default_rng(0).normal(0, 1.0, scene.shape)
    level = vacuum_level(summed, columns=scene.columns())
    y0, y1, x0, x1 = level.attrs["box"]
    assert y1 <= scene.place[:, 1].min()
    n_pixels = (y1 - y0) * (x1 - x0)
    assert float(level["stderr"]) == pytest.approx(1 / np.sqrt(n_pixels), rel=0.1)
    assert float(level["level"]) == pytest.approx(scene.background, abs=4 / np.sqrt(n_pixels))
    again = vacuum_level(summed, level.attrs["box"])
    assert float(again["level"]) == float(level["level"])


def test_vacuum_that_cannot_be_had(scene, make_movie):
    with pytest.raises(SettingsError, match="no vacuum is known"):
        vacuum_level(scene.summed())
    with pytest.raises(SettingsError, match=r"vacuum_level: box.*leaves the frame"):
        vacuum_level(scene.summed(), (0, 1000, 0, 10))
    with pytest.raises(SettingsError, match="vacuum of a movie needs its box"):
        vacuum_level(make_movie(scene.counts()))
    with pytest.raises(SettingsError, match="vacuum has no counts"):
        normalised(draw_tracks(), 0.0)
    with pytest.raises(SettingsError, match="size of a pixel"):
        normalised(draw_tracks().assign_attrs(pixel_size_pm=None), 1.0)


def test_a_square_angstrom_of_vacuum_integrates_to_one():
    tracks = draw_tracks()
    vacuum = xr.Dataset({"level": 20.0, "stderr": 0.4})
    found = normalised(tracks, vacuum)
    counts = 20.0 / 0.08**2  # in a square angstrom
    np.testing.assert_allclose(found["intensity"], tracks["intensity"] / counts)
    expected = np.sqrt(tracks["intensity_stderr"] ** 2 + (0.02 * tracks["intensity"]) ** 2) / counts
    np.testing.assert_allclose(found["intensity_stderr"], expected)
    np.testing.assert_allclose(normalised(tracks, 20.0)["intensity_error"], tracks["intensity_error"] / counts)
    assert found["intensity"].attrs["units"] == "vacuum A^2"


def test_each_frame_has_its_own_vacuum(scene, make_movie):
    """A beam whose current changes leaves normalised intensities as they are; they stay lazy."""
    beam = np.linspace(0.5, 2.0, 8)
    scene.n_frames = 8
    scene.__post_init__()
    frames = np.array([k * scene.frame(shift) for k, shift in zip(beam, scene.drift, strict=True)], np.float32)
    movie, drift = make_movie(frames), scene.drift_dataset()
    tracks = fit_columns(movie, scene.columns(), drift, FitSettings(refine_drift=False))
    found = normalised(tracks, vacuum_level(movie, (8, 40, 10, 130), drift=drift))
    assert found["intensity"].chunks is not None
    assert float(tracks["intensity"].std("frame").mean() / tracks["intensity"].mean()) > 0.3
    volume = PAPER * 2 * np.pi * scene.amplitude * scene.sigma_a * scene.sigma_b
    np.testing.assert_allclose(found["intensity"], volume / scene.background * 0.08**2, rtol=0.01)


# Time and dose


def test_means_in_time_have_the_error_of_a_mean():
    tracks = draw_tracks(305)
    tracks["status"][7, 1] = Status.AT_BOUND
    found = mean_intensity(tracks, 10)
    assert found.sizes["frame"] == 30
    assert found["frame"].to_numpy().tolist() == list(range(0, 300, 10))
    assert int(found["n"][0, 1]) == 9
    np.testing.assert_allclose(found["stderr"][1:], 50 / np.sqrt(10))
    away = (found["intensity"] - 1000.0 * found["column_id"]) / found["stderr"]
    assert float(away.std()) == pytest.approx(1.0, abs=0.16)  # 180 values: known to 5 %
    assert float(found["chi_squared"].mean()) == pytest.approx(1.0, abs=0.14)  # 1620 degrees of freedom: known to 3.5 %


def test_a_column_that_changes_scatters_more_than_its_errors():
    tracks = draw_tracks()
    tracks["intensity"][150:, 3] += 200.0
    found = mean_intensity(tracks)
    assert found.sizes["frame"] == 1
    steady = np.delete(found["chi_squared"].to_numpy()[0], 3)
    np.testing.assert_allclose(steady, 1.0, atol=4 * np.sqrt(2 / 299))
    assert float(found["chi_squared"][0, 3]) == pytest.approx(1 + (100 / 50) ** 2, rel=0.1)
    assert mean_intensity(tracks.chunk(frame=64), 7)["intensity"].chunks is not None
    with pytest.raises(SettingsError, match="1 to 300"):
        mean_intensity(tracks, 301)


def test_normalised_intensity_does_not_depend_on_the_dose_and_its_error_falls_with_its_root(scene, make_movie):
    scene.n_frames = 48
    scene.__post_init__()
    groups = (4, 1)
    series = fit_doses(
        make_movie(scene.counts()),
        scene.columns(),
        scene.drift_dataset(),
        groups,
        settings=FitSettings(refine_drift=False),
    )
    table = intensity_against_dose(series, [2, 3, 5], vacuum=[n * scene.background for n in groups])
    assert table["dose"].to_numpy().tolist() == [125.0, 500.0]
    assert table["column_id"].to_numpy().tolist() == [2, 3, 5]
    truth = PAPER * 2 * np.pi * scene.amplitude * scene.sigma_a * scene.sigma_b / scene.background * 0.08**2
    away = (table["intensity"] - truth) / table["stderr"]
    assert np.abs(away).max() < 4.5  # neighbours' tails: half a standard error
    np.testing.assert_allclose(table["error_68"][0] / table["error_68"][1], 2.0, rtol=0.02)
    np.testing.assert_allclose(table["error_95"], 1.96 * table["error_68"])
    np.testing.assert_allclose(table["n"], [[48] * 3, [12] * 3])
    with pytest.raises(SettingsError, match="one dose and one vacuum"):
        intensity_against_dose(series, [2], vacuum=[1.0])
