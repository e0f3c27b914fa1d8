"""The tracks of a job, as its pages show them: numbers of columns and frames, series, displacements; as JSON.

Run in the process pool. All work on a store whose fits still run: then of its finished shards. Lengths are in pm, or in
px where the size of a pixel is not known; what is not known is null.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ...analysis import motion, overview
from ...analysis.overview import Calibration, Floats
from ...errors import InputError, SettingsError
from ...kernels.gaussian import parameters
from ...settings.run import FitSettings
from ...settings.toml import from_toml, load, to_dict
from ...store import datasets, metadata, results, schema
from ...store.run_folder import RunFolder
from .pictures import as_json
from .track_cache import open_tracks

_DIGITS = 6
_COLUMN_NUMBERS = {"sd": "spread", "sd_x": "sd_x", "sd_y": "sd_y", "stated": "expected", "accepted_share": "share"}
_COLUMN_NUMBERS["intensity"] = "intensity"
"""Numbers of the API by the names that they have in the overview."""


def summary(folder: Path, cache: Path, version: str) -> bytes:
    """Return how much is done, what was measured, and how."""
    path = RunFolder(folder).results
    tracks, known, about = open_tracks(path, cache), _calibration(path), metadata.attributes(path)
    counts = dict(zip(overview.COUNTS, tracks.columns.counts, strict=True))
    sizes = len(tracks.done), len(counts["fits"])
    return as_json(
        {
            "version": version,
            "complete": bool(about.get("complete")),
            "shards": {"done": int(tracks.shards.sum()), "total": len(tracks.shards)},
            "frames": {"done": int(tracks.done.sum()), "total": sizes[0]},
            "columns": sizes[1],
            "fits": int(counts["fits"].sum()),
            "accepted": int(counts["accepted"].sum()),
            **dataclasses.asdict(known),
            "unit": known.unit,
            "time_unit": known.time_unit,
            "last_time": float(_times(path)[-1]),
            "window_px": about.get("window"),
            "source": Path(str(about.get("source", ""))).name,
            "created": about.get("created"),
            "versions": about.get("versions", {}),
            "settings": _settings(folder, about),
            "bytes": {
                "zarr": results.stored_bytes(path),
                "nc": _dataset_bytes(*sizes),
                "csv": 470 * int(tracks.done.sum()) * sizes[1],
            },
        }
    )


def columns(folder: Path, cache: Path, version: str) -> bytes:
    """Return the numbers of every column."""
    path = RunFolder(folder).results
    tracks, known, static = open_tracks(path, cache), _calibration(path), _static(path)
    of = tracks.columns.numbers(known.scale)
    table = {
        "column_id": static["column_id"].to_numpy().tolist(),
        "x": numbers_of(static["x_ref"].to_numpy()),
        "y": numbers_of(static["y_ref"].to_numpy()),
        "kind": [str(kind) for kind in static["kind"].to_numpy()],
        "fits": of["fits"].tolist(),
        "accepted": of["accepted"].tolist(),
        **{name: numbers_of(of[number]) for name, number in _COLUMN_NUMBERS.items()},
    }
    return as_json({"version": version, "unit": known.unit, "columns": _rows(table)})


def series(
    folder: Path, cache: Path, column_id: int, frames: tuple[int, int | None], points: int, version: str
) -> bytes:
    """Return one column in time: place and intensity of its accepted fits, averaged where there are more than points.

    Parameters
    ----------
    frames
        The first, and the one after the last; None: all from the first.
    points
        Most of them; longer series are averaged over equal numbers of frames.

    Raises
    ------
    InputError
        Where there is no such column or frame.
    """
    path = RunFolder(folder).results
    tracks, known, static = open_tracks(path, cache), _calibration(path), _static(path)
    ids = static["column_id"].to_numpy().tolist()
    if column_id not in ids:
        raise InputError("there is no such column", "column_id", f"one of {len(ids)} columns", f"{column_id}")
    place = ids.index(column_id)
    start, stop = _range(frames, len(tracks.done))
    own = tracks.series(place, start, stop)
    step = -(-(stop - start) // points)
    reference = {axis: float(static[f"{axis}_ref"].to_numpy()[place]) for axis in ("x", "y")}
    found: dict[str, Any] = {
        "version": version,
        "column_id": column_id,
        "kind": str(static["kind"].to_numpy()[place]),
        "x_ref": reference["x"],
        "y_ref": reference["y"],
        "unit": known.unit,
        "time_unit": known.time_unit,
        "frames_per_point": step,
        "frame": list(range(start, stop, step)),
        "t": numbers_of(overview.binned_mean(_times(path)[start:stop], step)),
        "accepted": np.add.reduceat(np.isfinite(own["x"]), np.arange(0, stop - start, step), dtype=int).tolist(),
    }
    for name in overview.QUANTITIES:
        values, error = own[name], own[f"{name}_stderr"]
        found |= _points(name, values, error, step)
        if name in reference:
            away = known.scale * (values - reference[name])
            found |= _points(f"d{name}", away, known.scale * error, step)
    return as_json(found)


def frames(folder: Path, cache: Path, points: int, version: str) -> bytes:
    """Return drift, share of accepted fits and mean amplitude over the frames, averaged where they are many."""
    path = RunFolder(folder).results
    tracks, known = open_tracks(path, cache), _calibration(path)
    n_frames = len(tracks.done)
    step = -(-n_frames // points)
    found = overview.frame_curves(tracks.frames, step)
    return as_json(
        {
            "version": version,
            "time_unit": known.time_unit,
            "pixel_size_pm": known.pixel_size_pm,
            "frames_per_point": step,
            "frame": list(range(0, n_frames, step)),
            "t": numbers_of(overview.binned_mean(_times(path), step)),
            "accepted_share": numbers_of(found["share"]),
            **{name: numbers_of(found[name]) for name in ("drift_x", "drift_y", "amplitude")},
        }
    )


def displacement(folder: Path, first: int, second: int, version: str) -> bytes:
    """Return how far each column moved from one frame to another; see :func:`tract_dask.analysis.motion.displacement`.

    Raises
    ------
    InputError
        Where there is no such frame.
    """
    path = RunFolder(folder).results
    tracks, known = _around(path, (first, second), motion.AROUND), _calibration(path)
    moved = motion.displacement(tracks, first, second)
    values = {
        f"{name}_{axis}": moved[variable].sel(axis=axis).to_numpy()
        for name, variable in (("d", "displacement"), ("stderr", "stderr"))
        for axis in ("x", "y")
    }
    values |= {name: moved[name].to_numpy() for name in ("distance", "p_value")}
    table = {
        "column_id": tracks["column_id"].to_numpy().tolist(),
        "x": numbers_of(tracks["x_ref"].to_numpy()),
        "y": numbers_of(tracks["y_ref"].to_numpy()),
        **{name.replace("d_", "d"): numbers_of(of) for name, of in values.items()},
    }
    about = {"version": version, "first": first, "second": second, "unit": known.unit}
    return as_json(about | {"columns": _rows(table)})


def _rows(table: dict[str, list[Any]]) -> list[dict[str, Any]]:
    return [dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)]


def _around(path: Path, frames: tuple[int, ...], reach: int) -> xr.Dataset:
    """Return the fits of frames up to ``reach`` from some, in memory; those of frames that are not done do not count.

    Raises
    ------
    InputError
        Where there is no such frame.
    """
    finished = results.finished_shards(path)
    opened = results.variables(path)
    arrays = {name: opened(name) for name in (*results.FITTED, "status")}
    n_frames, step = arrays["fit"].shape[0], arrays["fit"].chunks[0]
    outside = [frame for frame in sorted(frames) if not 0 <= frame < n_frames]
    if outside:
        raise InputError("there is no such frame", "frame", f"0 to {n_frames - 1}", f"{outside[0]}")
    near = (range(max(0, frame - reach), min(n_frames, frame + reach + 1)) for frame in frames)
    wanted = np.unique(np.concatenate(list(near)))
    runs = np.split(wanted, np.flatnonzero(np.diff(wanted) > 1) + 1)
    coordinates = {"frame": wanted, "parameter": list(parameters.PARAMETERS)}
    tracks = _static(path).assign_coords(coordinates).assign_attrs(pixel_size_pm=_calibration(path).scale)
    for name, array in arrays.items():
        values = np.concatenate([np.asarray(array[run[0] : run[-1] + 1]) for run in runs])
        tracks[name] = (schema.RESULTS[name].dims, values)
    done = xr.DataArray(finished[wanted // step], dims="frame")
    return tracks.assign(status=tracks["status"].where(done, np.uint16(schema.Status.NOT_CONVERGED)))


def open_finished(path: Path) -> xr.Dataset:
    """Return the tracks of the frames that are done, lazily."""
    tracks = results.open_results(path, unfinished=True)
    step = datasets.open_array(path / "fit").chunks[0]
    done = np.repeat(results.finished_shards(path), step)[: tracks.sizes["frame"]]
    return tracks if done.all() else tracks.isel(frame=np.flatnonzero(done))


def numbers_of(values: Floats) -> list[float | None]:
    """Return numbers for JSON: None for what is not finite.

    Examples
    --------
    >>> numbers_of(np.array([1.5, np.nan, 0.1 + 0.2]))
    [1.5, None, 0.3]
    """
    rounded = np.round(values.astype(np.float64), _DIGITS)
    return [value if known else None for value, known in zip(rounded.tolist(), np.isfinite(rounded), strict=True)]


def _calibration(path: Path) -> Calibration:
    return Calibration.of(metadata.attributes(path))


def _static(path: Path) -> xr.Dataset:
    """Return the columns of a store: ``x_ref``, ``y_ref`` and ``kind``."""
    return _columns_of(path, str(metadata.attributes(path).get("key")))


@lru_cache(maxsize=16)
def _columns_of(path: Path, key: str) -> xr.Dataset:
    return datasets.open_dataset(path, only=("x_ref", "y_ref", "kind"))


def _range(frames: tuple[int, int | None], n_frames: int) -> tuple[int, int]:
    start, stop = frames[0], n_frames if frames[1] is None else min(frames[1], n_frames)
    if not 0 <= start < stop:
        raise InputError(
            "start and stop are not a valid range of frames",
            "start, stop",
            f"0 <= start < stop <= {n_frames}",
            f"{start}, {frames[1]}",
        )
    return start, stop


def _times(path: Path) -> Floats:
    """Return the time of every frame (frames,), as its stamps say; its number where the frame time is not known."""
    return np.asarray(datasets.open_dataset(path, only=("time",))["time"].to_numpy(), np.float64)


def _points(name: str, values: Floats, error: Floats, step: int) -> dict[str, Any]:
    """Return means over groups of frames and their standard errors; of groups of more than one also the extremes."""
    found = overview.binned(values, error, step)
    suffixes = {"mean": "", "error": "_stderr"} | ({"low": "_low", "high": "_high"} if step > 1 else {})
    return {f"{name}{suffix}": numbers_of(found[kind]) for kind, suffix in suffixes.items()}


def _settings(folder: Path, about: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of the run by group; those of the fit alone where the run's cannot be read."""
    try:
        return to_dict(load(RunFolder(folder).settings))
    except SettingsError:
        return {"fit": to_dict(from_toml(FitSettings, about["settings"]))}


def _dataset_bytes(n_frames: int, n_columns: int) -> int:
    """Return the bytes of all variables of the results, uncompressed."""
    sizes = {"frame": n_frames, "column_id": n_columns} | schema.SIZES
    return sum(
        np.dtype(variable.dtype).itemsize * int(np.prod([sizes[dim] for dim in variable.dims]))
        for variable in schema.RESULTS.values()
    )
