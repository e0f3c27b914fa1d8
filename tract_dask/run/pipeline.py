"""The stages strung together: a run from a movie on disk to tracks, its plan, and every stage as a job of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import xarray as xr
from distributed import Client

from ..cluster.retries import persist
from ..progress import REPORT, JsonLines, Noticed, RunState, Sink, StageDone, StageStarted, Warned, silent, tee
from ..readers.checks import Permit
from ..readers.movie_files import FileList
from ..readers.source import FrameSource
from ..settings.run import RunSettings
from ..settings.toml import to_toml
from ..stages.columns.stage import check_edited, clear_columns, columns_stage
from ..stages.columns.window_size import resolve_blur
from ..stages.convert.origin import is_movie_of
from ..stages.convert.references import check_references
from ..stages.convert.stage import convert_stage
from ..stages.drift.stage import drift_stage
from ..stages.fit.stage import FitSummary, fit_stage
from ..stages.fit.vacuum import check_box
from ..stages.sum import sum_stage
from ..store import files, metadata
from ..store.held import is_held
from ..store.journal import journal_beside, remove_journal
from ..store.movie import Movie, open_movie
from ..store.run_folder import RunFolder, sole_run
from .checks import check_inputs, check_output, check_pixels_of, check_stage, open_input, with_whole_paths
from .plan import Plan, expected_limit, plan_run
from .session import Record, Session, draw_columns


@dataclass(frozen=True)
class RunOutcome:
    """What a run did.

    Attributes
    ----------
    state
        Of the run; neither interrupted nor failed.
    seconds
        Time of every stage that worked, in s.
    reused
        Stages that an earlier run had finished.
    findings
        Names of the warnings about the tracks, see :mod:`tract_dask.report.findings`.
    """

    outputs: RunFolder
    plan: Plan
    state: RunState
    frames: int
    columns: int = 0
    fits: int = 0
    accepted: int = 0
    bad_frames: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    reused: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()

    def to_record(self) -> dict[str, Any]:
        """Return the outcome as a JSON-ready mapping."""
        return dataclasses.asdict(self) | {
            "outputs": self.outputs.paths(),
            "reused": list(self.reused),
            "findings": list(self.findings),
        }


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
        A folder; see :class:`~tract_dask.store.run_folder.RunFolder`.
    client
        The cluster to run on; None: the one that ``settings.cluster`` names, if there is anything to do.
    on_event
        Takes the run's progress. What it raises ends the run, which goes on from there as after any other error.
    overwrite
        Begin anew, even where the folder holds something else, or a movie that was converted otherwise. A table of
        columns that was edited by hand stays, with the same movie, field and bin, or is put away.
    plan_only
        Only plan, and write nothing.
    report
        Write ``report.html`` at the end, where it is not there yet or of other tracks. Without it the tracks are looked
        at all the same, and ``on_event`` takes what speaks against them (:class:`tract_dask.progress.Noticed`).
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
    settings = with_whole_paths(settings or RunSettings())
    outputs = RunFolder(Path(output).absolute())
    check_stage(until)
    attempt = partial(persist, send=on_event, file=str(outputs.root))
    opening = partial(open_input, source, settings, None if overwrite else outputs.movie, permit)
    with closing(attempt(opening)) as opened:
        attempt(partial(check_inputs, opened.shape, settings))
        attempt(partial(check_references, opened, settings.convert, settings.metadata))
        if plan_only:
            plan = plan_run(opened.shape, opened.dtype, settings, expected_limit(settings, client))
            return RunOutcome(outputs, plan, RunState.PLANNED, plan.frames)
        attempt(partial(check_output, outputs, opened, settings, overwrite=overwrite))
        with ExitStack() as stack:
            attempt(lambda: stack.enter_context(sole_run(outputs, patience_s)))
            if overwrite:
                same = attempt(lambda: metadata.is_sound(outputs.movie) and is_movie_of(outputs.movie, opened))
                attempt(partial(clear_run, outputs, on_event, keep_edited=same))
            part = dataclasses.asdict(opened.metadata.part) if opened.metadata.part else None
            attempt(partial(check_edited, outputs.columns, settings.columns, opened.shape[1:], part))
            return _run(opened, outputs, settings, client, on_event, report=report, until=until)


def _run(
    source: FrameSource,
    outputs: RunFolder,
    settings: RunSettings,
    client: Client | None,
    on_event: Sink,
    *,
    report: bool,
    until: str | None,
) -> RunOutcome:
    """Run the stages in their order, and stop after ``until``."""
    record, made = Record(), _Made()
    send = tee((record, JsonLines(outputs.events, on_event, is_held), on_event))
    plan = plan_run(source.shape, source.dtype, settings)
    with Session(source.path, outputs.root, settings.cluster, client, send, plan) as session:
        session.attempt(partial(files.write_aside, outputs.settings, _run_toml(settings, {}).encode()))
        for stage in _stages(source, outputs, settings, session, made):
            if stage == until:
                break
        session.finish_aside()
        if made.movie is None or made.summary is None:
            session.state = RunState.STOPPED
        else:
            session.attempt(partial(_complete_toml, outputs, settings, made.movie, made.columns))
            session.state = RunState.DONE_WITH_BAD_FRAMES if made.summary.bad_frames else RunState.DONE
            session.message = "" if record.seconds else "all was done before: nothing to do"
            made.findings = _look(outputs, session, page=report)
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
        made.findings,
    )


@dataclass
class _Made:
    """What the stages of a run have made so far."""

    movie: Movie | None = None
    columns: xr.Dataset = field(default_factory=xr.Dataset)
    summary: FitSummary | None = None
    findings: tuple[str, ...] = ()


def _stages(
    source: FrameSource, outputs: RunFolder, settings: RunSettings, session: Session, made: _Made
) -> Iterator[str]:
    """Run the stages one by one; yield the name of each when it is done."""
    attempt, workers, send = session.attempt, session.workers, session.send
    made.movie = movie = attempt(partial(convert_stage, source, outputs.movie, settings, workers, send))
    attempt(partial(check_pixels_of, movie, settings.fit))
    yield "convert"
    drift = attempt(partial(drift_stage, movie, outputs.drift, settings.drift, workers, send))
    check_box(settings.fit.vacuum_box, movie.shape[1:], drift["drift"].to_numpy())
    yield "drift"
    summed = attempt(partial(sum_stage, movie, drift, outputs.sum, workers, send))
    made.movie = movie = open_movie(movie.path)  # its gain and offset may have been measured
    yield "sum"
    session.finish_aside()  # it imports what comes next: two threads could meet in packages that import each other

    def draw(image: xr.Dataset, found: xr.Dataset, figure: Path) -> None:
        session.aside(partial(draw_columns, image, found, figure))

    find = partial(columns_stage, summed, outputs.columns, settings.columns, settings.fit, send)
    made.columns = columns = attempt(partial(find, part=movie.part, draw=draw))
    yield "columns"
    made.summary = attempt(
        partial(fit_stage, movie, columns, drift, summed, outputs.results, settings.fit, workers, send)
    )
    yield "fit"


def _complete_toml(outputs: RunFolder, settings: RunSettings, movie: Movie, columns: xr.Dataset) -> None:
    """Write the settings once more, with what the data gave for those that were unset."""
    files.write_aside(outputs.settings, _run_toml(settings, _resolved(movie, columns, outputs)).encode())


def _look(outputs: RunFolder, session: Session, *, page: bool) -> tuple[str, ...]:
    """Look at the tracks, and tell what speaks against them; whatever goes wrong, the tracks are done."""
    from ..report.look import look  # takes its time to import

    send = session.send
    if page:
        send(StageStarted(REPORT, 0))
    began, current = perf_counter(), False
    found: list[Any] = []
    try:
        found, current = session.attempt(partial(look, outputs.root, page=page))
    except Exception as error:  # noqa: BLE001  nothing in a page of figures may undo a finished run
        files.remove(outputs.report)  # it would be of other tracks
        send(Warned(f"the report could not be made: {error}"))
    if page:
        send(StageDone(REPORT, perf_counter() - began, reused=current))
    serious = [finding for finding in found if finding.serious]
    for finding in serious:
        send(Noticed(finding.name, finding.title, finding.text, finding.remedy))
    return tuple(finding.name for finding in serious)


def clear_run(outputs: RunFolder, on_event: Sink = silent, *, keep_edited: bool = False) -> None:
    """Delete what a run writes, and nothing else; columns that were edited by hand are kept, or put away."""
    clear_columns(outputs.columns, on_event, keep_edited=keep_edited)
    stages = (outputs.movie, outputs.drift, outputs.sum, outputs.results)
    for path in stages:
        remove_journal(journal_beside(path))
        files.remove(path)
    for path in (outputs.report, outputs.settings, outputs.events):
        files.remove(path)


def _resolved(movie: Movie, columns: xr.Dataset, outputs: RunFolder) -> dict[str, Any]:
    """Return what the data gave for settings that were unset."""
    about = metadata.attributes(outputs.results)
    found = {
        "metadata.pixel_size_pm": movie.pixel_size_pm,
        "metadata.frame_time_s": movie.frame_time_s,
        "metadata.dose": movie.dose,
        "columns.spacing_px": columns.attrs.get("spacing_px"),
        "fit.window_px": about.get("window"),
        "fit.blur_sigma_px": resolve_blur(None, columns),
        "fit.vacuum_box": about.get("vacuum"),
    }
    return {name: metadata.json_ready(value) for name, value in found.items() if value is not None}


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
