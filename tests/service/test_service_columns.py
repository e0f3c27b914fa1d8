"""Columns of a job over the API: what may be saved, how it is refined, lattices, versions, and going on."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from fastapi.testclient import TestClient
from serviced import make_app

from tract_dask.errors import MissingStoreError, SettingsError
from tract_dask.service.auth.tokens import Identity, identity
from tract_dask.service.jobs.states import State
from tract_dask.service.views import column_editing
from tract_dask.service.views.column_editing import MOST_COLUMNS, edited_columns, lattice_sites, refine
from tract_dask.settings import ColumnSettings, RunSettings, to_dict
from tract_dask.stages.columns.find import find_columns
from tract_dask.stages.columns.sites import lattice_columns
from tract_dask.store import datasets, files, metadata
from tract_dask.store.columns import column_dataset, parse_columns_csv, positions
from tract_dask.store.provenance import provenance
from tract_dask.store.run_folder import RunFolder

SHAPE = (150, 180)
SPACING = 30.0
SIGMA = 3.4
REFINED_BUDGET_PX = 0.02

j, i = np.mgrid[0:4, 0:5].reshape(2, -1)
TRUTH = np.stack([24.4 + SPACING * i, 22.7 + 33.0 * j], axis=1)


def image() -> xr.Dataset:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    counts = 10 + 0.01 * np.random.default_rng(1).standard_normal(SHAPE)
    for cx, cy in TRUTH:
        counts += 5 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * SIGMA**2))
    exposure = np.full(SHAPE, 40, np.uint32)
    return xr.Dataset({"image": (("y", "x"), counts), "exposure": (("y", "x"), exposure)}, attrs={"pixel_size_pm": 8.0})


def write_run(folder: Path, columns: xr.Dataset | None = None, settings: ColumnSettings | None = None) -> xr.Dataset:
    """Write what a run has when it waits for columns; return the columns."""
    settings = settings or ColumnSettings()
    outputs, summed = RunFolder(folder), image()
    found = find_columns(summed, settings) if columns is None else columns
    folder.mkdir(parents=True)
    for dataset, path in ((summed, outputs.sum), (found, outputs.columns.with_suffix(".zarr"))):
        stored = dataset.assign_attrs({metadata.ATTRIBUTE: provenance("", settings)})
        stored.attrs = {name: value for name, value in stored.attrs.items() if value is not None}
        datasets.write_dataset(stored, path)
    return found


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> column_editing.Scene:
    folder = tmp_path_factory.mktemp("run") / "out"
    write_run(folder)
    return column_editing.scene_of(folder, RunSettings())


class Service:
    """The application with a job that waits for its columns."""

    def __init__(self, root: Path) -> None:
        self.app = make_app(root)
        self.store = self.app.state.services.store
        self.job = self.store.submit(source="movie.tif", settings=stored(), owner="local", curate=True)
        self.found = write_run(root / self.job.output)
        self.woken = 0
        self.app.state.services.runner.wake = self._woken
        self.client = TestClient(self.app, base_url="http://127.0.0.1:8000", raise_server_exceptions=False)
        self.reach(State.RUNNING, State.WAITING)

    def _woken(self) -> None:
        self.woken += 1

    def reach(self, *states: State) -> None:
        for state in states:
            self.store.change(self.job.id, state)

    def get(self, path: str, status: int = 200) -> Any:
        return self._checked(self.client.get(f"/api/v1/jobs/{self.job.id}{path}"), status)

    def post(self, path: str, body: Any, status: int = 200) -> Any:
        return self._checked(self.client.post(f"/api/v1/jobs/{self.job.id}{path}", json=body), status)

    @staticmethod
    def _checked(answer: Any, status: int) -> Any:
        assert answer.status_code == status, answer.text
        return answer.json()


def stored() -> dict[str, Any]:
    settings = to_dict(RunSettings())
    del settings["cluster"]
    return settings


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    made = Service(tmp_path)
    yield made
    made.client.close()


def rows(columns: xr.Dataset) -> list[dict[str, Any]]:
    return [
        {"column_id": int(number), "x": float(x), "y": float(y)}
        for number, (x, y) in zip(columns["column_id"].to_numpy(), positions(columns), strict=True)
    ]


def test_long_tables_stay_in_the_pool(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """To pack and unpack what is in them would hold other requests up."""
    passed, run = [], service.app.state.services.pool.run

    async def noted(function: Any, *args: Any, **limits: Any) -> Any:
        value = await run(function, *args, **limits)
        passed.extend((*args, *(value if isinstance(value, tuple) else [value])))
        return value

    monkeypatch.setattr(service.app.state.services.pool, "run", noted)
    table = {"columns": rows(service.found), "note": "one", "base": 0}
    assert service.post("/columns", table, 201) == {"version": 1, "count": len(TRUTH), "newer": []}
    assert len(service.post("/columns/refine", {"columns": rows(service.found)})["columns"]) == len(TRUTH)
    assert len(passed) == 9
    assert all(
        isinstance(part, column_editing.Scene | int | str | bytes) or part == {"note": "one", "base": 0}
        for part in passed
    )


def test_version_0_is_what_the_settings_find(service: Service) -> None:
    listed = service.get("/columns")
    assert [(one["version"], one["count"]) for one in listed["versions"]] == [(0, len(TRUTH))]
    assert listed["next_column_id"] == len(TRUTH) + 1
    assert (listed["state"], listed["may_continue"], listed["chosen"]) == ("waiting_for_columns", True, None)
    table = service.get("/columns/0")
    assert [(row["column_id"], row["x"], row["y"]) for row in table["columns"]] == [
        (row["column_id"], row["x"], row["y"]) for row in rows(service.found)
    ]
    assert table["spacing_px"] == pytest.approx(SPACING, abs=0.05)
    blurred = 5 * SIGMA**2 / (SIGMA**2 + 1.0**2)  # by the 1 px with which frames are fitted
    assert table["columns"][6]["amplitude"] == pytest.approx(blurred, rel=0.01)


def test_saved_versions_are_read_back_exactly_and_the_job_goes_on(service: Service) -> None:
    kept = [row | {"kind": "Ce"} for row in rows(service.found)[3:]]
    new = {"x": 50.123456789012345, "y": 1 / 3, "kind": "adatom, α"}
    saved = service.post("/columns", {"columns": [*kept, new, new | {"x": 60.0}], "note": "three off", "base": 0}, 201)
    assert saved == {"version": 1, "count": len(TRUTH) - 1, "newer": []}
    table = service.get("/columns/1")["columns"]
    assert [(row["column_id"], row["x"], row["kind"]) for row in table[:-2]] == [
        (row["column_id"], row["x"], "Ce") for row in kept
    ]
    assert [row["column_id"] for row in table[-2:]] == [len(TRUTH) + 1, len(TRUTH) + 2]
    assert (table[-2]["x"], table[-2]["y"], table[-2]["kind"]) == (new["x"], new["y"], new["kind"])
    listed = service.get("/columns")
    assert listed["versions"][1]["note"] == "from version 0: three off"
    assert listed["next_column_id"] == len(TRUTH) + 3

    job = service.post("/continue", {"version": 1})
    assert (job["state"], job["columns_version"], service.woken) == ("queued", 1, 1)
    assert "may_continue" in service.get("/columns")
    assert service.post("/continue", {"version": 1}, 409)["error"]["what"] == "a job that is queued cannot be continued"


def test_nothing_is_overwritten(service: Service) -> None:
    first, *rest = rows(service.found)
    assert service.post("/columns", {"columns": rest, "base": 0}, 201)["newer"] == []
    assert service.post("/columns", {"columns": [first], "base": 0}, 201) == {"version": 2, "count": 1, "newer": [1]}
    assert [len(service.get(f"/columns/{version}")["columns"]) for version in (0, 1, 2)] == [20, 19, 1]
    assert service.post("/columns", {"columns": [{"x": 9, "y": 9}], "base": 2}, 201)["version"] == 3
    assert service.get("/columns/3")["columns"][0]["column_id"] == 21  # numbers are given once


def test_a_finished_job_can_be_fitted_again(service: Service) -> None:
    service.post("/continue", {"version": 0})
    service.reach(State.RUNNING, State.DONE)
    assert service.get("/columns")["may_continue"]
    assert service.post("/continue", {"version": 0})["state"] == "queued"


def test_who_does_not_own_the_job_may_look_only(service: Service) -> None:
    service.app.dependency_overrides[identity] = lambda: Identity("other", "user")
    listed = service.get("/columns")
    assert (listed["may_save"], listed["may_continue"]) == (False, False)
    assert service.post("/columns/refine", {"columns": rows(service.found), "spacing_px": SPACING})["columns"]
    service.post("/columns", {"columns": rows(service.found)}, 403)
    service.post("/continue", {"version": 0}, 403)


@pytest.mark.parametrize(
    ("columns", "status", "what"),
    [
        ([], 422, ""),
        ([{"x": 5}], 422, ""),
        ([{"x": 5, "y": "5"}], 422, "a number is needed"),
        ([{"x": 5, "y": 5, "z": 1}], 422, ""),
        ([{"x": 5, "y": 1e300}], 422, ""),
        ([{"x": 5, "y": 5, "kind": "k" * 65}], 422, ""),
        ([{"x": 5, "y": 5, "kind": "a\nb"}], 422, ""),
        ([{"x": 5, "y": 5, "column_id": -1}], 422, ""),
        ([{"x": 5, "y": 5, "column_id": True}], 422, "a number is needed"),
        ([{"x": 5, "y": 5, "kind": " a"}], 400, "a kind cannot be used"),
        ([{"x": 5, "y": 5, "column_id": 3}, {"x": 9, "y": 9, "column_id": 3}], 400, "a column_id comes twice"),
        ([{"x": 180, "y": 5}], 400, "1 of 1 columns lie outside the image"),
        ([{"x": -0.6, "y": 5}, {"x": 2, "y": 5}], 400, "1 of 2 columns lie outside the image"),
    ],
)
def test_what_cannot_be_saved_is_refused(service: Service, columns: Any, status: int, what: str) -> None:
    error = service.post("/columns", {"columns": columns}, status)["error"]
    assert what in error["what"]
    assert [one["version"] for one in service.get("/columns")["versions"]] == [0]


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_numbers_are_finite(service: Service, number: str) -> None:
    body = f'{{"columns": [{{"x": {number}, "y": 1}}]}}'
    path, header = f"/api/v1/jobs/{service.job.id}/columns", {"content-type": "application/json"}
    answer = service.client.post(path, content=body, headers=header)
    assert answer.status_code == 422
    assert answer.json()["error"]["what"]


def test_without_columns_there_is_nothing_to_edit(service: Service) -> None:
    store = service.app.state.services.root.path / service.job.output / "columns.zarr"
    files.remove(store)
    assert service.get("/columns", 404)["error"]["what"] == "there are no columns yet"
    service.post("/continue", {"version": 0}, 404)
    assert service.get("/columns/7", 404)["error"]["what"] == "there is no such version of the columns"
    assert service.client.get("/api/v1/jobs/0123456789/columns").status_code == 404


def test_refining_finds_the_truth_and_what_falls_together(scene: column_editing.Scene) -> None:
    rng = np.random.default_rng(0)
    seeds = np.vstack([TRUTH + rng.uniform(-3, 3, TRUTH.shape), TRUTH[4] + (2.0, -2.0)])
    numbers = [10 * n for n in range(1, len(seeds) + 1)]
    found = refine(scene, edited_columns(seeds, [""] * len(seeds), numbers, SHAPE))
    places = np.array([[row["x"], row["y"]] for row in found["columns"]])
    assert [row["column_id"] for row in found["columns"]] == numbers[:-1]
    assert np.abs(places - TRUTH).max() < REFINED_BUDGET_PX
    assert found["merged"] == [[50, 210]]
    assert all(not row["flags"] for row in found["columns"])


def test_a_few_columns_are_refined_as_all_are(scene: column_editing.Scene) -> None:
    every = refine(scene, edited_columns(TRUTH, [""] * len(TRUTH), [None] * len(TRUTH), SHAPE))
    for place, whole in zip(TRUTH, every["columns"], strict=True):
        (alone,) = refine(scene, edited_columns([place + 2.5], [""], [1], SHAPE), every["spacing_px"])["columns"]
        assert (alone["x"], alone["y"]) == pytest.approx((whole["x"], whole["y"]), abs=2e-3)


def test_columns_that_fall_together_in_great_numbers_take_no_time(scene: column_editing.Scene) -> None:
    """600 seeds of as many kinds within 7 px: nearly every one meets every other one."""
    seeds = np.repeat(TRUTH[:1] + np.indices((7, 7)).reshape(2, -1).T - 3, 16, axis=0)[:600]
    kinds = [f"kind {k}" for k in range(len(seeds))]
    began = time.monotonic()
    found = refine(scene, edited_columns(seeds, kinds, [None] * len(seeds), SHAPE), 15.0)
    assert time.monotonic() - began < 5
    assert len(found["columns"]) < 20
    assert len(found["columns"]) + len(found["merged"]) == len(seeds)


def test_more_columns_on_a_pixel_than_can_be_meant_are_refused_at_once() -> None:
    began = time.monotonic()
    with pytest.raises(SettingsError, match=r"many columns have the same place.*200000 on the pixel at x 30, y 60"):
        edited_columns(np.full((MOST_COLUMNS, 2), (30.2, 59.9)), [""] * MOST_COLUMNS, [None] * MOST_COLUMNS, SHAPE)
    assert time.monotonic() - began < 4


def test_too_many_large_windows_are_refused_at_once(scene: column_editing.Scene) -> None:
    y, x = np.indices(SHAPE).reshape(2, -1)[:, ::7]
    with pytest.raises(SettingsError, match="windows of 51 px"):
        refine(scene, edited_columns(np.stack([x, y], 1), [""] * len(x), [None] * len(x), SHAPE), 100.0)
    twice = np.repeat(np.stack([x, y], 1), 2, axis=0)
    with pytest.raises(SettingsError, match="most of these columns have the same place"):
        refine(scene, edited_columns(twice, [""] * len(twice), [None] * len(twice), SHAPE))


def test_what_leaves_the_image_is_told(scene: column_editing.Scene) -> None:
    (edge,) = refine(scene, edited_columns([[2.0, 3.0]], ["Ce"], [5], SHAPE), SPACING)["columns"]
    assert (edge["flags"], edge["x"], edge["y"], edge["amplitude"]) == (["outside_frame"], 2.0, 3.0, None)


def test_the_sites_are_those_of_the_lattice(scene: column_editing.Scene) -> None:
    how: dict[str, Any] = {"origin": (24.4, 22.7), "a": (114.4, 22.7), "a_count": 3, "b": (24.4, 88.7), "b_count": 2}
    found = json.loads(column_editing.lattice_json(scene, how | {"a_repeats": 7, "b_repeats": 3, "kind": "O"}))
    sites = positions(lattice_columns(**how, a_repeats=7, b_repeats=3))
    inside = sites[(sites < np.array(SHAPE[::-1]) - 0.5).all(axis=1)]
    assert [[row["x"], row["y"]] for row in found["columns"]] == inside.tolist()
    assert (found["outside"], found["merged"]) == (len(sites) - len(inside), 0)
    assert {row["kind"] for row in found["columns"]} == {"O"}


def test_sites_that_are_columns_already_are_left_out() -> None:
    how: dict[str, Any] = {"origin": (10, 10), "a": (40, 10), "a_count": 1, "b": (10, 40), "b_count": 1}
    there = [[40 + 9.9, 10.0], [70.0, 40.0 + 10.1], [10.0, 40.0]]  # just within, just beyond a third of 30 px, on it
    found = lattice_sites((100, 100), how | {"a_repeats": 3, "b_repeats": 2}, there)
    assert found["merged"] == 2
    assert [(row["x"], row["y"]) for row in found["columns"]] == [(10, 10), (70, 10), (40, 40), (70, 40)]


def test_lattices_are_bounded(service: Service) -> None:
    how = {"origin": [10, 10], "a": [40, 10], "a_count": 1, "b": [10, 40], "b_count": 1}
    too_many = service.post("/columns/lattice", how | {"a_repeats": 10_000, "b_repeats": 101}, 400)
    assert too_many["error"]["what"] == "the lattice has too many sites"
    service.post("/columns/lattice", how | {"a_count": 0}, 422)
    service.post("/columns/lattice", how | {"a": [1, 2, 3]}, 422)
    one_line = service.post("/columns/lattice", how | {"b": [70, 10]}, 400)
    assert one_line["error"]["what"] == "the three atoms lie on one line"


def test_the_automatic_columns_stay_version_0_after_an_edited_table_was_fitted(tmp_path: Path) -> None:
    found = write_run(tmp_path / "first")
    write_run(tmp_path / "run", column_dataset(TRUTH[:4]))
    metadata.update_attributes(tmp_path / "run" / "columns.zarr", edited=True)
    again = column_editing.automatic(column_editing.scene_of(tmp_path / "run", RunSettings()))
    assert np.array_equal(positions(again), positions(found))
    with pytest.raises(MissingStoreError, match="there are no columns yet"):
        column_editing.automatic(column_editing.scene_of(tmp_path / "none", RunSettings()))


def test_numbers_of_new_columns_follow_all_others() -> None:
    columns = edited_columns([[1, 1], [2, 2], [3, 3], [4, 4]], ["", "a", "", ""], [7, None, 12, None], (9, 9), 5)
    assert columns["column_id"].to_numpy().tolist() == [7, 13, 12, 14]
    with pytest.raises(SettingsError, match="finite x and y"):
        edited_columns([[1, np.nan]], [""], [1], (9, 9))
    with pytest.raises(SettingsError, match="1 to 200000 columns"):
        edited_columns([], [], [], (9, 9))


def test_a_table_is_its_columns(scene: column_editing.Scene) -> None:
    table = column_editing.checked_csv(scene, [[1.1, 2.2], [1 / 3, 5]], ["a,b", 'say "x"'], [4, None], 9)
    columns = parse_columns_csv(table, "table")
    assert positions(columns).tolist() == [[1.1, 2.2], [1 / 3, 5]]
    assert columns["kind"].to_numpy().tolist() == ["a,b", 'say "x"']
    assert columns["column_id"].to_numpy().tolist() == [4, 9]
