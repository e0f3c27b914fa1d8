"""The service for tests: the whole application without the processes that run jobs, on a port where streams matter."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
from fastapi import FastAPI

from tract_dask.service.api.column_desk import Threads
from tract_dask.service.app import create_app
from tract_dask.service.config import ServiceConfig
from tract_dask.service.services import Services
from tract_dask.service.views.exports import Exports

URL = "http://127.0.0.1:8000/api/v1"
FRAMES = (12, 48, 40)


class Here(Threads):
    """A process pool without processes: work is done in a thread."""

    async def run_long(self, function: Callable[..., Any], *args: Any, **limits: Any) -> Any:
        return await asyncio.to_thread(function, *args)


def make_root(root: Path) -> Path:
    """A data root with a movie, a table of columns, a raw file, and a folder of an earlier run's."""
    root.mkdir(exist_ok=True)
    movie = np.random.default_rng(0).integers(0, 200, FRAMES).astype(np.uint8)
    np.save(root / "movie.npy", movie)
    movie.tofile(root / "movie.raw")
    (root / "sub").mkdir()
    np.save(root / "sub" / "other.npy", movie[:3])
    (root / "sub" / "columns.csv").write_text("x,y\n10,12\n30.5,20\n")
    (root / "notes.txt").write_text("nothing that can be opened")
    return root


def make_app(root: Path, **config: Any) -> FastAPI:
    app = create_app(ServiceConfig(root, **config))
    services: Services = app.state.services
    services.pool = Here()
    services.exports = Exports(services.config.state / "exports", services.pool)
    return app


@contextmanager
def listening(root: Path, **config: Any) -> Iterator[tuple[str, FastAPI]]:
    """Serve on a free port of the loopback; no jobs are run."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        app = make_app(root, port=port, **config)
        server = uvicorn.Server(uvicorn.Config(app, lifespan="off", log_level="error", timeout_graceful_shutdown=1))
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        try:
            yield f"http://127.0.0.1:{port}", app
        finally:
            app.state.services.streams.close()
            server.should_exit = True
            thread.join()
