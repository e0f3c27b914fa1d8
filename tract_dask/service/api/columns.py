"""Columns of a job: read, refined, edited, saved in versions.

Version 0 are the columns that the job's settings find; nothing that was saved is ever changed or overwritten.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, TypeVar

import numpy as np
from fastapi import APIRouter, Depends, Path, Request, Response
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.concurrency import run_in_threadpool

from ...errors import MissingStoreError
from ...stages.columns.sites import MOST_SITES
from ..auth.tokens import Identity, Role
from ..errors import invalid
from ..jobs.public import JobRecord, Plain, Text
from ..jobs.records import Job
from ..jobs.states import CURATABLE, State
from ..views import column_editing
from ..views.column_editing import HIGHEST_ID, LONGEST_KIND, MOST_COLUMNS, Scene
from .answers import whole
from .column_desk import ColumnStore, Desk
from .models import JobId, errors
from .requests import OwnJob, Who

router = APIRouter(tags=["columns"])

_FAR = 1e6
_Px = Annotated[float, Plain, Field(ge=-_FAR, le=_FAR, allow_inf_nan=False)]
_Place = Annotated[
    list[_Px],
    Field(min_length=2, max_length=2, description="x, y in px of the summed image; an integer is a pixel's centre."),
]
_Kind = Annotated[Text, Field(max_length=LONGEST_KIND, description="Sublattice or element, free text.")]
_Count = Annotated[int, Plain, Field(ge=1, le=100_000)]
_Number = Annotated[int, Plain, Field(ge=0, lt=HIGHEST_ID)]
_Spacing = Annotated[float, Plain, Field(ge=2, le=_FAR, allow_inf_nan=False)]


class EditedColumn(BaseModel):
    """A column as a user has it."""

    model_config = ConfigDict(extra="forbid")

    column_id: _Number | None = Field(None, description="Null: a new one, which gets a new number.")
    x: _Px = Field(description="Column of the image, px.")
    y: _Px = Field(description="Row of the image, px.")
    kind: _Kind = ""


_Columns = Annotated[list[EditedColumn], Field(min_length=1, max_length=MOST_COLUMNS)]


class FoundColumn(BaseModel):
    """A column, with what its fit in the summed image found; null where there is none."""

    column_id: int
    x: float
    y: float
    kind: str
    flags: list[str] = Field(description="What speaks against its fit: below_noise, outside_frame and so on.")
    amplitude: float | None = Field(description="Counts a frame.")
    sigma_a: float | None = Field(description="px")
    sigma_b: float | None = Field(description="px")


_EXAMPLE_COLUMN: dict[str, Any] = {"column_id": 7, "x": 120.31, "y": 88.02, "kind": "Ce"}
_EXAMPLE_FOUND: dict[str, Any] = _EXAMPLE_COLUMN | {"flags": [], "amplitude": 3.1, "sigma_a": 7.4, "sigma_b": 6.9}
_EXAMPLE_VERSION: dict[str, Any] = {
    "version": 1,
    "time": "2026-11-22T10:05:00.000Z",
    "author": "maria",
    "note": "from version 0: two at the edge removed",
    "count": 132,
}


class VersionRecord(BaseModel):
    """A version of a job's columns."""

    version: int = Field(description="0: those found automatically.")
    time: str = Field(description="UTC, ISO 8601.")
    author: str
    note: str
    count: int = Field(description="Columns.")


class Versions(BaseModel):
    """The versions of a job's columns, oldest first."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "versions": [_EXAMPLE_VERSION],
                "next_column_id": 134,
                "chosen": None,
                "state": "waiting_for_columns",
                "may_save": True,
                "may_continue": True,
            }
        }
    )

    versions: list[VersionRecord]
    next_column_id: int = Field(description="No version has a column of this number, or of a higher one.")
    chosen: int | None = Field(description="The version that is, or was, fitted; null: none chosen yet.")
    state: State = Field(description="Of the job.")
    may_save: bool = Field(description="Whether you may save a version.")
    may_continue: bool = Field(description="Whether you may let the job go on with a version.")


class Table(BaseModel):
    """A version of a job's columns."""

    model_config = ConfigDict(
        json_schema_extra={"example": {"version": 0, "columns": [_EXAMPLE_FOUND], "spacing_px": 82.8}}
    )

    version: int
    columns: list[FoundColumn]
    spacing_px: float | None = Field(description="Median distance to the nearest neighbour.")


class NewVersion(BaseModel):
    """Columns to be kept as a version."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"example": {"columns": [_EXAMPLE_COLUMN], "note": "two at the edge removed", "base": 0}},
    )

    columns: _Columns
    note: Annotated[Text, Field(max_length=500)] = ""
    base: _Number | None = Field(None, description="The version that these were made from.")


class Saved(BaseModel):
    """What was saved."""

    model_config = ConfigDict(json_schema_extra={"example": {"version": 2, "count": 131, "newer": [1]}})

    version: int
    count: int
    newer: list[int] = Field(description="Versions that were saved after the one that these columns were made from.")


class ToRefine(BaseModel):
    """Columns to be fitted in the summed image."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"example": {"columns": [_EXAMPLE_COLUMN], "spacing_px": 82.8}}
    )

    columns: _Columns
    spacing_px: _Spacing | None = Field(
        None, description="For some of the columns only: the distance between neighbours among all of them."
    )


class Refined(BaseModel):
    """Where columns are in the summed image."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {"columns": [_EXAMPLE_FOUND], "merged": [[7, 12]], "spacing_px": 82.8, "window_px": 41}
        }
    )

    columns: list[FoundColumn]
    merged: list[Annotated[list[int], Field(min_length=2, max_length=2)]] = Field(
        description="A column, and one left out because it fell together with it."
    )
    spacing_px: float
    window_px: int


class Lattice(BaseModel):
    """A lattice that three atoms define."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {
                "origin": [10, 10],
                "a": [90, 10],
                "a_count": 4,
                "b": [10, 70],
                "b_count": 3,
                "a_repeats": 12,
                "b_repeats": 9,
                "kind": "Ce",
                "beside": [[10.2, 10.1]],
            }
        },
    )

    origin: _Place
    a: _Place
    a_count: _Count = Field(description="Columns from the origin to the a-atom, the origin not counted.")
    b: _Place
    b_count: _Count = Field(description="Columns from the origin to the b-atom, the origin not counted.")
    a_repeats: _Count = Field(1, description=f"Columns along a, the origin counted; in all at most {MOST_SITES}.")
    b_repeats: _Count = Field(1, description="Columns along b.")
    kind: _Kind = ""
    beside: Annotated[list[_Place], Field(max_length=MOST_COLUMNS)] = Field(
        default_factory=list, description="Columns that are there: a site within a third of the spacing is one of them."
    )


class Sites(BaseModel):
    """The sites of a lattice in the image."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {"columns": [_EXAMPLE_FOUND], "outside": 3, "merged": 1, "spacing_px": 20.0},
        }
    )

    columns: list[FoundColumn]
    outside: int = Field(description="Sites left out because they are outside of the image.")
    merged: int = Field(description="Sites left out because there is a column already.")
    spacing_px: float


class Choice(BaseModel):
    """The version of the columns that is to be fitted."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"version": 1}})

    version: _Number = Field(description="0: the columns found automatically.")


@dataclass(frozen=True)
class Given:
    """The columns of a request: places (columns, 2), kinds and numbers, and what was said beside them.

    It never leaves the process of the pool that reads it: to pack so many values holds other requests up.
    """

    places: NDArray[np.float64]
    kinds: list[str]
    column_ids: list[int | None]
    said: dict[str, Any]

    @property
    def parts(self) -> tuple[NDArray[np.float64], list[str], list[int | None]]:
        """What :mod:`tract_dask.service.views.column_editing` takes."""
        return self.places, self.kinds, self.column_ids


M = TypeVar("M", bound=BaseModel)


def _read(model: type[M], data: bytes) -> M:
    try:
        return model.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        raise invalid(first["msg"], first["loc"]) from None


def read_columns(model: type[NewVersion] | type[ToRefine], data: bytes) -> Given:
    """Return what the body of a request says.

    Raises
    ------
    InvalidError
        Naming the first field that is missing or invalid.
    """
    found = _read(model, data)
    places = np.array([(column.x, column.y) for column in found.columns])
    kinds, ids = [column.kind for column in found.columns], [column.column_id for column in found.columns]
    return Given(places, kinds, ids, found.model_dump(exclude={"columns"}))


def read_lattice(data: bytes) -> tuple[dict[str, Any], NDArray[np.float64]]:
    """Return a lattice and the columns beside it, (columns, 2); otherwise as :func:`read_columns`."""
    found = _read(Lattice, data)
    return found.model_dump(exclude={"beside"}), np.array(found.beside)


def saved_table(scene: Scene, highest_id: int, data: bytes) -> tuple[str, int, dict[str, Any]]:
    """Return the table that is to be kept, its number of columns, and what was said beside it; for the process pool.

    New columns get numbers above ``highest_id``, of the versions that are kept, and those found automatically.
    """
    given = read_columns(NewVersion, data)
    next_id = max(highest_id, column_editing.summary(scene)["highest_id"]) + 1
    return column_editing.checked_csv(scene, *given.parts, next_id), len(given.places), given.said


def refined_table(scene: Scene, data: bytes) -> bytes:
    """Return the columns of a request refined, as JSON; for the process pool."""
    given = read_columns(ToRefine, data)
    return column_editing.refined_json(scene, *given.parts, given.said["spacing_px"])


def sites_of_lattice(scene: Scene, data: bytes) -> bytes:
    """Return the sites of the lattice of a request, as JSON; for the process pool."""
    return column_editing.lattice_json(scene, *read_lattice(data))


def _sent(model: type[BaseModel]) -> dict[str, Any]:
    """Return the declaration of a body that a route reads by itself."""
    schema = model.model_json_schema()
    known = schema.pop("$defs", {})

    def inlined(part: Any) -> Any:
        if isinstance(part, dict):
            reference = part.get("$ref")
            return (
                inlined(known[reference.rpartition("/")[2]]) if reference else {k: inlined(v) for k, v in part.items()}
            )
        return [inlined(item) for item in part] if isinstance(part, list) else part

    return {"requestBody": {"required": True, "content": {"application/json": {"schema": inlined(schema)}}}}


def _answers(model: type[BaseModel]) -> dict[int | str, dict[str, Any]]:
    """Return the declaration of a route whose answer the process pool makes."""
    return {200: {"model": model}} | errors(400, 404, 503)


VersionNumber = Annotated[int, Path(ge=0, lt=HIGHEST_ID, description="0: the columns found automatically.")]


def scene_of_job(job_id: JobId, desk: Desk) -> Scene:
    """Return the image on which the columns of a job are edited."""
    return desk.scene(job_id)


OfJob = Annotated[Scene, Depends(scene_of_job)]


@router.get("/jobs/{job_id}/columns", response_model=Versions, responses=errors(400, 404, 503))
async def list_versions(job_id: JobId, desk: Desk, scene: OfJob, who: Who) -> dict[str, Any]:
    """List the versions of a job's columns."""
    first = await desk.pool.run(column_editing.summary, scene, about=scene.sum)
    return await run_in_threadpool(_versions, desk.store, job_id, first, who)


@router.get("/jobs/{job_id}/columns/{version:int}", responses=_answers(Table))
async def read_version(job_id: JobId, version: VersionNumber, desk: Desk, scene: OfJob) -> Response:
    """Read a version of a job's columns."""
    table = await run_in_threadpool(desk.store.columns, job_id, version) if version else None
    return _json(await desk.pool.run(column_editing.version_json, scene, version, table, about=scene.sum))


@router.post(
    "/jobs/{job_id}/columns",
    status_code=201,
    response_model=Saved,
    responses=errors(400, 404, 503),
    openapi_extra=_sent(NewVersion),
)
async def save_version(own: OwnJob, request: Request, desk: Desk, scene: OfJob, who: Who) -> dict[str, Any]:
    """Keep columns as a new version of a job's."""
    saved = await run_in_threadpool(desk.store.columns_versions, own.id)
    highest = await run_in_threadpool(_highest_of, desk.store, own.id, saved)
    table, count, said = await desk.pool.run(saved_table, scene, highest, await request.body(), about=scene.sum)
    note, given_base = said["note"].strip(), said["base"]
    if given_base is not None:
        note = f"from version {given_base}: {note}" if note else f"from version {given_base}"
    version = await run_in_threadpool(desk.store.add_columns, own.id, table, who.name, note)
    base = version if given_base is None else given_base
    newer = [one["version"] for one in saved if one["version"] > base]
    return {"version": version, "count": count, "newer": newer}


@router.post("/jobs/{job_id}/columns/refine", responses=_answers(Refined), openapi_extra=_sent(ToRefine))
async def refine_columns(job_id: JobId, request: Request, desk: Desk, scene: OfJob) -> Response:
    """Fit columns in the summed image, as a run that is given them does; nothing is kept."""
    return _json(await desk.pool.run(refined_table, scene, await request.body(), about=scene.sum))


@router.post("/jobs/{job_id}/columns/lattice", responses=_answers(Sites), openapi_extra=_sent(Lattice))
async def lattice_columns(job_id: JobId, request: Request, desk: Desk, scene: OfJob) -> Response:
    """Make the sites of a lattice inside the summed image; nothing is kept."""
    return _json(await desk.pool.run(sites_of_lattice, scene, await request.body(), about=scene.sum))


@router.post("/jobs/{job_id}/continue", response_model=JobRecord, responses=errors(400, 404, 409))
def continue_job(own: OwnJob, choice: Choice, desk: Desk, scene: OfJob) -> Job:
    """Let a job that waits for columns, or has ended, fit a version of them."""
    if not scene.exists:
        raise MissingStoreError(
            "there are no columns yet", own.id, remedy="Wait until the job has found them, or try it again"
        )
    job = desk.store.go_on(own.id, choice.version)
    desk.wake()
    return job


def _versions(store: ColumnStore, job_id: str, first: dict[str, Any], who: Identity) -> dict[str, Any]:
    job, saved = store.job(job_id), store.columns_versions(job_id)
    found = {
        "version": 0,
        "time": first["created"],
        "author": "automatic",
        "note": "as the settings find them",
        "count": first["count"],
    }
    own = who.role == Role.ADMIN or who.name == job.owner
    return {
        "versions": [found, *saved],
        "next_column_id": max(first["highest_id"], _highest_of(store, job_id, saved)) + 1,
        "chosen": job.columns_version,
        "state": job.state,
        "may_save": own,
        "may_continue": own and job.state in CURATABLE,
    }


def _highest_of(store: ColumnStore, job_id: str, saved: list[dict[str, Any]]) -> int:
    return max((_highest_id(store, job_id, one["version"]) for one in saved), default=0)


@lru_cache(maxsize=4096)
def _highest_id(store: ColumnStore, job_id: str, version: int) -> int:
    """Return the highest number of a version's columns; versions never change."""
    lines = store.columns(job_id, version).splitlines()[1:]
    return max(int(line.partition(",")[0]) for line in lines)


def _json(content: bytes) -> Response:
    return whole(content, "application/json")
