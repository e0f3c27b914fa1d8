"""Windows whose fits are to leave pixels out: filled there with what their own fits expect.

A window without data at some pixels is filled by its own fit, fitted again, and so on until the fit rests: expectation
and maximisation, whose end is the fit to the pixels that are there. A pixel that is saturated is filled with what is to
be expected of it above full scale: the end is then the fit to values of which some are only known to be high (Tobin
1958). Left out, or taken as they are, they would make the amplitude too small.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from ..kernels.filling import fill_near
from ..kernels.gaussian.model import blurred, evaluate
from ..kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from ..kernels.windows import blur_variance, cut_windows, gaussian_kernel

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Windows = NDArray[np.float32]

_RESTS_PX = 2e-3
"""A fit rests where its place changes by less, and its amplitude by less than a share of it."""
_RESTS, _MOST_ROUNDS = 2e-4, 100
_RESTS_FREE, _MOST_ROUNDS_FREE = 2e-5, 400
"""Where shapes are free, amplitude and width creep along together when the top of a column is missing."""
_LEAP, _LONGEST = 3, 0.95
"""Each third round leaps to where steps end that shrink alike, to this share of one another at most."""
_SURE = 37.0
"""Standard deviations beyond which a value above a limit is the limit."""


def fill_windows(
    raw: Windows,
    blur_sigma_px: float,
    fit: Callable[[Windows, NDArray[np.int64]], Floats],
    *,
    full_scale: float | None = None,
    counting: bool = True,
    free: bool = False,
) -> tuple[Windows, NDArray[np.int64]]:
    """Return windows after the blur, (n, size, size), and the numbers of those whose fits do not rest.

    Parameters
    ----------
    raw
        (n, side, side) pixels before the blur, with the margin that the blur reaches; NaN where missing, infinite where
        they are saturated.
    fit
        Returns the parameters (m, 7) of blurred windows (m, size, size), which are those of these numbers (m,).
    full_scale
        What saturated pixels reach; None: they are as missing ones.
    counting
        Whether a pixel's noise grows with its level.
    free
        Whether the fits' shapes are free.
    """
    rests, most_rounds = (_RESTS_FREE, _MOST_ROUNDS_FREE) if free else (_RESTS, _MOST_ROUNDS)
    margin = gaussian_kernel(blur_sigma_px).size // 2
    size, saturated = raw.shape[-1] - 2 * margin, np.isposinf(raw)
    if full_scale is None:
        saturated[:] = False
    raw = np.where(saturated, np.float32(full_scale or 0), raw)
    there = np.isfinite(raw)
    away = np.hypot(*np.indices(raw.shape[1:]) - raw.shape[1] // 2)
    own = (~there | saturated) & (away <= size / 2 + margin)
    filled = np.stack([fill_near(image) for image in raw])
    moving = np.arange(len(raw))

    def smooth(windows: Windows) -> Windows:
        corner = np.full((len(windows), 1), margin)
        return cut_windows(windows, corner, corner, size, blur_sigma_px)[:, 0]

    estimates = np.array(fit(smooth(filled), moving))
    last = np.zeros_like(estimates)
    for number in range(most_rounds):
        model = _before(estimates[moving], blur_sigma_px, margin, raw.shape[-1])
        if saturated.any():
            known = there[moving] & ~saturated[moving]
            noise = _noise(raw[moving], model, known, counting)
            model = np.where(saturated[moving], _above(model, noise, full_scale or 0.0), model)
        filled[moving] = np.where(own[moving], model, filled[moving])
        now, before = fit(smooth(filled[moving]), moving), estimates[moving]
        estimates[moving] = now if number % _LEAP else _ahead(now, now - before, last[moving])
        last[moving] = now - before
        steps, reach = np.abs(now - before), rests * np.abs(now[:, AMPLITUDE])
        moving = moving[(steps[:, [X, Y]].max(axis=1) > _RESTS_PX) | (steps[:, AMPLITUDE] > reach)]
        if not moving.size:
            break
    return smooth(filled), moving


def fill_holes(
    windows: Windows,
    image: Floats,
    corner: NDArray[np.int64],
    blur_sigma_px: float,
    fit: Callable[[Windows, NDArray[np.int64]], Floats],
) -> NDArray[np.int64]:
    """Fill what windows (n, h, w) of a blurred image miss, in place; return the numbers of those that do not rest.

    Parameters
    ----------
    image
        (y, x) before the blur, NaN where it is not known. Beyond the image its edge goes on.
    corner
        (n, 2) first pixels (x, y) of the windows.
    fit
        As for :func:`fill_windows`; numbers are those of the windows.
    """
    if np.isfinite(image).all():
        return np.empty(0, np.int64)
    margin, size = gaussian_kernel(blur_sigma_px).size // 2, windows.shape[1]
    padded = np.pad(image.astype(np.float32), margin, mode="edge")[None]
    raw = cut_windows(padded, corner[None, :, 1], corner[None, :, 0], size + 2 * margin, 0.0)[0]
    holed = np.flatnonzero(~np.isfinite(raw.sum(axis=(1, 2))))
    if not holed.size:
        return holed
    filled, moving = fill_windows(raw[holed], blur_sigma_px, lambda some, n: fit(some, holed[n]), free=True)
    windows[holed] = filled
    return holed[moving]


def _ahead(now: Floats, step: Floats, last: Floats) -> Floats:
    """Return where steps that shrink as the last two end, (n, 7); widths and angle stay."""
    scale = 1 / np.maximum(np.abs(now[:, AMPLITUDE : AMPLITUDE + 1]), 1e-30)
    scaled, before = (np.concatenate([part[:, [X, Y]], scale * part[:, [AMPLITUDE]]], axis=1) for part in (step, last))
    power = (before**2).sum(axis=1)
    shrink = np.clip((scaled * before).sum(axis=1) / np.maximum(power, 1e-30), 0, _LONGEST)
    ahead = now.copy()
    moved = [AMPLITUDE, X, Y, BACKGROUND]
    ahead[:, moved] += step[:, moved] * (shrink / (1 - shrink))[:, None]
    return ahead


def _before(estimates: Floats, blur_sigma_px: float, margin: int, side: int) -> Windows:
    """Return what fits expect before the blur, (n, side, side)."""
    raw = blurred(estimates, -blur_variance(blur_sigma_px))
    raw[:, [X, Y]] += margin
    return evaluate(raw, np.arange(side), np.arange(side)[:, None]).astype(np.float32)


def _noise(raw: Windows, model: Windows, known: Bools, counting: bool) -> Windows:
    """Return the standard deviation of pixels, by what those that are known miss the model by."""
    level = np.maximum(model, 1e-3 * model.max(axis=(1, 2), keepdims=True)) if counting else np.ones_like(model)
    level = np.maximum(level, np.float32(1e-30))
    with np.errstate(invalid="ignore"):
        squares = np.where(known, (raw - model) ** 2 / level, 0)
    size = squares.sum(axis=(1, 2)) / np.maximum(known.sum(axis=(1, 2)), 1)
    noise: Windows = np.sqrt(size[:, None, None] * level)
    return noise


def _above(model: Windows, noise: Windows, limit: float) -> Windows:
    """Return the mean of what is at least ``limit`` of a normal distribution about the model."""
    z = (limit - model.astype(np.float64)) / np.maximum(noise, 1e-30)
    with np.errstate(over="ignore", invalid="ignore"):
        ratio = np.exp(-0.5 * z**2 - 0.5 * np.log(2 * np.pi) - log_ndtr(-z))
        mean = np.where(z > _SURE, limit, model + noise * ratio)
    return np.maximum(mean, limit).astype(np.float32)
