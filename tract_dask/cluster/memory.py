"""The memory of workers: the limit of each, as set or as its share of the machine, and what one task may use of it."""

from __future__ import annotations

from dask.system import CPU_COUNT
from dask.utils import parse_bytes
from distributed import Client
from distributed.system import MEMORY_LIMIT

from ..errors import SettingsError
from ..settings.cluster import ClusterSettings


def memory_budget(client: Client) -> int | None:
    """Return the bytes that one task may use: the smallest memory limit of a worker, shared among its threads.

    None where no worker has a limit.
    """
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    shares = [worker["memory_limit"] // max(1, worker["nthreads"]) for worker in workers if worker["memory_limit"]]
    return min(shares, default=None)


def local_workers(settings: ClusterSettings) -> int:
    """Return how many workers the local cluster has: as many as set, or one a core."""
    return settings.workers or int(CPU_COUNT)


def local_memory_limit(settings: ClusterSettings) -> int:
    """Return the memory limit of a local worker in bytes: as set, or its share of the machine.

    Raises
    ------
    SettingsError
        Where the setting is no size.

    Examples
    --------
    >>> local_memory_limit(ClusterSettings(memory_limit="2GB"))
    2000000000
    """
    return memory_limit(settings) or int(MEMORY_LIMIT) // local_workers(settings)


def memory_limit(settings: ClusterSettings) -> int | None:
    """Return the memory limit of a worker in bytes as set; None where it is not.

    Raises
    ------
    SettingsError
        Where the setting is no size.
    """
    if settings.memory_limit is None:
        return None
    try:
        return int(parse_bytes(settings.memory_limit))
    except ValueError as error:
        raise SettingsError(
            "the memory limit is not a size",
            "setting memory_limit (ClusterSettings)",
            "a number with a unit, such as 2GB or 500MiB",
            repr(settings.memory_limit),
            "Correct it",
        ) from error
