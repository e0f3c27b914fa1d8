"""What fits of all frames have in common: the error of the shape that was taken from the summed image.

With its shape held, a column's volume V goes wrong by g dS where its covariances S = (xx, xy, yy) are off by dS. A
volume estimate of frames is a sum of raw pixels with the weights v, and dS one of the pixels of the summed image with
the weights s. So the mean over all frames errs as v + g s, and of that only v becomes smaller with frames that are
independent. Both are written for one frame's noise; of N frames that were summed, s has 1 / N of the variance.

So do places of columns that touch: one that is held too wide pushes its neighbour away. A column that is fitted alone
is even about its middle, and its place does not depend on its shape.

By volume and covariances, a column that is blurred is the same with the blur's variance added to xx and yy.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.correlated import alike, noise_spectrum
from ...kernels.gaussian.model import above_background, blurred
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, THETA, X, Y
from ...kernels.windows import blur_variance, disc, gaussian_kernel, spreading
from ...settings.run import FitSettings
from .groups import Groups, joint_settings

Floats = NDArray[np.float64]

_DARKEST = 0.02
"""Of the largest variance of a pixel that any has."""
_MODELS = 16
"""So many groups of one size tell what shapes do to the others."""


class ShapeErrors(NamedTuple):
    """Errors that all frames share, over a frame's own: of intensities (columns,), and of places (columns, 2)."""

    intensity: Floats
    place: Floats


def shape_errors(
    reference: Floats,
    window_px: int,
    groups: tuple[Groups, ...],
    settings: FitSettings,
    reference_blur_px: float,
    correlation: Floats | None = None,
) -> ShapeErrors:
    """Return the errors that the shape of one summed frame makes, over a frame's own.

    Of N summed frames they are smaller by sqrt(N). Zero where shapes are free.

    Parameters
    ----------
    reference
        (columns, 7) of Equation 1 as in the windows of the fits; where they are does not matter, but for groups.
    window_px
        Diameter of a column's own window.
    groups
        Touching columns, fitted together in the summed image and in the frames.
    reference_blur_px
        Sigma of the blur that the summed image went through before its fit by least squares.
    correlation
        (2 r + 1, 2 r + 1) autocorrelation of the raw pixels' noise; None: they share none.
    """
    place = np.zeros((len(reference), 2))
    if settings.shape == "free":
        return ShapeErrors(place[:, 0], place)
    blurs = reference_blur_px, settings.window_blur_px
    first, which = alike(reference)
    middle = window_px // 2
    some = reference[first]
    some[:, [X, Y]] = middle
    found = np.array([_errors(column[None], disc(window_px), blurs, settings, correlation)[0, 0] for column in some])[
        which
    ]
    together = joint_settings(settings)
    for of_size in groups:
        own = reference[of_size.members]
        own[..., [Y, X]] += np.array(of_size.size) // 2 - of_size.centre[:, None]
        chosen = np.unique(np.linspace(0, len(own) - 1, _MODELS).round().astype(int))
        errors = np.stack([_errors(own[k], of_size.masks[k], blurs, together, correlation) for k in chosen])
        found[of_size.members], *along = np.sqrt(np.square(errors).mean(axis=(0, 2)))
        place[of_size.members] = along
    return ShapeErrors(found, place)


def _errors(
    columns: Floats,
    mask: NDArray[np.bool_],
    blurs: tuple[float, float],
    settings: FitSettings,
    correlation: Floats | None,
) -> Floats:
    """Return errors (3, members) of volumes, x and y of columns (members, 7) that are fitted together to a mask."""
    margin = max(gaussian_kernel(blur).size for blur in blurs) // 2
    columns = columns.copy()
    columns[:, [AMPLITUDE, BACKGROUND]] /= np.abs(columns[:, AMPLITUDE]).max() or 1.0  # slopes are of about one size
    raw = blurred(columns, -blur_variance(blurs[1]))
    down, across = (np.arange(-margin, side + margin) for side in mask.shape)
    expected = above_background(raw, across, down[:, None]).sum(axis=0) + raw[:, BACKGROUND].mean()
    counted = (settings.counting or settings.estimator == "poisson") and expected.max() > 0
    variance = np.maximum(expected, _DARKEST * expected.max()) if counted else np.ones_like(expected)
    weights = 1 / variance[margin : margin + mask.shape[0], margin : margin + mask.shape[1]][mask]
    n = len(columns)
    summed, fitted = (_slopes(raw, mask, blur_variance(blur)) for blur in blurs)
    common = n > 1 and bool(np.ptp(columns[:, [SIGMA_A, SIGMA_B, THETA]], axis=0).max() < 1e-9)
    summed, shaped = (_of_common(slopes, n) if common else slopes for slopes in (summed, fitted))
    of_shapes = np.linalg.pinv(summed @ summed.T)[3 * n + 1 :] @ summed
    fitted, shaped = fitted[: 3 * n + 1], shaped[3 * n + 1 :]
    weighted = fitted * weights if settings.estimator == "poisson" else fitted
    estimates = (np.linalg.pinv(weighted @ fitted.T) @ weighted)[: 3 * n]
    wrong = estimates @ shaped.T
    own = _on_raw_pixels(estimates, mask, blurs[1], margin)
    both = own - np.einsum("vs,syx->vyx", wrong, _on_raw_pixels(of_shapes, mask, blurs[0], margin))
    alone, together = (_variances(images * np.sqrt(variance), correlation) for images in (own, both))
    return np.sqrt(np.maximum(together / alone - 1, 0)).reshape(3, n)


def _slopes(columns: Floats, mask: NDArray[np.bool_], blur: float) -> Floats:
    """Return slopes by volumes, x, y, the background, and covariances xx, xy, yy of each, (6 n + 1, pixels)."""
    y, x = (values.astype(np.float64) for values in np.nonzero(mask))
    wide = blurred(columns, blur)
    cos, sin = np.cos(columns[:, THETA]), np.sin(columns[:, THETA])
    first, second = 1 / wide[:, SIGMA_A] ** 2, 1 / wide[:, SIGMA_B] ** 2
    xx, yy = cos**2 * first + sin**2 * second, sin**2 * first + cos**2 * second
    xy = cos * sin * (second - first)
    dx, dy = x - columns[:, X, None], y - columns[:, Y, None]
    u, v = xx[:, None] * dx + xy[:, None] * dy, xy[:, None] * dx + yy[:, None] * dy
    unit = np.exp(-0.5 * (u * dx + v * dy))
    unit /= 2 * math.pi * (wide[:, SIGMA_A] * wide[:, SIGMA_B])[:, None]
    volume = 2 * math.pi * (columns[:, AMPLITUDE] * columns[:, SIGMA_A] * columns[:, SIGMA_B])[:, None]
    bends = [(u * u - xx[:, None]) / 2, u * v - xy[:, None], (v * v - yy[:, None]) / 2]
    of_shape = np.stack([volume * unit * bend for bend in bends], axis=1).reshape(-1, x.size)
    return np.concatenate([unit, volume * unit * u, volume * unit * v, np.ones((1, x.size)), of_shape])


def _of_common(slopes: Floats, n: int) -> Floats:
    """Return slopes of ``n`` columns that share one shape."""
    shape = slopes[3 * n + 1 :].reshape(n, 3, -1).sum(axis=0)
    return np.concatenate([slopes[: 3 * n + 1], shape])


def _on_raw_pixels(weights: Floats, mask: NDArray[np.bool_], blur_px: float, margin: int) -> Floats:
    """Return weights (k, pixels of the mask) of blurred pixels as those of raw ones, (k, rows, columns)."""
    images = np.zeros((len(weights), *mask.shape))
    images[:, mask] = weights
    kernel = gaussian_kernel(blur_px).astype(np.float64)
    rows, across = (spreading(side, kernel) for side in mask.shape)
    spare = margin - kernel.size // 2
    return np.pad(rows @ images @ across.T, ((0, 0), (spare, spare), (spare, spare)))


def _variances(images: Floats, correlation: Floats | None) -> Floats:
    """Return the variances of sums of noise with weights (k, rows, columns)."""
    if correlation is None:
        return np.asarray((images**2).sum(axis=(1, 2)))
    padded = tuple(2 * side for side in images.shape[1:])
    shared = np.fft.irfft2(np.fft.rfft2(images, padded) * noise_spectrum(correlation, padded), padded)
    return np.asarray((images * shared[:, : images.shape[1], : images.shape[2]]).sum(axis=(1, 2)))
