"""Precision against dose: each column of the table against closed forms, and fits against the bound."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from tract_dask import convert, fit_doses, open_movie
from tract_dask.analysis.precision import best_precision, column_precision, cramer_rao, precision_table, static_columns
from tract_dask.errors import InputError, SettingsError
from tract_dask.kernels.gaussian.fit import fit_gaussians
from tract_dask.kernels.gaussian.information import column_bounds
from tract_dask.kernels.gaussian.model import blurred, gaussian_image
from tract_dask.kernels.gaussian.parameters import AMPLITUDE, PARAMETERS, SIGMA_A, SIGMA_B
from tract_dask.settings import FitSettings, MetadataSettings
from tract_dask.store import schema
from tract_dask.store.schema import Status

PIXEL_PM = 4.0
COLUMN = np.array([60.0, 12.3, 11.6, 3.5, 2.6, 0.4, 20.0])


# The bound


def numerical_bounds(column: np.ndarray, side: int, radius: float, free: list[int]) -> tuple[float, ...]:
    """Bounds of x, y and volume by central differences, in the parameters of Equation 1."""
    inside = np.hypot(*(np.mgrid[:side, :side] - side // 2)) <= radius
    steps = 1e-5 * np.eye(7)[free]
    slopes = (
        np.array(
            [
                (gaussian_image(column + s, (side, side)) - gaussian_image(column - s, (side, side)))[inside]
                for s in steps
            ]
        )
        / 2e-5
    )
    covariance = np.linalg.inv(slopes / gaussian_image(column, (side, side))[inside] @ slopes.T)
    volume = np.array(
        [(np.prod((column + s)[[0, 3, 4]]) - np.prod((column - s)[[0, 3, 4]])) * np.pi / 1e-5 for s in steps]
    )
    return (
        covariance[free.index(1), free.index(1)],
        covariance[free.index(2), free.index(2)],
        volume @ covariance @ volume,
    )


@pytest.mark.parametrize("fixed_shape", [True, False])
@pytest.mark.parametrize("radius", [12.5, 30.0])
def test_bounds_are_those_of_numerical_derivatives(fixed_shape, radius):
    free = [0, 1, 2, 6] if fixed_shape else list(range(7))
    found = column_bounds(COLUMN[None], 25, radius_px=radius, fixed_shape=fixed_shape)
    np.testing.assert_allclose(np.ravel(found), numerical_bounds(COLUMN, 25, radius, free), rtol=1e-6)


def test_bound_of_a_faint_round_column_is_the_closed_form():
    # Far below the background, and far from the edges: var(x) = 2 B / (pi A^2), whatever sigma is.
    peak, background = 0.01, 20.0
    found = column_bounds([[peak, 25.0, 25.0, sigma, sigma, 0.3, background] for sigma in (3.0, 4.0)], 51)
    np.testing.assert_allclose(found[:2], 2 * background / (np.pi * peak**2), rtol=2e-3)


def test_no_counts_tell_nothing():
    columns = np.array([COLUMN, COLUMN, COLUMN])
    columns[1, 6], columns[2, 0] = -1.0, np.nan
    assert np.isfinite(column_bounds(columns, 25)).tolist() == [[True, False, False]] * 3


def test_maximum_likelihood_reaches_the_bound():
    counts = np.random.default_rng(0).poisson(gaussian_image(COLUMN, (25, 25)), (600, 25, 25)).astype(np.float32)
    start = np.tile(COLUMN, (600, 1))
    reach = np.array([59.0, 5, 5, 0, 0, 0, 19])
    fits = fit_gaussians(
        counts, start, start - reach, start + reach, estimator="poisson", fixed_shape=True, radius_px=12.5
    )
    bounds = column_bounds(COLUMN[None], 25, radius_px=12.5, fixed_shape=True)
    volume = 2 * np.pi * fits.estimates[:, [0, 3, 4]].prod(axis=1)
    for values, bound in zip((*fits.estimates[:, 1:3].T, volume), bounds, strict=True):
        assert values.std() == pytest.approx(np.sqrt(bound[0]), rel=0.09)  # 600 values: known to 3 %


# The table, from tracks that are drawn


def hexagons(rows: int = 7, pitch: float = 30.0) -> np.ndarray:
    """Places (n, 2) of a hexagonal crystal with straight edges."""
    y, x = np.mgrid[:rows, :rows]
    return np.stack([50 + pitch * (x + 0.5 * (y % 2)).ravel(), 50 + pitch * np.sqrt(0.75) * y.ravel()], axis=1)


def draw_tracks(
    spread_px: np.ndarray | float = 1.0, n_frames: int = 200, dose: float | None = 500.0, seed: int = 0
) -> xr.Dataset:
    """Tracks of a hexagonal crystal whose columns have normal positions, and say so; after a blur of 2 px."""
    rng = np.random.default_rng(seed)
    places = hexagons()
    n = len(places)
    reference = np.tile(COLUMN, (n, 1))
    reference[:, 1:3] = places
    reference = blurred(reference, 2.0**2)
    fit = np.tile(reference, (n_frames, 1, 1))
    fit[..., 1:3] += rng.normal(size=(n_frames, n, 2)) * np.broadcast_to(spread_px, n)[:, None]
    both = ("frame", "column_id")
    return xr.Dataset(
        {
            "fit": ((*both, "parameter"), fit),
            "stderr": ((*both, "parameter"), np.ones((n_frames, n, 7))),
            "intensity": (both, np.ones((n_frames, n))),
            "intensity_error": (both, np.ones((n_frames, n))),
            "intensity_stderr": (both, np.ones((n_frames, n))),
            "status": (both, np.zeros((n_frames, n), np.uint16)),
            "noise": ("frame", np.ones(n_frames)),
            "x_ref": ("column_id", places[:, 0]),
            "y_ref": ("column_id", places[:, 1]),
            "kind": ("column_id", schema.texts(["Ce"] * n)),
            "fit_ref": (("column_id", "parameter"), reference),
        },
        coords={"column_id": np.arange(1, n + 1), **schema.coordinates(n_frames)},
        attrs={
            "pixel_size_pm": PIXEL_PM,
            "dose": dose,
            "window_px": 25,
            "window_blur_px": 2.0,
            "reference_blur_px": 2.0,
            "shape": "free",
        },
    )


def test_the_table_holds_the_spreads_in_picometres():
    series = [draw_tracks(spread, dose=dose, seed=int(dose)) for dose, spread in ((500, 1.0), (125, 2.0))]
    table = precision_table(series, columns=range(1, 50))
    assert table["dose"].to_numpy().tolist() == [125.0, 500.0]
    for found, error, truth in zip(table["gaussian"], table["gaussian_stderr"], (2 * PIXEL_PM, PIXEL_PM), strict=True):
        assert float(error) == pytest.approx(truth / np.sqrt(4 * 199 * 49), rel=0.4)  # 49 columns: known to a tenth
        assert float(found) == pytest.approx(truth, abs=4 * float(error))
    np.testing.assert_array_equal(table["n_columns"], 49)
    np.testing.assert_array_equal(table["accepted"], 1.0)
    assert table["gaussian"].attrs["units"] == "pm"
    assert "centroid" not in table


def test_theory_and_bound_are_those_of_the_column_without_the_blur():
    tracks = draw_tracks()
    a, b = COLUMN[[SIGMA_A, SIGMA_B]]
    expected = 100 / np.sqrt(np.pi * 500.0) * np.sqrt((a / b + b / a) / 2)
    np.testing.assert_allclose(best_precision(tracks), expected, rtol=1e-4)
    np.testing.assert_allclose(best_precision(tracks, 125.0), 2 * expected, rtol=1e-4)
    bound = numerical_bounds(np.array([*COLUMN[:1], 12.0, 12.0, *COLUMN[3:]]), 25, 12.5, list(range(7)))
    np.testing.assert_allclose(
        cramer_rao(tracks), PIXEL_PM * np.sqrt(np.mean(bound[:2])), rtol=0.02
    )  # any place in a pixel
    known = cramer_rao(tracks.assign_attrs(shape="fixed"))
    assert (known <= cramer_rao(tracks)).all()


def test_theory_of_a_round_column_at_the_doses_of_the_paper():
    """Supplementary Table 2: 5.11, 3.61, 2.56 pm. See best_precision for what is known of its width."""
    tracks = draw_tracks()
    tracks["fit_ref"][:, [SIGMA_A, SIGMA_B]] = 5.0
    found = [float(best_precision(tracks, dose)[0]) for dose in (125.0, 250.0, 500.0)]
    np.testing.assert_allclose(found, [5.05, 3.57, 2.52], atol=5e-3)
    np.testing.assert_allclose(found, [5.11, 3.61, 2.56], rtol=0.016)


def test_centroids_are_compared_in_the_same_frames():
    tracks = draw_tracks()
    place = tracks["fit"].sel(parameter=list(schema.AXES)).drop_vars(["parameter", "unit"]).rename(parameter="axis")
    tracks["centroid"] = (2 * place).assign_coords(axis=schema.texts(schema.AXES))
    tracks["centroid"][:50] = 1e6  # of frames that are not accepted
    tracks["status"][:50] = Status.BELOW_NOISE
    table = precision_table(tracks)
    np.testing.assert_allclose(table["centroid"], 2 * table["gaussian"])
    assert table["centroid_all"].item() > 1e5
    np.testing.assert_allclose(table["centroid_stderr"], 2 * table["gaussian_stderr"])
    np.testing.assert_allclose(table["accepted"], 0.75)


def test_columns_with_neighbours_all_around_are_inside():
    inside = static_columns(draw_tracks(), rule="inside")
    y, x = np.mgrid[:7, :7]
    np.testing.assert_array_equal(inside, (1 + 7 * y + x)[1:-1, 1:-1].ravel())


def test_columns_that_move_are_not_static():
    spread = np.ones(49)
    spread[[10, 24]] = 1.5  # 200 frames: a spread known to 3.5 %
    tracks = draw_tracks(0.7 * spread)  # errors that are overstated, all by the same factor
    quiet = static_columns(tracks, rule="spread")
    assert not {11, 25} & set(quiet)
    assert len(quiet) >= 46
    both = static_columns(tracks)
    assert set(both) == set(quiet) & set(static_columns(tracks, rule="inside"))


def test_a_test_at_95_percent_turns_away_one_static_column_in_twenty():
    kept = [
        len(static_columns(draw_tracks(n_frames=40, seed=seed), rule="spread", confidence=0.95)) for seed in range(8)
    ]
    assert np.mean(kept) / 49 == pytest.approx(0.95, abs=0.035)  # of 392 columns, the median's own error included


def test_lazy_tracks_stay_lazy():
    tracks = draw_tracks()
    tracks["kind"] = tracks["kind"].astype(np.dtypes.StringDType())  # as a store gives it
    found = column_precision(tracks.chunk(frame=30))
    assert found["gaussian"].chunks is not None
    xr.testing.assert_allclose(found.compute(), column_precision(tracks))


@pytest.mark.parametrize(
    ("change", "arguments", "error", "words"),
    [
        ({"dose": None}, {}, SettingsError, "the dose of a frame is not known"),
        ({"pixel_size_pm": None}, {}, SettingsError, "size of a pixel"),
        ({}, {"columns": [3, 99]}, SettingsError, "no such columns.*99"),
        ({}, {"rule": "outside"}, SettingsError, "no such rule"),
        ({}, {"dose": [1.0, 2.0]}, SettingsError, "every Dataset has one dose"),
    ],
)
def test_what_is_missing_is_named(change, arguments, error, words):
    with pytest.raises(error, match=words):
        precision_table(draw_tracks(n_frames=5).assign_attrs(change), **arguments)


def test_tracks_without_their_attributes_say_so():
    tracks = draw_tracks(n_frames=5)
    del tracks.attrs["window_px"]
    with pytest.raises(SettingsError, match="do not say how they were fitted"):
        cramer_rao(tracks)


def test_a_particle_without_an_inside_says_so():
    with pytest.raises(InputError, match="keeps still"):
        precision_table(draw_tracks(n_frames=5).isel(column_id=slice(0, 14)))


# The table, from fits


def test_fits_reach_the_bound_at_every_dose(tmp_path, npy, scene):
    scene.n_frames, scene.shape = 48, (160, 144)
    scene.__post_init__()
    movie = open_movie(
        convert(
            npy(scene.counts()), tmp_path / "movie.zarr", metadata=MetadataSettings(pixel_size_pm=PIXEL_PM, dose=125.0)
        )
    )
    series = fit_doses(
        movie, scene.columns(), scene.drift_dataset(), groups=(1, 4), settings=FitSettings(refine_drift=False)
    )
    table = precision_table(series, columns=scene.columns()["column_id"].to_numpy())
    assert table["dose"].to_numpy().tolist() == [125.0, 500.0]
    truth = np.array([*scene.parameters[0, :1], 9.0, 9.0, *scene.parameters[0, 3:]])
    for k, n in enumerate((1, 4)):
        truth[[AMPLITUDE, PARAMETERS.index("background")]] = n * scene.amplitude, n * scene.background
        bound = PIXEL_PM * np.sqrt(np.mean(column_bounds(truth[None], 19, radius_px=9.5, fixed_shape=True)[:2]))
        assert float(table["crlb"][k]) == pytest.approx(bound, rel=0.02)
        assert float(table["gaussian"][k] / table["crlb"][k]) == pytest.approx(1.04, abs=0.1)
