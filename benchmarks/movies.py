"""Simulated movies to convert and to track: uncompressed uint16 TIFFs of a ceria surface."""

from __future__ import annotations

import os
from pathlib import Path

import tifffile

from tract_dask import simulate_movie

from .sizes import Size

DOSE = 2000.0
"""Electrons for one square angstrom: a few counts a pixel, as low-dose movies have."""


def simulate(path: Path, size: Size, n_frames: int) -> Path:
    """Write a movie of ``n_frames`` frames, each drawn anew."""
    simulate_movie(
        path,
        n_frames=n_frames,
        shape=(size.field, size.field),
        pixel_size_pm=size.pixel_size_pm,
        dose=DOSE,
        seed=1,
    )
    os.sync()
    return path


def first_frames(movie: Path, n_frames: int, path: Path) -> Path:
    """Write the first frames of a movie as a movie of its own, a BigTIFF."""
    tifffile.imwrite(path, tifffile.memmap(movie, mode="r")[:n_frames], bigtiff=True, photometric="minisblack")
    os.sync()
    return path
