"""The summed image, made ready for finding columns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ...errors import InputError
from ...kernels.filling import fill_near
from ...kernels.magnitude import unit_of
from ...store.camera import Camera
from .contrast import SIGNS
from .lattice import Lattice, find_lattice, without_holes
from .relief import Relief, pixel_noise, relief, sample

_TOP = 0.95
"""What frames do not show, and is at least this share of the brightest that they do, is saturated."""


@dataclass(frozen=True)
class Scene:
    """The summed image, made ready: columns bright in ``image``; ``sign`` -1 where they are dark in ``counts``.

    A pixel is a number of ``unit`` counts; ``known`` tells those that some frame shows, where ``valid`` has small holes
    and saturated tops filled. ``noise`` is a pixel's, ``frame_noise`` that in a frame without a fixed pattern.
    ``lattices`` are those that were looked for, by the spacing that was given.
    """

    counts: NDArray[np.float64]
    image: NDArray[np.float64]
    valid: NDArray[np.bool_]
    known: NDArray[np.bool_]
    sign: int
    noise: float
    blur_sigma_px: float | None
    unit: float
    frame_noise: float
    lattices: dict[float | None, Lattice | None] = field(default_factory=dict)

    @property
    def dark(self) -> Scene:
        """The same for dark columns, with the same lattices: they do not depend on the contrast."""
        return replace(self, image=-self.counts, sign=SIGNS["dark"])

    def lattice(self, spacing_px: float | None = None) -> Lattice | None:
        """Return the lattice of the image, looked for once; None where it has none."""
        if spacing_px not in self.lattices:
            found = find_lattice(self.image, self.valid, self.noise, self.blur_sigma_px, spacing_px)
            self.lattices[spacing_px] = found
        return self.lattices[spacing_px]

    def relief(self, spacing: float, precision_px: float = np.inf) -> Relief:
        """Return the image in which columns stand out."""
        return relief(self.image, self.valid, self.noise, spacing, self.blur_sigma_px, precision_px)


def scene_of(summed: xr.Dataset, blur_sigma_px: float | None) -> Scene:
    """Return the summed image, made ready.

    Raises
    ------
    InputError
        Where it is empty.
    """
    counts = summed["image"].to_numpy().astype(np.float64, copy=False)
    valid = np.isfinite(counts) & (summed["exposure"].to_numpy() > 0)
    if not valid.any():
        raise InputError(
            "the summed image is empty", "columns", "exposed pixels", "none", "Check the drift: it may leave no overlap"
        )
    known = valid
    if not valid.all():
        top = _TOP * float(counts[valid].max()) if summed.attrs.get("saturated") else np.inf
        shown = np.isfinite(counts) & (valid | (counts >= top))
        valid = without_holes(shown)
        near = fill_near(np.where(shown, counts, np.nan)) if (valid & ~shown).any() else counts
        counts = np.where(shown, counts, np.where(valid, near, np.median(sample(counts[known]))))
    unit = unit_of(counts)
    counts = counts if unit == 1 else counts / unit
    noise = pixel_noise(counts, valid)
    pattern = Camera.of(summed.attrs).fixed_pattern * float(np.median(sample(counts[known])))
    frame_noise = np.sqrt(max(noise**2 - pattern**2, 0.0) * float(summed["exposure"].max()))
    return Scene(counts, counts, valid, known, SIGNS["bright"], noise, blur_sigma_px, unit, float(frame_noise))
