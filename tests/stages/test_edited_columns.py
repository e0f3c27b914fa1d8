"""A table of columns that was edited by hand: what it outlives, and where it is put away."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import Scene
from distributed import Client

from tract_dask.errors import DestinationError
from tract_dask.progress import STAGES, Warned
from tract_dask.run import pipeline
from tract_dask.service.runner.job_work import place_columns
from tract_dask.settings import ConvertSettings, RunSettings
from tract_dask.stages.columns import stage as stages
from tract_dask.store import datasets, files, metadata, run_folder
from tract_dask.store.results import open_results

SETTINGS = RunSettings(convert=ConvertSettings(shard_mb=1))
KEPT = "was edited: your columns are kept"


def change(**groups: dict) -> RunSettings:
    return dataclasses.replace(
        SETTINGS, **{name: dataclasses.replace(getattr(SETTINGS, name), **values) for name, values in groups.items()}
    )


class Folder:
    """A run whose table of columns is edited."""

    def __init__(self, source: Path, root: Path, client: Client) -> None:
        self.source, self.root, self.client = source, root, client
        self.table = root / "columns.csv"
        self.warnings: list[str] = []

    def run(self, settings: RunSettings = SETTINGS, **more) -> pipeline.RunOutcome:
        events = []
        outcome = pipeline.run(
            self.source, self.root, settings, client=self.client, on_event=events.append, report=False, **more
        )
        self.warnings = [event.message for event in events if isinstance(event, Warned)]
        return outcome

    def edit(self, dropped: int = 3) -> str:
        """Remove the first columns of the table; return what is left."""
        header, *rows = self.table.read_text().splitlines()
        text = "\n".join([header, *rows[dropped:]]) + "\n"
        self.table.write_text(text)
        return text


@pytest.fixture(scope="module")
def base(client, tmp_path_factory) -> Folder:
    folder = tmp_path_factory.mktemp("edited")
    np.save(folder / "movie.npy", Scene().counts())
    made = Folder(folder / "movie.npy", folder / "out", client)
    made.run()
    return made


@pytest.fixture
def folder(base, tmp_path) -> Folder:
    shutil.copytree(base.root, tmp_path / "out")
    return Folder(base.source, tmp_path / "out", base.client)


N_COLUMNS = len(Scene().place)

CHANGES = {
    "nothing": {},
    "window": {"fit": {"window_px": 19}},
    "blur": {"fit": {"blur_sigma_px": 1.5}},
    "threshold": {"fit": {"threshold": 3.0}},
    "gain": {"metadata": {"gain": 2.0}},
    "amplitude": {"columns": {"min_amplitude": 0.2}},
    "spacing": {"columns": {"spacing_px": 30.0}},
    "search": {"columns": {"search_radius_px": 2.0}},
    "refinement": {"fit": {"refine_drift": False}},
    "drift": {"drift": {"method": "none"}},
}


@pytest.mark.parametrize("name", CHANGES)
def test_edited_columns_outlive_every_change(folder, name):
    edited = folder.edit()
    changed = change(**CHANGES[name])
    outcome = folder.run(changed)
    assert outcome.columns == N_COLUMNS - 3
    assert folder.table.read_text() == edited
    assert [KEPT in warning for warning in folder.warnings] == [True]
    assert open_results(folder.root / "results.zarr").sizes["column_id"] == N_COLUMNS - 3
    assert folder.run(changed).reused == STAGES
    assert folder.warnings == []


def test_they_outlive_changes_one_after_the_other_and_are_refitted_each_time(folder):
    edited = folder.edit()
    windows = []
    for name in ("nothing", "window", "gain", "blur", "nothing"):
        assert folder.run(change(**CHANGES[name]), until="columns").columns == N_COLUMNS - 3
        assert KEPT in folder.warnings[-1]
        found = datasets.open_dataset(folder.root / "columns.zarr")
        windows.append((found.attrs["window_px"], round(float(found["fit_ref"][0, 0]))))
    assert windows[0] == windows[-1]
    assert windows[1][0] == 19
    assert windows[2][1] == pytest.approx(2 * windows[0][1], rel=0.05)
    assert folder.table.read_text() == edited


@pytest.mark.parametrize("name", ["columns.png", "columns.zarr"])
@pytest.mark.parametrize("before", [True, False], ids=["known", "new"])
def test_they_outlive_the_loss_of_what_lies_beside_them(folder, name, before):
    edited = folder.edit()
    if before:
        folder.run()
    files.remove(folder.root / name)
    assert folder.run().columns == N_COLUMNS - 3
    assert folder.table.read_text() == edited
    assert folder.run(change(**CHANGES["window"])).columns == N_COLUMNS - 3


def test_a_table_that_nobody_edited_is_found_anew_though_its_store_was_lost(folder):
    files.remove(folder.root / "columns.zarr")
    folder.run()
    assert folder.warnings == []
    assert not metadata.attributes(folder.root / "columns.zarr")["edited"]


def test_a_removed_table_is_found_anew(folder):
    folder.edit()
    folder.run()
    folder.table.unlink()
    assert folder.run().columns == N_COLUMNS
    assert not metadata.attributes(folder.root / "columns.zarr")["edited"]


def seeds(folder: Folder, count: int) -> RunSettings:
    """Settings that name a file of columns."""
    path = folder.root.with_name(f"seeds{count}.csv")
    path.write_text("x,y\n" + "".join(f"{x},{y}\n" for x, y in Scene().place[:count]))
    return change(columns={"method": "csv", "csv": str(path)})


def test_another_method_or_file_puts_them_away_and_never_overwrites_what_was(folder):
    first = folder.edit()
    folder.run()
    assert folder.run(seeds(folder, 8), until="columns").columns == 8
    assert "columns-edited.csv" in folder.warnings[0]
    second = folder.edit(2)
    assert folder.run(seeds(folder, 8), until="columns").columns == 6
    assert folder.run(seeds(folder, 7), until="columns").columns == 7
    assert folder.run(until="columns").columns == N_COLUMNS
    assert folder.table.with_stem("columns-edited").read_text() == first
    assert folder.table.with_stem("columns-edited-2").read_text() == second


def test_the_table_itself_may_be_the_file_of_columns(folder):
    edited = folder.edit()
    settings = change(columns={"method": "csv", "csv": str(folder.table)})
    assert folder.run(settings, until="columns").columns == N_COLUMNS - 3
    assert folder.run(settings, until="columns").reused[-1] == "columns"
    assert folder.table.read_text() == edited


def test_what_is_edited_while_columns_are_found_is_put_away(folder, monkeypatch):
    found, edited = stages._found, []

    def edit_meanwhile(*arguments):
        edited.append(folder.edit())
        return found(*arguments)

    monkeypatch.setattr(stages, "_found", edit_meanwhile)
    folder.run(change(**CHANGES["window"]), until="columns")
    assert folder.table.with_stem("columns-edited").read_text() == edited[0]


def test_beginning_anew_keeps_them_with_the_same_movie_and_puts_them_away_with_another(folder, npy):
    edited = folder.edit()
    assert folder.run(change(convert={"codec": "zstd"}), overwrite=True).columns == N_COLUMNS - 3
    assert folder.table.read_text() == edited
    folder.source = npy(Scene(seed=3).counts(), "other.npy")
    assert folder.run(overwrite=True, until="columns").columns == N_COLUMNS
    assert folder.table.with_stem("columns-edited").read_text() == edited


def test_places_that_count_from_another_pixel_are_put_away_and_other_frames_keep_them(folder):
    """The same table in another field, or in sums of pixels, would mean other places: half of it off the columns."""
    edited = folder.edit()
    assert folder.run(change(source={"frames": "2:"}), overwrite=True, until="columns").columns == N_COLUMNS - 3
    assert folder.table.read_text() == edited
    assert folder.run(change(source={"roi": "0:160,11:144"}), overwrite=True, until="columns").columns == N_COLUMNS
    assert folder.table.with_stem("columns-edited").read_text() == edited
    assert any("columns-edited.csv" in warning for warning in folder.warnings)
    again = folder.edit(dropped=2)  # counted from there now
    folder.run(change(source={"roi": "0:160,11:144"}), until="columns")
    assert folder.table.read_text() == again


def test_a_version_of_the_service_outlives_changes_too(folder):
    outputs = run_folder.RunFolder(folder.root)
    edited = folder.edit()
    shutil.copy(folder.table, folder.root / "copy.csv")
    folder.run(until="columns")
    place_columns(outputs, edited)
    assert folder.run(change(**CHANGES["window"]), until="columns").columns == N_COLUMNS - 3
    place_columns(outputs, "")
    assert folder.run(change(**CHANGES["window"]), until="columns").columns == N_COLUMNS


def test_a_table_of_somebody_else_is_refused_and_not_lost(folder):
    files.remove(folder.root / "columns.zarr")
    folder.table.write_text("x,y\n30,70\n")
    with pytest.raises(DestinationError, match="not written by tract-dask"):
        folder.run()
    folder.run(overwrite=True, until="columns")
    assert folder.table.with_stem("columns-edited").read_text() == "x,y\n30,70\n"
