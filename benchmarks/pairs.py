"""Joint fits of touching pairs on one core, beside peers that fit both columns at the same time."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from tract_dask.kernels.gaussian.information import model_slopes
from tract_dask.kernels.gaussian.model import evaluate

from . import environment
from .fitters import PAIRS, Fitter, measure, processes
from .sizes import Size
from .windows import Case, Windows

CASES = tuple(Case(25, peak, peak) for peak in (20.0, 300.0))
FITTERS = (PAIRS, Fitter("scipy", "pairs", 0.02), Fitter("atomap", "pairs", 0.01, same_task=False))

DISTANCE, SIGMA_SHARE = 2.4, 0.1
"""Distance of the columns in sigma, and sigma as a share of the window's side."""
_START_PX, _REACH_PX = 0.7, 3.0
"""By how much fits start beside the truth, and how far they may go."""


def run(size: Size, work: Path) -> dict[str, Any]:
    """Return the rows of every fitter in every case."""
    peers = [fitter.peer for fitter in FITTERS if fitter.peer in size.peers]
    fitters = [fitter for fitter in FITTERS if fitter.peer in ("ours", *peers)]
    with processes(peers, work) as running:
        cases = {case.name: measure(fitters, running, draw(case, size.windows), work, size.repeats) for case in CASES}
    python = environment.peers_python(peers)
    return {"date": f"{datetime.now(UTC):%Y-%m-%d}", "cases": cases, "peers": environment.versions(python)}


def draw(case: Case, n: int, seed: int = 0) -> Windows:
    """Return ``n`` windows of two columns each, round and of known sigma, in any direction from each other.

    Start values have the true shapes; amplitudes are off by up to 20 %, positions by up to 0.7 px.
    """
    rng = np.random.default_rng([seed, case.side, int(case.peak), n])
    sigma, middle = SIGMA_SHARE * case.side, (case.side - 1) / 2
    turn, centre = rng.uniform(0, np.pi, n), middle + rng.uniform(-0.5, 0.5, (n, 1, 2))
    half = 0.5 * DISTANCE * sigma * np.column_stack([np.cos(turn), np.sin(turn)])
    truth = np.zeros((n, 2, 7))
    truth[..., 0] = case.peak * rng.uniform(0.7, 1.3, (n, 2))
    truth[..., 1:3] = centre + np.stack([-half, half], axis=1)
    truth[..., 3:5], truth[..., 6] = sigma, case.background
    y, x = np.mgrid[: case.side, : case.side].astype(np.float64)
    counts, crlb = np.empty((n, case.side, case.side), np.float32), np.empty((n, 2, 2))
    for number, pair in enumerate(truth):
        expected = evaluate(pair, x, y).sum(axis=0) - case.background
        counts[number] = rng.poisson(expected)
        parts = [model_slopes(column, x.ravel(), y.ravel(), fixed_shape=True)[1] for column in pair]
        slopes = np.concatenate([parts[0][:3], parts[1][:3], parts[0][3:4]])
        variance = np.linalg.inv((slopes / expected.ravel()) @ slopes.T).diagonal()
        crlb[number] = variance[[0, 1, 3, 4]].reshape(2, 2)
    start = truth.copy()
    start[..., 0] *= rng.uniform(0.8, 1.2, (n, 2))
    start[..., 1:3] += rng.uniform(-_START_PX, _START_PX, (n, 2, 2))
    start[..., 6] *= 1.1
    lower, upper = start.copy(), start.copy()
    lower[..., 1:3] -= _REACH_PX
    upper[..., 1:3] += _REACH_PX
    lower[..., [0, 6]], upper[..., [0, 6]] = 0.0, 20 * case.peak + 100
    return Windows(case, counts, truth, crlb, start, lower, upper)
