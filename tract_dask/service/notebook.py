"""The column editor of the service's pages, opened from a notebook, a script or the command line.

A small service of its own answers on this machine only, under an address with a secret in it; page, API and checks are
those of :mod:`tract_dask.service`.
"""

from __future__ import annotations

import asyncio
import secrets
import socket
import tempfile
import threading
import webbrowser
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import Any

import uvicorn
import xarray as xr
from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, StreamingResponse
from starlette.applications import Starlette
from starlette.routing import Mount

from ..settings.run import ColumnSettings, FitSettings, RunSettings
from ..settings.toml import load
from ..stages.columns.find import find_columns
from ..store import datasets, files, metadata, schema
from ..store.columns import check_inside, columns_csv, parse_columns_csv, read_columns_csv
from ..store.provenance import provenance
from ..store.run_folder import RunFolder, sum_beside
from .api import columns as columns_api
from .api import previews
from .api.column_desk import ColumnDesk, Threads, column_desk
from .api.requests import own_job
from .auth import tokens
from .auth.headers import CONTENT_SECURITY_POLICY, SecurityHeaders
from .data_root import DataRoot
from .error_handlers import ErrorHandlers
from .jobs.records import Job, UnknownVersionError, utc_now
from .jobs.states import State
from .pages import static_files, templates
from .views.column_editing import Scene, scene_of

_PREFIX = "/api/v1"
_GONE_S = 3.0
"""A page that has not come back by then was closed, not loaded anew."""
_LAST_ANSWERS_S = 2
_POLICY = CONTENT_SECURITY_POLICY.replace("frame-ancestors 'none'", "frame-ancestors * vscode-webview:")
"""Notebooks show the page in a frame; who does not know the address cannot."""

_JOB = Job(
    id="0" * 10,
    number=1,
    label="",
    owner=tokens.LOCAL.name,
    source="",
    output="",
    settings={},
    curate=True,
    state=State.WAITING,
    reason="",
    stage="",
    created=utc_now(),
    started=None,
    ended=None,
    attempts=0,
    progress={},
    outcome={},
    columns_version=None,
    not_before=None,
    lost_tries=0,
)
"""The job of the columns, as the API of the editor shows it: it always waits for them."""


def edit_columns(
    summed: xr.Dataset | str | Path,
    columns: xr.Dataset | str | Path | None = None,
    settings: ColumnSettings | None = None,
    *,
    blur_sigma_px: float | None = None,
    window_px: int | None = None,
    browser: bool = False,
    on_saved: Callable[[xr.Dataset], object] | None = None,
) -> ColumnEditor:
    """Edit columns by hand on the summed image (section 2.4 of the paper), in a notebook or a browser.

    In a notebook the editor is shown where it is the last value of a cell; ``editor.columns`` are the columns that were
    saved last. In a script, ``edit_columns(summed, browser=True).wait()`` returns them once the user is done.

    Parameters
    ----------
    summed
        From :func:`tract_dask.sum_image`, or the path of a sum.zarr or of the folder of a run.
    columns
        To begin with, or the path of their table; None: those of the run, else those that the settings find.
    settings
        How columns are found and refined; None: as in the run, else the defaults.
    blur_sigma_px, window_px
        As in the fit of the frames; where the settings are those of a run, they are its own.
    browser
        Open it in the browser at once.
    on_saved
        Called with the columns of every version that is saved, in the thread of its request.

    Raises
    ------
    SettingsError, InputError
        Where there are no columns, or they lie outside the image.
    """
    if isinstance(summed, str | Path):
        place = Path(summed)
        outputs = RunFolder(place if RunFolder(place).sum.exists() else place.parent)
        is_run = place == outputs.root
        if is_run and columns is None and outputs.columns.is_file():
            columns = outputs.columns
        if is_run and settings is None and outputs.settings.is_file():
            run = load(outputs.settings)
            settings, blur_sigma_px, window_px = run.columns, run.fit.blur_sigma_px, run.fit.window_px
        summed = datasets.open_dataset(outputs.sum if is_run else place)
    settings = settings or ColumnSettings()
    schema.validate(summed, schema.SUM, "summed image")
    if columns is None:
        columns = find_columns(summed, settings, blur_sigma_px=blur_sigma_px, window_px=window_px)
    elif not isinstance(columns, xr.Dataset):
        columns = read_columns_csv(columns)
    check_inside(columns, summed["image"].shape, "columns")
    run = RunSettings(columns=settings, fit=FitSettings(blur_sigma_px=blur_sigma_px, window_px=window_px))
    return ColumnEditor(summed, columns, run, browser=browser, on_saved=on_saved)


def edit_table(table: Path, settings: RunSettings, opened: Callable[[str], object]) -> bool:
    """Let the user edit a table of columns in the browser, and wait until that is done.

    Parameters
    ----------
    table
        As :func:`tract_dask.run.one_stage.run_columns` wrote it; what is saved takes its place.
    settings
        With which it was written.
    opened
        Called with the address of the editor.

    Returns
    -------
    bool
        Whether something was saved.
    """
    with edit_columns(
        datasets.open_dataset(sum_beside(table.absolute())),
        table,
        settings.columns,
        blur_sigma_px=settings.fit.blur_sigma_px,
        window_px=settings.fit.window_px,
        on_saved=lambda columns: files.write_aside(table, columns_csv(columns).encode()),
    ) as editor:
        opened(editor.url)
        editor.open()
        editor.wait()
    return editor.saved


class ColumnEditor:
    """An open editor; made by :func:`edit_columns`.

    Attributes
    ----------
    url
        Where it is seen, on this machine; whoever has it may edit.
    columns
        Those that were saved last, as ``seeds`` for :func:`tract_dask.find_columns`; before, those to begin with.
    saved
        Whether a version was saved.
    """

    def __init__(
        self,
        summed: xr.Dataset,
        columns: xr.Dataset,
        settings: RunSettings,
        *,
        browser: bool = False,
        on_saved: Callable[[xr.Dataset], object] | None = None,
    ) -> None:
        self.columns, self.saved = columns, False
        self._on_saved = on_saved
        self._folder = tempfile.TemporaryDirectory(prefix="tract-dask-columns-")
        self._viewers, self._done = _Viewers(), threading.Event()
        root = Path(self._folder.name)
        scene = _lay_out(root, summed, columns, settings)
        desk = ColumnDesk(Versions(self._keep), Threads(), lambda _: root, lambda _: scene, self._done.set)
        secret = secrets.token_urlsafe(24)
        app = _application(root, desk, self._viewers)
        self._server = uvicorn.Server(
            uvicorn.Config(
                Starlette(routes=[Mount(f"/{secret}", app=app)]),
                log_level="warning",
                access_log=False,
                timeout_graceful_shutdown=_LAST_ANSWERS_S,
            )
        )
        listening = socket.create_server(("127.0.0.1", 0))
        self._thread = threading.Thread(
            target=self._server.run, args=([listening],), name="tract_dask column editor", daemon=True
        )
        self._thread.start()
        self.url = f"http://127.0.0.1:{listening.getsockname()[1]}/{secret}/"
        if browser:
            self.open()

    def open(self) -> None:
        """Show it in the browser."""
        webbrowser.open(self.url)

    def wait(self) -> xr.Dataset:
        """Wait until the user is done, or has closed the page; return :attr:`columns`, and close the editor.

        Raises
        ------
        KeyboardInterrupt
            Where Ctrl-C was pressed; :attr:`columns` then are those that were saved last.
        """
        try:
            while not (self._done.wait(0.2) or self._viewers.gone) and self._thread.is_alive():
                pass
        finally:
            self.close()
        return self.columns

    def close(self) -> None:
        """Close the editor; :attr:`columns` stay."""
        self._server.should_exit = True
        self._viewers.end()
        self._thread.join()
        self._folder.cleanup()

    def __enter__(self) -> ColumnEditor:
        """Return the editor, to be closed at the end of the block."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        self.close()

    def _repr_html_(self) -> str:
        """Return the editor as a frame in a notebook."""
        style = "width: 100%; height: min(80vh, 900px); border: 1px solid #8888; border-radius: 6px"
        return (
            f'<iframe src="{self.url}?frame=1" style="{style}" title="Columns"></iframe>'
            f'<p><a href="{self.url}" target="_blank" rel="noopener">Open the editor in a new tab</a></p>'
        )

    def _keep(self, table: str) -> None:
        """Take a version that was saved."""
        self.columns, self.saved = parse_columns_csv(table, "columns"), True
        if self._on_saved is not None:
            self._on_saved(self.columns)


class Versions:
    """The columns of one image, each version in memory: a store of one job, which may always go on.

    Parameters
    ----------
    saved
        Called with the table of every version that is added.
    """

    def __init__(self, saved: Callable[[str], object]) -> None:
        self._saved, self._job, self._lock = saved, _JOB, threading.Lock()
        self._kept: list[tuple[dict[str, Any], str]] = []

    def job(self, job_id: str) -> Job:
        """Return the one job that there is."""
        return self._job

    def columns_versions(self, job_id: str) -> list[dict[str, Any]]:
        """Return the versions, oldest first."""
        return [about for about, _ in self._kept]

    def columns(self, job_id: str, version: int) -> str:
        """Return a version as a CSV table.

        Raises
        ------
        UnknownVersionError
            Where there is none.
        """
        if version > len(self._kept):
            raise UnknownVersionError("there is no such version of the columns", remedy="See the list of versions")
        return self._kept[version - 1][1]

    def add_columns(self, job_id: str, csv: str, author: str, note: str = "") -> int:
        """Keep a table as the next version; return its number."""
        with self._lock:
            version, count = len(self._kept) + 1, len(csv.splitlines()) - 1
            about = {"version": version, "time": utc_now(), "author": author, "note": note, "count": count}
            self._kept.append((about, csv))
            self._saved(csv)
        return version

    def go_on(self, job_id: str, version: int) -> Job:
        """Note the version that was chosen."""
        if version:
            self.columns(job_id, version)
        self._job = replace(self._job, columns_version=version)
        return self._job


class _Viewers:
    """The pages that are open, each with a stream that ends when it is closed."""

    def __init__(self) -> None:
        self._open, self._ended = 0, False
        self._left: float | None = None

    @property
    def gone(self) -> bool:
        """Whether the page was open, and has been closed."""
        return not self._open and self._left is not None and monotonic() - self._left > _GONE_S

    def end(self) -> None:
        """Let the streams end."""
        self._ended = True

    async def stream(self) -> AsyncIterator[str]:
        """Yield a line now and then."""
        self._open += 1
        try:
            while not self._ended:
                yield ": open\n\n"
                await asyncio.sleep(0.5)
        finally:
            self._open -= 1
            self._left = monotonic()


def _lay_out(root: Path, summed: xr.Dataset, columns: xr.Dataset, settings: RunSettings) -> Scene:
    """Write the image and the columns as a run does."""
    places = RunFolder(root)
    for dataset, path in ((summed, places.sum), (columns, places.columns.with_suffix(".zarr"))):
        attributes = {name: value for name, value in dataset.attrs.items() if value is not None}
        stored = dataset.copy()
        stored.attrs = metadata.json_ready(attributes | {metadata.ATTRIBUTE: provenance("", settings.columns)})
        datasets.write_dataset(stored, path)
    return scene_of(root, settings)


def _application(root: Path, desk: ColumnDesk, viewers: _Viewers) -> SecurityHeaders:
    """Return the page, its API and its files."""
    app = FastAPI(openapi_url=None)
    app.dependency_overrides = {
        tokens.identity: lambda: tokens.LOCAL,
        own_job: lambda: _JOB,
        column_desk: lambda: desk,
    }
    ErrorHandlers(DataRoot(root)).install(app)
    for router in (previews.sums, columns_api.router):
        app.include_router(router, prefix=_PREFIX)

    @app.get("/", response_class=HTMLResponse)
    def page(request: Request) -> HTMLResponse:
        about = {"job": _JOB, "layout": "alone.html"}
        return templates.TemplateResponse(request, "columns.html", about, headers={"Content-Security-Policy": _POLICY})

    @app.get("/open")
    def stream() -> StreamingResponse:
        return StreamingResponse(viewers.stream(), media_type="text/event-stream")

    app.mount("/static", static_files)
    return SecurityHeaders(app)
