"""Images and movies with known truth: analytic columns, or multislice images where abTEM and ASE are installed."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

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


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
