"""Filters: Supplementary Table 1 of the paper on a frame with a column off its site, and who draws it back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

import tract_dask as td
from tract_dask.analysis.filters import FILTERS

from .jumps import APPEARS, JUMPS, MOVIES, VANISHES
from .scenes import Floats, moving_columns, open_scene
from .tables import Table, with_error

SHOWN = (13, 14, 3, JUMPS)
"""Columns of the truth that the table shows: neighbours, and the one that is off its site."""
FRAME = 35
"""A frame in which it is 27 pm off its site."""
_FAR_PX = 8.0
"""A fit this far from its column has lost it."""
_DISPLACED_PM, _COARSE_PM = 40.0, 8.0


def run(data: Path, work: Path) -> list[Table]:
    """Measure all tables."""
    rows: list[list[str]] = []
    slopes: list[list[str]] = []
    for name, label in MOVIES.items():
        scene = open_scene(data, work, name, drifts=True)
        ours = moving_columns(data, scene.fit())
        compared = td.compare_filters(scene.movie, scene.columns, scene.drift, frames=range(scene.movie.n_frames))
        if not rows:
            rows = _table(compared, [ours[column] for column in SHOWN])
        slopes += _pull(data, label, compared, ours)
    return [
        Table(
            f"Supplementary Table 1 on frame {FRAME} of the movie at full contrast and 500 e/Å² (4 pm a pixel). Atom 4 "
            "is the column at the step's edge, 27 pm (6.8 px) from its site.",
            ["filter", "atom", "R²", "x, px", "y, px", "x difference", "y difference", "intensity", "difference, %"],
            rows,
        ),
        Table(
            "All 40 frames: how far the column at the step's edge is drawn back, as a share of its displacement (0: "
            "not at all, 1: it stays on its site); error of still columns, px per axis; and their R².",
            ["contrast, e/Å²", "filter", "drawn back", "error of still columns", "R²"],
            slopes,
        ),
        Table(
            f"A column {_DISPLACED_PM:.0f} pm ({_DISPLACED_PM / _COARSE_PM:.0f} px of {_COARSE_PM:.0f} pm) off its "
            "site in `simulate_movie`, 500 e/Å²: error of its position along the displacement, px, mean over the "
            "frames in which it is there.",
            ["contrast", *FILTERS],
            [[f"{contrast:g}", *_far(work, contrast)] for contrast in (1.0, 0.5)],
        ),
    ]


def _table(compared: xr.Dataset, columns: list[int]) -> list[list[str]]:
    rows = []
    for name in FILTERS:
        for atom, column in enumerate(columns, start=1):
            one = compared.sel(frame=FRAME, filter=name, column_id=column)
            values = {key: float(one[key]) for key in one.data_vars}
            plain = name == FILTERS[0]
            rows.append(
                [
                    name,
                    str(atom),
                    f"{values['r_squared']:.3f}",
                    *(f"{values[key]:.2f}" for key in ("x", "y")),
                    *("" if plain else f"{values[f'{key}_difference']:.2f}" for key in ("x", "y")),
                    f"{values['intensity']:.1f}",
                    "" if plain else f"{values['intensity_difference']:.1f}",
                ]
            )
    return rows


def _pull(data: Path, label: str, compared: xr.Dataset, ours: dict[int, int]) -> list[list[str]]:
    truth = np.load(data / "movie_truth.npz")
    number = {int(name): k for k, name in enumerate(truth["ids"])}
    moved = truth["disp_pm"][:, number[JUMPS]] / compared.attrs["pixel_size_pm"]
    still = [name for name in ours if name not in (VANISHES, APPEARS) and not _moves(truth["disp_pm"][:, number[name]])]
    rows = []
    for name in FILTERS:
        places = np.stack([compared[axis].sel(filter=name).to_numpy() for axis in ("x", "y")], axis=-1)
        column = {int(k): n for n, k in enumerate(compared["column_id"].to_numpy())}
        off = {k: places[:, column[ours[k]]] - truth["xy"][:, number[k]] for k in (*still, JUMPS)}
        scatter = np.concatenate([_kept(off[k]) - _kept(off[k]).mean(axis=0) for k in still])
        slope, error = _slope(moved, off[JUMPS])
        explained = compared["r_squared"].sel(filter=name, column_id=[ours[k] for k in still])
        rows.append(
            [label, name, with_error(-slope, error), f"{np.sqrt((scatter**2).mean()):.2f}", f"{explained.mean():.3f}"]
        )
    return rows


def _moves(displacement: Floats) -> bool:
    """Return whether a column leaves its site."""
    return bool(np.abs(displacement).max() > 0)


def _kept(off: Floats) -> Floats:
    return np.asarray(off[np.hypot(*off.T) < _FAR_PX])


def _slope(moved: Floats, off: Floats) -> tuple[float, float]:
    """Return the slope of the error of a position against the displacement, and its standard error."""
    near = np.hypot(*off.T) < _FAR_PX
    x, y = ((values[near] - values[near].mean(axis=0)).ravel() for values in (moved, off))
    slope = float(x @ y / (x @ x))
    return slope, float(np.sqrt(np.mean((y - slope * x) ** 2) / (x @ x)))


def _far(work: Path, contrast: float) -> list[str]:
    path = work / f"far_{contrast:g}.tif"
    truth = td.simulate_movie(
        path, n_frames=40, shape=(384, 384), contrast=contrast, jump_pm=_DISPLACED_PM, drift_px=0.0
    )
    td.convert(path, path.with_suffix(".zarr"), overwrite=True)
    movie = td.open_movie(path.with_suffix(".zarr"))
    column = int(np.flatnonzero(truth["role"].to_numpy() == "jumping")[0])
    x, y = (truth[axis].to_numpy()[:, column] for axis in ("x", "y"))
    away = np.flatnonzero(x > x.min() + 1)
    columns = td.find_columns(td.sum_image(movie))
    mine = int(np.hypot(columns["x_ref"] - x.mean(), columns["y_ref"] - y.mean()).argmin())
    compared = td.compare_filters(movie, columns, frames=away.tolist(), column_ids=[int(columns["column_id"][mine])])
    errors = compared["x"].isel(column_id=0).to_numpy() - x[away, None]
    return [with_error(error.mean(), error.std(ddof=1) / np.sqrt(len(error))) for error in errors.T]
