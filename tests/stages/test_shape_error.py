"""What all intensities of a column share, by the shape from the summed image: means over frames and their errors."""

import numpy as np
import pytest
from conftest import Scene

from tract_dask import convert, fit_columns, open_movie
from tract_dask.analysis.dose import fit_doses
from tract_dask.analysis.intensity import mean_intensity
from tract_dask.kernels.gaussian.fit import fit_gaussians
from tract_dask.kernels.gaussian.model import blurred, evaluate
from tract_dask.kernels.windows import blur, blur_variance
from tract_dask.settings import FitSettings
from tract_dask.stages.fit.noise_size import window_noise
from tract_dask.stages.fit.shape_error import _errors, shape_errors

PULL = 0.08
"""Errors of means over the frames, in units of the stated ones, have a root mean square this near to 1; 600 columns."""

COLUMNS, FRAMES, SIDE, HALO, SUMMED_BLUR = 600, 8, 13, 4, 1.0
TRUTH = np.array([60.0, 0.0, 0.0, 2.8, 2.3, 0.5, 20.0])


def windows(counts: np.ndarray, blur_px: float) -> np.ndarray:
    """Cut windows out of larger ones (n, y, x), after a blur."""
    soft = np.stack([blur(image, blur_px) for image in counts.astype(np.float32)]) if blur_px else counts
    return np.ascontiguousarray(soft[:, HALO:-HALO, HALO:-HALO], np.float32)


@pytest.fixture(scope="module")
def drawn() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Counts (columns, frames, y, x), true parameters in the windows, and free fits of the blurred means."""
    rng, size = np.random.default_rng(2), SIDE + 2 * HALO
    truth = np.tile(TRUTH, (COLUMNS, 1))
    truth[:, 1:3] = SIDE // 2 + rng.uniform(-0.5, 0.5, (COLUMNS, 2))
    expected = evaluate(truth + np.array([0, HALO, HALO, 0, 0, 0, 0]), np.arange(size), np.arange(size)[:, None])
    counts = rng.poisson(expected[:, None], (COLUMNS, FRAMES, size, size))
    far = np.array([1e9, 3, 3, 3, 3, 9, 1e9])
    fits = fit_gaussians(
        windows(counts.sum(axis=1), SUMMED_BLUR) / FRAMES,
        truth,
        truth - np.minimum(far, [1e9, 3, 3, 1.5, 1.5, 9, 1e9]),
        truth + far,
        blur_sigma_px=SUMMED_BLUR,
        radius_px=SIDE / 2,
    )
    return counts, truth, fits.estimates


@pytest.mark.parametrize(
    "settings", [{"blur_sigma_px": 1.0}, {"estimator": "poisson"}, {"blur_sigma_px": 0.5}], ids=str
)
def test_means_over_frames_are_as_far_from_the_truth_as_is_stated(drawn, settings):
    counts, truth, summed = drawn
    fit = FitSettings(**settings)
    shape = blurred(summed, blur_variance(fit.window_blur_px) - blur_variance(SUMMED_BLUR))
    start = np.repeat(shape, FRAMES, axis=0)
    room = np.array([1e9, 3, 3, 0, 0, 9, 1e9])
    fits = fit_gaussians(
        windows(counts.reshape(-1, *counts.shape[2:]), fit.window_blur_px),
        start,
        start - room,
        start + room,
        estimator=fit.estimator,
        fixed_shape=True,
        blur_sigma_px=fit.window_blur_px,
        radius_px=SIDE / 2,
        own_noise=False,
    )
    volume = 2 * np.pi * (fits.estimates[:, 0] * fits.estimates[:, 3] * fits.estimates[:, 4]).reshape(COLUMNS, FRAMES)
    of_one = np.sqrt((fits.volume_stderr**2).reshape(COLUMNS, FRAMES).mean(axis=1))
    of_one *= window_noise(shape, SIDE, fit).volume
    shared = shape_errors(shape, SIDE, (), fit, SUMMED_BLUR).intensity / np.sqrt(FRAMES)
    error = volume.mean(axis=1) - 2 * np.pi * truth[0, 0] * truth[0, 3] * truth[0, 4]
    stated = of_one * np.sqrt(1 / FRAMES + shared**2)
    assert np.sqrt(((error / stated) ** 2).mean()) == pytest.approx(1, abs=PULL)
    assert np.sqrt(((error / of_one) ** 2 * FRAMES).mean()) > 1.6  # without it they are far off


def test_tracks_state_it_and_means_carry_it(tmp_path, npy):
    scene = Scene(n_frames=8)
    movie = open_movie(convert(npy(scene.counts()), tmp_path / "movie.zarr"))
    summed, columns, drift = scene.summed(), scene.columns(), scene.drift_dataset()
    summed["exposure"][:] = 8
    summed["exposure"][:, :60] = 2
    fixed = fit_columns(movie, columns, drift, summed=summed).compute()
    shared = fixed["shape_error"]
    x = columns["x_ref"].to_numpy()
    seldom, often = (shared.to_numpy()[side].mean() for side in (x < 60, x > 60))
    assert seldom / often == pytest.approx(2, rel=0.05)
    free = fit_columns(movie, columns, drift, FitSettings(shape="free"), summed=summed)
    assert (free["shape_error"] == 0).all()
    pairs = fit_doses(movie, columns, drift, groups=[2], summed=summed)[0]
    np.testing.assert_allclose(pairs["shape_error"], np.sqrt(2) * shared, rtol=0.05)
    mean = mean_intensity(fixed)
    stated = np.sqrt((fixed["intensity_stderr"] ** 2).mean("frame"))
    np.testing.assert_allclose(mean["shape_stderr"].isel(frame=0), shared * stated)


def test_the_place_of_a_column_alone_does_not_depend_on_its_shape_and_that_of_touching_ones_does():
    """Along the line between two columns, and more the nearer they are; across it far less."""
    fit, blurs, inside = FitSettings(blur_sigma_px=1.0), (1.0, 1.0), np.ones((25, 37), bool)
    alone = np.array([[60.0, 18.0, 12.0, 2.8, 2.8, 0.0, 20.0]])
    assert np.abs(_errors(alone, inside, blurs, fit, None)[1:]).max() < 1e-3
    shared = []
    for apart in (5.6, 7.0, 8.4):
        pair = np.repeat(alone, 2, axis=0)
        pair[:, 1] += [-apart / 2, apart / 2 + 0.01]
        pair[1, 3:5] *= 1.02
        shared.append(_errors(pair, inside, blurs, fit, None)[1:].max(axis=1))
    along, across = np.array(shared).T
    assert (np.diff(along) < 0).all()
    assert (across < 0.3 * along).all()
