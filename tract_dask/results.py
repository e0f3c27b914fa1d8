"""results.zarr: create it, write it shard by shard, finish it, open it; and the mask of what can be trusted.

The store is created whole before the first fit (columns, measured drift, times; everything else at its fill value), so
that tasks need nothing but its path, and a viewer can open it while the fits still run.
"""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr

from . import schema, stores
from .errors import MissingStoreError, SettingsError
from .journal import entries, journal_beside
from .schema import REJECTED, Status
from .settings import FitSettings, from_toml
from .shard_files import CHUNK_KEYS, checksum, chunk_path, codecs, encode
from .shards import Shard

CALIBRATION = ("pixel_size_pm", "frame_time_s", "dose")
"""What pixels and frames mean: attributes of the store, which any reader finds there."""

_CODEC = "lz4"
FITTED = ("fit", "stderr", "intensity", "intensity_error", "intensity_stderr")
"""The variables that :func:`accepted` masks."""

_KNOWN_AT_START = ("drift_measured", "time")
SHARDED = tuple(name for name in schema.RESULTS if name not in _KNOWN_AT_START)
"""The variables of which every shard of the movie makes one chunk."""

_CHUNK_BYTES = 32 << 20
"""Stored chunks are opened in groups, of so many bytes of ``fit``: small ones would be a task each."""


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
    sizes = {"frame": len(time), "column_id": columns.sizes["column_id"]} | schema.SIZES
    known = {"drift_measured": drift, "time": time}
    static = columns.assign_coords(schema.coordinates(len(time)))
    static = static.assign({name: (schema.RESULTS[name].dims, known[name]) for name in _KNOWN_AT_START})
    static["kind"] = ("column_id", schema.texts(columns["kind"].to_numpy()))
    for name in (*_KNOWN_AT_START, *schema.COLUMNS):
        static[name].attrs = (schema.RESULTS | schema.COLUMNS)[name].attributes
    static.attrs = {name: about.get(name) for name in CALIBRATION}
    static.attrs[stores.ATTRIBUTE] = stores.json_ready({**about, "complete": False})
    aside = path.with_name(f".{path.name}.partial")
    with stores.disk_errors(path):
        stores.remove(aside)
        stores.write_arrays(static, aside)
        group = zarr.open_group(str(aside), mode="a")
        for variable in map(schema.RESULTS.__getitem__, SHARDED):
            shape = tuple(sizes[dim] for dim in variable.dims)
            group.create_array(
                variable.name,
                shape=shape,
                chunks=(min(frames_per_shard, shape[0]), *shape[1:]),
                dtype=variable.dtype,
                compressors=codecs(_CODEC),
                chunk_key_encoding=CHUNK_KEYS,
                fill_value=variable.fill,
                dimension_names=variable.dims,
                attributes=variable.attributes,
            )
        stores.seal(aside)
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
        place = chunk_path(path / name, shard.index, *[0] * (array.ndim - 1))
        data = bytes(encode(chunk, _CODEC))
        with stores.disk_errors(path):
            stores.write_aside(place, data + checksum(data))


def calibrate(path: Path, time: np.ndarray[Any, Any], **about: Any) -> None:
    """Bring a finished store's calibration up to date: times of the frames, and what its pixels mean."""
    if any(stores.attributes(path).get(name) != value for name, value in about.items()):
        stores.overwrite_array(path / "time", time)
        stores.update_attributes(path, plain=about, **about)


def finished_shards(path: Path) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return which shards of the store at ``path`` are done, (shards,); of a finished store, all.

    Those that are not may hold values already: of a task that was killed before its entry in the journal.

    Raises
    ------
    MissingStoreError
        Where there are no results.
    """
    about = stores.attributes(path)
    if not (path / "fit").is_dir():
        raise _nothing_here(path)
    fit = stores.open_array(path / "fit")
    done = np.full(-(-fit.shape[0] // fit.chunks[0]), bool(about.get("complete")))
    journal = journal_beside(path)
    with suppress(FileNotFoundError):
        if not done.all() and (journal / "key").read_text(encoding="utf-8") == about.get("key"):
            done[[index for index, _ in entries(journal) if index < len(done)]] = True
    return done


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
    MissingStoreError
        Where there are no results, they are unfinished, or another version of the package wrote them.
    """
    path = Path(path)
    about = stores.attributes(path)
    if not (path / "fit").is_dir():
        raise _nothing_here(path)
    if not about.get("complete") and not unfinished:
        raise MissingStoreError(
            "the fits are not all done",
            str(path),
            remedy="Run the same command again to finish, or open it with unfinished=True",
        )
    stored = stores.open_lazily(path, partial=not about.get("complete"))
    if lacking := [name for name in (*schema.RESULTS, *schema.COLUMNS) if name not in stored]:
        raise MissingStoreError(
            "these results are of another version",
            str(path),
            "all variables of this version",
            f"no {', '.join(lacking)}",
            "Fit again with this version: the same tract-dask run, with --overwrite",
        )
    frames, *rest = stored["fit"].encoding["chunks"]
    frames *= max(1, _CHUNK_BYTES // (8 * frames * math.prod(rest)))
    dataset = stored[[*schema.RESULTS, *schema.COLUMNS]].chunk(frame=frames)
    dataset.attrs |= {name: about.get(name) for name in CALIBRATION}
    settings = from_toml(FitSettings, about["settings"], str(path))
    dataset.attrs |= how_fitted(settings, about["window"], about["reference_blur_px"])
    return dataset


def _nothing_here(path: Path) -> MissingStoreError:
    return MissingStoreError(
        "there are no results here", str(path), "a results.zarr", remedy="Make it with tract-dask run"
    )


def how_fitted(settings: FitSettings, window: int, reference_blur_px: float) -> dict[str, Any]:
    """Return what an analysis needs to know of the fits, as attributes of their Dataset.

    They are the window's diameter, sigma of the blur that the windows went through and of that of the summed image
    (``fit_ref``), the ``shape`` (fixed or free), the ``estimator``, and the ``intensity_scale``.
    """
    return {
        "window_px": window,
        "window_blur_px": settings.window_blur_px,
        "reference_blur_px": float(reference_blur_px),
        "shape": settings.shape,
        "estimator": settings.estimator,
        "intensity_scale": settings.intensity_scale,
    }


def fitted_with(tracks: xr.Dataset, name: str) -> Any:
    """Return one of the attributes that :func:`how_fitted` makes.

    Raises
    ------
    SettingsError
        Where the tracks have lost it.
    """
    if name not in tracks.attrs:
        raise SettingsError(
            "the tracks do not say how they were fitted",
            f"tracks.attrs[{name!r}]",
            "the attributes of tract_dask.open_results or fit_columns",
            ", ".join(map(str, tracks.attrs)),
            "Keep them through what you do with the tracks, for instance by xarray.set_options(keep_attrs=True)",
        )
    return tracks.attrs[name]


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
    return dataset.assign({name: dataset[name].where(good) for name in FITTED} | {"status": status})
