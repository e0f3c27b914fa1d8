"""Touching columns of the summed image, fitted together, with their shapes: the reference of every frame's fit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...kernels.gaussian.joint_shapes import ShapeFits, fit_shapes
from ...kernels.gaussian.model import above_background, group_image
from ...kernels.gaussian.parameters import AMPLITUDE, SIGMA_A, SIGMA_B, X, Y
from ...kernels.windows import cut_windows
from ...store.schema import Status

Floats = NDArray[np.float64]

_SPREAD = 1.3
"""By how much the sigmas of members may differ from those of their common shape."""
_CALLED_FOR = 3.0
"""By how much more than Schwarz's criterion asks shapes of their own have to make the squares of the residual fall."""
_LAGS, _NO_MORE = 4, 0.05
"""Pixels, beyond the blur, over which noise may be correlated, and a correlation that is none."""
_FIT = 4.0
"""Fits leave this share of the noise at least, however few pixels are independent."""
_SIDES = 4
_ROUNDS = 2


class Summed(NamedTuple):
    """The summed image for these fits.

    Attributes
    ----------
    counts
        (y, x).
    known
        (y, x) pixels that some frame shows.
    blur_sigma_px
        Before the fit.
    sign
        1 where columns are bright, -1 where they are dark.
    weakest
        Amplitude below which a column is flagged below_noise.
    """

    counts: Floats
    known: NDArray[np.bool_]
    blur_sigma_px: float
    sign: int
    weakest: float


def fit_touching(
    image: Summed, fit: Floats, status: NDArray[np.uint8], groups: NDArray[np.int64], window_px: int
) -> None:
    """Fit the members of groups together; replace their fits (n, 7) and flags (n,) in place.

    Columns around a group are taken away as they were fitted in the round before. Members have shapes of their own
    where these are called for, by Schwarz's criterion, and differ by less than 30 % of their common shape; else they
    share one.

    Parameters
    ----------
    fit
        Where the fits start.
    groups
        (n,) number of each column's group; 0: alone.
    window_px
        Diameter of the round window of each member.
    """
    by_size: dict[tuple[int, int, int], list[NDArray[np.int64]]] = {}
    for number in np.unique(groups[groups > 0]):
        members = np.flatnonzero(groups == number)
        across, rows = np.ptp(fit[members][:, [X, Y]], axis=0) + window_px + 1
        rows, across = (int(np.ceil(span / _SIDES)) * _SIDES + 1 for span in (rows, across))
        by_size.setdefault((len(members), rows, across), []).append(members)
    touched = np.any([np.isin(np.arange(len(fit)), np.concatenate(found)) for found in by_size.values()], axis=0)
    for _ in range(_ROUNDS):
        total = rendered(fit[touched], image.counts.shape)
        for (_, *size), found in by_size.items():
            _fit_class(image, total, (fit, status), np.stack(found), (size[0], size[1]), window_px)


def rendered(columns: Floats, shape: tuple[int, ...]) -> Floats:
    """Return the image of columns without their backgrounds."""
    image = np.zeros(shape)
    for column in columns[np.isfinite(columns).all(axis=1)]:
        reach = int(np.ceil(4.5 * column[SIGMA_A]))
        x, y = np.rint(column[[X, Y]]).astype(int)
        rows = np.arange(max(y - reach, 0), min(y + reach + 1, shape[0]))
        across = np.arange(max(x - reach, 0), min(x + reach + 1, shape[1]))
        if len(rows) and len(across):
            own = above_background(column, across, rows[:, None])
            image[rows[0] : rows[-1] + 1, across[0] : across[-1] + 1] += own
    return image


def _fit_class(
    image: Summed,
    total: Floats,
    found: tuple[Floats, NDArray[np.uint8]],
    members: NDArray[np.int64],
    size: tuple[int, int],
    window_px: int,
) -> None:
    """Fit groups with the same number of members in windows of one size; ``total`` is the image of all columns."""
    fit, status = found
    shape = np.array(image.counts.shape)
    rows, across = (min(side, whole) for side, whole in zip(size, shape.tolist(), strict=True))
    start = fit[members]
    places = start[..., [X, Y]]
    middle = np.rint((places.min(axis=1) + places.max(axis=1)) / 2).astype(np.int64)
    corner = np.clip(middle - [across // 2, rows // 2], 0, shape[::-1] - [across, rows])
    cut = corner[None, :, 1], corner[None, :, 0], (rows, across)
    windows = cut_windows(image.counts[None], *cut, image.blur_sigma_px)[0].astype(np.float64)
    windows -= cut_windows(total[None], *cut, 0.0)[0]
    x, y = np.arange(across), np.arange(rows)[:, None]
    start[..., [X, Y]] -= corner[:, None]
    masks = np.zeros(windows.shape, np.bool_)
    for k, ((left, top), own) in enumerate(zip(corner, start, strict=True)):
        windows[k] += above_background(own, x, y).sum(axis=0)
        disc = [np.hypot(x - px, y - py) <= window_px / 2 for px, py in np.rint(own[:, [X, Y]])]
        masks[k] = np.any(disc, axis=0) & image.known[top : top + rows, left : left + across]
    fits = _best(windows, masks, start, image.sign, image.blur_sigma_px)
    estimates = fits.estimates.copy()
    estimates[..., [X, Y]] += corner[:, None]
    fit[members] = estimates
    weak = np.abs(estimates[..., AMPLITUDE]) <= image.weakest
    flags = np.where(weak, Status.BELOW_NOISE, 0) | np.where(fits.converged, 0, Status.NOT_CONVERGED)[:, None]
    status[members] = (status[members] & Status.OUTSIDE_FRAME) | flags.astype(np.uint8)


def shared_by_pixels(left: Floats, masks: NDArray[np.bool_], lags: int) -> float:
    """Return by how much more than white noise of the same size a column sees of noise that pixels share.

    ``left`` (n, rows, columns) is what fits leave of windows, 0 outside their masks; see :func:`correlations`.
    """
    return shared(np.median(correlations(left, masks, lags), axis=0))


def correlations(left: Floats, masks: NDArray[np.bool_], lags: int) -> Floats:
    """Return the correlations (n, 2, lags) of pixels with those so many rows, and columns, away."""
    found = np.zeros((len(left), 2, lags))
    for k, (residual, there) in enumerate(((left, masks), (left.transpose(0, 2, 1), masks.transpose(0, 2, 1)))):
        power = (residual**2).sum(axis=(1, 2)) / np.maximum(there.sum(axis=(1, 2)), 1)
        for lag in range(1, min(lags, residual.shape[1] - 1) + 1):
            both = (there[:, lag:] & there[:, :-lag]).sum(axis=(1, 2))
            products = (residual[:, lag:] * residual[:, :-lag]).sum(axis=(1, 2))
            found[:, k, lag - 1] = products / np.maximum(both * power, 1e-300)
    return found


def shared(along: Floats) -> float:
    """Return the sum of a noise's correlations (2, lags) over all pixels, up to where they have fallen to none."""
    kept = np.where(np.minimum.accumulate(along, axis=1) > _NO_MORE, along, 0.0)
    return float(np.prod(1 + 2 * kept.sum(axis=1)))


def _best(windows: Floats, masks: NDArray[np.bool_], start: Floats, sign: int, blur_sigma_px: float) -> ShapeFits:
    """Return fits with one shape for all members, or with shapes of their own where these are called for."""
    lags = _LAGS + round(3 * blur_sigma_px)
    members, side = start.shape[1], max(windows.shape[1:])
    lower, upper = start.copy(), start.copy()
    lower[..., AMPLITUDE], upper[..., AMPLITUDE] = (0, np.inf) if sign > 0 else (-np.inf, 0)
    reach = np.sqrt(start[..., SIGMA_A] * start[..., SIGMA_B])[..., None]
    lower[..., [X, Y]], upper[..., [X, Y]] = start[..., [X, Y]] - reach, start[..., [X, Y]] + reach
    lower[..., [SIGMA_A, SIGMA_B]], upper[..., [SIGMA_A, SIGMA_B]] = 0.5, side / 2
    common = fit_shapes(windows, masks, start, lower, upper, shape="shared", max_iterations=60)
    if members == 1:
        return common
    shape = common.estimates[..., [SIGMA_A, SIGMA_B]]
    lower[..., [SIGMA_A, SIGMA_B]], upper[..., [SIGMA_A, SIGMA_B]] = shape / _SPREAD, shape * _SPREAD
    along = np.arange(windows.shape[2]), np.arange(windows.shape[1])[:, None]
    left = np.where(masks, windows - group_image(common.estimates, *along), 0.0)
    own = fit_shapes(windows, masks, common.estimates, lower, upper, shape="own", max_iterations=60)
    number = masks.sum(axis=(1, 2))
    times = shared_by_pixels(left, masks, lags)
    variance = own.squares / np.maximum(number - times * (6 * members + 1), number / _FIT)
    asked = (3 * (members - 1) * np.log(np.maximum(number, 2)) + _CALLED_FOR) * times
    found = own.estimates[..., [SIGMA_A, SIGMA_B]]
    edge = (found[..., 0] >= upper[..., SIGMA_A] * 0.999) | (found[..., 1] <= lower[..., SIGMA_B] * 1.001)
    better = own.converged & ~edge.any(axis=1) & (common.squares - own.squares > asked * np.maximum(variance, 1e-300))
    return ShapeFits(
        *(
            np.where(better.reshape(-1, *(1,) * (first.ndim - 1)), second, first)
            for first, second in zip(common, own, strict=True)
        )
    )
