"""Where the noise is measured: a region of vacuum in the summed image, given or found."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy  # its parts load on use: workers need few of them
import xarray as xr
from numpy.typing import NDArray

from ...errors import SettingsError
from ...kernels.gaussian.parameters import AMPLITUDE
from ...kernels.magnitude import unit_of
from ...kernels.windows import blur
from ...store.movie import Movie
from ..columns.lattice import without_holes

_SHARES = (1 / 2, 1 / 3, 1 / 4, 1 / 6, 1 / 8)
_FLAT = 0.1
_MIN_SIDE_PX = 24
_PADDING_PX, _EDGE = 17, 0.05
"""Padding is a square of this side at least, whose edge is this share of the columns' amplitude."""
_LOOKED_AT = 4
"""Frames in which vacuum is looked at."""
_FEWEST_COUNTS = 20
"""In a frame: fewer leave the noise of some frames at zero."""
_CUT_SHARE, _CUT = 0.1, 3.0
"""Values were cut off where more than this share has the lowest one, and so many times as many as counts would have:
with n pixels of the lowest value and the mean m, in steps to the next value, that has m n pixels."""
_STEPS = 16
"""Squares are looked for in steps of this share of the smallest one's side."""


def find_vacuum(summed: xr.Dataset, columns: xr.Dataset, sigma: float) -> tuple[int, int, int, int] | None:
    """Return the largest flat square of the summed image as (y0, y1, x0, x1), or None where nothing is flat.

    Parameters
    ----------
    summed
        Summed image with its exposure (:data:`schema.SUM`); only pixels that every frame covers are looked at, and
        none that frames were padded with, as those that were aligned before are.
    columns
        The columns: their median amplitude is what flatness is held against.
    sigma
        Blur before the fit, in px; flatness is that of the blurred image.

    Notes
    -----
    Squares of a half down to an eighth of the frame's shorter side are tried, largest first, at every pixel of a small
    image and at every sixteenth of the smallest square's side in a large one. A square is vacuum when
    its standard deviation is at most a tenth of the columns' amplitude, and less than twice the smallest found.
    """
    image = np.asarray(summed["image"].to_numpy(), dtype=np.float64)
    exposure = summed["exposure"].to_numpy()
    unit = unit_of(image)
    smooth = blur((image if unit == 1 else image / unit).astype(np.float32), sigma)
    smooth -= smooth.mean(dtype=np.float64)
    amplitude = float(np.nanmedian(np.abs(columns["fit_ref"].to_numpy()[:, AMPLITUDE]))) / unit
    covered = without_holes(exposure == exposure.max()) & ~_is_padding(image / unit, amplitude)
    sides = [side for share in _SHARES if (side := int(share * min(image.shape))) >= _MIN_SIDE_PX]
    step = max(1, min(sides, default=1) // _STEPS)
    sides = [side // step * step for side in sides]
    tables = [_sum_table(values, step) for values in (smooth, smooth**2, covered)]
    flattest = [_flattest(tables, side, step) for side in sides]
    best = min((spread for spread, _, _ in flattest), default=np.inf)
    for side, (spread, y, x) in zip(sides, flattest, strict=True):
        if spread <= _FLAT * amplitude and spread <= 2 * best:
            return y, y + side, x, x + side
    return None


def why_unusable(movie: Movie, box: tuple[int, ...], shift: NDArray[np.float64], used: NDArray[np.bool_]) -> str | None:
    """Return why the noise of a box of vacuum does not tell that of the columns, in words; None where it does.

    Parameters
    ----------
    box
        y0, y1, x0, x1 in the summed image.
    shift
        (frames, 2) drift, px.
    used
        (frames,) frames that show something.
    """
    which = np.flatnonzero(used)
    parts = []
    for number in which[np.linspace(0, len(which) - 1, min(_LOOKED_AT, len(which))).astype(int)] if len(which) else ():
        dy, dx = np.rint(shift[number]).astype(int)
        rows, columns = (
            slice(max(0, low + step), max(0, high + step))
            for low, high, step in ((box[0], box[1], dy), (box[2], box[3], dx))
        )
        pixels = movie.read(int(number), int(number) + 1, rows, columns)
        parts.append(pixels[np.isfinite(pixels)].astype(np.float64))
    values = np.concatenate(parts) if parts else np.empty(0)
    if not values.size:
        return "its pixels carry no data"
    lowest = values.min()
    above = values[values > lowest]
    if not above.size:
        return f"all of its pixels have the value {lowest:g}"
    step = above.min() - lowest
    counts, share = (values - lowest).sum() / step, 1 - above.size / values.size
    if counts < _FEWEST_COUNTS * len(parts):
        return f"it has {counts / len(parts):.0f} counts a frame"
    next_lowest = np.count_nonzero(above == lowest + step)
    if share > _CUT_SHARE and (values.size - above.size) * counts / values.size > _CUT * next_lowest:
        return f"{share:.0%} of its pixels have the lowest value, {lowest:g}: what was below was cut off"
    return None


def check_box(
    box: tuple[int, ...] | None,
    shape: tuple[int, ...],
    drift: NDArray[np.float64] | None,
    where: str = "setting vacuum_box (FitSettings)",
) -> None:
    """Check that a vacuum box stays inside the frame whatever the drift; ``where`` is what an error names.

    Parameters
    ----------
    drift
        (frames, 2) in px; None where it is not known yet: then only a box that no drift brings inside is refused.

    Raises
    ------
    SettingsError
        Naming the first frame where it leaves.
    """
    if box is None:
        return
    if len(box) != 4 or box[0] >= box[1] or box[2] >= box[3]:
        raise SettingsError(
            "this is not a box", where, "y0, y1, x0, x1 with y0 < y1 and x0 < x1", str(box), "Correct it"
        )
    shift = np.rint(np.zeros((1, 2)) if drift is None else drift).astype(int)
    inside = (
        (shift[:, 0] + box[0] >= 0)
        & (shift[:, 0] + box[1] <= shape[0])
        & (shift[:, 1] + box[2] >= 0)
        & (shift[:, 1] + box[3] <= shape[1])
    )
    if not inside.all():
        frame = int(np.argmin(inside))
        raise SettingsError(
            f"the vacuum box leaves frame {frame}, drifted by {shift[frame, 1]}, {shift[frame, 0]} px in x, y"
            if shift[frame].any()
            else "the vacuum box leaves the frame",
            where,
            f"a box inside {shape[0]} rows and {shape[1]} columns in every frame",
            str(box),
            "Move it inwards or make it smaller",
        )


def _is_padding(image: NDArray[np.float64], amplitude: float) -> NDArray[np.bool_]:
    """Tell which pixels lie in areas of one value behind a sharp edge, as where frames were padded with zeros.

    Vacuum without noise ends in slopes of columns, and not in an edge.
    """
    constant = np.zeros(image.shape, np.uint8)
    constant[:-1, :-1] = (image[:-1, :-1] == image[1:, :-1]) & (image[:-1, :-1] == image[:-1, 1:])
    constant[-1], constant[:, -1] = constant[-2], constant[:, -2]
    padding: NDArray[np.bool_] = scipy.ndimage.grey_opening(constant, size=(_PADDING_PX, _PADDING_PX)).astype(bool)
    steps = [np.abs(np.diff(image, axis=axis))[np.diff(padding, axis=axis)] for axis in (0, 1)]
    edge = np.concatenate(steps)
    return padding if edge.size and np.median(edge) > _EDGE * amplitude else np.zeros_like(padding)


def _sum_table(values: NDArray[Any], step: int) -> NDArray[np.float64]:
    """Return the sums of all values above and to the left of every ``step``-th pixel, beginning with zeros."""
    ny, nx = (size // step for size in values.shape)
    rows = values[: ny * step, : nx * step].reshape(ny, step, nx * step).sum(axis=1, dtype=np.float64)
    table = np.zeros((ny + 1, nx + 1))
    table[1:, 1:] = rows.reshape(ny, nx, step).sum(axis=2).cumsum(axis=0).cumsum(axis=1)
    return table


def _flattest(tables: list[NDArray[np.float64]], side: int, step: int) -> tuple[float, int, int]:
    """Return standard deviation and corner (y, x) of the flattest square of ``side`` px that is covered.

    ``tables`` are the sum tables (Crow 1984) of the image, its square, and the pixels that are covered.
    """
    n = side // step
    mean, square, share = ((t[n:, n:] - t[n:, :-n] - t[:-n, n:] + t[:-n, :-n]) / side**2 for t in tables)
    spread = np.where(share > 1 - 0.5 / side**2, np.sqrt(np.maximum(square - mean**2, 0)), np.inf)
    y, x = np.unravel_index(int(np.argmin(spread)), spread.shape)
    return float(spread[y, x]), int(y) * step, int(x) * step
