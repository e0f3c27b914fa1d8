"""The numbers of a report: those of every column and of every frame, and series that are short enough for a page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dask
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..analysis import motion
from ..analysis.jumps import noise_factor
from ..errors import SettingsError
from ..kernels.blur import blur
from ..kernels.gaussian.model import evaluate
from ..kernels.gaussian.parameters import AMPLITUDE, X, Y
from ..settings.run import RunSettings
from ..settings.toml import load
from ..store import datasets, metadata, results, schema
from ..store.run_folder import RunFolder
from ..store.schema import Status

VALUES = 1_600_000
"""Numbers that the series of all columns together may have: 4 MB of the page."""
QUANTITIES = ("x", "y", "intensity")
_IN_MEMORY = 256 << 20
"""Tracks of no more bytes are read once; larger ones are gone through chunk by chunk, several times."""
_FRAMES = 2000
"""Points that a curve over the frames may have."""


@dataclass(frozen=True)
class Survey:
    """What a report tells of a run.

    Attributes
    ----------
    about
        What results.zarr says of itself; and ``movie``, what movie.zarr says.
    settings
        Those of the run; None where they cannot be read.
    unit, scale
        Of lengths: pm, and the size of a pixel; or px, and 1, where the size of a pixel is not known.
    columns
        Over column_id: x_ref, y_ref, kind, ``outside``, ``fits``, ``accepted``, ``share`` and the numbers of fits with
        each flag; over accepted fits the mean ``r_squared`` and ``intensity``, ``spread`` (the sd per axis),
        ``expected`` (the root mean square of the stated errors) and ``excess``, the one over the other; ``residual``,
        of the fit on the summed image, see :func:`residuals`.
    frames
        Over frame: time, drift, drift_measured (frame, axis), noise, ``share`` of accepted fits, ``bad``, and
        ``quality`` of the drift where it was measured.
    series
        See :func:`column_series`.
    factor
        Median over columns of :func:`tract_dask.analysis.jumps.noise_factor`; NaN where no error is known.
    summed
        The summed image.
    events
        The run's, as far as they are kept.
    """

    folder: Path
    tracks: xr.Dataset
    about: dict[str, Any]
    settings: RunSettings | None
    unit: str
    scale: float
    columns: xr.Dataset
    frames: xr.Dataset
    series: xr.Dataset
    factor: float
    summed: xr.Dataset
    events: list[dict[str, Any]]

    @property
    def fits(self) -> int:
        """Fits that were made."""
        return int(self.columns["fits"].sum())

    @property
    def accepted(self) -> int:
        """Fits that were accepted."""
        return int(self.columns["accepted"].sum())

    @property
    def time_unit(self) -> str:
        """Unit of the frames' times: s, or frames where the time of one is not known."""
        return "s" if self.tracks.attrs.get("frame_time_s") else "frames"


def survey(folder: Path, events: list[dict[str, Any]]) -> Survey:
    """Return what a report tells of the run in ``folder``; memory does not grow with the movie.

    Raises
    ------
    StoreError
        Where the tracks or the summed image are missing or unfinished.
    """
    places = RunFolder(folder)
    tracks = results.open_results(places.results)
    if tracks.nbytes <= _IN_MEMORY:
        tracks = tracks.load(scheduler="threads")
    summed = datasets.open_dataset(places.sum)
    about = metadata.attributes(places.results)
    scale = tracks.attrs.get("pixel_size_pm")
    measured = tracks if scale else tracks.assign_attrs(pixel_size_pm=1.0)  # lengths are then in px
    lazy = column_numbers(measured), frame_numbers(tracks), column_series(measured)
    columns, frames, series = dask.compute(*lazy, scheduler="threads", optimize_graph=False)  # else dask loses keys
    if places.drift.exists():
        frames["quality"] = ("frame", datasets.open_dataset(places.drift)["quality"].to_numpy())
    columns["residual"] = ("column_id", residuals(tracks, summed)[0])
    return Survey(
        folder=folder,
        tracks=measured,
        about=about | {"movie": metadata.attributes(places.movie)},
        settings=_settings(places.settings),
        unit="pm" if scale else "px",
        scale=scale or 1.0,
        columns=columns,
        frames=frames,
        series=series,
        factor=float(np.median(noise_factor(measured)["factor"])) if np.isfinite(columns["expected"]).any() else np.nan,
        summed=summed,
        events=events,
    )


def column_numbers(tracks: xr.Dataset) -> xr.Dataset:
    """Return the numbers over column_id of :class:`Survey`, lazily."""
    trusted = results.accepted(tracks)
    fitted, good = _fitted(tracks), _good(tracks)
    spread = motion.spread(tracks)["sd"]
    expected = ((motion.standard_errors(tracks) ** 2).mean("axis", skipna=False)).mean("frame") ** 0.5
    fits, accepted = fitted.sum("frame"), good.sum("frame")
    flags = {
        str(flag.name).lower(): (fitted & ((tracks["status"] & np.uint8(flag)) > 0)).sum("frame")
        for flag in (Status.BELOW_NOISE, Status.NOT_CONVERGED, Status.AT_BOUND, Status.SHAPE_AT_BOUND)
    }
    found = xr.Dataset(
        {
            "outside": ((tracks["status"] & np.uint8(Status.OUTSIDE_FRAME)) > 0).sum("frame"),
            "fits": fits,
            "accepted": accepted,
            "share": accepted / fits.where(fits > 0),
            "r_squared": tracks["r_squared"].where(good).mean("frame").astype(float),
            "intensity": trusted["intensity"].mean("frame"),
            "spread": spread,
            "expected": expected,
            "excess": spread / expected.where(expected > 0),
            **flags,
        }
    )
    return found.assign({name: tracks[name] for name in ("x_ref", "y_ref", "kind", "status_ref", "fit_ref")})


def frame_numbers(tracks: xr.Dataset) -> xr.Dataset:
    """Return the numbers over frame of :class:`Survey`, lazily."""
    fits = _fitted(tracks).sum("column_id")
    found = tracks[["time", "drift", "drift_measured", "noise"]]
    return found.assign(
        share=_good(tracks).sum("column_id") / fits.where(fits > 0),
        bad=((tracks["status"] & np.uint8(Status.BAD_FRAME)) > 0).any("column_id"),
    )


def column_series(tracks: xr.Dataset, values: int = VALUES) -> xr.Dataset:
    """Return place and intensity of every column in time, averaged over frames until they fit on a page, lazily.

    Parameters
    ----------
    tracks
        Results; only accepted fits count.
    values
        Numbers that all series together may have.

    Returns
    -------
    Dataset
        Over (bin, column_id, quantity), where quantity is x and y, measured from the place in the summed image (pm),
        and intensity (counts): ``mean`` over the frames of the bin, its standard error ``error`` as the fits state it;
        ``low`` and ``high``, the extremes of single frames, so that no jump and no outlier is averaged away; ``time``
        (bin), the middle of the bin. NaN where no fit is accepted. Attribute ``frames``: how many a bin has.
    """
    trusted = results.accepted(tracks)
    place = motion.positions(tracks) - motion.reference_positions(tracks)
    value = {
        "x": place.sel(axis="x", drop=True),
        "y": place.sel(axis="y", drop=True),
        "intensity": trusted["intensity"],
    }
    stated = motion.standard_errors(tracks)
    error = {"x": stated.sel(axis="x", drop=True), "y": stated.sel(axis="y", drop=True)}
    error["intensity"] = trusted["intensity_stderr"]
    n_frames, n_columns = tracks.sizes["frame"], tracks.sizes["column_id"]
    frames = _frames_a_bin(n_frames, n_columns, values)
    parts = []
    for name in QUANTITIES:
        binned, variance = _binned(value[name], frames), _binned(error[name] ** 2, frames)
        counted = binned.count()
        mean = {"mean": binned.mean(), "low": binned.min(), "high": binned.max()}
        parts.append(xr.Dataset(mean | {"error": variance.mean() ** 0.5 / counted.where(counted > 0) ** 0.5}))
    series = xr.concat(parts, dim="quantity").assign_coords(quantity=schema.texts(QUANTITIES))
    series = series.rename(frame="bin").drop_vars(["bin", "parameter", "unit"], errors="ignore")
    series["time"] = _binned(tracks["time"], frames).mean().rename(frame="bin").drop_vars("bin", errors="ignore")
    return series.transpose("bin", "column_id", "quantity").assign_attrs(frames=frames)


def frame_curve(frames: xr.Dataset) -> xr.Dataset:
    """Return the numbers over frame, averaged until a curve has no more points than a screen can show."""
    known = frames[
        [name for name in ("time", "drift", "drift_measured", "noise", "share", "quality") if name in frames]
    ]
    return known.coarsen(frame=-(-frames.sizes["frame"] // _FRAMES), boundary="pad").mean()


def residuals(tracks: xr.Dataset, summed: xr.Dataset) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what the fits on the summed image leave.

    Returns
    -------
    tuple
        The rms residual of each column in its round window as a share of its amplitude (column_id); and the windows
        (column_id, 3, window, window): blurred image, model, and their difference, in counts a frame, NaN beyond the
        disc. NaN where the column was not fitted in the summed image.
    """
    window, sigma = int(tracks.attrs["window_px"]), float(tracks.attrs["reference_blur_px"])
    image = blur(summed["image"].to_numpy(), sigma)
    parameters = tracks["fit_ref"].to_numpy().astype(np.float64)
    parameters[:, [Y, X]] += summed.attrs.get("rounding_px", (0.0, 0.0))
    half = window // 2
    rows, columns = np.mgrid[-half : half + 1, -half : half + 1]
    disc = rows**2 + columns**2 <= half**2
    shown = np.full((len(parameters), 3, window, window), np.nan)
    for k, own in enumerate(parameters):
        if not np.isfinite(own).all():
            continue
        y, x = (round(own[Y]), round(own[X]))
        if min(y, x) < half or y + half >= image.shape[0] or x + half >= image.shape[1]:
            continue
        data = image[y - half : y + half + 1, x - half : x + half + 1]
        model = evaluate(own, columns + x, rows + y)
        shown[k] = np.where(disc, np.stack([data, model, data - model]), np.nan)
    rms = np.sqrt(np.mean(shown[:, 2][:, disc] ** 2, axis=1)) / np.abs(parameters[:, AMPLITUDE])
    return rms, shown


def _fitted(tracks: xr.Dataset) -> xr.DataArray:
    """Tell which fits were made: neither does the window leave the frame, nor has the frame bad pixels."""
    return (tracks["status"] & np.uint8(Status.OUTSIDE_FRAME | Status.BAD_FRAME)) == 0


def _good(tracks: xr.Dataset) -> xr.DataArray:
    return (tracks["status"] & np.uint8(schema.REJECTED)) == 0


def _frames_a_bin(n_frames: int, n_columns: int, values: int) -> int:
    """Return how many frames are averaged, so that the series have about so many ``values``.

    A series of single frames has a value and an error; one of means also the extremes.

    Examples
    --------
    >>> _frames_a_bin(40, 34, 1_600_000), _frames_a_bin(20_000, 400, 1_600_000)
    (1, 61)
    """
    if 2 * len(QUANTITIES) * n_frames * n_columns <= values:
        return 1
    bins = max(2, values // (4 * len(QUANTITIES) * n_columns))
    return max(2, -(-n_frames // bins))


def _binned(values: xr.DataArray, frames: int) -> Any:
    """Return groups of so many consecutive frames; chunks are made whole groups first."""
    if values.chunks is not None:
        chunk = max(values.chunksizes["frame"])
        values = values.chunk(frame=max(1, chunk // frames) * frames)
    return values.coarsen(frame=frames, boundary="pad")


def _settings(path: Path) -> RunSettings | None:
    """Return the settings of the run; None where they are missing or of another version."""
    try:
        return load(path)
    except SettingsError:
        return None
