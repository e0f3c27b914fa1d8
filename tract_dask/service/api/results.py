"""What the jobs measured, also while they still measure: then the shards that are done."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi import Path as PathParameter
from fastapi.responses import FileResponse, StreamingResponse
from starlette.concurrency import run_in_threadpool

from ...errors import MissingStoreError
from ...store.journal import journal_beside
from ...store.run_folder import REPORT, RESULTS, SETTINGS
from ..services import Served, Services
from ..views import exports, tracks
from .answers import NOT_MODIFIED, kept_answer, stamp
from .models import JobId, errors
from .requests import folder_of
from .result_models import ColumnNumbers, Displacements, FrameNumbers, Prepared, Series, Summary

router = APIRouter(tags=["results"])

_ERRORS = errors(400, 404, 503) | NOT_MODIFIED
_REPORT_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'unsafe-inline'",
        "style-src 'unsafe-inline'",
        "img-src data: blob:",
        "font-src data:",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'self'",
        "sandbox allow-scripts allow-downloads",
    )
)
"""The report's own scripts may run, as of nobody: they reach neither the service nor anything else."""

_DOWNLOAD: dict[int | str, dict[str, Any]] = errors(400, 404, 503) | {
    200: {
        "description": "The file; with ``prepare``, whether it is ready.",
        "model": Prepared,
        "content": {kind.partition(";")[0]: {} for kind in exports.FORMATS.values()},
    }
}
_PREPARE_S = 1.0
_READ = (RESULTS, f"{RESULTS}.journal", SETTINGS)
"""What the answers are made from."""

Points = Annotated[int, Query(ge=2, le=20_000, description="Most points; longer series are averaged over frames.")]
Frame = Annotated[int, Query(ge=0, le=2**53, description="Number of a frame, from 0.")]


def _declared(model: type[Any]) -> dict[int | str, dict[str, Any]]:
    return {200: {"model": model}} | _ERRORS


@router.get("/jobs/{job_id}/results", response_class=Response, responses=_declared(Summary))
async def results_summary(job_id: JobId, request: Request, services: Served) -> Response:
    """Tell how much of a job's movie is fitted, what was measured, and how."""
    return await _answer(request, services, job_id, tracks.summary)


@router.get("/jobs/{job_id}/results/columns", response_class=Response, responses=_declared(ColumnNumbers))
async def results_columns(job_id: JobId, request: Request, services: Served) -> Response:
    """Tell of every column its place, its spread, its share of accepted fits, and its mean intensity."""
    return await _answer(request, services, job_id, tracks.columns)


@router.get("/jobs/{job_id}/results/series/{column_id}", response_class=Response, responses=_declared(Series))
async def results_series(
    job_id: JobId,
    column_id: Annotated[int, PathParameter(ge=0, le=2**53, description="Number of a column.")],
    request: Request,
    services: Served,
    start: Frame = 0,
    stop: Annotated[int | None, Query(ge=1, le=2**53, description="After the last frame; none: all.")] = None,
    points: Points = 2000,
) -> Response:
    """Show one column in time: where it was, and its intensity, of accepted fits."""
    return await _answer(request, services, job_id, tracks.series, column_id, (start, stop), points)


@router.get("/jobs/{job_id}/results/frames", response_class=Response, responses=_declared(FrameNumbers))
async def results_frames(job_id: JobId, request: Request, services: Served, points: Points = 1000) -> Response:
    """Tell of every frame its drift, its share of accepted fits, and their mean amplitude."""
    return await _answer(request, services, job_id, tracks.frames, points)


@router.get("/jobs/{job_id}/results/displacement", response_class=Response, responses=_declared(Displacements))
async def results_displacement(
    job_id: JobId, request: Request, services: Served, first: Frame, second: Frame
) -> Response:
    """Tell how far every column moved from one frame to another, and how sure that is."""
    return await _answer(request, services, job_id, tracks.displacement, first, second)


@router.get("/jobs/{job_id}/results/download", response_class=Response, responses=_DOWNLOAD)
async def download_results(
    job_id: JobId,
    request: Request,
    services: Served,
    format: Annotated[  # noqa: A002 (the name of the parameter in the address)
        Literal["zarr", "nc", "csv"], Query(description="A zipped Zarr store, netCDF 4, or a table.")
    ] = "zarr",
    prepare: Annotated[bool, Query(description="Only make the file, and tell whether it is ready.")] = False,
) -> Response:
    """Download the tracks. Zarr comes at once; for other formats a file is made first, which may take minutes."""
    path, version = await run_in_threadpool(_results, services, job_id)
    name = f"tracks-{job_id}.{'zarr.zip' if format == 'zarr' else format}"
    headers = {"Content-Disposition": f'attachment; filename="{name}"', "Cache-Control": "private, no-store"}
    if format == "zarr":
        if prepare:
            return Response(Prepared(ready=True, bytes=None).model_dump_json(), media_type="application/json")
        return StreamingResponse(exports.zipped(path), media_type=exports.FORMATS[format], headers=headers)
    made = await services.exports.made(path, version, format, _PREPARE_S if prepare else None)
    if prepare:
        ready = Prepared(ready=made is not None, bytes=made.stat().st_size if made else None)
        return Response(ready.model_dump_json(), media_type="application/json")
    assert made is not None, "it was waited for"
    return FileResponse(made, media_type=exports.FORMATS[format], headers=headers)


@router.get(
    "/jobs/{job_id}/report",
    response_class=Response,
    responses=errors(404) | {200: {"description": "One page.", "content": {"text/html": {}}}},
)
def read_report(job_id: JobId, services: Served) -> Response:
    """Show the report of a job that is done."""
    place = folder_of(services, job_id, REPORT) / REPORT
    if not place.is_file():
        raise MissingStoreError(
            "there is no report", place.parent.name, "the job to be done", remedy="Wait until the job is done"
        )
    with place.open("rb"):  # before the answer begins: a disk that does not give it is an error, and no empty page
        pass
    headers = {"Content-Security-Policy": _REPORT_POLICY, "Cache-Control": "private, no-cache"}
    return FileResponse(place, media_type="text/html; charset=utf-8", headers=headers)


async def _answer(
    request: Request, services: Services, job_id: str, function: Callable[..., bytes], *args: Any
) -> Response:
    path, version = await run_in_threadpool(_results, services, job_id)
    places: tuple[Path, ...] = (path.parent, services.config.state / "tracks")
    if function is tracks.displacement:
        places = places[:1]
    pool = services.pool
    return await kept_answer(request, pool, "application/json", version, function, *places, *args, version, about=path)


def _results(services: Services, job_id: str) -> tuple[Path, str]:
    """Return where the results of a job are, and their version.

    Raises
    ------
    MissingStoreError
        Where there are none yet.
    """
    path = folder_of(services, job_id, *_READ) / RESULTS
    if not (path / "zarr.json").is_file():
        raise MissingStoreError(
            "there are no results yet", job_id, "a job whose fits have begun", remedy="Wait for the stage fit"
        )
    return path, stamp(path / "zarr.json", journal_beside(path))
