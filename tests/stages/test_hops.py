"""Columns that leave their places: hops, swaps and columns that go, against known truth."""

import numpy as np
import pytest
import xarray as xr
from conftest import Scene

from tract_dask import convert, fit_columns, open_movie
from tract_dask.analysis.jumps import change_points
from tract_dask.settings import ConvertSettings, FitSettings
from tract_dask.store.schema import Status, is_accepted

HOPPER, NEIGHBOUR, N_FRAMES = 5, 8, 8
BOUND_PX = 19 / 4
"""So far the usual fit reaches."""


class Moving(Scene):
    """Frames in which columns are where ``seen`` (frames, columns, 2) says, as (x, y) without the drift; NaN: gone."""

    def __init__(self, **about):
        super().__init__(n_frames=N_FRAMES, **about)
        self.seen = np.repeat(self.place[None], N_FRAMES, axis=0)

    def counts(self, present=None, dtype="uint16"):
        chance, rest, frames = np.random.default_rng(7), self.place, []
        for places, shift in zip(self.seen, self.drift, strict=True):
            self.place = np.nan_to_num(places, nan=-1000.0)
            frames.append(chance.poisson(self.frame(shift)))
        self.place = rest
        return np.array(frames).astype(dtype)

    def tracks(self, npy, folder, columns=None, **settings):
        movie = convert(npy(self.counts()), folder / "movie.zarr", settings=ConvertSettings(tile_px=32))
        columns = self.columns() if columns is None else columns
        lazy = fit_columns(open_movie(movie), columns, self.drift_dataset(), FitSettings(**settings))
        return lazy.compute(scheduler="synchronous")


def places_of(tracks):
    return tracks["fit"].sel(parameter=["x", "y"]).transpose("frame", "column_id", "parameter").to_numpy()


@pytest.mark.parametrize("by", [(8.0, 0.0), (-7.0, 8.0), (3.0, 12.0)])
@pytest.mark.parametrize("settings", [{}, {"estimator": "poisson"}, {"shape": "free"}])
def test_a_column_that_hops_is_followed(npy, tmp_path, by, settings):
    scene = Moving()
    scene.seen[3:, HOPPER] += by
    tracks = scene.tracks(npy, tmp_path, **settings)
    status, error = tracks["status"].to_numpy(), tracks["stderr"].sel(parameter=["x", "y"]).to_numpy()
    away = (places_of(tracks) - scene.seen) / error
    assert ((status & Status.HOPPED) > 0).nonzero()[1].tolist() == [HOPPER] * (N_FRAMES - 3)
    assert is_accepted(status).all()
    assert np.abs(away[3:, HOPPER]).max() < 5
    assert 0.7 < away[3:, HOPPER].std() < 1.5  # ten numbers
    assert np.nanmin(tracks["presence"].to_numpy()[3:, HOPPER]) > 5
    found = change_points(tracks.assign_attrs(pixel_size_pm=10.0), 0.99)
    assert list(zip(found["frame"].values, found["column_id"].values - 1, strict=True)) == [(3, HOPPER)]


def test_dark_columns_hop_as_well(npy, tmp_path):
    scene = Moving(amplitude=-60.0, background=100.0)
    scene.seen[5, HOPPER] += (0.0, -9.0)
    tracks = scene.tracks(npy, tmp_path)
    assert np.argwhere(tracks["status"].to_numpy() & Status.HOPPED).tolist() == [[5, HOPPER]]
    assert np.abs(places_of(tracks) - scene.seen)[5, HOPPER].max() < 0.5


def test_columns_that_stay_have_the_same_fits_bit_for_bit(npy, tmp_path):
    scene = Moving()
    scene.seen[3:, HOPPER] += (8.0, 0.0)
    found, without = scene.tracks(npy, tmp_path / "found"), scene.tracks(npy, tmp_path / "without", search_px=0.0)
    hopped = found["status"] & np.uint16(Status.HOPPED)
    assert not (without["status"] & np.uint16(Status.HOPPED)).any()
    assert not is_accepted(without["status"]).to_numpy()[3:, HOPPER].any()
    for name in ("fit", "stderr", "intensity", "status", "p_value", "centroid"):
        same = found[name].where(hopped == 0)
        np.testing.assert_array_equal(same, without[name].where(hopped == 0))


def test_a_column_that_goes_is_found_nowhere(npy, tmp_path):
    scene = Moving()
    scene.seen[4:, HOPPER] = np.nan
    status = scene.tracks(npy, tmp_path)["status"].to_numpy()
    assert not is_accepted(status[4:, HOPPER]).any()
    assert not (status & Status.HOPPED).any()


def test_a_neighbour_that_moves_in_is_one_column(npy, tmp_path):
    """One column goes; its neighbour crosses the middle between both, and then stands in its place."""
    scene = Moving()
    step = scene.place[HOPPER] - scene.place[NEIGHBOUR]
    scene.seen[2:, HOPPER] = np.nan
    scene.seen[3, NEIGHBOUR] += 0.65 * step
    scene.seen[4:, NEIGHBOUR] += step
    tracks = scene.tracks(npy, tmp_path)
    good = is_accepted(tracks["status"].to_numpy())
    assert good[:, NEIGHBOUR].tolist() == [True] * 3 + [False] * (N_FRAMES - 3)
    assert good[:, HOPPER].tolist() == [True, True, False] + [True] * (N_FRAMES - 3)
    assert np.abs(places_of(tracks)[3:, HOPPER] - scene.seen[3:, NEIGHBOUR]).max() < 0.6


def test_a_frame_that_is_displaced_has_no_hops(npy, tmp_path):
    scene = Moving()
    scene.seen[4] += (7.0, 0.0)
    status = scene.tracks(npy, tmp_path)["status"].to_numpy()
    assert not (status & Status.HOPPED).any()
    assert not is_accepted(status[4]).any()


@pytest.mark.parametrize("apart", [0.0, 4.0])
def test_two_columns_do_not_end_on_one_atom(npy, tmp_path, apart):
    """A table may name an atom twice."""
    scene = Moving()
    columns = scene.columns()
    more = columns.isel(column_id=[HOPPER]).assign_coords(column_id=[99])
    more["x_ref"], more["fit_ref"] = more["x_ref"] + apart, more["fit_ref"].copy()
    more["fit_ref"][:, 1] += apart
    both = xr.concat([columns, more], "column_id").assign_attrs(columns.attrs)
    tracks = scene.tracks(npy, tmp_path, columns=both)
    status = tracks["status"].to_numpy()
    assert is_accepted(status[:, :-1]).all()
    assert ((status[:, -1] & Status.SAME_ATOM) > 0).all()
    assert not is_accepted(status[:, -1]).any()
