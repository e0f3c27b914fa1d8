"""Intensity of a column: the integral of its Gaussian."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B

Floats = NDArray[np.float64]

INTENSITY_SCALE = {"paper": 0.9545**2, "ellipse": 1 - np.exp(-2)}
"""Share of a Gaussian inside two sigma: the paper's (a box of +-2 sigma) and that of the ellipse of Equation 5."""


def intensities(estimates: Floats, scale: str = "paper", dark_variance: float = 0.0) -> tuple[Floats, Floats]:
    """Return column intensities and their errors, in counts.

    Parameters
    ----------
    estimates
        (..., 7) parameters of Equation 1, in counts and px.
    scale
        ``paper``: Equation 3's 0.9545^2, the share of the Gaussian in a box of +-2 sigma. ``ellipse``: 1 - exp(-2), the
        share in the ellipse of radii 2 sigma, over which Equation 5 counts the background.
    dark_variance
        That of a pixel without electrons (read noise), counts^2; it counts in Equation 5 as background does.

    Notes
    -----
    Equation 3: I = scale * 2 pi A sigma_a sigma_b. Equation 5: sqrt(I + 8 pi B sigma_a sigma_b). Dark columns have
    A < 0 and I < 0; the counts inside the ellipse are then I + 4 pi B sigma_a sigma_b, and Equation 5 stands as
    it is written.
    """
    area = estimates[..., SIGMA_A] * estimates[..., SIGMA_B]
    intensity = INTENSITY_SCALE[scale] * 2 * np.pi * estimates[..., AMPLITUDE] * area
    variance = intensity + 8 * np.pi * (estimates[..., BACKGROUND] + dark_variance) * area
    return intensity, np.sqrt(np.maximum(variance, 0))
