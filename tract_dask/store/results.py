"""results.zarr: create it, finish it, open it; and the mask of what can be trusted.

The store is created whole before the first fit (columns, measured drift, times; everything else at its fill value), so
that tasks need nothing but its path, and a viewer can open it while the fits still run. What is fitted lies in the
journal's folder until all is done (:mod:`tract_dask.store.parts`); then it is joined into a few files a variable.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr

from ..errors import MissingStoreError, SettingsError, StoreError
from ..settings.run import FitSettings
from ..settings.toml import from_toml
from . import datasets, disk, files, metadata, schema
from .journal import Journal, journal_beside
from .parts import CODEC, EVERY, SHARDED, WRITTEN, Growing, Parts, file_place, joined, layout, sharded
from .schema import Status, is_accepted
from .shard_files import CHUNK_KEYS, MARKED, chunk_path, codecs
from .source_pixels import with_source_coordinates

_SCALES = schema.CALIBRATION[:3]
"""What pixels and frames mean: attributes of the store, which any reader finds there."""

FITTED = ("fit", "stderr", "intensity", "intensity_error", "intensity_stderr")
"""The variables that :func:`accepted` masks."""

_FILE_SHARDS = (8, 64)
"""Shards of the movie whose fits share a file a variable: no fewer, unless there are no more; no more."""

_FILE_BYTES = 128 << 20
"""So large may such a file be, before compression."""

_CHUNK_BYTES = 32 << 20
"""Stored chunks are opened in groups, of so many bytes of ``fit``: small ones would be a task each."""


def damage(path: Path) -> StoreError | None:
    """Return what is wrong with what :func:`create` has written; None where it is sound.

    Raises
    ------
    StoreError
        Where it cannot be read.
    """
    try:
        datasets.open_dataset(path, only=[name for name in metadata.nodes(path) if name not in EVERY])
    except StoreError as error:
        if metadata.is_of_system(error):
            raise
        return error
    return None


def create(
    path: Path,
    columns: xr.Dataset,
    drift: np.ndarray[Any, Any],
    time: np.ndarray[Any, Any],
    frames_per_shard: int,
    frame_values: Mapping[str, xr.Variable] | None = None,
    rows: int | None = None,
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
        Frames in an inner chunk of every variable: those of a movie shard.
    frame_values
        Coordinates on ``frame``, such as the temperature.
    rows
        Rows of a frame, for the variables on their offsets; None: without these.
    about
        Attributes under :data:`.metadata.ATTRIBUTE`.
    """
    sizes = {"frame": len(time), "column_id": columns.sizes["column_id"], "row": rows or 0} | schema.SIZES
    known = {"drift_measured": drift, "time": time}
    static = columns.assign_coords(schema.coordinates(len(time)) | dict(frame_values or {}))
    static = static.assign({name: (schema.RESULTS[name].dims, values) for name, values in known.items()})
    static["kind"] = ("column_id", schema.texts(columns["kind"].to_numpy()))
    static = _with_groups(static)
    for name in (*known, *schema.COLUMNS):
        static[name].attrs = (schema.RESULTS | schema.COLUMNS)[name].attributes
    static.attrs = {name: about.get(name) for name in _SCALES}
    static.attrs[metadata.ATTRIBUTE] = metadata.json_ready({**about, MARKED: True, "complete": False})
    aside = disk.aside(path)
    step = min(frames_per_shard, len(time))
    per_file = _per_file(-(-len(time) // step), 8 * step * sizes["column_id"] * sizes["parameter"])
    with files.disk_errors(path):
        files.remove(aside)
        datasets.write_arrays(static, aside)
        group = zarr.open_group(aside, mode="a")
        for variable in map(WRITTEN.__getitem__, SHARDED if rows is None else EVERY):
            shape = tuple(sizes[dim] for dim in variable.dims)
            group.create_array(
                variable.name,
                shape=shape,
                chunks=(step, *shape[1:]),
                shards=(step * per_file, *shape[1:]),
                dtype=variable.dtype,
                compressors=codecs(CODEC),
                chunk_key_encoding=CHUNK_KEYS,
                fill_value=variable.fill,
                dimension_names=variable.dims,
                attributes=variable.attributes,
            )
        metadata.seal(aside)
        files.remove(path)
        disk.place_folder(aside, path)


def _with_groups(columns: xr.Dataset) -> xr.Dataset:
    """Return columns with the variables that some have: all are alone, and resolved, where they have none."""
    found = {}
    for variable in schema.OF_GROUPS:
        known = columns.get(variable.name)
        own = np.full(columns.sizes["column_id"], variable.fill) if known is None else known.to_numpy()
        found[variable.name] = variable.dims, own.astype(variable.dtype), variable.attributes
    return columns.assign(found)


def _per_file(n_shards: int, shard_bytes: int) -> int:
    """Return the shards that share a file, where the largest variable has ``shard_bytes`` a shard.

    Examples
    --------
    >>> _per_file(1000, 1000), _per_file(1000, 10 << 20), _per_file(1000, 1 << 30), _per_file(5, 1000)
    (64, 12, 8, 5)
    """
    fewest, most = _FILE_SHARDS
    return min(n_shards, max(fewest, min(most, _FILE_BYTES // shard_bytes)))


def finish(path: Path, **about: Any) -> None:
    """Say that the store is complete, once all files of its variables are on disk."""
    with files.disk_errors(path):
        disk.sync_folders(path)
    metadata.update_attributes(path, complete=True, **about)


def calibrate(path: Path, time: np.ndarray[Any, Any], **about: Any) -> None:
    """Bring a finished store's calibration up to date: times of the frames, and what its pixels mean."""
    present = metadata.attributes(path)
    same = np.array_equal(np.asarray(datasets.open_dataset(path, only=("time",))["time"]), time)
    known = any(file.startswith("time/") for file in present.get(metadata.CHUNKS, ()))  # unless this was cut off
    if not (same and known) or any(present.get(name) != value for name, value in about.items()):
        metadata.forget(path, ["time"])
        datasets.overwrite_array(path / "time", time)
        metadata.update_attributes(path, plain=about, changed=["time"], **about)


def finished_shards(path: Path) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return which shards of the store at ``path`` are done, (shards,); of a finished store, all.

    Raises
    ------
    MissingStoreError
        Where there are no results.
    """
    parts = _parts(path)
    if parts is not None:
        return parts.done
    n_frames, step, _ = layout(path)
    return np.full(-(-n_frames // step), bool(metadata.attributes(path).get("complete")))


def variables(path: Path) -> Callable[[str], Any]:
    """Return what opens a variable of the store at ``path`` by its name, to be sliced along its frames.

    Of a store whose fits are not all done it is at the fill value where they are not.

    Raises
    ------
    MissingStoreError
        Where there are no results.
    """
    parts = _parts(path)

    def opened(name: str) -> Any:
        array = datasets.open_array(path / name)
        return array if parts is None or name not in EVERY else Growing(array, name, parts)

    return opened


def growing_files(path: Path) -> list[tuple[Path, Iterator[bytes]]]:
    """Return the files that the finished shards of a store would make, and their bytes; none of a complete one."""
    parts = _parts(path)
    if parts is None:
        return []
    _, _, per_file = layout(path)
    about = metadata.attributes(path)
    found = []
    for number, start in enumerate(range(0, len(parts.done), per_file)):
        shards = range(start, min(start + per_file, len(parts.done)))
        if parts.done[shards].any():
            for name in sharded(path):
                file = chunk_path(path / name, number, *file_place(name))
                found.append((file, joined(parts, str(about.get("key")), name, shards, per_file)))
    return found


def stored_bytes(path: Path) -> int:
    """Return about how many bytes the fits take on disk, those that are done."""
    parts = _parts(path)
    if parts is not None:
        return sum((parts.run / name).stat().st_size for name in parts.files)
    return sum(file.stat().st_size for name in sharded(path) for file in (path / name).glob("c.*"))


def _parts(path: Path) -> Parts | None:
    """Return what is fitted of a store that is not complete; None where it is, or nothing is known of its fits."""
    about = metadata.attributes(path)
    if not (path / "fit").is_dir():
        raise _nothing_here(path)
    journal = None if about.get("complete") else Journal.existing(journal_beside(path), str(about.get("key")))
    if journal is None:
        return None
    n_frames, step, _ = layout(path)
    return Parts.of(journal, n_frames, step)


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
    about = metadata.attributes(path)
    if not (path / "fit").is_dir():
        raise _nothing_here(path)
    if not about.get("complete") and not unfinished:
        raise MissingStoreError(
            "the fits are not all done",
            str(path),
            remedy="Run the same command again to finish, or open it with unfinished=True",
        )
    stored = datasets.open_lazily(path, partial=not about.get("complete"))
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
    some = (*schema.OF_GROUPS, schema.SHAPE_ERROR, *schema.SCAN_ROWS.values())
    beside = [of.name for of in some if of.name in stored]
    dataset = stored[[*schema.RESULTS, *schema.COLUMNS, *beside]].chunk(frame=frames)
    if not about.get("complete"):
        dataset = _grown(dataset, path)
    dataset.attrs |= {name: about.get(name) for name in _SCALES}
    dataset.attrs |= part_attributes(about.get("part"))
    settings = from_toml(FitSettings, about["settings"], str(path))
    known = (about.get("threshold_scale", 1.0), about.get("dark_variance", 0.0))
    dataset.attrs["motion_centre"] = about.get("motion_centre", [0.0, 0.0])
    dataset.attrs |= how_fitted(settings, about["window"], about["reference_blur_px"], *known)
    return with_source_coordinates(dataset)


def part_attributes(part: Mapping[str, int] | None) -> dict[str, int]:
    """Return which part of its source a movie is, as attributes of its tracks; none where it is all of it."""
    return {f"source_{name}": number for name, number in (part or {}).items()}


def part_in_words(part: Mapping[str, int] | None) -> str | None:
    """Return which part of its source a movie is, for people; None where it is all of it.

    Examples
    --------
    >>> part_in_words({"first_frame": 5, "frame_step": 2, "top": 20, "left": 10, "bin_px": 2})
    'from frame 5 on, every 2 frames; from row 20 and column 10 on; sums of 2 x 2 pixels'
    """
    if not part:
        return None
    every, side = part["frame_step"], part["bin_px"]
    said = [
        f"from frame {part['first_frame']} on" + (f", every {every} frames" if every > 1 else ""),
        f"from row {part['top']} and column {part['left']} on",
        *([f"sums of {side} x {side} pixels"] if side > 1 else []),
    ]
    return "; ".join(said)


def _grown(dataset: xr.Dataset, path: Path) -> xr.Dataset:
    """Return the Dataset of a store that is not complete, with what is fitted so far."""
    import dask.array as da  # takes its time, and workers do not need it

    opened = variables(path)
    lazy = {
        name: da.from_array(opened(name), chunks=dataset[name].data.chunksize, name=False, fancy=False)
        for name in sharded(path)
    }
    return dataset.assign({name: dataset[name].copy(data=values) for name, values in lazy.items()})


def _nothing_here(path: Path) -> MissingStoreError:
    return MissingStoreError(
        "there are no results here", str(path), "a results.zarr", remedy="Make it with tract-dask run"
    )


def how_fitted(
    settings: FitSettings, window_px: int, reference_blur_px: float, threshold_scale: float, dark_variance: float = 0.0
) -> dict[str, Any]:
    """Return what an analysis needs to know of the fits, as attributes of their Dataset.

    They are the window's diameter, sigma of the blur that the windows went through and of that of the summed image
    (``fit_ref``), the ``shape`` (fixed or free), the ``estimator``, the ``intensity_scale``, what scales the threshold,
    and the ``dark_variance``, that of a pixel without electrons, counts^2.
    """
    return {
        "window_px": window_px,
        "window_blur_px": settings.window_blur_px,
        "reference_blur_px": float(reference_blur_px),
        "shape": settings.shape,
        "estimator": settings.estimator,
        "intensity_scale": settings.intensity_scale,
        "threshold_scale": float(threshold_scale),
        "dark_variance": float(dark_variance),
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
        Smallest amplitude that is believed, as :func:`weakest` counts it; None keeps that of the fit.

    Notes
    -----
    A fit is accepted where none of the flags in :data:`schema.REJECTED` is set. The paper's only condition is the one
    on the amplitude (section 2.4).
    """
    status = dataset["status"]
    if threshold is not None:
        weak = ~(abs(dataset["fit"].sel(parameter="amplitude", drop=True)) > weakest(dataset, threshold))
        status = (status & ~np.uint16(Status.BELOW_NOISE)) | (weak * np.uint16(Status.BELOW_NOISE))
    good = is_accepted(status)
    return dataset.assign({name: dataset[name].where(good) for name in FITTED} | {"status": status})


def weakest(dataset: xr.Dataset, threshold: float) -> xr.DataArray:
    """Return the amplitude (frame, column_id) that a fit must exceed to be accepted.

    It is the noise at the column times the threshold, scaled such that 5 % of places without a column exceed the
    default threshold in fits with the same settings.
    """
    return threshold * float(dataset.attrs.get("threshold_scale", 1.0)) * dataset["noise"]
