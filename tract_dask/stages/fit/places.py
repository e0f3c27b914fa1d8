"""Where the windows of columns, and the vacuum, lie in the frames of a movie."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.intensity import Floats
from ...kernels.gaussian.parameters import X, Y
from ...kernels.windows import gaussian_kernel
from .groups import Groups
from .job import Job

_NOISE_SIDE_PX = 256
"""Blurred with sigma 2 px, a square of this side has noise for 1300 independent values: its size is known to 2 %."""


class Places(NamedTuple):
    """Where the windows and the vacuum lie in some frames of a movie, from frame ``start`` on."""

    start: int
    shape: tuple[int, ...]
    """Rows and columns of a frame."""
    drift: Floats
    displaced: Floats
    """(frames, columns or 1, 2) how far (y, x) linear motion has carried the columns from there."""
    bad: NDArray[np.bool_]
    lost: NDArray[np.bool_]
    corner: NDArray[np.int64]
    """(frames, columns, 2) first row and column of each window."""
    outside: NDArray[np.bool_]
    """(frames, columns) whether it leaves the frame."""
    vacuum: NDArray[np.int64] | None
    """(frames, 3) first row, first column and side of the square whose noise is measured, if there is vacuum."""

    @classmethod
    def of(cls, frame: tuple[int, ...], start: int, stop: int, job: Job, displaced: Floats | None = None) -> Places:
        """Return where they lie in frames of that shape."""
        drift, shape = job.drift[start:stop], np.array(frame)
        displaced = np.zeros((len(drift), 1, 2)) if displaced is None else displaced
        middle = job.reference[None, :, [Y, X]] + drift[:, None] + displaced
        corner = np.rint(middle).astype(np.int64) - job.window_px // 2
        outside = np.any((corner < 0) | (corner + job.window_px > shape), axis=-1)
        lost = np.isin(np.arange(start, stop), job.lost) & ~job.bad[start:stop]
        return cls(
            start, frame, drift, displaced, job.bad[start:stop], lost, corner, outside, _vacuum(job, drift, shape)
        )

    def boxes(self, job: Job) -> NDArray[np.int64]:
        """Return what is needed of the frames, as :meth:`Movie.read_tiles` takes it."""
        halo = gaussian_kernel(job.settings.noise_blur_px).size // 2
        corner = self.corner[~self.outside]
        boxes = [np.concatenate([corner - halo, corner + job.window_px + halo], axis=-1)]
        for groups in job.groups:
            corner = group_corners(groups, self.drift, self.displaced, self.shape).reshape(-1, 2)
            boxes.append(np.concatenate([corner - halo, corner + np.array(groups.size) + halo], axis=-1))
        if self.vacuum is not None:
            first, side = self.vacuum[:, :2], self.vacuum[:, 2:]
            boxes.append(np.concatenate([first - halo, first + side + halo], axis=-1))
        return np.concatenate(boxes)


def _vacuum(job: Job, drift: Floats, shape: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """Return where the noise is measured: in each frame the first row and column, and the side, of a square; (f, 3).

    It is the middle of the vacuum box, no larger than what the noise takes, moved with the drift and kept inside the
    frame. None where there is no vacuum.
    """
    if job.vacuum is None:
        return None
    y0, y1, x0, x1 = job.vacuum
    side = min(y1 - y0, x1 - x0, _NOISE_SIDE_PX)
    corner = np.array([y0 + y1 - side, x0 + x1 - side]) // 2 + np.rint(drift).astype(np.int64)
    corner = np.clip(corner, 0, shape - side)
    return np.column_stack([corner, np.full(len(corner), side)])


def group_corners(groups: Groups, drift: Floats, displaced: Floats, shape: Sequence[int]) -> NDArray[np.int64]:
    """Return the first row and column of the windows of groups, (frames, n, 2), inside frames of ``shape`` (y, x)."""
    natural = natural_corners(groups, drift, displaced)
    return np.asarray(np.clip(natural, 0, np.maximum(np.array(shape) - groups.size, 0)))


def natural_corners(groups: Groups, drift: Floats, displaced: Floats) -> NDArray[np.int64]:
    """Return the same, (frames, n, 2), as if frames had no edges."""
    carried = displaced[:, groups.members].mean(axis=2) if displaced.shape[1] > 1 else displaced
    return np.asarray(np.rint(groups.centre + drift[:, None] + carried).astype(np.int64) - np.array(groups.size) // 2)
