"""The filters beside each other, on a lattice of which one column is off its site."""

import csv

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from conftest import Scene
from matplotlib.figure import Figure

from tract_dask import compare_filters, convert, filter_frames, fit_columns, open_movie
from tract_dask.analysis.filters import (
    FILTERS,
    filtered_region,
    table_rows,
    table_text,
    wiener_shifts,
    write_comparison,
)
from tract_dask.cli import main as cli
from tract_dask.errors import SettingsError
from tract_dask.kernels.total_variation import total_variation
from tract_dask.kernels.wiener import wiener
from tract_dask.kernels.windows import blur
from tract_dask.plots.filters import plot_filters
from tract_dask.settings import FitSettings, MetadataSettings
from tract_dask.store.schema import Status

OFF = 30
"""Index of the column that is off its site, by 4 px along x."""


@pytest.fixture(scope="module")
def lattice(tmp_path_factory):
    """A scene of 8 x 8 columns in vacuum, its movie, and the columns as found."""
    scene = Scene(n_frames=3, shape=(270, 220), spacing=24.0, amplitude=40.0, max_drift=0.0)
    scene.place = np.rint(scene.place)
    scene.place[OFF, 0] += 4
    folder = tmp_path_factory.mktemp("lattice")
    np.save(folder / "movie.npy", scene.counts())
    metadata = MetadataSettings(pixel_size_pm=8.0, gain=2.0)
    movie = open_movie(convert(str(folder / "movie.npy"), folder / "movie.zarr", metadata=metadata))
    columns = scene.columns()
    columns["fit_ref"][:, [0, 6]] *= 2
    return scene, movie, columns


@pytest.fixture(scope="module")
def compared(lattice):
    _, movie, columns = lattice
    return compare_filters(movie, columns, frames=(2, 0), settings=FitSettings(blur_sigma_px=2.0))


def test_wiener_draws_the_column_to_its_site_and_the_others_do_not(compared):
    pulled = compared["x_difference"].isel(column_id=OFF).mean("frame")
    assert pulled.sel(filter="wiener") < -0.6
    assert abs(pulled.sel(filter="gaussian")) < 0.15
    assert abs(pulled.sel(filter="tv-l1")) < 0.4
    still = np.delete(np.arange(compared.sizes["column_id"]), OFF)
    rest = compared["x_difference"].isel(column_id=still).sel(filter="wiener")
    assert float(np.sqrt((rest**2).mean())) < 0.35


def test_every_filter_finds_the_columns_where_they_are(lattice, compared):
    scene, _, _ = lattice
    still = np.delete(np.arange(len(scene.place)), OFF)
    away = np.stack([compared["x"], compared["y"]], axis=-1)[..., still, :] - scene.place[still]
    assert (np.sqrt((away**2).mean(axis=(0, 2, 3))) < [0.15, 0.15, 0.25, 0.35]).all()


def test_filters_raise_r_squared_and_only_known_errors_are_given(compared):
    fit = compared["r_squared"].mean(("frame", "column_id"))
    assert (fit.sel(filter=["gaussian", "wiener", "tv-l1"]) > fit.sel(filter="none") + 0.05).all()
    known = compared["x_stderr"].notnull().all(("frame", "column_id"))
    assert known.to_numpy().tolist() == [True, True, False, False]


def test_the_warning_names_the_column_and_how_far(compared):
    said = wiener_shifts(compared)
    assert sum(f"column {OFF + 1} in 2 of 2 frames" in sentence for sentence in said) == 1
    assert all("px (" in sentence and "pm)" in sentence for sentence in said)
    assert len(said) <= 8


def test_the_table_holds_differences_from_the_unfiltered_frame(compared, tmp_path):
    write_comparison(compared, tmp_path / "filters.csv")
    with (tmp_path / "filters.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * len(FILTERS) * compared.sizes["column_id"] == len(list(table_rows(compared)))
    plain, blurred = (
        next(r for r in rows if (r["frame"], r["filter"], r["column_id"]) == ("2", name, "7"))
        for name in ("none", "gaussian")
    )
    assert float(blurred["x_difference"]) == pytest.approx(float(blurred["x"]) - float(plain["x"]), abs=1e-3)
    share = 100 * (float(blurred["intensity"]) / float(plain["intensity"]) - 1)
    assert float(blurred["intensity_difference"]) == pytest.approx(share, abs=1e-2)
    assert float(plain["x_difference"]) == float(plain["intensity_difference"]) == 0
    assert table_text(compared).count("\n") == len(rows) + 2 * len(FILTERS) - 1


def test_what_is_not_there_cannot_be_compared(lattice):
    _, movie, columns = lattice
    with pytest.raises(SettingsError, match="no such frames"):
        compare_filters(movie, columns, frames=(3,))
    with pytest.raises(SettingsError, match="no such columns"):
        compare_filters(movie, columns, column_ids=(1, 999))


def test_frames_that_are_not_there_are_refused_before_the_run(lattice, tmp_path):
    _, movie, _ = lattice
    np.save(tmp_path / "movie.npy", movie.read(0, 3))
    arguments = ["compare-filters", str(tmp_path / "movie.npy"), str(tmp_path / "out"), "--frame-numbers", "3"]
    answer = CliRunner().invoke(cli.main, arguments)
    assert answer.exit_code == 2
    assert "Expected 0 to 2; got 3" in answer.output
    assert not (tmp_path / "out").exists()


def test_the_figure_shows_each_filter_and_profiles_of_all(lattice, compared, tmp_path):
    _, movie, _ = lattice
    few = compared.sel(column_id=[1, 2, 9, 10])
    region = filtered_region(movie, few, 2)
    assert region.dims == ("filter", "y", "x")
    assert {"x", "y"} <= set(region.coords)
    whole = filter_frames(movie, "wiener")[2].to_numpy()
    part = whole[region.y.to_numpy()[:, None], region.x.to_numpy()]
    np.testing.assert_array_equal(region.sel(filter="wiener"), part)
    figure = plot_filters(region, few, tmp_path / "filters.png")
    assert isinstance(figure, Figure)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["a  Unfiltered", "b  Gaussian blur", "c  Wiener", "d  TV-L1", "e  Profiles"]
    lines = figure.axes[-1].get_lines()
    assert len(lines) == len(FILTERS)
    lowest = [line.get_ydata().min() for line in lines]
    assert lowest == sorted(lowest)
    assert (tmp_path / "filters.png").stat().st_size > 10_000


def test_profiles_are_drawn_wherever_the_line_ends():
    """Its ends are on the region's edges but for rounding, beyond which an interpolation gives NaN."""
    rng = np.random.default_rng(1)
    axes = {"filter": list(FILTERS), "y": np.arange(33, 63), "x": np.arange(9, 89)}
    region = xr.DataArray(rng.normal(size=(len(FILTERS), 30, 80)), axes, ("filter", "y", "x"), attrs={"frame": 0})
    x, y = [65.4, 11.2], [54.5, 47.8]
    shape = (1, len(FILTERS), len(x))
    compared = xr.Dataset(
        {
            axis: (("frame", "filter", "column_id"), np.broadcast_to(values, shape))
            for axis, values in (("x", x), ("y", y))
        },
        {"frame": [0], "filter": list(FILTERS), "column_id": [1, 2]},
    )
    lines = plot_filters(region, compared).axes[-1].get_lines()
    assert len(lines) == len(FILTERS)
    assert all(np.isfinite(line.get_ydata()).all() for line in lines)


@pytest.mark.parametrize("name", FILTERS)
def test_filtered_frames_are_lazy_and_those_of_the_kernels(lattice, name):
    scene, movie, _ = lattice
    frames = filter_frames(movie, name, tv_iterations=50)
    assert isinstance(frames, xr.DataArray)
    assert frames.chunks[0] == (1, 1, 1)
    assert (frames.dims, frames.dtype, frames.attrs["units"]) == (("t", "y", "x"), np.float32, "counts")
    counts = 2 * scene.counts()[1].astype(np.float32)
    expected = {
        "none": lambda: counts,
        "gaussian": lambda: blur(counts, 2.0),
        "wiener": lambda: wiener(counts),
        "tv-l1": lambda: total_variation(counts, 0.9, max_iterations=50),
    }[name]()
    found = frames[1].to_numpy()
    if name == "tv-l1":  # counts are spread over their unit before
        assert np.abs(found - expected).mean() < 0.5 * 2
        np.testing.assert_array_equal(found, filter_frames(movie, name, tv_iterations=50)[1].to_numpy())
    else:
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("name", ["wiener", "tv-l1"])
def test_the_fit_stage_filters_whole_frames(lattice, name):
    """Positions are those of the same filter in a notebook; the noise is that of its vacuum; errors are unknown."""
    _, movie, columns = lattice
    settings = FitSettings(filter=name, shape="free", vacuum_box=(4, 44, 4, 200))
    tracks = fit_columns(movie, columns, None, settings).compute()
    compared = compare_filters(movie, columns, frames=(0, 1, 2), settings=settings).sel(filter=name)
    converged = (tracks.status & Status.NOT_CONVERGED) == 0
    np.testing.assert_allclose(tracks.fit.sel(parameter="x").where(converged), compared["x"], atol=1e-9)
    vacuum = filter_frames(movie, name)[:, 4:44, 82:122].std(("y", "x"))
    np.testing.assert_allclose(tracks.noise, np.repeat(vacuum.to_numpy()[:, None], 64, axis=1), rtol=1e-5)
    assert tracks.stderr.isnull().all()
    assert tracks.intensity_stderr.isnull().all()
    assert converged.mean() > 0.98


def test_unknown_filters_and_parameters_are_refused(lattice):
    _, movie, _ = lattice
    with pytest.raises(SettingsError, match="no such choice"):
        filter_frames(movie, "median")
    with pytest.raises(SettingsError, match="no setting 'strength'"):
        filter_frames(movie, "wiener", strength=2)


def test_filtered_frames_are_not_counts():
    with pytest.raises(SettingsError, match="not counts"):
        FitSettings(filter="wiener", estimator="poisson")
