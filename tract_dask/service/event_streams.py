"""What the store records, passed on to everybody who listens: one task reads, and any number of streams take."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import AsyncGenerator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from pydantic import TypeAdapter

from .jobs.public import JobRecord
from .jobs.records import Job, JobEvent
from .jobs.store import JobStore

HEARTBEAT = b": still here\n\n"

_LOG = logging.getLogger(__name__)
_POLL_S = 0.2
_BATCH = 500
_RECORD = TypeAdapter(JobRecord)


@dataclass(frozen=True)
class Message:
    """An event as it goes over the wire, made once for all streams."""

    id: int
    job_id: str
    chunk: bytes


def message(event: JobEvent) -> Message:
    r"""Return an event of the store as a server-sent event; its data say which job, and when.

    A ``job`` has the record of the job as every route shows it, or its id and that it is deleted.

    Examples
    --------
    >>> message(JobEvent(7, "3f9a0c12de", "2026-11-22T10:00:00.000Z", "log", {"level": "info"})).chunk
    b'id: 7\nevent: log\ndata: {"level":"info","job":"3f9a0c12de","time":"2026-11-22T10:00:00.000Z"}\n\n'
    """
    if event.kind != "job":
        data = event.data | {"job": event.job_id, "time": event.time}
    elif event.data.get("deleted"):
        data = {"id": event.job_id, "deleted": True}
    else:
        data = public_record(event.data)
    return Message(event.id, event.job_id, chunk(event.id, event.kind, data))


def _messages(events: Sequence[JobEvent]) -> list[Message]:
    """Return events as they go over the wire; made in a thread, since they may be many."""
    return [message(event) for event in events]


def public_record(job: Job | dict[str, Any]) -> dict[str, Any]:
    """Return a job as every route shows it, ready for JSON."""
    record: dict[str, Any] = _RECORD.dump_python(_RECORD.validate_python(job), mode="json")
    return record


def chunk(number: int | None, kind: str, data: dict[str, Any]) -> bytes:
    """Return a server-sent event as bytes; JSON has no line ends of its own, and nothing beyond ASCII."""
    head = "" if number is None else f"id: {number}\n"
    return f"{head}event: {kind}\ndata: {json.dumps(data, separators=(',', ':'))}\n\n".encode()


class EventStreams:
    """The events of the store, for streams.

    A stream that resumes reads what it missed from the store, and then what the one reader puts into its queue. The
    reader works while there are streams.

    Parameters
    ----------
    store
        Whose events are passed on, whichever process recorded them.
    heartbeat_s
        A stream in which nothing happens says so as often.
    places
        Messages that a stream may fall behind; then it ends, and its client resumes from the store.
    """

    def __init__(self, store: JobStore, *, heartbeat_s: float = 15.0, places: int = 1000) -> None:
        self._store, self._heartbeat_s, self._places = store, heartbeat_s, places
        self._streams: set[_Stream] = set()
        self._reader: asyncio.Task[None] | None = None
        self._begun = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._closed = False

    def __len__(self) -> int:
        """Streams that listen."""
        return len(self._streams)

    async def listen(self, after: int, job_id: str | None = None) -> AsyncGenerator[bytes]:
        """Yield the chunks of a stream of server-sent events, until the service ends or the client goes.

        Parameters
        ----------
        after
            The last event that the client has.
        job_id
            Only the events of this job; None: of all.
        """
        if self._closed:
            return
        stream = _Stream(job_id, asyncio.Queue(self._places))
        self._streams.add(stream)
        try:
            await self._reading()
            while missed := await asyncio.to_thread(self._store.events, after, job_id, _BATCH):
                for found in await asyncio.to_thread(_messages, missed):
                    yield found.chunk
                after = missed[-1].id
                if stream.ended or len(missed) < _BATCH:
                    break
            while True:
                try:
                    newest = await asyncio.wait_for(stream.queue.get(), self._heartbeat_s)
                except TimeoutError:
                    yield HEARTBEAT
                    continue
                if newest is None:
                    return
                if newest.id > after:
                    after = newest.id
                    yield newest.chunk
        finally:
            self._streams.discard(stream)

    def close(self) -> None:
        """End all streams at once, and begin no other; from any thread, any number of times."""
        self._closed = True
        if self._loop is not None and not self._loop.is_closed():
            with suppress(RuntimeError):  # closed in between
                self._loop.call_soon_threadsafe(self._end_all)

    def _end_all(self) -> None:
        if self._reader is not None:
            self._reader.cancel()
        self._end_streams()

    def _end_streams(self) -> None:
        for stream in tuple(self._streams):
            stream.end()

    async def _reading(self) -> None:
        """Let the reader work, if it does not; return when it knows where it begins.

        What is recorded from then on gets into the queues; what was before, a stream finds in the store.
        """
        if self._reader is None or self._reader.done():
            self._loop, self._begun = asyncio.get_running_loop(), asyncio.Event()
            self._reader = asyncio.create_task(self._read(self._begun), name="events")
        await self._begun.wait()

    async def _read(self, begun: asyncio.Event) -> None:
        """Pass on what is recorded, while anybody listens."""
        try:
            after = await asyncio.to_thread(self._store.newest_event)
            begun.set()
            while self._streams:
                events = await asyncio.to_thread(self._store.events, after, None, _BATCH)
                for found in await asyncio.to_thread(_messages, events):
                    self._pass_on(found)
                    after = found.id
                if len(events) < _BATCH:
                    await asyncio.sleep(_POLL_S)
        except Exception:  # noqa: BLE001  whatever it is, the streams must not wait for ever
            _LOG.exception("the events cannot be read")
            self._end_streams()
        finally:
            begun.set()

    def _pass_on(self, found: Message) -> None:
        for stream in tuple(self._streams):
            if stream.job_id in (None, found.job_id):
                stream.put(found)


@dataclass(eq=False)
class _Stream:
    """A client that listens; None in its queue is the end."""

    job_id: str | None
    queue: asyncio.Queue[Message | None]
    ended: bool = False

    def put(self, found: Message) -> None:
        """Give it a message; one that fell behind is ended."""
        if not self.ended:
            try:
                self.queue.put_nowait(found)
            except asyncio.QueueFull:
                self.end()

    def end(self) -> None:
        """End it now: what it has not taken yet, its client reads when it comes back."""
        if not self.ended:
            self.ended = True
            while not self.queue.empty():
                self.queue.get_nowait()
            self.queue.put_nowait(None)
