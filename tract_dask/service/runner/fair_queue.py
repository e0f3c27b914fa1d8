"""Who is next: jobs take turns among their owners."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from ..jobs.records import Job


def next_job(queued: Sequence[Job], running: Sequence[Job], served: Mapping[str, str], now: str) -> Job | None:
    """Return the job to start next; None where none may start yet. A pure function.

    The owner with the fewest running jobs comes first; among equals the one who has waited longest, since a job of
    theirs was last started or, if later, since they submitted the oldest of those that wait; of an owner's jobs the
    oldest. So each owner who waits is passed over at most once by every other, however many come and submit.

    Parameters
    ----------
    queued, running
        The jobs in these states.
    served
        When a job of each owner was last started (:meth:`tract_dask.service.jobs.store.JobStore.served`).
    now
        Jobs that are not to be tried before a later time are left out.
    """
    ready = [job for job in queued if (job.not_before or "") <= now]
    busy = Counter(job.owner for job in running)
    oldest: dict[str, Job] = {}
    for job in sorted(ready, key=lambda job: job.number):
        oldest.setdefault(job.owner, job)

    def turn(job: Job) -> tuple[int, str, int]:
        return busy[job.owner], max(served.get(job.owner, ""), job.created), job.number

    return min(oldest.values(), key=turn, default=None)
