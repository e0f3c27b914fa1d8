"""The report: its numbers against the Dataset's, its warnings where they belong, and a page that needs nothing else."""

import base64
import dataclasses
import gzip
import re
from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr
from conftest import Scene

from tract_dask import results, schema, stores
from tract_dask.errors import StoreError
from tract_dask.report import is_current, page, write_report
from tract_dask.report.findings import findings
from tract_dask.report.interactive import quantised
from tract_dask.report.survey import column_series, survey
from tract_dask.schema import Status
from tract_dask.settings import FitSettings, RunSettings, to_toml
from tract_dask.shards import Shard

N_FRAMES, ERROR_PX, PIXEL_PM = 40, 0.5, 4.0
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
        self.values["drift"][:] = self.values["drift_measured"][:] = self.scene.drift
        self.values["time"][:] = 0.1 * np.arange(N_FRAMES)
        self.folder, self.columns = folder, columns
        self.about = {"pixel_size_pm": PIXEL_PM, "frame_time_s": 0.1, "dose": 500.0} | about
        self.settings = RunSettings()

    def write(self):
        path = self.folder / "results.zarr"
        results.create(
            path,
            self.columns,
            self.values["drift_measured"],
            self.values["time"],
            N_FRAMES,
            settings=to_toml(self.settings.fit),
            window=19,
            reference_blur_px=2.0,
            created="2026-11-22T08:00:00+00:00",
            source="/data/movie.tif",
            versions={"tract_dask": "0.1.0"},
            **self.about,
        )
        stored = {name: values for name, values in self.values.items() if name not in ("time", "drift_measured")}
        results.write(path, Shard(0, 0, N_FRAMES), stored, N_FRAMES)
        stores.update_attributes(path, complete=True)
        summed = self.scene.summed()
        summed.attrs = {"pixel_size_pm": self.about["pixel_size_pm"]} if self.about["pixel_size_pm"] else {}
        stores.write_dataset(summed, self.folder / "sum.zarr")
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
    np.testing.assert_allclose(found["r_squared"], 0.8, rtol=1e-6)
    assert int(found["below_noise"][2]) == N_FRAMES * 3 // 4
    assert float(found["residual"].max()) < 0.02  # the scene is Gaussians; what their neighbours add, and the blur


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


@pytest.mark.parametrize(
    ("change", "expected"),
    [
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
        (_odd_column, {"residual"}),
    ],
)
def test_warnings_are_where_they_belong(run, change, expected):
    change(run)
    assert run.names() == expected


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
        {"event": "RunStarted"},
        {"event": "Warned", "message": "columns.csv was edited by hand"},
    ]
    assert [finding.text for finding in findings(survey(run.write(), events))] == ["Columns.csv was edited by hand."]


def test_series_keep_the_extremes(run):
    run.values["fit"][17, 3, 1] += 30  # px: a single wild fit
    run.values["status"][10:20, 5] = Status.BELOW_NOISE
    tracks = results.open_results(run.write() / "results.zarr").load()
    n = tracks.sizes["column_id"]
    series = column_series(tracks, values=12 * n * 4)
    assert series.attrs["frames"] == 10
    assert series.sizes["bin"] == 4
    own = series.sel(quantity="x").isel(column_id=3)
    x = (run.values["fit"][:, 3, 1] - run.columns["x_ref"].to_numpy()[3]) * PIXEL_PM
    np.testing.assert_allclose(own["mean"], x.reshape(4, 10).mean(axis=1))
    np.testing.assert_allclose(own["high"], x.reshape(4, 10).max(axis=1))
    np.testing.assert_allclose(own["low"], x.reshape(4, 10).min(axis=1))
    np.testing.assert_allclose(own["error"], ERROR_PX * PIXEL_PM / np.sqrt(10))
    assert np.isnan(series["mean"].isel(bin=1, column_id=5)).all()
    lazy = column_series(tracks.chunk(frame=7), values=12 * n * 4).compute()
    xr.testing.assert_allclose(lazy, series)


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


def test_series_on_the_page_are_those_of_the_dataset(written):
    made, text = written
    found = re.search(
        r'"x_mean",\{"type":"ndarray","array":\{"type":"bytes","data":"([^"]+)"\},"shape":\[(\d+)\]', text
    )
    packed = base64.b64decode(found[1])
    numbers = np.frombuffer(gzip.decompress(packed) if packed[:2] == b"\x1f\x8b" else packed, np.int16)
    expected, _, _ = quantised(
        survey(made.folder, []).series["mean"].sel(quantity="x").transpose("column_id", "bin").to_numpy()
    )
    np.testing.assert_array_equal(numbers, expected)


@pytest.mark.usefixtures("no_pictures")
def test_report_is_made_anew_only_for_other_tracks(run):
    assert not is_current(run.write())
    write_report(run.folder)
    assert is_current(run.folder)
    stores.update_attributes(run.folder / "results.zarr", dose=250.0)
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
