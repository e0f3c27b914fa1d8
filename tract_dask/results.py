"""results.zarr: create it, write it shard by shard, finish it, open it; and the mask of what can be trusted.

The store is created whole before the first fit (columns, measured drift, times; everything else at its fill value), so
that tasks need nothing but its path, and a viewer can open it while the fits still run.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from zarr.codecs import BloscCodec

from . import schema, stores
from .errors import StoreError
from .schema import REJECTED, Status
from .shard_files import BLOSC, encode
from .shards import Shard

_CODEC = "lz4"
_FITTED = ("fit", "stderr", "intensity", "intensity_error", "intensity_stderr")
_KNOWN_AT_START = ("drift_measured", "time")


def create(
    path: Path,
    columns: xr.Dataset,
    drift: np.ndarray[Any, Any],
    time: np.ndarray[Any, Any],
    frames_per_shard: int,
    **about: Any,
) -> None:
    """Create the store at ``path``, whole or not at all.

    Parameters
    ----------
    columns
        The columns in the summed image (:data:`schema.COLUMNS`).
    drift, time
        Measured drift (frame, axis) in px and start of each frame (frame) in s.
    frames_per_shard
        Frames in a chunk of every variable: those of a movie shard.
    about
        Attributes under :data:`stores.ATTRIBUTE`.
    """
    sizes = {
        "frame": len(time),
        "column_id": columns.sizes["column_id"],
        "parameter": len(schema.PARAMETERS),
        "axis": 2,
    }
    known = {"drift_measured": drift, "time": time}
    static = columns.assign_coords(schema.coordinates(len(time)))
    static = static.assign({name: (schema.RESULTS[name].dims, known[name]) for name in _KNOWN_AT_START})
    static["kind"] = ("column_id", schema.texts(columns["kind"].to_numpy()))
    for name in (*_KNOWN_AT_START, *schema.COLUMNS):
        static[name].attrs = (schema.RESULTS | schema.COLUMNS)[name].attributes
    static.attrs = {stores.ATTRIBUTE: stores.json_ready({**about, "complete": False})}
    aside = path.with_name(f".{path.name}.partial")
    with stores.disk_errors(path):
        stores.remove(aside)
        static.to_zarr(aside, mode="w", zarr_format=3, consolidated=False)
        group = zarr.open_group(str(aside), mode="a")
        for variable in schema.RESULTS.values():
            if variable.name not in _KNOWN_AT_START:
                shape = tuple(sizes[dim] for dim in variable.dims)
                group.create_array(
                    variable.name,
                    shape=shape,
                    chunks=(min(frames_per_shard, shape[0]), *shape[1:]),
                    dtype=variable.dtype,
                    compressors=BloscCodec(**BLOSC[_CODEC]),
                    fill_value=variable.fill,
                    dimension_names=variable.dims,
                    attributes=variable.attributes,
                )
        stores.remove(path)
        aside.replace(path)


def write(path: Path, shard: Shard, values: dict[str, np.ndarray[Any, Any]], frames_per_shard: int) -> None:
    """Write the values of every variable for the frames of ``shard``: one whole chunk each, encoded here.

    Chunks have the frames of a whole shard; that of the last shard is filled up.
    """
    for name, array in values.items():
        variable = schema.RESULTS[name]
        chunk = np.full((frames_per_shard, *array.shape[1:]), variable.fill, variable.dtype)
        chunk[: shard.frames] = array
        place = path.joinpath(name, "c", str(shard.index), *["0"] * (array.ndim - 1))
        with stores.disk_errors(path):
            place.parent.mkdir(parents=True, exist_ok=True)
            stores.write_aside(place, bytes(encode(chunk, _CODEC)))


def calibrate(path: Path, time: np.ndarray[Any, Any], **about: Any) -> None:
    """Bring a finished store's calibration up to date: times of the frames, and what its pixels mean."""
    if any(stores.attributes(path).get(name) != value for name, value in about.items()):
        zarr.open_array(str(path / "time"), mode="r+")[...] = time
        stores.update_attributes(path, **about)


def open_results(path: str | Path, *, unfinished: bool = False) -> xr.Dataset:
    """Return the tracks at ``path`` as a lazy Dataset over (frame, column_id, parameter).

    Parameters
    ----------
    path
        A results.zarr.
    unfinished
        Also open a store whose fits are not all done; what is missing is NaN, flagged ``not_converged``.

    Raises
    ------
    StoreError
        Where there are no results, or they are unfinished.
    """
    path = Path(path)
    about = stores.attributes(path)
    if not (path / "fit").is_dir():
        raise StoreError("there are no results here", str(path), "a results.zarr", remedy="Make it with tract-dask run")
    if not about.get("complete") and not unfinished:
        raise StoreError(
            "the fits are not all done",
            str(path),
            remedy="Run the same command again to finish, or open it with unfinished=True",
        )
    dataset: xr.Dataset = xr.open_zarr(path, consolidated=False)[[*schema.RESULTS, *schema.COLUMNS]]
    for key in ("pixel_size_pm", "frame_time_s", "dose"):
        dataset.attrs[key] = about.get(key)
    return dataset


def accepted(dataset: xr.Dataset, threshold: float | None = None) -> xr.Dataset:
    """Return the Dataset with every untrusted fit masked: estimates, errors and intensities become NaN.

    Parameters
    ----------
    dataset
        Results, as :func:`open_results` gives them.
    threshold
        Smallest amplitude that is believed, in units of the frame's noise; None keeps that of the fit (the paper's 2).

    Notes
    -----
    A fit is accepted where none of the flags in :data:`schema.REJECTED` is set. The paper's only condition is the one
    on the amplitude (section 2.4).
    """
    status = dataset["status"]
    if threshold is not None:
        weak = ~(abs(dataset["fit"].sel(parameter="amplitude", drop=True)) > threshold * dataset["noise"])
        status = (status & ~np.uint8(Status.BELOW_NOISE)) | (weak * np.uint8(Status.BELOW_NOISE))
    good = (status & np.uint8(REJECTED)) == 0
    return dataset.assign({name: dataset[name].where(good) for name in _FITTED} | {"status": status})
