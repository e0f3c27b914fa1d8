"""Workers on machines that are reached by ssh: a scheduler here, a ``dask worker`` on each machine, kept running.

The program ``ssh`` is used as it is, with the user's own ``~/.ssh/config``, keys, agent and known hosts.
"""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from time import monotonic, sleep

from distributed import LocalCluster
from distributed.utils import get_ip, get_ip_interface

from ..errors import ClusterError, SettingsError
from ..settings.cluster import ClusterSettings
from . import deaths, forkserver
from .child_processes import Supervised
from .tls import security, worker_flags

_START_S, _STOP_S = 60.0, 5.0
_SSH = ("ssh", "-T", "-o", "BatchMode=yes", "-o", "ConnectTimeout=15", "-o", "ServerAliveInterval=15")


@contextmanager
def hold_ssh(settings: ClusterSettings, memory_limit: int | None) -> Iterator[LocalCluster]:
    """Yield a cluster whose scheduler is in this process and whose workers are on the hosts of ``settings.ssh``.

    Where ssh or the workers of a host end, they are started again. Workers end with the scheduler.

    Parameters
    ----------
    memory_limit
        Of a worker, in bytes; None: its share of its machine.

    Raises
    ------
    ClusterError
        Where no host starts a worker, with what ssh said.
    """
    used = security(settings.tls)
    with LocalCluster(
        n_workers=0,
        host=_own_address(settings.interface),
        protocol="tls://" if used else "tcp://",
        security=used,
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    ) as cluster:
        command = _worker_command(cluster.scheduler_address, settings, memory_limit, worker_flags(used))
        commands = {host: shlex.join([*command, "--name", host]) for host in settings.ssh.hosts}
        line = [*_SSH, *settings.ssh.options, "--"]
        processes = {host: Supervised(f"dask worker on {host}", [*line, host, commands[host]]) for host in commands}
        try:
            _wait_for_one(cluster, processes)
            yield cluster
        finally:
            for process in processes.values():
                process.let_end()
            cluster.close()  # workers end with the scheduler, and ssh with them
            for process in processes.values():
                process.stop(_STOP_S)


def _worker_command(address: str, settings: ClusterSettings, memory_limit: int | None, flags: list[str]) -> list[str]:
    """Return the command that starts the workers of a host."""
    scratch = ["--local-directory", settings.local_directory] if settings.local_directory else []
    return [
        "env",
        *(f"{name}={value}" for name, value in forkserver.ENVIRONMENT.items()),
        settings.python or sys.executable,
        "-m",
        "distributed.cli.dask_worker",
        address,
        "--nworkers",
        str(settings.workers or "auto"),
        "--nthreads",
        str(settings.threads),
        "--memory-limit",
        str(memory_limit or "auto"),
        "--death-timeout",
        "60",
        "--no-dashboard",
        "--preload-nanny",
        deaths.MODULE,
        *scratch,
        *flags,
    ]


def _wait_for_one(cluster: LocalCluster, processes: dict[str, Supervised]) -> None:
    """Wait until a worker is there; give up where every host has failed, or none has answered in time."""
    deadline = monotonic() + _START_S
    while not cluster.scheduler_info["workers"]:
        if all(process.problem for process in processes.values()) or monotonic() > deadline:
            raise ClusterError(
                "no host starts a worker",
                ", ".join(processes),
                f"a worker within {_START_S:g} s",
                "; ".join(f"{host}: {process.problem or 'no answer'}" for host, process in processes.items()),
                "Check that ssh reaches the hosts without a password, and that the interpreter is there",
            )
        sleep(0.1)


def _own_address(interface: str | None) -> str:
    """Return the address on which the scheduler listens: that of an interface, or of the way to other machines."""
    if interface is None:
        return str(get_ip())
    try:
        return str(get_ip_interface(interface))
    except ValueError as error:
        raise SettingsError(
            "there is no such network interface",
            "setting interface (ClusterSettings)",
            "one of this machine with an IPv4 address",
            interface,
            str(error),
        ) from error
