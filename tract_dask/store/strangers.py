"""Stores in a run's folder that were made from another movie than the one that lies beside them.

A run makes each of its stores from the movie in its folder, and every key of a stage depends on that of the movie; so
a run never takes a stranger for its own. Who copies stores by hand can mix two runs all the same. Each store therefore
remembers the key of its movie.
"""

from __future__ import annotations

from pathlib import Path

from ..errors import StoreError
from . import metadata
from .run_folder import RunFolder

MOVIE_KEY = "movie_key"
"""Attribute of drift, sum, columns and results: the key of the movie that they were made from."""

WHY = "it was made from another movie than movie.zarr, which lies next to it"


def strangers(folder: Path) -> tuple[Path, ...]:
    """Return the stores in a run's folder that were made from another movie than the one that is there.

    Stores that do not say what they were made from, as those of earlier versions, are not among them, nor are damaged
    ones.
    """
    movie, *others = RunFolder(folder).stages()
    key = _said(movie, "key")
    return tuple(store for store in others if key and (made := _said(store, MOVIE_KEY)) and made != key)


def _said(store: Path, name: str) -> str:
    """Return what a store says of itself under a name; "" where it says nothing, or is damaged."""
    try:
        return str(metadata.attributes(store).get(name) or "")
    except (StoreError, OSError):
        return ""


def advice(folder: Path) -> str:
    """Return what to do about strangers, as a sentence without its full stop."""
    return f"Move the stores of one of the two runs out of {folder}, or put the movie back that was there"
