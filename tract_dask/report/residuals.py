"""What the fits on the summed image leave, and whether noise explains it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..kernels.gaussian.model import evaluate
from ..kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from ..kernels.windows import blur, gaussian_kernel
from ..settings.run import FitSettings, RunSettings
from ..stages.columns.slopes import without_slopes
from ..stages.fit.goodness import p_values
from ..stages.fit.noise_size import frame_noise, window_noise
from ..store.camera import Camera

Floats = NDArray[np.float64]


class Residuals(NamedTuple):
    """What the fits on the summed image leave in their round windows, (columns,); NaN where there is none.

    Attributes
    ----------
    residual
        Root mean square, as a share of the amplitude.
    p_value
        How probable so large a residual is where the column is one Gaussian. The noise is that of the electrons, or
        what the fits of all columns leave, whichever is less.
    """

    residual: Floats
    p_value: Floats


def residuals(
    tracks: xr.Dataset, summed: xr.Dataset, gain: float = 1.0, settings: RunSettings | None = None
) -> Residuals:
    """Return what the fits on the summed image leave.

    Parameters
    ----------
    gain
        Counts of a detector unit.
    settings
        Those of the run.
    """
    fit = tracks["fit_ref"].to_numpy().astype(np.float64)
    size, sigma = int(tracks.attrs["window_px"]), float(tracks.attrs["reference_blur_px"])
    of_sum = replace(settings.fit if settings else FitSettings(), shape="free", estimator="lsq", filter="gaussian")
    of_sum = replace(of_sum, blur_sigma_px=sigma)
    dark, kernel = float(tracks.attrs.get("dark_variance") or 0.0), gaussian_kernel(sigma).astype(np.float64)
    squares, ratio = np.full((2, len(fit)), np.nan)
    for k, (_, model, left) in enumerate(residual_windows(tracks, summed, range(len(fit)))):
        inside = np.isfinite(left)
        if inside.any():
            squares[k] = np.mean(left[inside] ** 2)
            variance = np.mean(model[inside]) + dark if of_sum.counting else 1.0
            ratio[k] = squares[k] / (variance * (kernel @ kernel) ** 2) if variance > 0 else np.nan
    rows, across = (np.rint(np.nan_to_num(fit[:, at])).astype(int) for at in (Y, X))
    ratio *= np.pad(summed["exposure"].to_numpy(), size)[rows + size, across + size]
    camera = Camera.of(summed.attrs)
    electron = gain * camera.noise_per_count if camera.noise_per_count else 1.0
    chance = _p_values(ratio, fit, dark, size, of_sum, camera, electron if of_sum.counting else np.inf)
    return Residuals(np.sqrt(squares) / np.abs(fit[:, AMPLITUDE]), chance)


def _p_values(
    ratio: Floats, fit: Floats, dark: float, size: int, settings: FitSettings, camera: Camera, electron: float
) -> Floats:
    """Return the p-values of residuals whose sums of squares are ``ratio`` times those of noise of size 1."""
    known, chance = np.isfinite(ratio), np.full(len(ratio), np.nan)
    if known.any():
        own = fit[known]
        own[:, BACKGROUND] += dark
        noise = window_noise(own, size, settings, camera.shared if camera.shared.size > 1 else None)
        seen, number = frame_noise(ratio[None, known], np.ones((1, len(own)), np.bool_), noise.left, noise.free)
        least = np.fmin(seen, electron)
        number = np.where(least == seen, number, np.inf)
        chance[known] = p_values(ratio[None, known], least, noise.left, noise.level, noise.free, number)[0]
    return chance


def residual_windows(tracks: xr.Dataset, summed: xr.Dataset, which: Iterable[int]) -> Iterator[Floats]:
    """Yield what the fits on the summed image leave of the columns at the places ``which``, one by one.

    Yields
    ------
    numpy.ndarray
        (3, window, window): blurred image, model, and their difference, in counts a frame, NaN beyond the disc, and
        everywhere where the column was not fitted in the summed image. A background that rises is made even. The model
        of touching columns is that of all in the group.
    """
    window, sigma = int(tracks.attrs["window_px"]), float(tracks.attrs["reference_blur_px"])
    parameters = tracks["fit_ref"].to_numpy().astype(np.float64)
    parameters[:, [Y, X]] += summed.attrs.get("rounding_px", (0.0, 0.0))
    raw = summed["image"].to_numpy()
    flat = without_slopes(raw, parameters, 2.0 * window)
    image = blur(raw, sigma)
    half = window // 2
    rows, columns = np.mgrid[-half : half + 1, -half : half + 1]
    disc = rows**2 + columns**2 <= half**2
    groups = tracks["group"].to_numpy() if "group" in tracks else np.zeros(len(parameters), np.int64)
    for number in which:
        own = parameters[number]
        y, x = (round(own[Y]), round(own[X])) if np.isfinite(own).all() else (-1, -1)
        if min(y, x) < half or y + half >= image.shape[0] or x + half >= image.shape[1]:
            yield np.full((3, window, window), np.nan)
            continue
        here = (slice(y - half, y + half + 1), slice(x - half, x + half + 1))
        data = image[here]
        if flat is not raw:
            data = data - (raw[here] - flat[here]) + (raw[y, x] - flat[y, x])
        model = evaluate(own, columns + x, rows + y)
        for other in np.flatnonzero((groups == groups[number]) & (groups > 0)):
            if other != number:
                model += evaluate(parameters[other], columns + x, rows + y) - parameters[other, BACKGROUND]
        yield np.where(disc, np.stack([data, model, data - model]), np.nan)
