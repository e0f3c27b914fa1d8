"""Figures over the summed image: their colours, places and lengths against the data that they show."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_hex
from matplotlib.quiver import Quiver
from plotted import BLUR, JUMP_FRAME, JUMP_PX, N_FRAMES, PIXEL_PM, PLACES, SHAPE, every_axes, make_tracks, parameters

from tract_dask import plots
from tract_dask.analysis import jumps, motion
from tract_dask.analysis.intensity import repeated_error
from tract_dask.errors import SettingsError
from tract_dask.kernels.gaussian.model import gaussian_image
from tract_dask.plots.base import scale_of


@pytest.fixture(scope="module")
def summed() -> xr.Dataset:
    image = 20.0 + sum(gaussian_image(fit, SHAPE) - 20.0 for fit in parameters())
    return xr.Dataset(
        {"image": (("y", "x"), image), "exposure": (("y", "x"), np.ones(SHAPE, "u4"))},
        attrs={"pixel_size_pm": PIXEL_PM, "n_frames": N_FRAMES},
    )


@pytest.fixture(scope="module")
def tracks() -> xr.Dataset:
    return make_tracks()


def discs(axes) -> PathCollection:
    return next(c for c in axes.collections if isinstance(c, PathCollection) and c.get_array() is not None)


def test_the_map_of_spreads_has_the_colours_of_both_kinds_of_fit(tracks, summed):
    figure = plots.plot_spread(tracks, summed)
    spread = motion.spread(tracks)["sd"].to_numpy()
    both = figure.axes[:2]
    gaussian, centroid = (discs(axes) for axes in both)
    np.testing.assert_allclose(gaussian.get_offsets(), PLACES)
    np.testing.assert_allclose(gaussian.get_array(), spread)
    np.testing.assert_allclose(centroid.get_array()[1:], 1.5 * spread[1:])  # of all frames: one of the first's is out
    assert gaussian.norm.vmin == centroid.norm.vmin == pytest.approx(min(spread.min(), *centroid.get_array()))
    assert f"median {np.median(spread):.1f} pm" in both[0].get_title(loc="left")
    assert "Standard deviation per axis (pm)" in [axes.get_ylabel() for axes in every_axes(figure)]


def test_one_restless_column_does_not_flatten_the_others():
    values = np.r_[np.linspace(4, 6, 99), 60.0]
    scale = scale_of(values)
    assert scale.extend == "max"
    assert 5.9 < scale.norm.vmax < 8
    assert scale_of(values[:-1]).extend == "neither"
    assert scale_of([np.nan]).norm.vmax == 1


@pytest.mark.parametrize(("size", "label"), [(4.0, "0.1 nm"), (400.0, "10 nm"), (None, "20 px")])
def test_scale_bars_are_as_long_as_they_say(summed, size, label):
    figure = plots.plot_sum(summed.assign_attrs(pixel_size_pm=size))
    image = figure.axes[0]
    (bar,) = image.patches
    assert [text.get_text().strip() for text in image.texts] == [label]
    assert bar.get_width() == pytest.approx(float(label.split()[0]) * (1000 / size if size else 1))


def test_the_transform_shows_a_lattice_at_its_spatial_frequency():
    x = np.arange(256)
    image = np.broadcast_to(10 + np.cos(2 * np.pi * x / 16), (200, 256)) + 0.01 * np.random.default_rng(0).normal(
        size=(200, 256)
    )
    summed = xr.Dataset(
        {"image": (("y", "x"), image), "exposure": (("y", "x"), np.ones(image.shape, "u4"))},
        attrs={"pixel_size_pm": 10.0},
    )
    axes = plots.plot_sum(summed).axes[1]
    shown = axes.images[0]
    left, right, bottom, top = shown.get_extent()
    row, column = np.unravel_index(np.argmax(shown.get_array()), shown.get_array().shape)
    ny, nx = shown.get_array().shape
    assert abs(left + (column + 0.5) * (right - left) / nx) == pytest.approx(1 / 16, abs=1e-3)
    assert top + (row + 0.5) * (bottom - top) / ny == pytest.approx(0, abs=5e-3)
    length = float(axes.texts[0].get_text().split()[0])
    assert axes.patches[0].get_width() == pytest.approx(length / 100)  # 100 cycles a nm are one a px of 10 pm


def test_ellipses_at_half_maximum_have_the_size_and_direction_of_the_fit(tracks, summed):
    figure = plots.plot_fwhm(tracks, summed)
    (rings,) = (c for c in figure.axes[0].collections if isinstance(c, LineCollection))
    sigma_a, sigma_b = np.sqrt(6.0**2 - BLUR**2), np.sqrt(4.0**2 - BLUR**2)
    half = np.sqrt(2 * np.log(2))
    outline = rings.get_segments()[4] - PLACES[4]
    away = np.hypot(*outline.T)
    assert away.max() == pytest.approx(half * sigma_a, rel=1e-3)
    assert away.min() == pytest.approx(half * sigma_b, rel=1e-3)
    along = outline[away.argmax()] / away.max()
    assert abs(along @ [np.cos(0.5), -np.sin(0.5)]) == pytest.approx(1, abs=1e-3)
    np.testing.assert_allclose(rings.get_array(), 2 * half * PIXEL_PM * np.sqrt(sigma_a * sigma_b), rtol=1e-4)


def test_jumps_are_arrows_and_points_in_time(tracks, summed):
    found = jumps.change_points(tracks, confidence=0.99)
    assert found["column_id"].to_numpy().tolist() == [2]
    figure = plots.plot_jumps(found, tracks, summed)
    image, raster = (axes for axes in every_axes(figure) if axes.get_title(loc="left")[:1] in ("a", "b"))
    (arrows,) = (c for c in image.collections if isinstance(c, Quiver))
    np.testing.assert_allclose(arrows.XY, [PLACES[1]])
    direction = np.array([arrows.U[0], arrows.V[0]])
    step = found["step"].sel(axis=["x", "y"]).to_numpy()[0]
    np.testing.assert_allclose(direction / np.hypot(*direction), step / np.hypot(*step))
    assert discs(image).get_array().tolist() == [1]
    (point,) = discs(raster).get_offsets()
    assert point.tolist() == pytest.approx([0.1 * JUMP_FRAME, 2])
    assert discs(raster).get_array()[0] == pytest.approx(float(found["size"][0]))
    none = plots.plot_jumps(found.isel(jump=[]), tracks, summed)
    assert any(axes.get_title(loc="left") == "a  No jumps were found" for axes in every_axes(none))


def test_tracks_are_enlarged_about_their_mean(tracks, summed):
    figure = plots.plot_tracks(tracks, summed, [2, 3])
    image = next(axes for axes in every_axes(figure) if axes.get_title(loc="left").startswith("Tracks"))
    factor = float(image.get_title(loc="left").split()[1])
    (lines,) = (c for c in image.collections if isinstance(c, LineCollection))
    assert len(lines.get_segments()) == (N_FRAMES - 1) * len(PLACES) - 2  # one fit is not accepted
    place = tracks["fit"].sel(parameter=["x", "y"], column_id=3).to_numpy()
    expected = PLACES[2] + factor * (place - place.mean(axis=0))
    drawn = [segment for segment in lines.get_segments() if np.allclose(segment[0], expected[0])]
    np.testing.assert_allclose(drawn, [expected[:2]])
    graphs = {axes.get_title(loc="left"): axes for axes in every_axes(figure)}
    x, y = (line.get_ydata() for line in graphs["Column 2"].lines)
    assert x[JUMP_FRAME:].mean() - x[:JUMP_FRAME].mean() == pytest.approx(JUMP_PX[0] * PIXEL_PM, abs=1.0)
    assert y[JUMP_FRAME:].mean() - y[:JUMP_FRAME].mean() == pytest.approx(JUMP_PX[1] * PIXEL_PM, abs=1.0)


def test_columns_that_spread_most_are_drawn_by_default(tracks, summed):
    figure = plots.plot_tracks(tracks, summed)
    titles = {axes.get_title(loc="left") for axes in every_axes(figure)}
    assert {"Column 2", "Column 6", "Column 5"} <= titles
    with pytest.raises(SettingsError, match="99"):
        plots.plot_tracks(tracks, summed, [1, 99])


@pytest.mark.parametrize("frame", [None, 3])
def test_numbers_of_atoms_are_written_in_the_colours_of_the_bar(tracks, summed, frame):
    atoms = np.array([0, 1, 2, 3, 4, np.nan])
    low, high = atoms.copy(), atoms.copy()
    high[3] += 1
    counts = xr.Dataset(
        {name: ("column_id", value) for name, value in {"atoms": atoms, "low_95": low, "high_95": high}.items()}
        | {"ambiguous": ("column_id", np.zeros(6, bool))},
        {"column_id": tracks["column_id"]},
    )
    if frame is not None:
        counts = counts.expand_dims(frame=np.arange(N_FRAMES))
    figure = plots.plot_occupancy(counts, tracks, summed, frame)
    axes = figure.axes[0]
    written = {tuple(text.xy): text.get_text() for text in axes.texts if hasattr(text, "xy")}
    assert [written.get(tuple(place)) for place in PLACES] == ["0", "1", "2", "3?", "4", None]
    shown = discs(axes)
    colours = [to_hex(colour) for colour in shown.to_rgba(shown.get_array())]
    assert colours == [to_hex(shown.cmap(level)) for level in range(5)]
    assert "4 of 5" in axes.get_title(loc="left")
    with pytest.raises(SettingsError, match="frame"):
        plots.plot_occupancy(counts, tracks, summed, 3 if frame is None else None)


def test_the_error_by_repetition_is_mapped_and_drawn_against_dose(tracks, summed):
    errors = repeated_error(tracks)
    dose = [125.0, 500.0]
    against = xr.Dataset(
        {name: (("dose", "column_id"), np.array([[value], [value / 2]])) for name, value in
         {"sd": 0.2, "sd_stderr": 0.02, "error_68": 0.1, "fitted": 0.15}.items()},
        {"dose": dose, "column_id": [5]},
    )  # fmt: skip
    figure = plots.plot_repeated_error(errors, tracks, summed, against_dose=against)
    image, graph = (axes for axes in every_axes(figure) if axes.get_title(loc="left")[:1] in ("a", "b"))
    np.testing.assert_allclose(discs(image).get_array(), errors["sd"])
    lines = {line.get_label(): line for line in graph.lines}
    np.testing.assert_allclose(lines["Poisson noise, Equation 5"].get_xydata(), [[125, 0.1], [500, 0.05]])
    np.testing.assert_allclose(lines["stated by the fit"].get_ydata(), [0.15, 0.075])
    (bars,) = graph.containers
    np.testing.assert_allclose(bars.lines[0].get_ydata(), [0.2, 0.1])


def test_twenty_thousand_frames_are_drawn_as_quantiles_and_means_of_runs(summed):
    long = make_tracks(20_000).chunk(frame=1000)
    figure = plots.plot_tracks(long, summed, [1])
    image = next(axes for axes in every_axes(figure) if axes.get_title(loc="left").startswith("Tracks"))
    (lines,) = (c for c in image.collections if isinstance(c, LineCollection))
    assert len(lines.get_segments()) <= 250 * len(PLACES)
    assert "means of 80 frames" in image.get_title(loc="left")
    graph = next(axes for axes in every_axes(figure) if axes.get_title(loc="left") == "Column 1")
    assert all(len(line.get_xdata()) <= 300 for line in graph.lines)
    band = next(c for c in graph.collections)
    outline = band.get_paths()[0].vertices[:, 1]
    place = long["fit"].sel(parameter="x", column_id=1).to_numpy()
    assert outline.max() == pytest.approx(PIXEL_PM * (np.nanmax(place) - np.nanmean(place)), rel=1e-3)


def test_figures_leave_pyplot_alone_and_can_be_saved(tracks, summed, tmp_path: Path):
    before = "matplotlib.pyplot" in sys.modules
    plots.plot_spread(tracks, summed, tmp_path / "spread.pdf")
    assert ("matplotlib.pyplot" in sys.modules) == before
    assert (tmp_path / "spread.pdf").read_bytes()[:4] == b"%PDF"
    with pytest.raises(SettingsError, match="pixel"):
        plots.plot_spread(tracks.assign_attrs(pixel_size_pm=None), summed)
    with pytest.raises(AttributeError, match="plot_nothing"):
        plots.plot_nothing  # noqa: B018
    assert set(plots.__all__) <= set(dir(plots))
