"""Tracking of atomic columns in time-resolved TEM movies, out of core and distributed.

The public names are imported when they are first used, so that ``import tract_dask`` costs nothing.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from .lazy import lazy_names
from .system import check_system

if TYPE_CHECKING:
    from .client import ServiceClient
    from .columns import find_columns, lattice_columns
    from .comparison import compare_filters
    from .conversion import convert
    from .detection import detect_columns, link_detections
    from .dose import fit_doses, rebin_frames
    from .drift import estimate_drift
    from .editor import edit_columns
    from .filtering import filter_frames
    from .fit import fit_columns
    from .io import open_source
    from .movie import open_movie
    from .pipeline import run
    from .results import accepted, open_results
    from .simulate import simulate_movie
    from .summing import sum_image

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
