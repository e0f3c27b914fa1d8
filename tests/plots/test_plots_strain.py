"""Maps over kinds: colours, arrows and lines against the numbers that they show."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.quiver import Quiver
from perovskite import FRAMES, OFF_CENTRE, PIXEL_PM, field, tracks_of

from tract_dask import plots
from tract_dask.analysis.polarisation import neighbour_distances, polarisation
from tract_dask.analysis.strain import strain
from tract_dask.errors import SettingsError
from tract_dask.store.columns import positions


@pytest.fixture(scope="module")
def tracks():
    return tracks_of(field)


@pytest.fixture(scope="module")
def summed():
    shape = 520, 560
    image = {"image": (("y", "x"), np.ones(shape)), "exposure": (("y", "x"), np.full(shape, FRAMES, "u4"))}
    return xr.Dataset(image, attrs={"pixel_size_pm": PIXEL_PM})


def only(axes, kind):
    return next(shown for shown in axes.collections if isinstance(shown, kind) and shown.get_array() is not None)


def test_strains_share_a_scale_that_is_even_about_zero(tracks, summed, tmp_path):
    found = strain(tracks, "A")
    figure = plots.plot_strain(found, summed, tmp_path / "strain.png")
    assert (tmp_path / "strain.png").exists()
    for axes, name in zip(figure.axes[:3], ("xx", "yy", "xy"), strict=True):
        value = 100 * found[name].to_numpy()
        discs = only(axes, PathCollection)
        np.testing.assert_allclose(discs.get_array(), value[np.isfinite(value)])
        assert discs.norm.vmin == -discs.norm.vmax
        assert f" {name}, ±" in axes.get_title(loc="left")
    with pytest.raises(SettingsError, match="no such component"):
        plots.plot_strain(found, summed, components=["zz"])


def test_arrows_point_where_columns_are_off_their_centres(tracks, summed):
    found = polarisation(tracks)
    axes = plots.plot_polarisation(found, summed).axes[0]
    arrows = only(axes, Quiver)
    moved = found["displacement"].to_numpy()
    seen = np.isfinite(moved).all(axis=1)
    np.testing.assert_allclose(arrows.get_array(), np.hypot(*moved[seen].T))
    np.testing.assert_allclose(np.arctan2(arrows.V, arrows.U), np.arctan2(*moved[seen].T[::-1]))
    assert f"{moved[seen].mean(axis=0)[1]:.1f}" in axes.get_title(loc="left")
    assert moved[seen].mean(axis=0)[1] == pytest.approx(OFF_CENTRE[1], abs=1)


def test_lines_join_neighbours(tracks, summed):
    found = neighbour_distances(tracks, "A", "B")
    axes = plots.plot_neighbour_distances(found, summed).axes[0]
    lines = only(axes, LineCollection)
    np.testing.assert_allclose(lines.get_array(), found["distance"])
    ends = np.array([lines.get_segments()[0][0], lines.get_segments()[0][-1]])
    pair = positions(tracks.sel(column_id=[int(found["first"][0]), int(found["second"][0])]))
    np.testing.assert_allclose(np.sort(ends, axis=0), np.sort(pair, axis=0), atol=1.5)
    with pytest.raises(SettingsError, match="size of a pixel"):
        plots.plot_neighbour_distances(found, summed.drop_attrs())
