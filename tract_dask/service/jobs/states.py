"""The states of a job, and which follows which."""

from __future__ import annotations

from enum import StrEnum

from ...progress import RunState


class State(StrEnum):
    """Where a job is."""

    QUEUED = "queued"
    RUNNING = "running"
    WAITING = "waiting_for_columns"
    DONE = "done"
    DONE_WITH_FAILED_FRAMES = "done_with_failed_frames"
    FAILED = "failed"
    CANCELLED = "cancelled"


ENDED = frozenset({State.DONE, State.DONE_WITH_FAILED_FRAMES, State.FAILED, State.CANCELLED})
"""Nothing more happens to such a job unless somebody asks for it."""

RETRYABLE = frozenset({State.FAILED, State.CANCELLED, State.DONE_WITH_FAILED_FRAMES})
"""Another try may end otherwise."""

AT_REST = ENDED | {State.WAITING}
"""A job stays in such a state until somebody does something."""

CURATABLE = AT_REST
"""Such a job can go on with a version of its columns."""

AFTER_RUN = {
    RunState.DONE: State.DONE,
    RunState.DONE_WITH_BAD_FRAMES: State.DONE_WITH_FAILED_FRAMES,
    RunState.STOPPED: State.WAITING,
}
"""What becomes of a job whose run has ended so."""

TRANSITIONS: dict[State, frozenset[State]] = {
    State.QUEUED: frozenset({State.RUNNING, State.CANCELLED}),
    State.RUNNING: frozenset({State.QUEUED, State.WAITING})
    | ENDED,  # to the queue where its cluster or the service went
    State.WAITING: frozenset({State.QUEUED, State.CANCELLED}),
    State.DONE: frozenset({State.QUEUED}),  # with other columns
    State.DONE_WITH_FAILED_FRAMES: frozenset({State.QUEUED}),
    State.FAILED: frozenset({State.QUEUED}),
    State.CANCELLED: frozenset({State.QUEUED}),
}
"""The states that may follow each."""
