"""The cluster that all jobs share: a process of its own that holds it, and what can be seen of its workers.

The service and every job's process are clients of that cluster, and find it by a scheduler file. The process that holds
it (:mod:`.cluster_main`) ends when its standard input does, so that a killed service leaves nothing behind; where it
dies, it is started again. A cluster that somebody else runs (kind address) needs no process, and is only looked at.
"""

from __future__ import annotations

import asyncio
import json
import logging
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from threading import Event, Thread
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

from distributed.core import rpc
from distributed.utils import key_split

from ...cluster.child_processes import Supervised
from ...cluster.connect import scheduler_address
from ...cluster.tls import checked_address, in_memory, security, temporary_credentials, web_context
from ...errors import ClusterError
from ...settings.cluster import ClusterSettings
from ...settings.toml import to_dict

_log = logging.getLogger(__name__)

_MAIN = f"{__package__}.cluster_main"
_LOOK_S = 1.0
_ANSWER_S = 5.0
_STALE_S = 30.0
_STOP_S = 20.0


class ClusterProcess:
    """Keeps a cluster running, and looks at its workers once a second; safe to use from any thread.

    Parameters
    ----------
    settings
        Of the cluster.
    folder
        Where the scheduler file is written.

    Attributes
    ----------
    credentials
        With which to speak to a local cluster without certificates of its own; in memory only. None for all others.
    """

    def __init__(self, settings: ClusterSettings, folder: Path) -> None:
        self._settings, self._file = settings, folder / "scheduler.json"
        self._is_ours = settings.resolved_kind != "address"
        is_local = settings.resolved_kind == "local" and settings.tls is None
        self.credentials = temporary_credentials() if is_local else None
        self._process: Supervised | None = None
        self._looking: Thread | None = None
        self._ending = Event()
        self._seen: tuple[float, list[dict[str, Any]], str | None] = (-_STALE_S, [], None)

    def start(self) -> None:
        """Start the process that holds the cluster, where one is needed, and begin to look."""
        self._file.parent.mkdir(parents=True, exist_ok=True)
        self._ending.clear()
        if self._is_ours:
            order = {
                "settings": to_dict(self._settings),
                "file": str(self._file.absolute()),
                "credentials": self.credentials,
            }
            forget = partial(self._file.unlink, missing_ok=True)
            self._process = Supervised("the cluster", [sys.executable, "-m", _MAIN], json.dumps(order), forget)
        self._looking = Thread(target=self._look, name="cluster", daemon=True)
        self._looking.start()

    def stop(self) -> None:
        """End the process and its workers; returns when they are gone."""
        self._ending.set()
        if self._process is not None:
            self._process.stop(_STOP_S)
        if self._looking is not None:
            self._looking.join()

    def ready(self, timeout_s: float) -> ClusterSettings:
        """Return settings with which a job finds the running cluster.

        Raises
        ------
        ClusterError
            Where it is not up within ``timeout_s``, with what its process said last.
        """
        if not self._is_ours:
            checked_address(scheduler_address(self._settings), self._settings.tls)
            return self._settings
        process = self._process
        deadline = monotonic() + timeout_s
        while not (process and process.is_alive() and self._file.exists()):
            if monotonic() > deadline or self._ending.is_set():
                raise ClusterError(
                    "the cluster is not up",
                    f"kind {self._settings.resolved_kind}",
                    f"a scheduler within {timeout_s:g} s",
                    (process and process.problem) or "none yet",
                    "See what it says; it is started again by itself",
                )
            self._ending.wait(0.05)
        return ClusterSettings(
            kind="address",
            scheduler_file=str(self._file.absolute()),
            tls=self._settings.tls,
            patience_s=self._settings.resolved_patience_s,
        )

    def dashboard(self) -> str | None:
        """Return the address of the Dask dashboard as seen from this machine, such as http://127.0.0.1:8787."""
        seen, _, dashboard = self._seen
        return dashboard if monotonic() - seen < _STALE_S else None

    def workers(self) -> list[dict[str, Any]]:
        """Return what each worker does: name, address, cpu (%), memory and memory_limit (bytes), executing, stage.

        As it was seen last; empty where the scheduler has not answered for some seconds.
        """
        seen, workers, _ = self._seen
        return workers if monotonic() - seen < _STALE_S else []

    def _look(self) -> None:
        asyncio.run(self._look_on())

    async def _look_on(self) -> None:
        """Ask the scheduler each second; whatever goes wrong, ask again."""
        while not self._ending.is_set():
            try:
                await self._look_at(scheduler_address(self._target()))
            except Exception as error:  # noqa: BLE001  not up, or gone, or not to be understood: the next one may be
                _log.debug("the scheduler does not answer: %s", error)
            await asyncio.sleep(_LOOK_S)

    def _target(self) -> ClusterSettings:
        if not self._is_ours:
            return self._settings
        return ClusterSettings(scheduler_file=str(self._file), tls=self._settings.tls)

    async def _look_at(self, address: str) -> None:
        used = in_memory(self.credentials) if self.credentials else security(self._settings.tls)
        address = address if self.credentials else checked_address(address, self._settings.tls)
        arguments = used.get_connection_args("client") if used else {}
        async with rpc(address, connection_args=arguments, timeout=_ANSWER_S) as scheduler:
            dashboard: str | None = None
            while not self._ending.is_set():
                async with asyncio.timeout(_ANSWER_S):
                    identity = await scheduler.identity(n_workers=-1)
                    processing = await scheduler.processing()
                workers = [
                    _worker(where, about, processing.get(where, ())) for where, about in identity["workers"].items()
                ]
                if dashboard is None and (port := identity["services"].get("dashboard")):
                    host = "127.0.0.1" if self._is_ours else str(urlsplit(address).hostname)
                    dashboard = await self._dashboard_at(host, port)
                self._seen = (monotonic(), workers, dashboard)
                await asyncio.sleep(_LOOK_S)

    async def _dashboard_at(self, host: str, port: int) -> str:
        """Return the address of the dashboard: that of a scheduler with certificates may be encrypted as well."""
        scheme = "http"
        if context := web_context(self._settings.tls):
            with suppress(OSError):  # it speaks no TLS, or shows another certificate
                async with asyncio.timeout(_ANSWER_S):
                    _, writer = await asyncio.open_connection(host, port, ssl=context)
                    writer.close()
                    scheme = "https"
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}"


def _worker(address: str, about: dict[str, Any], tasks: Any) -> dict[str, Any]:
    """Return what is told of a worker, from what the scheduler says of it and the keys of its tasks."""
    metrics = about.get("metrics", {})
    return {
        "name": str(about.get("name", address)),
        "address": address,
        "cpu": float(metrics.get("cpu", 0.0)),
        "memory": int(metrics.get("memory", 0)),
        "memory_limit": int(about.get("memory_limit") or 0),
        "executing": int(metrics.get("task_counts", {}).get("executing", 0)),
        "stage": next((key_split(key) for key in tasks), ""),
    }
