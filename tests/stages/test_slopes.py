"""Places of columns on a background that rises."""

import numpy as np
import pytest
import xarray as xr
from scipy.spatial import cKDTree

from tract_dask.kernels.gaussian.fit import fit_gaussians
from tract_dask.kernels.gaussian.model import blurred, evaluate
from tract_dask.kernels.windows import blur_variance
from tract_dask.stages.columns.find import find_columns
from tract_dask.stages.columns.slopes import background_slopes, drawn_by_slopes, without_slopes

WINDOW, SIGMA, HEIGHT = 21, 5.0, 2.0


def _lattice(n=6, spacing=40.0):
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    return spacing * np.stack([i.ravel() + j.ravel() / 2, j.ravel() * np.sqrt(0.75)], axis=1) + 40


def _fits(places, level, height=HEIGHT, wide=(SIGMA, SIGMA, 0.0)):
    """Fits of Equation 1, with the widths known, to columns on the background ``level`` (x, y), without noise."""
    half = WINDOW // 2
    corner = np.rint(places).astype(int) - half
    truth = np.column_stack([np.full(len(places), height), places, np.tile([*wide, 0.0], (len(places), 1))])
    y, x = np.mgrid[:WINDOW, :WINDOW]
    windows = np.stack(
        [
            evaluate(own, x + left, y + top) + level(x + left, y + top)
            for own, (left, top) in zip(truth, corner, strict=True)
        ]
    ).astype(np.float32)
    start = truth.copy()
    start[:, 1:3] -= corner
    start[:, 6] = windows.mean(axis=(1, 2))
    reach = np.array([5.0, 5, 5, 5, 5, 1, 50])
    found = fit_gaussians(windows, start, start - reach, start + reach, fixed_shape=True, radius_px=WINDOW / 2)
    fit = found.estimates.copy()
    fit[:, 1:3] += corner
    return fit


@pytest.mark.parametrize("height", [HEIGHT, -HEIGHT])
def test_columns_are_put_back_down_a_slope(height):
    """Columns are drawn by 0.7 px up the slope, or down it where they are dark; what is left is below 0.03 px."""
    places = _lattice()
    fit = _fits(places, lambda x, y: 8 + 0.02 * x - 0.01 * y, height)
    off = fit[:, 1:3] - places
    assert abs(off[:, 0]).min() > 0.6
    np.testing.assert_allclose(drawn_by_slopes(fit, WINDOW), off, atol=0.03)


def test_no_slope_is_seen_in_an_even_background_nor_in_one_that_differs_from_column_to_column():
    places = _lattice()
    assert not background_slopes(places, np.full(len(places), 8.0)).any()
    kinds = np.where(np.arange(len(places)) % 2, 8.0, 9.0)
    assert not background_slopes(places, kinds + np.random.default_rng(1).normal(0, 0.05, len(places))).any()


def test_slopes_need_columns_around():
    places = _lattice()
    level = 8 + 0.02 * places[:, 0]
    np.testing.assert_allclose(background_slopes(places, level), np.tile([0.02, 0], (len(places), 1)), atol=1e-9)
    assert not background_slopes(places[:8], level[:8]).any()
    level[9:] = np.nan
    found = background_slopes(places, level)
    np.testing.assert_allclose(found[:9, 0], 0.02, atol=1e-9)
    assert not found[9:].any()
    in_a_row = np.column_stack([40.0 * np.arange(12), np.full(12, 7.0)])
    np.testing.assert_allclose(background_slopes(in_a_row, 0.02 * in_a_row[:, 0])[:, 0], 0.02, atol=1e-9)


def test_an_image_loses_a_background_that_rises_and_nothing_else():
    """Less than 5 % of what rises is left; the planes flatten its curve. An even image is the same object."""
    places = _lattice()
    y, x = np.mgrid[:230, :300].astype(float)
    rising = 8 + 0.02 * x - 0.01 * y + 5e-5 * x**2
    fit = np.zeros((len(places), 7))
    fit[:, 1:3] = places
    fit[:, 6] = 8 + 0.02 * places[:, 0] - 0.01 * places[:, 1] + 5e-5 * places[:, 0] ** 2
    inside = (slice(60, 170), slice(100, 220))
    assert np.ptp(without_slopes(rising, fit, 40.0)[inside]) < 0.05 * np.ptp(rising[inside])
    fit[:, 6] = 8.0
    assert without_slopes(rising, fit, 40.0) is rising


@pytest.mark.parametrize(("curve", "off_px", "share"), [(0.0, 0.01, 0.005), (5e-5, 0.45, 0.07)])
def test_columns_of_the_sum_are_as_wide_on_a_slope_as_on_even_ground(curve, off_px, share):
    """One background for a window made volumes 1.4 times too large on a plane, 2.6 times on the curved background."""
    places = _lattice(5)
    y, x = np.mgrid[:220, :330].astype(float)
    image = 6 + 0.02 * x - 0.01 * y + curve * x**2
    for column in places:
        image += HEIGHT * np.exp(-((x - column[0]) ** 2 + (y - column[1]) ** 2) / (2 * SIGMA**2))
    exposure = np.full(image.shape, 30, np.uint32)
    found = find_columns(xr.Dataset({"image": (("y", "x"), image), "exposure": (("y", "x"), exposure)}))
    away, which = cKDTree(np.stack([found["x_ref"], found["y_ref"]], axis=1)).query(places)
    assert away.max() < off_px
    fit = blurred(found["fit_ref"].to_numpy()[which].astype(float), -blur_variance(found.attrs["blur_sigma_px"]))
    wide, own = np.sqrt(fit[:, 3] * fit[:, 4]), places
    np.testing.assert_allclose(wide, SIGMA, rtol=share / 2 + 0.001)
    np.testing.assert_allclose(fit[:, 0] * wide**2, HEIGHT * SIGMA**2, rtol=share)
    np.testing.assert_allclose(fit[:, 6], 6 + 0.02 * own[:, 0] - 0.01 * own[:, 1] + curve * own[:, 0] ** 2, rtol=0.02)
