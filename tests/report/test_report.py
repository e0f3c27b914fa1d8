"""The report: its numbers against the Dataset's, its warnings where they belong, and a page that needs nothing else."""

import base64
import dataclasses
import io
import json
import re
from contextlib import contextmanager
from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr
from conftest import Scene, store_fits
from matplotlib import colormaps
from matplotlib.image import imread

from tract_dask import convert, find_columns
from tract_dask.analysis import overview
from tract_dask.errors import StoreError
from tract_dask.kernels.gaussian.model import evaluate
from tract_dask.report import page
from tract_dask.report import survey as survey_module
from tract_dask.report.findings import findings
from tract_dask.report.interactive import quantised, script_json
from tract_dask.report.look import look
from tract_dask.report.page import cards, is_current, write_report
from tract_dask.report.residuals import residual_windows, residuals
from tract_dask.report.survey import gathered, survey
from tract_dask.service.api.results import _REPORT_POLICY
from tract_dask.service.views import tracks as tracks_of_job
from tract_dask.settings import ColumnSettings, FitSettings, RunSettings, to_toml
from tract_dask.store import datasets, metadata, results, schema
from tract_dask.store.columns import column_dataset
from tract_dask.store.schema import Status

N_FRAMES, ERROR_PX, PIXEL_PM = 40, 0.5, 4.0
WAIT_MS = 15_000
KIND = "Ce</script><!--<b>&"
VOID = {"meta", "link", "img", "br", "hr", "input"}


class Page(HTMLParser):
    """Checks that elements close in order, and keeps what a test asks for."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open, self.references, self.findings, self.alternatives = [], [], {}, []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.references += [values[name] for name in ("src", "href", "srcset", "action") if name in values]
        if "data-finding" in values:
            self.findings[values["data-finding"]] = values["class"]
        if tag == "img":
            self.alternatives.append(values.get("alt", ""))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


class Run:
    """A folder with tracks whose numbers are known: columns that keep still with errors as they are stated."""

    def __init__(self, folder, **about):
        self.scene = Scene(n_frames=N_FRAMES, seed=3)
        columns, n = self.scene.columns(), len(self.scene.place)
        rng = np.random.default_rng(5)
        self.values = {}
        for name, variable in schema.RESULTS.items():
            sizes = {"frame": N_FRAMES, "column_id": n} | schema.SIZES
            self.values[name] = np.zeros([sizes[dim] for dim in variable.dims], variable.dtype)
        self.values["fit"][:] = columns["fit_ref"].to_numpy()
        self.values["fit"][..., 1:3] += rng.normal(0, ERROR_PX, (N_FRAMES, n, 2))
        self.values["stderr"][:] = ERROR_PX
        self.values["intensity"][:] = 4000 + rng.normal(0, 50, (N_FRAMES, n))
        self.values["intensity_stderr"][:] = 50
        self.values["r_squared"][:] = 0.8
        self.values["p_value"][:] = 0.5
        self.values["drift"][:] = self.values["drift_measured"][:] = self.scene.drift
        self.values["time"][:] = 0.1 * np.arange(N_FRAMES)
        self.folder, self.columns = folder, columns
        self.about = {"pixel_size_pm": PIXEL_PM, "frame_time_s": 0.1, "dose": 500.0} | about
        self.settings, self.quality = RunSettings(), None
        self.found = {"contrast": "bright", "contrast_rival": 0.01, "lattice_px": 30.0, "spacing_px": 30.0}

    def write(self):
        path = self.folder / "results.zarr"
        results.create(
            path,
            self.columns,
            self.values["drift_measured"],
            self.values["time"],
            N_FRAMES,
            settings=to_toml(dataclasses.replace(self.settings.fit, blur_sigma_px=2.0)),
            window=19,
            reference_blur_px=2.0,
            created="2026-11-22T08:00:00+00:00",
            source="/data/movie.tif",
            versions={"tract_dask": "0.1.0"},
            **self.about,
        )
        stored = {name: values for name, values in self.values.items() if name not in ("time", "drift_measured")}
        store_fits(path, stored, N_FRAMES)
        if self.quality is not None:
            drift = xr.Dataset({"quality": ("frame", self.quality), "drift": (("frame", "axis"), self.scene.drift)})
            datasets.write_dataset(drift, self.folder / "drift.zarr")
        found = self.columns.assign_attrs(self.found)
        datasets.write_dataset(found, self.folder / "columns.zarr")
        summed = self.scene.summed()
        summed.attrs = {"pixel_size_pm": self.about["pixel_size_pm"]} if self.about["pixel_size_pm"] else {}
        datasets.write_dataset(summed, self.folder / "sum.zarr")
        (self.folder / "run.toml").write_text(to_toml(self.settings))
        return self.folder

    def names(self):
        found = findings(survey(self.write(), []))
        return {finding.name for finding in found}


@pytest.fixture
def run(tmp_path):
    return Run(tmp_path)


@pytest.fixture
def no_pictures(monkeypatch):
    """Leave the figures out, which take most of the time."""
    monkeypatch.setattr(page, "_pictures", lambda _: [])


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A run with a weak column and a changed setting, and its page."""
    made = Run(tmp_path_factory.mktemp("run"))
    made.values["status"][: N_FRAMES * 3 // 4, 2] = Status.BELOW_NOISE
    made.values["r_squared"][:, 2] = 0.6
    made.columns["kind"][1] = KIND
    made.settings = RunSettings(fit=FitSettings(threshold=2.5))
    return made, write_report(made.write()).read_text(encoding="utf-8")


def test_page_is_well_formed_and_needs_nothing_else(written):
    found = Page(written[1])
    assert not found.open
    assert found.references
    assert all(reference.startswith(("data:", "#")) for reference in found.references)
    outside = re.sub(r"<script.*?</script>", "", written[1], flags=re.DOTALL)
    assert "http:" not in outside
    assert "https:" not in outside
    assert "@import" not in outside
    assert not re.search(r"<script[^>]*\bsrc=", written[1])
    assert found.alternatives
    assert all(found.alternatives)
    assert len(written[1]) < 4e6


def test_page_has_the_true_numbers(written):
    made, text = written
    tracks = results.accepted(results.open_results(made.folder / "results.zarr")).load()
    place = tracks["fit"].sel(parameter=["x", "y"]).to_numpy() * PIXEL_PM
    sd = np.sqrt((np.nanstd(place, axis=0, ddof=1) ** 2).mean(axis=1))
    n = len(made.scene.place)
    accepted = N_FRAMES * n - N_FRAMES * 3 // 4
    assert f"{accepted:,} of {N_FRAMES * n:,} fits were accepted ({accepted / (N_FRAMES * n):.1%})" in text
    assert f"A column spreads by {np.median(sd):.3g} pm per axis" in text
    assert f"the fits state an error of {ERROR_PX * PIXEL_PM:.3g} pm" in text
    span = PIXEL_PM * np.ptp(made.scene.drift, axis=0)
    assert f"{span[1]:.3g} × {span[0]:.3g} pm" in text
    assert "movie.tif" in text
    assert "500 e/Å²" in text
    assert "4 pm" in text


def test_changed_settings_come_first(written):
    _, text = written
    changed = text[text.index("Changed from their defaults (1)") : text.index("All of [source]")]
    assert "<code>fit.threshold</code>" in changed
    assert "<td>2.5" in changed
    assert changed.count("<code>") == 1


def test_numbers_of_columns_are_those_of_the_dataset(written):
    made, _ = written
    found = survey(made.folder, []).columns
    np.testing.assert_allclose(found["share"][2], 0.25)
    np.testing.assert_array_equal(np.delete(found["share"].to_numpy(), 2), 1.0)
    np.testing.assert_allclose(found["expected"], ERROR_PX * PIXEL_PM)
    np.testing.assert_allclose(found["r_squared"][2], 0.6, rtol=1e-6)
    np.testing.assert_allclose(np.delete(found["r_squared"].to_numpy(), 2), 0.8, rtol=1e-6)
    assert int(found["below_noise"][2]) == N_FRAMES * 3 // 4
    assert float(found["residual"].max()) < 0.02  # the scene is Gaussians; what their neighbours add, and the blur


@pytest.mark.parametrize(("error", "said"), [(400, None), (850, None), (1300, "2.1 stated errors")])
def test_intensities_that_noise_makes_larger_are_told(run, error, said):
    """By more than 3 %, and by more than the stated errors of 40 frames' mean say: 4.5 % are 1.3 of these."""
    run.values["intensity_stderr"][:] = error
    found = {finding.name: finding for finding in findings(survey(run.write(), []))}
    assert ("faint" in found) == (said is not None)
    assert said is None or said in found["faint"].text


def test_good_run_has_no_warnings(run):
    assert run.names() == set()


def _weak_column(run):
    run.values["status"][: N_FRAMES * 3 // 4, 2] = Status.BELOW_NOISE


def _few_accepted(run):
    run.values["status"][::4] = Status.NOT_CONVERGED


def _at_bound(run):
    run.values["status"][::20] = Status.AT_BOUND


def _bad_frame(run):
    run.values["status"][7] = Status.BAD_FRAME


def _outside(run):
    run.values["status"][:, 0] = Status.OUTSIDE_FRAME


def _sometimes_outside(run):
    run.values["status"][:5, 0] = Status.OUTSIDE_FRAME


def _errors_too_small(run):
    run.values["stderr"] /= 2


def _no_errors(run):
    run.values["stderr"][:] = np.nan


def _long_drift(run):
    run.values["drift"][:, 1] = np.linspace(0, 40, N_FRAMES)


def _drift_step(run):
    run.values["drift_measured"][20:, 0] += 20


def _odd_column(run):
    run.columns["fit_ref"][1, 0] *= 0.5


def _two_in_one(run):
    run.values["p_value"][::4, 1] = 1e-6


def _one_unlikely_fit_of_few(run):
    run.values["status"][3:, 1] = Status.BELOW_NOISE
    run.values["p_value"][0, 1] = 5e-4


def _noise_of_another_kind(run):
    run.values["p_value"][::4] = 1e-6


def _lost_frames(run):
    run.values["status"][[4, 5]] = Status.LOST_FRAME
    run.quality = np.where(np.isin(np.arange(N_FRAMES), [4, 5]), 0.0, 0.8)


def _contrast_not_sure(run):
    run.found["contrast_rival"] = 0.7


def _missing_pixels(run):
    run.values["status"][:10, 3] = Status.INCOMPLETE


def _hopper(run):
    run.values["status"][:3, 2] = Status.HOPPED


def _named_twice(run):
    run.values["status"][: N_FRAMES // 4, 2] = Status.SAME_ATOM | Status.BELOW_NOISE


def _doubtful(run):
    run.columns["status_ref"][1:] = Status.AT_BOUND


def _columns_too_far_apart(run):
    run.found["lattice_px"] = 15.0


def _columns_too_near(run):
    run.settings = RunSettings(columns=ColumnSettings(spacing_px=15.0))
    run.columns["status_ref"][::3] = Status.AT_BOUND


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (_contrast_not_sure, {"contrast"}),
        (_lost_frames, {"lost_frames"}),
        (_missing_pixels, {"incomplete"}),
        (_doubtful, {"doubtful_columns"}),
        (_hopper, {"hopped"}),
        (_named_twice, {"same_atom"}),
        (_columns_too_far_apart, {"spacing"}),
        (_columns_too_near, {"spacing"}),
        (_weak_column, {"weak_columns"}),
        (_few_accepted, {"accepted", "not_converged", "poor_frames"}),
        (_at_bound, {"at_bound", "poor_frames"}),
        (_bad_frame, {"bad_frames"}),
        (_outside, {"never_fitted"}),
        (_sometimes_outside, {"at_the_edge"}),
        (_errors_too_small, {"scatter"}),
        (_no_errors, {"no_errors"}),
        (_long_drift, {"long_drift"}),
        (_drift_step, {"long_step"}),
        (_odd_column, {"one_gaussian"}),
        (_two_in_one, {"one_gaussian"}),
        (_one_unlikely_fit_of_few, {"weak_columns"}),
        (_noise_of_another_kind, set()),
    ],
)
def test_warnings_are_where_they_belong(run, change, expected):
    change(run)
    assert run.names() == expected


def test_saturated_pixels_and_vacuum_without_noise_are_named(run, npy):
    convert(npy(np.minimum(run.scene.counts(), 50)), run.folder / "movie.zarr")
    run.about |= {"vacuum_unusable": "60% of its pixels have the lowest value, 0: what was below was cut off"}
    found = {finding.name: finding for finding in findings(survey(run.write(), []))}
    assert {"saturated", "vacuum"} <= found.keys()
    assert "50 detector units" in found["saturated"].text
    assert found["saturated"].serious
    assert found["vacuum"].serious


@pytest.mark.usefixtures("no_pictures")
def test_pixels_without_data_are_counted_and_drawn(run, npy):
    frames = run.scene.counts()
    frames[:, [10, 20, 31], [40, 50, 61]] = 9000
    frames[:, :, 100] = 0
    convert(npy(frames), run.folder / "movie.zarr")
    found = survey(run.write(), [])
    text = page.render(found)
    line = run.scene.shape[0]
    assert f"3 hot pixels and {line} pixels in lines left out" in text
    assert f"red: 3 hot, blue: {line} in lines" in text
    data = text.split('<img class="mask" src="data:image/png;base64,')[1].split('"')[0]
    colours = imread(io.BytesIO(base64.b64decode(data)))[..., :3]
    assert np.ptp(colours[10, 40]) > 0.5
    assert np.ptp(colours[90, 20]) == 0
    assert "masked_pixels" not in {finding.name for finding in findings(found)}
    counts = found.left_out | {"hot": found.summed["image"].size // 50}
    many = dataclasses.replace(found, about=found.about | {"movie": found.about["movie"] | {"pixels": counts}})
    assert "masked_pixels" in {finding.name for finding in findings(many)}


@pytest.mark.usefixtures("no_pictures")
def test_without_a_pixel_size_lengths_are_in_pixels(tmp_path):
    made = Run(tmp_path, pixel_size_pm=None, frame_time_s=None)
    assert made.names() == {"pixel_size", "frame_time"}
    text = write_report(tmp_path).read_text(encoding="utf-8")
    assert f"the fits state an error of {ERROR_PX:.3g} px" in text
    assert Page(text).findings == {"pixel_size": "warning", "frame_time": "note"}


def test_warnings_of_the_run_itself_are_repeated(run):
    events = [
        {"event": "Warned", "message": "of an earlier run"},
        {"event": "RunStarted", "dashboard": ""},
        {"event": "Warned", "message": "a part of the movie is read"},
        {"event": "RunStarted", "dashboard": "http://127.0.0.1:8787/status"},
        {"event": "Warned", "message": "columns.csv was edited by hand"},
    ]
    said = [finding.text for finding in findings(survey(run.write(), events))]
    assert said == ["A part of the movie is read.", "Columns.csv was edited by hand."]


def test_a_movie_with_lost_frames_lasts_as_long_as_its_times_say(run):
    run.values["time"][20:] += 6.0
    name, number, lasting = cards(survey(run.write(), []))[0]
    assert (name, number, lasting) == ("Frames", f"{N_FRAMES}", f"{0.1 * N_FRAMES + 6:g} s")


def test_why_no_errors_are_known_is_said(run):
    _no_errors(run)
    assert [found.text for found in findings(survey(run.write(), []))] == [
        "The fits state no errors of the positions: after a blur of 2 px too few pixels are independent in a window "
        "that is 19 px across."
    ]


def test_series_keep_the_extremes(run, monkeypatch):
    run.values["fit"][17, 3, 1] += 30  # px: a single wild fit
    run.values["status"][10:20, 5] = Status.BELOW_NOISE
    tracks = results.open_results(run.write() / "results.zarr").load()
    n = tracks.sizes["column_id"]
    whole = gathered(tracks, None, values=12 * n * 4)
    series = whole[2]
    assert series.attrs["frames"] == 10
    assert series.sizes["bin"] == 4
    own = series.sel(quantity="x").isel(column_id=3)
    x = (run.values["fit"][:, 3, 1] - run.columns["x_ref"].to_numpy()[3]) * PIXEL_PM
    np.testing.assert_allclose(own["mean"], x.reshape(4, 10).mean(axis=1))
    np.testing.assert_allclose(own["high"], x.reshape(4, 10).max(axis=1))
    np.testing.assert_allclose(own["low"], x.reshape(4, 10).min(axis=1))
    np.testing.assert_allclose(own["error"], ERROR_PX * PIXEL_PM / np.sqrt(10))
    assert np.isnan(series["mean"].isel(bin=1, column_id=5)).all()
    monkeypatch.setattr(survey_module, "_PART_BYTES", 1)  # a bin at a time, from the store
    in_parts = gathered(tracks, results.variables(run.folder / "results.zarr"), values=12 * n * 4)
    for one, other in zip(in_parts, whole, strict=True):
        xr.testing.assert_allclose(one, other)


@pytest.mark.parametrize("has_errors", [True, False])
def test_the_jobs_page_shows_the_same_numbers(run, has_errors):
    _weak_column(run)
    _bad_frame(run)
    run.values["status"][:, 0] = Status.OUTSIDE_FRAME
    run.values["stderr"] *= 1 if has_errors else np.nan
    reported, cache = survey(run.write(), []), run.folder / "cache"
    rows = json.loads(tracks_of_job.columns(run.folder, cache, "v"))["columns"]
    names = {"sd": "spread", "stated": "expected", "accepted_share": "share"}
    for name in ("fits", "accepted", "sd", "sd_x", "sd_y", "stated", "accepted_share", "intensity"):
        shown = np.array([row[name] for row in rows], float)
        np.testing.assert_allclose(shown, reported.columns[names.get(name, name)], atol=1e-6, err_msg=name)
    frames = json.loads(tracks_of_job.frames(run.folder, cache, 7, "v"))
    curves = overview.frame_curves(
        {name: reported.frames[name].to_numpy() for name in overview.FRAME}, frames["frames_per_point"]
    )
    for shown, name in (("accepted_share", "share"), ("drift_x", "drift_x"), ("amplitude", "amplitude")):
        np.testing.assert_allclose(np.array(frames[shown], float), curves[name], atol=1e-6)
    own = json.loads(tracks_of_job.series(run.folder, cache, 3, (0, None), N_FRAMES, "v"))
    for name in overview.QUANTITIES:
        series = reported.series.sel(quantity=name, column_id=3)
        shown = own[name if name == "intensity" else f"d{name}"]
        np.testing.assert_allclose(np.array(shown, float), series["mean"], atol=1e-5)


def test_packed_numbers_are_the_numbers():
    rng = np.random.default_rng(1)
    values = rng.normal(3, 100, (5, 40))
    values[1, 7], values[2] = np.nan, np.nan
    values[3] = 2.5
    numbers, zero, step = quantised(values)
    numbers = numbers.reshape(values.shape)
    back = np.where(numbers == -32768, np.nan, zero[:, None] + step[:, None] * numbers)
    np.testing.assert_array_equal(np.isnan(back), np.isnan(values))
    span = np.nanmax(values[[0, 1, 4]], axis=1) - np.nanmin(values[[0, 1, 4]], axis=1)
    assert (np.nanmax(np.abs(back - values)[[0, 1, 4]], axis=1) <= 0.51 * span / 65534).all()
    np.testing.assert_allclose(back[3], 2.5)


def page_data(text: str) -> dict:
    """What the page's scripts are given."""
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])


def unpacked(packed: dict[str, str]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed["base64"]), np.dtype(packed["dtype"]).newbyteorder("<"))


def trusted(made: Run) -> xr.Dataset:
    return results.accepted(results.open_results(made.folder / "results.zarr")).load()


def in_time(made: Run, quantity: str) -> np.ndarray:
    """What the report shows of every column (column, frame): places from that in the summed image, pm; counts."""
    tracks = trusted(made)
    if quantity == "intensity":
        return tracks["intensity"].to_numpy().T
    place = tracks["fit"].sel(parameter=quantity) - made.columns[f"{quantity}_ref"].to_numpy()
    return PIXEL_PM * place.to_numpy().T


@pytest.mark.parametrize("quantity", ["x", "y", "intensity"])
def test_series_on_the_page_are_those_of_the_dataset(written, quantity):
    made, text = written
    own = page_data(text)["series"][quantity]["mean"]
    numbers, zero, step = (unpacked(own[name]) for name in ("numbers", "zero", "step"))
    expected = in_time(made, quantity)
    shown = np.where(numbers == -32768, np.nan, zero.repeat(N_FRAMES) + step.repeat(N_FRAMES) * numbers)
    np.testing.assert_array_equal(np.isnan(shown), np.isnan(expected.ravel()))
    assert np.nanmax(np.abs(shown - expected.ravel()) / step.repeat(N_FRAMES)) <= 0.51
    np.testing.assert_allclose(unpacked(page_data(text)["series"]["time"]), 0.1 * np.arange(N_FRAMES), atol=1e-9)


def test_no_text_of_a_run_ends_a_script(written):
    made, text = written
    assert page_data(text)["kinds"] == [str(kind) for kind in made.columns["kind"].to_numpy()]
    assert KIND not in text
    with pytest.raises(ValueError, match="not JSON compliant"):
        script_json({"spread": float("nan")})


def test_page_is_small_and_has_no_library(written):
    made, _ = written
    text = write_report(made.folder, made.folder / "small.html", figures=False).read_text(encoding="utf-8")
    assert "bokeh" not in text.lower()
    assert len(text) < 250_000


@contextmanager
def opened(chromium, address, theme="light", policy=""):
    """The page, which has to end without a complaint of the browser, and to ask for nothing beside itself."""
    context = chromium.new_context(color_scheme=theme, viewport={"width": 1280, "height": 800})
    context.set_default_timeout(WAIT_MS)
    shown, said, asked = context.new_page(), [], []
    shown.on("console", lambda message: said.append(message.text))
    shown.on("pageerror", lambda error: said.append(str(error)))
    shown.on("request", lambda request: request.url.startswith(("data:", "blob:")) or asked.append(request.url))
    if policy:
        file, address = address, "http://report.test/"
        headers = {"Content-Security-Policy": policy, "Content-Type": "text/html; charset=utf-8"}
        context.route(address, lambda route: route.fulfill(path=file, headers=headers))
    try:
        shown.goto(address)
        shown.wait_for_selector("#map canvas.overlay")
        yield shown
        assert said == []
        assert asked == [address]
    finally:
        context.close()


@pytest.fixture
def shown(chromium, written):
    with opened(chromium, f"file://{written[0].folder / 'report.html'}") as page:
        yield page


def on_map(page, made: Run, index: int) -> tuple[float, float]:
    """The place of a column in the map, CSS px: the image fits into it, with four px around."""
    (ny, nx), box = made.scene.shape, page.locator("#map").bounding_box()
    scale = min((box["width"] - 8) / nx, (box["height"] - 8) / ny)
    away = made.scene.place[index] - (np.array([nx, ny]) - 1) / 2
    return tuple(np.array([box["width"], box["height"]]) / 2 + scale * away)


def click_column(page, made: Run, index: int) -> None:
    x, y = on_map(page, made, index)
    page.click("#map", position={"x": x, "y": y})


def settle(page) -> None:
    """Wait until everything is drawn."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def walk(page, chart: str, steps: int) -> list[list[str]]:
    """What the chart tells of its points one after the other, as somebody hears who has but a keyboard."""
    page.focus(f"#{chart} canvas")
    page.keyboard.press("Home")
    told = []
    for _ in range(steps):
        settle(page)
        told.append(page.locator(f"#{chart} .chart-legend b").all_text_contents())
        page.keyboard.press("ArrowRight")
    return told


def number(text: str) -> float:
    found = re.match(r"-?[\d,.]+(e-?\d+)?", text)
    return float(found[0].replace(",", "")) if found else np.nan


def chosen(page) -> str:
    return page.locator("#chosen").text_content()


@pytest.mark.parametrize("quantity", ["x", "y", "intensity"])
def test_a_click_on_a_column_shows_the_values_of_the_dataset(shown, written, quantity):
    made, _ = written
    click_column(shown, made, 2)
    assert chosen(shown) == "3 (Ce)"
    assert shown.locator("#column").input_value() == "2"
    told = np.array([number(one) for (one,) in walk(shown, quantity, N_FRAMES)])
    expected = in_time(made, quantity)[2]
    assert np.isnan(told).sum() == N_FRAMES * 3 // 4  # gaps, where no fit is accepted
    np.testing.assert_allclose(told, expected, rtol=6e-4, atol=np.nanmax(np.abs(expected)) / 30_000)


def test_the_whole_series_is_in_the_charts_description(shown, written):
    made, _ = written
    click_column(shown, made, 4)
    settle(shown)
    label = shown.locator("#x canvas").get_attribute("aria-label")
    x = in_time(made, "x")[4]
    low, high = re.fullmatch(r"x of column 5 in time: x \(pm\) from (\S+) to (\S+)", label).groups()
    np.testing.assert_allclose([float(low), float(high)], [x.min(), x.max()], rtol=6e-4)


def test_columns_are_coloured_by_the_number_that_is_asked_for(shown, written):
    made, _ = written
    columns = survey(made.folder, []).columns
    colours = {}
    for name in ("spread", "share"):
        shown.select_option("#shade", name)
        settle(shown)
        values = columns[name].to_numpy() * (100 if name == "share" else 1)
        label = shown.locator("#colour-bar").get_attribute("aria-label")
        low, high = (float(text) for text in re.search(r"from (\S+) to (\S+)$", label).groups())
        assert low == pytest.approx(values.min())
        assert high == pytest.approx(np.sort(values)[int(np.ceil(0.95 * (len(values) - 1)))])
        for index in (0, 2, 7):
            share = (values[index] - low) / (high - low) if high > low else 0.5
            colours[name, index] = pixel(shown, *on_map(shown, made, index))
            np.testing.assert_allclose(colours[name, index], 255 * np.array(colormaps["viridis"](share)[:3]), atol=12)
    assert colours["spread", 0] != colours["share", 0]


def pixel(page, x: float, y: float) -> list[int]:
    """The colour that is drawn over the image there."""
    read = """([x, y]) => {
        const pen = new OffscreenCanvas(1, 1).getContext("2d"), from = document.querySelector("#map canvas.overlay");
        pen.drawImage(from, -Math.round(x * devicePixelRatio), -Math.round(y * devicePixelRatio));
        return [...pen.getImageData(0, 0, 1, 1).data].slice(0, 3);
    }"""
    return page.evaluate(read, [x, y])


def test_the_pointer_is_told_what_a_column_measures(shown, written):
    made, _ = written
    x, y = on_map(shown, made, 1)
    shown.hover("#map", position={"x": x, "y": y})
    told = shown.locator("#tip").inner_text().splitlines()
    own = survey(made.folder, []).columns.isel(column_id=1)
    assert told[0] == f"Column 2 {KIND}"
    assert told[1] == f"x {float(own['x_ref']):.2f}, y {float(own['y_ref']):.2f} px"
    assert number(told[2].removeprefix("spread ")) == pytest.approx(float(own["spread"]), rel=6e-3)
    assert told[4] == "accepted 100 %"


def test_a_dot_is_told_and_chooses_its_column(shown, written):
    made, _ = written
    columns = survey(made.folder, []).columns
    order = np.lexsort([columns["spread"], columns["expected"]])
    told = walk(shown, "spread", len(order))
    pattern = r"stated error (\S+) pm, spread (\S+) pm"
    values = np.array([re.fullmatch(pattern, one).groups() for (one,) in told], float)
    np.testing.assert_allclose(values[:, 0], columns["expected"][order], rtol=6e-3)
    np.testing.assert_allclose(values[:, 1], columns["spread"][order], rtol=6e-3)
    shown.keyboard.press("Enter")
    assert chosen(shown).split()[0] == str(int(columns["column_id"][order[-1]]))
    settle(shown)
    assert shown.locator("#share .chart-legend b").text_content() == "accepted 100 %, R² 0.8"


def test_a_click_on_a_dot_chooses_its_column(shown):
    canvas = shown.locator("#share canvas")
    low = canvas.bounding_box()["height"] - 32 - 0.06 / 1.12 * (canvas.bounding_box()["height"] - 56)
    for x in range(30, 120, 4):  # the weak column is at the lower left, beyond the axis' numbers
        canvas.hover(position={"x": x, "y": low})
        settle(shown)
        if "accepted 25 %" in shown.locator("#share .chart-legend").text_content():
            break
    canvas.click(position={"x": x, "y": low})
    assert chosen(shown) == "3 (Ce)"


def test_curves_over_the_frames_are_those_of_the_dataset(shown, written):
    made, _ = written
    told = np.array([[number(value) for value in values] for values in walk(shown, "drift", N_FRAMES)])
    np.testing.assert_allclose(told, PIXEL_PM * made.scene.drift[:, ::-1], rtol=6e-4, atol=1e-6)
    n = len(made.scene.place)
    share = [number(value) for (value,) in walk(shown, "accepted", N_FRAMES)]
    accepted = np.where(np.arange(N_FRAMES) < N_FRAMES * 3 // 4, n - 1, n)
    np.testing.assert_allclose(share, 100 * accepted / n, rtol=6e-4)


def test_buttons_and_tables_choose_columns_and_zoom_is_shared(shown, written):
    made, _ = written
    n = len(made.scene.place)
    click_column(shown, made, 0)
    shown.click("#before")
    assert chosen(shown) == f"{n} (Ce)"
    shown.click("#after")
    shown.click("#after")
    assert chosen(shown) == f"2 ({KIND})"
    shown.select_option("#column", label="6")
    assert chosen(shown) == "6 (Ce)"
    button = shown.locator(".go").first
    button.click()
    assert chosen(shown).split()[0] == button.text_content()
    shown.focus("#x canvas")
    shown.keyboard.press("+")
    settle(shown)
    assert shown.locator(".chart-whole:visible").count() == 3
    shown.keyboard.press("0")
    settle(shown)
    assert shown.locator(".chart-whole:visible").count() == 0


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_the_page_follows_the_system_and_is_never_too_wide(chromium, written, theme):
    with opened(chromium, f"file://{written[0].folder / 'report.html'}", theme) as page:
        assert page.locator("html").get_attribute("data-theme") == theme
        page.emulate_media(color_scheme="dark" if theme == "light" else "light")
        settle(page)
        assert page.locator("html").get_attribute("data-theme") != theme
        page.set_viewport_size({"width": 390, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth") <= 390


def _nothing_accepted(run):
    run.values["status"][:] = Status.BELOW_NOISE


def _not_calibrated(run):
    run.about |= {"pixel_size_pm": None, "frame_time_s": None}


@pytest.mark.parametrize(
    ("change", "told", "dots"),
    [
        (_no_errors, r"^spread \S+ pm · accepted 100 %", 0),
        (_nothing_accepted, "^accepted 0 % · residual", 0),
        (_not_calibrated, r"^spread \S+ px · spread \S+ × stated error · accepted 100 %", 1),
        (_outside, r"^spread \S+ pm · spread \S+ × stated error · accepted 100 %", 1),
    ],
)
def test_what_is_not_known_is_left_out(chromium, tmp_path, change, told, dots):
    made = Run(tmp_path)
    change(made)
    file = write_report(made.write(), figures=False)
    with opened(chromium, f"file://{file}") as page:
        page.select_option("#column", label="2")
        settle(page)
        assert re.search(told, page.locator("#said").text_content())
        assert page.locator("#spread").count() == dots


def test_the_page_works_as_the_service_shows_it(chromium, written):
    made, _ = written
    with opened(chromium, made.folder / "report.html", policy=_REPORT_POLICY) as page:
        click_column(page, made, 4)
        assert chosen(page) == "5 (Ce)"


@pytest.mark.usefixtures("no_pictures")
def test_report_is_made_anew_only_for_other_tracks(run):
    assert not is_current(run.write())
    write_report(run.folder)
    assert is_current(run.folder)
    metadata.update_attributes(run.folder / "results.zarr", dose=250.0)
    assert not is_current(run.folder)


def test_folder_without_tracks_is_refused(tmp_path):
    with pytest.raises(StoreError, match="no results here"):
        write_report(tmp_path)


def test_every_setting_is_on_the_page():
    rows = page.settings_rows(RunSettings())
    names = {
        f"{group.name}.{item.name}"
        for group in dataclasses.fields(RunSettings())
        for item in dataclasses.fields(getattr(RunSettings(), group.name))
        if item.default is not dataclasses.MISSING  # not those of SLURM and ssh
    }
    assert {row["name"] for group in rows.values() for row in group} == names
    assert not any(row["changed"] for group in rows.values() for row in group)


def test_a_look_keeps_what_it_found_with_the_tracks(run, monkeypatch):
    _weak_column(run)
    found, known = look(run.write(), page=False)
    assert not known
    assert "weak_columns" in {finding.name for finding in found}
    assert not (run.folder / "report.html").exists()
    assert results.open_results(run.folder / "results.zarr").attrs["findings"] == "weak_columns"
    monkeypatch.setattr("tract_dask.report.look.survey", None)  # what is known is not measured again
    assert look(run.folder, page=False) == (found, True)


def test_a_look_writes_the_page_once(run):
    assert look(run.write())[1] is False
    assert is_current(run.folder)
    assert look(run.folder)[1] is True
    assert results.open_results(run.folder / "results.zarr").attrs["findings"] == "none"
    run.settings = RunSettings(columns=ColumnSettings(spacing_px=15.0))
    (run.folder / "run.toml").write_text(to_toml(run.settings))
    assert look(run.folder)[1] is False


def test_residuals_are_those_of_the_windows():
    """A column that is its model leaves the noise; one beyond the image, or not fitted, has none."""
    reference = np.array([[40.0, 30, 25, 3, 2, 0.3, 5], [40.0, 2, 25, 3, 2, 0.3, 5], np.full(7, np.nan)])
    y, x = np.mgrid[:60, :60]
    noise = np.random.default_rng(0).normal(0, 2.0, (60, 60))
    tracks = xr.Dataset(
        {"fit_ref": (("column_id", "parameter"), reference)}, attrs={"window_px": 15, "reference_blur_px": 0.0}
    )
    image, exposure = evaluate(reference[0], x, y) + noise, np.ones((60, 60), np.uint32)
    summed = xr.Dataset({"image": (("y", "x"), image), "exposure": (("y", "x"), exposure)})
    disc = np.hypot(y - 25, x - 30) <= 7
    expected = np.sqrt((noise[disc] ** 2).mean()) / 40
    np.testing.assert_allclose(residuals(tracks, summed).residual, [expected, np.nan, np.nan], rtol=1e-5)
    outside, shown = residual_windows(tracks, summed, [1, 0])
    assert np.isnan(outside).all()
    np.testing.assert_allclose(shown[2][np.isfinite(shown[1])], noise[disc], atol=1e-4)


def test_p_values_of_the_sum_tell_noise_from_a_second_column():
    """225 columns, 2 counts a pixel, 10 frames: 0.1 to 3 % are below 1 %; one with a neighbour is far below."""
    rng, side, spacing = np.random.default_rng(4), 15, 24
    y, x = np.mgrid[: (side + 1) * spacing, : (side + 1) * spacing]
    line = (np.arange(side) + 1) * float(spacing)
    places = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    down, across = (np.exp(-((np.arange(y.shape[0]) - line[:, None]) ** 2) / (2 * 3.5**2)) for _ in "yx")
    expected = 2.0 + 2.0 * np.einsum("ay,bx->yx", down, across)
    expected += evaluate(np.array([1.5, *(places[40] + [7.0, 0.0]), 3.5, 3.5, 0.0, 0.0]), x, y)
    exposure = np.full(y.shape, 10, np.uint32)
    summed = xr.Dataset({"image": (("y", "x"), rng.poisson(10 * expected) / 10), "exposure": (("y", "x"), exposure)})
    settings, seeds = ColumnSettings(contrast="bright"), column_dataset(places)
    tracks = find_columns(summed, settings, seeds=seeds, window_px=15, blur_sigma_px=2.0)
    found = residuals(tracks.assign_attrs(reference_blur_px=2.0), summed).p_value
    assert found[40] < 1e-4
    assert 0.001 < (np.delete(found, 40) < 0.01).mean() < 0.03


def touching_run(folder, apart_px, error_px=ERROR_PX, group=(1, 1), **fit):
    """The usual run, whose first two columns are so far apart."""
    run = Run(folder)
    first = run.columns["fit_ref"].to_numpy()
    first[1, 1:3] = first[0, 1:3] + [apart_px, 0.0]
    run.columns["x_ref"].to_numpy()[1], run.columns["y_ref"].to_numpy()[1] = first[1, 1:3]
    run.values["fit"][:, 1, 1:3] += first[1, 1:3] - run.values["fit"][:, 1, 1:3].mean(axis=0)
    run.values["stderr"][:, :2] = error_px
    run.columns["group"] = "column_id", np.array([*group, *[0] * (len(first) - 2)])
    run.settings = RunSettings(fit=FitSettings(**fit))
    return {finding.name: finding for finding in findings(survey(run.write(), []))}


def test_sublattices_that_were_left_out_are_told(tmp_path):
    run = Run(tmp_path)
    near = {"why": "near", "number": 48, "cell": [0.5, 0.25], "distance_px": 17.4, "share": None}
    faint = {"why": "faint", "number": 40, "cell": [0.5, 0.5], "distance_px": 28.0, "share": 0.11}
    run.found = {"left_out": [near, faint]}
    found = {finding.name: finding for finding in findings(survey(run.write(), []))}["left_out"]
    assert not found.serious
    assert all(part in found.text for part in ("48 places", "17.4 px", "40 columns", "11%"))
    assert "--min-amplitude" in found.remedy


def test_touching_columns_that_were_fitted_alone_are_told(tmp_path):
    together, given = (tmp_path / name for name in ("together", "given"))
    for folder in (together, given):
        folder.mkdir()
    assert "touching_alone" not in touching_run(together, 11.0)
    found = touching_run(given, 11.0, group=(0, 0))["touching_alone"]
    assert "column 1 and 2" in found.text
    assert "given" in found.text


def test_pairs_whose_errors_are_as_large_as_their_distance_are_told(tmp_path):
    (tmp_path / "sharp").mkdir()
    (tmp_path / "blind").mkdir()
    assert "unresolved" not in touching_run(tmp_path / "sharp", 8.0, error_px=1.0)
    assert "1-2" in touching_run(tmp_path / "blind", 8.0, error_px=3.0)["unresolved"].text


def test_a_crystal_that_turned_and_one_that_slipped_are_told(tmp_path):
    for name in ("still", "turned", "slipped", "both"):
        (tmp_path / name).mkdir()
    assert not {"crystal_motion", "moving_columns"} & {
        finding.name for finding in findings(survey(Run(tmp_path / "still").write(), []))
    }
    turned = Run(tmp_path / "turned", motions_undone=["rotation"], not_reference=[], motion_centre=[70.0, 100.0])
    turned.values["motion"][:, 0] = np.deg2rad(np.linspace(-1.5, 1.5, N_FRAMES))
    found = {finding.name: finding for finding in findings(survey(turned.write(), []))}
    assert "turned by 3 degrees" in found["crystal_motion"].text
    slipped = Run(tmp_path / "slipped", motions_undone=[], not_reference=[1, 2, 3])
    found = {finding.name: finding for finding in findings(survey(slipped.write(), []))}
    assert found["moving_columns"].text.startswith("3 of ")
    both = Run(tmp_path / "both", motions_undone=["rotation"], not_reference=[1, 2, 3, 4, 5], motion_centre=[0.0, 0.0])
    assert {"crystal_motion", "moving_columns"} <= {finding.name for finding in findings(survey(both.write(), []))}
