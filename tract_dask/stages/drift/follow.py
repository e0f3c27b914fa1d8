"""Following a movie's frames, each against the sum of those before, and steps that may be wrong by a whole period.

A frame is searched for within less than half a period of the lattice, so that two answers are never a period apart. A
longer step is then taken for one that is shorter by a period. What does not repeat itself (an edge, a defect, a bright
column) tells: where the frame resembles the sum less than usual, or the step is near the limit, it is compared a period
away as well.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from ...kernels.registration import Floats, Image, Spectrum, correlation, search, search_rival
from ...kernels.sums import Whole, add_shifted

TRUST = 0.5
"""Share of the usual resemblance below which a frame is not believed."""

MEMORY, _FEWEST = 16, 2
"""So many frames say what is usual, and so many at least."""

_LONG = 0.3
"""Steps longer than this share of the period may be a period off, if the other one is longer by no more than that."""

_LESS = 0.02, 4.0
"""A frame resembles the sum less than usual where its correlation is lower by so much, and by so many median
deviations."""

_APART, _FARTHEST = 0.5, 1.45
"""Rivals are so many periods from each other at least, and so many from where the frame was expected at most."""

_AS_USUAL = 0.8
"""A rival has this share of the usual correlation: what looks like no other frame is not explained by a step."""

_BETTER, _NO_CHANCE = 0.03, 4.0
"""A rival wins where its correlation is higher by so much, and by so many standard errors of the noise."""


@dataclass(frozen=True)
class Level:
    """The level that drift is measured on.

    Attributes
    ----------
    stored
        Binning of the level as it is read; 1 for the movie itself.
    fold
        Further binning after it is read.
    shape
        (y, x) of a frame of the level.
    spectrum
        Of the movie's frames on this level.
    search
        Search range, px of the level.
    search_fold
        Further binning for the search.
    unit
        By which pixels are divided (:func:`unit_of`).
    rivals
        Whether steps may be a period longer than the search range.
    """

    stored: int
    fold: int
    shape: tuple[int, int]
    spectrum: Spectrum
    search: float
    search_fold: int
    unit: float
    rivals: bool = True

    @property
    def bin(self) -> int:
        """Pixels of the movie along one side of a pixel of the level."""
        return self.stored * self.fold


class MovingSum:
    """A sum of images that move: it keeps itself where the newest is."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.total, self.origin = np.zeros(shape, np.float32), np.zeros(2, np.int64)

    def add(self, image: Image, place: Whole) -> None:
        """Add an image that lies at ``place``; move along where that is far from the origin."""
        if (np.abs(place - self.origin) > np.array(self.total.shape[-2:]) / 8).any():
            moved = np.zeros_like(self.total)
            add_shifted(moved, self.total, self.origin - place)
            self.total, self.origin = moved, place
        add_shifted(self.total, image, place - self.origin)


class Follower:
    """Follows images, binned for the search, each against the sum of those before; shifts in px of the level.

    Attributes
    ----------
    is_sure
        Whether the last image looked like those before.
    is_doubtful
        Whether its shift may be wrong by a whole period.
    """

    def __init__(self, level: Level) -> None:
        self.fold, self.reach = level.search_fold, level.search / level.search_fold
        self.sum = MovingSum((level.shape[0] // self.fold, level.shape[1] // self.fold))
        self.period = level.spectrum.period_px / self.fold if level.rivals else np.nan
        self.empty, self.is_sure, self.is_doubtful = True, True, False
        self._recent: deque[float] = deque(maxlen=MEMORY)

    def follow(self, small: Image, guess: Floats) -> tuple[Floats, float]:
        """Return the shift of an image near a guess, and its score; take it up unless it looks like no other."""
        shift, score = guess / self.fold, 1.0
        if not self.empty:
            before = shift - self.sum.origin
            dy, dx, score = search(small, self.sum.total, tuple(before), self.reach)
            dy, dx, score = self._settled(small, (dy, dx), score, (float(before[0]), float(before[1])))
            shift = np.array([dy, dx]) + self.sum.origin
            self.is_sure = not self._recent or bool(score >= TRUST * np.median(self._recent))
            if not self.is_sure:
                return guess, score
            self._recent.append(score)
        self.sum.add(small, whole(shift))
        self.empty = False
        return shift * self.fold, score

    def _settled(
        self, small: Image, shift: tuple[float, float], score: float, guess: tuple[float, float]
    ) -> tuple[float, float, float]:
        """Return the shift and the score of an image, or those a period away where it resembles the sum more there.

        White noise of n pixels moves the difference of two correlations c by sqrt(2 (1 - r) (1 - c^2) / n), with the
        correlation r of the sum with itself, so far apart.
        """
        step = float(np.hypot(shift[0] - guess[0], shift[1] - guess[1]))
        far, self.is_doubtful = step > _LONG * self.period, False
        if len(self._recent) < _FEWEST or not np.isfinite(self.period):
            return *shift, score
        usual = float(np.median(self._recent))
        less, deviations = _LESS
        spread = float(np.median(np.abs(np.array(self._recent) - usual)))
        if not (far or score < usual - max(less * usual, deviations * spread)):
            return *shift, score
        apart = _APART * self.period if step < self.reach - 1 else 1.5  # at the limit it is no answer
        apart_px = (apart, _APART * self.period)
        rival = search_rival(small, self.sum.total, shift, guess, _FARTHEST * self.period, apart_px)
        if rival is None:
            self.is_doubtful = bool(far)
            return *shift, score
        between = whole(np.array([rival.dy - shift[0], rival.dx - shift[1]]))
        alike = min(correlation(self.sum.total, self.sum.total, between), 1.0)
        best = max(rival.correlation, rival.near)
        noise = np.sqrt(max(2 * (1 - alike) * (1 - best**2), 1e-12) / small.size)
        more, clear = rival.correlation - rival.near, max(_NO_CHANCE * noise, _BETTER * best)
        if more > clear and rival.correlation > _AS_USUAL * usual:
            self.is_doubtful = rival.next_step < rival.step + _LONG * self.period
            return rival.dy, rival.dx, rival.correlation
        self.is_doubtful = bool(far and more > -clear and rival.step < step + _LONG * self.period)
        return *shift, score

    def resemblance(self, small: Image, shift: Floats) -> float:
        """Return Pearson's correlation of an image that lies at ``shift`` with the sum."""
        return correlation(small, self.sum.total, whole(shift / self.fold) - self.sum.origin)


def whole(shift: Floats) -> Whole:
    """Return shifts in whole pixels."""
    return np.rint(shift).astype(np.int64)
