"""A Dask client from nothing, an address, SLURM or ssh, and whether its workers are fit for the work."""

from __future__ import annotations

import importlib.metadata
import json
import logging
import shlex
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import dask
from distributed import Client, LocalCluster

from ..errors import ClusterError, SettingsError
from ..settings.cluster import ClusterSettings
from . import dashboard, deaths, forkserver
from .crew import PATIENCE, patience_s
from .memory import local_memory_limit, local_workers, memory_limit
from .tls import Credentials, checked_address, in_memory, security, temporary_credentials, worker_flags

PACKAGE = "tract_dask"

_NANNY_ENVIRONMENT = "distributed.nanny.pre-spawn-environ"
_LOST_WORKER = "distributed.deploy.lost-worker-timeout"
_PROCESS_METHOD = "distributed.worker.multiprocessing-method"

_TOLD_OF_DEATHS = {"distributed.scheduler.allowed-failures": 0, "distributed.nanny.preload": [deaths.MODULE]}
"""How a cluster is configured that reports each death of a worker: the loop over shards judges them itself."""


@contextmanager
def connect(settings: ClusterSettings | None = None, *, timeout_s: float = 10.0) -> Iterator[Client]:
    """Yield a client of the cluster that ``settings`` name: a local one by default, which ends with the block.

    Scripts that use the local cluster need the usual ``if __name__ == "__main__":`` guard, since workers import them.

    Raises
    ------
    ClusterError
        Where the scheduler does not answer within ``timeout_s``, or the local cluster does not come up.
    SettingsError
        Where both an address and a scheduler file are given, or the memory limit is no size.
    """
    settings = settings or ClusterSettings()
    if settings.scheduler and settings.scheduler_file:
        raise SettingsError(
            "two schedulers are given",
            "settings scheduler and scheduler_file (ClusterSettings)",
            "one of them",
            f"{settings.scheduler} and {settings.scheduler_file}",
            "Leave one out",
        )
    if settings.resolved_kind == "address":
        with _remote(settings, timeout_s) as client:
            yield client
    else:
        with hold(settings) as cluster, Client(cluster) as client:
            yield client


@contextmanager
def hold(settings: ClusterSettings, credentials: Credentials | None = None) -> Iterator[Any]:
    """Yield a running cluster (:class:`distributed.deploy.Cluster`) of any kind but address; it ends with the block.

    Parameters
    ----------
    credentials
        For a local cluster without certificates, instead of new ones.

    Raises
    ------
    ClusterError
        Where it does not come up.
    """
    with dask.config.set(_TOLD_OF_DEATHS):
        if settings.resolved_kind == "slurm":
            from .slurm import hold_slurm  # an extra

            with hold_slurm(settings, memory_limit(settings)) as cluster:
                yield cluster
        elif settings.resolved_kind == "ssh":
            from .ssh import hold_ssh

            with hold_ssh(settings, memory_limit(settings)) as cluster:
                yield cluster
        else:
            with _hold_local(settings, credentials) as cluster:
                yield cluster


class LazyClient:
    """A client that is made at its first use, so that a run with nothing to do starts no cluster.

    Parameters
    ----------
    settings
        Of the cluster to connect to.
    client
        A client to use instead; it is left open.
    on_connect
        Called once with the checked client, before it is used; may refuse it by raising.
    """

    def __init__(
        self,
        settings: ClusterSettings | None = None,
        client: Client | None = None,
        on_connect: Callable[[Client], None] = lambda client: None,
    ) -> None:
        self._settings, self._given, self._on_connect = settings or ClusterSettings(), client, on_connect
        if client is None and self._settings.resolved_kind == "local":
            forkserver.start()  # it imports while this process prepares the work
        self._stack = ExitStack()
        self._client: Client | None = None

    def close(self) -> None:
        """Close the client and its local cluster, if they were made here."""
        self._client = None
        self._stack.close()

    def __call__(self) -> Client:
        """Return the client; connect and check the workers if this is its first use.

        Raises
        ------
        ClusterError
            As :func:`connect` and :func:`check_workers`.
        """
        if self._client is None:
            client = self._given
            if client is None:
                self._stack.enter_context(dask.config.set({PATIENCE: self._settings.resolved_patience_s}))
                client = self._stack.enter_context(connect(self._settings))
            check_workers(client, timeout_s=patience_s())
            self._on_connect(client)
            self._client = client
        return self._client


def check_workers(client: Client, *, timeout_s: float = 60.0) -> None:
    """Check that the cluster has workers, and that each has this version of the package.

    Raises
    ------
    ClusterError
        Where no worker appears within ``timeout_s``, or one lacks the package or has another version of it.
    """
    address = client.scheduler.address
    try:
        client.wait_for_workers(1, timeout=timeout_s)
    except TimeoutError as error:
        raise ClusterError(
            "the scheduler has no workers",
            address,
            "one worker or more",
            f"none within {timeout_s:g} s",
            f"Start some with: {shlex.join(['dask', 'worker', address, *worker_flags(client.security)])}",
        ) from error
    expected = importlib.metadata.version(PACKAGE)
    found: dict[str, Any] = client.run(importlib.metadata.version, PACKAGE, on_error="return")
    for worker, version in sorted(found.items()):
        if version != expected:
            missing = isinstance(version, importlib.metadata.PackageNotFoundError)
            raise ClusterError(
                f"a worker lacks {PACKAGE}" if missing else f"a worker has another {PACKAGE}",
                worker,
                f"{PACKAGE} {expected}",
                "none" if missing else str(version),
                f"Install {PACKAGE} {expected} in the worker's environment and start it again",
            )


@contextmanager
def _hold_local(settings: ClusterSettings, credentials: Credentials | None) -> Iterator[LocalCluster]:
    """Start workers of one thread each, if not set otherwise, whose libraries use one thread each.

    What listens speaks TLS: the loopback is open to every user of the machine, and Dask runs what it is sent.
    """
    changes: dict[str, Any] = {
        _NANNY_ENVIRONMENT: dict(dask.config.get(_NANNY_ENVIRONMENT)) | forkserver.ENVIRONMENT,
        _LOST_WORKER: "1000 days",  # its nanny starts another; one that died twice in 15 s would not be replaced
    }
    if forkserver.AVAILABLE:
        changes[_PROCESS_METHOD] = "forkserver"
    forkserver.start()
    with dask.config.set(changes), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Port .* is already in use")
        try:
            cluster = LocalCluster(
                n_workers=local_workers(settings),
                threads_per_worker=settings.threads,
                memory_limit=local_memory_limit(settings),
                processes=True,
                protocol="tls://",
                security=security(settings.tls) or in_memory(credentials or temporary_credentials()),
                local_directory=settings.local_directory,
                dashboard_address="127.0.0.1:8787",
                scheduler_kwargs=dashboard.LATER,
                silence_logs=logging.CRITICAL,
            )
        except RuntimeError as error:
            raise ClusterError(
                "the local cluster cannot start its workers",
                "this machine",
                f"{local_workers(settings)} worker processes",
                str(error),
                'In a script, put what is run under if __name__ == "__main__": since workers import the script; '
                "otherwise look at what the workers wrote above, and whether the memory limit is too small",
            ) from error
        with cluster:
            dashboard.open_on_request(cluster)
            yield cluster


@contextmanager
def _remote(settings: ClusterSettings, timeout_s: float) -> Iterator[Client]:
    where = settings.scheduler or str(settings.scheduler_file)
    address = checked_address(scheduler_address(settings), settings.tls)
    try:
        client = Client(address, timeout=timeout_s, security=security(settings.tls))
    except (OSError, ValueError, TypeError) as error:  # TimeoutError is an OSError; the others mean a malformed address
        raise ClusterError(
            "the scheduler cannot be reached",
            where,
            f"an answer within {timeout_s:g} s",
            " ".join(str(error).split()) or type(error).__name__,
            "Check that it runs (dask scheduler) and that this machine can reach it, or leave it out to work locally",
        ) from error
    with client:
        yield client


def scheduler_address(settings: ClusterSettings) -> str:
    """Return the address of the scheduler that the settings name, or that its file holds.

    Raises
    ------
    ClusterError
        Where the file cannot be used.
    """
    if settings.scheduler:
        return settings.scheduler
    name = str(settings.scheduler_file)
    try:
        return str(json.loads(Path(name).read_text(encoding="utf-8"))["address"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ClusterError(
            "the scheduler file cannot be used",
            name,
            "the JSON file that dask scheduler --scheduler-file writes",
            str(error),
            "Check its path, and that the scheduler has started",
        ) from error
