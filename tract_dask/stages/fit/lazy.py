"""Fits of all columns as a lazy Dataset."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ...kernels.gaussian.intensity import Floats
from ...settings.run import FitSettings
from ...store import results, schema
from ...store.movie import Movie
from .job import calibration, frame_times, prepare
from .measure import measure


def fit_columns(
    movie: Movie,
    columns: xr.Dataset,
    drift: xr.Dataset | None = None,
    settings: FitSettings | None = None,
    *,
    summed: xr.Dataset | None = None,
) -> xr.Dataset:
    """Fit every column in every frame, lazily: the Dataset computes what is asked of it, shard by shard.

    Parameters
    ----------
    movie
        An opened movie.
    columns
        From :func:`tract_dask.find_columns`.
    drift
        From :func:`tract_dask.estimate_drift`; None means none.
    settings
        Defaults to least squares on blurred pixels, with every column's shape as in the summed image.
    summed
        From :func:`tract_dask.sum_image`; the vacuum for the noise is looked for in it. Without it, and without
        ``settings.vacuum_box``, the noise of a frame is the rms residual of its fits.

    Returns
    -------
    xr.Dataset
        As declared in :data:`schema.RESULTS`, with the columns and coordinates; x and y in px, drift-corrected.

    Raises
    ------
    SettingsError
        Where a window is larger than the frame, the vacuum box leaves it, or counts (``poisson``) are negative.
    InputError
        Where float32 does not hold the pixels (:func:`tract_dask.stages.pixel_range.check_pixels`).
    """
    import dask.array as da  # takes its time, and workers do not need it

    job = prepare(movie, columns, drift, settings or FitSettings(), summed=summed)
    n_columns = len(job.reference)
    names = [name for name in schema.RESULTS if name not in ("time", "drift_measured")]
    sizes = {"frame": movie.n_frames, "column_id": n_columns} | schema.SIZES
    chunk = {shard.index: shard for shard in movie.shards}

    def fit_packed(index: NDArray[np.int64]) -> Floats:
        values = measure(movie, chunk[int(index[0])], job)
        return np.concatenate(
            [values[name].reshape(len(values["noise"]), -1) for name in names], axis=1, dtype=np.float64
        )

    tails = {name: tuple(sizes[dim] for dim in schema.RESULTS[name].dims[1:]) for name in names}
    width = sum(math.prod(tail) for tail in tails.values())
    packed = da.map_blocks(
        fit_packed,
        da.arange(len(chunk), chunks=1),
        new_axis=1,
        chunks=(tuple(shard.frames for shard in movie.shards), (width,)),
        dtype=np.float64,
        name=False,
    )
    dataset = columns.assign_coords(schema.coordinates(movie.n_frames)).assign(_unpacked(packed, tails))
    dataset["drift_measured"] = (("frame", "axis"), job.drift, schema.RESULTS["drift_measured"].attributes)
    dataset["time"] = ("frame", frame_times(movie), schema.RESULTS["time"].attributes)
    dataset.attrs = calibration(movie) | results.how_fitted(job.settings, job.window_px, job.reference_blur_px)
    return dataset


def _unpacked(packed: Any, tails: dict[str, tuple[int, ...]]) -> dict[str, Any]:
    """Return the variables that lie side by side in an array (frames, values), each of a shape ``tails`` a frame."""
    variables, offset = {}, 0
    for name, tail in tails.items():
        variable, count = schema.RESULTS[name], math.prod(tail)
        block = packed[:, offset : offset + count].reshape((len(packed), *tail))
        variables[name] = (variable.dims, block.astype(variable.dtype), variable.attributes)
        offset += count
    return variables
