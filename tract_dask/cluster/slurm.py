"""Workers in SLURM jobs, through dask-jobqueue: as many as set, also after jobs have ended or were cancelled."""

from __future__ import annotations

import logging
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from math import ceil
from threading import Event, Thread, current_thread, main_thread
from time import monotonic
from typing import Any

from ..errors import ClusterError
from ..settings.cluster import ClusterSettings
from . import deaths, forkserver
from .tls import security

_log = logging.getLogger(__name__)

NANNY_BYTES = 256_000_000
"""What a job needs for each worker beside the worker's own memory: the process that watches it."""

_LOOK_S = 2.0
_CORRECT_S = 120.0
"""For so long jobs may be cancelled and queued until it is given up, and tried again."""

_IDLE_S = 60.0
"""For so long the workers beyond the fewest are kept when the last client has gone."""


@contextmanager
def hold_slurm(settings: ClusterSettings, memory_limit: int | None) -> Iterator[Any]:
    """Yield a SLURMCluster (:mod:`dask_jobqueue`) that is kept at its size; its jobs are cancelled with the block.

    A job that ends by its walltime, by scancel or by a node that fails is followed by another. While clients are
    connected there are as many workers as ``settings.workers`` says; after a minute without, ``settings.min_workers``.

    Parameters
    ----------
    memory_limit
        Of a worker, in bytes.

    Raises
    ------
    ClusterError
        Where dask-jobqueue is missing or SLURM does not answer.
    """
    try:
        jobqueue = _import_jobqueue()
    except ImportError as error:
        raise ClusterError(
            "dask-jobqueue is not installed",
            "setting kind (ClusterSettings)",
            "the package dask-jobqueue",
            str(error),
            'Install it with: pip install "tract_dask[slurm]"',
        ) from error
    with jobqueue.SLURMCluster(**_arguments(settings, int(memory_limit or 0))) as cluster:
        _ask(["sbatch", "--test-only"], cluster.job_script())
        ended = Event()
        keeping = Thread(target=_keep, args=(cluster, settings, ended), name="slurm", daemon=True)
        keeping.start()
        try:
            yield cluster
        finally:
            ended.set()
            keeping.join()


def _import_jobqueue() -> Any:
    """Return dask-jobqueue; its import answers Ctrl-C by an exit with code 0, so this process's answer is put back."""
    if "dask_jobqueue" not in sys.modules and current_thread() is not main_thread():
        raise ClusterError(
            "dask-jobqueue can only be imported in the main thread",
            "setting kind (ClusterSettings)",
            "the main thread",
            f"the thread {current_thread().name}",
            "Write 'import dask_jobqueue' at the top of the program that starts this thread.",
        )
    before = signal.getsignal(signal.SIGINT)
    import dask_jobqueue

    if current_thread() is main_thread():
        signal.signal(signal.SIGINT, before)
    return dask_jobqueue


def _arguments(settings: ClusterSettings, memory_limit: int) -> dict[str, Any]:
    """Return what SLURMCluster takes; memory is the workers' own, to which the job adds that of their nannies."""
    slurm, count = settings.slurm, settings.slurm.workers_per_job
    threads = [f"export {name}={value}" for name, value in forkserver.ENVIRONMENT.items()]
    return {
        "cores": count * settings.threads,
        "processes": count,
        "memory": f"{count * memory_limit} B",
        "job_mem": f"{ceil(count * (memory_limit + NANNY_BYTES) / 2**20)}M",
        "queue": slurm.queue,
        "account": slurm.account,
        "walltime": slurm.walltime,
        "job_extra_directives": list(slurm.directives),
        "job_script_prologue": [*slurm.prologue, *threads],
        "log_directory": slurm.log_directory,
        "python": settings.python,
        "local_directory": settings.local_directory,
        "death_timeout": 60,
        "worker_extra_args": ["--lifetime", f"{lifetime_s(slurm.walltime)}s", "--preload-nanny", deaths.MODULE],
        "security": security(settings.tls),
        "protocol": "tls://" if settings.tls else "tcp://",
        "name": "tract",
        "scheduler_options": {"interface": settings.interface, "dashboard_address": "127.0.0.1:0"},
    }


def _keep(cluster: Any, settings: ClusterSettings, ended: Event) -> None:
    """Replace jobs that have ended, and follow what is wanted, until the end.

    Whatever fails is tried again: without this thread, no job would follow another.
    """
    most, per_job = int(settings.workers or 1), settings.slurm.workers_per_job
    fewest = most if settings.min_workers is None else settings.min_workers
    busy_at = -_IDLE_S
    while not ended.is_set():
        try:
            if cluster.sync(partial(_has_clients, cluster)):
                busy_at = monotonic()
            wanted = most if monotonic() - busy_at < _IDLE_S else fewest
            ended_jobs = _ended_jobs({job.job_id for job in list(cluster.workers.values())} - {None})
            correct = partial(_correct, cluster, ceil(wanted / per_job), ended_jobs)
            cluster.sync(correct, callback_timeout=_CORRECT_S)
        except Exception as error:  # noqa: BLE001  of a command, or of the classes that call them
            _log.warning("SLURM jobs could not be looked after: %s", str(error) or repr(error))
        ended.wait(_LOOK_S)


async def _has_clients(cluster: Any) -> bool:
    return any(key != "fire-and-forget" for key in cluster.scheduler.clients)


async def _correct(cluster: Any, jobs: int, ended_jobs: set[str]) -> None:
    """Forget the jobs that have ended, and ask for as many as are wanted.

    The cluster itself cancels the job of a worker that it has not heard of for some time, and leaves its place empty
    until it is awaited.
    """
    lost = [name for name, job in cluster.workers.items() if job.job_id is None or job.job_id in ended_jobs]
    if lost:  # without a number: sbatch has refused it
        _log.warning("SLURM jobs have ended: %s", ", ".join(str(cluster.workers[name].job_id) for name in lost))
        await cluster.scale_down([name for name in lost if name in cluster.worker_spec])
    if len(cluster.worker_spec) != jobs:
        cluster.scale(jobs=jobs)
    await cluster


def lifetime_s(walltime: str) -> int:
    """Return how long (s) a worker takes tasks: it leaves in good order before SLURM ends its job.

    One that is killed with its job loses what it was doing.

    Examples
    --------
    >>> lifetime_s("01:00:00"), lifetime_s("10"), lifetime_s("2-0")
    (3480, 540, 172680)
    """
    days, dash, rest = walltime.rpartition("-")
    parts = [int(part) for part in rest.split(":")]
    if dash:
        hours, minutes, seconds = (*parts, 0, 0)[:3]
    else:
        hours, minutes, seconds = (0, *parts, 0)[:3] if len(parts) < 3 else parts
    total = ((int(days or 0) * 24 + hours) * 60 + minutes) * 60 + seconds
    return max(total - 120, total * 9 // 10)


def _ended_jobs(job_ids: set[str]) -> set[str]:
    """Return which of the jobs neither wait nor run any more."""
    states = "--states=PENDING,CONFIGURING,RUNNING,SUSPENDED"
    return job_ids - set(_ask(["squeue", "--noheader", "--format=%i", states]).split())


def _ask(command: list[str], said: str = "") -> str:
    """Return what a command of SLURM prints.

    Raises
    ------
    ClusterError
        Where it is missing, fails or takes too long.
    """
    try:
        return subprocess.run(command, input=said, capture_output=True, text=True, timeout=60, check=True).stdout
    except (OSError, subprocess.SubprocessError) as error:
        raise ClusterError(
            "SLURM refuses",
            " ".join(command),
            "a job that can be queued, on a machine on which SLURM's commands work",
            str(getattr(error, "stderr", "") or error).strip(),
            "Correct what it names in the cluster's settings",
        ) from error
