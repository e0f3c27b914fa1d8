"""Columns on the sites of lattices that the settings name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ...errors import SettingsError, shown
from ...store.columns import column_dataset, is_inside, positions

MOST_SITES = 1_000_000
"""Sites of all lattices together, those outside the image counted."""

_MOST_COUNT = 1_000_000

_LATTICE_KEYS = ("origin", "a", "a_count", "b", "b_count", "a_repeats", "b_repeats", "kind")


def lattice_columns(
    origin: Sequence[float],
    a: Sequence[float],
    a_count: int,
    b: Sequence[float],
    b_count: int,
    a_repeats: int = 1,
    b_repeats: int = 1,
    kind: str = "",
) -> xr.Dataset:
    """Return the columns of a lattice that three atoms of the image define, as seeds for ``find_columns``.

    The columns are ``origin + i (a - origin) / a_count + j (b - origin) / b_count`` for i = 0 ... a_repeats - 1 and
    j = 0 ... b_repeats - 1, i running fastest: ``a_repeats * b_repeats`` columns, the first of them the origin. Where
    the a-atom lies to the left of or above the origin, the lattice runs to the left or upwards.

    Parameters
    ----------
    origin, a, b
        Positions (x, y) of three atoms in px.
    a_count, b_count
        Columns from the origin to the a-atom and to the b-atom, the origin not counted: the farther away the atom, the
        more precise the lattice.
    a_repeats, b_repeats
        Columns along each direction, the origin counted.
    kind
        Sublattice or element of all of them.

    Raises
    ------
    SettingsError
        Where a position is not two finite numbers, a count or repeat is not a whole number from 1 to 1,000,000, there
        are more than :data:`MOST_SITES` sites, or the three atoms lie on one line.

    Examples
    --------
    >>> seeds = lattice_columns((10, 10), (90, 10), 4, (10, 70), 3, a_repeats=3, b_repeats=2)
    >>> seeds.x_ref.values
    array([10., 30., 50., 10., 30., 50.])
    """
    where = "lattice"
    start, to_a, to_b = (_position(value, name, where) for value, name in ((origin, "origin"), (a, "a"), (b, "b")))
    for name, count in {"a_count": a_count, "b_count": b_count, "a_repeats": a_repeats, "b_repeats": b_repeats}.items():
        _check_count(count, name, where)
    check_sites(a_repeats * b_repeats, where)
    if not isinstance(kind, str):
        raise SettingsError("kind cannot be used", where, "text", shown(kind))
    step_a, step_b = (to_a - start) / a_count, (to_b - start) / b_count
    area = abs(step_a[0] * step_b[1] - step_a[1] * step_b[0])
    if area <= 1e-3 * np.hypot(*step_a) * np.hypot(*step_b):
        raise SettingsError(
            "the three atoms lie on one line",
            where,
            "an origin, an a-atom and a b-atom in two directions",
            f"origin {tuple(origin)}, a {tuple(a)}, b {tuple(b)}",
            "Choose a b-atom off the line from the origin to the a-atom",
        )
    j, i = np.divmod(np.arange(a_repeats * b_repeats), a_repeats)
    seeds = column_dataset(start + i[:, None] * step_a + j[:, None] * step_b, kind)
    seeds.attrs["spacing_px"] = float(min(np.hypot(*v) for v in (step_a, step_b, step_a + step_b, step_a - step_b)))
    return seeds


def _check_count(count: Any, name: str, where: str) -> None:
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or not 1 <= count <= _MOST_COUNT:
        raise SettingsError(f"{name} cannot be used", where, f"a whole number from 1 to {_MOST_COUNT}", shown(count))


def check_sites(total: int, where: str, most: int = MOST_SITES) -> None:
    """Check that lattices have at most ``most`` sites.

    Raises
    ------
    SettingsError
        With both numbers.
    """
    if total > most:
        raise SettingsError(
            "the lattice has too many sites",
            where,
            f"at most {most}",
            str(total),
            "Repeat the lattice less often, or check the counts",
        )


def _position(value: Any, name: str, where: str) -> NDArray[np.float64]:
    try:
        position = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        position = np.empty(0)
    if position.shape != (2,) or not np.isfinite(position).all():
        raise SettingsError(f"{name} is not a position", where, "two numbers [x, y] in px", shown(value))
    return position


def settings_lattices(lattices: Sequence[Any]) -> list[xr.Dataset]:
    """Return the columns of each lattice of the settings: tables with the arguments of :func:`lattice_columns`.

    Raises
    ------
    SettingsError
        Naming the lattice, counted from 1, and what is wrong with it.
    """
    if not lattices:
        raise SettingsError(
            "there is no lattice",
            "setting lattices (ColumnSettings)",
            "one table [[columns.lattices]] or more",
            "none",
            "Give origin, a, a_count, b, b_count and the repeats, or choose method auto",
        )
    found = list[xr.Dataset]()
    for number, table in enumerate(lattices, start=1):
        where = f"setting lattices (ColumnSettings), lattice {number}"
        if not isinstance(table, Mapping):
            raise SettingsError("this is not a table", where, f"the keys {', '.join(_LATTICE_KEYS)}", shown(table))
        unknown = [str(key) for key in table if key not in _LATTICE_KEYS]
        missing = [key for key in _LATTICE_KEYS[:5] if key not in table]
        if unknown or missing:
            got = [f"without {', '.join(missing)}"] * bool(missing) + [f"unknown {', '.join(unknown)}"] * bool(unknown)
            raise SettingsError(
                "the keys are not those of a lattice",
                where,
                f"{', '.join(_LATTICE_KEYS[:5])}, and if need be {', '.join(_LATTICE_KEYS[5:])}",
                "; ".join(got),
            )
        try:
            found.append(lattice_columns(**table))
            check_sites(sum(lattice.sizes["column_id"] for lattice in found), where)
        except SettingsError as error:
            raise SettingsError(error.what, where, error.expected, error.got, error.remedy) from None
    return found


def lattice_sites(lattices: Sequence[Any], shape: tuple[int, ...]) -> xr.Dataset:
    """Return the sites of all lattices of the settings inside an image of ``shape`` (y, x), lattice by lattice.

    The attribute ``spacing_px`` is the shortest of the lattices.

    Raises
    ------
    SettingsError
        As :func:`settings_lattices`, and where no site is inside.
    """
    found = settings_lattices(lattices)
    places = np.concatenate([positions(lattice) for lattice in found])
    kind = np.concatenate([lattice["kind"].to_numpy() for lattice in found])
    inside = is_inside(places, shape)
    if not inside.any():
        raise SettingsError(
            "no site of the lattices is inside the image",
            "setting lattices (ColumnSettings)",
            f"positions (x, y) from 0 to {shape[1] - 1}, {shape[0] - 1}",
            f"the first at ({places[0, 0]:g}, {places[0, 1]:g})",
            "Give positions in px of the summed image, x to the right and y down",
        )
    sites = column_dataset(places[inside], kind[inside].tolist())
    sites.attrs["spacing_px"] = min(lattice.attrs["spacing_px"] for lattice in found)
    return sites
