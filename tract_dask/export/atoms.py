"""Tracks as atoms in XYZ files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from ..analysis.motion import positions
from ..errors import InputError, SettingsError
from ..kernels.gaussian.intensity import Floats
from ..store.files import read_small
from ..store.tables import decoded, parse_number, parse_table
from .tables import ROWS, written_aside

ALIGNMENTS = ("centre", "face")

_PM_PER_ANGSTROM = 100.0
_MOST_BYTES = 1 << 30
"""Bytes of a table of numbers of atoms."""


def to_xyz(
    place: xr.Dataset | xr.DataArray,
    atoms: xr.DataArray,
    path: str | Path,
    *,
    spacing_pm: float,
    element: str | Mapping[str, str] = "Ce",
    align: str = "centre",
    overwrite: bool = False,
) -> Path:
    """Write a model of the specimen: in each column its atoms, one above the other along the beam.

    Parameters
    ----------
    place
        Tracks, or places (column_id, axis) or (frame, column_id, axis) in pm, such as those of
        :func:`tract_dask.analysis.motion.positions`. Of tracks the mean places are taken, or those of each frame where
        ``atoms`` has frames.
    atoms
        Atoms in each column (column_id), or in each frame too (frame, column_id); NaN counts as none.
    path
        A file of extended XYZ, which OVITO, ASE and VESTA read. With frames it is a trajectory.
    spacing_pm
        Distance of neighbouring atoms along the beam, pm.
    element
        Symbol of the element, or one for each ``kind`` of column (tracks only).
    align
        ``"centre"``: every column is centred on z = 0. ``"face"``: every column begins at z = 0, the flat face.
    overwrite
        Replace what is at ``path``.

    Returns
    -------
    Path
        The file. Lengths are in Å; x points right, y up (so y is minus that of the image), z along the beam.

    Raises
    ------
    SettingsError
        Where the atoms are not whole numbers from 0, or of other columns, or a value is out of range.
    DestinationError
        Where the file is there already, or its folder cannot be written.

    Notes
    -----
    This is the original's Model3D, which draws spheres in the same places.
    """
    if not spacing_pm > 0:
        raise SettingsError("the spacing is out of range", "spacing_pm", "above 0 pm", f"{spacing_pm:g}")
    if align not in ALIGNMENTS:
        raise SettingsError("the alignment is not known", "align", " or ".join(ALIGNMENTS), repr(align))
    columns = place["column_id"].to_numpy()
    counts = _whole_numbers(atoms, columns)
    elements = _elements(place, element, columns)
    if isinstance(place, xr.Dataset):
        place = positions(place)
        place = place if "frame" in counts.dims else place.mean("frame")
    if "frame" in counts.dims and "frame" in place.dims:
        place = place.sel(frame=counts["frame"])
    path = Path(path)
    with written_aside(path, overwrite=overwrite) as aside, aside.open("w", encoding="utf-8") as file:
        for block in _frames_of(place, counts):
            for frame, (places, numbers) in block.items():
                file.write(_xyz_frame(places, numbers, columns, elements, spacing_pm, align, frame))
    return path


def _frames_of(place: xr.DataArray, counts: xr.DataArray) -> Iterator[dict[int | None, tuple[Floats, Floats]]]:
    """Yield blocks of frames: by frame, the places (column, (y, x)) and the atoms; one without a number if still."""
    moving = next((array for array in (place, counts) if "frame" in array.dims), None)
    if moving is None:
        yield {None: (place.transpose("column_id", "axis").to_numpy(), counts.to_numpy())}
        return
    step = max(1, ROWS // max(place.sizes["column_id"], 1))
    for start in range(0, moving.sizes["frame"], step):
        frames = moving["frame"].to_numpy()[start : start + step]
        there, here = (a.sel(frame=frames).compute() if "frame" in a.dims else a for a in (place, counts))
        yield {
            int(frame): (
                (there.sel(frame=frame) if "frame" in there.dims else there).transpose("column_id", "axis").to_numpy(),
                (here.sel(frame=frame) if "frame" in here.dims else here).to_numpy(),
            )
            for frame in frames
        }


def _xyz_frame(
    places: Floats,
    numbers: Floats,
    columns: NDArray[np.int64],
    elements: list[str],
    spacing_pm: float,
    align: str,
    frame: int | None,
) -> str:
    """Return one frame of extended XYZ."""
    lines = []
    for (y, x), number, column, element in zip(places, numbers.astype(int), columns, elements, strict=True):
        if np.isfinite(x) and np.isfinite(y):
            first = -(number - 1) / 2 if align == "centre" else 0.0
            lines += [
                f"{element} {x / _PM_PER_ANGSTROM:.5f} {-y / _PM_PER_ANGSTROM:.5f} "
                f"{(first + k) * spacing_pm / _PM_PER_ANGSTROM:.5f} {column}\n"
                for k in range(number)
            ]
    comment = 'Properties=species:S:1:pos:R:3:column_id:I:1 pbc="F F F"' + ("" if frame is None else f" frame={frame}")
    return "".join([f"{len(lines)}\n{comment}\n", *lines])


def _whole_numbers(atoms: xr.DataArray, columns: NDArray[np.int64]) -> xr.DataArray:
    """Return the atoms of these columns in this order, NaN as 0."""
    missing = sorted(set(columns.tolist()) - set(atoms["column_id"].to_numpy().tolist()))
    if missing:
        raise SettingsError(
            "some columns have no number of atoms",
            "atoms",
            "a number for every column",
            f"none for column {missing[0]}" + (f" and {len(missing) - 1} more" if len(missing) > 1 else ""),
            "Give 0 where there is none",
        )
    counts = atoms.sel(column_id=columns).fillna(0).compute()
    if (counts < 0).any() or (counts != np.rint(counts)).any():
        raise SettingsError("these are not numbers of atoms", "atoms", "whole numbers from 0", "others")
    return counts


def _elements(place: xr.Dataset | xr.DataArray, element: str | Mapping[str, str], columns: Any) -> list[str]:
    if isinstance(element, str):
        return [element] * len(columns)
    if not isinstance(place, xr.Dataset):
        raise SettingsError("places have no kinds", "element", "one symbol", "one for each kind", "Give the tracks")
    kinds = [str(kind) for kind in place["kind"].to_numpy()]
    unknown = sorted(set(kinds) - set(element))
    if unknown:
        raise SettingsError("a kind has no element", "element", ", ".join(sorted(set(kinds))), ", ".join(element))
    return [element[kind] for kind in kinds]


def read_atoms(path: str | Path) -> xr.DataArray:
    """Return the numbers of atoms in a CSV file with the columns ``column_id``, ``atoms`` and, if they vary, ``frame``.

    Raises
    ------
    InputError
        Where it cannot be read, or lacks them.
    """
    try:
        text = decoded(read_small(path, _MOST_BYTES))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("the numbers of atoms cannot be read", str(path), "a CSV file", str(error)) from error
    table = parse_table(text, str(path), InputError)
    read = pd.DataFrame([_numbers(table.header, *row, str(path)) for row in table.rows], columns=table.header)
    index = [name for name in ("frame", "column_id") if name in read]
    if "column_id" not in read or "atoms" not in read or read.duplicated(index).any():
        raise InputError(
            "these are not numbers of atoms",
            str(path),
            "columns column_id, atoms and perhaps frame, one row for each column (and frame)",
            ", ".join(map(str, read)),
        )
    read = read.astype(dict.fromkeys(index, np.int64))
    found: xr.DataArray = read.set_index(index)["atoms"].to_xarray()
    return found


def _numbers(header: list[str], line: int, values: list[str], where: str) -> list[float | str]:
    """Return a row whose IDs, frames and numbers of atoms are numbers, the last NaN where there is none.

    Raises
    ------
    InputError
        Naming the line, where one is not.
    """
    row: list[float | str] = []
    for name, value in zip(header, values, strict=True):
        try:
            found: float | str = parse_number(value or "nan") if name in ("frame", "column_id", "atoms") else value
        except ValueError:
            found = math.inf
        if name in ("frame", "column_id") and not float(found).is_integer():
            found = math.inf
        if found == math.inf:
            raise InputError(f"{name} cannot be read", f"{where}, line {line}", "a whole number", repr(value))
        row.append(found)
    return row
