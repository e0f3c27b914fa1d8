"""Tracks for other programs: what is written is what their readers read back."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
import scipy.io
import xarray as xr
from click.testing import CliRunner
from conftest import store_fits
from pyarrow import parquet

from tract_dask import accepted, open_results
from tract_dask.cli import main as cli
from tract_dask.errors import DestinationError, InputError, SettingsError, StoreError
from tract_dask.export import tables
from tract_dask.export.atoms import read_atoms, to_xyz
from tract_dask.export.tables import original_layout, table
from tract_dask.kernels.gaussian import parameters
from tract_dask.kernels.gaussian.model import evaluate
from tract_dask.settings import FitSettings, to_toml
from tract_dask.store import results, schema

N_FRAMES, N_COLUMNS = 11, 4
FULL = ("x", "y", "x_stderr", "intensity", "status", "drift_x", "drift_y", "noise", "accepted", "time", "n_iterations")


@pytest.fixture
def store(scene, tmp_path):
    """A results.zarr of 11 frames in shards of 4, every number in it another one; two fits are not accepted."""
    path = tmp_path / "out" / "results.zarr"
    path.parent.mkdir()
    columns = scene.columns().isel(column_id=slice(N_COLUMNS))
    sizes = {"frame": N_FRAMES, "column_id": N_COLUMNS} | schema.SIZES
    rng = np.random.default_rng(0)
    results.create(
        path,
        columns,
        rng.normal(size=(N_FRAMES, 2)),
        0.1 * np.arange(N_FRAMES),
        4,
        pixel_size_pm=4.0,
        frame_time_s=0.1,
        settings=to_toml(FitSettings(blur_sigma_px=2.0)),
        window=19,
        reference_blur_px=2.0,
    )
    values = {
        name: rng.uniform(1, 2, [sizes[dim] for dim in variable.dims]).astype(variable.dtype)
        for name, variable in schema.RESULTS.items()
        if name not in ("time", "drift_measured")
    }
    values["fit"][..., parameters.THETA] = rng.uniform(-1.5, 1.5, (N_FRAMES, N_COLUMNS))
    values["status"] = np.zeros((N_FRAMES, N_COLUMNS), np.uint16)
    values["status"][3, 1], values["status"][9, 2] = 1, 2
    store_fits(path, values, 4)
    return path


@pytest.fixture
def few_rows(monkeypatch):
    """Few rows at a time, so that a small file has several blocks."""
    monkeypatch.setattr(tables, "ROWS", 3 * N_COLUMNS)


def check_table(read: pd.DataFrame, tracks: xr.Dataset) -> None:
    assert len(read) == N_FRAMES * N_COLUMNS
    np.testing.assert_array_equal(read["frame"], np.repeat(np.arange(N_FRAMES), N_COLUMNS))
    np.testing.assert_array_equal(read["column_id"], np.tile(tracks["column_id"], N_FRAMES))
    for name in parameters.PARAMETERS:
        np.testing.assert_array_equal(read[name], tracks["fit"].sel(parameter=name).to_numpy().ravel())
        np.testing.assert_array_equal(read[f"{name}_stderr"], tracks["stderr"].sel(parameter=name).to_numpy().ravel())
    np.testing.assert_array_equal(read["x_pm"], 4.0 * read["x"])
    np.testing.assert_array_equal(read["drift_y"], np.repeat(tracks["drift"].sel(axis="y").to_numpy(), N_COLUMNS))
    np.testing.assert_array_equal(read["noise"], tracks["noise"].to_numpy().ravel())
    np.testing.assert_array_equal(read["accepted"], tracks["status"].to_numpy().ravel() == 0)
    assert set(read["kind"]) == {"Ce"}
    assert set(FULL) <= set(read)


def test_csv_holds_every_number_exactly(store, tmp_path, few_rows):
    path = tables.export(store, tmp_path / "tracks.csv")
    check_table(pd.read_csv(path), open_results(store))


def test_parquet_holds_every_number_and_the_units(store, tmp_path, few_rows):
    path = tables.export(store.parent, tmp_path / "tracks.parquet")
    file = parquet.ParquetFile(path)
    assert file.num_row_groups == 4
    check_table(file.read().to_pandas(), open_results(store))
    units = json.loads(file.schema_arrow.metadata[b"units"])
    assert (units["x"], units["x_stderr"], units["x_pm"], units["drift_x"], units["intensity"]) == (
        "px",
        "px",
        "pm",
        "px",
        "counts",
    )


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_only_accepted_fits(store, tmp_path, few_rows, suffix):
    path = tables.export(store, tmp_path / f"tracks{suffix}", accepted_only=True)
    read = pd.read_csv(path) if suffix == ".csv" else pd.read_parquet(path)
    assert len(read) == N_FRAMES * N_COLUMNS - 2
    assert read["accepted"].all()


def test_netcdf_is_the_dataset(store, tmp_path):
    path = tables.export(store, tmp_path / "tracks.nc")
    with xr.open_dataset(path, engine="h5netcdf") as read:
        expected = open_results(store).compute()
        for name in expected.data_vars:
            np.testing.assert_array_equal(read[name], expected[name], err_msg=str(name))
            assert read[name].attrs["units"] == expected[name].attrs["units"]
        assert list(read["parameter"].to_numpy()) == list(parameters.PARAMETERS)
        assert float(read.attrs["pixel_size_pm"]) == 4.0
    masked = tables.export(store, tmp_path / "accepted.nc", accepted_only=True)
    with xr.open_dataset(masked, engine="h5netcdf") as read:
        np.testing.assert_array_equal(read["fit"], accepted(open_results(store))["fit"])


def test_mat_has_the_layout_of_the_original(store, tmp_path):
    read = scipy.io.loadmat(tables.export(store, tmp_path / "tracks.mat"))
    tracks = open_results(store).compute()
    peaks = read["RefinedPeaksGauss"].reshape(N_FRAMES, N_COLUMNS, 10)
    fit = tracks["fit"].to_numpy()
    good = tracks["status"].to_numpy() == 0
    np.testing.assert_array_equal(peaks[..., 1][good], fit[..., parameters.X][good] + 1)
    np.testing.assert_array_equal(peaks[..., 3][good], fit[..., parameters.Y][good] + 1)
    assert np.isnan(peaks[~good][:, [1, 3]]).all()
    assert (peaks[~good][:, [0, 6]] == 0).all()
    np.testing.assert_array_equal(peaks[..., 6][good], tracks["intensity"].to_numpy()[good])
    np.testing.assert_array_equal(peaks[..., 7][good], tracks["intensity_error"].to_numpy()[good])
    np.testing.assert_array_equal(peaks[0, :, 8], tracks["column_id"])
    np.testing.assert_array_equal(peaks[:, 0, 9], np.arange(1, N_FRAMES + 1))
    assert np.abs(peaks[..., 5][good]).max() <= np.pi / 4
    np.testing.assert_array_equal(read["ProjPeaksGauss"][:, 1], tracks["fit_ref"].sel(parameter="x") + 1)
    assert read["Scale"].item() == 0.004
    np.testing.assert_array_equal(read["Drift"][:, 0], tracks["drift"].sel(axis="x"))
    assert read["Kind"][0, 0].item() == "Ce"


def test_parameters_of_the_original_describe_the_same_column(store):
    """Widths that change places with a quarter turn are the same Gaussian."""
    tracks = open_results(store).compute()
    rows = original_layout(tracks)["RefinedPeaksGauss"]
    y, x = np.mgrid[-3:6, -3:6].astype(float)
    for fit, row in zip(tracks["fit"].to_numpy().reshape(-1, 7)[:8], rows[:8], strict=True):
        amplitude, x0, sigma_x, y0, sigma_y, angle = row[:6]
        again = np.array([amplitude, x0 - 1, y0 - 1, sigma_x, sigma_y, angle, fit[parameters.BACKGROUND]])
        if row[0]:
            np.testing.assert_allclose(evaluate(again, x, y), evaluate(fit, x, y))


def test_what_is_there_is_kept(store, tmp_path):
    path = tmp_path / "tracks.csv"
    path.write_text("mine")
    with pytest.raises(DestinationError, match="--overwrite"):
        tables.export(store, path)
    assert path.read_text() == "mine"
    tables.export(store, path, overwrite=True)
    assert path.read_text().startswith("frame,")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(DestinationError, match="folder"):
        tables.export(store, tmp_path / "folder.csv", overwrite=True)


def test_a_failed_export_leaves_nothing(store, tmp_path, monkeypatch):
    def fail(*args, **more):
        raise RuntimeError

    monkeypatch.setattr(pd.DataFrame, "to_csv", fail)
    with pytest.raises(RuntimeError):
        tables.export(store, tmp_path / "tracks.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_errors_say_what_to_do(store, tmp_path, monkeypatch):
    with pytest.raises(SettingsError, match=r"\.csv, \.parquet, \.nc, \.mat"):
        tables.export(store, tmp_path / "tracks.xlsx")
    with pytest.raises(StoreError, match="no results here"):
        tables.export(tmp_path, tmp_path / "tracks.csv")
    monkeypatch.setattr(tables, "_MAT_LIMIT", 1000)
    with pytest.raises(InputError, match="ncread"):
        tables.export(store, tmp_path / "tracks.mat")
    monkeypatch.setattr(tables, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'tract_dask\[export\]'"):
        tables.export(store, tmp_path / "tracks.parquet")


def read_xyz(path):
    """The frames of an XYZ file: (comment, elements, numbers)."""
    lines, frames = path.read_text().splitlines(), []
    while lines:
        count, comment = int(lines[0]), lines[1]
        rows = [line.split() for line in lines[2 : 2 + count]]
        frames.append((comment, [row[0] for row in rows], np.array([row[1:] for row in rows], float).reshape(-1, 4)))
        lines = lines[2 + count :]
    return frames


def test_xyz_stacks_the_atoms_of_each_column(tmp_path):
    place = xr.DataArray(
        [[100.0, 200.0], [300.0, 400.0], [500.0, 600.0], [np.nan, 1.0]],
        coords={"column_id": [1, 2, 5, 7], "axis": ["y", "x"]},
        dims=("column_id", "axis"),
    )
    atoms = xr.DataArray([np.nan, 2, 3, 4], coords={"column_id": [5, 2, 1, 7]}, dims="column_id")
    ((comment, elements, numbers),) = read_xyz(to_xyz(place, atoms, tmp_path / "a.xyz", spacing_pm=380.0))
    assert 'Properties=species:S:1:pos:R:3:column_id:I:1 pbc="F F F"' in comment
    assert elements == ["Ce"] * 5
    np.testing.assert_allclose(
        numbers, [[2, -1, -3.8, 1], [2, -1, 0, 1], [2, -1, 3.8, 1], [4, -3, -1.9, 2], [4, -3, 1.9, 2]], atol=1e-9
    )
    ((_, _, numbers),) = read_xyz(to_xyz(place, atoms, tmp_path / "b.xyz", spacing_pm=380.0, align="face"))
    np.testing.assert_allclose(numbers[:, 2], [0, 3.8, 7.6, 0, 3.8])
    for wrong, match in (
        ({"spacing_pm": 0.0}, "above 0"),
        ({"spacing_pm": 1.0, "align": "top"}, "centre or face"),
        ({"spacing_pm": 1.0, "element": {"": "Ce"}}, "no kinds"),
    ):
        with pytest.raises(SettingsError, match=match):
            to_xyz(place, atoms, tmp_path / "c.xyz", **wrong)
    with pytest.raises(SettingsError, match="column 1"):
        to_xyz(place, atoms.isel(column_id=[0, 1]), tmp_path / "c.xyz", spacing_pm=1.0)
    with pytest.raises(SettingsError, match="whole numbers"):
        to_xyz(place, atoms + 0.5, tmp_path / "c.xyz", spacing_pm=1.0)


def test_xyz_of_counts_in_time_is_a_trajectory(store, tmp_path, few_rows):
    tracks = open_results(store)
    counts = np.arange(5 * N_COLUMNS).reshape(5, N_COLUMNS) % 4
    atoms = xr.DataArray(counts, coords={"frame": np.arange(2, 7), "column_id": tracks["column_id"]})
    frames = read_xyz(to_xyz(tracks, atoms, tmp_path / "a.xyz", spacing_pm=380.0, element={"Ce": "Pt"}))
    assert [comment.split()[-1] for comment, _, _ in frames] == [f"frame={frame}" for frame in range(2, 7)]
    for k, (_, elements, numbers) in enumerate(frames):
        here = counts[k] * (tracks["status"].to_numpy()[2 + k] == 0)
        assert elements == ["Pt"] * here.sum()
        np.testing.assert_allclose(
            numbers[:, 0], np.repeat(tracks["fit"].sel(parameter="x").to_numpy()[2 + k] * 0.04, here), atol=1e-5
        )
    with pytest.raises(SettingsError, match="no element"):
        to_xyz(tracks, atoms, tmp_path / "b.xyz", spacing_pm=380.0, element={"O": "O"})


def test_atoms_are_read_from_csv(tmp_path):
    path = tmp_path / "atoms.csv"
    path.write_text("column_id,atoms,note\n4,2,a\n2,5,b\n")
    np.testing.assert_array_equal(read_atoms(path).sel(column_id=[2, 4]), [5, 2])
    path.write_text("frame,column_id,atoms\n0,1,2\n0,2,3\n1,1,4\n1,2,5\n")
    np.testing.assert_array_equal(read_atoms(path), [[2, 3], [4, 5]])
    for wrong in ("column_id,number\n1,2\n", "column_id,atoms\n1,2\n1,3\n"):
        path.write_text(wrong)
        with pytest.raises(InputError, match="one row for each column"):
            read_atoms(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_atoms(tmp_path / "nowhere.csv")


def test_a_table_of_tracks_without_a_pixel_size_has_no_picometres(store):
    tracks = open_results(store).assign_attrs(pixel_size_pm=None)
    assert "x_pm" not in table(tracks)


def test_a_table_has_the_motion_that_was_undone(store):
    tracks = open_results(store).load()
    written = table(tracks)
    rotation = tracks["motion"].sel(motion_kind="rotation").to_numpy()
    np.testing.assert_array_equal(written["motion_rotation"], np.repeat(rotation, N_COLUMNS))
    assert not [name for name in written if name.startswith(("motion_measured", "motion_stderr"))]


def test_the_command(store, tmp_path):
    def tract(*arguments):
        return CliRunner().invoke(cli.main, ["export", *map(str, arguments)])

    file = tmp_path / "tracks.csv"
    done = tract(store.parent, file, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.output) == {"wrote": str(file), "bytes": file.stat().st_size}
    again = tract(store.parent, file)
    assert again.exit_code == 2
    assert "--overwrite" in again.output
    assert tract(store.parent, file, "--overwrite", "--accepted-only").exit_code == 0
    assert len(pd.read_csv(file)) == N_FRAMES * N_COLUMNS - 2
    model = tmp_path / "model.xyz"
    assert "--spacing-pm" in tract(store.parent, model).output
    atoms = tmp_path / "atoms.csv"
    atoms.write_text("column_id,atoms\n" + "".join(f"{k},{k}\n" for k in range(1, N_COLUMNS + 1)))
    done = tract(store, model, "--atoms", atoms, "--spacing-pm", 383, "--align", "face", "--element", "Au")
    assert done.exit_code == 0, done.output
    ((_, elements, _),) = read_xyz(model)
    assert elements == ["Au"] * (N_COLUMNS * (N_COLUMNS + 1) // 2)
