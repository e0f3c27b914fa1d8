"""The columns stage: where the atomic columns are in the summed image."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ...errors import InputError, SettingsError
from ...kernels.filling import fill_near
from ...kernels.gaussian.fit import GaussianFits, fit_gaussians
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, THETA, X, Y
from ...kernels.magnitude import unit_of
from ...kernels.peaks import centroids, climb
from ...kernels.windows import cut_windows
from ...settings.run import ColumnSettings
from ...store import schema
from ...store.columns import check_inside, column_dataset, positions, read_columns_csv
from ...store.schema import Status
from ..filled import fill_holes
from .contrast import SIGNS, chosen, support
from .detect import METHODS, make_detector
from .lattice import Lattice, find_lattice, find_peaks, without_holes
from .relief import Places, Relief, damping, pixel_noise, relief, sample
from .sites import lattice_sites
from .twins import twins_of
from .window_size import default_blur, neighbour_distance, resolve_window, usual_sigma

_SAME = 1 / 3
"""Seeds nearer than this share of the spacing, after refinement, are one column."""
_USUAL_SIGMA = 0.13
"""Sigma of a column, in spacings, before it is fitted."""
_NARROWEST = 0.06
"""Least sigma that is fitted, in windows, from half a pixel to a pixel: what is narrower is a single pixel's noise."""
_SIGNIFICANT = 3.0
"""Amplitude, in standard deviations of the blurred image's noise, below which a column is flagged below_noise."""
_SHAPE_FACTOR = 1.5
"""A sigma beyond this factor of its median over the columns of the same kind is unusual; the fit is then repeated."""
_SHAPE_MARGIN = 1.1
"""With sigmas within this factor of the median."""
_FEWEST_FOR_SHAPE = 5
_TOP = 0.95
"""What frames do not show, and is at least this share of the brightest that they do, is saturated."""


@dataclass(frozen=True)
class _Scene:
    """The summed image, made ready: columns bright in ``image``; ``sign`` -1 where they are dark in ``counts``.

    A pixel is a number of ``unit`` counts; ``known`` tells those that some frame shows, where ``valid`` has small holes
    and saturated tops filled. ``lattices`` are those that were looked for, by the spacing that was given.
    """

    counts: NDArray[np.float64]
    image: NDArray[np.float64]
    valid: NDArray[np.bool_]
    known: NDArray[np.bool_]
    sign: int
    noise: float
    blur_sigma_px: float | None
    unit: float
    lattices: dict[float | None, Lattice | None] = field(default_factory=dict)

    @property
    def dark(self) -> _Scene:
        """The same for dark columns, with the same lattices: they do not depend on the contrast."""
        return replace(self, image=-self.counts, sign=SIGNS["dark"])

    def lattice(self, spacing_px: float | None = None) -> Lattice | None:
        if spacing_px not in self.lattices:
            found = find_lattice(self.image, self.valid, self.noise, self.blur_sigma_px, spacing_px)
            self.lattices[spacing_px] = found
        return self.lattices[spacing_px]

    def relief(self, spacing: float, precision_px: float = np.inf) -> Relief:
        return relief(self.image, self.valid, self.noise, spacing, self.blur_sigma_px, precision_px)


@dataclass(frozen=True)
class _Seeds:
    """Where to look: (n, 2) of (x, y), kinds, numbers to report them by; ``fixed``: the numbers stay as IDs."""

    places: Places
    kind: NDArray[np.str_]
    number: NDArray[np.int64]
    fixed: bool


@dataclass(frozen=True)
class _Found:
    """The columns of one contrast: seeds, refined places, and fits on the summed image in units of the scene."""

    contrast: str
    seeds: _Seeds
    spacing: float
    window_px: int
    blur_sigma_px: float
    places: Places
    fit: Places
    status: NDArray[np.uint8]
    support: float


def find_columns(
    summed: xr.Dataset,
    settings: ColumnSettings | None = None,
    *,
    seeds: xr.Dataset | None = None,
    blur_sigma_px: float | None = None,
    window_px: int | None = None,
) -> xr.Dataset:
    """Find the atomic columns of the summed image and fit each of them (section 2.4 of the paper).

    Seeds come from the image (method ``auto``, see :func:`tract_dask.stages.columns.lattice.find_peaks`), from lattices
    of three atoms (``lattice``, see :func:`tract_dask.lattice_columns`), from a file (``csv``), or are what stands out
    of the noise (``maxima``, ``blobs``, ``template``, see :mod:`tract_dask.stages.columns.detect`). Each moves to the
    local maximum within the search radius, then to the centroid around that, and there Equation 1 is fitted.

    Parameters
    ----------
    summed
        From :func:`tract_dask.sum_image`.
    settings
        Defaults to automatic columns; with contrast ``auto`` both are tried, and the better one is taken.
    seeds
        Columns to start from, as :func:`lattice_columns` and :func:`read_columns_csv` return them and as you may have
        changed them; they take the place of the method, and keep their IDs. With ``share``, the share of the frames in
        which a column is there (:func:`tract_dask.link_detections`), the amplitude is divided by it.
    blur_sigma_px, window_px
        As in the fit of the frames, px. The window's default is half the columns' spacing, odd; the blur's is about
        0.4 of the columns' sigma (:func:`tract_dask.stages.columns.window_size.default_blur`).

    Returns
    -------
    xr.Dataset
        As declared in :data:`schema.COLUMNS`. Columns found automatically or on lattices are numbered from 1, row by
        row from the top and by x within a row (the columns no more than a third of the spacing below a row's first);
        those from a file or ``seeds`` keep their order and IDs. A column whose window leaves the exposed part of the
        image is kept where its seed was, with the flag outside_frame and without a fit. Attributes: spacing_px (median
        distance to the nearest neighbour), window_px, contrast (bright or dark), contrast_rival (the share of its
        support that the other one has, see :mod:`tract_dask.stages.columns.contrast`; None where it was set),
        lattice_px (shortest period of the image; None where it has none, and for columns that were given),
        blur_sigma_px, sigma_px (the columns' median sigma without that blur), rounding_variance_px2 (of the summed
        image), pixel_size_pm, n_seeds, and merged: pairs of a column's ID and the number of a later seed that refined
        to the same column and was dropped. (A seed's number is its ID, or its place in the list of seeds, from 1:
        automatic ones strongest first, those of lattices lattice by lattice, without sites beyond the image.)

    Raises
    ------
    SettingsError
        Where lattices, file or window cannot be used, or seeds of a file lie outside the image.
    InputError
        Where there is no column.
    """
    settings = settings or ColumnSettings()
    schema.validate(summed, schema.SUM, "summed image")
    scene = _scene(summed, blur_sigma_px)
    best, rival = _by_contrast(scene, settings, seeds, window_px)
    fit, found = best.fit.copy(), best.seeds
    fit[:, [AMPLITUDE, BACKGROUND]] *= scene.unit
    if seeds is not None and "share" in seeds:
        fit[:, AMPLITUDE] /= seeds["share"].to_numpy()
    fit[:, [Y, X]] -= summed.attrs.get("rounding_px", (0.0, 0.0))  # by which the sum of whole-pixel shifts is displaced
    places = np.where(np.isfinite(fit[:, [X, Y]]), fit[:, [X, Y]], best.places)
    twins = twins_of(places, _SAME * best.spacing)
    kept = np.setdiff1d(np.arange(len(places)), list(twins))
    kept = kept if found.fixed else kept[_reading_order(places[kept], best.spacing / 3)]
    ids = found.number[kept] if found.fixed else np.arange(1, len(kept) + 1)
    columns = column_dataset(places[kept], found.kind[kept].tolist(), ids, fit[kept], best.status[kept])
    name = dict(zip(kept.tolist(), ids.tolist(), strict=True))
    lattice = scene.lattice() if seeds is None and settings.method in ("auto", *METHODS) else None
    columns.attrs = {
        "spacing_px": neighbour_distance(places[kept]) or best.spacing,
        "window_px": best.window_px,
        "contrast": best.contrast,
        "contrast_rival": rival,
        "lattice_px": lattice.spacing if lattice else None,
        "blur_sigma_px": best.blur_sigma_px,
        "sigma_px": usual_sigma(best.fit[best.status == 0], best.blur_sigma_px),
        "rounding_variance_px2": summed.attrs.get("rounding_variance_px2", 0.0),
        "pixel_size_pm": summed.attrs.get("pixel_size_pm"),
        "n_seeds": len(found.number),
        "merged": sorted([name[first], int(found.number[twin])] for twin, first in twins.items()),
    }
    return columns


def _by_contrast(
    scene: _Scene, settings: ColumnSettings, seeds: xr.Dataset | None, window_px: int | None
) -> tuple[_Found, float | None]:
    """Return the columns of the contrast that is set, or of the one with more support, and the share of the other one.

    Where one contrast leads to no columns, the other is taken; the error is that of bright columns where both do not.
    """
    if settings.contrast != "auto":
        own = scene if settings.contrast == "bright" else scene.dark
        return _found(own, settings, seeds, window_px), None
    found, errors = {}, []
    for name, own in (("bright", scene), ("dark", scene.dark)):
        try:
            found[name] = _found(own, replace(settings, contrast=name), seeds, window_px)
        except InputError as error:
            errors.append(error)
    if not found:
        raise errors[0]
    name, share = chosen({name: found[name].support if name in found else 0.0 for name in SIGNS})
    return found.get(name, next(iter(found.values()))), share


def _found(scene: _Scene, settings: ColumnSettings, given: xr.Dataset | None, window_px: int | None) -> _Found:
    """Return the columns of one contrast."""
    seeds, spacing = _seeds(scene, settings, given)
    window_px = resolve_window(window_px, scene.image.shape, spacing)
    search = spacing / 4 if settings.search_radius_px is None else settings.search_radius_px
    centroid = max(2.0, spacing / 8) if settings.centroid_radius_px is None else settings.centroid_radius_px
    places = _refined(scene.relief(spacing, min(search / 6, centroid / 3)), seeds.places, search, centroid)
    inside, corner = _corners(places, window_px, scene.valid)
    places = np.where(inside[:, None], places, seeds.places)
    blur = default_blur(_USUAL_SIGMA * spacing) if scene.blur_sigma_px is None else float(scene.blur_sigma_px)
    fitted = partial(_fit, scene, places, corner, inside, seeds.kind, window_px, max(search, 1.0))
    fit, status, explained = fitted(blur)
    sigma = usual_sigma(fit[status == 0], blur)
    if scene.blur_sigma_px is None and sigma and (suiting := default_blur(sigma)) != blur:
        fit, status, explained = fitted(blur := suiting)
    held = status == 0
    known = next(iter(scene.lattices.values()), None)
    held_by = support(scene.counts, places[held], fit[held], explained[held], spacing=spacing, lattice=known)
    return _Found(settings.contrast, seeds, spacing, window_px, blur, places, fit, status, held_by)


def _scene(summed: xr.Dataset, blur_sigma_px: float | None) -> _Scene:
    counts = summed["image"].to_numpy().astype(np.float64, copy=False)
    valid = np.isfinite(counts) & (summed["exposure"].to_numpy() > 0)
    if not valid.any():
        raise InputError(
            "the summed image is empty", "columns", "exposed pixels", "none", "Check the drift: it may leave no overlap"
        )
    known = valid
    if not valid.all():
        top = _TOP * float(counts[valid].max()) if summed.attrs.get("saturated") else np.inf
        shown = np.isfinite(counts) & (valid | (counts >= top))
        valid = without_holes(shown)
        near = fill_near(np.where(shown, counts, np.nan)) if (valid & ~shown).any() else counts
        counts = np.where(shown, counts, np.where(valid, near, np.median(sample(counts[known]))))
    unit = unit_of(counts)
    counts = counts if unit == 1 else counts / unit
    return _Scene(counts, counts, valid, known, SIGNS["bright"], pixel_noise(counts, valid), blur_sigma_px, unit)


def _refined(raised: Relief, places: Places, search: float, centroid: float) -> Places:
    """Return places moved to the local maximum within ``search`` px, then to the centroid around it."""
    climbed = climb(raised.height, raised.bins(places), search / raised.step)
    return raised.px(centroids(raised.height, climbed, centroid / raised.step))


def _seeds(scene: _Scene, settings: ColumnSettings, given: xr.Dataset | None) -> tuple[_Seeds, float]:
    """Return the seeds and their spacing in px."""
    if given is None and settings.method == "auto":
        return _automatic(scene, settings)
    if given is None and settings.method == "lattice":
        return _on_lattices(scene, settings)
    if given is None and settings.method in METHODS:
        return _detected(scene, settings)
    where = "seeds"
    if given is None:
        if settings.csv is None:
            raise SettingsError(
                "there is no file to take the columns from",
                "setting csv (ColumnSettings)",
                "the path of a CSV file for method csv",
                "none",
                "Give it, or choose method auto",
            )
        given, where = read_columns_csv(settings.csv), settings.csv
    seeds = _Seeds(positions(given), schema.texts(given["kind"].to_numpy()), given["column_id"].to_numpy(), True)
    check_inside(given, scene.valid.shape, where)
    measured = None if settings.spacing_px else neighbour_distance(seeds.places) or _lattice_of(scene, settings).spacing
    return seeds, settings.spacing_px or measured or 0.0


def _automatic(scene: _Scene, settings: ColumnSettings) -> tuple[_Seeds, float]:
    if settings.spacing_px is None:
        lattice: Lattice | None = _lattice_of(scene, settings)
    else:
        lattice = scene.lattice(settings.spacing_px)
    spacing = lattice.spacing if lattice else float(settings.spacing_px or 0)
    places = find_peaks(scene.relief(spacing), lattice, spacing, settings.min_amplitude)
    if not len(places):
        raise _none_stands_out(scene, settings)
    number = np.arange(1, len(places) + 1)
    return _Seeds(places, np.full(len(places), ""), number, False), neighbour_distance(places) or spacing


def _detected(scene: _Scene, settings: ColumnSettings) -> tuple[_Seeds, float]:
    """Return the seeds that a detector finds, without a lattice."""
    detector = make_detector(scene.counts, scene.valid, settings, blur_sigma_px=scene.blur_sigma_px)
    places, _ = detector(scene.counts, scene.valid)
    if not len(places):
        raise _none_stands_out(scene, settings)
    number = np.arange(1, len(places) + 1)
    return _Seeds(places, np.full(len(places), ""), number, False), detector.spacing_px


def _none_stands_out(scene: _Scene, settings: ColumnSettings) -> InputError:
    return InputError(
        "no column stands out of the noise",
        "columns",
        f"columns {'brighter' if scene.sign > 0 else 'darker'} than their surroundings",
        "none",
        f"Check the contrast (now {settings.contrast}) and spacing_px, or give the columns in a CSV file",
    )


def _lattice_of(scene: _Scene, settings: ColumnSettings) -> Lattice:
    lattice = scene.lattice()
    if lattice is None:
        raise InputError(
            "the summed image shows no lattice, so the distance between columns is not known",
            "columns",
            "a periodic image",
            "none of its shifts matches it",
            f"Give spacing_px, or a CSV file, and check the contrast (now {settings.contrast}) and the drift",
        )
    return lattice


def _on_lattices(scene: _Scene, settings: ColumnSettings) -> tuple[_Seeds, float]:
    """Return the sites of all lattices inside the image; a site that two lattices share belongs to the first."""
    sites = lattice_sites(settings.lattices, scene.valid.shape)
    seeds = _Seeds(positions(sites), schema.texts(sites["kind"].to_numpy()), sites["column_id"].to_numpy(), False)
    finest = settings.spacing_px or sites.attrs["spacing_px"]
    shared = twins_of(seeds.places, _SAME * finest)
    distinct = np.delete(seeds.places, list(shared), axis=0)
    return seeds, settings.spacing_px or neighbour_distance(distinct) or finest


def _corners(places: Places, window_px: int, valid: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return whether each window is wholly on exposed pixels, and its first pixel (x, y)."""
    corner = np.rint(places).astype(np.int64) - window_px // 2
    inside = np.all((corner >= 0) & (corner + window_px <= np.array(valid.shape[::-1])), axis=1)
    for column in np.flatnonzero(inside):
        x, y = corner[column]
        inside[column] = valid[y : y + window_px, x : x + window_px].all()
    return inside, corner


def _fit(
    scene: _Scene,
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
    windows = cut_windows(scene.counts[None], y[None], x[None], window_px, blur_sigma_px)[0]
    start, lower, upper = _bounds(windows, places[inside] - corner[inside], scene.sign, search)
    options: dict[str, Any] = {"blur_sigma_px": blur_sigma_px, "max_iterations": 200, "radius_px": window_px / 2}
    filling = windows, np.where(scene.known, scene.counts, np.nan), corner[inside], blur_sigma_px
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
    weak = ~(np.abs(fits.estimates[:, AMPLITUDE]) > _SIGNIFICANT * scene.noise * damping(blur_sigma_px))
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


def _reading_order(places: Places, thickness: float) -> NDArray[np.int64]:
    """Return the order by rows from the top, then by x; a row reaches ``thickness`` px below its topmost place."""
    row = np.zeros(len(places), dtype=np.int64)
    top, current = -np.inf, -1
    for place in np.lexsort((places[:, 0], places[:, 1])):
        if places[place, 1] > top + thickness:
            top, current = places[place, 1], current + 1
        row[place] = current
    return np.lexsort((places[:, 0], row))
