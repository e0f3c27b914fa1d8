"""Noise at the columns' own level, and how many places without a column pass: on made crystals of known truth."""

import numpy as np
import pytest

from benchmarks.science.made import Made
from tract_dask import convert, fit_columns, open_movie
from tract_dask.analysis.presence import present
from tract_dask.settings import FitSettings, MetadataSettings
from tract_dask.stages.columns.window_size import default_blur
from tract_dask.stages.fit.levels import Vacuum, noise_at_columns
from tract_dask.store.camera import Camera
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

    good = (tracks["status"].to_numpy() & np.uint16(REJECTED)) == 0
    assert within(good[empty].mean(), 0.05)
    for rate in (0.1, 0.01):
        assert within(present(tracks, rate).to_numpy()[empty].mean(), rate)
    assert good[there].mean() >= 0.98
    true = np.sqrt(made.background) / (2 * np.sqrt(np.pi) * default_blur(made.sigma_px))
    np.testing.assert_allclose(tracks["noise"].mean(), true, rtol=0.05)
    again = accepted(tracks, FitSettings().threshold)["status"]
    np.testing.assert_array_equal(again, tracks["status"])


def test_what_a_camera_spreads_passes_at_the_stated_rate(tmp_path):
    """Neighbours share noise (a Gaussian of 1 px): of 2,000 places without a column 5 % pass, to 2 points."""
    lag = np.arange(-4, 5)
    shared = np.exp(-(lag[:, None] ** 2 + lag**2) / 4)
    made = Made(amplitude=3.0, background=6.4, side=10, psf_px=1.0)
    camera = Camera(correlation=tuple(map(tuple, shared.tolist())))
    still = np.zeros((20, made.n_columns, 2))
    tracks = made.tracks(tmp_path, still, np.zeros(still.shape[:2], bool), camera=camera)
    good = (tracks["status"].to_numpy() & np.uint16(REJECTED)) == 0
    assert good.mean() == pytest.approx(0.05, abs=0.02)


def test_an_offset_is_no_level_of_the_vacuum(scene, npy, tmp_path):
    """The same counts on an offset of 100 have the same noise, strength and status."""
    found = []
    for offset in (0, 100):
        metadata = MetadataSettings(offset=float(offset))
        path = convert(npy(scene.counts() + offset), tmp_path / f"{offset}.zarr", metadata=metadata)
        settings = FitSettings(vacuum_box=(4, 40, 8, 136))
        found.append(fit_columns(open_movie(path), scene.columns(), scene.drift_dataset(), settings).compute())
    for name in ("noise", "presence", "status"):
        np.testing.assert_allclose(found[1][name], found[0][name], rtol=1e-3)


def test_levels_that_do_not_tell_the_noise_are_not_known():
    """A vacuum whose background was subtracted; noise that does not grow with the level is the same everywhere."""
    estimates = np.ones((3, 2, 7))
    reference = np.ones((2, 7))
    reference[1, 6] = 4.0
    estimates[:, 1, 6] = 4.0
    vacuum = Vacuum(np.full(3, 0.5), np.array([1.0, 0.001, -0.2]))
    found = noise_at_columns(vacuum, estimates, reference, FitSettings(blur_sigma_px=2.0))
    np.testing.assert_allclose(found, [[0.5, 1.0], [np.nan, np.nan], [np.nan, np.nan]])
    same = noise_at_columns(vacuum, estimates, reference, FitSettings(counting=False, blur_sigma_px=2.0))
    np.testing.assert_allclose(same, 0.5)
