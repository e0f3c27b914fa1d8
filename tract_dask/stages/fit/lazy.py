"""Fits of all columns as a lazy Dataset."""

from __future__ import annotations

import xarray as xr

from ...settings.run import FitSettings
from ...store import results, schema
from ...store.movie import Movie
from ...store.source_pixels import with_source_coordinates
from .crystal import named
from .empty import calibrated
from .job import calibration, prepare
from .measure import Values, measure


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
    from dask import delayed

    job = calibrated(prepare(movie, columns, drift, settings or FitSettings(), summed=summed))
    still = named(job)
    sizes = {"frame": movie.n_frames, "column_id": len(job.reference), "row": movie.shape[1]} | schema.SIZES
    fitted = {name: of for name, of in schema.RESULTS.items() if name not in ("time", "drift_measured")}
    fitted |= schema.SCAN_ROWS if job.settings.scan_rows != "off" else {}

    def fit_shard(index: int) -> Values:
        values = measure(movie, movie.shards[index], job)
        values |= still.put_right(values) if still else {}
        return {name: values[name].astype(of.dtype) for name, of in fitted.items()}

    shards = [delayed(fit_shard, pure=False)(index) for index in range(len(movie.shards))]
    dataset = columns.assign_coords(schema.coordinates(movie.n_frames) | movie.frame_values())
    for name, of in fitted.items():
        shapes = [(shard.frames, *(sizes[dim] for dim in of.dims[1:])) for shard in movie.shards]
        blocks = [da.from_delayed(fits[name], shape, of.dtype) for fits, shape in zip(shards, shapes, strict=True)]
        dataset[name] = (of.dims, da.concatenate(blocks), of.attributes)
    dataset["drift_measured"] = (("frame", "axis"), job.drift, schema.RESULTS["drift_measured"].attributes)
    dataset[schema.SHAPE_ERROR.name] = job.shape_error
    dataset["time"] = ("frame", movie.times(), schema.RESULTS["time"].attributes)
    dataset.attrs = calibration(movie) | results.how_fitted(
        job.settings, job.window_px, job.reference_blur_px, job.scale, job.dark_variance
    )
    dataset.attrs |= results.part_attributes(movie.part)
    return with_source_coordinates(dataset)
