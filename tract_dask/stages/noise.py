"""What some of a movie's frames say of its camera: gain, offset, read noise, and how far an electron spreads."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy  # its parts load on use: workers need few of them
from numpy.typing import NDArray

from ..kernels.noise import Cells, Lags, Law, correlation, fit_law, gather, lag_sums
from ..kernels.patterns import Measured, pattern_power
from ..kernels.windows import blur
from ..store.camera import Camera
from ..store.movie import Movie

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Image = NDArray[np.float32]

FEWEST_FRAMES = 12
"""With fewer, the mean image is too noisy to tell levels and slopes."""
_FIELD_PX, _RUN, _PIXELS = 256, 16, 8 << 20
"""Fields of this side, runs of so many frames, and so many pixels of all together are looked at."""
_MIDDLE_PX = 512
"""A fixed pattern is looked for in the middle of the field, in a square of this side."""
_SMOOTH_PX = 1.0
_REACH_PX = 8
_SMALLEST_PX = 32
_STILL = 0.02
"""Pixels in which motion adds no more than this share of the noise tell how pixels share it."""
_ALIKE_PX = 2.0
"""Pixels so near have noise alike."""
_FIXED = 0.005
"""Pixels in which the shift of the image adds more than this share of the noise do not tell gain and offset."""
_SHARPEST_PX2 = 0.3
"""Variance of the sharpest image that is expected; noise in the level looks sharper."""
_USUAL_MOTION_PX2 = 0.2**2
_FEWEST_PIXELS = 1 << 14
_SURE = 0.05
"""Gain and offset are known where their error is below this share (of itself; of the usual level). What moves leaves up
to twice the error."""
_SURE_OFFSET = 0.05


class _Field(NamedTuple):
    """A run of frames in a part of the summed image's field, in its coordinates."""

    frames: NDArray[np.float32]
    differences: NDArray[np.float32]
    level: NDArray[np.float32]
    slope: NDArray[np.float32]
    usable: Bools


def measure_camera(movie: Movie, mean: Floats, covered: Bools, drift: Floats, used: Bools) -> Camera:
    """Return what is measured of the camera from at most eight million pixels, spread over the movie.

    Parameters
    ----------
    mean
        (y, x) drift-corrected mean of the frames in detector units; NaN where no frame shows anything.
    covered
        (y, x) which pixels count.
    drift
        (frames, 2) in px; frames are moved by its whole part, and what is left is taken off by the mean's slope.
    used
        (frames,) which frames count.
    """
    found = _measured(movie, mean, covered, drift, used)
    power = _pattern(movie, used, movie.offset if found.offset is None else found.offset)
    value, error = power or (None, None)
    return replace(found, frames=movie.summed, pattern=value, pattern_stderr=error)


def _pattern(movie: Movie, used: Bools, offset: float) -> Measured | None:
    """Return the power of a fixed pattern of the pixels, from runs of frames in the middle of the field."""
    n_frames, *sides = movie.shape
    rows, columns = (slice(max(0, (side - _MIDDLE_PX) // 2), (side + min(side, _MIDDLE_PX)) // 2) for side in sides)
    runs = max(1, _PIXELS // (_RUN * min(sides[0], _MIDDLE_PX) * min(sides[1], _MIDDLE_PX)))
    every = np.arange(0, n_frames, _RUN)  # a frame in both halves would be a pattern
    starts = every[np.linspace(0, len(every) - 1, min(runs, len(every))).astype(int)]
    halves = np.zeros((2, rows.stop - rows.start, columns.stop - columns.start))
    number = 0
    for start in starts.tolist():
        frames = movie.read(start, min(start + _RUN, n_frames), rows, columns)[used[start : start + _RUN]]
        pairs = len(frames) // 2
        halves += [frames[k : 2 * pairs : 2].sum(axis=0, dtype=np.float64) for k in (0, 1)]
        number += pairs
    return pattern_power(*(halves / number - offset)) if number else None


def _measured(movie: Movie, mean: Floats, covered: Bools, drift: Floats, used: Bools) -> Camera:
    if used.sum() < FEWEST_FRAMES or min(mean.shape) < _SMALLEST_PX:
        return Camera(reason=f"it takes {FEWEST_FRAMES} frames of {_SMALLEST_PX} px to compare pixels")
    level = blur(np.where(np.isfinite(mean), mean, mean[covered].mean() if covered.any() else 0.0), _SMOOTH_PX)
    slopes = [np.asarray(slope, np.float32) for slope in np.gradient(level)]
    cells: list[Cells] = []
    fields: list[_Field] = []
    for field in _fields(movie, level, slopes, covered, drift, used):
        cells.append(gather(*field))
        fields.append(field)
    if not cells or sum(float(c.number.sum()) for c in cells) < _FEWEST_PIXELS:
        return Camera(reason="there are too few pixels that all frames cover")
    every = Cells.joined(cells)
    chance_level = np.average(every.variance, weights=every.number) / (used.sum() * 4 * np.pi * _SMOOTH_PX**2)
    levels = every.level - np.average(every.level, weights=every.number)
    several = np.average(levels**2, weights=every.number) > 4 * chance_level
    law = fit_law(every) if several else None
    shared, chance = _shared(fields, law)
    if law and shared is not None and shared.size > 1:
        every = Cells.joined([gather(_as_noise_sees(f, shared), *f[1:]) for f in fields])
        law = fit_law(every)
    return _camera(every, law, shared, chance, movie.offset)


def _as_noise_sees(field: _Field, shared: Floats) -> Image:
    """Return the frames of a field at the level of which their noise is, where pixels share electrons.

    A detector that spreads electrons by weights w has the mean of its pixels blurred by w, but their variance by w
    squared: for a Gaussian of variance v that is half as wide. The sum of the noise's autocorrelation is 4 pi v.
    """
    variance = float(shared.sum()) / (4 * np.pi)
    return np.asarray(field.frames - np.float32(variance / 4) * scipy.ndimage.laplace(field.level), np.float32)


def _camera(cells: Cells, law: Law | None, shared: Floats | None, chance: float, offset_said: float) -> Camera:
    """Return what the law and the correlation say together."""
    known = None if shared is None else tuple(tuple(float(f"{v:.5f}") for v in row) for row in shared)
    if law is None:
        return Camera(correlation=known, reason="the noise does not follow the level of pixels, or they have one level")
    usual = float(np.average(cells.level, weights=cells.number)) - law.zero
    spread = _spread(shared, (offset_said - law.zero) / usual)
    noise = np.hypot(law.per_count_stderr / law.per_count, chance * (0 if shared is None else np.sqrt(shared.size - 1)))
    if noise > _SURE or usual <= 0:
        return Camera(correlation=known, reason="pixels of too few levels are seen to tell gain and offset")
    offset, read = _offset(cells, law) if shared is not None and shared.size == 1 else (None, None)
    per_electron = law.per_count * spread
    return Camera(
        per_electron=per_electron,
        per_electron_stderr=float(per_electron * noise),
        zero=law.zero,
        zero_stderr=law.zero_stderr,
        offset=offset,
        read_noise=read,
        noise_per_count=law.per_count,
        correlation=known,
        reason="" if shared is not None else "too few pixels keep still to tell how far an electron spreads",
    )


def _spread(shared: Floats | None, white: float) -> float:
    """Return by what the spread of electrons makes their noise smaller; ``white`` is the share of read noise."""
    share = min(max(white, 0.0), 0.9)
    return 1.0 if shared is None or shared.size == 1 else float((shared.sum() - share) / (1 - share))


def _offset(cells: Cells, law: Law) -> tuple[float | None, float | None]:
    """Return offset and read noise; None where they cannot be told apart.

    The third moment of counted electrons is per_electron^2 (mean - offset), and read noise has none.
    """
    still = (law.motion * cells.slope < _STILL / 2 * cells.variance) & (cells.number > 0)
    if not still.any():
        return None, None
    level, variance, third, count = (
        values[still] for values in (cells.level, cells.variance, cells.third, cells.number)
    )
    weight = count / variance**3
    found = float(np.average(level - third / law.per_count**2, weights=weight))
    usual = float(np.average(level, weights=weight)) - found
    error = np.hypot(np.sqrt(15 / weight.sum()) / law.per_count**2, 2 * usual * law.per_count_stderr / law.per_count)
    read = law.per_count * (found - law.zero)
    sure = law.per_count * np.hypot(error, law.zero_stderr)
    if usual <= 0 or error > _SURE_OFFSET * usual or read < -3 * sure:
        return None, None
    if read < 2 * sure:
        return law.zero, 0.0
    return found, float(np.sqrt(read))


def _shared(fields: list[_Field], law: Law | None) -> tuple[Floats | None, float]:
    """Return how pixels that keep still share their noise, and the error of that; None where too few do."""
    motion = max(law.motion, 0.0) if law else _USUAL_MOTION_PX2
    sums: list[Lags] = []
    for field in fields:
        if law:
            size = np.sqrt(np.maximum(law.per_count * (field.level - law.zero), 1e-12)).astype(np.float32)
            usable = field.usable & (field.level > law.zero)
        else:
            size, usable = np.full_like(field.level, field.differences.std() or 1.0), field.usable
        still = usable & (motion * field.slope < _STILL * size**2)
        if still.sum() >= _FEWEST_PIXELS // 16:
            values = np.clip(field.differences / np.where(size > 0, size, 1), -8, 8).astype(np.float32)
            sums.append(lag_sums(values, still, min(_REACH_PX, min(still.shape) // 4)))
    reach = min((len(one.products) for one in sums), default=0)
    sums = [one for one in sums if len(one.products) == reach]
    if sum(float(one.pairs.max()) for one in sums) < _FEWEST_PIXELS:
        return None, 0.0
    return correlation(sums)


def _fields(
    movie: Movie,
    level: Image,
    slopes: list[Image],
    covered: Bools,
    drift: Floats,
    used: Bools,
) -> Iterator[_Field]:
    """Yield runs of frames in parts of the field, spread over the movie."""
    shift = np.rint(drift).astype(np.int64)
    left = (drift - shift).astype(np.float32)
    for start, rows, columns in _places(movie):
        number = np.arange(start, min(start + _RUN, movie.n_frames))
        number = number[used[number]]
        if len(number) < 3:
            continue
        own, field = shift[number], np.array([rows, columns])
        low = np.maximum(field[:, 0], -own.min(axis=0))
        high = np.minimum(field[:, 1], np.array(level.shape) - own.max(axis=0))
        if (high - low < 3 * _REACH_PX).any():
            continue
        (top, leftmost), (bottom, right) = own.min(axis=0) + low, own.max(axis=0) + high
        pixels = movie.read(int(number[0]), int(number[-1]) + 1, slice(top, bottom), slice(leftmost, right))
        size = high - low
        at = own + low - (top, leftmost)
        frames = np.stack(
            [
                pixels[n - number[0], y : y + size[0], x : x + size[1]].astype(np.float32)
                for n, (y, x) in zip(number, at, strict=True)
            ]
        )
        here = (slice(low[0], high[0]), slice(low[1], high[1]))
        usable = covered[here] & np.isfinite(frames).all(axis=0)
        frames = np.where(usable, frames, 0).astype(np.float32)
        own_slopes = [slope[here] for slope in slopes]
        differences = _compared(frames, level[here], own_slopes, left[number], usable)
        usable &= _keeps_still(level[here], own_slopes, left[number], differences)
        frames, differences = (np.where(usable, values, 0).astype(np.float32) for values in (frames, differences))
        yield _Field(frames, differences, level[here], own_slopes[0] ** 2 + own_slopes[1] ** 2, usable)


def _compared(
    frames: NDArray[np.float32],
    level: NDArray[np.float32],
    slopes: list[NDArray[np.float32]],
    left: NDArray[np.float32],
    usable: Bools,
) -> NDArray[np.float32]:
    """Return the differences of successive frames, less what is left of the drift, and changes of brightness."""
    differences = np.diff(frames, axis=0)
    step = np.diff(left, axis=0)
    differences += step[:, 0, None, None] * slopes[0] + step[:, 1, None, None] * slopes[1]
    about = np.where(usable, level - level[usable].mean() if usable.any() else 0, 0)
    power = float((about.astype(np.float64) ** 2).sum())
    for one in differences:
        one -= one[usable].mean() if usable.any() else 0
        if power > 0:
            one -= np.float32((one * about).sum(dtype=np.float64) / power) * about
    return np.where(usable, differences, 0).astype(np.float32)


def _keeps_still(
    level: Image, slopes: list[Image], left: NDArray[np.float32], differences: NDArray[np.float32]
) -> Bools:
    """Tell in which pixels (y, x) motion adds hardly anything to the noise that the level's slope does not take off.

    The level is smoother than the image. What smoothing it again takes from its slopes tells how sharp the image is: of
    Gaussians with a variance v the root mean square is in proportion to 1 / v. Places beyond a slope are on its curve.
    """
    again = [blur(slope, _SMOOTH_PX) for slope in slopes]
    first, second = (
        float(np.sqrt(sum(np.square(s, dtype=np.float64).mean() for s in every))) for every in (slopes, again)
    )
    kept, width = second / first if first else 1.0, _SMOOTH_PX**2
    sharp = max(width * (2 * kept - 1) / max(1 - kept, 1e-6), _SHARPEST_PX2)
    y, x = left.astype(np.float64).T
    bend = [np.gradient(slope) for slope in slopes]
    curves = ((bend[0][0], y * y / 2), (bend[1][1], x * x / 2), (bend[0][1], y * x))
    lost = sum(np.square(one - two) * moved.var() for one, two, moved in zip(slopes, again, (y, x), strict=True))
    curved = sum(np.square(curve) * moved.var() for curve, moved in curves)
    added = lost * (1 + 2 * width / sharp) ** 2 + curved * (1 + width / sharp) ** 4
    noise = blur(np.square(differences).mean(axis=0, dtype=np.float64) / 2, _ALIKE_PX)
    return np.asarray(added < _FIXED * noise)


def _places(movie: Movie) -> list[tuple[int, tuple[int, int], tuple[int, int]]]:
    """Return first frame, rows and columns of what is looked at: as many as the pixels allow, evenly spread."""
    n_frames, height, width = movie.shape
    rows, columns = (
        [(i * side // n, (i + 1) * side // n) for i in range(n)]
        for side, n in ((side, max(1, round(side / _FIELD_PX))) for side in (height, width))
    )
    starts = range(0, max(1, n_frames - 2), _RUN)
    every = [(start, row, column) for start in starts for row in rows for column in columns]
    most = max(1, _PIXELS // (min(_RUN, n_frames) * (height // len(rows)) * (width // len(columns))))
    if len(every) <= most:
        return every
    golden = np.argsort((np.arange(len(every)) * 0.6180339887498949) % 1, kind="stable")
    return [every[k] for k in sorted(golden[:most].tolist())]
