"""Positions and intensities against dose: Supplementary Table 2 of the paper with the Cramér-Rao bound, Equation 5."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from tract_dask.analysis.intensity import normalised, repeated_error, vacuum_level
from tract_dask.analysis.precision import precision_table

from .scenes import Scene, still_columns, still_scene
from .tables import Table, with_error

PAPER = {125: (10.14, 9.08, 5.11), 250: (9.45, 6.72, 3.61), 500: (7.63, 4.76, 2.56)}
"""Supplementary Table 2: centroid, Gaussian and theory at each dose, pm."""
CASES = (("soft", 125), ("soft", 250), ("soft", 500), ("soft", 2500), ("full", 500), ("full", 2500))
WAYS: dict[str, dict[str, Any]] = {
    "default": {},
    "paper": {"shape": "free", "threshold": 2.0, "mask_radius_px": 10.0},
    "poisson": {"estimator": "poisson"},
}
"""Settings of the fit; the paper's centroid has a radius of 10 px (section 2.4)."""


def run(data: Path, work: Path) -> list[Table]:
    """Measure all tables."""
    beside, ratios, intensities = [], [], []
    for contrast, dose in CASES:
        scene = still_scene(data, work, contrast, dose)
        truth = still_columns(data, scene)
        ids: list[int] = truth["column_id"][truth["below"]].to_numpy().tolist()
        tracks = {name: scene.fit(**settings) for name, settings in WAYS.items()}
        found = {name: precision_table(fits, columns=ids).isel(dose=0) for name, fits in tracks.items()}
        label = f"{contrast}, {dose}"
        beside.append([label, *_beside(found), *_of_the_paper(contrast, dose)])
        ratios.append([label, *_ratios(found)])
        intensities.append(
            [label, *(cell for name in ("default", "paper") for cell in _intensity(scene, tracks[name], ids))]
        )
    n = f"{len(ids)} columns below the surface, 40 frames each; pm per axis, with the standard error over the columns"
    return [
        Table(
            f"Standard deviation of positions: {n}.",
            ["contrast, e/Å² a frame", "Gaussian, paper's way", "Gaussian, default", "Gaussian, `poisson`",
             "centroid, mask of 10 px", "centroid, best mask", "theory", "CRLB", "accepted",
             "paper: Gaussian", "centroid", "theory"],
            beside,
        ),
        Table(
            "Ratios of these, in the frames in which the Gaussian is accepted.",
            ["contrast, e/Å² a frame", "default / CRLB", "paper's way / CRLB", "`poisson` / CRLB",
             "centroid, mask of 10 px / Gaussian, paper's way", "centroid, best mask / Gaussian, default",
             "centroid, best mask / Gaussian, `poisson`", "paper: centroid / Gaussian"],
            [[*row, _paper_ratio(*case)] for row, case in zip(ratios, CASES, strict=True)],
        ),
        Table(
            "Intensities of the same columns in units of 1 Å² of vacuum, means over the columns: intensity, its "
            "standard deviation over the frames, its error by Equation 5, and that which the fit states.",
            ["contrast, e/Å² a frame", *(f"{way}: {what}" for way in ("default", "paper's way")
             for what in ("mean", "sd", "Equation 5", "fit"))],
            intensities,
        ),
    ]  # fmt: skip


def _beside(found: dict[str, xr.Dataset]) -> list[str]:
    default, paper, poisson = found["default"], found["paper"], found["poisson"]
    return [
        _cell(paper, "gaussian"),
        _cell(default, "gaussian"),
        _cell(poisson, "gaussian"),
        _cell(paper, "centroid_all"),
        _cell(default, "centroid_all"),
        f"{float(default['theory']):.2f}",
        f"{float(default['crlb']):.2f}",
        f"{float(default['accepted']):.1%}",
    ]


def _intensity(scene: Scene, tracks: xr.Dataset, ids: list[int]) -> list[str]:
    vacuum = vacuum_level(scene.summed, columns=scene.columns)
    errors = repeated_error(normalised(tracks, vacuum)).sel(column_id=ids).mean("column_id")
    return [f"{float(errors[name]):.3f}" for name in ("mean", "sd", "predicted", "fitted")]


def _cell(table: xr.Dataset, name: str) -> str:
    return with_error(float(table[name]), float(table[f"{name}_stderr"]))


def _ratios(found: dict[str, xr.Dataset]) -> list[str]:
    pairs = [(found[name]["gaussian"], found[name]["crlb"]) for name in ("default", "paper", "poisson")]
    pairs += [(found[name]["centroid"], found[name]["gaussian"]) for name in ("paper", "default")]
    pairs += [(found["default"]["centroid"], found["poisson"]["gaussian"])]
    return [f"{float(above / below):.2f}" for above, below in pairs]


def _of_the_paper(contrast: str, dose: int) -> list[str]:
    centroid, gaussian, theory = PAPER.get(dose, (np.nan,) * 3) if contrast == "soft" else (np.nan,) * 3
    return ["" if np.isnan(value) else f"{value:.2f}" for value in (gaussian, centroid, theory)]


def _paper_ratio(contrast: str, dose: int) -> str:
    return f"{PAPER[dose][0] / PAPER[dose][1]:.2f}" if contrast == "soft" and dose in PAPER else ""
