"""Are stated confidences what they say? Over hundreds of made tracks: still ones, hopping ones, and absent columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from tract_dask.analysis.jumps import change_points, jump_rate
from tract_dask.analysis.motion import displacement
from tract_dask.analysis.presence import present, states
from tract_dask.store.schema import REJECTED

from .made import Floats, Made
from .tables import Table, with_error

ROWS = {
    "weak (45 %), 500": Made(amplitude=1.44, background=3.2),
    "weak (45 %), 2500": Made(amplitude=7.2, background=16.0),
    "strong (125 %), 500": Made(amplitude=4.0, background=3.2),
    "faint (22 %), 500": Made(amplitude=0.7, background=3.2),
}
"""Contrast of a column and dose, e/A^2 a frame at 8 pm a pixel."""
N_FRAMES, AWAY = 40, slice(16, 24)
HOP_ERRORS, HOP_CHANCE = 3.0, 0.1
"""Size of hops, in errors of a place, and their probability a frame."""


def run(data: Path, work: Path) -> list[Table]:
    """Measure all tables."""
    measured = {label: _of(made, work / f"levels_{number}") for number, (label, made) in enumerate(ROWS.items())}
    heads = list(next(iter(measured.values())))
    rows = [[head, *(of[head] for of in measured.values())] for head in heads]
    caption = (
        f"Stated levels over made tracks of {N_FRAMES} frames: 196 columns that keep still, and 196 of which a third "
        "hops, a third is away for eight frames, and a third is never there. Percent, with the standard error."
    )
    return [Table(caption, ["contrast, e/Å² a frame", *measured], rows)]


def _of(made: Made, work: Path) -> dict[str, str]:
    """Return what holds of one kind of column, by what is stated."""
    work.mkdir()
    still = made.tracks(work, np.zeros((N_FRAMES, made.n_columns, 2)), seed=1)
    found = {f"still columns with a jump at {level:.0%}": _jumped(still, level) for level in (0.9, 0.95, 0.99)}
    pairs = [displacement(still, first, first + 20)["p_value"].to_numpy() for first in range(0, 20, 2)]
    p_values = np.concatenate(pairs)
    found["still columns that moved, p < 5 %"] = share(p_values[np.isfinite(p_values)] < 0.05)
    moved, there = motion(made, still)
    kinds = np.arange(made.n_columns) % 3
    tracks = made.tracks(work, moved, there, seed=2)
    rates = jump_rate(change_points(tracks), tracks).isel(column_id=kinds == 0)
    held = (rates["low"] <= HOP_CHANCE) & (rates["high"] >= HOP_CHANCE)
    found["95 % intervals that hold the rate of hops"] = share(held.to_numpy()[~rates["counted"].to_numpy()])
    never = kinds == 2
    passes = (tracks["status"].to_numpy() & np.uint16(REJECTED)) == 0
    found["accepted fits where there is no column, 5 % stated"] = share(passes[:, never])
    for rate in (0.05, 0.01):
        seen = present(tracks, rate).to_numpy()
        found[f"`present` at {rate:.0%} where there is no column"] = share(seen[:, never])
    found["`present` at 1 % where there is one"] = share(seen[:, ~never][there[:, ~never]])
    told = states(tracks).to_numpy()
    found["columns that are never there, and are at 95 % by `states`"] = share(np.asarray(told[:, never].any(axis=0)))
    gone = kinds == 1
    found["absences of eight frames that `states` sees"] = share((~told[AWAY][:, gone]).mean(axis=0) > 0.5)
    return found


def motion(made: Made, still: xr.Dataset) -> tuple[Floats, NDArray[np.bool_]]:
    """Return how columns move, (frame, column, 2) in px, and whether they are there, (frame, column)."""
    rng, shape = np.random.default_rng(5), (N_FRAMES, made.n_columns)
    kinds = np.arange(made.n_columns) % 3
    moved, there = np.zeros((*shape, 2)), np.ones(shape, np.bool_)
    error = float(np.nanmedian(still["stderr"].sel(parameter="x")))
    site = np.cumsum(rng.random(shape) < HOP_CHANCE, axis=0) % 2
    moved[..., 0] = np.where(kinds == 0, HOP_ERRORS * error * site, 0.0)
    there[AWAY, kinds == 1] = False
    there[:, kinds == 2] = False
    return moved, there


def _jumped(tracks: xr.Dataset, level: float) -> str:
    jumps = change_points(tracks, level)["column_id"].to_numpy()
    return share(np.isin(tracks["column_id"].to_numpy(), jumps))


def share(cases: NDArray[np.bool_]) -> str:
    """Return the share of the cases that are true, in percent, with its standard error.

    Examples
    --------
    >>> share(np.arange(100) < 5)
    '5.0 ± 2.2'
    """
    n, mean = max(1, cases.size), float(cases.mean()) if cases.size else 0.0
    return with_error(100 * mean, 100 * np.sqrt(max(mean * (1 - mean), 1 / n**2) / n), 1)
