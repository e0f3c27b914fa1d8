"""The page of results in a browser: what it shows of a column is what the store holds."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from playwright import sync_api
from serviced import listening
from test_service_results import N_COLUMNS, Fits

from tract_dask import open_results
from tract_dask.store import datasets, results

expect = sync_api.expect


SHAPE = (90, 100)
WAIT_MS = 30_000


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """The address of a job's results, and its fits; the last two shards are not done yet."""
    root = tmp_path_factory.mktemp("root")
    np.save(root / "movie.npy", np.zeros((2, *SHAPE), np.uint8))
    (root / "out").mkdir()
    fits = Fits(root / "out")
    fits.create()
    fits.write(*range(4))
    image = {"image": (("y", "x"), np.random.default_rng(0).normal(10, 1, SHAPE))}
    image["exposure"] = (("y", "x"), np.full(SHAPE, 5, np.uint32))
    datasets.write_dataset(xr.Dataset(image, attrs={"pixel_size_pm": 4.0}), root / "out" / "sum.zarr")
    with listening(root) as (address, app):
        made = app.state.services.store.submit(source="movie.npy", settings={}, owner="local", output="out")
        yield f"{address}/jobs/{made.id}/results", fits


@pytest.fixture
def page(chromium, job):
    """The page, once it shows results; what goes wrong in it fails the test."""
    shown, wrong = chromium.new_page(viewport={"width": 1366, "height": 768}), []
    shown.set_default_timeout(WAIT_MS)
    shown.on("pageerror", lambda error: wrong.append(str(error)))
    shown.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
    shown.goto(job[0])
    shown.wait_for_selector("#chosen li")
    yield shown
    shown.close()
    assert wrong == []


def on_map(page, fits: Fits, column_id: int) -> tuple[float, float]:
    """The place of a column on the screen: the view fits the image into the map, with four px around."""
    box = page.locator("#map").bounding_box()
    scale = min((box["width"] - 8) / SHAPE[1], (box["height"] - 8) / SHAPE[0])
    column = open_results(fits.path, unfinished=True).sel(column_id=column_id)
    away = float(column["x_ref"]) - (SHAPE[1] - 1) / 2, float(column["y_ref"]) - (SHAPE[0] - 1) / 2
    return box["x"] + box["width"] / 2 + scale * away[0], box["y"] + box["height"] / 2 + scale * away[1]


def chosen(page) -> list[str]:
    return [text.removesuffix("×") for text in page.locator("#chosen li").all_text_contents()]


def saved(page, file: Path) -> list[dict[str, str]]:
    with page.expect_download() as download:
        page.click("#save")
    download.value.save_as(file)
    return list(csv.DictReader(file.open(newline="")))


def test_a_click_on_a_column_shows_its_series(page, job, tmp_path):
    fits = job[1]
    page.mouse.click(*on_map(page, fits, 4))
    expect(page.locator("#chosen li")).to_have_text("4×", timeout=WAIT_MS)
    expect(page.locator("#series-x canvas")).to_have_attribute("aria-label", re.compile("4 from"), timeout=WAIT_MS)
    rows = saved(page, tmp_path / "series.csv")
    trusted = results.accepted(open_results(fits.path, unfinished=True)).sel(column_id=4)
    assert [row["frame"] for row in rows] == [str(frame) for frame in range(23)]
    for name, values in (
        ("x_px", trusted["fit"].sel(parameter="x")),
        ("y_stderr_px", trusted["stderr"].sel(parameter="y")),
        ("intensity_counts", trusted["intensity"]),
    ):
        shown = np.array([row[name] or "nan" for row in rows], float)
        np.testing.assert_allclose(shown, values, atol=1e-6)
        assert np.isnan(shown[16:]).all()  # not done yet


def test_columns_are_compared_and_let_go(page, job, tmp_path):
    page.click("[data-column='1'] .id-button")
    page.click("[data-column='6'] .id-button", modifiers=["Shift"])
    assert chosen(page) == ["1", "6"]
    assert page.url.endswith("#columns=1,6")
    expect(page.locator("#series-x .chart-key")).to_have_count(2, timeout=WAIT_MS)
    assert {row["column_id"] for row in saved(page, tmp_path / "series.csv")} == {"1", "6"}
    page.click("#chosen li:first-child button")
    assert chosen(page) == ["6"]
    assert page.locator("tr[aria-selected='true']").get_attribute("data-column") == "6"


def test_the_table_sorts_and_what_is_unknown_comes_last(page):
    page.click("text=sd (pm) >> nth=-1")
    heads = page.locator("#table th").all_text_contents()
    cells = page.locator(f"#table tbody td:nth-child({heads.index('sd (pm)') + 1})").all_text_contents()
    values = [float(cell) for cell in cells[:-1]]
    assert cells[-1] == "–"  # the column that leaves the frame
    assert values == sorted(values, reverse=True)


def test_the_histogram_picks_out_columns(page):
    box = page.locator("#histogram canvas").bounding_box()
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.99 * box["width"], box["y"] + 40, steps=3)
    page.mouse.up()
    said = page.locator("#table-said").text_content()
    count = int(said.split()[0])
    assert said.endswith("picked out")
    assert 0 < count < N_COLUMNS
    assert page.locator("tr[data-dim]").count() == N_COLUMNS - count
    page.select_option("#quantity", "intensity")
    assert page.locator("tr[data-dim]").count() == 0


def test_displacements_between_two_frames_are_told(page, job):
    page.click("[data-mode='arrows']")
    page.fill("#first", "1")
    page.fill("#second", "6")
    expect(page.locator("#map-said")).to_contain_text("moved", timeout=WAIT_MS)
    page.mouse.move(*on_map(page, job[1], 4))
    page.wait_for_selector("#tip:not([hidden])")
    assert "Column 4" in page.locator("#tip").text_content()


def test_what_is_done_is_shown_and_the_rest_comes_by_itself(page, job):
    assert page.locator("#live-text").text_content().startswith("4 of 6 shards fitted")
    assert page.locator("#figures").text_content().startswith("Frames16 of 23")
    assert page.locator("#report").is_hidden()


def test_medians_of_an_even_number_of_columns_are_those_of_the_report(chromium, job):
    page, rows = chromium.new_page(), []

    def without_the_first(route):
        answer = route.fetch()
        found = answer.json()
        rows[:] = found["columns"][1:]
        route.fulfill(response=answer, json=found | {"columns": rows})

    page.route("**/results/columns*", without_the_first)
    page.goto(job[0])
    page.wait_for_selector("#chosen li")
    known = np.array([row["sd"] for row in rows if row["sd"] is not None])
    assert len(known) == 4
    shown = re.search(r"sd, median([\d.]+) pm", page.locator("#figures").text_content())
    assert float(shown[1]) == pytest.approx(np.median(known), rel=6e-3)
    page.close()


def test_downloads_are_offered(page, job, tmp_path):
    page.click("#downloads summary")
    with page.expect_download() as download:
        page.click("[data-format='zarr']")
    assert download.value.suggested_filename.endswith(".zarr.zip")
