"""Frames and summed images as pictures, at any zoom, and what values they have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field
from starlette.concurrency import run_in_threadpool

from ...errors import MissingStoreError
from ...readers.movie_files import FileList
from ...settings.run import MetadataSettings, SourceSettings
from ...settings.toml import from_dict
from ...store.damage import METADATA
from ...store.metadata import attributes
from ...store.run_folder import MOVIE, SUM
from ..data_root import DataRoot
from ..services import Served, Services
from ..views import pictures
from ..views.pictures import MAX_SIDE_PX, View
from .answers import NOT_MODIFIED, Version, kept_answer, stamp
from .column_desk import ColumnDesk, Desk
from .models import JobId, RelativePath, errors
from .requests import PartOfMovie, folder_of

router, sums = APIRouter(tags=["previews"]), APIRouter()

_NUMBER = r"-?\d{1,8}(\.\d{1,12})?"


class Levels(BaseModel):
    """What values an image has, as it is seen: zoomed out, noise is less."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "version": "0f3a9c1122334455",
                "shape": [512, 576],
                "range": [0.0, 14.2],
                "percentiles": {"0.5": 0.4, "50.0": 3.1, "99.5": 9.7},
                "counts": [12, 340, 88],
                "edges": [0.0, 4.7, 9.5, 14.2],
                "pixel_size_pm": 7.8,
            }
        }
    )

    version: str = Field(description="Another once the image has changed; give it as ``v`` with its pictures.")
    shape: list[int] = Field(min_length=2, max_length=2, description="Rows and columns of the whole image, px.")
    range: list[float] | None = Field(
        min_length=2, max_length=2, description="Smallest and largest value, counts; null: nothing exposed."
    )
    percentiles: dict[str, float] | None = Field(description="Values, in counts, by percentile.")
    counts: list[int] = Field(description="Points of the picture in each bin of the histogram.")
    edges: list[float] = Field(description="Edges of its bins, counts.")
    pixel_size_pm: float | None = Field(None, description="Size of a pixel, where it is known.")


_ERRORS = errors(400, 404, 503) | NOT_MODIFIED
_LEVELS: dict[int | str, dict[str, Any]] = _ERRORS | {200: {"model": Levels}}
_PICTURE: dict[int | str, dict[str, Any]] = _ERRORS | {
    200: {
        "description": "Grey levels: 0 (transparent) where nothing was exposed, 1 at ``low`` to 255 at ``high``.",
        "content": {"image/png": {"schema": {"type": "string", "format": "binary"}}},
    }
}


def view(
    box: Annotated[
        str,
        Query(
            pattern=f"^({_NUMBER}(,{_NUMBER}){{3}})?$",
            description="Edges x0,y0,x1,y1 in px; an integer coordinate is a pixel's centre, so the whole image is "
            "-0.5,-0.5,width-0.5,height-0.5, which is also meant by nothing.",
            examples=["-0.5,-0.5,575.5,511.5"],
        ),
    ] = "",
    width: Annotated[int, Query(ge=1, le=MAX_SIDE_PX, description="Of the picture, in its own pixels.")] = 1024,
    low: Annotated[float | None, Query(ge=-1e30, le=1e30, description="Counts that are black; else automatic.")] = None,
    high: Annotated[float | None, Query(ge=-1e30, le=1e30, description="Counts that are white.")] = None,
) -> View:
    """Return what is to be seen."""
    x0, y0, x1, y1 = map(float, box.split(",")) if box else (0.0, 0.0, 0.0, 0.0)
    return View((x0, y0, x1, y1) if box else None, width, low, high)


Seen = Annotated[View, Depends(view)]
FrameNumber = Annotated[int, Query(ge=0, le=2**53, description="Number of the frame, from 0.")]


def declared_raw(
    part: PartOfMovie,
    raw_shape: Annotated[
        str, Query(pattern=r"^(\d{1,9},\d{1,9},\d{1,9})?$", description="Frames,rows,columns of a raw binary file.")
    ] = "",
    raw_dtype: Annotated[str, Query(max_length=16, description="Pixel type of a raw binary file.")] = "",
    raw_offset: Annotated[int, Query(ge=0, le=2**53, description="Bytes to skip at its start.")] = 0,
) -> SourceSettings:
    """Return how a raw file is to be read, and which part of any movie."""
    shape = tuple(map(int, raw_shape.split(","))) if raw_shape else None
    return from_dict(
        SourceSettings, {"raw_shape": shape, "raw_dtype": raw_dtype or None, "raw_offset": raw_offset} | part
    )


def declared_gain(
    gain: Annotated[float, Query(gt=0, le=1e12, description="Electron counts for one detector unit.")] = 1.0,
) -> MetadataSettings:
    """Return what counts are."""
    return MetadataSettings(gain=gain)


MoviePath = Annotated[RelativePath, Query(min_length=1, description="The movie, relative to the data root.")]
Raw = Annotated[SourceSettings, Depends(declared_raw)]
Gain = Annotated[MetadataSettings, Depends(declared_gain)]


async def file_frame(
    services: Served, path: MoviePath, raw: Raw, gain: Gain, frame: FrameNumber = 0
) -> pictures.MovieFrame:
    """Return a frame of a file."""
    root = services.root
    place, version = await run_in_threadpool(_movie, root, path)
    return pictures.MovieFrame(root.path / path, place, raw, gain, root.permit, frame, version)


async def job_frame(job_id: JobId, services: Served, frame: FrameNumber = 0) -> pictures.MovieFrame:
    """Return a frame of a job's movie."""
    found, version = await run_in_threadpool(_job_movie, services, job_id)
    return pictures.MovieFrame(str(found[0]), *found, services.root.permit, frame, version)


FileFrame = Annotated[pictures.MovieFrame, Depends(file_frame)]
JobFrame = Annotated[pictures.MovieFrame, Depends(job_frame)]


@router.get("/files/frame.png", response_class=Response, responses=_PICTURE)
async def frame_picture(
    request: Request, services: Served, frame: FileFrame, seen: Seen, said: Version = ""
) -> Response:
    """Show a part of a frame of a movie on disk, in any format, also of a converted one."""
    return await _picture(request, services, frame, seen, said)


@router.get("/files/histogram", response_class=Response, responses=_LEVELS)
async def frame_histogram(request: Request, services: Served, frame: FileFrame, seen: Seen) -> Response:
    """Tell what values a frame has, as frame.png shows it with the same parameters."""
    return await _levels(request, services, frame, seen)


@router.get("/jobs/{job_id}/frame.png", response_class=Response, responses=_PICTURE)
async def job_frame_picture(
    request: Request, services: Served, frame: JobFrame, seen: Seen, said: Version = ""
) -> Response:
    """Show a part of a frame of a job's movie."""
    return await _picture(request, services, frame, seen, said)


@router.get("/jobs/{job_id}/histogram", response_class=Response, responses=_LEVELS)
async def job_frame_histogram(request: Request, services: Served, frame: JobFrame, seen: Seen) -> Response:
    """Tell what values a frame of a job's movie has, as its frame.png shows it with the same parameters."""
    return await _levels(request, services, frame, seen)


@sums.get("/jobs/{job_id}/sum.png", response_class=Response, responses=_PICTURE)
async def sum_picture(job_id: JobId, request: Request, desk: Desk, seen: Seen, said: Version = "") -> Response:
    """Show a part of a job's drift-corrected summed image, in counts of one frame."""
    folder, version = await run_in_threadpool(_sum, desk, job_id)
    return await kept_answer(
        request, desk.pool, "image/png", version, pictures.sum_png, folder, seen, version, about=folder, said=said
    )


@sums.get("/jobs/{job_id}/sum", response_class=Response, responses=_LEVELS)
async def sum_about(job_id: JobId, request: Request, desk: Desk, seen: Seen) -> Response:
    """Tell the size of a job's summed image, and what values it has."""
    folder, version = await run_in_threadpool(_sum, desk, job_id)
    return await kept_answer(
        request, desk.pool, "application/json", version, pictures.sum_levels, folder, seen, version, about=folder
    )


router.include_router(sums)


async def _picture(request: Request, services: Services, frame: pictures.MovieFrame, seen: View, said: str) -> Response:
    pool, make = services.pool, pictures.source_png
    return await kept_answer(request, pool, "image/png", frame.stamp, make, frame, seen, about=frame.named, said=said)


async def _levels(request: Request, services: Services, frame: pictures.MovieFrame, seen: View) -> Response:
    pool, make = services.pool, pictures.source_levels
    return await kept_answer(request, pool, "application/json", frame.stamp, make, frame, seen, about=frame.named)


def _movie(root: DataRoot, path: str) -> tuple[str | FileList, str]:
    place = root.source(path)
    return place, _version(place)


def _version(place: str | FileList) -> str:
    if isinstance(place, FileList):
        return stamp(*sorted(place.files))
    outer = Path(place.partition("::")[0])
    return stamp(outer / METADATA if outer.suffix == ".zarr" else outer)


def _job_movie(services: Services, job_id: str) -> tuple[tuple[str | FileList, SourceSettings, MetadataSettings], str]:
    """Return where the movie of a job is, converted if it is already, and its version."""
    job, converted = services.store.job(job_id), folder_of(services, job_id, MOVIE) / MOVIE
    is_part = bool(attributes(converted).get("complete"))  # the converted movie is the part that the job reads
    place = str(converted) if is_part else services.root.source(job.source)
    source = from_dict(SourceSettings, {} if is_part else job.settings.get("source", {}))
    metadata = from_dict(MetadataSettings, job.settings.get("metadata", {}))
    return (place, source, metadata), _version(place)


def _sum(desk: ColumnDesk, job_id: str) -> tuple[Path, str]:
    """Return the folder of a job, and the version of its summed image.

    Raises
    ------
    MissingStoreError
        Where there is none yet.
    """
    folder = desk.folder(job_id)
    about = folder / SUM / METADATA
    if not about.is_file():
        raise MissingStoreError(
            "there is no summed image yet", job_id, "a job whose stage sum is done", remedy="Wait for it"
        )
    return folder, stamp(about)
