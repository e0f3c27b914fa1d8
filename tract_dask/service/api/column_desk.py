"""What the column editor works with: the jobs of the service, or one image in a notebook."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar

from fastapi import Depends

from ...settings.run import RunSettings
from ...settings.toml import from_dict
from ...store.run_folder import COLUMNS, SUM, TABLE
from ..job_settings import inside
from ..jobs.records import Job
from ..services import Served, Services
from ..views.column_editing import Scene, scene_of
from .answers import Pool
from .requests import folder_of

T = TypeVar("T")


class ColumnStore(Hashable, Protocol):
    """The versions of a job's columns; :class:`tract_dask.service.jobs.store.JobStore` is one, and says more."""

    def job(self, job_id: str) -> Job:
        """Return the job."""

    def columns_versions(self, job_id: str) -> list[dict[str, Any]]:
        """Return version, time, author, note and count of every version, oldest first."""

    def columns(self, job_id: str, version: int) -> str:
        """Return a version as a CSV table."""

    def add_columns(self, job_id: str, csv: str, author: str, note: str = "") -> int:
        """Keep a table as the next version; return its number, from 1."""

    def go_on(self, job_id: str, version: int) -> Job:
        """Let the job use a version; 0: the automatic columns."""


@dataclass(frozen=True)
class ColumnDesk:
    """Who keeps columns, who does the work, and where a job's image is; ``wake`` is called after ``go_on``."""

    store: ColumnStore
    pool: Pool
    folder: Callable[[str], Path]
    scene: Callable[[str], Scene]
    wake: Callable[[], object]


class Threads:
    """A pool of threads of this process, for one user."""

    async def run(self, function: Callable[..., T], *args: Any, about: str | Path = "") -> T:
        """Return ``function(*args)``."""
        return await asyncio.to_thread(function, *args)

    async def run_cached(self, key: str, function: Callable[..., bytes], *args: Any, about: str | Path = "") -> bytes:
        """Return ``function(*args)``, done again each time."""
        return await asyncio.to_thread(function, *args)


def column_desk(services: Served) -> ColumnDesk:
    """Return the desk of the service's jobs; a notebook has its own in place of this dependency."""
    folder, scene = partial(_folder, services), partial(_scene, services)
    return ColumnDesk(services.store, services.pool, folder, scene, services.runner.wake)


Desk = Annotated[ColumnDesk, Depends(column_desk)]
"""What a route works with."""


def _folder(services: Services, job_id: str) -> Path:
    return folder_of(services, job_id, SUM)


def _scene(services: Services, job_id: str) -> Scene:
    settings = from_dict(RunSettings, inside(services.root, services.store.job(job_id).settings))
    return scene_of(folder_of(services, job_id, SUM, COLUMNS, TABLE), settings)
