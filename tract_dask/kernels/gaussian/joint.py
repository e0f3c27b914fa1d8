"""Joint fits of columns that touch: the members of a group together, with one background, in one window.

Each alone, touching columns pull at each other: the flank of the neighbour is in the window. Together they do not. The
shapes are known, from the summed image; positions, amplitudes and the background are fitted, within bounds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..windows import blur_variance, gaussian_kernel
from .fit import LARGEST_SIGMA, SMALLEST_SIGMA_PX, Outcome
from .iteration import FIRST_DAMPING, NOT_FINITE, RUNNING
from .joint_engine import fit_groups
from .joint_errors import FREEDOM, LEVEL, RATIO
from .joint_room import (
    BACKGROUND_ROW,
    DAMPING,
    FACTOR,
    FIRST,
    HIGH_BACKGROUND,
    LOW_BACKGROUND,
    MERIT,
    OFFSET,
    OUTCOME,
    PIXELS,
    SECOND,
    STEPS,
    TRIAL_BACKGROUND,
    n_state,
)
from .joint_sums import LOWER, N_MEMBER, REACH, TRIAL, UPPER, A
from .parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, THETA, X, Y

__all__ = ["MOST_MEMBERS", "JointFits", "fit_joint"]

MOST_MEMBERS = 8
"""Columns in a group."""

_LARGEST = 3e38
_OWN = (AMPLITUDE, X, Y)


class JointFits(NamedTuple):
    """What is known of each window's group; parameters in the order of Equation 1, positions in window pixels."""

    estimates: npt.NDArray[np.float64]
    """(n, members, 7); always finite: where a window cannot be fitted, the start moved onto the bounds."""
    stderr: npt.NDArray[np.float64]
    """(n, members, 7) for noise of size 1; NaN for the shape, for what is on a bound, and without convergence."""
    volume_stderr: npt.NDArray[np.float64]
    """(n, members) of the volume 2 pi amplitude sigma_a sigma_b."""
    r_squared: npt.NDArray[np.float32]
    """(n,) share of the window's variance that the group explains."""
    n_iterations: npt.NDArray[np.int16]
    """(n,) steps tried."""
    status: npt.NDArray[np.uint8]
    """(n,) codes of :class:`~tract_dask.kernels.gaussian.fit.Outcome`."""
    held: npt.NDArray[np.bool_]
    """(n, members) whether amplitude, position or background ended on a bound."""
    noise: npt.NDArray[np.float64]
    """(n,) the residual's sum of squares over what noise of size 1 has, as for single fits."""
    freedom: npt.NDArray[np.float64]
    """(n,) share of the noise's sum of squares that a fit leaves."""

    @property
    def converged(self) -> npt.NDArray[np.bool_]:
        """(n,) whether the fit converged."""
        return np.less_equal(self.status, Outcome.AT_BOUND)


def fit_joint(
    windows: npt.NDArray[np.float32],
    masks: npt.NDArray[np.bool_],
    which: npt.NDArray[np.int64],
    start: npt.ArrayLike,
    lower: npt.ArrayLike,
    upper: npt.ArrayLike,
    *,
    blur_sigma_px: float = 0.0,
    counting: bool = True,
    tolerance_px: float = 1e-4,
    max_iterations: int = 50,
) -> JointFits:
    """Fit the sum of several Gaussians of known shapes, and a background, to each window by least squares.

    Parameters
    ----------
    windows
        (n, h, w); pixels that are NaN or infinite do not count.
    masks, which
        (m, h, w) pixels that count, and (n,) the mask of each window.
    start, lower, upper
        (n, members, 7) of Equation 1, up to :data:`MOST_MEMBERS`; x and y in px from the centre of the window's first
        pixel. Shapes stay as in ``start``. The background is common: it starts at the mean of the members', between
        the smallest of their lower and the largest of their upper bounds.
    blur_sigma_px, counting
        As for :func:`~tract_dask.kernels.gaussian.fit.fit_gaussians`; they enter the standard errors.
    tolerance_px
        A fit has converged when an undamped step moves no centre by more than this, or when the fall of the residual
        that it promises is far below the noise.
    max_iterations
        Most steps that are tried.

    Raises
    ------
    ValueError
        If the shapes do not go together, or a lower bound is not at or below its upper bound.

    Examples
    --------
    >>> from tract_dask.kernels.gaussian.model import gaussian_image
    >>> pair = np.array([[[90.0, 8.0, 12.0, 3.0, 3.0, 0.0, 50.0], [60.0, 14.5, 12.0, 3.0, 3.0, 0.0, 50.0]]])
    >>> window = gaussian_image(pair[0], (25, 23)).sum(axis=0) - 50
    >>> start = pair + [-20, 1, -1, 0, 0, 0, 5]
    >>> whole, one = np.ones((1, 25, 23), bool), np.zeros(1, np.int64)
    >>> fits = fit_joint(window[None], whole, one, start, start - 100, start + 100)
    >>> fits.estimates[0, :, 0:3].round(2).tolist()
    [[90.0, 8.0, 12.0], [60.0, 14.5, 12.0]]
    """
    windows = np.ascontiguousarray(windows, dtype=np.float32)
    starts = np.array(start, np.float64)
    if windows.ndim != 3 or starts.ndim != 3 or starts.shape != (len(windows), starts.shape[1], 7):
        raise ValueError(f"start must be (n, members, 7) for windows (n, h, w), got {starts.shape} and {windows.shape}")
    if not 1 <= starts.shape[1] <= MOST_MEMBERS:
        raise ValueError(f"a group has 1 to {MOST_MEMBERS} members, got {starts.shape[1]}")
    n, height, width = windows.shape
    if (
        masks.shape[1:] != (height, width)
        or which.shape != (n,)
        or (n and not 0 <= which.min() <= which.max() < len(masks))
    ):
        raise ValueError(f"masks {masks.shape} and which {which.shape} do not go with windows {windows.shape}")
    lowers, uppers = (np.broadcast_to(np.asarray(bound, np.float64), starts.shape) for bound in (lower, upper))
    if not (lowers[..., [AMPLITUDE, X, Y, BACKGROUND]] <= uppers[..., [AMPLITUDE, X, Y, BACKGROUND]]).all():
        raise ValueError("a lower bound is not at or below its upper bound")
    least = min(1.0, SMALLEST_SIGMA_PX), LARGEST_SIGMA * max(height, width)
    starts[..., [SIGMA_A, SIGMA_B]] = np.clip(np.abs(starts[..., [SIGMA_A, SIGMA_B]]), *least)
    table, bounds = _table(starts, lowers, uppers, (width // 2, height // 2))
    kernel = gaussian_kernel(blur_sigma_px).astype(np.float64)
    power = float(kernel @ kernel) ** 2
    errors = fit_groups(
        windows,
        np.ascontiguousarray(masks, np.float32),
        which,
        table,
        (tolerance_px, max_iterations, power),
        (np.float32(blur_variance(blur_sigma_px)), np.float32(power), bool(counting)),
    )
    return _found(table, errors.astype(np.float64), bounds, (width // 2, height // 2), counting=counting)


def _table(
    starts: npt.NDArray[np.float64],
    lowers: npt.NDArray[np.float64],
    uppers: npt.NDArray[np.float64],
    middle: tuple[int, int],
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64]]:
    """Return the fitter's table (n, n_state), and start and bounds (3, n, members, 7) of what is fitted."""
    n, members, _ = starts.shape
    finite = np.isfinite(starts).all(axis=(1, 2))
    starts = np.where(np.isfinite(starts), starts, 0.0)
    own = np.stack([starts, lowers, uppers])
    own[0, ..., BACKGROUND] = starts[..., BACKGROUND].mean(axis=1)[:, None]
    own[1, ..., BACKGROUND] = lowers[..., BACKGROUND].min(axis=1)[:, None]
    own[2, ..., BACKGROUND] = uppers[..., BACKGROUND].max(axis=1)[:, None]
    own[0] = np.clip(own[0], own[1], own[2], where=np.isin(np.arange(7), (*_OWN, BACKGROUND)), out=own[0])
    table = np.zeros((n, n_state(members)), np.float32)
    of_members = table[:, : members * N_MEMBER].reshape(n, members, N_MEMBER)
    own_middle = own.copy()
    own_middle[..., [X, Y]] -= middle
    for first, values in ((0, own_middle[0]), (TRIAL, own_middle[0]), (LOWER, own_middle[1]), (UPPER, own_middle[2])):
        of_members[..., first : first + 3] = np.clip(values[..., _OWN], -_LARGEST, _LARGEST)
    a, b = (starts[..., k] ** -2.0 for k in (SIGMA_A, SIGMA_B))
    cos, sin = np.cos(starts[..., THETA]), np.sin(starts[..., THETA])
    of_members[..., A] = a * cos**2 + b * sin**2
    of_members[..., A + 1] = (b - a) * sin * cos
    of_members[..., A + 2] = a * sin**2 + b * cos**2
    of_members[..., REACH] = np.minimum(starts[..., SIGMA_A], starts[..., SIGMA_B])
    common = table[:, members * N_MEMBER :]
    for row, k in ((BACKGROUND_ROW, 0), (TRIAL_BACKGROUND, 0), (LOW_BACKGROUND, 1), (HIGH_BACKGROUND, 2)):
        common[:, row] = np.clip(own[k, :, 0, BACKGROUND], -_LARGEST, _LARGEST)
    common[:, DAMPING], common[:, MERIT] = FIRST_DAMPING, _LARGEST
    common[:, OUTCOME] = np.where(finite, RUNNING, NOT_FINITE)
    return table, own


def _found(
    table: npt.NDArray[np.float32],
    errors: npt.NDArray[np.float64],
    bounds: npt.NDArray[np.float64],
    middle: tuple[int, int],
    *,
    counting: bool,
) -> JointFits:
    """Return what the table and the errors say, in the units of the windows."""
    start = bounds[0]
    n, members, _ = start.shape
    rows = table.astype(np.float64)
    own, common = rows[:, : members * N_MEMBER].reshape(n, members, N_MEMBER), rows[:, members * N_MEMBER :]
    tried = common[:, STEPS] > 0
    factor = np.where(common[:, FACTOR] > 0, common[:, FACTOR], 1.0)
    found, held = _estimates(own, common, bounds, middle)
    status = common[:, OUTCOME].astype(np.uint8)
    converged = status == Outcome.CONVERGED
    status[converged & held.any(axis=1)] = Outcome.AT_BOUND
    last = 3 * members + 1
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = common[:, SECOND] - common[:, FIRST] ** 2 / common[:, PIXELS]
        explained = np.where(tried, np.clip(1 - common[:, MERIT] / spread, 0, 1), 0.0)
        size = errors[:, last + LEVEL] * factor if counting else factor**2
        scale = np.where(converged, np.sqrt(size), np.nan)[:, None]
        noise = np.where(converged, errors[:, last + RATIO] / size, np.nan)
    stderr = np.full(start.shape, np.nan)
    stderr[..., _OWN] = errors[:, : 3 * members].reshape(n, members, 3) * scale[..., None]
    stderr[..., AMPLITUDE] /= factor[:, None]
    stderr[..., BACKGROUND] = errors[:, 3 * members][:, None] * scale / factor[:, None]
    area = 2 * math.pi * start[..., SIGMA_A] * start[..., SIGMA_B]
    return JointFits(
        found,
        stderr,
        area * stderr[..., AMPLITUDE],
        np.nan_to_num(explained).astype(np.float32),
        common[:, STEPS].astype(np.int16),
        status,
        held & converged[:, None],
        noise,
        np.where(converged, errors[:, last + FREEDOM], np.nan),
    )


def _estimates(
    own: npt.NDArray[np.float64],
    common: npt.NDArray[np.float64],
    bounds: npt.NDArray[np.float64],
    middle: tuple[int, int],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Return estimates (n, members, 7), exactly on the bounds that they are on, and which members are on one."""
    start, lower, upper = bounds
    tried = common[:, STEPS] > 0
    offset, factor = common[:, OFFSET], np.where(common[:, FACTOR] > 0, common[:, FACTOR], 1.0)
    found = start.copy()
    values = np.stack([own[..., 0] / factor[:, None], own[..., 1] + middle[0], own[..., 2] + middle[1]], axis=-1)
    low, high = own[..., 0:3] <= own[..., LOWER : LOWER + 3], own[..., 0:3] >= own[..., UPPER : UPPER + 3]
    values = np.clip(values, lower[..., _OWN], upper[..., _OWN])
    values = np.where(low, lower[..., _OWN], np.where(high, upper[..., _OWN], values))
    found[..., _OWN] = np.where(tried[:, None, None], values, found[..., _OWN])
    level = common[:, BACKGROUND_ROW]
    low_level, high_level = level <= common[:, LOW_BACKGROUND], level >= common[:, HIGH_BACKGROUND]
    background = np.clip(level / factor + offset, lower[:, 0, BACKGROUND], upper[:, 0, BACKGROUND])
    background = np.where(low_level, lower[:, 0, BACKGROUND], np.where(high_level, upper[:, 0, BACKGROUND], background))
    found[..., BACKGROUND] = np.where(tried, background, start[:, 0, BACKGROUND])[:, None]
    movable = lower[..., _OWN] < upper[..., _OWN]
    held = (movable & (low | high)).any(axis=-1) | (low_level | high_level)[:, None]
    return found, held
