"""What a job would take, before it is submitted; what can be set; who would do the work."""

from __future__ import annotations

from typing import Any, Literal

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from ..checks import plan_job
from ..services import Served
from .models import RelativePath, SettingValues, Shape, errors
from .requests import Who
from .settings_schema import setting_rows

router = APIRouter(tags=["plan"])


class PlanRequest(BaseModel):
    """A movie and settings."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {"source": "2026-11/ceo2_surface.tif", "settings": {"metadata": {"pixel_size_pm": 8.0}}}
        },
    )

    source: RelativePath = Field(min_length=1, description="The movie, as in a job.")
    settings: SettingValues = Field(default_factory=dict)
    output: RelativePath = Field("", description="The folder, as in a job.")


class PlanAnswer(BaseModel):
    """What a job would take."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "frames": 2048,
                "shape": [2048, 1024, 1024],
                "dtype": "uint8",
                "shards": 8,
                "bytes_read": 6710886400,
                "bytes_written": 2415919104,
                "disk_free": 512000000000,
                "peak_memory": 860000000,
                "memory_limit": 12000000000,
                "seconds": 46.0,
                "fits": True,
                "problem": "",
            }
        }
    )

    frames: int
    shape: Shape
    dtype: str
    shards: int = Field(description="Units of work.")
    bytes_read: int = Field(description="From disk, at most.")
    bytes_written: int = Field(description="To disk, before compression.")
    disk_free: int = Field(description="Bytes that are free on the disk of the data root.")
    peak_memory: int = Field(description="Bytes that a task needs with its worker, at most.")
    memory_limit: int | None = Field(description="Bytes that a task may use; null: no limit is known.")
    seconds: float = Field(description="Estimated time of the whole run, in s, from earlier jobs where there are any.")
    fits: bool = Field(description="Whether it fits into memory and onto the disk.")
    problem: str = Field(description="Why it does not fit; empty: it does.")


class SettingRow(BaseModel):
    """A setting."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "group": "metadata",
                "title": "Metadata (otherwise as the file says)",
                "name": "pixel_size_pm",
                "type": "number",
                "items": None,
                "optional": True,
                "default": None,
                "unit": "pm",
                "description": "Size of a pixel",
                "low": 0.001,
                "high": 10000000.0,
                "choices": [],
                "words": [],
            }
        }
    )

    group: str
    title: str = Field(description="Heading of the group.")
    name: str
    type: Literal["boolean", "integer", "number", "string", "array"]
    items: Literal["integer", "object"] | None = Field(description="What an array holds.")
    optional: bool = Field(description="Whether it can be unset (null): it is measured then, or taken from the file.")
    default: Any
    unit: str
    description: str
    low: float | None
    high: float | None
    choices: list[str]
    words: list[str] = Field(description="What may stand in place of a number.")


class SettingList(BaseModel):
    """Every setting that a job can have, in groups."""

    settings: list[SettingRow]


class WorkerRecord(BaseModel):
    """What a worker does."""

    name: str
    address: str
    cpu: float = Field(description="Use of its processor, in per cent of one core.")
    memory: int = Field(description="Bytes that it holds.")
    memory_limit: int | None = Field(description="Bytes that it may hold; null or 0: no limit.")
    executing: int = Field(description="Tasks that it works on.")
    stage: str = Field(description="The stage that they belong to.")


class WorkerList(BaseModel):
    """The workers of the cluster as they were seen last."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "workers": [
                    {
                        "name": "0",
                        "address": "tcp://127.0.0.1:40123",
                        "cpu": 98.0,
                        "memory": 512000000,
                        "memory_limit": 12000000000,
                        "executing": 1,
                        "stage": "fit",
                    }
                ],
                "dashboard": True,
            }
        }
    )

    workers: list[WorkerRecord]
    dashboard: bool = Field(description="Whether Dask's own dashboard can be seen under /dask/.")


@router.post("/plan", response_model=PlanAnswer, responses=errors(400, 404, 503))
async def plan(asked: PlanRequest, services: Served, who: Who) -> dict[str, Any]:
    """Plan a job: the checks that its submission makes, what it reads and writes, and how long it takes."""
    return await plan_job(services, who.name, asked.source, asked.settings, asked.output)


@router.get("/settings", response_model=SettingList, responses=errors())
def list_settings() -> dict[str, Any]:
    """List every setting with its default, unit, range and one sentence."""
    return {"settings": setting_rows()}


@router.get("/workers", response_model=WorkerList, responses=errors())
def list_workers(services: Served) -> dict[str, Any]:
    """List the workers of the cluster and what they do."""
    cluster = services.runner.cluster
    return {"workers": cluster.workers(), "dashboard": cluster.dashboard() is not None}
