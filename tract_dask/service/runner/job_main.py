"""The process that does a job: it takes an order, and ends when it is told to.

The first line of standard input is the order. Then ``cancel`` ends the work in order; the end of standard input, which
means that the service is gone, ends it at once, with all that it has started. It listens before it imports anything
that takes time.
"""

from __future__ import annotations

import json
import os
import signal
import threading
from queue import SimpleQueue
from typing import Any

from ...cluster.child_processes import listen
from ...cluster.forkserver import uncollected
from ...errors import ExitCode


def main() -> int:
    """Do the order on standard input; return the exit code."""
    stream = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print is no record
    orders, main_thread = SimpleQueue[dict[str, Any]](), threading.get_ident()

    def take(line: str) -> None:
        if line.strip() == "cancel":
            signal.pthread_kill(main_thread, signal.SIGINT)
        else:
            orders.put(json.loads(line))

    listen(take, _end)
    try:
        with uncollected():
            from .job_work import carry_out
        return carry_out(orders.get(), stream)
    except KeyboardInterrupt:  # before the work had begun
        return ExitCode.INTERRUPTED


def _end() -> None:
    """End at once, with all that this process has started."""
    if os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


if __name__ == "__main__":
    os._exit(main())
