"""The fitting kernel on one core, beside its peers: cost and precision on the same windows, and cost against size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from . import environment
from .fitters import LSQ, PEERS, POISSON, Fitter, measure, processes
from .sizes import Size
from .windows import Case, draw

BRIGHT = tuple(Case(side, peak, peak) for side in (25, 51) for peak in (20.0, 300.0))
"""The cases that speed is compared in."""

FAINT = tuple(Case(side, 5.0, 20.0) for side in (25, 51))
"""The cases that show who loses columns."""

IN_SWEEP = (LSQ, POISSON, Fitter("picasso", "lsq guess", 0.1), Fitter("scipy", "trf", 0.01))


def run(size: Size, work: Path) -> dict[str, Any]:
    """Return the rows of every fitter in every case, and of some for every size of the window."""
    fitters = [LSQ, POISSON, *(fitter for fitter in PEERS if fitter.peer in size.peers)]
    in_sweep = [fitter for fitter in IN_SWEEP if fitter in (LSQ, POISSON) or fitter.peer in size.peers]
    with processes(size.peers, work) as running:
        cases = {
            case.name: measure(fitters, running, draw(case, size.windows), work, size.repeats)
            for case in (*BRIGHT, *FAINT)
        }
        sweep = {
            str(side): measure(in_sweep, running, draw(Case(side, 20.0, 20.0), size.windows), work, size.repeats)
            for side in size.sides
        }
    return {"cases": cases, "sides": sweep, "peers": environment.versions(environment.peers_python(size.peers))}
