"""A model of a CeO2 nanoparticle's surface seen along [110], with its (111) rows horizontal and vacuum above."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

FloatArray: TypeAlias = np.ndarray[Any, np.dtype[np.float64]]

LATTICE_PM = 541.1
"""Lattice constant of ceria."""

ROW_PITCH_PM = LATTICE_PM * np.sqrt(3 / 8)
"""Distance between neighbouring cerium columns of one (111) row: 331.4 pm."""

ROW_SPACING_PM = LATTICE_PM / np.sqrt(3)
"""Distance between (111) rows: 312.4 pm."""

ROW_SHIFT_PM = ROW_PITCH_PM / 3
"""Every row lies this much to the left of the row above it: 110.5 pm."""

SIGMA_PM = {"Ce": 28.0, "O": 25.0}
"""Apparent width of the columns."""

CERIUM_AMPLITUDE = (0.0, 1.0, 1.7, 2.4, 3.1, 3.7, 4.2)
"""Peak height of a cerium column of 0 to 6 atoms at full contrast, in units of the vacuum's intensity."""

OXYGEN_AMPLITUDE = 0.08
"""Peak height for each oxygen atom of a column, in the same units."""

MOST_ATOMS = 6
INNER_LEVEL_DROP = 0.15
"""How much darker than vacuum the particle is between its columns, at full contrast."""

EDGE_SOFTNESS_PM = 60.0
"""Standard deviation of the edge of that darker level."""


@dataclass(frozen=True)
class Surface:
    """Columns of a particle and the outline of its surface, all in picometres from the centre of pixel (0, 0).

    ``x``, ``y``, ``atoms``, ``kind`` ("Ce" or "O") and ``row`` have one entry a column: cerium first, in reading order,
    then oxygen. ``row`` counts (111) rows downwards; 0 is the surface of the lower terrace, -1 that of the upper.
    ``upper_y`` and ``lower_y`` are the heights of the two terraces' edges, ``step_x`` is where they meet.
    """

    x: FloatArray
    y: FloatArray
    atoms: np.ndarray[Any, np.dtype[np.int8]]
    kind: np.ndarray[Any, np.dtype[np.str_]]
    row: np.ndarray[Any, np.dtype[np.int64]]
    upper_y: float
    lower_y: float
    step_x: float

    def cerium_near(self, row: int, x: float) -> int:
        """Return the index of the cerium column of ``row`` that is nearest to ``x``."""
        distance = np.where((self.kind == "Ce") & (self.row == row), np.abs(self.x - x), np.inf)
        return int(np.argmin(distance))


def ceria_surface(height_pm: float, width_pm: float, margin_pm: float) -> Surface:
    """Return the surface that fills a field of view and ``margin_pm`` around it.

    The top is vacuum, about a third of a large field. A step near the middle parts an upper terrace (left) from a lower
    one (right). The particle thickens from one atom a column at the surface's right end to six, downwards and to the
    left. Oxygen sits where fluorite has it, a quarter of [001] to either side of each cerium column, and is kept where
    at least two of its three cerium neighbours are there.
    """
    lower_y = max(0.3 * height_pm, 700.0)
    step_x = 0.45 * width_pm
    rows = np.arange(-2, int((height_pm + margin_pm - lower_y) / ROW_SPACING_PM) + 3)
    reach = rows[-1] * ROW_SHIFT_PM + margin_pm
    places = np.arange(-int(margin_pm / ROW_PITCH_PM) - 2, int((width_pm + reach) / ROW_PITCH_PM) + 3)
    row, place = np.meshgrid(rows, places, indexing="ij")
    x = 0.25 * ROW_PITCH_PM + place * ROW_PITCH_PM - row * ROW_SHIFT_PM
    y = lower_y + row * ROW_SPACING_PM

    depth = row + (x < step_x)
    thinning = np.rint(1.5 * np.clip(1 - x / width_pm, 0, 1)).astype(int)
    atoms = np.where(depth >= 0, np.clip(1 + depth + thinning, 1, MOST_ATOMS), 0)

    right, left = np.roll(atoms, -1, axis=1), np.roll(atoms, 1, axis=1)
    above, below = np.roll(atoms, 1, axis=0), np.roll(atoms, -1, axis=0)
    above[0], below[-1] = 0, MOST_ATOMS
    parts = [
        ("Ce", x, y, atoms),
        ("O", x + ROW_SHIFT_PM, y - ROW_SPACING_PM / 4, _oxygen_atoms(atoms, right, above)),
        ("O", x - ROW_SHIFT_PM, y + ROW_SPACING_PM / 4, _oxygen_atoms(atoms, left, below)),
    ]

    def inside(px: FloatArray, py: FloatArray) -> Any:
        along = (px > -margin_pm) & (px < width_pm + margin_pm)
        return along & (py > -margin_pm) & (py < height_pm + margin_pm)

    kept = [(kind, px, py, n, (n > 0) & inside(px, py)) for kind, px, py, n in parts]
    return Surface(
        x=np.concatenate([px[there] for _, px, _, _, there in kept]),
        y=np.concatenate([py[there] for _, _, py, _, there in kept]),
        atoms=np.concatenate([n[there] for _, _, _, n, there in kept]).astype(np.int8),
        kind=np.concatenate([np.full(int(there.sum()), kind) for kind, _, _, _, there in kept]),
        row=np.concatenate([row[there] for _, _, _, _, there in kept]),
        upper_y=lower_y - 1.5 * ROW_SPACING_PM,
        lower_y=lower_y - 0.5 * ROW_SPACING_PM,
        step_x=step_x,
    )


def amplitudes(surface: Surface, atoms: np.ndarray[Any, Any]) -> FloatArray:
    """Return the peak heights at full contrast of columns with ``atoms`` atoms each (last axis as in ``surface``)."""
    cerium = np.asarray(CERIUM_AMPLITUDE)[atoms]
    return np.where(surface.kind == "Ce", cerium, OXYGEN_AMPLITUDE * atoms)


def _oxygen_atoms(*neighbours: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return the atoms of an oxygen column: the mean of its cerium neighbours', none where fewer than two are there."""
    stack = np.stack(neighbours)
    return np.where((stack > 0).sum(axis=0) >= 2, stack.sum(axis=0) // len(neighbours), 0)
