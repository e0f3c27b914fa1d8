"""Whole runs from the command line: throughput, workers against each other, memory and time against the length."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from threading import Event, Thread
from time import perf_counter
from typing import Any

import psutil

from . import movies
from .sizes import Size
from .timing import summary

_POLL_S = 0.05


def run(size: Size, work: Path) -> dict[str, Any]:
    """Return times and memory of runs on one worker and on one a core, and on movies that are shorter.

    One worker is measured twice: with all cores for its driver, its reading thread and the disk, and, where processes
    can be pinned, with everything on one core.
    """
    cores = psutil.cpu_count() or 1
    movie = movies.simulate(work / "run.tif", size, size.frames)
    by_workers: dict[int, list[dict[str, Any]]] = {cores: [], 1: []}
    on_one_core: list[dict[str, Any]] = []
    for _ in range(size.long_repeats):
        for workers, outcomes in by_workers.items():
            outcomes.append(measured_run(movie, work / "run", size, workers))
        if size.one_core and hasattr(os, "sched_setaffinity"):
            on_one_core.append(measured_run(movie, work / "run", size, 1, one_core=True))
    by_frames: dict[int, list[dict[str, Any]]] = {}
    for share in size.shares:
        frames = size.frames // share
        part = movies.first_frames(movie, frames, work / "part.tif")
        by_frames[frames] = [measured_run(part, work / "run", size, cores) for _ in range(size.long_repeats)]
        part.unlink()
    movie.unlink()
    by_frames[size.frames] = by_workers[cores]
    return {
        "workers": cores,
        "frames": size.frames,
        "input_mb": size.frames * size.frame_bytes / 1e6,
        "shard_mb": size.shard_mb,
        "columns": by_workers[cores][0]["columns"],
        "by_workers": {str(workers): _summary(outcomes) for workers, outcomes in by_workers.items()},
        "on_one_core": _summary(on_one_core) if on_one_core else None,
        "by_frames": {str(frames): _summary(outcomes) for frames, outcomes in by_frames.items()},
    }


def measured_run(movie: Path, output: Path, size: Size, workers: int, *, one_core: bool = False) -> dict[str, Any]:
    """Run ``tract-dask run`` in a process of its own; return its time, its stages' times and its workers' memory.

    ``one_core`` pins it and all that it starts to one core.
    """
    command = [str(Path(sys.executable).with_name("tract-dask")), "run", str(movie), str(output)]
    command += ["--workers", str(workers), "--window-px", str(size.window_px), "--shard-mb", str(size.shard_mb)]

    def pin() -> None:
        os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])

    try:
        began = perf_counter()
        with subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, preexec_fn=pin if one_core else None
        ) as process:
            memory = _Memory(process.pid)
            _, errors = process.communicate()
            seconds = perf_counter() - began
        peak_mb = memory.stop() / 1e6
        if process.returncode:
            raise RuntimeError(f"{' '.join(command)} ended with {process.returncode}:\n{errors.decode()}")
        lines = (output / "events.jsonl").read_text(encoding="utf-8").splitlines()
        columns = (output / "columns.csv").read_text(encoding="utf-8").splitlines()
    finally:
        shutil.rmtree(output, ignore_errors=True)
    events = [json.loads(line) for line in lines]
    stages = {event["stage"]: event["seconds"] for event in events if event["event"] == "StageDone"}
    return {"seconds": seconds, "stages": stages, "peak_mb": peak_mb, "columns": len(columns) - 1}


def _summary(outcomes: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "seconds": summary([outcome["seconds"] for outcome in outcomes]),
        "worker_peak_mb": summary([outcome["peak_mb"] for outcome in outcomes]),
        "stages": {name: summary([outcome["stages"][name] for outcome in outcomes]) for name in outcomes[0]["stages"]},
    }


class _Memory:
    """Watches the workers of a run: their largest resident memory, without pages of files that are shared."""

    def __init__(self, pid: int) -> None:
        self._pid, self._peak, self._ended = pid, 0, Event()
        self._thread = Thread(target=self._watch, daemon=True)
        self._thread.start()

    def stop(self) -> int:
        """Stop watching; return the largest memory of one worker, bytes."""
        self._ended.set()
        self._thread.join()
        return self._peak

    def _watch(self) -> None:
        while not self._ended.wait(_POLL_S):
            try:
                for child in psutil.Process(self._pid).children(recursive=True):
                    memory = child.memory_info()
                    self._peak = max(self._peak, memory.rss - getattr(memory, "shared", 0))
            except psutil.NoSuchProcess:
                continue
