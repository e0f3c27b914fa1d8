"""Blobs of the summed image that are two columns: found by every method, told where one is missing, or too close."""

import numpy as np
import pytest
import xarray as xr
from scipy import ndimage

from tract_dask import find_columns
from tract_dask.kernels.gaussian.joint import fit_joint
from tract_dask.kernels.gaussian.model import evaluate, gaussian_image
from tract_dask.kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from tract_dask.settings import ColumnSettings
from tract_dask.stages.columns.group_fits import shared_by_pixels
from tract_dask.stages.columns.unresolved import blind_pairs, merged
from tract_dask.store.columns import column_dataset, positions

SIGMA, CELL, SIDE = 3.0, 21.0, 5
MOST_MISSED = 0.05  # one of 25


def crystal(distance, amplitudes=(1.0, 1.0), noise=0.0, shared_px=0.0, frames=1, seed=0):
    """A lattice of pairs ``distance`` sigma apart, or of single columns for 0: summed image, places (n, members, 2)."""
    rng = np.random.default_rng(seed)
    shape = (int(CELL * (SIDE + 1)), int(1.3 * CELL * (SIDE + 1)))
    y, x = np.mgrid[1 : SIDE + 1, 1 : SIDE + 1].reshape(2, -1) * CELL
    centre = np.column_stack([1.3 * x, y]) + 0.3
    half = 0.5 * distance * SIGMA * np.array([np.cos(0.3), np.sin(0.3)])
    places = centre[:, None] + (np.array([-1.0, 1.0])[:, None] * half if distance else np.zeros((1, 2)))
    places += rng.normal(0, 0.05 * SIGMA, places.shape)
    down, across = np.mgrid[: shape[0], : shape[1]]
    image = np.full(shape, 0.5)
    for pair in places:
        for (px, py), amplitude in zip(pair, amplitudes, strict=False):
            image += evaluate(np.array([amplitude, px, py, SIGMA, SIGMA, 0.0, 0.0]), across, down)
    grain = rng.normal(size=shape)
    if shared_px:
        grain = ndimage.gaussian_filter(grain, shared_px)
    image += noise * grain / grain.std()
    exposure = np.full(shape, frames, np.uint32)
    return xr.Dataset({"image": (("y", "x"), 1000 * image), "exposure": (("y", "x"), exposure)}), places


def found_share(columns, places):
    """Share of the groups of which each member has a column of its own."""
    away = np.hypot(*(positions(columns)[:, None] - places.reshape(-1, 2)[None]).transpose(2, 0, 1))
    near = (away.min(axis=0) < 0.9 * SIGMA).reshape(places.shape[:2])
    own = away.argmin(axis=0).reshape(places.shape[:2])
    distinct = np.array([len(set(row)) == len(row) for row in own.tolist()])
    return float((near.all(axis=1) & distinct).mean())


@pytest.mark.parametrize(("method", "shared_px"), [("auto", 0.0), ("auto", 1.0), ("maxima", 1.0), ("blobs", 0.0)])
def test_pairs_are_found_by_every_method(method, shared_px):
    image, places = crystal(2.6, (1.0, 0.8), 0.1, shared_px, seed=4)
    columns = find_columns(image, ColumnSettings(method=method, contrast="bright"))
    assert found_share(columns, places) >= 1 - MOST_MISSED
    away = np.hypot(*(positions(columns)[:, None] - places.mean(axis=1)[None]).transpose(2, 0, 1))
    assert (np.count_nonzero(away < 3 * SIGMA, axis=0) <= 2).all(), "no third"


@pytest.mark.parametrize(("noise", "shared_px"), [(0.02, 0.0), (0.15, 0.0), (0.1, 1.0)])
def test_single_columns_stay_single(noise, shared_px):
    image, places = crystal(0.0, (1.0,), noise, shared_px, seed=5)
    columns = find_columns(image, ColumnSettings(contrast="bright"))
    away = np.hypot(*(positions(columns)[:, None] - places[None, :, 0]).transpose(2, 0, 1))
    assert (np.count_nonzero(away < 4 * SIGMA, axis=0) == 1).all()
    assert not columns["group"].to_numpy().any()
    assert not columns["unresolved"].to_numpy().any()


def test_given_columns_that_are_one_of_two_are_told():
    image, places = crystal(2.8, noise=0.02, seed=6)
    every, half = places.reshape(-1, 2), places[:, 0]
    both = find_columns(image, ColumnSettings(contrast="bright"), seeds=column_dataset(every))
    assert both.attrs["one_of_two"] == []
    ids = np.arange(len(half)) + 11
    one = find_columns(image, ColumnSettings(contrast="bright"), seeds=column_dataset(half, column_id=ids))
    assert len(one.attrs["one_of_two"]) >= 0.95 * len(half)
    assert set(one.attrs["one_of_two"]) <= set(ids.tolist())


def test_pairs_that_one_frame_does_not_resolve_are_one_column():
    """The sum of 900 frames, in which noise is larger than a column: both are seen in the sum, and one is fitted."""
    image, places = crystal(1.9, noise=0.05, frames=900, seed=7)
    columns = find_columns(image, ColumnSettings(contrast="bright"))
    assert columns.sizes["column_id"] == len(places)
    assert columns["unresolved"].to_numpy().all()
    assert not columns["group"].to_numpy().any()
    away = np.hypot(*(positions(columns)[:, None] - places.mean(axis=1)[None]).transpose(2, 0, 1)).min(axis=1)
    assert away.max() < 0.2 * SIGMA
    resolved, _ = crystal(1.9, noise=0.05, frames=1, seed=7)
    columns = find_columns(resolved, ColumnSettings(contrast="bright"))
    assert not columns["unresolved"].to_numpy().any()
    assert columns.sizes["column_id"] == 2 * len(places)


def test_the_bound_of_pairs_is_that_of_their_joint_fit():
    """A pair is blind where the joint fit has errors, along the pair, of more than a quarter of the distance."""
    pair = np.array([[100.0, 14.0, 15.0, 3.0, 3.0, 0.0, 20.0], [80.0, 20.0, 15.0, 3.0, 3.0, 0.0, 20.0]])
    window = gaussian_image(pair, (31, 35)).sum(axis=0) - 20
    y, x = np.mgrid[:31, :35]
    mask = np.any([np.hypot(x - c[X], y - c[Y]) <= 12 for c in pair], axis=0)[None]
    bounds = np.full((1, 2, 7), np.inf)
    none = np.zeros(1, np.int64)
    fit = fit_joint(window[None].astype(np.float32), mask, none, pair[None], -bounds, bounds, counting=False)
    limit = 0.25 * 6.0 / fit.stderr[0, :, X].max()
    for noise, blind in ((0.97 * limit, []), (1.03 * limit, [(0, 1)])):
        assert blind_pairs(pair, np.array([1, 1]), noise, 24, 0.0) == blind


def test_one_column_for_two_has_their_volume_and_moments():
    pair = np.array([[100.0, 14.0, 15.0, 3.0, 2.5, 0.3, 20.0], [80.0, 19.0, 12.0, 3.0, 3.0, 0.0, 20.0]])
    alone = np.array([50.0, 60.0, 60.0, 3.0, 3.0, 0.0, 20.0])
    columns, first, several = merged(np.vstack([pair, alone]), [(0, 1)])
    assert first.tolist() == [0, 2]
    assert several.tolist() == [True, False]
    np.testing.assert_array_equal(columns[1], alone)
    y, x = np.mgrid[-30:60, -30:60]
    with_no_background = np.where(np.arange(7) == BACKGROUND, 0, np.vstack([columns[:1], pair]))
    one, *two = evaluate(with_no_background, x, y)
    both = np.sum(two, axis=0)
    assert one.sum() == pytest.approx(both.sum(), rel=1e-3)
    for weight in (x, y, x * x, x * y, y * y):
        assert (weight * one).sum() == pytest.approx((weight * both).sum(), rel=2e-3)
    assert columns[0, AMPLITUDE] < 180


def test_noise_that_pixels_share_calls_for_no_shapes_of_their_own():
    """Members of one shape mostly keep one; where pixels are taken for independent two of three pairs have two."""
    image, _ = crystal(1.8, noise=0.1, shared_px=1.0, seed=3)
    columns = find_columns(image, ColumnSettings(contrast="bright"))
    fits = columns["fit_ref"].to_numpy()[columns["group"].to_numpy() > 0]
    assert len(fits) >= 40
    sigmas = fits[:, 3:5].reshape(-1, 2, 2)
    assert (np.ptp(sigmas, axis=1) == 0).all(axis=1).mean() > 0.8


@pytest.mark.parametrize("blur_px", [0.0, 1.0, 2.0])
def test_how_far_pixels_share_noise_is_measured(blur_px):
    noise = np.random.default_rng(5).normal(size=(40, 41, 45))
    left = ndimage.gaussian_filter(noise, (0, blur_px, blur_px))
    found = shared_by_pixels(left, np.ones(left.shape, bool), 4 + round(3 * blur_px))
    assert found == pytest.approx(max(4 * np.pi * blur_px**2, 1.0), rel=0.1)
