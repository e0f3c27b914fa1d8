"""The windows of groups of touching columns, and what these windows do with noise."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.correlated import noise_spectrum
from ...kernels.gaussian.information import group_slopes
from ...kernels.gaussian.joint import fit_joint
from ...kernels.gaussian.model import blurred, evaluate, group_image
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from ...kernels.windows import blur_variance, gaussian_kernel, spreading
from ...settings.run import FitSettings
from ..groups import touching
from .goodness import Freedom, freedom_left

Floats = NDArray[np.float64]

_STEP = 2
"""Windows reach from their middle in steps of so many px: fewer sizes, fewer calls."""
_MODELS = 16
"""So many groups tell what windows of their size do with noise."""
_LEAST = 0.02
"""Of the largest variance of a pixel that any has."""


class Groups(NamedTuple):
    """Groups with the same number of members, in windows of the same size.

    Attributes
    ----------
    members
        (n, members) numbers of the columns.
    centre
        (n, 2) y and x of the middle of the window in the summed image, px.
    size
        Rows and columns of the windows, px, odd.
    disc
        (n, members, 2) y and x of the pixel in the middle of each member's disc, from the window's middle pixel.
    masks
        (n, rows, columns) pixels that count: those of the members' discs.
    outer
        (n, m) columns that touch members and are not of the group; -1: none.
    filters
        (n, members, pixels) weights of matched filters that the other members leave alone.
    errors
        (n, 7) true over the kernel's standard errors.
    free
        Degrees of freedom of a window's residual.
    left, level
        (n,) as :class:`.noise_size.WindowNoise` has them.
    """

    members: NDArray[np.int64]
    centre: Floats
    size: tuple[int, int]
    disc: NDArray[np.int64]
    masks: NDArray[np.bool_]
    outer: NDArray[np.int64]
    filters: NDArray[np.float32]
    free: Freedom
    errors: Floats
    left: Floats
    level: Floats


def joint_settings(settings: FitSettings) -> FitSettings:
    """Return the settings of joint fits: least squares, of counts as they are where single fits are by likelihood."""
    if settings.estimator != "poisson":
        return settings
    return replace(settings, estimator="lsq", blur_sigma_px=0.0, counting=True)


def plan_groups(
    numbers: NDArray[np.int64],
    reference: Floats,
    window_px: int,
    settings: FitSettings,
    correlation: Floats | None = None,
    frame: tuple[int, ...] | None = None,
) -> tuple[Groups, ...]:
    """Return the groups, by size.

    Parameters
    ----------
    numbers
        (columns,) group of each column; 0: alone.
    reference
        (columns, 7) of Equation 1 as in the windows.
    window_px
        Diameter of a column's own window.
    correlation
        (2 r + 1, 2 r + 1) autocorrelation of the raw pixels' noise; None: they share none.
    frame
        (y, x) pixels of a frame, which windows are no larger than; None: any size.
    """
    if not numbers.any():
        return ()
    settings = joint_settings(settings)
    near: dict[int, set[int]] = {}
    for one, other in zip(*(side.tolist() for side in touching(reference)[:2]), strict=True):
        if numbers[one] != numbers[other]:
            near.setdefault(one, set()).add(other)
            near.setdefault(other, set()).add(one)
    classes: dict[tuple[int, tuple[int, int]], list[tuple[NDArray[np.int64], Floats, list[int]]]] = {}
    for number in np.unique(numbers[numbers > 0]):
        members = np.flatnonzero(numbers == number)
        places = reference[members][:, [Y, X]]
        centre = (places.min(axis=0) + places.max(axis=0)) / 2
        reach = np.abs(np.rint(places - centre)).max(axis=0).astype(int) + window_px // 2
        rows, across = (2 * -(-int(side) // _STEP) * _STEP + 1 for side in reach)
        if frame is not None:
            rows, across = (
                min(side, whole - (whole + 1) % 2) for side, whole in zip((rows, across), frame, strict=True)
            )
        outer = sorted(set[int]().union(*(near.get(int(k), set()) for k in members)) - set(members.tolist()))
        classes.setdefault((len(members), (rows, across)), []).append((members, centre, outer))
    return tuple(
        _class(size, found, reference, window_px, settings, correlation) for (_, size), found in sorted(classes.items())
    )


def _class(
    size: tuple[int, int],
    found: list[tuple[NDArray[np.int64], Floats, list[int]]],
    reference: Floats,
    window_px: int,
    settings: FitSettings,
    correlation: Floats | None,
) -> Groups:
    members = np.stack([group for group, _, _ in found])
    centre = np.stack([middle for _, middle, _ in found])
    disc = np.rint(reference[members][..., [Y, X]] - centre[:, None]).astype(np.int64)
    masks = discs(disc, size, window_px)
    outer = np.full((len(found), max(len(others) for _, _, others in found)), -1)
    for row, (_, _, others) in zip(outer, found, strict=True):
        row[: len(others)] = others
    own = reference[members]
    own[..., [Y, X]] += np.array(size) // 2 - centre[:, None]
    own[..., BACKGROUND] = own[..., BACKGROUND].mean(axis=1)[:, None]
    errors, left, level = _noise(own, masks, settings, correlation)
    filters = _filters(own, masks, settings.window_blur_px)
    free = _freedom(own[len(own) // 2], masks[len(own) // 2], settings, correlation)
    return Groups(members, centre, size, disc, masks, outer, filters, free, errors, left, level)


def _freedom(group: Floats, mask: NDArray[np.bool_], settings: FitSettings, correlation: Floats | None) -> Freedom:
    """Return the degrees of freedom of what fits of a group (members, 7) leave in its window."""
    y, x = (values.ravel().astype(np.float64) for values in np.indices(mask.shape))
    expected, slopes = group_slopes(group, x, y)
    return freedom_left(slopes, expected, mask, settings, correlation)


def discs(centre: NDArray[np.int64], size: tuple[int, ...], window_px: int) -> NDArray[np.bool_]:
    """Return the pixels of windows (n, rows, columns) in round ones around some of theirs.

    Parameters
    ----------
    centre
        (n, members, 2) y and x of their middle pixels, from the window's middle one.
    """
    down, across = (np.arange(side) - side // 2 for side in size)
    masks = np.zeros((len(centre), *size), np.bool_)
    for k in range(centre.shape[1]):
        y, x = centre[:, k, 0, None, None], centre[:, k, 1, None, None]
        masks |= np.hypot(down[:, None] - y, across - x) <= window_px / 2
    return masks


def _filters(own: Floats, masks: NDArray[np.bool_], blur_sigma_px: float) -> NDArray[np.float32]:
    """Return matched filters (n, members, pixels) of the members (n, members, 7) in their windows.

    As in :mod:`tract_dask.kernels.presence`, with weights that give nothing on the other members either. In white noise
    of standard deviation 1 before the blur, the sum of weights times pixels has standard deviation 1.
    """
    n, members, _ = own.shape
    down, across = (np.arange(side) for side in masks.shape[1:])
    kernel = gaussian_kernel(blur_sigma_px).astype(np.float64)
    by_rows, by_columns = (spreading(side, kernel) for side in masks.shape[1:])
    filters = np.zeros((n, members, *masks.shape[1:]), np.float32)
    for k in range(n):
        shapes, narrow = own[k].copy(), blurred(own[k], -2 * blur_variance(blur_sigma_px))
        for columns in (shapes, narrow):
            columns[:, AMPLITUDE], columns[:, BACKGROUND] = np.sign(columns[:, AMPLITUDE]), 0
        mask = masks[k]
        images, weights = (evaluate(some, across, down[:, None])[:, mask] for some in (shapes, narrow))
        for m in range(members):
            others = np.vstack([np.ones(images.shape[1]), np.delete(images, m, axis=0)])
            basis = np.linalg.qr(others.T)[0]
            own_weights = np.zeros(mask.shape)
            own_weights[mask] = weights[m] - basis @ (basis.T @ weights[m])
            norm = np.sqrt(((by_rows @ own_weights @ by_columns.T) ** 2).sum())
            filters[k, m] = own_weights / max(norm, np.finfo(float).tiny)
    return filters.reshape(n, members, -1)


def _noise(
    own: Floats, masks: NDArray[np.bool_], settings: FitSettings, correlation: Floats | None
) -> tuple[Floats, Floats, Floats]:
    """Return errors (n, 7), left (n,) and level (n,) of groups (n, members, 7) in their windows.

    The errors are those of a few groups, which stand for the others that are about as wide and as far apart. Members,
    and directions, share their factors.
    """
    n, bounds = len(own), np.full(own.shape, np.inf)
    spread = np.sqrt(np.ptp(own[..., X], axis=1) ** 2 + np.ptp(own[..., Y], axis=1) ** 2) / np.sqrt(
        own[:, 0, 3] * own[:, 0, 4]
    )
    order = np.argsort(spread, kind="stable")
    chosen = order[np.unique(np.linspace(0, n - 1, _MODELS).round().astype(int))]
    nearest = np.abs(spread[:, None] - spread[chosen]).argmin(axis=1)
    grid = np.arange(masks.shape[2]), np.arange(masks.shape[1])[:, None]
    images = group_image(own[chosen], *grid)
    stated = fit_joint(
        images.astype(np.float32),
        masks[chosen],
        np.arange(len(chosen)),
        own[chosen],
        -bounds[chosen],
        bounds[chosen],
        blur_sigma_px=settings.window_blur_px,
        counting=settings.counting,
    )
    errors, left = np.ones((len(chosen), 7)), np.ones(len(chosen))
    for k, group in enumerate(own[chosen]):
        exact, left[k] = _exact(group, masks[chosen[k]], settings, correlation)
        ratio = (exact / stated.stderr[k]) ** 2
        for places in ((AMPLITUDE,), (X, Y), (BACKGROUND,)):
            factor = np.sqrt(np.mean(ratio[:, places]))
            errors[k, places] = factor if factor > 0 else 1.0
    counts = np.array([image[mask].mean() for image, mask in zip(images, masks[chosen], strict=True)])
    level = np.where(settings.counting & (counts > 0), counts, np.inf)
    level = level if correlation is None else level / correlation.sum()
    return errors[nearest], left[nearest], level[nearest]


def _exact(
    group: Floats, mask: NDArray[np.bool_], settings: FitSettings, correlation: Floats | None
) -> tuple[Floats, float]:
    """Return standard errors (members, 7) for noise of size 1, and the share of it that a fit leaves."""
    kernel = gaussian_kernel(settings.window_blur_px).astype(np.float64)
    y, x = np.nonzero(mask)
    _, flat = group_slopes(group, x.astype(float), y.astype(float))
    scale = np.sqrt((flat**2).sum(axis=1))
    images = np.zeros((len(flat), *mask.shape))
    images[:, mask] = flat / scale[:, None]
    inverse = np.linalg.pinv(images[:, mask] @ images[:, mask].T)
    reach = kernel.size // 2
    down, across = (np.arange(-reach, side + reach) for side in mask.shape)
    narrow = blurred(group, -blur_variance(settings.window_blur_px))
    raw = group_image(narrow, across, down[:, None])
    counted = settings.counting and (raw > 0).any()
    variance = np.maximum(raw, _LEAST * raw.max()) if counted else np.ones_like(raw)
    power, spread = ([spreading(side, weights) for side in mask.shape] for weights in (kernel**2, kernel))
    whole = float((power[0] @ mask.astype(float) @ power[1].T * variance).sum())
    wide = spread[0] @ images @ spread[1].T * np.sqrt(variance)
    shared = wide if correlation is None else _shared(wide, correlation)
    meat = np.einsum("iyx,jyx->ij", wide, shared)
    covariance = inverse @ meat @ inverse / np.outer(scale, scale)
    trace = whole if correlation is None else whole * _share(kernel, correlation)
    found = np.full((len(group), 7), np.nan)
    variances = covariance.diagonal()
    found[:, [X, Y, AMPLITUDE]] = np.sqrt(variances[:-1]).reshape(-1, 3)
    found[:, BACKGROUND] = np.sqrt(variances[-1])
    return found, (trace - float(np.trace(inverse @ meat))) / whole


def _shared(images: Floats, correlation: Floats) -> Floats:
    """Return images (n, y, x) convolved with the autocorrelation of the noise."""
    rows, columns = (2 * side for side in images.shape[1:])
    spectrum = noise_spectrum(correlation, (rows, columns))
    whole = np.fft.irfft2(np.fft.rfft2(images, (rows, columns)) * spectrum, (rows, columns))
    return np.asarray(whole[:, : images.shape[1], : images.shape[2]])


def _share(kernel: Floats, correlation: Floats) -> float:
    """Return the variance of blurred noise that pixels share over that of white noise of the same size."""
    lags = np.correlate(kernel, kernel, "full")
    reach = len(correlation) // 2
    lags = np.pad(lags, max(0, reach - kernel.size + 1))
    kept = lags[len(lags) // 2 - reach : len(lags) // 2 + reach + 1]
    return float((correlation * np.outer(kept, kept)).sum()) / float(lags[len(lags) // 2]) ** 2
