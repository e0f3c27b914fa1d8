"""The stages strung together: a run from a movie on disk to tracks, its plan, and every stage as a job of its own."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, repeat
from pathlib import Path
from time import perf_counter
from types import TracebackType
from typing import Any

import numpy as np
import xarray as xr
from distributed import Client

from . import stores
from .cluster import LazyClient, local_memory_limit, memory_budget
from .conversion import check_kept, is_movie_of, remembered_source
from .errors import ClusterError, DestinationError, InputError, SourceError, StoreError
from .fit import FitSummary
from .inputs import check_columns, check_drift, check_fit, check_inputs, check_pixels_of
from .io import FileList, FrameSource, Permit, open_source
from .journal import journal_beside, remove_journal
from .layout import peak_memory, plan_layout
from .locks import sole_use
from .movie import Movie, open_movie
from .progress import (
    REPORT,
    STAGES,
    Event,
    JsonLines,
    RunDone,
    RunStarted,
    Sink,
    StageDone,
    StageStarted,
    Warned,
    silent,
    tee,
)
from .schema import drift_of
from .settings import ClusterSettings, RunSettings, to_toml
from .shards import split
from .stages import check_edited, clear_columns, columns_stage, convert_stage, drift_stage, fit_stage, sum_stage
from .tls import open_to_others
from .tries import Done, persist

WORKER_BYTES = 300_000_000
"""What a worker process takes before it has read a pixel."""

BATCH_BYTES = 128_000_000
"""What a task that reads the movie works on at a time, beside the frames themselves and the sums of the field."""

_FILTER_BYTES = 40
"""A pixel of a frame that is filtered as a whole: its transform, powers and rings, or the dual of its gradient."""


@dataclass(frozen=True)
class Outputs:
    """The places of everything that a run writes, under one folder."""

    root: Path

    @property
    def movie(self) -> Path:
        """The converted movie."""
        return self.root / "movie.zarr"

    @property
    def drift(self) -> Path:
        """The drift of every frame."""
        return self.root / "drift.zarr"

    @property
    def sum(self) -> Path:
        """The drift-corrected sum."""
        return self.root / "sum.zarr"

    @property
    def columns(self) -> Path:
        """The columns as a table that can be edited; beside it ``columns.zarr`` and ``columns.png``."""
        return self.root / "columns.csv"

    @property
    def results(self) -> Path:
        """The tracks."""
        return self.root / "results.zarr"

    @property
    def report(self) -> Path:
        """What was measured, and how well, as one page."""
        return self.root / "report.html"

    @property
    def settings(self) -> Path:
        """Every setting of the run."""
        return self.root / "run.toml"

    @property
    def events(self) -> Path:
        """What happened when."""
        return self.root / "events.jsonl"

    def stages(self) -> tuple[Path, ...]:
        """Return the stores, in the order of the stages."""
        return (self.movie, self.drift, self.sum, self.columns.with_suffix(".zarr"), self.results)

    def written(self) -> tuple[Path, ...]:
        """Return everything that a run writes: its stores, beside which journals may lie, then its files."""
        return (*self.stages(), self.columns, self.columns.with_suffix(".png"), self.report, self.settings, self.events)

    def paths(self) -> dict[str, str]:
        """Return the paths by name."""
        names = ("movie", "drift", "sum", "columns", "results", "report", "settings", "events")
        return {name: str(getattr(self, name)) for name in names} | {"figure": str(self.columns.with_suffix(".png"))}


@dataclass(frozen=True)
class Plan:
    """What a run is going to do, known before it does anything.

    Attributes
    ----------
    frames, shards, frames_per_shard
        The units of work.
    bytes_read, bytes_written
        From and to disk, before compression: the source once, the movie twice; the movie with its binned levels.
    peak_memory
        Bytes that a task needs with its worker, at most.
    memory_limit
        Bytes that it may use; None where the workers have no limit.
    """

    frames: int
    shards: int
    frames_per_shard: int
    bytes_read: int
    bytes_written: int
    peak_memory: int
    memory_limit: int | None = None

    def check(self) -> None:
        """Refuse work that does not fit.

        Raises
        ------
        ClusterError
            With both numbers.
        """
        if self.memory_limit is not None and self.peak_memory > self.memory_limit:
            raise ClusterError(
                "the work does not fit into a worker's memory",
                "plan",
                f"at most {self.memory_limit / 1e9:.2f} GB a task",
                f"{self.peak_memory / 1e9:.2f} GB for shards of {self.frames_per_shard} frames",
                "Make shards smaller (--shard-mb), give workers more memory (--memory-limit), or start fewer",
            )


@dataclass(frozen=True)
class RunOutcome:
    """What a run did.

    Attributes
    ----------
    state
        ``planned``, ``stopped`` (after the stage that was asked for), ``done`` or ``done_with_bad_frames``.
    seconds
        Time of every stage that worked, in s.
    reused
        Stages that an earlier run had finished.
    """

    outputs: Outputs
    plan: Plan
    state: str
    frames: int
    columns: int = 0
    fits: int = 0
    accepted: int = 0
    bad_frames: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    reused: tuple[str, ...] = ()

    def to_record(self) -> dict[str, Any]:
        """Return the outcome as a JSON-ready mapping."""
        return dataclasses.asdict(self) | {"outputs": self.outputs.paths(), "reused": list(self.reused)}


def plan_run(
    shape: tuple[int, int, int], dtype: np.dtype[Any], settings: RunSettings, memory_limit: int | None = None
) -> Plan:
    """Return the plan for a movie of ``shape`` (frames, y, x) and ``dtype``; a pure function."""
    layout = plan_layout(shape, dtype, settings.convert)
    raw = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    shard = raw // shape[0] * layout.frames_per_shard
    filtered = _FILTER_BYTES * shape[1] * shape[2] if settings.fit.filters_frames else 0
    binned = sum(4 * shape[0] * (shape[1] // bin_) * (shape[2] // bin_) for bin_ in layout.bins)
    return Plan(
        frames=shape[0],
        shards=len(split(shape[0], layout.frames_per_shard)),
        frames_per_shard=layout.frames_per_shard,
        bytes_read=3 * raw + binned,
        bytes_written=raw + binned,
        peak_memory=WORKER_BYTES
        + max(peak_memory(layout), BATCH_BYTES + max(2 * shard, 24 * shape[1] * shape[2]) + filtered),
        memory_limit=memory_limit,
    )


def run(
    source: str | Path | FileList,
    output: str | Path,
    settings: RunSettings | None = None,
    *,
    client: Client | None = None,
    on_event: Sink = silent,
    overwrite: bool = False,
    plan_only: bool = False,
    report: bool = True,
    until: str | None = None,
    patience_s: float = 0.0,
    permit: Permit | None = None,
) -> RunOutcome:
    """Turn a movie on disk into tracks: convert, drift, sum, columns, fit.

    What an earlier run with the same settings has done is kept; changed settings redo what they affect, but a finished
    conversion is thrown away with ``overwrite`` only. A table of columns that was edited by hand is kept, and fitted,
    until the method or the file of columns changes.

    Once the movie is converted, its source may be moved or archived.

    Parameters
    ----------
    source
        Any movie that :func:`tract_dask.open_source` reads.
    output
        A folder; see :class:`Outputs`.
    client
        The cluster to run on; None: the one that ``settings.cluster`` names, if there is anything to do.
    on_event
        Takes the run's progress. What it raises ends the run, which goes on from there as after any other error.
    overwrite
        Begin anew, even where the folder holds something else, or a movie that was converted otherwise. A table of
        columns that was edited by hand stays, with the same movie, or is put away.
    plan_only
        Only plan, and write nothing.
    report
        Write ``report.html`` at the end, where it is not there yet or of other tracks.
    until
        The stage to stop after, one of :data:`tract_dask.progress.STAGES`; the same call without it goes on. After
        ``columns``, the table can be edited first.
    patience_s
        How long to wait for another run in the same folder to end, in s.
    permit
        Called with the resolved path of every file of the source before it is opened.

    Raises
    ------
    InputError
        Where the source, the settings or the folder cannot be used; nothing is written then.
    ClusterError
        Where the cluster cannot do the work.
    TractError
        Where a stage fails; what is done is kept, and the same call goes on from there.
    """
    settings = _absolute(settings or RunSettings())
    outputs = Outputs(Path(output).absolute())
    _check_stage(until)
    attempt = partial(persist, send=on_event, file=str(outputs.root))
    opening = partial(_open, source, settings, None if overwrite else outputs.movie, permit)
    with closing(attempt(opening)) as opened:
        attempt(partial(check_inputs, opened.shape, settings))
        if plan_only:
            plan = plan_run(opened.shape, opened.dtype, settings, _expected_limit(settings, client))
            return RunOutcome(outputs, plan, "planned", plan.frames)
        attempt(partial(check_output, outputs, opened, settings, overwrite=overwrite))
        with ExitStack() as stack:
            attempt(lambda: stack.enter_context(sole_run(outputs, patience_s)))
            if overwrite:
                same = attempt(lambda: stores.is_sound(outputs.movie) and is_movie_of(outputs.movie, opened))
                attempt(partial(clear_run, outputs, on_event, keep_edited=same))
            attempt(partial(check_edited, outputs.columns, settings.columns, opened.shape[1:]))
            return _run(opened, outputs, settings, client, on_event, report=report, until=until)


def run_convert(
    source: str | Path,
    destination: str | Path,
    settings: RunSettings | None = None,
    *,
    client: Client | None = None,
    on_event: Sink = silent,
    overwrite: bool = False,
) -> Movie:
    """Convert a movie to the store ``destination``; the first stage of :func:`run`, alone."""
    settings, path = _absolute(settings or RunSettings()), Path(destination).absolute()
    opening = partial(_open, source, settings, None if overwrite else path)
    with closing(persist(opening, on_event, str(source))) as opened:
        plan = plan_run(opened.shape, opened.dtype, settings)
        if overwrite and stores.is_sound(path) and stores.attributes(path).get("kind") == "movie":
            stores.remove(path)  # also the very movie that would be made: a shard of it may be damaged
        with _Session(opened.path, path, settings.cluster, client, on_event, plan) as session:
            return session.attempt(
                partial(convert_stage, opened, path, settings, session.workers, session.send, overwrite=overwrite)
            )


def run_drift(
    movie: str | Path,
    output: str | Path,
    settings: RunSettings | None = None,
    *,
    client: Client | None = None,
    on_event: Sink = silent,
) -> xr.Dataset:
    """Measure the drift of a movie store into the store ``output``."""
    settings, path, opened = _absolute(settings or RunSettings()), Path(output).absolute(), open_movie(movie)
    check_drift(opened.n_frames, settings.drift)
    with _Session(str(movie), path, settings.cluster, client, on_event) as session:
        return session.attempt(partial(drift_stage, opened, path, settings.drift, session.workers, session.send))


def run_columns(
    movie: str | Path,
    output: str | Path,
    settings: RunSettings | None = None,
    drift: str | Path | None = None,
    *,
    client: Client | None = None,
    on_event: Sink = silent,
    overwrite: bool = False,
) -> xr.Dataset:
    """Find the columns of a movie store into the table ``output`` (.csv); the summed image is kept beside it."""
    settings, path, opened = _absolute(settings or RunSettings()), Path(output).absolute(), open_movie(movie)
    _check_suffix(path, ".csv")
    check_columns(opened.shape[1:], settings.columns, settings.fit.window_px)
    check_edited(path, settings.columns, opened.shape[1:])
    shift = None if drift is None else stores.open_dataset(Path(drift))
    with _Session(str(movie), path, settings.cluster, client, on_event) as session:
        attempt, send = session.attempt, session.send
        summed = attempt(partial(sum_stage, opened, shift, sum_beside(path), session.workers, send))
        return attempt(partial(columns_stage, summed, path, settings.columns, settings.fit, send, overwrite=overwrite))


def run_fit(
    movie: str | Path,
    columns: str | Path,
    results: str | Path,
    settings: RunSettings | None = None,
    drift: str | Path | None = None,
    *,
    client: Client | None = None,
    on_event: Sink = silent,
) -> FitSummary:
    """Fit the columns of a table (.csv) in every frame of a movie store, into the store ``results``."""
    settings, path, opened = _absolute(settings or RunSettings()), Path(results).absolute(), open_movie(movie)
    table = Path(columns).absolute()
    stores.check_destination(path)
    shift = None if drift is None else stores.open_dataset(Path(drift))
    chosen = dataclasses.replace(settings.columns, method="csv", csv=str(table))
    check_columns(opened.shape[1:], chosen, settings.fit.window_px)
    check_fit(opened.shape[1:], settings.fit, drift_of(shift, opened.n_frames))
    check_pixels_of(opened, settings.fit)
    with _Session(str(movie), path, settings.cluster, client, on_event) as session:
        attempt, workers, send = session.attempt, session.workers, session.send
        summed = attempt(partial(sum_stage, opened, shift, sum_beside(path), workers, send))
        csv = path.with_name(f"{path.stem}_columns.csv")
        found = attempt(partial(columns_stage, summed, csv, chosen, settings.fit, send))
        refine = _refine_columns(settings)
        return attempt(partial(fit_stage, opened, found, shift, summed, path, settings.fit, refine, workers, send))


def _run(
    source: FrameSource,
    outputs: Outputs,
    settings: RunSettings,
    client: Client | None,
    on_event: Sink,
    *,
    report: bool,
    until: str | None,
) -> RunOutcome:
    """Run the stages in their order, and stop after ``until``."""
    record, made = _Record(), _Made()
    send = tee((record, JsonLines(outputs.events, on_event), on_event))
    plan = plan_run(source.shape, source.dtype, settings)
    with _Session(source.path, outputs.root, settings.cluster, client, send, plan) as session:
        session.attempt(partial(stores.write_aside, outputs.settings, _run_toml(settings, {}).encode()))
        for stage in _stages(source, outputs, settings, session, made):
            if stage == until:
                break
        session.finish_aside()
        if made.movie is None or made.summary is None:
            session.state = "stopped"
        else:
            session.attempt(partial(_complete_toml, outputs, settings, made.movie, made.columns))
            session.state = "done_with_bad_frames" if made.summary.bad_frames else "done"
            session.message = "" if record.seconds else "all was done before: nothing to do"
            if report:
                _report(outputs, session)
    summary = made.summary or FitSummary(0, 0, 0)
    return RunOutcome(
        outputs,
        plan,
        session.state,
        plan.frames,
        made.columns.sizes.get("column_id", 0),
        summary.fits,
        summary.accepted,
        summary.bad_frames,
        record.seconds,
        record.reused,
    )


@dataclass
class _Made:
    """What the stages of a run have made so far."""

    movie: Movie | None = None
    columns: xr.Dataset = field(default_factory=xr.Dataset)
    summary: FitSummary | None = None


def _stages(
    source: FrameSource, outputs: Outputs, settings: RunSettings, session: _Session, made: _Made
) -> Iterator[str]:
    """Run the stages one by one; yield the name of each when it is done."""
    attempt, workers, send = session.attempt, session.workers, session.send
    made.movie = movie = attempt(partial(convert_stage, source, outputs.movie, settings, workers, send))
    attempt(partial(check_pixels_of, movie, settings.fit))
    yield "convert"
    drift = attempt(partial(drift_stage, movie, outputs.drift, settings.drift, workers, send))
    check_fit(movie.shape[1:], settings.fit, drift["drift"].to_numpy())
    yield "drift"
    summed = attempt(partial(sum_stage, movie, drift, outputs.sum, workers, send))
    yield "sum"
    session.finish_aside()  # it imports what comes next: two threads could meet in packages that import each other
    found = partial(columns_stage, summed, outputs.columns, settings.columns, settings.fit, send, aside=session.aside)
    made.columns = columns = attempt(found)
    yield "columns"
    refine = _refine_columns(settings)
    made.summary = attempt(
        partial(fit_stage, movie, columns, drift, summed, outputs.results, settings.fit, refine, workers, send)
    )
    yield "fit"


def _complete_toml(outputs: Outputs, settings: RunSettings, movie: Movie, columns: xr.Dataset) -> None:
    """Write the settings once more, with what the data gave for those that were unset."""
    stores.write_aside(outputs.settings, _run_toml(settings, _resolved(movie, columns, outputs)).encode())


def _report(outputs: Outputs, session: _Session) -> None:
    """Write the report, if there is none of these tracks; whatever goes wrong, the tracks are done."""
    from .report import is_current, write_report  # takes its time to import

    send = session.send
    send(StageStarted(REPORT, 0))
    began, current = perf_counter(), False
    try:
        current = session.attempt(partial(is_current, outputs.root))
        if not current:
            session.attempt(partial(write_report, outputs.root, figures=False))
    except Exception as error:  # noqa: BLE001  nothing in a page of figures may undo a finished run
        stores.remove(outputs.report)  # it would be of other tracks
        send(Warned(f"the report could not be made: {error}"))
    send(StageDone(REPORT, perf_counter() - began, reused=current))


class _Session:
    """What every job has around it: a client at its first use, and events that tell its beginning and its end.

    A thread does what nothing waits for, while the workers work.
    """

    def __init__(
        self,
        source: str,
        output: Path,
        cluster: ClusterSettings,
        client: Client | None,
        send: Sink,
        plan: Plan | None = None,
    ) -> None:
        self._started, self._plan, self._began = RunStarted(source, str(output)), plan, perf_counter()
        self._is_given = client is not None
        self.workers, self._sink = LazyClient(cluster, client, self._on_connect), send
        self._refusal: OSError | None = None
        self.state, self.message = "done", ""
        self._thread, self._asides = ThreadPoolExecutor(1, "aside"), list[tuple[Callable[[], object], Future[object]]]()

    def send(self, event: Event) -> None:
        """Send an event to the sink; what that raises ends the job."""
        try:
            self._sink(event)
        except OSError as error:
            self._refusal = error
            raise

    def attempt(self, work: Callable[[], Done]) -> Done:
        """Do some work, again where this process meets an error that may pass; see :func:`tract_dask.tries.persist`."""
        return persist(work, self.send, self._started.output, lambda error: error is self._refusal)

    def aside(self, work: Callable[[], object]) -> None:
        """Let the thread do some work."""
        self._asides.append((work, self._thread.submit(work)))

    def finish_aside(self) -> None:
        """Wait for the thread; do here what met an error there that may pass, raise other errors."""
        for work, future in self._asides:
            tries = chain([future.result], repeat(work))
            self.attempt(partial(_do_next, tries))
        self._asides.clear()

    def __enter__(self) -> _Session:
        self.send(self._started)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._thread.shutdown(cancel_futures=True)
        self.workers.close()
        if kind is not None:
            self.state, self.message = "interrupted" if kind is KeyboardInterrupt else "failed", ""
        self.send(RunDone(self.state, perf_counter() - self._began, self.message))
        if isinstance(error, OSError) and error.errno and not isinstance(error, ConnectionError | TimeoutError):
            raise StoreError(
                "a file could not be read or written",
                error.filename or f"{self._started.output}, made from {self._started.source}",
                got=os.strerror(error.errno),
                remedy="Look at the disk, then run the same command again: what is done is kept",
            ) from error

    def _on_connect(self, client: Client) -> None:
        if self._plan:
            dataclasses.replace(self._plan, memory_limit=memory_budget(client)).check()
        self.send(dataclasses.replace(self._started, dashboard=client.dashboard_link or ""))
        if not self._is_given and (warning := open_to_others(client.scheduler.address)):
            self.send(Warned(warning))
        self.aside(_get_ready)


def _do_next(works: Iterator[Callable[[], object]]) -> object:
    return next(works)()


class _Record:
    """A sink that keeps how long every stage took, and which were done before."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.reused: tuple[str, ...] = ()

    def __call__(self, event: Event) -> None:
        if isinstance(event, StageDone):
            if event.reused:
                self.reused += (event.stage,)
            else:
                self.seconds[event.stage] = event.seconds


def _get_ready() -> None:
    """Import what the later stages need here, and make the compiler ready to load kernels."""
    from . import columns, report  # noqa: F401
    from .kernels.registration import load_kernels
    from .plots import plot_columns  # noqa: F401

    load_kernels()


def _open(
    source: str | Path | FileList, settings: RunSettings, kept: Path | None, permit: Permit | None = None
) -> FrameSource:
    """Open the source by its whole path, which any worker can use.

    A source that is not there is taken from the complete movie at ``kept``, if it is that movie's.
    """
    place = source if isinstance(source, FileList) else str(Path(source).absolute())
    try:
        return open_source(place, settings.source, permit=permit)
    except SourceError as error:
        gone = None if kept is None else remembered_source(kept, str(place), error)
        if gone is None:
            raise
        return gone


def sum_beside(path: Path) -> Path:
    """Return where the summed image lies from which the table or the results at ``path`` were made."""
    return path.with_name(f"{path.stem}_sum.zarr")


def _refine_columns(settings: RunSettings) -> int | None:
    return settings.drift.refine_columns if settings.drift.refine and settings.drift.method != "none" else None


def _check_suffix(path: Path, suffix: str) -> None:
    if path.suffix != suffix:
        raise DestinationError(
            "the name does not fit", str(path), f"a name that ends in {suffix}", path.name, "Change it"
        )


def _absolute(settings: RunSettings) -> RunSettings:
    """Return the settings with whole paths, so that they mean the same from any folder."""
    cluster = settings.cluster

    def whole(path: str | None) -> str | None:
        return None if path is None else str(Path(path).absolute())

    return dataclasses.replace(
        settings,
        drift=dataclasses.replace(settings.drift, csv=whole(settings.drift.csv)),
        columns=dataclasses.replace(settings.columns, csv=whole(settings.columns.csv)),
        cluster=dataclasses.replace(cluster, scheduler_file=whole(cluster.scheduler_file), tls=whole(cluster.tls)),
    )


def _check_stage(until: str | None) -> None:
    if until is not None and until not in STAGES:
        raise InputError("there is no such stage", "until", f"one of {', '.join(STAGES)}", until, "Correct its name")


def check_output(
    outputs: Outputs, source: FrameSource, settings: RunSettings | None = None, *, overwrite: bool
) -> None:
    """Check that the folder is empty or holds a run of this movie, and can be written.

    Without ``settings``, those of its conversion are taken to be the same.

    Raises
    ------
    DestinationError
        Also where a complete movie would have to be thrown away.
    """
    root = outputs.root
    ours = outputs.settings.exists() or outputs.events.exists()
    if root.exists() and not root.is_dir():
        raise DestinationError(
            "this place holds something else", str(root), "a folder", "a file", "Choose another place"
        )
    for path in outputs.written():
        if path.suffix != ".zarr" and path.is_dir():
            raise DestinationError(
                "a folder lies where a file is written", str(path), "a file, or nothing", "a folder", "Move it away"
            )
    others = sorted(path.name for path in root.glob("[!.]*"))
    if others and not ours and not overwrite:
        raise DestinationError(
            "this folder holds something else",
            str(root),
            "an empty folder, or that of an earlier run",
            ", ".join(others[:3]),
            "Choose another place, or say --overwrite",
        )
    if not overwrite:
        _check_movie(outputs, source, settings)
        for path in outputs.stages()[1:]:
            stores.check_place(path)
    stores.check_destination(outputs.movie, overwrite=overwrite)


def _check_movie(outputs: Outputs, source: FrameSource, settings: RunSettings | None) -> None:
    """Check that the movie in a run's folder is one of this source, and would not have to be thrown away."""
    present = stores.attributes(outputs.movie)
    before = str(present.get("source", source.path))
    unfinished_of_it = before == source.path and not present.get("complete")
    if present.get("kind") == "movie" and not unfinished_of_it and not is_movie_of(outputs.movie, source):
        raise DestinationError(
            "this folder holds the run of another movie",
            str(outputs.root),
            f"an empty folder, or a run of what {source.path} holds now",
            f"a run of what {before} held on {present.get('created', 'an unknown day')}",
            "Choose another place, or say --overwrite: then all of that run is made again",
        )
    if settings is not None:
        check_kept(outputs.movie, source, settings.convert, settings.source)


def clear_run(outputs: Outputs, on_event: Sink = silent, *, keep_edited: bool = False) -> None:
    """Delete what a run writes, and nothing else; columns that were edited by hand are kept, or put away."""
    clear_columns(outputs.columns, on_event, keep_edited=keep_edited)
    stages = (outputs.movie, outputs.drift, outputs.sum, outputs.results)
    for path in stages:
        remove_journal(journal_beside(path))
        stores.remove(path)
    for path in (outputs.report, outputs.settings, outputs.events):
        stores.remove(path)


@contextmanager
def sole_run(outputs: Outputs, patience_s: float = 0.0) -> Iterator[None]:
    """Hold the folder against a second run, after waiting at most ``patience_s`` for one that holds it.

    Raises
    ------
    DestinationError
        Where another run holds it.
    """
    with sole_use(outputs.root / ".lock", "another run works in this folder", patience_s):
        yield


def _expected_limit(settings: RunSettings, client: Client | None) -> int | None:
    """Return the bytes that a task may use, without starting workers."""
    cluster = settings.cluster
    if client is None and cluster.resolved_kind != "address":
        return local_memory_limit(cluster) // cluster.threads
    with closing(LazyClient(cluster, client)) as workers:
        return memory_budget(workers())


def _resolved(movie: Movie, columns: xr.Dataset, outputs: Outputs) -> dict[str, Any]:
    """Return what the data gave for settings that were unset."""
    about = stores.attributes(outputs.results)
    found = {
        "metadata.pixel_size_pm": movie.pixel_size_pm,
        "metadata.frame_time_s": movie.frame_time_s,
        "metadata.dose": movie.dose,
        "columns.spacing_px": columns.attrs.get("spacing_px"),
        "fit.window_px": about.get("window"),
        "fit.vacuum_box": about.get("vacuum"),
    }
    return {name: stores.json_ready(value) for name, value in found.items() if value is not None}


def _run_toml(settings: RunSettings, resolved: dict[str, Any]) -> str:
    """Return all settings as TOML; what is unset stands in comments, with the value that the data gave."""
    lines = [to_toml(settings), "# Unset:"]
    for group in dataclasses.fields(settings):
        values = getattr(settings, group.name)
        for item in dataclasses.fields(values):
            if getattr(values, item.name) is None:
                name = f"{group.name}.{item.name}"
                value = f" = {resolved[name]}" if name in resolved else ""
                lines.append(f"# {name}{value}  ({item.metadata['description']})")
    return "\n".join(lines) + "\n"
