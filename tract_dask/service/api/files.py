"""What lies under the data root."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query
from pydantic import BaseModel, ConfigDict, Field
from starlette.concurrency import run_in_threadpool

from ..checks import about_movie
from ..data_root import PAGE
from ..services import Served
from .models import RelativePath, Shape, errors
from .requests import PartOfMovie

router = APIRouter(tags=["files"])


class EntryRecord(BaseModel):
    """A line of a folder's listing."""

    model_config = ConfigDict(from_attributes=True)

    name: str
    path: str = Field(description='Relative to the data root, with "/" between.')
    kind: str = Field(description="folder, movie, file for what is neither; or unusable: its name is not UTF-8.")
    bytes: int | None = Field(description="Size of a file; null for folders and stores.")
    modified: str = Field(description="UTC, ISO 8601.")


class Listing(BaseModel):
    """A folder."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "path": "2026-11",
                "entries": [
                    {
                        "name": "ceo2_surface.tif",
                        "path": "2026-11/ceo2_surface.tif",
                        "kind": "movie",
                        "bytes": 1073742336,
                        "modified": "2026-11-21T09:12:44Z",
                    }
                ],
                "next": None,
            }
        }
    )

    path: str
    entries: list[EntryRecord]
    next: str | None = Field(description="What to give as ``after`` for the next page; null: this is the last.")


class About(BaseModel):
    """What a movie says about itself."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "path": "2026-11/ceo2_surface.tif",
                "format": "TIFF",
                "files": 1,
                "shape": [2048, 1024, 1024],
                "dtype": "uint8",
                "bytes": 2147483648,
                "pixel_size_pm": 8.0,
                "frame_time_s": 0.025,
                "time_stamps": False,
                "file_pixel_size_pm": 8.0,
                "file_frame_time_s": 0.025,
                "dose": None,
                "gain": 1.0,
                "warnings": [],
            }
        }
    )

    path: str
    format: str
    files: int = Field(description="How many files hold the frames.")
    shape: Shape
    dtype: str
    bytes: int = Field(description="Of all frames, uncompressed.")
    pixel_size_pm: float | None = Field(description="Side of a pixel in pm; null: the file does not say.")
    frame_time_s: float | None = Field(description="From one frame to the next, in s.")
    time_stamps: bool = Field(description="Whether each frame has a time stamp; ``frame_time_s`` is their usual step.")
    file_pixel_size_pm: float | None = Field(description="The same of the whole movie, before pixels are summed.")
    file_frame_time_s: float | None = Field(description="The same of the whole movie, before frames are left out.")
    dose: float | None = Field(description="Of a frame, in e/A^2.")
    gain: float = Field(description="Electron counts for one detector unit.")
    warnings: list[str] = Field(description="What the user should read.")


FolderPath = Annotated[RelativePath, Query(description="A folder under the data root; empty: the root itself.")]
MoviePath = Annotated[RelativePath, Query(min_length=1, description="A movie under the data root.")]


@router.get("/files", response_model=Listing, responses=errors(400, 404))
def list_files(
    services: Served,
    path: FolderPath = "",
    after: Annotated[
        str, Query(max_length=600, pattern="^([01][0-9a-f]*)?$", description="``next`` of the page before.")
    ] = "",
    limit: Annotated[int, Query(ge=1, le=5000, description="Entries of a page, at most.")] = PAGE,
) -> dict[str, Any]:
    """List a folder, page by page: folders first, then movies and other files, by name; hidden ones are left out."""
    page = services.root.listing(path, after, limit)
    return {"path": path, "entries": page.entries, "next": page.next}


@router.get("/files/about", response_model=About, responses=errors(400, 404, 503))
async def about_file(
    services: Served,
    path: MoviePath,
    part: PartOfMovie,
    raw_shape: Annotated[
        list[int] | None, Query(description="Of a raw file: frames, rows, columns.", min_length=3, max_length=3)
    ] = None,
    raw_dtype: Annotated[RelativePath | None, Query(description="Of a raw file, such as uint16.")] = None,
    raw_offset: Annotated[int, Query(ge=0, le=2**53, description="Of a raw file: bytes to skip.")] = 0,
) -> dict[str, Any]:
    """Read what a movie, or a part of it, says about itself, without its pixels."""
    root = services.root
    declared = {"raw_shape": raw_shape, "raw_dtype": raw_dtype, "raw_offset": raw_offset} | part
    place, file = await run_in_threadpool(root.source, path), root.path / path
    found = await services.pool.run(about_movie, place, declared, root.permit, about=file)
    return root.shown(found) | {"path": path}
