"""Strain, polarisation and distances of neighbours against fields that are known."""

import numpy as np
import pytest
from perovskite import CELL_PM, ERROR_PM, FRAMES, OFF_CENTRE, PIXEL_PM, SIDE, field, tracks_of

from tract_dask.analysis.polarisation import neighbour_distances, polarisation
from tract_dask.analysis.strain import lattice_of, strain
from tract_dask.errors import InputError, SettingsError


@pytest.fixture(scope="module")
def strained():
    return tracks_of(field)


def test_a_strain_that_is_known_is_found_within_its_error(strained):
    found = strain(strained, "A")
    x = strained["x_ref"].to_numpy()[strained["kind"].to_numpy() == "A"] * PIXEL_PM - 2000.0
    truth = {"xx": 0.04 / 3500 * x, "yy": 0.01, "xy": 0.006, "rotation": 0.003}
    seen = np.isfinite(found["xx"].to_numpy())
    assert 45 < seen.sum() < len(seen)
    for name, true in truth.items():
        expected = np.broadcast_to(true, seen.shape)[seen]
        value = found[name].to_numpy()[seen]
        pull = (value - value.mean() - (expected - expected.mean())) / found[f"{name}_stderr"].to_numpy()[seen]
        assert 0.8 < pull.std() < 1.2, name
        assert abs(pull.mean()) < 0.3
    assert found["xx_stderr"].median() == pytest.approx(ERROR_PM / np.sqrt(FRAMES) / CELL_PM / np.sqrt(6), rel=0.15)


def test_strain_is_relative_to_the_reference_and_nan_where_neighbours_are_missing(strained):
    left = strained["column_id"].to_numpy()[(strained["kind"] == "A") & (strained["x_ref"] < 120)]
    found = strain(strained, "A", reference=left.tolist())
    assert abs(float(found["xx"].sel(column_id=left).mean())) < 2e-3
    assert np.hypot(*found.attrs["a_pm"]) < np.hypot(*strain(strained, "A").attrs["a_pm"])
    assert np.isnan(found["xx"].sel(column_id=41)), "never accepted"
    assert np.isnan(found["xx"].isel(column_id=0)), "a corner has three neighbours"
    assert found["neighbours"].max() == 8


def test_each_frame_has_its_strain():
    found = strain(tracks_of(), "A", frames="each")
    assert found["xx"].dims == ("frame", "column_id")
    spread = found["xx"].std("frame").median() / found["xx_stderr"].median()
    assert float(spread) == pytest.approx(1.0, abs=0.1)
    together = np.sqrt(FRAMES) * strain(tracks_of(), "A")["xx_stderr"].median()
    assert 1.0 < float(together / found["xx_stderr"].median()) < 1.2, "the larger of what fits state and what scatters"


def test_off_centring_is_found_within_its_error_in_a_strained_crystal(strained):
    found = polarisation(strained)
    moved, stderr = found["displacement"].to_numpy(), found["displacement_stderr"].to_numpy()
    seen = np.isfinite(moved).all(axis=1)
    assert seen.sum() == (SIDE - 1) ** 2 - 4, "the four around a column that is not known"
    assert found.attrs["neighbours"] == 4
    np.testing.assert_allclose(moved[seen].mean(axis=0), OFF_CENTRE, atol=1.0)
    centre = 0.04 / 3500 * (CELL_PM / 2) ** 2 / 2 * np.array([1, 0])  # of a parabola, not of noise
    pull = (moved[seen] - OFF_CENTRE + centre) / stderr[seen]
    assert 0.8 < pull.std() < 1.2
    assert np.median(stderr[seen]) == pytest.approx(ERROR_PM / np.sqrt(FRAMES) * np.sqrt(1.25), rel=0.1)


def test_a_centred_crystal_has_no_polarisation_of_its_own_kind(strained):
    each = polarisation(strained, frames="each")["displacement"]
    assert each.dims == ("frame", "column_id", "axis")
    with pytest.raises(InputError, match="between neighbours"):
        polarisation(strained.sel(column_id=[1, 2, 3, 90]))
    with pytest.raises(SettingsError, match="no column is of this kind"):
        polarisation(strained, "C")
    with pytest.raises(SettingsError, match="mean or each"):
        polarisation(strained, frames="all")


def test_distances_between_kinds_have_their_errors():
    tracks = tracks_of()
    same, mixed = neighbour_distances(tracks, "A", "A"), neighbour_distances(tracks, "A", "B")
    assert same.sizes["pair"] == 2 * SIDE * (SIDE - 1) - 4
    pull = (same["distance"] - CELL_PM) / same["distance_stderr"]
    assert float(pull.std()) == pytest.approx(1.0, abs=0.2)
    assert abs(float(pull.mean())) < 0.4
    assert mixed.sizes["pair"] == 4 * (SIDE - 1) ** 2 - 4
    assert float(mixed["distance"].mean()) == pytest.approx(CELL_PM / np.sqrt(2), abs=1.0)
    assert set(tracks["kind"].sel(column_id=mixed["first"]).to_numpy()) == {"A"}


def test_the_lattice_of_pairs_is_that_of_cells():
    i, j = np.mgrid[:8, :7].reshape(2, -1)
    first = np.stack([i * 50.0, j * 40.0], axis=1)
    basis = lattice_of(np.concatenate([first, first + np.array([12.0, 3.0])]))
    np.testing.assert_allclose(np.abs(basis), [[0, 40], [50, 0]], atol=1e-9)
    with pytest.raises(InputError, match="no lattice"):
        lattice_of(first[:4])
