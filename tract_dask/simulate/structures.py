"""What is put under the beam: ceria slabs and steps, blocks cut from any crystal, files that ASE reads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import xarray as xr
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..errors import InputError, SettingsError, SourceError
from ..store.schema import texts
from .ceria import LATTICE_PM, ROW_PITCH_PM, ROW_SHIFT_PM, ROW_SPACING_PM, Surface, ceria_surface
from .settings import SpecimenSettings

if TYPE_CHECKING:
    from ase import Atoms

FloatArray: TypeAlias = np.ndarray[Any, np.dtype[np.float64]]

CERIA_PERIOD_PM = LATTICE_PM / np.sqrt(2)
"""Distance between cerium atoms of one column along [110]: 382.6 pm."""

VACUUM_PM = 800.0
"""Vacuum that is left beside a block in its field of view."""

SAME_COLUMN_PM = 15.0
"""Atoms whose projections are nearer than this belong to one column."""

_FEWEST_NEIGHBOURS = 2
_SAME_PLACE = 0.02


@dataclass(frozen=True)
class Specimen:
    """Atoms and the field of view on them.

    ``atoms`` are at picometres divided by 100 (ASE's angstroms): x to the right and y down, counted from the centre of
    pixel (0, 0), and z along the beam, so that the electrons leave at the largest z. Atoms may lie outside the field.
    ``period_pm`` is the repeat along the beam, None where there is none.
    """

    atoms: Atoms
    height_pm: float
    width_pm: float
    period_pm: float | None = None


def specimen_of(settings: SpecimenSettings, *, even: bool = False) -> Specimen:
    """Return what the settings ask for; with ``even``, all columns are to have the same thickness.

    Raises
    ------
    SettingsError, SourceError, InputError
        As :func:`block` and :func:`read_structure`.
    """
    if settings.structure == "ceo2":
        if settings.zone_axis or settings.up:
            raise SettingsError(
                "ceo2 has its own directions",
                "zone_axis, up",
                "none: it is seen along [110], with (111) upwards",
                f"{settings.zone_axis}, {settings.up}",
                "Give a structure file to choose them",
            )
        return ceria_slab(settings.n_periods) if even else ceria_step(settings.height_pm, settings.width_pm)
    crystal = read_structure(Path(settings.structure))
    zone_axis = settings.zone_axis
    if not zone_axis:
        return as_it_is(crystal)
    up = settings.up or min(((1, 0, 0), (0, 1, 0), (0, 0, 1)), key=lambda axis: abs(np.dot(axis, zone_axis)))
    return block(
        crystal,
        zone_axis,
        up,
        n_periods=settings.n_periods,
        height_pm=settings.height_pm,
        width_pm=settings.width_pm,
    )


def ceria_slab(n_atoms: int, *, n_rows: int = 4, n_columns: int = 5) -> Specimen:
    """Return a CeO2 slab with ``n_atoms`` Ce in every column, seen along [110], its (111) face at the top.

    All columns end on one flat exit face, neighbours half a period apart; an oxygen atom is kept where at least two of
    its four cerium neighbours are there. Vacuum is on all sides.

    Parameters
    ----------
    n_atoms
        Cerium atoms of a column, 1 or more.
    n_rows, n_columns
        (111) rows, and columns of a row, 1 or more.
    """
    for name, value in (("n_atoms", n_atoms), ("n_rows", n_rows), ("n_columns", n_columns)):
        _at_least_one(f"ceria_slab: {name}", value)
    row, place = (index.ravel() for index in np.meshgrid(np.arange(n_rows), np.arange(n_columns), indexing="ij"))
    left = VACUUM_PM + (n_rows - 1) * ROW_SHIFT_PM
    atoms, _ = _ceria(row, place, np.full(row.size, n_atoms), (left, VACUUM_PM))
    width = left + (n_columns - 1) * ROW_PITCH_PM + VACUUM_PM
    height = (n_rows - 1) * ROW_SPACING_PM + 2 * VACUUM_PM
    return Specimen(atoms, float(height), float(width), float(CERIA_PERIOD_PM))


def ceria_step(height_pm: float, width_pm: float, margin_pm: float = 500.0) -> Specimen:
    """Return a CeO2 surface with a step, seen along [110]: vacuum above, columns of 1 to 6 Ce.

    The cerium columns are those of :func:`tract_dask.simulate.ceria.ceria_surface`, ``margin_pm`` beyond the field on
    every side; they end on one flat exit face, and oxygen is kept as in :func:`ceria_slab`.
    """
    return surface_specimen(ceria_surface(height_pm, width_pm, margin_pm), height_pm, width_pm)[0]


def surface_specimen(
    surface: Surface, height_pm: float, width_pm: float
) -> tuple[Specimen, np.ndarray[Any, np.dtype[np.int64]]]:
    """Return the atoms of a ceria surface, and for each its cerium column's index in ``surface``, -1 for oxygen."""
    cerium = np.flatnonzero(surface.kind == "Ce")
    x, y, row = surface.x[cerium], surface.y[cerium], surface.row[cerium]
    place = np.rint((x - x[0] + (row - row[0]) * ROW_SHIFT_PM) / ROW_PITCH_PM).astype(int)
    origin = (x[0] + row[0] * ROW_SHIFT_PM, y[0] - row[0] * ROW_SPACING_PM)
    atoms, column = _ceria(row, place, surface.atoms[cerium].astype(int), origin)
    column = np.where(column >= 0, cerium[column], -1)
    return Specimen(atoms, height_pm, width_pm, float(CERIA_PERIOD_PM)), column


def block(
    crystal: Atoms,
    zone_axis: tuple[int, ...],
    up: tuple[int, ...],
    *,
    n_periods: int,
    height_pm: float = 2000.0,
    width_pm: float = 2000.0,
) -> Specimen:
    """Return a block cut from a crystal, in vacuum.

    Parameters
    ----------
    crystal
        The unit cell, periodic in three dimensions.
    zone_axis, up
        Lattice directions [uvw]: along the beam, and upwards in the image (as far as it is perpendicular to the beam).
    n_periods
        Thickness in periods along the beam.
    height_pm, width_pm
        Size of the block across the beam; the field of view is :data:`VACUUM_PM` larger on every side.

    Raises
    ------
    SettingsError
        Where the directions are not three whole numbers each, are parallel or zero, or a size is not positive.
    InputError
        Where the crystal has no three-dimensional cell.
    """
    _at_least_one("block: n_periods", n_periods)
    if not height_pm > 0 < width_pm:
        raise SettingsError("a block needs a size", "block", "above 0 pm", f"{height_pm:g} x {width_pm:g} pm")
    cell = np.asarray(crystal.cell)
    if abs(np.linalg.det(cell)) < 1e-6:
        raise InputError(
            "the structure has no unit cell", "block", "three cell vectors", remedy="Use it without zone axis"
        )
    for name, direction in (("zone_axis", zone_axis), ("up", up)):
        if len(direction) != 3:
            raise SettingsError("a direction has three indices", f"block: {name}", "such as 1,1,0", f"{direction}")
    beam, top = (np.asarray(direction, dtype=float) @ cell for direction in (zone_axis, up))
    across = np.cross(beam, top)  # to the right, where the beam goes into the page
    if np.linalg.norm(across) < 1e-6:
        raise SettingsError(
            "the direction upwards has to differ from the beam's", "block", "two directions", f"{zone_axis} and {up}"
        )
    z = beam / np.linalg.norm(beam)
    x = across / np.linalg.norm(across)
    axes = np.stack([x, np.cross(z, x), z])
    period = float(np.linalg.norm(beam)) / _repeats(crystal, np.asarray(zone_axis, dtype=float))

    size = np.array([width_pm / 100, height_pm / 100, n_periods * period])
    corners = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [0, 1], indexing="ij")).reshape(3, -1).T * size
    steps = corners @ axes @ np.linalg.inv(cell)
    first, last = np.floor(steps.min(axis=0)) - 1, np.ceil(steps.max(axis=0)) + 1
    spans = [np.arange(low, high + 1) for low, high in zip(first, last, strict=True)]
    cells = np.stack([grid.ravel() for grid in np.meshgrid(*spans, indexing="ij")], axis=1) @ cell
    places = ((crystal.positions[:, None] + cells[None]) @ axes.T).reshape(-1, 3)
    numbers = np.repeat(crystal.numbers, len(cells))
    low = np.array([-size[0] / 2, -size[1] / 2, 0.0]) - 1e-4
    inside = ((places >= low) & (places < low + size)).all(axis=1)
    shift = np.array([size[0] / 2 + VACUUM_PM / 100, size[1] / 2 + VACUUM_PM / 100, 0.0])
    atoms = _atoms(numbers[inside], places[inside] + shift)
    return Specimen(atoms, height_pm + 2 * VACUUM_PM, width_pm + 2 * VACUUM_PM, period * 100)


def as_it_is(atoms: Atoms) -> Specimen:
    """Return atoms as they are, the beam along their z axis, in a field :data:`VACUUM_PM` larger on every side."""
    low, high = atoms.positions.min(axis=0), atoms.positions.max(axis=0)
    shift = np.array([VACUUM_PM / 100, VACUUM_PM / 100, 0.0]) - low
    width, height = (high - low)[:2] * 100 + 2 * VACUUM_PM
    return Specimen(_atoms(atoms.numbers, atoms.positions + shift), float(height), float(width))


def read_structure(path: Path) -> Atoms:
    """Read a file in any format of ASE (CIF, XYZ, POSCAR, ...).

    Raises
    ------
    SourceError
        Where there is no such file, or ASE cannot read atoms from it.
    """
    require_simulators()
    import ase.io

    if not path.is_file():
        raise SourceError("there is no such file", str(path), "a structure that ASE reads, such as a CIF")
    try:
        found = ase.io.read(path)
    except Exception as error:  # ASE's readers raise whatever they meet
        raise SourceError(
            "no structure can be read from this file", str(path), "a format of ASE, such as CIF or XYZ", str(error)
        ) from error
    if len(found) == 0:
        raise SourceError("the structure has no atoms", str(path), remedy="Check the export")
    return found


def projected_columns(specimen: Specimen, pixel_size_pm: float) -> xr.Dataset:
    """Return the atomic columns inside the field: atoms that lie above one another, within 15 pm.

    Returns
    -------
    Dataset
        ``x_ref``, ``y_ref`` (column_id) in px, ``atoms`` (column_id) and ``kind`` (column_id): the column's element, or
        several in the order of their symbols, such as "As+Ga". Heavy columns first, then in reading order; numbered
        from 1.
    """
    places = specimen.atoms.positions[:, :2] * 100
    symbols = np.asarray(specimen.atoms.get_chemical_symbols())
    label = _clusters(places, SAME_COLUMN_PM)
    count = np.bincount(label)
    x, y = (np.bincount(label, places[:, k]) / count / pixel_size_pm for k in (0, 1))
    kind = np.array(["+".join(sorted(set(symbols[label == k]))) for k in range(count.size)], dtype=object)
    heaviest = np.zeros(count.size, dtype=int)
    np.maximum.at(heaviest, label, specimen.atoms.numbers)

    low, high = -0.5, (specimen.width_pm / pixel_size_pm, specimen.height_pm / pixel_size_pm)
    inside = np.flatnonzero((x >= low) & (x < high[0] - 0.5) & (y >= low) & (y < high[1] - 0.5))
    order = inside[np.lexsort((x[inside], np.rint(y[inside]), -heaviest[inside]))]
    return xr.Dataset(
        {
            "x_ref": ("column_id", x[order], {"units": "px", "long_name": "Position of the column"}),
            "y_ref": ("column_id", y[order], {"units": "px", "long_name": "Position of the column"}),
            "kind": ("column_id", texts(kind[order]), {"units": "1", "long_name": "Elements of the column"}),
            "atoms": ("column_id", count[order], {"units": "1", "long_name": "Atoms of the column"}),
        },
        coords={"column_id": np.arange(1, order.size + 1)},
        attrs={"pixel_size_pm": pixel_size_pm},
    )


def require_simulators() -> None:
    """Check that abTEM and ASE are installed.

    Raises
    ------
    InputError
        Where they are not.
    """
    from importlib.util import find_spec

    missing = [name for name, package in (("abTEM", "abtem"), ("ASE", "ase")) if find_spec(package) is None]
    if missing:
        raise InputError(
            f"{' and '.join(missing)} cannot be imported",
            "multislice simulation",
            "the optional packages of simulation",
            remedy='Install them with: pip install "tract_dask[simulate]"',
        )


def _ceria(
    row: np.ndarray[Any, Any], place: np.ndarray[Any, Any], n_atoms: np.ndarray[Any, Any], origin: tuple[float, float]
) -> tuple[Atoms, np.ndarray[Any, np.dtype[np.int64]]]:
    """Return the atoms of cerium columns with their oxygen, and each atom's column, -1 for oxygen.

    ``origin`` is the x and y of place 0 of row 0, in pm. A layer is half a period; columns lie in the odd or in the
    even ones, as their row and place add up, and all end on the last two. Each cerium atom touches eight oxygen sites.
    A site is named by the column nearest to it in projection (a quarter of [001] away), the side of it, and its layer.
    """
    column = np.repeat(np.arange(row.size), n_atoms)
    level = np.concatenate([np.arange(n_atoms.max() - n, n_atoms.max()) for n in n_atoms])
    r, p = row[column], place[column]
    layer = 2 * level + (r + p) % 2
    touched = [
        np.stack([r + dr, p - side * dp, np.full(r.size, side), layer + dl], axis=1)
        for side in (1, -1)
        for dr, dp, dl in ((0, 0, 1), (0, 0, -1), (0, 1, 0), (side, 0, 0))
    ]
    site, neighbours = np.unique(np.concatenate(touched), axis=0, return_counts=True)
    near_r, near_p, side, near_layer = site[neighbours >= _FEWEST_NEIGHBOURS].T

    def position(r: Any, p: Any, side: Any, layer: Any) -> FloatArray:
        x = origin[0] + p * ROW_PITCH_PM + (side - r) * ROW_SHIFT_PM
        y = origin[1] + (r - side / 4) * ROW_SPACING_PM
        return np.stack([x, y, (layer + 0.5) * CERIA_PERIOD_PM / 2], axis=1) / 100

    places = np.concatenate([position(r, p, 0, layer), position(near_r, near_p, side, near_layer)])
    atoms = _atoms(np.repeat([58, 8], [r.size, side.size]), places)
    return atoms, np.concatenate([column, np.full(side.size, -1)])


def _atoms(numbers: np.ndarray[Any, Any], positions: FloatArray) -> Atoms:
    require_simulators()
    from ase import Atoms

    return Atoms(numbers=numbers, positions=positions)


def _repeats(crystal: Atoms, direction: FloatArray) -> int:
    """Return how often the crystal repeats itself along one step of a lattice direction (2 for [110] in fcc's cube)."""
    places = crystal.get_scaled_positions()
    for n in range(6, 1, -1):
        moved = (places + direction / n)[:, None] - places[None]
        near = (np.abs(moved - np.rint(moved)) < _SAME_PLACE).all(axis=2)
        same = crystal.numbers[:, None] == crystal.numbers[None]
        if (near & same).any(axis=1).all():
            return n
    return 1


def _clusters(places: FloatArray, reach: float) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return the number of the cluster of each place; places nearer than ``reach`` are of one cluster."""
    first, second = cKDTree(places).query_pairs(reach, output_type="ndarray").T
    links = coo_array((np.ones(first.size), (first, second)), shape=(len(places), len(places)))
    _, label = connected_components(links, directed=False)
    return np.asarray(label, dtype=np.int64)


def _at_least_one(name: str, value: int) -> None:
    if value < 1:
        raise SettingsError("there has to be at least one", name, "1 or more", str(value))
