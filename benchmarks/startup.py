"""How long it takes before anything happens: the import, the help, the first fit with and without compiled kernels."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

from .sizes import Size
from .timing import ONE_THREAD, alternate, summary

FIRST_FIT = """
import numpy as np
from tract_dask.kernels.gaussian.fit import fit_gaussians
from tract_dask.kernels.gaussian.model import gaussian_image
truth = np.array([100.0, 12.5, 11.5, 4.0, 3.0, 0.3, 20.0])
windows = gaussian_image(truth[None], (25, 25)).astype(np.float32)
fits = fit_gaussians(windows, truth * 1.05, truth - 50, truth + 50, blur_sigma_px=2.0)
assert fits.converged.all()
"""


def run(size: Size, work: Path) -> dict[str, Any]:
    """Return the times of whole processes, from their start to their end, s."""
    python = [sys.executable, "-c"]
    first_fit = [*python, FIRST_FIT]
    tasks = {
        "python": partial(_process, [*python, "pass"]),
        "import tract_dask": partial(_process, [*python, "import tract_dask"]),
        "tract-dask --help": partial(_process, [str(Path(sys.executable).with_name("tract-dask")), "--help"]),
        "import numba": partial(_process, [*python, "import numba"]),
    }
    if size.cold:
        tasks["first fit, cold cache"] = partial(_with_empty_cache, first_fit, work / "cache")
        tasks["first fit, warm cache"] = partial(_process, first_fit, NUMBA_CACHE_DIR=str(work / "cache"))
    else:
        tasks["first fit, warm cache"] = partial(_process, first_fit)
    return {name: summary(times) for name, times in alternate(tasks, size.repeats).items()}


def _with_empty_cache(command: list[str], cache: Path) -> float:
    """Run a command that finds no compiled kernels, and leaves them in ``cache``."""
    shutil.rmtree(cache, ignore_errors=True)
    return _process(command, NUMBA_CACHE_DIR=str(cache))


def _process(command: list[str], **environment: str) -> float:
    began = perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=os.environ | ONE_THREAD | environment)
    return perf_counter() - began
