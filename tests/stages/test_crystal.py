"""A crystal that turns, grows or slips: what is undone, and which columns stand still; against known truth."""

import numpy as np
import pytest
from conftest import Scene

from tract_dask import convert, open_movie, open_results
from tract_dask.analysis.jumps import change_points
from tract_dask.analysis.motion import places_in_frames
from tract_dask.errors import SettingsError
from tract_dask.kernels import linear_motion
from tract_dask.settings import ConvertSettings, FitSettings
from tract_dask.stages.fit.job import prepare
from tract_dask.stages.fit.stage import fit_movie
from tract_dask.store import metadata

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


@pytest.mark.parametrize(("settings", "words"), [({"drift_columns": (1, 999)}, "999"), ({"drift_columns": ()}, "none")])
def test_columns_that_are_not_there_cannot_stand_still(npy, tmp_path, settings, words):
    with pytest.raises(SettingsError, match=f"no such columns.*{words}"):
        fitted(Crystal(), npy, tmp_path, **settings)
