"""Touching columns: groups, their joint fits in frames, and what becomes of the others."""

from dataclasses import replace

import numpy as np
import pytest

from tract_dask import accepted, convert, find_columns, fit_columns, open_movie, sum_image
from tract_dask.kernels.gaussian.model import blurred, gaussian_image
from tract_dask.kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from tract_dask.kernels.windows import blur_variance
from tract_dask.settings import ColumnSettings, FitSettings
from tract_dask.stages.fit.groups import plan_groups
from tract_dask.stages.groups import groups_of
from tract_dask.store.columns import column_dataset, positions

SIGMA, CELL = 3.0, 40.0
BIAS_PX = 0.02  # of a mean over pairs and frames, with its own error: 0.006 px here
RATIO, PULL = 1.08, 0.08  # of 2400 positions


def columns_at(places, sigma=SIGMA):
    columns = np.zeros((len(places), 7))
    columns[:, [X, Y]], columns[:, AMPLITUDE], columns[:, 3:5], columns[:, BACKGROUND] = places, 60.0, sigma, 20.0
    return columns


def test_groups_are_connected_columns():
    chain = np.column_stack([np.arange(20) * 9.0, np.zeros(20)])
    chain[8:, 0] += 0.5  # farther apart than the others, and still touching
    far = np.array([[500.0, 0.0], [500.0, 60.0], [509.0, 60.0], [500.0, 120.0], [511.0, 120.0]])
    groups = groups_of(columns_at(np.concatenate([chain, far])))
    assert groups[20] == 0
    assert groups[21] == groups[22] > 0
    assert 0 < groups[23] != groups[24] > 0, "such neighbours are held"
    assert len(set(groups[:8])) == 1, "cut where it is widest"
    assert np.bincount(groups).max() <= 8
    assert (groups[:20] > 0).all()


def test_isolated_columns_have_no_groups():
    assert not groups_of(columns_at(np.array([[0, 0], [12.01, 0], [0, 40], [np.nan, 0]]))).any()
    assert plan_groups(np.zeros(3, np.int64), columns_at(np.zeros((3, 2))), 9, FitSettings()) == ()


class Pairs:
    """Pairs on a grid, each turned by another angle, that jitter from frame to frame; a row of them is alone."""

    def __init__(self, distance, n_frames=30, side=4, jitter=0.1, seed=0, amplitude=60.0):
        rng = np.random.default_rng(seed)
        y, x = np.mgrid[:side, :side].reshape(2, -1) * CELL + CELL
        turn = rng.uniform(0, np.pi, len(x))
        by = 0.5 * distance * SIGMA * np.column_stack([np.cos(turn), np.sin(turn)])
        centre = np.column_stack([x, y])
        self.places = np.stack([centre - by, centre + by], axis=1).reshape(-1, 2)
        self.alone = np.column_stack([x[:side], np.full(side, CELL * (side + 1))])
        self.shape = (int(CELL * (side + 2)), int(CELL * (side + 1)))
        still = np.concatenate([self.places, self.alone])
        self.truth = still + rng.normal(0, jitter, (n_frames, *still.shape))
        self.expected = [self._frame(places, amplitude) for places in self.truth]
        self.counts = rng.poisson(self.expected).astype(np.uint16)
        self.mean = columns_at(still)

    def _frame(self, places, amplitude):
        image = np.full(self.shape, 20.0)
        for x, y in places:
            rows, across = (slice(int(v) - 16, int(v) + 17) for v in (y, x))
            yy, xx = np.mgrid[rows, across]
            image[rows, across] += amplitude * np.exp(-((xx - x) ** 2 + (yy - y) ** 2) / (2 * SIGMA**2))
        return image

    def columns(self, blur=1.0, groups=True):
        """The true columns after a blur, with the true groups."""
        known = blurred(self.mean, blur_variance(blur))
        numbers = np.concatenate([np.repeat(np.arange(len(self.places) // 2) + 1, 2), np.zeros(len(self.alone))])
        found = column_dataset(self.mean[:, [X, Y]], fit=known, group=numbers if groups else None)
        found.attrs |= {"window_px": 19, "blur_sigma_px": blur}
        return found


@pytest.fixture(scope="module")
def movie_of(tmp_path_factory):
    def make(frames):
        folder = tmp_path_factory.mktemp("pairs")
        np.save(folder / "movie.npy", frames)
        return open_movie(convert(folder / "movie.npy", folder / "movie.zarr"))

    return make


@pytest.fixture(scope="module")
def pairs():
    return Pairs(2.4)


@pytest.fixture(scope="module")
def movie(pairs, movie_of):
    return movie_of(pairs.counts)


SETTINGS = FitSettings(refine_drift=False, blur_sigma_px=1.0)


@pytest.fixture(scope="module", params=["lsq", "poisson"])
def estimator(request):
    return request.param


@pytest.fixture(scope="module")
def tracks(movie, pairs, estimator):
    return fit_columns(movie, pairs.columns(), settings=replace(SETTINGS, estimator=estimator)).compute()


def errors_of(tracks, pairs):
    found = tracks["fit"].sel(parameter=["x", "y"]).to_numpy() - pairs.truth
    return np.where((tracks["status"].to_numpy() == 0)[..., None], found, np.nan)


def test_pairs_are_fitted_without_bias_and_know_their_errors(tracks, pairs):
    n = len(pairs.places)
    errors, stated = errors_of(tracks, pairs)[:, :n], tracks["stderr"].sel(parameter=["x", "y"]).to_numpy()[:, :n]
    assert np.isfinite(errors).mean() > 0.99
    along = pairs.places[1::2] - pairs.places[::2]
    along /= np.hypot(*along.T)[:, None]
    outward = np.einsum("fnk,nk->fn", errors[:, 1::2] - errors[:, ::2], along)
    assert abs(np.nanmean(outward)) < BIAS_PX, "members pull at each other"
    assert np.abs(np.nanmean(errors, axis=(0, 1))).max() < BIAS_PX
    assert np.nanstd(errors / stated) == pytest.approx(1, abs=PULL)
    intensity = tracks["intensity"].to_numpy()[:, :n]
    assert np.std((intensity - intensity.mean()) / tracks["intensity_stderr"].to_numpy()[:, :n]) < 1.15


def test_alone_each_would_be_pulled(movie, pairs):
    n = len(pairs.places)
    single = fit_columns(movie, pairs.columns(groups=False), settings=SETTINGS).compute()
    errors = single["fit"].sel(parameter=["x", "y"]).to_numpy()[:, :n] - pairs.truth[:, :n]
    along = pairs.places[1::2] - pairs.places[::2]
    along /= np.hypot(*along.T)[:, None]
    outward = np.einsum("fnk,nk->fn", errors[:, 1::2] - errors[:, ::2], along)
    assert abs(np.nanmean(outward)) > 5 * BIAS_PX


def test_isolated_columns_are_the_same_bit_for_bit(movie, pairs, tracks, estimator):
    """Errors and presence hold the noise of the frame, which all columns tell."""
    alone = replace(SETTINGS, estimator=estimator)
    single = fit_columns(movie, pairs.columns(groups=False), settings=alone).compute()
    n = len(pairs.places)
    for name in ("fit", "r_squared", "n_iterations", "centroid"):
        np.testing.assert_array_equal(tracks[name].to_numpy()[:, n:], single[name].to_numpy()[:, n:], err_msg=name)


def test_how_well_pairs_fit_is_known(tracks, pairs):
    """p-values are uniform where the model is right, and presence is that of a column that is there."""
    chance = tracks["p_value"].to_numpy()[:, : len(pairs.places) : 2].ravel()
    assert 0.35 < np.nanmean(chance) < 0.65
    assert (chance < 0.05).mean() < 0.12
    assert np.nanmin(tracks["presence"].to_numpy()) > 5


def test_a_member_that_is_away_is_seen_to_be_away(movie_of):
    pairs = Pairs(2.4, n_frames=16, seed=4)
    gone = pairs.truth.copy()
    without = pairs._frame(np.delete(gone[0], 0, axis=0), 60.0)
    frames = pairs.counts.copy()
    frames[8:] = np.random.default_rng(5).poisson(without, (8, *without.shape))
    tracks = fit_columns(movie_of(frames), pairs.columns(), settings=SETTINGS).compute()
    presence = tracks["presence"].to_numpy()[:, :2]
    assert presence[:8].min() > 5
    assert np.abs(presence[8:, 0]).mean() < 2
    assert presence[8:, 1].min() > 5


def test_groups_at_the_edge_and_missing_pixels(movie_of):
    pairs = Pairs(2.4, n_frames=6, seed=6)
    cut = int(pairs.places[:, 1].min()) - 10
    frames = pairs.counts[:, cut:].astype(np.float32)
    x, y = pairs.places[4].round().astype(int)
    frames[:, y - cut - 1, x + 2] = np.nan
    columns = pairs.columns()
    columns["y_ref"] = columns["y_ref"] - cut
    columns["fit_ref"][:, Y] -= cut
    tracks = fit_columns(movie_of(frames), columns, settings=replace(SETTINGS, blur_sigma_px=0.0)).compute()
    known = accepted(tracks)["fit"].sel(parameter=["x", "y"]).to_numpy() + np.array([0, cut])
    away = known - pairs.truth
    assert np.isfinite(away[:, : len(pairs.places)]).mean() > 0.95
    assert np.nanmax(np.abs(away)) < 1


def test_long_chains_are_cut_and_neighbours_held(movie_of):
    rng = np.random.default_rng(7)
    places = np.column_stack([20 + 9.0 * np.arange(12), np.full(12, 30.0)])
    y, x = np.mgrid[:60, :140]
    truth = places + rng.normal(0, 0.1, (30, 12, 2))
    expected = np.full((30, 60, 140), 20.0)
    for frame, own in zip(expected, truth, strict=True):
        for px, py in own:
            frame += 60 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * SIGMA**2))
    known = blurred(columns_at(places), 0.0)
    columns = column_dataset(places, fit=known, group=groups_of(known))
    columns.attrs |= {"window_px": 13, "blur_sigma_px": 0.0}
    assert len(set(columns["group"].to_numpy())) == 2
    movie = movie_of(rng.poisson(expected).astype(np.uint16))
    tracks = fit_columns(movie, columns, settings=replace(SETTINGS, blur_sigma_px=0.0)).compute()
    errors = tracks["fit"].sel(parameter=["x", "y"]).to_numpy() - truth
    bias = errors.mean(axis=0)
    assert np.abs(bias).max() < 5 * errors.std() / np.sqrt(30)


def test_given_pairs_are_grouped_and_their_shapes_are_right(pairs, movie):
    """Alone their windows hold both; together each has the width that it was made with."""
    truth = np.concatenate([pairs.places, pairs.alone])
    seeds = column_dataset(truth + np.random.default_rng(1).uniform(-0.5, 0.5, truth.shape))
    columns = find_columns(sum_image(movie), seeds=seeds)
    away = positions(columns) - truth
    assert np.abs(away[: len(pairs.places)]).max() < 0.2
    groups, n = columns["group"].to_numpy(), len(pairs.places)
    assert (groups[:n:2] == groups[1:n:2]).all()
    assert len(set(groups[:n])) == n // 2
    assert (groups[n:] == 0).all()
    widths = blurred(columns["fit_ref"].to_numpy(), -blur_variance(columns.attrs["blur_sigma_px"]))[:n, 3:5]
    np.testing.assert_allclose(np.sqrt(widths.prod(axis=1)), SIGMA, rtol=0.08)
    assert np.sqrt(widths.prod(axis=1)).mean() == pytest.approx(SIGMA, rel=0.01)
    assert columns.attrs["spacing_px"] == pytest.approx(CELL, rel=0.1)
    tracks = fit_columns(movie, columns, settings=FitSettings(refine_drift=False)).compute()
    assert (tracks["status"] == 0).mean() > 0.98
    outward = np.einsum(
        "fnk,nk->fn",
        (errors_of(tracks, pairs)[:, 1:n:2] - errors_of(tracks, pairs)[:, :n:2]),
        (truth[1:n:2] - truth[:n:2]) / np.hypot(*(truth[1:n:2] - truth[:n:2]).T)[:, None],
    )
    assert abs(np.nanmean(outward)) < 2 * BIAS_PX


@pytest.mark.parametrize("method", ["auto", "maxima"])
def test_both_columns_of_pairs_are_found(pairs, movie, method):
    """With defaults: both of each pair, no third, and those that are alone once."""
    columns = find_columns(sum_image(movie), ColumnSettings(method=method))
    truth = np.concatenate([pairs.places, pairs.alone])
    away = np.hypot(*(positions(columns)[:, None] - truth[None]).transpose(2, 0, 1))
    assert columns.sizes["column_id"] == len(truth)
    assert away.min(axis=0).max() < 0.3
    own = columns["group"].to_numpy()[away.argmin(axis=0)]
    n = len(pairs.places)
    assert (own[:n:2] == own[1:n:2]).all()
    assert (own[:n] > 0).all()
    assert (own[n:] == 0).all()


def test_long_columns_are_not_two(movie_of):
    """Columns 25 % longer than wide, and round ones: with noise, each stays one."""
    y, x = np.mgrid[20:200:30, 20:200:30].reshape(2, -1).astype(float)
    columns = np.zeros((len(x), 7))
    columns[:, [X, Y]] = np.column_stack([x, y])
    columns[:, AMPLITUDE], columns[:, 3], columns[:, 4], columns[:, 5] = 60.0, 4.0, 3.2, 0.4
    expected = gaussian_image(columns, (200, 200)).sum(axis=0) + 20
    frames = np.random.default_rng(3).poisson(expected, (20, 200, 200)).astype(np.uint16)
    found = find_columns(sum_image(movie_of(frames)))
    assert found.sizes["column_id"] == len(x)
    assert not found["group"].to_numpy().any()


def test_groups_that_are_larger_than_a_frame_are_fitted_together(movie_of):
    rng = np.random.default_rng(8)
    places = np.array([[7.4, 12.2], [15.8, 11.6]])
    truth = places + rng.normal(0, 0.1, (60, 2, 2))
    known = columns_at(places)
    moved = np.tile(known, (60, 1, 1))
    moved[..., [X, Y]] = truth
    expected = gaussian_image(moved, (24, 24)).sum(axis=1) - 20
    columns = column_dataset(places, fit=known, group=[1, 1])
    columns.attrs |= {"window_px": 15, "blur_sigma_px": 0.0}
    tracks = fit_columns(
        movie_of(rng.poisson(expected).astype(np.uint16)), columns, settings=replace(SETTINGS, blur_sigma_px=0.0)
    ).compute()
    errors = tracks["fit"].sel(parameter=["x", "y"]).to_numpy() - truth
    assert (tracks["status"] == 0).mean() > 0.95
    assert np.abs(np.nanmean(errors, axis=0)).max() < 3 * np.nanstd(errors) / np.sqrt(60)
