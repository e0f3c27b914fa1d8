"""The tracks for other programs: CSV, Parquet, netCDF, MATLAB's .mat, and models of atoms as extended XYZ.

A file is written aside and renamed, so it is whole or not there. CSV, Parquet and XYZ are written frame by frame, and
netCDF chunk by chunk, so memory does not grow with the movie.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from ..errors import DestinationError, InputError, SettingsError
from ..kernels import linear_motion
from ..kernels.gaussian import parameters
from ..kernels.gaussian.intensity import Floats
from ..store import disk, files, metadata, results, schema
from ..store.run_folder import RunFolder
from ..store.schema import is_accepted
from ..store.source_pixels import in_source_pixels

ROWS = 1 << 17
"""Rows that are in memory at a time."""

_MAT_LIMIT = (1 << 31) - 1


def export(
    source: str | Path | xr.Dataset, path: str | Path, *, accepted_only: bool = False, overwrite: bool = False
) -> Path:
    """Write the tracks in the format that the suffix of ``path`` names.

    Parameters
    ----------
    source
        A results.zarr, the folder of a run, or the Dataset of :func:`tract_dask.open_results`.
    path
        ``.csv``, ``.parquet`` (with ``tract_dask[export]``): a row for each fit, see :func:`table`. ``.nc``: the
        Dataset as netCDF 4 (with ``tract_dask[export]``). ``.mat``: the original's layout, see :func:`original_layout`.
    accepted_only
        Leave out the fits that are not accepted: no rows in tables, NaN in netCDF. In ``.mat`` they are always marked
        in the original's way.
    overwrite
        Replace what is at ``path``.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    SettingsError
        Where the suffix is not one of these.
    DestinationError
        Where the file is there already, or its folder cannot be written.
    InputError
        Where the format cannot hold so much, or the package that writes it is missing.
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise SettingsError(
            "the format is not known",
            str(path),
            f"a suffix of {', '.join(_WRITERS)}",
            path.suffix or "no suffix",
            "For a model of atoms (.xyz) use to_xyz, or give --atoms",
        )
    _check_package(path)
    tracks = open_tracks(source)
    with written_aside(path, overwrite=overwrite) as aside:
        writer(tracks, aside, accepted_only)
    return path


def open_tracks(source: str | Path | xr.Dataset) -> xr.Dataset:
    """Return the Dataset of a results.zarr, or of the folder of a run; in pixels of the movie on disk."""
    if isinstance(source, xr.Dataset):
        return in_source_pixels(source)
    inside = RunFolder(Path(source)).results
    return in_source_pixels(results.open_results(inside if inside.exists() else source))


_LEFT_OUT = ("presence_vacuum", "motion_measured", "motion_stderr", "row_offset", "row_offset_stderr")
"""Variables over the frames that are in no table."""


def table(tracks: xr.Dataset) -> pd.DataFrame:
    """Return tracks as a table with a row for each fit, in the order of the frames.

    Parameters
    ----------
    tracks
        Results, or some frames of them; they are computed.

    Returns
    -------
    DataFrame
        ``frame``, ``time``, ``column_id``, ``kind``, ``group``, ``unresolved``, ``x_pm`` and ``y_pm`` (where the size
        of a pixel is known), then the variables of the results under their names: the parameters of the fit,
        ``x_stderr`` for the standard error of x, ``drift_y`` for the y axis of drift; ``shape_error`` of the column;
        ``accepted`` tells which fits are. Units are those of the results.
        What is measured in vacuum, and motions that are not undone, are left out.
    """
    tracks = tracks.compute()
    n_frames, n_columns = tracks.sizes["frame"], tracks.sizes["column_id"]
    columns: dict[str, Any] = {
        "frame": np.repeat(tracks["frame"].to_numpy(), n_columns),
        "time": np.repeat(tracks["time"].to_numpy(), n_columns),
        "column_id": np.tile(tracks["column_id"].to_numpy(), n_frames),
        "kind": np.tile(schema.texts(tracks["kind"].to_numpy()), n_frames),
    }
    of_groups = [variable.name for variable in schema.OF_GROUPS if variable.name in tracks]
    columns |= {name: np.tile(tracks[name].to_numpy(), n_frames) for name in of_groups}
    scale = tracks.attrs.get("pixel_size_pm")
    for axis in ("x", "y") if scale else ():
        columns[f"{axis}_pm"] = scale * tracks["fit"].sel(parameter=axis).to_numpy().ravel()
    said = [str(name) for name, of in tracks.coords.items() if of.dims == ("frame",) and name not in columns]
    for name in [*said, *map(str, tracks.data_vars)]:
        if name not in columns and name not in _LEFT_OUT and "frame" in tracks[name].dims:
            columns |= _flat(name, tracks[name], n_columns)
    if (shared := schema.SHAPE_ERROR.name) in tracks:
        columns[shared] = np.tile(tracks[shared].to_numpy(), n_frames)
    columns["accepted"] = is_accepted(tracks["status"]).to_numpy().ravel()
    return pd.DataFrame(columns)


def _flat(name: str, values: xr.DataArray, n_columns: int) -> dict[str, NDArray[Any]]:
    """Return one variable as columns of a table."""
    last = values.dims[-1]
    if last in ("parameter", "axis", "motion_kind"):
        label = {"fit": "{}", "stderr": "{}_stderr"}.get(name, f"{name}_{{}}")
        return {
            key: column
            for part in values[last].to_numpy()
            for key, column in _flat(label.format(part), values.sel({last: part}), n_columns).items()
        }
    flat = values.to_numpy().ravel()
    return {name: flat if "column_id" in values.dims else np.repeat(flat, n_columns)}


def original_layout(tracks: xr.Dataset) -> dict[str, Any]:
    """Return tracks as the arrays of the original MATLAB program.

    Parameters
    ----------
    tracks
        Results; they are computed.

    Returns
    -------
    dict
        ``RefinedPeaksGauss`` (frames x columns, 10), frame by frame, with amplitude, x, σx, y, σy, angle, intensity,
        error of the intensity, column ID, frame; ``ProjPeaksGauss`` (columns, 9), the same of the summed image without
        the frame; ``Scale`` in nm/px. Positions and frames count from 1, the angle is within ±π/4, and a fit that is
        not accepted has amplitude and intensity 0 and NaN for its place. Beside them, what the original does not keep:
        ``Background``, ``Status`` (frames, columns), ``Time`` (s), ``Drift`` (frames, 2; x, y) and ``Kind``.

    Notes
    -----
    The layout is the one that the script published with the paper documents.
    """
    tracks = tracks.compute()
    trusted = results.accepted(tracks)
    n_frames, n_columns = tracks.sizes["frame"], tracks.sizes["column_id"]
    column, frame = tracks["column_id"].to_numpy(), tracks["frame"].to_numpy()
    peaks = np.empty((n_frames, n_columns, 10))
    peaks[..., :6] = _original_parameters(trusted["fit"].to_numpy())
    peaks[..., 6], peaks[..., 7] = trusted["intensity"], trusted["intensity_error"]
    peaks[..., 8], peaks[..., 9] = column, frame[:, None] + 1
    peaks[..., [0, 6]] = np.nan_to_num(peaks[..., [0, 6]])
    summed = np.full((n_columns, 9), np.nan)
    summed[:, :6], summed[:, 8] = _original_parameters(tracks["fit_ref"].to_numpy()), column
    scale = tracks.attrs.get("pixel_size_pm")
    return {
        "RefinedPeaksGauss": peaks.reshape(-1, 10),
        "ProjPeaksGauss": summed,
        "Scale": scale / 1000 if scale else np.nan,
        "Background": trusted["fit"].sel(parameter="background").to_numpy(),
        "Status": tracks["status"].to_numpy(),
        "Time": tracks["time"].to_numpy(),
        "Drift": tracks["drift"].sel(axis=["x", "y"]).to_numpy(),
        "Kind": schema.texts(tracks["kind"].to_numpy()),
    }


def _original_parameters(fit: Floats) -> Floats:
    """Return amplitude, x, σx, y, σy, angle from Equation 1's parameters: the angle within ±π/4, x and y from 1."""
    theta = fit[..., parameters.THETA]
    turned = np.abs(theta) > np.pi / 4
    sigma_a, sigma_b = fit[..., parameters.SIGMA_A], fit[..., parameters.SIGMA_B]
    return np.stack(
        [
            fit[..., parameters.AMPLITUDE],
            fit[..., parameters.X] + 1,
            np.where(turned, sigma_b, sigma_a),
            fit[..., parameters.Y] + 1,
            np.where(turned, sigma_a, sigma_b),
            np.where(turned, theta - np.sign(theta) * np.pi / 2, theta),
        ],
        axis=-1,
    )


def _blocks(tracks: xr.Dataset, accepted_only: bool) -> Iterator[pd.DataFrame]:
    step = max(1, ROWS // max(tracks.sizes["column_id"], 1))
    for start in range(0, max(tracks.sizes["frame"], 1), step):
        rows = table(tracks.isel(frame=slice(start, start + step)))
        yield rows[rows["accepted"]] if accepted_only else rows


def _write_csv(tracks: xr.Dataset, path: Path, accepted_only: bool) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        for number, rows in enumerate(_blocks(tracks, accepted_only)):
            rows.to_csv(file, index=False, header=number == 0, lineterminator="\n")


def _write_parquet(tracks: xr.Dataset, path: Path, accepted_only: bool) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    units = {name: unit for name, unit in _units(tracks).items() if unit}
    writer = None
    try:
        for rows in _blocks(tracks, accepted_only):
            block = pa.Table.from_pandas(rows, preserve_index=False)
            if writer is None:
                schema_ = block.schema.with_metadata({"units": json.dumps(units), **_plain_attributes(tracks)})
                writer = parquet.ParquetWriter(path, schema_)
            writer.write_table(block.cast(writer.schema))
    finally:
        if writer is not None:
            writer.close()


def _write_netcdf(tracks: xr.Dataset, path: Path, accepted_only: bool) -> None:
    tracks = results.accepted(tracks) if accepted_only else tracks
    tracks = tracks.drop_encoding()
    tracks.attrs = _plain_attributes(tracks)
    tracks.to_netcdf(path, engine="h5netcdf")


def _write_mat(tracks: xr.Dataset, path: Path, accepted_only: bool) -> None:
    from scipy.io import savemat

    size = tracks.sizes["frame"] * tracks.sizes["column_id"] * 10 * 8
    if size > _MAT_LIMIT:
        raise InputError(
            "these tracks are too large for a .mat file",
            path.name,
            f"at most {_MAT_LIMIT / 1e9:.1f} GB for an array",
            f"{size / 1e9:.1f} GB",
            "Write .nc, which MATLAB's ncread reads, or export some of the frames",
        )
    savemat(path, original_layout(tracks), do_compression=False, oned_as="column")


def _units(tracks: xr.Dataset) -> dict[str, str]:
    """Return the units of the columns of :func:`table`."""
    units = dict(zip(parameters.PARAMETERS, parameters.PARAMETER_UNITS, strict=True))
    units |= {f"{name}_stderr": unit for name, unit in units.items()} | {"x_pm": "pm", "y_pm": "pm"}
    for name, values in tracks.data_vars.items():
        unit = str(values.attrs.get("units", ""))
        units |= {str(name): unit} | {f"{name}_{axis}": unit for axis in schema.AXES if "axis" in values.dims}
    return units | {f"motion_{kind}": unit for kind, unit in zip(linear_motion.NAMES, linear_motion.UNITS, strict=True)}


def _plain_attributes(tracks: xr.Dataset) -> dict[str, Any]:
    """Return the attributes that other formats hold: numbers and text; what is nested, as JSON; nothing for None."""
    return {
        str(name): value if isinstance(value, str) else json.dumps(metadata.json_ready(value), default=str)
        for name, value in tracks.attrs.items()
        if value is not None
    }


_PACKAGES = {".parquet": "pyarrow", ".nc": "h5netcdf"}

_WRITERS: dict[str, Callable[[xr.Dataset, Path, bool], None]] = {
    ".csv": _write_csv,
    ".parquet": _write_parquet,
    ".nc": _write_netcdf,
    ".mat": _write_mat,
}


def _check_package(path: Path) -> None:
    package = _PACKAGES.get(path.suffix.lower())
    if package and find_spec(package) is None:
        raise InputError(
            f"a {path.suffix} file needs the package {package}, which is not installed",
            str(path),
            remedy="Install it with pip install 'tract_dask[export]', or write .csv",
        )


@contextmanager
def written_aside(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """Yield a place beside ``path`` to write to, which takes its name if all goes well and vanishes otherwise."""
    if path.is_dir():
        raise DestinationError("a folder has this name", str(path), "a file", "a folder", "Choose another name")
    metadata.check_destination(path, overwrite=overwrite)
    aside = disk.aside(path, suffix=path.suffix)
    try:
        with files.disk_errors(path):
            yield aside
            aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)
