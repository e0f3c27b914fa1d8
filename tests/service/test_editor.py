"""The column editor in a browser: where a click lands, what the tools do, and what is kept."""

from __future__ import annotations

import json
import pathlib
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import httpx
import numpy as np
import pytest
import xarray as xr
from matplotlib.path import Path
from PIL import Image
from playwright.sync_api import Browser

from tract_dask.errors import SettingsError, StoreError
from tract_dask.service.notebook import ColumnEditor, edit_columns, edit_table
from tract_dask.settings import RunSettings
from tract_dask.stages.columns.sites import lattice_columns
from tract_dask.store import datasets
from tract_dask.store.columns import column_dataset, columns_csv, positions, read_columns_csv

SHAPE = (200, 240)
SPACING = 30.0
SIGMA = 3.5
SCREEN_BUDGET_PX = 0.5
ADDED_BUDGET_PX = 0.05

EDITOR = "import('./static/editor.js').then((module) => module.opened)"


def lattice() -> np.ndarray[Any, Any]:
    """Sites (x, y) of a lattice at no whole pixels, row by row."""
    j, i = np.mgrid[0:5, 0:7].reshape(2, -1)
    return np.stack([21.3 + SPACING * i, 24.6 + 36.0 * j], axis=1)


TRUTH = lattice()


def summed(places: np.ndarray[Any, Any], shape: tuple[int, int] = SHAPE) -> xr.Dataset:
    y, x = np.mgrid[: shape[0], : shape[1]]
    image = 10 + 0.02 * np.random.default_rng(3).standard_normal(shape)
    for cx, cy in places:
        image += 5 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * SIGMA**2))
    exposure = np.full(shape, 40, np.uint32)
    return xr.Dataset({"image": (("y", "x"), image), "exposure": (("y", "x"), exposure)}, attrs={"pixel_size_pm": 8.0})


class Seat:
    """A user in front of the page; places are in px of the image."""

    def __init__(self, browser: Browser, editor: ColumnEditor) -> None:
        self.editor, self.problems = editor, list[str]()
        self.page = browser.new_page(viewport={"width": 1100, "height": 700})
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.goto(editor.url)
        self.page.wait_for_selector("#editor:not([hidden])")
        self.until("editor.model.grid && editor.view.loaded")

    def begin(self) -> None:
        """Go back to the columns to begin with, the whole image and the first tool."""
        self.run(
            "await editor.versions.load(0, false); editor.versions.forgetDraft(); editor.choose('select');"
            "editor.view.fit(); document.getElementById('snap').checked = true;"
            "document.getElementById('toasts').replaceChildren()"
        )

    def run(self, code: str) -> Any:
        """Return the value of ``code`` in the page, where ``editor`` is the editor."""
        return self.page.evaluate(f"{EDITOR}.then(async (editor) => {{ {code} }})")

    def until(self, condition: str) -> None:
        """Wait until ``condition`` holds in the page."""
        ended = time.monotonic() + 20
        while not self.run(f"return Boolean({condition})"):
            assert time.monotonic() < ended, condition
            self.page.wait_for_timeout(20)

    def rows(self) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = self.run("return editor.model.rows()")
        return found

    def xy(self) -> dict[int, tuple[float, float]]:
        return {row["column_id"]: (row["x"], row["y"]) for row in self.rows()}

    def screen(self, x: float, y: float) -> tuple[float, float]:
        """Where a place of the image is in the window, CSS px."""
        at = self.run(
            f"const at = editor.view.toScreen({x}, {y}), frame = editor.view.element.getBoundingClientRect();"
            "return [frame.left + at.x, frame.top + at.y]"
        )
        return at[0], at[1]

    def place(self, left: float, top: float) -> tuple[float, float]:
        """Return what place of the image is there in the window."""
        at = self.run(
            "const frame = editor.view.element.getBoundingClientRect();"
            f"return editor.view.toImage({left} - frame.left, {top} - frame.top)"
        )
        return at["x"], at["y"]

    @property
    def scale(self) -> float:
        return float(self.run("return editor.view.scale"))

    def click(self, x: float, y: float, *keys: str) -> None:
        for key in keys:
            self.page.keyboard.down(key)
        self.page.mouse.click(*self.screen(x, y))
        for key in keys:
            self.page.keyboard.up(key)

    def drag(self, *line: tuple[float, float], keys: tuple[str, ...] = ()) -> None:
        places = [self.screen(*place) for place in line]
        self.page.mouse.move(*places[0])
        self.page.mouse.down()
        for place in places[1:]:
            self.page.mouse.move(*place, steps=4)
        for key in keys:
            self.page.keyboard.down(key)
        self.page.mouse.up()
        for key in keys:
            self.page.keyboard.up(key)


@contextmanager
def seated(browser: Browser, image: xr.Dataset, columns: xr.Dataset, **options: Any) -> Iterator[Seat]:
    with edit_columns(image, columns, **options) as editor:
        seat = Seat(browser, editor)
        yield seat
        assert not seat.problems
        seat.page.close(run_before_unload=False)


@pytest.fixture(scope="module")
def opened(chromium: Browser) -> Iterator[Seat]:
    """An editor that begins with every column but the last one."""
    with seated(chromium, summed(TRUTH), column_dataset(TRUTH[:-1])) as seat:
        yield seat


@pytest.fixture
def seat(opened: Seat) -> Seat:
    opened.begin()
    return opened


def test_a_place_in_the_image_is_that_place_on_the_screen(chromium: Browser) -> None:
    """The light of the window itself: nine bright pixels around (97, 61) are where the editor says that (97, 61) is."""
    image = summed(TRUTH[:0]).assign(image=(("y", "x"), np.full(SHAPE, 10.0)))
    image["image"][60:63, 96:99] = 100.0
    with seated(chromium, image, column_dataset([[30.0, 30.0]])) as seat:
        seat.run("document.getElementById('show-columns').click()")
        for scale in (0.7, 1.0, 3.0, 17.3):
            seat.run(f"editor.view.center(90.2, 66.7, {scale}); await new Promise((done) => setTimeout(done, 100))")
            seat.until("editor.view.loaded && !editor.view.frame")
            at, half = np.array(seat.screen(97, 61)), round(4 * scale) + 3
            corner = np.floor(at).astype(int) - half
            clip = {"x": int(corner[0]), "y": int(corner[1]), "width": 2 * half + 1, "height": 2 * half + 1}
            light = np.asarray(Image.open(BytesIO(seat.page.screenshot(clip=clip))).convert("L"), dtype=float)
            light = np.clip(light - np.median(light[0]), 0, None)
            centre = [(light.sum(axis=axis) @ (np.arange(2 * half + 1) + 0.5)) / light.sum() for axis in (0, 1)]
            assert np.abs(corner + centre - at).max() < SCREEN_BUDGET_PX, scale


@pytest.mark.parametrize("scale", [1.4, 6.0])
def test_a_click_on_a_column_means_its_place(seat: Seat, scale: float) -> None:
    x, y = TRUTH[16]
    seat.run(f"editor.view.center({x} + 9, {y} - 7, {scale})")
    seat.click(x, y)
    told = seat.run("return [...editor.model.selection]"), seat.page.text_content("#place")
    assert told[0] == [17]
    where = [float(part) for part in str(told[1]).replace("px", "").split() if part.replace(".", "").isdigit()]
    assert np.abs(np.array(where[:2]) - (x, y)).max() < SCREEN_BUDGET_PX / scale + 0.06  # one decimal is told


def test_zooming_keeps_what_is_under_the_pointer(seat: Seat) -> None:
    pointer = np.rint(seat.screen(*TRUTH[9]))
    before = seat.place(*pointer)
    seat.page.mouse.move(*pointer)
    for turn in (-400, -400, 250):
        seat.page.mouse.wheel(0, turn)
    seat.until("editor.view.scale > 6 && editor.view.scale < 20")
    seat.page.wait_for_timeout(100)
    assert np.abs(np.subtract(seat.place(*pointer), before)).max() * seat.scale < SCREEN_BUDGET_PX


def test_delete_three_drag_one_add_one(seat: Seat) -> None:
    first = seat.xy()
    seat.click(*TRUTH[0])
    seat.click(*TRUTH[8], "Shift")
    seat.click(*TRUTH[12], "Shift")
    seat.page.keyboard.press("Delete")
    assert set(first) - set(seat.xy()) == {1, 9, 13}

    x, y = TRUTH[20]
    seat.drag((x, y), (x + 5, y - 4))  # it goes back to the maximum, since that is near
    seat.until(f"editor.model.done.length === 2 && Math.abs(editor.model.columns.get(21).x - {x}) < 1")
    assert np.hypot(*np.subtract(seat.xy()[21], (x, y))) < ADDED_BUDGET_PX

    seat.page.keyboard.press("a")
    x, y = TRUTH[-1]
    seat.click(x + 3.4, y - 2.2)
    seat.until(f"editor.model.done.length === 3 && Math.abs(editor.model.selected()[0].x - {x}) < 1")
    new = set(seat.xy()) - set(first)
    assert len(new) == 1
    assert min(new) > max(first)
    assert np.hypot(*np.subtract(seat.xy()[min(new)], (x, y))) < ADDED_BUDGET_PX

    seat.page.keyboard.press("Control+s")
    seat.until("!editor.model.dirty")
    saved = seat.editor.columns
    assert set(saved["column_id"].to_numpy().tolist()) == (set(first) | new) - {1, 9, 13}
    assert np.abs(positions(saved) - np.delete(TRUTH, [0, 8, 12], axis=0)).max() < ADDED_BUDGET_PX


def test_a_drag_with_alt_is_exact(seat: Seat) -> None:
    x, y = TRUTH[10]
    seat.drag((x, y), (x + 6.0, y + 2.5), keys=("Alt",))
    assert np.abs(np.subtract(seat.xy()[11], (x + 6.0, y + 2.5))).max() < SCREEN_BUDGET_PX / seat.scale


def test_lasso_deletes_exactly_those_inside_and_undo_restores_them(seat: Seat) -> None:
    before = json.dumps(seat.rows())
    line = [(6.0, 40.0), (100.0, 45.0), (97.0, 112.0), (66.0, 75.0), (35.0, 115.0), (6.0, 110.0)]
    seat.page.keyboard.press("d")
    seat.drag(*line)
    inside = {n for n, place in enumerate(TRUTH[:-1], start=1) if Path(line).contains_point(place)}
    assert inside == {8, 9, 10, 15}
    left = {row["column_id"] for row in seat.rows()}
    assert set(range(1, len(TRUTH))) - left == inside
    seat.page.keyboard.press("Control+z")
    assert json.dumps(seat.rows()) == before
    seat.page.keyboard.press("Control+Shift+z")
    assert {row["column_id"] for row in seat.rows()} == left


def test_every_step_back_restores_what_was(seat: Seat) -> None:
    states = [json.dumps(seat.rows())]
    seat.click(*TRUTH[3])
    for act in ("Delete", "kind", "drag"):
        if act == "kind":
            seat.click(*TRUTH[4])
            seat.page.fill("#kind", "Ce")
            seat.page.press("#kind", "Enter")
        elif act == "drag":
            seat.page.uncheck("#snap")
            seat.drag(tuple(TRUTH[5]), (TRUTH[5][0] + 9, TRUTH[5][1]))
        else:
            seat.page.keyboard.press(act)
        states.append(json.dumps(seat.rows()))
    assert len(set(states)) == len(states)
    for state in reversed(states[:-1]):
        seat.run("editor.undo()")
        assert json.dumps(seat.rows()) == state
    for state in states[1:]:
        seat.run("editor.redo()")
        assert json.dumps(seat.rows()) == state


def test_three_clicks_lay_a_lattice(chromium: Browser) -> None:
    """The sites are those of lattice_columns between the columns that were clicked; those that are columns stay."""
    start = TRUTH[[0, 3, 21]]  # origin, three columns along a, three rows along b
    with seated(chromium, summed(TRUTH), column_dataset(start)) as seat:
        seat.page.keyboard.press("t")
        for place in start:
            seat.click(place[0] + 0.6, place[1] - 0.5)
        for name, value in {"a_count": 3, "a_after": 8, "b_count": 3, "b_after": 4}.items():
            seat.page.fill(f"[name={name}]", str(value))
        seat.page.fill("#lattice-kind", "Ce")
        told = str(seat.page.text_content("[data-part=told]"))
        seat.page.click("#lattice [type=submit]")
        seat.page.wait_for_selector("text=37 columns added")
        rows = seat.rows()
    assert "45 sites" in told
    assert "5 outside the image" in told
    assert "3 are columns already" in told
    sites = positions(lattice_columns(start[0], start[1], 3, start[2], 3, 9, 5))
    sites = sites[sites[:, 0] < SHAPE[1] - 0.5]
    found = np.array([[row["x"], row["y"]] for row in rows])
    distance = np.hypot(*(sites[:, None] - found).transpose(2, 0, 1))
    assert len(rows) == len(sites) == 40
    assert distance.min(axis=1).max() < 1e-6
    assert [row["kind"] for row in rows] == [""] * 3 + ["Ce"] * 37
    assert [row["column_id"] for row in rows] == list(range(1, 41))


def test_columns_that_fall_together_are_told(seat: Seat) -> None:
    x, y = TRUTH[7] + (4.0, 3.0)
    seat.run(f"editor.model.edit('twin', {{ put: editor.model.created([{{ x: {x}, y: {y} }}]) }})")
    seat.page.keyboard.press("r")
    seat.page.click("text=1 column falls together with another")
    assert seat.run("return [...editor.model.selection]") == [max(seat.xy())]
    seat.page.keyboard.press("r")


def test_what_is_not_saved_survives_a_reload_and_warns(seat: Seat) -> None:
    seat.click(*TRUTH[2])
    seat.page.keyboard.press("Delete")
    asked: list[str] = []
    seat.page.once("dialog", lambda dialog: (asked.append(dialog.type), dialog.accept()))
    seat.page.reload()
    seat.page.wait_for_selector("text=Not saved")
    assert asked == ["beforeunload"]
    assert 3 not in seat.xy()
    seat.run("editor.undo()")
    assert 3 in seat.xy()


def test_versions_are_kept_and_loaded(seat: Seat) -> None:
    saved = seat.run("return editor.versions.known.versions.length - 1")
    seat.page.fill("#note", "without the first")
    seat.click(*TRUTH[0])
    seat.page.keyboard.press("Delete")
    seat.page.click("[data-do=save]")
    seat.page.wait_for_selector("text=from version 0: without the first")
    assert seat.run("return editor.model.version") == saved + 1
    seat.page.click("#version-list >> text=Automatic")
    seat.until("editor.model.version === 0")
    assert 1 in seat.xy()
    seat.click(*TRUTH[1])
    seat.page.keyboard.press("Delete")
    seat.page.click("[data-do=save]")
    seat.page.wait_for_selector(f"text={saved + 1} was saved elsewhere")
    assert seat.page.text_content("#version-list .current .version-number") == str(saved + 2)
    assert seat.editor.columns["column_id"].to_numpy().tolist() == [1, *range(3, 35)]


def test_going_on_ends_the_wait(chromium: Browser) -> None:
    saved: list[int] = []
    keep = {"on_saved": lambda columns: saved.append(columns.sizes["column_id"])}
    with seated(chromium, summed(TRUTH), column_dataset(TRUTH), **keep) as seat:
        seat.click(*TRUTH[34])
        seat.page.keyboard.press("Delete")
        seat.page.click("text=Save and close")
        seat.page.wait_for_selector("text=You can close this page")
        columns = seat.editor.wait()
    assert saved == [34]
    assert columns["column_id"].to_numpy().tolist() == list(range(1, 35))


def test_twenty_thousand_columns_stay_quick(chromium: Browser) -> None:
    """Hits look at the neighbourhood only, and a step of the view is drawn in a small part of a second."""
    j, i = np.mgrid[0:100, 0:200].reshape(2, -1)
    places = np.stack([6.0 + 10 * i, 6.0 + 10 * j], axis=1)
    flat = {"image": np.ones((1010, 2010)), "exposure": np.ones((1010, 2010), np.uint32)}
    image = xr.Dataset({name: (("y", "x"), values) for name, values in flat.items()})
    with seated(chromium, image, column_dataset(places)) as seat:
        timed = (
            "const began = performance.now(); for (let n = 0; n < %d; n++) %s; return (performance.now() - began) / %d"
        )
        assert seat.run("return editor.model.size") == 20_000
        assert seat.run(timed % (1000, "editor.model.grid.nearest(n, n, 8)", 1000)) < 0.2
        assert seat.run(timed % (10, "editor.view.draw()", 10)) < 400


def test_nobody_sees_it_without_the_secret(opened: Seat) -> None:
    editor = opened.editor
    host = editor.url.rsplit("/", 2)[0]
    assert httpx.get(f"{host}/").status_code == 404
    assert httpx.get(f"{host}/static/editor.js").status_code == 404
    answer = httpx.get(editor.url)
    assert answer.status_code == 200
    assert "frame-ancestors *" in answer.headers["content-security-policy"]
    assert editor.url in editor._repr_html_()


def test_a_notebook_serves_the_routes_of_the_editor_only(opened: Seat) -> None:
    """It keeps versions in memory, and the image and the first columns in a folder that goes with it."""
    editor = opened.editor
    assert sorted(path.name for path in pathlib.Path(editor._folder.name).iterdir()) == ["columns.zarr", "sum.zarr"]
    jobs = f"{editor.url}api/v1/jobs/0000000000"
    assert httpx.get(f"{jobs}/sum").status_code == 200
    assert httpx.get(f"{editor.url}api/v1/files/frame.png?path=sum.zarr").status_code == 404
    for answer in (
        httpx.get(f"{jobs}/columns/999"),
        httpx.post(f"{jobs}/continue", json={"version": 999}),
    ):
        assert (answer.status_code, answer.json()["error"]["kind"]) == (404, "UnknownVersionError")


def test_the_folder_of_a_run_is_enough(tmp_path: Any) -> None:
    with pytest.raises(StoreError, match="there is no Dataset here"):
        edit_columns(tmp_path)
    with pytest.raises(SettingsError, match="outside the image"):
        edit_columns(summed(TRUTH), column_dataset([[500.0, 3.0]]))


def test_the_command_line_writes_what_was_saved(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A browser that saves two of five columns, one of them moved, and is done."""
    table = tmp_path / "columns.csv"
    (table).write_text(columns_csv(column_dataset(TRUTH[:5])))
    datasets.write_dataset(summed(TRUTH), tmp_path / "columns_sum.zarr")
    opened: list[str] = []

    def user(url: str) -> None:
        job = re.search(r'data-job="(\w+)"', httpx.get(url).text)
        assert job is not None
        api = f"{url}api/v1/jobs/{job[1]}"
        kept = [{"column_id": 2, "x": 50.25, "y": 60.0, "kind": "Ce"}, {"column_id": 4, "x": 70.0, "y": 80.0}]
        httpx.post(f"{api}/columns", json={"columns": kept, "base": 0}).raise_for_status()
        httpx.post(f"{api}/continue", json={"version": 1}).raise_for_status()

    monkeypatch.setattr("webbrowser.open", user)
    assert edit_table(table, RunSettings(), opened.append)
    written = read_columns_csv(table)
    assert written["column_id"].to_numpy().tolist() == [2, 4]
    assert positions(written).tolist() == [[50.25, 60.0], [70.0, 80.0]]
    assert written["kind"].to_numpy().tolist() == ["Ce", ""]
    assert len(opened) == 1


def test_closing_the_page_ends_the_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tract_dask.service.notebook._GONE_S", 0.2)
    with edit_columns(summed(TRUTH), column_dataset(TRUTH[:3])) as editor:
        with httpx.stream("GET", f"{editor.url}open") as stream:
            next(stream.iter_lines())
        assert positions(editor.wait()).tolist() == TRUTH[:3].tolist()
        assert not editor.saved
