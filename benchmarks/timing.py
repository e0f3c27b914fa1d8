"""Times that can be compared: alternating measurements, one thread a process, medians with their spread."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Mapping
from statistics import median
from time import perf_counter
from typing import Any, TypeVar

from tract_dask.cluster.forkserver import THREAD_VARIABLES

Name = TypeVar("Name", bound=Hashable)

ONE_THREAD = dict.fromkeys(THREAD_VARIABLES, "1")
"""Environment of every process that is measured on one core."""


def alternate(tasks: Mapping[Name, Callable[[], float]], repeats: int) -> dict[Name, list[float]]:
    """Return the times of every task, s: each runs once before any runs again, so that a slow minute slows all.

    A task does its own timing, and returns seconds.
    """
    times: dict[Name, list[float]] = {name: [] for name in tasks}
    for _ in range(repeats):
        for name, task in tasks.items():
            times[name].append(task())
    return times


def timed(work: Callable[[], Any]) -> Callable[[], float]:
    """Return a task that does the work and returns how long it took, s; what was written before is on the disk then."""

    def task() -> float:
        os.sync()
        began = perf_counter()
        work()
        return perf_counter() - began

    return task


def summary(times: list[float], scale: float = 1.0) -> dict[str, float]:
    """Return the median and the range of some times, divided by ``scale``.

    Examples
    --------
    >>> summary([3.0, 1.0, 2.0], scale=2)
    {'median': 1.0, 'low': 0.5, 'high': 1.5}
    """
    return {name: pick(times) / scale for name, pick in (("median", median), ("low", min), ("high", max))}
