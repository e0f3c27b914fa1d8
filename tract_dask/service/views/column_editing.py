"""Columns edited by hand: what may be saved, how it is refined, and the sites of lattices (section 2.4 of the paper).

Nothing here knows of HTTP or of jobs: the service and the editor of notebooks and the command line share it.
"""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import count
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from ...errors import MissingStoreError, SettingsError
from ...kernels.gaussian.parameters import AMPLITUDE, SIGMA_A, SIGMA_B
from ...settings.run import ColumnSettings, RunSettings
from ...settings.toml import from_toml, to_toml
from ...stages.columns.find import find_columns
from ...stages.columns.sites import check_sites, lattice_columns
from ...stages.columns.window_size import default_window, neighbour_distance
from ...store import datasets, metadata
from ...store.columns import check_inside, column_dataset, columns_csv, flag_names, parse_columns_csv, positions

MOST_COLUMNS = 200_000
"""Columns of one table."""
LONGEST_KIND = 64
"""Characters of a kind."""
HIGHEST_ID = 2**53
"""What a number of a column stays below, so that scripts in a browser hold it exactly."""

_SAME = 1 / 3
"""Sites nearer to a column than this share of the spacing are that column."""
_FEW = 64
"""So many columns are refined on a part of the image."""
_MOST_ON_A_PIXEL = 16
"""Columns that may have their places on one pixel."""
_MOST_WINDOW_PX = 10**8
_MOST_COVER = 16
"""Windows that are refined at once cover the image so many times at most, and have so many pixels together."""
_AROUND = 3.0
"""How far that part reaches beyond the columns, in spacings."""


class ColumnRecord(TypedDict):
    """A column as JSON: px and counts a frame; None where it has no fit."""

    column_id: int
    x: float
    y: float
    kind: str
    flags: list[str]
    amplitude: float | None
    sigma_a: float | None
    sigma_b: float | None


@dataclass(frozen=True)
class Scene:
    """An image on which columns are edited, and how they are fitted in it.

    Attributes
    ----------
    sum, found
        The stores of the summed image, and of the columns that a run found or refined in it.
    columns
        How columns are found.
    blur_sigma_px, window_px
        As in the fit of the frames.
    """

    sum: Path
    found: Path
    columns: ColumnSettings
    blur_sigma_px: float | None
    window_px: int | None

    @property
    def exists(self) -> bool:
        """Whether columns have been looked for."""
        return bool(metadata.attributes(self.found))

    @property
    def shape(self) -> tuple[int, int]:
        """Size (y, x) of the image, px.

        Raises
        ------
        MissingStoreError
            Where there is none yet.
        """
        if not metadata.attributes(self.sum):
            raise MissingStoreError(
                "there is no summed image yet", str(self.sum), remedy="Wait until the run has summed the movie"
            )
        ny, nx = datasets.open_array(self.sum / "image").shape
        return ny, nx


def scene_of(output: Path, settings: RunSettings) -> Scene:
    """Return the scene of a run into the folder ``output``."""
    from ...store.run_folder import RunFolder  # it takes its time, and the process pool does not need it

    places, fit = RunFolder(output), settings.fit
    return Scene(places.sum, places.columns.with_suffix(".zarr"), settings.columns, fit.blur_sigma_px, fit.window_px)


def automatic(scene: Scene) -> xr.Dataset:
    """Return the columns that the settings find: version 0, whatever has been edited since.

    Raises
    ------
    MissingStoreError
        Where no columns have been looked for yet.
    """
    about = metadata.attributes(scene.found)
    if not about:
        raise MissingStoreError(
            "there are no columns yet", str(scene.found), remedy="Wait until the run has found them in the summed image"
        )
    made_by = from_toml(ColumnSettings, about.get("settings", ""))
    if not about.get("edited") and made_by.method == scene.columns.method:
        return datasets.open_dataset(scene.found)
    return _found_again(scene.sum, _stamp(scene.sum), to_toml(scene.columns), scene.blur_sigma_px, scene.window_px)


def summary(scene: Scene) -> dict[str, Any]:
    """Return ``count``, ``highest_id`` and ``created`` (UTC, ISO 8601) of the automatic columns."""
    ids = automatic(scene)["column_id"].to_numpy()
    created = metadata.attributes(scene.found).get("created", "")
    return {"count": len(ids), "highest_id": int(ids.max(initial=0)), "created": created}


def version_json(scene: Scene, version: int, table: str | None) -> bytes:
    """Return a version of the columns as JSON: ``version``, ``columns`` (records) and ``spacing_px``.

    Parameters
    ----------
    table
        A saved one, as CSV; None: :func:`automatic`.
    """
    columns = automatic(scene) if table is None else parse_columns_csv(table, "columns")
    spacing = neighbour_distance(positions(columns))
    return _as_json({"version": version, "columns": to_records(columns), "spacing_px": spacing})


def checked_csv(
    scene: Scene, places: ArrayLike, kinds: Sequence[str], column_ids: Sequence[int | None], next_id: int
) -> str:
    """Return edited columns as a table, checked by :func:`edited_columns`."""
    return columns_csv(edited_columns(places, kinds, column_ids, scene.shape, next_id))


def refined_json(
    scene: Scene,
    places: ArrayLike,
    kinds: Sequence[str],
    column_ids: Sequence[int | None],
    spacing_px: float | None = None,
) -> bytes:
    """Return what :func:`refine` makes of edited columns, as JSON."""
    return _as_json(refine(scene, edited_columns(places, kinds, column_ids, scene.shape), spacing_px))


def lattice_json(scene: Scene, lattice: Mapping[str, Any], beside: ArrayLike = ()) -> bytes:
    """Return what :func:`lattice_sites` makes of a lattice, as JSON."""
    return _as_json(lattice_sites(scene.shape, lattice, beside))


def _as_json(value: Mapping[str, Any]) -> bytes:
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()


def to_records(columns: xr.Dataset) -> list[ColumnRecord]:
    """Return columns, one mapping each."""
    flags = {status: flag_names(status) for status in np.unique(columns["status_ref"].to_numpy()).tolist()}
    numbers = columns["fit_ref"].to_numpy()[:, [AMPLITUDE, SIGMA_A, SIGMA_B]]
    fits = numbers.astype(object)
    fits[~np.isfinite(numbers)] = None
    return [
        ColumnRecord(
            column_id=column,
            x=x,
            y=y,
            kind=str(kind),
            flags=flags[status],
            amplitude=fit[0],
            sigma_a=fit[1],
            sigma_b=fit[2],
        )
        for column, (x, y), kind, status, fit in zip(
            columns["column_id"].to_numpy().tolist(),
            positions(columns).tolist(),
            columns["kind"].to_numpy(),
            columns["status_ref"].to_numpy().tolist(),
            fits.tolist(),
            strict=True,
        )
    ]


def edited_columns(
    places: ArrayLike,
    kinds: Sequence[str],
    column_ids: Sequence[int | None],
    shape: tuple[int, int],
    next_id: int = 1,
    where: str = "columns",
) -> xr.Dataset:
    """Return columns as a user has edited them, checked.

    Parameters
    ----------
    places
        (columns, 2) rows of (x, y) in px of the summed image.
    kinds
        Sublattice or element of each, or "".
    column_ids
        Their numbers; None: a new one, from ``next_id`` on.
    shape
        (y, x) of the summed image.
    where
        What to call them in errors.

    Raises
    ------
    SettingsError
        Where there is none or more than :data:`MOST_COLUMNS`, a place is not finite or outside the image, a number
        comes twice or is none, a kind is too long or cannot be written in a table, or far too many are on one pixel.
    """
    xy = np.asarray(places, dtype=np.float64).reshape(-1, 2)
    if not 1 <= len(xy) <= MOST_COLUMNS:
        raise SettingsError(
            "this is not a table of columns",
            where,
            f"1 to {MOST_COLUMNS} columns",
            str(len(xy)),
            "Keep at least one column" if not len(xy) else "Edit fewer columns at a time",
        )
    if not np.isfinite(xy).all():
        first = int(np.flatnonzero(~np.isfinite(xy).all(axis=1))[0])
        raise SettingsError("a position is not a number", f"{where}, column {first + 1}", "finite x and y in px")
    for number, kind in enumerate(kinds, start=1):
        if len(kind) > LONGEST_KIND or kind != kind.strip() or not kind.isprintable():
            expected = f"at most {LONGEST_KIND} printable characters, without spaces around them"
            raise SettingsError("a kind cannot be used", f"{where}, column {number}", expected, repr(kind[:80]))
    columns = column_dataset(xy, kinds, _numbered(column_ids, next_id, where))
    check_inside(columns, shape, where)
    _check_apart(xy, where)
    return columns


def _check_apart(xy: NDArray[np.float64], where: str) -> None:
    """Check that no pixel has more columns than can be meant."""
    x, y = np.rint(xy).astype(np.int64).T
    _, firsts, numbers = np.unique(y * (x.max() + 1) + x, return_index=True, return_counts=True)
    number, first = numbers.max(), firsts[numbers.argmax()]
    if number > _MOST_ON_A_PIXEL:
        raise SettingsError(
            "many columns have the same place",
            f"{where}, column {first + 1}",
            f"at most {_MOST_ON_A_PIXEL} columns on a pixel",
            f"{number} on the pixel at x {x[first]}, y {y[first]}",
            "Keep one of them",
        )


def _numbered(column_ids: Sequence[int | None], next_id: int, where: str) -> list[int]:
    """Return the numbers, with new ones in place of None."""
    given = [number for number in column_ids if number is not None]
    if given and not (min(given) >= 0 and max(given) < HIGHEST_ID):
        wrong = min(given) if min(given) < 0 else max(given)
        raise SettingsError(
            "a column_id cannot be used", where, f"whole numbers from 0 to {HIGHEST_ID - 1}", str(wrong)
        )
    if len(set(given)) < len(given):
        twice, _ = Counter(given).most_common(1)[0]
        raise SettingsError(
            "a column_id comes twice", where, "each column_id once", str(twice), "Leave it out for new columns"
        )
    new = count(max([next_id, *(number + 1 for number in given)]))
    return [next(new) if number is None else number for number in column_ids]


def refine(scene: Scene, columns: xr.Dataset, spacing_px: float | None = None) -> dict[str, Any]:
    """Fit edited columns in the summed image, as a run that is given them does.

    Parameters
    ----------
    columns
        As :func:`edited_columns` returns them.
    spacing_px
        Where these are only some of the columns: the distance between neighbours among all of them. It says how far a
        column may move, and the window. A few columns are then refined on their part of the image.

    Returns
    -------
    dict
        ``columns`` (records, in their order, without those that fell together with an earlier one), ``merged`` (pairs
        of the numbers of a column and of one that fell together with it), ``spacing_px`` and ``window_px``.

    Raises
    ------
    SettingsError, InputError
        As :func:`tract_dask.find_columns`.
    """
    summed = _summed(scene.sum, _stamp(scene.sum))
    settings, window, corner = scene.columns, scene.window_px, np.zeros(2, dtype=np.int64)
    _check_windows(columns, window, spacing_px or settings.spacing_px, summed["image"].size)
    if spacing_px is not None:
        settings = dataclasses.replace(settings, spacing_px=spacing_px)
        window = window or default_window(spacing_px)
        if columns.sizes["column_id"] <= _FEW:
            summed, corner = _around(summed, positions(columns), _AROUND * spacing_px + window)
    moved = columns.assign(x_ref=columns["x_ref"] - corner[0], y_ref=columns["y_ref"] - corner[1])
    found = find_columns(summed, settings, seeds=moved, blur_sigma_px=scene.blur_sigma_px, window_px=window)
    found = found.assign(x_ref=found["x_ref"] + corner[0], y_ref=found["y_ref"] + corner[1])
    return {"columns": to_records(found)} | {name: found.attrs[name] for name in ("merged", "spacing_px", "window_px")}


def _check_windows(columns: xr.Dataset, window_px: int | None, spacing_px: float | None, image_px: int) -> None:
    """Check that the windows of many columns can be fitted while somebody waits."""
    number = columns.sizes["column_id"]
    if number <= _FEW:
        return
    spacing = spacing_px or neighbour_distance(positions(columns))
    if not spacing:
        raise SettingsError(
            "most of these columns have the same place as another one",
            "columns",
            "each column once",
            f"{number} columns",
            "Keep one of those at the same place",
        )
    side = window_px or default_window(spacing)
    most = max(_FEW, min(_MOST_COVER * image_px, _MOST_WINDOW_PX) // side**2)
    if number > most:
        raise SettingsError(
            "the windows of these columns are too large to refine so many at once",
            "columns",
            f"at most {most} columns with windows of {side} px",
            str(number),
            "Refine fewer columns at a time; or check spacing_px",
        )


def lattice_sites(
    shape: tuple[int, int], lattice: Mapping[str, Any], beside: ArrayLike = (), where: str = "lattice"
) -> dict[str, Any]:
    """Return the sites of a lattice inside an image, without those that are columns already.

    Parameters
    ----------
    shape
        (y, x) of the image.
    lattice
        Arguments of :func:`tract_dask.lattice_columns`.
    beside
        (columns, 2) rows of (x, y): the columns that are there. A site within a third of the spacing (the smaller of
        the lattice's and theirs) of one of them is that column.

    Returns
    -------
    dict
        ``columns`` (records; numbered from 1), ``outside`` and ``merged`` (how many sites were left out for either
        reason), and the lattice's ``spacing_px``.

    Raises
    ------
    SettingsError
        As :func:`tract_dask.lattice_columns`; where more than :data:`MOST_COLUMNS` sites are in the image.
    """
    sites = lattice_columns(**lattice)
    places, size = positions(sites), np.array(shape[::-1])
    inside = ((places >= -0.5) & (places < size - 0.5)).all(axis=1)
    there = np.asarray(beside, dtype=np.float64).reshape(-1, 2)
    spacing = float(sites.attrs["spacing_px"])
    known: NDArray[np.bool_] = np.zeros(len(places), dtype=bool)
    if len(there):
        reach = _SAME * min(spacing, neighbour_distance(there) or spacing)
        known = inside & (np.asarray(cKDTree(np.unique(there, axis=0)).query(places)[0]) <= reach)
    kept = np.flatnonzero(inside & ~known)
    check_sites(len(kept), where, MOST_COLUMNS)
    found = column_dataset(places[kept], sites["kind"].to_numpy()[kept].tolist())
    return {
        "columns": to_records(found),
        "outside": int((~inside).sum()),
        "merged": int(known.sum()),
        "spacing_px": spacing,
    }


def _around(summed: xr.Dataset, places: NDArray[np.float64], margin: float) -> tuple[xr.Dataset, NDArray[np.int64]]:
    """Return the part of the image that reaches ``margin`` px beyond the places, and its first pixel (x, y)."""
    size = np.array([summed.sizes["x"], summed.sizes["y"]])
    low = np.clip(np.floor(places.min(axis=0) - margin).astype(np.int64), 0, size - 1)
    high = np.clip(np.ceil(places.max(axis=0) + margin).astype(np.int64) + 1, low + 1, size)
    return summed.isel(x=slice(low[0], high[0]), y=slice(low[1], high[1])), low


def _stamp(store: Path) -> int:
    """Return what changes when a store is written anew."""
    try:
        return (store / "zarr.json").stat().st_mtime_ns
    except OSError as error:
        raise MissingStoreError(
            "there is no summed image yet", str(store), remedy="Wait until the run has summed the movie"
        ) from error


@lru_cache(maxsize=1)
def _summed(store: Path, stamp: int) -> xr.Dataset:
    return datasets.open_dataset(store)


@lru_cache(maxsize=4)
def _found_again(
    store: Path, stamp: int, settings: str, blur_sigma_px: float | None, window_px: int | None
) -> xr.Dataset:
    how = from_toml(ColumnSettings, settings)
    return find_columns(_summed(store, stamp), how, blur_sigma_px=blur_sigma_px, window_px=window_px)
