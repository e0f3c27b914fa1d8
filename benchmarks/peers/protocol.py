"""What the benchmark and a fitter's process say to each other: one line of JSON there, one back, arrays in files.

Imports nothing but numpy, since it runs in the peers' environment too.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Task:
    """Windows to be fitted.

    Attributes
    ----------
    windows
        (n, side, side) float32 counts.
    start, lower, upper
        (n, 7) amplitude, x, y, sigma_a, sigma_b, theta, background of Equation 1; px from the first pixel's centre.
        Of pairs (n, 2, 7), with the shapes that they have.
    """

    windows: NDArray[np.float32]
    start: Floats
    lower: Floats
    upper: Floats

    @classmethod
    def load(cls, path: Path, count: int) -> Task:
        """Return the first ``count`` windows of a file."""
        with np.load(path) as arrays:
            return cls(**{name: np.ascontiguousarray(arrays[name][:count]) for name in cls.__annotations__})

    @property
    def grid(self) -> tuple[Floats, Floats]:
        """The coordinates x and y of a window's pixels, flat."""
        y, x = np.mgrid[: self.windows.shape[1], : self.windows.shape[2]].astype(np.float64)
        return x.ravel(), y.ravel()


class Found(NamedTuple):
    """What a fitter found: centres (n, 2), (x, y), of pairs (n, 2, 2), and whether it says of each that all is fine.

    A fitter may do fewer windows than it was given.
    """

    centres: Floats
    fine: NDArray[np.bool_]


Method = Callable[[Task], Callable[[], Found]]
"""Takes a task, prepares all that is not to be timed, and returns the work that is."""


def serve(methods: dict[str, Method]) -> None:
    """Answer requests on standard input until it ends.

    A request names a ``method``, a file of windows (``task``), how many of them (``count``) and the file for what is
    found (``found``). The answer tells the processor time of the work, ``seconds``.
    """
    for line in sys.stdin:
        request: dict[str, Any] = json.loads(line)
        work = methods[request["method"]](Task.load(Path(request["task"]), request["count"]))
        began, cpu = perf_counter(), process_time()
        found = work()
        answer = {"seconds": process_time() - cpu, "elapsed": perf_counter() - began}
        np.savez(request["found"], centres=found.centres, fine=found.fine)
        print(json.dumps(answer), flush=True)


def equation_1(parameters: Floats, x: Floats, y: Floats) -> Floats:
    """Return the model at the points x, y, for one column's seven parameters."""
    amplitude, x0, y0, sigma_a, sigma_b, theta, background = parameters
    cos, sin = np.cos(theta), np.sin(theta)
    along, across = (x - x0) * cos - (y - y0) * sin, (x - x0) * sin + (y - y0) * cos
    result: Floats = amplitude * np.exp(-0.5 * ((along / sigma_a) ** 2 + (across / sigma_b) ** 2)) + background
    return result


def slopes_1(parameters: Floats, x: Floats, y: Floats) -> Floats:
    """Return the derivatives of :func:`equation_1` by its parameters, (points, 7)."""
    amplitude, x0, y0, sigma_a, sigma_b, theta, _ = parameters
    cos, sin = np.cos(theta), np.sin(theta)
    along, across = (x - x0) * cos - (y - y0) * sin, (x - x0) * sin + (y - y0) * cos
    u, v = along / sigma_a**2, across / sigma_b**2
    shape = np.exp(-0.5 * (along * u + across * v))
    column = amplitude * shape
    return np.stack(
        [
            shape,
            column * (u * cos + v * sin),
            column * (v * cos - u * sin),
            column * along * u / sigma_a,
            column * across * v / sigma_b,
            column * along * across * (1 / sigma_a**2 - 1 / sigma_b**2),
            np.ones_like(shape),
        ],
        axis=-1,
    )


def mosaic(task: Task) -> tuple[Floats, Floats]:
    """Return the windows side by side in a square image, as many as fill it, and their centres (n, 2), (y, x)."""
    side = task.windows.shape[1]
    row = int(np.sqrt(len(task.windows)))
    tiles = task.windows[: row * row].reshape(row, row, side, side).astype(np.float64)
    middle = np.arange(row) * side + (side - 1) / 2
    y, x = np.meshgrid(middle, middle, indexing="ij")
    return tiles.transpose(0, 2, 1, 3).reshape(row * side, row * side), np.stack([y.ravel(), x.ravel()], axis=1)
