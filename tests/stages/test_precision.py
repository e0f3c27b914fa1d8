"""What estimators, shapes and windows do to positions, intensities and their errors: against truth and the bound."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import xarray as xr
from scipy.optimize import least_squares

from tract_dask import accepted, convert, fit_columns, open_movie
from tract_dask.errors import SettingsError
from tract_dask.kernels.gaussian.fit import fit_gaussians
from tract_dask.kernels.gaussian.model import gaussian_image
from tract_dask.kernels.gaussian.parameters import PARAMETERS
from tract_dask.settings import FitSettings

WINDOW = 19
SLACK = 1.12
"""Standard deviations may exceed the Cramer-Rao bound by this factor, statistics of some hundred fits included."""
PULLS = 0.12
"""Errors in units of their standard errors have a standard deviation this near to 1, as far as 480 fits tell."""


def bound(scene, free=("amplitude", "x", "y", "background")) -> np.ndarray:
    """Standard deviations of the free parameters by the Cramer-Rao bound, for counts in a column's round window."""
    truth = np.array(
        [scene.amplitude, WINDOW // 2, WINDOW // 2, scene.sigma_a, scene.sigma_b, scene.theta, scene.background]
    )
    offset = np.hypot(*(np.mgrid[:WINDOW, :WINDOW] - WINDOW // 2))
    inside = offset <= WINDOW / 2
    slopes = []
    for name in free:
        step = np.zeros(7)
        step[PARAMETERS.index(name)] = 1e-4
        ahead, behind = (gaussian_image(truth + sign * step, (WINDOW, WINDOW))[inside] for sign in (1, -1))
        slopes.append((ahead - behind) / 2e-4)
    information = np.array(slopes) / gaussian_image(truth, (WINDOW, WINDOW))[inside] @ np.array(slopes).T
    return np.sqrt(np.diag(np.linalg.inv(information)))


@pytest.fixture
def tracks(scene, tmp_path, npy):
    """Fit the scene's counts, less ``offset``, with the settings given; x and y become deviations from the truth."""
    scene.drift[:] = 0

    def fit(offset=0.0, present=None, **settings) -> xr.Dataset:
        frames = scene.counts(present) if not offset else scene.counts(present).astype(np.float32) + offset
        path = tmp_path / f"movie{len(list(tmp_path.iterdir()))}.zarr"
        movie = open_movie(convert(npy(frames), path))
        summed = scene.summed()
        summed["image"] = summed["image"] + offset
        columns = scene.columns(settings.get("blur_sigma_px", 2.0))
        columns["fit_ref"][:, 6] += offset
        result = fit_columns(movie, columns, None, FitSettings(**settings), summed=summed).compute()
        result["fit"].loc[{"parameter": ["x", "y"]}] -= scene.place[None]
        return result

    return fit


def spread(tracks: xr.Dataset) -> float:
    """Root mean square error of the positions, per axis, px."""
    return float(np.sqrt((tracks["fit"].sel(parameter=["x", "y"]) ** 2).mean()))


def found(tracks: xr.Dataset) -> np.ndarray:
    """Which fits are accepted, (frames, columns)."""
    return np.asarray(accepted(tracks)["fit"].sel(parameter="x").notnull())


def dim(scene) -> None:
    """With a blur of 1 px like CeO2 at some 250 electrons per square angstrom, 4 pm a pixel, with one of 2 px."""
    scene.n_frames, scene.amplitude, scene.background = 40, 1.6, 2.0
    scene.drift = np.zeros((scene.n_frames, 2))


def bright(scene) -> None:
    """High contrast on little background: the noise of a column's peak is far from that of its surroundings."""
    scene.n_frames, scene.amplitude, scene.background = 40, 30.0, 2.0
    scene.drift = np.zeros((scene.n_frames, 2))


def test_the_default_reaches_the_bound_at_low_dose_and_loses_few_columns(scene, tracks):
    dim(scene)
    fits = tracks(blur_sigma_px=1.0)
    assert found(fits).mean() >= 0.97
    assert spread(accepted(fits)) <= SLACK * bound(scene)[1:3].mean()


def test_a_fixed_shape_beats_a_free_one_at_low_dose(scene, tracks):
    dim(scene)
    fixed, free = tracks(blur_sigma_px=1.0), tracks(blur_sigma_px=1.0, shape="free")
    assert spread(fixed) < 0.97 * spread(free)
    scatter = [float(fits["intensity"].std() / fits["intensity"].mean()) for fits in (fixed, free)]
    assert scatter[0] < 0.8 * scatter[1]


def test_empty_places_are_taken_for_columns_at_the_stated_rate_by_either_shape(scene, tracks):
    dim(scene)
    here = np.ones((scene.n_frames, len(scene.place)), bool)
    here[:, ::2] = False
    fixed, free = (found(tracks(present=here, blur_sigma_px=1.0, shape=shape)) for shape in ("fixed", "free"))
    for judged in (fixed, free):
        assert judged[~here].mean() <= 0.07  # 5 % are stated
        assert judged[here].mean() >= 0.99


def test_likelihood_reaches_the_bound_where_contrast_is_high(scene, tracks):
    bright(scene)
    likely, least = (spread(tracks(estimator=name)) for name in ("poisson", "lsq"))
    assert likely <= 1.06 * bound(scene)[1:3].mean()
    assert likely < 0.97 * least


def test_likelihood_measures_columns_as_they_are_without_the_blur(scene, tracks):
    bright(scene)
    for shape in ("free", "fixed"):
        mean = tracks(estimator="poisson", shape=shape)["fit"].mean(("frame", "column_id"))
        for name in ("amplitude", "sigma_a", "sigma_b"):
            assert mean.sel(parameter=name).item() == pytest.approx(getattr(scene, name), rel=0.02), shape


def test_likelihood_of_counts_on_an_offset_is_least_squares(scene, tracks):
    bright(scene)
    assert spread(tracks(estimator="poisson", offset=100.0)) <= 1.02 * spread(tracks(blur_sigma_px=0.0))


def test_negative_pixels_cannot_be_counts(scene, tracks):
    with pytest.raises(SettingsError, match="a pixel is negative"):
        tracks(estimator="poisson", offset=-50.0)


@pytest.mark.parametrize("estimator", ["lsq", "poisson"])
@pytest.mark.parametrize("light", [dim, bright])
def test_standard_errors_are_those_of_the_scatter(scene, tracks, estimator, light):
    light(scene)
    fits = tracks(estimator=estimator, blur_sigma_px=1.0)
    errors = {name: fits["stderr"].sel(parameter=name) for name in ("x", "y", "amplitude")}
    values = {name: fits["fit"].sel(parameter=name) for name in errors}
    values["intensity"], errors["intensity"] = fits["intensity"], fits["intensity_stderr"]
    for name, value in values.items():
        pull = (value - value.mean("frame")) / errors[name]
        assert float(pull.std()) == pytest.approx(1.0, abs=PULLS), name


def test_a_fixed_shape_is_that_of_the_summed_image(scene, tracks):
    fits = tracks(blur_sigma_px=2.0)
    reference = scene.columns()["fit_ref"].to_numpy()
    np.testing.assert_allclose(
        fits["fit"][..., 3:6], np.broadcast_to(reference[:, 3:6], (12, *reference[:, 3:6].shape))
    )
    assert fits["stderr"][..., 3:6].isnull().all()
    assert (fits["status"] == 0).mean() > 0.99


def spots(size: int, n: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Counts in windows of one size, and the true parameters."""
    rng = np.random.default_rng(size)
    truth = np.tile([40.0, size // 2, size // 2, size / 7, size / 9, 0.4, 15.0], (n, 1))
    truth[:, 1:3] += rng.uniform(-1.5, 1.5, (n, 2))
    return rng.poisson(gaussian_image(truth, (size, size))).astype(np.float32), truth


@pytest.mark.parametrize("size", [12, 19, 43, 61])
def test_a_round_window_is_fitted_as_scipy_fits_its_pixels(size):
    windows, truth = spots(size)
    inside = np.hypot(*(np.mgrid[:size, :size] - size // 2)) <= size / 2.5
    fits = fit_gaussians(windows, truth, *limits(truth), radius_px=size / 2.5)
    for k, window in enumerate(windows):
        model = partial(gaussian_image, shape=window.shape)
        best = least_squares(lambda p, model=model, window=window: (model(p) - window)[inside], truth[k], xtol=1e-12)
        np.testing.assert_allclose(fits.estimates[k, 1:3], best.x[1:3], atol=1e-3)
        spread = ((window[inside] - window[inside].mean()) ** 2).sum()
        assert fits.r_squared[k] == pytest.approx(1 - 2 * best.cost / spread, abs=1e-4)


@pytest.mark.parametrize("estimator", ["lsq", "poisson"])
@pytest.mark.parametrize("fixed_shape", [True, False])
def test_pixels_outside_a_round_window_do_not_matter(estimator, fixed_shape):
    windows, truth = spots(43)
    outside = np.hypot(*(np.mgrid[:43, :43] - 21)) > 43 / 2
    other = np.where(outside, windows[:, ::-1, ::-1] + 9, windows)
    one, two = (
        fit_gaussians(w, truth, *limits(truth), estimator=estimator, fixed_shape=fixed_shape, radius_px=43 / 2)
        for w in (windows, other)
    )
    np.testing.assert_allclose(one.estimates, two.estimates, atol=5e-3)
    np.testing.assert_allclose(one.estimates[:, 1:3], two.estimates[:, 1:3], atol=2e-4)
    np.testing.assert_allclose(one.stderr, two.stderr, rtol=5e-3)


def limits(truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wide bounds around the truth."""
    reach = np.array([39.0, 6, 6, 0, 0, 0, 14])
    lower, upper = truth - reach, truth + 10 * reach
    lower[:, 3:5], upper[:, 3:5] = 1, 60
    return lower, upper
