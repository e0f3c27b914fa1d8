"""Figures: one function each, Dataset in, matplotlib Figure out, with ``path`` to save it as well.

They are drawn without pyplot, so they leave its state alone and may be made in any thread. Positions are px of the
summed image, x to the right and y down. Matplotlib is imported with the first of them that is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..cluster.forkserver import lazy_names

if TYPE_CHECKING:
    from .columns import plot_columns, plot_sum
    from .drift import plot_drift
    from .filters import plot_filters
    from .fit import plot_fit
    from .intensity import plot_intensity, plot_intensity_against_dose, plot_repeated_error
    from .motion import plot_displacement, plot_jumps, plot_tracks
    from .occupancy import plot_look_up, plot_occupancy
    from .precision import plot_fwhm, plot_precision, plot_spread
    from .presence import plot_presence

_ROOMS = {
    "plot_columns": "columns",
    "plot_displacement": "motion",
    "plot_drift": "drift",
    "plot_filters": "filters",
    "plot_fit": "fit",
    "plot_fwhm": "precision",
    "plot_intensity": "intensity",
    "plot_intensity_against_dose": "intensity",
    "plot_jumps": "motion",
    "plot_look_up": "occupancy",
    "plot_occupancy": "occupancy",
    "plot_precision": "precision",
    "plot_presence": "presence",
    "plot_repeated_error": "intensity",
    "plot_spread": "precision",
    "plot_sum": "columns",
    "plot_tracks": "motion",
}

__all__ = [
    "plot_columns",
    "plot_displacement",
    "plot_drift",
    "plot_filters",
    "plot_fit",
    "plot_fwhm",
    "plot_intensity",
    "plot_intensity_against_dose",
    "plot_jumps",
    "plot_look_up",
    "plot_occupancy",
    "plot_precision",
    "plot_presence",
    "plot_repeated_error",
    "plot_spread",
    "plot_sum",
    "plot_tracks",
]


__getattr__, __dir__ = lazy_names(__name__, _ROOMS)
