"""Whether a column is there: the matched filter against closed forms, its calibration, and events, all simulated."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from tract_dask import convert, fit_columns, open_movie
from tract_dask.analysis.presence import appearances, false_alarms, looked, p_values, present, states
from tract_dask.errors import SettingsError
from tract_dask.kernels.gaussian.model import gaussian_image
from tract_dask.kernels.presence import best_states, matched_filters, strengths
from tract_dask.kernels.windows import blur, cut_windows
from tract_dask.settings import ConvertSettings, FitSettings, MetadataSettings

COLUMN = np.array([3.0, 10.0, 10.0, 4.0, 3.2, 0.4, 0.0])


def white_windows(size, sigma, noise=1.0, side=600, signal=None):
    """Windows that do not touch, cut from a blurred frame of white noise, to which a signal may be added in each."""
    frame = np.random.default_rng(size).normal(5.0, noise, (1, side, side))
    y, x = (grid.ravel()[None] for grid in np.mgrid[12 : side - size - 12 : size, 12 : side - size - 12 : size])
    if signal is not None:
        for top, left in zip(y[0], x[0], strict=True):
            frame[0, top : top + size, left : left + size] += signal
    return cut_windows(frame.astype(np.float32), y, x, size, sigma)[0]


@pytest.mark.parametrize(("size", "sigma"), [(5, 0.0), (5, 1.0), (7, 2.0), (21, 0.0), (21, 2.0)])
def test_noise_alone_has_strengths_of_standard_deviation_1(size, sigma):
    """Whatever the window, blur, and level; to 3.5 standard errors of the standard deviation of so many."""
    windows = white_windows(size, sigma)
    wide = np.array([[-2.0, 0, 0, size / 4 + sigma, size / 5 + sigma, 0.7, 1.0]])
    found = strengths(windows, matched_filters(wide, size, sigma), np.zeros(len(windows), np.int64))
    error = 1 / np.sqrt(len(found))
    assert abs(found.mean()) <= 3.5 * error
    assert abs(found.std() - 1) <= 3.5 * error


@pytest.mark.parametrize(("sigma", "least"), [(0.0, 1 - 1e-6), (2.0, 0.99)])
def test_a_column_has_the_strength_of_the_best_filter(sigma, least):
    """In raw pixels A sqrt(sum u^2) / noise, the matched filter with free background; after a blur within 1 %."""
    size = 21
    signal = gaussian_image(COLUMN, (size, size))
    disc = np.hypot(*(np.mgrid[:size, :size] - 10)) <= size / 2
    best = np.sqrt(((signal - signal[disc].mean())[disc] ** 2).sum())
    frame = np.zeros((61, 61), np.float32)
    frame[20:41, 20:41] = gaussian_image(COLUMN, (size, size))
    seen = blur(frame, sigma)[20:41, 20:41][None]
    shape = COLUMN.copy()
    shape[3:5] = np.sqrt(shape[3:5] ** 2 + sigma**2)
    found = float(strengths(seen, matched_filters(shape[None], size, sigma), np.zeros(1, np.int64))[0])
    assert found <= best * (1 + 1e-6) or sigma > 0
    assert found >= least * best


def test_a_slope_is_no_column():
    y, x = np.mgrid[:21, :21]
    windows = np.stack([0.3 * x, -0.2 * y, 7.0 + 0 * x]).astype(np.float32)
    found = strengths(windows, matched_filters(COLUMN[None], 21, 2.0), np.zeros(3, np.int64))
    np.testing.assert_allclose(found, 0, atol=2e-5)


def test_filters_of_many_columns_take_little_more_memory_than_they_keep():
    """And each is that of the same column alone, whichever block it is made in."""
    rng, size = np.random.default_rng(0), 41
    shapes = np.tile(COLUMN, (3000, 1))
    shapes[:, 3:5] = rng.uniform(3, 8, (3000, 2))
    tracemalloc.start()
    try:
        filters = matched_filters(shapes, size, 2.0)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < filters.weights.nbytes + 32e6
    for k in (0, 155, 156, 2999):
        alone = matched_filters(shapes[k : k + 1], size, 2.0)
        np.testing.assert_allclose(filters.weights[k], alone.weights[0], atol=1e-7)
    assert matched_filters(shapes[:0], size, 2.0).weights.shape == (0, *alone.weights.shape[1:])


def test_each_window_has_its_own_filter():
    """As the plain sum does it, of the filter that each window names."""
    windows = white_windows(9, 0.0, side=100)[:20]
    shapes = np.array([[1.0, 0, 0, 2, 2, 0, 0], [-1.0, 0, 0, 3, 2, 0.5, 0]])
    filters = matched_filters(shapes, 9, 0.0)
    which = np.arange(20) % 2
    found = strengths(windows, filters, which)
    for k in (0, 1):
        impulses = np.eye(81, dtype=np.float32).reshape(81, 9, 9)
        weights = strengths(impulses, filters, np.full(81, k)).reshape(9, 9)
        np.testing.assert_allclose(found[which == k], (windows[which == k] * weights).sum((1, 2)), atol=1e-4)
    with pytest.raises(ValueError, match="which"):
        strengths(windows, filters, which + 1)
    with pytest.raises(ValueError, match="do not go"):
        strengths(windows[:, 1:], filters, which)


def test_the_best_path_is_the_best_of_all():
    scores = np.random.default_rng(3).normal(0, 2, 12)
    paths = (np.arange(2**12)[:, None] >> np.arange(12) & 1).astype(bool)
    merit = (paths * scores).sum(axis=1) - 1.5 * np.count_nonzero(np.diff(paths, axis=1), axis=1)
    np.testing.assert_array_equal(best_states(scores, 1.5), paths[merit.argmax()])


def tracks_of(presence, vacuum=None):
    """Tracks of these strengths (frame, column_id); standard normal ones in vacuum unless given."""
    if vacuum is None:
        vacuum = np.random.default_rng(9).normal(size=(len(presence), 16))
    return xr.Dataset(
        {"presence": (("frame", "column_id"), presence), "presence_vacuum": (("frame", "place"), vacuum)},
        {"frame": np.arange(len(presence)), "column_id": np.arange(1, presence.shape[1] + 1)},
    )


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_p_values_are_calibrated_on_vacuum(scale):
    """Noise of another size, and off zero: empty columns pass at the stated rate, and held-out vacuum says so.

    To 3 standard errors of their number, and 30 %, two standard errors of a tail that begins at 50 strengths.
    """
    rng = np.random.default_rng(1)
    empty, vacuum = 0.3 + scale * rng.normal(size=(200, 50)), 0.3 + scale * rng.normal(size=(200, 16))
    tracks = tracks_of(empty, vacuum)
    for rate in (0.1, 0.01, 0.001):
        passed = int(present(tracks, rate).sum())
        expected = rate * empty.size
        assert abs(passed - expected) <= 3 * np.sqrt(expected) + 0.3 * expected
    alarms = false_alarms(tracks)
    assert ((alarms.low <= alarms.rate) & (alarms.rate <= alarms.high)).sum() >= 4
    assert int(alarms.n) == vacuum.size
    strong = p_values(tracks_of(np.full((200, 1), 0.3 + 6 * scale), vacuum)).to_numpy()
    np.testing.assert_allclose(np.log10(strong), np.log10(stats.norm.sf(6)), atol=1.5)


def test_without_vacuum_theory_has_to_do():
    tracks = tracks_of(np.array([[2.326], [np.nan]]), np.full((2, 16), np.nan))
    found = p_values(tracks)
    np.testing.assert_allclose(found, [[0.01], [np.nan]], rtol=1e-2)
    assert found.calibration == "theory"
    assert not present(tracks)[1].any()
    with pytest.raises(SettingsError, match="too little vacuum"):
        false_alarms(tracks)


def test_there_not_there_and_not_looked_at_are_three_things():
    strength = np.array([[9.0, 0.0, np.nan], [9.0, 0.0, 9.0]])
    tracks = tracks_of(strength, np.random.default_rng(0).normal(size=(2, 60)))
    seen = looked(tracks)
    np.testing.assert_array_equal(seen, [[True, True, False], [True, True, True]])
    np.testing.assert_array_equal(seen & ~present(tracks), [[False, True, False], [False, True, False]])
    assert not present(tracks)[0, 2]


def test_p_values_stay_lazy():
    tracks = tracks_of(np.random.default_rng(2).normal(size=(60, 4)))
    lazy = present(tracks.chunk(frame=7))
    assert lazy.chunks == ((7,) * 8 + (4,), (4,))
    np.testing.assert_array_equal(lazy, present(tracks))


@pytest.mark.parametrize("strength", [0.0, 1.0, 2.0, 8.0])
def test_what_does_not_change_shows_no_event(strength):
    """At most 5 % of 400 columns (to 3 standard errors) show any in 100 frames, however weak they are."""
    presence = strength + np.random.default_rng(int(10 * strength)).normal(size=(100, 400))
    events = appearances(tracks_of(presence), 0.95)
    assert len(np.unique(events.column_id)) <= 400 * (0.05 + 3 * np.sqrt(0.05 * 0.95 / 400))


@pytest.mark.parametrize("n_frames", [20, 40])
@pytest.mark.parametrize("confidence", [0.95, 0.99])
def test_a_column_that_is_never_there_has_the_stated_chance(n_frames, confidence):
    """At most 5 % or 1 % of 600 (to 3 standard errors) are seen in any frame; weak ones of strength 1.5 in all."""
    noise = np.random.default_rng(n_frames).normal(size=(n_frames, 600))
    rate = 1 - confidence
    seen = states(tracks_of(noise), confidence).any("frame")
    assert float(seen.mean()) <= rate + 3 * np.sqrt(rate * confidence / 600)
    assert float(states(tracks_of(noise + 1.5), confidence).mean()) > 0.97


def test_appearances_are_found_where_they_are():
    """Columns of strength 4 that vanish for 8 frames, appear late, or are there for 6 frames: all, to a frame."""
    truth = np.ones((60, 90), bool)
    truth[20:28, :30] = False
    truth[:35, 30:60] = False
    truth[:, 60:] = False
    truth[40:46, 60:] = True
    presence = 4.0 * truth + np.random.default_rng(5).normal(size=truth.shape)
    presence[10] = np.nan
    tracks = tracks_of(presence)
    found = states(tracks).to_numpy()
    wrong = found != truth
    wrong[10] = False
    assert wrong.mean() <= 0.01
    events = appearances(tracks)
    assert (np.diff(events.frame) >= 0).all()
    late = events.sel(event=(events.column_id > 30) & (events.column_id <= 60))
    assert late.sizes["event"] == 30
    assert set(late["kind"].to_numpy()) == {"appears"}
    assert abs(late.frame - 35).max() <= 1
    assert (late.p_value < 1e-6).all()
    gone = events.sel(event=events.column_id <= 30)
    assert gone.sizes["event"] >= 56
    assert list(gone["kind"].isel(event=gone.column_id == 1).to_numpy()) == ["vanishes", "appears"]


def test_bad_arguments_are_refused():
    tracks = tracks_of(np.zeros((4, 2)))
    with pytest.raises(SettingsError, match="between 0 and 1"):
        appearances(tracks, 1.0)
    with pytest.raises(SettingsError, match="between 0 and 1"):
        present(tracks, 0.0)
    with pytest.raises(SettingsError, match="without presence_vacuum"):
        present(tracks.drop_vars("presence_vacuum"))


@pytest.mark.parametrize(
    "settings",
    [FitSettings(), FitSettings(estimator="poisson"), FitSettings(filter="none", blur_sigma_px=0.0)],
    ids=["blurred", "poisson", "raw"],
)
def test_fits_tell_which_columns_are_there(scene, tmp_path, npy, settings):
    """The strength in vacuum is 1 to 10 %; columns that are gone are found to be, and those that are there too."""
    there = np.ones((scene.n_frames, len(scene.place)), bool)
    there[4:9, 1] = False
    scene.amplitude = 15.0
    made = convert(
        npy(scene.counts(there)),
        tmp_path / "movie.zarr",
        settings=ConvertSettings(tile_px=32),
        metadata=MetadataSettings(pixel_size_pm=4.0),
    )
    box = (8, 48, 12, 132)
    settings = FitSettings(**{**vars(settings), "vacuum_box": box})
    movie = open_movie(made)
    tracks = fit_columns(movie, scene.columns(), scene.drift_dataset(), replace(settings, refine_drift=False)).compute()
    assert abs(float(tracks.presence_vacuum.std()) - 1) <= 0.15
    found = present(tracks, 0.001).to_numpy()
    assert (found == there).mean() >= 0.98
    assert not found[4:9, 1].any()
