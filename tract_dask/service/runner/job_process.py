"""One try of a job: the order for its process, what the process says, and what that makes of the job."""

from __future__ import annotations

import json
import logging
import sqlite3
import sys
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from threading import Event, Thread
from time import monotonic
from typing import Any

from ...cluster.child_processes import Child, how_ended
from ...errors import ClusterError, TractError
from ...progress import RunState
from ...readers.movie_files import FileList
from ...settings.cluster import ClusterSettings
from ...settings.toml import to_dict
from ..crashes import UnreachableError, crash_of, crashed, of_system
from ..data_root import DataRoot
from ..job_settings import inside
from ..jobs.records import Job, utc_now
from ..jobs.states import AFTER_RUN, State
from ..jobs.store import JobStore
from ..outputs import Mark, check_owner, seal
from .cluster_process import ClusterProcess

_log = logging.getLogger(__name__)

COMMAND = (sys.executable, "-m", f"{__package__}.job_main")
"""Starts a job's process."""

GRACE_S = 20.0
"""A process that is told to end is killed after so long."""

CLUSTER_S = 120.0
"""For so long a try waits for the cluster."""

MOST_LOST_TRIES = 10
"""After so many tries in a row whose cluster was lost before a shard was finished, the job has failed at the next."""

SHORTEST_BACKOFF_S, LONGEST_BACKOFF_S = 1.0, 300.0
"""The time before the first try again, which doubles with each more, and the longest: a quarter of an hour in all."""

_LOOK_S = 0.25
_WORKERS_S = 2.0
_LAST_LINES = 20


@dataclass
class ProcessReport:
    """What a try's process has said so far."""

    shards: int = 0
    outcome: dict[str, Any] | None = None
    error: str = ""
    lost: bool = False


@dataclass(frozen=True)
class Ending:
    """What becomes of a job after a try."""

    state: State
    reason: str
    fields: dict[str, Any] = field(default_factory=dict)


def ending(job: Job, report: ProcessReport, code: int, *, cancel_reason: str | None, stopping: bool) -> Ending:
    """Return what becomes of a job whose process has ended; a pure function but for the time of the next try.

    Parameters
    ----------
    code
        The exit code; negative for the signal that killed it. One of a crash ends the job: it would crash again.
    cancel_reason
        Why somebody cancelled it; None where nobody did.
    stopping
        Whether the service is about to end.
    """
    if report.outcome is not None and (cancel_reason is None or report.outcome["state"] != RunState.STOPPED):
        state = AFTER_RUN[report.outcome["state"]]
        fields = {} if state == State.WAITING else {"outcome": report.outcome}
        reason = "the columns can be looked at" if state == State.WAITING else ""
        return Ending(state, reason, fields | {"lost_tries": 0})
    if cancel_reason is not None:
        return Ending(State.CANCELLED, cancel_reason)
    if stopping:
        return Ending(State.QUEUED, "the service was stopped")
    if report.error and not report.lost:
        return Ending(State.FAILED, report.error)
    if not report.error and (sign := crash_of(code)):
        return Ending(State.FAILED, str(crashed(job.source, sign)))
    why = report.error or f"the job's process has ended: {how_ended(code)}"
    return after_loss(job, why, progressed=report.shards > 0)


def after_loss(job: Job, reason: str, *, progressed: bool) -> Ending:
    """Return what becomes of a job whose cluster or process was lost: it is tried again, not too soon nor too often."""
    lost = 1 if progressed else job.lost_tries + 1
    if lost > MOST_LOST_TRIES:
        return Ending(State.FAILED, f"{reason.rstrip('.')}; it was lost {lost} times without getting any further")
    backoff = min(SHORTEST_BACKOFF_S * 2 ** (lost - 1), LONGEST_BACKOFF_S)
    return Ending(State.QUEUED, reason, {"lost_tries": lost, "not_before": utc_now(later_s=backoff)})


class JobProcess(Thread):
    """A thread that sees a job through one try, from RUNNING to whatever comes then.

    Parameters
    ----------
    job
        As it is after the change to RUNNING.
    stopping
        Set where the service is about to end.
    done
        Called at the end.
    """

    def __init__(
        self,
        job: Job,
        store: JobStore,
        root: DataRoot,
        cluster: ClusterProcess,
        stopping: Event,
        done: Callable[[], object],
    ) -> None:
        super().__init__(name=f"job {job.id}", daemon=True)
        self._job, self._store, self._root, self._cluster = job, store, root, cluster
        self._stopping, self._done = stopping, done
        self._mark, self._report = Mark(job.owner, job.id, job.output), ProcessReport()
        self._asked_at: float | None = None

    def run(self) -> None:
        """See the job through."""
        try:
            end = self._try()
        except (ClusterError, sqlite3.Error) as error:  # the store's disk may be full, or slow
            end = self._lost(str(error))
        except (TractError, OSError) as error:
            found = of_system(error) or error
            passes = isinstance(found, UnreachableError)
            end = self._lost(str(found)) if passes else Ending(State.FAILED, str(found))
        except Exception as error:  # noqa: BLE001  the last resort: no job may stay behind as running
            _log.exception("job %s", self._job.id)
            end = Ending(State.FAILED, f"unexpected {type(error).__name__}: {error}")
        end = replace(end, reason=self._root.shown(end.reason))
        if end.reason and end.state in (State.QUEUED, State.FAILED):
            self._store.log(self._job.id, "error" if end.state == State.FAILED else "warning", end.reason)
        self._store.change(self._job.id, end.state, end.reason, **end.fields)
        self._store.close()
        self._done()

    def _try(self) -> Ending:
        """Run the process, and follow it to its end."""
        order, last_lines = self._order(), deque[str](maxlen=_LAST_LINES)
        child = Child(COMMAND, last_lines.append, talks=True)
        try:
            cluster = self._running_cluster()  # while the process imports what it needs
            if cluster is None:
                return self._ending(0)
            where = {"cluster": to_dict(cluster), "credentials": self._cluster.credentials}
            child.tell(json.dumps(order | where))
            self._follow(child)
            child.end(GRACE_S)  # it has said its last
        finally:
            code = child.end()
            seal(self._root, self._mark)
        if code and self._report.outcome is None and not self._is_ending():
            for line in last_lines:
                self._store.log(self._job.id, "error", self._root.shown(line))
        return self._ending(code)

    def _order(self) -> dict[str, Any]:
        """Return the order for the process, but for the cluster; its paths are checked once more.

        A movie that is not there is the run's to judge: it may be converted already.
        """
        job, place = self._job, self._root.source(self._job.source, must_exist=False)
        check_owner(self._root, self._mark)
        version = job.columns_version
        columns = None if version is None else self._store.columns(job.id, version) if version else ""
        return {
            "job": job.id,
            "source": str(place),
            "files": list(map(str, place.files)) if isinstance(place, FileList) else None,
            "output": str(self._root.path / job.output),
            "root": str(self._root.path),
            "closed": list(map(str, self._root.permit.closed)),
            "mark": asdict(self._mark),
            "content": job.content,
            "settings": inside(self._root, job.settings),
            "columns": columns,
            "until": "columns" if job.curate and version is None else None,
            "stages": job.progress.get("stages", {}),
        }

    def _running_cluster(self) -> ClusterSettings | None:
        """Return the running cluster; None where the try is to end meanwhile.

        Raises
        ------
        ClusterError
            Where it does not come up in time.
        """
        deadline = monotonic() + CLUSTER_S
        while not self._is_ending():
            try:
                return self._cluster.ready(timeout_s=1.0)
            except ClusterError:
                if monotonic() > deadline:
                    raise
                self._stopping.wait(_LOOK_S)
        return None

    def _follow(self, child: Child) -> None:
        """Take what the process says until it says no more; tell it to end where that is wanted."""
        looked = 0.0
        for line in child.lines(_LOOK_S):
            with suppress(ValueError):  # nothing; or the torn last line of a process that was killed
                self._take(json.loads(line))
            if self._asked_at is None and self._is_ending():
                self._asked_at = monotonic()
                child.tell("cancel")
            if self._asked_at is not None and monotonic() - self._asked_at > GRACE_S:
                child.end()
            if monotonic() - looked > _WORKERS_S:
                looked = monotonic()
                seen = {"workers": self._cluster.workers(), "dashboard": self._cluster.dashboard() is not None}
                self._store.workers(self._job.id, seen)

    def _take(self, record: dict[str, Any]) -> None:
        """Note what the process says; paths of the data root end here."""
        record, job_id = self._root.shown(record), self._job.id
        match record["kind"]:
            case "stage":
                self._store.stage(job_id, record["stage"])
            case "progress":
                self._report.shards = record["shards"]
                self._store.progress(job_id, record["data"])
            case "log":
                self._store.log(job_id, record["level"], record["message"])
            case "outcome":
                self._report.outcome = {name: value for name, value in record.items() if name != "kind"}
            case "error":
                self._report.error, self._report.lost = record["text"], record["lost"]

    def _is_ending(self) -> bool:
        return self._stopping.is_set() or self._store.cancel_requested(self._job.id)

    def _lost(self, why: str) -> Ending:
        self._report.error, self._report.lost = why, True
        return self._ending(1)

    def _ending(self, code: int) -> Ending:
        reason = self._store.cancel_reason(self._job.id)
        return ending(self._job, self._report, code, cancel_reason=reason, stopping=self._stopping.is_set())
