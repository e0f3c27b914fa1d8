"""Motion in picometres: spreads, displacements, lattices, jumps and their rates, against what is known."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from tract_dask.analysis.jumps import (
    _jumps,
    activation_energy,
    chance,
    change_points,
    jump_rate,
    noise_factor,
    threshold_jumps,
)
from tract_dask.analysis.motion import (
    displacement,
    lattice_displacement,
    positions,
    spread,
    standard_deviation,
    standard_errors,
)
from tract_dask.analysis.weights import blocks, scatter_of
from tract_dask.errors import SettingsError
from tract_dask.kernels.changepoints import critical_penalty, plateaus
from tract_dask.kernels.gaussian import parameters
from tract_dask.plots.base import time_of
from tract_dask.store import schema

PIXEL_PM = 4.0
TRUE_JUMPS = (6, 11, 17, 20, 29, 33)
"""Frames at which the column of the jump tests moves; two plateaus are three and four frames long."""


def tracks_of(places_pm, stderr_pm=2.0, kind="Ce", **attributes) -> xr.Dataset:
    """Results whose columns are at ``places_pm`` (frame, column, (y, x)); NaN is a fit that is not accepted."""
    n_frames, n_columns, _ = places_pm.shape
    lost = np.isnan(places_pm).any(axis=-1)
    fit = np.zeros((n_frames, n_columns, 7))
    fit[..., [parameters.Y, parameters.X]] = np.where(lost[..., None], 1e6, places_pm) / PIXEL_PM
    stderr = np.broadcast_to(np.asarray(stderr_pm) / PIXEL_PM, (n_frames, n_columns))
    mean = np.nanmean(places_pm, axis=0) / PIXEL_PM
    return xr.Dataset(
        {
            "fit": (("frame", "column_id", "parameter"), fit),
            "stderr": (("frame", "column_id", "parameter"), np.repeat(stderr[..., None], 7, axis=2)),
            **{
                name: (("frame", "column_id"), np.ones((n_frames, n_columns)))
                for name in ("intensity", "intensity_error", "intensity_stderr")
            },
            "centroid": (("frame", "column_id", "axis"), places_pm / PIXEL_PM),
            "status": (("frame", "column_id"), np.where(lost, np.uint16(1), np.uint16(0))),
            "y_ref": ("column_id", mean[:, 0]),
            "x_ref": ("column_id", mean[:, 1]),
            "kind": ("column_id", schema.texts(np.broadcast_to(kind, n_columns))),
        },
        coords=schema.coordinates(n_frames) | {"column_id": np.arange(1, n_columns + 1)},
        attrs={"pixel_size_pm": PIXEL_PM, "frame_time_s": 0.1} | attributes,
    )


def still(n_frames, n_columns, seed=0, sigma_pm=2.0):
    rng = np.random.default_rng(seed)
    return rng.normal(0, sigma_pm, (n_frames, n_columns, 2)) + 100.0 * np.arange(1, n_columns + 1)[:, None]


def jumping(n_frames=40, size_pm=10.0):
    """A path that jumps at TRUE_JUMPS, by ``size_pm``, in directions that lead back now and then."""
    path = np.zeros((n_frames, 2))
    for k, frame in enumerate(TRUE_JUMPS):
        path[frame:] += size_pm * np.array([np.cos(2.0 * k), np.sin(2.0 * k)])
    return path


def test_positions_are_in_pm_and_masked_and_lazy():
    places = still(6, 3)
    places[2, 1] = np.nan
    tracks = tracks_of(places)
    lazy = positions(tracks.chunk(frame=2))
    assert lazy.chunks is not None
    assert lazy.dims == ("frame", "column_id", "axis")
    assert list(lazy["axis"].values) == ["y", "x"]
    np.testing.assert_allclose(lazy.values, places)


@pytest.mark.parametrize("function", [positions, spread, lattice_displacement, change_points])
def test_an_unknown_pixel_size_is_refused(function):
    with pytest.raises(SettingsError, match="--pixel-size-pm"):
        function(tracks_of(still(4, 4), pixel_size_pm=None))


def test_spread_is_that_of_the_noise():
    n, sigma = 4000, 3.0
    found = spread(tracks_of(still(n, 4, sigma_pm=sigma)).chunk(frame=500))
    assert found["sd"].chunks is not None
    within = 4 * sigma / np.sqrt(2 * n)  # four standard errors of a standard deviation
    for name in ("sd_x", "sd_y", "sd"):
        np.testing.assert_allclose(found[name], sigma, atol=within)
    np.testing.assert_allclose(found["sd_radial"], np.sqrt(2) * sigma, atol=1.5 * within)
    np.testing.assert_allclose(found["mean_displacement"], np.sqrt(np.pi / 2) * sigma, atol=1.5 * within)
    assert (found["n"] == n).all()


def test_spread_leaves_out_what_is_not_accepted():
    places = still(30, 2)
    places[5:9, 0] = np.nan
    found = spread(tracks_of(places))
    np.testing.assert_allclose(found["sd_y"], np.nanstd(places[..., 0], axis=0, ddof=1))
    np.testing.assert_array_equal(found["n"], [26, 30])


def test_displacement_and_its_probability():
    places = still(3, 20000, sigma_pm=2.0)
    places[2, 1] = np.nan
    tracks = tracks_of(places, stderr_pm=2.0)
    found = displacement(tracks, 0, 2)
    np.testing.assert_allclose(found["displacement"], places[2] - places[0])
    np.testing.assert_allclose(found["distance"], np.hypot(*(places[2] - places[0]).T))
    np.testing.assert_allclose(found["stderr"][0], np.sqrt(8))
    assert np.isnan(found["p_value"][1])
    uniform = stats.kstest(found["p_value"].values[2:], "uniform")  # of columns that keep still
    assert uniform.pvalue > 1e-3
    with pytest.raises(SettingsError, match="frame from 0 to 2"):
        displacement(tracks, 0, 3)


def test_threshold_jumps_are_those_of_the_rule():
    places = 0.1 * still(20, 2)
    places[8:, 1] += [6.0, 8.0]  # 10 pm, but half of it from the mean on either side
    places[15, 0] += [0.0, 30.0]  # one frame away: far from the mean on the way there, not on the way back
    places[3, 1] = np.nan
    found = threshold_jumps(tracks_of(places).chunk(frame=7), 5.0)
    assert list(zip(found["column_id"].values, found["frame"].values, strict=True)) == [(1, 15)]
    found = threshold_jumps(tracks_of(places), 3.5)
    assert list(zip(found["column_id"].values, found["frame"].values, strict=True)) == [(2, 8), (1, 15)]
    np.testing.assert_allclose(found["step"].values, [places[8, 1] - places[7, 1], places[15, 0] - places[14, 0]])
    np.testing.assert_allclose(found["size"], np.hypot(*found["step"].values.T))
    with pytest.raises(SettingsError, match="above 0"):
        threshold_jumps(tracks_of(places), 0.0)


@pytest.mark.parametrize(("n_frames", "n_columns"), [(40, 1000), (400, 150)])
@pytest.mark.parametrize("misjudged", [1.0, 1.6])
def test_change_points_of_still_columns_come_as_often_as_stated(n_frames, n_columns, misjudged):
    places = still(n_frames, n_columns, seed=n_frames, sigma_pm=2.0 * misjudged)
    places[np.random.default_rng(1).random(places.shape[:2]) < 0.1] = np.nan
    found = change_points(tracks_of(places, stderr_pm=2.0), confidence=0.9)
    alarms = len(np.unique(found["column_id"]))
    low, high = stats.binom.ppf([5e-4, 1 - 5e-4], n_columns, [0.08, 0.12])
    assert low <= alarms <= high
    assert (found["p_value"] <= 0.1 + 1e-9).all()


def test_errors_that_follow_the_noise_of_their_frame_raise_no_alarm():
    """Errors scatter by two fifths from frame to frame, as a faint column's do; levels hold within 2 points."""
    n_columns = 1500
    rng = np.random.default_rng(4)
    stated = 2.0 * np.exp(0.4 * rng.normal(size=(40, n_columns)))
    tracks = tracks_of(still(40, n_columns, seed=2), stderr_pm=stated)
    for level in (0.1, 0.05, 0.01):
        alarms = len(np.unique(change_points(tracks, 1 - level)["column_id"])) / n_columns
        assert abs(alarms - level) <= 0.02 + 3 * np.sqrt(level / n_columns)
        moved = (displacement(tracks, 5, 30)["p_value"] < level).mean()
        assert abs(moved - level) <= 0.02 + 3 * np.sqrt(level / n_columns)


def test_errors_follow_the_dose_and_a_column_that_changes():
    """A flicker that all columns share, and a column that becomes fainter, count; the noise of one frame does not."""
    rng = np.random.default_rng(6)
    truth = np.full((300, 200), 2.0)
    truth[100:110] *= 2
    truth[150:, 0] *= 2
    stated = tracks_of(still(300, 200), stderr_pm=truth * np.exp(0.3 * rng.normal(size=truth.shape)))
    ((_, _, found),) = blocks(positions(stated), standard_errors(stated))
    away = np.abs(np.arange(300) - 150) > 25
    assert np.abs(found[0, away, 0] / truth[away, 0] - 1).max() <= 0.25
    assert np.quantile(np.abs(found[1:, :, 0].T / truth[:, 1:] - 1), 0.999) <= 0.25
    assert np.std(found[1:, :, 0].T / truth[:, 1:]) <= 0.08


def test_a_column_by_itself_does_not_alarm_more_often():
    """The error of the noise factor counts: one column of 40 frames knows its noise to about 14 %."""
    alarms, draws = 0, 1500
    series = still(40, draws, seed=8).transpose(1, 0, 2)
    for places, (variance, error) in zip(series, scatter_of(series, np.ones(series.shape)), strict=True):
        degrees = 2 / (np.pi / 2 * error)  # as noise_factor has it for one column
        alarms += len(_jumps(places, np.full((40, 2), np.exp(variance / 2)), degrees, 0.9, 2)[0]) > 0
    assert alarms <= stats.binom.ppf(0.9995, draws, 0.12)


def test_six_jumps_in_forty_frames_are_found():
    n, jumping_ones = 40, 40
    places = still(n, 10 * jumping_ones)
    places[:, ::10] += jumping()[:, None]
    places[24, ::10] = np.nan
    found = change_points(tracks_of(places, stderr_pm=2.0))
    frames = [found["frame"].values[found["column_id"].values == 10 * k + 1] for k in range(jumping_ones)]
    missed = sum(not np.any(np.abs(own - true) <= 1) for own in frames for true in TRUE_JUMPS)
    false = sum(min(abs(frame - true) for true in TRUE_JUMPS) > 1 for own in frames for frame in own)
    assert missed <= 0.02 * jumping_ones * len(TRUE_JUMPS)
    assert false <= 0.02 * jumping_ones * len(TRUE_JUMPS)
    assert sum(list(own) == list(TRUE_JUMPS) for own in frames) >= 0.7 * jumping_ones


def test_steps_of_change_points_scatter_as_stated():
    n = 150
    places = still(30, 3 * n)
    places[12:, :n] += [0.0, 15.0]
    found = change_points(tracks_of(places), confidence=0.999)
    found = found.isel(jump=(found["column_id"].values <= n) & (found["frame"].values == 12))
    assert found.sizes["jump"] >= 0.99 * n
    deviation = (found["step"].values - [0.0, 15.0]) / found["stderr"].values
    np.testing.assert_allclose(deviation.std(axis=0), 1.0, atol=3.3 / np.sqrt(2 * n))
    np.testing.assert_allclose(deviation.mean(axis=0), 0.0, atol=3.3 / np.sqrt(n))
    np.testing.assert_allclose(found["stderr"], 2 * np.sqrt(1 / 12 + 1 / 18), rtol=0.25)


def test_one_wild_fit_is_no_jump_and_chunks_change_nothing():
    places = still(60, 6)
    places[30, 2] += [0.0, 12.0]
    places[20:, 3] += [12.0, 0.0]
    tracks = tracks_of(places)
    found = change_points(tracks, confidence=0.99)
    assert list(found["column_id"].values) == [4]
    xr.testing.assert_identical(found, change_points(tracks.chunk(frame=7), confidence=0.99))
    single = change_points(tracks, shortest=1, confidence=0.5)
    assert {30, 31} <= set(single["frame"].values[single["column_id"].values == 3])
    for wrong in ({"confidence": 1.0}, {"shortest": 0}):
        with pytest.raises(SettingsError):
            change_points(tracks, **wrong)


def test_plateaus_are_the_best_of_all_segmentations():
    rng = np.random.default_rng(3)
    values, weights = rng.normal(size=(9, 2)), rng.uniform(0.5, 2, (9, 2))
    values[4:] += 1.5

    def cost(cuts):
        parts = np.split(np.arange(9), cuts)
        means = [np.average(values[part], axis=0, weights=weights[part]) for part in parts]
        return sum((weights[p] * (values[p] - m) ** 2).sum() for p, m in zip(parts, means, strict=True)) + 2.5 * len(
            cuts
        )

    every = [[k for k in range(1, 9) if bits >> k & 1] for bits in range(0, 512, 2)]
    assert list(plateaus(values, weights, 2.5, 1)) == min(every, key=cost)
    long_enough = [cuts for cuts in every if min(np.diff([0, *cuts, 9])) >= 3]
    assert list(plateaus(values, weights, 2.5, 3)) == min(long_enough, key=cost)


def test_chance_is_that_of_simulated_still_columns():
    rng = np.random.default_rng(5)
    for n, draws in ((20, 3000), (150, 600)):
        weights = np.ones((n, 2))
        needed = np.array([critical_penalty(rng.normal(size=(n, 2)), weights, 2, 2.0) for _ in range(draws)])
        for level in (0.3, 0.1):
            error = np.sqrt(level * (1 - level) / draws)
            stated = chance(np.quantile(needed, 1 - level), n)
            assert stated == pytest.approx(level, abs=0.15 * level + 3 * error)


def test_noise_factor_of_columns_that_differ_and_of_those_that_do_not():
    alike = noise_factor(tracks_of(still(40, 60, sigma_pm=3.0), stderr_pm=2.0))
    np.testing.assert_allclose(alike["factor"], 1.5, atol=0.15)
    assert alike["factor"].std() < 0.06  # each alone would scatter by 0.12
    assert (alike["degrees"] > 120).mean() > 0.9  # by chance one in twenty is farther off than the limit
    places = still(2000, 3)
    places[:, 1] += 2 * (places[:, 1] - places[:, 1].mean(axis=0))
    places[1000:, 2] += 50.0
    differ = noise_factor(tracks_of(places, stderr_pm=2.0))
    np.testing.assert_allclose(differ["factor"], [1.0, 3.0, 1.0], rtol=0.06)


def test_noise_of_one_column_is_known_as_well_as_it_says():
    places = np.swapaxes(still(60, 800), 0, 1)
    found = scatter_of(places, np.full(places.shape, 2.0))
    np.testing.assert_allclose(found[:, 0].var(), found[0, 1], rtol=0.2)  # 800 draws: 5 % standard error


def test_rates_and_energies():
    places = still(41, 3)
    places[:40, 2] = np.nan
    tracks = tracks_of(places)
    jumps = xr.Dataset({"column_id": ("jump", [1, 1, 1, 1, 1])})
    rate = jump_rate(jumps, tracks, confidence=0.95)
    np.testing.assert_array_equal(rate["n"], [5, 0, 0])
    np.testing.assert_allclose(rate["rate"], [5 / 4.0, 0, np.nan])
    np.testing.assert_allclose(rate["low"], [1.6235 / 4, 0, np.nan], rtol=1e-4)  # Garwood's table: 5 events, 95 %
    np.testing.assert_allclose(rate["high"], [11.6683 / 4, 3.6889 / 4, np.nan], rtol=1e-4)
    energy = activation_energy(rate, temperature_k=300.0)
    assert float(energy["energy"][0]) == pytest.approx(0.0258520 * np.log(1e13 / 1.25), rel=1e-5)
    assert energy["low"][0] < energy["energy"][0] < energy["high"][0]
    assert np.isinf(energy["high"][1])
    assert float(energy["low"][1]) == pytest.approx(0.0258520 * np.log(1e13 / (3.6889 / 4)), rel=1e-4)
    with pytest.raises(SettingsError, match="--frame-time-s"):
        jump_rate(jumps, tracks.assign_attrs(frame_time_s=None))


def test_a_rate_counts_the_time_in_which_frames_were_lost():
    places = still(41, 2)
    places[10:12, 1] = np.nan
    tracks = tracks_of(places)
    time = 0.1 * np.arange(41.0)
    time[20:] += 6.0
    jumps = xr.Dataset({"column_id": ("jump", [1, 1, 1, 1, 1])})
    lost = jump_rate(jumps, tracks.assign(time=("frame", time)))
    np.testing.assert_allclose(lost["rate"], [0.5, 0])
    np.testing.assert_allclose(lost["high"][1], 3.6889 / 9.8, rtol=1e-4)
    halves = jump_rate(jumps, tracks.assign(time=("frame", time)).isel(frame=slice(None, None, 2)))
    np.testing.assert_allclose(halves["rate"], [0.5, 0])
    untold = tracks.assign(time=("frame", np.arange(41.0)))  # the frame time was given to the tracks later
    np.testing.assert_allclose(jump_rate(jumps, untold)["rate"], [1.25, 0])
    assert time_of(untold)[0][-1] == pytest.approx(4.0)
    assert time_of(tracks.assign(time=("frame", time)))[0][-1] == 10.0


def test_energies_need_a_temperature():
    rate = jump_rate(xr.Dataset({"column_id": ("jump", [1])}), tracks_of(still(41, 3)))
    with pytest.raises(SettingsError, match="temperature_k"):
        activation_energy(rate, 0.0)


def lattice(nx=7, ny=5):
    """Two sublattices of an oblique lattice, (y, x) in pm, with the kind of each column."""
    a, b = np.array([12.0, 310.0]), np.array([270.0, 150.0])
    cells = np.array([i * a + j * b for j in range(ny) for i in range(nx)])
    return np.concatenate([cells, cells + 0.5 * a + 0.3 * b]), np.repeat(["Ce", "O"], len(cells)), a, b


def test_displacements_from_the_lattice():
    sites, kinds, a, b = lattice()
    rng = np.random.default_rng(2)
    places = sites + rng.normal(0, 1.0, (50, *sites.shape))
    places[:, 17] += [0.0, 40.0]  # a column off its site
    found = lattice_displacement(tracks_of(places, kind=kinds).chunk(frame=10))
    assert found["displacement"].chunks is not None
    vectors = found["vector"].values
    for true in (a, b):
        steps = true @ np.linalg.inv(vectors)
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)  # the same lattice, whichever vectors span it
    assert abs(np.linalg.det(vectors)) == pytest.approx(abs(np.linalg.det([a, b])), rel=1e-3)
    np.testing.assert_allclose(found["mean_displacement"][17], [0.0, 40.0], atol=1.0)
    assert not found["fitted"][17]
    others = np.delete(found["mean_displacement"].values, 17, axis=0)
    assert np.sqrt((others**2).mean()) < 1.5 / np.sqrt(50)
    np.testing.assert_allclose(found["displacement"].mean("frame"), found["mean_displacement"], atol=1e-9)
    assert found["vector_stderr"].max() < 0.2


def test_a_lattice_fitted_to_some_columns_says_how_the_others_relax():
    sites, kinds, _, _ = lattice()
    surface = np.arange(len(sites)) % 35 < 7
    sites[surface] += [-15.0, 0.0]
    places = np.repeat(sites[None], 3, axis=0)
    found = lattice_displacement(tracks_of(places, kind=kinds), columns=list(np.flatnonzero(~surface) + 1))
    np.testing.assert_allclose(found["mean_displacement"][surface], [[-15.0, 0.0]] * surface.sum(), atol=1e-6)
    np.testing.assert_allclose(found["distance"][~surface], 0.0, atol=1e-6)


@pytest.mark.parametrize("places", [np.zeros((3, 2)), np.arange(8)[:, None] * [100.0, 0.0]])
def test_what_is_no_lattice_is_refused(places):
    with pytest.raises(SettingsError, match="no lattice"):
        lattice_displacement(tracks_of(places[None] + np.zeros((2, 1, 1))))


@pytest.mark.parametrize("chunks", [None, {"frame": 7}])
def test_standard_deviation_is_numpys_and_columns_without_values_bring_no_warning(chunks):
    values = 16000 + np.random.default_rng(2).normal(0, 5, (40, 5, 2))
    values[:, 1], values[1:, 2], values[:9, 3], values[:, 4] = np.nan, np.nan, np.nan, 1.25
    array = xr.DataArray(values, dims=("frame", "column_id", "axis"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = standard_deviation(array if chunks is None else array.chunk(chunks)).compute()
    assert found.isel(column_id=[1, 2]).isnull().all()
    expected = np.stack([values[:, 0].std(axis=0, ddof=1), values[9:, 3].std(axis=0, ddof=1), np.zeros(2)])
    np.testing.assert_allclose(found.isel(column_id=[0, 3, 4]), expected, rtol=1e-8, atol=1e-12)
