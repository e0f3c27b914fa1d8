"""The progress of a job as one record, kept up to date by the events of its run."""

from __future__ import annotations

from typing import Any

from ...progress import REPORT, STAGES, Event, ShardDone, StageDone, StageMeter, StageStarted
from ..jobs.records import utc_now

SHARES = {"convert": 0.3, "drift": 0.15, "sum": 0.15, "columns": 0.05, "fit": 0.3, REPORT: 0.05}
"""What part of a run's time each stage takes, about: from the stages' times in docs/performance.md."""


class Timeline:
    """A sink that keeps what is known of a job's stages.

    Parameters
    ----------
    before
        The stages' records as an earlier try left them: of a stage that it had finished, they are kept.

    Attributes
    ----------
    stage
        The one that began last; empty before the first.
    shards
        How many this try has finished.
    """

    def __init__(self, before: dict[str, Any]) -> None:
        self.stage, self.shards = "", 0
        self._before = before
        self._meters: dict[str, StageMeter] = {}
        self._times: dict[str, dict[str, str | None]] = {}

    def __call__(self, event: Event) -> None:
        """Take an event of the run."""
        match event:
            case StageStarted():
                self.stage = event.stage
                self._meters[event.stage] = StageMeter.start(event)
                self._times[event.stage] = {"started": utc_now(), "ended": None}
            case ShardDone():
                self._meters[event.stage].add(event)
                self.shards += 1
            case StageDone():
                self.stage = event.stage
                self._meters.setdefault(event.stage, StageMeter(event.stage)).finish(event)
                now = utc_now()
                self._times.setdefault(event.stage, {"started": now})["ended"] = now

    def to_record(self) -> dict[str, Any]:
        """Return the progress as a JSON-ready mapping; see :attr:`tract_dask.service.jobs.store.Job.progress`."""
        meter = self._meters.get(self.stage, StageMeter(self.stage))
        frames_per_s, fits_per_s = meter.recent_rates if meter.frames else (None, None)
        return {
            "stage": self.stage,
            "done_frames": meter.done_frames,
            "frames": meter.movie_frames,
            "passes": meter.passes,
            "fits": meter.fits,
            "frames_per_s": frames_per_s,
            "fits_per_s": fits_per_s,
            "seconds_left": self._seconds_left(),
            "fraction": sum(share * self._done_share(stage) for stage, share in SHARES.items()),
            "stages": {stage: self._stage_record(stage) for stage in (*STAGES, REPORT)},
        }

    def _stage_record(self, stage: str) -> dict[str, Any]:
        meter = self._meters.get(stage)
        before: dict[str, Any] = self._before.get(stage, {})
        if meter is not None and meter.reused and before.get("state") == "done":
            return before
        if meter is None:
            return {"state": "pending", "seconds": None, "started": None, "ended": None} | _EMPTY
        return {
            "state": "running" if meter.seconds is None else "reused" if meter.reused else "done",
            "seconds": meter.elapsed,
            **self._times[stage],
            "frames": meter.movie_frames,
            "done_frames": meter.done_frames,
            "summary": meter.summary,
        }

    def _done_share(self, stage: str) -> float:
        meter = self._meters.get(stage)
        if meter is None:
            return 0.0
        return 1.0 if meter.seconds is not None else meter.done / meter.frames if meter.frames else 0.0

    def _seconds_left(self) -> float | None:
        """Return the seconds until the run's end: of this stage as it goes, of the next ones as their shares say.

        None before the first shard of the first stage.
        """
        worked = {stage: meter for stage, meter in self._meters.items() if not meter.reused}
        spent = sum(meter.elapsed for meter in worked.values())
        share = sum(SHARES[stage] * self._new_share(meter) for stage, meter in worked.items())
        if not share:
            return None
        running = next((meter for meter in worked.values() if meter.seconds is None), None)
        own = running.seconds_left if running else 0.0
        to_come = sum(share for stage, share in SHARES.items() if stage not in self._meters)
        if running and own is None:
            own, to_come = 0.0, to_come + SHARES[running.stage]
        return (own or 0.0) + to_come * spent / share

    def _new_share(self, meter: StageMeter) -> float:
        """Return the part of a stage that this try has done."""
        if not meter.frames:
            return self._done_share(meter.stage)
        return (meter.done - meter.done_before) / meter.frames


_EMPTY = {"frames": 0, "done_frames": 0, "summary": ""}
