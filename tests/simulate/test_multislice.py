"""Multislice images against the structures and the optics that they were made from."""

import ast
import dataclasses
import importlib
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import tifffile
from click.testing import CliRunner
from scipy import constants

from tract_dask.cli import main as cli
from tract_dask.cli import simulate
from tract_dask.errors import SettingsError
from tract_dask.readers import open_source
from tract_dask.settings import from_toml
from tract_dask.simulate.ceria import LATTICE_PM, ROW_PITCH_PM
from tract_dask.simulate.files import read_image, read_table
from tract_dask.simulate.multislice import multislice_image, pictures, thickness_series
from tract_dask.simulate.pictured import simulate_multislice_movie
from tract_dask.simulate.settings import PRESETS, Microscope, SpecimenSettings
from tract_dask.simulate.shipped import ceo2_image, ceo2_table
from tract_dask.simulate.structures import Specimen, block, ceria_slab, ceria_step, projected_columns
from tract_dask.store.columns import read_columns_csv
from tract_dask.store.datasets import open_dataset

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "tract_dask"
PIXEL_PM = 5.0


def tract(*arguments: object):
    return CliRunner().invoke(cli.main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def ase():
    return importlib.import_module("ase")  # takes its time


@pytest.fixture(scope="module")
def series(ase):
    """Slabs of 1 to 4 atoms a column."""
    return thickness_series(ceria_slab(4, n_rows=2, n_columns=3), pixel_size_pm=PIXEL_PM)


def maximum(image, x, y):
    """The highest point near a place, by a parabola through three pixels of each axis."""
    row, column = np.rint([y, x]).astype(int)
    near = image[row - 6 : row + 7, column - 6 : column + 7]
    down, right = np.unravel_index(near.argmax(), near.shape)
    row, column = row - 6 + down, column - 6 + right

    def vertex(before, at, after):
        return (before - after) / (2 * (before - 2 * at + after))

    return column + vertex(*image[row, column - 1 : column + 2]), row + vertex(*image[row - 1 : row + 2, column])


def test_slab_is_fluorite_with_one_flat_exit_face(ase):
    atoms = ceria_slab(3, n_rows=4, n_columns=5).atoms
    cerium, oxygen = atoms[atoms.numbers == 58], atoms[atoms.numbers == 8]
    distance = 100 * np.linalg.norm(oxygen.positions[:, None] - cerium.positions[None], axis=-1)
    bonds = np.isclose(distance, LATTICE_PM * np.sqrt(3) / 4, atol=0.01)
    assert distance.min() == pytest.approx(LATTICE_PM * np.sqrt(3) / 4)
    assert bonds.sum(axis=1).min() >= 2
    assert bonds.sum(axis=1).max() == 4
    between = np.linalg.norm(cerium.positions[:, None] - cerium.positions[None], axis=-1) * 100
    assert np.unique(between[between > 0]).min() == pytest.approx(LATTICE_PM / np.sqrt(2))
    ends = [
        cerium.positions[np.isclose(cerium.positions[:, :2], place).all(axis=1), 2].max()
        for place in np.unique(cerium.positions[:, :2].round(6), axis=0)
    ]
    assert np.ptp(ends) == pytest.approx(LATTICE_PM / 100 / np.sqrt(8))  # neighbours are half a period apart


def test_step_has_columns_of_one_to_six_atoms(ase):
    columns = projected_columns(ceria_step(2000.0, 1800.0), 4.0)
    cerium = columns["atoms"][(columns["kind"] == "Ce").to_numpy()]
    assert set(cerium.to_numpy()) == {1, 2, 3, 4, 5, 6}
    assert set(columns["kind"].to_numpy()) == {"Ce", "O"}


def test_block_of_ceria_is_the_slab(ase):
    from ase.build import bulk

    crystal = bulk("CeO2", "fluorite", a=LATTICE_PM / 100, cubic=True)
    cut = block(crystal, (1, 1, 0), (1, -1, 1), n_periods=2, height_pm=1500.0, width_pm=1500.0)
    assert cut.period_pm == pytest.approx(LATTICE_PM / np.sqrt(2))
    columns = projected_columns(cut, 1.0)
    assert set(columns["atoms"].to_numpy()) == {2}
    cerium = columns.isel(column_id=columns["kind"].to_numpy() == "Ce")
    places = np.stack([cerium["x_ref"], cerium["y_ref"]], axis=1)
    steps = (places[:, None] - places[None]).reshape(-1, 2)
    steps = steps[(np.hypot(*steps.T) > 1) & (np.hypot(*steps.T) < 1.1 * ROW_PITCH_PM)]
    assert np.hypot(*steps.T) == pytest.approx(ROW_PITCH_PM)
    assert np.isclose(steps, [ROW_PITCH_PM, 0], atol=1e-6).all(axis=1).any()  # (111) rows are horizontal


def test_block_has_its_directions_where_they_belong(ase):
    crystal = ase.Atoms("OCAlSi", [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], cell=[5, 6, 7], pbc=True)
    cut = block(crystal, (0, 0, 1), (0, 1, 0), n_periods=1, height_pm=300.0, width_pm=300.0).atoms
    place = {atom.symbol: atom.position for atom in cut}
    assert place["Al"][1] < place["O"][1]  # up is towards smaller y
    assert place["C"][0] < place["O"][0]  # seen along c with b upwards, a points to the left
    assert place["Si"][2] > place["O"][2]


@pytest.mark.parametrize(
    ("zone_axis", "up", "word"), [((1, 1, 0), (2, 2, 0), "differ"), ((1, 1), (0, 0, 1), "three indices")]
)
def test_impossible_directions_are_refused(ase, zone_axis, up, word):
    from ase.build import bulk

    with pytest.raises(SettingsError, match=word):
        block(bulk("Si", cubic=True), zone_axis, up, n_periods=1)


def test_vacuum_is_one(series):
    image = series["image"].to_numpy()
    assert image[:, :40].mean(axis=(1, 2)) == pytest.approx(1, abs=2e-3)
    assert np.abs(image[:, :40] - 1).max() < 0.02


def test_maxima_are_where_the_cerium_columns_are(series):
    cerium = series.isel(column_id=series["kind"].to_numpy() == "Ce")
    for image in series["image"].to_numpy():
        found = [maximum(image, x, y) for x, y in zip(cerium["x_ref"].values, cerium["y_ref"].values, strict=True)]
        assert np.abs(np.array(found) - np.stack([cerium["x_ref"], cerium["y_ref"]], axis=1)).max() < 0.3
        middle = np.array(found)[1] - [cerium["x_ref"].values[1], cerium["y_ref"].values[1]]
        assert np.abs(middle).max() < 0.1


def test_columns_grow_brighter_with_every_atom(series):
    row, column = np.rint([series["y_ref"].values[1], series["x_ref"].values[1]]).astype(int)
    heights = series["image"].to_numpy()[:, row, column]
    assert (np.diff(heights) > 0.3).all()
    assert heights[0] > 1.5


def test_a_page_of_the_series_is_the_slab_of_that_thickness(series):
    alone = multislice_image(ceria_slab(2, n_rows=2, n_columns=3), pixel_size_pm=PIXEL_PM)
    x, y = (round(float(series[name][1])) for name in ("x_ref", "y_ref"))
    middle = {"y": slice(0, y + 30), "x": slice(x - 30, x + 31)}  # oxygen at the sides lacks neighbours in a thin slab
    np.testing.assert_allclose(alone["image"][middle], series["image"][1][middle], atol=2e-3)
    cerium = series["kind"].to_numpy() == "Ce"
    np.testing.assert_array_equal(series["atoms"][:, cerium], np.arange(1, 5)[:, None] * np.ones(cerium.sum()))


@pytest.mark.parametrize("microscope", [PRESETS["paper"], PRESETS["supplement"]])
def test_a_hydrogen_atom_is_a_weak_phase_object(ase, microscope):
    """Linear imaging: the spectrum of I - 1 is 2 sigma V sin(chi), damped by the envelopes."""
    from abtem.parametrizations import LobatoParametrization

    n, size = 128, 10.0
    atom = ase.Atoms("H", [[n / 2 * size / 100, n / 2 * size / 100, 0.5]])
    image = multislice_image(Specimen(atom, n * size, n * size), microscope, pixel_size_pm=size)["image"].to_numpy()

    volts = microscope.energy_kev * 1e3
    rest = constants.m_e * constants.c**2 / constants.e
    wavelength = 1e10 * constants.h * constants.c / constants.e / np.sqrt(volts * (2 * rest + volts))
    interaction = 2 * np.pi / (wavelength * volts) * (rest + volts) / (2 * rest + volts)
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(4 * n, size / 100), np.fft.fftfreq(4 * n, size / 100)))
    angle = wavelength * k
    chi = (2 * np.pi / wavelength) * (
        microscope.defocus_nm * 10 * angle**2 / 2
        + microscope.spherical_um * 1e4 * angle**4 / 4
        + microscope.fifth_order_mm * 1e7 * angle**6 / 6
    )
    slope = (
        2
        * np.pi
        * (
            microscope.defocus_nm * 10 * k
            + microscope.spherical_um * 1e4 * wavelength**2 * k**3
            + microscope.fifth_order_mm * 1e7 * wavelength**4 * k**5
        )
    )
    envelope = np.exp(
        -((np.pi * wavelength * microscope.focal_spread_nm * 10 * k**2 / 2) ** 2)
        - (slope * microscope.angular_spread_mrad * 1e-3) ** 2 / 4
        - 2 * (np.pi * k / 100) ** 2 * (microscope.thermal_pm**2 + microscope.vibration_pm**2)
    )
    envelope[angle > microscope.aperture_mrad * 1e-3] = 0
    potential = LobatoParametrization().projected_scattering_factor("H")(k**2)
    expected = np.fft.fftshift(np.fft.ifft2(2 * interaction * potential * np.sin(chi) * envelope).real)
    expected = expected[2 * n - n // 2 : 2 * n + n // 2, 2 * n - n // 2 : 2 * n + n // 2] / (size / 100) ** 2
    assert np.abs(image - 1 - expected).max() < 0.03 * np.abs(expected).max()


def test_electrons_are_conserved_by_a_perfect_lens(ase):
    perfect = Microscope(defocus_nm=0, spherical_um=0, fifth_order_mm=0, focal_spread_nm=0, angular_spread_mrad=0,
                         aperture_mrad=200, vibration_pm=0)  # fmt: skip
    atom = ase.Atoms("Ce", [[3.0, 3.0, 1.0]])
    picture = pictures(Specimen(atom, 600.0, 600.0), perfect, PIXEL_PM)[0]
    assert picture.spectrum[0, 0].real / np.prod(picture.grid) == pytest.approx(1, abs=1e-4)


def test_drift_moves_the_picture_exactly(ase):
    atom = ase.Atoms("Ce", [[4.0, 5.0, 1.0]])
    picture = pictures(Specimen(atom, 900.0, 800.0), PRESETS["paper"], 10.0)[0]
    still = picture.sample()
    assert maximum(still, 40, 50) == pytest.approx((40, 50), abs=0.02)
    np.testing.assert_allclose(picture.sample((3.0, -2.0))[3:, :-2], still[:-3, 2:], atol=1e-5)
    assert maximum(picture.sample((0.25, -0.4)), 40, 50) == pytest.approx((39.6, 50.25), abs=0.02)


def test_movie_has_its_truth(tmp_path, ase):
    truth = simulate_multislice_movie(
        tmp_path / "movie.tif", n_frames=4, shape=(130, 150), pixel_size_pm=10.0, dose=20_000, drift_px=1.0, seed=1
    )
    frames = tifffile.imread(tmp_path / "movie.tif").astype(float)
    vacuum = truth.attrs["vacuum_counts"]
    assert vacuum == pytest.approx(20_000 * 0.1**2)
    assert frames[:, :12].mean() == pytest.approx(vacuum, rel=0.01)
    inner = ((truth["x"] > 14) & (truth["x"] < 135) & (truth["y"] < 115)).all("frame") & (truth["kind"] == "Ce")
    for column in np.flatnonzero(inner.to_numpy()):
        for frame, image in enumerate(frames):
            x, y = float(truth["x"][frame, column]), float(truth["y"][frame, column])
            row, place = np.rint([y, x]).astype(int)
            window = image[row - 4 : row + 5, place - 4 : place + 5] / vacuum - 1
            if truth["atoms"][frame, column] == 0:
                assert window.max() < 0.5
            else:
                rows, places = np.mgrid[-4:5, -4:5]
                bright = np.clip(window - 0.3 * window.max(), 0, None)
                assert (bright * places).sum() / bright.sum() + place == pytest.approx(x, abs=0.35)
                assert (bright * rows).sum() / bright.sum() + row == pytest.approx(y, abs=0.35)
    assert set(truth["role"].to_numpy()) >= {"static", "absent"}
    assert (truth["atoms"].to_numpy()[:, (truth["role"] == "absent").to_numpy()] == 0).any()
    assert from_toml(Microscope, truth.attrs["microscope"]) == PRESETS["paper"]


def test_command_writes_an_image_of_a_file(tmp_path, ase):
    (tmp_path / "pair.xyz").write_text("2\n\nAu 0 0 0\nAu 3 0 0\n")
    shown = tract(
        "simulate", "image", tmp_path / "pair.tif", "--structure", tmp_path / "pair.xyz", "--pixel-size-pm", 10,
        "--defocus-nm", "5"
    )  # fmt: skip
    assert shown.exit_code == 0, shown.output
    found = read_image(tmp_path / "pair.tif")
    assert list(found["x_ref"].values) == pytest.approx([80, 110])
    assert list(found["kind"].values) == ["Au", "Au"]
    assert maximum(found["image"].to_numpy(), 80, 80) == pytest.approx((80, 80), abs=0.1)
    assert from_toml(Microscope, found.attrs["microscope"]) == Microscope(defocus_nm=5.0)
    assert open_source(tmp_path / "pair.tif").metadata.pixel_size_pm == pytest.approx(10)
    assert read_columns_csv(tmp_path / "pair.csv").sizes["column_id"] == 2


def test_command_makes_the_table_that_is_shipped(tmp_path, ase):
    shown = tract("simulate", "table", tmp_path / "table.csv", "--max-atoms", 2)
    assert shown.exit_code == 0, shown.output
    made, shipped = read_table(tmp_path / "table.csv"), ceo2_table()
    np.testing.assert_allclose(made["intensity"], shipped["intensity"][:2], rtol=1e-3)
    assert made.attrs == shipped.attrs
    assert tifffile.imread(tmp_path / "table.tif").shape[0] == 2


def test_command_writes_a_movie_and_its_truth(tmp_path):
    shown = tract(
        "simulate", "movie", tmp_path / "m.tif", "--frames", 2, "--pixel-size-pm", 10, "--height-pm", 1500,
        "--width-pm", 1400, "--dose", 100
    )  # fmt: skip
    assert shown.exit_code == 0, shown.output
    assert tifffile.imread(tmp_path / "m.tif").shape == (2, 150, 140)
    truth = open_dataset(tmp_path / "m.zarr")
    assert truth.attrs["vacuum_counts"] == pytest.approx(1.0)
    assert truth.sizes["frame"] == 2


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (("image", "x.png"), ["x.png", "ends in .tif"]),
        (("table", "x.csv", "--structure", "none.cif"), ["none.cif", "no such file"]),
        (("image", "x.tif", "--pixel-size-pm", "1000"), ["pixel_size_pm", "0.5 to 100"]),
        (("movie", "x.tif", "--structure", "none.cif"), ["--model multislice"]),
        (("image", "x.tif", "--vibration-pm", "-1"), ["vibration_pm", "at least 0"]),
        (("image", "x.tif", "--zone-axis", "0,0,1"), ["zone_axis", "structure file"]),
    ],
)
def test_bad_input_is_explained_before_work(ase, command, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shown = tract("simulate", *command)
    assert shown.exit_code == 2
    assert all(word in shown.output for word in words), shown.output
    assert not list(tmp_path.iterdir())


def test_missing_packages_are_named(monkeypatch, tmp_path):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    shown = tract("simulate", "image", tmp_path / "x.tif")
    assert shown.exit_code == 2
    assert "abTEM and ASE cannot be imported" in shown.output
    assert 'pip install "tract_dask[simulate]"' in shown.output


def test_optional_packages_are_imported_only_inside_functions():
    for file in PACKAGE.rglob("*.py"):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for node in tree.body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            assert not {name.split(".")[0] for name in names} & {"abtem", "ase"}, file
        everywhere = ast.walk(tree)
        used = {node.module.split(".")[0] for node in everywhere if isinstance(node, ast.ImportFrom) and node.module}
        assert file.parent.name == "simulate" or not used & {"abtem", "ase"}, file


def test_shipped_image_shows_its_columns():
    found = ceo2_image()
    assert found.attrs["pixel_size_pm"] == 8
    image = found["image"].to_numpy()
    assert image[:10].mean() == pytest.approx(1, abs=5e-3)
    rows, columns = image.shape
    cerium = found.isel(column_id=found["kind"].to_numpy() == "Ce")
    inside = (cerium["x_ref"] > 8) & (cerium["x_ref"] < columns - 8) & (cerium["y_ref"] < rows - 8)
    for column in np.flatnonzero(inside.to_numpy()):
        x, y = float(cerium["x_ref"][column]), float(cerium["y_ref"][column])
        assert maximum(image, x, y) == pytest.approx((x, y), abs=0.35)
    assert sum(file.stat().st_size for file in (PACKAGE / "simulate" / "data").iterdir()) < 300_000


def test_shipped_table_rises_to_six_atoms_and_falls():
    table = ceo2_table()
    assert list(table["atoms"].values) == list(range(1, 13))
    intensity = table["intensity"].to_numpy()
    assert (np.diff(intensity[:6]) > 0).all()
    assert (np.diff(intensity[5:]) < 0).all()
    assert np.polyfit([0, 1, 2, 3], [0, *intensity[:3]], 1)[0] == pytest.approx(
        intensity[0], rel=0.1
    )  # linear at first
    assert from_toml(Microscope, table.attrs["microscope"]) == PRESETS["paper"]


def test_every_setting_of_a_simulation_is_documented():
    text = (ROOT / "docs" / "simulation.md").read_text(encoding="utf-8")
    for kind in (Microscope, SpecimenSettings):
        for item in dataclasses.fields(kind):
            assert re.search(rf"^\| `--{item.name.replace('_', '-')}` \|", text, re.MULTILINE), item.name


def test_commands_of_the_documentation_are_commands():
    text = (ROOT / "docs" / "simulation.md").read_text(encoding="utf-8")
    lines = [line for block in re.findall(r"^```bash\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
             for line in block.splitlines() if line.startswith("tract-dask simulate")]  # fmt: skip
    assert len(lines) >= 4
    for line in lines:
        _, _, verb, *arguments = shlex.split(line)
        simulate.simulate.commands[verb].make_context(verb, arguments)  # raises where an option is not there
