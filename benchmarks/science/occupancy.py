"""Numbers of atoms: how many are right, and whether the intervals hold what they claim."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from tract_dask.analysis.intensity import mean_intensity, normalised, repeated_error, vacuum_level
from tract_dask.analysis.mixtures import mixture
from tract_dask.analysis.occupancy import count_atoms, dose_to_be_sure

from .scenes import CONTRASTS, still_columns, still_scene, table_of
from .tables import Table

DOSES = (500, 2500)
MAX_ATOMS = 6
"""Excludes the falling branch, as the paper does."""
ERRORS = ("stderr", "poisson", "repeated")


def run(data: Path, work: Path) -> list[Table]:
    """Measure all tables."""
    counted, groups = [], []
    for contrast in CONTRASTS:
        for dose in DOSES:
            scene = still_scene(data, work, contrast, dose)
            truth = still_columns(data, scene)["atoms"]
            tracks = scene.fit().sel(column_id=truth["column_id"])
            table = table_of(data, contrast, window_px=tracks.attrs["window_px"])
            vacuum = vacuum_level(scene.summed, columns=scene.columns)
            units = normalised(tracks, vacuum)
            errors = repeated_error(units)
            for frames in ("each", "mean"):
                for error in ERRORS:
                    atoms = count_atoms(tracks, table, vacuum, frames=frames, error=error, max_atoms=MAX_ATOMS)
                    stated = {"stderr": "fitted", "poisson": "predicted", "repeated": "sd"}[error]
                    ratio = float((errors[stated] / errors["sd"]).median())
                    label = [f"{contrast}, {dose}", frames, f"`{error}`", f"{ratio:.2f}"]
                    counted.append([*label, *_scores(atoms, truth)])
            sorted_ = mixture(mean_intensity(units)["intensity"].isel(frame=0, drop=True))
            pairs = sorted(set(zip(sorted_["assigned"].to_numpy().tolist(), truth.to_numpy().tolist(), strict=True)))
            members = [sorted({n for group, n in pairs if group == k}) for k in sorted_["component"].to_numpy()]
            groups.append([f"{contrast}, {dose}", "; ".join(", ".join(map(str, some)) for some in members)])
    n = ", ".join(f"{(truth == k).sum().item()} of {k}" for k in np.unique(truth))
    return [
        Table(
            f"{truth.size} columns ({n} atoms) in 40 frames, at most {MAX_ATOMS} atoms. *mean*: from the mean of all "
            "frames. *Stated / true*: the error that is taken for an intensity over its standard deviation, median.",
            ["contrast, e/Å²", "frames", "`error`", "stated / true", "right", "within ±1",
             "sets of 68 % hold the truth", "and claim", "sets of 95 % hold the truth", "and claim", "numbers in them"],
            counted,
        ),
        Table(
            "Dose of a frame from which on the 95 % interval (Equation 5) of n atoms reaches no other number's "
            "intensity, e/Å², of at most 6 atoms; in brackets that for n ± 1.",
            ["contrast", *(f"{n}" for n in range(1, MAX_ATOMS + 1))],
            [[contrast, *_doses(data, contrast)] for contrast in CONTRASTS],
        ),
        Table(
            "Without a table: numbers of atoms in each group that `mixture` makes of the mean intensities, faintest "
            "first.",
            ["contrast, e/Å²", "groups"],
            groups,
        ),
    ]  # fmt: skip


def _scores(counts: xr.Dataset, truth: xr.DataArray) -> list[str]:
    known = counts["atoms"].notnull().to_numpy()
    off = np.abs((counts["atoms"] - truth).to_numpy())[known]
    held = []
    for level in (0.68, 0.95):
        holds, claims, size = _sets(counts["probability"], truth, level)
        held += [f"{holds[known].mean():.1%}", f"{claims[known].mean():.1%}"]
    return [f"{(off == 0).mean():.0%}", f"{(off <= 1).mean():.0%}", *held, f"{size[known].mean():.1f}"]


def _sets(
    probability: xr.DataArray, truth: xr.DataArray, level: float
) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.float64]], ...]:
    """Return for the smallest set that holds ``level``: whether it has the truth, what it claims, and its size."""
    shares = probability.to_numpy().astype(np.float64)
    ordered = -np.sort(-shares, axis=-1)
    held = np.cumsum(ordered, axis=-1)
    last = np.minimum((held < level).sum(axis=-1), shares.shape[-1] - 1)[..., None]
    of_truth = probability.sel(n_atoms=truth).to_numpy()
    limit = np.take_along_axis(ordered, last, axis=-1)
    claims = np.take_along_axis(held, last, axis=-1)[..., 0]
    return (of_truth >= limit[..., 0]).astype(np.float64), claims, (shares >= limit).sum(axis=-1).astype(np.float64)


def _doses(data: Path, contrast: str) -> list[str]:
    table = table_of(data, contrast)
    doses = [dose_to_be_sure(table, max_atoms=MAX_ATOMS, within=within)["dose"].to_numpy() for within in (0, 1)]
    return [f"{_dose(exact)} ({_dose(near)})" for exact, near in zip(*doses, strict=True)]


def _dose(value: float) -> str:
    return f"{value:.0f}" if np.isfinite(value) else "none"
