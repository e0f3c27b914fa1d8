"""The service's figures for Prometheus.

What the jobs are is read from the store when the figures are asked for. Counters begin at zero with the process, as
those of Prometheus may; the store knows what every job has done. Routes are counted by their templates, so that there
are as many series as routes, whatever is asked for.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from threading import Lock
from typing import Any

import prometheus_client
from prometheus_client import CollectorRegistry, Histogram, PlatformCollector, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..progress import REPORT, STAGES
from .event_streams import EventStreams
from .jobs.records import Job, utc_now
from .jobs.states import ENDED, State
from .jobs.store import JobStore

_BUCKETS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
_ENDLESS = "/events"
_API = "/api/v1"
_MOST = 10_000


class Metrics:
    """The registry of a service, and what counts its requests.

    Parameters
    ----------
    store
        Of the jobs.
    streams
        Of the streams.
    """

    def __init__(self, store: JobStore, streams: EventStreams) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        PlatformCollector(registry=self.registry)
        self.registry.register(JobFigures(store, streams))
        self.latency = Histogram(
            "tract_dask_request_seconds",
            "Time from a request to the end of its answer; streams of events are left out.",
            ("method", "route"),
            buckets=_BUCKETS,
            registry=self.registry,
        )
        self.answers = prometheus_client.Counter(
            "tract_dask_requests", "Requests answered.", ("method", "route", "status"), registry=self.registry
        )

    def text(self) -> bytes:
        """Return all figures in Prometheus' text format."""
        return generate_latest(self.registry)


class CountRequests:
    """Counts requests, and how long they take, by the template of their route."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self.app, self.metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and count it."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        begun, status = time.perf_counter(), 500

        async def noticed(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self.app(scope, receive, noticed)
        finally:
            method, route = _method(scope["method"]), _template(scope)
            self.metrics.answers.labels(method, route, str(status)).inc()
            if not route.endswith(_ENDLESS):
                self.metrics.latency.labels(method, route).observe(time.perf_counter() - begun)


@dataclass(frozen=True)
class _Done:
    """What a job had done when it was looked at: its fit, by when that began, and when its other stages ended."""

    fit_started: str = ""
    frames: int = 0
    fits: int = 0
    ended: dict[str, str] = field(default_factory=dict)


class JobFigures:
    """Reads what the jobs are, and what they have done since it was last asked, from the store."""

    def __init__(self, store: JobStore, streams: EventStreams) -> None:
        self._store, self._streams = store, streams
        self._lock = Lock()
        self._begun = self._asked = utc_now()
        self._seen: dict[str, _Done] = {}
        self._totals: Counter[str] = Counter()
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._stages: Counter[str] = Counter()

    def collect(self) -> Iterable[Metric]:
        """Yield the figures."""
        with self._lock:
            counts = self._store.counts()
            self._look()
        jobs = GaugeMetricFamily("tract_dask_jobs", "Jobs by state.", labels=("state",))
        for state in State:
            jobs.add_metric((str(state),), counts[state])
        seconds = CounterMetricFamily("tract_dask_stage_seconds", "Time that finished stages took.", labels=("stage",))
        stages = CounterMetricFamily("tract_dask_stages", "Stages that were finished.", labels=("stage",))
        for stage in (*STAGES, REPORT):
            seconds.add_metric((stage,), self._seconds[stage])
            stages.add_metric((stage,), self._stages[stage])
        yield from (jobs, seconds, stages)
        yield GaugeMetricFamily("tract_dask_queue_length", "Jobs in the queue.", counts[State.QUEUED])
        yield GaugeMetricFamily("tract_dask_event_streams", "Streams of events that are open.", len(self._streams))
        yield CounterMetricFamily(
            "tract_dask_frames",
            "Frames whose columns were fitted; those of a resumed fit again.",
            self._totals["frames"],
        )
        yield CounterMetricFamily("tract_dask_fits", "Fits that were made.", self._totals["fits"])

    def describe(self) -> Iterable[Metric]:
        """Name no figures beforehand, so that registering reads nothing."""
        return ()

    def _look(self) -> None:
        """Add what jobs have done since the last look: those that have not ended, and those that ended in between."""
        now = utc_now()
        seen: dict[str, _Done] = {}
        for job in (*self._store.jobs(states=tuple(set(State) - ENDED), limit=_MOST), *self._ended_since(self._asked)):
            before, done = self._seen.get(job.id, _Done()), _done(job)
            if done.fit_started >= self._begun:
                same_fit = done.fit_started == before.fit_started
                self._totals["frames"] += max(0, done.frames - (before.frames if same_fit else 0))
                self._totals["fits"] += max(0, done.fits - (before.fits if same_fit else 0))
            for stage, ended in done.ended.items():
                if ended >= self._begun and before.ended.get(stage) != ended:
                    self._seconds[stage] += job.progress["stages"][stage]["seconds"] or 0.0
                    self._stages[stage] += 1
            seen[job.id] = done
        self._seen, self._asked = seen, now

    def _ended_since(self, moment: str) -> list[Job]:
        rows = self._store.connection().execute("SELECT id FROM jobs WHERE ended >= ?", (moment,)).fetchall()
        return [self._store.job(row["id"]) for row in rows]


def _done(job: Job) -> _Done:
    stages: dict[str, dict[str, Any]] = job.progress.get("stages", {})
    fit = stages.get("fit", {})
    of_stage = job.progress.get("fits") if job.progress.get("stage") == "fit" else job.outcome.get("fits")
    ended = {name: about["ended"] for name, about in stages.items() if about["state"] == "done" and about["ended"]}
    if fit.get("state") not in ("running", "done"):
        return _Done(ended=ended)
    return _Done(fit["started"] or "", fit["done_frames"], of_stage or 0, ended)


def _method(method: str) -> str:
    return method if method in ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS") else "other"


def _template(scope: Scope) -> str:
    """Return the template of the route that took the request, with its prefix; one name for all that none took."""
    path = getattr(scope.get("route"), "path_format", None)
    if not isinstance(path, str):
        return "/static" if scope["path"].startswith("/static/") else "none"
    prefix = _API if scope["path"].startswith(f"{_API}/") and not path.startswith(_API) else ""
    return prefix + path
