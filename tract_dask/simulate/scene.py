"""What a simulated movie shows: where every column is in every frame, and the expected counts of a frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr

from ..kernels.rendering import add_columns, draw_level
from .ceria import CERIUM_AMPLITUDE, EDGE_SOFTNESS_PM, INNER_LEVEL_DROP, SIGMA_PM, Surface, amplitudes, ceria_surface

_JUMP_PROBABILITY = 0.15


@dataclass(frozen=True)
class Scene:
    """A ceria surface in motion.

    ``x``, ``y`` (px) and ``atoms`` are (frame, column), with the columns of ``surface``; ``drift`` is (frame, axis)
    from frame 0, in px; ``role`` says what a column does; ``vacuum`` is the expected count of an empty pixel.
    """

    surface: Surface
    shape: tuple[int, int]
    pixel_size_pm: float
    vacuum: float
    contrast: float
    drift: np.ndarray[Any, np.dtype[np.float64]]
    x: np.ndarray[Any, np.dtype[np.float64]]
    y: np.ndarray[Any, np.dtype[np.float64]]
    atoms: np.ndarray[Any, np.dtype[np.int8]]
    role: np.ndarray[Any, np.dtype[np.str_]]

    def expected_counts(self, frame: int) -> np.ndarray[Any, np.dtype[np.float32]]:
        """Return the noise-free image of a frame: the model at the frame's exact positions, at pixel centres."""
        image = np.empty(self.shape, dtype=np.float32)
        sigma = np.vectorize(SIGMA_PM.__getitem__)(self.surface.kind) / self.pixel_size_pm
        draw_level(image, *self._level(frame))
        height = self.vacuum * self.contrast * amplitudes(self.surface, self.atoms[frame])
        add_columns(image, self.x[frame], self.y[frame], height, sigma)
        return image

    def _level(self, frame: int) -> tuple[np.ndarray[Any, Any], ...]:
        """Return the level below the columns: its profiles along y under both terraces, the upper's share along x."""
        soft = EDGE_SOFTNESS_PM
        y = (np.arange(self.shape[0]) - self.drift[frame, 0]) * self.pixel_size_pm
        x = (np.arange(self.shape[1]) - self.drift[frame, 1]) * self.pixel_size_pm
        drop = INNER_LEVEL_DROP * self.contrast
        lower, upper = (
            self.vacuum * (1 - drop * ndtr((y - edge) / soft)) for edge in (self.surface.lower_y, self.surface.upper_y)
        )
        return lower, upper, ndtr((self.surface.step_x - x) / soft)

    @property
    def limits(self) -> tuple[float, float]:
        """Bounds of the expected counts of every frame, wide enough for two cerium columns on one place."""
        highest = 2 * CERIUM_AMPLITUDE[-1] * self.contrast
        lowest = min(0.0, highest, -INNER_LEVEL_DROP * self.contrast)
        return max(0.0, self.vacuum * (1 + lowest)), self.vacuum * (1 + abs(highest))


def moving_scene(
    shape: tuple[int, int],
    pixel_size_pm: float,
    vacuum: float,
    contrast: float,
    drift: np.ndarray[Any, np.dtype[np.float64]],
    jump_pm: float,
    rng: np.random.Generator,
) -> Scene:
    """Return a scene that drifts, in which one column at the step's edge jumps and one of the lower terrace is absent.

    The jumping column goes to and fro between its place and ``jump_pm`` to the right of it. The absent column leaves
    for a sixth of the movie, and later for a twentieth.
    """
    margin_pm = float(np.abs(drift).max()) * pixel_size_pm + 7 * max(SIGMA_PM.values())
    surface = ceria_surface(shape[0] * pixel_size_pm, shape[1] * pixel_size_pm, margin_pm)
    n_frames = len(drift)
    role = np.full(surface.x.size, "static", dtype="<U7")

    jumping = surface.cerium_near(-1, surface.step_x - 0.5 * jump_pm)
    role[jumping] = "jumping"
    x = surface.x / pixel_size_pm + drift[:, 1:]
    x[:, jumping] += jump_pm / pixel_size_pm * (np.cumsum(rng.random(n_frames) < _JUMP_PROBABILITY) % 2)

    absent = surface.cerium_near(0, surface.step_x / 0.6)
    role[absent] = "absent"
    atoms = np.repeat(surface.atoms[None], n_frames, axis=0)
    atoms[n_frames // 3 : n_frames // 2, absent] = 0
    atoms[3 * n_frames // 4 : 3 * n_frames // 4 + n_frames // 20, absent] = 0
    return Scene(
        surface, shape, pixel_size_pm, vacuum, contrast, drift, x, surface.y / pixel_size_pm + drift[:, :1], atoms, role
    )
