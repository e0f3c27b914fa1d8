"""Times as the store writes them: UTC, ISO 8601 with milliseconds, so that the texts sort as the times do."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta


def utc_now(later_s: float = 0.0) -> str:
    """Return the time now, or ``later_s`` seconds later.

    Examples
    --------
    >>> len(utc_now()) == len("2026-01-31T12:00:00.000Z"), utc_now() < utc_now(later_s=1.0)
    (True, True)
    """
    time = datetime.now(UTC) + timedelta(seconds=later_s)
    return time.isoformat(timespec="milliseconds").replace("+00:00", "Z")
