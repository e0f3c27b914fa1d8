"""Tracking of atomic columns in time-resolved TEM movies, out of core and distributed.

The public names are imported when they are first used, so that ``import tract_dask`` costs nothing.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from .cluster.forkserver import lazy_names
from .errors import check_system

if TYPE_CHECKING:
    from .analysis.dose import fit_doses, rebin_frames
    from .analysis.filters import compare_filters
    from .readers import open_source
    from .run.pipeline import run
    from .service.client import ServiceClient
    from .service.notebook import edit_columns
    from .simulate.movie import simulate_movie
    from .stages.columns.detect import detect_columns, link_detections
    from .stages.columns.find import find_columns
    from .stages.columns.sites import lattice_columns
    from .stages.convert.stage import convert
    from .stages.drift.stage import estimate_drift
    from .stages.fit.filters import filter_frames
    from .stages.fit.lazy import fit_columns
    from .stages.sum import sum_image
    from .store.movie import open_movie
    from .store.results import accepted, open_results

__version__ = "0.1.0"

_ROOMS = {
    "open_source": "io",
    "convert": "conversion",
    "open_movie": "movie",
    "estimate_drift": "drift",
    "edit_columns": "editor",
    "sum_image": "summing",
    "find_columns": "columns",
    "lattice_columns": "columns",
    "detect_columns": "detection",
    "link_detections": "detection",
    "fit_columns": "fit",
    "filter_frames": "filtering",
    "compare_filters": "comparison",
    "rebin_frames": "dose",
    "fit_doses": "dose",
    "run": "pipeline",
    "open_results": "results",
    "accepted": "results",
    "simulate_movie": "simulate",
    "ServiceClient": "client",
}

__all__ = [
    "ServiceClient",
    "accepted",
    "compare_filters",
    "convert",
    "detect_columns",
    "edit_columns",
    "estimate_drift",
    "filter_frames",
    "find_columns",
    "fit_columns",
    "fit_doses",
    "lattice_columns",
    "link_detections",
    "open_movie",
    "open_results",
    "open_source",
    "rebin_frames",
    "run",
    "simulate_movie",
    "sum_image",
]

_find, __dir__ = lazy_names(__name__, _ROOMS)


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        check_system()
    return _find(name)


if sys.platform == "win32":
    import warnings

    warnings.warn(
        "tract_dask does not run on Windows: install and run it in WSL, the Linux inside Windows", stacklevel=2
    )
