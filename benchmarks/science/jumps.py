"""Motion: the jumps of a column at a step's edge, columns that vanish and appear, and false alarms of all others."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from tract_dask.analysis import motion
from tract_dask.analysis.intensity import vacuum_level
from tract_dask.analysis.jumps import change_points, threshold_jumps
from tract_dask.analysis.occupancy import count_atoms
from tract_dask.analysis.presence import looked, present, states
from tract_dask.store.results import accepted

from .scenes import moving_columns, open_scene, table_of
from .tables import Table, with_error

MOVIES = {
    "movie_counts_0500": "full, 500",
    "movie_soft_counts_0500": "soft, 500",
    "movie_soft_counts_2500": "soft, 2500",
}
JUMPS, APPEARS, VANISHES, WANDERS = 4, 5, 16, 15
"""IDs of the columns that do something; all others keep still."""
_NEAR = 1
"""A jump that is found this many frames off is that jump."""
_CONFIDENCES = (0.95, 0.99)
_MAX_ATOMS = 6


def run(data: Path, work: Path) -> list[Table]:
    """Measure all tables."""
    truth = np.load(data / "movie_truth.npz")
    number = truth["ids"].tolist().index(JUMPS)
    moves = np.diff(truth["disp_pm"][:, number], axis=0)
    true = {int(frame) + 1: float(np.hypot(*moves[frame])) for frame in np.flatnonzero(np.abs(moves).max(axis=1) > 0)}
    there = {name: truth["n_ce"][:, truth["ids"].tolist().index(name)] > 0 for name in (VANISHES, APPEARS)}
    found_rows, step_rows, presence_rows = [], [], []
    for name, label in MOVIES.items():
        scene = open_scene(data, work, name, drifts=True)
        tracks = scene.fit()
        ours = moving_columns(data, tracks)
        still = [mine for theirs, mine in ours.items() if theirs not in (JUMPS, APPEARS, VANISHES, WANDERS)]
        error = float(motion.spread(tracks)["sd"].sel(column_id=still).median())
        rules = {f"change points, {share:.0%}": change_points(tracks, share) for share in _CONFIDENCES}
        rules[f"original's, {3 * error:.1f} pm (3 sd)"] = threshold_jumps(tracks, 3 * error)
        for rule, jumps in rules.items():
            found_rows.append([label, f"{error:.2f}", rule, *_found(jumps, ours[JUMPS], still, list(true))])
        step_rows.append([label, *_steps(rules["change points, 95%"], ours[JUMPS], true)])
        counts = count_atoms(
            tracks,
            table_of(data, label.split(",")[0], window_px=tracks.attrs["window_px"]),
            vacuum_level(scene.summed, columns=scene.columns),
            max_atoms=_MAX_ATOMS,
        )
        seen = looked(tracks)
        tests = {
            "fit not accepted": accepted(tracks)["intensity"].isnull(),
            "`threshold=3`": accepted(tracks, 3.0)["intensity"].isnull(),
            "`present`, 1 % false alarms": ~present(tracks, 0.01),
            "`states`, 95 %": ~states(tracks, 0.95),
            "`count_atoms`: none": counts["atoms"] == 0,
        }
        for test, absent in tests.items():
            presence_rows.append([label, test, *_absences(absent & seen, seen, ours, there, still)])
    steps = [f"{frame}: {size:.1f}" for frame, size in true.items()]
    return [
        Table(
            "Jumps of column 4 (six, at frames " + ", ".join(map(str, true)) + "), and false ones of the columns that "
            "keep still. A jump that is found a frame off counts as found.",
            ["contrast, e/Å²", "sd of a still column, pm", "rule", "found", "missed", "false", "still columns with any",
             "false jumps of still columns"],
            found_rows,
        ),
        Table(
            "The same jumps, frame: size in pm, as change points at 95 % find them; true: " + ", ".join(steps) + ".",
            ["contrast, e/Å²", "frame: size ± standard error"],
            step_rows,
        ),
        Table(
            f"Columns that are not there: frames in which column {VANISHES} (one atom) or column {APPEARS} (two atoms) "
            "is absent and said to be, frames in which it is there and said to be absent, and the latter over all "
            "still columns.",
            ["contrast, e/Å²", "test", "16: absence seen", "16: false alarms", "5: absence seen", "5: false alarms",
             "still columns: false alarms"],
            presence_rows,
        ),
    ]  # fmt: skip


def _found(jumps: xr.Dataset, column: int, still: Sequence[int], true: Sequence[int]) -> list[str]:
    """Return what was found, missed and false for the jumping column, and what the still ones show."""
    mine = jumps["frame"].to_numpy()[jumps["column_id"].to_numpy() == column].tolist()
    found = [frame for frame in true if any(abs(frame - other) <= _NEAR for other in mine)]
    false = [other for other in mine if all(abs(frame - other) > _NEAR for frame in true)]
    others = jumps["column_id"].to_numpy()[np.isin(jumps["column_id"], still)]
    missed = [str(frame) for frame in true if frame not in found]
    return [
        f"{len(found)} of {len(true)}",
        ", ".join(missed) or "none",
        str(len(false)),
        f"{len(set(others.tolist()))} of {len(still)}",
        str(len(others)),
    ]


def _steps(jumps: xr.Dataset, column: int, true: dict[int, float]) -> list[str]:
    mine = jumps.isel(jump=jumps["column_id"].to_numpy() == column)
    error = (mine["stderr"] ** 2).mean("axis") ** 0.5
    parts = zip(mine["frame"].to_numpy(), mine["size"].to_numpy(), error.to_numpy(), strict=True)
    return [", ".join(f"{frame}: {with_error(size, sd, 1)}" for frame, size, sd in parts)]


def _absences(
    absent: xr.DataArray,
    seen: xr.DataArray,
    ours: dict[int, int],
    there: dict[int, NDArray[Any]],
    still: Sequence[int],
) -> list[str]:
    """Return how many absences are found, and how many are false; frames whose window left the field do not count."""
    cells = []
    for name, truth in there.items():
        if name not in ours:
            cells += ["not found", "not found"]
            continue
        said, known = (values.sel(column_id=ours[name]).to_numpy() for values in (absent, seen))
        cells += [
            f"{(said & ~truth).sum()} of {(known & ~truth).sum()}",
            f"{(said & truth).sum()} of {(known & truth).sum()}",
        ]
    alarms, frames = (int(values.sel(column_id=list(still)).sum()) for values in (absent, seen))
    return [*cells, f"{alarms} of {frames} ({alarms / frames:.1%})"]
