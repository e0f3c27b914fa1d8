"""Dask's dashboard, loaded when somebody opens it: most runs nobody looks at, and Bokeh takes a second to import."""

from __future__ import annotations

import asyncio
from importlib import import_module
from typing import Any

from distributed.deploy import LocalCluster
from tornado.web import Application, RequestHandler

LATER = {"dashboard": False}
"""What a scheduler takes (``scheduler_kwargs``) that has an HTTP server, and no dashboard on it yet."""


def open_on_request(cluster: LocalCluster) -> None:
    """Let the first request that a scheduler started with :data:`LATER` does not know bring its dashboard."""
    scheduler = cluster.scheduler
    scheduler.http_application.add_application(Application([(r".*", _First, {"scheduler": scheduler})]))


class _First(RequestHandler):
    """Puts the dashboard into its own place, and lets the browser ask once more."""

    def initialize(self, scheduler: Any) -> None:
        self._scheduler = scheduler

    async def get(self) -> None:
        pages = await asyncio.to_thread(import_module, "distributed.dashboard.scheduler")
        routes = self._scheduler.http_application
        if self.application in routes.applications:  # not yet: several may ask at once
            routes.applications.remove(self.application)
            pages.connect(routes, self._scheduler.http_server, self._scheduler)
        self.redirect("/" + str(self.request.uri).lstrip("/"))
