"""The service from Python: jobs submitted, watched and read over its REST API.

Errors of the service come out as the classes of :mod:`tract_dask.errors`, with the text that the service gave them.
"""

from __future__ import annotations

import atexit
import dataclasses
import json
import shutil
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, sleep
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import httpx

from ..errors import ClusterError, DestinationError, InputError, ServiceError
from ..settings.run import RunSettings
from .client_answers import check_answer, trusting, values_of
from .jobs.records import PublicJob
from .jobs.states import AT_REST, State

if TYPE_CHECKING:
    import xarray as xr

API = "/api/v1"

FORMATS = {".zip": "zarr", ".nc": "nc", ".csv": "csv"}
"""What results can be downloaded as, by the suffix of the file."""

_TIMEOUT_S, _CONNECT_S = 60.0, 10.0

_SILENCE_S = 45.0
"""A stream of events that is silent for so long is dead: the service says something every 15 s."""

_RETRY_S = (0.5, 10.0)

_PAGE = 200


@dataclass(frozen=True, kw_only=True)
class ServiceJob(PublicJob):
    """A job of the service as it was when it was read; docs/service.md says what the fields are."""

    transitions: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self:
        """Return the job of a record as the service sends it; what a newer service adds is left out."""
        known = {item.name: record[item.name] for item in dataclasses.fields(cls) if item.name in record}
        return cls(**known | {"state": State(record["state"])})

    @property
    def is_at_rest(self) -> bool:
        """Whether nothing happens to it until somebody does something: it has ended, or waits for columns."""
        return self.state in AT_REST


@dataclass(frozen=True)
class ServiceEvent:
    """Something that happened.

    Attributes
    ----------
    id
        Its number, from which a stream can be resumed; None for a snapshot in several parts.
    kind
        ``job``, ``progress``, ``workers`` or ``log``.
    data
        Of ``job`` the record of the job, or its ``id`` and ``deleted``.
    """

    id: int | None
    kind: str
    data: dict[str, Any]

    @property
    def job(self) -> ServiceJob | None:
        """The job, where the event brings it."""
        return ServiceJob.from_record(self.data) if self.kind == "job" and not self.data.get("deleted") else None


class ServiceClient:
    """A client of the service at ``url``; use it as a context manager, or close it.

    Parameters
    ----------
    url
        Such as ``http://127.0.0.1:8000``.
    token
        As ``tract-dask token create`` showed it; None where the service demands none.
    ca
        File with the certificate of the authority, where the service has one that ``tract-dask certs`` made.
    patience_s
        For so long :meth:`watch` tries to reach a service that has gone.
    transport
        How requests are sent, for tests; None: over the network.

    Raises
    ------
    InputError
        Where the address is none, or the certificate cannot be read.

    Examples
    --------
    >>> with ServiceClient("http://127.0.0.1:8000") as service:  # doctest: +SKIP
    ...     job = service.submit("2026-11/ceo2.tif", {"fit": {"window_px": 25}})
    ...     tracks = service.open_results(service.wait(job.id).id)
    """

    def __init__(
        self,
        url: str,
        token: str | None = None,
        ca: str | Path | None = None,
        *,
        patience_s: float = 300.0,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.url, self._patience_s = url.rstrip("/"), patience_s
        if not self.url.startswith(("http://", "https://")):
            raise InputError(
                "this is not an address of a service", url, "http://HOST:PORT or https://HOST:PORT", remedy="Correct it"
            )
        self._http = httpx.Client(
            base_url=f"{self.url}{API}",
            headers={"Authorization": f"Bearer {token}"} if token else None,
            verify=trusting(ca),
            timeout=httpx.Timeout(_TIMEOUT_S, connect=_CONNECT_S),
            transport=transport,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def submit(
        self,
        source: str,
        settings: RunSettings | Mapping[str, Mapping[str, Any]] | None = None,
        *,
        label: str = "",
        output: str = "",
        curate: bool = False,
    ) -> ServiceJob:
        """Queue a job.

        Parameters
        ----------
        source, output
            Relative to the service's data root; without ``output`` the job gets a folder of its own.
        settings
            All settings, or some by group and name. Files that they name are relative to the data root; the cluster
            is the service's.
        curate
            Stop after the summed image, for columns to be edited by hand.

        Raises
        ------
        InputError
            Where the job cannot be done; nothing is queued then.
        """
        body = {"source": source, "settings": values_of(settings), "label": label, "output": output, "curate": curate}
        return ServiceJob.from_record(self._ask("POST", "/jobs", json=body))

    def plan(
        self, source: str, settings: RunSettings | Mapping[str, Mapping[str, Any]] | None = None, *, output: str = ""
    ) -> dict[str, Any]:
        """Return what a job would take: frames, bytes, memory, an estimate of the seconds, and whether it fits."""
        return self._ask("POST", "/plan", json={"source": source, "settings": values_of(settings), "output": output})

    def jobs(
        self, *, states: Iterable[str] = (), owner: str = "", text: str = "", limit: int | None = None
    ) -> list[ServiceJob]:
        """Return jobs, the newest first: at most ``limit`` of those that the filters let through; None: all of them."""
        found: list[ServiceJob] = []
        asked: dict[str, Any] = {"state": [str(state) for state in states], "owner": owner, "text": text}
        while limit is None or len(found) < limit:
            asked["limit"] = _PAGE if limit is None else min(_PAGE, limit - len(found))
            page = self._ask("GET", "/jobs", params=asked)
            found += map(ServiceJob.from_record, page["jobs"])
            if page["next"] is None:
                break
            asked["before"] = page["next"]
        return found

    def job(self, job_id: str) -> ServiceJob:
        """Return a job with its history."""
        return ServiceJob.from_record(self._ask("GET", f"/jobs/{job_id}"))

    def find(self, start: str) -> ServiceJob:
        """Return the one job whose id begins with ``start``.

        Raises
        ------
        InputError
            Where there is none, or more than one.
        """
        found = [job for job in self.jobs(text=start) if job.id.startswith(start)] if start else []
        if len(found) != 1:
            raise InputError(
                "several jobs have an id that begins so" if found else "no job has an id that begins so",
                start,
                "the id of one job, or its first digits",
                ", ".join(job.id for job in found[:5]),
                "List the jobs",
            )
        return found[0]

    def cancel(self, job_id: str) -> ServiceJob:
        """Cancel a job: at once, or as soon as its process has ended."""
        return ServiceJob.from_record(self._ask("POST", f"/jobs/{job_id}/cancel"))

    def retry(self, job_id: str) -> ServiceJob:
        """Queue a job again that failed, was cancelled, or could not fit some frames."""
        return ServiceJob.from_record(self._ask("POST", f"/jobs/{job_id}/retry"))

    def label(self, job_id: str, label: str) -> ServiceJob:
        """Give a job another label."""
        return ServiceJob.from_record(self._ask("POST", f"/jobs/{job_id}/label", json={"label": label}))

    def delete(self, job_id: str, *, files: bool = False) -> dict[str, Any]:
        """Delete a job; with ``files`` what it wrote as well, or the answer says under ``kept`` why not."""
        return self._ask("DELETE", f"/jobs/{job_id}", params={"files": files})

    def log(self, job_id: str) -> list[dict[str, Any]]:
        """Return the lines of a job's log: id, time, level, message."""
        lines: list[dict[str, Any]] = []
        after: int | None = 0
        while after is not None:
            page = self._ask("GET", f"/jobs/{job_id}/log", params={"after": after})
            lines += page["lines"]
            after = page["next"]
        return lines

    def files(self, folder: str = "") -> list[dict[str, Any]]:
        """Return what a folder under the data root holds: name, path, kind, bytes, modified."""
        entries: list[dict[str, Any]] = []
        after: str | None = ""
        while after is not None:
            page = self._ask("GET", "/files", params={"path": folder, "after": after})
            entries += page["entries"]
            after = page["next"]
        return entries

    def about(self, source: str) -> dict[str, Any]:
        """Return what a movie under the data root says about itself."""
        return self._ask("GET", "/files/about", params={"path": source})

    def workers(self) -> list[dict[str, Any]]:
        """Return what each worker of the cluster does."""
        return list(self._ask("GET", "/workers")["workers"])

    def events(self, job_id: str | None = None, *, after: int | None = None) -> Iterator[ServiceEvent]:
        """Yield what happens, to one job or to all, without end; a broken connection is taken up where it broke.

        Parameters
        ----------
        after
            Begin after the event of this number; None: with the jobs as they are.

        Raises
        ------
        ServiceError
            Where the service cannot be reached for longer than the client's patience.
        """
        yield from self._events("/events" if job_id is None else f"/jobs/{job_id}/events", after, None)

    def watch(self, job_id: str) -> Iterator[ServiceEvent]:
        """Yield what happens to a job until it is at rest; first the job as it is."""
        yield from self._watch(job_id, None)

    def wait(self, job_id: str, *, timeout_s: float | None = None) -> ServiceJob:
        """Return a job when it has ended or waits for columns.

        Raises
        ------
        TimeoutError
            Where that takes longer than ``timeout_s``.
        InputError
            Where it is deleted meanwhile.
        """
        deadline = None if timeout_s is None else monotonic() + timeout_s
        for event in self._watch(job_id, deadline):
            if event.job is not None and event.job.is_at_rest:
                return event.job
        raise InputError("the job was deleted", job_id)

    def columns_versions(self, job_id: str) -> list[dict[str, Any]]:
        """Return the versions of a job's columns: version (0: the automatic ones), time, author, note, count."""
        return list(self._ask("GET", f"/jobs/{job_id}/columns")["versions"])

    def columns(self, job_id: str, version: int = 0) -> list[dict[str, Any]]:
        """Return a version of a job's columns: column_id, x, y (px), kind, flags."""
        return list(self._ask("GET", f"/jobs/{job_id}/columns/{version}")["columns"])

    def save_columns(self, job_id: str, columns: Sequence[Mapping[str, Any]], note: str = "") -> int:
        """Keep columns (x, y, and perhaps column_id and kind) as the next version; return its number."""
        names = ("column_id", "x", "y", "kind")
        rows = [{name: column[name] for name in names if name in column} for column in columns]
        return int(self._ask("POST", f"/jobs/{job_id}/columns", json={"columns": rows, "note": note})["version"])

    def go_on(self, job_id: str, version: int = 0) -> ServiceJob:
        """Let a job go on with a version of its columns."""
        return ServiceJob.from_record(self._ask("POST", f"/jobs/{job_id}/continue", json={"version": version}))

    def download(self, job_id: str, file: str | Path, *, overwrite: bool = False) -> Path:
        """Write a job's results to ``file``: .zip (a Zarr store), .nc or .csv; it appears when it is whole.

        Raises
        ------
        DestinationError
            Where there is a file already, its suffix is another, or it cannot be written.
        """
        path = Path(file)
        if path.suffix.lower() not in FORMATS:
            raise DestinationError("the format is unknown", str(path), f"a name that ends in {', '.join(FORMATS)}")
        if path.exists() and not overwrite:
            raise DestinationError("the file already exists", str(path), remedy="Choose another, or say overwrite")
        params = {"format": FORMATS[path.suffix.lower()]}
        aside = path.with_name(f".{path.name}.part")
        try:
            with (
                self._reached(),
                self._http.stream("GET", f"/jobs/{job_id}/results/download", params=params) as answer,
                aside.open("wb") as written,
            ):
                check_answer(answer)
                for chunk in answer.iter_bytes():
                    written.write(chunk)
            aside.replace(path)
        except OSError as error:
            raise DestinationError(
                "the file cannot be written", str(path), got=error.strerror or str(error), remedy="Choose another place"
            ) from error
        finally:
            aside.unlink(missing_ok=True)
        return path

    def open_results(self, job_id: str, folder: str | Path | None = None) -> xr.Dataset:
        """Return a job's tracks as :func:`tract_dask.open_results` does, downloaded to ``folder``.

        Parameters
        ----------
        folder
            The store is made there, named after the job, in place of an older one; None: in a temporary folder that
            lasts as long as this process.
        """
        from ..store.results import open_results

        place = _temporary_folder() if folder is None else Path(folder)
        store, aside = place / f"{job_id}.zarr", place / f".{job_id}.zarr.part"
        place.mkdir(parents=True, exist_ok=True)
        archive = self.download(job_id, place / f".{job_id}.zip", overwrite=True)
        try:
            with zipfile.ZipFile(archive) as zipped:
                zipped.extractall(aside)
            shutil.rmtree(store, ignore_errors=True)
            aside.rename(store)
        finally:
            archive.unlink()
            shutil.rmtree(aside, ignore_errors=True)
        return open_results(store)

    def _ask(self, method: str, path: str, **asked: Any) -> dict[str, Any]:
        """Return what a route answers."""
        with self._reached():
            answer = self._http.request(method, path, **asked)
        check_answer(answer)
        found: dict[str, Any] = answer.json()
        return found

    @contextmanager
    def _reached(self) -> Iterator[None]:
        try:
            yield
        except httpx.HTTPError as error:
            raise self._unreachable(error) from error

    def _unreachable(self, error: httpx.HTTPError) -> ServiceError:
        return ServiceError(
            "the service cannot be reached",
            self.url,
            got=str(error) or type(error).__name__,
            remedy="Check the address, and that it runs: tract-dask serve",
        )

    def _watch(self, job_id: str, deadline: float | None) -> Iterator[ServiceEvent]:
        for event in self._events(f"/jobs/{job_id}/events", None, deadline):
            yield event
            if event.kind == "job" and (event.job is None or event.job.is_at_rest):
                return

    def _events(self, path: str, after: int | None, deadline: float | None) -> Iterator[ServiceEvent]:
        first, longest = _RETRY_S
        delay, heard = first, monotonic()
        while True:
            try:
                for event in self._stream(path, after, deadline):
                    after = after if event.id is None else event.id
                    yield event
                    delay, heard = first, monotonic()
                    _check_time(deadline, path)
            except (httpx.TransportError, ClusterError) as error:
                if monotonic() - heard > self._patience_s:
                    raise self._unreachable(error) if isinstance(error, httpx.HTTPError) else error from error
            _check_time(deadline, path)
            sleep(delay)
            delay = min(2 * delay, longest)

    def _stream(self, path: str, after: int | None, deadline: float | None) -> Iterator[ServiceEvent]:
        """Yield the events of one connection."""
        headers = {} if after is None else {"Last-Event-ID": str(after)}
        silence = _SILENCE_S if deadline is None else max(0.01, min(_SILENCE_S, deadline - monotonic()))
        timeout = httpx.Timeout(_TIMEOUT_S, connect=_CONNECT_S, read=silence)
        with self._http.stream("GET", path, headers=headers, timeout=timeout) as answer:
            check_answer(answer)
            yield from parse_events(answer.iter_lines())


def parse_events(lines: Iterable[str]) -> Iterator[ServiceEvent]:
    """Yield the events in the lines of a stream of server-sent events; comments are left out.

    Examples
    --------
    >>> list(parse_events(["id: 7", "event: log", 'data: {"level":"info"}', "", ": still here", ""]))
    [ServiceEvent(id=7, kind='log', data={'level': 'info'})]
    """
    fields: dict[str, str] = {}
    for line in lines:
        if line:
            name, _, value = line.partition(":")
            fields[name] = value.removeprefix(" ")
        elif "data" in fields:
            number = fields.get("id", "")
            yield ServiceEvent(int(number) if number else None, fields.get("event", ""), json.loads(fields["data"]))
            fields = {}
        else:
            fields = {}


def _check_time(deadline: float | None, path: str) -> None:
    if deadline is not None and monotonic() > deadline:
        raise TimeoutError(f"{path}: the answer took longer than the timeout")


def _temporary_folder() -> Path:
    """Return a folder that goes when this process ends."""
    folder = tempfile.mkdtemp(prefix="tract_dask_")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)
