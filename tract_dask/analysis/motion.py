"""Where the columns are, in picometres: positions, their spread, displacements, and the lattice that they belong to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..errors import SettingsError
from ..kernels.linear_motion import moved
from ..stages.sites import fit_sites
from ..store import results, schema
from .weights import blocks, drawn_together, scatter_of

AROUND = 100
"""Frames on each side of a frame that say how large a column's error is there."""
_FEWEST = 10
"""Accepted frames from which on the scatter of places scales their errors."""
_EXACT = 1e9
"""Degrees of freedom of an error that is taken as known."""


def pixel_size_pm(tracks: xr.Dataset) -> float:
    """Return the size of a pixel in pm.

    Raises
    ------
    SettingsError
        Where the tracks do not know it.
    """
    again = "Run again with --pixel-size-pm, or say tracks.assign_attrs(pixel_size_pm=4.0)"
    return _calibrated(tracks, "pixel_size_pm", "the size of a pixel is not known", "picometres for one pixel", again)


def dose_of(tracks: xr.Dataset) -> float:
    """Return the dose of a frame, e/Å^2.

    Raises
    ------
    SettingsError
        Where the tracks do not know it.
    """
    again = "Run again with --dose, or give the dose here"
    return _calibrated(tracks, "dose", "the dose of a frame is not known", "electrons for one square angstrom", again)


def frame_times(tracks: xr.Dataset) -> NDArray[np.float64]:
    """Return the time of every frame (frames,) in s, also where frames were lost or left out between them.

    Tracks that know no times, as where the frame time was told them later, have multiples of the frame time.

    Raises
    ------
    SettingsError
        Where the time of a frame is not known.
    """
    again = "Run again with --frame-time-s, or say tracks.assign_attrs(frame_time_s=0.1)"
    step = _calibrated(tracks, "frame_time_s", "the time of a frame is not known", "seconds for one frame", again)
    frame = tracks["frame"].to_numpy().astype(np.float64)
    times = tracks["time"].to_numpy().astype(np.float64) if "time" in tracks else frame
    return frame * step if np.array_equal(times, np.arange(len(times))) or np.array_equal(times, frame) else times


def _calibrated(tracks: xr.Dataset, name: str, problem: str, expected: str, remedy: str) -> float:
    """Return a calibration of the movie that the tracks carry as an attribute."""
    value = tracks.attrs.get(name)
    if not value:
        raise SettingsError(problem, f"tracks.attrs[{name!r}]", expected, repr(value), remedy)
    return float(value)


def positions(tracks: xr.Dataset) -> xr.DataArray:
    """Return the drift-corrected places of the columns: their tracks.

    Parameters
    ----------
    tracks
        Results, from :func:`tract_dask.open_results`; only accepted fits count.

    Returns
    -------
    DataArray
        (frame, column_id, axis) in pm; NaN where a fit is not accepted. As lazy as the tracks.

    Raises
    ------
    SettingsError
        Where the size of a pixel is not known.
    """
    return _in_pm(tracks, "fit", "Place of the column, drift-corrected")


def standard_errors(tracks: xr.Dataset) -> xr.DataArray:
    """Return the standard errors of :func:`positions`, (frame, column_id, axis) in pm, as the fits state them."""
    return _in_pm(tracks, "stderr", "Standard error of the place")


def _in_pm(tracks: xr.Dataset, name: str, description: str) -> xr.DataArray:
    scale = pixel_size_pm(tracks)
    values = results.accepted(tracks)[name].sel(parameter=list(schema.AXES))
    values = values.drop_vars(["parameter", "unit"], errors="ignore").rename(parameter="axis")
    values = (values * scale).assign_coords(axis=schema.texts(schema.AXES))
    return values.rename(None).assign_attrs(units="pm", long_name=description)


def reference_positions(tracks: xr.Dataset) -> xr.DataArray:
    """Return the places of the columns in the summed image, (column_id, axis) in pm."""
    places = xr.concat([tracks[f"{axis}_ref"] for axis in schema.AXES], dim="axis").transpose("column_id", "axis")
    places = (places * pixel_size_pm(tracks)).assign_coords(axis=schema.texts(schema.AXES))
    return places.rename(None).assign_attrs(units="pm", long_name="Place of the column in the summed image")


def places_in_frames(tracks: xr.Dataset) -> xr.DataArray:
    """Return where the frames show the columns: with the drift, and with what else positions are freed from.

    Parameters
    ----------
    tracks
        Results, some frames of them perhaps; fits that are not accepted count as well.

    Returns
    -------
    DataArray
        (frame, column_id, axis) in px of the movie, in memory.
    """
    names = [name for name in ("fit", "drift", "motion", "row_shift") if name in tracks]
    some = tracks[names].sel(parameter=list(schema.AXES)).compute().transpose("frame", ...)
    places = some["fit"].transpose("frame", "column_id", "parameter").to_numpy()
    if "motion" in some and some["motion"].any():
        centre = np.array(tracks.attrs["motion_centre"])
        places = (centre + moved(places[..., ::-1] - centre, some["motion"].to_numpy()))[..., ::-1]
    places = places + some["drift"].to_numpy()[:, None]
    if "row_shift" in some:
        places[..., 1] += some["row_shift"].transpose("frame", "column_id").to_numpy()
    coords = {"frame": some["frame"], "column_id": some["column_id"], "axis": schema.texts(schema.AXES)}
    about = {"units": "px", "long_name": "Place of the column in the frame"}
    return xr.DataArray(places, coords, ("frame", "column_id", "axis"), attrs=about)


def spread(tracks: xr.Dataset) -> xr.Dataset:
    """Return how far each column spreads about its mean place: the precision, for a column that keeps still.

    Parameters
    ----------
    tracks
        Results; only accepted fits count.

    Returns
    -------
    Dataset
        Over column_id, in pm and as lazy as the tracks: ``sd_x``, ``sd_y`` (of a sample, n - 1), ``sd`` per axis, the
        root mean square of both, ``sd_radial``, the root of the sum of their squares, and ``mean_displacement``, the
        mean distance from the place in the summed image, which the original calls RMSD. ``n``: accepted frames.

    Notes
    -----
    Figure 4 of the paper. For a column that keeps still, with the same normal error σ along both axes,
    ``sd`` = σ, ``sd_radial`` = √2 σ and ``mean_displacement`` = √(π/2) σ.
    """
    place = positions(tracks)
    deviation = standard_deviation(place)
    sd_y, sd_x = (deviation.sel(axis=axis, drop=True) for axis in schema.AXES)
    radial = _length(deviation)
    away = _length(place - reference_positions(tracks)).mean("frame")
    found = {
        "sd_x": (sd_x, "Standard deviation along x"),
        "sd_y": (sd_y, "Standard deviation along y"),
        "sd": (radial / np.sqrt(2), "Standard deviation per axis, root mean square of x and y"),
        "sd_radial": (radial, "Standard deviation in the plane"),
        "mean_displacement": (away, "Mean distance from the place in the summed image"),
    }
    spreads = xr.Dataset({name: named(values, "pm", text) for name, (values, text) in found.items()})
    spreads["n"] = named(place.notnull().all("axis").sum("frame"), "1", "Accepted frames")
    return spreads


def displacement(tracks: xr.Dataset, first: int, second: int) -> xr.Dataset:
    """Return how far each column moved from one frame to another, and how sure that is.

    Parameters
    ----------
    tracks
        Results; only accepted fits count.
    first, second
        Frames, as the coordinate ``frame`` numbers them.

    Returns
    -------
    Dataset
        Over column_id: ``displacement`` (column_id, axis) with its ``stderr``, ``distance``, all in pm, and
        ``p_value``, the probability of such a displacement in units of its error, or a larger one, for a column that
        keeps still: (1 + χ²/d)^(-d/2), with χ² the sum of both axes' squares and d the degrees of freedom with which
        the error is known. NaN where a fit is not accepted.

    Raises
    ------
    SettingsError
        Where there is no such frame.

    Notes
    -----
    The errors are the medians of what the column's fits state in the hundred frames on each side, times how far its
    places scatter from frame to frame there against what the fits state (:mod:`tract_dask.analysis.weights`); of fewer
    than ten frames they are taken as stated. That of the drift, which moves all columns alike, is not in them. The
    paper compares displacements with the spread of columns that keep still (section 3.2, Figure 3); for that use
    :func:`spread`.
    """
    frames = tracks["frame"].to_numpy()
    for frame in (first, second):
        if frame not in frames:
            raise SettingsError(
                "there is no such frame", "displacement", f"a frame from {frames[0]} to {frames[-1]}", f"{frame}"
            )
    numbers = [int(np.flatnonzero(frames == frame)[0]) for frame in (first, second)]
    around = sorted({k for n in numbers for k in range(max(n - AROUND, 0), min(n + AROUND + 1, len(frames)))})
    place, stated = (
        values.isel(frame=around).transpose("frame", "column_id", "axis")
        for values in (positions(tracks), standard_errors(tracks))
    )
    error, degrees = _scaled_errors(place, stated)
    place, error = (values.sel(frame=[first, second]) for values in (place, error))
    moved = place.isel(frame=1, drop=True) - place.isel(frame=0, drop=True)
    stderr = (error**2).sum("frame", skipna=False).where(moved.notnull()) ** 0.5
    chi_squared = ((moved / stderr) ** 2).sum("axis", skipna=False)
    p_value = xr.ufuncs.exp(-degrees / 2 * xr.ufuncs.log1p(chi_squared / degrees))
    return xr.Dataset(
        {
            "displacement": named(moved, "pm", f"Displacement from frame {first} to frame {second}"),
            "distance": named(_length(moved), "pm", "Length of the displacement"),
            "stderr": named(stderr, "pm", "Standard error of the displacement"),
            "p_value": named(p_value, "1", "Probability of as much or more without motion"),
        },
        attrs={"first": first, "second": second},
    )


def _scaled_errors(place: xr.DataArray, stated: xr.DataArray) -> tuple[xr.DataArray, xr.DataArray]:
    """Return the errors of places, as far as these scatter, and the degrees of freedom (column_id) of that scale."""
    steady, scatters = [], []
    for _, places, errors in blocks(place, stated):
        steady.append(errors.transpose(1, 0, 2))
        scatters.append(scatter_of(places, errors))
    error = place.copy(data=np.concatenate(steady, axis=1))
    factor, degrees = drawn_together(np.concatenate(scatters))
    few = place.notnull().all("axis").sum("frame").to_numpy() < _FEWEST
    column = {"column_id": place["column_id"]}
    scale, known = np.where(few, 1.0, factor), np.where(few, _EXACT, degrees)
    return error * xr.DataArray(scale, column, ("column_id",)), xr.DataArray(known, column, ("column_id",))


def standard_deviation(values: xr.DataArray) -> xr.DataArray:
    """Return the standard deviation of a sample over its frames; NaN where there are fewer than two values.

    Unlike Dask's, it does not warn of columns without values. Squares are of the distances to the first frame, which
    keeps their digits.
    """
    away = values - values.isel(frame=0, drop=True).fillna(0)
    n, total, squares = away.count("frame"), away.sum("frame"), (away**2).sum("frame")
    variance = (squares - total**2 / n.where(n > 0)) / (n - 1).where(n > 1)
    return variance.clip(0) ** 0.5


def named(values: xr.DataArray, unit: str, description: str) -> xr.DataArray:
    """Return values with their unit and a sentence that says what they are, and no other attributes."""
    values = values.copy(deep=False)
    values.attrs = {"units": unit, "long_name": description}
    return values


def _length(vectors: xr.DataArray) -> xr.DataArray:
    return (vectors**2).sum("axis", skipna=False) ** 0.5


def lattice_displacement(tracks: xr.Dataset, columns: Sequence[int] | None = None) -> xr.Dataset:
    """Return how far each column is from its site on a lattice fitted to the mean places.

    The lattice has one pair of vectors, and one origin for each ``kind`` of column (sublattice). It is fitted by least
    squares; columns farther than four robust standard deviations from their sites do not count.

    Parameters
    ----------
    tracks
        Results; only accepted fits count.
    columns
        IDs of the columns to fit the lattice to, such as those well below the surface; None: all.

    Returns
    -------
    Dataset
        ``displacement`` (frame, column_id, axis) from the site, as lazy as the tracks; ``mean_displacement`` and
        ``site`` (column_id, axis); ``distance`` (column_id), the length of the mean displacement; ``index`` (column_id,
        direction), the site's number along both vectors; ``fitted`` (column_id), whether the column counted; ``vector``
        and ``vector_stderr`` (direction, axis). Lengths in pm.

    Raises
    ------
    SettingsError
        Where the columns do not make a lattice.
    """
    place = positions(tracks)
    mean = place.mean("frame").compute()
    kinds = schema.texts(tracks["kind"].to_numpy()).astype(str)
    chosen = np.ones(len(kinds), bool) if columns is None else np.isin(tracks["column_id"].to_numpy(), columns)
    found = fit_sites(mean.to_numpy(), kinds, chosen)
    site = xr.zeros_like(mean) + found.site
    directions = {"direction": schema.texts(("a", "b"))}
    vector = xr.DataArray(found.vectors, directions | {"axis": mean["axis"].to_numpy()}, ("direction", "axis"))
    index = xr.DataArray(found.index, {"column_id": mean["column_id"], **directions}, ("column_id", "direction"))
    fitted = xr.DataArray(found.fitted, {"column_id": mean["column_id"]}, ("column_id",))
    return xr.Dataset(
        {
            "displacement": named(place - site, "pm", "Displacement from the lattice site"),
            "mean_displacement": named(mean - site, "pm", "Mean displacement from the lattice site"),
            "distance": named(_length(mean - site), "pm", "Length of the mean displacement"),
            "site": named(site, "pm", "Lattice site"),
            "index": named(index, "1", "Number of the site along both vectors of the lattice"),
            "fitted": named(fitted, "1", "Whether the lattice was fitted to the column"),
            "vector": named(vector, "pm", "Vectors of the lattice"),
            "vector_stderr": named(vector.copy(data=found.stderr), "pm", "Standard errors of the vectors"),
        }
    )
