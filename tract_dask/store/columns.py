"""Where to look for columns when the user says so: lattices made from three atoms, and CSV files."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from ..errors import SettingsError
from ..kernels.gaussian import parameters
from . import schema
from .files import read_small
from .schema import Status
from .tables import decoded, parse_number, parse_table

_FIT_COLUMNS = tuple(name for name in parameters.PARAMETERS if name not in ("x", "y"))

_FLAGS = {str(flag.name).lower(): int(flag) for flag in Status if flag}

_BLIND = schema.UNRESOLVED.name

MOST_BYTES = 64 << 20
"""Bytes of a table of columns."""

MOST_ROWS = 500_000
"""Lines of a table of columns."""


def column_dataset(
    places: ArrayLike,
    kind: Sequence[str] | str = "",
    column_id: ArrayLike | None = None,
    fit: ArrayLike | None = None,
    status: ArrayLike | None = None,
    group: ArrayLike | None = None,
    unresolved: ArrayLike | None = None,
) -> xr.Dataset:
    """Return a Dataset of columns as declared in :data:`schema.COLUMNS`.

    Parameters
    ----------
    places
        (columns, 2) rows of (x, y) in px.
    kind
        One for each column, or one for all.
    column_id
        From 1 on, where it is not given.
    fit, status
        (columns, 7) fit on the summed image, NaN where there is none, and (columns,) its flags.
    group
        (columns,) touching columns that are fitted together; 0, which is the default: alone.
    unresolved
        (columns,) whether one frame cannot tell it apart from another (:data:`schema.UNRESOLVED`); by default False.
    """
    xy = np.asarray(places, dtype=np.float64).reshape(-1, 2)
    kinds = [kind] * len(xy) if isinstance(kind, str) else list(kind)
    values: dict[str, Any] = {
        "x_ref": xy[:, 0].copy(),
        "y_ref": xy[:, 1].copy(),
        "kind": schema.texts(kinds),
        "fit_ref": np.full((len(xy), len(parameters.PARAMETERS)), np.nan)
        if fit is None
        else np.asarray(fit, np.float64),
        "status_ref": np.zeros(len(xy), np.uint8) if status is None else np.asarray(status, np.uint8),
    }
    ids = np.arange(1, len(xy) + 1) if column_id is None else np.asarray(column_id)
    dataset = xr.Dataset(
        {name: (schema.COLUMNS[name].dims, value, schema.COLUMNS[name].attributes) for name, value in values.items()},
        {"column_id": ids.astype(np.int64), "parameter": list(parameters.PARAMETERS)},
    )
    dataset["status_ref"].attrs |= schema.STATUS_ATTRIBUTES
    for variable, values_of in zip(schema.OF_GROUPS, (group, unresolved), strict=True):
        own = np.full(len(xy), variable.fill) if values_of is None else np.asarray(values_of)
        dataset[variable.name] = variable.dims, own.astype(variable.dtype), variable.attributes
    return dataset.assign_coords(unit=("parameter", list(parameters.PARAMETER_UNITS)))


def positions(columns: xr.Dataset) -> NDArray[np.float64]:
    """Return the places of columns as (columns, 2) rows of (x, y) in px."""
    return np.stack([columns["x_ref"].to_numpy(), columns["y_ref"].to_numpy()], axis=1).astype(np.float64)


def is_inside(places: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Tell which places (n, 2) of (x, y) lie on pixels of an image of ``shape`` (y, x)."""
    on_pixels = (places >= -0.5) & (places < np.array(shape[::-1]) - 0.5)
    inside: NDArray[np.bool_] = np.all(on_pixels, axis=1)
    return inside


def check_inside(columns: xr.Dataset, shape: tuple[int, ...], where: str) -> None:
    """Check that the columns lie inside an image of ``shape`` (y, x).

    Raises
    ------
    SettingsError
        With their number, and the first that does not.
    """
    places = positions(columns)
    outside = np.flatnonzero(~is_inside(places, shape))
    if len(outside):
        exchanged = bool(is_inside(places[:, ::-1], shape).all())
        first = int(outside[0])
        x, y = places[first]
        raise SettingsError(
            f"{len(outside)} of {len(places)} columns lie outside the image",
            where,
            f"x from 0 to {shape[1] - 1}, y from 0 to {shape[0] - 1}",
            f"column {columns['column_id'].to_numpy()[first]} at x {x:g}, y {y:g}"
            + (" first" if len(outside) > 1 else ""),
            "x and y are exchanged, as it seems: all columns lie inside with x as y"
            if exchanged
            else "Give positions in px of the summed image, or remove these columns; of a movie read with --roi or"
            " --bin they are pixels of that part, as in its own columns.csv, and not those of the whole movie",
        )


def columns_csv(columns: xr.Dataset) -> str:
    """Return columns as CSV: column_id, x, y, kind, the fit's other parameters, and the flags by name.

    Numbers keep their full precision; :func:`parse_columns_csv` gives back what was written.
    """
    blind = columns[_BLIND].to_numpy() if _BLIND in columns else np.zeros(columns.sizes["column_id"], np.bool_)
    fits = columns["fit_ref"].sel(parameter=list(_FIT_COLUMNS)).to_numpy()
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["column_id", "x", "y", "kind", *_FIT_COLUMNS, "flags"])
    for column, (x, y), kind, fit, status, unresolved in zip(
        columns["column_id"].to_numpy().tolist(),
        positions(columns).tolist(),
        columns["kind"].to_numpy(),
        fits.tolist(),
        columns["status_ref"].to_numpy().tolist(),
        blind.tolist(),
        strict=True,
    ):
        numbers = [repr(value) if math.isfinite(value) else "" for value in fit]
        flags = [*flag_names(status), *([_BLIND] if unresolved else [])]
        writer.writerow([column, repr(x), repr(y), str(kind), *numbers, " ".join(flags)])
    return text.getvalue()


def flag_names(status: int) -> list[str]:
    """Return the names of the flags that are set.

    Examples
    --------
    >>> flag_names(9)
    ['below_noise', 'outside_frame']
    """
    return [name for name, flag in _FLAGS.items() if status & flag]


def read_columns_csv(path: str | Path) -> xr.Dataset:
    """Return the columns of a CSV file, as :func:`parse_columns_csv` understands it.

    Raises
    ------
    SettingsError
        Where the file cannot be read, is empty or has more than :data:`MOST_BYTES` or :data:`MOST_ROWS`, x or y is
        missing, a number is none, or an ID comes twice; naming the line.
    """
    try:
        text = decoded(read_small(path, MOST_BYTES))
    except (OSError, UnicodeDecodeError) as error:
        raise _unreadable(str(path), error) from error
    return parse_columns_csv(text, str(path))


def parse_columns_csv(text: str, where: str) -> xr.Dataset:
    """Return the columns of a CSV table.

    Its first line names the columns: ``x`` and ``y`` (px) must be there, ``column_id`` (whole numbers from 0 on, each
    once) and ``kind`` may be; a fit and flags are read where :func:`columns_csv` has written them, others are
    ignored. Without IDs the columns are numbered from 1 in the order of the table. Separators and decimal commas are
    understood as :func:`~tract_dask.store.tables.parse_table` does.

    Parameters
    ----------
    text
        The table.
    where
        What to call it in errors.

    Raises
    ------
    SettingsError
        As :func:`read_columns_csv`.
    """
    header, rows = _rows(text, where)
    numbers = [_Row(where, line, dict(zip(header, values, strict=True))) for line, values in rows]
    places = [[row.number("x"), row.number("y")] for row in numbers]
    ids = [row.integer("column_id") for row in numbers] if "column_id" in header else None
    first: dict[int, int] = {}
    for row, column in zip(numbers, ids or (), strict=False):
        if column in first:
            raise SettingsError(
                "a column_id comes twice",
                f"{where}, line {row.line}",
                "each column_id once",
                f"{column}, as in line {first[column]}",
                "Renumber the columns, or leave column_id out",
            )
        first[column] = row.line
    fit = np.full((len(numbers), len(parameters.PARAMETERS)), np.nan)
    if set(_FIT_COLUMNS) <= set(header):
        for row, estimates, place in zip(numbers, fit, places, strict=True):
            if row.values["amplitude"]:
                found = {name: row.number(name) for name in _FIT_COLUMNS} | {"x": place[0], "y": place[1]}
                estimates[:] = [found[name] for name in parameters.PARAMETERS]
    kinds = [row.values.get("kind", "") for row in numbers]
    flags = [row.flags() for row in numbers]
    blind = [_BLIND in row.values.get("flags", "").split() for row in numbers]
    return column_dataset(places, kinds, ids, fit, flags, unresolved=blind)


def _unreadable(where: str, error: Exception) -> SettingsError:
    what = "the columns file cannot be read"
    return SettingsError(what, where, "a CSV file", str(error), "Check its path, and save it as CSV in UTF-8")


def _rows(text: str, where: str) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the names of a table's columns and its (line, values), stripped; x, y and one row are there."""
    table = parse_table(text, where, most=MOST_ROWS)
    if len(table.rows) > MOST_ROWS:
        raise SettingsError("the columns file is too long", where, f"at most {MOST_ROWS} lines", "more", "Shorten it")
    if not {"x", "y"} <= set(table.header):
        raise SettingsError(
            "the columns file does not say where the columns are" if table.header else "the columns file is empty",
            f"{where}, line {table.line}" if table.header else where,
            "a first line that names the columns x and y, separated by commas, semicolons or tabs",
            ", ".join(table.header) or "no line",
            "Name them in the first line: x,y or column_id,x,y,kind",
        )
    if not table.rows:
        raise SettingsError("the columns file is empty", where, "a row for each column", "the first line alone")
    return table.header, table.rows


class _Row:
    """One row of a table that knows its line."""

    def __init__(self, where: str, line: int, values: dict[str, str]) -> None:
        self.where, self.line, self.values = where, line, values

    def number(self, name: str) -> float:
        try:
            value = parse_number(self.values.get(name, ""))
        except ValueError:
            value = float("nan")
        if not math.isfinite(value):
            raise self._error(name, "a number")
        return value

    def integer(self, name: str) -> int:
        text = self.values.get(name, "")
        if not (text.isascii() and text.isdigit() and len(text) < 19):
            raise self._error(name, "a whole number from 0 on")
        return int(text)

    def flags(self) -> int:
        found = set(self.values.get("flags", "").split()) - {_BLIND}
        if not found <= _FLAGS.keys():
            raise self._error("flags", f"some of {', '.join(_FLAGS)}")
        return sum(_FLAGS[name] for name in found)

    def _error(self, name: str, expected: str) -> SettingsError:
        got = repr(self.values[name]) if name in self.values else "nothing"
        return SettingsError(f"{name} cannot be read", f"{self.where}, line {self.line}", expected, got, "Correct it")
