"""Intensities: Equations 3 and 5, errors by repetition, vacuum as their unit, and their course in time and dose."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import dask.array as da
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..errors import SettingsError
from ..kernels.gaussian.intensity import INTENSITY_SCALE, intensities
from ..kernels.gaussian.parameters import AMPLITUDE, SIGMA_A, SIGMA_B
from ..stages.columns.window_size import resolve_blur
from ..stages.fit.vacuum import check_box, find_vacuum
from ..store import schema
from ..store.movie import Movie
from ..store.results import accepted
from .motion import dose_of, named, pixel_size_pm, standard_deviation

UNIT = "vacuum A^2"
"""Unit of normalised intensities: that of 1 square angstrom of vacuum."""

_INTENSITIES = ("intensity", "intensity_error", "intensity_stderr")
_NORMAL_95 = 1.96


def with_scale(tracks: xr.Dataset, scale: str) -> xr.Dataset:
    """Return the tracks with intensities by Equations 3 and 5 under one of the conventions of scale.

    Parameters
    ----------
    tracks
        Results; what is not accepted becomes NaN.
    scale
        ``paper``: Equation 3 counts 0.9111 of the Gaussian, its share in a box of +-2 sigma. ``ellipse``: 0.8647, its
        share in the ellipse of Equation 5; see :func:`tract_dask.kernels.gaussian.intensity.intensities`.

    Returns
    -------
    Dataset
        As lazy as the tracks, with its attribute ``intensity_scale`` changed.

    Raises
    ------
    SettingsError
        Where there is no such convention.
    """
    if scale not in INTENSITY_SCALE:
        raise SettingsError("there is no such scale", "with_scale", ", ".join(INTENSITY_SCALE), scale)
    tracks = accepted(tracks)
    fits = tracks["fit"]
    both = xr.apply_ufunc(
        partial(intensities, scale=scale, dark_variance=tracks.attrs.get("dark_variance", 0.0)),
        fits.chunk({"parameter": -1}) if fits.chunks else fits,
        input_core_dims=[["parameter"]],
        output_core_dims=[[], []],
        dask="parallelized",
        output_dtypes=[np.float64, np.float64],
    )
    area = 2 * np.pi * fits.isel(parameter=SIGMA_A, drop=True) * fits.isel(parameter=SIGMA_B, drop=True)
    share = tracks["intensity"] / (fits.isel(parameter=AMPLITUDE, drop=True) * area)
    stderr = tracks["intensity_stderr"] * (INTENSITY_SCALE[scale] / share)
    values = {
        name: value.drop_vars(["parameter", "unit"], errors="ignore").assign_attrs(schema.RESULTS[name].attributes)
        for name, value in zip(_INTENSITIES, (*both, stderr), strict=True)
    }
    return tracks.assign(values).assign_attrs(intensity_scale=scale)


def repeated_error(tracks: xr.Dataset) -> xr.Dataset:
    """Return the error of each column's intensity by repetition, beside what is predicted (Supplementary Figure 3).

    Parameters
    ----------
    tracks
        Results, or those that :func:`normalised` returns; only accepted fits count.

    Returns
    -------
    Dataset
        Over column_id, in the intensities' unit and as lazy as the tracks: ``mean``; ``sd``, the standard deviation
        over the frames, and ``sd_stderr``, its own standard error, sd / sqrt(2 (n - 1)); ``predicted``, Equation 5, and
        ``fitted``, the standard error that the fits state, both root mean squares over the frames; ``mean_stderr``, the
        standard error of the mean; ``n`` frames.

    Notes
    -----
    ``sd`` also holds what the column's intensity really does. Equation 5 takes two independent counts, of column with
    background and of background alone, inside the ellipse; ``fitted`` is that of the fit that was made, and is what
    ``sd`` should be for a column that does not change. Frames do not lessen the error of the shape that all of them
    have from the summed image: ``mean_stderr`` is sqrt(sd^2 / n + (shape_error fitted)^2), for comparisons between
    columns.
    """
    tracks = accepted(tracks) if "status" in tracks else tracks
    intensity = tracks["intensity"]
    unit = str(intensity.attrs.get("units", "counts"))
    n = intensity.notnull().sum("frame")
    sd = standard_deviation(intensity)
    fitted = _root_mean_square(tracks["intensity_stderr"])
    of_mean = (sd**2 / n.where(n > 0) + (shape_error(tracks) * fitted) ** 2) ** 0.5
    found = {
        "mean": (intensity.mean("frame"), "Mean intensity"),
        "sd": (sd, "Standard deviation of the intensity over the frames"),
        "sd_stderr": (sd / np.sqrt(2 * (n - 1).clip(min=1)), "Standard error of that standard deviation"),
        "predicted": (_root_mean_square(tracks["intensity_error"]), "Error by Equation 5"),
        "fitted": (fitted, "Standard error that the fits state"),
        "mean_stderr": (of_mean, "Standard error of the mean intensity, that of the column's shape included"),
    }
    errors = xr.Dataset({name: named(values, unit, text) for name, (values, text) in found.items()})
    errors["n"] = named(n, "1", "Accepted frames")
    return errors


def vacuum_level(
    image: xr.Dataset | Movie,
    box: tuple[int, int, int, int] | None = None,
    *,
    columns: xr.Dataset | None = None,
    drift: xr.Dataset | None = None,
    blur_sigma_px: float | None = None,
) -> xr.Dataset:
    """Return the mean of a large box in the vacuum, far from the particle.

    Parameters
    ----------
    image
        The summed image (:func:`tract_dask.sum_image`), for the mean over all frames; or a movie, for each frame.
    box
        (y0, y1, x0, x1) in the summed image, px. None, for a summed image: the largest flat square, as the fit finds it
        (:func:`tract_dask.stages.fit.vacuum.find_vacuum`), for which ``columns`` are needed.
    blur_sigma_px
        Of that search; None: as the columns are fitted by default.
    drift
        From :func:`tract_dask.estimate_drift`, for a movie: the box moves with it, by whole pixels.

    Returns
    -------
    Dataset
        ``level``, counts in a pixel and frame, and its standard error ``stderr``, from the scatter of the pixels; both
        over frame for a movie, and lazy. Attributes ``box`` and ``area``, the box's in Å^2 (None without a pixel size;
        the paper takes more than 100).

    Raises
    ------
    SettingsError
        Where no vacuum is found, the box is none, or it leaves the image.
    """
    if isinstance(image, Movie):
        if box is None:
            raise SettingsError(
                "the vacuum of a movie needs its box",
                "vacuum_level: box",
                "y0, y1, x0, x1",
                "None",
                "Take that of the summed image: vacuum_level(summed, columns=columns).attrs['box']",
            )
        shift = schema.drift_of(drift, image.n_frames)
        check_box(box, image.shape[1:], shift, "vacuum_level: box")
        level, stderr = _levels(image, box, np.rint(shift).astype(np.int64))
        coordinates = {"frame": np.arange(image.n_frames)}
    else:
        box = box or _found(image, columns, blur_sigma_px)
        check_box(box, image["image"].shape, None, "vacuum_level: box")
        y0, y1, x0, x1 = box
        pixels = image["image"].to_numpy()[y0:y1, x0:x1]
        level, stderr = _mean(pixels[None])[0]
        coordinates = {}
    pixel = image.pixel_size_pm if isinstance(image, Movie) else image.attrs.get("pixel_size_pm")
    area = None if not pixel else (box[1] - box[0]) * (box[3] - box[2]) * (pixel / 100) ** 2
    return xr.Dataset(
        {
            "level": named(xr.DataArray(level, coordinates, tuple(coordinates)), "counts", "Mean of a pixel of vacuum"),
            "stderr": named(
                xr.DataArray(stderr, coordinates, tuple(coordinates)), "counts", "Standard error of that mean"
            ),
        },
        attrs={"box": tuple(map(int, box)), "area": area},
    )


def normalised(tracks: xr.Dataset, vacuum: xr.Dataset | xr.DataArray | float) -> xr.Dataset:
    """Return intensities in units of that of 1 Å^2 of vacuum, as the paper does before it compares them (section 2.6).

    Parameters
    ----------
    tracks
        Results; what is not accepted becomes NaN.
    vacuum
        Of :func:`vacuum_level`, for all frames or each; or the counts in a pixel of vacuum alone, which then have no
        error.

    Returns
    -------
    Dataset
        (frame, column_id) ``intensity``, ``intensity_error`` (Equation 5) and ``intensity_stderr`` (from the fit), to
        both of which the error of the vacuum, which all columns share, is added in quadrature; as lazy as the tracks.
        ``shape_error`` (column_id) as the tracks have it.

    Raises
    ------
    SettingsError
        Where the size of a pixel is not known, or the vacuum (unless it is lazy) is not above zero.
    """
    level, error = (vacuum["level"], vacuum["stderr"]) if isinstance(vacuum, xr.Dataset) else (vacuum, 0.0)
    if not (isinstance(level, xr.DataArray) and level.chunks) and not np.all(np.asarray(level) > 0):
        raise SettingsError(
            "the vacuum has no counts", "normalised: vacuum", "more than 0", f"{np.min(level):g}", "See its box"
        )
    tracks = accepted(tracks)
    unit = level / (pixel_size_pm(tracks) / 100) ** 2  # counts in a square angstrom of vacuum
    intensity = tracks["intensity"] / unit
    values = {"intensity": intensity}
    for name in _INTENSITIES[1:]:
        values[name] = ((tracks[name] / unit) ** 2 + (intensity * (error / level)) ** 2) ** 0.5
    found = {
        name: named(value.transpose("frame", "column_id"), UNIT, schema.RESULTS[name].description)
        for name, value in values.items()
    }
    beside = schema.SHAPE_ERROR.name
    return xr.Dataset(found | ({beside: tracks[beside]} if beside in tracks else {}), attrs=tracks.attrs)


def mean_intensity(tracks: xr.Dataset, frames: int | None = None) -> xr.Dataset:
    """Return mean intensities of consecutive frames: the time series of each column, smoother and with its error.

    Parameters
    ----------
    tracks
        Results, or those that :func:`normalised` returns; only accepted fits count.
    frames
        In a mean; the last ones, too few for a mean, are left out. None: all.

    Returns
    -------
    Dataset
        (frame, column_id) ``intensity`` and its standard error ``stderr``, from what the fits state, for the course of
        one column; ``shape_stderr``, the error that all means of a column share, from its shape in the summed image;
        ``chi_squared``, the mean square of the deviations from the mean in units of the frames' errors, times
        n / (n - 1): 1 for a column that does not change; ``n`` frames that count. ``frame`` is the first of each mean.
        As lazy as the tracks.

    Raises
    ------
    SettingsError
        Where ``frames`` is not between 1 and their number.

    Notes
    -----
    All frames weigh alike. Weights from the frames' own errors would favour those that noise has made brighter or
    darker, for the errors follow the intensity. Columns are compared with each other, or with a table, by
    sqrt(stderr^2 + shape_stderr^2).
    """
    tracks = accepted(tracks) if "status" in tracks else tracks
    n_frames = tracks.sizes["frame"]
    frames = n_frames if frames is None else frames
    if not 1 <= frames <= n_frames:
        raise SettingsError(
            "the number of frames in a mean is out of range", "mean_intensity: frames", f"1 to {n_frames}", f"{frames}"
        )
    groups = n_frames // frames
    used = tracks[["intensity", "intensity_stderr"]].isel(frame=slice(groups * frames))
    parts = used.coarsen(frame=frames).construct(frame=("frame", "part"))
    value, error = parts["intensity"], parts["intensity_stderr"].where(parts["intensity"].notnull())
    n = value.notnull().sum("part")
    mean, variance = value.mean("part"), (error**2).mean("part")
    scatter = (((value - mean) / error) ** 2).sum("part") / (n - 1).where(n > 1)
    unit = str(tracks["intensity"].attrs.get("units", "counts"))
    found = xr.Dataset(
        {
            "intensity": named(mean, unit, "Mean intensity"),
            "stderr": named((variance / n.where(n > 0)) ** 0.5, unit, "Standard error of the mean"),
            "shape_stderr": named(
                shape_error(tracks) * variance**0.5, unit, "Error that all means of a column share, from its shape"
            ),
            "chi_squared": named(scatter, "1", "Scatter against the errors: 1 for a column that does not change"),
            "n": named(n, "1", "Accepted frames"),
        }
    )
    return found.assign_coords(frame=tracks["frame"][: groups * frames : frames].to_numpy())


def intensity_against_dose(
    tracks: Sequence[xr.Dataset],
    columns: Sequence[int],
    *,
    vacuum: Sequence[xr.Dataset | float] | None = None,
    dose: Sequence[float] | None = None,
) -> xr.Dataset:
    """Return the intensities of columns against the dose of a frame (Figure 6c, Supplementary Figure 3c).

    Parameters
    ----------
    tracks
        One Dataset for each dose, with the same column IDs, as those of :func:`tract_dask.fit_doses`.
    columns
        IDs.
    vacuum
        For each of them what :func:`normalised` takes; None: intensities stay counts, and grow with the dose.
    dose
        Of a frame, e/Å^2, for each; None: their attribute ``dose``.

    Returns
    -------
    Dataset
        (dose, column_id), ascending: ``intensity``, the mean over the frames, with ``stderr``, that of its shape, which
        doses have in common, included; ``error_68`` and ``error_95``, of a single frame by Equation 5 (the paper's
        error bars); ``sd``, by repetition, with ``sd_stderr``; ``fitted``, that of the fit; ``n`` frames. In memory.

    Raises
    ------
    SettingsError
        Where the numbers of Datasets, doses and vacua differ, or a dose is not known.
    """
    doses = [dose_of(one) for one in tracks] if dose is None else [float(value) for value in dose]
    vacua = [None] * len(tracks) if vacuum is None else list(vacuum)
    if not len(tracks) == len(doses) == len(vacua):
        raise SettingsError(
            "every Dataset has one dose and one vacuum",
            "intensity_against_dose",
            f"{len(tracks)} of each",
            f"{len(doses)} doses, {len(vacua)} vacua",
        )
    rows = []
    for one, unit in zip(tracks, vacua, strict=True):
        known = accepted(one).sel(column_id=list(columns))
        found = repeated_error(known if unit is None else normalised(known, unit)).compute()
        counts = found["mean"].attrs["units"]
        error_95 = named(_NORMAL_95 * found["predicted"], counts, "Error by Equation 5, 95 %")
        names = {"mean": "intensity", "mean_stderr": "stderr", "predicted": "error_68"}
        found = found.rename(names).assign(error_95=error_95)
        rows.append(found)
    table: xr.Dataset = xr.concat(rows, dim="dose", join="exact").assign_coords(dose=doses).sortby("dose")
    table["dose"].attrs = {"units": "e/A^2", "long_name": "Dose of a frame"}
    return table


def shape_error(tracks: xr.Dataset) -> Any:
    """Return the error that all frames of a column share, over that of one frame, (column_id); 0 where none is told."""
    return tracks.get(schema.SHAPE_ERROR.name, 0.0)


def _root_mean_square(values: xr.DataArray) -> xr.DataArray:
    return (values**2).mean("frame") ** 0.5


def _found(summed: xr.Dataset, columns: xr.Dataset | None, blur_sigma_px: float | None) -> tuple[int, int, int, int]:
    box = None if columns is None else find_vacuum(summed, columns, resolve_blur(blur_sigma_px, columns))
    if box is None:
        raise SettingsError(
            "no vacuum is known",
            "vacuum_level: box",
            "y0, y1, x0, x1, or columns for it to be found",
            "nothing flat in the image" if columns is not None else "neither",
            "Give the box of a region without columns",
        )
    return box


def _levels(movie: Movie, box: tuple[int, int, int, int], shift: NDArray[np.int64]) -> tuple[da.Array, da.Array]:
    """Return mean and standard error of the box in each frame, (frame,), lazily, shard by shard."""
    y0, y1, x0, x1 = box
    shards = {shard.index: shard for shard in movie.shards}

    def of_shard(index: NDArray[np.int64]) -> NDArray[np.float64]:
        shard = shards[int(index[0])]
        moved = shift[shard.start : shard.stop]
        (top, left), (bottom, right) = moved.min(axis=0), moved.max(axis=0)
        block = movie.read(shard.start, shard.stop, slice(y0 + top, y1 + bottom), slice(x0 + left, x1 + right))
        boxes = np.array(
            [
                frame[dy - top : dy - top + y1 - y0, dx - left : dx - left + x1 - x0]
                for frame, (dy, dx) in zip(block, moved, strict=True)
            ]
        )
        return movie.gain * (_mean(boxes) - [movie.offset, 0.0])

    both = da.map_blocks(
        of_shard,
        da.arange(len(shards), chunks=1),
        new_axis=1,
        chunks=(tuple(shard.frames for shard in movie.shards), (2,)),
        dtype=np.float64,
    )
    return both[:, 0], both[:, 1]


def _mean(pixels: NDArray[np.generic]) -> NDArray[np.float64]:
    """Return mean and standard error of the pixels of images, (images, 2)."""
    flat = pixels.reshape(len(pixels), -1).astype(np.float64)
    return np.stack([flat.mean(axis=1), flat.std(axis=1, ddof=1) / np.sqrt(flat.shape[1])], axis=1)
