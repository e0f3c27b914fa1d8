"""The columns stage: where the atomic columns are in the summed image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ...errors import InputError, SettingsError
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from ...settings.run import ColumnSettings
from ...store import schema
from ...store.columns import check_inside, column_dataset, positions, read_columns_csv
from .contrast import SIGNS, chosen, support
from .detect import METHODS, make_detector
from .grains import with_grains
from .grouping import Grouped, grouped, same_column_px
from .kinds import kinds_of
from .lattice import Lattice, find_peaks
from .relief import Places
from .scene import Scene, scene_of
from .singles import Fits, Seeds, fitted_alone
from .sites import lattice_sites
from .sublattices import Extended, LeftOut, told, with_fainter
from .twins import twins_of
from .window_size import neighbour_distance, usual_sigma

_SAME = 1 / 3
"""Seeds nearer than this share of the spacing, after refinement, are one column."""


@dataclass(frozen=True)
class _Found:
    """The columns of one contrast: seeds, their distance, fits in units of the scene, groups, and support."""

    contrast: str
    seeds: Seeds
    spacing: float
    fits: Fits
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

    Seeds come from the image (method ``auto``, see :func:`tract_dask.stages.columns.lattice.find_peaks`, and
    :mod:`tract_dask.stages.columns.sublattices` for fainter kinds), from lattices
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
        As declared in :data:`schema.COLUMNS`; ``kind`` is that of :func:`tract_dask.stages.columns.kinds.kinds_of`
        where it was not given. Columns found automatically or on lattices are numbered from 1, row by
        row from the top and by x within a row (the columns no more than a third of the spacing below a row's first);
        those from a file or ``seeds`` keep their order and IDs. A column whose window leaves the exposed part of the
        image is kept where its seed was, with the flag outside_frame and without a fit. Attributes: spacing_px (median
        distance to the nearest neighbour), window_px, contrast (bright or dark), contrast_rival (the share of its
        support that the other one has, see :mod:`tract_dask.stages.columns.contrast`; None where it was set),
        lattice_px (shortest period of the image; None where it has none, and for columns that were given),
        blur_sigma_px, sigma_px (the columns' median sigma without that blur), rounding_variance_px2 (of the summed
        image), pixel_size_pm, n_seeds, left_out (sublattices that were seen and not taken, see
        :class:`tract_dask.stages.columns.sublattices.LeftOut`), one_of_two (IDs of given columns that touch one that
        was not given), and merged: pairs of a column's ID and the number of a later seed that refined to the same
        column and was dropped. (A seed's number is its ID, or its place in the list of seeds, from 1: automatic ones
        strongest first, those of lattices lattice by lattice, without sites beyond the image.)

    Raises
    ------
    SettingsError
        Where lattices, file or window cannot be used, or seeds of a file lie outside the image.
    InputError
        Where there is no column.
    """
    settings = settings or ColumnSettings()
    schema.validate(summed, schema.SUM, "summed image")
    scene = scene_of(summed, blur_sigma_px)
    chosen_one, rival = _by_contrast(scene, settings, seeds, window_px)
    own = scene if chosen_one.contrast == "bright" else scene.dark
    best, left_out = _with_others(own, settings, chosen_one, window_px, given=seeds is not None)
    fits, found = best.fits, best.seeds
    fit = _in_counts(best, scene, summed, seeds)
    places = np.where(np.isfinite(fit[:, [X, Y]]), fit[:, [X, Y]], fits.places)
    twins = twins_of(places, same_column_px(places, best.groups, _SAME * best.spacing))
    kept = np.setdiff1d(np.arange(len(places)), list(twins))
    kept = kept if found.fixed else kept[_reading_order(places[kept], best.spacing / 3)]
    ids = found.number[kept] if found.fixed else np.arange(1, len(kept) + 1)
    groups = _numbered(best.groups[kept])
    lattice = scene.lattice() if seeds is None and settings.method in ("auto", *METHODS) else None
    kinds = found.kind[kept] if lattice is None else kinds_of(places[kept], fit[kept, AMPLITUDE], lattice)
    columns = column_dataset(
        places[kept], kinds.tolist(), ids, fit[kept], fits.status[kept], groups, best.unresolved[kept]
    )
    name = dict(zip(kept.tolist(), ids.tolist(), strict=True))
    columns.attrs = {
        "spacing_px": best.spacing if groups.any() else neighbour_distance(places[kept]) or best.spacing,
        "window_px": fits.window_px,
        "contrast": chosen_one.contrast,
        "contrast_rival": rival,
        "lattice_px": lattice.spacing if lattice else None,
        "blur_sigma_px": fits.blur_sigma_px,
        "sigma_px": usual_sigma(fits.fit[fits.status == 0], fits.blur_sigma_px),
        "rounding_variance_px2": summed.attrs.get("rounding_variance_px2", 0.0),
        "pixel_size_pm": summed.attrs.get("pixel_size_pm"),
        "n_seeds": len(found.number),
        "left_out": told(left_out, places[kept]),
        "one_of_two": [int(ids[k]) for k in np.flatnonzero(best.half[kept])],
        "merged": sorted([name[first], int(found.number[twin])] for twin, first in twins.items()),
    }
    return columns


def _in_counts(best: Grouped, scene: Scene, summed: xr.Dataset, seeds: xr.Dataset | None) -> Places:
    """Return fits (n, 7) in counts, where the columns are."""
    fit = best.fits.fit.copy()
    fit[:, [AMPLITUDE, BACKGROUND]] *= scene.unit
    if seeds is not None and "share" in seeds:
        fit[:, AMPLITUDE] /= seeds["share"].to_numpy()
    fit[:, [Y, X]] -= summed.attrs.get("rounding_px", (0.0, 0.0))  # by which the sum of whole-pixel shifts is displaced
    return fit


def _with_others(
    scene: Scene, settings: ColumnSettings, found: _Found, window_px: int | None, *, given: bool
) -> tuple[Grouped, list[LeftOut]]:
    """Return the columns with those of fainter sublattices and those that touch, and sublattices that were left out."""
    more = Extended(found.seeds, found.spacing, found.fits, [], window_px)
    if not given and settings.method == "auto":
        more = with_fainter(scene, settings, found.seeds, found.spacing, found.fits, window_px)
    crowded = len(more.seeds.places) > len(found.seeds.places)
    if not given and settings.method == "auto":
        more = with_grains(scene, settings, more)
    best = grouped(scene, settings, more.seeds, more.spacing, more.fits, more.window_px, crowded=crowded)
    return best, more.left_out


def _by_contrast(
    scene: Scene, settings: ColumnSettings, seeds: xr.Dataset | None, window_px: int | None
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


def _found(scene: Scene, settings: ColumnSettings, given: xr.Dataset | None, window_px: int | None) -> _Found:
    """Return the columns of one contrast."""
    seeds, spacing = _seeds(scene, settings, given)
    fits = fitted_alone(scene, settings, seeds, spacing, window_px)
    held = fits.status == 0
    known = next(iter(scene.lattices.values()), None)
    held_by = support(
        scene.counts, fits.places[held], fits.fit[held], fits.explained[held], spacing=spacing, lattice=known
    )
    return _Found(settings.contrast, seeds, spacing, fits, held_by)


def _seeds(scene: Scene, settings: ColumnSettings, given: xr.Dataset | None) -> tuple[Seeds, float]:
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
    blind = given[schema.UNRESOLVED.name].to_numpy() if schema.UNRESOLVED.name in given else None
    seeds = Seeds(positions(given), schema.texts(given["kind"].to_numpy()), given["column_id"].to_numpy(), True, blind)
    check_inside(given, scene.valid.shape, where)
    measured = None if settings.spacing_px else neighbour_distance(seeds.places) or _lattice_of(scene, settings).spacing
    return seeds, settings.spacing_px or measured or 0.0


def _automatic(scene: Scene, settings: ColumnSettings) -> tuple[Seeds, float]:
    if settings.spacing_px is None:
        lattice: Lattice | None = _lattice_of(scene, settings)
    else:
        lattice = scene.lattice(settings.spacing_px)
    spacing = lattice.spacing if lattice else float(settings.spacing_px or 0)
    places = find_peaks(scene.relief(spacing), lattice, spacing, settings.min_amplitude)
    if not len(places):
        raise _none_stands_out(scene, settings)
    number = np.arange(1, len(places) + 1)
    return Seeds(places, np.full(len(places), ""), number, False), neighbour_distance(places) or spacing


def _detected(scene: Scene, settings: ColumnSettings) -> tuple[Seeds, float]:
    """Return the seeds that a detector finds, without a lattice."""
    detector = make_detector(scene.counts, scene.valid, settings, blur_sigma_px=scene.blur_sigma_px)
    places, _ = detector(scene.counts, scene.valid)
    if not len(places):
        raise _none_stands_out(scene, settings)
    number = np.arange(1, len(places) + 1)
    return Seeds(places, np.full(len(places), ""), number, False), detector.spacing_px


def _none_stands_out(scene: Scene, settings: ColumnSettings) -> InputError:
    return InputError(
        "no column stands out of the noise",
        "columns",
        f"columns {'brighter' if scene.sign > 0 else 'darker'} than their surroundings",
        "none",
        f"Check the contrast (now {settings.contrast}) and spacing_px, or give the columns in a CSV file",
    )


def _lattice_of(scene: Scene, settings: ColumnSettings) -> Lattice:
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


def _on_lattices(scene: Scene, settings: ColumnSettings) -> tuple[Seeds, float]:
    """Return the sites of all lattices inside the image; a site that two lattices share belongs to the first."""
    sites = lattice_sites(settings.lattices, scene.valid.shape)
    seeds = Seeds(positions(sites), schema.texts(sites["kind"].to_numpy()), sites["column_id"].to_numpy(), False)
    finest = settings.spacing_px or sites.attrs["spacing_px"]
    shared = twins_of(seeds.places, _SAME * finest)
    distinct = np.delete(seeds.places, list(shared), axis=0)
    return seeds, settings.spacing_px or neighbour_distance(distinct) or finest


def _numbered(groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return groups numbered from 1, in the order of their first columns."""
    numbers, first = np.unique(groups[groups > 0], return_index=True)
    found = np.zeros(len(groups), np.int64)
    for k, number in enumerate(numbers[np.argsort(first, kind="stable")], 1):
        found[groups == number] = k
    return found


def _reading_order(places: Places, thickness: float) -> NDArray[np.int64]:
    """Return the order by rows from the top, then by x; a row reaches ``thickness`` px below its topmost place."""
    row = np.zeros(len(places), dtype=np.int64)
    top, current = -np.inf, -1
    for place in np.lexsort((places[:, 0], places[:, 1])):
        if places[place, 1] > top + thickness:
            top, current = places[place, 1], current + 1
        row[place] = current
    return np.lexsort((places[:, 0], row))
