"""Columns of the summed image, each fitted alone in its window."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...kernels.gaussian.fit import GaussianFits, fit_gaussians
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, THETA, X, Y
from ...kernels.peaks import centroids, climb
from ...kernels.windows import cut_windows
from ...settings.run import ColumnSettings
from ...store.schema import Status
from ..filled import fill_holes
from .relief import Places, Relief, damping
from .scene import Scene
from .slopes import without_slopes
from .window_size import default_blur, resolve_window, usual_sigma

_USUAL_SIGMA = 0.13
"""Sigma of a column, in spacings, before it is fitted."""
_NARROWEST = 0.06
"""Least sigma that is fitted, in windows, from half a pixel to a pixel: what is narrower is a single pixel's noise."""
SIGNIFICANT = 3.0
"""Amplitude, in standard deviations of the blurred image's noise, below which a column is flagged below_noise."""
_SHAPE_FACTOR = 1.5
"""A sigma beyond this factor of its median over the columns of the same kind is unusual; the fit is then repeated."""
_SHAPE_MARGIN = 1.1
"""With sigmas within this factor of the median."""
_FEWEST_FOR_SHAPE = 5
_ROUNDS = 2
"""So often columns are fitted again without the slopes of their background."""


@dataclass(frozen=True)
class Seeds:
    """Where to look: (n, 2) of (x, y), kinds, numbers to report them by; ``fixed``: the numbers stay as IDs.

    ``unresolved`` tells which are known to be more than one; None: none is.
    """

    places: Places
    kind: NDArray[np.str_]
    number: NDArray[np.int64]
    fixed: bool
    unresolved: NDArray[np.bool_] | None = None

    def numbers_with(self, more: int) -> NDArray[np.int64]:
        """Return the numbers, and those of so many that are added."""
        return np.concatenate([self.number, self.number.max(initial=0) + 1 + np.arange(more)])

    @property
    def alike(self) -> NDArray[np.str_]:
        """Columns with the same one are of about the same shape."""
        if self.unresolved is None:
            return self.kind
        parts = zip(self.kind, self.unresolved, strict=True)
        return np.array([f"{kind} of several" if several else str(kind) for kind, several in parts])


@dataclass(frozen=True)
class Fits:
    """Refined places (n, 2) of (x, y), and fits on the summed image in units of the scene.

    Attributes
    ----------
    fit, status, explained
        (n, 7), NaN where the window leaves the image; (n,) flags, and R squared.
    """

    window_px: int
    blur_sigma_px: float
    places: Places
    fit: Places
    status: NDArray[np.uint8]
    explained: NDArray[np.float64]


def fitted_alone(
    scene: Scene,
    settings: ColumnSettings,
    seeds: Seeds,
    spacing: float,
    window_px: int | None,
    *,
    blur_sigma_px: float | None = None,
) -> Fits:
    """Return the fits of columns, each alone in its window, at the maxima near the seeds.

    Parameters
    ----------
    spacing
        Distance of neighbouring columns, or of groups of touching ones, px.
    window_px
        Diameter of the windows; None: what suits the spacing.
    blur_sigma_px
        The seeds are taken for the columns' places, and the windows are blurred by this; None: places are refined, and
        the blur is what suits the columns.
    """
    window_px = resolve_window(window_px, scene.image.shape, spacing)
    search = spacing / 4 if settings.search_radius_px is None else settings.search_radius_px
    centroid = max(2.0, spacing / 8) if settings.centroid_radius_px is None else settings.centroid_radius_px
    places = seeds.places
    if blur_sigma_px is None:
        places = _refined(scene.relief(spacing, min(search / 6, centroid / 3)), seeds.places, search, centroid)
    inside, corner = _corners(places, window_px, scene.valid)
    places = np.where(inside[:, None], places, seeds.places)
    blur = default_blur(_USUAL_SIGMA * spacing) if scene.blur_sigma_px is None else float(scene.blur_sigma_px)
    blur = blur if blur_sigma_px is None else blur_sigma_px
    fitted = partial(_on_even_ground, scene, spacing, places, corner, inside, seeds.alike, window_px, max(search, 1.0))
    fit, status, explained = fitted(blur)
    sigma = usual_sigma(fit[status == 0], blur)
    free = scene.blur_sigma_px is None and blur_sigma_px is None
    if free and sigma and (suiting := default_blur(sigma)) != blur:
        fit, status, explained = fitted(blur := suiting)
    return Fits(window_px, blur, places, fit, status, explained)


def _refined(raised: Relief, places: Places, search: float, centroid: float) -> Places:
    """Return places moved to the local maximum within ``search`` px, then to the centroid around it."""
    climbed = climb(raised.height, raised.bins(places), search / raised.step)
    return raised.px(centroids(raised.height, climbed, centroid / raised.step))


def _corners(places: Places, window_px: int, valid: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return whether each window is wholly on exposed pixels, and its first pixel (x, y)."""
    corner = np.rint(places).astype(np.int64) - window_px // 2
    inside = np.all((corner >= 0) & (corner + window_px <= np.array(valid.shape[::-1])), axis=1)
    for column in np.flatnonzero(inside):
        x, y = corner[column]
        inside[column] = valid[y : y + window_px, x : x + window_px].all()
    return inside, corner


def _on_even_ground(
    scene: Scene, spacing: float, *how: Any
) -> tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.float64]]:
    """Return what :func:`_fit` does, on the image less what its background rises by, where it does.

    One background for a window makes of a column on a slope one that is too wide, and drawn up the slope. The
    backgrounds of a first fit tell the slope, and those of the second tell it better.
    """
    found = _fit(scene, scene.counts, *how)
    for _ in range(_ROUNDS):
        fit = found[0]
        flat = without_slopes(scene.counts, np.where((found[1] == 0)[:, None], fit, np.nan), spacing)
        if flat is scene.counts:
            break
        found = _fit(scene, flat, *how)
        known = np.isfinite(found[0]).all(axis=1)
        at = found[0][known][:, [Y, X]].T
        found[0][known, BACKGROUND] += ndimage.map_coordinates(scene.counts - flat, at, order=1, mode="nearest")
    return found


def _fit(
    scene: Scene,
    counts: Places,
    places: Places,
    corner: NDArray[np.int64],
    inside: NDArray[np.bool_],
    kind: NDArray[np.str_],
    window_px: int,
    search: float,
    blur_sigma_px: float,
) -> tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.float64]]:
    """Return (n, 7) fits, NaN where the window leaves the image, (n,) flags, and R squared.

    What a first fit makes of a weak column may reach out to its neighbours. Where its shape is unusual for its kind, it
    is fitted again with about the usual one (mostly flagged at_bound), as the paper bounds fits by its columns' size.
    """
    fit = np.full((len(places), 7), np.nan)
    status = np.where(inside, 0, Status.OUTSIDE_FRAME).astype(np.uint8)
    explained = np.zeros(len(places))
    if not inside.any():
        return fit, status, explained
    x, y = corner[inside].T
    windows = cut_windows(counts[None], y[None], x[None], window_px, blur_sigma_px)[0]
    start, lower, upper = _bounds(windows, places[inside] - corner[inside], scene.sign, search)
    options: dict[str, Any] = {"blur_sigma_px": blur_sigma_px, "max_iterations": 200, "radius_px": window_px / 2}
    filling = windows, np.where(scene.known, counts, np.nan), corner[inside], blur_sigma_px
    moving = fill_holes(
        *filling, lambda some, n: fit_gaussians(some, start[n], lower[n], upper[n], **options).estimates
    )
    fits = fit_gaussians(windows, start, lower, upper, **options)
    odd = _odd_shapes(fits, kind[inside], start, lower, upper)
    if odd.any():
        again = fit_gaussians(windows[odd], start[odd], lower[odd], upper[odd], **options)
        for name in ("estimates", "status", "r_squared"):
            getattr(fits, name)[odd] = getattr(again, name)
    fit[inside], explained[inside] = fits.estimates, fits.r_squared
    fit[inside, X : Y + 1] += corner[inside]
    weak = ~(np.abs(fits.estimates[:, AMPLITUDE]) > SIGNIFICANT * scene.noise * damping(blur_sigma_px))
    restless = ~fits.converged | np.isin(np.arange(len(weak)), moving)
    flags = {Status.BELOW_NOISE: weak, Status.NOT_CONVERGED: restless, Status.AT_BOUND: fits.at_bound}
    for flag, found in flags.items():
        status[inside] |= np.where(found, flag, Status.OK).astype(np.uint8)
    return fit, status, explained


def _odd_shapes(
    fits: GaussianFits, kind: NDArray[np.str_], start: Places, lower: Places, upper: Places
) -> NDArray[np.bool_]:
    """Return which fits failed or are of a shape unusual for their kind; bind theirs to the usual one, in place."""
    odd = np.zeros(len(kind), dtype=bool)
    _, number, count = np.unique(kind, return_inverse=True, return_counts=True)
    for common in np.flatnonzero(count >= _FEWEST_FOR_SHAPE):
        same = number == common
        usual = np.nanmedian(fits.estimates[same][:, [SIGMA_A, SIGMA_B]], axis=0)
        too_wide = fits.estimates[:, SIGMA_A] > usual[0] * _SHAPE_FACTOR
        too_narrow = fits.estimates[:, SIGMA_B] < usual[1] / _SHAPE_FACTOR
        some = same & (too_wide | too_narrow | ~fits.converged)
        start[some, SIGMA_A : SIGMA_B + 1] = usual
        lower[some, SIGMA_A : SIGMA_B + 1] = usual[1] / _SHAPE_MARGIN
        upper[some, SIGMA_A : SIGMA_B + 1] = usual[0] * _SHAPE_MARGIN
        odd |= some
    return odd


def _bounds(windows: NDArray[np.float32], at: Places, sign: int, search: float) -> tuple[Places, Places, Places]:
    """Return start values and bounds, each (n, 7): the amplitude has the contrast's sign, sigmas fit the window."""
    n, size, _ = windows.shape
    low, high = windows.min(axis=(1, 2)).astype(np.float64), windows.max(axis=(1, 2)).astype(np.float64)
    span = high - low + 1e-12
    start, lower, upper = np.zeros((3, n, 7))
    surroundings = np.quantile(windows, 0.25 if sign > 0 else 0.75, axis=(1, 2))
    start[:, AMPLITUDE] = sign * 0.8 * span
    start[:, [X, Y]], start[:, BACKGROUND] = at, surroundings
    start[:, SIGMA_A], start[:, SIGMA_B] = size / 5, size / 5
    lower[:, AMPLITUDE], upper[:, AMPLITUDE] = np.sort([0 * span, sign * 5 * span], axis=0)
    lower[:, [X, Y]], upper[:, [X, Y]] = at - search, at + search
    lower[:, [SIGMA_A, SIGMA_B]], upper[:, [SIGMA_A, SIGMA_B]] = np.clip(_NARROWEST * size, 0.5, 1.0), size
    lower[:, THETA], upper[:, THETA] = -np.inf, np.inf
    lower[:, BACKGROUND], upper[:, BACKGROUND] = low - 5 * span, high + 5 * span
    return start, lower, upper
