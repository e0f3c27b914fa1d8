"""Images and movies with known truth: analytic columns, or multislice images where abTEM and ASE are installed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..cluster.forkserver import lazy_names

if TYPE_CHECKING:
    from .movie import simulate_movie
    from .multislice import multislice_image, thickness_series
    from .pictured import simulate_multislice_movie
    from .settings import PRESETS, Microscope, SpecimenSettings
    from .shipped import ceo2_image, ceo2_table
    from .structures import Specimen, as_it_is, block, ceria_slab, ceria_step, specimen_of
    from .table import tabulate

_HOME = {
    "PRESETS": "settings",
    "Microscope": "settings",
    "SpecimenSettings": "settings",
    "simulate_movie": "movie",
    "multislice_image": "multislice",
    "thickness_series": "multislice",
    "simulate_multislice_movie": "pictured",
    "ceo2_image": "shipped",
    "ceo2_table": "shipped",
    "Specimen": "structures",
    "as_it_is": "structures",
    "block": "structures",
    "ceria_slab": "structures",
    "ceria_step": "structures",
    "specimen_of": "structures",
    "tabulate": "table",
}

__all__ = [
    "PRESETS",
    "Microscope",
    "Specimen",
    "SpecimenSettings",
    "as_it_is",
    "block",
    "ceo2_image",
    "ceo2_table",
    "ceria_slab",
    "ceria_step",
    "multislice_image",
    "simulate_movie",
    "simulate_multislice_movie",
    "specimen_of",
    "tabulate",
    "thickness_series",
]


__getattr__, __dir__ = lazy_names(__name__, _HOME)
