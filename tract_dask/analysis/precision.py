"""How precisely columns that keep still are located, and could be: Figure 4c and Supplementary Table 2 of the paper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import chi2

from ..errors import InputError, SettingsError
from ..kernels.gaussian.information import column_bounds
from ..kernels.gaussian.model import blurred
from ..kernels.gaussian.parameters import SIGMA_A, SIGMA_B, X, Y
from ..kernels.windows import blur_variance
from ..store.results import fitted_with
from .motion import dose_of, named, pixel_size_pm, positions, spread, standard_deviation, standard_errors

_WIDEST_GAP = np.deg2rad(100)
"""Directions to the neighbours of a column inside a crystal are nowhere farther apart than this."""
_NEIGHBOURS, _REACH = 6, 1.5
"""Neighbours are the columns within this factor of the median distance of the sixth nearest."""
_RULES = ("both", "inside", "spread")
_COMPARED = {
    "gaussian": "Standard deviation per axis of positions by Gaussian fits",
    "centroid": "Standard deviation per axis of positions by centroids, in the same frames",
    "centroid_all": "Standard deviation per axis of positions by centroids, in all frames",
    "theory": "The paper's best precision: width / sqrt(electrons)",
    "crlb": "Cramer-Rao bound of the fit",
}


def precision_table(
    tracks: xr.Dataset | Sequence[xr.Dataset],
    *,
    dose: Sequence[float] | None = None,
    columns: Sequence[int] | None = None,
    rule: str = "both",
    confidence: float = 0.999,
) -> xr.Dataset:
    """Return the precision of positions against the dose of a frame: Figure 4c and Supplementary Table 2 of the paper.

    Parameters
    ----------
    tracks
        One Dataset for each dose: of :func:`tract_dask.fit_doses`, which sums the frames of one movie, or of one movie
        each. Only accepted fits count.
    dose
        Of a frame, e/Å^2, for each Dataset; None: their attribute ``dose``.
    columns
        IDs of the columns that keep still, in every Dataset. None: those that :func:`static_columns` finds in each.
    rule, confidence
        As for :func:`static_columns`.

    Returns
    -------
    Dataset
        Over dose, ascending, in pm per axis, means over the columns: ``gaussian`` and, where the tracks have centroids,
        ``centroid``, the standard deviation over the frames, and ``centroid_all``, over all frames, as in the paper,
        for a centroid cannot tell that a column is not there; ``theory`` (:func:`best_precision`); ``crlb``
        (:func:`cramer_rao`). Each has a standard error, ``gaussian_stderr`` and so on, from its scatter over the
        columns. ``n_columns``, ``n_frames`` and ``accepted``, the share of the fits that count. In memory.

    Raises
    ------
    SettingsError
        Where dose or pixel size are not known, or the columns.
    InputError
        Where no column keeps still.

    Notes
    -----
    A standard deviation of n frames is on average 1 - 1 / (8 (n - 1)) of the true one. Where many fits are not
    accepted, those that are flatter it.
    """
    several = [tracks] if isinstance(tracks, xr.Dataset) else list(tracks)
    doses = [dose_of(one) for one in several] if dose is None else [float(value) for value in dose]
    if len(doses) != len(several):
        raise SettingsError("every Dataset has one dose", "precision_table: dose", f"{len(several)}", f"{len(doses)}")
    rows = []
    for one, value in zip(several, doses, strict=True):
        found = column_precision(one, value).compute()
        chosen = _chosen(found, columns, rule, confidence)
        rows.append(_mean_over_columns(found.isel(column_id=chosen)))
    table: xr.Dataset = xr.concat(rows, dim="dose", join="exact").assign_coords(dose=doses).sortby("dose")
    table["dose"].attrs = {"units": "e/A^2", "long_name": "Dose of a frame"}
    return table


def column_precision(tracks: xr.Dataset, dose: float | None = None) -> xr.Dataset:
    """Return the precision of each column; a row of :func:`precision_table` is the mean over some of them.

    Parameters
    ----------
    tracks
        Results; only accepted fits count.
    dose
        Of a frame, e/Å^2; None: the tracks' attribute ``dose``.

    Returns
    -------
    Dataset
        Over column_id, in pm per axis and as lazy as the tracks: ``gaussian``, ``centroid`` and ``centroid_all`` (where
        the tracks have them), ``theory`` and ``crlb``; ``stderr``, the harmonic mean of the errors that the fits
        state; ``n`` accepted of ``n_frames`` frames; ``inside``, whether neighbours of the column's kind surround it.
    """
    spreads = spread(tracks)
    compared = {
        "gaussian": spreads["sd"],
        "theory": best_precision(tracks, dose),
        "crlb": cramer_rao(tracks),
    }
    if "centroid" in tracks:
        fitted = positions(tracks)
        centroids = tracks["centroid"] * pixel_size_pm(tracks)
        compared["centroid"] = _per_axis(standard_deviation(centroids.where(fitted.notnull())))
        compared["centroid_all"] = _per_axis(standard_deviation(centroids))
    found = xr.Dataset({name: named(values, "pm", _COMPARED[name]) for name, values in compared.items()})
    stderr = 1 / (1 / standard_errors(tracks)).mean("frame")
    found["stderr"] = named(_per_axis(stderr), "pm", "Standard error per axis that the fits state")
    found["n"] = spreads["n"]
    found["n_frames"] = named(xr.full_like(spreads["n"], tracks.sizes["frame"]), "1", "Frames")
    inside = xr.DataArray(_surrounded(tracks), {"column_id": tracks["column_id"]}, ("column_id",))
    found["inside"] = named(inside, "1", "Whether neighbours of its kind surround the column")
    return found


def static_columns(tracks: xr.Dataset, *, rule: str = "both", confidence: float = 0.999) -> NDArray[np.int64]:
    """Return the IDs of columns that can be expected to keep still.

    Parameters
    ----------
    tracks
        Results; only accepted fits count.
    rule
        ``inside``: columns that neighbours of their own kind surround, so that two directions to neighbours in turn are
        nowhere more than 100 degrees apart (the paper's sub-surface columns; those at the edge of the field are left
        out as well). ``spread``: columns whose standard deviation, against the errors that their fits state, is not
        larger than the columns' median by more than chance allows. ``both``: columns for which both hold.
    confidence
        Of that test: the probability that a column passes which does keep still. A column passes that moves by less
        than its errors.

    Raises
    ------
    SettingsError
        Where there is no such rule.
    InputError
        Where there is no such column.
    """
    found = column_precision(tracks, dose=1.0).compute()  # no rule depends on the dose
    return np.asarray(found["column_id"].to_numpy()[_chosen(found, None, rule, confidence)])


def best_precision(tracks: xr.Dataset, dose: float | None = None) -> xr.DataArray:
    """Return the paper's estimate of the best possible precision, (column_id,) in pm per axis (section 2.5).

    It is the width of the column divided by the square root of the electrons that fall on it in a frame. The width is
    2 sigma (root mean square of both axes) and the area that of Equation 5, the ellipse of radii 2 sigma, both of the
    column in the summed image, without the blur.

    Notes
    -----
    The column's size cancels: a round column has 100 pm / sqrt(pi dose), with the dose in e/Å^2. That is 5.05, 3.57 and
    2.52 pm at 125, 250 and 500 e/Å^2. The paper does not say what width and area it took; the 5.11, 3.61 and 2.56 pm
    of its Supplementary Table 2 are 57.1 pm / sqrt(dose), 1.3 % more. That is what this formula gives for sigmas in the
    ratio of 1.25, and as well a width of 57.1 pm (14.3 of its pixels) and the electrons of 1 Å^2.
    """
    pixel, dose = pixel_size_pm(tracks), dose_of(tracks) if dose is None else dose
    column = _columns_as_they_are(tracks)
    sigmas = column[:, [SIGMA_A, SIGMA_B]] * pixel
    area = 4 * np.pi * sigmas.prod(axis=1) / 100.0**2
    width = 2 * np.sqrt((sigmas**2).mean(axis=1))
    return _of_columns(tracks, width / np.sqrt(dose * area), _COMPARED["theory"])


def cramer_rao(tracks: xr.Dataset) -> xr.DataArray:
    """Return the Cramér-Rao bound of the fit, (column_id,) in pm per axis (root mean square of both axes).

    It is the smallest standard deviation that positions can have, of any unbiased estimator, where pixels are counts:
    for Equation 1 with the parameters that were free, seven or four, in the window that was fitted, at the fit of the
    summed image without its blur.

    Notes
    -----
    Counts are detector units above ``offset`` times ``gain``: the bound holds where a count is an electron. Read noise
    counts where it was measured. How far the detector spreads an electron does not: what is wider than that spread
    can be seen as well as without it. Least squares sees blurred
    pixels, and so, at the rim, those up to a blur beyond the window; and neighbours disturb the model. So a fit can
    come out some per cent below the bound, the more so where few are accepted.
    """
    window_px = fitted_with(tracks, "window_px")
    column = _columns_as_they_are(tracks)
    places = column[:, [X, Y]]
    column[:, [X, Y]] -= np.rint(places) - window_px // 2
    fixed = fitted_with(tracks, "shape") == "fixed"
    dark = tracks.attrs.get("dark_variance", 0.0)
    bounds = column_bounds(column, window_px, radius_px=window_px / 2, fixed_shape=fixed, dark_variance=dark)
    return _of_columns(tracks, np.sqrt((bounds.x + bounds.y) / 2) * pixel_size_pm(tracks), _COMPARED["crlb"])


def _columns_as_they_are(tracks: xr.Dataset) -> NDArray[np.float64]:
    """Return the columns in the summed image without its blur, (column_id, parameter); NaN where it was not fitted."""
    fits = tracks["fit_ref"].to_numpy().astype(np.float64)
    return blurred(fits, -blur_variance(fitted_with(tracks, "reference_blur_px")))


def _of_columns(tracks: xr.Dataset, values: NDArray[np.float64], description: str) -> xr.DataArray:
    return named(xr.DataArray(values, {"column_id": tracks["column_id"]}, ("column_id",)), "pm", description)


def _per_axis(values: xr.DataArray) -> xr.DataArray:
    """Return the root mean square over the axes."""
    return (values**2).mean("axis", skipna=False) ** 0.5


def _mean_over_columns(found: xr.Dataset) -> xr.Dataset:
    """Return the means of what is compared, their standard errors, and how much went into them."""
    row = xr.Dataset()
    for name, description in _COMPARED.items():
        if name in found:
            values = found[name]
            row[name] = named(values.mean("column_id"), "pm", f"{description}, mean over the columns")
            error = values.std("column_id", ddof=1) / np.sqrt(values.notnull().sum("column_id"))
            row[f"{name}_stderr"] = named(error, "pm", f"Standard error of {name}")
    row["n_columns"] = named(found["n"].count(), "1", "Columns")
    row["n_frames"] = named(found["n_frames"].max(), "1", "Frames")
    row["accepted"] = named(found["n"].sum() / found["n_frames"].sum(), "1", "Share of the fits that are accepted")
    return row


def _chosen(found: xr.Dataset, columns: Sequence[int] | None, rule: str, confidence: float) -> NDArray[np.bool_]:
    """Return which columns keep still, (column_id,)."""
    ids = found["column_id"].to_numpy()
    if columns is not None:
        missing = np.setdiff1d(columns, ids)
        if missing.size:
            raise SettingsError(
                "there are no such columns", "columns", "IDs of the tracks", ", ".join(map(str, missing.tolist()))
            )
        return np.isin(ids, columns)
    if rule not in _RULES:
        raise SettingsError("there is no such rule", "static_columns: rule", ", ".join(_RULES), rule)
    chosen = found["n"].to_numpy() > 1
    if rule != "spread":
        chosen &= found["inside"].to_numpy()
    if rule != "inside":
        chosen &= _quiet(found, chosen, confidence)
    if not chosen.any():
        raise InputError(
            "no column is found that keeps still",
            "static_columns",
            "columns inside the particle, whose spread is that of their errors",
            f"{len(ids)} columns",
            "Name such columns, or take another rule (fits of filtered frames state no errors)",
        )
    return chosen


def _quiet(found: xr.Dataset, typical: NDArray[np.bool_], confidence: float) -> NDArray[np.bool_]:
    """Return which columns spread no more than their errors tell, in units of the median over ``typical`` columns.

    For a column that keeps still, the sum over both axes of (n - 1) sd^2 / error^2 is chi-squared distributed, with
    2 (n - 1) degrees of freedom.
    """
    ratio = (found["gaussian"] / found["stderr"]).to_numpy() ** 2
    freedom = 2 * np.maximum(found["n"].to_numpy() - 1, 1)
    known = typical & np.isfinite(ratio)
    usual = float(np.median(ratio[known])) if known.any() else np.nan
    return np.asarray(ratio / usual * freedom <= chi2.ppf(confidence, freedom))


def _surrounded(tracks: xr.Dataset) -> NDArray[np.bool_]:
    """Return which columns have neighbours of their own kind in all directions, (column_id,)."""
    places = np.stack([tracks["x_ref"].to_numpy(), tracks["y_ref"].to_numpy()], axis=1)
    kinds = np.array([str(kind) for kind in tracks["kind"].to_numpy()])
    inside = np.zeros(len(places), np.bool_)
    for kind in np.unique(kinds):
        here = np.flatnonzero(kinds == kind)
        if len(here) <= _NEIGHBOURS:
            continue
        tree = cKDTree(places[here])
        reach = _REACH * float(np.median(np.asarray(tree.query(places[here], k=_NEIGHBOURS + 1)[0])[:, -1]))
        for number, near in zip(here, tree.query_ball_point(places[here], reach), strict=True):
            away = places[here[near]] - places[number]
            angles = np.sort(np.arctan2(away[:, 1], away[:, 0])[np.any(away != 0, axis=1)])
            gaps = np.diff(angles, append=angles[:1] + 2 * np.pi)
            inside[number] = gaps.size > 1 and gaps.max() <= _WIDEST_GAP
    return inside
