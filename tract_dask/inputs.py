"""Checks of settings and small inputs against the shape of a movie, before any work: faults show in seconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .cluster import local_memory_limit
from .drift import read_drift_csv
from .errors import InputError, SettingsError
from .fit import check_counts
from .movie import Movie
from .seeds import check_inside, lattice_sites, read_columns_csv
from .settings import ColumnSettings, DriftSettings, FitSettings, RunSettings
from .vacuum import check_box
from .windows import check_window, default_window

_LENGTHS = ("spacing_px", "search_radius_px", "centroid_radius_px")
"""Settings of the columns that are lengths in the summed image."""


def check_inputs(shape: tuple[int, int, int], settings: RunSettings) -> None:
    """Check all settings of a run of a movie of ``shape`` (frames, y, x), and read its small inputs once.

    Raises
    ------
    InputError
        Naming what cannot be used, and the shape that it does not fit.
    """
    drift = check_drift(shape[0], settings.drift)
    check_columns(shape[1:], settings.columns, settings.fit.window_px)
    check_fit(shape[1:], settings.fit, drift)
    local_memory_limit(settings.cluster)


def check_drift(n_frames: int, settings: DriftSettings) -> NDArray[np.float64] | None:
    """Return the drift of a movie of ``n_frames``, (frames, 2) in px, where a file gives it.

    Raises
    ------
    InputError
        As :func:`check_inputs`.
    """
    if settings.method != "csv":
        return None
    return read_drift_csv(_required(settings.csv, "--drift-csv"), n_frames)


def check_columns(shape: tuple[int, ...], settings: ColumnSettings, window_px: int | None) -> None:
    """Check where columns are to be looked for in frames of ``shape`` (y, x), and the window of their fit.

    Raises
    ------
    SettingsError
        As :func:`check_inputs`.
    """
    if settings.method == "csv":
        table = _required(settings.csv, "--columns")
        check_inside(read_columns_csv(table), shape, str(table))
    if settings.method == "lattice":
        lattice_sites(settings.lattices, shape)
    if settings.method == "template" and settings.template is not None:
        _check_place(settings.template, shape)
    for name in _LENGTHS:
        _check_length(name, getattr(settings, name), shape)
    if window_px is not None:
        check_window(window_px, shape)
    elif settings.spacing_px is not None and settings.method != "auto":
        check_window(default_window(settings.spacing_px), shape, f", from a spacing of {settings.spacing_px:.4g} px")


def check_fit(shape: tuple[int, ...], settings: FitSettings, drift: NDArray[np.float64] | None = None) -> None:
    """Check the window and the vacuum box of fits in frames of ``shape`` (y, x).

    Parameters
    ----------
    drift
        (frames, 2) in px; None where it is not known yet: then only a box that no drift brings inside is refused.

    Raises
    ------
    SettingsError
        As :func:`check_inputs`.
    """
    if settings.window_px is not None:
        check_window(settings.window_px, shape)
    if settings.vacuum_box is not None:
        check_box(settings.vacuum_box, shape, np.zeros((1, 2)) if drift is None else drift)


def check_pixels_of(movie: Movie, settings: FitSettings) -> None:
    """Check that a converted movie holds what the fit needs.

    Raises
    ------
    SettingsError
        Where the estimator needs counts, and a pixel is negative.
    """
    if settings.estimator == "poisson":
        check_counts(movie.statistics()["frame_min"].to_numpy())


def _check_place(place: tuple[int, ...], shape: tuple[int, ...]) -> None:
    if len(place) != 2 or not (0 <= place[0] < shape[1] and 0 <= place[1] < shape[0]):
        raise SettingsError(
            "the template lies outside the frame" if len(place) == 2 else "this is not a place",
            "setting template (ColumnSettings)",
            f"x, y with x from 0 to {shape[1] - 1}, y from 0 to {shape[0] - 1}",
            str(place),
            "Give the place of a column in px of the summed image, x first",
        )


def _check_length(name: str, value: float | None, shape: tuple[int, ...]) -> None:
    if value is not None and value > max(shape):
        raise SettingsError(
            "the value is larger than the frame",
            f"setting {name} (ColumnSettings)",
            f"at most {max(shape)} px, the longer side of a frame of {shape[0]} rows and {shape[1]} columns",
            f"{value:g}",
            "Give it in px of the frame",
        )


def _required(path: str | None, option: str) -> Path:
    if path is None:
        raise InputError("method csv needs a file", "settings", option, "none", f"Give one with {option}")
    return Path(path)
