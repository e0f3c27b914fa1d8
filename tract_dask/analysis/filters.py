"""What the filters do to positions and intensities: Supplementary Table 1 of the paper, for any columns and frames."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ..errors import SettingsError
from ..kernels.gaussian.parameters import X, Y
from ..settings.run import FitSettings
from ..stages.fit.common_motion import CERTAIN
from ..stages.fit.filters import above_offset, filter_frame
from ..stages.fit.job import prepare
from ..stages.fit.measure import Values, measure
from ..store import files
from ..store.movie import Movie
from ..store.schema import NOT_SEEN, Status
from ..store.shards import Shard

FILTERS = ("none", "gaussian", "wiener", "tv-l1")
"""In the order of the paper's table; the first is what the others are compared with."""

TABLE = (
    "frame",
    "filter",
    "column_id",
    "r_squared",
    "x",
    "y",
    "x_difference",
    "y_difference",
    "intensity",
    "intensity_difference",
)
"""The columns of the table, as in the paper; positions in px of the frame, intensities in counts and per cent."""

_MARGIN = 0.75
"""Of a region beyond its outermost columns, in units of their windows."""


def compare_filters(
    movie: Movie,
    columns: xr.Dataset,
    drift: xr.Dataset | None = None,
    *,
    frames: Sequence[int] = (0,),
    column_ids: Sequence[int] | None = None,
    settings: FitSettings | None = None,
) -> xr.Dataset:
    """Fit columns in a few frames after each filter.

    All seven parameters are fitted, as in the paper, for a filter changes a column's shape as well.

    Parameters
    ----------
    movie, columns, drift
        As for :func:`tract_dask.fit_columns`.
    frames
        Numbers of the frames.
    column_ids
        Of the columns; None for all.
    settings
        The parameters of the filters, the window, and all else about the fits.

    Returns
    -------
    xr.Dataset
        Over (frame, filter, column_id): ``r_squared``; ``x``, ``y`` in px of the frame; their ``x_stderr``,
        ``y_stderr``, NaN after ``wiener`` and ``tv-l1``; ``intensity`` in counts; ``status``; and against the filter
        ``none`` ``x_difference``, ``y_difference`` in px and ``intensity_difference`` in per cent. What could not be
        fitted is NaN.

    Raises
    ------
    SettingsError
        Where there is no such frame or column.
    """
    known = columns["column_id"].to_numpy().tolist()
    chosen = known if column_ids is None else list(column_ids)
    _check_known("columns", chosen, known, f"{known[0]} to {known[-1]}" if known else "none")
    check_frames(frames, movie.n_frames)
    settings = dataclasses.replace(settings or FitSettings(), estimator="lsq", shape="free")
    parts = []
    for name in FILTERS:
        job = prepare(movie, columns, drift, dataclasses.replace(settings, filter=name, refine_drift=False))
        measured = [_frame_rows(measure(movie, Shard(0, frame, frame + 1), job, whole=True)) for frame in frames]
        parts.append(xr.concat(measured, "frame").assign_coords(column_id=known).sel(column_id=chosen))
    compared = xr.concat(parts, xr.IndexVariable("filter", list(FILTERS)))
    compared = compared.assign_coords(frame=list(frames)).transpose("frame", "filter", "column_id")
    plain = compared.sel(filter=FILTERS[0])
    for name in ("x", "y"):
        compared[f"{name}_difference"] = (compared[name] - plain[name]).assign_attrs(units="px")
    change = 100 * (compared["intensity"] / plain["intensity"] - 1)
    compared["intensity_difference"] = change.assign_attrs(units="%")
    compared.attrs = {
        "pixel_size_pm": movie.pixel_size_pm,
        "window_px": job.window_px,
        "blur_sigma_px": job.settings.blur_sigma_px,
    }
    return compared


def check_frames(frames: Sequence[int], n_frames: int) -> None:
    """Check that a movie of ``n_frames`` has the frames.

    Raises
    ------
    SettingsError
        Naming those that it has not.
    """
    _check_known("frames", frames, range(n_frames), f"0 to {n_frames - 1}")


def _check_known(what: str, wanted: Sequence[int], known: Sequence[int], expected: str) -> None:
    unknown = [number for number in wanted if number not in known]
    if unknown or not wanted:
        got = ", ".join(map(str, unknown)) or "none"
        raise SettingsError(f"there are no such {what}", f"compare_filters: {what}", expected, got, "Choose others")


def _frame_rows(values: Values) -> xr.Dataset:
    """Return what the table needs of the fits of one frame, over (column_id)."""
    raw = values["fit"][0, :, [X, Y]] + values["drift"][0, ::-1, None]
    failed = (values["status"][0] & (Status.NOT_CONVERGED | NOT_SEEN)) > 0
    numbers = {
        "r_squared": (values["r_squared"][0], "1"),
        "x": (raw[0], "px"),
        "y": (raw[1], "px"),
        "x_stderr": (values["stderr"][0, :, X], "px"),
        "y_stderr": (values["stderr"][0, :, Y], "px"),
        "intensity": (values["intensity"][0], "counts"),
    }
    rows = {
        name: ("column_id", np.where(failed, np.nan, value), {"units": unit}) for name, (value, unit) in numbers.items()
    }
    return xr.Dataset(rows | {"status": ("column_id", values["status"][0])})


def wiener_shifts(compared: xr.Dataset) -> list[str]:
    """Return in plain words which columns the Wiener filter moved: beyond the error of their position, for certain.

    The shift is that against the Gaussian blur, and the error the standard error of the position after that; a shift
    that large (chi-squared of both axes above 13.8) is by noise alone in one case of a thousand.
    """
    blurred, moved = (compared.sel(filter=name).transpose("frame", "column_id") for name in ("gaussian", "wiener"))
    shift = np.stack([(moved[axis] - blurred[axis]).to_numpy() for axis in ("x", "y")])
    errors = np.sqrt(((shift / np.stack([blurred[f"{axis}_stderr"] for axis in ("x", "y")])) ** 2).sum(axis=0))
    distance = np.hypot(*shift)
    pixel_size = compared.attrs.get("pixel_size_pm")
    certain = errors**2 > CERTAIN
    said = []
    for column in np.flatnonzero(certain.any(axis=0)).tolist():
        frame = int(np.argmax(np.where(certain[:, column], errors[:, column], 0)))
        length = f" ({distance[frame, column] * pixel_size:.1f} pm)" if pixel_size else ""
        said.append(
            f"the Wiener filter moved column {compared.column_id[column].item()} in {certain[:, column].sum()} of "
            f"{len(certain)} frames, most certainly in frame {compared.frame[frame].item()}: by "
            f"{distance[frame, column]:.2f} px{length}, {errors[frame, column]:.1f} times its standard error. It "
            "imposes the period of the lattice, and does not suit columns that leave their sites"
        )
    return said


def table_rows(compared: xr.Dataset) -> Iterator[dict[str, Any]]:
    """Yield the rows of the table, to six digits: frame by frame, and filter by filter, the columns."""
    frames, filters, ids = (compared[dim].to_numpy().tolist() for dim in ("frame", "filter", "column_id"))
    cells = np.stack([compared[key].transpose("frame", "filter", "column_id") for key in TABLE[3:]], axis=-1)
    for i, j, k in np.ndindex(*cells.shape[:3]):
        numbers = {key: float(f"{value:.6g}") for key, value in zip(TABLE[3:], cells[i, j, k], strict=True)}
        yield {"frame": frames[i], "filter": filters[j], "column_id": ids[k]} | numbers


def table_text(compared: xr.Dataset) -> str:
    """Return the table as text to be read: a block for each filter, as in the paper."""
    heads = ("frame", "filter", "column", "R2", "x", "y", "dx", "dy", "intensity", "change %")
    form = "{:>5}  {:<8} {:>6} {:>7} {:>9} {:>9} {:>7} {:>7} {:>10} {:>9}"
    lines, before = [form.format(*heads)], ""
    for row in table_rows(compared):
        if before and row["filter"] != before:
            lines.append("")
        before = row["filter"]
        digits = (3, 2, 2, 2, 2, 2, 1)
        numbers = (f"{row[key]:.{count}f}" for key, count in zip(TABLE[3:], digits, strict=True))
        lines.append(form.format(row["frame"], before, row["column_id"], *numbers))
    return "\n".join(lines)


def write_comparison(compared: xr.Dataset, path: Path) -> None:
    """Write the table as CSV."""
    with files.disk_errors(path), path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, TABLE)
        writer.writeheader()
        writer.writerows(table_rows(compared))


def filtered_region(
    movie: Movie, compared: xr.Dataset, frame: int, settings: FitSettings | None = None
) -> xr.DataArray:
    """Return the part of a frame that holds the compared columns, after each filter: (filter, y, x), counts.

    The coordinates are pixels of the frame. Whole frames are filtered, then cut.
    """
    settings = settings or FitSettings()
    if settings.blur_sigma_px is None:
        settings = dataclasses.replace(settings, blur_sigma_px=compared.attrs["blur_sigma_px"])
    margin = _MARGIN * compared.attrs["window_px"]
    spans = []
    for axis, length in (("y", movie.shape[1]), ("x", movie.shape[2])):
        places = compared[axis].sel(frame=frame, filter="gaussian")
        low, high = float(places.min()) - margin, float(places.max()) + margin
        low, high = (low, high) if np.isfinite(low + high) else (0.0, float(length))
        spans.append(slice(max(0, round(low)), min(length, round(high) + 1)))
    pixels = above_offset(movie.read(frame, frame + 1)[0], movie.offset)
    images = [
        filter_frame(pixels, dataclasses.replace(settings, estimator="lsq", filter=name), movie.gain)[tuple(spans)]
        for name in FILTERS
    ]
    coordinates = {"filter": list(FILTERS), "y": np.r_[spans[0]], "x": np.r_[spans[1]]}
    attributes = {"units": "counts", "pixel_size_pm": movie.pixel_size_pm, "frame": frame}
    return xr.DataArray(np.stack(images), coordinates, ("filter", "y", "x"), "counts", attributes)
