"""One table of all scenes: ``python -m benchmarks.cases.scenes.table --frames 24``.

A row a movie: columns found of those that are there, false ones, scatter over the Cramer-Rao bound, bias in stated
errors of the columns' means, pull, intensity over the true one, accepted fits, accepted ones where the column is away,
and the warnings that the run ends with. A row is *silent* where a number is wrong and no warning tells its cause.
"""

from __future__ import annotations

import argparse
import time
import warnings

import numpy as np

from tract_dask.errors import TractError

from ..common import Score, score, track, warnings_of, work_folder
from .bounds import bound
from .scenes import SCENES, WINDOW, Trial

BIAS, PULL, FALSE, INTENSITY = 2.0, (0.9, 1.1), 0.01, 0.03
"""Bias (in stated errors of the mean), pull, false columns and error of intensities from which on a row is wrong."""

HEADINGS = (
    *("scene", "found", "false", "sd / bound", "bias", "pull", "intensity (errors)", "accepted", "while absent"),
    *("verdict", "warnings", "s"),
)

EXPLAINS: dict[str, frozenset[str]] = {
    name: frozenset(what.split())
    for name, what in {
        "gain_pattern": "bias pull intensity",
        "masked_pixels": "missing",
        "saturated": "bias pull intensity",
        "vacuum": "pull absent",
        "contrast": "missing false",
        "doubtful_columns": "missing false",
        "spacing": "missing false",
        "undersampled": "missing bias pull intensity",
        "weak_columns": "missing false absent intensity",
        "one_gaussian": "missing false bias pull intensity",
        "faint": "pull intensity",
        "lost_frames": "absent",
        "scatter": "pull",
        "touching_alone": "bias pull intensity",
        "shared_error": "bias pull",
        "unresolved": "missing false bias pull intensity",
        "long_step": "bias pull",
        "poor_drift": "bias pull",
        "crystal_motion": "bias pull intensity",
        "moving_columns": "bias pull",
        "shape_at_bound": "intensity",
        "mixed": "missing false bias pull absent intensity",
    }.items()
}
"""Which wrong numbers a warning tells the cause of; the others tell of none of these."""


def row(trial: Trial) -> str:
    """Track a movie, and return its row of the table."""
    began = time.perf_counter()
    with work_folder() as folder:
        try:
            tracks, _ = track(trial.counts, folder, trial.fit, trial.columns)
        except TractError as error:
            return f"| {trial.name} | refused: {str(error).splitlines()[0]} |"
        found = score(tracks, trial.scene, border=trial.border, tolerance=trial.tolerance, unit=trial.unit)
        said, window = warnings_of(folder), int(tracks.attrs["window_px"])
    wrong = _wrong(found)
    silent = [what for what in wrong if not any(what in EXPLAINS.get(name, ()) for name in said)]
    verdict = "right" if not wrong else "warned" if not silent else "silent"
    absent = "" if np.isnan(found.accepted_absent) else f"{found.accepted_absent:.1%}"
    cells = (
        trial.name,
        f"{found.found} of {found.wanted}",
        f"{found.false}",
        f"{found.scatter / _bound(trial, window):.2f}",
        f"{found.bias_in_errors:.2f}",
        f"{found.pull:.2f}",
        f"{found.intensity:.3f} ({found.intensity_in_errors:.1f})",
        f"{found.accepted:.1%}",
        absent,
        verdict + (f" ({', '.join(silent or wrong)})" if wrong else ""),
        ", ".join(said),
        f"{time.perf_counter() - began:.0f}",
    )
    return f"| {' | '.join(cells)} |"


def _wrong(found: Score) -> list[str]:
    """Return what is wrong with the numbers of a row."""
    checks = {
        "missing": found.found < 0.98 * found.wanted,
        "false": found.false > FALSE * max(1, found.wanted),
        "bias": found.bias_in_errors > BIAS,
        "pull": not PULL[0] <= found.pull <= PULL[1],
        "absent": found.accepted_absent > 2 * 0.05,
        "intensity": abs(found.intensity - 1) > INTENSITY and found.intensity_in_errors > BIAS,
    }
    return [name for name, is_wrong in checks.items() if is_wrong]


def _bound(trial: Trial, window: int) -> float:
    scene = trial.scene
    height = float(np.median(scene.amplitudes[np.nonzero(scene.amplitudes)])) if scene.amplitudes.any() else 1.0
    return bound(height, scene.sigma, float(np.median(scene.background)), max(WINDOW, window))[0]


def main() -> None:
    """Print the table, of the scenes that are named or of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[[], *SCENES], metavar="NAME", help=", ".join(SCENES))
    parser.add_argument("--frames", type=int, default=40, help="frames of each movie, the first of them")
    options = parser.parse_args()
    warnings.filterwarnings("ignore", category=RuntimeWarning)
    print(f"| {' | '.join(HEADINGS)} |\n|{'---|' * len(HEADINGS)}")
    for name in options.names or SCENES:
        for trial in SCENES[name]():
            print(row(trial.cut(options.frames)), flush=True)


if __name__ == "__main__":
    main()
