"""Data out: what a browser is shown, or downloads, is what the stores hold; also while they grow."""

from __future__ import annotations

import asyncio
import io
import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
import zarr.storage
from conftest import add_fits, store_fits
from fastapi.testclient import TestClient
from serviced import URL, Here, make_app

from tract_dask import open_results
from tract_dask.analysis import motion
from tract_dask.kernels.gaussian import parameters
from tract_dask.service.views import exports, track_cache, tracks
from tract_dask.service.views.exports import Exports
from tract_dask.settings import FitSettings
from tract_dask.store import files as store_files
from tract_dask.store import results, schema
from tract_dask.store.provenance import provenance
from tract_dask.store.schema import Status
from tract_dask.store.shards import split

N_FRAMES, N_COLUMNS, STEP = 23, 6, 4
PIXEL_PM, FRAME_S = 4.0, 0.1
KEY = "the key of these fits"


class Fits:
    """Fits with known values, and the store that takes them shard by shard."""

    def __init__(self, folder: Path) -> None:
        rng = np.random.default_rng(5)
        self.path, self.shards = folder / "results.zarr", split(N_FRAMES, STEP)
        sizes = {"frame": N_FRAMES, "column_id": N_COLUMNS} | schema.SIZES
        self.known = {
            name: rng.normal(100, 10, [sizes[dim] for dim in schema.RESULTS[name].dims])
            for name in results.SHARDED
            if name != "status"
        }
        self.known["stderr"] = rng.uniform(0.1, 0.4, (N_FRAMES, N_COLUMNS, 7))
        status = np.zeros((N_FRAMES, N_COLUMNS), np.uint16)
        status[rng.random(status.shape) < 0.2] = Status.BELOW_NOISE
        status[:, 2] = Status.OUTSIDE_FRAME  # never fitted
        status[5] = Status.BAD_FRAME
        status[rng.random(status.shape) < 0.1] |= np.uint16(Status.SHAPE_AT_BOUND)  # accepted nevertheless
        self.known["status"] = status

    def create(self) -> None:
        reference = np.random.default_rng(6).uniform(20, 80, (N_COLUMNS, 7))
        columns = xr.Dataset(
            {
                "x_ref": ("column_id", reference[:, parameters.X]),
                "y_ref": ("column_id", reference[:, parameters.Y]),
                "kind": ("column_id", schema.texts(["Ce", "O"] * (N_COLUMNS // 2))),
                "fit_ref": (("column_id", "parameter"), reference),
                "status_ref": ("column_id", np.zeros(N_COLUMNS, np.uint8)),
            },
            {"column_id": np.arange(1, N_COLUMNS + 1)},
        )
        about = {"pixel_size_pm": PIXEL_PM, "frame_time_s": FRAME_S, "dose": None, "window": 19, "vacuum": None}
        results.create(
            self.path,
            columns,
            np.zeros((N_FRAMES, 2)),
            np.arange(N_FRAMES) * FRAME_S,
            STEP,
            **provenance(KEY, FitSettings(blur_sigma_px=2.0), "movie.zarr"),
            **about,
            reference_blur_px=2.0,
            refine_columns=10,
        )

    def write(self, *indices: int, record: bool = True) -> None:
        add_fits(self.path, self.known, [self.shards[k] for k in indices], STEP, KEY, record)

    def finish(self) -> None:
        store_fits(self.path, self.known, STEP, KEY)


@pytest.fixture(scope="module")
def empty(tmp_path_factory) -> Path:
    """A store that is created, and not written yet."""
    fits = Fits(tmp_path_factory.mktemp("empty"))
    fits.create()
    return fits.path


@pytest.fixture
def service(tmp_path, empty):
    """A client of the API, with a job in ``job`` whose folder holds results that are not written yet, ``fits``."""
    app = make_app(tmp_path)
    app.state.services.exports = Exports(tmp_path / ".tract_dask" / "exports", Here())
    np.save(tmp_path / "movie.npy", np.zeros((2, 8, 8), np.uint8))
    job = app.state.services.store.submit(source="movie.npy", settings={}, owner="local", output="out")
    shutil.copytree(empty, tmp_path / "out" / "results.zarr")
    client = TestClient(app, base_url=URL)
    client.job, client.fits = f"jobs/{job.id}", Fits(tmp_path / "out")
    return client


def get(service, place: str, **params):
    answer = service.get(f"{service.job}/results{place}", params=params)
    assert answer.status_code == 200, answer.text
    return answer.json()


def array(values) -> np.ndarray:
    return np.array(values, float)  # None becomes NaN


def test_numbers_of_columns_are_those_of_the_analysis(service):
    service.fits.finish()
    found = pd.DataFrame(get(service, "/columns")["columns"])
    data = open_results(service.fits.path)
    spread = motion.spread(data)
    for name in ("sd", "sd_x", "sd_y"):
        np.testing.assert_allclose(array(found[name]), spread[name], atol=1e-6)
    trusted = results.accepted(data)
    np.testing.assert_allclose(array(found["intensity"]), trusted["intensity"].mean("frame"), atol=1e-6)
    stated = (motion.standard_errors(data) ** 2).mean("axis", skipna=False).mean("frame") ** 0.5
    np.testing.assert_allclose(array(found["stated"]), stated, atol=1e-6)
    np.testing.assert_array_equal(found["accepted"], spread["n"])
    status = service.fits.known["status"]
    made = (status & (Status.OUTSIDE_FRAME | Status.BAD_FRAME)) == 0
    np.testing.assert_array_equal(found["fits"], made.sum(axis=0))
    share = array(found["accepted_share"])
    np.testing.assert_allclose(
        share, found["accepted"] / np.where(made.any(axis=0), made.sum(axis=0), np.nan), atol=1e-6
    )
    assert found["sd"].isna().tolist() == [k == 2 for k in range(N_COLUMNS)]
    assert found["kind"].tolist() == ["Ce", "O"] * 3
    np.testing.assert_allclose(found["x"], data["x_ref"], atol=1e-6)


def test_a_series_is_the_columns_accepted_fits(service):
    service.fits.finish()
    trusted = results.accepted(open_results(service.fits.path)).sel(column_id=4)
    found = get(service, "/series/4")
    assert found["frames_per_point"] == 1
    assert found["frame"] == list(range(N_FRAMES))
    np.testing.assert_allclose(found["t"], np.arange(N_FRAMES) * FRAME_S)
    for axis in ("x", "y"):
        values, errors = (trusted[name].sel(parameter=axis) for name in ("fit", "stderr"))
        np.testing.assert_allclose(array(found[axis]), values, atol=1e-6)
        np.testing.assert_allclose(array(found[f"{axis}_stderr"]), errors, atol=1e-6)
        away = PIXEL_PM * (values - trusted[f"{axis}_ref"])
        np.testing.assert_allclose(array(found[f"d{axis}"]), away, atol=1e-5)
        np.testing.assert_allclose(array(found[f"d{axis}_stderr"]), PIXEL_PM * errors, atol=1e-5)
    np.testing.assert_allclose(array(found["intensity"]), trusted["intensity"], atol=1e-6)
    np.testing.assert_allclose(array(found["intensity_stderr"]), trusted["intensity_stderr"], atol=1e-6)
    assert found["x"][5] is None  # the bad frame
    part = get(service, "/series/4", start=7, stop=11)
    assert part["frame"] == [7, 8, 9, 10]
    assert part["x"] == found["x"][7:11]


def test_a_long_series_is_averaged_with_the_standard_error_of_the_mean(service):
    service.fits.finish()
    trusted = results.accepted(open_results(service.fits.path)).sel(column_id=1)
    x, error = (trusted[name].sel(parameter="x").to_numpy() for name in ("fit", "stderr"))
    found = get(service, "/series/1", points=6)
    assert (found["frames_per_point"], found["frame"]) == (4, [0, 4, 8, 12, 16, 20])
    np.testing.assert_allclose(found["t"], [0.15, 0.55, 0.95, 1.35, 1.75, 2.1])  # middles; the last has 3 frames
    for k in range(6):
        here = slice(4 * k, 4 * k + 4)
        known = np.isfinite(x[here])
        n = known.sum()
        assert found["accepted"][k] == n
        np.testing.assert_allclose(found["x"][k], x[here][known].mean(), atol=1e-6)
        np.testing.assert_allclose(found["x_stderr"][k], np.sqrt((error[here][known] ** 2).sum()) / n, atol=1e-6)
        np.testing.assert_allclose(
            (found["x_low"][k], found["x_high"][k]), (x[here][known].min(), x[here][known].max())
        )


def test_the_error_of_a_mean_comes_from_the_spread_where_fits_state_none():
    values = np.array([1.0, 2.0, 6.0, np.nan, 5.0, np.nan, np.nan, np.nan])
    found = tracks._points("x", values, np.full(8, np.nan), 4)
    assert found["x"] == [3.0, 5.0]
    assert found["x_stderr"] == [pytest.approx(np.std([1, 2, 6], ddof=1) / np.sqrt(3), abs=1e-6), None]


def test_curves_over_the_frames(service):
    service.fits.finish()
    found, values = get(service, "/frames"), service.fits.known
    np.testing.assert_allclose(array(found["drift_y"]), values["drift"][:, 0], atol=1e-6)
    np.testing.assert_allclose(array(found["drift_x"]), values["drift"][:, 1], atol=1e-6)
    accepted = (values["status"] & schema.REJECTED) == 0
    made = (values["status"] & (Status.OUTSIDE_FRAME | Status.BAD_FRAME)) == 0
    expected = np.where(made.any(axis=1), accepted.sum(axis=1) / np.maximum(made.sum(axis=1), 1), np.nan)
    np.testing.assert_allclose(array(found["accepted_share"]), expected, atol=1e-6)
    amplitude = np.where(accepted, values["fit"][..., parameters.AMPLITUDE], np.nan)
    for frame in (0, 11, 22):
        assert found["amplitude"][frame] == pytest.approx(np.nanmean(amplitude[frame]), abs=1e-6)
    assert found["amplitude"][5] is None
    binned = get(service, "/frames", points=12)
    assert binned["drift_y"][1] == pytest.approx(values["drift"][2:4, 0].mean(), abs=1e-6)
    assert binned["accepted_share"][1] == pytest.approx(accepted[2:4].sum() / made[2:4].sum(), abs=1e-6)


def test_displacement_between_two_frames(service):
    service.fits.finish()
    expected = motion.displacement(open_results(service.fits.path), 3, 14)
    for first, second, sign in ((3, 14, 1), (14, 3, -1)):
        found = pd.DataFrame(get(service, "/displacement", first=first, second=second)["columns"])
        for axis in ("x", "y"):
            moved, error = (expected[name].sel(axis=axis) for name in ("displacement", "stderr"))
            np.testing.assert_allclose(array(found[f"d{axis}"]), sign * moved, atol=1e-5)
            np.testing.assert_allclose(array(found[f"stderr_{axis}"]), error, atol=1e-5)
        np.testing.assert_allclose(array(found["p_value"]), expected["p_value"], atol=1e-6)
    assert found["distance"].isna()[2]
    still = pd.DataFrame(get(service, "/displacement", first=3, second=3)["columns"])
    np.testing.assert_array_equal(still["dx"].dropna(), 0)


def test_of_an_unfinished_store_finished_shards_count_and_no_others(service):
    fits = service.fits
    fits.write(0, 3)
    fits.write(1, record=False)  # its task was killed before the entry in the journal
    found = get(service, "")
    assert found["shards"] == {"done": 2, "total": 6}
    assert found["frames"] == {"done": 8, "total": 23}
    assert not found["complete"]
    frames = np.r_[0:4, 12:16]
    accepted = (fits.known["status"][frames] & schema.REJECTED) == 0
    assert found["accepted"] == accepted.sum()
    x = np.where(accepted, fits.known["fit"][frames][..., parameters.X], np.nan)
    columns = get(service, "/columns")["columns"]
    assert columns[0]["sd_x"] == pytest.approx(PIXEL_PM * np.nanstd(x[:, 0], ddof=1), abs=1e-6)
    shown = array(get(service, "/series/1")["x"])
    np.testing.assert_allclose(shown[frames], x[:, 0], atol=1e-6)
    assert np.isnan(np.delete(shown, frames)).all()
    assert get(service, "/frames")["drift_x"][4:12] == [None] * 8
    assert [row["dx"] for row in get(service, "/displacement", first=0, second=4)["columns"]] == [None] * N_COLUMNS
    moved = [row["dx"] is not None for row in get(service, "/displacement", first=0, second=13)["columns"]]
    assert moved == (accepted[0] & accepted[5]).tolist()
    assert any(moved)


def test_times_are_those_of_the_stamps_where_frames_were_lost(service):
    fits, time = service.fits, FRAME_S * np.arange(N_FRAMES)
    time[12:] += 5.0
    fits.finish()
    results.calibrate(fits.path, time, pixel_size_pm=PIXEL_PM, frame_time_s=FRAME_S, dose=None)
    assert get(service, "")["last_time"] == pytest.approx(time[-1])
    np.testing.assert_allclose(get(service, "/series/1", start=10, stop=14)["t"], time[10:14])
    np.testing.assert_allclose(get(service, "/frames")["t"], time)


def test_shards_that_are_added_make_the_same_as_all_at_once(service, tmp_path):
    fits, versions = service.fits, set()
    for index in (4, 0, 5, 2, 1, 3):
        fits.write(index)
        answer = get(service, "/columns")
        versions.add(answer["version"])
    fits.finish()
    grown = get(service, "/columns")
    versions.add(grown["version"])
    assert len(versions) == 7
    at_once = json.loads(tracks.columns(fits.path.parent, tmp_path / "fresh", "v"))["columns"]
    for one, other in zip(grown["columns"], at_once, strict=True):
        for name, value in other.items():
            assert one[name] == (pytest.approx(value, abs=2e-6) if isinstance(value, float) else value), name


def test_a_store_too_large_to_be_copied_is_read_itself(service, tmp_path, monkeypatch):
    service.fits.write(0, 1, 3)
    copied = get(service, "/series/4", start=2, stop=15)
    monkeypatch.setattr(track_cache, "_MAX_FITS", 0)
    read = json.loads(tracks.series(service.fits.path.parent, tmp_path / "fresh", 4, (2, 15), 2000, copied["version"]))
    assert read == copied
    assert not list((tmp_path / "fresh").rglob("series.f8"))


def test_a_copy_is_made_anew_where_it_was_deleted(service, tmp_path):
    service.fits.finish()
    before = get(service, "/series/1")
    folder = service.app.state.services.config.state / "tracks"
    (place,) = folder.iterdir()
    (place / "series.f8").unlink()
    (place / "frames.f8").unlink()
    assert get(service, "/series/1") == before


def test_without_a_pixel_size_lengths_are_in_px(service):
    service.fits.finish()
    numbers = np.arange(N_FRAMES, dtype=float)
    results.calibrate(service.fits.path, numbers, pixel_size_pm=None, frame_time_s=None, dose=None)
    found = get(service, "/series/1")
    assert (found["unit"], found["time_unit"]) == ("px", "frames")
    np.testing.assert_allclose(array(found["dx"]), array(found["x"]) - found["x_ref"], atol=2e-6)
    assert found["t"][3] == 3
    assert get(service, "/displacement", first=0, second=1)["unit"] == "px"


@pytest.mark.parametrize(
    ("place", "status", "said"),
    [
        ("/series/99", 400, "there is no such column"),
        ("/series/0x1", 422, "integer"),
        ("/series/1?start=30", 400, "start and stop are not a valid range of frames"),
        ("/series/1?start=3&stop=3", 400, "start and stop are not a valid range of frames"),
        ("/series/1?points=1", 422, "greater than or equal to 2"),
        ("/displacement?first=0&second=23", 400, "there is no such frame"),
        ("/displacement?first=-1&second=2", 422, "greater than or equal to 0"),
        ("/download?format=../x", 422, "'zarr', 'nc' or 'csv'"),
    ],
)
def test_what_is_not_there_is_said(service, place, status, said):
    service.fits.write(0)
    answer = service.get(f"{service.job}/results{place}")
    assert answer.status_code == status
    assert said in answer.json()["error"]["text"]


def test_a_job_without_results_says_so(service):
    store_files.remove(service.fits.path)
    for place in ("results", "results/columns", "results/download", "report", "sum", "sum.png"):
        assert service.get(f"{service.job}/{place}").status_code == 404, place
    assert service.get("jobs/0123456789/results").status_code == 404
    assert service.get("jobs/..%2f..%2fetc/results").status_code in (404, 422)


def test_an_answer_is_not_sent_twice(service):
    service.fits.write(0)
    first = service.get(f"{service.job}/results/columns")
    assert first.headers["cache-control"] == "private, no-cache"
    known = {"If-None-Match": first.headers["etag"]}
    again = service.get(f"{service.job}/results/columns", headers=known)
    assert (again.status_code, again.content) == (304, b"")
    service.fits.write(1)
    assert service.get(f"{service.job}/results/columns", headers=known).status_code == 200


def test_the_zipped_store_opens_and_equals_the_stored(service, tmp_path):
    service.fits.finish()
    answer = service.get(f"{service.job}/results/download")
    assert answer.headers["content-type"] == "application/zip"
    assert answer.headers["content-disposition"].endswith('.zarr.zip"')
    file = tmp_path / "tracks.zip"
    file.write_bytes(answer.content)
    assert zipfile.ZipFile(file).testzip() is None
    with zarr.storage.ZipStore(file, mode="r") as store:
        opened = xr.open_zarr(store, consolidated=False).load()
    stored = xr.open_zarr(service.fits.path, consolidated=False).load()
    xr.testing.assert_identical(opened, stored)
    np.testing.assert_array_equal(opened["fit"], service.fits.known["fit"])


def test_the_zip_of_an_unfinished_store_holds_its_finished_shards(service, tmp_path):
    service.fits.write(1, 4)
    service.fits.write(0, record=False)
    with zipfile.ZipFile(io.BytesIO(service.get(f"{service.job}/results/download").content)) as archive:
        archive.extractall(tmp_path / "copy.zarr")
    copy = open_results(tmp_path / "copy.zarr", unfinished=True).load()
    frames = np.r_[4:8, 16:20]
    np.testing.assert_array_equal(copy["fit"].isel(frame=frames), service.fits.known["fit"][frames])
    assert np.isnan(copy["fit"].isel(frame=np.setdiff1d(np.arange(N_FRAMES), frames))).all()
    np.testing.assert_array_equal(copy["x_ref"], open_results(service.fits.path, unfinished=True)["x_ref"])


def test_a_zip_goes_out_piece_by_piece(service, monkeypatch):
    service.fits.finish()
    monkeypatch.setattr(exports, "_PIECE", 500)
    pieces = list(exports.zipped(service.fits.path))
    assert max(map(len, pieces)) < 8000
    assert zipfile.ZipFile(io.BytesIO(b"".join(pieces))).testzip() is None


def test_tables_and_netcdf(service, tmp_path):
    service.fits.write(0, 2)
    for _ in range(10):  # each waits for some seconds
        if service.get(f"{service.job}/results/download?format=csv&prepare=true").json()["ready"]:
            break
    else:
        pytest.fail("the table does not get ready")
    answer = service.get(f"{service.job}/results/download?format=csv")
    table = pd.read_csv(io.BytesIO(answer.content))
    assert int(answer.headers["content-length"]) == len(answer.content)
    assert sorted(table["frame"].unique()) == [0, 1, 2, 3, 8, 9, 10, 11]
    x = service.fits.known["fit"][[0, 1, 2, 3, 8, 9, 10, 11], :, parameters.X].ravel()
    np.testing.assert_allclose(table["x"], x)
    np.testing.assert_allclose(table["x_pm"], PIXEL_PM * x)
    service.fits.finish()
    file = tmp_path / "tracks.nc"
    file.write_bytes(service.get(f"{service.job}/results/download?format=nc").content)
    with xr.open_dataset(file, engine="h5netcdf") as opened:
        np.testing.assert_array_equal(opened["fit"], service.fits.known["fit"])


def test_a_file_is_made_once_and_deleted_later(service, tmp_path, monkeypatch):
    service.fits.finish()
    folder = tmp_path / ".tract_dask" / "exports"
    for _ in range(2):
        service.get(f"{service.job}/results/download?format=csv")
    (made,) = folder.iterdir()
    written = made.stat().st_ino
    service.get(f"{service.job}/results/download?format=csv")
    assert made.stat().st_ino == written
    monkeypatch.setattr(exports, "_KEPT_S", -1.0)
    service.get(f"{service.job}/results/download?format=nc")
    assert [file.suffix for file in folder.iterdir()] == [".nc"]


def test_a_download_that_needs_a_missing_package_says_so(service, monkeypatch):
    service.fits.finish()
    monkeypatch.setattr("tract_dask.export.tables.find_spec", lambda name: None)
    answer = service.get(f"{service.job}/results/download?format=nc")
    assert answer.status_code == 400
    assert "needs the package h5netcdf" in answer.json()["error"]["text"]


def test_a_slow_file_is_waited_for_in_steps(tmp_path):
    class Slow(Here):
        async def run_long(self, function, *args, **limits):
            await asyncio.sleep(0.2)
            args[-1].write_text("table")

    async def steps():
        files = Exports(tmp_path, Slow())
        path = tmp_path / "out" / "results.zarr"
        first = await files.made(path, "v", "csv", wait_s=0.01)
        second = await files.made(path, "v", "csv")
        return first, second.read_text()

    assert asyncio.run(steps()) == (None, "table")


def test_the_report_may_run_its_own_scripts_and_reach_nothing(service, tmp_path):
    (tmp_path / "out" / "report.html").write_text("<!doctype html><script>1</script>")
    answer = service.get(f"{service.job}/report")
    policy = dict(part.split(" ", 1) for part in answer.headers["content-security-policy"].split("; "))
    assert answer.headers["content-type"].startswith("text/html")
    assert policy["default-src"] == "'none'"
    assert "allow-same-origin" not in policy["sandbox"]
    assert "connect-src" not in policy  # so it is that of default-src
