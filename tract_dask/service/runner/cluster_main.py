"""The process that holds the cluster of the service: it takes an order, and ends when its standard input does.

The first line of standard input is the order: the cluster's settings, its credentials where they are in memory only,
and the file that says where its scheduler is.
It listens before it imports anything that takes time.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from threading import Event
from typing import Any

from ...cluster.child_processes import listen
from ...cluster.forkserver import uncollected


def main() -> None:
    """Hold the cluster that the order describes, until standard input ends."""
    signal.signal(signal.SIGTERM, lambda *about: sys.exit())  # in good order: SLURM's jobs have to be cancelled
    order = json.loads(sys.stdin.readline())
    prepared, gone = Event(), Event()

    def end() -> None:
        gone.set()
        if not prepared.is_set():  # nothing has been started yet
            os._exit(1)

    listen(str, end)
    from ...errors import TractError

    try:
        _hold(order, prepared, gone)
    except TractError as error:
        sys.exit(str(error))


def _hold(order: dict[str, Any], prepared: Event, gone: Event) -> None:
    with uncollected():
        from ...cluster.connect import hold
        from ...settings.cluster import ClusterSettings
        from ...settings.toml import from_dict
        from ...store.files import write_aside

    settings, file = from_dict(ClusterSettings, order["settings"]), Path(order["file"])
    prepared.set()
    if gone.is_set():
        return
    with hold(settings, order["credentials"]) as cluster:
        about = {"type": "Scheduler", "address": cluster.scheduler_address, "dashboard": cluster.dashboard_link}
        write_aside(file, json.dumps(about).encode())
        gone.wait()


if __name__ == "__main__":
    main()
