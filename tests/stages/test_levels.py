"""Noise at the columns' own level, and how many places without a column pass: on made crystals of known truth."""

import numpy as np
import pytest

from benchmarks.science.made import Made
from tract_dask.analysis.presence import present
from tract_dask.settings import FitSettings
from tract_dask.stages.fit.levels import Vacuum, noise_at_columns
from tract_dask.store.results import accepted
from tract_dask.store.schema import REJECTED

CRYSTAL = Made(amplitude=3.0, background=6.4, sigma_px=4.0, vacuum=0.3, side=12)


@pytest.mark.parametrize(
    ("made", "settings"),
    [
        (CRYSTAL, {}),
        (CRYSTAL, {"estimator": "poisson"}),
        (CRYSTAL, {"shape": "free"}),
        (CRYSTAL, {"vacuum_box": None}),
        (Made(amplitude=6.0, background=6.4, sigma_px=2.0, vacuum=1.6, side=12), {}),
    ],
    ids=["brighter than vacuum", "poisson", "free shape", "without vacuum", "darker than vacuum"],
)
def test_empty_places_pass_at_the_stated_rates(made, settings, tmp_path):
    """Of 580 places, 5 % of fits, 10 and 1 % of `present`: to 2 points and 2 standard errors; the noise to 5 %."""
    there = np.random.default_rng(3).random((10, made.n_columns)) < 0.6
    tracks = made.tracks(tmp_path, np.zeros((*there.shape, 2)), there, **settings)
    empty = ~there

    def within(share, level):
        return abs(share - level) <= 0.02 + 2 * np.sqrt(level * (1 - level) / empty.sum())

    good = (tracks["status"].to_numpy() & np.uint8(REJECTED)) == 0
    assert within(good[empty].mean(), 0.05)
    for rate in (0.1, 0.01):
        assert within(present(tracks, rate).to_numpy()[empty].mean(), rate)
    assert good[there].mean() >= 0.98
    true = np.sqrt(made.background) / (2 * np.sqrt(np.pi) * 2.0)
    np.testing.assert_allclose(tracks["noise"].mean(), true, rtol=0.05)
    again = accepted(tracks, FitSettings().threshold)["status"]
    np.testing.assert_array_equal(again, tracks["status"])


def test_levels_that_do_not_tell_the_noise_are_not_known():
    """A vacuum whose background was subtracted; noise that does not grow with the level is the same everywhere."""
    estimates = np.ones((3, 2, 7))
    reference = np.ones((2, 7))
    reference[1, 6] = 4.0
    estimates[:, 1, 6] = 4.0
    vacuum = Vacuum(np.full(3, 0.5), np.array([1.0, 0.001, -0.2]))
    found = noise_at_columns(vacuum, estimates, reference, FitSettings())
    np.testing.assert_allclose(found, [[0.5, 1.0], [np.nan, np.nan], [np.nan, np.nan]])
    same = noise_at_columns(vacuum, estimates, reference, FitSettings(counting=False))
    np.testing.assert_allclose(same, 0.5)
