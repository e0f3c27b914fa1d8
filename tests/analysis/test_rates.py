"""Rates of hops: the hidden Markov model against all paths, and its intervals against made columns."""

from itertools import product

import numpy as np
import pytest
import xarray as xr
from test_motion import still, tracks_of

from tract_dask.analysis.jumps import change_points, jump_rate
from tract_dask.analysis.rates import hop_rate
from tract_dask.kernels.hops import hop_likelihoods


def hopping(n_frames, n_columns, apart, probabilities, seed=0):
    """Places (frame, column, axis) of columns on two sites, in units of their error; probabilities to leave them."""
    rng = np.random.default_rng(seed)
    a, b = probabilities
    state = rng.random(n_columns) < a / (a + b)
    places = rng.normal(size=(n_frames, n_columns, 2))
    for frame in range(n_frames):
        state = state ^ (rng.random(n_columns) < np.where(state, b, a)) if frame else state
        places[frame, :, 0] += apart * state
    return places


def test_the_likelihood_is_the_sum_over_all_paths():
    """With a frame that is missing; and the share of samples at each site."""
    values, weights = np.random.default_rng(1).normal(size=(6, 2)), np.full((6, 2), 0.7)
    gaps, sites, (a, b) = np.array([1, 1, 2, 1, 1, 1]), np.array([[0.0, 0.0], [0.6, -0.2]]), (0.4, 0.2)
    step = np.array([[1 - a, a], [b, 1 - b]])
    each = np.exp(-0.35 * ((values[:, None] - sites) ** 2).sum(axis=-1))
    total, second = 0.0, 0.0
    for path in product((0, 1), repeat=6):
        chance = np.array([b, a])[path[0]] / (a + b) * each[0, path[0]]
        for k in range(1, 6):
            chance *= np.linalg.matrix_power(step, gaps[k])[path[k - 1], path[k]] * each[k, path[k]]
        total, second = total + chance, second + chance * sum(path)
    logs, _, found = hop_likelihoods(values, weights, gaps, np.array([[a, b]]), sites, 0.0, 0)
    np.testing.assert_allclose(logs[0], [np.log(total), np.log(6 - second / total), np.log(second / total)], rtol=1e-9)
    np.testing.assert_array_equal(found[0], sites)


@pytest.mark.parametrize(("apart", "probabilities"), [(2.5, (0.1, 0.1)), (4.0, (0.1, 0.4)), (3.0, (0.3, 0.3))])
def test_intervals_hold_the_truth_as_often_as_stated(apart, probabilities):
    """Fast hops, small hops and unequal sites, in 40 frames: 95 %, to 2 points and 3 standard errors, or more."""
    n = 60
    places = hopping(40, n, apart, probabilities, seed=int(10 * apart)).transpose(1, 0, 2)
    found = np.array([hop_rate(p, np.ones((40, 2)), np.ones(40, np.int64), 0.95) for p in places])
    truth = 2 * np.prod(probabilities) / np.sum(probabilities)
    held = ((found[:, 1] <= truth) & (truth <= found[:, 2])).mean()
    assert held >= 0.93 - 3 * np.sqrt(0.05 * 0.95 / n)
    assert np.median(found[:, 0]) == pytest.approx(truth, rel=0.35)


def test_rates_of_tracks_come_from_the_model_where_it_holds():
    """Columns that hop have their rate; intervals of still ones begin at 0; jumps between many sites are counted."""
    places = 2.0 * hopping(60, 20, 6.0, (0.3, 0.3), seed=3) + 100.0 * np.arange(20)[:, None]
    places[:, 10:] = still(60, 20, seed=5)[:, 10:]
    places[:, 19] += np.repeat([0.0, 30.0, 80.0], 20)[:, None] * [1.0, 0.3]
    tracks = tracks_of(places)
    jumps = change_points(tracks)
    rate = jump_rate(jumps, tracks)
    assert rate["counted"].values.tolist() == [False] * 19 + [True]
    assert ((rate["low"] <= 3.0) & (rate["high"] >= 3.0))[:10].mean() >= 0.8
    assert (rate["low"][10:19] == 0).mean() >= 0.8
    assert rate["rate"][:10].median() == pytest.approx(3.0, rel=0.2)
    np.testing.assert_allclose(rate["smallest"][:10], 4.0, rtol=0.2)
    assert rate["rate"][19] == pytest.approx(2 / 5.9)
    by_hand = jump_rate(xr.Dataset({"column_id": ("jump", jumps["column_id"].values)}), tracks)
    assert by_hand["counted"].all()
