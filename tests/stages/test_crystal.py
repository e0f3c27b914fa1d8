"""A crystal that turns, grows or slips: what is undone, and which columns stand still; against known truth."""

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import Scene

from tract_dask import convert, fit_columns, open_movie, open_results
from tract_dask.analysis.jumps import change_points
from tract_dask.analysis.motion import places_in_frames
from tract_dask.errors import SettingsError
from tract_dask.kernels import linear_motion
from tract_dask.kernels.gaussian.parameters import X, Y
from tract_dask.settings import ConvertSettings, FitSettings
from tract_dask.stages.fit.crystal import Crystal as PutRight
from tract_dask.stages.fit.crystal import judge
from tract_dask.stages.fit.job import prepare
from tract_dask.stages.fit.stage import fit_movie
from tract_dask.store import metadata
from tract_dask.store.schema import Status

N_FRAMES = 24
SLIP_PX = 0.6


class Crystal(Scene):
    """A crystal of 6 x 6 columns that moves, each frame's places in ``seen`` (frames, columns, 2) as (x, y)."""

    def __init__(self, motion=None, slipped=0.0):
        super().__init__(n_frames=N_FRAMES, shape=(256, 256), background=8.0, amplitude=25.0)
        centre = self.place.mean(axis=0)
        self.motion = np.zeros((N_FRAMES, 4)) if motion is None else motion
        self.block = self.place[:, 0] > np.quantile(self.place[:, 0], 1 - slipped) if slipped else np.zeros(0, bool)
        rest = np.repeat(self.place[None], N_FRAMES, axis=0)
        if slipped:
            rest[N_FRAMES // 2 :, self.block, 0] += SLIP_PX
        self.seen = centre + linear_motion.moved(rest - centre, self.motion) + self.drift[:, None, ::-1]

    def movie(self):
        chance, rest, frames = np.random.default_rng(5), self.place, []
        for places in self.seen:
            self.place = places
            frames.append(chance.poisson(self.frame(np.zeros(2))).astype(np.uint16))
        self.place = rest
        return np.array(frames)


def fitted(crystal, npy, folder, **settings):
    movie = convert(npy(crystal.movie()), folder / "movie.zarr", settings=ConvertSettings(shard_mb=1, tile_px=64))
    movie = open_movie(movie)
    job = prepare(movie, crystal.columns(), crystal.drift_dataset(), FitSettings(**settings))
    fit_movie(movie, job, folder / "results.zarr")
    return open_results(folder / "results.zarr").load().assign_attrs(pixel_size_pm=8.0, frame_time_s=1.0)


def course(number, size):
    motion = np.zeros((N_FRAMES, 4))
    motion[:, number] = size * (np.arange(N_FRAMES) / (N_FRAMES - 1) - 0.5)
    return motion


@pytest.mark.parametrize(("number", "size"), [(0, np.deg2rad(5.0)), (1, 0.06)])
def test_a_crystal_that_turns_or_grows_leaves_no_jumps(npy, tmp_path, number, size):
    crystal = Crystal(course(number, size))
    tracks = fitted(crystal, npy, tmp_path)
    assert metadata.attributes(tmp_path / "results.zarr")["motions_undone"] == [linear_motion.NAMES[number]]
    off = tracks["motion"].to_numpy()[:, number] - crystal.motion[:, number]
    sigma = float(np.nanmedian(tracks["stderr"].sel(parameter="x")))
    bound = sigma / np.sqrt(((crystal.place - crystal.place.mean(axis=0)) ** 2).sum())
    assert off.std() < 1.45 * bound  # 24 frames tell it to 15 %
    accepted = (tracks["status"] == 0).to_numpy()
    assert accepted.mean() > 0.9
    assert np.unique(change_points(tracks, 0.99)["column_id"]).size <= 2
    away = places_in_frames(tracks).sel(axis=["x", "y"]).to_numpy() - crystal.seen
    assert np.abs(away[accepted]).max() < 6 * sigma


def test_the_larger_part_of_a_crystal_that_slips_stands_still(npy, tmp_path):
    crystal = Crystal(slipped=0.34)
    tracks = fitted(crystal, npy, tmp_path)
    about = metadata.attributes(tmp_path / "results.zarr")
    assert about["motions_undone"] == []
    assert set(about["not_reference"]) == set(np.flatnonzero(crystal.block) + 1)
    x = tracks["fit"].sel(parameter="x").to_numpy()
    step = np.nanmean(x[N_FRAMES // 2 :], axis=0) - np.nanmean(x[: N_FRAMES // 2], axis=0)
    error = float(np.nanmedian(tracks["stderr"].sel(parameter="x"))) * np.sqrt(4 / N_FRAMES)
    within = 4 * error / np.sqrt(crystal.block.sum())
    assert abs(step[crystal.block].mean() - SLIP_PX) < within
    assert abs(step[~crystal.block].mean()) < within


@pytest.mark.parametrize("undone", [True, False])
def test_a_crystal_that_keeps_still_is_left_as_it_was_fitted(npy, tmp_path, undone):
    tracks = fitted(Crystal(), npy, tmp_path, refine_drift=undone)
    assert "motions_undone" not in metadata.attributes(tmp_path / "results.zarr")
    assert not tracks["motion"].any()


def test_columns_that_are_named_stand_still(npy, tmp_path):
    crystal = Crystal(slipped=0.34)
    named = tuple((np.flatnonzero(crystal.block) + 1).tolist())
    tracks = fitted(crystal, npy, tmp_path, drift_columns=named)
    x = tracks["fit"].sel(parameter="x").to_numpy()
    step = np.nanmean(x[N_FRAMES // 2 :], axis=0) - np.nanmean(x[: N_FRAMES // 2], axis=0)
    assert abs(step[crystal.block].mean()) < 0.1
    assert abs(step[~crystal.block].mean() + SLIP_PX) < 0.1


class Fits:
    """Fits (frames, columns, 2) of x and y, in one shard, as the journal's parts give them; NaN is not accepted."""

    done = np.ones(1, bool)

    def __init__(self, away, job):
        places = away + job.reference[:, [X, Y]]
        size = np.linalg.norm(away, axis=-1)
        weight = np.clip(1 - (np.nan_to_num(size, nan=9) / 0.6) ** 2, 0, None) ** 2  # as robust as the fits' motion
        motion = linear_motion.estimate(away, job.from_centre, weight)
        self.values = {
            "fit": np.repeat(places[..., :1], 7, axis=-1),
            "status": np.where(np.isnan(away[..., 0]), Status.NOT_CONVERGED, 0).astype(np.uint16),
            "motion_measured": motion[0],
            "motion_stderr": motion[1],
        }
        self.values["fit"][..., [X, Y]] = places

    def read(self, shard, name, into):
        into[:] = self.values[name]


def still(columns):
    """A job with a square of columns that are 30 px apart."""
    side = np.ceil(np.sqrt(columns))
    reference = np.tile([25.0, 0, 0, 4, 4, 0, 8], (columns, 1))
    reference[:, X], reference[:, Y] = 30 * (np.arange(columns) % side), 30 * (np.arange(columns) // side)
    settings = SimpleNamespace(drift_columns=None)
    from_centre = reference[:, [X, Y]] - reference[:, [X, Y]].mean(axis=0)
    return SimpleNamespace(reference=reference, from_centre=from_centre, centre=0, refined_by=10, settings=settings)


@pytest.mark.parametrize("frames", [6, 12, 24])
def test_columns_that_scatter_or_hop_by_themselves_are_no_part_that_slips(frames):
    """At most one of 20 crystals of 100 columns; a third of them hops by four standard errors, in half of the draws."""
    chance, job, slipped = np.random.default_rng(frames), still(100), 0
    for draw in range(20):
        away = chance.normal(0, 0.1, (frames, 100, 2))
        if draw % 2:
            away[:, ::3] += 0.4 * np.repeat(chance.normal(0, 1, (-(-frames // 6), 34, 2)), 6, axis=0)[:frames]
        slipped += judge(Fits(away, job), frames, frames, job) is not None
    assert slipped <= 1


def test_a_part_that_slips_is_told_from_columns_that_hop():
    chance, job = np.random.default_rng(3), still(100)
    away = chance.normal(0, 0.1, (12, 100, 2))
    away[:6, ::3] += 0.4 * chance.normal(0, 1, (34, 2))
    slips = job.reference[:, X] > 170
    away[6:, slips, 0] += 0.6
    away[..., 0] -= 0.3 * (np.arange(12) >= 6)[:, None]  # a drift that follows both parts
    crystal = judge(Fits(away, job), 12, 12, job)
    assert crystal.reference[slips].mean() < 0.1  # hoppers that went where the others are
    assert crystal.reference[~slips].mean() > 0.6


def test_a_crystal_that_is_seen_in_three_frames_is_left_as_it_was_fitted():
    away = np.random.default_rng(4).normal(0, 0.1, (24, 30, 2))
    away[3:] = np.nan
    assert judge(Fits(away, still(30)), 24, 24, still(30)) is None


def test_one_column_that_is_named_stands_still_with_and_without_a_measured_drift(npy, tmp_path):
    crystal = Crystal()
    settings = FitSettings(drift_columns=(8,))
    path = npy(crystal.movie())
    movie = open_movie(convert(path, tmp_path / "movie.zarr", settings=ConvertSettings(shard_mb=1, tile_px=64)))
    job = prepare(movie, crystal.columns(), crystal.drift_dataset().assign_attrs(method="none"), settings)
    fit_movie(movie, job, tmp_path / "results.zarr")
    tracks = open_results(tmp_path / "results.zarr").load()
    seen = tracks["fit"].sel(parameter=["x", "y"]).to_numpy()[:, 7]
    assert np.nanmax(np.abs(seen - job.reference[7, [X, Y]])) < 1e-6
    assert "not_reference" not in metadata.attributes(tmp_path / "results.zarr")
    lazy = fit_columns(movie, crystal.columns(), crystal.drift_dataset(), settings)
    np.testing.assert_allclose(lazy["fit"].sel(parameter=["x", "y"]).to_numpy()[:, 7], seen, atol=1e-6)


def test_a_frame_without_the_columns_that_stand_still_is_lost():
    job = still(100)
    values = {"fit": np.tile(job.reference, (2, 1, 1)), "centroid": np.zeros((2, 100, 2)), "drift": np.zeros((2, 2))}
    values["status"] = np.zeros((2, 100), np.uint16)
    values["status"][1, :98] = Status.NOT_CONVERGED
    turning = PutRight((0,), np.ones(100, bool), np.zeros(2), job.reference[:, [X, Y]], np.ones(100))
    lost = turning.put_right(values)["status"] & Status.LOST_FRAME
    assert not lost[0].any()
    assert lost[1].all()


@pytest.mark.parametrize(("settings", "words"), [({"drift_columns": (1, 999)}, "999"), ({"drift_columns": ()}, "none")])
def test_columns_that_are_not_there_cannot_stand_still(npy, tmp_path, settings, words):
    with pytest.raises(SettingsError, match=f"no such columns.*{words}"):
        fitted(Crystal(), npy, tmp_path, **settings)
