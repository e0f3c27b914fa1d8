"""Graphs, fits and frames: what is drawn against the data."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from plotted import BLUR, N_FRAMES, PIXEL_PM, PLACES, SHAPE, every_axes, make_tracks, parameters

from tract_dask import plots
from tract_dask.cli.main import main
from tract_dask.errors import SettingsError, StoreError
from tract_dask.kernels.gaussian.model import evaluate, gaussian_image
from tract_dask.kernels.windows import blur
from tract_dask.plots.base import course
from tract_dask.plots.of_run import FIGURES, draw_figures

DOSES = np.array([125.0, 500.0, 2000.0])


@pytest.fixture(scope="module")
def tracks() -> xr.Dataset:
    return make_tracks()


def movie_of(tracks: xr.Dataset) -> SimpleNamespace:
    """Frames without noise that show, before the blur, what the tracks say."""

    def read(start: int, stop: int, rows: slice, columns: slice) -> np.ndarray:
        frames = []
        for frame in range(start, stop):
            fits = tracks["fit"].to_numpy()[frame].copy()
            fits[:, [2, 1]] += tracks["drift"].to_numpy()[frame]
            image = 20.0 + sum(gaussian_image(fit, SHAPE) - 20.0 for fit in fits)
            frames.append(image[rows, columns] / 2)
        return np.array(frames, np.float32)

    return SimpleNamespace(read=read, counts=lambda pixels: 2 * pixels, gain=2.0, shape=(N_FRAMES, *SHAPE))


def titled(figure: Figure, start: str):
    return next(axes for axes in every_axes(figure) if axes.get_title(loc="left").startswith(start))


def test_precision_is_drawn_against_dose_and_the_bound():
    curves = {"gaussian": 10.0, "centroid": 12.0, "centroid_all": 13.0, "theory": 5.0, "crlb": 8.0}
    scale = np.sqrt(DOSES[0] / DOSES)
    values = {name: ("dose", value * scale) for name, value in curves.items()}
    errors = {f"{name}_stderr": ("dose", 0.1 * value * scale) for name, value in curves.items()}
    above, below = plots.plot_precision(xr.Dataset(values | errors, {"dose": DOSES})).axes
    found = {bar.get_label(): bar for bar in above.containers}
    np.testing.assert_allclose(found["Gaussian fit"].lines[0].get_ydata(), 10 * scale)
    lengths = [np.ptp(segment[:, 1]) for segment in found["Gaussian fit"].lines[2][0].get_segments()]
    np.testing.assert_allclose(lengths, 2 * 0.1 * 10 * scale)
    bound = next(line for line in above.lines if line.get_label().startswith("Cram"))
    np.testing.assert_allclose(bound.get_xydata(), np.stack([DOSES, 8 * scale], axis=1))
    np.testing.assert_allclose(below.containers[0].lines[0].get_ydata(), 10 / 8)
    assert [text.get_text() for text in below.get_xticklabels()] == ["125", "500", "2000"]


def look_up() -> xr.Dataset:
    middle = np.array([0.15, 0.27, 0.37, 0.43, 0.44, 0.42, np.nan])
    values = {"intensity": middle, "low": middle - 0.01, "high": middle + 0.02}
    table = xr.Dataset({name: ("atoms", value) for name, value in values.items()}, {"atoms": np.arange(1, 8)})
    table["intensity"].attrs["units"] = "vacuum A^2"
    return table


def test_the_look_up_curve_has_the_range_of_the_sites_and_its_falling_branch():
    axes = plots.plot_look_up(look_up()).axes[0]
    (bars,) = axes.containers
    np.testing.assert_allclose(bars.lines[0].get_xydata()[:, 1], look_up()["intensity"][:6])
    segment = bars.lines[2][0].get_segments()[0]
    np.testing.assert_allclose(segment[:, 1], [0.14, 0.17])
    assert axes.patches[0].get_x() == 5.5
    assert axes.get_ylabel() == "Intensity (1 Å$^2$ of vacuum = 1)"


def test_intensity_against_dose_has_both_errors_and_the_levels_of_the_table():
    error = 0.1 * np.sqrt(DOSES[0] / DOSES)
    values = {"intensity": 0.37 + 0 * error, "error_68": error, "error_95": 1.96 * error}
    against = xr.Dataset(
        {name: (("dose", "column_id"), value[:, None]) for name, value in values.items()},
        {"dose": DOSES, "column_id": [7]},
    )
    axes = plots.plot_intensity_against_dose(against, table=look_up()).axes[0]
    bold = {bar.get_label(): bar.lines[2][0] for bar in axes.containers}
    for label, factor in (("68 %", 1.0), ("95 %", 1.96)):
        lengths = [np.ptp(segment[:, 1]) for segment in bold[label].get_segments()]
        np.testing.assert_allclose(lengths, 2 * factor * error)
    assert bold["68 %"].get_linewidth()[0] > bold["95 %"].get_linewidth()[0]
    levels = sorted(
        line.get_ydata()[0] for line in axes.lines if line.get_xdata()[0] == 0 and len(line.get_xdata()) == 2
    )
    np.testing.assert_allclose(levels, look_up()["intensity"][:5])
    labels = [text.get_text() for text in axes.texts]
    assert labels == ["1", "2", "3", "4, 5", "atoms"]
    with pytest.raises(SettingsError, match="99"):
        plots.plot_intensity_against_dose(against, 99)


def test_intensity_in_time_has_its_errors_and_marks_what_is_not_accepted(tracks):
    axes = plots.plot_intensity(tracks, [1]).axes[0]
    wide, narrow = (c for c in axes.collections if isinstance(c, LineCollection))
    for bars, factor in ((wide, 1.96), (narrow, 1.0)):
        segments = np.array(bars.get_segments())
        assert len(segments) == N_FRAMES - 1
        np.testing.assert_allclose(np.ptp(segments[..., 1], axis=1), 2 * factor * 25.0)
    marks = next(line for line in axes.lines if line.get_marker() == "|")
    np.testing.assert_allclose(marks.get_xdata(), [0.4])
    assert axes.get_xlabel() == "Time (s)"


def test_no_line_crosses_a_gap_where_frames_were_lost():
    time = np.arange(60.0)
    time[20:] += 5
    time[41:] += 0.4  # late, not lost
    short = course(time, np.arange(60.0))
    assert np.flatnonzero(np.isnan(short.time)).tolist() == [20]
    assert np.flatnonzero(np.isnan(short.middle)).tolist() == [20]
    long = np.arange(20_000.0)
    long[7001:] += 300
    found = course(long, np.random.default_rng(0).normal(size=long.size))
    lost = np.flatnonzero(np.isnan(found.time))
    assert len(lost) == 1
    assert found.time[lost[0] - 1] < 7001 < 7300 < found.time[lost[0] + 1]
    assert all(np.isnan(values[lost[0]]) for values in found)
    assert np.isfinite(np.delete(found.low, lost)).all()


def test_a_long_course_is_drawn_as_quantiles_of_runs():
    rng = np.random.default_rng(0)
    time = np.arange(30_000.0)
    values = np.where(time < 15_000, 0.0, 5.0) + rng.normal(size=30_000)
    values[20_000], values[7] = 60.0, np.nan
    found = course(time, values)
    assert len(found.time) == 300
    assert found.most.max() == 60
    np.testing.assert_allclose(found.middle[:150].mean(), 0, atol=0.05)
    np.testing.assert_allclose((found.high - found.low).mean(), 2 * 0.994, rtol=0.05)
    short = course(time[:50], values[:50])
    assert short.low.size == 0
    np.testing.assert_array_equal(short.middle, values[:50])


@pytest.mark.parametrize(("size", "unit", "factor"), [(4.0, "pm", 4.0), (4000.0, "nm", 4.0), (None, "px", 1.0)])
def test_drift_is_drawn_in_the_unit_that_is_known(tracks, size, unit, factor):
    figure = plots.plot_drift(tracks.assign_attrs(pixel_size_pm=size))
    graph, plane = figure.axes[:2]
    assert graph.get_ylabel() == f"Drift ({unit})"
    for line, axis in zip(graph.lines, ("y", "x"), strict=True):
        np.testing.assert_allclose(line.get_ydata(), factor * tracks["drift"].sel(axis=axis))
    start = next(line for line in plane.lines)
    np.testing.assert_allclose(start.get_xydata()[0], factor * tracks["drift"].to_numpy()[0, ::-1])
    assert plane.yaxis_inverted()


def test_a_fit_is_drawn_with_its_pixels_and_its_cuts(tracks):
    figure = plots.plot_fit(tracks, movie_of(tracks), 5, 3)
    fit = tracks["fit"].to_numpy()[3, 4].copy()
    fit[[2, 1]] += tracks["drift"].to_numpy()[3]
    data, model, residual = (titled(figure, f"{letter}  ").images[0] for letter in "abc")
    left, right, bottom, top = data.get_extent()
    rows, columns = np.mgrid[top + 0.5 : bottom, left + 0.5 : right]
    np.testing.assert_allclose(model.get_array(), evaluate(fit, columns, rows))
    whole = blur(2.0 * movie_of(tracks).read(3, 4, slice(None), slice(None))[0], BLUR)
    expected = whole[int(top + 0.5) : int(bottom + 0.5), int(left + 0.5) : int(right + 0.5)]
    np.testing.assert_allclose(data.get_array(), expected, rtol=1e-5)
    np.testing.assert_allclose(residual.get_array(), data.get_array() - model.get_array(), rtol=1e-5, atol=1e-9)
    assert residual.norm.vmin == -residual.norm.vmax
    cut = titled(figure, "d")
    line = next(line for line in cut.lines if line.get_label() == "fit")
    x, y = line.get_xydata().T
    np.testing.assert_allclose(y, 20 + 50 * np.exp(-((x / PIXEL_PM) ** 2) / (2 * 6.0**2)), rtol=1e-6)
    assert cut.get_title(loc="left").endswith(f"FWHM {2.3548 * 6 * PIXEL_PM:.0f} pm")
    minor = next(line for line in titled(figure, "e").lines if line.get_label() == "fit")
    np.testing.assert_allclose(minor.get_ydata().max(), 70, rtol=1e-3)


def test_the_fit_in_the_sum_needs_no_movie(tracks):
    image = 20.0 + sum(gaussian_image(fit, SHAPE) - 20.0 for fit in parameters())
    summed = xr.Dataset({"image": (("y", "x"), image), "exposure": (("y", "x"), np.ones(SHAPE, "u4"))})
    figure = plots.plot_fit(tracks, summed, 2)
    shown = titled(figure, "b").images[0]
    assert shown.get_array().max() == pytest.approx(70, rel=1e-3)
    for arguments, message in (
        ((summed, 2, 3), "go together"),
        ((summed, 77), "77"),
        ((movie_of(tracks), 2, 999), "999"),
    ):
        with pytest.raises(SettingsError, match=message):
            plots.plot_fit(tracks, *arguments)


def test_displacements_are_arrows_between_crosses(tracks):
    still = tracks.assign(drift=(("frame", "axis"), tracks["drift"].to_numpy().round() + 0.25))
    figure = plots.plot_displacement(still, movie_of(still), 14, 15, [1, 2, 4, 5])
    places = still["fit"].sel(parameter=["x", "y"], column_id=[1, 2, 4, 5]).to_numpy()
    for start, frame in (("a", 14), ("b", 15)):
        panel = titled(figure, start)
        np.testing.assert_allclose(panel.lines[0].get_xydata(), places[frame])
        left, _, _, top = panel.images[0].get_extent()
        image = panel.images[0].get_array()
        ny, nx = image.shape
        y, x = np.mgrid[:ny, :nx]
        weight = np.clip(image - 20, 0, None) * (
            np.hypot(x + left + 0.5 - PLACES[0, 0], y + top + 0.5 - PLACES[0, 1]) < 15
        )
        centre = [(weight * x).sum() / weight.sum() + left + 0.5, (weight * y).sum() / weight.sum() + top + 0.5]
        np.testing.assert_allclose(centre, places[frame, 0], atol=0.1)
    panel = titled(figure, "d")
    arrows = [c for c in panel.collections if isinstance(c, Quiver) and c.get_label()[0] == "p"]
    certain = next(c for c in arrows if c.get_label().startswith("p <"))
    np.testing.assert_allclose(certain.XY, [PLACES[1]])
    step = (places[15] - places[14])[1]
    drawn = np.array([certain.U[0], certain.V[0]])
    np.testing.assert_allclose(drawn / np.hypot(*drawn), step / np.hypot(*step))
    assert f"{np.hypot(*step) * PIXEL_PM:.1f} pm" in [text.get_text() for text in panel.texts]
    factor = np.hypot(*drawn) / np.hypot(*step)
    assert f"{factor:.0f} times enlarged" in panel.get_title(loc="left")


def test_presence_is_a_raster_with_its_events(tracks):
    rng = np.random.default_rng(1)
    strength = rng.normal(size=(N_FRAMES, 6)) + 12.0
    strength[:10, 2] -= 12.0
    strength[3:6, 4] = np.nan
    seen = tracks.assign(
        presence=(("frame", "column_id"), strength.astype("f4")),
        presence_vacuum=(("frame", "place"), rng.normal(size=(N_FRAMES, 20)).astype("f4")),
    )
    events = xr.Dataset(
        {"column_id": ("event", [3]), "frame": ("event", [10]), "kind": ("event", np.array(["appears"], object))}
    )
    axes = plots.plot_presence(seen, events=events, false_alarm_rate=1e-4).axes[0]
    shown = np.ma.filled(axes.collections[0].get_array(), np.nan).reshape(6, N_FRAMES)
    expected = np.ones((6, N_FRAMES))
    expected[2, :10], expected[4, 3:6] = 0, np.nan
    assert "not looked at" in [text.get_text() for text in axes.get_legend().get_texts()]
    np.testing.assert_array_equal(shown, expected)
    mark = next(line for line in axes.lines if line.get_label() == "appears")
    np.testing.assert_allclose(mark.get_xydata(), [[1.0, 2]])


def test_figures_that_do_not_exist_and_runs_that_are_not_there_are_refused(tmp_path):
    with pytest.raises(SettingsError, match="nonsense"):
        draw_figures(tmp_path, only=["nonsense"])
    with pytest.raises(StoreError, match="not a finished run"):
        draw_figures(tmp_path)
    result = CliRunner().invoke(main, ["figures", str(tmp_path), "--only", "sum,nonsense"])
    assert result.exit_code == 2
    assert "nonsense" in result.output
    assert all(name in CliRunner().invoke(main, ["figures", "--help"]).output for name in FIGURES)
