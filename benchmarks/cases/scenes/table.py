"""One table of all scenes: ``python -m benchmarks.cases.scenes.table --frames 24``.

A row a movie: columns found of those that are there, false ones, scatter over the Cramer-Rao bound, bias in stated
errors of the columns' means, pull, accepted fits, accepted ones where the column is away, and the warnings that the run
ends with. A row is *silent* where a number is wrong and no warning says so.
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

BIAS, PULL, FALSE = 2.0, (0.9, 1.1), 0.01
"""Bias (in stated errors of the mean), pull and false columns beyond which a row is wrong."""

USUAL = {"never_fitted"}
"""Warnings that say nothing of the fits that were made."""


def row(trial: Trial) -> str:
    """Track a movie, and return its row of the table."""
    began = time.perf_counter()
    with work_folder() as folder:
        try:
            tracks, _ = track(trial.counts, folder, trial.fit, trial.columns)
        except TractError as error:
            return f"| {trial.name} | refused: {str(error).splitlines()[0]} |"
        found = score(tracks, trial.scene, border=trial.border, tolerance=trial.tolerance)
        said, window = warnings_of(folder), int(tracks.attrs["window_px"])
    wrong = _wrong(found)
    verdict = "right" if not wrong else "warned" if set(said) - USUAL else "silent"
    absent = "" if np.isnan(found.accepted_absent) else f"{found.accepted_absent:.1%}"
    cells = (
        trial.name,
        f"{found.found} of {found.wanted}",
        f"{found.false}",
        f"{found.scatter / _bound(trial, window):.2f}",
        f"{found.bias_in_errors:.2f}",
        f"{found.pull:.2f}",
        f"{found.accepted:.1%}",
        absent,
        verdict + (f" ({', '.join(wrong)})" if wrong else ""),
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
    print("| scene | found | false | sd/bound | bias | pull | accepted | while absent | verdict | warnings | s |")
    print(f"|{'---|' * 11}")
    for name in options.names or SCENES:
        for trial in SCENES[name]():
            print(row(trial.cut(options.frames)), flush=True)


if __name__ == "__main__":
    main()
