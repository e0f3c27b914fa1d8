"""Stated errors are true in windows of every size: the noise's size comes from all windows of a frame."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import xarray as xr

from tract_dask import convert, fit_columns, open_movie
from tract_dask.settings import FitSettings
from tract_dask.stages.fit.goodness import Freedom, freedom, p_values
from tract_dask.stages.fit.noise_size import FEWEST_DEGREES, frame_noise, window_noise
from tract_dask.store.columns import column_dataset

PULL = 0.05
"""Errors in units of the stated ones have a root mean square this near to 1, of 2000 fits."""

UNIFORM = 0.06
"""Largest distance of p-values' distribution from a uniform one, 2000 fits (their scatter alone makes 0.03)."""

SIGMA = 0.15
"""Of a column, in units of the spacing."""


class Row(NamedTuple):
    """Columns on a square lattice: spacing in px, height and background in counts, settings of the fit."""

    spacing: float
    height: float
    background: float
    settings: dict[str, Any]


def fitted(
    row: Row, folder: Path, side: int = 5, fits: int = 2000, beside: dict[int, float] | None = None
) -> tuple[xr.Dataset, np.ndarray]:
    """Fit columns that jitter by 0.2 px by themselves; return the fits and where the columns are.

    ``beside`` are numbers of columns that have another one of half their height, so many px to the right.
    """
    rng, sigma = np.random.default_rng(int(row.spacing)), SIGMA * row.spacing
    line = (np.arange(side) + 1.25) * row.spacing
    sites = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2) + 0.37
    places = sites + rng.normal(0, 0.2, (-(-fits // side**2), *sites.shape))
    along = np.arange(int((side + 1.5) * row.spacing))
    across, down = (np.exp(-0.5 * ((along - places[..., k, None]) / sigma) ** 2) for k in (0, 1))
    expected = row.background + row.height * np.einsum("fcy,fcx->fyx", down, across)
    for column, aside in (beside or {}).items():
        shifted = np.exp(-0.5 * ((along - places[:, column, 0, None] - aside) / sigma) ** 2)
        expected += 0.5 * row.height * np.einsum("fy,fx->fyx", down[:, column], shifted)
    np.save(folder / "movie.npy", rng.poisson(expected).astype("u2"))
    movie = open_movie(convert(folder / "movie.npy", folder / "movie.zarr"))
    truth = np.array([[row.height, x, y, sigma, sigma, 0, row.background] for x, y in sites])
    columns = column_dataset(sites, [""] * len(sites), np.arange(1, len(sites) + 1), truth)
    columns.attrs |= {"spacing_px": row.spacing, "blur_sigma_px": 0.0}
    return fit_columns(movie, columns, None, FitSettings(**row.settings)).compute(), places


BRIGHT, DARK, MODEST = (30.0, 10.0), (-50.0, 100.0), (20.0, 20.0)


@pytest.mark.parametrize(
    "row",
    [
        *(Row(spacing, *BRIGHT, {"blur_sigma_px": min(2.0, 0.06 * spacing)}) for spacing in (12, 16, 24, 36, 80)),
        *(Row(spacing, *DARK, {"blur_sigma_px": min(2.0, 0.06 * spacing)}) for spacing in (16, 36)),
        *(Row(spacing, *MODEST, {"estimator": "poisson"}) for spacing in (16, 36)),
        *(Row(spacing, *BRIGHT, {"estimator": name}) for spacing in (5.4, 8.0) for name in ("lsq", "poisson")),
        Row(24, *BRIGHT, {"blur_sigma_px": 2.0}),
        Row(36, *BRIGHT, {"filter": "none"}),
    ],
    ids=str,
)
def test_errors_of_places_and_intensities_are_as_stated(row, tmp_path):
    fits, places = fitted(row, tmp_path)
    stated = fits["stderr"].sel(parameter=["x", "y"]).to_numpy()
    pulls = (fits["fit"].sel(parameter=["x", "y"]).to_numpy() - places) / stated
    intensity = fits["intensity"].to_numpy()
    of_intensity = (intensity - intensity.mean()) / fits["intensity_stderr"].to_numpy()
    assert np.sqrt((pulls**2).mean()) == pytest.approx(1, abs=PULL)
    assert np.sqrt((of_intensity**2).mean()) == pytest.approx(1, abs=1.5 * PULL)


@pytest.mark.parametrize(
    "row",
    [
        Row(24, *BRIGHT, {"blur_sigma_px": 1.44}),
        Row(36, *DARK, {}),
        Row(24, 3.0, 1.0, {"filter": "none"}),
        Row(24, 3.0, 1.0, {"estimator": "poisson"}),
    ],
    ids=str,
)
def test_p_values_of_true_gaussians_are_uniform(row, tmp_path):
    fits, _ = fitted(row, tmp_path)
    found = np.sort(fits["p_value"].to_numpy().ravel())
    assert np.abs(found - (np.arange(found.size) + 0.5) / found.size).max() < UNIFORM
    assert (found < 0.001).mean() < 0.006


def test_p_values_tell_a_column_that_is_two(tmp_path):
    """A second column of half the height, two sigmas aside, which the table does not know."""
    row, aside = Row(24, *BRIGHT, {"blur_sigma_px": 1.44}), 2 * SIGMA * 24
    fits, _ = fitted(row, tmp_path, beside={6: aside, 18: aside})
    share = (fits["p_value"] < 0.01).mean("frame").to_numpy()
    assert share[[6, 18]].min() > 0.9
    assert np.delete(share, [6, 18]).max() < 0.15


@pytest.mark.parametrize(("size", "blur", "psf"), [(21, 2.0, 0.0), (15, 0.0, 0.8), (15, 1.5, 1.0)])
def test_p_values_are_uniform_where_pixels_share_noise(size, blur, psf):
    """4,000 residuals of drawn noise: 0.5 to 2 % below 1 %, and 4 to 6 % below 5 % and above 95 %."""
    from scipy.ndimage import gaussian_filter1d

    lag, wide = np.arange(-6, 7), np.hypot(3.5, blur)
    shared = np.exp(-(lag[:, None] ** 2 + lag**2) / (4 * psf**2)) if psf else None
    settings = FitSettings(counting=False, filter="gaussian" if blur else "none", blur_sigma_px=blur or 2.0)
    free = freedom(np.array([1.0, 0, 0, wide, wide, 0, 0]), size, settings, shared)
    images = np.random.default_rng(2).normal(size=(4000, size + 16, size + 16)).astype(np.float32)
    for sigma in (blur, psf):
        for axis in (1, 2) if sigma else ():
            images = gaussian_filter1d(images, sigma, axis=axis)
    y, x = np.indices((size, size)) - size // 2
    disc = np.hypot(y, x) <= size / 2
    shape = np.exp(-(y**2 + x**2) / (2 * wide**2))
    basis = np.linalg.qr(np.stack([shape, np.ones_like(shape), x * shape, y * shape])[:, disc].T)[0]
    pixels = images[:, 8:-8, 8:-8][:, disc]
    squares = (pixels**2).sum(axis=1) - ((pixels @ basis) ** 2).sum(axis=1)
    level = np.full(len(squares), np.inf)
    found = p_values(squares[None] / squares.mean(), np.ones(1), np.ones(4000), level, free, np.array([10**6]))
    assert 0.005 < (found < 0.01).mean() < 0.02
    assert (found < 0.05).mean() == pytest.approx(0.05, abs=0.01)
    assert (found > 0.95).mean() == pytest.approx(0.05, abs=0.01)


def test_a_free_shape_on_its_bound_states_no_error_of_its_intensity(tmp_path):
    fits, places = fitted(Row(16, *BRIGHT, {"shape": "free", "blur_sigma_px": 0.96}), tmp_path)
    bound = (fits["status"].to_numpy() & 32) > 0
    assert bound.any()
    assert np.isnan(fits["intensity_stderr"].to_numpy()[bound]).all()
    pulls = (fits["fit"].sel(parameter=["x", "y"]).to_numpy() - places) / fits["stderr"].sel(parameter=["x", "y"])
    assert float(np.sqrt((pulls**2).mean())) == pytest.approx(1, abs=PULL)


def test_errors_of_intensities_of_free_shapes_are_true_in_the_mean(tmp_path):
    """Each goes with its own estimate (a faint one states a small error), so their mean square is what holds."""
    fits, _ = fitted(Row(36, *BRIGHT, {"shape": "free"}), tmp_path)
    good = (fits["status"].to_numpy() == 0) & np.isfinite(fits["intensity_stderr"].to_numpy())
    intensity, error = (fits[name].to_numpy()[good] for name in ("intensity", "intensity_stderr"))
    assert good.mean() > 0.99
    assert intensity.std() / np.sqrt((error**2).mean()) == pytest.approx(1, abs=PULL)


def test_the_size_of_the_noise_is_that_of_most_windows():
    rng = np.random.default_rng(1)
    ratio = 2.5 * rng.chisquare(12, (40, 60)) / 12 * 0.6
    ratio[:, ::12] *= 9  # columns with a neighbour that the model does not know
    size, number = frame_noise(ratio, np.ones(ratio.shape, bool), np.full(60, 0.6), Freedom(12.0, 12.0, 0.0))
    assert (number == 60).all()
    assert size.mean() == pytest.approx(2.5, rel=0.1)


def test_a_few_degrees_of_freedom_do_not_tell_the_size():
    ratio, few, many = np.ones((1, 2)), *(Freedom(k, k, 0.0) for k in (FEWEST_DEGREES / 2.1, 50.0))
    assert np.isnan(frame_noise(ratio, np.ones((1, 2), bool), np.ones(2), few)[0]).all()
    assert np.isnan(frame_noise(ratio, np.zeros((1, 2), bool), np.ones(2), many)[0]).all()


def test_degrees_of_freedom_are_those_of_the_residual():
    """Against simulated noise: twice the squared mean of a sum of squares over its variance."""
    from scipy.ndimage import gaussian_filter

    size, blur, rng = 15, 1.5, np.random.default_rng(0)
    reference = np.array([[30.0, 0, 0, 3.4, 3.0, 0.3, 10.0]])
    noise = window_noise(reference, size, FitSettings(blur_sigma_px=blur, counting=False))
    images = gaussian_filter(rng.normal(size=(4000, size + 14, size + 14)), (0, blur, blur))[:, 7:-7, 7:-7]
    y, x = np.indices((size, size)) - size // 2
    disc = np.hypot(y, x) <= size / 2
    shape = np.exp(
        -0.5 * (((x * np.cos(0.3) - y * np.sin(0.3)) / 3.4) ** 2 + ((x * np.sin(0.3) + y * np.cos(0.3)) / 3.0) ** 2)
    )
    slopes = np.stack([shape, np.ones(shape.shape), *np.gradient(shape)])[:, disc]
    basis = np.linalg.qr(slopes.T)[0]
    pixels = images[:, disc]
    squares = (pixels**2).sum(axis=1) - ((pixels @ basis) ** 2).sum(axis=1)
    assert noise.free.degrees == pytest.approx(2 * squares.mean() ** 2 / squares.var(), rel=0.1)
    assert noise.free.median == pytest.approx(np.median(squares) / squares.mean(), rel=0.01)
    assert noise.left[0] == pytest.approx(squares.mean() / (pixels**2).sum(axis=1).mean(), rel=0.03)
