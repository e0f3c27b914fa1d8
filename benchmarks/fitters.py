"""Fitters as processes: every method of every fitter on the same windows, one after the other, again and again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .environment import HERE, peers_python
from .timing import ONE_THREAD, alternate, summary
from .windows import Windows, score


@dataclass(frozen=True)
class Fitter:
    """A method of a peer, or of this project.

    Attributes
    ----------
    peer
        Module of :mod:`benchmarks.peers`.
    method
        Its name there.
    share
        Of the windows, which it gets; less for the slow ones.
    same_task
        Whether it fits all seven parameters.
    """

    peer: str
    method: str
    share: float = 1.0
    same_task: bool = True

    @property
    def name(self) -> str:
        """For tables."""
        return f"{'tract_dask' if self.peer == 'ours' else self.peer} {self.method}"


LSQ, POISSON, PAIRS = Fitter("ours", "lsq"), Fitter("ours", "poisson"), Fitter("ours", "pairs")

PEERS = (
    Fitter("picasso", "lsq guess", 0.2),
    Fitter("picasso", "lsq seeds", 0.2),
    Fitter("picasso", "poisson guess", 0.2),
    Fitter("picasso", "poisson seeds", 0.2),
    Fitter("scipy", "trf", 0.02),
    Fitter("lmfit", "leastsq", 0.02),
    Fitter("atomap", "2d gaussian", 0.01),
    Fitter("trackpy", "leastsq", 0.005, same_task=False),
    Fitter("trackpy", "centroid", same_task=False),
)

_FEWEST, _WARM = 9, 2
"""Windows that every fitter gets at least, and before its time is taken."""


class Process:
    """A fitter's process, which waits for work."""

    def __init__(self, peer: str, python: str | Path, folder: Path) -> None:
        self._peer, self._found = peer, folder / f"{peer}.npz"
        command = [python, "-m", f"benchmarks.peers.{peer}"]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=HERE.parent, env=_environment()
        )

    def close(self) -> None:
        """End it."""
        with self._process:
            assert self._process.stdin is not None
            self._process.stdin.close()

    def fit(self, method: str, task: Path, count: int) -> float:
        """Let it fit the first ``count`` windows of a file; return the processor time that it took, s."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        request = {"method": method, "task": str(task), "count": count, "found": str(self._found)}
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        for line in self._process.stdout:  # some peers have other things to say as well
            if line.startswith("{"):
                return float(json.loads(line)["seconds"])
        raise RuntimeError(f"the process of {self._peer} ended without an answer")

    def found(self, windows: Windows) -> dict[str, Any]:
        """Return the score of what it found last."""
        with np.load(self._found) as arrays:
            return score(arrays["centres"], arrays["fine"], windows)


@contextmanager
def processes(peers: Sequence[str], folder: Path) -> Iterator[dict[str, Process]]:
    """Yield the processes of this project and of these peers; they end with the block."""
    python = peers_python(peers)
    with ExitStack() as stack:
        started: dict[str, Process] = {}
        for peer in ("ours", *peers):
            interpreter = sys.executable if peer == "ours" else python
            started[peer] = Process(peer, interpreter, folder)
            stack.callback(started[peer].close)
        yield started


def measure(
    fitters: Sequence[Fitter], running: dict[str, Process], windows: Windows, folder: Path, repeats: int
) -> list[dict[str, Any]]:
    """Return a row for each fitter: what it took for one fit, and how good its fits were.

    The first fit of every fitter is not measured: it may compile.
    """
    task = folder / "task.npz"
    np.savez(task, windows=windows.counts, **{n: getattr(windows, n) for n in ("start", "lower", "upper")})
    counts = {
        fitter: min(len(windows.counts), max(_FEWEST, round(fitter.share * len(windows.counts)))) for fitter in fitters
    }
    scores: dict[Fitter, dict[str, Any]] = {}

    def fit(fitter: Fitter) -> float:
        process = running[fitter.peer]
        seconds = process.fit(fitter.method, task, counts[fitter])
        scores[fitter] = process.found(windows)
        return seconds

    for fitter in fitters:
        running[fitter.peer].fit(fitter.method, task, _WARM)
    times = alternate({fitter: partial(fit, fitter) for fitter in fitters}, repeats)
    return [
        {"fitter": fitter.name, "same_task": fitter.same_task}
        | {"seconds_per_fit": summary(times[fitter], scores[fitter]["windows"])}
        | scores[fitter]
        for fitter in fitters
    ]


def _environment() -> dict[str, str]:
    return os.environ | ONE_THREAD | {"PYTHONWARNINGS": "ignore"}
