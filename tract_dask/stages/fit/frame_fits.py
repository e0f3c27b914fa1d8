"""What the fits of the windows of some frames give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.intensity import Floats
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, THETA, X, Y


@dataclass(frozen=True)
class FrameFits:
    """What the windows of some frames give, (frames, columns, ...), at first in the coordinates of the windows.

    Standard errors are NaN after a filter of whole frames: there is no theory of its noise. A fit is ``held`` where a
    bound other than that of a sigma is active, and ``incomplete`` where pixels of its window are missing. Centroids are
    (y, x); strengths are those of the matched filters. Residuals (rms) are NaN where there is vacuum, and so no need of
    them; their ratio is that of the sums of squares to what noise of size 1 has. Standard errors are for noise of size
    1 until :meth:`with_noise`.
    """

    estimates: Floats
    stderr: Floats
    volume_stderr: Floats
    r_squared: NDArray[np.float32]
    n_iterations: NDArray[np.int16]
    converged: NDArray[np.bool_]
    at_bound: NDArray[np.bool_]
    held: NDArray[np.bool_]
    centroid: Floats
    strength: Floats
    residual: Floats
    ratio: Floats
    incomplete: NDArray[np.bool_]

    @classmethod
    def joined(cls, parts: Sequence[FrameFits], shape: tuple[int, ...]) -> FrameFits:
        """Return fits of successive windows, (windows, ...), as those of ``shape`` (frames, columns)."""
        fields = {name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])}
        return cls(**{name: values.reshape(*shape, *values.shape[1:]) for name, values in fields.items()})

    def good(self, unseen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which fits have converged within their bounds, but for those that are ``unseen`` (frames, columns)."""
        return self.converged & ~(self.held | unseen)

    def without(self, outside: NDArray[np.bool_], bad: NDArray[np.bool_]) -> FrameFits:
        """Return the same with NaN for windows ``outside`` (frames, columns), and for centroids of ``bad`` frames."""
        names = ("estimates", "stderr", "volume_stderr", "r_squared", "centroid", "strength", "residual", "ratio")
        blank: dict[str, Any] = {name: vars(self)[name].copy() for name in names}
        for values in blank.values():
            values[outside] = np.nan
        blank["centroid"][bad] = np.nan
        return replace(self, **blank, n_iterations=self.n_iterations * ~outside)

    def with_noise(self, size: Floats) -> FrameFits:
        """Return the same with the standard errors that noise of this size (frames,) makes."""
        factor = np.sqrt(size)[:, None]
        stderr = self.stderr * factor[..., None]
        stderr[..., THETA] = np.minimum(stderr[..., THETA], np.pi / 2)
        return replace(self, stderr=stderr, volume_stderr=self.volume_stderr * factor)

    def moved(self, offset: NDArray[Any]) -> FrameFits:
        """Return the same with positions moved by ``offset`` in (y, x), (frames, columns or 1, 2)."""
        estimates = self.estimates.copy()
        estimates[..., [Y, X]] += offset
        return replace(self, estimates=estimates, centroid=self.centroid + offset)

    def scaled(self, unit: float) -> FrameFits:
        """Return the same with amplitudes, backgrounds and the errors of volumes times ``unit``, a power of two."""
        factor = np.ones(7)
        factor[[AMPLITUDE, BACKGROUND]] = unit
        counts: dict[str, Any] = {name: vars(self)[name] * factor for name in ("estimates", "stderr")}
        return replace(self, **counts, volume_stderr=self.volume_stderr * unit)
