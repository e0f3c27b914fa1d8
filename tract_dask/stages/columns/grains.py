"""Columns off every lattice that was found: of another grain, where the lattice of two grains is that of neither."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ...settings.run import ColumnSettings
from .lattice import TOLERANCE, peaks_of
from .relief import Places, Relief
from .scene import Scene
from .singles import fitted_alone
from .sublattices import Extended, with_places
from .window_size import neighbour_distance

_AS_HIGH = 0.5
"""Of the columns' median height."""
_APART = 0.6
"""Of the columns' distance: what is nearer to a column belongs to it, or to a group of touching ones."""


def with_grains(scene: Scene, settings: ColumnSettings, found: Extended) -> Extended:
    """Return columns with the peaks that are half as high as they are, and far from all of them.

    Two grains together may show a lattice that neither has, with far larger cells than both: then columns lie in its
    holes, and are on none of its sites. Peaks of sublattices that were left out stay out.
    """
    period = scene.lattice(settings.spacing_px)
    spacing = period.spacing if period else found.spacing
    beside = beside_all(
        scene.relief(spacing), spacing, found.fits.places, [one.sublattice.places for one in found.left_out]
    )
    if not len(beside):
        return found
    seeds = with_places(found.seeds, beside)
    apart = neighbour_distance(seeds.places) or found.spacing
    fits = fitted_alone(scene, settings, seeds, apart, found.window_px)
    return found._replace(seeds=seeds, spacing=apart, fits=fits)


def beside_all(relief: Relief, spacing: float, columns: Places, left_out: list[Places]) -> Places:
    """Return peaks, (n, 2) of (x, y), px, strongest first, that are half as high as columns are and far from all.

    Parameters
    ----------
    relief, spacing
        In which columns were looked for, and the period of the image, px.
    columns, left_out
        (n, 2) columns, and each sublattice that was left out.
    """
    peaks, heights = peaks_of(relief, spacing)
    distance = neighbour_distance(columns)
    if not len(peaks) or distance is None:
        return np.empty((0, 2))
    away, nearest = cKDTree(peaks).query(columns)
    own = np.asarray(nearest)[np.asarray(away) < TOLERANCE * distance]
    if not len(own):
        return np.empty((0, 2))
    far = np.asarray(cKDTree(np.concatenate([columns, *left_out])).query(peaks)[0]) > _APART * distance
    return np.asarray(peaks[far & (heights >= _AS_HIGH * np.median(heights[own]))])
