"""The free part of a column's cell: where it may be that has left its place."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.model import above_background
from ...kernels.gaussian.parameters import SIGMA_A, SIGMA_B, X, Y
from ...kernels.presence import Filters, strengths
from ...kernels.strength_maps import dense_filters

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_OF_WINDOW = 1.15
"""Columns are looked for within so many windows' diameters: where windows are half of a spacing, in all of the cell."""

_STEP = 0.75
"""Steps of the search in sigmas: at worst 7 % of a column's strength is missed."""


class Cells:
    """The cells of columns, on a grid of places about each of them.

    Parameters
    ----------
    reference
        (columns, 7) of Equation 1 as in the windows.
    filters
        The columns' matched filters.
    search_px
        How far from its place a column is looked for; None: as far as its cell goes.

    Attributes
    ----------
    step
        From one place of the grid to the next, px.
    along
        (places,) offsets of the grid from the column's place, along y and along x, px.
    """

    def __init__(self, reference: Floats, filters: Filters, search_px: float | None) -> None:
        self._reference, self._filters = reference, filters
        self.reach = _OF_WINDOW * filters.size if search_px is None else search_px
        sigma = float(np.median(np.sqrt(reference[:, SIGMA_A] * reference[:, SIGMA_B])))
        self.step = max(1, int(_STEP * sigma))
        most = int(self.reach / self.step) + 1
        self.along = self.step * np.arange(-most, most + 1)
        self._known: dict[int, tuple[Bools, float]] = {}

    @cached_property
    def _tree(self) -> object:
        from scipy.spatial import cKDTree  # takes its time, and few movies need it

        return cKDTree(self._reference[:, [Y, X]])

    def free(self, columns: Sequence[int]) -> Bools:
        """Return which places of the grid are nearer to each column (n,) than to any other, (n, places, places)."""
        return np.stack([self._of(k)[0] for k in columns])

    def expected(self, columns: Sequence[int]) -> Floats:
        """Return the strength (n,) that each column has where it is, in noise whose standard deviation is 1."""
        return np.array([self._of(k)[1] for k in columns])

    def weights(self, columns: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the columns' matched filters as images, (n, size, size)."""
        return dense_filters(self._filters, columns)

    def _of(self, column: int) -> tuple[Bools, float]:
        if column not in self._known:
            self._known[column] = self._free(column), self._expected(column)
        return self._known[column]

    def _free(self, column: int) -> Bools:
        place = self._reference[column, [Y, X]]
        near = self._tree.query_ball_point(place, 2 * self.reach)  # type: ignore[attr-defined]
        others = self._reference[[k for k in near if k != column]][:, [Y, X]] - place
        y, x = self.along[:, None], self.along
        own = np.hypot(y, x)
        free = own <= self.reach
        for other_y, other_x in others:
            free &= np.hypot(y - other_y, x - other_x) > own
        return np.asarray(free)

    def _expected(self, column: int) -> float:
        size = self._filters.size
        shape = self._reference[column : column + 1].copy()
        shape[:, [X, Y]] = size // 2
        window = above_background(shape, np.arange(size), np.arange(size)[:, None]).astype(np.float32)
        return float(strengths(window, self._filters, np.array([column]))[0])
