"""Whether a job can be done, and what it will take: the checks of a run before it starts, made at submission."""

from __future__ import annotations

import dataclasses
import math
import shutil
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np
from anyio import to_thread

from ..cluster.memory import local_memory_limit, memory_limit
from ..errors import ClusterError, TractError
from ..progress import STAGES
from ..readers import open_source
from ..readers.checks import Permit
from ..readers.movie_files import FileList
from ..readers.times import has_stamps
from ..run.checks import check_inputs, check_output
from ..run.plan import Plan, plan_run
from ..settings.run import RunSettings, SourceSettings
from ..settings.toml import from_dict
from ..stages.convert.origin import origin_of
from ..stages.convert.references import check_references
from ..store.movie import open_movie
from ..store.run_folder import RunFolder
from .data_root import DataRoot
from .job_settings import inside, stored_settings
from .jobs.states import State
from .jobs.store import JobStore
from .outputs import Mark, check_owner

if TYPE_CHECKING:
    from .services import Services  # the processes of the pool do without

BYTES_PER_S = 60e6
"""Raw bytes of a movie that a whole run gets through in a second on two cores, before any job has told better."""

STARTUP_S = 10.0
"""What a run takes beside its stages, whatever the movie."""

_PAST_JOBS = 5
_TRIED_BYTES = 256 << 20
_WHOLE = frozenset(STAGES)


@dataclass(frozen=True)
class Checked:
    """What the checks found out about a job.

    Attributes
    ----------
    shape, dtype
        The movie's frames, rows and columns, and its pixel type.
    content
        A hash of what it holds.
    """

    shape: tuple[int, int, int]
    dtype: str
    plan: Plan
    content: str


async def check_job(
    services: Services, owner: str, source: str, values: dict[str, Any], output: str = ""
) -> tuple[dict[str, Any], str, Checked]:
    """Check a job; return its settings as they are stored, its folder relative to the root, and what it will take.

    Parameters
    ----------
    services
        Of the application.
    owner
        Whose job it is.
    source, output
        Relative to the data root; ``output`` may be empty.
    values
        Settings by group and name.

    Raises
    ------
    TractError
        Where it cannot be done: the movie, the settings or the folder cannot be used.
    """
    root: DataRoot = services.root
    stored, place, whole = await to_thread.run_sync(_checked_parts, root, owner, source, values, output)
    folder = root.path / output if output else None
    file = root.path / source
    checked = await services.pool.run(check_source, place, whole, folder, root.permit, about=file)
    return stored, output, checked


def _checked_parts(
    root: DataRoot, owner: str, source: str, values: dict[str, Any], output: str
) -> tuple[dict[str, Any], str | FileList, dict[str, Any]]:
    """Return the settings to be stored, the movie, and the settings with whole paths; all that is named may be used."""
    stored = stored_settings(values)
    if output:
        check_owner(root, Mark(owner, "", output))
    return stored, root.source(source), inside(root, stored)


async def plan_job(
    services: Services, owner: str, source: str, values: dict[str, Any], output: str = ""
) -> dict[str, Any]:
    """Return what a job would take, by name as in :class:`tract_dask.service.api.plan.PlanAnswer`.

    Raises
    ------
    TractError
        As :func:`check_job`; that it does not fit into memory or onto the disk is part of the answer.
    """
    _, _, checked = await check_job(services, owner, source, values, output)
    return await to_thread.run_sync(_measured, services, checked)


def _measured(services: Services, checked: Checked) -> dict[str, Any]:
    plan = dataclasses.replace(checked.plan, memory_limit=_memory_limit(services))
    seconds = STARTUP_S + _raw_bytes(checked.shape, checked.dtype) / _bytes_per_s(services.store, services.root)
    free = shutil.disk_usage(services.root.path).free
    problem = _problem(plan, free)
    amounts = ("frames", "shards", "bytes_read", "bytes_written", "peak_memory", "memory_limit")
    return {name: getattr(plan, name) for name in amounts} | {
        "shape": checked.shape,
        "dtype": checked.dtype,
        "disk_free": free,
        "seconds": round(seconds, 1),
        "fits": not problem,
        "problem": problem,
    }


def _problem(plan: Plan, free: int) -> str:
    """Return why the work does not fit; "" where it does."""
    if plan.bytes_written > free:
        return (
            f"the disk has {free / 1e9:.2f} GB free, and the job may write {plan.bytes_written / 1e9:.2f} GB "
            "(less where the movie compresses well)"
        )
    try:
        plan.check()
    except ClusterError as error:
        return str(error)
    return ""


def _memory_limit(services: Services) -> int | None:
    """Return the bytes that a task may use: of the workers that are there, else of those that would be started."""
    if limits := [worker["memory_limit"] for worker in services.runner.cluster.workers() if worker["memory_limit"]]:
        return int(min(limits))
    cluster = services.config.cluster
    return local_memory_limit(cluster) if cluster.resolved_kind == "local" else memory_limit(cluster)


def _bytes_per_s(store: JobStore, root: DataRoot) -> float:
    """Return how fast the last jobs got through their movies, in raw bytes a second."""
    rates = []
    for job in store.jobs(states=(State.DONE, State.DONE_WITH_FAILED_FRAMES), limit=_PAST_JOBS):
        seconds = job.outcome.get("seconds") or {}
        if not seconds.keys() >= _WHOLE:
            continue  # some of it had been done before
        with suppress(TractError, OSError):
            movie = open_movie(RunFolder(root.resolve(job.output)).movie)
            rates.append(_raw_bytes(movie.shape, movie.dtype.name) / max(sum(seconds.values()), 1e-3))
    return median(rates) if rates else BYTES_PER_S


def _raw_bytes(shape: tuple[int, int, int], dtype: str) -> int:
    return math.prod(shape) * np.dtype(dtype).itemsize


def check_source(place: str | FileList, stored: dict[str, Any], folder: Path | None, permit: Permit) -> Checked:
    """Open a movie, and make the checks of a run in ``folder`` before it starts; for a process of the pool.

    Its first frame is read as well, unless that is very large: some files crash their reader only then.
    """
    settings = from_dict(RunSettings, stored)
    with closing(open_source(place, settings.source, settings.metadata, permit=permit)) as source:
        check_inputs(source.shape, settings)
        check_references(source, settings.convert, settings.metadata)
        if folder is not None and folder.exists():
            check_output(RunFolder(folder), source, settings, overwrite=False)
        if _raw_bytes((1, *source.shape[1:]), source.dtype.name) <= _TRIED_BYTES:
            source.read(0, 1)
        plan = plan_run(source.shape, source.dtype, settings)
        return Checked(source.shape, source.dtype.name, plan, origin_of(source).content)


def about_movie(place: str | FileList, declared: dict[str, Any], permit: Permit) -> dict[str, Any]:
    """Return what a movie says about itself, ready for JSON; for a process of the pool."""
    settings = from_dict(SourceSettings, {name: value for name, value in declared.items() if value is not None})
    with closing(open_source(place, settings, permit=permit)) as source:
        known, own = source.metadata, getattr(source, "whole", source).metadata
        return {
            "format": source.format,
            "files": len(source.files),
            "shape": source.shape,
            "dtype": source.dtype.name,
            "bytes": _raw_bytes(source.shape, source.dtype.name),
            "pixel_size_pm": known.pixel_size_pm,
            "frame_time_s": known.frame_time_s,
            "time_stamps": has_stamps(known),
            "file_pixel_size_pm": own.pixel_size_pm,
            "file_frame_time_s": own.frame_time_s,
            "dose": known.dose,
            "gain": known.gain,
            "warnings": list(known.notes),
        }
