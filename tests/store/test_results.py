"""results.zarr: the store that outlives interruptions."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from tract_dask import accepted, convert, fit_columns, open_movie, open_results
from tract_dask.errors import StoreError
from tract_dask.progress import ShardDone, StageDone
from tract_dask.settings import ConvertSettings, FitSettings, MetadataSettings
from tract_dask.stages.fit.job import prepare
from tract_dask.stages.fit.stage import fit_movie


@pytest.fixture
def movie(scene, tmp_path, npy):
    store = convert(
        npy(scene.counts()),
        tmp_path / "movie.zarr",
        settings=ConvertSettings(tile_px=32),
        metadata=MetadataSettings(pixel_size_pm=4.0, frame_time_s=0.1),
    )
    return open_movie(store)


def fit_all(movie, scene, path, settings=None, **more):
    columns = scene.columns()
    job = prepare(movie, columns, scene.drift_dataset(), settings or FitSettings())
    return fit_movie(movie, job, path, **more)


class Killed(BaseException):
    """Stands for the end of the process."""


def test_stored_results_equal_the_lazy_ones(scene, movie, tmp_path):
    path = tmp_path / "results.zarr"
    summary = fit_all(movie, scene, path)
    lazy = fit_columns(movie, scene.columns(), scene.drift_dataset())
    stored = open_results(path)
    for name in lazy.data_vars:
        np.testing.assert_array_equal(stored[name], lazy[name], err_msg=name)
    assert summary.fits == scene.n_frames * len(scene.place)
    assert summary.accepted == int((stored.status == 0).sum())
    assert stored.attrs["pixel_size_pm"] == 4.0
    np.testing.assert_allclose(stored.time, 0.1 * np.arange(scene.n_frames))
    assert list(stored.parameter.values) == ["amplitude", "x", "y", "sigma_a", "sigma_b", "theta", "background"]
    assert stored.attrs["tract_dask"]["versions"]["tract_dask"]


def test_an_interrupted_fit_goes_on_to_the_same_numbers(scene, movie, tmp_path):
    whole, resumed = tmp_path / "whole.zarr", tmp_path / "resumed.zarr"
    fit_all(movie, scene, whole)
    seen: list[int] = []

    def kill_after_two(event):
        if isinstance(event, ShardDone):
            seen.append(event.shard)
            if len(seen) == 2:
                raise Killed

    with pytest.raises(Killed):
        fit_all(movie, scene, resumed, on_event=kill_after_two)
    with pytest.raises(StoreError, match="not all done"):
        open_results(resumed)
    partial = open_results(resumed, unfinished=True)
    assert np.isnan(partial.fit[-1]).all()
    rest: list[int] = []
    fit_all(
        movie,
        scene,
        resumed,
        on_event=lambda e: rest.append(e.shard) if isinstance(e, ShardDone) else None,
    )
    assert sorted(seen + rest) == [shard.index for shard in movie.shards]
    xr.testing.assert_equal(open_results(whole).drop_attrs().compute(), open_results(resumed).drop_attrs().compute())


def test_a_finished_fit_is_reused_and_other_settings_are_not(scene, movie, tmp_path):
    path = tmp_path / "results.zarr"
    events = []
    first = fit_all(movie, scene, path)
    assert fit_all(movie, scene, path, on_event=events.append) == first
    assert events == [StageDone("fit", 0.0, reused=True)]
    fit_all(movie, scene, path, FitSettings(blur_sigma_px=0.0), on_event=events.append)
    assert sum(isinstance(event, ShardDone) for event in events) == len(movie.shards)


def test_accepted_masks_what_is_flagged(scene, movie):
    tracks = fit_columns(movie, scene.columns(), scene.drift_dataset(), summed=scene.summed()).compute()
    tracks["status"][2, 3] = 2
    masked = accepted(tracks)
    assert np.isnan(masked.fit[2, 3]).all()
    assert np.isnan(masked.intensity[2, 3])
    assert masked.fit.notnull().sum() == 7 * (tracks.status == 0).sum()
    strict = accepted(tracks, threshold=1e6)
    assert strict.fit.isnull().all()
    assert (strict.status & 1).all()


def test_opening_what_is_not_there_says_so(tmp_path):
    with pytest.raises(StoreError, match="no results here"):
        open_results(tmp_path)


def test_a_journal_that_a_killed_run_left_is_removed(scene, movie, tmp_path):
    path = tmp_path / "results.zarr"
    fit_all(movie, scene, path)
    (tmp_path / "results.zarr.journal").mkdir()
    fit_all(movie, scene, path)
    assert not (tmp_path / "results.zarr.journal").exists()
