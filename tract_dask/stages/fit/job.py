"""What the tasks of a fit need: checked, and written for workers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ...errors import SettingsError
from ...kernels.gaussian.intensity import Floats
from ...kernels.gaussian.model import blurred
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from ...kernels.magnitude import unit_of
from ...kernels.presence import Filters, matched_filters
from ...settings.run import FitSettings
from ...settings.toml import from_toml
from ...store import datasets, metadata, schema
from ...store.journal import left_over
from ...store.movie import Movie
from ..columns.window_size import check_window, default_window, neighbour_distance
from ..pixel_range import check_pixels
from .vacuum import check_box, find_vacuum


@dataclass(frozen=True)
class Job:
    """Everything that the fit of a shard needs beside the pixels.

    Attributes
    ----------
    reference
        (columns, 7) fit on the summed image; what could not be fitted there holds the median shape at the seed's place.
    drift
        (frames, 2) measured drift, (y, x), px, of all frames of the movie.
    bad
        (frames,) frames with pixels that are NaN or infinite.
    window
        Side of the windows in px.
    vacuum
        (y0, y1, x0, x1) in the summed image, or None: noise is taken from the residuals.
    refined_by
        Fewest accepted columns that may refine a frame's drift; None leaves the drift as measured.
    """

    reference: Floats
    drift: Floats
    bad: NDArray[np.bool_]
    window: int
    vacuum: tuple[int, ...] | None
    refined_by: int | None
    settings: FitSettings

    @cached_property
    def filters(self) -> Filters:
        """The matched filter of each column, by which it is told whether it is there."""
        return matched_filters(self.reference, self.window, self.settings.window_blur_px)

    @cached_property
    def unit(self) -> float:
        """Counts in the unit that frames are computed in."""
        return unit_of(self.reference[:, [AMPLITUDE, BACKGROUND]])

    @cached_property
    def in_units(self) -> Job:
        """The same with the reference's counts in that unit."""
        if self.unit == 1:
            return self
        reference = self.reference.copy()
        reference[:, [AMPLITUDE, BACKGROUND]] /= self.unit
        return replace(self, reference=reference)


def prepare(
    movie: Movie,
    columns: xr.Dataset,
    drift: xr.Dataset | None,
    settings: FitSettings,
    *,
    summed: xr.Dataset | None = None,
) -> Job:
    """Return all that the tasks need, checked; see :func:`fit_columns` for the arguments and errors."""
    schema.validate(columns, schema.COLUMNS, "columns")
    shift = schema.drift_of(drift, movie.n_frames)
    window = settings.window_px or int(columns.attrs.get("window_px") or default_window(_spacing(columns)))
    check_window(window, movie.shape[1:])
    box = settings.vacuum_box
    if box is not None:
        check_box(box, movie.shape[1:], shift)
    elif summed is not None:
        box = find_vacuum(summed, columns, settings.blur_sigma_px)
    statistics = movie.statistics()
    check_pixels(statistics, str(movie.path))
    bad = statistics["frame_bad_pixels"].to_numpy() > 0
    if settings.estimator == "poisson":
        check_counts(statistics["frame_min"].to_numpy())
    blur = columns.attrs.get("blur_sigma_px", settings.blur_sigma_px)
    measured = drift is not None and drift.attrs.get("method") != "none"
    refined_by = settings.refine_columns if settings.refine_drift and measured else None
    return Job(_reference(columns, blur, settings), shift, bad, window, box, refined_by, settings)


def check_counts(smallest: Floats) -> None:
    """Check that the smallest pixels of the frames can be counts.

    Raises
    ------
    SettingsError
        Where one is negative.
    """
    if (smallest < 0).any():
        frame = int(np.nanargmin(smallest))
        raise SettingsError(
            "a pixel is negative, so the frames are not counts",
            "setting estimator (FitSettings)",
            "counts, or a multiple of counts, for poisson",
            f"{smallest[frame]:g} in frame {frame}",
            "Choose the estimator lsq, or convert frames from which nothing was subtracted",
        )


def _spacing(columns: xr.Dataset) -> float:
    """Return the median distance from a column to its nearest neighbour, px."""
    place = np.stack([columns["y_ref"].to_numpy(), columns["x_ref"].to_numpy()], axis=1)
    distance = neighbour_distance(place)
    if distance is None:
        raise SettingsError(
            "one column alone does not tell how large its window should be",
            "setting window_px (FitSettings)",
            "two columns or more, or a window",
            "one column",
            "Give --window-px",
        )
    return distance


def frame_times(movie: Movie) -> Floats:
    """Return the start of each frame in s; the frame's number where the frame time is not known."""
    return np.arange(movie.n_frames, dtype=np.float64) * (movie.frame_time_s or 1.0)


@lru_cache(maxsize=4)
def load_job(movie: Movie, path: Path, key: str) -> Job:
    """Return what the tasks of one fit stage share, from the stores; ``key`` tells one stage from the next."""
    store = datasets.open_dataset(path, only=(*schema.COLUMNS, "drift_measured"))
    about = metadata.attributes(path)
    if about.get("key") != key:
        raise left_over(path, f"key {key}", f"key {about.get('key')}")
    bad = movie.statistics()["frame_bad_pixels"].to_numpy() > 0
    vacuum = tuple(about["vacuum"]) if about["vacuum"] else None
    settings = from_toml(FitSettings, about["settings"], str(path))
    drift = store["drift_measured"].to_numpy()
    reference = _reference(store, about["reference_blur_px"], settings)
    return Job(reference, drift, bad, about["window"], vacuum, about["refine_columns"], settings)


def _reference(columns: xr.Dataset, blur_sigma_px: float, settings: FitSettings) -> Floats:
    """Return the fit on the summed image, which went through that blur, as it would be after that of the windows.

    Columns that have none get the median shape at their seed's place.
    """
    reference: Floats = columns["fit_ref"].to_numpy().astype(np.float64)
    known = np.isfinite(reference).all(axis=1)
    if not known.any():
        raise SettingsError(
            "no column could be fitted in the summed image",
            "columns",
            "at least one",
            "0",
            "Check the contrast and the seeds",
        )
    reference[~known] = np.median(reference[known], axis=0)
    reference[:, X] = np.where(known, reference[:, X], columns["x_ref"].to_numpy())
    reference[:, Y] = np.where(known, reference[:, Y], columns["y_ref"].to_numpy())
    return blurred(reference, settings.window_blur_px**2 - blur_sigma_px**2)


def calibration(movie: Movie) -> dict[str, float | None]:
    """Return what is known of a movie's units."""
    return {"pixel_size_pm": movie.pixel_size_pm, "frame_time_s": movie.frame_time_s, "dose": movie.dose}
